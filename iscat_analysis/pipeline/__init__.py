"""The main job: load → calibrate → background → detect → fit → posterior → bounds → report.

`analyse` does it in this order.  `prepare` loads and calibrates.  What `finder` gives, chosen
by ``background.method`` alone (`background_mode`), measures the background, searches, fits, samples
posteriors and computes bounds.  `make_analysis` makes the table, and describes tracks and species.

An event is first a candidate, then `Fitted` while its neighbours are still being found, then an
`Event` with its verdict.  Its row is made when all events are known, because its number and some
of its errors depend on all of them (`rows`).
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from iscat_analysis.config import Config, refuse_rod
from iscat_analysis.diagnosis import Prepared
from iscat_analysis.errors import ConfigError
from iscat_analysis.executors import Executor, LocalExecutor
from iscat_analysis.fitting.ranges import BackgroundMode, background_mode
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import (
    Notify,
    Run,
    compiling,
    is_resumable,
    notify_nobody,
    partial_folder,
    parts_kept,
    remove_parts,
)
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.movie import Stack, open_stack, path_beside
from iscat_analysis.pipeline.finish import make_analysis
from iscat_analysis.pipeline.injection import injected
from iscat_analysis.pipeline.prepare import prepare
from iscat_analysis.records import Analysis, Progress, silent
from iscat_analysis.report import EVENT_FIGURES, write_report
from iscat_analysis.report.output import check_output, claim_output

FEW_FIGURES = 2
"""Events of a landing movie that are drawn for print; the page shows hundreds."""


def finder(mode: BackgroundMode) -> Callable[[Prepared, Run], DetectionResult]:
    """Import background, search and fits of one kind of movie; each takes a while to load."""
    match mode:
        case "fixed":
            from iscat_analysis.pipeline.before_after import find_before_after as find
        case "sliding":
            from iscat_analysis.landing.find import find_landings as find
        case "tracks":
            from iscat_analysis.tracking.find import find_moving as find
    return find


def fit_stack(
    stack: str | Path,
    config: Config,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Notify = notify_nobody,
    command: str = "",
    inject: int = 0,
    executor: Executor | None = None,
) -> Analysis:
    """Analyse a movie and write the report.

    Parameters
    ----------
    stack : str or Path
        The movie.
    config : Config
        What to do; see `iscat_analysis.config`.
    out : Path, optional
        Output folder; default the movie's name with ``.iscat``.
    overwrite : bool
        Replace an earlier result.
    progress : Progress
        Told how far each stage is.
    notify : callable
        Told what the user should know, one line at a time.
    command : str
        The command line, for the record.
    inject : int
        Known particles to add to a landing movie in a second run, which tells how many are found
        and how well they are measured; ``summary["injection"]``.
    executor : Executor, optional
        Where the chunks of a landing movie are analysed; default in this process.

    Returns
    -------
    Analysis
        Everything found; also written to the folder.

    Raises
    ------
    DataError
        The movie cannot be analysed, or the folder exists.
    ConfigError
        The configuration does not suit the movie.
    KeyboardInterrupt
        The user stopped it; what was finished is in the folder, or kept beside it where the report
        was not yet begun or not done, as the interrupt says.
    """
    stack = path_in("`stack`", stack)
    if not isinstance(config, Config):
        raise ConfigError(f"`config`: is {type(config).__name__}; give what `configure` returns")
    inject = int(number_in("`inject`", inject, least=0, whole=True))
    folder = path_beside(stack, ".iscat") if out is None else out
    overwrite = overwrite or is_resumable(folder)
    mode = background_mode(config)
    figures = FEW_FIGURES if mode == "sliding" else EVENT_FIGURES
    check_output(folder, overwrite)
    partial = partial_folder(folder.resolve())
    with claim_output(folder, overwrite):
        with open_stack(stack) as movie:
            movie.hashed()
            analysis = analyse(
                movie,
                config,
                progress=progress,
                notify=notify,
                command=command,
                partial=partial,
                inject=inject,
                executor=executor,
            )
        with parts_kept(None if mode == "fixed" else partial):
            write_report(
                analysis, folder, overwrite=overwrite, event_figures=figures, executor=executor
            )
        if not analysis.summary["interrupted"]:
            remove_parts(partial)
    if analysis.summary["interrupted"]:
        progress("report", 1, 1)
        goes_on = ", and the same command goes on from there" if is_resumable(folder) else ""
        notify(f"interrupted; what was finished is in {folder}{goes_on}")
        raise KeyboardInterrupt
    return analysis


def analyse(
    movie: Stack,
    config: Config,
    *,
    progress: Progress = silent,
    notify: Notify = notify_nobody,
    command: str = "",
    partial: Path | None = None,
    inject: int = 0,
    executor: Executor | None = None,
) -> Analysis:
    """Analyse an open movie."""
    if executor is not None and executor.distant and not movie.identity:
        raise ConfigError(
            f"{movie.name}: is an array, and workers read a movie from its file: save it, as with "
            "numpy.save, and give its path; or leave `scheduler` out"
        )
    refuse_rod(config, "iscat-fit does not fit directions")
    started = datetime.now(UTC).isoformat(timespec="seconds")
    with compiling(notify):
        run = Run(notify, progress, partial, executor or LocalExecutor(), inject)
        ready = prepare(movie, config, run)  # load, calibrate
        # background, detect, fit, posterior, bounds
        found = finder(ready.background_mode)(ready, run)
        with parts_kept(None if ready.background_mode == "fixed" else partial):
            extra, stopped = injected(ready, run, found)
            stopped = stopped or found.interrupted
            return make_analysis(
                ready, run, found, extra, command=command, started=started, interrupted=stopped
            )
