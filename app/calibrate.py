"""Calibrate: contrast against mass by standards, the camera from its noise, the optics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import panel as pn

from iscat_analysis.answers.calibrations import contrast_peaks, mass_calibration
from iscat_analysis.calibration import ContrastPeak, MassCalibration
from iscat_analysis.errors import DataError
from iscat_analysis.movie import path_beside
from iscat_analysis.report.page import curves, marks
from iscat_analysis.report.vega import figures_in
from iscat_app import widgets as ui
from iscat_app.chosen import Chosen, Notice, numbers_in
from iscat_app.files import listed
from iscat_app.runs import Job, Kind, Queue
from iscat_app.settings import Taken
from iscat_app.widgets import clickable

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
        self._bars = np.zeros(0), np.zeros(1)
        self._histogram, self._line = ui.Drawn(("pick",), self._clicked), ui.Drawn()
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
            pn.FlexBox(self._histogram, self._line),
            self._table,
            "### Camera and optics, from the movie that is chosen",
            ui.in_line(self._dark, *measured),
            "### Use a calibration",
            self._taken.body,
        )

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
        self._line.draw(None)
        self._notice.say("" if result else "Choose an analysed movie of standards under Open.")
        if result is not None:
            with self._notice.told():
                size, self.peaks = contrast_peaks(result)
                self._bars = np.histogram(100 * size, bins=60)
        self._assign({})

    # ---- which peak has which mass ----------------------------------------------------------

    def _masses(self) -> list[float]:
        return sorted(numbers_in(self._standards.value))

    def _clicked(self, _: str, picked: Any) -> None:
        with self._notice.told():
            for each in picked:
                away = [abs(100 * peak.contrast - each["x"]) for peak in self.peaks]
                self._give(int(np.argmin(away)))

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
        places = [100 * peak.contrast for peak in self.peaks]
        names = [f"{assigned[k]:g} kDa" if k in assigned else "" for k in range(len(places))]
        pairs = enumerate(zip(places, names, strict=True), 1)
        texts = [f"{k}: {x:.3g} %, {name}".removesuffix(", ") for k, (x, name) in pairs]
        peak = self._peak.value if self._peak.value in range(len(texts)) else None
        self._peak.param.update(
            options={text: k for k, text in enumerate(texts)},
            value=0 if texts and peak is None else peak,
        )
        if not places:
            self._histogram.draw(None)
            return
        counts, edges = self._bars
        parts = [marks("bar", "events", edges, counts)]
        for x, name, known in zip(places, names, self.peaks, strict=True):
            near = (edges[1:] > x - 100 * known.width) & (edges[:-1] < x + 100 * known.width)
            top = 1.08 * counts[near].max(initial=0.0)
            parts.append(marks("point", name or "no mass", [x], [top]))
        self._histogram.draw(clickable(curves("assigned", parts).figure, "x"))

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
        self._line.draw(figures_in(out / "calibration.html")["standards"])
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
