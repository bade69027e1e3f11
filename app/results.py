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
from bokeh.models import BoxAnnotation, BoxSelectTool, ColumnDataSource, PointDrawTool, TapTool
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_analysis.answers.gates import (
    Gate,
    MassHistogram,
    counted_events,
    counted_rows,
    gate,
    mass_histogram,
    usual_bin,
)
from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.species.describe import Branch
from iscat_analysis.species.tables import EventTable
from iscat_app.chosen import Chosen, Notice, in_line, link_to, masses_in, table_of

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


_BLUE, _GREY, _RED = "#0072B2", "#8A8F96", "#D55E00"
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
_GATE_HEAD = (
    "gate [kDa]",
    "events",
    "95 %",
    "mean [kDa]",
    "± SE",
    "width [kDa]",
    "fraction",
    "95 %",
)
_SPECIES_HEAD = ("species [kDa]", "95 %", "width [kDa]", "events", "fraction", "95 %")


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
        self._bars = ColumnDataSource({"left": [], "right": [], "top": []})
        self._curve = ColumnDataSource({"x": [], "y": []})
        self._species_curve = ColumnDataSource({"x": [], "y": []})
        self._handles = ColumnDataSource({"x": [], "y": []})
        self._events = ColumnDataSource(
            {name: [] for name in ("x", "y", "frame", "mass", "event", "colour")}
        )
        self._hist = figure(
            width=620, height=330, tools="xwheel_zoom,xpan,reset,save", x_axis_label="|mass| [kDa]",
            y_axis_label="events", active_drag=None,
        )  # fmt: skip
        bars = self._hist.quad(
            left="left", right="right", top="top", bottom=0, source=self._bars, color=_GREY,
            alpha=0.5, line_color="white", selection_color=_BLUE, nonselection_alpha=0.35,
        )  # fmt: skip
        self._hist.line("x", "y", source=self._curve, color=_BLUE, legend_label="kernel density")
        self._hist.line(
            "x", "y", source=self._species_curve, color=_RED, line_width=2, legend_label="species"
        )
        handles = self._hist.scatter(
            "x", "y", source=self._handles, size=14, marker="diamond", color=_RED,
            line_color="white", nonselection_alpha=1,
        )  # fmt: skip
        self._hist.add_tools(
            PointDrawTool(renderers=[handles], description="move, add or remove species")
        )
        self._hist.toolbar.logo = None
        legend = self._hist.legend[0]
        legend.update(orientation="horizontal", border_line_color=None, padding=2)
        self._hist.add_layout(legend, "above")
        gate_tool = BoxSelectTool(dimensions="width", renderers=[], description="drag a gate")
        self._hist.add_tools(gate_tool, TapTool(renderers=[bars]))
        self._hist.toolbar.active_drag = gate_tool
        self._hist.on_event(SelectionGeometry, self._dragged)
        self._hist.y_range.start = 0
        self._bars.selected.on_change("indices", self._bar_clicked)
        self._map = figure(
            width=310, height=300, tools="pan,wheel_zoom,box_select,tap,reset",
            x_axis_label="x [px]", y_axis_label="y [px]", match_aspect=True,
        )  # fmt: skip
        self._map.y_range.flipped = True
        self._course = figure(
            width=310, height=300, tools="pan,wheel_zoom,box_select,tap,reset",
            x_axis_label="frame", y_axis_label="mass [kDa]",
        )  # fmt: skip
        self._map.toolbar.logo = self._course.toolbar.logo = None
        for plot, x, y in ((self._map, "x", "y"), (self._course, "frame", "mass")):
            plot.scatter(
                x, y, source=self._events, size=6, color="colour", selection_line_color="black",
                nonselection_alpha=0.25,
            )  # fmt: skip
        self._events.selected.on_change("indices", self._events_selected)

    def _make_widgets(self) -> None:
        self.bin = pn.widgets.FloatInput(
            label="Bar width [kDa]", value=10.0, start=0.01, step=1.0, width=110
        )
        self.kernel = pn.widgets.FloatInput(
            label="Kernel [kDa]", value=10.0, start=0.01, step=1.0, width=110
        )
        self.branch = pn.widgets.Select(label="Events", options=[*_BRANCHES], width=190)
        self.flagged = pn.widgets.Checkbox(label="flagged too")
        self.find = pn.widgets.Button(label="Find the species", width=140)
        self.refit = pn.widgets.Button(label="Fit again from the diamonds", width=210)
        self.begin = pn.widgets.TextInput(
            label="Species begin at [kDa]", placeholder="66, 146", width=300
        )
        self.low = pn.widgets.FloatInput(label="Gate from [kDa]", value=0.0, width=100)
        self.high = pn.widgets.FloatInput(label="to [kDa]", value=100.0, width=100)
        add = pn.widgets.Button(label="Add the gate", width=100)
        drop = pn.widgets.Button(label="Remove all gates", width=125)
        pick = pn.widgets.Button(label="Select its events", width=120)
        self._report = pn.pane.HTML("")
        self._gate_table = pn.pane.HTML("", sizing_mode="stretch_width")
        self._species_table = pn.pane.HTML("", sizing_mode="stretch_width")
        self.which = pn.widgets.Select(label="Selected events", options=[], size=7, width=230)
        self._facts = pn.pane.HTML("", width=300)
        self._picture = pn.pane.PNG(
            None, width=560, alt_text="data, model and residual of the event"
        )
        reject = pn.widgets.Button(label="Reject the selected events", width=190)
        self.listed = pn.widgets.Select(label="Rejected by hand", options=[], size=5, width=230)
        back = pn.widgets.Button(label="Take the event back", width=160)
        for widget in (self.bin, self.kernel, self.branch, self.flagged):
            widget.param.watch(lambda _: self._draw(), "value")
        self.begin.param.watch(self._begin_typed, "value")
        self._handles.on_change("data", self._write_means)
        self.find.on_click(lambda _: self._find_species(None))
        self.refit.on_click(lambda _: self._find_species(self._means()))
        add.on_click(lambda _: self._add_gate(*self._ends()))
        pick.on_click(lambda _: self._select(*self._ends()))
        drop.on_click(lambda _: self._set_gates([]))
        reject.on_click(self._reject)
        back.on_click(self._take_back)
        self.which.param.watch(self._show_event, "value")
        self.body = pn.Column(
            self._notice.pane,
            in_line(self.bin, self.kernel, self.branch, self.flagged, self.find, self._report),
            pn.FlexBox(
                pn.Column(
                    pn.pane.Bokeh(self._hist),
                    pn.pane.HTML(_HINT),
                    in_line(self.low, self.high, add, pick, drop),
                    in_line(self.begin, self.refit),
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
            place = {
                "x": "x_px",
                "y": "y_px",
                "frame": "frame",
                "mass": "mass_kda",
                "event": "event",
            }
            data = {name: self._seen[column].to_numpy() for name, column in place.items()}
            data["colour"] = np.where(self._seen["status"] == "ok", _BLUE, "#E69F00")
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
        boxes = [
            BoxAnnotation(left=g.low_kda, right=g.high_kda, fill_alpha=0.12, fill_color=_BLUE)
            for g in self.gates
        ]
        self._hist.center = [*kept, *boxes]
        rows = [
            (
                f"{g.low_kda:g} to {g.high_kda:g}", str(g.count),
                f"{g.count_low:.1f} to {g.count_high:.1f}", f"{g.mean_kda:.2f}", f"{g.mean_se:.2f}",
                f"{g.width_kda:.2f}", f"{g.fraction:.1%}",
                f"{g.fraction_low:.1%} to {g.fraction_high:.1%}",
            )
            for g in self.gates
        ]  # fmt: skip
        self._gate_table.object = table_of(rows, _GATE_HEAD) if rows else ""

    # ---- species ----------------------------------------------------------------------------

    def _means(self) -> list[float]:
        """Give the masses at which somebody left the diamonds."""
        return sorted({round(float(x), 2) for x in self._handles.data["x"] if x > 0})

    def _write_means(self, attr: str, old: Any, new: Any) -> None:
        del attr, old, new
        self.begin.value = ", ".join(f"{mass:g}" for mass in self._means())

    def _begin_typed(self, event: Any) -> None:
        """Put the diamonds where somebody writes."""
        with self._notice.told():
            masses = sorted(masses_in(event.new))
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
            with self._notice.told():
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
        rows = [
            (
                f"{s['mass_kda']:.1f}", f"{s['mass_low']:.1f} to {s['mass_high']:.1f}",
                f"{s['width_kda']:.1f}", f"{s['count']:.1f}", f"{s['fraction']:.1%}",
                f"{s['fraction_low']:.1%} to {s['fraction_high']:.1%}",
            )
            for s in self.species.species.to_dict("records")
        ]  # fmt: skip
        notes = [(f"{note}.",) for note in self.species.notes]
        self._species_table.object = table_of(rows, _SPECIES_HEAD) + table_of(notes)

    # ---- single events ----------------------------------------------------------------------

    def _bar_clicked(self, attr: str, old: Any, new: list[int]) -> None:
        del attr, old
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

    def _events_selected(self, attr: str, old: Any, new: list[int]) -> None:
        del attr, old
        options = {
            f"{row['event']}: {row['mass_kda']:.1f} kDa, {row['status']}": int(row["event"])
            for row in self._seen.iloc[new].to_dict("records")
        }
        self.which.param.update(options=options, value=next(iter(options.values()), None))

    def _show_event(self, event: Any) -> None:
        """Show the numbers of an event, and then its pictures, which are made of the movie."""
        result, number = self.result, event.new
        if result is None or number is None:
            self._facts.object, self._picture.object = "", None
            return
        row = int(np.flatnonzero(self.table["event"] == number)[0])
        self._facts.object = table_of(result.facts(row))
        # where the film goes, and what it rings
        self._chosen.param.update(frame=int(self.table["frame"].iloc[row]), event=int(number))
        self._notice.work(
            "Drawing the event", lambda: _png(result, row), lambda png: self._take(png, number)
        )

    def _take(self, picture: bytes, number: int) -> None:
        if self.which.value == number:
            self._picture.object = picture

    def _reject(self, _: Any) -> None:
        chosen = self._events.selected.indices
        if not chosen or self.rejections is None:
            self._notice.say("Select events first: click a bar, or a dot.")
            return
        with self._notice.told():
            self.rejections.reject(self._seen.iloc[chosen])
            self._rejected_anew()

    def _take_back(self, _: Any) -> None:
        if self.rejections is not None and self.listed.value is not None:
            with self._notice.told():
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
