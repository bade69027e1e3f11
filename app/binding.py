"""K_D of the samples that are compared: their concentrations, the curve, and the constant."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from bokeh.models import ColumnDataSource, Whisker
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.binding import CONCENTRATIONS
from iscat_analysis.species.equilibrium import Model
from iscat_app.chosen import Notice, masses_in, table_of

_MODELS: dict[str, Model] = {"two M make a dimer": "dimer", "A and B make AB": "ab"}
_COLUMNS = {"concentration_nm": "monomers in all [nM]", "a_nm": "A in all [nM]",
            "b_nm": "B in all [nM]"}  # fmt: skip
_HEAD = ("sample", "[nM]", "events", "complexes", "95 %", "by K_D", "pull")


class BindingPart:
    """The part of Compare that fits a binding constant."""

    def __init__(self, notice: Notice, tables: Callable[[], list[tuple[str, Any]]]) -> None:
        self._notice, self._tables = notice, tables
        self._given: dict[tuple[str, str], Any] = {}  # widgets by sample and column
        self._model = pn.widgets.Select(label="Reaction", options=[*_MODELS], width=190)
        self._masses = pn.widgets.TextInput(label="Approximate masses [kDa]", width=190)
        self._inactive = pn.widgets.Checkbox(label="a part does not bind")
        fit = pn.widgets.Button(label="Fit K_D", color="primary", width=110)
        self._inputs = pn.Column()
        self._said = pn.pane.HTML("", sizing_mode="stretch_width")
        self._points = ColumnDataSource({name: [] for name in ("x", "y", "low", "high")})
        self._curve = ColumnDataSource({"x": [], "y": []})
        plot = figure(width=520, height=320, x_axis_type="log", x_axis_label="concentration [nM]",
                      y_axis_label="complexes among the particles", y_range=(0, 1),
                      tools="pan,wheel_zoom,reset,save")  # fmt: skip
        plot.line("x", "y", source=self._curve, color="#D55E00", line_width=2)
        plot.scatter("x", "y", source=self._points, size=8, color="#0072B2")
        plot.add_layout(Whisker(base="x", lower="low", upper="high", source=self._points))
        plot.toolbar.logo = None
        self._plot = pn.Column(pn.pane.Bokeh(plot), visible=False)
        self._model.param.watch(lambda _: self.show(self._names), "value")
        fit.on_click(self._fit)
        self._names: list[str] = []
        self.body = pn.FlexBox(
            pn.Column(self._model, self._masses, self._inactive, self._inputs, fit, width=430),
            pn.Column(self._plot, self._said, width=560),
        )

    def show(self, names: list[str]) -> None:
        """Ask for the concentrations of these samples."""
        self._names = names
        self._masses.placeholder = "66, or found" if self._reaction == "dimer" else "40, 80"
        rows = []
        for name in names:
            for column in CONCENTRATIONS[self._reaction]:
                if (name, column) not in self._given:
                    self._given[name, column] = pn.widgets.FloatInput(
                        label=f"{name}: {_COLUMNS[column]}", value=None, start=0.0, width=190
                    )
            rows.append(pn.Row(*(self._given[name, c] for c in CONCENTRATIONS[self._reaction])))
        self._inputs[:] = rows

    @property
    def _reaction(self) -> Model:
        return _MODELS[self._model.value]

    def _fit(self, _: Any) -> None:
        with self._notice.told():
            model, columns = self._reaction, CONCENTRATIONS[self._reaction]
            named = self._tables()
            rows = [
                {"path": name, **{c: self._given[name, c].value for c in columns}}
                for name in self._names
            ]
            samples = pd.DataFrame(rows, columns=["path", *columns])
            if len(named) < 2 or samples[list(columns)].isna().any(axis=None):
                self._notice.say(
                    "Choose two results or more, and give all concentrations.", "error"
                )
                return
            masses = masses_in(self._masses.value) or None
            inactive = self._inactive.value
            self._notice.work(
                "Fitting K_D",
                lambda: ia.fit_kd(
                    samples, tables=[table for _, table in named], model=model, masses_kda=masses,
                    inactive=inactive,
                ),
                self._show_fit,
            )  # fmt: skip

    def _show_fit(self, found: ia.Binding) -> None:
        rows, fit = found.samples, found.fit
        at = rows[list(CONCENTRATIONS[found.model])].sum(axis=1).to_numpy(float)
        self._points.data = {
            "x": at,
            "y": rows["complexes"],
            "low": rows["complexes_low"],
            "high": rows["complexes_high"],
        }
        self._plot.visible = True
        curve = found.curve
        if len(curve):
            self._curve.data = {"x": curve["concentration_nm"], "y": curve["complexes"]}
        else:  # of two partners there is no curve, but what the equilibrium says of each table
            order = np.argsort(at)
            self._curve.data = {"x": at[order], "y": rows["predicted"].to_numpy(float)[order]}
        high = "∞" if math.isinf(fit.kd_high) else f"{fit.kd_high:.4g}"
        said = [
            (
                f"K_D = {fit.kd_nm:.4g} nM (95 %: {fit.kd_low:.4g} to {high} nM); "
                f"p = {fit.p_value:.2g} of the equilibrium",
            ),
            *((f"{note}.",) for note in found.notes),
        ]
        cells = [
            (
                str(row["path"]), f"{total:.4g}", str(row["events"]), f"{row['complexes']:.1%}",
                f"{row['complexes_low']:.1%} to {row['complexes_high']:.1%}",
                f"{row['predicted']:.1%}", f"{row['pull']:+.1f}",
            )
            for row, total in zip(rows.to_dict("records"), at, strict=True)
        ]  # fmt: skip
        self._said.object = table_of(said) + table_of(cells, _HEAD)
