"""Fringes are decided over a track."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scenes import PIXEL_NM, make_config

from iscat_analysis.inference.moving import Ground, MovingField, Rows
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline.heights import decide_heights

SHAPE, FRAMES, LEVEL_E, ROI, RANGE = (28, 28), 40, 4e5, 24, (0.0, 700.0)


def test_a_track_stays_in_its_fringe() -> None:
    """Half of the frames begin a fringe off; each alone would stay there."""
    config = make_config(fit={"mode": "joint", "z_range_nm": list(RANGE)})
    model = forward_model(config, 1e4)
    rng = np.random.default_rng(1)
    path = np.column_stack([
        1150 + np.cumsum(rng.normal(0, 20, (FRAMES, 2)), axis=0),
        350 + np.cumsum(rng.normal(0, 20, FRAMES)),
    ])  # fmt: skip
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    amplitude = model.scale.amplitude(500.0)
    mean = np.stack([LEVEL_E * (1 + model.amplitude_image(grid, *p, amplitude)) for p in path])
    near = forward_model(config, math.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    truth = np.column_stack([path, np.full(FRAMES, amplitude), np.zeros(FRAMES)])
    start = truth.copy()
    start[::2, 2] += np.where(start[::2, 2] < 350, 1, -1) * model.fringe_nm
    frames, track = np.arange(FRAMES), np.zeros(FRAMES, dtype=np.int64)
    with ThreadPoolExecutor(1) as pool:
        field = MovingField(
            rng.poisson(mean).astype(np.float32), np.zeros(SHAPE), np.ones(SHAPE, dtype=bool),
            near, model, pixel_nm=PIXEL_NM, roi_px=ROI, z_range_nm=RANGE, largest=1e9, pool=pool,
        )  # fmt: skip
        ground = Ground(np.full(SHAPE, LEVEL_E), np.ones(FRAMES))
        rows = Rows.of(frames, track, start)
        alone, _, _ = field.fit(ground, rows)
        found = decide_heights(field, ground, rows, fringe_nm=model.fringe_nm, z_range_nm=RANGE)
    jumped = np.abs(alone.theta[:, 2] - path[:, 2]) > model.fringe_nm / 2
    assert jumped.sum() > FRAMES / 4
    assert np.abs(found.theta[:, 2] - path[:, 2]).max() < model.fringe_nm / 4
