"""Compare: samples over each other, and whether they differ."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import Legend
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.gates import MassHistogram, counted_events, counted_rows, mass_histogram
from iscat_analysis.report.species import PALETTES
from iscat_analysis.species.tables import EventTable
from iscat_app.binding import BindingPart
from iscat_app.chosen import Chosen, Notice, in_line, link_to, table_of
from iscat_app.rejections import Rejections
from iscat_app.runs import Job, Queue

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
