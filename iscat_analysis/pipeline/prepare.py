"""From an open movie to one whose camera, optics and kind are known: load and calibrate."""

from __future__ import annotations

from dataclasses import replace

from iscat_analysis.calibration import with_standards
from iscat_analysis.camera import text_summary
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import (
    LIGHT_STEPS,
    Prepared,
    Step,
    as_landing,
    as_moving,
    calibrated,
    changes_summary,
    look_at_changes,
)
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import Finding, existing, remark
from iscat_analysis.fitting.ranges import tracked_frames
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.contrast_sign import learn_sign, wrong_sign
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.movie import Stack
from iscat_analysis.threads import start_in_thread


def prepare(movie: Stack, config: Config, run: Run) -> Prepared:
    """Load and calibrate a movie."""
    ready = calibrated(movie, config, STEPS, report=run.report, notify=run.notify, ahead=True)
    run.clock.lap("optics")
    if ready.background_mode != "sliding":
        _refuse_what_only_slides(run, movie.name)
    text = ready.known.text
    left_out = {"texts": [] if text is None else text_summary(text)}
    summary = {**ready.summary, "left_out": ready.stretches.summary | left_out}
    return replace(ready, summary=summary).over_all_stretches()


def times(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Say what rate, exposure and length leave unknown where particles are followed."""
    if not state.tracked:
        return state, []
    from iscat_analysis.tracking.tracks import judge_times

    frames = tracked_frames(state.movie, state.config)
    return state, [remark(text) for text in judge_times(state.config, frames, state.movie.name)]


def optics(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Learn the optics, or the sign of the contrast, from the brightest particles."""
    configured, camera, steady = state.config, state.camera, state.steady
    texts: list[str] = []
    wrong = wrong_sign(configured)
    if wrong is not None:
        config, learned = learn_sign(
            steady, wrong, camera, warn=texts.append, notify=state.notify, opening=state.opening
        )
        config = _with_standards(config, state)
    else:
        config, learned = learn_optics(
            steady, _with_standards(configured, state), camera,
            warn=texts.append, notify=state.notify, opening=state.opening,
        )  # fmt: skip
    changes, stretches, breaks = state.changes, state.stretches, None
    if changes is not None and config.optics.na != configured.optics.na:
        changes = start_in_thread(look_at_changes, steady, config, camera, state.span)
    if state.background_mode == "sliding" and config.optics.focus_jumps:
        jumps = [frame for frame, rise in config.optics.focus_jumps if rise]
        stretches = stretches.with_jumps(jumps)
        if stretches is not state.stretches:
            breaks = stretches.finding(steady.name)
    summary = {**state.summary, **({"optics": learned} if learned else {})}
    state = replace(state, config=config, changes=changes, stretches=stretches, summary=summary)
    return state, existing([*(remark(text) for text in texts), breaks])


def kind(state: Prepared) -> tuple[Prepared, list[Finding]]:
    """Tell whether particles move where landings were expected, or land where they should move."""
    if state.changes is None:
        return state, []
    changes = state.changes.result()
    other = (as_landing if state.tracked else as_moving)(changes, state.movie.name)
    summary = {**state.summary, "changes": changes_summary(changes)}
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


def _refuse_what_only_slides(run: Run, name: str) -> None:
    """Refuse to inject particles, and say that workers are idle, where windows do not slide."""
    if run.executor.distant:
        run.notify(f"{name}: is analysed in this process: only landing movies have chunks")
    if run.inject:
        raise ConfigError(
            f"`inject` = {run.inject}: particles are added to landing movies only, which have an "
            'interferometric scheme and background.method = "sliding"; leave it out'
        )
