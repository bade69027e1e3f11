"""The camera from its own noise: gain, offset and read noise by photon transfer.

A pixel of gain g [e/count], offset o [counts] and read noise σ_r [e] that receives μ photoelectrons
per frame has the mean m = o + μ/g and the variance

    v = (m − o)/g + σ_r²/g²                              (Janesick, *Photon Transfer*, 2007)

so the slope of variance against mean over pixels of different brightness is 1/g.  What follows
from which recording:

* a **dark** gives o and σ_r, pixel by pixel;
* **power that flickers**, or several levels of the same scene, give o: every pixel follows the
  laser by its light alone, dm_p/dρ = μ_p/g = m_p − o, a line whose zero is the offset;
* **neither**: only o − σ_r²/g, where the line meets v = 0, can be known, and is said to be so.

Laser power is taken out by regressing each pixel's frame-to-frame differences on those of the whole
frame, which needs no offset.  Rounding to whole counts is part of the read noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import log_ndtr

from iscat_analysis.camera.background import blocks, unlike_neighbours
from iscat_analysis.camera.counts import Camera, full_scale_of
from iscat_analysis.camera.noise import NoiseSpectrum, measure_spectrum
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.movie import SelectedFrames
from iscat_analysis.records import BoolArray, CountSource, FloatArray, FrameSource, Progress, silent
from iscat_analysis.units import are, frames_listed

_CACHE_BYTES = 4 * 2**20  # what lies in a processor's cache takes no fresh memory
_TOGETHER = {"frames": (1, 2), "rows": (2,), "columns": (1,)}  # axes of (t, y, x)


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of one stack, per pixel [counts]."""

    mean: FloatArray
    variance: FloatArray
    slope: FloatArray
    slope_variance: FloatArray
    highest: NDArray[Any]
    lowest: NDArray[Any]
    n_frames: int

    @property
    def relative_se(self) -> float:
        """Standard error of one pixel's variance, relative (von Neumann et al., 1941)."""
        return math.sqrt(3 * self.n_frames - 4) / (self.n_frames - 1)


def brightness_bins(mean: FloatArray) -> list[NDArray[np.intp]]:
    """Group pixels by brightness, equally many in each group.

    Shapes: `mean` (n,).
    """
    return np.array_split(np.argsort(mean), max(1, min(32, mean.size // 32)))


def moments_of(
    stack: FrameSource,
    used: BoolArray | None,
    advance: Callable[[int], None],
    *,
    flickering: str = "frames",
    jumps: BoolArray | None = None,
) -> Moments:
    """Measure mean and variance of every pixel; with `used`, the light's flicker is taken out.

    Differences of successive frames at `jumps` are left out.

    Notes
    -----
    Differences d_k of successive frames have the covariance v·(2, −1 beside the diagonal).  Their
    regression on the differences D_k of the mean over `used` takes away DᵀMD/DᵀD of the 2(K − 1)
    squares that are expected, with M that matrix; the mean carries 1/P of each pixel's noise, of
    which a pixel that follows it s times as strongly loses s/P.
    Where rows or columns flicker, the mean is that of each.

    Shapes: `used` (y, x), `jumps` (frames − 1,).
    """
    together = _TOGETHER[flickering]
    frames, rows, columns = stack.shape
    total = np.zeros((rows, columns))
    squares = np.zeros((rows, columns))
    product = np.zeros((rows, columns))
    highest = lowest = stack.read(0, 1)[0]
    flicker = []
    last: FloatArray | None = None
    for start, stop in blocks(stack.shape, (0, stack.shape[0]), _CACHE_BYTES):
        counts = stack.read(start, stop)
        if not np.isfinite(counts).all():
            raise DataError(
                f"{stack.name}: frames {start} to {stop - 1} hold NaN or infinity; give raw counts"
            )
        highest = np.maximum(highest, counts.max(axis=0))
        lowest = np.minimum(lowest, counts.min(axis=0))
        block = counts.astype(np.float64, copy=False)
        total += block.sum(axis=0)
        if last is not None:
            block = np.concatenate([last[np.newaxis], block])
        steps = np.diff(block, axis=0)
        if jumps is not None:
            first = max(start - 1, 0)
            steps[jumps[first : first + len(steps)]] = 0.0
        squares += np.einsum("kyx,kyx->yx", steps, steps)
        if used is not None:
            common = np.mean(steps, axis=together, keepdims=True, where=used)
            product += np.einsum("kyx,kyx->yx", np.broadcast_to(common, steps.shape), steps)
            flicker.append(common)
        last = block[-1]
        advance(stop - start)
    n = frames - 1 - (0 if jumps is None else int(np.count_nonzero(jumps)))
    mean = total / frames
    if used is None:
        still, certain = np.ones_like(mean), np.zeros_like(mean)
        return Moments(mean, squares / (2 * n), still, certain, highest, lowest, frames)
    common = np.concatenate(flicker)
    power = np.sum(common**2, axis=0)
    spread = 2 * power - 2 * np.sum(common[:-1] * common[1:], axis=0)
    if not power.any():
        raise DataError(
            f"{stack.name}: successive frames are identical: this is not raw camera data"
        )
    in_frame = tuple(axis - 1 for axis in together)
    pixels = np.sum(used, axis=in_frame, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):  # lines in which no pixel is used
        variance = (squares - product**2 / power) / (2 * n - spread / power)
        variance /= 1 - product / power / pixels
        own = 2 * n * variance / pixels
    slope_power = power - np.mean(own, axis=in_frame, keepdims=True, where=used)
    usable = bool(np.all(slope_power > 0.1 * power))  # else the flicker is the frames' own noise
    slope = (product - own) / slope_power if usable else np.full_like(mean, np.nan)
    slope_variance = variance * spread / slope_power**2 if usable else np.full_like(mean, np.nan)
    return Moments(mean, variance, slope, slope_variance, highest, lowest, frames)


KINDS = ("saturated", "clipped", "dead", "hot")
"""What may be wrong with a pixel."""

_OUTLIER_SIGMAS = 8.0


def saturated(highest: NDArray[Any], name: str) -> BoolArray:
    """Find saturated pixels: at the largest number of their type, or of an ADC of 8 to 16 bits.

    Shapes: `highest` (y, x), result (y, x).
    """
    top = float(highest.max())
    full = Camera(full_scale_adu=full_scale_of(highest.dtype)).saturated(highest)
    if full.mean() > 0.5:
        raise DataError(
            f"{name}: {100 * full.mean():.0f} % of the pixels are saturated (count {top:g}); "
            "lower the exposure or the laser power"
        )
    return full


def clipped(lowest: NDArray[Any]) -> BoolArray:
    """Find pixels that reached zero counts, below which nothing is stored.

    Shapes: `lowest` (y, x), result (y, x).
    """
    unsigned = np.issubdtype(lowest.dtype, np.unsignedinteger)
    return np.asarray((lowest == 0) & unsigned, dtype=np.bool_)


def stand_out(values: FloatArray) -> BoolArray:
    """Find pixels far above the others, in robust standard deviations.

    Shapes: `values` (y, x), result (y, x).
    """
    centre = float(np.median(values))
    spread = robust_sigma(values - centre)
    return np.asarray(values > centre + _OUTLIER_SIGMAS * max(spread, 1e-3), dtype=np.bool_)


def unsteady(found: Sequence[Moments], used: BoolArray) -> BoolArray:
    """Find pixels that blink, or over which a particle moved.

    Shapes: `used` (y, x), result (y, x).
    """
    out = np.zeros(used.shape, dtype=np.bool_)
    for item in found:
        variance, smooth = item.variance[used], np.empty(np.count_nonzero(used))
        for part in brightness_bins(item.mean[used]):
            smooth[part] = np.median(variance[part])
        out[used] |= variance > (1 + _OUTLIER_SIGMAS * item.relative_se) * smooth
    return out


def mask_notes(masked: Mapping[str, BoolArray]) -> list[str]:
    """Say how many pixels are left out, and where.

    Shapes: `masked` (y, x).
    """
    notes = []
    for name, mask in masked.items():
        if mask.any():
            (y, x), number = np.argwhere(mask)[0], int(mask.sum())
            notes.append(
                f"{number} of {mask.size} pixels {are(number)} {name} and left out, the first at "
                f"y = {y}, x = {x}"
            )
    return notes


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
        offset = zero_of_line((intercept, slope), cov)
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


def zero_of_line(line: Sequence[float] | FloatArray, covariance: FloatArray) -> Estimate:
    """Find where a line (intercept, slope) is zero.

    Shapes: `covariance` (2, 2).
    """
    intercept, slope = line
    gradient = np.array([-1 / slope, intercept / slope**2])
    return Estimate(-intercept / slope, math.sqrt(gradient @ covariance @ gradient))


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


_CONTRASTS = ("contrast_noise", "contrast_noise_se", "shot_noise")
NOISE_COLUMNS = ("n_frames", *_CONTRASTS, "excess", "excess_se", "comparisons")
"""Columns of `CameraCalibration.noise`."""


def noise_curve(
    stack: FrameSource, found: Moments, used: BoolArray, result: Solution, progress: Progress
) -> pd.DataFrame:
    """Compare the noise between successive averages of 1, 2, 4 … frames with shot noise.

    Notes
    -----
    The spread over pixels is taken from a median, so that a few particles do not count; what moves
    or drifts everywhere does.

    Shapes: `used` (y, x).
    """
    frames = stack.shape[0]
    light = found.mean[used] - result.offset.value
    if light.min() <= 0:
        light = np.maximum(light, 0.05 * light.mean())
    predicted = np.maximum(result.intercept + result.slope * found.mean[used], 1e-12) / light**2
    shot = result.slope / light
    ratios: list[list[float]] = [[] for _ in range(int(math.log2(frames // 2)) + 1)]

    def compared(sums: Iterator[FloatArray], n: int, found: list[float]) -> Iterator[FloatArray]:
        """Compare successive sums of n frames, and go on with those of 2 n."""
        stride = max(1, -(-(frames // n - 1) // 64))  # more would not narrow the curve noticeably
        earlier = np.empty(0)
        for number, total in enumerate(sums):
            if number and (number - 1) % stride == 0:
                contrast = total / earlier * (earlier.sum() / total.sum()) - 1
                z = np.abs(contrast - np.median(contrast)) / np.sqrt(2 * predicted / n)
                found.append(robust_sigma(z) ** 2)
            if number % 2:
                yield earlier + total
            earlier = total

    def single() -> Iterator[FloatArray]:
        for start, stop in blocks(stack.shape, (0, stack.shape[0]), _CACHE_BYTES):
            yield from stack.read(start, stop)[:, used] - result.offset.value
            progress("noise curve", stop, frames)

    stream = single()
    for j, found_ratios in enumerate(ratios):
        stream = compared(stream, 2**j, found_ratios)
    for _ in stream:
        pass
    rows = []
    scale, mean_shot = float(predicted.mean() / shot.mean()), float(shot.mean())
    for j, values in enumerate(ratios):
        if not values:
            continue
        excess = float(np.mean(values)) * scale
        # relative standard error of a variance from a median, times √n
        se = excess * 2.333 * math.sqrt(1.5 / (light.size * len(values)))
        noise, root = math.sqrt(2 * mean_shot / 2**j), math.sqrt(excess)
        rows.append((2**j, noise * root, noise * se / (2 * root), noise, excess, se, len(values)))
    return pd.DataFrame(rows, columns=list(NOISE_COLUMNS))


def verdict_of(noise: pd.DataFrame) -> tuple[int, str]:
    """Say up to which average the noise is shot noise."""
    # 10 % above shot noise, and three standard errors
    within = noise["excess"] <= 1.1 + 3.0 * noise["excess_se"]
    if not within.iloc[0]:
        return 0, (
            "not shot-noise limited: already between single frames the noise variance is "
            f"{noise['excess'].iloc[0]:.3g} times that of the photoelectrons"
        )
    stop = len(noise) if within.all() else int(np.argmin(within.to_numpy()))
    best = noise.iloc[stop - 1]
    frames, reached = int(best["n_frames"]), f"(contrast noise {best['contrast_noise']:.2g})"
    limited = f"shot-noise limited up to {frames} averaged frames"
    if stop == len(noise):
        return frames, f"{limited}, the longest average this recording can test {reached}"
    beyond = noise.iloc[stop]
    return frames, (
        f"{limited} {reached}; at {int(beyond['n_frames'])} the noise variance is "
        f"{beyond['excess']:.3g} times that of the photoelectrons: drift, or particles"
    )


LEAST_FRAMES = 8
"""Fewer say too little about the variance of a pixel."""

LEAST_FRAMES_FOR_MAPS = 100
"""Fewer leave the gain of one pixel uncertain by more than 17 %."""

_LEAST_PIXELS = 64
_CURVE_COLUMNS = ["mean_adu", "variance_adu2", "variance_se", "fit_adu2", "pixels"]


def measure_camera(
    light: Sequence[CountSource],
    *,
    dark: CountSource | None = None,
    offset_adu: float | None = None,
    maps: bool = False,
    progress: Progress = silent,
) -> CameraCalibration:
    """Measure gain, offset and read noise, and how far averaging lowers the noise.

    Every stack is read twice at most, a block at a time.
    """
    _checked(light, dark, maps)
    notes: list[str] = []
    light = [without_repeats(stack, LEAST_FRAMES, notes) for stack in light]
    stacks = [*light, *([dark] if dark is not None else [])]
    shape, total, done = stacks[0].shape[1:], sum(stack.shape[0] for stack in stacks), 0

    def advance(frames: int) -> None:
        nonlocal done
        done += frames
        progress("photon transfer", done, total)

    masked = {name: np.zeros(shape, dtype=np.bool_) for name in KINDS}
    dark_found = None
    if dark is not None:
        dark_found = _moments_of_dark(dark, masked, notes, advance)
        if not light:
            return _from_dark(dark_found, masked, maps)

    floor = float(np.median(dark_found.mean)) if dark_found is not None else offset_adu or 0.0
    found = [_moments_with_light(stack, floor, masked, advance) for stack in light]
    if dark is None and floor > 0:
        _refuse_darker(light, found, floor)
    used = ~np.logical_or.reduce(list(masked.values()))
    if np.count_nonzero(used) < _LEAST_PIXELS:
        raise DataError(
            f"{light[0].name}: only {np.count_nonzero(used)} pixels are lit, above zero counts, "
            f"unsaturated and alive throughout, fewer than {_LEAST_PIXELS}; change the exposure or "
            "the camera's offset, or record a flat"
        )
    used &= ~unsteady(found, used)
    masked["hot"] |= ~(used | masked["saturated"] | masked["dead"] | masked["clipped"])

    flicker_notes: list[str] = []
    result = solve(found, used, dark_found, offset_adu, flicker_notes)
    longest = int(np.argmax([item.n_frames for item in found]))
    spectrum = _spectrum(light[longest], ~used, result)
    if spectrum is not None and any(spectrum.shared):
        lines = "rows" if spectrum.shared[0] >= spectrum.shared[1] else "columns"
        again = (moments_of(stack, used, lambda _: None, flickering=lines) for stack in light)
        found = [replace(a, variance=b.variance) for a, b in zip(found, again, strict=True)]
        flicker_notes = [
            f"whole {lines} flicker ({100 * max(spectrum.shared):.2g} % of the noise variance); "
            f"the flicker of each of the {lines} was taken out"
        ]
        result = solve(found, used, dark_found, offset_adu, flicker_notes)
        spectrum = _spectrum(light[longest], ~used, result)
    notes += [*flicker_notes, *mask_notes(masked)]
    noise = noise_curve(light[longest], found[longest], used, result, progress)
    if spectrum is not None and spectrum.correlated:
        result = _with_neighbours(result, spectrum, notes)
    limit, verdict = verdict_of(noise)
    return CameraCalibration(
        *(result.gain, result.offset, result.offset_from),
        *(result.read_adu, result.read_e, result.read_below_e),
        curve=_curve(found, used, result, notes),
        noise=noise,
        shot_limited_frames=limit,
        verdict=verdict,
        masked=masked,
        maps=_maps(found, used, dark_found, result, notes) if maps else {},
        frames=sum(item.n_frames for item in found),
        notes=tuple(notes),
    )


def _moments_of_dark(
    dark: FrameSource,
    masked: dict[str, BoolArray],
    notes: list[str],
    advance: Callable[[int], None],
) -> Moments:
    """Measure the moments of a dark, and mask its pixels that are hot or dead."""
    found = moments_of(dark, None, advance)
    masked["hot"] |= stand_out(found.mean) | stand_out(found.variance)
    masked["dead"] |= found.variance <= 0
    low = float(np.mean(clipped(found.lowest)))
    if low > 0.01:  # that are worth a line
        notes.append(
            f"{100 * low:.0f} % of the dark's pixels reach zero counts, where noise is cut off: "
            "its offset is too high and its read noise too small; raise the camera's offset"
        )
    if masked["dead"].all():
        raise DataError(
            f"{dark.name}: every frame is the same: this is not raw camera data; record a dark"
        )
    return found


def _moments_with_light(
    stack: FrameSource, floor: float, masked: dict[str, BoolArray], advance: Callable[[int], None]
) -> Moments:
    """Measure the moments of a stack, and add pixels that are not to be used to those masked."""
    places = np.unique(np.linspace(0, stack.shape[0] - 1, 16).astype(int)).tolist()
    first = np.concatenate([stack.read(place, place + 1) for place in places])
    odd = masked["hot"] | masked["dead"] | saturated(first.max(axis=0), stack.name)
    lit = ~np.logical_or.reduce([odd, *unlike_neighbours(first.mean(axis=0) - floor)])
    measured = moments_of(stack, lit, advance)
    full = saturated(measured.highest, stack.name)
    masked["saturated"] |= full
    masked["clipped"] |= clipped(measured.lowest) & (measured.variance > 0)
    dark, bright = unlike_neighbours(measured.mean - floor)
    masked["dead"] |= (dark | (measured.variance <= 0)) & ~full
    masked["hot"] |= bright & ~full
    return measured


def _refuse_darker(light: Sequence[FrameSource], found: Sequence[Moments], floor: float) -> None:
    """Refuse a stack with no more counts than the offset that was given."""
    for stack, measured in zip(light, found, strict=True):
        if np.median(measured.mean) <= floor:
            raise DataError(
                f"{stack.name}: has {np.median(measured.mean):.5g} counts, no more than "
                f"`offset_adu` = {floor:g}: give the counts that the camera has in the dark"
            )


def _spectrum(stack: FrameSource, masked: BoolArray, result: Solution) -> NoiseSpectrum | None:
    """Measure the noise of a stack as that of the camera that was found."""
    camera = Camera(
        gain_e_per_adu=result.gain.value,
        offset_adu=result.offset.value,
        read_noise_e=result.read_e.value if result.read_e else 0.0,
    )
    counts = stack.read(0, min(stack.shape[0], 128))  # on which correlations of pixels are measured
    return measure_spectrum(counts, camera, masked=masked)


def _with_neighbours(result: Solution, spectrum: NoiseSpectrum, notes: list[str]) -> Solution:
    """Correct the gain for noise that neighbouring pixels share."""
    summed, error = (value / spectrum.variance for value in spectrum.summed)
    gain, scatter = result.gain.value / summed, math.sqrt(spectrum.alike) * result.gain.se
    x, y = spectrum.neighbours
    notes.append(
        f"the noise of neighbouring pixels is correlated ({x:+.2f} in x, {y:+.2f} in y): pixels "
        f"share charge or are filtered, and one alone has {1 / summed:.3g} of the variance of its "
        "light; the gain is from the noise that neighbours have together"
    )
    read = result.read_e
    return replace(
        result,
        gain=Estimate(gain, math.hypot(scatter / summed, gain * error / summed)),
        read_e=Estimate(read.value / summed, read.se / summed) if read else None,
        read_below_e=result.read_below_e / summed if result.read_below_e else None,
    )


def _checked(light: Sequence[FrameSource], dark: FrameSource | None, maps: bool) -> None:
    """Refuse stacks that are not usable together."""
    stacks = [*light, *([dark] if dark is not None else [])]
    if not stacks:
        raise DataError("no recording was given; give a flat, the movie, or a dark")
    for stack in stacks:
        if stack.shape[0] < LEAST_FRAMES:
            raise DataError(
                f"{stack.name}: has {stack.shape[0]} frames; photon transfer needs {LEAST_FRAMES} "
                "or more of the same scene"
            )
        if stack.shape[1:] != stacks[0].shape[1:]:
            ours, theirs = (" x ".join(map(str, s.shape[1:])) for s in (stacks[0], stack))
            raise DataError(
                f"{stack.name}: is {theirs} pixels but {stacks[0].name} is {ours}; "
                "record both with the same region of the sensor"
            )
    frames = sum(stack.shape[0] for stack in light)
    if maps and light and frames < LEAST_FRAMES_FOR_MAPS:
        raise DataError(
            f"`maps` needs {LEAST_FRAMES_FOR_MAPS} frames or more, not {frames}: with fewer the "
            "gain of one pixel is all noise"
        )


def _curve(
    found: Sequence[Moments], used: BoolArray, result: Solution, notes: list[str]
) -> pd.DataFrame:
    """Average variance against mean in bins of equally many pixels, for each stack."""
    rows = []
    for item in found:
        mean, variance = item.mean[used], item.variance[used]
        for part in brightness_bins(mean):
            level, values = float(mean[part].mean()), variance[part]
            se = float(values.std(ddof=1)) / math.sqrt(part.size)
            fit = result.intercept + result.slope * level
            rows.append((level, float(values.mean()), se, fit, part.size))
    curve = pd.DataFrame(rows, columns=_CURVE_COLUMNS).sort_values("mean_adu", ignore_index=True)
    residual = (curve["variance_adu2"] - curve["fit_adu2"]) / curve["variance_se"]
    chi2 = float((residual**2).mean())
    if chi2 > 3.0:  # reduced
        notes.append(
            f"the variance does not follow a straight line (reduced χ² {chi2:.3g}): the camera is "
            "not linear, the frames were processed, or the light itself is noisy"
        )
    return curve


def _maps(
    found: Sequence[Moments],
    used: BoolArray,
    dark: Moments | None,
    result: Solution,
    notes: list[str],
) -> dict[str, FloatArray]:
    """Make one number per pixel; masked pixels keep that of the whole sensor."""
    gain = result.gain.value
    offset = dark.mean if dark is not None else np.full(used.shape, result.offset.value)
    read: FloatArray | float = max(0.0, result.intercept + result.slope * result.offset.value)
    read = dark.variance if dark is not None else read
    weights = [item.n_frames - 1 for item in found]
    light, shot = (
        np.tensordot(weights, each, axes=1)
        for each in ([m.mean - offset for m in found], [m.variance - read for m in found])
    )
    good = used & (shot > 0) & (light > 0)
    found_gain = np.full(used.shape, gain)
    found_gain[good] = light[good] / shot[good]
    expected = math.sqrt(3 / sum(weights))
    seen = robust_sigma(found_gain[good] / gain - 1)
    own = math.sqrt(max(0.0, seen**2 - expected**2))
    notes.append(
        f"the gain map spreads by {100 * seen:.2g} %, of which {100 * expected:.2g} % is its own "
        + (
            f"noise: the pixels differ by about {100 * own:.2g} %"
            if seen > 1.1 * expected
            else "noise: the pixels do not differ noticeably, so use the number and not the map"
        )
    )
    maps = {"gain_e_per_adu": found_gain}
    if dark is None:
        notes.append("maps of offset and read noise need a dark")
        return maps
    maps["offset_adu"] = np.where(used, dark.mean, result.offset.value)
    typical = result.read_e.value if result.read_e is not None else 0.0
    maps["read_noise_e"] = np.where(used, np.sqrt(np.maximum(dark.variance, 0)) * gain, typical)
    return maps


def _from_dark(dark: Moments, masked: dict[str, BoolArray], maps: bool) -> CameraCalibration:
    """Calibrate without light: offset and read noise in counts, but no gain."""
    used = ~(masked["hot"] | masked["dead"])
    offset, read = dark_numbers(dark, used)
    note = "a dark alone gives no gain, so the read noise is in counts; add a flat or the movie"
    return CameraCalibration(
        *(None, offset, "dark", read, None, None),
        curve=pd.DataFrame(columns=_CURVE_COLUMNS),
        noise=pd.DataFrame(columns=list(NOISE_COLUMNS)),
        shot_limited_frames=None,
        verdict="a dark says nothing of shot noise",
        masked=masked,
        maps={"offset_adu": np.where(used, dark.mean, offset.value)} if maps else {},
        frames=0,
        notes=(note, *mask_notes(masked)),
    )


def without_repeats(stack: CountSource, least: int, notes: list[str]) -> CountSource:
    """Leave out frames that are zero throughout or equal to the frame before."""
    total = stack.shape[0]
    good = np.zeros(total, dtype=np.bool_)
    last: NDArray[Any] | None = None
    for start, stop in blocks(stack.shape, (0, stack.shape[0]), _CACHE_BYTES):
        for k, frame in enumerate(stack.read(start, stop), start):
            good[k] = frame.any() and not (last is not None and np.array_equal(frame, last))
            last = frame
    kept = np.flatnonzero(good)
    if kept.size <= 1 or kept.size == total:
        return stack
    if kept.size < least:
        raise DataError(
            f"{stack.name}: only {kept.size} of {total} frames are neither zero throughout nor the "
            f"same as the frame before; photon transfer needs {least} or more"
        )
    lost = np.flatnonzero(~good)
    notes.append(
        f"{stack.name}: {frames_listed(lost)} {are(lost.size)} zero throughout or the same as the "
        "frame before (dropped or stuck in the camera); left out"
    )
    return SelectedFrames(stack, kept)
