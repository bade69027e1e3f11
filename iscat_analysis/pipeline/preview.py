"""What one looks at before a movie is analysed: the search of `analyse`, and a ratiometric film.

The frames, windows, matched filter and threshold are those with which `analyse` begins, because
both prepare the movie by the same steps (`calibrated`); nothing is fitted.  The optics are the
configured ones: learning them takes fits of particles.

Frames of the film are read when they are needed, and the two sums follow a player from frame to
frame, so that a movie of any length is played with the memory of two images.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis._kernels.sliding import contrast_map
from iscat_analysis.camera import measure_windows, start_power
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import Prepared, calibrated, judge_background, survey_over
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import printing
from iscat_analysis.fitting.context import AnalysisContext, make_context, reported_steps
from iscat_analysis.fitting.events import contrast_image
from iscat_analysis.fitting.field import search_field
from iscat_analysis.fitting.pattern import SPAN, corrected
from iscat_analysis.fitting.ranges import (
    BackgroundMode,
    checked,
    fitted_frames,
    frame_ranges,
    measured_windows,
)
from iscat_analysis.inference.checks import number_in
from iscat_analysis.landing.maps import SidelobeFilter
from iscat_analysis.movie import Stack
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


_SEARCHES: Mapping[BackgroundMode, Callable[[Prepared], Search]] = {
    "fixed": BeforeAfterSearch,
    "sliding": LandingSearch,
    "tracks": MovingSearch,
}


class Preview:
    """The search for particles in the frames that one is looking at.

    A landing movie is searched for what lands or leaves between two windows, those just before a
    frame and those from it on; a movie with background frames for what is there in the frames from
    it on; a movie of moving particles in the frame itself.

    Parameters
    ----------
    movie : Stack
        From `open_stack`; it must stay open.
    config : Config
        As for `fit_movie`.

    Attributes
    ----------
    config : Config
        With what the movie's metadata and its frames say.
    notes : tuple of str
        What an analysis would warn of before its search, one line each.
    camera : LearnedCamera
        Its numbers, and where they come from.
    steady : Stack
        The frames with what is unsteady in their light divided out.
    prepared : Prepared
        All that an analysis knows of the movie before it learns the optics.

    Raises
    ------
    DataError
        The movie is too short, or its frames are impossible.
    ConfigError
        The configuration does not suit the movie.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> with ia.open_stack("movie.tif") as movie:  # doctest: +SKIP
    ...     look = ia.Preview(movie, ia.configure("C.toml")).look(200)
    ...     look.found(threshold=5.0)
    """

    def __init__(self, movie: Stack, config: Config) -> None:
        if not isinstance(movie, Stack) or not isinstance(config, Config):
            raise ConfigError(
                f"`movie` is {type(movie).__name__} and `config` {type(config).__name__}: give "
                "what open_stack and configure return"
            )
        notes: list[str] = []
        self.prepared = calibrated(movie, config, report=printing(notes.append))
        self.config = self.prepared.over_all_stretches().config
        self.notes = tuple(notes)
        self.camera, self.steady = self.prepared.known, self.prepared.steady
        dark = self.config.optics.scheme == "darkfield"  # each frame by itself
        self._search = _SEARCHES["fixed" if dark else self.prepared.background_mode](self.prepared)
        self._lock = threading.Lock()  # a viewer may ask from several threads

    @property
    def window(self) -> int:
        """Frames that `analyse` sums: as configured, or chosen from the noise."""
        return self._search.window

    @property
    def longest(self) -> int:
        """Frames that a window may have at most."""
        return self._search.longest

    @property
    def frames(self) -> tuple[int, int]:
        """Frames that `analyse` looks at, half-open."""
        return self._search.frames

    def threshold(self, window: int | None = None) -> float:
        """Give the threshold that is configured.

        Parameters
        ----------
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        float
            Signal-to-noise ratio.
        """
        return self._search.context(self._checked(window)).templates.threshold

    def false_alarms(self, threshold: float, window: int | None = None) -> float:
        """Say how many false alarms a threshold would bring.

        Parameters
        ----------
        threshold : float
            Signal-to-noise ratio.
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        float
            Expected in the whole movie: the ``detection.false_alarms_per_movie`` that has this
            threshold.
        """
        templates = self._search.context(self._checked(window)).templates
        above = templates.excursions.above
        share = above(positive_threshold(threshold)) / above(templates.threshold)
        return self.config.detection.false_alarms_per_movie * share

    def look(self, frame: int, window: int | None = None) -> Look:
        """Search the frames around one.

        Parameters
        ----------
        frame : int
            Number of the frame.
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        Look
            Contrast, threshold, and what exceeds it.

        Raises
        ------
        DataError
            The frames cannot be read or are impossible.
        ConfigError
            The window is not one of 1 to `longest`.
        """
        number = int(number_in("`frame`", frame, whole=True))
        with self._lock:
            return self._search.look(number, self._checked(window))

    def _checked(self, window: int | None) -> int:
        if window is None:
            return self.window
        return int(number_in("window", window, least=1, most=self.longest, whole=True))


_SAMPLED = 5  # frames from which limits of the contrast are taken, at most
_READ_BYTES = 2**29  # of frames that are looked at before a movie is shown, for either purpose
_INSIDE = (0.001, 0.999)  # quantiles of the pixels that such limits leave inside


def film_limits(
    image: Callable[[int], NDArray[Any]], frames: tuple[int, int], most: int = _SAMPLED
) -> tuple[float, float]:
    """Give the limits between which most of the pixels of a few frames of a film lie."""
    looked = np.unique(np.linspace(frames[0], frames[1] - 1, most).astype(int))
    seen = np.concatenate([np.ravel(image(int(t))) for t in looked]).astype(np.float64)
    seen = seen[np.isfinite(seen)]
    low, high = np.quantile(seen, _INSIDE) if seen.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


class RatioFilm:
    """The ratiometric film of a movie, in which particles appear as they land.

    Each frame is divided by its mean first, so that a flickering laser does not show.  Counts are
    above `offset_adu`: with the wrong one every contrast is wrong by the same factor.
    """

    def __init__(self, movie: Stack, *, window: int = 1, offset_adu: float = 0.0) -> None:
        self.movie = movie
        self._offset = float(offset_adu)
        self._window = 0
        self._at = -1
        shape = movie.shape[1:]
        self._before, self._after = np.zeros(shape), np.zeros(shape)
        self.window = window

    @property
    def window(self) -> int:
        """Frames in each of the two means."""
        return self._window

    @window.setter
    def window(self, frames: int) -> None:
        """Take means of so many frames from now on."""
        frames = int(number_in("`window`", frames, least=1, most=self.longest, whole=True))
        if frames != self._window:
            self._window, self._at = frames, -1

    @property
    def offset_adu(self) -> float:
        """Counts of a pixel without light."""
        return self._offset

    @offset_adu.setter
    def offset_adu(self, counts: float) -> None:
        """Take contrasts over another offset from now on."""
        self._offset, self._at = float(counts), -1

    @property
    def longest(self) -> int:
        """Frames that a window may have at most."""
        return self.movie.shape[0] // 2

    @property
    def frames(self) -> tuple[int, int]:
        """Frames that have a whole window before and after them, half-open."""
        return self._window, self.movie.shape[0] - self._window + 1

    def raw(self, frame: int) -> FloatArray:
        """Give the counts of a frame.

        Shapes: result (y, x).
        """
        frame = min(max(frame, 0), self.movie.shape[0] - 1)
        return np.asarray(self.movie.read(frame, frame + 1)[0], dtype=np.float64)

    def contrast(self, frame: int) -> FloatArray:
        """Give the mean from a frame on over the mean before it, minus 1.

        Shapes: result (y, x).
        """
        first, stop = self.frames
        frame = min(max(frame, first), stop - 1)
        step = frame - self._at
        if self._at < 0 or abs(step) > self._window // 2:
            self._sum_anew(frame)
        else:
            while self._at < frame:
                self._forward()
            while self._at > frame:
                self._backward()
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self._after / self._before - 1.0)

    def light(self, most: int = 400) -> pd.DataFrame:
        """Give light and noise of frames all over the movie, at most so many, fewer of large ones.

        Columns: frame, light [counts above the offset, mean of the pixels], noise (standard
        deviation of the contrast of this frame to the next, of one frame).
        """
        last, most = self.movie.shape[0] - 2, self._affordable(2, most)
        rows = []
        for frame in np.unique(np.linspace(0, last, min(most, last + 1)).astype(int)):
            pair = self.movie.read(int(frame), int(frame) + 2).astype(np.float64) - self._offset
            light = pair.mean(axis=(1, 2))
            with np.errstate(divide="ignore", invalid="ignore"):
                change = (pair[1] / light[1]) / (pair[0] / light[0])
            change = change[np.isfinite(change)]
            noise = float(np.std(change)) / math.sqrt(2) if change.size else math.nan
            rows.append((int(frame), float(light[0]), noise))
        return pd.DataFrame(rows, columns=["frame", "light", "noise"])

    def limits(self, *, ratio: bool) -> tuple[float, float]:
        """Give the limits between which most of the pixels of a few frames lie.

        Those of the contrast are as far above 0 as below.
        """
        if not ratio:
            return film_limits(self.raw, (0, self.movie.shape[0]))
        looks = self._affordable(2 * self._window, _SAMPLED)
        low, high = film_limits(self.contrast, self.frames, looks)
        most = max(abs(low), abs(high)) or 1.0
        return -most, most

    def _affordable(self, frames: int, most: int) -> int:
        """Say how many looks at so many frames may be taken."""
        frame_bytes = math.prod(self.movie.shape[1:]) * self.movie.dtype.itemsize
        return min(most, max(1, _READ_BYTES // (frames * frame_bytes)))

    def _frame(self, number: int) -> FloatArray:
        counts: FloatArray = self.movie.read(number, number + 1)[0].astype(np.float64)
        counts -= self._offset
        light = float(counts.mean())
        if not light > 0:
            raise ConfigError(
                f"{self.movie.name}: frame {number} is no brighter than camera.offset_adu = "
                f"{self._offset:g}: correct the offset"
            )
        counts /= light
        return counts

    def _sum_anew(self, frame: int) -> None:
        self._before[:], self._after[:] = 0.0, 0.0
        for number in range(frame - self._window, frame):
            self._before += self._frame(number)
        for number in range(frame, frame + self._window):
            self._after += self._frame(number)
        self._at = frame

    def _forward(self) -> None:
        passing = self._frame(self._at)
        self._before += passing
        self._before -= self._frame(self._at - self._window)
        self._after += self._frame(self._at + self._window)
        self._after -= passing
        self._at += 1

    def _backward(self) -> None:
        self._at -= 1
        passing = self._frame(self._at)
        self._before -= passing
        self._before += self._frame(self._at - self._window)
        self._after += passing
        self._after -= self._frame(self._at + self._window)
