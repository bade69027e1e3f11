"""Set up: a form made of the configuration's schema, with what the search would find."""

from __future__ import annotations

import html
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d
from bokeh.palettes import gray
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.pipeline.setup import Setup, write_setup
from iscat_app.chosen import Chosen, Notice
from iscat_app.settings import Taken, config_of, plain, read_texts, toml_text, write_texts

_SIDE_PX = 380
_ENDS = (0.005, 0.995)  # quantiles that are black and white


class DetectionPreview:
    """A picture that follows the form."""

    def __init__(self, chosen: Chosen, notice: Notice) -> None:
        self._chosen, self._notice = chosen, notice
        self._config: ia.Config | None = None
        self.asked = pn.widgets.Checkbox(label="Show what the search finds with these values")
        self._image = ColumnDataSource({"image": [], "dw": [], "dh": []})
        self._rings = ColumnDataSource({"x": [], "y": [], "text": []})
        self._grey = LinearColorMapper(palette=gray(256), low=0, high=1)
        self._x, self._y = Range1d(0, 1), Range1d(1, 0)
        self._plot = figure(
            width=_SIDE_PX, height=_SIDE_PX, x_range=self._x, y_range=self._y, tools="",
            toolbar_location=None, x_axis_label="x [px]", y_axis_label="y [px]",
        )  # fmt: skip
        self._plot.grid.visible = False
        self._plot.image(
            image="image", x=0, y=0, dw="dw", dh="dh", source=self._image, color_mapper=self._grey
        )
        self._plot.scatter(
            "x", "y", source=self._rings, size=22, line_color="#F0E442", line_width=2,
            fill_color=None,
        )  # fmt: skip
        self._plot.text(
            "x", "y", text="text", source=self._rings, text_color="#F0E442", x_offset=12,
            y_offset=-8, text_font_size="11px",
        )  # fmt: skip
        self._said = pn.pane.HTML("", width=_SIDE_PX)
        self._shown = pn.Column(pn.pane.Bokeh(self._plot), self._said, visible=False)
        self.asked.param.watch(lambda _: self.follow(self._config), "value")
        self.body = pn.Column(self.asked, self._shown)

    def follow(self, config: ia.Config | None) -> None:
        """Search with a configuration, if somebody wants to see that; without one, wait for it."""
        self._config, movie = config, self._chosen.movie
        self._shown.visible = self.asked.value
        if not self.asked.value or config is None or movie is None:
            return
        frame = self._chosen.view
        self._notice.latest(
            "Searching", lambda: _looked(movie, config, frame), lambda found: self._show(*found)
        )

    def _show(self, look: ia.Look, found: pd.DataFrame) -> None:
        seen = look.image[np.isfinite(look.image)]
        if seen.size:
            low, high = np.quantile(seen, _ENDS)
            self._grey.update(low=float(low), high=float(max(high, np.nextafter(low, math.inf))))
        rows, columns = look.image.shape
        self._x.end, self._y.start = columns, rows
        self._image.data = {"image": [look.image], "dw": [columns], "dh": [rows]}
        self._rings.data = {
            "x": found["x_px"] + 0.5,
            "y": found["y_px"] + 0.5,
            "text": [f"{snr:.1f} σ" for snr in found["snr"]],
        }
        first, stop = look.after
        self._said.object = (
            f"<p>{len(found)} above {look.threshold:.2f} times the noise, in frames {first} to "
            f"{stop - 1}; Look chooses the frame.</p>"
        )


def _looked(movie: Path, config: ia.Config, frame: int | None) -> tuple[ia.Look, pd.DataFrame]:
    """Measure camera and noise and search, as the analysis would."""
    with ia.open_stack(movie) as stack:
        preview = ia.Preview(stack, config)
        look = preview.look(sum(preview.frames) // 2 if frame is None else frame)
        return look, look.found()


FIRST = ("camera.pixel_size_nm", "optics.wavelength_nm", "optics.na", "particle.kind", "fit.mode")
"""What matters most, and is asked first."""

_ELSEWHERE = ("simulation", "bounds")  # sections that no analysis of a movie reads
_UNSET = "(default)"
_UNITS = {
    "nm": "nm", "kda": "kDa", "deg": "°", "e": "photoelectrons", "ms": "ms", "hz": "Hz",
    "frames": "frames", "adu": "counts", "mb": "MB", "c": "°C", "s": "mPa·s",
}  # fmt: skip


@dataclass(frozen=True)
class Field:
    """One key of the configuration, as its schema has it."""

    key: str
    help: str
    default: Any
    choices: tuple[Any, ...]

    @property
    def label(self) -> str:
        """The key with its unit."""
        name = self.key.rpartition(".")[2]
        unit = _UNITS.get(name.rpartition("_")[2], "")
        return f"{self.key}{f' [{unit}]' if unit and '_' in name else ''}"


def fields() -> list[Field]:
    """Read the keys out of the JSON schema of the configuration."""
    whole = ia.Config.model_json_schema()
    found = []
    for section, reference in whole["properties"].items():
        if section in _ELSEWHERE:
            continue
        for name, said in _resolved(reference, whole).get("properties", {}).items():
            choices = _choices(_resolved(said, whole))
            found.append(
                Field(
                    f"{section}.{name}", said.get("description", ""), said.get("default"), choices
                )
            )
    return found


def _resolved(said: Mapping[str, Any], whole: Mapping[str, Any]) -> Mapping[str, Any]:
    """Follow a reference into the schema's definitions."""
    for each in (said, *said.get("anyOf", ())):
        if "$ref" in each:
            found: Mapping[str, Any] = whole["$defs"][each["$ref"].rpartition("/")[2]]
            return found
    return said


def _choices(said: Mapping[str, Any]) -> tuple[Any, ...]:
    """Give the values that a key may have, where these are few."""
    kinds = [each for each in said.get("anyOf", [said]) if each.get("type") != "null"]
    found: list[Any] = []
    for kind in kinds:
        if "enum" in kind:
            found += kind["enum"]
        elif "const" in kind:
            found.append(kind["const"])
        elif kind.get("type") == "boolean":
            found += [True, False]
        else:
            return ()
    return tuple(found)


class Form:
    """The form, for the movie that is chosen."""

    title = "Set up"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._notice = Notice()
        self._widgets: dict[str, Any] = {}
        self._shown: tuple[Any, ...] | None = None
        self._first = pn.Column()
        self._asked_first: list[Any] = []
        self._rest = pn.Accordion(sizing_mode="stretch_width")
        self._written = pn.pane.Str("", sizing_mode="stretch_width")
        self._warned: dict[str, Any] = {}  # what is wrong with a key, by key
        self._fills = False
        self._complaint = pn.pane.HTML("", width=440, visible=False)
        self._preview = DetectionPreview(chosen, self._notice)
        self._taken = Taken(chosen, self._notice)
        propose = pn.widgets.Button(label="Propose from the movie", width=190)
        save = pn.widgets.Button(label="Save iscat.toml", color="primary", width=150)
        propose.on_click(self._propose)
        save.on_click(self._save)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(
                    "### What matters most", self._first, pn.Row(save, propose),
                    self._complaint, self._taken.body,
                    width=480,
                ),
                pn.Column("### Everything else", self._rest, width=520),
                pn.Column(
                    self._preview.body, "### The file", self._written, width=420,
                    margin=(0, 0, 0, 12),
                ),
            ),
        )  # fmt: skip

    def refresh(self) -> None:
        """Show the configuration of the movie that is chosen."""
        if not self._widgets:
            self._make_widgets()
        self._fills = True
        try:
            self._fill()
        finally:
            self._fills = False
        if not len(self._first):  # only now, or a slow browser takes back what somebody writes
            self._first.extend(self._asked_first)
        self._check()

    def _fill(self) -> None:
        self._taken.refresh()
        now = self._chosen.movie, self._chosen.changed
        if now != self._shown:
            self._shown = now
            with self._notice.told():
                texts = read_texts(self._chosen.config)
                for key, widget in self._widgets.items():
                    unset = _UNSET if isinstance(widget, pn.widgets.Select) else ""
                    widget.value = plain(texts.get(key, unset))
            self._show_file()
        if self._chosen.span is not None:
            first, last = self._chosen.span
            self._widgets["fit.frames"].value = f"[{first}, {last}]"
        if self._chosen.excluded is not None:
            widget = self._widgets["fit.excluded_frames"]
            had = tomllib.loads(f"value = {widget.value or '[]'}")["value"]
            if list(self._chosen.excluded) not in had:
                widget.value = toml_text([*had, list(self._chosen.excluded)])

    def _make_widgets(self) -> None:
        first: dict[str, Any] = {}
        sections: dict[str, list[Any]] = {}
        for field in fields():
            widget = _widget_of(field)
            widget.param.watch(lambda _: self._check(), "value")
            self._widgets[field.key] = widget
            wrong = self._warned[field.key] = pn.pane.HTML("", width=400, visible=False)
            shown = pn.Column(widget, wrong, pn.pane.HTML(_help(field), width=400))
            if field.key in FIRST:
                first[field.key] = shown
            else:
                sections.setdefault(field.key.partition(".")[0], []).append(shown)
        self._asked_first = [first[key] for key in FIRST]
        # The browser needs seconds for all of these, so a section is sent when it is unfolded.
        places = [pn.Column() for _ in sections]
        self._rest.extend(list(zip(sections, places, strict=True)))

        def fill(event: Any) -> None:
            for number in event.new:
                if not len(places[number]):
                    places[number].extend([*sections.values()][number])

        self._rest.param.watch(fill, "active")

    def _check(self) -> None:
        """Say below each field what is wrong with it, and search with what is right."""
        if self._fills:
            return
        said, config = "", None
        try:
            config = config_of(self._texts() | self._others())
        except ia.ConfigError as error:
            said = str(error).removeprefix("the form: ")
        _warn(self._complaint, said)  # also where a section is folded
        for key, wrong in self._warned.items():
            _warn(wrong, "; ".join(part for part in said.split("; ") if _names(part, key)))
        self._preview.follow(config)

    def _texts(self) -> dict[str, str]:
        texts = {}
        for key, widget in self._widgets.items():
            text = str(widget.value).strip()
            if text and text != _UNSET:
                texts[key] = text
        return texts

    def _others(self) -> dict[str, str]:
        """Give what is in the file and not in the form, which stays as it is."""
        texts = read_texts(self._chosen.config)
        return {key: text for key, text in texts.items() if key not in self._widgets}

    def _save(self, _: Any) -> None:
        path = self._chosen.setup
        if path is None:
            self._notice.say("Choose a movie under Open.", "error")
            return
        with self._notice.told():
            config = write_texts(path, self._texts() | self._others())
            self._chosen.span = self._chosen.excluded = None
            self._chosen.changed += 1
            self._notice.say(f"saved as {path}: mode {config.fit.mode}")
            self._show_file()

    def _propose(self, _: Any) -> None:
        """Fill the form as `iscat init` would, with what the file and its noise say."""
        movie, path = self._chosen.movie, self._chosen.setup
        if movie is None or path is None:
            self._notice.say("Choose a movie under Open.", "error")
            return
        texts = self._texts()
        answers = {key: _number(texts[key]) for key in FIRST if key in texts and key != "fit.mode"}
        self._notice.work(
            "Looking at the movie",
            lambda: write_setup(movie, answers=answers, out=path, overwrite=True),
            self._proposed,
        )

    def _proposed(self, found: Setup) -> None:
        self._chosen.changed += 1
        self._shown = None
        self.refresh()
        self._notice.say(f"saved as {found.out}; every value has its origin beside it")

    def _show_file(self) -> None:
        config = self._chosen.config
        self._written.object = config.read_text("utf-8") if config else "none yet"


def _widget_of(field: Field) -> Any:
    """Make the widget of a key; what is left empty has its default."""
    if field.choices:
        texts = [str(c).lower() if isinstance(c, bool) else str(c) for c in field.choices]
        return pn.widgets.Select(label=field.label, options=[_UNSET, *texts], width=380)
    default = "" if field.default is None else _default(field.default)
    return pn.widgets.TextInput(label=field.label, placeholder=default, width=380)


def _warn(pane: Any, text: str) -> None:
    pane.visible = bool(text)
    pane.object = f'<div class="notice error" role="alert">{html.escape(text)}</div>'


def _names(said: str, key: str) -> bool:
    """Say whether a message is about a key."""
    return re.search(rf"(?<![\w.]){re.escape(key)}(?![\w.])", said.replace(": ", " ")) is not None


def _default(value: Any) -> str:
    return "" if isinstance(value, dict) else f"default {value}"


def _help(field: Field) -> str:
    return f"<small>{html.escape(field.help)}</small>"


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
