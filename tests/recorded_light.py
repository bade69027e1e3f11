"""Frames of a still scene, as cameras of known law record them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

SHAPE, LEVEL_E = (64, 64), 1e5

Electrons = NDArray[np.float64]


def gamma(exponent: float) -> Callable[[Electrons], Electrons]:
    """Give counts as light to a power, as where gamma is switched on."""
    return lambda e: np.asarray(60000 * (e / (2 * LEVEL_E)) ** exponent)


def saturation(full: float) -> Callable[[Electrons], Electrons]:
    """Give counts that approach a full scale, of so many times the mean light."""
    most = full * LEVEL_E
    return lambda e: np.asarray(most / 4 * -np.expm1(-e / most))


def linear(gain: float, offset: float = 0.0) -> Callable[[Electrons], Electrons]:
    """Give counts of a camera as it should be."""
    return lambda e: e / gain + offset


def record(
    seed: int,
    response: Callable[[Electrons], Electrons],
    *,
    frames: int = 384,
    spread: float = 0.15,
    flicker: float = 0.01,
    level_e: float = LEVEL_E,
    room_e: float = 0.0,
    read_e: float = 0.0,
    dark: int = 0,
) -> NDArray[Any]:
    """Record a speckled field under a laser that flickers; the first frames may be dark.

    Shapes: result (t, y, x).
    """
    rng = np.random.default_rng(seed)
    rough = gaussian_filter(rng.standard_normal(SHAPE), 2.0, mode="wrap")
    light = level_e * (1 + spread * rough / rough.std())
    counts = np.empty((frames, *SHAPE), dtype=np.uint16)
    for t in range(frames):
        expected = (1 + flicker * rng.standard_normal()) * light * (t >= dark) + room_e
        electrons = rng.poisson(expected) + read_e * rng.standard_normal(SHAPE)
        counts[t] = np.clip(np.rint(response(electrons)), 0, 65535)
    return counts
