"""Make a configuration: from files, mappings and changes of single keys; and write one.

A configuration starts from a file, a mapping, another configuration or the defaults; keys are then
changed one after another.  A change from ``--set``, from an option, from ``settings=`` or from a
keyword argument always has the same effect.  Messages name the key, the value, and what to write
instead; old values of keys work for one release with a notice that names the new one.
"""

from __future__ import annotations

import difflib
import re
import tomllib
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, get_args

from pydantic import ValidationError

from iscat_analysis.config.instrument import AUTO
from iscat_analysis.config.kinds import METHODS
from iscat_analysis.config.named import instruments
from iscat_analysis.config.schema import Config
from iscat_analysis.config.synthetic import SIMULATED
from iscat_analysis.config.values import ALL, Section
from iscat_analysis.errors import ConfigError
from iscat_analysis.reading import LARGEST_TEMPLATE_BYTES, read_bytes, read_text, toml_of
from iscat_analysis.text import in_toml

S = TypeVar("S", bound=Section)

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
    # The least similarity of two words, as difflib measures it
    near = difflib.get_close_matches(small, list(known), n=1, cutoff=0.7)
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
        model = model_of(model.model_fields[part].annotation)
    return list(model.model_fields)


def section_name(model: type) -> tuple[str, ...]:
    """Name the section that a class describes."""
    fields = Config.model_fields.items()
    return tuple(name for name, field in fields if model_of(field.annotation) is model)


def model_of(annotation: Any) -> type[Section]:
    """Give the section of an annotation that may be None."""
    model: type[Section] = next(iter(get_args(annotation)), annotation)
    return model


def _is_union_branch(part: Any) -> bool:
    return isinstance(part, str) and (
        part in {"str", "float", "int", "bool", "tuple"}
        or any(mark in part for mark in ("constrained", "literal", "function"))
    )


_OLD_METHODS = {"mean": "fixed", "none": "known"}


def rename(values: dict[str, Any]) -> None:
    """Replace old values of ``background.method`` in place, and say so in a `FutureWarning`."""
    background, fit, optics = (
        table if isinstance(table, dict) else {}
        for table in (values.get(name) for name in ("background", "fit", "optics"))
    )
    method, unset = str(background.get("method")), background.get("frames") is None
    dark = str(optics.get("scheme")).lower() == "darkfield"
    if method == "median" and unset and fit.get("mode") == "track" and not dark:
        background["frames"] = ALL
        _notice(
            'background.method = "median" without background.frames', f'background.frames = "{ALL}"'
        )
    elif method == "mean" and unset:
        # Without frames the mean meant that the windows slide, where the scheme allows it.
        del background["method"]
        _notice('background.method = "mean" without background.frames', '"sliding"')
    elif method in _OLD_METHODS:
        background["method"] = _OLD_METHODS[method]
        _notice(f'background.method = "{method}"', f'"{_OLD_METHODS[method]}"')


def _notice(old: str, new: str) -> None:
    warnings.warn(
        f"{old} is now called {new}; the old name works until the next release",
        FutureWarning,
        stacklevel=4,
    )


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


def read_optics_file(path: Path) -> dict[str, dict[str, Any]]:
    """Read optics that ``iscat calibrate optics`` measured: values, errors and covariance."""
    values = read_toml(path)
    tables = {name: values.get(name, {}) for name in ("optics", "uncertainty", "covariance")}
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
    return tables


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
    for name, field in Config.model_fields.items():
        section = getattr(config, name)
        if (sections is not None and name not in sections) or not (section or comments):
            continue
        lines, tables = [f"[{name}]" if section else f"# [{name}]"], []
        for key, info in model_of(field.annotation).model_fields.items():
            value = getattr(section, key, None)
            if key in SIMULATED:
                tables += [_table_toml(key, each) for each in value or ()]
            elif value is not None or comments:
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


def _anchored(table: Mapping[str, Any], keys: Iterable[str], folder: Path) -> dict[str, str]:
    """Give the paths of a table, those that are relative as of a folder."""
    return {
        key: str(folder / value)
        for key in keys
        if isinstance(value := table.get(key), str) and value not in _NOT_PATHS
    }


def _anchor_paths(values: dict[str, Any], folder: Path) -> None:
    """Make the relative paths of a file relative to the folder it lies in."""
    for section, keys in _PATH_KEYS.items():
        table: Any = values
        for name in section.split("."):
            table = table.get(name) if isinstance(table, dict) else None
        if isinstance(table, dict):
            table.update(_anchored(table, keys, folder))


def with_absolute_paths(config: Config) -> Config:
    """Make the paths absolute, for a process that runs in another folder."""
    for section, keys in _PATH_KEYS.items():
        config = _absolute(config, section.split("."), keys)
    return config


def _absolute(section: S, names: Sequence[str], keys: Iterable[str]) -> S:
    """Make the paths absolute of a section within a section."""
    if not names:
        return section.model_copy(update=_anchored(vars(section), keys, Path.cwd()))
    inner = getattr(section, names[0])
    if inner is None:
        return section
    return section.model_copy(update={names[0]: _absolute(inner, names[1:], keys)})


_EXCLUSIVE_KEYS = {
    ("particle", "mass_kda"): ("diameter_nm",),
    ("particle", "diameter_nm"): ("mass_kda",),
    ("particle", "index"): ("permittivity",),
    ("particle", "permittivity"): ("index",),
    ("simulation", "count"): ("events",),
    ("simulation", "events"): ("count", "leavings"),
}
"""Keys that exclude each other: the one that is given later removes the other."""


Source: TypeAlias = str | Path | Mapping[str, Any] | Config
"""Where a configuration comes from."""


def configure(
    source: Source | Sequence[Source] | None = None,
    *,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
    arguments: Mapping[str, Any] | None = None,
    called: Mapping[str, str] | None = None,
    instrument: str | None = None,
) -> Config:
    """Make a configuration from a file, a mapping, another configuration, or the defaults.

    Parameters
    ----------
    source : str, Path, mapping or Config, or a list of them, optional
        A TOML file, sections of keys as in ``{"optics": {"na": 1.3}}`` or
        ``{"optics.na": 1.3}``, or a configuration to change; without it, the defaults.  Of several
        the keys of a later one replace those of the ones before, and its ``[calibration]``, which
        is one line, the whole of theirs.
    settings : mapping of str to Any, or iterable of str, optional
        Changes, which replace values of the source, in their order:
        ``{"optics.na": 1.3, "fit.frames": (200, 400)}``, or text as in ``["optics.na=1.3"]``.
        None as a value unsets a key.  If two keys exclude each other, as ``particle.mass_kda``
        and ``particle.diameter_nm`` do, the later one replaces the earlier.
    arguments : mapping of str to Any, optional
        Further changes, which replace `settings`.
    called : mapping of str to str, optional
        Names in messages of keys that the caller has under another name, as in
        ``{"fit.mode": "mode"}``.
    instrument : str, optional
        Name of one of `iscat_analysis.instruments`, which replaces the defaults; a file or mapping
        replaces values of it.

    Returns
    -------
    Config
        Validated and immutable; `iscat_analysis.config` documents every key and its unit.

    Raises
    ------
    ConfigError
        The file cannot be read, a key is unknown (the nearest known one is named), or a value is
        impossible.
    """
    if isinstance(source, Config) and not settings and not arguments and instrument is None:
        return source
    given: list[Any] = list(source) if isinstance(source, (list, tuple)) else [source]
    values, changes = _merged(given)
    if instrument is not None:
        complete = any(isinstance(each, Config) for each in given)
        values = _with_instrument(instrument, values, complete=complete)
    changes += _changes(settings) + _changes(arguments)
    files = [str(each) for each in given if isinstance(each, (str, Path))]
    where = ", ".join(files) or "configuration"
    if isinstance(source, Config):
        where = "arguments" if called else "settings"
    for section, key, value in changes:
        _change(values, section, key, value)
    if any(change[:2] in _METHOD_FOLLOWS for change in changes):
        _choose_method_again(values, changes)
    return _validated(values, changes, where, called or {})


def _with_instrument(name: str, values: dict[str, Any], *, complete: bool) -> dict[str, Any]:
    """Put values over those of a named set-up."""
    begun = _nested(instruments[name].settings)
    if complete:
        raise ConfigError(
            f"`instrument` = {name!r}: a Config has a value for every key already; give "
            f'`settings=ia.instruments["{name}"].settings` to change it'
        )
    for section, table in values.items():
        known = begun.get(section)
        begun[section] = {**known, **table} if known and isinstance(table, dict) else table
    return begun


def _merged(given: Sequence[Any]) -> tuple[dict[str, Any], list[Change]]:
    """Give the sections of the first source, and the keys by which later ones change them."""
    values = _values_of(given[0]) if given else {}
    changes: list[Change] = []
    for later in map(_values_of, given[1:]):
        if "calibration" in later:
            values.pop("calibration", None)
            changes = [change for change in changes if change[0] != "calibration"]
        changes += _changes(later)
    return values, changes


def _values_of(source: Source | None) -> dict[str, Any]:
    """Give the sections of one source."""
    if source is None:
        return {}
    if isinstance(source, Config):
        return source.model_dump(exclude_none=True)
    if isinstance(source, Mapping):
        return _nested(source)
    if isinstance(source, (str, Path)):
        return read_toml(Path(source))
    raise ConfigError(
        f"a configuration is made from a file, a mapping or a Config, not from a "
        f"{type(source).__name__}: give the path of a TOML file, or sections of keys as in "
        '{"optics": {"na": 1.42}}'
    )


def load_config(
    path: Source | Sequence[Source] | None = None, overrides: Iterable[str] = ()
) -> Config:
    """Read a configuration file and change keys of it.

    Parameters
    ----------
    path : str or Path, or a list of them, optional
        TOML file, or several, of which later ones win; without it, the defaults.
    overrides : iterable of str
        ``"section.key=value"``, the value as TOML would write it (quotes may be left out).

    Returns
    -------
    Config
        Validated.  Relative paths in it are relative to the file's folder.

    Raises
    ------
    ConfigError
        As `configure` raises it.
    """
    return configure(path, settings=overrides)


def parse_config(values: Mapping[str, Any], *, where: str = "configuration") -> Config:
    """Validate a nested mapping, as `tomllib` returns it."""
    return _validated(_nested(values), [], where, {})


Change = tuple[str, str, Any]


def _validated(
    values: dict[str, Any], changes: Iterable[Change], where: str, called: Mapping[str, str]
) -> Config:
    rename(values)
    _merge_optics_file(values, changes)
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        found = dict.fromkeys(complaints(error.errors(), called))
        raise ConfigError(f"{where}: {'; '.join(found)}") from None


def _changes(settings: Mapping[str, Any] | Iterable[str] | None) -> list[Change]:
    if settings is None:
        return []
    if not isinstance(settings, Mapping):
        try:
            texts = [settings] if isinstance(settings, str) else list(settings)
        except TypeError:
            raise ConfigError(
                f'`settings` = {settings!r}: give a mapping, as in {{"optics.na": 1.42}}'
            ) from None
        if not all(isinstance(text, str) for text in texts):
            raise ConfigError(
                "`settings`: has an item that is not text; give a mapping, or texts such as "
                "optics.na=1.42"
            )
        return [_parsed(text) for text in texts]
    found = []
    for name, value in settings.items():
        section, dot, key = str(name).partition(".")
        if dot and section and key:
            found.append((section, key, value))
        elif not dot and isinstance(value, Mapping):
            found += [(section, str(each), item) for each, item in value.items()]
        else:
            raise ConfigError(f'settings: write "{name}" as "section.key", as in "optics.na"')
    return found


def _parsed(text: str) -> Change:
    """Read ``section.key=value``, the argument of ``--set``."""
    name, equals, written = text.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise ConfigError(
            f"`settings` = {text}: write it as section.key=value, as in optics.na=1.42"
        )
    try:
        value = toml_of(f"value = {written}")["value"]
    except tomllib.TOMLDecodeError:
        value = written.strip()
    return section, key, value


def _nested(source: Mapping[str, Any]) -> dict[str, Any]:
    """Copy a mapping; ``{"optics.na": 1.3}`` becomes ``{"optics": {"na": 1.3}}``."""
    values: dict[str, Any] = {}
    for name, value in source.items():
        section, dot, key = str(name).partition(".")
        if dot:
            _change(values, section, key, value, exclude=False)
        elif isinstance(value, Mapping) and isinstance(values.get(section), dict):
            values[section].update(deepcopy(dict(value)))
        else:
            values[section] = deepcopy(dict(value)) if isinstance(value, Mapping) else value
    return values


def _change(
    values: dict[str, Any], section: str, key: str, value: Any, *, exclude: bool = True
) -> None:
    table = values.setdefault(section, {})
    if not isinstance(table, dict):
        raise ConfigError(f"{section}.{key}: {section} is not a section but {table!r}")
    key, dot, inner = key.partition(".")
    if dot:  # a key of a table, as in optics.aberrations_nm.z11
        held = table.get(key)
        value = {**(held if isinstance(held, dict) else {}), inner: value}
        value = {name: each for name, each in value.items() if each is not None}
    if value is None:
        table.pop(key, None)
        return
    table[key] = value
    for rival in _EXCLUSIVE_KEYS.get((section, key), ()) if exclude else ():
        table.pop(rival, None)


_METHOD_FOLLOWS = {
    ("background", "frames"),
    ("background", "method"),
    ("optics", "scheme"),
    ("fit", "mode"),
}
_WITHOUT_FRAMES = frozenset(name for name, kind in METHODS.items() if not kind.takes_frames)


def _choose_method_again(values: dict[str, Any], changes: Iterable[Change]) -> None:
    """Choose again between a fixed and a sliding background after a change.

    A configuration that is changed names its method, which followed from the frames, the scheme and
    the mode that it had.  A method that is among the changes is taken as it is, and removes frames
    of the source that contradict it.
    """
    background = values.get("background")
    if not isinstance(background, dict):
        return
    named = {key: value for section, key, value in changes if section == "background"}
    if named.get("method") is not None:
        if named["method"] in _WITHOUT_FRAMES and "frames" not in named:
            background.pop("frames", None)
    elif background.get("method") in _WITHOUT_FRAMES or (
        background.get("method") == "fixed"
        and (background.get("frames") is None or named.get("frames") == ALL)
    ):
        del background["method"]


def _merge_optics_file(values: dict[str, Any], changes: Iterable[Change]) -> None:
    """Put the values of ``optics.file`` over those of the section."""
    optics = values.get("optics")
    path = optics.get("file") if isinstance(optics, dict) else None
    if not isinstance(optics, dict) or not isinstance(path, str):
        return
    found = read_optics_file(Path(path))
    measured = found["optics"]
    if found["covariance"]:
        measured["covariance"] = found["covariance"]
    for section, key, value in changes:
        if section == "optics" and key in measured and measured[key] != value:
            raise ConfigError(
                f"optics.{key} = {value} contradicts {path}, which says {measured[key]}: change it "
                "in that file, or leave optics.file out"
            )
    optics.update(measured)
