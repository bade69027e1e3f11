"""The configuration file beside a movie, as texts by key."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import iscat_analysis as ia
from iscat_analysis.config import parse_config, toml_value
from iscat_analysis.files import whole_file


def read_texts(path: Path | None) -> dict[str, str]:
    """Read a configuration file as texts by key."""
    if path is None:
        return {}
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise ia.ConfigError(f"{path}: cannot be read ({error})") from None
    return {
        f"{section}.{name}": toml_text(value)
        for section, table in values.items()
        if isinstance(table, dict)
        for name, value in table.items()
    }


def toml_text(value: Any) -> str:
    """Write what tomllib has read."""
    return toml_value(tuple(value) if isinstance(value, list) else value)


def write_texts(path: Path, texts: Mapping[str, str]) -> ia.Config:
    """Check texts by key, and write them as a configuration file."""
    written = _written(texts)
    checked = parse_config(tomllib.loads(written), where=str(path))
    with whole_file(path) as partial:
        partial.write_text(written, encoding="utf-8")
    return checked


def config_of(texts: Mapping[str, str]) -> ia.Config:
    """Check texts by key."""
    return parse_config(tomllib.loads(_written(texts)), where="the form")


def _written(texts: Mapping[str, str]) -> str:
    tables: dict[str, list[str]] = {}
    for key, text in texts.items():
        section, _, name = key.partition(".")
        tables.setdefault(section, []).append(f"{name} = {_as_toml(text)}")
    written = "# Written by `iscat app`; `iscat config` prints every key there is.\n"
    for section, lines in tables.items():
        written += f"\n[{section}]\n" + "\n".join(lines) + "\n"
    return written


def plain(text: str) -> str:
    """Take the quotes off a text."""
    return str(tomllib.loads(f"value = {text}")["value"]) if text.startswith('"') else text


def _as_toml(text: str) -> str:
    """Put quotes around what is a text and has none."""
    try:
        tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return toml_value(text.strip())
    return text.strip()


def add_table(path: Path, section: str, toml: str) -> None:
    """Put a section, as a calibration writes it, into a configuration file in place of its own."""
    texts = read_texts(path if path.is_file() else None)
    kept = {key: text for key, text in texts.items() if not key.startswith(f"{section}.")}
    new = tomllib.loads(toml)[section]
    write_texts(path, kept | {f"{section}.{name}": toml_text(v) for name, v in new.items()})
