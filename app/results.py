"""Results: the histogram with its gates, the map, pictures of events, and rejections by hand."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from bokeh.events import SelectionGeometry
from bokeh.models import BoxAnnotation, BoxSelectTool, PointDrawTool, TapTool

import iscat_analysis as ia
from iscat_analysis.answers.gates import (
    Gate,
    MassHistogram,
    counted_events,
    counted_rows,
    gate,
    gate_rows,
    mass_histogram,
    usual_bin,
)
from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.species.describe import Branch
from iscat_analysis.species.tables import EventTable
from iscat_app import widgets as ui
from iscat_app.chosen import Chosen, Notice, link_to, masses_in

COLUMNS = ("event", "frame", "x_px", "y_px", "mass_kda", "rejected_at")
"""Columns of the list: what the event was, so that a new analysis does not reject another."""


class Rejections:
    """The rejected events of one result."""

    def __init__(self, result: Path) -> None:
        self.path = result.with_name(f"{result.name}.rejected.csv")
        try:
            self.rows = pd.read_csv(self.path)
        except FileNotFoundError:
            self.rows = pd.DataFrame(columns=list(COLUMNS))
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path}: cannot be read ({error}); move it away") from None
        if not set(COLUMNS) <= set(self.rows.columns):
            raise DataError(f"{self.path}: is no list of rejected events; move it away")

    def events(self, table: pd.DataFrame) -> set[int]:
        """Give the numbers of rejected events that are still those of the table."""
        found = set()
        known = table.set_index("event")
        for row in self.rows.to_dict("records"):
            if row["event"] in known.index:
                now = known.loc[row["event"]]
                near = abs(now["x_px"] - row["x_px"]) + abs(now["y_px"] - row["y_px"]) < 1.0
                if near and now["frame"] == row["frame"]:
                    found.add(int(row["event"]))
        return found

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


_BRANCHES: dict[str, Branch] = {
    "landing and leaving": "magnitude",
    "landing": "landing",
    "leaving": "leaving",
}
_HINT = (
    "<small>Drag over the histogram for a gate; click a bar, or dots below, to select events. The "
    "point tool moves, adds (click) and removes (Backspace) the diamonds of species, and so do the "
    "masses in the field. Species are of events that are ok.</small>"
)
_GATES = (
    "gate [kDa] | events | 95 % | mean [kDa] | ± SE | width [kDa] | fraction | 95 %",
    "{low_kda:g} to {high_kda:g} | {count} | {count_low:.1f} to {count_high:.1f} | "
    "{mean_kda:.2f} | {mean_se:.2f} | {width_kda:.2f} | {fraction:.1f%} | "
    "{fraction_low:.1f%} to {fraction_high:.1f%}",
)
_SPECIES = (
    "species [kDa] | 95 % | width [kDa] | events | fraction | 95 %",
    "{mass_kda:.1f} | {mass_low:.1f} to {mass_high:.1f} | {width_kda:.1f} | {count:.1f} |"
    " {fraction:.1f%} | {fraction_low:.1f%} to {fraction_high:.1f%}",
)


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
        self.table = pd.DataFrame()
        self.histogram: MassHistogram | None = None
        self.gates: list[Gate] = []
        self.species: ia.Distribution | None = None
        self.start: list[float] | None = None  # from where the species were fitted
        self._seen = pd.DataFrame()
        self._make_figures()
        self._make_widgets()

    # ---- figures ----------------------------------------------------------------------------

    def _make_figures(self) -> None:
        self._bars = ui.source("left", "right", "top")
        self._curve, self._species_curve = ui.source("x", "y"), ui.source("x", "y")
        self._handles = ui.source("x", "y")
        self._events = ui.source("x", "y", "frame", "mass", "event", "colour")
        self._hist = ui.plot((620, 330), ("|mass| [kDa]", "events"), "xwheel_zoom,xpan,reset,save")
        grey = {
            "alpha": 0.5,
            "nonselection_alpha": 0.35,
            "selection_color": ui.BLUE,
            "color": ui.GREY,
        }
        edges = {"left": "left", "right": "right", "top": "top", "bottom": 0}
        bars = self._hist.quad(**edges, source=self._bars, line_color="white", **grey)
        self._hist.line("x", "y", source=self._curve, color=ui.BLUE, legend_label="kernel density")
        red = {"color": ui.RED, "line_width": 2, "legend_label": "species"}
        self._hist.line("x", "y", source=self._species_curve, **red)
        diamond = {"marker": "diamond", "size": 14, "color": ui.RED, "nonselection_alpha": 1}
        handles = self._hist.scatter("x", "y", source=self._handles, line_color="white", **diamond)
        about = "move, add or remove species"
        self._hist.add_tools(PointDrawTool(renderers=[handles], description=about))
        legend = self._hist.legend[0]
        legend.update(orientation="horizontal", border_line_color=None, padding=2)
        self._hist.add_layout(legend, "above")
        gate_tool = BoxSelectTool(dimensions="width", renderers=[], description="drag a gate")
        self._hist.add_tools(gate_tool, TapTool(renderers=[bars]))
        self._hist.toolbar.active_drag = gate_tool
        self._hist.on_event(SelectionGeometry, self._dragged)
        self._hist.y_range.start = 0
        self._bars.selected.on_change("indices", self._bar_clicked)
        tools = "pan,wheel_zoom,box_select,tap,reset"
        self._map = ui.plot((310, 300), ("x [px]", "y [px]"), tools)
        self._map.match_aspect = self._map.y_range.flipped = True
        self._course = ui.plot((310, 300), ("frame", "mass [kDa]"), tools)
        dot = {"size": 6, "selection_line_color": "black", "nonselection_alpha": 0.25}
        for shown, x, y in ((self._map, "x", "y"), (self._course, "frame", "mass")):
            shown.scatter(x, y, source=self._events, color="colour", **dot)
        self._events.selected.on_change("indices", self._events_selected)

    def _make_widgets(self) -> None:
        select = pn.widgets.Select
        self.bin = ui.number("Bar width [kDa]", 10.0, 110, start=0.01)
        self.kernel = ui.number("Kernel [kDa]", 10.0, 110, start=0.01)
        self.branch = select(label="Events", options=[*_BRANCHES], width=190)
        self.flagged = pn.widgets.Checkbox(label="flagged too")
        self.find = self._notice.button("Find the species", 140, lambda: self._find_species(None))
        again = "Fit again from the diamonds"
        self.refit = self._notice.button(again, 210, lambda: self._find_species(self._means()))
        begin = {"label": "Species begin at [kDa]", "placeholder": "66, 146", "width": 300}
        self.begin = pn.widgets.TextInput(**begin)
        self.low = ui.number("Gate from [kDa]", 0.0, 100)
        self.high = ui.number("to [kDa]", 100.0, 100)
        gates = (
            self._notice.button("Add the gate", 100, lambda: self._add_gate(*self._ends())),
            self._notice.button("Select its events", 120, lambda: self._select(*self._ends())),
            self._notice.button("Remove all gates", 125, lambda: self._set_gates([])),
        )
        self._report = pn.pane.HTML("")
        self._gate_table, self._species_table = ui.wide_pane(), ui.wide_pane()
        self.which = select(label="Selected events", options=[], size=7, width=230)
        self._facts = pn.pane.HTML("", width=300)
        about = "data, model and residual of the event"
        self._picture = pn.pane.PNG(None, width=560, alt_text=about)
        reject = self._notice.button("Reject the selected events", 190, self._reject)
        self.listed = select(label="Rejected by hand", options=[], size=5, width=230)
        back = self._notice.button("Take the event back", 160, self._take_back)
        self._notice.watch(self._draw, self.bin, self.kernel, self.branch, self.flagged)
        self._notice.watch(self._begin_typed, self.begin)
        self._notice.watch(self._show_event, self.which)
        self._handles.on_change("data", self._write_means)
        counted = (self.bin, self.kernel, self.branch, self.flagged, self.find, self._report)
        self.body = pn.Column(
            self._notice.pane,
            ui.in_line(*counted),
            pn.FlexBox(
                pn.Column(
                    pn.pane.Bokeh(self._hist),
                    pn.pane.HTML(_HINT),
                    ui.in_line(self.low, self.high, *gates),
                    ui.in_line(self.begin, self.refit),
                    self._gate_table,
                    self._species_table,
                    pn.Row(pn.pane.Bokeh(self._map), pn.pane.Bokeh(self._course)),
                    width=660,
                ),
                pn.Column(self.which, reject, self._facts, self._picture, self.listed, back),
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
        self.result, self.table = None, pd.DataFrame()
        self.species, self.start = None, None
        self._set_gates([])
        if self._chosen.result is None:
            self._notice.say("There is no result yet: analyse the movie under Run.")
            self._report.object = ""
            return
        self._notice.say("")
        report = self._chosen.result / "report.html"
        self._report.object = link_to(report, "The whole report") if report.is_file() else ""
        with self._notice.told():
            self.result = ia.open_result(self._chosen.result, movie=self._chosen.movie)
            self.table = self.result.table
            self.rejections = Rejections(self._chosen.result)
            self.rejected = self.rejections.events(self.table)
            lost = self.rejections.lost(self.table)
            if lost:
                self._notice.say(
                    f"{lost} events of {self.rejections.path.name} are not in this result"
                )
            if self.result.summary.get("interrupted"):
                self._notice.say("The analysis was interrupted: these are the events so far.")
            width = usual_bin(self.table)
            self.bin.value, self.kernel.value = width, width
            self._draw()

    def masses(self) -> np.ndarray[Any, Any]:
        """Give the masses that count now."""
        return np.abs(self._seen["mass_kda"].to_numpy(float)) if len(self._seen) else np.empty(0)

    def _draw(self) -> None:
        """Count anew: what is shown follows what counts."""
        if not len(self.table):
            return
        with self._notice.told():
            counts = counted_rows(
                self.table,
                branch=self.counted_branch,
                ok_only=not self.flagged.value,
                rejected=self.rejected,
            )
            if not self.table[counts].equals(self._seen):
                self._seen, self.species, self.start = self.table[counts], None, None
            seen = self.histogram = mass_histogram(
                self.masses(), bin_kda=self.bin.value, bandwidth_kda=self.kernel.value
            )
            self._bars.selected.indices = []
            self._bars.data = {"left": seen.edges[:-1], "right": seen.edges[1:], "top": seen.counts}
            self._curve.data = {"x": seen.mass_kda, "y": seen.density}
            self._hist.yaxis.axis_label = f"events per {seen.bin_kda:g} kDa"
            self._draw_species()
            place = {"x": "x_px", "y": "y_px", "frame": "frame", "mass": "mass_kda"}
            place["event"] = "event"
            data = {name: self._seen[column].to_numpy() for name, column in place.items()}
            data["colour"] = np.where(self._seen["status"] == "ok", ui.BLUE, ui.ORANGE)
            self._events.selected.indices = []
            self._events.data = data
            self._set_gates([(g.low_kda, g.high_kda) for g in self.gates])
            self._list_rejected()

    # ---- gates ------------------------------------------------------------------------------

    def _dragged(self, event: SelectionGeometry) -> None:
        if event.final and event.geometry.get("type") == "rect":
            self._add_gate(event.geometry["x0"], event.geometry["x1"])

    def _ends(self) -> tuple[float, float]:
        return self.low.value or 0.0, self.high.value or 0.0  # None where the field is empty

    def _add_gate(self, low: float, high: float) -> None:
        low, high = sorted((max(round(low, 1), 0.0), round(high, 1)))
        if high > low:
            self._set_gates([*((g.low_kda, g.high_kda) for g in self.gates), (low, high)])

    def _set_gates(self, ends: list[tuple[float, float]]) -> None:
        with self._notice.told():
            self.gates = [gate(self.masses(), low, high) for low, high in sorted(ends)]
        kept = [r for r in self._hist.center if not isinstance(r, BoxAnnotation)]
        look = {"fill_alpha": 0.12, "fill_color": ui.BLUE}
        ends_of = [(each.low_kda, each.high_kda) for each in self.gates]
        boxes = [BoxAnnotation(left=low, right=high, **look) for low, high in ends_of]
        self._hist.center = [*kept, *boxes]
        self._gate_table.object = ui.listing(gate_rows(self.gates), *_GATES) if self.gates else ""

    # ---- species ----------------------------------------------------------------------------

    def _means(self) -> list[float]:
        """Give the masses at which somebody left the diamonds."""
        return sorted({round(float(x), 2) for x in self._handles.data["x"] if x > 0})

    def _write_means(self, _attr: str, _old: Any, _new: Any) -> None:
        self.begin.value = ", ".join(f"{mass:g}" for mass in self._means())

    def _begin_typed(self) -> None:
        """Put the diamonds where somebody writes."""
        masses = sorted(masses_in(self.begin.value))
        if masses != self._means():
            curve = self.species_curve()
            height = np.interp(masses, *curve) if curve else np.zeros(len(masses))
            self._handles.data = {"x": np.array(masses), "y": height}

    def events(self) -> EventTable:
        """Give the events that count, with what the search of the whole result missed."""
        if self.result is None:
            raise ia.DataError("there is no result yet")
        return counted_events(self.result.folder, self._seen)

    @property
    def counted_branch(self) -> Branch:
        """Which side of zero counts."""
        return _BRANCHES[self.branch.value]

    def _find_species(self, start: list[float] | None) -> None:
        """Fit species, as many as there are, or from where somebody says."""
        seen, branch = self._seen, self.counted_branch
        if start is not None and not start:
            self._notice.say("Find the species first, or give masses to begin at.")
        elif len(seen):
            events = self.events()
            self._notice.work(
                "Finding species",
                lambda: ia.find_species(events, start_kda=start, branch=branch),
                lambda found: self._take_species(found, seen, start),
            )

    def _take_species(
        self, found: ia.Distribution, seen: pd.DataFrame, start: list[float] | None
    ) -> None:
        if seen is self._seen:  # and not of events that count no more
            self.species, self.start = found, start
            self._draw_species()

    def species_curve(self) -> tuple[Any, Any] | None:
        """Give the curve of the species, per bar of the histogram."""
        if self.species is None or self.histogram is None:
            return None
        curves = self.species.curves
        return curves["mass_kda"].to_numpy(), curves["model"].to_numpy() * self.histogram.bin_kda

    def _draw_species(self) -> None:
        found = self.species_curve()
        if found is None or self.species is None:
            self._species_curve.data = self._handles.data = {"x": [], "y": []}
            self._species_table.object = ""
            return
        self._species_curve.data = {"x": found[0], "y": found[1]}
        means = self.species.species["mass_kda"].dropna().to_numpy(float)
        self._handles.data = {"x": means, "y": np.interp(means, *found)}
        rows = ui.listing(self.species.species.to_dict("records"), *_SPECIES)
        self._species_table.object = rows + ui.lines(f"{note}." for note in self.species.notes)

    # ---- single events ----------------------------------------------------------------------

    def _bar_clicked(self, _attr: str, _old: Any, new: list[int]) -> None:
        if self.histogram is None or not new:
            return
        edges, mass = self.histogram.edges, self.masses()
        inside = np.zeros(mass.size, dtype=bool)
        for bar in (b for b in new if b < self.histogram.counts.size):
            inside |= (mass >= edges[bar]) & (mass < edges[bar + 1])
        self._events.selected.indices = np.flatnonzero(inside).tolist()

    def _select(self, low: float, high: float) -> None:
        """Select the events between two masses, as a click on their bars would."""
        mass = self.masses()
        self._events.selected.indices = np.flatnonzero((mass >= low) & (mass < high)).tolist()

    def _events_selected(self, _attr: str, _old: Any, new: list[int]) -> None:
        options = {
            f"{row['event']}: {row['mass_kda']:.1f} kDa, {row['status']}": int(row["event"])
            for row in self._seen.iloc[new].to_dict("records")
        }
        self.which.param.update(options=options, value=next(iter(options.values()), None))

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
        self._notice.work(
            "Drawing the event", lambda: _png(result, row), lambda png: self._take(png, event)
        )

    def _take(self, picture: bytes, event: int) -> None:
        if self.which.value == event:
            self._picture.object = picture

    def _reject(self) -> None:
        chosen = self._events.selected.indices
        if not chosen or self.rejections is None:
            raise DataError("Select events first: click a bar, or a dot.")
        self.rejections.reject(self._seen.iloc[chosen])
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

    def _list_rejected(self) -> None:
        rows = self.table[self.table["event"].isin(self.rejected)].to_dict("records")
        self.listed.options = {
            f"{r['event']}: {r['mass_kda']:.1f} kDa": int(r["event"]) for r in rows
        }


def _png(result: ia.StoredResult, row: int) -> bytes:
    """Draw an event."""
    buffer = io.BytesIO()
    result.view(row).savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()
