"""Look: the raw and the ratiometric film, with what was found, and the light below."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from bokeh import models

import iscat_analysis as ia
from iscat_analysis.pipeline.preview import RatioFilm
from iscat_analysis.pipeline.stored import SHOWN_FRAMES
from iscat_analysis.report.numbers import number
from iscat_app.chosen import Chosen, Notice
from iscat_app.results import sample_of
from iscat_app.widgets import BLUE, ORANGE, RED, YELLOW, Picture, plot, source

RATES = (5, 10, 25, 50, 100, 250, 1000)
"""Frames of the movie per second."""

_LANDS, _LEAVES = "#56B4E9", "#CC79A7"
_SIDE_PX = 560
_RATIO, _RAW = "ratiometric", "raw"


class Film:
    """Plays a movie; the frames are read as they are shown."""

    title = "Look"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._film: RatioFilm | None = None
        self._shown: tuple[Any, ...] = ()
        self._preview: ia.Preview | None = None
        self._events, self._unit = pd.DataFrame(), ""
        self._um = 1.0
        self._limits = (0.0, 1.0)
        self._begun = 0  # pictures that were sent before it was played
        self._at = 0  # the frame that is shown
        self._next = 0.0  # where the film is, as it plays
        self._ticked = self._slid = 0.0
        self._by_player = False
        self._due = False  # whether a step of the player is to come
        self._found, self._found_at = pd.DataFrame(), -1
        self._notice = Notice()
        self._make_figures()
        self._make_widgets()

    # ---- what there is to see ---------------------------------------------------------------

    def _make_figures(self) -> None:
        tools = "pan,wheel_zoom,box_zoom,zoom_in,zoom_out,reset,save"
        self._picture = Picture(_SIDE_PX, tools)
        shown = self._picture.figure
        shown.output_backend = "canvas"
        shown.toolbar.active_scroll = shown.select_one({"type": models.WheelZoomTool})
        self._bar = source("x", "y", "text")
        shown.line("x", "y", source=self._bar, line_width=5, color=YELLOW)
        shown.text("x", "y", text="text", source=self._bar, text_color=YELLOW, y_offset=-6)
        # The browser says which picture it has drawn, and only then the next one is sent.
        self._drawn = models.Spinner(value=0, visible=False, title="pictures drawn")
        answer = "requestAnimationFrame(() => { drawn.value = picture.data.sent[0] })"
        both = {"drawn": self._drawn, "picture": self._picture.data}
        self._picture.data.js_on_change("data", models.CustomJS(args=both, code=answer))
        self._drawn.on_change("value", self._browser_has_drawn)

        self._trace = source("frame", "light", "noise")
        self._light = plot((_SIDE_PX + 60, 170), ("frame", "light [counts]"), "reset")
        self._light.update(toolbar_location=None, x_range=models.Range1d(0, 1))
        self._light.extra_y_ranges = {"noise": models.DataRange1d(range_padding=0.15)}
        self._light.add_layout(models.LinearAxis(y_range_name="noise", axis_label="noise"), "right")
        light = self._light.line("frame", "light", source=self._trace, color=BLUE)
        noise = {"source": self._trace, "color": RED, "y_range_name": "noise"}
        self._light.extra_y_ranges["noise"].renderers = [
            self._light.line("frame", "noise", **noise)
        ]
        self._light.y_range.update(renderers=[light], range_padding=0.15)
        marks = self._light.scatter("frame", "light", source=self._trace, size=3, alpha=0)
        self._band = models.BoxAnnotation(left=0, right=0, fill_alpha=0.15, fill_color=ORANGE)
        self._light.add_layout(self._band)
        self._light.add_tools(models.BoxSelectTool(dimensions="width", renderers=[marks]))

    def _make_widgets(self) -> None:
        slider, integer = pn.widgets.IntSlider, pn.widgets.IntInput
        self.play = pn.widgets.Toggle(label="▶ Play", width=90)
        self.frame = slider(label="Frame", start=0, end=1, width=470)
        rates = {"options": list(RATES), "value": 25, "width": 130}
        self.rate = pn.widgets.Select(label="Frames per second", **rates)
        self.kind = pn.widgets.RadioButtonGroup(options=[_RATIO, _RAW], value=_RATIO)
        self.window = slider(label="Window [frames]", start=1, end=2, width=300)
        ends = {"start": 0, "end": 1, "value": (0, 1), "step": 0.01, "width": 300}
        self.contrast = pn.widgets.RangeSlider(label="Black and white at", **ends)
        self.search = pn.widgets.Checkbox(label="Mark what the search sees in this frame")
        self.events = pn.widgets.Checkbox(label="Ring the events of the result", value=True)
        self.first = integer(label="Marked frames, from", start=0, value=0, width=140)
        self.last = integer(label="to", start=0, value=0, width=140)
        button = self._notice.button
        self.of_span = [
            button("Analyse only these frames", 300, lambda: self._keep("span", "frames")),
            button(
                "Leave these frames out", 300, lambda: self._keep("excluded", "excluded_frames")
            ),
        ]
        self.facts = pn.pane.HTML("", width=320)
        self.play.param.watch(self._play, "value")
        self.contrast.param.watch(self._contrast_changed, "value")
        self._notice.watch(self._picture_changed, self.window, what="value_throttled")
        self._notice.watch(self._frame_moved, self.frame)
        self._notice.watch(self._picture_changed, self.kind)
        self._notice.watch(self._search_changed, self.search)
        self._notice.watch(self._ring, self.events)
        self._notice.watch(self._show_span, self.first, self.last)
        self._trace.selected.on_change("indices", self._marked)
        self._show_span()
        drawn, light = pn.pane.Bokeh(self._picture.figure), pn.pane.Bokeh(self._light)
        how = (self.kind, self.rate, self.window, self.contrast, self.events, self.search)
        span = (pn.Row(self.first, self.last), *self.of_span)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(pn.Row(self.play, self.frame), drawn, light),
                pn.Column(*how, self.facts, *span, pn.pane.Bokeh(self._drawn), width=340),
            ),
        )

    # ---- the movie --------------------------------------------------------------------------

    def refresh(self) -> None:
        """Open the movie that is chosen, if it is not open."""
        now = self._chosen.movie, self._chosen.result, self._chosen.changed
        if now == self._shown:
            self._go_to_event()
            return
        self._shown = now
        self.play.value = False
        self._close()
        if self._chosen.movie is None:
            self._notice.say("Choose a movie under Open.")
            return
        self._notice.say("")
        with self._notice.told():
            self._open()
            self._go_to_event()

    def _go_to_event(self) -> None:
        """Show the frame of the event that was looked at under Results."""
        if self._film is not None and self._chosen.frame is not None:
            self.frame.value = min(self._chosen.frame, self.frame.end)
            self._chosen.frame = None

    def _close(self) -> None:
        if self._film is not None:
            self._film.movie.close()
        self._film, self._preview, self._events = None, None, pd.DataFrame()

    def _open(self) -> None:
        stack = ia.open_stack(self._chosen.movie)
        try:
            config = ia.configure(self._chosen.config)
            pixel_nm = config.camera.pixel_size_nm or stack.metadata.pixel_size_nm
            offset: float | str | None = config.camera.offset_adu
            if isinstance(offset, str):  # measured, or a map
                offset = stack.metadata.offset_adu
            self._film = RatioFilm(stack, offset_adu=offset or 0.0)
            # Frames of the window before anyone has chosen
            self._film.window = min(25, self._film.longest)
        except ia.IscatError:
            stack.close()
            raise
        if offset is None:
            self._notice.say(
                "The offset of the camera is not known yet and is taken as 0, so that contrasts "
                "come out too small; marking what the search sees measures it."
            )
        if self._chosen.result is not None:
            with self._notice.told(), ia.open_result(self._chosen.result) as result:
                sample = sample_of(result, result.table)
                values = sample.per_unit * np.abs(sample.quantity.values(result.table)[0])
                texts = [number(value) for value in values]
                self._events, self._unit = result.table.assign(text=texts), sample.quantity.unit
        self._um = (pixel_nm or 1000.0) / 1000.0
        frames, rows, columns = stack.shape
        unit = "µm" if pixel_nm else "pixels"
        shown = self._picture.figure
        shown.xaxis.axis_label = shown.yaxis.axis_label = unit
        self._picture.fit(rows, columns, self._um)
        bar = _bar_of(columns * self._um, rows * self._um)
        self._bar.data = bar if pixel_nm else {"x": [], "y": [], "text": []}
        self.window.param.update(end=max(self._film.longest, 2), value=self._film.window)
        self.frame.param.update(end=frames - 1)
        for end, value in ((self.first, 0), (self.last, frames - 1)):
            end.param.update(end=frames - 1, value=value)
        self._fit_limits()
        self._shown_by_player(self._film.frames[0])
        self._show()
        light = self._film.light()
        self._trace.data = {name: light[name].to_numpy() for name in light}
        self._light.x_range.update(start=0, end=frames)

    # ---- playing ----------------------------------------------------------------------------

    def _play(self, event: Any) -> None:
        self.play.label = "⏸ Pause" if event.new else "▶ Play"
        if event.new and self._film is None:
            self.play.value = False
        elif event.new:
            self._next, self._ticked = float(self.frame.value), time.monotonic()
            self._begun = self._picture.sent
            self._soon()
        elif self._film is not None:
            self._shown_by_player(self.frame.value)

    def _soon(self) -> None:
        """Show the next frame when it is time for it."""
        document = pn.state.curdoc
        ahead = self._picture.sent - max(self._drawn.value, self._begun)
        # Pictures on their way to the browser at most
        if document is not None and not self._due and ahead < 2:
            self._due = True
            left = 1.0 / self.rate.value - (time.monotonic() - self._ticked)
            document.add_timeout_callback(self._step, max(1, round(1000 * left)))

    def _step(self) -> None:
        """Show the frame that it is time for; where the browser is slow, some are left out."""
        self._due = False
        if self._film is None or not self.play.value:
            return
        now = time.monotonic()
        self._next += max((now - self._ticked) * self.rate.value, 1.0)
        self._ticked = now
        first, stop = self._film.frames if self.kind.value == _RATIO else (0, self.frame.end + 1)
        if not first <= self._next < stop:
            self._next = float(first)
        self._at = math.floor(self._next)
        # After which the slider of frames follows the film, as it plays
        if now - self._slid > 0.25:
            self._slid = now
            self._shown_by_player(self._at)
        self._show()
        self._soon()

    def _shown_by_player(self, frame: int) -> None:
        self._by_player = True
        self.frame.value = self._at = self._chosen.view = frame
        self._by_player = False

    def _browser_has_drawn(self, _attr: str, _old: Any, _new: Any) -> None:
        if self.play.value:
            self._soon()

    def _frame_moved(self) -> None:
        if not self._by_player:
            self._at = self._chosen.view = self.frame.value
            self._next = float(self._at)
            self._show()
            if self.search.value:
                self._look()

    def _picture_changed(self) -> None:
        """Show pictures of another kind, or of another window."""
        if self._film is not None:
            self._film.window = self.window.value
            self._fit_limits()
            self._show()
            if self.search.value:
                self._look()

    def _fit_limits(self) -> None:
        if self._film is None:
            return
        low, high = self._film.limits(ratio=self.kind.value == _RATIO)
        span = high - low
        self._limits = low, high
        unit = 100.0 if self.kind.value == _RATIO else 1.0
        digits = max(0, 2 - math.floor(math.log10(unit * span)))
        self.contrast.param.update(
            label="Black and white at " + ("[%]" if unit > 1 else "[counts]"),
            start=round(unit * (low - span), digits),
            end=round(unit * (high + span), digits),
            step=10.0**-digits,
            value=(round(unit * low, digits), round(unit * high, digits)),
        )

    def _contrast_changed(self, event: Any) -> None:
        unit = 100.0 if self.kind.value == _RATIO else 1.0
        low, high = (value / unit for value in event.new)
        if high > low and (low, high) != self._limits:
            self._limits = low, high
            self._show()

    def _show(self) -> None:
        """Send the picture of the frame to the browser."""
        film = self._film
        if film is None:
            return
        with self._notice.told():
            at = self._at
            image = film.contrast(at) if self.kind.value == _RATIO else film.raw(at)
            self._picture.show(image, *self._limits, self._um)
            self._ring()

    # ---- what was found ---------------------------------------------------------------------

    def _ring(self) -> None:
        """Ring what landed or left about this frame."""
        rings: list[tuple[float, float, str, str]] = []
        at = self._at
        if self.events.value and len(self._events):
            near = self._events[
                (self._events["frame"] - at).abs().le(SHOWN_FRAMES) & self._events["x_px"].notna()
            ]
            for row in near.to_dict("records"):
                ok = row["status"] == "ok"
                colour = ORANGE if not ok else _LANDS if row["mass_kda"] > 0 else _LEAVES
                text = row["text"]
                if row["event"] == self._chosen.event:
                    colour, text = YELLOW, f"event {row['event']}: {text} {self._unit}".rstrip()
                rings.append((row["x_px"], row["y_px"], colour, text))
        if self.search.value and self._found_at == at:
            for row in self._found.to_dict("records"):
                rings.append((row["x_px"], row["y_px"], YELLOW, f"{row['snr']:.1f} σ"))
        self._picture.ring(rings, self._um)

    def _search_changed(self) -> None:
        if not self.search.value:
            self._ring()
        elif self._film is None:
            self.search.value = False
        elif self._preview is not None:
            self._look()
        else:
            movie, config = self._film.movie, self._chosen.config
            self._notice.work(
                "Measuring camera and noise",
                lambda: ia.Preview(movie, ia.configure(config)),
                self._take_preview,
            )

    def _take_preview(self, made: ia.Preview) -> None:
        """Look as the search does: with its window, and over the offset that it found."""
        if self._film is None or made.steady.path != self._film.movie.path:
            return  # another movie was chosen meanwhile
        self._preview = made
        offset = made.camera.numbers["offset_adu"].value
        if isinstance(offset, (int, float)):
            self._film.offset_adu = float(offset)
        self._film.window = min(max(made.window, 1), self._film.longest)
        self.window.value = self._film.window
        self._fit_limits()
        self._show()
        self._look()

    def _look(self) -> None:
        """Search the windows around the frame that is shown."""
        preview, at = self._preview, self._at
        if preview is not None and not self.play.value:
            window = min(self.window.value, preview.longest)
            self._notice.work(
                "", lambda: preview.look(at, window), lambda look: self._mark(look, at, window)
            )

    def _mark(self, look: ia.Look, at: int, window: int) -> None:
        if at != self._at:
            return
        self._found, self._found_at = look.found(), at
        self.facts.object = (
            f"<p>{len(self._found)} above {look.threshold:.2f} times the noise, with windows of "
            f"{window} frames</p>"
        )
        self._ring()

    # ---- frames to analyse ------------------------------------------------------------------

    def _marked(self, _attr: str, _old: Any, new: list[int]) -> None:
        if new:
            frames = np.asarray(self._trace.data["frame"])[new]
            self.first.value, self.last.value = int(frames.min()), int(frames.max())

    def _show_span(self) -> None:
        """Shade the frames that are marked, unless these are all."""
        first, stop = self._span()
        some = first < stop and (first, stop) != (0, self.frame.end + 1)
        for button in self.of_span:
            button.disabled = not some
        self._band.update(left=first, right=stop if some else first)

    def _span(self) -> tuple[int, int]:
        first, last = self.first.value, self.last.value  # None where the field is empty
        return first or 0, (self.frame.end if last is None else last) + 1

    def _keep(self, name: str, key: str) -> None:
        span = self._span()
        self._chosen.param.update({name: span})
        self._notice.say(f"{[*span]} goes into fit.{key} of the form: save it under Set up.")


def _bar_of(width_um: float, height_um: float) -> dict[str, list[Any]]:
    """Give a scale bar of a round length, a fifth of the width or less."""
    wanted = width_um / 5
    power = 10.0 ** math.floor(math.log10(wanted))
    length = max(step * power for step in (1, 2, 5) if step * power <= wanted)
    x, y = 0.04 * width_um, 0.96 * height_um
    return {"x": [x, x + length], "y": [y, y], "text": [f"{length:g} µm", ""]}
