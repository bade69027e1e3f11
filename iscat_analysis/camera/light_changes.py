"""Changes of the light between frames that are far apart, in units of their noise.

`camera.amplifier_boundaries`, `camera.fringes` and `iscat_analysis.camera.lighting` look for
structure in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray, FloatArray

LEAST_CONTRAST_SHARE = 0.02
"""Of the noise variance of a pixel between two windows, below which no change does."""

_LEAST_LIGHT = 0.1  # of the median pixel's


@dataclass(frozen=True, eq=False)
class Changes:
    """Sums of frames, before and after."""

    sums_e: FloatArray
    frames: NDArray[np.int64]
    light_e: FloatArray
    noises: FloatArray

    @classmethod
    def of(
        cls, pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera
    ) -> Changes | None:
        """Sum frames.

        Shapes: `pairs` (t, y, x).
        """
        if not pairs:
            return None
        sums = np.array([[camera.to_electrons(k).sum(axis=0) for k in two] for two in pairs])
        frames = np.array([[len(k) for k in two] for two in pairs])
        light = sums.sum(axis=(0, 1)) / frames.sum()
        used = usable_pixels(pairs, light, camera)
        if not used.any() or sums[..., used].sum(axis=-1).min() <= 0:
            return None
        read = float(camera.read_variance_e2(used.shape)[used].mean() / light[used].mean())
        noises = (1 + read) * (1 / frames).sum(axis=1)
        if not used.all():
            sums[..., ~used] = 0.0
        return cls(sums, frames, np.where(used, light, 0.0), noises)

    @property
    def used(self) -> BoolArray:
        """Pixels with enough light, shape (y, x)."""
        return self.light_e > 0

    @property
    def error(self) -> float:
        """Variance of a contrast that is measured with all the light."""
        return float(self.noises.mean() / self.light_e.sum())

    def least(self, window: int) -> float:
        """Mean square contrast of two windows below which a change is ignored."""
        return LEAST_CONTRAST_SHARE * float(2 / (window * self.light_e[self.used].mean()))

    def divided(self, factors: FloatArray) -> Changes:
        """Divide the light of the sums by measured factors.

        Shapes: `factors` (pairs, 2, y, x).
        """
        return replace(self, sums_e=self.sums_e / factors)

    def binned(self, side: int) -> tuple[FloatArray, FloatArray]:
        """Give the changes of squares of pixels.

        Shapes: `changes` (pairs, y, x), `light_e` (y, x).
        """
        light = squares(self.light_e, side)
        before, after = np.moveaxis(squares(self.sums_e, side), 1, 0)
        changes = after / after.sum(axis=(1, 2), keepdims=True)
        changes -= before / before.sum(axis=(1, 2), keepdims=True)
        changes *= light.sum()
        changes /= np.sqrt(np.where(light > 0, light, 1.0) * self.noises[:, None, None])
        return np.where(light > 0, changes, 0.0), light


def squares(values: FloatArray, side: int) -> FloatArray:
    """Sum over squares of pixels.

    Shapes: `values` (…, y, x), result (…, y // side, x // side).
    """
    if side == 1:
        return values
    *before, rows, columns = values.shape
    high, wide = rows // side, columns // side
    cut = values[..., : high * side, : wide * side].reshape(*before, high, side, wide, side)
    return np.asarray(cut.sum(axis=(-3, -1)))


def usable_pixels(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], light_e: FloatArray, camera: Camera
) -> BoolArray:
    """Tell which pixels have enough light.

    Shapes: `pairs` (t, y, x), `light_e` (y, x), result (y, x).
    """
    highest = np.max([part.max(axis=0) for two in pairs for part in two], axis=0)
    lit: BoolArray = light_e > _LEAST_LIGHT * max(float(np.median(light_e)), 0.0)
    return lit & ~camera.saturated(highest)
