"""Images of several particles of one kind on the same pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.image import signal_image
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.optics.model import ForwardModel

FloatArray = NDArray[np.float64]


def signals_within(model: ForwardModel, grid: PixelGrid, theta: FloatArray) -> FloatArray:
    """Draw each particle alone, if it is within the reach of its model.

    Shapes: `theta` (n, 4), result (n, ny, nx).
    """
    far_x, far_y = (
        np.maximum(np.abs(axis[0] - place), np.abs(axis[-1] - place)) + grid.pixel_nm / 2
        for axis, place in ((grid.x_nm, theta[:, 0]), (grid.y_nm, theta[:, 1]))
    )
    near = np.flatnonzero(np.hypot(far_x, far_y) <= model.reach_nm)
    out = np.zeros((len(theta), *grid.shape))
    lens, pixels = model.lens, model.pixels(grid)
    for number, (x, y, z, amplitude) in zip(near.tolist(), theta[near].tolist(), strict=True):
        signal_image(model.profile(z, 1), lens, pixels, x, y, amplitude, out[number])
    return out
