"""Grids of pixel centres on which images are evaluated; x along columns, y down the rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PixelGrid:
    """Pixel centres on a regular grid; x along columns, y down the rows."""

    x_nm: FloatArray
    y_nm: FloatArray
    pixel_nm: float

    def __post_init__(self) -> None:
        for name in ("x_nm", "y_nm"):
            axis = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, axis)
            if axis.ndim != 1 or not axis.size or not np.isfinite(axis).all():
                raise DataError(f"{name}: give the centres as one row of finite numbers")
            if (axis[1:] <= axis[:-1]).any():
                raise DataError(f"{name}: the centres must ascend; sort them, without doubles")
        if not (math.isfinite(self.pixel_nm) and self.pixel_nm > 0):
            raise DataError(f"pixel_nm = {self.pixel_nm}: give the side of a pixel, above 0 nm")

    @classmethod
    @lru_cache(maxsize=1024)  # fits that follow each other share it
    def region(cls, rows: tuple[int, int], columns: tuple[int, int], pixel_nm: float) -> PixelGrid:
        """Half-open ranges of full-frame pixels; pixel (0, 0) has its centre at (0, 0) nm."""
        x, y = (np.arange(*span, dtype=np.float64) * pixel_nm for span in (columns, rows))
        return cls(x, y, pixel_nm)

    @classmethod
    def centred(cls, pixels: int, pixel_nm: float) -> PixelGrid:
        """Return a square field with centres (i − (n−1)/2)·pixel."""
        axis = (np.arange(pixels, dtype=np.float64) - (pixels - 1) / 2) * pixel_nm
        return cls(axis, axis, pixel_nm)

    @cached_property
    def is_regular(self) -> bool:
        """Whether neighbours are one pixel apart everywhere, to a millionth of it."""
        steps = np.concatenate([np.diff(self.x_nm), np.diff(self.y_nm)])
        return bool(np.all(np.abs(steps - self.pixel_nm) < 1e-6 * self.pixel_nm))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.y_nm.size, self.x_nm.size

    @property
    def diagonal_nm(self) -> float:
        """Largest distance inside the grid, pixel edges included [nm]."""
        return math.hypot(
            self.x_nm[-1] - self.x_nm[0] + self.pixel_nm,
            self.y_nm[-1] - self.y_nm[0] + self.pixel_nm,
        )
