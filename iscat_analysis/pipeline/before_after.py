"""Particles on top of a background that was recorded before they bound, or whose level is known."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.diagnosis import (
    Noise,
    Prepared,
    drift_warning,
    examine_background,
    judge_background,
    judge_beside,
    misfit_warning,
    pixel_warnings,
    repeats_warning,
    uneven_warning,
    without_cut_off,
)
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import MODEL_MISFITS
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import (
    Event,
    Region,
    contrast_image,
    photons_scale,
    posterior_of,
    untold_message,
    with_index,
)
from iscat_analysis.fitting.field import add_signal, fit_field
from iscat_analysis.fitting.ranges import checked, frame_ranges, measured_windows
from iscat_analysis.fitting.results import (
    Compared,
    DetectionResult,
    evidence_beside,
    table_of,
    view_of,
)
from iscat_analysis.fitting.run import Run
from iscat_analysis.landing.split_frames import field_repeats
from iscat_analysis.movie import Stack
from iscat_analysis.records import (
    FREE_PARAMETERS,
    FloatArray,
    PosteriorResult,
    Progress,
    Status,
    Windows,
    verdict,
)
from iscat_analysis.threads import threads
from iscat_analysis.units import count

CHANGES = 4.0
"""Spread of the mass between parts of an event's frames over that of its light, beyond which it is
no constant particle: with 4 degrees of freedom or more by chance once in 10¹²."""

_LEAST_DEGREES = 4
_LEAST_AWAY = 0.25  # of the field, from which what no particle explains is told
_NEAR = 2.0  # λ/NA from a particle, within which a wrong model leaves most of it over


def find_before_after(ready: Prepared, run: Run) -> DetectionResult:
    """Find particles in the frames after a background; mode track fits each frame by itself."""
    ready, windows = _sum_frames(ready, run)
    context, noise, summary, doubt = _background(ready, run, windows)
    movie, camera = ready.steady, ready.camera
    with threads(context.config.compute.workers) as pool:
        if context.mode == "track":
            from iscat_analysis.tracking.find import track_frames

            found = track_frames(
                context, movie, camera, windows, summary,
                check=checked(movie, camera), pool=pool, progress=run.progress,
                doubt=doubt, warn=run.warn,
            )  # fmt: skip
            if not windows.n_before:
                run.report(*_judge_beside_particles(ready, context, windows, found.fits).findings)
        else:
            found = _fit_together(ready, run, context, windows, noise, summary, pool)
    run.clock.lap("results")
    return found if ready.kept is None else ready.kept.put_back(found)


def _sum_frames(ready: Prepared, run: Run) -> tuple[Prepared, Windows]:
    """Sum the background and the frames after it, without those that are cut off."""
    config, camera = ready.config, ready.camera
    before, after = frame_ranges(ready.steady, config)

    def sums(movie: Stack) -> Windows:
        return measured_windows(movie, config, camera, before, after, progress=run.progress)

    windows = sums(ready.steady)
    if config.optics.scheme == "darkfield":
        return ready, windows
    movie, finding = without_cut_off(ready.steady, camera, windows)
    run.report(finding)
    if movie is ready.steady:
        return ready, windows
    return replace(ready, steady=movie), sums(movie)


def _background(
    ready: Prepared, run: Run, windows: Windows
) -> tuple[AnalysisContext, Noise, dict[str, Any], str]:
    """Make the models, and judge noise, pixels and drift of the background.

    Also returned is why it may not be the background of these frames; empty where it is.
    """
    movie, config, camera = ready.steady, ready.config, ready.camera
    after = windows.frames_after
    searches = after[1] - after[0] if config.fit.mode == "track" else 1
    context = make_context(config, ready.shape, searches=searches, lines=ready.lines)
    run.warm_up(context)
    run.clock.lap("model")
    still = config.fit.mode != "track"
    noise = judge_background(movie, camera, windows, still=still, additive=context.additive)
    if noise.spectrum is not None:
        context = make_context(
            config, ready.shape, searches=searches, noise=noise.spectrum, lines=ready.lines
        )
    run.report(*noise.findings_of(movie.name), *pixel_warnings(*windows.left_out))
    uneven = None if still else uneven_warning(config, movie.name, windows)
    run.report(None if still else repeats_warning(movie, windows), uneven)
    summary: dict[str, Any] = {}
    moved = None
    if not context.additive:
        summary = examine_background(movie, camera, windows)
        summary["noise_spectrum"] = noise.summary
        moved = drift_warning(movie.name, summary)
        run.report(moved)
    run.clock.lap("background")
    doubt = uneven or moved
    return context, noise, summary, "" if doubt is None else doubt.text


def _judge_beside_particles(
    ready: Prepared, context: AnalysisContext, windows: Windows, table: pd.DataFrame
) -> Noise:
    """Judge the camera in pixels that no moving particle comes near; the background is known."""
    movie, camera, (first, last) = ready.steady, ready.camera, windows.frames_after
    frame = table["frame"].to_numpy(np.int64)
    particles = table[["x_nm", "y_nm", "z_nm", "mass_kda"]].to_numpy(float)
    rows, columns = ready.shape
    field = Region((0, rows), (0, columns))

    def without(count: int) -> FloatArray:
        electrons = camera.to_electrons(movie.read(first, first + count))
        for number, image in enumerate(electrons if not context.additive else ()):
            signal = np.zeros(field.shape)
            for x, y, z, mass in particles[frame == first + number].tolist():
                add_signal(context, (x, y, z, mass), field, signal)
            image /= 1 + signal
        return electrons

    noise = judge_beside(
        context, movie, camera, (first, last), (frame, particles[:, :2]), ~windows.masked, without
    )
    return noise.compared_with_fits(table["chi2_reduced"].to_numpy(float))


def _fit_together(
    ready: Prepared,
    run: Run,
    context: AnalysisContext,
    windows: Windows,
    noise: Noise,
    summary: dict[str, Any],
    pool: ThreadPoolExecutor,
) -> DetectionResult:
    """Find and fit the particles that are there in all frames, and sample their posteriors."""
    events, windows = fit_field(
        context, windows, excess_noise=noise.excess, pool=pool, progress=run.progress
    )
    if context.config.fit.index:
        found = list(pool.map(lambda event: with_index(context, event), events))
        events = tuple(event for event, _ in found)
        untold = [told for _, told in found if told]
        n_sample = context.model.optics.n_sample
        if text := untold_message(untold, len(untold), len(events), n_sample):
            run.warn(text)
    run.clock.lap("fit")
    # rings of many particles that a wrong microscope leaves over look uneven too
    cause = misfit_warning(context.config, events)
    misfit = MODEL_MISFITS({"cause": cause}) if cause else None
    run.report(misfit or _uneven_finding(context, ready.steady.name, windows, events))
    repeats, empty = field_repeats(context, ready.steady, ready.camera, windows, events)
    if context.config.fit.sigma != "measured":
        events, changing = _flag_changing_masses(context.mode, events, repeats)
        if changing:
            run.warn(
                f"the mass of {count(changing, 'event')} changes within the frames by more than "
                f"{CHANGES:g} times its error, flagged poor_fit: they land, leave or move there; "
                "let background.frames end before they land and fit.frames begin after"
            )
    run.clock.lap("repeats")
    chains: list[PosteriorResult] = []
    interrupted = False
    if context.config.samples_posterior:
        chains, interrupted = _sample_posteriors(context, events, pool, run.progress)
        run.clock.lap("posterior")
    return DetectionResult(
        context=context,
        fits=table_of(context, events),
        evidence=evidence_beside(context, events),
        views=tuple(
            view_of(number, event, posterior=chain)
            for number, (event, chain) in enumerate(zip_longest(events, chains))
        ),
        image=contrast_image(context, windows),
        compared=Compared.of(windows),
        heading="background",
        summary=summary,
        repeats=tuple(repeats),
        empty=empty,
        interrupted=interrupted,
    )


def _uneven_finding(
    context: AnalysisContext, name: str, windows: Windows, events: Sequence[Event]
) -> Finding | None:
    """Find that a known background is uneven, where no particle was fitted."""
    if windows.n_before:
        return None
    rows, columns = windows.after_e.shape
    field, signal = Region((0, rows), (0, columns)), np.zeros(windows.after_e.shape)
    optics = context.config.optics
    near_nm = _NEAR * optics.wavelength_nm / optics.na
    y, x = (context.pixel_nm * index for index in np.indices(signal.shape))
    away = np.ones(signal.shape, dtype=np.bool_)
    for event in events:
        x_nm, y_nm, z_nm = (float(v) for v in event.fit.theta[:3])
        mass = float(context.model.scale.mass(event.fit.theta[3]))
        add_signal(context, (x_nm, y_nm, z_nm, mass), field, signal)
        away &= np.hypot(x - x_nm, y - y_nm) > near_nm
    if away.mean() < _LEAST_AWAY:
        return uneven_warning(context.config, name, windows)
    if context.additive:
        signal = signal * photons_scale(context, windows)
    return uneven_warning(context.config, name, windows, np.where(away, signal, np.nan))


def _flag_changing_masses(
    mode: str, events: Sequence[Event], repeats: Sequence[FloatArray]
) -> tuple[tuple[Event, ...], int]:
    """Flag events whose mass differs between parts of their frames, and count them."""
    if "mass_kda" not in FREE_PARAMETERS[mode]:
        return tuple(events), 0
    column, changing = FREE_PARAMETERS[mode].index("mass_kda"), 0
    judged = list(events)
    for number, (event, own) in enumerate(zip(events, repeats, strict=True)):
        squares, degrees = own[0, column], own[0, -1]
        if degrees >= _LEAST_DEGREES and squares > CHANGES**2 * degrees:
            changing += 1
            judged[number] = replace(event, flags=verdict([*event.flags, Status.POOR_FIT])[1])
    return tuple(judged), changing


def _sample_posteriors(
    context: AnalysisContext, events: Sequence[Event], pool: ThreadPoolExecutor, progress: Progress
) -> tuple[list[PosteriorResult], bool]:
    """Sample the posteriors, in order; an interrupt keeps those that are done."""
    stop = threading.Event()
    done: list[PosteriorResult] = []
    try:
        for chain in pool.map(
            lambda n: posterior_of(context, events[n], n, stopped=stop.is_set), range(len(events))
        ):
            done.append(chain)
            progress("posterior", len(done), len(events))
    except KeyboardInterrupt:
        stop.set()
        pool.shutdown(cancel_futures=True)
        return done, True
    return done, False
