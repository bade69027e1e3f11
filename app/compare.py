"""Compare: samples over each other, and whether they differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import Legend
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.gates import MassHistogram, counted_rows, mass_histogram
from iscat_analysis.report.gates import PALETTES
from iscat_app.chosen import Chosen, Notice, table_of
from iscat_app.rejections import Rejections

_HEAD = ("sample", "p: same", "p: same masses", "p: same fractions", "species [kDa]", "shift [kDa]",
         "95 %", "fraction", "difference", "95 %")  # fmt: skip


class Compare:
    """The results of the folder, of which some are compared."""

    title = "Compare"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._notice = Notice()
        self.samples: list[tuple[str, MassHistogram]] = []
        self._paths = pn.widgets.MultiSelect(label="Results (Ctrl for several)",
                                             options=[], size=10, width=430)  # fmt: skip
        self._bin = pn.widgets.FloatInput(
            label="Bar width [kDa]", value=10.0, start=0.01, width=130
        )
        self._stacked = pn.widgets.Checkbox(label="one above the other")
        test = pn.widgets.Button(label="Test whether they differ", color="primary", width=200)
        self._plot = pn.pane.Bokeh(figure(width=760, height=420))
        self._table = pn.pane.HTML("", sizing_mode="stretch_width")
        for widget in (self._paths, self._bin, self._stacked):
            widget.param.watch(lambda _: self._draw(), "value")
        test.on_click(self._test)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(pn.Column(self._paths, pn.Row(self._bin, self._stacked), test), self._plot),
            self._table,
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
            self._paths.options = options

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

    def _draw(self) -> None:
        self._notice.say("")
        with self._notice.told():
            self.samples = [
                (name, mass_histogram(table["mass_kda"].to_numpy(float), bin_kda=self._bin.value))
                for name, table in self._tables()
            ]
            plot = figure(width=760, height=420, x_axis_label="|mass| [kDa]",
                          y_axis_label=f"share of events per {self._bin.value:g} kDa",
                          tools="xwheel_zoom,pan,reset,save")  # fmt: skip
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
            named = self._tables()
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
        tests = [f"{t.p_value:.3g}" for t in (each.same, each.same_masses, each.same_fractions)]
        for place, s in enumerate(each.species.to_dict("records")):
            head = (name, *tests) if place == 0 else ("", "", "", "")
            rows.append(
                (
                    *head, f"{s['mass_kda']:.1f}", f"{s['shift_kda']:.2f}",
                    f"{s['shift_low']:.2f} to {s['shift_high']:.2f}", f"{s['fraction']:.1%}",
                    f"{s['difference']:.1%}",
                    f"{s['difference_low']:.1%} to {s['difference_high']:.1%}",
                )
            )  # fmt: skip
    return rows
