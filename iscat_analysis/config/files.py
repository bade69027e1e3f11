"""Reading and writing TOML."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from iscat_analysis.config.complaints import model_of
from iscat_analysis.config.instrument import AUTO
from iscat_analysis.config.schema import Config
from iscat_analysis.config.synthetic import SIMULATED
from iscat_analysis.config.values import Section
from iscat_analysis.errors import ConfigError
from iscat_analysis.reading import LARGEST_TEMPLATE_BYTES, read_bytes, read_text, toml_of
from iscat_analysis.text import in_toml


@dataclass(frozen=True)
class OpticsFile:
    """Optics that ``iscat calibrate optics`` measured."""

    optics: dict[str, Any]
    uncertainty: dict[str, Any]
    covariance: dict[str, Any]


def read_toml(path: Path) -> dict[str, Any]:
    """Read a configuration file without validating it."""
    try:
        text = read_text(path)
        values = toml_of(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not a text file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not valid TOML: {_explain(text, str(error))}") from None
    _anchor_paths(values, path.parent)
    return values


def read_optics_file(path: Path) -> OpticsFile:
    """Read the optics that were measured from a movie."""
    values = read_toml(path)
    tables = {name: values.pop(name, {}) for name in ("optics", "uncertainty", "covariance")}
    checksum = values.get("template", {}).get("sha256")
    if checksum is not None:
        _check_sum(path, Path(tables["optics"].get("template", "")), checksum)
    if not tables["optics"] or not all(isinstance(table, dict) for table in tables.values()):
        raise ConfigError(
            f"{path}: has no table [optics], which optics.file needs; "
            "`iscat calibrate optics` writes one"
        )
    if "file" in tables["optics"]:
        raise ConfigError(f"{path}: names another optics file: give that one as optics.file")
    return OpticsFile(**tables)


def _check_sum(path: Path, template: Path, checksum: str) -> None:
    """Refuse a template that is not the one an optics file was written with."""
    try:
        found = sha256(read_bytes(template, LARGEST_TEMPLATE_BYTES)).hexdigest()
    except OSError as error:
        raise ConfigError(
            f"{path}: names the template {template}, which cannot be read ({error.strerror}): keep "
            "both files of `iscat calibrate optics --measured` together"
        ) from None
    if found != checksum:
        raise ConfigError(
            f"{template}: is not the template that {path.name} was written with (its SHA-256 "
            f"differs): keep both files of `iscat calibrate optics --measured` together"
        )


def _explain(text: str, message: str) -> str:
    """Explain an error of the TOML parser."""
    place = re.search(r"\(at line (\d+)", message)
    lines = text.splitlines()
    number = int(place[1]) if place else 0
    line = lines[number - 1].strip() if 0 < number <= len(lines) else ""
    comma = re.match(r"(\w+)\s*=\s*([-+]?\d+),(\d+)\s*(#.*)?$", line)
    if comma:
        return (
            f"line {number}: numbers have a decimal point: write {comma[1]} = {comma[2]}.{comma[3]}"
        )
    if "twice" in message:
        return f"line {number}: the section {line} is there twice: put its keys under one heading"
    if "overwrite" in message:
        key = line.partition("=")[0].strip() if place else lines[-1].partition("=")[0].strip()
        return f"the key {key} is given twice in its section: leave one out"
    return message


def config_to_toml(
    config: Config, *, comments: bool = True, sections: Collection[str] | None = None
) -> str:
    """Write a configuration as TOML that `load_config` reads back to an equal object.

    Parameters
    ----------
    config : Config
        What to write.
    comments : bool
        Put each key's description beside it and show unset keys commented out.
    sections : collection of str, optional
        Which ones to write; default all.

    Returns
    -------
    str
        TOML text.
    """
    if not isinstance(config, Config):
        raise ConfigError(f"`config`: is {type(config).__name__}; give what `configure` returns")
    if not isinstance(comments, bool):
        raise ConfigError(f"`comments`: is {type(comments).__name__}; give True or False")
    known = [*Config.model_fields]
    if sections is not None and not (
        isinstance(sections, Iterable)
        and all(isinstance(name, str) and name in known for name in sections)
    ):
        raise ConfigError(f"`sections`: has an unknown name; the sections are {', '.join(known)}")
    blocks = []
    for name, field in type(config).model_fields.items():
        if sections is not None and name not in sections:
            continue
        model: Section | type[Section]
        section = getattr(config, name)
        model = section if section is not None else model_of(field.annotation)
        if section is None and not comments:
            continue
        lines = [f"[{name}]" if section is not None else f"# [{name}]"]
        tables: list[str] = []
        fields = (model if isinstance(model, type) else type(model)).model_fields
        for key, info in fields.items():
            value = getattr(section, key) if section is not None else None
            if key in SIMULATED:
                tables += [_table_toml(key, each) for each in value or ()]
                continue
            if value is None and not comments:
                continue
            line = f"# {key} =" if value is None else f"{key} = {toml_value(value)}"
            lines.append(f"{line:<36} # {info.description}" if comments else line)
        blocks.append("\n".join([*lines, *tables]))
    return "\n\n".join(blocks) + "\n"


def _table_toml(key: str, table: Section) -> str:
    lines = [f"{k} = {toml_value(v)}" for k, v in table.model_dump().items() if v is not None]
    return "\n".join([f"[[simulation.{key}]]", *lines])


def toml_value(value: Any) -> str:
    """Write a value in TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return in_toml(value)
    if isinstance(value, tuple):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    if isinstance(value, Section):
        return toml_value(value.model_dump(exclude_none=True))
    if isinstance(value, dict):
        items = ", ".join(f"{k} = {toml_value(v)}" for k, v in value.items())
        return f"{{ {items} }}" if items else "{}"
    return repr(value)


_PATH_KEYS = {
    "optics": ("file", "template"),
    "camera": ("gain_e_per_adu", "offset_adu", "read_noise_e", "response"),
    "simulation": ("background",),
    "calibration.optics": ("template",),
}

_NOT_PATHS = ("flat", "speckle", AUTO)


def _anchor_paths(values: dict[str, Any], folder: Path) -> None:
    """Make the relative paths of a file relative to the folder it lies in."""
    for section, keys in _PATH_KEYS.items():
        table: Any = values
        for name in section.split("."):
            table = table.get(name) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            continue
        for key in keys:
            value = table.get(key)
            if isinstance(value, str) and value not in _NOT_PATHS:
                table[key] = str(folder / value)


def with_absolute_paths(config: Config) -> Config:
    """Make the paths absolute, for a process that runs in another folder."""
    changed: dict[str, Any] = {}
    for section, keys in _PATH_KEYS.items():
        name, _, inner = section.partition(".")
        whole: Any = changed.get(name, getattr(config, name))
        table: Any = getattr(whole, inner, None) if inner else whole
        paths = {
            key: str(Path(value).absolute())
            for key in keys
            if isinstance(value := getattr(table, key, None), str) and value not in _NOT_PATHS
        }
        if paths:
            table = table.model_copy(update=paths)
            changed[name] = whole.model_copy(update={inner: table}) if inner else table
    return config.model_copy(update=changed) if changed else config
