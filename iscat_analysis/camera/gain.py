"""Noise between frames beside that of the gain, and what else makes it: motion, filters in time.

Frames that contain light of earlier frames: averaged, interpolated or filtered in time.

Of independent frames any two differ by the same noise, apart from slow changes.  If each was
averaged with the one before, neighbours differ less than frames farther apart, and those all differ
equally.  Where light or stage drift, or the laser flickers, differences go on growing.

Noise that is not the light's: a fixed pattern that shakes, or counts that are too coarse.

In variance against mean, both look like a wrong gain.

Metadata of a movie, and whether its noise agrees with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import GAIN_OFF, NOISE_ROUNDED, PATTERN_SHAKES
from iscat_analysis.records import BoolArray, FloatArray

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
    steady = theirs.mapped(lambda image: image[lit]).steady(values[:, lit]) if lit.any() else None
    if steady is None:
        return None
    pixels, _ = steady
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
    steady = camera.steady(counts[:_FRAMES])
    if steady is None or shared_light(counts, camera) is None:
        return None
    pixels, _ = steady
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
        return np.asarray(changes @ self.slopes_in_noise.T @ self.covariance)


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
