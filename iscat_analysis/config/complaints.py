"""Messages for errors of a configuration: the key, the value, and what to write instead."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_args

from iscat_analysis.config.schema import Config
from iscat_analysis.config.synthetic import SIMULATED
from iscat_analysis.config.values import Section

_LEAST_SIMILARITY = 0.7  # of two words, as difflib measures it
_DECIMAL_COMMA = re.compile(r"\s*([-+]?\d+),(\d+)\s*")


def complaint(item: Mapping[str, Any], called: Mapping[str, str]) -> str:
    """Write the message for one of pydantic's errors."""
    unknown = item["type"] == "extra_forbidden"
    named = len(item["loc"]) - 1 if unknown else len(item["loc"])  # an unknown key may be "str"
    location = [
        str(part) for i, part in enumerate(item["loc"]) if i == named or not _is_union_branch(part)
    ]
    key = called.get(".".join(location), ".".join(location))
    if unknown:
        near = _nearest(location[-1], location[:-1])
        known = known_keys(location[:-1])
        hint = f"; did you mean {near}?" if near else f"; known: {', '.join(known)}"
        kind = "section" if len(location) == 1 else "key"
        return f"unknown {kind} {key}{hint}"
    message = str(item["msg"]).removeprefix("Value error, ")
    if not key:
        return message
    if item["type"] == "missing":
        return f"{key}: is required"
    given = item["input"]
    comma = _DECIMAL_COMMA.fullmatch(given) if isinstance(given, str) else None
    if comma:
        return f"{key}: write {comma[1]}.{comma[2]}, with a decimal point (got {given!r})"
    shown = f" (got {given!r})" if isinstance(given, (str, int, float, list)) else ""
    if isinstance(given, (int, float)) and abs(given) < 1e300 and f"{given:g} " in message:
        shown = ""
    return f"{key}: {message[:1].lower()}{message[1:]}{shown}"


def complaints(items: Iterable[Mapping[str, Any]], called: Mapping[str, str]) -> Iterator[str]:
    """Write the messages for pydantic's errors."""
    items = tuple(items)
    for item in items:
        others = (other for other in items if other is not item)
        branch = any(other["loc"][:-1] == item["loc"][:-1] for other in others)
        number = isinstance(item["input"], (int, float))
        if not (item["type"] == "string_type" and number and branch):
            yield complaint(item, called)


def _nearest(word: str, location: list[str]) -> str:
    """Give the key that was probably meant: of this section, else with its section; or nothing."""
    known = {key.lower(): key for key in known_keys(location)}
    small = word.lower()
    begun = [key for key in known if key.startswith(small)]
    if begun:
        return known[small if small in known else begun[0]]
    if small in Config.model_fields:
        return f"section [{small}]"
    # [uncertainty] has the same keys as other sections, and is never the section that was meant
    sections = [
        section
        for section in Config.model_fields
        if section != "uncertainty" and small in known_keys([section])
    ]
    if sections and len(location) < 2:
        return " or ".join(f"{section}.{small}" for section in sections)
    near = difflib.get_close_matches(small, list(known), n=1, cutoff=_LEAST_SIMILARITY)
    return known[near[0]] if near else ""


def known_keys(location: list[str]) -> list[str]:
    """List the keys of a section."""
    model: type[Section] = Config
    for part in location:
        if part.isdigit():
            continue
        if part in SIMULATED:
            model = SIMULATED[part]
            continue
        annotation = model.model_fields[part].annotation
        model = annotation if isinstance(annotation, type) else model_of(annotation)
    return list(model.model_fields)


def section_name(model: type) -> tuple[str, ...]:
    """Name the section that a class describes."""
    for name, field in Config.model_fields.items():
        if model in (field.annotation, *get_args(field.annotation)):
            return (name,)
    return ()


def model_of(annotation: Any) -> type[Section]:
    """Give the section of an annotation that may be None."""
    model: type[Section] = next(a for a in get_args(annotation) if a is not type(None))
    return model


def _is_union_branch(part: Any) -> bool:
    return isinstance(part, str) and (
        part in {"str", "float", "int", "bool", "tuple"}
        or any(mark in part for mark in ("constrained", "literal", "function"))
    )
