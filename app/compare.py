"""Compare: samples over each other, whether they differ, and K_D over their concentrations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import panel as pn

import iscat_analysis as ia
from iscat_analysis.answers.binding import CONCENTRATIONS
from iscat_analysis.answers.gates import MassHistogram, counted_events, counted_rows, mass_histogram
from iscat_analysis.errors import DataError
from iscat_analysis.report.answer import MASS
from iscat_analysis.report.movie_figures import Sample
from iscat_analysis.report.page import curves, marks
from iscat_analysis.report.species import binding_charts
from iscat_analysis.schemas import jsonable
from iscat_analysis.species.equilibrium import Model
from iscat_analysis.species.tables import EventTable
from iscat_app import widgets as ui
from iscat_app.chosen import Chosen, Notice, link_to, numbers_in
from iscat_app.results import Rejections, sample_of
from iscat_app.runs import Job, Queue

_MODELS: dict[str, Model] = {"two M make a dimer": "dimer", "A and B make AB": "ab"}
_COLUMNS = {"concentration_nm": "monomers in all", "a_nm": "A in all", "b_nm": "B in all"}  # [nM]
_BINDING = (
    "sample | [nM] | events | complexes | 95 % | by K_D | pull",
    "{path} | {total:.4g} | {events} | {complexes:.1f%} | {complexes_low:.1f%} to "
    "{complexes_high:.1f%} | {predicted:.1f%} | {pull:+.1f}",
)


class BindingPart:
    """The part of Compare that fits a binding constant."""

    def __init__(self, notice: Notice, tables: Callable[[], list[tuple[str, Any]]]) -> None:
        self._notice, self._tables = notice, tables
        self._given: dict[tuple[str, str], Any] = {}  # widgets by sample and column
        self._model = pn.widgets.Select(label="Reaction", options=[*_MODELS], width=190)
        self._masses = pn.widgets.TextInput(label="Approximate masses [kDa]", width=190)
        self._inactive = pn.widgets.Checkbox(label="a part does not bind")
        fit = self._notice.button("Fit K_D", 110, self._fit, main=True)
        self._inputs = pn.Column()
        self._said = ui.wide_pane()
        self._drawn = ui.Drawn(), ui.Drawn()
        self._names: list[str] = []
        self._notice.watch(lambda: self.show(self._names), self._model)
        self.body = pn.FlexBox(
            pn.Column(self._model, self._masses, self._inactive, self._inputs, fit, width=430),
            pn.Column(*self._drawn, self._said, width=680),
        )

    def show(self, names: list[str]) -> None:
        """Ask for the concentrations of these samples."""
        self._names = names
        self._masses.placeholder = "66, or found" if self._reaction == "dimer" else "40, 80"
        rows = []
        columns = CONCENTRATIONS[self._reaction]
        for name in names:
            for column in columns:
                label = f"{name}: {_COLUMNS[column]} [nM]"
                if (name, column) not in self._given:
                    self._given[name, column] = ui.number(label, None, 190, start=0.0)
            rows.append(pn.Row(*(self._given[name, column] for column in columns)))
        self._inputs[:] = rows

    @property
    def _reaction(self) -> Model:
        return _MODELS[self._model.value]

    def _fit(self) -> None:
        model, columns = self._reaction, CONCENTRATIONS[self._reaction]
        tables = [table for _, table in self._tables()]
        rows = [
            {"path": name, **{c: self._given[name, c].value for c in columns}}
            for name in self._names
        ]
        samples = pd.DataFrame(rows, columns=["path", *columns])
        if len(tables) < 2 or samples[list(columns)].isna().any(axis=None):
            raise DataError("Choose two results or more, and give all concentrations.")
        options: Any = {"masses_kda": numbers_in(self._masses.value) or None}
        options |= {"inactive": self._inactive.value, "model": model, "tables": tables}
        fit = partial(ia.fit_kd, samples, **options)
        self._notice.work("Fitting K_D", fit, self._show_fit)

    def _show_fit(self, found: ia.Binding) -> None:
        fit = found.fit
        rows = found.samples.assign(
            total=found.samples[list(CONCENTRATIONS[found.model])].sum(axis=1)
        )
        charts = binding_charts(jsonable(found.to_dict()))
        for drawn, chart in zip(self._drawn, charts, strict=True):
            drawn.draw(chart.figure)
        high = "∞" if math.isinf(fit.kd_high) else f"{fit.kd_high:.4g}"
        said = (
            f"K_D = {fit.kd_nm:.4g} nM (95 %: {fit.kd_low:.4g} to {high} nM); "
            f"p = {fit.p_value:.2g} of the equilibrium"
        )
        notes = (f"{note}." for note in found.notes)
        self._said.object = ui.lines([said, *notes]) + ui.listing(
            rows.to_dict("records"), *_BINDING
        )


_HEAD = (
    "sample | p: same | p: same masses | p: same fractions | species [kDa] | shift [kDa] "
    "| 95 % | fraction | difference | 95 %",
    "{sample} | {same:.3g} | {same_masses:.3g} | {same_fractions:.3g} | {mass_kda:.1f} | "
    "{shift_kda:.2f} | {shift_low:.2f} to {shift_high:.2f} | {fraction:.1f%} | "
    "{difference:.1f%} | {difference_low:.1f%} to {difference_high:.1f%}",
)


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
        self.axis = ""
        self._paths = pn.widgets.MultiSelect(
            label="Results (Ctrl for several)", options=[], size=10, width=430
        )
        self._bin = ui.number("Bar width", 10.0, 130, start=1e-6)
        self._stacked = pn.widgets.Checkbox(label="one above the other")
        test = self._notice.button("Test whether they differ", 200, self._test, main=True)
        self._drawn = ui.Drawn()
        day = self._notice.button("Analyse the folder as a day", 200, self._start_day)
        self._pages = pn.pane.HTML("")
        self._binding = BindingPart(self._notice, self._events)
        self._table = ui.wide_pane()
        self._notice.watch(self._draw, self._paths, self._bin, self._stacked)
        chosen_ones = pn.Column(self._paths, ui.in_line(self._bin, self._stacked), test, width=460)
        binding = ("### Binding", self._binding.body)
        of_day = ("### The day", pn.pane.HTML(_DAY), ui.in_line(day, self._pages))
        shown = pn.FlexBox(chosen_ones, self._drawn)
        self.body = pn.Column(self._notice.pane, shown, self._table, *binding, *of_day)

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
        links = [link_to(page, f"Page of {page.parent.name}") for page in pages]
        self._pages.object = " · ".join(links)

    def _start_day(self) -> None:
        folder = self._chosen.wanted_movie.parent
        self._queue.add(Job(folder, self._chosen.config, folder / DAY, "day"))
        self._notice.say("The day is in the queue: Run shows how far it is.")

    def _chosen_samples(self) -> Iterator[tuple[Path, str, Sample]]:
        """Give the events that count of each result: ok, and not rejected."""
        for text in self._paths.value:
            path = Path(text)
            with ia.open_result(path) as result:
                rejected = Rejections(path).events(result.table)
                rows = result.table[counted_rows(result.table, rejected=rejected)]
                name = path.stem + (f" (without {len(rejected)})" if rejected else "")
                yield path, name, sample_of(result, rows.reset_index(drop=True))

    def _events(self) -> list[tuple[str, EventTable]]:
        """Take them as events, with what the search of each result missed."""
        found = []
        for path, name, sample in self._chosen_samples():
            if sample.quantity is not MASS:
                raise DataError(f"{name}: has no masses but {sample.quantity.axis}; calibrate it")
            found.append((name, counted_events(path, sample.rows)))
        return found

    def _draw(self) -> None:
        self._notice.say("")
        self._binding.show([Path(text).stem for text in self._paths.value])
        found = [(name, sample) for _, name, sample in self._chosen_samples()]
        axes = {sample.quantity.axis for _, sample in found}
        if len(axes) > 1:
            raise DataError(f"These results cannot be compared: {', '.join(sorted(axes))}.")
        self.axis, wide = "".join(axes), self._bin.value
        self.samples = [
            (name, mass_histogram(sample.values[0], bar=wide)) for name, sample in found
        ]
        shares = [seen.counts / max(seen.counts.sum(), 1.0) for _, seen in self.samples]
        step = 1.1 * max((share.max() for share in shares), default=1) * self._stacked.value
        parts = [
            marks("line", name, np.repeat(seen.edges, 2)[1:-1], np.repeat(share, 2) + k * step)
            for k, ((name, seen), share) in enumerate(zip(self.samples, shares, strict=True))
        ]
        words = {"x": self.axis, "wide": f"{wide:g}"}
        self._drawn.draw(curves("samples", parts, words).figure if parts else None)

    def _test(self) -> None:
        named = self._events()
        if len(named) < 2:
            raise DataError("Choose two or more results.")
        names, tables = zip(*named, strict=True)
        compare = partial(ia.compare_tables, tables)
        self._notice.work("Comparing", compare, lambda found: self._tell(names, found))

    def _tell(self, names: tuple[str, ...], found: list[ia.Comparison]) -> None:
        rows: list[dict[str, Any]] = []
        for name, each in zip(names[1:], found, strict=True):
            tests = ("same", "same_masses", "same_fractions")
            head = {"sample": name, **{test: getattr(each, test).p_value for test in tests}}
            rows += (head | row for row in each.species.to_dict("records"))
        self._table.object = ui.listing(rows, *_HEAD)
