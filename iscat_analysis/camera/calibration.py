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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera.background import unlike_neighbours
from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.moments import (
    KINDS,
    Moments,
    blocks,
    brightness_bins,
    clipped,
    mask_notes,
    moments_of,
    saturated,
    stand_out,
    unsteady,
)
from iscat_analysis.camera.regression import (
    CameraCalibration,
    Estimate,
    Solution,
    dark_numbers,
    solve,
)
from iscat_analysis.camera.spectrum import NoiseSpectrum, measure_spectrum
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.movie import SelectedFrames
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress, silent
from iscat_analysis.units import listed

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
        for start, stop in blocks(stack):
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
    light: Sequence[FrameSource],
    *,
    dark: FrameSource | None = None,
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
    first = _glance(stack)
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


def _glance(stack: FrameSource) -> NDArray[Any]:
    """Read a few frames from all over the stack."""
    frames = stack.shape[0]
    places = np.unique(np.linspace(0, frames - 1, 16).astype(int))
    return np.concatenate([stack.read(int(k), int(k) + 1) for k in places])


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


def without_repeats(stack: FrameSource, least: int, notes: list[str]) -> FrameSource:
    """Leave out frames that are zero throughout or equal to the frame before."""
    total = stack.shape[0]
    good = np.zeros(total, dtype=np.bool_)
    last: NDArray[Any] | None = None
    for start, stop in blocks(stack):
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
        f"{stack.name}: frame{'s' if lost.size > 1 else ''} {listed(lost, 4)} "
        f"{'are' if lost.size > 1 else 'is'} zero throughout or the same as the frame before "
        "(dropped or stuck in the camera); left out"
    )
    return SelectedFrames(stack, kept)
