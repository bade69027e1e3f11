"""The configuration file beside a movie, as texts by key, and the calibrations that go into it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import panel as pn

import iscat_analysis as ia
from iscat_analysis.config import parse_config, toml_value
from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.movie import setup_beside
from iscat_app.chosen import Chosen, Notice
from iscat_app.widgets import in_line


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


_KINDS = (
    ("*.camera/camera.toml", "camera"),
    ("*.optics/optics.toml", "optics"),
    ("*.calibration/calibration.toml", "line of the masses"),
)
"""Where calibrations are, and what they are called."""


def beside(folder: Path) -> dict[str, str]:
    """List the calibrations of a folder by what they are."""
    return {
        f"{name}: {path.parent.stem}": str(path)
        for pattern, name in _KINDS
        for path in sorted(folder.glob(pattern))
    }


def take(calibration: Path, setup: Path) -> str:
    """Put a calibration into a configuration file; say what it is now."""
    if calibration.name == "optics.toml":
        _put(setup, {"optics.file": toml_text(str(calibration.resolve()))})
        return f"optics.file of {setup} is {calibration}"
    try:
        text = calibration.read_text(encoding="utf-8")
        values: dict[str, Any] = tomllib.loads(text)
    except (OSError, ValueError) as error:
        raise DataError(f"{calibration}: cannot be read ({error}); calibrate again") from None
    if calibration.name != "camera.toml":
        add_table(setup, "calibration", text)
        return f"[calibration] of {setup} is the line of {calibration}; analyse anew to use it"
    folder = calibration.parent.resolve()
    for key, value in values["camera"].items():
        placed = str(folder / value) if isinstance(value, str) else value
        values["camera"][key] = toml_text(placed)
    _put(setup, {f"camera.{key}": value for key, value in values["camera"].items()})
    return f"[camera] of {setup} has gain, offset and read noise of {calibration}"


def _put(setup: Path, texts: dict[str, str]) -> None:
    write_texts(setup, read_texts(setup if setup.is_file() else None) | texts)


class Taken:
    """Chooses one of the calibrations and puts it into the movie's configuration."""

    def __init__(self, chosen: Chosen, notice: Notice) -> None:
        self._chosen, self._notice = chosen, notice
        self._list = pn.widgets.Select(label="Calibrations beside the movie", width=280)
        self._use = notice.button("Put it into iscat.toml", 170, self._take)
        self.body = in_line(self._list, self._use)

    def refresh(self) -> None:
        """List what there is now."""
        place = self._chosen.movie or self._chosen.result
        found = {} if place is None else beside(place.parent)
        if found != self._list.options:
            known = self._list.options or {}
            new = [path for name, path in found.items() if name not in known]
            last = [*found.values(), *new][-1] if found else None
            self._list.param.update(options=found, value=last)
        self._use.disabled = not found

    def _take(self) -> None:
        if not self._list.value:
            raise DataError("Choose a calibration first.")
        said = take(Path(self._list.value), setup_beside(self._chosen.wanted_movie))
        self._chosen.changed += 1
        self._notice.say(said)
