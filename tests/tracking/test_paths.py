"""What the unknown path of one exposure does to a fit."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.errors import DataError
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.model import blurred
from iscat_analysis.tracking.linking import link
from iscat_analysis.tracking.table import SKEW, SKEW_ACROSS, path_shifts

ROI, VARIANCE_NM2, PATHS, PARTS = 24, 120.0, 400, 48
SIGMAS = 4.0


def _paths(rng: np.random.Generator) -> np.ndarray:
    """Brownian motion about its mean, of mean variance `VARIANCE_NM2`, (paths, parts, 3) [nm]."""
    steps = rng.normal(0, np.sqrt(6 * VARIANCE_NM2 / PARTS), (PATHS, PARTS, 3))
    walk = np.cumsum(steps, axis=1)
    return np.asarray(walk - walk.mean(axis=1, keepdims=True))


@pytest.mark.parametrize("z_nm", [230.0, 900.0])
def test_paths_scatter_fits_as_said(z_nm: float) -> None:
    """Pictures along true paths, fitted to first order, against the covariance that is computed.

    An amplitude so small that the square of the scattered field does not matter.
    """
    config = make_config(fit={"mode": "joint", "z_range_nm": [0.0, 1200.0]})
    model = forward_model(config, np.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    amplitude = model.scale.amplitude(20.0)
    grid = PixelGrid.centred(ROI | 1, PIXEL_NM)
    still = blurred(model, VARIANCE_NM2, upwards=True)
    signal, slopes = still.signal(grid, (0.0, 0.0, z_nm, amplitude))
    weight = 1 / (1 + signal)
    fisher = np.einsum("ayx,byx,yx->ab", slopes, slopes, weight)
    pinned = np.linalg.inv(fisher) @ np.einsum("ayx,yx->ayx", slopes, weight).reshape(4, -1)
    errors = []
    for path in _paths(np.random.default_rng(3)):
        seen = np.mean(
            [model.amplitude_image(grid, x, y, z_nm + z, amplitude) for x, y, z in path], axis=0
        )
        errors.append(pinned @ (seen - signal).ravel())
    found = np.std(errors, axis=0)
    (shifts,) = path_shifts(still, ROI, PIXEL_NM, np.array([z_nm]), amplitude, VARIANCE_NM2)
    said = np.linalg.norm(shifts, axis=1)
    # what of the square of a spread is not in first order is q k² ≈ 0.12 of it
    assert np.all(np.abs(found / said - 1) < 0.12 + SIGMAS / np.sqrt(PATHS))


def test_third_moments_of_brownian_paths() -> None:
    rng = np.random.default_rng(5)
    walk = np.cumsum(rng.standard_normal((4000, 200, 2)), axis=1) * np.sqrt(6 / 200)
    walk -= walk.mean(axis=1, keepdims=True)
    along, across = (
        (walk[..., 0] ** 3).mean(axis=1),
        (walk[..., 0] * walk[..., 1] ** 2).mean(axis=1),
    )
    assert np.sqrt(np.mean(along**2)) == pytest.approx(SKEW, rel=0.15)
    assert np.sqrt(np.mean(across**2)) == pytest.approx(SKEW_ACROSS, rel=0.15)


def test_a_reach_that_cannot_be_linked_is_said() -> None:
    rng = np.random.default_rng(1)
    frame = np.repeat(np.arange(4), 60)
    with pytest.raises(DataError, match=r"track\.max_step_nm = 5000"):
        link(frame, rng.uniform(0, 5000, (240, 2)), reach_nm=5000.0, memory=0)
