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
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress, silent

LEAST_FRAMES = 8
"""Fewer say too little about the variance of a pixel."""

LEAST_FRAMES_FOR_MAPS = 100
"""Fewer leave the gain of one pixel uncertain by more than 17 %."""

EXCESS = 0.10
"""Noise variance above shot noise by more than this, and three standard errors, is a limit."""

_SIGMAS = 3.0
_Z95 = 1.959964
_Z95_ONE_SIDED = 1.644854
_BLOCK_BYTES = 32 * 2**20
_DARK, _BRIGHT = 0.2, 5.0  # of the neighbours' median, as in the stage background
_OUTLIER_SIGMAS = 8.0
_COMPARISONS = 64  # of the noise curve, at each length: more would not narrow it noticeably
_BINS = 32
_USABLE_SLOPE = 0.30  # relative standard error beyond which a gain is none
_GOOD_SLOPE = 0.05
_USABLE_OFFSET = 0.05  # standard error over the light level
_STEADY = 2.0  # robust χ² of the flicker line beyond which the scene has moved
_LEAST_RELIABILITY = 0.9  # of the spread of the means that is not their own noise
_CURVED = 3.0  # reduced χ² of the photon-transfer curve
_MAD = 0.6744898
_MAD_VARIANCE = 2.333  # relative standard error of a variance from a median, times √n


@dataclass(frozen=True)
class Estimate:
    """A number and how well it is known.

    Attributes
    ----------
    value, se : float
        Estimate and standard error, in the same unit.
    """

    value: float
    se: float

    @property
    def ci95(self) -> tuple[float, float]:
        """Central 95 % confidence interval."""
        return self.value - _Z95 * self.se, self.value + _Z95 * self.se


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What the noise says of a camera; `measure_camera` makes it.

    Attributes
    ----------
    gain_e_per_adu : Estimate or None
        Photoelectrons per count [e/count]; None from a dark alone.
    offset_adu : Estimate
        Counts in the dark [counts]; where `offset_from` is ``"line"`` it is o − σ_r²/g.
    offset_from : str
        ``"dark"``, ``"given"``, ``"flicker"`` or ``"line"``.
    read_noise_adu : Estimate or None
        Standard deviation per frame, rounding included [counts]; None where not identifiable.
    read_noise_e : Estimate or None
        The same [e].
    read_noise_below_e : float or None
        95 % upper limit where the read noise is too small to be seen [e].
    curve : pandas.DataFrame
        Photon-transfer curve: mean_adu, variance_adu2, variance_se, fit_adu2, pixels.
    noise : pandas.DataFrame
        Noise against averaging: n_frames, contrast_noise, contrast_noise_se, shot_noise, excess
        (noise variance over shot-noise variance), excess_se, comparisons.
    shot_limited_frames : int or None
        Longest average whose noise is shot noise; 0 for none, None where it cannot be told.
    verdict : str
        The same in one sentence.
    masked : dict of str to ndarray of bool, shape (y, x)
        ``"saturated"``, ``"dead"``, ``"hot"`` (bright or noisy beyond its neighbours).
    maps : dict of str to ndarray, shape (y, x)
        As far as the recordings give them and they were asked for: ``"gain_e_per_adu"``,
        ``"offset_adu"``, ``"read_noise_e"``.
    frames : int
        Frames of light that were used.
    notes : tuple of str
        What the user should know, one sentence each.
    """

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
    notes: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Give what ``camera.json`` holds.

        Returns
        -------
        dict
            Nested plain values, the curves by column; maps are left out.
        """

        def plain(estimate: Estimate | None) -> dict[str, Any] | None:
            if estimate is None:
                return None
            return {"value": estimate.value, "se": estimate.se, "ci95": list(estimate.ci95)}

        return {
            "gain_e_per_adu": plain(self.gain_e_per_adu),
            "offset_adu": plain(self.offset_adu),
            "offset_from": self.offset_from,
            "read_noise_adu": plain(self.read_noise_adu),
            "read_noise_e": plain(self.read_noise_e),
            "read_noise_below_e": self.read_noise_below_e,
            "shot_limited_frames": self.shot_limited_frames,
            "verdict": self.verdict,
            "frames": self.frames,
            "masked_pixels": {name: int(mask.sum()) for name, mask in self.masked.items()},
            "photon_transfer": self.curve.to_dict("list"),
            "noise": self.noise.to_dict("list"),
            "notes": list(self.notes),
        }

    def to_toml(self, maps: dict[str, str] | None = None) -> str:
        """Write the section ``[camera]`` to paste into a configuration.

        Parameters
        ----------
        maps : dict of str to str, optional
            Paths of maps, by key, to name in place of the numbers.

        Returns
        -------
        str
            TOML text; a value that is not known is left out.
        """
        lines = ["[camera]"]
        for key, estimate in (
            ("gain_e_per_adu", self.gain_e_per_adu),
            ("offset_adu", self.offset_adu),
            ("read_noise_e", self.read_noise_e),
        ):
            if estimate is None:
                continue
            low, high = estimate.ci95
            value = f'"{maps[key]}"' if maps and key in maps else f"{estimate.value:.6g}"
            lines.append(f"{key} = {value}  # 95 %: {low:.6g} to {high:.6g}")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, eq=False)
class _Light:
    """Moments of one stack, per pixel [counts]."""

    mean: FloatArray
    variance: FloatArray
    slope: FloatArray  # of the pixel against the mean frame, 1 on average
    slope_variance: FloatArray
    highest: NDArray[Any]
    n_frames: int

    @property
    def relative_se(self) -> float:
        """Standard error of one pixel's variance, relative (von Neumann et al., 1941)."""
        return math.sqrt(3 * self.n_frames - 4) / (self.n_frames - 1)


def measure_camera(
    light: Sequence[FrameSource],
    *,
    dark: FrameSource | None = None,
    offset_adu: float | None = None,
    maps: bool = False,
    progress: Progress = silent,
) -> CameraCalibration:
    """Measure gain, offset and read noise, and how far averaging lowers the noise.

    Every stack is read twice at most, a block at a time.

    Parameters
    ----------
    light : sequence of FrameSource
        Flats, or the movie itself, at one or several levels, each of `LEAST_FRAMES` frames or more;
        may be empty where `dark` is given.
    dark : FrameSource, optional
        Frames without light.
    offset_adu : float, optional
        The offset, where it is known and there is no dark [counts].
    maps : bool
        Give maps as well as numbers.
    progress : Progress
        Told how many frames are done.

    Returns
    -------
    CameraCalibration
        Estimates with standard errors from the scatter over pixels, curves and a verdict.

    Raises
    ------
    DataError
        The stacks differ in shape, are too short, are saturated, or hold no noise that grows with
        the light.
    """
    _check(light, dark, maps)
    shape = (*light, dark)[0].shape[1:] if light else dark.shape[1:]  # type: ignore[union-attr]
    notes: list[str] = []
    masked = {name: np.zeros(shape, dtype=np.bool_) for name in ("saturated", "dead", "hot")}
    frames = sum(stack.shape[0] for stack in light) + (dark.shape[0] if dark else 0)
    counter = _Counter(progress, frames)

    dark_found = None
    if dark is not None:
        dark_found = _moments(dark, None, counter)
        masked["hot"] |= _stand_out(dark_found.mean) | _stand_out(dark_found.variance)
        masked["dead"] |= dark_found.variance <= 0
        if masked["dead"].all():
            raise DataError(
                f"{dark.name}: every frame is the same: this is not raw camera data; record a dark"
            )
    if not light:
        return _from_dark(dark_found, masked, maps)  # type: ignore[arg-type]

    floor = float(np.median(dark_found.mean)) if dark_found is not None else offset_adu or 0.0
    found = []
    for stack in light:
        first = _glance(stack)
        odd = masked["hot"] | masked["dead"] | _saturated(first.max(axis=0), stack.name)
        measured = _moments(stack, ~(odd | _off(first.mean(axis=0) - floor)), counter)
        full = _saturated(measured.highest, stack.name)
        masked["saturated"] |= full
        masked["dead"] |= (measured.variance <= 0) & ~full
        masked["dead"] |= _off(measured.mean - floor, high=math.inf) & ~full
        masked["hot"] |= _off(measured.mean - floor, low=-math.inf) & ~full
        found.append(measured)
    used = ~np.logical_or.reduce(list(masked.values()))
    if np.count_nonzero(used) < 2 * _BINS:
        raise DataError(
            f"{light[0].name}: only {np.count_nonzero(used)} pixels are lit, unsaturated and alive "
            f"throughout, fewer than {2 * _BINS}; lower the exposure, or record a flat"
        )
    used &= ~_unsteady(found, used)
    masked["hot"] |= ~(used | masked["saturated"] | masked["dead"])

    result = _solve(found, used, dark_found, offset_adu, notes)
    _share_notes(masked, notes)
    longest = int(np.argmax([item.n_frames for item in found]))
    noise = _noise_curve(light[longest], found[longest], used, result, progress)
    limit, verdict = _verdict(noise)
    return CameraCalibration(
        gain_e_per_adu=result.gain,
        offset_adu=result.offset,
        offset_from=result.offset_from,
        read_noise_adu=result.read_adu,
        read_noise_e=result.read_e,
        read_noise_below_e=result.read_below_e,
        curve=_curve(found, used, result, notes),
        noise=noise,
        shot_limited_frames=limit,
        verdict=verdict,
        masked=masked,
        maps=_maps(found, used, dark_found, result, notes) if maps else {},
        frames=sum(item.n_frames for item in found),
        notes=tuple(notes),
    )


# ---- reading -------------------------------------------------------------------------------------


class _Counter:
    """Counts frames over several stacks."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def add(self, frames: int) -> None:
        self._done += frames
        self._progress("photon transfer", self._done, self._total)


def _check(light: Sequence[FrameSource], dark: FrameSource | None, maps: bool) -> None:
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
            f"--maps needs {LEAST_FRAMES_FOR_MAPS} frames or more, not {frames}: with fewer the "
            "gain of one pixel is all noise"
        )


def _blocks(stack: FrameSource) -> list[tuple[int, int]]:
    frames, rows, columns = stack.shape
    size = max(2, _BLOCK_BYTES // (8 * rows * columns))
    return [(a, min(a + size, frames)) for a in range(0, frames, size)]


def _glance(stack: FrameSource) -> NDArray[Any]:
    """Return a few frames from all over the stack."""
    frames = stack.shape[0]
    places = np.unique(np.linspace(0, frames - 1, 16).astype(int))
    return np.concatenate([stack.read(int(k), int(k) + 1) for k in places])


def _moments(stack: FrameSource, used: BoolArray | None, counter: _Counter) -> _Light:
    """Mean and variance of every pixel; with `used`, the laser's flicker is taken out.

    Differences d_k of successive frames have the covariance v·(2, −1 beside the diagonal).  Their
    regression on the differences D_k of the mean over `used` takes away DᵀMD/DᵀD of the 2(K − 1)
    squares that are expected, with M that matrix; the mean carries 1/P of each pixel's noise.
    """
    frames, rows, columns = stack.shape
    total = np.zeros((rows, columns))
    squares = np.zeros((rows, columns))
    product = np.zeros((rows, columns))
    highest: NDArray[Any] | None = None
    flicker = []
    last: FloatArray | None = None
    for start, stop in _blocks(stack):
        counts = stack.read(start, stop)
        if not np.isfinite(counts).all():
            raise DataError(
                f"{stack.name}: frames {start} to {stop - 1} hold NaN or infinity; give raw counts"
            )
        top = counts.max(axis=0)
        highest = top if highest is None else np.maximum(highest, top)
        block = counts.astype(np.float64)
        total += block.sum(axis=0)
        if last is not None:
            block = np.concatenate([last[np.newaxis], block])
        steps = np.diff(block, axis=0)
        squares += np.einsum("kyx,kyx->yx", steps, steps)
        if used is not None:
            common = steps[:, used].mean(axis=1)
            product += np.tensordot(common, steps, axes=1)
            flicker.append(common)
        last = block[-1]
        counter.add(stop - start)
    n = frames - 1
    mean = total / frames
    if used is None:
        return _Light(mean, squares / (2 * n), np.ones_like(mean), np.zeros_like(mean),
                      highest, frames)  # type: ignore[arg-type] # fmt: skip
    common = np.concatenate(flicker)
    power = float(common @ common)
    spread = 2 * power - 2 * float(common[:-1] @ common[1:])
    if power <= 0:
        raise DataError(
            f"{stack.name}: successive frames are identical: this is not raw camera data"
        )
    pixels = int(np.count_nonzero(used))
    variance = (squares - product**2 / power) / (2 * n - spread / power) / (1 - 1 / pixels)
    own = 2 * n * variance / pixels
    slope_power = power - float(own[used].mean())
    usable = slope_power > 0.1 * power  # else the flicker is the frames' own noise
    slope = (product - own) / slope_power if usable else np.full_like(mean, np.nan)
    slope_variance = variance * spread / slope_power**2 if usable else np.full_like(mean, np.nan)
    return _Light(mean, variance, slope, slope_variance, highest, frames)  # type: ignore[arg-type]


# ---- pixels that must not be used ----------------------------------------------------------------


def _saturated(highest: NDArray[Any], name: str) -> BoolArray:
    """Pixels that ever reached the largest number of their type, or of an ADC of 8 to 16 bits."""
    top = float(highest.max())
    ceiling = math.inf
    if np.issubdtype(highest.dtype, np.integer):
        ceiling = float(np.iinfo(highest.dtype).max)
    if top >= 255 and math.log2(top + 1).is_integer():
        ceiling = min(ceiling, top)
    full: BoolArray = highest >= ceiling
    if full.mean() > 0.5:
        raise DataError(
            f"{name}: {100 * full.mean():.0f} % of the pixels are saturated (count {top:g}); "
            "lower the exposure or the laser power"
        )
    return full


def _off(light: FloatArray, *, low: float = _DARK, high: float = _BRIGHT) -> BoolArray:
    """Pixels far darker or brighter than their neighbours."""
    local = np.maximum(median_filter(light, size=5, mode="nearest"), 0.0)
    with np.errstate(invalid="ignore"):
        found: BoolArray = (light < low * local) | (light > high * local)
    return np.asarray(found & (local > 0), dtype=np.bool_)


def _stand_out(values: FloatArray) -> BoolArray:
    """Pixels far above the others, in robust standard deviations."""
    centre = float(np.median(values))
    spread = float(np.median(np.abs(values - centre))) / _MAD
    return np.asarray(values > centre + _OUTLIER_SIGMAS * max(spread, 1e-3), dtype=np.bool_)


def _unsteady(found: Sequence[_Light], used: BoolArray) -> BoolArray:
    """Pixels that blink, or through which a particle moved, from the variance around the line."""
    out = np.zeros(used.shape, dtype=np.bool_)
    for item in found:
        mean, variance = item.mean[used], item.variance[used]
        order = np.argsort(mean)
        smooth = np.empty(mean.size)
        for part in np.array_split(order, max(1, min(_BINS, mean.size // 32))):
            smooth[part] = np.median(variance[part])
        limit = 1 + _OUTLIER_SIGMAS * item.relative_se
        out[used] |= variance > limit * smooth
    return out


def _share_notes(masked: dict[str, BoolArray], notes: list[str]) -> None:
    total = next(iter(masked.values())).size
    for name, mask in masked.items():
        count = int(mask.sum())
        if count:
            place = np.argwhere(mask)[0]
            notes.append(
                f"{count} of {total} pixels {'is' if count == 1 else 'are'} {name} and left out, "
                f"the first at y = {place[0]}, x = {place[1]}"
            )


# ---- from moments to a camera --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Solution:
    gain: Estimate
    offset: Estimate
    offset_from: str
    read_adu: Estimate | None
    read_e: Estimate | None
    read_below_e: float | None
    intercept: float  # of the fitted variance against the mean [counts²]
    slope: float


def _solve(
    found: Sequence[_Light],
    used: BoolArray,
    dark: _Light | None,
    given: float | None,
    notes: list[str],
) -> _Solution:
    mean = np.concatenate([item.mean[used] for item in found])
    variance = np.concatenate([item.variance[used] for item in found])
    frames = np.concatenate([np.full(used.sum(), item.n_frames - 1.0) for item in found])
    if dark is not None:
        return _with_dark(mean, variance, frames, dark, used, len(found))

    offset, source = _offset(found, used, given, notes)
    own = float((variance / (frames + 1)).mean())
    reliability = 1 - own / float(mean.var()) if mean.var() > 0 else 0.0
    line = None
    if reliability > _LEAST_RELIABILITY:
        (intercept, slope), cov = _line(mean, variance, frames)
        if slope > 0 and math.sqrt(cov[1, 1]) / slope < _USABLE_SLOPE:
            line = intercept, slope, cov
        elif slope <= 0 and -slope > _SIGMAS * math.sqrt(cov[1, 1]):
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
        return _Solution(gain, offset, "line", None, None, None, intercept, slope)
    read = intercept + slope * offset.value
    gradient = np.array([1.0, offset.value])
    read_se = math.sqrt(gradient @ cov @ gradient + (slope * offset.se) ** 2)
    if read > 2 * read_se:
        root = math.sqrt(read)
        adu = Estimate(root, read_se / (2 * root))
        electrons = Estimate(root / slope, math.hypot(adu.se / slope, root * relative / slope))
        return _Solution(gain, offset, source, adu, electrons, None, intercept, slope)
    below = math.sqrt(max(read, 0.0) + _Z95_ONE_SIDED * read_se) / slope
    notes.append(
        f"the read noise is too small beside the shot noise to be seen: below {below:.3g} e "
        "(95 %); a dark would measure it"
    )
    return _Solution(gain, offset, source, None, None, below, intercept, slope)


def _with_dark(
    mean: FloatArray,
    variance: FloatArray,
    frames: FloatArray,
    dark: _Light,
    used: BoolArray,
    n: int,
) -> _Solution:
    """Fit the slope alone: the dark gives every pixel's own offset and read noise."""
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
        new = float(np.sum(weight * light * shot) / np.sum(weight * light**2))
        done = abs(new - slope) < 1e-12 * slope
        slope = new
        if done:
            break
    se = math.sqrt(float(np.sum((weight * light * (shot - slope * light)) ** 2))) / float(
        np.sum(weight * light**2)
    )
    gain = Estimate(1 / slope, se / slope**2)
    offset, read = _dark_numbers(dark, used)
    electrons = Estimate(
        read.value / slope, math.hypot(read.se / slope, read.value * se / slope**2)
    )
    intercept = read.value**2 - slope * offset.value
    return _Solution(gain, offset, "dark", read, electrons, None, intercept, slope)


def _dark_numbers(dark: _Light, used: BoolArray) -> tuple[Estimate, Estimate]:
    """Offset and read noise [counts], with standard errors from the scatter over pixels."""
    pixels = math.sqrt(np.count_nonzero(used))
    mean, variance = dark.mean[used], dark.variance[used]
    root = math.sqrt(float(variance.mean()))
    return (
        Estimate(float(mean.mean()), float(mean.std(ddof=1)) / pixels),
        Estimate(root, float(variance.std(ddof=1)) / pixels / (2 * root)),
    )


def _ratio(
    mean: FloatArray, variance: FloatArray, offset: Estimate | None, source: str, notes: list[str]
) -> _Solution:
    """One level only: the gain follows if the offset is known and the read noise is small."""
    if offset is None:
        raise DataError(
            "the pixels are too alike in brightness for variance against mean, and the offset is "
            "not known: give a dark (--dark), the offset (--offset), or a second level"
        )
    light = mean - offset.value
    if light.mean() <= 0:
        raise DataError(
            f"the offset of {offset.value:g} counts is not below the frames' mean of "
            f"{mean.mean():g}; correct --offset"
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
    return _Solution(
        Estimate(1 / ratio, se / ratio**2), offset, source, None, None, None,
        -ratio * offset.value, ratio,
    )  # fmt: skip


def _line(x: FloatArray, y: FloatArray, frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit y = a + b·x with the variance of y as (fit)²/frames; sandwich covariance."""
    centre, scale = float(x.mean()), float(x.std())
    design = np.stack([np.ones_like(x), (x - centre) / scale], axis=1)
    fit = np.full(x.shape, y.mean())
    for _ in range(25):
        weight = frames / np.square(np.maximum(fit, 0.05 * y.mean()))
        normal = design.T @ (design * weight[:, np.newaxis])
        theta = np.linalg.solve(normal, design.T @ (weight * y))
        new = design @ theta
        done = np.max(np.abs(new - fit)) < 1e-10 * y.mean()
        fit = new
        if done:
            break
    inverse = np.linalg.inv(normal)
    score = design * (weight * (y - fit))[:, np.newaxis]
    cov = inverse @ (score.T @ score) @ inverse
    back = np.array([[1.0, -centre / scale], [0.0, 1 / scale]])
    return back @ theta, back @ cov @ back.T


def _offset(
    found: Sequence[_Light], used: BoolArray, given: float | None, notes: list[str]
) -> tuple[Estimate | None, str]:
    """Where the pixels' response to the laser's power vanishes; combined over all that know."""
    if given is not None:
        return Estimate(given, 0.0), "given"
    estimates = [
        _zero(item.slope[used], item.slope_variance[used], item.mean[used]) for item in found
    ]
    order = sorted(found, key=lambda item: float(item.mean[used].mean()))
    for low, high in pairwise(order):
        rise = float((high.mean - low.mean)[used].mean())
        noise = (low.variance / low.n_frames + high.variance / high.n_frames)[used]
        if rise > 0:
            slope = (high.mean - low.mean)[used] / rise
            estimates.append(_zero(slope, noise / rise**2, low.mean[used]))
    known = [item for item in estimates if item is not None]
    if not known:
        return None, "line"
    weights = np.array([1 / item.se**2 for item in known])
    value = float(np.sum(weights * [item.value for item in known]) / weights.sum())
    se = float(1 / math.sqrt(weights.sum()))
    level = float(np.mean([item.mean[used].mean() for item in found]))
    if se > _USABLE_OFFSET * abs(level - value):
        return None, "line"
    notes.append(
        "the offset is that of the light which follows the laser's power: stray light that "
        "flickers with it is not part of it"
    )
    return Estimate(value, se), "flicker"


def _zero(slope: FloatArray, variance: FloatArray, mean: FloatArray) -> Estimate | None:
    """Mean at which the slope is zero, from a weighted line of slope against mean."""
    if not np.isfinite(slope).all() or mean.std() == 0:
        return None
    weight = 1 / variance
    kept = np.ones(slope.shape, dtype=np.bool_)
    for _ in range(4):
        w = np.where(kept, weight, 0.0)
        centre = float(np.sum(w * mean) / w.sum())
        x = mean - centre
        level = float(np.sum(w * slope) / w.sum())
        gradient = float(np.sum(w * x * slope) / np.sum(w * x * x))
        residual = (slope - level - gradient * x) * np.sqrt(weight)
        robust = float(np.median(np.abs(residual))) / _MAD
        kept = np.abs(residual) < 5 * max(robust, 1e-12)
    if robust**2 > _STEADY or gradient <= 0:
        return None
    score_level = w * (slope - level - gradient * x)
    gradient_se = math.sqrt(float(np.sum((score_level * x) ** 2))) / float(np.sum(w * x * x))
    level_se = math.sqrt(float(np.sum(score_level**2))) / float(w.sum())
    if gradient < 5 * gradient_se:
        return None
    zero = centre - level / gradient
    se = math.hypot(level_se / gradient, level / gradient**2 * gradient_se)
    return Estimate(zero, se)


# ---- curves, maps, verdict -----------------------------------------------------------------------


def _curve(
    found: Sequence[_Light], used: BoolArray, result: _Solution, notes: list[str]
) -> pd.DataFrame:
    """Variance against mean in bins of equally many pixels, each stack by itself."""
    rows = []
    for item in found:
        mean, variance = item.mean[used], item.variance[used]
        parts = np.array_split(np.argsort(mean), max(1, min(_BINS, mean.size // 32)))
        for part in parts:
            rows.append(
                (
                    float(mean[part].mean()),
                    float(variance[part].mean()),
                    float(variance[part].std(ddof=1)) / math.sqrt(part.size),
                    result.intercept + result.slope * float(mean[part].mean()),
                    int(part.size),
                )
            )
    names = ["mean_adu", "variance_adu2", "variance_se", "fit_adu2", "pixels"]
    curve = pd.DataFrame(rows, columns=names).sort_values("mean_adu", ignore_index=True)
    chi2 = float(
        (((curve["variance_adu2"] - curve["fit_adu2"]) / curve["variance_se"]) ** 2).mean()
    )
    if chi2 > _CURVED:
        notes.append(
            f"the variance does not follow a straight line (reduced χ² {chi2:.3g}): the camera is "
            "not linear, the frames were processed, or the light itself is noisy"
        )
    return curve


def _noise_curve(
    stack: FrameSource, found: _Light, used: BoolArray, result: _Solution, progress: Progress
) -> pd.DataFrame:
    """Contrast noise between successive averages of 1, 2, 4 … frames, against shot noise.

    The spread over pixels is taken from a median, so that a few particles do not count; what moves
    or drifts everywhere does.
    """
    frames = stack.shape[0]
    light = found.mean[used] - result.offset.value
    if light.min() <= 0:
        light = np.maximum(light, 0.05 * light.mean())
    predicted = np.maximum(result.intercept + result.slope * found.mean[used], 1e-12) / light**2
    shot = result.slope / light
    levels = int(math.log2(frames // 2))
    strides = [max(1, -(-(frames // 2**j - 1) // _COMPARISONS)) for j in range(levels + 1)]
    waiting: list[FloatArray | None] = [None] * (levels + 1)
    last: list[FloatArray | None] = [None] * (levels + 1)
    seen = [0] * (levels + 1)
    ratios: list[list[float]] = [[] for _ in range(levels + 1)]
    for start, stop in _blocks(stack):
        block = stack.read(start, stop)[:, used].astype(np.float64)
        for frame in block:
            total: FloatArray | None = frame - result.offset.value
            for j in range(levels + 1):
                if total is None:
                    break
                earlier = last[j]
                if earlier is not None and (seen[j] - 1) % strides[j] == 0:
                    contrast = total / earlier * (earlier.sum() / total.sum()) - 1
                    z = np.abs(contrast - np.median(contrast))
                    z /= np.sqrt(2 * predicted / 2**j)
                    ratios[j].append(float((np.median(z) / _MAD) ** 2))
                last[j] = total
                seen[j] += 1
                pair = waiting[j]
                waiting[j] = total if pair is None else None
                total = None if pair is None else pair + total
        progress("noise curve", stop, frames)
    rows = []
    scale = float(predicted.mean() / shot.mean())
    for j, values in enumerate(ratios):
        if not values:
            continue
        n = 2**j
        excess = float(np.mean(values)) * scale
        pixels = light.size
        se = excess * _MAD_VARIANCE * math.sqrt(1.5 / (pixels * len(values)))
        noise = math.sqrt(2 * float(shot.mean()) / n)
        rows.append(
            (n, noise * math.sqrt(excess), noise * se / (2 * math.sqrt(excess)), noise,
             excess, se, len(values))
        )  # fmt: skip
    names = [
        "n_frames", "contrast_noise", "contrast_noise_se", "shot_noise", "excess", "excess_se",
        "comparisons",
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=names)


def _verdict(noise: pd.DataFrame) -> tuple[int, str]:
    """Say up to which average the noise is shot noise."""
    within = noise["excess"] <= 1 + EXCESS + _SIGMAS * noise["excess_se"]
    first = noise.iloc[0]
    if not within.iloc[0]:
        return 0, (
            f"not shot-noise limited: already between single frames the noise variance is "
            f"{first['excess']:.3g} times that of the photoelectrons"
        )
    if within.all():
        longest = noise.iloc[-1]
        return int(longest["n_frames"]), (
            f"shot-noise limited up to {int(longest['n_frames'])} averaged frames, the longest "
            f"average this recording can test (contrast noise {longest['contrast_noise']:.2g})"
        )
    stop = int(np.argmin(within.to_numpy()))
    best, beyond = noise.iloc[stop - 1], noise.iloc[stop]
    return int(best["n_frames"]), (
        f"shot-noise limited up to {int(best['n_frames'])} averaged frames (contrast noise "
        f"{best['contrast_noise']:.2g}); at {int(beyond['n_frames'])} the noise variance is "
        f"{beyond['excess']:.3g} times that of the photoelectrons: drift, or particles"
    )


def _maps(
    found: Sequence[_Light],
    used: BoolArray,
    dark: _Light | None,
    result: _Solution,
    notes: list[str],
) -> dict[str, FloatArray]:
    """One number per pixel; what is masked keeps the number of the whole sensor."""
    gain = result.gain.value
    offset = dark.mean if dark is not None else np.full(used.shape, result.offset.value)
    read = dark.variance if dark is not None else np.full(
        used.shape, max(0.0, result.intercept + result.slope * result.offset.value)
    )  # fmt: skip
    light = sum(
        ((item.n_frames - 1) * (item.mean - offset) for item in found), np.zeros(used.shape)
    )
    shot = sum(
        ((item.n_frames - 1) * (item.variance - read) for item in found), np.zeros(used.shape)
    )
    frames = sum(item.n_frames - 1 for item in found)
    good = used & (shot > 0) & (light > 0)
    found_gain = np.full(used.shape, gain)
    found_gain[good] = light[good] / shot[good]
    expected = math.sqrt(3 / frames)
    seen = float(np.median(np.abs(found_gain[good] / gain - 1))) / _MAD
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


def _from_dark(dark: _Light, masked: dict[str, BoolArray], maps: bool) -> CameraCalibration:
    """Without light there is an offset and a read noise in counts, and no gain."""
    used = ~(masked["hot"] | masked["dead"])
    offset, read = _dark_numbers(dark, used)
    notes = ["a dark alone gives no gain, so the read noise is in counts; add a flat or the movie"]
    _share_notes(masked, notes)
    return CameraCalibration(
        gain_e_per_adu=None,
        offset_adu=offset,
        offset_from="dark",
        read_noise_adu=read,
        read_noise_e=None,
        read_noise_below_e=None,
        curve=pd.DataFrame(
            columns=["mean_adu", "variance_adu2", "variance_se", "fit_adu2", "pixels"]
        ),
        noise=pd.DataFrame(columns=["n_frames", "contrast_noise", "contrast_noise_se",
                                    "shot_noise", "excess", "excess_se", "comparisons"]),
        shot_limited_frames=None,
        verdict="a dark says nothing of shot noise",
        masked=masked,
        maps={"offset_adu": np.where(used, dark.mean, offset.value)} if maps else {},
        frames=0,
        notes=tuple(notes),
    )  # fmt: skip
