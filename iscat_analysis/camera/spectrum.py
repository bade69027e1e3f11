"""The noise of ratio images at every spatial frequency, measured, and the filter that whitens it.

Shot noise is alike at all frequencies, and of known size.  Charge that leaks between pixels,
filters in the read-out, rows that flicker and read noise that nobody declared are not: a matched
filter that takes such noise for white has more false alarms than it was asked for, or fewer.
Neighbouring frames tell: in their difference nothing is left but noise.

Frames that are not as the camera gave them: interpolated, smoothed, sharpened or compressed.

The noise of raw counts is as strong at the finest patterns of the pixels, which no lens transmits,
as at coarser ones, and in every frame alike.  Bilinear interpolation by a fraction f of a pixel
multiplies the finest ones by (1 − 2f)², and f changes from frame to frame where a movie was
aligned.  Smoothing and lossy compression weaken them in all frames alike, sharpening strengthens
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.drift import middle_of
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import FRAMES_PROCESSED, NOISE_CORRELATED
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource

REACH_PX = 6
"""Distance of pixels up to which their noise may be correlated, beyond what rows share."""

MARGIN_PX = REACH_PX + 2
"""Width over which images are continued by reflection before they are whitened."""

LEAST_SIGMAS = 4.5  # standard errors beyond which a correlation is one
_LEAST_CORRECTION = 0.01  # of the expected variance, below which nothing is corrected
_LEAST_VARIANCE = 0.05  # of the variance, that every frequency is taken to have


@dataclass(frozen=True)
class NoiseSpectrum:
    """Variance of the noise over the expected one, at every spatial frequency.

    Images are continued by reflection over `MARGIN_PX`, so that at an edge as well a pixel has
    neighbours like those that it is correlated with.
    """

    shape: tuple[int, int]
    power: FloatArray
    information: FloatArray
    variance: float
    neighbours: tuple[float, float]
    shared: tuple[float, float]
    summed: tuple[float, float]

    @property
    def alike(self) -> float:
        """Factor by which correlation reduces the number of independent pixels."""
        covariance = fft.irfft2(self.power, s=self.shape)
        return float(np.sum(np.square(covariance / covariance[0, 0])))

    @property
    def correlated(self) -> bool:
        """Whether neighbouring pixels are correlated."""
        return max(map(abs, self.neighbours)) > _LEAST_CORRECTION

    def whitened(self, weighted: NDArray[Any], weight: NDArray[Any]) -> NDArray[Any]:
        """Divide a signal, times its information, by the spectrum of the noise.

        Shapes: `weighted` (y, x), `weight` (y, x).
        """
        root = np.sqrt(weight)
        in_noise = np.divide(weighted, root, out=np.zeros_like(root), where=root > 0)
        spectrum = fft.rfft2(np.pad(in_noise, MARGIN_PX, mode="symmetric"))
        spectrum /= self.power.astype(weighted.dtype)
        whitened = fft.irfft2(spectrum, s=self.shape)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        out: NDArray[Any] = root * whitened
        return out

    def dual(self, template: FloatArray) -> FloatArray:
        """Give what an image's product with a template is, to the noise, as a product of numbers.

        Shapes: `template` (…, k, k), result (…, k, k).
        """
        side = template.shape[-1]
        high, wide = (min(side, there) for there in self.shape)
        top, left = (side - high) // 2, (side - wide) // 2
        rows, columns = slice(top, top + high), slice(left, left + wide)
        field = np.zeros((*template.shape[:-2], *self.shape))
        field[..., :high, :wide] = template[..., rows, columns]
        seen = fft.irfft2(fft.rfft2(field) * self.information, s=self.shape)
        out = np.zeros_like(template)
        out[..., rows, columns] = seen[..., :high, :wide]
        return out

    def on(self, shape: tuple[int, int]) -> NoiseSpectrum:
        """Give the same noise for images of another, smaller shape."""
        size = (shape[0] + 2 * MARGIN_PX, shape[1] + 2 * MARGIN_PX)
        lags = np.ix_(*(np.arange(n) - n * (2 * np.arange(n) > n) for n in size))
        power, information = (
            fft.rfft2(fft.irfft2(spectrum, s=self.shape)[lags]).real
            for spectrum in (self.power, self.information)
        )
        least = _LEAST_VARIANCE * self.variance
        return replace(self, shape=size, power=np.maximum(power, least), information=information)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of the noise."""
        row, column = self.shared
        shares = {"row_share": row, "column_share": column}
        neighbours = list(self.neighbours)
        return {"variance_over_shot": self.variance, "neighbour_correlation": neighbours, **shares}

    @property
    def finding(self) -> Finding | None:
        """What differs from white noise; None where only the variance differs."""
        parts = []
        x, y = self.neighbours
        if self.correlated:
            parts.append(
                f"the noise of neighbouring pixels is correlated ({x:+.2f} in x, {y:+.2f} in y)"
            )
        for part, lines in zip(self.shared, ("rows", "columns"), strict=True):
            if part:
                parts.append(f"whole {lines} flicker ({100 * part:.2g} % of the noise variance)")
        if not parts:
            return None
        row, column = self.shared
        values = {"x": x, "y": y, "row_share": row, "column_share": column}
        return NOISE_CORRELATED({"what": " and ".join(parts), **values})


def measure_spectrum(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> NoiseSpectrum | None:
    """Measure the noise between neighbouring frames.

    Notes
    -----
    Covariances at distances up to `REACH_PX`, and those that a whole row or column shares, from the
    mean periodogram (R. B. Blackman and J. W. Tukey, The Measurement of Power Spectra, 1959).

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    rows, columns = counts.shape[1:]
    pairs = min(len(counts) // 2, 64)  # that are compared
    if pairs < 4 or min(rows, columns) < 4 * REACH_PX:
        return None
    starts = 2 * np.linspace(0, len(counts) // 2 - 1, pairs).astype(int)
    frames = np.concatenate([starts, starts + 1])
    mean = camera.to_electrons(counts[frames].mean(axis=0))
    used = (mean > 0) & camera.usable(counts[frames], masked)
    if used.mean() < 0.5 or mean[used].mean() < 20.0:  # noise is far from normal
        return None
    light = float(mean[used].mean())
    read = camera.read_variance_e2((rows, columns))
    expected = np.where(used, mean, 1.0)

    # rounded to single precision, which is a millionth of the noise and takes half of the time
    single = [
        np.asarray(value, dtype=np.float32)
        for value in (expected, read, camera.gain_e_per_adu, camera.offset_adu)
    ]

    def change(start: int) -> tuple[NDArray[np.float32], float, int] | None:
        # in its expected errors, with the size beyond which it is no noise, and what is beyond
        expected, read, gain, offset = single
        before, after = (
            gain * np.subtract(counts[k], offset, dtype=np.float32) for k in (start, start + 1)
        )
        powers = [float(frame.mean(where=used)) / light for frame in (before, after)]
        if min(powers) <= 0:
            return None
        by_light, by_frame = (sum(q**-n for q in powers) for n in (1, 2))
        z = after / powers[1] - before / powers[0]
        z /= np.sqrt(by_light * expected + by_frame * read)
        z[~used] = 0.0
        limit = 5.0 * robust_sigma(z[used][::8])  # some pixels tell how large the noise is
        return z, limit, int(np.count_nonzero(np.abs(z) > limit))

    # where something bright lands, its rings are no noise; a pixel that blinks is in every pair
    few = [found[2] for start in starts[:: max(1, pairs // 9)] if (found := change(start))]
    most = (float(np.median(few)) if few else 0.0) + 4
    total, number = np.zeros((rows, columns // 2 + 1)), 0
    for found in map(change, starts.tolist()):
        if found is not None and found[2] <= most:
            waves = fft.rfft2(np.clip(found[0], -found[1], found[1], out=found[0]))
            total += np.square(waves.real) + np.square(waves.imag)
            number += 1
    if not number:
        return None
    # in how many pairs of frames and of used pixels each distance occurs
    alike = fft.irfft2(np.abs(fft.rfft2(used.astype(np.float64))) ** 2, s=(rows, columns))
    covariance = fft.irfft2(total, s=(rows, columns)) / (number * np.maximum(np.rint(alike), 1.0))
    root = np.sqrt(np.where(used, mean, light))
    return _spectrum_of(covariance, 1 / math.sqrt(number * np.count_nonzero(used)), root)


def _spectrum_of(
    covariance: FloatArray, error: float, root_light: FloatArray
) -> NoiseSpectrum | None:
    """Keep of a covariance (rows, columns) what is near, and what rows and columns share."""
    here, lags = REACH_PX, np.arange(-REACH_PX, REACH_PX + 1)
    far_y, far_x = (slice(REACH_PX + 1, n - REACH_PX) for n in covariance.shape)
    # a frame's mean was taken for its power, which takes the same from every covariance
    covariance = covariance - covariance[far_y, far_x].mean()
    variance = float(covariance[0, 0])
    error *= variance

    def shared(lines: FloatArray) -> FloatArray:
        """Mean of lines (n, lags), where it is significant at lag 0.

        It is negative where each line was divided by its own light.
        """
        mean: FloatArray = lines.mean(axis=0)
        # a distance and its opposite have the same covariance: half as many are independent
        limit = LEAST_SIGMAS * error * math.sqrt(2 / len(lines))
        return mean if abs(mean[here]) > limit else 0 * mean

    by_row, by_column = shared(covariance[lags, far_x].T), shared(covariance[far_y, lags])
    common = by_row[:, None] + by_column[None, :]
    local = covariance[np.ix_(lags, lags)] - common
    # no signal is left either of what was divided out, so that nothing is to be whitened there
    by_row, by_column = (
        line if line[here] > 0 else np.zeros_like(line) for line in (by_row, by_column)
    )
    common = by_row[:, None] + by_column[None, :]
    neighbours = np.abs(local)
    neighbours[here, here] = 0.0
    if neighbours.max() < max(LEAST_SIGMAS * error, _LEAST_CORRECTION * variance):
        if abs(variance - 1) < _LEAST_CORRECTION and not common.any():
            return None
        local = np.zeros_like(local)
        local[here, here] = variance - common[here, here]
    light = np.pad(root_light, MARGIN_PX, mode="symmetric")
    whole = np.zeros(light.shape)
    whole[lags, :] += by_row[:, None]
    whole[:, lags] += by_column[None, :]
    whole[np.ix_(lags, lags)] += local
    power = np.maximum(fft.rfft2(whole).real, _LEAST_VARIANCE * variance)
    # signals are multiplied by the root of the light before they meet the whitening filter
    alike = fft.irfft2(np.abs(fft.rfft2(light)) ** 2, s=light.shape)
    kernel = fft.irfft2(1 / power, s=light.shape) * alike / alike[0, 0]
    return NoiseSpectrum(
        shape=(light.shape[0], light.shape[1]),
        power=power,
        information=fft.rfft2(kernel).real,
        variance=variance,
        neighbours=(local[here, here + 1] / variance, local[here + 1, here] / variance),
        shared=(by_row[here] / variance, by_column[here] / variance),
        summed=(float(local.sum()), error * math.sqrt(local.size)),
    )


_COARSE = (0.1, 0.3)  # cycles per pixel that they are compared with
_WEAK, _STRONG = 0.5, 2.0  # finest noise over that at coarser patterns

Kind = Literal["interpolated", "smoothed", "sharpened"]


@dataclass(frozen=True)
class Processing:
    """What was done to the frames, and the noise that tells it.

    `finest` is the noise at the finest patterns over that at coarser ones; `uneven` is by how much
    of itself the finest noise changes from frame to frame, beyond chance.
    """

    kind: Kind
    finest: float
    uneven: float

    @property
    def finding(self) -> Finding:
        """What the user should know."""
        what, instead = {
            "interpolated": (
                "interpolated, as where a movie is aligned by parts of a pixel: the noise of the "
                f"finest patterns changes by {100 * self.uneven:.0f} % from frame to frame, which "
                "no camera does",
                "the movie before it was aligned (its drift is measured and followed here), or "
                "shift it by whole pixels",
            ),
            "smoothed": (
                "smoothed, denoised or compressed with losses: the finest patterns have "
                f"{100 * self.finest:.0f} % of the noise of coarser ones, where a camera has as "
                "much",
                "the camera's own counts, uncompressed or compressed without losses",
            ),
            "sharpened": (
                f"sharpened: the finest patterns have {self.finest:.1f} times the noise of coarser "
                "ones, where a camera has as much",
                "the camera's own counts",
            ),
        }[self.kind]
        return FRAMES_PROCESSED({"what": what, "instead": instead, **self.summary})

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {"kind": self.kind, "finest": self.finest, "uneven": self.uneven}


def find_processing(
    movie: FrameSource, camera: Camera, span: tuple[int, int], *, moving: bool = False
) -> Processing | None:
    """Compare the noise of the finest patterns with that of coarser ones and between frames.

    Where particles move, coarser patterns are of them, and do not tell what was smoothed.
    """
    rows, columns = middle_of(movie.shape, 512)  # pixels along each side
    fine, coarse = _bands(rows.stop - rows.start, columns.stop - columns.start)
    found = []
    # pairs of frames all over the movie
    starts = np.unique(np.linspace(span[0], span[1] - 2, 48).astype(int))
    for start in starts.tolist() if span[1] - span[0] > 1 else ():
        spectrum = _spectrum(movie, camera, start, (rows, columns))
        if spectrum is not None:
            found.append((spectrum[fine].mean(), spectrum[coarse].mean()))
    if len(found) < 8:  # pairs that tell
        return None
    finest, coarser = np.array(found).T
    # |z|² of a complex normal number scatters by its mean; a normalised movie's noise changes at
    # all patterns alike, and what vibrates is coarse
    sizes = [np.count_nonzero(band) for band in (fine, coarse)]
    uneven = min(
        _uneven(finest, 1 / sizes[0]), _uneven(finest / coarser, 1 / sizes[0] + 1 / sizes[1])
    )
    ratio = float(np.quantile(finest / coarser, 0.9))  # of pairs between which little vibrates
    if uneven > 0.1:  # of itself
        return Processing("interpolated", ratio, uneven)
    if moving:
        return None
    if ratio < _WEAK:
        return Processing("smoothed", ratio, uneven)
    return Processing("sharpened", ratio, uneven) if ratio > _STRONG else None


def _uneven(values: FloatArray, chance: float) -> float:
    """Say by how much of their median values scatter beyond chance; 0 where that may be chance.

    Some that lie far off do not count, as of frames that are cut off.
    """
    middle = float(np.median(values))
    scatter = robust_sigma(values - middle) / middle
    excess = scatter**2 - chance
    # 2.33/√n: the relative error of a variance by the median deviation of n
    significant = excess > 6.0 * chance * 2.33 / math.sqrt(len(values))
    return math.sqrt(excess) if significant else 0.0


def _bands(rows: int, columns: int) -> tuple[BoolArray, BoolArray]:
    """Select the finest and the coarser patterns of a half spectrum, each with its opposite once.

    Whole rows and columns, which flicker by themselves, are in neither.
    """
    y, x = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None, :]
    radius = np.hypot(y, x)
    own = (y != 0) & (x > 0) & (x < 0.5)
    # only noise is beyond half a cycle per pixel: the corners of the spectrum
    return own & (radius > 0.5), own & (radius > _COARSE[0]) & (radius < _COARSE[1])


def _spectrum(
    movie: FrameSource, camera: Camera, start: int, region: tuple[slice, slice]
) -> FloatArray | None:
    """Give the power of the noise of two frames; None where they are dark, odd or the same."""
    counts = movie.read(start, start + 2)
    if np.array_equal(counts[0], counts[1]) or not np.isfinite(counts).all():
        return None
    before, after = camera.to_electrons(counts)[(slice(None), *region)]
    powers = float(before.mean()), float(after.mean())
    if min(powers) < 20.0:  # noise is far from normal
        return None
    before, after = before / powers[0], after / powers[1]
    light = before + after
    used = light > 0.1 * np.median(light)
    change = np.where(used, (after - before) / np.sqrt(np.where(used, light, 1.0)), 0.0)
    # shot noise over the light: alike in all frames, whatever the laser does
    change *= math.sqrt(2 / (1 / powers[0] + 1 / powers[1]))
    limit = 5.0 * robust_sigma(change[used])  # a change beyond is no noise
    waves = fft.rfft2(np.clip(change, -limit, limit))
    return np.asarray(np.square(waves.real) + np.square(waves.imag))
