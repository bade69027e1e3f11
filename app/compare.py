"""Compare: samples over each other, whether they differ, and K_D over their concentrations."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from bokeh.models import ColumnDataSource, Legend, Whisker
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.binding import CONCENTRATIONS
from iscat_analysis.answers.gates import MassHistogram, counted_events, counted_rows, mass_histogram
from iscat_analysis.report.species import PALETTES
from iscat_analysis.species.equilibrium import Model
from iscat_analysis.species.tables import EventTable
from iscat_app.chosen import Chosen, Notice, in_line, link_to, masses_in, table_of
from iscat_app.results import Rejections
from iscat_app.runs import Job, Queue

_MODELS: dict[str, Model] = {"two M make a dimer": "dimer", "A and B make AB": "ab"}
_COLUMNS = {"concentration_nm": "monomers in all [nM]", "a_nm": "A in all [nM]",
            "b_nm": "B in all [nM]"}  # fmt: skip
_BINDING_HEAD = ("sample", "[nM]", "events", "complexes", "95 %", "by K_D", "pull")


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
        self._said.object = table_of(said) + table_of(cells, _BINDING_HEAD)


_HEAD = ("sample", "p: same", "p: same masses", "p: same fractions", "species [kDa]", "shift [kDa]",
         "95 %", "fraction", "difference", "95 %")  # fmt: skip


_DAY = (
    "<small>All movies of the folder, or those of its samples.csv, with the day's calibrations "
    "and in one page; what is finished is left alone.</small>"
)
DAY = "day.batch"
"""Folder of a day's results, beside its movies."""


class Compare:
    """The results of the folder, of which some are compared."""

    title = "Compare"

    def __init__(self, chosen: Chosen, queue: Queue) -> None:
        self._chosen, self._queue = chosen, queue
        self._notice = Notice()
        self.samples: list[tuple[str, MassHistogram]] = []
        self._paths = pn.widgets.MultiSelect(
            label="Results (Ctrl for several)", options=[], size=10, width=430
        )
        self._bin = pn.widgets.FloatInput(
            label="Bar width [kDa]", value=10.0, start=0.01, width=130
        )
        self._stacked = pn.widgets.Checkbox(label="one above the other")
        test = pn.widgets.Button(label="Test whether they differ", color="primary", width=200)
        self._plot = pn.pane.Bokeh(None)
        day = pn.widgets.Button(label="Analyse the folder as a day", width=200)
        self._pages = pn.pane.HTML("")
        self._binding = BindingPart(self._notice, self._events)
        self._table = pn.pane.HTML("", sizing_mode="stretch_width")
        for widget in (self._paths, self._bin, self._stacked):
            widget.param.watch(lambda _: self._draw(), "value")
        test.on_click(self._test)
        day.on_click(self._start_day)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(self._paths, in_line(self._bin, self._stacked), test, width=460),
                self._plot,
            ),
            self._table,
            "### Binding",
            self._binding.body,
            "### The day",
            pn.pane.HTML(_DAY),
            in_line(day, self._pages),
        )

    def refresh(self) -> None:
        """List the results beside the chosen movie."""
        place = self._chosen.movie or self._chosen.result
        if place is None:
            self._notice.say("Choose a movie or result under Open; its folder is compared.")
            return
        found = sorted(p for p in place.parent.glob("*.iscat") if (p / "fits.parquet").is_file())
        options = {p.name: str(p) for p in found}
        if options != self._paths.options:
            kept = [path for path in self._paths.value if path in options.values()]
            self._paths.param.update(options=options, value=kept)
        pages = sorted(place.parent.glob("*/batch.html"))
        self._pages.object = " · ".join(
            link_to(page, f"Page of {page.parent.name}") for page in pages
        )

    def _start_day(self, _: Any) -> None:
        place = self._chosen.movie
        if place is None:
            self._notice.say("Choose a movie under Open; its folder is the day.", "error")
            return
        folder = place.parent
        self._queue.add(Job(folder, self._chosen.config, folder / DAY, "day"))
        self._notice.say("The day is in the queue: Run shows how far it is.")

    def _tables(self) -> list[tuple[str, Any]]:
        """Read the events that count: ok, and not rejected."""
        tables = []
        for text in self._paths.value:
            path = Path(text)
            with ia.open_result(path) as result:
                rejected = Rejections(path).events(result.table)
                table = result.table[counted_rows(result.table, rejected=rejected)]
                name = path.stem + (f" (without {len(rejected)})" if rejected else "")
                tables.append((name, table))
        return tables

    def _events(self) -> list[tuple[str, EventTable]]:
        """Take them as events, with what the search of each result missed."""
        paths = [Path(text) for text in self._paths.value]
        return [
            (name, counted_events(path, table))
            for path, (name, table) in zip(paths, self._tables(), strict=True)
        ]

    def _draw(self) -> None:
        self._notice.say("")
        with self._notice.told():
            self._binding.show([Path(text).stem for text in self._paths.value])
            self.samples = [
                (name, mass_histogram(table["mass_kda"].to_numpy(float), bin_kda=self._bin.value))
                for name, table in self._tables()
            ]
            plot = figure(width=640, height=420, x_axis_label="|mass| [kDa]",
                          y_axis_label=f"share of events per {self._bin.value:g} kDa",
                          tools="xwheel_zoom,pan,reset,save")  # fmt: skip
            plot.toolbar.logo = None
            plot.add_layout(Legend(click_policy="hide"), "right")
            colours = PALETTES["colour-blind safe"]
            most = max(
                (s.counts.max() / max(s.counts.sum(), 1) for _, s in self.samples), default=1
            )
            for place, (name, seen) in enumerate(self.samples):
                share = seen.counts / max(seen.counts.sum(), 1.0)
                lift = 1.1 * most * place if self._stacked.value else 0.0
                plot.step(
                    np.repeat(seen.edges, 2)[1:-1], np.repeat(share, 2) + lift, mode="after",
                    color=colours[place % len(colours)], line_width=2, legend_label=name,
                )  # fmt: skip
            self._plot.object = plot

    def _test(self, _: Any) -> None:
        with self._notice.told():
            named = self._events()
            if len(named) < 2:
                self._notice.say("Choose two or more results.", "error")
                return
            names, tables = zip(*named, strict=True)
            self._notice.work(
                "Comparing",
                lambda: ia.compare_tables(tables),
                lambda found: self._tell(list(names[1:]), found),
            )

    def _tell(self, names: list[str], found: list[ia.Comparison]) -> None:
        self._table.object = table_of(_rows(names, found), _HEAD)


def _rows(names: list[str], found: list[ia.Comparison]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, each in zip(names, found, strict=True):
        tests = [
            _said(t.p_value, ".3g") for t in (each.same, each.same_masses, each.same_fractions)
        ]
        for place, s in enumerate(each.species.to_dict("records")):
            head = (name, *tests) if place == 0 else ("", "", "", "")
            rows.append(
                (
                    *head, _said(s["mass_kda"], ".1f"), _said(s["shift_kda"], ".2f"),
                    _between(s["shift_low"], s["shift_high"], ".2f"), _said(s["fraction"], ".1%"),
                    _said(s["difference"], ".1%"),
                    _between(s["difference_low"], s["difference_high"], ".1%"),
                )
            )  # fmt: skip
    return rows


def _said(value: float, form: str) -> str:
    """Write a number; a dash where too few events tell it."""
    return "–" if math.isnan(value) else format(value, form)


def _between(low: float, high: float, form: str) -> str:
    return "–" if math.isnan(low + high) else f"{low:{form}} to {high:{form}}"
