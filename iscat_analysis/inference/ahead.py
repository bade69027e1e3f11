"""Half of the kernels of a fit, compiled in a process of its own while another compiles the rest.

Run as ``python -m iscat_analysis.inference.ahead``.  What it compiles lands where Numba keeps
compiled kernels, and the other process finds it there.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.noise import compile_values, poisson
from iscat_analysis.optics.forward import PixelGrid, forward_model

_PIXELS = 12
_PIXEL_NM = 80.0


def main() -> None:
    """Compile what evaluates likelihoods, their curvature and the goodness of fits."""
    model = forward_model(Config(), 2 * _PIXELS * _PIXEL_NM)
    grid = PixelGrid.region((0, _PIXELS), (0, _PIXELS), _PIXEL_NM)
    centre = 0.5 * _PIXELS * _PIXEL_NM
    theta = np.array([centre, centre, model.height_nm, 1.0, 0.0])
    free = np.array([True, True, False, True, False])
    counts = np.random.default_rng(0).poisson(1000.0, grid.shape).astype(np.float64)
    compile_values(model)
    goodness_of_fit(poisson(model, grid, counts, 1000.0, 1000.0), theta, free)


if __name__ == "__main__":
    main()
