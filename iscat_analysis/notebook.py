"""What a notebook user meets: a movie goes in, a `Result` comes out, prints and draws itself.

Each function is one call of the stages below with plain arguments: paths may be text, keys of the
configuration are given as a mapping.
"""

from __future__ import annotations

import html
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from iscat_analysis.answers.calibrations import optics_calibration
from iscat_analysis.bounds import bounds_report, parse_scan, scan
from iscat_analysis.bounds.shared import EVENTS, OpticsForecast
from iscat_analysis.bounds.shared import forecast_optics as _forecast
from iscat_analysis.config import LARGEST_NM, Config, Source, configure
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.executors import THREADS, open_executor
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.checks import number_in, path_in, truth_in
from iscat_analysis.instrument.learning import calibrate_movie
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.movie import ArrayLike, open_stack
from iscat_analysis.pipeline import analyse
from iscat_analysis.pipeline.stored import MovieResult
from iscat_analysis.progress import automatic, told
from iscat_analysis.records import (
    Analysis,
    EventView,
    FloatArray,
    PosteriorResult,
    Progress,
    Status,
)
from iscat_analysis.report import check_output, write_report
from iscat_analysis.report.exchange import to_napari, to_trackpy
from iscat_analysis.report.tables import posterior_groups
from iscat_analysis.study.simulate import write_stack
from iscat_analysis.text import in_page

if TYPE_CHECKING:
    from arviz import InferenceData
    from matplotlib.figure import Figure

Settings = Mapping[str, Any] | Iterable[str]
"""Values of the configuration by key, or as ``"section.key = value"``."""


@dataclass(frozen=True, repr=False)
class Result(MovieResult):
    """What a fit found; shows itself in a notebook.

    Attributes
    ----------
    analysis : Analysis
        Everything, as the stages know it.
    """

    analysis: Analysis

    def images(self, row: int) -> EventView:
        """Give the images of one event.

        Parameters
        ----------
        row : int
            The event's number in the table.

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
        return _view_of(self.analysis, row)

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
        from iscat_analysis.report.plots import figure_of, plot_corner

        return figure_of(plot_corner(_posterior_of(self.analysis, event), event))

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
        _posterior_of(self.analysis, event)
        with warnings.catch_warnings():
            # ArviZ announces its next major version on import, once a day.
            warnings.simplefilter("ignore", FutureWarning)
            import arviz
        groups = posterior_groups(self.analysis, [_view_of(self.analysis, event)])
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

    def save(self, folder: str | Path, *, overwrite: bool = False, figures: bool = False) -> Path:
        """Write the report and the tables into a folder.

        Parameters
        ----------
        folder : str or Path
            Appears complete or not at all.
        overwrite : bool
            Replace an earlier result.
        figures : bool
            Draw the figures of `write_figures` into its folder ``figures`` as well.

        Returns
        -------
        Path
            The folder; ``report.html`` is in it.

        Raises
        ------
        DataError
            The folder holds something already, or cannot be written.
        """
        return write_report(self.analysis, Path(folder), overwrite=overwrite, figures=figures)


def _view_of(analysis: Analysis, event: int) -> EventView:
    """Find the images of one event."""
    if isinstance(event, bool) or not isinstance(event, (int, np.integer)):
        raise ConfigError(f"event = {event!r}: events have whole numbers, as in view(0)")
    for view in analysis.views:
        if view.event == event:
            return view
    known = [view.event for view in analysis.views]
    numbered = f"it has events {min(known)} to {max(known)}" if known else "no event was found"
    raise DataError(f"{_movie(analysis)}: there is no event {event}; {numbered}")


def _posterior_of(analysis: Analysis, event: int) -> PosteriorResult:
    """Find the converged chain of one event."""
    posterior = _view_of(analysis, event).posterior
    if posterior is None:
        status = analysis.table.loc[analysis.table["event"] == event, "status"].iloc[0]
        why = "" if status == Status.OK else f" (its fit is {status})"
        raise DataError(
            f"{_movie(analysis)}: the posterior of event {event} was not sampled{why}; "
            "fit again with posterior.enabled = true"
        )
    if not posterior.converged:
        raise DataError(
            f"{_movie(analysis)}: the chain of event {event} has not converged "
            f"({posterior.message}), so it is not a posterior; raise posterior.steps"
        )
    return posterior


def _movie(analysis: Analysis) -> str:
    return analysis.provenance.input_path or "the movie"


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

    @told
    def scan(self, values: str, *, progress: Progress = automatic) -> pd.DataFrame:
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


@told
def fit_movie(
    movie: str | Path | ArrayLike,
    *,
    name: str | None = None,
    config: Source | None = None,
    settings: Settings | None = None,
    mode: str | None = None,
    background: tuple[int, int] | None = None,
    frames: tuple[int, int] | None = None,
    pixel_size_nm: float | None = None,
    posterior: bool | None = None,
    workers: int | None = None,
    scheduler: str = THREADS,
    scheduler_file: str | Path | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    figures: bool = False,
    progress: Progress = automatic,
) -> Result:
    """Fit the particles of a movie; in memory, unless `out` names a folder.

    Parameters
    ----------
    movie : str, Path or array_like of shape (t, y, x)
        A file, or the camera's counts as an array of NumPy, Dask, Zarr or h5py; see `open_stack`.
    name : str, optional
        What messages and reports call an array; default ``"array"``.
    config : str, Path, mapping or Config, optional
        As for `configure`.
    settings : mapping of str to Any, or iterable of str, optional
        As for `configure`; they win over `config`, and the arguments below win over both.
    mode : str, optional
        ``"mass"`` (x, y, mass), ``"localize"`` (x, y, z), ``"joint"`` (x, y, z, mass) or
        ``"track"`` (particles that move: every frame, linked; `Result.tracks`).
    background : (int, int), optional
        Frames before the particles bound, ``[start, stop)``.
    frames : (int, int), optional
        Frames to fit, ``[start, stop)``; default all after the background.
    pixel_size_nm : float, optional
        In the sample plane [nm]; default as the movie's metadata say.
    posterior : bool, optional
        Sample the posterior of every event; default as configured.
    workers : int, optional
        Threads.
    scheduler : str
        Where the chunks of a landing movie are analysed: ``"threads"`` of this process, or the
        address of a Dask scheduler, as ``"tcp://10.0.0.1:8786"``, whose workers read the file by
        its path; the result is the same.
    scheduler_file : str or Path, optional
        File with that address, instead of `scheduler`.
    out : str or Path, optional
        Folder for the report and the tables; nothing is written without it.
    overwrite : bool
        Replace an earlier result in `out`.
    figures : bool
        Draw figures for papers into `out`, as `Result.save` does.
    progress : Progress
        Called with the stage and the steps done and in all; default bars with the time left where
        stderr is a terminal, a line in a notebook, and nothing elsewhere.

    Returns
    -------
    Result
        Table, figures, posteriors.

    Raises
    ------
    DataError
        The movie cannot be analysed, or `out` may not be written.
    ConfigError
        A setting is unknown or impossible, or does not suit the movie; the scheduler does not
        answer, a worker has other versions, or the movie is an array, which no worker can read.
    SchedulerError
        The scheduler went away.
    """
    given = {
        "mode": mode,
        "background": background,
        "frames": frames,
        "pixel_size_nm": pixel_size_nm,
        "posterior": posterior,
        "workers": workers,
    }
    resolved = _resolved(config, settings, given)
    overwrite = truth_in("`overwrite`", overwrite)
    folder = None if out is None else path_in("`out`", out)
    if folder is not None:
        check_output(folder, overwrite)
    with (
        open_stack(movie, name=name) as stack,
        open_executor(scheduler, scheduler_file) as executor,
    ):
        command = f"iscat_analysis.fit_movie({str(stack.path)!r})"
        run = Run(progress=progress, executor=executor)
        analysis = analyse(stack, resolved, run, command=command)
    result = Result(analysis)
    if folder is not None:
        result.save(folder, overwrite=overwrite, figures=truth_in("`figures`", figures))
    return result


@told
def calibrate_optics(
    movie: str | Path | ArrayLike,
    *,
    name: str | None = None,
    config: Source | None = None,
    settings: Settings | None = None,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = automatic,
) -> OpticsCalibration:
    """Learn the optics from a movie of particles; in memory, unless `out` names a folder.

    Parameters
    ----------
    movie : str, Path or array_like of shape (t, y, x)
        A landing movie, one with background frames, or a scan of the focus: a file, or the camera's
        counts as for `fit_movie`.
    name : str, optional
        What messages and the report call an array; default ``"array"``.
    config : str, Path, mapping or Config, optional
        As for `configure`: the microscope as far as it is known.
    settings : mapping of str to Any, or iterable of str, optional
        As for `configure`; they win over `config`.
    free : str or sequence of str, optional
        What may change, some of ``focus, na, phase, mask, zernike, polarization``; default all.
    focus_step_nm : float, optional
        The movie is a scan of immobile particles: rise of the focus from frame to frame [nm].
    out : str or Path, optional
        Folder for optics.toml, optics.json and optics.html.
    overwrite : bool
        Replace an earlier result in `out`.
    progress : Progress
        Called with the stage and the steps done and in all; default bars with the time left where
        stderr is a terminal, a line in a notebook, and nothing elsewhere.

    Returns
    -------
    OpticsCalibration
        Its `config` holds the measured optics, unless they are refused.

    Raises
    ------
    DataError
        The movie shows too few bright particles, or `out` may not be written.
    ConfigError
        A setting is unknown or impossible, or cannot be calibrated.
    """
    resolved = configure(config, settings=settings)
    overwrite = truth_in("`overwrite`", overwrite)
    if focus_step_nm is not None:
        number_in("`focus_step_nm`", focus_step_nm, least=-LARGEST_NM, most=LARGEST_NM)
    learned: Any = {"free": free, "focus_step_nm": focus_step_nm, "progress": progress}
    if out is not None:
        learned |= {"name": name, "overwrite": overwrite}
        return optics_calibration(movie, resolved, path_in("`out`", out), **learned)
    with open_stack(movie, name=name) as stack:
        return calibrate_movie(stack, resolved, **learned)


@told
def simulate_movie(
    config: Source,
    path: str | Path,
    *,
    seed: int | None = None,
    settings: Settings | None = None,
    overwrite: bool = False,
    progress: Progress = automatic,
) -> pd.DataFrame:
    """Write a shot-noise movie of particles whose position and mass are known.

    Parameters
    ----------
    config : str, Path, mapping or Config
        As for `configure`; its ``[simulation]`` says what is in the movie.
    path : str or Path
        The TIFF file; ``<stem>.truth.csv`` lands beside it.
    seed : int, optional
        In place of ``simulation.seed``; the same seed gives the same bytes.
    settings : mapping of str to Any, or iterable of str, optional
        As for `configure`.
    overwrite : bool
        Replace an existing file.
    progress : Progress
        Told how many frames are done.

    Returns
    -------
    pandas.DataFrame
        One row per particle: frames, position [px, nm], height [nm], mass [kDa], peak contrast.
        Of particles that move, one row for each frame in which they are in the field, averaged over
        its exposure, with `track`, `d_um2_s` [µm²/s] and the place in the middle of the exposure.

    Raises
    ------
    ConfigError
        A setting is unknown or impossible, or the counts do not fit into 16 bits.
    DataError
        The file exists, or cannot be written.
    """
    resolved = configure(config, settings=settings)
    if seed is not None:
        seed = int(number_in("`seed`", seed, least=0, whole=True))
    overwrite = truth_in("`overwrite`", overwrite)
    return write_stack(
        resolved, path_in("`path`", path), seed=seed, overwrite=overwrite, progress=progress
    )


def compute_bounds(
    config: Source | None = None, *, settings: Settings | None = None, mode: str | None = None
) -> Bounds:
    """Compute what no estimate from a planned experiment can beat.

    Parameters
    ----------
    config : str, Path, mapping or Config, optional
        As for `configure`; its ``[bounds]`` describes the experiment.
    settings : mapping of str to Any, or iterable of str, optional
        As for `configure`.
    mode : str, optional
        Which parameters are free in the joint bound; as for `fit_movie`.

    Returns
    -------
    Bounds
        Classical and quantum Cramér–Rao bounds (Dong et al., J. Phys. D 54, 394002, 2021).

    Raises
    ------
    ConfigError
        A setting is unknown or impossible, or the pixel size is missing.
    """
    resolved = _resolved(config, settings, {"mode": mode})
    return Bounds(resolved, bounds_report(resolved))


def forecast_optics(
    config: Source | None = None,
    *,
    settings: Settings | None = None,
    events: int = EVENTS,
    free: str | Sequence[str] | None = None,
) -> OpticsForecast:
    """Foresee how well particles would determine the microscope, before they are recorded.

    Parameters
    ----------
    config : str, Path, mapping or Config, optional
        As for `configure`: the optics, the camera, the particle and ``fit.roi_nm``; ``[bounds]``
        has the light and the frames.
    settings : mapping of str to Any, or iterable of str, optional
        As for `configure`.
    events : int
        Particles of ``particle.mass_kda`` that are fitted together.
    free : str or sequence of str, optional
        What is fitted, of ``focus, na, phase, mask, zernike, polarization``; default all.

    Returns
    -------
    OpticsForecast
        Standard deviations of `calibrate_optics`, what the pictures would not tell, and the errors
        that all later masses and heights would share.

    Raises
    ------
    ConfigError
        A setting is unknown or impossible, or the microscope has no reference.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> setup = {"camera.pixel_size_nm": 84.4, "optics.attenuation": 0.1, "bounds.n_after": 200}
    >>> found = ia.forecast_optics(settings=setup | {"particle.mass_kda": 5000.0}, events=40)
    >>> list(found.values)[:3]
    ['focus_nm', 'na', 'reference_phase_deg']
    >>> bool(0 < found.common["mass"]["mass_kda"] < 5000)
    True
    """
    return _forecast(configure(config, settings=settings), events=events, free=free)


_KEYS = {
    "mode": "fit.mode",
    "background": "background.frames",
    "frames": "fit.frames",
    "pixel_size_nm": "camera.pixel_size_nm",
    "posterior": "posterior.enabled",
    "workers": "compute.workers",
}
"""Argument → key of the configuration."""


def _resolved(config: Source | None, settings: Settings | None, given: Mapping[str, Any]) -> Config:
    """Make a configuration with the keys that arguments stand for; messages name the arguments."""
    arguments = {_KEYS[name]: value for name, value in given.items() if value is not None}
    called = {_KEYS[name]: name for name in given if given[name] is not None}
    return configure(config, settings=settings, arguments=arguments, called=called)
