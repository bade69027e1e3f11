"""Drift: how far the fixed pattern of a movie moves, and the pattern moved.

Speckle moves with the sample, so that after over before holds B(x − d_a)/B(x − d_b), a false
contrast −∇B·(d_a − d_b)/B, beside that of particles.  Counts are never interpolated: they would be
Poisson no longer.  The *expectation* is: the pattern, an average over many frames, is moved to
where it was in either window, and the ratio of the two is a known factor of the likelihood.

What moves is the sample: the light that falls on it stays where it is.  B is E(x) S(x − d), and E
is taken for what is left of B where it is smoothed over more than speckle.

The way is followed block by block.  Each is set against the one before it, by least squares
weighted by shot noise; particles, which cover few pixels, are clipped.  Noise of block k
enters d_k as a linear functional L of that noise, and every later shift through L as well, so that
it does not add up along the way, and the shift between two windows is the one that fits *these*
windows best: two degrees of freedom of their noise, out of as many as there are pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

from iscat_analysis.medians import SIGMA_PER_MAD, median_3x3, robust_sigma
from iscat_analysis.records import BoolArray, ComplexArray, FloatArray, Mapper

REACH_PX = 4
"""From the edges of a field, within which a moved pattern is not to be trusted."""

_SETTLED_PX = 1e-5
_SLOPE_VARIANCE = 130 / 144  # of `_slopes`, over that of a pixel


def middle_of(shape: tuple[int, ...], most_px: int) -> tuple[slice, slice]:
    """Index the middle of a large field, at most so many pixels wide: it moves as all of it does.

    Shapes: the last two axes of `shape` are (y, x).
    """
    held = ((size, min(size, most_px)) for size in shape[-2:])
    rows, columns = (slice((size - kept) // 2, (size + kept) // 2) for size, kept in held)
    return rows, columns


@dataclass(frozen=True)
class Trajectory:
    """Shift of the fixed pattern with time."""

    frames: FloatArray
    shift_px: FloatArray
    error_px: FloatArray

    @property
    def typical_error_px(self) -> float:
        """Median standard error of a block's shift along the worse axis [pixels]."""
        return float(np.median(self.error_px.max(axis=1)))

    def at(self, frames: FloatArray | float) -> FloatArray:
        """Shift in some frames, shape (…, 2); linear between blocks and beyond them."""
        at, known = np.asarray(frames, dtype=float), self.frames
        if known.size < 2:
            return np.broadcast_to(self.shift_px[0], (*at.shape, 2)).copy()
        k = np.clip(np.searchsorted(known, at) - 1, 0, known.size - 2)
        share = ((at - known[k]) / (known[k + 1] - known[k]))[..., None]
        return (1 - share) * self.shift_px[k] + share * self.shift_px[k + 1]


def follow_pattern(
    blocks_e: NDArray[np.floating],
    power: FloatArray,
    frames: FloatArray,
    usable: BoolArray,
    read_variance_e2: FloatArray,
    *,
    mapper: Mapper = map,
) -> Trajectory | None:
    """Measure the shift of the fixed pattern from block to block.

    Shapes: `blocks_e` (k, y, x), `power` (k,), `frames` (k,), `usable` (y, x), `read_variance_e2`
    (y, x).
    """
    lit = np.flatnonzero(power > 0)
    nearest = filling(usable)
    still = still_light(blocks_e, usable)
    # of a count divided by E < 1 the variance is more than that of a count, as by read noise
    light = blocks_e[lit].sum(axis=0, dtype=float) / (max(power[lit].sum(), 1e-300) * still)
    noise = light * (1 / still - 1) + read_variance_e2 / still**2
    usable = trusted(usable)
    mover = Mover((usable.shape[0], usable.shape[1]))

    def one(number: int) -> tuple[FloatArray, FloatArray, float]:
        here, before = lit[number], lit[number - 1]
        pattern, image = (blocks_e[before] / still)[nearest], blocks_e[here] / still
        reads = power[before] * noise, power[here] * noise
        return _register(mover, pattern, image, usable, *reads, float(power[here] / power[before]))

    found = list(mapper(one, range(1, lit.size)))
    if not found or not np.median([clear for _, _, clear in found]) > 1.0:  # of that of its noise
        return None
    steps, errors = (np.array([each[k] for each in found]) for k in (0, 1))
    shift = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return Trajectory(frames[lit], shift, np.vstack([errors[:1], errors]))


def _register(
    mover: Mover,
    pattern: FloatArray,
    image: FloatArray,
    usable: BoolArray,
    pattern_read: FloatArray,
    image_read: FloatArray,
    ratio: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Shift (y, x) of an image against a pattern, its error, and how clear the pattern is."""
    spectrum = mover.spectrum(pattern)
    nowhere = math.inf, np.zeros(2), np.full(2, math.inf), 0.0

    def refined(shift: FloatArray) -> tuple[float, FloatArray, FloatArray, float]:
        for _ in range(4):  # passes settle
            moved = pattern
            if shift.any():
                moved = mover.image(spectrum * mover.transfer(shift[None], np.ones(1)))
            expected = ratio * moved
            variance = (1 + ratio) * expected + image_read + ratio**2 * pattern_read
            lit = usable & (expected > 0)
            deviation = np.full(moved.shape, np.nan)
            noise = np.sqrt(np.maximum(variance, 0.0))
            np.divide(image - expected, noise, where=lit, out=deviation)
            some = np.abs(deviation[::2, ::3])
            if np.isnan(some).all():
                return nowhere
            scale = max(SIGMA_PER_MAD * float(np.nanmedian(some)), 1.0)
            z = np.where(np.abs(deviation) <= 4.0 * scale, deviation, np.nan)[2:-2, 2:-2]
            used = np.isfinite(z)
            per = ratio / np.sqrt(variance[2:-2, 2:-2][used])
            slopes = np.stack([*(-step[used] for step in _slopes(moved)), moved[2:-2, 2:-2][used]])
            slopes *= per
            own = (moved + pattern_read)[2:-2, 2:-2][used]
            spurious = _SLOPE_VARIANCE * float(per**2 @ own)  # that the noise of slopes adds
            normal, right = slopes @ slopes.T, slopes @ z[used]
            normal[[0, 1], [0, 1]] -= spurious
            clear = float(normal[0, 0] + normal[1, 1]) / max(2 * spurious, 1e-300)
            if not clear > 0 or np.linalg.eigvalsh(normal)[0] <= 0:
                return nowhere
            inverse = np.linalg.inv(normal)
            step = (inverse @ right)[:2]
            shift = shift + step
            if np.hypot(*step) < _SETTLED_PX:
                break
        return scale, shift, scale * np.sqrt(np.diag(inverse)[:2]), clear

    found = refined(np.zeros(2))
    if found[0] > 3.0:  # the stage has jumped: another start
        far = np.array(measure_drift(pattern, np.where(usable, image, ratio * pattern)))
        if np.isfinite(far).all():
            found = min(found, refined(far), key=lambda result: result[0])
    return found[1:]


def _slopes(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes along y and x by five pixels, two pixels from the edges on."""
    along = [
        (part[:-4] - 8 * part[1:-3] + 8 * part[3:-1] - part[4:]) / 12
        for part in (image[:, 2:-2], image.T[:, 2:-2])
    ]
    return along[0], along[1].T


def _continued(image: FloatArray, more: int) -> FloatArray:
    """Continue the rows of an image by a blend of their reflections, so that their ends meet."""
    size, k = len(image), np.arange(more)
    share = ((k + 1) / (more + 1))[:, None]
    fade = share**3 * (10 + share * (6 * share - 15))
    near, far = image[np.maximum(size - 1 - k, 0)], image[np.minimum(more - 1 - k, size - 1)]
    return np.concatenate([image, (1 - fade) * near + fade * far])


class Mover:
    """Moves images of one size by any part of a pixel, by the phase of their spectra.

    Exact for a pattern that the pixels resolve.  Beyond its edges an image is continued by its
    reflection; what that pretends is felt within `REACH_PX` of them.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._size = tuple(fft.next_fast_len(n + 4 * REACH_PX, real=True) for n in shape)
        self._fy, self._fx = fft.fftfreq(self._size[0]), fft.rfftfreq(self._size[1])
        self.waves = 2j * np.pi * self._fy[:, None], 2j * np.pi * self._fx[None]

    def spectrum(self, image: FloatArray) -> ComplexArray:
        """Spectrum of an image, shape (v, u)."""
        more_y, more_x = np.subtract(self._size, self._shape).tolist()
        wide = _continued(image.T, more_x).T
        return np.asarray(fft.rfft2(_continued(wide, more_y)))

    def image(self, spectrum: ComplexArray) -> FloatArray:
        """Image of a spectrum, shape (y, x)."""
        rows, columns = self._shape
        return np.asarray(fft.irfft2(spectrum, s=self._size)[:rows, :columns])

    def transfer(self, shift_px: FloatArray, weights: FloatArray) -> ComplexArray:
        """Factors that make a spectrum that of a weighted sum of shifted images.

        Shapes: `shift_px` (n, 2), `weights` (n,), result (v, u).
        """
        y = np.exp(-2j * np.pi * shift_px[:, :1] * self._fy) * weights[:, None]
        x = np.exp(-2j * np.pi * shift_px[:, 1:] * self._fx)
        return np.asarray(np.einsum("kv,ku->vu", y, x))


def derivatives(image: FloatArray) -> FloatArray:
    """Differentiate an image that fades at its edges.

    Shapes: `image` (y, x), result (5, y, x).
    """
    mover = Mover((image.shape[0], image.shape[1]))
    spectrum, (y, x) = mover.spectrum(image), mover.waves
    return np.stack([mover.image(spectrum * w) for w in (y, x, y * y, y * x, x * x)])


def trusted(usable: BoolArray, moved_px: float = 0.0) -> BoolArray:
    """Pixels at which a moved pattern is known.

    Shapes: `usable` (y, x), result (y, x).
    """
    near = binary_dilation(~usable, iterations=2)
    border = REACH_PX + math.ceil(moved_px - _SETTLED_PX)
    inside = np.zeros_like(usable)
    inside[border:-border, border:-border] = True
    return np.asarray(inside & ~near)


def filling(usable: BoolArray) -> tuple[FloatArray, ...]:
    """Index that gives unusable pixels the value of the nearest usable one.

    Shapes: `usable` (y, x).
    """
    index = distance_transform_edt(~usable, return_distances=False, return_indices=True)
    return tuple(index)


def still_light(blocks_e: NDArray[np.floating], usable: BoolArray) -> FloatArray:
    """Estimate the light that does not move with the pattern.

    Shapes: `blocks_e` (k, y, x), `usable` (y, x), result (y, x).
    """
    total = blocks_e.sum(axis=0, dtype=float)[filling(usable)]
    smooth = gaussian_filter(total, 16.0)  # speckle is finer
    least = 1e-3 * smooth.max()
    if not least > 0:
        return np.ones(usable.shape)
    return np.asarray(np.maximum(smooth, least) / smooth.max())


def measure_drift(reference_e: FloatArray, later_e: FloatArray) -> tuple[float, float]:
    """Shift of the fixed pattern between two mean images, by phase correlation.

    Shapes: `reference_e, later_e` (y, x).
    """
    return pattern_of(later_e).shift_from(pattern_of(reference_e))


def pattern_of(image_e: FloatArray) -> Pattern:
    """Transform a mean image, once for all images with which it is compared.

    Two pixels that blink would make a peak of their correlation: they are left out.

    Shapes: `image_e` (y, x).
    """
    rows, columns = image_e.shape
    taper = np.outer(np.hanning(rows), np.hanning(columns))
    smooth = _without_spikes(image_e)
    return Pattern(fft.rfft2(taper * (smooth / smooth.mean() - 1)), (rows, columns))


@dataclass(frozen=True)
class Pattern:
    """The spectrum of a fixed pattern."""

    spectrum: ComplexArray
    """Shapes: (v, u)."""

    shape: tuple[int, int]
    """Of the image."""

    def shift_from(self, reference: Pattern) -> tuple[float, float]:
        """Shift against another image, in pixels along y and x; NaN where the images do not tell.

        Notes
        -----
        C. D. Kuglin and D. C. Hines, Proc. IEEE Conf. Cybernetics and Society, 163 (1975).  Below a
        pixel the phase of the cross-spectrum is fitted by a plane, weighted by its strength.  Of
        two images of nothing but noise the phases are random, and the highest of N points of their
        correlation is at some 5/√N: a peak that is no higher says nothing of a shift.  All
        frequencies count alike.
        """
        cross = self.spectrum * np.conj(reference.spectrum)
        magnitude = np.abs(cross)
        if not magnitude.max() > 0:
            return math.nan, math.nan
        surface = fft.irfft2(cross / np.maximum(magnitude, 1e-12 * magnitude.max()), s=self.shape)
        at = np.unravel_index(int(np.argmax(surface)), surface.shape)
        # times the noise of random phases, whose largest is at 5
        if surface[at] * math.sqrt(surface.size) < 8.0:
            return math.nan, math.nan
        y, x = (int((i + n // 2) % n - n // 2) for i, n in zip(at, self.shape, strict=True))
        fy, fx = np.meshgrid(fft.fftfreq(self.shape[0]), fft.rfftfreq(self.shape[1]), indexing="ij")
        left = cross * np.exp(2j * np.pi * (fy * y + fx * x))
        weight = np.abs(left) * (np.hypot(fy, fx) < 0.25)
        angle = np.angle(left)
        a = np.array([[np.sum(weight * u * v) for v in (fy, fx)] for u in (fy, fx)])
        b = np.array([np.sum(weight * u * angle) for u in (fy, fx)])
        dy, dx = np.linalg.lstsq(a, -b / (2 * np.pi), rcond=None)[0]
        return float(y + dy), float(x + dx)


def _without_spikes(image: FloatArray) -> FloatArray:
    """Replace outlying pixels by the median of their neighbours."""
    around = median_3x3(image)
    out = np.abs(image - around)
    return np.where(out > 6.0 * robust_sigma(out), around, image)  # a pixel that blinks
