"""Calibrations that lie beside a movie, and how one goes into its configuration."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import panel as pn

from iscat_analysis.errors import DataError
from iscat_app.chosen import Chosen, Notice, in_line
from iscat_app.setup_file import add_table, read_texts, toml_text, write_texts

_KINDS = {
    "camera": ("*.camera/camera.toml", "camera"),
    "optics": ("*.optics/optics.toml", "optics"),
    "mass": ("*.calibration/calibration.toml", "line of the masses"),
}
"""Where calibrations are, and what they are called."""


def beside(folder: Path) -> dict[str, str]:
    """List the calibrations of a folder by what they are."""
    return {
        f"{name}: {path.parent.stem}": str(path)
        for pattern, name in _KINDS.values()
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
    if calibration.name == "camera.toml":
        folder = calibration.parent.resolve()
        _put(setup, {
            f"camera.{key}": toml_text(str(folder / value) if isinstance(value, str) else value)
            for key, value in values["camera"].items()
        })  # fmt: skip
        return f"[camera] of {setup} has gain, offset and read noise of {calibration}"
    add_table(setup, "calibration", text)
    return f"[calibration] of {setup} is the line of {calibration}; analyse anew to use it"


def _put(setup: Path, texts: dict[str, str]) -> None:
    write_texts(setup, read_texts(setup if setup.is_file() else None) | texts)


class Taken:
    """Chooses one of the calibrations and puts it into the movie's configuration."""

    def __init__(self, chosen: Chosen, notice: Notice) -> None:
        self._chosen, self._notice = chosen, notice
        self._list = pn.widgets.Select(label="Calibrations beside the movie", width=280)
        self._use = pn.widgets.Button(label="Put it into iscat.toml", width=170)
        self._use.on_click(self._take)
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

    def _take(self, _: Any) -> None:
        setup = self._chosen.setup
        if setup is None or not self._list.value:
            self._notice.say("Choose a movie under Open, and a calibration.", "error")
            return
        with self._notice.told():
            said = take(Path(self._list.value), setup)
            self._chosen.changed += 1
            self._notice.say(said)
