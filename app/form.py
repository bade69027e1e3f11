"""Set up: a form made of the configuration's schema, with what the search would find."""

from __future__ import annotations

import html
import math
import re
import tomllib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import pandas as pd
import panel as pn

import iscat_analysis as ia
from iscat_analysis.config.files import model_of
from iscat_analysis.movie import setup_beside
from iscat_analysis.pipeline.setup import Setup, write_setup
from iscat_app.chosen import Chosen, Notice
from iscat_app.settings import Taken, config_of, plain, read_texts, toml_text, write_texts
from iscat_app.widgets import YELLOW, Picture

_SIDE_PX = 380
_ENDS = (0.005, 0.995)  # quantiles that are black and white


class DetectionPreview:
    """A picture that follows the form."""

    def __init__(self, chosen: Chosen, notice: Notice) -> None:
        self._chosen, self._notice = chosen, notice
        self._config: ia.Config | None = None
        self.asked = pn.widgets.Checkbox(label="Show what the search finds with these values")
        self._picture = Picture(_SIDE_PX)
        self._picture.figure.toolbar_location = None
        self._said = pn.pane.HTML("", width=_SIDE_PX)
        self._shown = pn.Column(pn.pane.Bokeh(self._picture.figure), self._said, visible=False)
        self._notice.watch(lambda: self.follow(self._config), self.asked)
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
        low, high = map(float, np.quantile(seen, _ENDS)) if seen.size else (0.0, 1.0)
        self._picture.fit(*look.image.shape)
        self._picture.show(look.image, low, max(high, math.nextafter(low, math.inf)))
        places = found[["x_px", "y_px", "snr"]].itertuples(index=False)
        self._picture.ring([(x, y, YELLOW, f"{snr:.1f} σ") for x, y, snr in places])
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
_UNITS = {"kda": "kDa", "deg": "°", "e": "photoelectrons", "hz": "Hz", "adu": "counts", "mb": "MB"}
_UNITS |= {"c": "°C", "s": "mPa·s", "nm": "nm", "ms": "ms", "frames": "frames"}


@dataclass(frozen=True)
class Field:
    """One key of the configuration."""

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
    """List the keys of the configuration."""
    found = []
    for section, outer in ia.Config.model_fields.items():
        known = {} if section in _ELSEWHERE else model_of(outer.annotation).model_fields
        for name, field in known.items():
            about, default = field.description or "", field.get_default(call_default_factory=True)
            found.append(Field(f"{section}.{name}", about, default, _choices(field.annotation)))
    return found


def _choices(annotation: Any) -> tuple[Any, ...]:
    """Give the values that a key may have, where these are few."""
    found: list[Any] = []
    united = get_origin(annotation) in (Union, UnionType)
    for kind in get_args(annotation) if united else (annotation,):
        if kind is bool:
            found += [True, False]
        elif get_origin(kind) is Literal:
            found += get_args(kind)
        elif kind is not NoneType:
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
        save = self._notice.button("Save iscat.toml", 150, self._save, main=True)
        propose = self._notice.button("Propose from the movie", 190, self._propose)
        buttons = pn.Row(save, propose)
        first = ("### What matters most", self._first, buttons, self._complaint, self._taken.body)
        seen = (self._preview.body, "### The file", self._written)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(*first, width=480),
                pn.Column("### Everything else", self._rest, width=520),
                pn.Column(*seen, width=420, margin=(0, 0, 0, 12)),
            ),
        )

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
            self._notice.watch(self._check, widget)
            self._widgets[field.key] = widget
            wrong = self._warned[field.key] = pn.pane.HTML("", width=400, visible=False)
            about = f"<small>{html.escape(field.help)}</small>"
            shown = pn.Column(widget, wrong, pn.pane.HTML(about, width=400))
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
        texts = {key: str(widget.value).strip() for key, widget in self._widgets.items()}
        return {key: text for key, text in texts.items() if text not in ("", _UNSET)}

    def _others(self) -> dict[str, str]:
        """Give what is in the file and not in the form, which stays as it is."""
        texts = read_texts(self._chosen.config)
        return {key: text for key, text in texts.items() if key not in self._widgets}

    def _save(self) -> None:
        path = setup_beside(self._chosen.wanted_movie)
        config = write_texts(path, self._texts() | self._others())
        self._chosen.span = self._chosen.excluded = None
        self._chosen.changed += 1
        self._notice.say(f"saved as {path}: mode {config.fit.mode}")
        self._show_file()

    def _propose(self) -> None:
        """Fill the form as `iscat init` would, with what the file and its noise say."""
        movie, texts = self._chosen.wanted_movie, self._texts()
        answers = {key: _number(texts[key]) for key in FIRST if key in texts and key != "fit.mode"}
        how: Any = {"answers": answers, "out": setup_beside(movie), "overwrite": True}
        self._notice.work(
            "Looking at the movie", partial(write_setup, movie, **how), self._proposed
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
    default = field.default
    if default is not None and not hasattr(default, "model_fields"):
        shown = list(default) if isinstance(default, tuple) else default
        default = f"default {shown}"
    return pn.widgets.TextInput(label=field.label, placeholder=str(default or ""), width=380)


def _warn(pane: Any, text: str) -> None:
    pane.visible = bool(text)
    pane.object = f'<div class="notice error" role="alert">{html.escape(text)}</div>'


def _names(said: str, key: str) -> bool:
    """Say whether a message is about a key."""
    return re.search(rf"(?<![\w.]){re.escape(key)}(?![\w.])", said.replace(": ", " ")) is not None


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
