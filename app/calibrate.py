"""Calibrate: contrast against mass, by standards in the result that is chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Whisker
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.calibrations import mass_calibration
from iscat_analysis.calibration.mass import MassCalibration
from iscat_analysis.movie.addresses import path_beside
from iscat_app.chosen import Chosen, Notice, table_of
from iscat_app.form import add_table

_HEAD = ("standard [kDa]", "contrast", "±", "by the line [kDa]", "95 %", "residual [%]")


class Calibrate:
    """Standards of known mass make the scale of all others."""

    title = "Calibrate"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._notice = Notice()
        self._toml = ""
        self._standards = pn.widgets.TextInput(label="Masses of the standards [kDa]",
                                               placeholder="66, 146, 480", width=260)  # fmt: skip
        fit = pn.widgets.Button(label="Fit the line", color="primary", width=120)
        self._use = pn.widgets.Button(
            label="Put it into the movie's iscat.toml", width=250, disabled=True
        )
        self._points = ColumnDataSource({"mass": [], "contrast": [], "low": [], "high": []})
        self._line = ColumnDataSource({"mass": [], "contrast": []})
        self._bars = ColumnDataSource({"left": [], "right": [], "top": []})
        plot = figure(width=480, height=360, x_axis_label="mass [kDa]",
                      y_axis_label="|contrast| [%]", tools="pan,wheel_zoom,reset,save")  # fmt: skip
        plot.line("mass", "contrast", source=self._line, color="#D55E00")
        plot.scatter("mass", "contrast", source=self._points, size=9, color="#0072B2")
        plot.add_layout(Whisker(base="mass", lower="low", upper="high", source=self._points))
        peaks = figure(width=480, height=260, x_axis_label="|contrast| [%]", y_axis_label="events",
                       tools="xwheel_zoom,xpan,reset")  # fmt: skip
        peaks.quad(left="left", right="right", top="top", bottom=0, source=self._bars,
                   color="#8A8F96", line_color="white")  # fmt: skip
        self._table = pn.pane.HTML("", sizing_mode="stretch_width")
        self._text = pn.pane.Str("", sizing_mode="stretch_width")
        fit.on_click(self._fit)
        self._use.on_click(self._put)
        self.body = pn.Column(
            self._notice.pane,
            pn.Row(self._standards, fit, self._use, styles={"align-items": "end"}),
            pn.FlexBox(pn.pane.Bokeh(peaks), pn.pane.Bokeh(plot)),
            self._table, self._text,
        )  # fmt: skip

    def refresh(self) -> None:
        """Show the contrasts of the result that is chosen."""
        if self._chosen.result is None:
            self._notice.say("Choose an analysed movie of standards under Open.")
            return
        self._notice.say("")
        with self._notice.told(), ia.open_result(self._chosen.result) as result:
            good = result.table[result.table["status"] == "ok"]
            size = 100 * np.abs(good["contrast"].to_numpy(float))
            counts, edges = np.histogram(size, bins=60)
            self._bars.data = {"left": edges[:-1], "right": edges[1:], "top": counts}

    def _fit(self, _: Any) -> None:
        result = self._chosen.result
        if result is None:
            return
        try:
            masses = [float(text) for text in self._standards.value.replace(";", ",").split(",")]
        except ValueError:
            self._notice.say("Write the masses as 66, 146, 480.", "error")
            return
        out = path_beside(result, ".calibration")
        notes: list[str] = []
        self._notice.work(
            "Fitting",
            lambda: mass_calibration(result, masses, out, overwrite=True, notify=notes.append),
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
        self._toml = found.to_toml()
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
        ) + table_of([(note,) for note in notes])  # fmt: skip
        self._text.object = f"saved in {out}\n\n{self._toml}"
        self._use.disabled = False

    def _put(self, _: Any) -> None:
        path: Path | None = self._chosen.setup
        if path is None:
            self._notice.say("Choose a movie under Open.", "error")
            return
        with self._notice.told():
            add_table(path, "calibration", self._toml)
            self._chosen.changed += 1
            self._notice.say(f"[calibration] of {path} is this line now; analyse anew to use it")
