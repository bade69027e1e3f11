"""What a notebook user meets: a movie goes in, a `Result` comes out and shows itself.

Each function is one call of the stages below with plain arguments: paths may be text, keys of the
configuration are given as a mapping.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from iscat_analysis.answers.calibrations import optics_calibration
from iscat_analysis.bounds import bounds_report
from iscat_analysis.bounds.shared import EVENTS, OpticsForecast
from iscat_analysis.bounds.shared import forecast_optics as _forecast
from iscat_analysis.config import LARGEST_NM, Config, configure
from iscat_analysis.executors import THREADS, open_executor
from iscat_analysis.inference.checks import number_in, path_in, truth_in
from iscat_analysis.instrument.learning import calibrate_movie
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.movie import ArrayLike, open_stack
from iscat_analysis.pipeline import analyse
from iscat_analysis.records import Progress, silent
from iscat_analysis.report import check_output
from iscat_analysis.result import Bounds, Result
from iscat_analysis.study.simulate import write_stack


def fit_movie(
    movie: str | Path | ArrayLike,
    *,
    name: str | None = None,
    config: str | Path | Mapping[str, Any] | Config | None = None,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
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
    progress: Progress = silent,
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
    progress : Progress
        Called with the stage and the steps done and in all.

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
        analysis = analyse(stack, resolved, progress=progress, command=command, executor=executor)
    result = Result(analysis)
    if folder is not None:
        result.save(folder, overwrite=overwrite)
    return result


def calibrate_optics(
    movie: str | Path | ArrayLike,
    *,
    name: str | None = None,
    config: str | Path | Mapping[str, Any] | Config | None = None,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
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
        Called with the stage and the steps done and in all.

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
    if out is not None:
        folder = path_in("`out`", out)
        return optics_calibration(
            movie, resolved, folder, name=name, free=free, focus_step_nm=focus_step_nm,
            overwrite=overwrite, progress=progress,
        )  # fmt: skip
    with open_stack(movie, name=name) as stack:
        return calibrate_movie(
            stack, resolved, free=free, focus_step_nm=focus_step_nm, progress=progress
        )


def simulate_movie(
    config: str | Path | Mapping[str, Any] | Config,
    path: str | Path,
    *,
    seed: int | None = None,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
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
    config: str | Path | Mapping[str, Any] | Config | None = None,
    *,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
    mode: str | None = None,
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
    config: str | Path | Mapping[str, Any] | Config | None = None,
    *,
    settings: Mapping[str, Any] | Iterable[str] | None = None,
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


def _resolved(
    config: str | Path | Mapping[str, Any] | Config | None,
    settings: Mapping[str, Any] | Iterable[str] | None,
    given: Mapping[str, Any],
) -> Config:
    """Make a configuration with the keys that arguments stand for; messages name the arguments."""
    arguments = {_KEYS[name]: value for name, value in given.items() if value is not None}
    called = {_KEYS[name]: name for name in given if given[name] is not None}
    return configure(config, settings=settings, arguments=arguments, called=called)
