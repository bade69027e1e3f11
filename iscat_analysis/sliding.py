"""Landing movies: sums that slide over the frames, where they jump, and at which frame.

The movie is summed once, in blocks of w/4 frames.  At every boundary between blocks the w frames
after it are set against the w before it; a particle that lands or leaves shows as a contrast that
rises and falls linearly within w frames of its step.  The statistic is the matched filter's
signal-to-noise ratio with the model's image, the root of twice the gain in log-likelihood.  Noise
of neighbouring boundaries is correlated by 5/8 only, so above any useful threshold each boundary
counts as an independent search.

The frame of a step comes from the likelihood of the amplitude of every single frame: Gaussian with
known noise and one change of mean, whose posterior over the frames (flat prior, amplitudes
profiled) gives the estimate and its interval (D. V. Hinkley, Biometrika 57, 1, 1970).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from iscat_analysis._kernels.sliding import (
    block_sums,
    contrast_map,
    frame_totals,
    region_scores,
    region_sum,
    step_peaks,
)
from iscat_analysis.camera import Camera
from iscat_analysis.records import BoolArray, FloatArray

MapArray = NDArray[np.float32]
Mapper = Callable[..., Iterable[Any]]
"""`map`, or the one of a pool."""

STRIDES = 4
"""Boundaries searched per window: a step midway between two loses an eighth of its height."""

LONGEST_WINDOW = 100
"""Frames that a window chosen from the noise may have; beyond it events overlap too often."""

SHORTEST_WINDOW = 10
"""Frames that it must have at least."""

SHORTEST_MOVIE = 4 * SHORTEST_WINDOW
"""Frames of the shortest movie for which windows are chosen."""

MOVIE_SHARE = 10
"""A window chosen from the noise takes at most this part of the movie."""

CREDIBLE = 0.95
"""Posterior probability inside the interval of a step's frame."""

SHOT_LIMITED = 1.2
"""Noise variance over shot noise up to which averaging is called shot-noise limited."""

_LENGTHS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100)
_SAMPLED = 0.85  # of a peak's height that the pixel next to it has at least
_ROWS = 16  # on which the noise is measured
_NORMAL_QUARTILE = 0.6744897501960817
_STEEP = 4.0  # (per-frame SNR)² at which about one frame around a step is doubtful


@dataclass(frozen=True)
class Chunk:
    """Consecutive frames in memory, with their power.

    Attributes
    ----------
    first : int
        Number of the first frame.
    counts : ndarray, shape (t, y, x)
        Stored counts.
    good : ndarray of bool, shape (t,)
        Frames that may be used; others are as if they did not exist.
    power : ndarray, shape (t,)
        Light of every frame over the mean; 0 where not good.
    camera : Camera
        Counts → photoelectrons.
    mean_e : ndarray, shape (y, x)
        Mean photoelectrons of a frame of unit power.
    usable : ndarray of bool, shape (y, x)
        Pixels that are neither defective nor saturated.
    saturated : ndarray of bool, shape (y, x)
        Pixels that were saturated in some frame.
    edges : ndarray of int, shape (k + 1,)
        Blocks, relative to `first`.
    blocks_e : ndarray, shape (k, y, x)
        Photoelectrons summed over each block.
    """

    first: int
    counts: NDArray[Any]
    good: BoolArray
    power: FloatArray
    camera: Camera
    mean_e: FloatArray
    usable: BoolArray
    saturated: BoolArray
    edges: NDArray[np.int64]
    blocks_e: FloatArray

    @property
    def stop(self) -> int:
        """One past the last frame."""
        return self.first + len(self.counts)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return int(self.counts.shape[1]), int(self.counts.shape[2])

    def cut(self, start: int, stop: int) -> slice:
        """Index of frames [start, stop), clipped to those held."""
        return slice(max(start - self.first, 0), max(min(stop, self.stop) - self.first, 0))

    def patch(
        self, start: int, stop: int, rows: tuple[int, int], columns: tuple[int, int]
    ) -> Patch:
        """Copy a region of frames together, for all that is asked of it.

        Parameters
        ----------
        start, stop : int
            Half-open range of frames, clipped to those held.
        rows, columns : (int, int)
            Half-open ranges of pixels.

        Returns
        -------
        Patch
            See there.
        """
        here, pixels = self.cut(start, stop), (slice(*rows), slice(*columns))
        camera = self.camera
        return Patch(
            first=self.first + here.start,
            counts=np.ascontiguousarray(self.counts[(here, *pixels)]),
            good=self.good[here],
            power=self.power[here],
            gain=_at(camera.gain_e_per_adu, pixels),
            offset=_at(camera.offset_adu, pixels),
            read_noise_e=_at(camera.read_noise_e, pixels),
            mean_e=self.mean_e[pixels],
            usable=self.usable[pixels],
        )


@dataclass(frozen=True)
class Patch:
    """A region of consecutive frames.

    Attributes
    ----------
    first : int
        Number of the first frame.
    counts : ndarray, shape (t, ny, nx)
        Stored counts.
    good, power : ndarray, shape (t,)
        As in `Chunk`.
    gain, offset, read_noise_e : float or ndarray, shape (ny, nx)
        Of the camera.
    mean_e, usable : ndarray, shape (ny, nx)
        As in `Chunk`.
    """

    first: int
    counts: NDArray[Any]
    good: BoolArray
    power: FloatArray
    gain: float | FloatArray
    offset: float | FloatArray
    read_noise_e: float | FloatArray
    mean_e: FloatArray
    usable: BoolArray

    def window(self, start: int, stop: int) -> tuple[FloatArray, int, float]:
        """Sum frames.

        Parameters
        ----------
        start, stop : int
            Half-open range, clipped to those held.

        Returns
        -------
        electrons : ndarray, shape (ny, nx)
            Summed photoelectrons [e].
        frames : int
            Good frames in the range.
        power : float
            Their power.
        """
        here = slice(max(start - self.first, 0), max(stop - self.first, 0))
        out = np.zeros(self.mean_e.shape)
        region_sum(self.counts[here], self.good[here], out)
        frames = int(np.count_nonzero(self.good[here]))
        return self.gain * (out - frames * self.offset), frames, float(self.power[here].sum())


@dataclass(frozen=True)
class NoiseCurve:
    """Noise of the contrast between neighbouring averages, against their length.

    Attributes
    ----------
    frames : tuple of int
        Lengths n.
    variance_over_shot : tuple of float
        Robust variance of the contrast over that of shot noise; rises where averaging no longer
        helps.
    """

    frames: tuple[int, ...]
    variance_over_shot: tuple[float, ...]

    @property
    def shot_limited(self) -> int:
        """Longest average that is shot-noise limited, and every shorter one too; 0 for none."""
        limit = 0
        for n, ratio in zip(self.frames, self.variance_over_shot, strict=True):
            if ratio > SHOT_LIMITED * max(1.0, self.variance_over_shot[0]):
                break
            limit = n
        return limit

    @property
    def best(self) -> int:
        """Length whose contrast is least noisy."""
        noise = [r / n for n, r in zip(self.frames, self.variance_over_shot, strict=True)]
        return self.frames[int(np.argmin(noise))]


def measure_noise(counts: NDArray[Any], camera: Camera, longest: int) -> NoiseCurve:
    """Noise of averages over frames, as the Allan deviation has it: neighbours are compared.

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Consecutive good frames.
    camera : Camera
        Counts → photoelectrons.
    longest : int
        Longest average wanted.

    Returns
    -------
    NoiseCurve
        For the lengths of which two fit into the frames.

    Notes
    -----
    D. W. Allan, Proc. IEEE 54, 221 (1966).  Variances are from the median deviation, so that
    particles, which cover few pixels at a time, do not count as noise.
    """
    rows = np.linspace(0, counts.shape[1] - 1, min(_ROWS, counts.shape[1])).astype(int)
    strip = counts[:, rows]
    shape = (counts.shape[1], counts.shape[2])
    gain, offset = (
        np.broadcast_to(v, shape)[rows] for v in (camera.gain_e_per_adu, camera.offset_adu)
    )
    read = camera.read_variance_e2(shape)[rows]
    lengths, ratios = [], []
    for n in (*_LENGTHS[:-1], max(longest, 1)):
        pairs = len(strip) // (2 * n)
        if n > longest or not pairs or n in lengths:
            continue
        used = strip[: 2 * n * min(pairs, 8)]
        sums = gain * (
            np.add.reduceat(used, np.arange(0, len(used), n), axis=0, dtype=np.float64) - n * offset
        )
        before, after = sums[0::2], sums[1::2]
        lit = np.all(sums > 0, axis=0)
        before, after = before[:, lit], after[:, lit]
        power = after.sum(axis=1, keepdims=True) / before.sum(axis=1, keepdims=True)
        contrast = after / (power * before) - 1
        variance = (before + n * read[lit]) / before**2 + (after + n * read[lit]) / after**2
        deviation = float(np.median(np.abs(contrast) / np.sqrt(variance)))
        lengths.append(n)
        ratios.append((deviation / _NORMAL_QUARTILE) ** 2)
    return NoiseCurve(tuple(lengths), tuple(ratios))


def choose_window(curve: NoiseCurve, frames: int) -> int:
    """Choose the window from the noise.

    Parameters
    ----------
    curve : NoiseCurve
        Of the movie.
    frames : int
        Its length.

    Returns
    -------
    int
        The length whose contrast is least noisy, at most a tenth of the movie.
    """
    return max(SHORTEST_WINDOW, min(curve.best, longest_window(frames)))


def longest_window(frames: int) -> int:
    """Longest window that is chosen for a movie.

    Parameters
    ----------
    frames : int
        Frames in the movie.

    Returns
    -------
    int
        Frames.
    """
    return max(SHORTEST_WINDOW, min(LONGEST_WINDOW, frames // MOVIE_SHARE))


def measure_frames(
    counts: NDArray[Any], camera: Camera, *, mapper: Mapper = map
) -> tuple[FloatArray, BoolArray]:
    """Light of every frame, and which frames repeat the one before them.

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Consecutive frames.
    camera : Camera
        Counts → photoelectrons.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    light_e : ndarray, shape (t,)
        Mean photoelectrons per pixel; a frame that is zero throughout has −∞.
    repeats : ndarray of bool, shape (t,)
        Bytes equal to the frame before.
    """
    whole = np.issubdtype(counts.dtype, np.integer)
    totals = np.empty(len(counts), dtype=np.int64 if whole else np.float64)
    repeats = np.zeros(len(counts), dtype=np.bool_)
    zero = totals.dtype.type(0)

    def some(start: int) -> None:
        # one frame more in front, so that the first of these is compared as well
        begin = max(start - 1, 0)
        part = counts[begin : start + 64]
        sums, same = np.empty(len(part), dtype=totals.dtype), np.empty(len(part), dtype=np.bool_)
        frame_totals(part, zero, sums, same)
        skip = start - begin
        totals[start : start + len(part) - skip] = sums[skip:]
        repeats[start : start + len(part) - skip] = same[skip:]

    for _ in mapper(some, range(0, len(counts), 64)):
        pass
    pixels = counts.shape[1] * counts.shape[2]
    maps = np.ndim(camera.gain_e_per_adu) > 0
    if maps:
        gain = np.asarray(camera.gain_e_per_adu, dtype=np.float64)
        weighted = np.array([float(np.vdot(gain, frame)) for frame in counts])
        light = (weighted - float(np.sum(gain * camera.offset_adu))) / pixels
    else:
        light = camera.gain_e_per_adu * (totals / pixels - float(np.mean(camera.offset_adu)))
    return np.where(totals == 0, -np.inf, light), repeats


def make_chunk(
    first: int,
    counts: NDArray[Any],
    good: BoolArray,
    light_e: FloatArray,
    camera: Camera,
    *,
    stride: int,
    defects: Callable[[FloatArray, FloatArray], BoolArray],
    mapper: Mapper = map,
) -> Chunk:
    """Sum consecutive frames in blocks.

    Parameters
    ----------
    first : int
        Number of the first frame.
    counts : ndarray, shape (t, y, x)
        The frames.
    good : ndarray of bool, shape (t,)
        Frames that may be used.
    light_e : ndarray, shape (t,)
        From `measure_frames`.
    camera : Camera
        Counts → photoelectrons.
    stride : int
        Frames per block; the last may be shorter.
    defects : callable
        Summed photoelectrons and their read-noise variance → dead and hot pixels.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    Chunk
        Ready to be searched.
    """
    frames, rows, columns = counts.shape
    edges = np.append(np.arange(0, frames, stride), frames).astype(np.int64)
    blocks = np.empty((edges.size - 1, rows, columns))
    whole = np.issubdtype(counts.dtype, np.integer)
    narrow = counts.dtype.itemsize <= 2
    scratch = (np.uint32 if narrow else np.int64) if whole else np.float64
    highest = np.empty((edges.size - 1, rows, columns), dtype=counts.dtype)

    def one(k: int) -> None:
        part = slice(edges[k], edges[k + 1])
        start = int(np.argmax(good[part])) + int(edges[k])
        highest[k] = counts[start]
        block_sums(
            counts[part], good[part], np.empty((rows, columns), dtype=scratch),
            blocks[k], highest[k],
        )  # fmt: skip

    for _ in mapper(one, range(edges.size - 1)):
        pass
    saturated = camera.saturated(highest.max(axis=0))
    n = np.add.reduceat(good.astype(np.int64), edges[:-1])
    blocks -= n[:, None, None] * np.asarray(camera.offset_adu)
    blocks *= camera.gain_e_per_adu
    power = np.where(good, light_e, 0.0)
    power /= power[good].mean()
    total = blocks.sum(axis=0)
    variance = camera.read_variance_e2((rows, columns))
    usable = ~(saturated | defects(total, n.sum() * variance)) & (total > 0)
    return Chunk(
        first, counts, good, power, camera, total / power.sum(), usable, saturated, edges, blocks
    )


@dataclass(frozen=True)
class Filter:
    """Matched filter of one chunk; the weights are those of its mean image.

    Attributes
    ----------
    spectrum : ndarray
        Of the reversed template.
    size : (int, int)
        Of the transforms.
    half : int
        Half the template's side [pixels].
    weight : ndarray, shape (y, x)
        Information of a pixel about its contrast, per frame of unit power; 0 where not used.
    norm : ndarray, shape (y, x)
        Information about the amplitude, per frame.
    """

    spectrum: NDArray[np.complex64]
    size: tuple[int, int]
    half: int
    weight: MapArray
    norm: MapArray


def make_filter(chunk: Chunk, template: FloatArray) -> Filter:
    """Prepare the matched filter.

    Parameters
    ----------
    chunk : Chunk
        Gives the weights.
    template : ndarray, shape (k, k)
        Contrast per unit amplitude, k odd.

    Returns
    -------
    Filter
        See there.
    """
    rows, columns = chunk.shape
    half = template.shape[0] // 2
    size = (
        fft.next_fast_len(rows + half, real=True),
        fft.next_fast_len(columns + half, real=True),
    )
    mean = np.where(chunk.usable, chunk.mean_e, 0.0)
    read = chunk.camera.read_variance_e2(chunk.shape)
    weight = np.zeros(size)
    weight[:rows, :columns] = mean**2 / np.where(chunk.usable, mean + read, 1.0)
    scale = math.sqrt(float(np.sum(template**2)))  # keeps single precision in range
    reversed_ = np.zeros((2, *size))
    k = template.shape[0]
    flipped = template[::-1, ::-1]
    reversed_[0, :k, :k] = flipped
    reversed_[1, :k, :k] = (flipped / scale) ** 2
    # the template's centre belongs at the origin, so that nothing is shifted
    spectra = fft.rfft2(np.roll(reversed_, (-half, -half), axis=(1, 2)))
    norm = fft.irfft2(fft.rfft2(weight) * spectra[1], s=size)[:rows, :columns] * scale**2
    norm = np.maximum(norm, 1e-6 * norm.max())
    return Filter(
        spectra[0].astype(np.complex64),
        size,
        half,
        weight[:rows, :columns].astype(np.float32),
        norm.astype(np.float32),
    )


def sliding_maps(
    chunk: Chunk,
    matched: Filter,
    strides: int,
    *,
    explained: Callable[[int, slice, slice], FloatArray | None] | None = None,
    mapper: Mapper = map,
) -> tuple[MapArray, FloatArray]:
    """Signal-to-noise ratio of a step at every boundary between blocks and every pixel.

    Parameters
    ----------
    chunk : Chunk
        The sums.
    matched : Filter
        From `make_filter`.
    strides : int
        Blocks in a window; fewer near the ends.
    explained : callable, optional
        Boundary, and the frames before and after → contrast of known events, or None for none.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    snr : ndarray of float32, shape (k − 1, y, x)
        Map j belongs to a step at ``edges[j + 1]``.
    frames : ndarray, shape (k − 1,)
        Effective frames: information at a boundary is `Filter.norm` times this.
    """
    count = chunk.edges.size - 2
    rows, columns = chunk.shape
    snr = np.empty((count, rows, columns), dtype=np.float32)
    block_power = np.add.reduceat(chunk.power, chunk.edges[:-1])
    effective = np.zeros(count)

    def one(j: int) -> None:
        low, middle, high = max(j + 1 - strides, 0), j + 1, min(j + 1 + strides, count + 1)
        powers = block_power[low:middle].sum(), block_power[middle:high].sum()
        if min(powers) <= 0:
            snr[j] = 0.0
            return
        before = chunk.blocks_e[low:middle].sum(axis=0)
        after = chunk.blocks_e[middle:high].sum(axis=0)
        image = np.zeros(matched.size, dtype=np.float32)
        contrast_map(before, after, matched.weight, image)
        if explained is not None:
            known = explained(
                j,
                slice(int(chunk.edges[low]), int(chunk.edges[middle])),
                slice(int(chunk.edges[middle]), int(chunk.edges[high])),
            )
            if known is not None:
                image[:rows, :columns] -= (matched.weight * known).astype(np.float32)
        spectrum = fft.rfft2(image)
        spectrum *= matched.spectrum
        overlap = fft.irfft2(spectrum, s=matched.size)[:rows, :columns]
        effective[j] = powers[0] * powers[1] / (powers[0] + powers[1])
        np.divide(overlap * math.sqrt(effective[j]), np.sqrt(matched.norm), out=snr[j])

    for _ in mapper(one, range(count)):
        pass
    return snr, effective


@dataclass(frozen=True)
class Peak:
    """A place and a boundary at which the contrast seems to step.

    Attributes
    ----------
    frame : int
        The boundary.
    x_px, y_px : float
        Sub-pixel position.
    snr : float
        With its sign.
    amplitude : float
        Linear estimate, with its sign.
    """

    frame: int
    x_px: float
    y_px: float
    snr: float
    amplitude: float


def find_steps(
    chunk: Chunk,
    matched: Filter,
    snr: MapArray,
    effective: FloatArray,
    threshold: float,
    *,
    polarity: int = 0,
) -> list[Peak]:
    """Peaks in (t, y, x) above the threshold, strongest first.

    Parameters
    ----------
    chunk : Chunk
        The sums.
    matched : Filter
        From `make_filter`.
    snr : ndarray, shape (n, y, x)
        From `sliding_maps`.
    effective : ndarray
        From `sliding_maps`.
    threshold : float
        Least signal-to-noise ratio, between the pixels: where the field peaks, not where it is
        sampled, it exceeds the threshold as often as the theory of smooth fields has it.
    polarity : int
        Sign wanted, 0 for both.

    Returns
    -------
    list of Peak
        With sub-pixel positions.
    """
    peaks = []
    for k, i, j in step_peaks(snr, _SAMPLED * threshold, polarity):
        value = float(snr[k, i, j])
        image = snr[k] * np.sign(value)
        (dy, above), (dx, beside) = _vertex(image[:, j], int(i)), _vertex(image[i], int(j))
        height = math.copysign(abs(value) + above + beside, value)
        if abs(height) <= threshold:
            continue
        amplitude = height / math.sqrt(float(effective[k]) * float(matched.norm[i, j]))
        boundary = chunk.first + int(chunk.edges[k + 1])
        peaks.append(Peak(boundary, float(j + dx), float(i + dy), height, amplitude))
    return sorted(peaks, key=lambda p: -abs(p.snr))


@dataclass(frozen=True)
class StepFrame:
    """The frame of a step.

    Attributes
    ----------
    frame : int
        First frame of the new state.
    half_width : int
        The interval `frame` ± `half_width` holds at least 95 % of the posterior.
    height : float
        Step in units of the template that was used.
    per_frame_snr : float
        Its height over the noise of one frame.
    """

    frame: int
    half_width: int
    height: float
    per_frame_snr: float

    @property
    def gap(self) -> int:
        """Frames on either side of the step that may belong to the other state.

        They stay out of the fit: where the frame was chosen by their noise, that noise would
        count as signal.
        """
        return round(_STEEP / max(self.per_frame_snr, 0.5) ** 2)


def locate_step(
    patch: Patch,
    image: FloatArray,
    search: tuple[int, int],
    *,
    known: FloatArray | None = None,
) -> StepFrame:
    """Find the frame of a step by the likelihood of the frames around it.

    Parameters
    ----------
    patch : Patch
        The frames; one step alone must lie in them.
    image : ndarray, shape (ny, nx)
        Contrast that appears.
    search : (int, int)
        Frames that may be the first of the new state, half-open.
    known : ndarray, shape (t,), optional
        Height that other events add to each frame, in units of `image`; from `crosstalk`.

    Returns
    -------
    StepFrame
        The most likely frame and its interval.
    """
    weights, scale = _projector(patch, image)
    scores = np.empty(len(patch.counts))
    region_scores(patch.counts, weights * patch.gain, scores)
    power = patch.power
    lit = power > 0
    zero = float(np.sum(weights * patch.gain * patch.offset))
    heights = (scores - zero) / np.where(lit, power, 1.0) / scale
    if known is not None:
        heights = heights - known
    weight = np.where(lit, power, 0.0) * scale
    n = np.cumsum(weight)
    total = np.cumsum(weight * heights)
    before, after = n[:-1], n[-1] - n[:-1]
    usable = (before > 0) & (after > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        jump = np.where(usable, (total[-1] - total[:-1]) / after - total[:-1] / before, 0.0)
    gain_in_log = 0.5 * before * after / n[-1] * jump**2 * (jump > 0)
    frames = np.arange(patch.first + 1, patch.first + heights.size)
    inside = (frames >= search[0]) & (frames < search[1]) & usable
    if not inside.any():
        middle = int(np.clip((search[0] + search[1]) // 2, frames[0], frames[-1]))
        return StepFrame(middle, search[1] - search[0], 0.0, 0.0)
    log = np.where(inside, gain_in_log, -np.inf)
    best = int(np.argmax(log))
    posterior = np.exp(log - log[best])
    posterior /= posterior.sum()
    distance = np.abs(frames - frames[best])
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(posterior[order])
    half_width = int(distance[order][np.searchsorted(held, CREDIBLE * (1 - 1e-12))])
    height = float(jump[best])
    return StepFrame(int(frames[best]), half_width, height, abs(height) * math.sqrt(scale))


def crosstalk(patch: Patch, image: FloatArray, other: FloatArray) -> float:
    """Height that another particle's contrast adds to a frame, in units of `image`.

    Parameters
    ----------
    patch : Patch
        Gives the weights.
    image, other : ndarray, shape (ny, nx)
        Contrasts.

    Returns
    -------
    float
        To be taken off in `locate_step`.
    """
    weights, scale = _projector(patch, image)
    return float(np.sum(weights * patch.mean_e * other)) / scale


def measure_drift(reference_e: FloatArray, later_e: FloatArray) -> tuple[float, float]:
    """Shift of the fixed pattern between two mean images, by phase correlation.

    Parameters
    ----------
    reference_e, later_e : ndarray, shape (y, x)
        Mean images.

    Returns
    -------
    dy_px, dx_px : float
        How far the later pattern moved; NaN where there is no pattern to follow.

    Notes
    -----
    C. D. Kuglin and D. C. Hines, Proc. IEEE Conf. Cybernetics and Society, 163 (1975).  Below a
    pixel the phase of the cross-spectrum is fitted by a plane, weighted by its strength.
    """
    rows, columns = reference_e.shape
    taper = np.outer(np.hanning(rows), np.hanning(columns))
    one, two = (fft.rfft2(taper * (image / image.mean() - 1)) for image in (reference_e, later_e))
    cross = two * np.conj(one)
    magnitude = np.abs(cross)
    if not magnitude.max() > 0:
        return math.nan, math.nan
    surface = fft.irfft2(cross / np.maximum(magnitude, 1e-12 * magnitude.max()), s=taper.shape)
    at = np.unravel_index(int(np.argmax(surface)), surface.shape)
    y, x = (int((i + n // 2) % n - n // 2) for i, n in zip(at, taper.shape, strict=True))
    fy, fx = np.meshgrid(fft.fftfreq(rows), fft.rfftfreq(columns), indexing="ij")
    left = cross * np.exp(2j * np.pi * (fy * y + fx * x))
    weight = np.abs(left) * (np.hypot(fy, fx) < 0.25)
    angle = np.angle(left)
    a = np.array([[np.sum(weight * u * v) for v in (fy, fx)] for u in (fy, fx)])
    b = np.array([np.sum(weight * u * angle) for u in (fy, fx)])
    dy, dx = np.linalg.lstsq(a, -b / (2 * np.pi), rcond=None)[0]
    return float(y + dy), float(x + dx)


def _projector(patch: Patch, image: FloatArray) -> tuple[FloatArray, float]:
    """Weights that measure the amplitude of an image and ignore a common level, and their scale."""
    used = patch.usable
    mean = np.where(used, patch.mean_e, 0.0)
    share = mean / np.where(used, mean + np.square(patch.read_noise_e), 1.0)
    light = mean * share
    level = float(np.sum(light * image)) / max(float(light.sum()), 1e-300)
    weights = np.where(used, share * (image - level), 0.0)
    return weights, max(float(np.sum(weights * mean * image)), 1e-300)


def _at(value: float | FloatArray, here: tuple[slice, slice]) -> Any:
    """Return a number, or the region of a map."""
    return value[here] if isinstance(value, np.ndarray) else value


def _vertex(line: NDArray[Any], index: int) -> tuple[float, float]:
    """Vertex of the parabola through a maximum and its neighbours, and its height above it."""
    if not 0 < index < line.size - 1:
        return 0.0, 0.0
    low, mid, high = (float(v) for v in line[index - 1 : index + 2])
    bend = low - 2 * mid + high
    if bend >= 0:
        return 0.0, 0.0
    shift = float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5))
    return shift, 0.25 * (high - low) * shift
