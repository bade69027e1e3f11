"""From moments to numbers of the camera: variance against mean, and the zero of the light.

Results of photon transfer: numbers with standard errors, curves, masks, a verdict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import log_ndtr

from iscat_analysis.camera.moments import Moments
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray

_Z95 = 1.959964


@dataclass(frozen=True)
class Estimate:
    """A number and how well it is known."""

    value: float
    se: float

    @property
    def ci95(self) -> tuple[float, float]:
        """Central 95 % confidence interval."""
        return self.value - _Z95 * self.se, self.value + _Z95 * self.se


_ARRAYS = ("curve", "masked", "maps")


def _plain(value: Any) -> Any:
    if not isinstance(value, Estimate):
        return value
    return {"value": value.value, "se": value.se, "ci95": list(value.ci95)}


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What the noise says of a camera; `measure_camera` makes it."""

    gain_e_per_adu: Estimate | None
    offset_adu: Estimate
    offset_from: str
    read_noise_adu: Estimate | None
    read_noise_e: Estimate | None
    read_noise_below_e: float | None
    curve: pd.DataFrame
    noise: pd.DataFrame
    shot_limited_frames: int | None
    verdict: str
    masked: dict[str, BoolArray]
    maps: dict[str, FloatArray]
    frames: int
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Give what ``camera.json`` holds."""
        held = vars(self) | {
            "masked_pixels": {name: int(mask.sum()) for name, mask in self.masked.items()},
            "photon_transfer": self.curve.to_dict("list"),
            "noise": self.noise.to_dict("list"),
            "notes": list(self.notes),
        }
        return {key: _plain(value) for key, value in held.items() if key not in _ARRAYS}

    def to_toml(self, maps: dict[str, str] | None = None) -> str:
        """Write the section ``[camera]`` to paste into a configuration."""
        lines = ["[camera]"]
        for key in ("gain_e_per_adu", "offset_adu", "read_noise_e"):
            estimate: Estimate | None = getattr(self, key)
            if estimate is None:
                continue
            low, high = estimate.ci95
            value = f'"{maps[key]}"' if maps and key in maps else f"{estimate.value:.6g}"
            interval = f"95 %: {low:.6g} to {high:.6g}" if low < high else "as given"
            lines.append(f"{key} = {value}  # {interval}")
        return "\n".join(lines) + "\n"


LEAST_RELIABILITY = 0.9
"""Of the spread of the means of pixels, what must not be their own noise."""

_GOOD_SLOPE = 0.05
# Of half of the pixels, standard errors from which read noise is not chance
_READ_NOISE_SIGMAS = 3.5


@dataclass(frozen=True, eq=False)
class Solution:
    """A camera, and the line of variance against mean that it stands for."""

    gain: Estimate
    offset: Estimate
    offset_from: str
    read_adu: Estimate | None
    read_e: Estimate | None
    read_below_e: float | None
    intercept: float
    slope: float


def solve(
    found: Sequence[Moments],
    used: BoolArray,
    dark: Moments | None,
    given: float | None,
    notes: list[str],
) -> Solution:
    """Solve for the camera, as far as the recordings allow.

    Shapes: `used` (y, x).
    """
    mean, variance, frames = _pooled(found, used)
    if dark is not None:
        return _with_dark(mean, variance, frames, dark, used, len(found))

    offset, source = _offset(found, used, given, notes)
    own = float((variance / (frames + 1)).mean())
    reliability = 1 - own / float(mean.var()) if mean.var() > 0 else 0.0
    line = None
    if reliability > LEAST_RELIABILITY:
        (intercept, slope), cov = variance_line(mean, variance, frames)
        if slope > 0 and math.sqrt(cov[1, 1]) / slope < 0.30:  # a gain that is less certain is none
            line = intercept, slope, cov
        elif slope <= 0 and -slope > 3.0 * math.sqrt(cov[1, 1]):
            raise DataError(
                "the noise falls as the light rises: the frames were processed, or are saturated; "
                "give raw counts"
            )
    if line is None or (offset is not None and math.sqrt(line[2][1, 1]) / line[1] > _GOOD_SLOPE):
        return _ratio(mean, variance, offset, source, notes)
    intercept, slope, cov = line
    relative = math.sqrt(cov[1, 1]) / slope
    gain = Estimate(1 / slope, relative / slope)
    if relative > _GOOD_SLOPE:
        notes.append(
            f"the pixels are too alike in brightness: the gain is known to {100 * relative:.0f} % "
            "only; give a dark, or a second level"
        )
    if offset is None:
        zero = -intercept / slope
        gradient = np.array([-1 / slope, intercept / slope**2])
        offset = Estimate(zero, math.sqrt(gradient @ cov @ gradient))
        notes.append(
            "offset and read noise cannot be told apart without a dark or a flickering laser: "
            "offset_adu is where the variance would vanish, o − σ_r²/g, and with it "
            "read_noise_e = 0 predicts the noise that was measured"
        )
        return Solution(gain, offset, "line", None, None, None, intercept, slope)
    read = _read_variance(line, offset)
    half = _half(found, used, given)
    if half is not None and half.value > _READ_NOISE_SIGMAS * half.se:
        electrons = _root(_unselected(read, half, _READ_NOISE_SIGMAS * half.se))
        # in counts the gain has no part in the error
        narrower = read.adu2.se / (slope**2 * read.e2.se)
        adu = Estimate(electrons.value * slope, electrons.se * slope * narrower)
        return Solution(gain, offset, source, adu, electrons, None, intercept, slope)
    below = math.sqrt(max(read.e2.value, 0.0) + 1.644854 * read.e2.se)  # 95 % on one side
    notes.append(
        f"the read noise is too small beside the shot noise to be seen: below {below:.3g} e "
        "(95 %); a dark would measure it"
    )
    return Solution(gain, offset, source, None, None, below, intercept, slope)


@dataclass(frozen=True)
class _ReadVariance:
    """Variance of the read noise [counts²] and [e²], and the covariance of the two estimates."""

    adu2: Estimate
    e2: Estimate
    covariance: float


def _read_variance(line: tuple[float, float, FloatArray], offset: Estimate) -> _ReadVariance:
    """Give the variance of the line at the offset, where there is no light.

    It and the slope have errors of opposite sign, which in electrons add up; the bias of second
    order is taken off.
    """
    intercept, slope, cov = line
    dark = intercept + slope * offset.value
    counts = np.array([1.0, offset.value])
    electrons = np.array([1.0, offset.value - 2 * dark / slope]) / slope**2
    bias = (3 * dark * cov[1, 1] / slope - 2 * float(counts @ cov[1])) / slope**3
    return _ReadVariance(
        Estimate(dark, math.hypot(math.sqrt(counts @ cov @ counts), slope * offset.se)),
        Estimate(
            dark / slope**2 - bias,
            math.hypot(math.sqrt(electrons @ cov @ electrons), offset.se / slope),
        ),
        float(counts @ cov @ electrons) + offset.se**2,
    )


def _half(found: Sequence[Moments], used: BoolArray, given: float | None) -> Estimate | None:
    """Read noise of every other tile of the sensor [counts²]."""
    y, x = np.indices(used.shape) // 8  # noise is correlated less far
    part = used & ((y + x) % 2 == 0)
    if np.count_nonzero(part) < 32:  # pixels that tell
        return None
    offset, _ = _offset(found, part, given, [])
    if offset is None:
        return None
    (intercept, slope), cov = variance_line(*_pooled(found, part))
    return _read_variance((intercept, slope, cov), offset).adu2 if slope > 0 else None


def _unselected(whole: _ReadVariance, half: Estimate, threshold: float) -> Estimate:
    """Estimate without bias what is reported only where half of the data exceed a threshold.

    Notes
    -----
    The other half knows nothing of the decision, so that its estimate has no bias, and by the
    theorem of Rao and Blackwell its mean given the whole has a smaller error.  A − M is normal and
    independent of M, of variance δ² = a² − τ²; so that mean is E − κ/δ · λ((c − M)/δ), with E the
    estimate in electrons, κ its covariance with M, and λ the inverse Mills ratio.  Far above the
    threshold it is E.
    """
    mean, error = whole.adu2.value, whole.adu2.se
    delta = math.sqrt(max(half.se**2 - error**2, 0.01 * half.se**2))
    at = (threshold - mean) / delta
    mills = math.exp(-(at**2) / 2 - float(log_ndtr(-at))) / math.sqrt(2 * math.pi)
    slope = whole.covariance / delta**2 * mills * (mills - at)
    se = math.sqrt(whole.e2.se**2 + 2 * slope * whole.covariance + (slope * error) ** 2)
    other = whole.e2.se * half.se / delta  # the error of the other half by itself
    return Estimate(
        whole.e2.value - whole.covariance / delta * mills, min(se, max(other, whole.e2.se))
    )


def _root(variance: Estimate) -> Estimate:
    """Root of a variance, corrected for the bias of a root."""
    root = math.sqrt(max(variance.value, variance.se / 4))
    relative = variance.se / root**2
    return Estimate(root * (1 + min(relative, 1.0) ** 2 / 8), root * relative / 2)


def _pooled(found: Sequence[Moments], used: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and variance of all pixels in all stacks, and the degrees of freedom of each."""
    return (
        np.concatenate([item.mean[used] for item in found]),
        np.concatenate([item.variance[used] for item in found]),
        np.concatenate([np.full(used.sum(), item.n_frames - 1.0) for item in found]),
    )


def _with_dark(
    mean: FloatArray,
    variance: FloatArray,
    frames: FloatArray,
    dark: Moments,
    used: BoolArray,
    n: int,
) -> Solution:
    """Fit only the slope; the dark gives offset and read noise of every pixel."""
    light = mean - np.tile(dark.mean[used], n)
    shot = variance - np.tile(dark.variance[used], n)
    if light.mean() <= 0:
        raise DataError(
            "the dark is no darker than the light frames; give the frames without light"
        )
    slope = float(shot.sum() / light.sum())
    for _ in range(20):
        if slope <= 0:
            raise DataError("the light adds no noise: these are not raw counts; give raw frames")
        weight = frames / np.square(np.maximum(slope * light, 1e-12) + variance.min())
        last, slope = slope, float(weight @ (light * shot)) / float(weight @ light**2)
        if abs(slope - last) < 1e-12 * last:
            break
    scatter = float(np.linalg.norm(weight * light * (shot - slope * light)))
    se = scatter / float(weight @ light**2)
    gain = Estimate(1 / slope, se / slope**2)
    offset, read = dark_numbers(dark, used)
    electrons = Estimate(
        read.value / slope, math.hypot(read.se / slope, read.value * se / slope**2)
    )
    intercept = read.value**2 - slope * offset.value
    return Solution(gain, offset, "dark", read, electrons, None, intercept, slope)


def dark_numbers(dark: Moments, used: BoolArray) -> tuple[Estimate, Estimate]:
    """Average a dark over its pixels, with standard errors from their scatter.

    Shapes: `used` (y, x).
    """
    pixels = math.sqrt(np.count_nonzero(used))
    mean, variance = dark.mean[used], dark.variance[used]
    root = math.sqrt(float(variance.mean()))
    return (
        Estimate(float(mean.mean()), float(mean.std(ddof=1)) / pixels),
        Estimate(root, float(variance.std(ddof=1)) / pixels / (2 * root)),
    )


def _ratio(
    mean: FloatArray, variance: FloatArray, offset: Estimate | None, source: str, notes: list[str]
) -> Solution:
    """One level only: the gain follows if the offset is known and the read noise is small."""
    if offset is None:
        raise DataError(
            "the pixels are too alike in brightness for variance against mean, and the offset is "
            "not known: give a dark (`dark`), the offset (`offset_adu`), or a second level"
        )
    light = mean - offset.value
    if light.mean() <= 0:
        raise DataError(
            f"the offset of {offset.value:g} counts is not below the frames' mean of "
            f"{mean.mean():g}; correct `offset_adu`"
        )
    ratio = float(variance.sum() / light.sum())
    scatter = float(np.sum((variance - ratio * light) ** 2))
    se = math.hypot(
        math.sqrt(scatter) / float(light.sum()), ratio * offset.se / float(light.mean())
    )
    notes.append(
        "there is one level of light only: the read noise is taken as zero, and the gain is too "
        "small by the factor 1 + σ_r²/μ; a dark removes the assumption"
    )
    gain = Estimate(1 / ratio, se / ratio**2)
    return Solution(gain, offset, source, None, None, None, -ratio * offset.value, ratio)


def variance_line(
    x: FloatArray, y: FloatArray, frames: FloatArray, tiles: NDArray[np.int64] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Fit y = a + b·x with the variance of y as (fit)²/frames.

    Shapes: `x, y` (n,), `frames` (n,), `tiles` (n,), `theta` (2,), `covariance` (2, 2).
    """
    fit = np.full(x.shape, y.mean())
    for _ in range(25):
        weight = frames / np.square(np.maximum(fit, 0.05 * y.mean()))
        centre, theta, cov = _line(x, y, weight, tiles)
        new = theta[0] + theta[1] * (x - centre)
        done = np.max(np.abs(new - fit)) < 1e-10 * y.mean()
        fit = new
        if done:
            break
    back = np.array([[1.0, -centre], [0.0, 1.0]])
    return back @ theta, back @ cov @ back.T


def _line(
    x: FloatArray, y: FloatArray, weight: FloatArray, tiles: NDArray[np.int64] | None
) -> tuple[float, FloatArray, FloatArray]:
    """Fit a weighted line: its centre, level and slope there, and their covariance.

    Errors are from the scatter of pixels; those of one of the `tiles` may deviate together.

    Shapes: `x, y, weight` (n,), `tiles` (n,), `theta` (2,), `covariance` (2, 2).
    """
    centre = float(np.average(x, weights=weight))
    design = np.stack([np.ones_like(x), x - centre])
    inverse = 1 / np.sum(weight * design**2, axis=1)
    theta = inverse * (design @ (weight * y))
    score = design * (weight * (y - theta @ design))
    if tiles is not None:
        score = np.stack([np.bincount(tiles, weights=part) for part in score])
    return centre, theta, np.outer(inverse, inverse) * (score @ score.T)


def _offset(
    found: Sequence[Moments], used: BoolArray, given: float | None, notes: list[str]
) -> tuple[Estimate | None, str]:
    """Where the pixels' response to the laser's power vanishes; combined over all that know."""
    if given is not None:
        return Estimate(given, 0.0), "given"
    estimates = [
        zero_of_flicker(item.slope[used], item.slope_variance[used], item.mean[used])
        for item in found
    ]
    order = sorted(found, key=lambda item: float(item.mean[used].mean()))
    for low, high in pairwise(order):
        rise = float((high.mean - low.mean)[used].mean())
        noise = (low.variance / low.n_frames + high.variance / high.n_frames)[used]
        if rise > 0:
            slope = (high.mean - low.mean)[used] / rise
            estimates.append(zero_of_flicker(slope, noise / rise**2, low.mean[used]))
    known = [item for item in estimates if item is not None]
    if not known:
        return None, "line"
    weights = np.array([1 / item.se**2 for item in known])
    value = float(np.sum(weights * [item.value for item in known]) / weights.sum())
    se = float(1 / math.sqrt(weights.sum()))
    level = float(np.mean([item.mean[used].mean() for item in found]))
    if se > 0.05 * abs(level - value):  # of the light level
        return None, "line"
    notes.append(
        "the offset is that of the light which follows the laser's power: stray light that "
        "flickers with it is not part of it"
    )
    return Estimate(value, se), "flicker"


def zero_of_flicker(
    slope: FloatArray,
    variance: FloatArray,
    mean: FloatArray,
    tiles: NDArray[np.int64] | None = None,
) -> Estimate | None:
    """Find the mean at which pixels follow the power no more, from a weighted line.

    Shapes: `slope, variance` (n,), `mean` (n,), `tiles` (n,).
    """
    if not np.isfinite(slope).all() or mean.std() == 0:
        return None
    kept = np.ones(slope.shape, dtype=np.bool_)
    for _ in range(4):
        centre, (level, gradient), cov = _line(mean, slope, kept / variance, tiles)
        residual = (slope - level - gradient * (mean - centre)) / np.sqrt(variance)
        robust = robust_sigma(residual)
        kept = np.abs(residual) < 5 * max(robust, 1e-12)
    level_se, gradient_se = np.sqrt(np.diag(cov))
    if robust**2 > 2.0 or gradient <= max(0, 5 * gradient_se):  # the scene has moved
        return None
    se = math.hypot(level_se / gradient, level / gradient**2 * gradient_se)
    return Estimate(centre - level / gradient, se)
