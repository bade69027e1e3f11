"""Calibrate: contrast against mass by standards, the camera from its noise, the optics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import DoubleTap, Tap
from bokeh.models import ColumnDataSource, Range1d, Whisker
from bokeh.plotting import figure

from iscat_analysis.answers.calibrations import contrast_peaks, mass_calibration
from iscat_analysis.calibration import ContrastPeak, MassCalibration
from iscat_analysis.errors import DataError
from iscat_analysis.movie import path_beside
from iscat_app.chosen import Chosen, Notice, in_line, masses_in, table_of
from iscat_app.files import listed
from iscat_app.runs import Job, Kind, Queue
from iscat_app.settings import Taken

_HEAD = ("standard [kDa]", "contrast", "±", "by the line [kDa]", "95 %", "residual [%]")
_NO_DARK = "(none)"
_HINT = (
    "<small>Click a peak, or choose it from the list, to give it the lightest mass that has none "
    "yet, and again to take it back. Where nobody chooses, the peaks are found that fit the masses "
    "best.</small>"
)


class Calibrate:
    """Standards of known mass make the scale of all others; camera and optics are measured."""

    title = "Calibrate"

    def __init__(self, chosen: Chosen, queue: Queue) -> None:
        self._chosen, self._queue = chosen, queue
        self._notice = Notice()
        self._result: Path | None = None
        self.peaks: list[ContrastPeak] = []
        self.assigned: dict[int, float] = {}  # masses by number of the peak
        self._make_figures()
        self._standards = pn.widgets.TextInput(
            label="Masses of the standards [kDa]", placeholder="66, 146, 480", width=260
        )
        fit = pn.widgets.Button(label="Fit the line", color="primary", width=120)
        forget = pn.widgets.Button(label="Take all masses back", width=160)
        self._peak = pn.widgets.Select(label="Peak", width=200)
        give = pn.widgets.Button(label="Give it a mass, or take it back", width=210)
        self._dark = pn.widgets.Select(label="Frames without light", options=[_NO_DARK], width=260)
        camera = pn.widgets.Button(label="Measure the camera of this movie", width=240)
        optics = pn.widgets.Button(label="Learn the optics from this movie", width=240)
        self._table = pn.pane.HTML("", sizing_mode="stretch_width")
        self._taken = Taken(chosen, self._notice)
        self._standards.param.watch(lambda _: self._assign({}), "value")
        fit.on_click(self._fit)
        give.on_click(lambda _: self._give(self._peak.value))
        forget.on_click(lambda _: self._assign({}))
        camera.on_click(lambda _: self._measure("camera"))
        optics.on_click(lambda _: self._measure("optics"))
        self.body = pn.Column(
            self._notice.pane,
            "### Masses, from standards",
            in_line(self._standards, self._peak, give, forget, fit),
            pn.pane.HTML(_HINT),
            pn.FlexBox(self._histogram_pane, self._line_pane),
            self._table,
            "### Camera and optics, from the movie that is chosen",
            in_line(self._dark, camera, optics),
            "### Use a calibration",
            self._taken.body,
        )

    def _make_figures(self) -> None:
        self._points = ColumnDataSource({"mass": [], "contrast": [], "low": [], "high": []})
        self._line = ColumnDataSource({"mass": [], "contrast": []})
        self._bars = ColumnDataSource({"left": [], "right": [], "top": []})
        self._marks = ColumnDataSource({"x": [], "y": [], "text": [], "colour": []})
        plot = figure(width=480, height=300, x_axis_label="mass [kDa]",
                      y_axis_label="|contrast| [%]", tools="pan,wheel_zoom,reset,save")  # fmt: skip
        plot.line("mass", "contrast", source=self._line, color="#D55E00")
        plot.scatter("mass", "contrast", source=self._points, size=9, color="#0072B2")
        plot.add_layout(Whisker(base="mass", lower="low", upper="high", source=self._points))
        peaks = figure(width=520, height=300, x_axis_label="|contrast| [%]", y_axis_label="events",
                       tools="xwheel_zoom,xpan,reset,tap", y_range=Range1d(0, 1))  # fmt: skip
        peaks.quad(left="left", right="right", top="top", bottom=0, source=self._bars,
                   color="#8A8F96", line_color="white", nonselection_alpha=1)  # fmt: skip
        peaks.scatter("x", "y", source=self._marks, marker="inverted_triangle", size=12,
                      color="colour", nonselection_alpha=1)  # fmt: skip
        peaks.text("x", "y", text="text", source=self._marks, text_align="center", y_offset=-10,
                   text_font_size="12px", text_color="colour", nonselection_alpha=1)  # fmt: skip
        for kind in (Tap, DoubleTap):  # of two clicks that are fast the second is the latter
            peaks.on_event(kind, lambda event: self._clicked(event.x))
        plot.toolbar.logo = peaks.toolbar.logo = None
        self._histogram = peaks
        self._histogram_pane = pn.Column(pn.pane.Bokeh(peaks), visible=False)
        self._line_pane = pn.Column(pn.pane.Bokeh(plot), visible=False)

    def refresh(self) -> None:
        """Show the contrasts of the result that is chosen."""
        self._taken.refresh()
        movie, result = self._chosen.movie, self._chosen.result
        others = (
            []
            if movie is None
            else [entry.path.name for entry in listed(movie.parent) if entry.kind == "movie"]
        )
        darks = [_NO_DARK, *(name for name in others if movie is None or name != movie.name)]
        if darks != self._dark.options:
            self._dark.options = darks
        if result == self._result and self.peaks:
            return
        self._result, self.peaks = result, []
        self._histogram_pane.visible, self._line_pane.visible = result is not None, False
        if result is None:
            self._notice.say("Choose an analysed movie of standards under Open.")
            self._bars.data = {"left": [], "right": [], "top": []}
            self._assign({})
            return
        self._notice.say("")
        with self._notice.told():
            size, self.peaks = contrast_peaks(result)
            counts, edges = np.histogram(100 * size, bins=60)
            self._bars.data = {"left": edges[:-1], "right": edges[1:], "top": counts}
        self._assign({})

    # ---- which peak has which mass ----------------------------------------------------------

    def _masses(self) -> list[float] | None:
        try:
            return sorted(masses_in(self._standards.value))
        except DataError as error:
            self._notice.say(str(error), "error")
            return None

    def _clicked(self, contrast_percent: float | None) -> None:
        if self.peaks and contrast_percent is not None:
            away = [abs(100 * peak.contrast - contrast_percent) for peak in self.peaks]
            self._give(int(np.argmin(away)))

    def _give(self, peak: int | None) -> None:
        """Give a peak the next mass, or take its mass back."""
        masses = self._masses()
        if peak is None or masses is None:
            return
        if not masses:
            self._notice.say("Write the masses of the standards first.")
            return
        free = [mass for mass in masses if mass not in self.assigned.values()]
        if peak in self.assigned:
            self._assign({k: mass for k, mass in self.assigned.items() if k != peak})
        elif free:
            self._assign(self.assigned | {peak: free[0]})
        else:
            self._notice.say("Every mass has a peak: take one back first.")

    def _assign(self, assigned: dict[int, float]) -> None:
        self.assigned = assigned
        top = np.asarray(self._bars.data["top"], float)
        left, right = (np.asarray(self._bars.data[k], float) for k in ("left", "right"))
        places = [100 * peak.contrast for peak in self.peaks]
        near = [
            float(top[(right > x - 100 * p.width) & (left < x + 100 * p.width)].max(initial=0.0))
            for x, p in zip(places, self.peaks, strict=True)
        ]
        self._marks.data = {
            "x": places,
            "y": [1.08 * y for y in near],
            "text": [f"{assigned[k]:g} kDa" if k in assigned else "" for k in range(len(places))],
            "colour": ["#D55E00" if k in assigned else "#0072B2" for k in range(len(places))],
        }
        texts = [
            f"{k + 1}: {x:.3g} %" + (f", {assigned[k]:g} kDa" if k in assigned else "")
            for k, x in enumerate(places)
        ]
        peak = self._peak.value if self._peak.value in range(len(texts)) else None
        self._peak.param.update(
            options={text: k for k, text in enumerate(texts)},
            value=0 if texts and peak is None else peak,
        )
        end = 1.3 * max(top.max(initial=0.0), 1.0)
        self._histogram.y_range.update(end=end, reset_end=end)

    # ---- calibrations -----------------------------------------------------------------------

    def _fit(self, _: Any) -> None:
        result, masses = self._chosen.result, self._masses()
        if result is None or masses is None:
            return
        places: list[float] | None = None
        if self.assigned:
            pairs = sorted((mass, self.peaks[k].contrast) for k, mass in self.assigned.items())
            masses, places = [mass for mass, _ in pairs], [contrast for _, contrast in pairs]
        out = path_beside(result, ".calibration")
        notes: list[str] = []
        self._notice.work(
            "Fitting",
            lambda: mass_calibration(
                result, masses, out, peaks_at=places, overwrite=True, notify=notes.append
            ),
            lambda found: self._show(found, notes, out),
        )

    def _show(self, found: MassCalibration, notes: list[str], out: Path) -> None:
        rows = found.standards.to_dict("records")
        self._points.data = {
            "mass": [r["mass_kda"] for r in rows],
            "contrast": [100 * abs(r["contrast"]) for r in rows],
            "low": [100 * (abs(r["contrast"]) - r["contrast_se"]) for r in rows],
            "high": [100 * (abs(r["contrast"]) + r["contrast_se"]) for r in rows],
        }
        self._line_pane.visible = True
        slope, offset = found.gradient_per_kda, found.offset
        ends = [0.0, 1.1 * max(r["mass_kda"] for r in rows)]
        self._line.data = {"mass": ends, "contrast": [100 * abs(slope * m + offset) for m in ends]}
        self._table.object = table_of(
            [
                (
                    f"{r['mass_kda']:g}", f"{r['contrast']:.4g}", f"{r['contrast_se']:.2g}",
                    f"{r['found_kda']:.2f}", f"{r['low_kda']:.2f} to {r['high_kda']:.2f}",
                    f"{r['residual_percent']:.2f}",
                )
                for r in rows
            ],
            _HEAD,
        ) + table_of([(note,) for note in (f"saved in {out}", *notes)])  # fmt: skip
        self._taken.refresh()

    def _measure(self, kind: Kind) -> None:
        movie = self._chosen.movie
        if movie is None:
            self._notice.say("Choose a movie under Open.", "error")
            return
        dark = None
        if kind == "camera" and self._dark.value != _NO_DARK:
            dark = movie.with_name(self._dark.value)
        out = path_beside(movie, f".{kind}")
        self._queue.add(Job(movie, self._chosen.config, out, kind, overwrite=True, dark=dark))
        self._notice.say(f"{kind} of {movie.name} is in the queue: Run shows how far it is.")
