"""Noise of averages, and up to which length it follows shot noise."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from iscat_analysis.camera.calibration.moments import Moments, blocks, robust_sigma
from iscat_analysis.camera.calibration.regression import Solution
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress

LEAST_EXCESS_VARIANCE = 0.10
"""Noise variance above shot noise by more than this, and three standard errors, is a limit."""

NOISE_COLUMNS = (
    "n_frames", "contrast_noise", "contrast_noise_se", "shot_noise", "excess", "excess_se",
    "comparisons",
)  # fmt: skip
"""Columns of `CameraCalibration.noise`."""

_SIGMAS = 3.0
_COMPARISONS = 64  # at each length: more would not narrow the curve noticeably
_MEDIAN_VARIANCE = 2.333  # relative standard error of a variance from a median, times √n


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
    levels = int(math.log2(frames // 2))
    strides = [max(1, -(-(frames // 2**j - 1) // _COMPARISONS)) for j in range(levels + 1)]
    waiting: list[FloatArray | None] = [None] * (levels + 1)
    last: list[FloatArray | None] = [None] * (levels + 1)
    seen = [0] * (levels + 1)
    ratios: list[list[float]] = [[] for _ in range(levels + 1)]
    for start, stop in blocks(stack):
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
                    ratios[j].append(robust_sigma(z) ** 2)
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
        se = excess * _MEDIAN_VARIANCE * math.sqrt(1.5 / (pixels * len(values)))
        noise = math.sqrt(2 * float(shot.mean()) / n)
        rows.append(
            (n, noise * math.sqrt(excess), noise * se / (2 * math.sqrt(excess)), noise,
             excess, se, len(values))
        )  # fmt: skip
    return pd.DataFrame(rows, columns=list(NOISE_COLUMNS))


def verdict_of(noise: pd.DataFrame) -> tuple[int, str]:
    """Say up to which average the noise is shot noise."""
    within = noise["excess"] <= 1 + LEAST_EXCESS_VARIANCE + _SIGMAS * noise["excess_se"]
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
