"""Noise between frames beside that of the gain, and what else makes it: motion, filters in time.

Frames that contain light of earlier frames: averaged, interpolated or filtered in time.

Of independent frames any two differ by the same noise, apart from slow changes.  If each was
averaged with the one before, neighbours differ less than frames farther apart, and those all differ
equally.  Where light or stage drift, or the laser flickers, differences go on growing.

Noise that is not the light's: a fixed pattern that shakes, or counts that are too coarse.

In variance against mean, both look like a wrong gain.

The noise of ratio images at every spatial frequency, measured, and the filter that whitens it.

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
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.drift import middle_of
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import (
    FRAMES_PROCESSED,
    GAIN_OFF,
    NOISE_CORRELATED,
    NOISE_ROUNDED,
    PATTERN_SHAKES,
)
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource

_APART, _FAR = 8, 16  # frames: filters are forgotten by then
_FEWEST, _FRAMES = 40, 256  # frames that tell, and as many as are asked


def shared_light(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> float | None:
    """Test whether successive frames have light in common.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    if len(counts) < _FEWEST:
        return None
    counts, shape = counts[:_FRAMES], counts.shape[1:]
    places = np.arange(math.prod(shape)) if masked is None else np.flatnonzero(~masked)
    places = places[:: max(1, -(-places.size // 4096))]  # some thousand pixels all over the field
    theirs = camera.mapped(lambda image: image.reshape(-1)[places])
    values = counts.reshape(len(counts), -1)[:, places]
    lit = theirs.to_electrons(values.mean(axis=0)) > 0
    pixels = theirs.mapped(lambda image: image[lit]).steady(values[:, lit]) if lit.any() else None
    if pixels is None:
        return None
    light = pixels.mean(axis=0)
    near, apart, far = (
        float(np.median(np.mean((pixels[lag:] - pixels[:-lag]) ** 2, axis=0) / light))
        for lag in (1, _APART, _FAR)
    )
    if apart <= 0 or far <= 0:
        return None
    short = 1 - near / apart
    # the deficit, and by how much of it farther frames may differ more
    return near / apart if short > 0.1 and abs(far / apart - 1) < 0.15 * short else None


def averaged_noise(counts: NDArray[Any], camera: Camera) -> float | None:
    """Give the variance of long averages over that of frames next to each other, where they share.

    Frames that were averaged or filtered in time have noise in common: with the correlation ρ_k of
    frames k apart, an average of n has 1 + 2 Σ ρ_k times the variance over n of one.

    Shapes: `counts` (t, y, x).
    """
    pixels = camera.steady(counts[:_FRAMES])
    if pixels is None or shared_light(counts, camera) is None:
        return None
    squares = [float(np.mean((pixels[k:] - pixels[:-k]) ** 2)) for k in (*range(1, _APART), _FAR)]
    common = sum(1 - one / squares[-1] for one in squares[:-1])
    return squares[-1] / squares[0] * (1 + 2 * common)


@dataclass(frozen=True)
class PatternJitter:
    """Motion of the fixed pattern from frame to frame."""

    share: float
    rms_px: float


def measure_pattern_jitter(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> PatternJitter | None:
    """Fit the difference of neighbouring frames with the gradient of their mean.

    A pattern B that moves by δ changes by −δ·∇B.  The difference of two frames is fitted with ∂_y B
    and ∂_x B, weighted by shot noise.  Of noise alone each of them explains 1 of χ².

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    seen = _Pattern.of(counts, camera, masked)
    if seen is None:
        return None
    steps = np.diff(seen.light, axis=0)[:, seen.used] / seen.noise
    moved = seen.motion(steps)
    explained = float(np.sum((moved @ seen.slopes_in_noise) ** 2)) - moved.size
    beyond = float(np.sum(steps**2)) - steps.size
    if beyond <= 0:
        return None
    own = float(np.trace(seen.covariance)) / 2  # of the light's noise alone
    rms = math.sqrt(max(float(np.mean(moved**2)) - own, 0.0) / 2)
    return PatternJitter(explained / beyond, rms)


def without_pattern_jitter(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> NDArray[Any]:
    """Remove the motion of the fixed pattern from frames, to first order.

    Shapes: `counts` (t, y, x), `masked` (y, x), result (t, y, x).
    """
    seen = _Pattern.of(counts, camera, masked)
    if seen is None:
        return counts
    moved = seen.motion((seen.light - seen.mean)[:, seen.used] / seen.noise)
    change_e = np.einsum("ki,iyx->kyx", moved * seen.power[:, None], seen.slopes)
    return np.asarray(counts - change_e / camera.gain_e_per_adu)


@dataclass(frozen=True)
class _Pattern:
    """Frames of equal power, their mean, and how its motion stands out of the noise."""

    light: FloatArray  # (t, y, x) [e]
    power: FloatArray  # (t,), that was divided out
    mean: FloatArray
    slopes: FloatArray  # (2, y, x)
    used: BoolArray
    noise: FloatArray  # of the difference of two frames, at the pixels used
    slopes_in_noise: FloatArray  # (2, p)
    covariance: FloatArray  # (2, 2) of the motion

    @classmethod
    def of(cls, counts: NDArray[Any], camera: Camera, masked: BoolArray | None) -> _Pattern | None:
        light = np.stack([camera.to_electrons(frame) for frame in counts])
        used = light.min(axis=0) > 0
        if masked is not None:
            used &= ~masked
        if len(light) < 3 or not used.any():
            return None
        power = light[:, used].mean(axis=1)
        power /= power.mean()
        light /= power[:, None, None]
        mean = light.mean(axis=0)
        slopes = np.stack(np.gradient(mean))
        noise = np.sqrt(2 * (mean + camera.read_variance_e2(mean.shape))[used])
        seen = slopes[:, used] / noise
        if not np.linalg.cond(seen @ seen.T) < 1 / np.finfo(float).eps:
            return None
        return cls(light, power, mean, slopes, used, noise, seen, np.linalg.inv(seen @ seen.T))

    def motion(self, changes: FloatArray) -> FloatArray:
        """Fit the slopes to changes (k, p) over their noise: the motion along −y and −x."""
        return changes @ self.slopes_in_noise.T @ self.covariance


@dataclass(frozen=True)
class GainDiagnosis:
    """Measured noise over that of the configured gain."""

    noise_ratio: float
    noise_ratio_se: float
    configured_gain: float
    gain_e_per_adu: float
    gain_se: float
    n_frames: int
    n_pixels: int
    noise_counts: float = math.inf
    pattern_jitter: PatternJitter | None = None

    @property
    def off(self) -> bool:
        """Whether the gain is wrong by more than 10 %, and chance does not explain it."""
        # 10 % beyond three standard errors
        return abs(self.noise_ratio - 1) > 0.10 + 3.0 * self.noise_ratio_se

    @property
    def shakes(self) -> bool:
        """Whether motion of the fixed pattern explains most of an excess."""
        return (
            self.off
            and self.pattern_jitter is not None
            and self.pattern_jitter.share > 0.5  # of the excess, which its motion makes
        )

    @property
    def finding(self) -> Finding | None:
        """What the user should know where the gain is off."""
        if not self.off:
            return None
        ratio, measured = self.noise_ratio, self.gain_e_per_adu
        values: dict[str, float | str] = {"ratio": ratio, "ratio_se": self.noise_ratio_se}
        values |= {"gain": self.configured_gain, "measured": measured}
        if self.noise_counts < 1:
            return NOISE_ROUNDED({**values, "noise_counts": self.noise_counts})
        if self.pattern_jitter is not None and self.shakes:
            jitter = self.pattern_jitter
            share = min(jitter.share, 1.0)
            return PATTERN_SHAKES({**values, "rms_px": jitter.rms_px, "share": share, "follow": ""})
        # Noise that grows with the light itself can only add, so only an excess has two causes.
        unless = "unless the light itself is noisy, " if ratio > 1 else ""
        return GAIN_OFF({**values, "unless": unless})


def diagnose_gain(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> GainDiagnosis:
    r"""Measure the gain from the noise of frames in which nothing happens.

    Let e_kp be the photoelectrons that the configured gain g makes of pixel p in frame k, g₀ the
    true gain, and r = g/g₀.  Then e_kp = r·N_kp + read noise, N_kp Poisson of mean ρ_k·μ_p, with
    ρ_k the relative laser power, so that

        E e_kp = r·ρ_k·μ_p,        Var e_kp = r²·ρ_k·μ_p + σ_r² .

    Dividing by ρ_k, measured as the frame's total over the mean total, removes the power noise.
    The difference d_kp of successive normalised frames loses everything static as well, and

        E d_kp² = r·m_p·(1/ρ_k + 1/ρ_{k+1})·(1 − Σ_q w_q²) + σ_r²·(1/ρ_k² + 1/ρ_{k+1}²),

    with m_p = r·μ_p the mean normalised frame and w = μ/Σμ.  The factor in w is exact for pure shot
    noise, when the counts given their total are multinomial: normalising by the total costs one
    degree of freedom.  Summed over pairs and pixels, with the read noise taken off,

        R = Σ_p a_p / Σ_p b_p  →  r,      a_p = Σ_k d_kp² − read noise,   b_p = the terms in m_p,

    (half the variance of a difference over the mean, weighted by the light).  Pixels are
    independent, so the standard error is that of a ratio over pixels, √Σ(a_p − R·b_p)² / Σ b_p; it
    holds although successive differences share a frame.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    n_frames = len(counts)
    if n_frames < 2:
        raise DataError(
            f"the gain needs two background frames or more to be measured, not {n_frames}"
        )
    used = camera.usable(counts, masked)
    image = sum(map(camera.to_electrons, counts), np.zeros(used.shape)) / n_frames
    used &= image > 0
    if np.count_nonzero(used) < 2:
        raise DataError("the gain cannot be measured: no pixel is lit and unsaturated throughout")
    mean = image[used]
    power = np.array([camera.to_electrons(frame)[used].mean() for frame in counts]) / mean.mean()
    if power.min() <= 0:
        raise DataError(
            f"the gain cannot be measured: background frame {int(power.argmin())} is dark"
        )
    frames = (camera.to_electrons(f)[used] / p for f, p in zip(counts, power, strict=True))
    squares = sum((np.square(after - before) for before, after in pairwise(frames)), 0 * mean)
    shot, read = (float(np.sum(power[:-1] ** -n + power[1:] ** -n)) for n in (1, 2))
    excess = squares - read * camera.dark_variance_e2(counts)[used]
    expected = shot * (1 - float(np.sum(np.square(mean / mean.sum())))) * mean
    kept = _without_outliers(excess / expected, n_frames)
    excess, expected = excess[kept], expected[kept]
    ratio = float(excess.sum() / expected.sum())
    if ratio <= 0:
        raise DataError(
            "the gain cannot be measured: the frames are no noisier than camera.read_noise_e "
            "alone; lower it"
        )
    ratio_se = float(np.sqrt(np.sum((excess - ratio * expected) ** 2)) / expected.sum())
    configured = float(np.broadcast_to(camera.gain_e_per_adu, used.shape)[used][kept].mean())
    whole = np.issubdtype(counts.dtype, np.integer)
    found = GainDiagnosis(
        noise_ratio=ratio,
        noise_ratio_se=ratio_se,
        configured_gain=configured,
        gain_e_per_adu=configured / ratio,
        gain_se=configured * ratio_se / ratio**2,
        n_frames=n_frames,
        n_pixels=len(excess),
        noise_counts=math.sqrt(excess.mean() / shot) / configured if whole else math.inf,
    )
    if not found.off or ratio < 1:
        return found
    return replace(found, pattern_jitter=measure_pattern_jitter(counts, camera, masked=~used))


def _without_outliers(ratios: FloatArray, n_frames: int) -> BoolArray:
    """Leave out blinking pixels, whose variance would outweigh that of all others."""
    if n_frames < 16:  # too few to call a pixel an outlier
        return np.ones(ratios.shape, dtype=np.bool_)
    # Relative spread of half the mean squared successive difference of normal numbers
    # (von Neumann et al., Ann. Math. Stat. 12, 153, 1941).
    spread = math.sqrt(3 * n_frames - 4) / (n_frames - 1)
    centre = float(np.median(ratios))
    kept: BoolArray = ratios <= centre * (1 + 8.0 * spread)  # a blinking pixel is beyond
    return kept if centre > 0 else np.ones(ratios.shape, dtype=np.bool_)


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
        return np.asarray(root * whitened)

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
            total += _periodogram(*found[:2])
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
    return _periodogram(change, limit)


def _periodogram(change: NDArray[Any], limit: float) -> NDArray[Any]:
    """Give the power of a change at every spatial frequency, without what is beyond noise."""
    waves = fft.rfft2(np.clip(change, -limit, limit, out=change))
    return np.asarray(np.square(waves.real) + np.square(waves.imag))
