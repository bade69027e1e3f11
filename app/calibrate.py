"""Calibrate: contrast against mass by standards, the camera from its noise, the optics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import panel as pn
from bokeh.events import DoubleTap, Tap
from bokeh.models import Range1d, Whisker

from iscat_analysis.answers.calibrations import contrast_peaks, mass_calibration
from iscat_analysis.calibration import ContrastPeak, MassCalibration
from iscat_analysis.errors import DataError
from iscat_analysis.movie import path_beside
from iscat_app import widgets as ui
from iscat_app.chosen import Chosen, Notice, masses_in
from iscat_app.files import listed
from iscat_app.runs import Job, Kind, Queue
from iscat_app.settings import Taken

_STANDARDS = (
    "standard [kDa] | contrast | ± | by the line [kDa] | 95 % | residual [%]",
    "{mass_kda:g} | {contrast:.4g} | {contrast_se:.2g} | {found_kda:.2f} | {low_kda:.2f} "
    "to {high_kda:.2f} | {residual_percent:.2f}",
)
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
        standards = {"label": "Masses of the standards [kDa]", "placeholder": "66, 146, 480"}
        self._standards = pn.widgets.TextInput(**standards, width=260)
        self._peak = pn.widgets.Select(label="Peak", width=200)
        button = self._notice.button
        masses = (
            button("Give it a mass, or take it back", 210, lambda: self._give(self._peak.value)),
            button("Take all masses back", 160, lambda: self._assign({})),
            button("Fit the line", 120, self._fit, main=True),
        )
        self._dark = pn.widgets.Select(label="Frames without light", options=[_NO_DARK], width=260)
        measured = (
            button("Measure the camera of this movie", 240, lambda: self._measure("camera")),
            button("Learn the optics from this movie", 240, lambda: self._measure("optics")),
        )
        self._table = ui.wide_pane()
        self._taken = Taken(chosen, self._notice)
        self._notice.watch(lambda: self._assign({}), self._standards)
        self.body = pn.Column(
            self._notice.pane,
            "### Masses, from standards",
            ui.in_line(self._standards, self._peak, *masses),
            pn.pane.HTML(_HINT),
            pn.FlexBox(self._histogram_pane, self._line_pane),
            self._table,
            "### Camera and optics, from the movie that is chosen",
            ui.in_line(self._dark, *measured),
            "### Use a calibration",
            self._taken.body,
        )

    def _make_figures(self) -> None:
        self._points = ui.source("mass", "contrast", "low", "high")
        self._line = ui.source("mass", "contrast")
        self._bars = ui.source("left", "right", "top")
        self._marks = ui.source("x", "y", "text", "colour")
        axes = "mass [kDa]", "|contrast| [%]"
        shown = ui.plot((480, 300), axes, "pan,wheel_zoom,reset,save")
        shown.line("mass", "contrast", source=self._line, color=ui.RED)
        shown.scatter("mass", "contrast", source=self._points, size=9, color=ui.BLUE)
        shown.add_layout(Whisker(base="mass", lower="low", upper="high", source=self._points))
        peaks = ui.plot((520, 300), ("|contrast| [%]", "events"), "xwheel_zoom,xpan,reset,tap")
        peaks.y_range = Range1d(0, 1)
        edges = {"left": "left", "right": "right", "top": "top", "bottom": 0}
        look = {"line_color": "white", "nonselection_alpha": 1}
        peaks.quad(**edges, source=self._bars, color=ui.GREY, **look)
        mark = {"marker": "inverted_triangle", "size": 12, "nonselection_alpha": 1}
        peaks.scatter("x", "y", source=self._marks, color="colour", **mark)
        word = {"text_align": "center", "y_offset": -10, "text_font_size": "12px"}
        word |= {"text_color": "colour", "nonselection_alpha": 1}
        peaks.text("x", "y", text="text", source=self._marks, **word)
        for kind in (Tap, DoubleTap):  # of two clicks that are fast the second is the latter
            peaks.on_event(kind, lambda event: self._clicked(event.x))
        self._histogram = peaks
        self._histogram_pane = pn.Column(pn.pane.Bokeh(peaks), visible=False)
        self._line_pane = pn.Column(pn.pane.Bokeh(shown), visible=False)

    def refresh(self) -> None:
        """Show the contrasts of the result that is chosen."""
        self._taken.refresh()
        movie, result = self._chosen.movie, self._chosen.result
        entries = [] if movie is None else listed(movie.parent)
        others = [e.path.name for e in entries if e.kind == "movie" and e.path != movie]
        darks = [_NO_DARK, *others]
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

    def _masses(self) -> list[float]:
        return sorted(masses_in(self._standards.value))

    def _clicked(self, contrast_percent: float | None) -> None:
        if self.peaks and contrast_percent is not None:
            away = [abs(100 * peak.contrast - contrast_percent) for peak in self.peaks]
            self._notice.tried(lambda: self._give(int(np.argmin(away))))

    def _give(self, peak: int | None) -> None:
        """Give a peak the next mass, or take its mass back."""
        masses = self._masses()
        free = [mass for mass in masses if mass not in self.assigned.values()]
        if not masses:
            raise DataError("Write the masses of the standards first.")
        if peak in self.assigned:
            self._assign({k: mass for k, mass in self.assigned.items() if k != peak})
        elif peak is not None and not free:
            raise DataError("Every mass has a peak: take one back first.")
        elif peak is not None:
            self._assign(self.assigned | {peak: free[0]})

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
            "colour": [ui.RED if k in assigned else ui.BLUE for k in range(len(places))],
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

    def _fit(self) -> None:
        result, masses = self._chosen.result, self._masses()
        if result is None:
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
        contrast, error = 100 * found.standards["contrast"].abs(), found.standards["contrast_se"]
        bars = {"low": contrast - 100 * error, "high": contrast + 100 * error}
        self._points.data = {"mass": found.standards["mass_kda"], "contrast": contrast, **bars}
        self._line_pane.visible = True
        slope, offset = found.gradient_per_kda, found.offset
        ends = [0.0, 1.1 * max(r["mass_kda"] for r in rows)]
        self._line.data = {"mass": ends, "contrast": [100 * abs(slope * m + offset) for m in ends]}
        self._table.object = ui.listing(rows, *_STANDARDS) + ui.lines([f"saved in {out}", *notes])
        self._taken.refresh()

    def _measure(self, kind: Kind) -> None:
        movie = self._chosen.wanted_movie
        dark = None
        if kind == "camera" and self._dark.value != _NO_DARK:
            dark = movie.with_name(self._dark.value)
        out = path_beside(movie, f".{kind}")
        self._queue.add(Job(movie, self._chosen.config, out, kind, overwrite=True, dark=dark))
        self._notice.say(f"{kind} of {movie.name} is in the queue: Run shows how far it is.")
