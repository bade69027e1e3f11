"""Fringes are decided over a track."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.tracking.field import Exposures, MovingField
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations
from iscat_analysis.tracking.stages import decide_heights
from iscat_analysis.tracking.table import collected_areas, quantum_bounds

SHAPE, FRAMES, LEVEL_E, ROI = (28, 28), 40, 4e5, 24


@pytest.mark.parametrize(
    ("mass_kda", "top_nm", "off", "tracked"),
    [(500.0, 700.0, 1, True), (5e3, 2000.0, 4, True), (5e3, 2000.0, 4, False)],
)
def test_rows_come_into_their_fringe(
    mass_kda: float, top_nm: float, off: int, tracked: bool
) -> None:
    """Half of the frames begin fringes off; each alone would stay there.

    The fringes of a whole pupil are wider than λ/(2n), by a fifth near the coverslip: four of
    these are nearly five of those.  A particle that is bright is put right without a track.
    """
    span = (0.0, top_nm)
    config = make_config(fit={"mode": "joint", "z_range_nm": list(span)})
    model = forward_model(config, 1e4)
    rng = np.random.default_rng(1)
    path = np.column_stack([
        1150 + np.cumsum(rng.normal(0, 20, (FRAMES, 2)), axis=0),
        top_nm / 2 + np.cumsum(rng.normal(0, 20, FRAMES)),
    ])  # fmt: skip
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    amplitude = model.scale.amplitude(mass_kda)
    mean = np.stack([LEVEL_E * (1 + model.amplitude_image(grid, *p, amplitude)) for p in path])
    near = forward_model(config, math.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    truth = np.column_stack([path, np.full(FRAMES, amplitude), np.zeros(FRAMES)])
    start = truth.copy()
    start[::2, 2] += np.where(start[::2, 2] < top_nm / 2, off, -off) * model.fringe_nm
    frames, track = np.arange(FRAMES), np.full(FRAMES, 0 if tracked else -1)
    with ThreadPoolExecutor(1) as pool:
        field = MovingField(
            Exposures(rng.poisson(mean).astype(np.float32)), np.zeros(SHAPE),
            np.ones(SHAPE, dtype=bool), near, model, pixel_nm=PIXEL_NM, roi_px=ROI,
            z_range_nm=span, pool=pool,
        )  # fmt: skip
        ground = BackgroundEstimate(np.full(SHAPE, LEVEL_E), np.ones(FRAMES))
        rows = Localizations.of(frames, track, start)
        alone, _, _ = field.fit(ground, rows)
        found = decide_heights(field, ground, rows)
    jumped = np.abs(alone.theta[:, 2] - path[:, 2]) > model.fringe_nm / 2
    assert jumped.sum() > FRAMES / 4
    assert np.abs(found.theta[:, 2] - path[:, 2]).max() < model.fringe_nm / 4


def test_a_height_that_noise_puts_below_the_coverslip_has_the_bounds_of_the_coverslip() -> None:
    model = forward_model(make_config(), 1500.0)
    z, ones = np.array([-3.0, 0.0, 150.0]), np.ones(3)
    free = np.array([True, True, True, True])
    bounds = quantum_bounds(model, z, 300.0 * ones, 1e4 * ones, free)
    assert np.array_equal(bounds[0], bounds[1])
    assert not np.allclose(bounds[2], bounds[1], rtol=0.01)
    areas = collected_areas(model, z, 300.0 * ones)
    assert areas[0] == areas[1] != areas[2]
