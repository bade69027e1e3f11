"""The clock of the camera: its rate and dropped frames, from the times of all frames."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from iscat_analysis.records import FloatArray

# |mean exp(2πi f t)| of times that tell the clock; a jitter of 0.19 intervals
_LEAST_REGULARITY = 0.5
_BLOCK = 64  # frames that tell the rate at first
_REACH = 0.2  # of the rate by the median interval, where the true one is looked for
_STEP = 0.1  # of the width of the maximum, 1/(time that passed)


def measure_clock(times_s: Mapping[int, float]) -> tuple[float | None, tuple[int, ...] | None]:
    """Tell the rate [Hz], and the intervals from the first frame to each where some are missing.

    Times t of a camera of rate f lie on a grid: |Σ exp(2πi f t)| is largest at its rate, whether
    frames are missing or not, and the phase there says where the grid lies.  A computer may
    receive a frame late, but that does not delay those that follow; a missing frame does.  So as
    many are missing before frame i as the least number by which frames from i on are behind.  Where
    the times are not on a grid, or not all known, the rate is the mean, and nothing is missing.
    """
    if len(times_s) < 2:
        return None, None
    number, times = (np.array(values) for values in zip(*sorted(times_s.items()), strict=True))
    times = times - times[0]
    if not (math.isfinite(times[-1]) and times[-1] > 0):
        return None, None
    mean = float((number[-1] - number[0]) / times[-1])
    if not np.array_equal(number, np.arange(times.size)) or np.diff(times).min() < 0:
        return mean, None
    middle = float(np.median(np.diff(times)))
    rate = _rate(times, 1 / middle) if middle > 0 else mean
    grid = np.mean(np.exp(2j * np.pi * rate * times))
    if abs(grid) < _LEAST_REGULARITY:
        return mean, None
    behind = np.rint(rate * times - np.angle(grid) / (2 * np.pi)).astype(np.int64) - number
    ticks = number + np.minimum.accumulate(behind[::-1])[::-1]
    ticks -= ticks[0]
    missing = bool(np.diff(ticks).min() > 0 and ticks[-1] > number[-1])
    return rate, tuple(ticks.tolist()) if missing else None


def _rate(times: FloatArray, rate: float) -> float:
    """Find the rate whose grid the times lie on, from a few of them to all."""
    size, reach = min(_BLOCK, times.size), _REACH * rate
    while True:
        block = times[:size]
        step = _STEP / block[-1] if block[-1] > 0 else reach
        rates = rate + np.arange(-reach, reach + step / 2, step)
        on_grid = [abs(np.exp(2j * np.pi * each * block).mean()) for each in rates]
        rate, reach = float(rates[int(np.argmax(on_grid))]), 2 * step
        if size == times.size:
            return rate
        size = min(4 * size, times.size)
