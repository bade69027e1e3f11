"""Particles on top of a background that was recorded before they bound, or whose level is known."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from iscat_analysis import diagnosis, records
from iscat_analysis.camera import measure_windows, refine_power, start_power
from iscat_analysis.config import BackgroundConfig
from iscat_analysis.diagnosis import Noise, Prepared
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import MODEL_MISFITS
from iscat_analysis.findings.particles import MASSES_CHANGE
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import (
    Event,
    Fitted,
    PlaceAndMass,
    Region,
    contrast_image,
    index_finding,
    photons_scale,
    posterior_of,
    region_around,
    region_likelihood,
    with_index,
)
from iscat_analysis.fitting.field import add_signal, fit_field, search_field
from iscat_analysis.fitting.ranges import checked, frame_ranges, measured_windows
from iscat_analysis.fitting.results import (
    Compared,
    DetectionResult,
    evidence_beside,
    table_of,
    view_of,
)
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.landing.split_frames import field_repeats
from iscat_analysis.movie import Stack
from iscat_analysis.pipeline.kinds import Kind, Look, candidate_table, with_threshold
from iscat_analysis.records import FREE_PARAMETERS, FloatArray, PosteriorResult, Windows
from iscat_analysis.threads import threads
from iscat_analysis.units import count

if TYPE_CHECKING:
    from iscat_analysis.pipeline.stored import StoredResult

CHANGES = 4.0
"""Spread of the mass between parts of an event's frames over that of its light, beyond which it is
no constant particle: with 4 degrees of freedom or more by chance once in 10¹²."""


@dataclass(frozen=True)
class Background:
    """The sums of a movie over its background, and what these say of noise and drift.

    `doubt` says why it may not be the background of these frames; it is empty where it is.
    """

    context: AnalysisContext
    windows: Windows
    noise: Noise
    summary: Mapping[str, Any]
    doubt: str


Fit = Callable[[Prepared, Run, Background, ThreadPoolExecutor], DetectionResult]
"""Fits what is there in the frames after a background."""


def find_before_after(ready: Prepared, run: Run, fit: Fit) -> DetectionResult:
    """Find particles in the frames after a background."""
    ready, windows = _sum_frames(ready, run)
    ground = _judged(ready, run, windows)
    with threads(ready.config.compute.workers) as pool:
        found = fit(ready, run, ground, pool)
    run.clock.lap("results")
    if ready.kept is None:
        return found
    return ready.kept.put_back(found, ready.with_frames_asked(found.context.config))


def background_context(ready: Prepared, windows: Windows) -> tuple[AnalysisContext, Noise]:
    """Judge the noise of the background, and make models and filter for it."""
    config, after = ready.config, windows.frames_after
    still = not config.fit.follows_tracks
    noise = diagnosis.judge_background(
        ready.steady, ready.camera, windows, still=still, additive=not config.optics.interferes
    )
    searches = 1 if still else after[1] - after[0]
    context = make_context(
        config, ready.shape, searches=searches, noise=noise.spectrum, lines=ready.lines
    )
    return context, noise


def fit_together(
    ready: Prepared, run: Run, ground: Background, pool: ThreadPoolExecutor
) -> DetectionResult:
    """Fit the particles that are there in all frames, and sample their posteriors."""
    context = ground.context
    events, windows = fit_field(
        context, ground.windows, excess_noise=ground.noise.excess, pool=pool,
        progress=run.progress,
    )  # fmt: skip
    if context.config.fit.index:
        found = list(pool.map(lambda event: with_index(context, event), events))
        events = tuple(event for event, _ in found)
        untold = [told for _, told in found if told]
        run.report(index_finding(context, untold, len(untold), len(events)))
    run.clock.lap("fit")
    # rings of many particles that a wrong microscope leaves over look uneven too
    cause = diagnosis.misfit_warning(context.config, events)
    misfit = MODEL_MISFITS({"cause": cause}) if cause else None
    run.report(misfit or _uneven_finding(context, ready.steady.name, windows, events))
    repeats, empty = field_repeats(context, ready.steady, ready.camera, windows, events)
    if context.config.fit.sigma != "measured":
        events, changing = _flag_changing_masses(context.mode, events, repeats)
        if changing:
            which = count(changing, "event")
            run.report(MASSES_CHANGE({"events": which, "sigmas": CHANGES}))
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
        summary=ground.summary,
        repeats=tuple(repeats),
        empty=empty,
        interrupted=interrupted,
    )


def _judged(ready: Prepared, run: Run, windows: Windows) -> Background:
    """Make the models, and judge noise, pixels and drift of the background."""
    movie, config, still = ready.steady, ready.config, not ready.config.fit.follows_tracks
    context, noise = background_context(ready, windows)
    run.warm_up(context)
    run.clock.lap("model")
    repeated = None if still else diagnosis.repeats_warning(movie, windows)
    uneven = None if still else diagnosis.uneven_warning(config, movie.name, windows)
    summary: dict[str, Any] = {}
    moved = None
    if not context.additive:
        summary = diagnosis.examine_background(movie, ready.camera, windows)
        summary["noise_spectrum"] = noise.summary
        moved = diagnosis.drift_warning(movie.name, summary)
    run.report(*noise.findings_of(movie.name), *diagnosis.pixel_warnings(*windows.left_out))
    run.report(repeated, uneven, moved)
    run.clock.lap("background")
    doubt = uneven or moved
    return Background(context, windows, noise, summary, doubt.text if doubt else "")


def _sum_frames(ready: Prepared, run: Run) -> tuple[Prepared, Windows]:
    """Sum the background and the frames after it, without those that are cut off."""
    config, camera = ready.config, ready.camera
    before, after = frame_ranges(ready.steady, config)

    def sums(movie: Stack) -> Windows:
        return measured_windows(movie, config, camera, before, after, progress=run.progress)

    windows = sums(ready.steady)
    if not config.optics.interferes:
        return ready, windows
    movie, finding = diagnosis.without_cut_off(ready.steady, camera, windows)
    run.report(finding)
    if movie is ready.steady:
        return ready, windows
    return replace(ready, steady=movie), sums(movie)


class BeforeAfterSearch:
    """Searches for particles that were not in the background."""

    def __init__(self, ready: Prepared) -> None:
        self._movie, self._config, self._camera = ready.steady, ready.config, ready.camera
        self._check = checked(self._movie, self._camera)
        before, after = frame_ranges(self._movie, self._config)
        self._after, self.longest = after, after[1] - after[0]
        numbers = None if ready.kept is None else ready.kept.numbers
        self._numbers = np.arange(ready.whole.shape[0]) if numbers is None else numbers
        self.frames = self._in_file(after)
        self.window = 1 if self._config.fit.follows_tracks else self.longest
        self._windows = measured_windows(
            self._movie, self._config, self._camera, before, (after[0], after[0] + 1)
        )
        whole = replace(self._windows, n_after=self.longest, frames_after=after)
        self._context, _ = background_context(ready, whole)

    def _in_file(self, span: tuple[int, int]) -> tuple[int, int]:
        """Give the numbers in the file of a range of the frames that are left."""
        return int(self._numbers[span[0]]), int(self._numbers[span[1] - 1]) + 1

    def context(self, window: int) -> AnalysisContext:  # noqa: ARG002
        """Give models and threshold, which are those of every window."""
        return self._context

    def look(self, frame: int, window: int) -> Look:
        """Compare the frames from one on with the background."""
        context, known = self._context, self._windows
        frame = int(np.searchsorted(self._numbers, frame))
        frame = min(max(frame, self._after[0]), self._after[1] - window)
        one = BackgroundConfig(method="known", level_e=1.0, power_normalization=False)
        span = frame, frame + window
        part = measure_windows(self._movie, self._camera, None, span, one, check=self._check)
        windows = replace(
            known,
            after_e=part.after_e,
            n_after=window,
            power_ratio=window / max(known.n_before, 1),
            read_variance_after_e2=part.read_variance_after_e2,
            masked=known.masked | part.saturated,
            saturated=known.saturated | part.saturated,
            frames_after=part.frames_after,
        )
        if self._config.background.power_normalization:
            windows = start_power(windows)
        image = contrast_image(context, windows)
        wanted = self._config.detection.sign

        def search(threshold: float) -> pd.DataFrame:
            found, _ = search_field(with_threshold(context, threshold), windows)
            rows = [
                (c.x_px, c.y_px, c.snr, context.model.peak_contrast(c.z_nm, c.mass_kda), c.mass_kda)
                for c in found
            ]
            return candidate_table(r for r in rows if context.additive or wanted * r[3] >= 0)

        return Look(
            int(self._numbers[frame]),
            self._in_file(known.frames_before) if known.n_before else None,
            self._in_file(windows.frames_after),
            np.where(windows.masked, np.nan, image),
            context.templates.threshold,
            search,
        )


class StoredEvents:
    """Draws rows over a background of other frames: all together, or each in its frame."""

    def __init__(self, ready: Prepared, result: StoredResult) -> None:
        self.ready, self.table = ready, result.table
        self._still = not ready.config.fit.follows_tracks
        self.before, self.after = frame_ranges(ready.steady, ready.config)
        self.context = self.made_context()
        self._opened = lru_cache(1)(self._open)

    def made_context(self) -> AnalysisContext:
        """Make the models."""
        return make_context(self.ready.config, self.ready.shape, lines=self.ready.lines)

    def sums(self, span: tuple[int, int]) -> Windows:
        """Sum some frames over the background."""
        ready = self.ready
        return measured_windows(ready.steady, ready.config, ready.camera, self.before, span)

    def _drawn(self, region: Region, rows: Sequence[int]) -> FloatArray:
        """Draw the signal of some rows in a region."""
        total = np.zeros(region.shape)
        for i in rows:
            add_signal(self.context, _place(self.table.iloc[i]), region, total)
        return total

    @property
    def _field(self) -> Region:
        rows, columns = self.ready.shape
        return Region((0, rows), (0, columns))

    def _open(self, span: tuple[int, int]) -> tuple[Windows, list[int]]:
        """Give the sums, with the light that the particles leave, and the rows in them."""
        windows, table, context = self.sums(span), self.table, self.context
        rows = table.index[table["mass_kda"].notna() & records.is_event(table)]
        frames, still = table["frame"], self._still
        here = [int(i) for i in rows if still or int(frames.iloc[i]) == span[0]]
        if self.ready.config.background.power_normalization:
            signal = context.left(self._drawn(self._field, here))
            if context.additive:
                signal = signal * photons_scale(context, windows)
            windows = refine_power(windows, signal, additive=context.additive)
        return windows, here

    def __call__(self, row: int) -> records.EventView:
        """Draw a row of the table."""
        table, context = self.table, self.context
        frame = int(table["frame"].iloc[row])
        windows, here = self._opened(self.after if self._still else (frame, frame + 1))
        x_nm, y_nm, z_nm, mass = _place(table.iloc[row])
        pixel = context.pixel_nm
        start = records.Candidate(
            x_nm / pixel, y_nm / pixel, z_nm, mass, float(table["snr"].iloc[row])
        )
        region = region_around(context.roi_px, self.ready.shape, start)
        others = self._drawn(region, [i for i in here if i != row])
        if context.lines is not None:
            taken = context.lines.taken(self._drawn(self._field, here))
            others = (1 + others) / taken[region.slices] - 1
        likelihood = region_likelihood(context, windows, region, others)
        z_range = context.config.fit.z_range_nm
        fit = fit_particle(likelihood, start, context.mode, z_range, level=False)
        return view_of(int(table["event"].iloc[row]), Fitted(region, fit, likelihood))


def _place(row: pd.Series[Any]) -> PlaceAndMass:
    x, y, z, mass = (float(row[name]) for name in ("x_nm", "y_nm", "z_nm", "mass_kda"))
    return x, y, z, mass


def _uneven_finding(
    context: AnalysisContext, name: str, windows: Windows, events: Sequence[Event]
) -> Finding | None:
    """Find that a known background is uneven, where no particle was fitted."""
    if windows.n_before:
        return None
    rows, columns = windows.after_e.shape
    field, signal = Region((0, rows), (0, columns)), np.zeros(windows.after_e.shape)
    optics = context.config.optics
    # within which a wrong model leaves most of a particle over
    near_nm = 2 * optics.wavelength_nm / optics.na
    y, x = (context.pixel_nm * index for index in np.indices(signal.shape))
    away = np.ones(signal.shape, dtype=np.bool_)
    for event in events:
        x_nm, y_nm, z_nm = (float(v) for v in event.fit.theta[:3])
        mass = float(context.model.scale.mass(event.fit.theta[3]))
        add_signal(context, (x_nm, y_nm, z_nm, mass), field, signal)
        away &= np.hypot(x - x_nm, y - y_nm) > near_nm
    # of the field, from which what no particle explains is told
    if away.mean() < 0.25:
        return diagnosis.uneven_warning(context.config, name, windows)
    if context.additive:
        signal = signal * photons_scale(context, windows)
    return diagnosis.uneven_warning(context.config, name, windows, np.where(away, signal, np.nan))


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
        if degrees >= 4 and squares > CHANGES**2 * degrees:
            changing += 1
            judged[number] = replace(
                event, flags=records.verdict([*event.flags, records.Status.POOR_FIT])[1]
            )
    return tuple(judged), changing


def _sample_posteriors(
    context: AnalysisContext,
    events: Sequence[Event],
    pool: ThreadPoolExecutor,
    progress: records.Progress,
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
        progress("report", 0, 1)  # from here on what was finished is gathered and kept
        stop.set()
        pool.shutdown(cancel_futures=True)
        return done, True
    return done, False


BEFORE_AFTER = Kind(
    "background", partial(find_before_after, fit=fit_together), BeforeAfterSearch, StoredEvents,
    keeps_parts=False,
)  # fmt: skip
