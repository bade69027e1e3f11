"""Frames that contain light of earlier frames: averaged, interpolated or filtered in time.

Of independent frames any two differ by the same noise, apart from slow changes.  If each was
averaged with the one before, neighbours differ less than frames farther apart, and those all differ
equally.  Where light or stage drift, or the laser flickers, differences go on growing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray

_APART, _FAR = 8, 16  # frames: filters are forgotten by then
_FEWEST, _FRAMES = 40, 256  # frames that tell, and as many as are asked
_MOST_PIXELS = 4096  # that are asked, all over the field
_LEAST_DEFICIT = 0.1  # by which the variance between neighbours falls short
_MOST_GROWTH = 0.15  # of that, by which it may still grow farther on


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
    places = places[:: max(1, -(-places.size // _MOST_PIXELS))]
    offset, gain = (
        np.broadcast_to(value, shape).flat[places]
        for value in (camera.offset_adu, camera.gain_e_per_adu)
    )
    theirs = Camera(offset_adu=offset, gain_e_per_adu=gain)
    pixels = theirs.to_electrons(counts.reshape(len(counts), -1)[:, places])
    pixels = pixels[:, pixels.mean(axis=0) > 0]
    if not pixels.size:
        return None
    power = pixels.mean(axis=1)
    if power.min() <= 0:
        return None
    pixels *= (power.mean() / power)[:, None]
    light = pixels.mean(axis=0)
    near, apart, far = (
        float(np.median(np.einsum("tp,tp->p", change, change) / len(change) / light))
        for change in (pixels[lag:] - pixels[:-lag] for lag in (1, _APART, _FAR))
    )
    if apart <= 0 or far <= 0:
        return None
    short = 1 - near / apart
    return (
        near / apart
        if short > _LEAST_DEFICIT and abs(far / apart - 1) < _MOST_GROWTH * short
        else None
    )


def averaged_noise(counts: NDArray[Any], camera: Camera) -> float | None:
    """Give the variance of long averages over that of frames next to each other, where they share.

    Frames that were averaged or filtered in time have noise in common: with the correlation ρ_k of
    frames k apart, an average of n has 1 + 2 Σ ρ_k times the variance over n of one.

    Shapes: `counts` (t, y, x).
    """
    if shared_light(counts, camera) is None:
        return None
    pixels = camera.to_electrons(counts[:_FRAMES])
    power = pixels.mean(axis=(1, 2), keepdims=True)
    pixels *= power.mean() / power
    squares = [float(np.mean((pixels[k:] - pixels[:-k]) ** 2)) for k in (*range(1, _APART), _FAR)]
    common = sum(1 - one / squares[-1] for one in squares[:-1])
    return squares[-1] / squares[0] * (1 + 2 * common)
