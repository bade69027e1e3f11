"""Channels whose frames take turns in one series are recognised."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.errors import DataError

_MOST = 4  # channels that are looked for
_ALIKE = 0.1  # of the mean square difference of others, by which frames of one channel differ
_PIXELS = 4096  # that are asked, all over the field


def refuse_channels(counts: NDArray[Any], camera: Camera, name: str) -> None:
    """Refuse frames of several kinds that take turns: each is a movie of its own.

    Frames of one channel differ by noise, those of another by its pattern as well.

    Shapes: `counts` (t, y, x).
    """
    channels = channels_of(counts, camera)
    if channels > 1:
        others = " or ".join(f"{channels}:{k}" for k in range(1, channels))
        raise DataError(
            f"{name}: frames of {channels} kinds take turns, as of {channels} channels or cameras "
            f"that were saved as one series: choose one with --channels {channels}:0, or {others} "
            f"(camera.channels = [{channels}, 0])"
        )


def channels_of(counts: NDArray[Any], camera: Camera) -> int:
    """Tell how many channels take turns; 1 where none do.

    Shapes: `counts` (t, y, x).
    """
    shape = counts.shape[1:]
    every = max(1, -(-math.prod(shape) // _PIXELS))
    cut = camera.mapped(lambda image: np.broadcast_to(image, shape).reshape(-1)[::every])
    light = cut.to_electrons(counts.reshape(len(counts), -1)[:, ::every])
    power = light.mean(axis=1, keepdims=True)
    fresh = np.array([True, *(not np.array_equal(a, b) for a, b in pairwise(counts))])
    light, power = light[fresh], power[fresh]
    if len(light) < 2 * _MOST or not (np.isfinite(power) & (power > 0)).all():
        return 1
    light /= power
    apart = [
        float(np.median(np.mean((light[n:] - light[:-n]) ** 2, axis=1)))
        for n in range(1, _MOST + 1)
    ]
    found = (n for n in range(2, _MOST + 1) if apart[n - 1] < _ALIKE * min(apart[: n - 1]))
    return next(found, 1)
