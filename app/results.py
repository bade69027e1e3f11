"""Results: the histogram with its gates, the map, pictures of events, and rejections by hand."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import panel as pn

import iscat_analysis as ia
from iscat_analysis.answers import gates
from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.records import BoolArray
from iscat_analysis.report.answer import DIAMETER, caution
from iscat_analysis.report.movie_figures import Sample, bin_width, field, masses, time
from iscat_analysis.report.numbers import number, with_error
from iscat_analysis.report.vega import VegaFigure, figures_in
from iscat_analysis.species.describe import Branch
from iscat_analysis.species.diameters import describe_sizes
from iscat_analysis.species.tables import EventTable
from iscat_app import widgets as ui
from iscat_app.chosen import Chosen, Notice, link_to, numbers_in

COLUMNS = ("event", "frame", "x_px", "y_px", "mass_kda", "rejected_at")
"""Columns of the list: what the event was, so that a new analysis does not reject another."""


class Rejections:
    """The rejected events of one result."""

    def __init__(self, result: Path) -> None:
        self.path = result.with_name(f"{result.name}.rejected.csv")
        try:
            self.rows = pd.read_csv(self.path)
        except FileNotFoundError:
            self.rows = pd.DataFrame(columns=list(COLUMNS), dtype=float)
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path}: cannot be read ({error}); move it away") from None
        if not set(COLUMNS) <= set(self.rows.columns):
            raise DataError(f"{self.path}: is no list of rejected events; move it away")

    def events(self, table: pd.DataFrame) -> set[int]:
        """Give the numbers of rejected events that are still those of the table."""
        both = table.merge(self.rows, on=["event", "frame"], suffixes=("", "_was"))
        away = (both["x_px"] - both["x_px_was"]).abs() + (both["y_px"] - both["y_px_was"]).abs()
        return set(both["event"][away < 1.0].astype(int))

    def lost(self, table: pd.DataFrame) -> int:
        """Count the rejected events that this table does not have."""
        return len(self.rows) - len(self.events(table))

    def reject(self, rows: pd.DataFrame) -> None:
        """Put events on the list."""
        new = rows[[c for c in COLUMNS if c in rows]].assign(
            rejected_at=datetime.now(UTC).isoformat(timespec="seconds")
        )
        new = new[~new["event"].isin(self.rows["event"])]
        self.rows = new if self.rows.empty else pd.concat([self.rows, new], ignore_index=True)
        self._write()

    def take_back(self, events: set[int]) -> None:
        """Take events off the list."""
        self.rows = self.rows[~self.rows["event"].isin(events)]
        self._write()

    def _write(self) -> None:
        with whole_file(self.path) as partial:
            self.rows.to_csv(partial, index=False)


def sample_of(
    result: ia.StoredResult, rows: pd.DataFrame, described: Mapping[str, Any] | None = None
) -> Sample:
    """Take rows of a result as a sample, which knows what is measured and in which unit.

    `described` replaces what the summary says of species and sizes.
    """
    summary = {**result.summary, **(described or {})}
    ends = [math.ceil(place) + 1 for place in rows[["y_px", "x_px"]].max().fillna(0.0)]
    field_of_view = np.zeros(summary["input"].get("shape", ends)[-2:])
    kept: Any = {"table": rows, "tracks": None, "summary": summary, "ratio_image": field_of_view}
    return Sample(replace(result.analysis, **kept))


_NO_ROWS = pd.DataFrame(columns=["event", "frame"])
_BRANCHES: dict[str, Branch] = {
    "landing and leaving": "magnitude",
    "landing": "landing",
    "leaving": "leaving",
}
_HINT = (
    "<small>Drag over the histogram for a gate; drag over dots, or click one, to select events. "
    "Grey, or the only curve: the kernel density. Species are of events that are ok.</small>"
)
_GATES = (
    " | events | 95 % | mean | ± SE | width | fraction | 95 %",
    "{low:g} to {high:g} | {count} | {count_low:.1f} to {count_high:.1f} | "
    "{mean:.2f} | {mean_se:.2f} | {width:.2f} | {fraction:.1f%} | "
    "{fraction_low:.1f%} to {fraction_high:.1f%}",
)
_SPECIES = (
    " | σ | common | width | events | 95 % | share | 95 %",
    "{value:.4g} | {sigma:.2g} | {systematic:.2g} | {width:.2g} | {count:.1f} | "
    "{count_low:.1f} to {count_high:.1f} | {share:.1f%} | {share_low:.1f%} to {share_high:.1f%}",
)
_ENDS = {
    "brush": {"low": "value"},
    "stretch": {"time": "time", "value": "value"},
    "area": {"x": "x", "y": "y"},
}
"""Columns of events by what somebody drags over, and by the axis of its figure."""


class Results:
    """The events of the result that is chosen."""

    title = "Results"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._shown: tuple[Any, ...] = ()
        self._notice = Notice()
        self.result: ia.StoredResult | None = None
        self.rejections: Rejections | None = None
        self.rejected: set[int] = set()
        self.table = _NO_ROWS
        self.sample: Sample | None = None
        self.histogram: gates.MassHistogram | None = None
        self._ends: list[tuple[float, float]] = []  # of gates
        self.start: list[float] | None = None  # [kDa], from where the species were fitted
        self._described: dict[str, Any] = {}  # in place of what the summary says of species
        self._behind: dict[str, Any] = {}  # the picture of the field, if the page has it
        self._seen = _NO_ROWS
        self._marked = np.zeros(0, dtype=bool)
        self._marked_in = ""
        picks = {"brush": (), "stretch": ("pick",), "area": ("pick",)}
        self._drawn = {k: ui.Drawn((k, *more), self._dragged) for k, more in picks.items()}
        self._make_widgets()

    def _make_widgets(self) -> None:
        select, button = pn.widgets.Select, self._notice.button
        self.bin = ui.number("Bar width", 10.0, 130, start=1e-6)
        self.kernel = ui.number("Kernel", 10.0, 110, start=1e-6)
        self.branch = select(label="Events", options=[*_BRANCHES], width=190)
        self.flagged = pn.widgets.Checkbox(label="flagged too")
        find = button("Find the species", 140, lambda: self._find_species(None))
        again = button("Fit again from these", 160, lambda: self._find_species(self.means()))
        self.begin = pn.widgets.TextInput(label="Species begin at", width=300)
        self.low, self.high = ui.number("Gate from", 0.0, 110), ui.number("to", 100.0, 90)
        of_gates = (
            button("Add the gate", 95, self._add_gate),
            button("Select its events", 115, self._select),
            button("Remove all gates", 115, lambda: self._set_gates([])),
        )
        self._report = pn.pane.HTML("")
        self._gate_table, self._species_table = ui.wide_pane(), ui.wide_pane()
        self.which = select(label="Selected events", options=[], size=7, width=230)
        self._facts = pn.pane.HTML("", width=230)
        about = "data, model and residual of the event"
        self._picture = pn.pane.PNG(None, width=560, alt_text=about)
        reject = button("Reject the selected events", 190, self._reject)
        self.listed = select(label="Rejected by hand", options=[], size=5, width=230)
        back = button("Take the event back", 160, self._take_back)
        self._notice.watch(self._draw, self.bin, self.kernel, self.branch, self.flagged)
        self._notice.watch(self._show_event, self.which)
        counted = (self.bin, self.kernel, self.branch, self.flagged, find, self._report)
        self.body = pn.Column(
            self._notice.pane,
            ui.in_line(*counted),
            pn.FlexBox(
                pn.Column(
                    self._drawn["brush"],
                    pn.pane.HTML(_HINT),
                    ui.in_line(self.low, self.high, *of_gates),
                    ui.in_line(self.begin, again),
                    self._gate_table,
                    self._species_table,
                    width=640,
                ),
                pn.Column(
                    self._drawn["stretch"],
                    pn.FlexBox(
                        self._drawn["area"],
                        pn.Column(self.which, reject, self._facts, self.listed, back, width=240),
                    ),
                    self._picture,
                    width=640,
                ),
            ),
        )

    # ---- the result -------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the result that is chosen."""
        now = self._chosen.result, self._chosen.changed
        if now == self._shown:
            return
        self._shown = now
        if self.result is not None:
            self.result.close()
        self.result, self.sample, self.table, self._seen = None, None, _NO_ROWS, _NO_ROWS
        self.rejected, self._ends = set(), []
        self._report.object = ""
        if self._chosen.result is None:
            self._notice.say("There is no result yet: analyse the movie under Run.")
            self._show()
            return
        self._notice.say("")
        report = self._chosen.result / "report.html"
        self._report.object = link_to(report, "The whole report") if report.is_file() else ""
        with self._notice.told():
            result = ia.open_result(self._chosen.result, movie=self._chosen.movie)
            self.table, self._behind = result.table, _picture_in(report)
            self.rejections = Rejections(self._chosen.result)
            self.rejected = self.rejections.events(self.table)
            if lost := self.rejections.lost(self.table):
                self._notice.say(
                    f"{lost} events of {self.rejections.path.name} are not in this result"
                )
            if result.summary.get("interrupted"):
                self._notice.say("The analysis was interrupted: these are the events so far.")
            self._seen = self._counted()
            self._described, self.start = {}, None
            if self.rejected:  # what the analysis says of species is of other events
                self._described = dict.fromkeys(("distribution", "sizes"))
            self._ask_in_units(sample_of(result, self._seen))
            self.result = result
            self._show()

    def _ask_in_units(self, sample: Sample) -> None:
        """Ask for everything in the unit of the result."""
        values, sigma = sample.values
        known = np.isfinite(values)
        width = bin_width(values[known], sigma[known]) if known.any() else 10.0
        unit = f" [{sample.quantity.unit}]" if sample.quantity.unit else ""
        self.low.label, self.high.label = f"Gate from{unit}", "to"
        self.bin.param.update(label=f"Bar width{unit}", value=width)
        self.kernel.param.update(label=f"Kernel{unit}", value=width)
        self.high.value = 10 * width
        self.begin.param.update(label=f"Species begin at{unit}", value="")

    def _counted(self) -> pd.DataFrame:
        """Give the rows that count now."""
        how: Any = {"branch": self.counted_branch, "ok_only": not self.flagged.value}
        counts = gates.counted_rows(self.table, rejected=self.rejected, **how)
        return self.table[counts].reset_index(drop=True)

    def _draw(self) -> None:
        """Count anew: what is shown follows what counts."""
        if self.result is not None:
            counted = self._counted()
            if not counted.equals(self._seen):
                self._seen, self.start, self.sample = counted, None, None
                self._described = dict.fromkeys(("distribution", "sizes"))
            self._show()

    def _show(self) -> None:
        """Show the events that count."""
        self.histogram = None
        if self.result is not None and len(self._seen):
            self.sample = self.sample or sample_of(self.result, self._seen, self._described)
            width = {"bar": self.bin.value, "kernel": self.kernel.value}
            values = self.sample.values[0]
            self.histogram = gates.mass_histogram(values[np.isfinite(values)], **width)
        self._mark(np.zeros(len(self._seen), dtype=bool), "")
        self._show_species()
        rows = self.table[self.table["event"].isin(self.rejected)]
        self.listed.options = {
            f"{row['event']}, frame {row['frame']}": int(row["event"])
            for row in rows.to_dict("records")
        }

    # ---- figures, and what is marked in them ------------------------------------------------

    def _draw_figures(self) -> None:
        """Draw all figures but that in which somebody has marked events."""
        sample = self.sample
        if sample is None:
            for drawn in self._drawn.values():
                drawn.draw(None)
            return
        marked = self._marked | (not self._marked.any())
        sample.events.update(row=list(range(len(marked))), marked=marked.tolist())
        made: dict[str, Callable[[], VegaFigure]] = {
            "brush": lambda: masses(sample, self.bin.value, self._beside(sample)),
            "stretch": lambda: time(sample),
            "area": lambda: field(sample),
        }
        for name, make in made.items():
            if name != self._marked_in:
                figure = make()
                data = {**figure.data, **(self._behind if name == "area" else {})}
                self._drawn[name].draw(replace(figure, data=data))

    def _beside(self, sample: Sample) -> dict[str, pd.DataFrame]:
        """Give what the histogram shows beside bars and species."""
        seen, wide = self.histogram, self.bin.value
        k, many = np.unique(sample.values[0][self._marked] // wide, return_counts=True)
        bars = {"low": k * wide, "high": (k + 1) * wide, "bottom": 0, "top": many, "count": many}
        labels = [f"{number(each.mean)}: {each.count}" for each in self.gates]
        more = {
            "gates": pd.DataFrame(gates.gate_rows(self.gates)).assign(label=labels),
            "bars": pd.DataFrame(bars | {"part": "marked"}),
        }
        if seen is not None:
            smooth = {"species": -1, "value": seen.at, "density": seen.density / seen.bar}
            more["curves"] = pd.DataFrame(smooth)
        return more

    def _dragged(self, name: str, ends: Any) -> None:
        """Mark the events over which somebody has dragged, or the one that was clicked."""
        if self.sample is None or (not ends and name != self._marked_in):
            return
        inside = np.full(len(self._seen), bool(ends) and name in _ENDS)
        if name not in _ENDS:
            inside[[each["row"] for each in ends]] = True
        for axis, (low, high) in ends.items() if name in _ENDS else ():
            column = _ENDS[name][axis.replace("\\", "")]
            value = np.asarray(self.sample.events[column], float)
            inside &= (value >= min(low, high)) & (value <= max(low, high))
            if name == "brush":
                digits = 2 - math.floor(math.log10(self.bin.value))
                self.low.value, self.high.value = round(low, digits), round(high, digits)
        self._mark(inside, name)

    def _select(self) -> None:
        """Mark the events between the ends of the gate."""
        if self.sample is not None:
            (low, high), values = self._typed(), self.sample.values[0]
            self._mark((values >= low) & (values < high), "")

    def _mark(self, inside: BoolArray, name: str) -> None:
        self._marked, self._marked_in = inside, name
        self._set_gates(self._ends)
        options: dict[str, int] = {}
        if self.sample is not None:
            named = zip(self._seen["event"], *self.sample.values, self._seen["status"], strict=True)
            for event, value, sigma, status in np.array([*named], dtype=object)[inside]:
                told = f"{event}: {with_error(value, sigma)} {self.sample.quantity.unit}".rstrip()
                options[f"{told}, {status}"] = int(event)
        self.which.param.update(options=options, value=next(iter(options.values()), None))

    # ---- gates ------------------------------------------------------------------------------

    @property
    def gates(self) -> list[gates.Gate]:
        """What is inside the gates."""
        if self.sample is None:
            return []
        return [gates.gate(self.sample.values[0], *ends) for ends in self._ends]

    def _typed(self) -> tuple[float, float]:
        low, high = sorted((self.low.value or 0.0, self.high.value or 0.0))  # None where empty
        return low, high

    def _add_gate(self) -> None:
        low, high = self._typed()
        if high > low:
            self._marked_in = ""
            self._set_gates([*self._ends, (low, high)])

    def _set_gates(self, ends: list[tuple[float, float]]) -> None:
        self._ends = sorted(ends)
        self._draw_figures()
        rows, axis = (
            gates.gate_rows(self.gates),
            "" if self.sample is None else self.sample.quantity.axis,
        )
        self._gate_table.object = ui.listing(rows, axis + _GATES[0], _GATES[1]) if rows else ""

    # ---- species ----------------------------------------------------------------------------

    def means(self) -> list[float]:
        """Give the masses [kDa] at which species are to begin."""
        values = np.array(sorted(numbers_in(self.begin.value)))
        if self.sample is None:
            return []
        power = max(self.sample.quantity.power, 1)
        return list((values / self.sample.scale) ** (1 / power))

    def events(self) -> EventTable:
        """Give the events that count, with what the search of the whole result missed."""
        if self.result is None:
            raise DataError("there is no result yet")
        return gates.counted_events(self.result.folder, self._seen)

    @property
    def counted_branch(self) -> Branch:
        """Which side of zero counts."""
        return _BRANCHES[self.branch.value]

    def species_curve(self) -> tuple[Any, Any] | None:
        """Give the curve of the species, per bar of the histogram."""
        curves = {} if self.sample is None else masses(self.sample).data.get("curves", {})
        if not curves or self.histogram is None:
            return None
        whole = pd.DataFrame(curves).groupby("value")["density"].sum() * self.histogram.bar
        return whole.index, whole

    def _find_species(self, start: list[float] | None) -> None:
        """Fit species, as many as there are, or from where somebody says."""
        seen, sample = self._seen, self.sample
        if start is not None and not start:
            self._notice.say("Find the species first, or give values to begin at.")
        elif sample is not None and not sample.analysis.mode_kind.masses_free:
            raise DataError("Masses were not fitted in this movie, so it has no species.")
        elif sample is not None:
            events, branch = self.events(), self.counted_branch

            def find() -> dict[str, Any]:
                if sample.quantity is DIAMETER:
                    sizes = describe_sizes(*sample.values, seed=0, common=0.0, findings=[])
                    return {"sizes": None if sizes is None else sizes.to_dict()}
                found = ia.find_species(events, start_kda=start, branch=branch)
                return {"distribution": found.to_dict()}

            self._notice.work("Finding species", find, lambda found: self._take(found, seen, start))

    def _take(self, found: dict[str, Any], seen: pd.DataFrame, start: list[float] | None) -> None:
        if seen is self._seen:  # and not of events that count no more
            self._described, self.start, self.sample = found, start, None
            self._show()

    def _show_species(self) -> None:
        sample = self.sample
        found = [] if sample is None else sample.species
        if sample is None or not found:
            self._species_table.object = ""
            if sample is not None and (wrong := caution(sample.fits)) is not None:
                self._notice.say(wrong.text)
            return
        self.begin.value = ", ".join(f"{each.value:.4g}" for each in found)
        notes = (sample.described("sizes") or sample.described("distribution") or {})["notes"]
        if sample.quantity.unit != "kDa":  # of masses that have no scale
            notes = [note for note in notes if "kDa" not in note]
        table = ui.listing(map(vars, found), sample.quantity.axis + _SPECIES[0], _SPECIES[1])
        self._species_table.object = table + ui.lines(f"{note}." for note in notes)

    # ---- single events ----------------------------------------------------------------------

    def _show_event(self) -> None:
        """Show the numbers of an event, and then its pictures, which are made of the movie."""
        result, event = self.result, self.which.value
        if result is None or event is None:
            self._facts.object, self._picture.object = "", None
            return
        row = int(np.flatnonzero(self.table["event"] == event)[0])
        self._facts.object = ui.table_of(result.facts(row))
        # where the film goes, and what it rings
        self._chosen.param.update(frame=int(self.table["frame"].iloc[row]), event=int(event))

        def take(picture: bytes) -> None:
            if self.which.value == event:
                self._picture.object = picture

        self._notice.work("Drawing the event", lambda: _png(result, row), take)

    def _reject(self) -> None:
        if not self._marked.any() or self.rejections is None:
            raise DataError("Select events first: drag over the figures, or click a dot.")
        self.rejections.reject(self._seen[self._marked])
        self._rejected_anew()

    def _take_back(self) -> None:
        if self.rejections is not None and self.listed.value is not None:
            self.rejections.take_back({self.listed.value})
            self._rejected_anew()

    def _rejected_anew(self) -> None:
        if self.rejections is not None:
            self.rejected = self.rejections.events(self.table)
            self._draw()
            self._notice.say(f"{len(self.rejected)} rejected by hand: {self.rejections.path.name}")


def _picture_in(page: Path) -> dict[str, Any]:
    """Give the picture of the field as the page of a result has it."""
    try:
        return {"picture": figures_in(page)["field"].data["picture"]}
    except (DataError, KeyError):
        return {}


def _png(result: ia.StoredResult, row: int) -> bytes:
    """Draw an event."""
    buffer = io.BytesIO()
    result.view(row).savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()
