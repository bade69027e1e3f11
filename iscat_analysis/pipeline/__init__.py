"""The main job: load → calibrate → background → detect → fit → posterior → bounds → report.

`analyse` does it in this order.  `prepare` loads and calibrates.  The kind of the movie, chosen by
``background.method`` (`kind_of`), measures the background, searches, fits, samples posteriors and
computes bounds.  `make_analysis` makes the table, and describes tracks and species.

An event is first a candidate, then `Fitted` while its neighbours are still being found, then an
`Event` with its verdict.  Its row is made when all events are known, because its number and some
of its errors depend on all of them (`rows`).
"""

from __future__ import annotations

from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from iscat_analysis import diagnosis
from iscat_analysis.calibration import with_standards
from iscat_analysis.camera import text_summary
from iscat_analysis.config import Config, refuse_rod
from iscat_analysis.diagnosis import LIGHT_STEPS, Prepared, Step
from iscat_analysis.errors import ConfigError
from iscat_analysis.executors import Executor
from iscat_analysis.findings import Finding, existing
from iscat_analysis.fitting.ranges import tracked_frames
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
from iscat_analysis.instrument.learning import learn_optics, learn_sign, wrong_sign
from iscat_analysis.movie import Stack, open_stack, path_beside
from iscat_analysis.pipeline.finish import make_analysis
from iscat_analysis.pipeline.kinds import kind_of
from iscat_analysis.progress import automatic, told
from iscat_analysis.records import Analysis, Progress
from iscat_analysis.report import write_report
from iscat_analysis.report.output import check_output, claim_output
from iscat_analysis.threads import start_in_thread


@told
def fit_stack(
    stack: str | Path,
    config: Config,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    figures: bool = False,
    progress: Progress = automatic,
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
    figures : bool
        Draw figures for papers into its folder ``figures``.
    progress : Progress
        Told how far each stage is; default as for `iscat_analysis.fit_movie`.
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
    kind = kind_of(config)
    check_output(folder, overwrite)
    partial = partial_folder(folder.resolve())
    with claim_output(folder, overwrite):
        with open_stack(stack) as movie:
            movie.hashed()
            run = Run(notify, progress, partial, executor or Executor(), inject)
            analysis = analyse(movie, config, run, command=command)
        with parts_kept(partial if kind.keeps_parts else None):
            write_report(analysis, folder, overwrite=overwrite, figures=figures)
        if not analysis.summary["interrupted"]:
            remove_parts(partial)
    if analysis.summary["interrupted"]:
        progress("report", 1, 1)
        goes_on = ", and the same command goes on from there" if is_resumable(folder) else ""
        notify(f"interrupted; what was finished is in {folder}{goes_on}")
        raise KeyboardInterrupt
    return analysis


def analyse(movie: Stack, config: Config, run: Run | None = None, *, command: str = "") -> Analysis:
    """Analyse an open movie."""
    run = run or Run()
    if run.executor.distant and not movie.identity:
        raise ConfigError(
            f"{movie.name}: is an array, and workers read a movie from its file: save it, as with "
            "numpy.save, and give its path; or leave `scheduler` out"
        )
    refuse_rod(config, "iscat-fit does not fit directions")
    started = datetime.now(UTC).isoformat(timespec="seconds")
    with compiling(run.notify):
        kind = kind_of(config)
        ready = prepare(movie, config, run)  # load, calibrate
        if kind.inject is None and run.executor.distant:
            run.notify(
                f"{movie.name}: is analysed in this process: only landing movies have chunks"
            )
        if kind.inject is None and run.inject:
            raise ConfigError(
                f"`inject` = {run.inject}: particles are added to landing movies only, which have "
                'an interferometric scheme and background.method = "sliding"; leave it out'
            )
        found = kind.find(ready, run)  # background, detect, fit, posterior, bounds
        with parts_kept(run.partial if kind.keeps_parts else None):
            extra: dict[str, Any] = {}
            if kind.inject and run.inject and not found.interrupted:
                try:
                    extra = {"injection": kind.inject(ready, run, found)}
                except KeyboardInterrupt:
                    found = replace(found, interrupted=True)
                run.clock.lap("injection")
            return make_analysis(kind, ready, run, found, extra, command=command, started=started)


def prepare(movie: Stack, config: Config, run: Run) -> Prepared:
    """Load and calibrate a movie."""
    ready = diagnosis.calibrated(
        movie, config, STEPS, report=run.report, notify=run.notify, ahead=True
    )
    run.clock.lap("optics")
    text = ready.known.text
    left_out = {"texts": [] if text is None else text_summary(text)}
    summary = {**ready.summary, "left_out": ready.stretches.summary | left_out}
    return replace(ready, summary=summary).over_all_stretches()


def times(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Say what rate, exposure and length leave unknown where particles are followed."""
    if not state.config.fit.follows_tracks:
        return state, []
    from iscat_analysis.tracking.tracks import judge_times

    frames = tracked_frames(state.movie, state.config)
    return state, judge_times(state.config, frames, state.movie.name)


def optics(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Learn the optics, or the sign of the contrast, from the brightest particles."""
    configured, camera, steady = state.config, state.camera, state.steady
    wrong = wrong_sign(configured)
    if wrong is not None:
        config, learned, findings = learn_sign(
            steady, wrong, camera, notify=state.notify, opening=state.opening
        )
        config = _with_standards(config, state)
    else:
        config, learned, findings = learn_optics(
            steady, _with_standards(configured, state), camera,
            notify=state.notify, opening=state.opening,
        )  # fmt: skip
    changes, stretches, breaks = state.changes, state.stretches, None
    if changes is not None and config.optics.na != configured.optics.na:
        changes = start_in_thread(diagnosis.look_at_changes, steady, config, camera, state.span)
    if config.background.slides and config.optics.focus_jumps:
        jumps = [frame for frame, rise in config.optics.focus_jumps if rise]
        stretches = stretches.with_jumps(jumps)
        if stretches is not state.stretches:
            breaks = stretches.finding(steady.name)
    summary = {**state.summary, **({"optics": learned} if learned else {})}
    state = replace(state, config=config, changes=changes, stretches=stretches, summary=summary)
    return state, existing([*findings, breaks])


def kind(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Tell whether particles move where landings were expected, or land where they should move."""
    if state.changes is None:
        return state, []
    changes = state.changes.result()
    other = (diagnosis.as_landing if state.config.fit.follows_tracks else diagnosis.as_moving)(
        changes, state.movie.name
    )
    summary = {**state.summary, "changes": asdict(changes)}
    said = "" if other is None else other.text
    return replace(state, other_kind=said, summary=summary), existing([other])


STEPS: tuple[Step, ...] = (*LIGHT_STEPS, times, optics, kind)
"""From an open movie to one that can be searched."""


def _with_standards(config: Config, state: Prepared) -> Config:
    """Say where the gradient is taken whose standards have no recorded optics."""
    found = with_standards(config)
    if found is not config:
        told = found.optics
        state.notify(
            "[calibration] does not say with what optics its standards were measured: the gradient "
            f"is taken at those of the configuration (focus {told.focus_nm:g} nm, NA "
            f"{told.na:g}, height {found.particle.nominal_height_nm:g} nm); "
            "`iscat calibrate mass` writes a line with its optics"
        )
    return found
