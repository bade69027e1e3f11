"""Make a configuration.

A configuration starts from a file, a mapping, another configuration or the defaults; keys are then
changed one after another.  A change from ``--set``, from an option, from ``settings=`` or from a
keyword argument always has the same effect.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ValidationError

from iscat_analysis.config.complaints import complaints
from iscat_analysis.config.files import read_optics_file, read_toml
from iscat_analysis.config.kinds import METHODS
from iscat_analysis.config.named import instruments
from iscat_analysis.config.renamed import rename
from iscat_analysis.config.schema import Config
from iscat_analysis.config.values import ALL
from iscat_analysis.errors import ConfigError
from iscat_analysis.reading import toml_of

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
    if isinstance(settings, str):
        settings = [settings]
    if not isinstance(settings, Mapping):
        if not isinstance(settings, Iterable):
            raise ConfigError(
                f'`settings` = {settings!r}: give a mapping, as in {{"optics.na": 1.42}}'
            )
        texts: list[Any]
        try:
            texts = list(settings)
        except TypeError:  # of an array without an axis
            texts = [settings]
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
    measured = found.optics | ({"covariance": found.covariance} if found.covariance else {})
    for section, key, value in changes:
        if section == "optics" and key in measured and measured[key] != value:
            raise ConfigError(
                f"optics.{key} = {value} contradicts {path}, which says {measured[key]}: change it "
                "in that file, or leave optics.file out"
            )
    optics.update(measured)
