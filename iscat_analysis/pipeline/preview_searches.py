"""The searches of a preview, one for each background mode, and what they find."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Protocol

import numpy as np
import pandas as pd

from iscat_analysis._kernels.sliding import contrast_map
from iscat_analysis.camera.background import measure_windows, start_power
from iscat_analysis.diagnosis.noise import judge_background, survey_over
from iscat_analysis.diagnosis.prepared import Prepared
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import AnalysisContext, make_context, reported_steps
from iscat_analysis.fitting.field import search_field
from iscat_analysis.fitting.pattern import SPAN, corrected
from iscat_analysis.fitting.ranges import checked, fitted_frames, frame_ranges, measured_windows
from iscat_analysis.fitting.regions import contrast_image
from iscat_analysis.landing.sidelobes import SidelobeFilter
from iscat_analysis.records import FloatArray, silent
from iscat_analysis.search.sliding import (
    STRIDES,
    Filter,
    MapArray,
    boundaries,
    find_steps,
    make_filter,
    sliding_maps,
    stride_of,
)
from iscat_analysis.threads import threads
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations
from iscat_analysis.tracking.moving_field import (
    LEAST_FRAMES,
    initial_background,
    load_field,
    search_frames,
    tracking_context,
)

FOUND_COLUMNS = ("x_px", "y_px", "snr", "contrast", "mass_kda")
"""Columns of what a `Look` finds."""

AROUND = 100
"""Frames that make the background of one frame in which particles move."""

_WINDOWS_KEPT = 16  # lengths of window whose models are remembered


@dataclass(frozen=True)
class Look:
    """What the search sees in some frames.

    Attributes
    ----------
    frame : int
        First of the frames `after`; the one that was asked for, or the nearest that has as many
        frames before and after it as are needed.
    before : (int, int) or None
        Frames of the background, half-open; None where it is known.
    after : (int, int)
        Frames that are compared with it, half-open.
    image : ndarray, shape (y, x)
        Contrast, after over before minus 1 (dark field: photoelectrons above background); NaN where
        a pixel is not used.
    threshold : float
        Signal-to-noise ratio above which `analyse` takes something for a particle.
    search : callable
        Threshold → what exceeds it.
    """

    frame: int
    before: tuple[int, int] | None
    after: tuple[int, int]
    image: FloatArray
    threshold: float
    search: Callable[[float], pd.DataFrame]

    def found(self, threshold: float | None = None) -> pd.DataFrame:
        """Give what exceeds a threshold.

        Parameters
        ----------
        threshold : float, optional
            Signal-to-noise ratio; default as configured.

        Returns
        -------
        pandas.DataFrame
            Columns `FOUND_COLUMNS`, strongest first: place [px], signal-to-noise ratio, contrast at
            the peak and mass [kDa] by the linear estimate, negative for a particle that leaves.
            What may be a side lobe of another is not listed.

        Raises
        ------
        ConfigError
            The threshold is not positive.
        """
        return self.search(positive_threshold(self.threshold if threshold is None else threshold))


class Search(Protocol):
    """A search for one background mode."""

    window: int
    longest: int
    frames: tuple[int, int]

    def context(self, window: int) -> AnalysisContext:
        """Give models and threshold for windows of `window` frames."""

    def look(self, frame: int, window: int) -> Look:
        """Search the frames around one."""


class LandingSearch:
    """Searches for particles that land or leave between two windows."""

    def __init__(self, ready: Prepared) -> None:
        whole, self._stretches = ready.over_all_stretches(), ready.stretches.kept
        self._config = config = whole.config
        self.frames = whole.span
        self.longest = max(stop - start for start, stop in self._stretches) // 2
        opening = survey_over(ready.steady, config, ready.camera, self.frames, ready.opening)
        self._reader, noise, self.window = opening.reader, opening.noise, opening.window

        @lru_cache(_WINDOWS_KEPT)
        def context(window: int) -> AnalysisContext:
            searches = sum(boundaries(stop - start, window) for start, stop in self._stretches)
            return make_context(
                config, self._reader.shape, searches=searches, noise=noise.spectrum,
                lines=ready.lines, sliding=True,
            )  # fmt: skip

        self.context = context

    def look(self, frame: int, window: int) -> Look:
        """Compare the windows before and after the boundary at which a frame begins."""
        stride = stride_of(window)
        first, last = min(  # the stretch with or next to the frame in which windows have room
            (span for span in self._stretches if span[1] - span[0] >= 2 * stride),
            key=lambda span: max(span[0] - frame, frame + 1 - span[1], 0),
        )
        frame = min(max(frame, first + stride), last - stride)
        half = STRIDES * stride
        reach = (SPAN if self._config.background.follows_pattern else 1) * STRIDES
        blocks_before = min(reach, (frame - first) // stride)
        span = frame - blocks_before * stride, min(frame + reach * stride, last)
        context = self.context(window)
        with threads(self._config.compute.workers) as pool:
            chunk = self._reader.chunk(span, stride, pool)
            chunk, pattern = corrected(chunk, wanted=reach > STRIDES, mapper=pool.map)
        at = blocks_before - 1  # the boundary between blocks at which `frame` begins
        known = pattern.contrast[at] if pattern else None
        earlier, later = slice(max(at + 1 - STRIDES, 0), at + 1), slice(at + 1, at + 1 + STRIDES)
        image = np.zeros(chunk.shape, dtype=np.float32)
        contrast_map(
            chunk.blocks_e[earlier], chunk.blocks_e[later], chunk.usable.astype(np.float32), image
        )
        contrast = np.where(chunk.usable, image.astype(np.float64), np.nan)
        if known is not None:
            contrast = (1 + contrast) / (1 + known) - 1

        @cache
        def map_of() -> tuple[Filter, MapArray, FloatArray]:
            matched = make_filter(chunk, context.templates.images[0], context.templates.noise)
            count = chunk.edges.size - 2
            empty = np.zeros((count, *chunk.shape), np.float32), np.zeros(count)
            snr, effective = sliding_maps(
                chunk, matched, STRIDES, explained=None if known is None else lambda *_: known,
                earlier=empty, changed=[at],
            )  # fmt: skip
            return matched, snr[at : at + 1], effective[at : at + 1]

        def search(threshold: float) -> pd.DataFrame:
            matched, snr, effective = map_of()
            peaks = find_steps(chunk, matched, snr, effective, threshold)
            sieve = SidelobeFilter(chunk.first, stride, window, context.roi_px)
            sign, scale = reported_steps(context), context.model.scale
            return _candidate_table(
                (p.x_px, p.y_px, p.snr, float(context.contrasts(np.asarray(p.amplitude))),
                 math.copysign(float(scale.mass(np.asarray(abs(p.amplitude)))), p.amplitude))
                for p in sieve.sift(peaks, (), snr)[0]
                if sign * p.amplitude >= 0
            )  # fmt: skip

        return Look(
            frame, (max(frame - half, first), frame), (frame, min(frame + half, last)), contrast,
            context.templates.threshold, search,
        )  # fmt: skip


class BeforeAfterSearch:
    """Searches for particles that were not in the background."""

    def __init__(self, ready: Prepared) -> None:
        self._movie, config, camera = ready.steady, ready.config, ready.camera
        self._camera, self._config = camera, config
        self._check = checked(self._movie, camera)
        before, after = frame_ranges(self._movie, config)
        self._after, self.longest = after, after[1] - after[0]
        numbers = None if ready.kept is None else ready.kept.numbers
        self._numbers = np.arange(ready.whole.shape[0]) if numbers is None else numbers
        self.frames = self._in_file(after)
        self.window = 1 if ready.tracked else self.longest
        self._windows = measured_windows(
            self._movie, config, camera, before, (after[0], after[0] + 1)
        )
        noise = judge_background(
            self._movie,
            camera,
            replace(self._windows, n_after=self.longest, frames_after=after),
            still=not ready.tracked,
            additive=config.optics.scheme == "darkfield",
        )
        self._context = make_context(
            config, ready.shape, searches=self.longest if ready.tracked else 1,
            noise=noise.spectrum, lines=ready.lines,
        )  # fmt: skip

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
        part = measure_windows(
            self._movie, self._camera, None, (frame, frame + window),
            level_e=1.0, power_normalization=False, check=self._check,
        )  # fmt: skip
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
            found, _ = search_field(_with_threshold(context, threshold), windows)
            rows = [
                (c.x_px, c.y_px, c.snr, context.model.peak_contrast(c.z_nm, c.mass_kda), c.mass_kda)
                for c in found
            ]
            return _candidate_table(r for r in rows if context.additive or wanted * r[3] >= 0)

        return Look(
            int(self._numbers[frame]),
            self._in_file(known.frames_before) if known.n_before else None,
            self._in_file(windows.frames_after),
            np.where(windows.masked, np.nan, image),
            context.templates.threshold,
            search,
        )


class MovingSearch:
    """Searches single frames for particles that are not in the median of the frames around."""

    def __init__(self, ready: Prepared) -> None:
        movie, config, camera = ready.steady, ready.config, ready.camera
        self._config, check = config, checked(movie, camera)
        self.frames = first, last = fitted_frames(movie, config)
        self.longest = last - first
        self.window = min(AROUND, self.longest)
        self._context = tracking_context(config, ready.shape, max(last - first, 1), ready.lines)

        @lru_cache(1)
        def background(span: tuple[int, int]) -> tuple[MovingField, BackgroundEstimate]:
            with threads(config.compute.workers) as pool:
                field = load_field(self._context, movie, camera, span, check, pool, silent)
                return field, initial_background(config, field)

        self._background = background

    def context(self, window: int) -> AnalysisContext:  # noqa: ARG002
        """Give models and threshold, which are those of every window."""
        return self._context

    def look(self, frame: int, window: int) -> Look:
        """Compare one frame with the median of those around it."""
        first, last = self.frames
        window = max(window, min(LEAST_FRAMES, last - first))
        frame = min(max(frame, first), last - 1)
        start = min(frame - (frame - first) % window, last - window)
        span = start, start + window
        field, ground = self._background(span)
        nothing = np.zeros(0, dtype=np.int64)
        rows = Localizations.of(nothing, nothing, np.zeros((0, 5)))
        here, context = frame - start, self._context
        light = ground.level * ground.power[here]
        image = field.residual(ground, rows, here, here + 1)[0] / light

        def search(threshold: float) -> pd.DataFrame:
            with threads(self._config.compute.workers) as pool:
                found = search_frames(
                    _with_threshold(context, threshold), field, ground, rows,
                    pool=pool, frames=(here, here + 1),
                )  # fmt: skip
            mass = np.asarray(context.model.scale.mass(found.strength))
            each = zip(found.x_px, found.y_px, found.snr, found.z_nm, mass, strict=True)
            return _candidate_table(
                (x, y, snr, context.model.peak_contrast(float(z), float(m)), m)
                for x, y, snr, z, m in each
            )

        return Look(
            frame, span, (frame, frame + 1), np.where(field.used, image, np.nan),
            context.templates.threshold, search,
        )  # fmt: skip


def _with_threshold(context: AnalysisContext, threshold: float) -> AnalysisContext:
    return replace(context, templates=replace(context.templates, threshold=threshold))


def _candidate_table(rows: Iterable[tuple[float, ...]]) -> pd.DataFrame:
    """Make a table of candidates, the strongest first."""
    values = np.array([tuple(map(float, row)) for row in rows]).reshape(-1, len(FOUND_COLUMNS))
    order = np.argsort(-np.abs(values[:, FOUND_COLUMNS.index("snr")]), kind="stable")
    return pd.DataFrame(values[order], columns=list(FOUND_COLUMNS))


def positive_threshold(threshold: float) -> float:
    """Refuse a threshold that is no positive number."""
    if not (math.isfinite(threshold) and threshold > 0):
        raise ConfigError(f"threshold = {threshold:g} must be a positive signal-to-noise ratio")
    return threshold
