"""What a notebook shows of a fit and of bounds: objects that print and draw themselves."""

from __future__ import annotations

import html
import math
import textwrap
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from matplotlib.figure import Figure

from iscat_analysis.bounds import parse_scan, scan
from iscat_analysis.config import Config
from iscat_analysis.findings import Finding
from iscat_analysis.records import (
    BUDGET_COLUMNS,
    FREE_PARAMETERS,
    Analysis,
    EventView,
    FloatArray,
    Progress,
    silent,
    tally,
)
from iscat_analysis.report import write_report
from iscat_analysis.report.answer import (
    as_contrasts,
    caution,
    headline,
    label_of,
    main_quantity,
    precision_of,
    tracks_of,
)
from iscat_analysis.report.exchange import to_napari, to_trackpy
from iscat_analysis.report.figures import draw, draw_corner, draw_view, posterior_of, view_of
from iscat_analysis.report.numbers import UNITS, number
from iscat_analysis.report.tables import event_table, posterior_groups
from iscat_analysis.text import in_page
from iscat_analysis.units import count

if TYPE_CHECKING:
    from arviz import InferenceData

ROWS_SHOWN = 20
"""Events that a `Result` shows of itself in a notebook."""

_COLUMNS = ("event", "frame", "x_px", "y_px", "z_nm", "mass_kda")
_TRACK_COLUMNS = (
    "track", "first_frame", "last_frame", "n_frames", "mass_kda", "sigma_mass_kda", "crb_mass_kda",
    "d_um2_s", "sigma_d_um2_s", "crb_d_um2_s", "diameter_nm", "sigma_diameter_nm",
)  # fmt: skip


@dataclass(frozen=True, repr=False)
class Result:
    """What a fit found; shows itself in a notebook.

    Attributes
    ----------
    analysis : Analysis
        Everything, as the stages know it.
    """

    analysis: Analysis

    @property
    def table(self) -> pd.DataFrame:
        """One row per event, the columns of ``fits.csv``, which carry their units."""
        return self.analysis.table

    @property
    def tracks(self) -> pd.DataFrame:
        """Mode ``track``: one row per track, the columns of ``tracks.csv``; else empty."""
        return tracks_of(self.analysis)

    @property
    def summary(self) -> Mapping[str, Any]:
        """Counts, medians, efficiency and provenance, as in ``summary.json``."""
        return self.analysis.summary

    @property
    def budget(self) -> pd.DataFrame:
        """What the error of a mass is made of, one row per source, as in ``summary.json``.

        Columns `name`, `kind` (measured, learned or assumed), `common` (shared by all rows: these
        add up to ``systematic_mass_kda``), `sigma_mass_kda` [kDa], `sigma_rel`, `dof`, `remedy`;
        medians over the rows that are ok.  Empty where no masses are fitted.
        """
        return pd.DataFrame(self.summary.get("budget", ()), columns=list(BUDGET_COLUMNS))

    @property
    def mode(self) -> str:
        """What was free: ``"mass"``, ``"localize"``, ``"joint"`` or ``"track"``."""
        return self.analysis.mode

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the user should know, each with a code, a severity, its values and a remedy."""
        return self.analysis.findings

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are more than a note."""
        return self.analysis.warnings

    @property
    def config_toml(self) -> str:
        """The resolved configuration, which reruns the job."""
        return self.analysis.config_toml

    def __len__(self) -> int:
        return len(self.analysis.table)

    def images(self, event: int) -> EventView:
        """Give the images of one event.

        Parameters
        ----------
        event : int
            Its number in the table.

        Returns
        -------
        EventView
            `contrast`, `model` and `residual`, each of shape (y, x); of landing movies `trace`, the
            contrast of every frame around the step, and of the first events `clip`.

        Raises
        ------
        DataError
            There is no such event.
        """
        return view_of(self.analysis, event)

    def view(self, event: int) -> Figure:
        """Draw data, model and residual of one event; of landing movies its trace too.

        Parameters
        ----------
        event : int
            Its number in the table.

        Returns
        -------
        matplotlib.figure.Figure
            Three panels, and below them the contrast against frame where there is a trace.

        Raises
        ------
        DataError
            There is no such event.
        """
        view = view_of(self.analysis, event)
        return draw_view(view, self.analysis.scheme, self.analysis.pixel_size_nm)

    def overview(self) -> Figure:
        """Draw the field of view, its events numbered.

        Returns
        -------
        Figure
            Image with a ring for each event.
        """
        return draw(self.analysis, "overview")

    def histogram(self) -> Figure:
        """Draw the histogram of the masses [kDa]; of the heights [nm] where the mass is fixed.

        Returns
        -------
        Figure
            Histogram of all events that are ok.
        """
        return draw(self.analysis, "histogram")

    def precision(self) -> Figure:
        """Draw each event's σ and QCRB against its CRB, for every free parameter.

        Returns
        -------
        Figure
            One panel for each free parameter.
        """
        return draw(self.analysis, "precision")

    def corner(self, event: int) -> Figure:
        """Draw the posterior of one event.

        Parameters
        ----------
        event : int
            Its number in the table.

        Returns
        -------
        matplotlib.figure.Figure
            A corner plot.

        Raises
        ------
        DataError
            There is no such event, it was not sampled, or its chain did not converge.
        """
        return draw_corner(self.analysis, event)

    def posterior(self, event: int) -> InferenceData:
        """Give the posterior samples of one event.

        Parameters
        ----------
        event : int
            Its number in the table.

        Returns
        -------
        arviz.InferenceData
            Group `posterior` with one variable (chain, draw) for each free parameter [nm, kDa], and
            `sample_stats` with the log-likelihood.

        Raises
        ------
        DataError
            There is no such event, it was not sampled, or its chain did not converge.
        """
        posterior_of(self.analysis, event)
        with warnings.catch_warnings():
            # ArviZ announces its next major version on import, once a day.
            warnings.simplefilter("ignore", FutureWarning)
            import arviz
        groups = posterior_groups(self.analysis, [view_of(self.analysis, event)])
        return arviz.InferenceData(**{name: group.isel(event=0) for name, group in groups.items()})

    def trackpy(self) -> pd.DataFrame:
        """Mode ``track``: the tracks in trackpy's layout; see `to_trackpy`.

        Returns
        -------
        DataFrame
            One row for each position of a track.
        """
        return to_trackpy(self.table)

    def napari(self) -> FloatArray:
        """Mode ``track``: the tracks as an array (track, t, y, x); see `to_napari`.

        Returns
        -------
        ndarray, shape (n, 4)
            One row for each position of a track.
        """
        return to_napari(self.table)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the report, the tables and the figures into a folder.

        Parameters
        ----------
        folder : str or Path
            Appears complete or not at all.
        overwrite : bool
            Replace an earlier result.

        Returns
        -------
        Path
            The folder; ``report.html`` is in it.

        Raises
        ------
        DataError
            The folder holds something already, or cannot be written.
        """
        return write_report(self.analysis, Path(folder), overwrite=overwrite)

    def _heading(self) -> str:
        analysis = self.analysis
        name = Path(analysis.provenance.input_path).name or "movie"
        found = count(tally(analysis.table).number, "event")
        if analysis.tracks is not None:
            found = f"{count(len(self.tracks), 'track')} of {count(len(self), 'position')}"
        return f"{found} in {name}, mode {analysis.mode}"

    def _facts(self) -> list[tuple[str, str]]:
        table, tracked = event_table(self.analysis), self.analysis.tracks is not None
        facts = [("", text) for text in headline(self.analysis, table)] if len(self) else []
        rows = tally(self.tracks if tracked else table)
        facts.append(("status", rows.text("track" if tracked else "event")))
        for name in FREE_PARAMETERS[self.mode] if caution(table) is None else ():
            p = precision_of(self.analysis, table, name)
            if p.events:
                text = f"σ {number(p.sigma)}{p.shared}, CRB {number(p.crb)}"
                text += f", Holevo {number(p.holevo)}" if math.isfinite(p.holevo) else ""
                text += f", QCRB {number(p.qcrb)}"
                facts.append((label_of(self.analysis, name), f"{text} {UNITS[name]} (medians)"))
        return facts + [("warning", text) for text in self.warnings]

    def __repr__(self) -> str:
        lines = [
            line
            for name, text in self._facts()
            for line in textwrap.wrap(
                f"{name} {text}".strip(), 78, initial_indent="  ", subsequent_indent="    "
            )
        ]
        looks = ".view(0), .histogram(), .posterior(0)"
        if self.analysis.tracks is not None:
            looks = ".tracks, .overview(), .view(0), .histogram()"
        hint = f"  look at .table, {looks}; keep with .save(folder)"
        return "\n".join([f"Result: {self._heading()}", *lines, hint])

    def _repr_html_(self) -> str:
        facts = "".join(
            f"<tr><th style='text-align:left'>{html.escape(in_page(name))}</th>"
            f"<td style='text-align:left'>{html.escape(in_page(text))}</td></tr>"
            for name, text in self._facts()
        )
        names = [*_COLUMNS, *(f"sigma_{name}" for name in FREE_PARAMETERS[self.mode]), "status"]
        listed = self.table
        if self.analysis.tracks is not None:
            names, listed = [*_TRACK_COLUMNS, "status"], self.tracks
        shown = listed.head(ROWS_SHOWN)
        if main_quantity(self.analysis).column == "contrast":
            shown = as_contrasts(shown)
        shown = shown[names]
        if main_quantity(self.analysis).column == "contrast":
            new = {"mass_kda": "contrast", "sigma_mass_kda": "sigma_contrast"}
            shown = shown.rename(columns=new)
        rest = len(listed) - len(shown)
        where = ".table" if listed is self.table else ".tracks"
        more = f"<p>… and {rest} more in <code>{where}</code></p>" if rest else ""
        body = shown.to_html(index=False, float_format="{:.4g}".format, border=0, escape=True)
        return (
            f"<p><b>{html.escape(in_page(self._heading()))}</b></p><table>{facts}</table>"
            f"{body if len(listed) else ''}{more}"
        )


@dataclass(frozen=True, repr=False)
class Bounds:
    """Bounds of a planned experiment; shows itself in a notebook.

    Attributes
    ----------
    config : Config
        The experiment.
    report : mapping
        Everything, as `iscat bounds --json` prints it.
    """

    config: Config
    report: Mapping[str, Any]

    @property
    def actual(self) -> pd.DataFrame:
        """Bounds for the planned frames [nm, kDa]: one row per parameter, one column per kind."""
        return self._frame("actual")

    @property
    def per_photon(self) -> pd.DataFrame:
        """Bounds for one scattered photon, on the camera (CRB) or collected [nm, relative]."""
        return self._frame("per_photon")

    def scan(self, values: str, *, progress: Progress = silent) -> pd.DataFrame:
        """Vary one thing and compute the bounds at each step.

        Parameters
        ----------
        values : str
            ``"axis=start:stop:step"``, as in ``"focus=-1000:1000:50"``.
        progress : Progress
            Told after each step.

        Returns
        -------
        pandas.DataFrame
            One row per value, the axis first, then bounds [nm, kDa] and photon numbers.

        Raises
        ------
        ConfigError
            There is no such axis (the known ones are named), or a value is impossible.
        """
        axis, points = parse_scan(values)
        return scan(self.config, axis, points, progress=progress).table

    def _frame(self, which: str) -> pd.DataFrame:
        kinds: Mapping[str, Mapping[str, float]] = self.report[which]
        return pd.DataFrame({kind: dict(values) for kind, values in kinds.items()})

    def _heading(self) -> str:
        at, photons = self.report["at"], self.report["n_scattered"]
        return (
            f"{at['mass_kda']:.4g} kDa at z = {at['z_nm']:g} nm, {at['scheme']}, "
            f"{at['n_after']} frames, {photons['collected']:.4g} scattered photons collected"
        )

    def __repr__(self) -> str:
        text: str = self.actual.to_string(float_format="{:.4g}".format, na_rep="–")
        return f"Bounds: {self._heading()}\n{text}"

    def _repr_html_(self) -> str:
        body = self.actual.to_html(float_format="{:.4g}".format, na_rep="–", border=0)
        return f"<p><b>{html.escape(in_page(self._heading()))}</b></p>{body}"
