"""What a result offers, in memory or from its folder; and a folder whose movie is read again."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from iscat_analysis.config import Config, load_config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import KINDS, Finding
from iscat_analysis.inference.checks import path_in
from iscat_analysis.movie import Stack, open_stack, split_address
from iscat_analysis.pipeline.kinds import Redraw, kind_of
from iscat_analysis.reading import read_json, read_parquet
from iscat_analysis.records import (
    BUDGET_COLUMNS,
    FREE_PARAMETERS,
    PARAMETERS,
    Analysis,
    EventView,
    Provenance,
    Status,
    counted,
    tally,
)
from iscat_analysis.report import answer
from iscat_analysis.report.numbers import LABELS, UNITS, number
from iscat_analysis.report.tables import event_table
from iscat_analysis.text import in_page
from iscat_analysis.units import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from iscat_analysis.report.plots import Panels
    from iscat_analysis.report.vega import VegaFigure

SHOWN_FRAMES = 12
"""Frames around its own in which an event of a landing movie is marked in a film."""


class MovieResult:
    """What was found in a movie: tables, the answer and figures, in memory or from a folder.

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
    def events(self) -> pd.DataFrame:
        """The rows of `table` that are counted as events: no side lobes of others."""
        return counted(self.table)

    @property
    def tracks(self) -> pd.DataFrame:
        """Mode ``track``: one row per track, the columns of ``tracks.csv``; else empty."""
        return answer.tracks_of(self.analysis)

    @property
    def species(self) -> pd.DataFrame:
        """One row per species, the lightest first; empty where there are none.

        Columns `mass_kda` (or `contrast`, without a scale of masses, or `diameter_nm` of spheres),
        ``sigma_…`` and ``systematic_…`` of it, `count`, `share` with `share_low` and `share_high`
        (95 %), `landing`, `leaving`.
        """
        return answer.species_of(self.analysis)

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
        return len(self.table)

    def images(self, row: int) -> EventView:
        """Give the images of an event."""
        raise NotImplementedError

    def facts(self, row: int) -> list[tuple[str, str]]:
        """Say in words what was found of a row of the table.

        Parameters
        ----------
        row : int
            Position in the table.

        Returns
        -------
        list of (str, str)
            What is told, and its value with error, bound and unit.
        """
        facts = event_facts(self.table.iloc[row])
        unscaled = answer.is_uncalibrated(self.analysis)
        return [fact for fact in facts if not (unscaled and fact[0] == LABELS["mass_kda"])]

    # ---- Figures -----------------------------------------------------------------------------

    def plot_masses(self, *, ax: Axes | None = None, bins: int | ArrayLike | None = None) -> Axes:
        """Draw the histogram of masses, landings and leavings by magnitude, and the species.

        Without a scale of masses it is of contrasts, of spheres of diameters [nm], and of heights
        [nm] where the mass is fixed.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a figure that shows itself in a notebook.
        bins : int or array_like, optional
            Number of bins, or their edges; default two standard deviations wide.

        Returns
        -------
        matplotlib.axes.Axes
            What was drawn into.

        Raises
        ------
        DataError
            No event was found.
        """
        from iscat_analysis.report import plots

        return plots.plot_masses(self.analysis, ax=ax, bins=bins)

    def plot_precision(self, *, ax: Any = None) -> Panels:
        """Draw each event's σ and QCRB against its CRB, for every free parameter.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            One axes for each free parameter, or one for the mass, or else the height.

        Returns
        -------
        ndarray of matplotlib.axes.Axes
            What was drawn into.

        Raises
        ------
        DataError
            No event was found.
        ConfigError
            The number of axes is another one.
        """
        from iscat_analysis.report import plots

        return plots.plot_precision(self.analysis, ax=ax)

    def plot_field(self, *, ax: Axes | None = None) -> Axes:
        """Draw the field of view with its events numbered, or the paths of its tracks.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a figure that shows itself in a notebook.

        Returns
        -------
        matplotlib.axes.Axes
            What was drawn into.
        """
        from iscat_analysis.report import plots

        return plots.plot_field(self.analysis, ax=ax)

    def plot_tracks(self, *, ax: Axes | None = None) -> Axes:
        """Draw mass, or contrast, and diffusion coefficient of every track.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a figure that shows itself in a notebook.

        Returns
        -------
        matplotlib.axes.Axes
            What was drawn into.

        Raises
        ------
        DataError
            There are no tracks with both.
        """
        from iscat_analysis.report import plots

        return plots.plot_tracks(self.analysis, ax=ax)

    def plot_event(self, row: int, *, ax: Any = None) -> Panels:
        """Draw data, model and residual of an event; of landing movies its trace too.

        Parameters
        ----------
        row : int
            As for `images`.
        ax : sequence of Axes, optional
            Three, or four, of which the last takes the contrast against frame.

        Returns
        -------
        ndarray of matplotlib.axes.Axes
            What was drawn into.

        Raises
        ------
        DataError, ConfigError
            As for `images`; or the number of axes is another one.
        """
        from iscat_analysis.report import plots

        analysis = self.analysis
        return plots.plot_event(self.images(row), analysis.scheme, analysis.pixel_size_nm, ax=ax)

    def view(self, row: int) -> Figure:
        """Draw data, model and residual of an event; of landing movies its trace too.

        Parameters
        ----------
        row : int
            As for `images`.

        Returns
        -------
        matplotlib.figure.Figure
            Three panels, and below them the contrast against frame where there is a trace.

        Raises
        ------
        DataError, ConfigError
            As for `images`.
        """
        return _figure(self.plot_event(row))

    def histogram(self, *, ax: Axes | None = None, bins: int | ArrayLike | None = None) -> Figure:
        """Give the figure of `plot_masses`.

        Parameters
        ----------
        ax, bins
            As for `plot_masses`.

        Returns
        -------
        matplotlib.figure.Figure
            It shows itself in a notebook.
        """
        return _figure(self.plot_masses(ax=ax, bins=bins))

    def overview(self) -> Figure:
        """Give the figure of `plot_field`.

        Returns
        -------
        matplotlib.figure.Figure
            It shows itself in a notebook.
        """
        return _figure(self.plot_field())

    def precision(self) -> Figure:
        """Give the figure of `plot_precision`.

        Returns
        -------
        matplotlib.figure.Figure
            It shows itself in a notebook.
        """
        return _figure(self.plot_precision())

    def figure(self, name: str) -> VegaFigure:
        """Give a figure of the result page: its data and its Vega-Lite specification.

        Parameters
        ----------
        name : str
            As ``"masses"``.

        Returns
        -------
        VegaFigure
            A notebook draws it, and it can be saved.

        Raises
        ------
        ConfigError
            There is no such figure; the known ones are named.
        """
        known = self._page_figures()
        if name not in known:
            raise ConfigError(f"there is no figure {name!r}; known: {', '.join(sorted(known))}")
        return known[name]

    def _page_figures(self) -> dict[str, VegaFigure]:
        from iscat_analysis.report.movie_figures import movie_figures

        return movie_figures(self.analysis)

    def write_figures(
        self, folder: str | Path, *, formats: tuple[str, ...] = ("png", "svg")
    ) -> list[Path]:
        """Write the figures of papers, with the images of the first events.

        Parameters
        ----------
        folder : str or Path
            Made if it is not there.
        formats : tuple of str
            Some of ``png``, ``svg``, ``pdf``.

        Returns
        -------
        list of Path
            The files.
        """
        from iscat_analysis.report import plots

        return plots.write_figures(self.analysis, path_in("`folder`", folder), formats)

    # ---- What it shows of itself ---------------------------------------------------------------

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        known = [each for each in dir(type(self)) if not each.startswith("_")]
        near = get_close_matches(name, known, 3, 0.5) or [n for n in known if name in n]
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise AttributeError(f"a {type(self).__name__} has no {name!r}{hint}")

    def _heading(self) -> str:
        analysis = self.analysis
        name = Path(analysis.provenance.input_path).name or "movie"
        found = count(tally(analysis.table).number, "event")
        if analysis.tracks is not None:
            found = f"{count(len(self.tracks), 'track')} of {count(len(self), 'position')}"
        return f"{found} in {name}, mode {analysis.mode}"

    def _precision(self) -> list[str]:
        """Say how large the errors are, of each parameter that is free."""
        table, lines = event_table(self.analysis), []
        for name in FREE_PARAMETERS[self.mode] if answer.caution(table) is None else ():
            p = answer.precision_of(self.analysis, table, name)
            if p.events and not (name == "mass_kda" and answer.is_uncalibrated(self.analysis)):
                text = f"σ {number(p.sigma)}{p.shared}, CRB {number(p.crb)}"
                text += f", Holevo {number(p.holevo)}" if math.isfinite(p.holevo) else ""
                text += f", QCRB {number(p.qcrb)} {UNITS[name]} (medians)"
                lines.append(f"{answer.label_of(self.analysis, name)}: {text}")
        return lines

    def __repr__(self) -> str:
        said = answer.spoken(self.analysis)
        wrap = textwrap.TextWrapper(78, initial_indent="  ", subsequent_indent="    ").wrap
        rows = [[column.label for column in said.species.columns], *said.species.rows]
        wide = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
        lines = [
            "  " + "  ".join(cell.rjust(n) for cell, n in zip(row, wide, strict=True))
            for row in rows
            if row
        ]
        told = [*said.facts, said.totals, *said.cautions, *self._precision()]
        more = [f"warning: {text}" for text in self.warnings]
        hint = "look at .species, .table, .plot_masses(), .plot_field(), .plot_event(0)"
        if self.analysis.tracks is not None:
            hint = "look at .tracks, .plot_tracks(), .plot_masses(), .plot_field()"
        lines += [line for text in told + more for line in wrap(text)]
        lines = [f"{type(self).__name__}: {self._heading()}", *lines]
        if len(lines) > ROWS_SHOWN - 2:
            lines = [*lines[: ROWS_SHOWN - 2], "  … and more in .findings"]
        return "\n".join([*lines, *wrap(hint)])

    def _repr_html_(self) -> str:
        said = answer.spoken(self.analysis)
        species = pd.DataFrame(
            said.species.rows, columns=[column.label for column in said.species.columns]
        )
        told = [*said.facts, said.totals, *said.cautions, *self._precision(), *self.warnings]
        lines = "".join(f"<p>{html.escape(in_page(text))}</p>" for text in told)
        body = species.to_html(index=False, border=0, escape=True) if len(species) else ""
        return f"<p><b>{html.escape(in_page(self._heading()))}</b></p>{body}{lines}"


ROWS_SHOWN = 20
"""Lines that a result shows of itself."""


def _figure(drawn: Axes | Panels) -> Figure:
    from iscat_analysis.report.plots import figure_of

    return figure_of(drawn)


def event_facts(row: pd.Series[Any]) -> list[tuple[str, str]]:
    """Say in words what was found of an event: its numbers, with errors and bounds."""
    name, number = "event", row["event"]
    if "track" in row and pd.notna(row["track"]):
        name, number = "track", int(row["track"])
    when = "leaves at frame" if row["mass_kda"] < 0 else "frame"
    facts = [(name, f"{number}, {when} {row['frame']}")]
    for key in (PARAMETERS[-1], *PARAMETERS[:-1]):
        if not np.isfinite(row[key]):
            continue
        sigma, bound = row[f"sigma_{key}"], row[f"crb_{key}"]
        error = f" ± {sigma:.1f}" if np.isfinite(sigma) else ""
        beside = f" (CRB {bound:.1f})" if np.isfinite(bound) else ""
        facts.append((LABELS[key], f"{row[key]:.1f}{error} {UNITS[key]}{beside}"))
    status = Status(row["status"])
    facts.append(("contrast", f"{100 * row['contrast']:.3f} %, SNR {row['snr']:.1f}"))
    return [*facts, ("status", f"{status.value}: {status.advice}")]


def open_result(folder: str | Path, *, movie: str | Path | None = None) -> StoredResult:
    """Open the output folder of `fit_movie` or ``iscat fit``.

    Parameters
    ----------
    folder : str or Path
        The folder.
    movie : str or Path, optional
        The movie that was analysed, for the images of its events; default where the folder says,
        or beside the folder.

    Returns
    -------
    StoredResult
        Its tables and configuration; it opens the movie when images are asked for.

    Raises
    ------
    DataError
        The folder holds no result.
    ConfigError
        Its configuration is not one of this version.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> with ia.open_result("movie.iscat") as result:  # doctest: +SKIP
    ...     figure = result.view(0)
    """
    return StoredResult(
        path_in("`folder`", folder), None if movie is None else path_in("`movie`", movie)
    )


class StoredResult(MovieResult):
    """A result that was written before; `open_result` makes it.

    Parameters
    ----------
    folder : Path
        The output folder.
    movie : Path, optional
        The movie that was analysed.

    Attributes
    ----------
    folder : Path
        The output folder.
    analysis : Analysis
        What the folder says, without images.
    config : Config
        ``config.toml``, the resolved configuration.

    Raises
    ------
    DataError
        The folder holds no result.
    """

    def __init__(self, folder: Path, movie: Path | None = None) -> None:
        self.folder = folder
        self._movie = movie
        try:
            table: pd.DataFrame = read_parquet(folder / "fits.parquet")
            summary: Mapping[str, Any] = read_json(folder / "summary.json")
            tracked = folder / "tracks.parquet"
            tracks = read_parquet(tracked) if tracked.is_file() else None
        except FileNotFoundError as error:
            missing = Path(error.filename).name if error.filename else "such file"
            raise DataError(
                f"{folder}: is no result of iscat fit (there is no {missing} in it)"
            ) from None
        except (OSError, ValueError) as error:
            raise DataError(f"{folder}: cannot be read as a result ({error})") from None
        self.config: Config = load_config(folder / "config.toml")
        nothing = np.zeros(0)
        try:
            source, versions = summary.get("input", {}), summary.get("versions", {})
            place = str(source.get("path", "")), str(source.get("sha256", ""))
            provenance = Provenance("", *place, versions, summary.get("seed"), "")
            mode, findings = str(summary["mode"]), tuple(_findings(summary))
        except (KeyError, TypeError, AttributeError) as error:
            raise DataError(
                f"{folder / 'summary.json'}: is no summary of this version ({error!r}); analyse "
                "the movie again"
            ) from None
        self.analysis = Analysis(
            config_toml=(folder / "config.toml").read_text(encoding="utf-8"),
            mode=mode,
            scheme=self.config.optics.scheme,
            pixel_size_nm=float(self.config.camera.pixel_size_nm or 0.0),
            table=table,
            views=(),
            ratio_image=nothing,
            power=nothing,
            power_frames=nothing.astype(np.int64),
            summary=summary,
            provenance=provenance,
            findings=findings,
            tracks=tracks,
        )

    def __enter__(self) -> StoredResult:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def movie_path(self) -> Path:
        """The movie: as it was given, where the result says, or beside the folder.

        Raises
        ------
        DataError
            It is at none of these places.
        """
        recorded = Path(self.summary["input"]["path"])
        given = [] if self._movie is None else [self._movie]
        for path in given or [recorded, self.folder.parent / recorded.name]:
            if split_address(path)[0].exists():
                return path
        raise DataError(
            f"{self.folder}: its movie is neither {given[0] if given else recorded} nor beside it; "
            "give the place of the movie"
        )

    @cached_property
    def _opened(self) -> tuple[Stack, Redraw]:
        movie = open_stack(self.movie_path)
        try:
            expected = self.summary["input"]["sha256"]
            if movie.sha256() != expected:
                raise DataError(
                    f"{movie.path}: is not the movie of {self.folder.name} (its SHA-256 differs "
                    f"from {expected[:12]}…); give the one that was analysed"
                )
            ready = calibrated(movie, self.config).over_all_stretches()
            return movie, kind_of(ready.config).stored(ready, self)
        except BaseException:
            movie.close()
            raise

    def images(self, row: int) -> EventView:
        """Give the images of a row of the table, made of the movie as they were for its fit.

        Parameters
        ----------
        row : int
            Position in the table; of a result without tracks that is the event's number.

        Returns
        -------
        EventView
            `contrast`, `model` and `residual`, each of shape (y, x).

        Raises
        ------
        DataError
            The movie is not there, or is another one; or the row has no place.
        ConfigError
            There is no such row.
        """
        if not 0 <= row < len(self):
            rows = f"rows 0 to {len(self) - 1}" if len(self) else "none, nothing was found"
            raise ConfigError(f"row = {row}: {self.folder.name} has {rows}")
        if not self.table[["x_px", "y_px", "mass_kda"]].iloc[row].notna().all():
            raise DataError(f"{self.folder.name}: row {row} has no place, so there is no image")
        return self._opened[1](row)

    def _page_figures(self) -> dict[str, VegaFigure]:
        from iscat_analysis.report.vega import figures_in

        return figures_in(self.folder / "report.html")

    def write_figures(
        self, folder: str | Path, *, formats: tuple[str, ...] = ("png", "svg")
    ) -> list[Path]:
        """Write the figures of papers; images of the first events only where the movie is there.

        Parameters
        ----------
        folder : str or Path
            Made if it is not there.
        formats : tuple of str
            Some of ``png``, ``svg``, ``pdf``.

        Returns
        -------
        list of Path
            The files.
        """
        from iscat_analysis.report import plots

        views = []
        with suppress(DataError):  # without the movie
            first = ~self.table["event"].duplicated() & self.table["x_px"].notna()
            rows = np.flatnonzero(first)[: plots.EVENT_FIGURES].tolist()
            views = [self.images(row) for row in rows]
        target = path_in("`folder`", folder)
        return plots.write_figures(self.analysis, target, formats, views=views)

    def close(self) -> None:
        """Release the movie, where it was opened; it is opened again when it is needed."""
        opened = self.__dict__.pop("_opened", None)
        if opened is not None:
            opened[0].close()


def _findings(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Make the findings of a summary again, as far as this version knows their codes."""
    for found in summary.get("findings", ()):  # earlier versions had none
        kind, values = KINDS.get(found["code"]), found["values"]
        if kind is not None and kind.names <= values.keys():
            frames = found["frames"] and (int(found["frames"][0]), int(found["frames"][1]))
            where, _, said = found["text"].rpartition(kind(values).text)
            yield kind(values, where="" if said else where.removesuffix(": "), frames=frames)
