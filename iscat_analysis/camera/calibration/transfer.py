"""Photon transfer of one movie: noise and response to the laser, against the light.

Pixels of one movie have different light.  The variance between frames and the slope against the
laser power are measured for each pixel, and averaged over pixels of like brightness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.calibration.moments import Moments, brightness_bins, moments_of
from iscat_analysis.camera.calibration.pixels import stand_out, unlike_neighbours, unsteady
from iscat_analysis.camera.calibration.regression import (
    LEAST_RELIABILITY,
    variance_line,
    zero_of_flicker,
)
from iscat_analysis.camera.calibration.result import Estimate
from iscat_analysis.camera.counts import Camera
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.records import BoolArray, FloatArray

_LEAST_FRAMES = 16
_LEAST_PIXELS = 256
_LEAST_NOISE = 1e-6  # of the shot noise; what has less, as a picture that was copied, has none
_LEAST_SLOPE = 5.0  # standard errors of the slope, of which the line's zero is a quotient
_TILE_PX = 16  # within which pixels may differ from the line together, as a speckle that shakes


@dataclass(frozen=True, eq=False)
class Transfer:
    """Variance and slope of pixels, in bins of like brightness [e]; and where lines end.

    Without `flicker` the laser is too steady, or the scene moved, and `slope` says nothing.
    Shapes: `light, variance, variance_se, slope, slope_se` (bins,).
    """

    light: FloatArray
    variance: FloatArray
    variance_se: FloatArray
    slope: FloatArray
    slope_se: FloatArray
    level: float
    noise: Estimate | None
    flicker: Estimate | None


def measure_transfer(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> Transfer | None:
    """Measure photon transfer; None where the pixels are too alike, too few, or not raw.

    Notes
    -----
    The variance of the read noise and of rounding is taken off.  Where a bright particle lands, its
    pixels change and the light of the field with them, which is no flicker.  Errors are from the
    scatter of pixels, times what squares of `_TILE_PX` pixels scatter more than these.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    if len(counts) < _LEAST_FRAMES:
        return None
    used = ~camera.saturated(counts.max(axis=0))
    if masked is not None:
        used &= ~masked
    electrons = camera.to_electrons(counts)
    light = electrons.mean(axis=0)
    used &= (light > 0) & ~unlike_neighbours(light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    try:
        found = moments_of(
            open_stack(electrons), used, lambda _: None, jumps=_jumps(electrons, light, used)
        )
    except DataError:
        return None
    used &= ~unsteady([found], used) & (found.variance > _LEAST_NOISE * light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    own = float((found.variance[used] / found.n_frames).mean())
    if own > (1 - LEAST_RELIABILITY) * float(found.mean[used].var()):
        return None
    return _binned(found, used, camera.dark_variance_e2(counts)[used])


def _jumps(electrons: FloatArray, light: FloatArray, used: BoolArray) -> BoolArray:
    """Find successive frames that differ by more than noise and power, as where a particle lands.

    Shapes: `electrons` (t, y, x), `light, used` (y, x), result (t − 1,).
    """
    mean = light[used]
    excess = np.empty(len(electrons) - 1)
    for number, (before, after) in enumerate(pairwise(electrons)):
        step = after[used] - before[used]
        step -= step.mean() / mean.mean() * mean
        excess[number] = np.mean(step**2 / mean)
    return stand_out(excess)


def _binned(found: Moments, used: BoolArray, other: FloatArray) -> Transfer:
    """Average over pixels of like brightness; find the zeros of the lines through all pixels."""
    mean, variance = found.mean[used], found.variance[used] - other
    level = float(mean.mean())
    y, x = np.nonzero(used)
    tiles = (y // _TILE_PX) * (1 + used.shape[1] // _TILE_PX) + x // _TILE_PX
    freedom = np.full(mean.shape, found.n_frames - 1.0)
    (intercept, slope), cov = variance_line(mean, variance, freedom, tiles)
    noise = None
    if slope > _LEAST_SLOPE * math.sqrt(cov[1, 1]):
        gradient = np.array([-1 / slope, intercept / slope**2])
        noise = Estimate(-intercept / slope, math.sqrt(gradient @ cov @ gradient))
    seen = found.slope[used], found.slope_variance[used], mean
    flicker = zero_of_flicker(*seen, tiles)
    _, alone = variance_line(mean, variance, freedom)
    wider = [math.sqrt(max(1.0, float(cov[1, 1] / alone[1, 1]))), 1.0]
    if flicker is not None:
        single = zero_of_flicker(*seen)
        wider[1] = max(1.0, flicker.se / single.se) if single is not None else 1.0
    rows = []
    for part in brightness_bins(mean):
        root = math.sqrt(part.size)
        rows.append(
            [
                mean[part].mean(),
                variance[part].mean(),
                wider[0] * variance[part].std(ddof=1) / root,
                found.slope[used][part].mean(),
                wider[1] * math.sqrt(found.slope_variance[used][part].mean()) / root,
            ]
        )
    light, noises, noises_se, slopes, slopes_se = np.array(rows).T
    return Transfer(
        light, noises, noises_se, slopes, slopes_se, level=level, noise=noise, flicker=flicker
    )
