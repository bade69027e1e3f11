"""What one search of a frame finds: faint particles beside bright ones, and no side lobes."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.config import Config
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.tracking.frames import tracking_context
from iscat_analysis.tracking.rows import Localizations
from iscat_analysis.tracking.search import FrameFilter

SIDE, ROI, LEVEL_E = 96, 32, 4e5


def _config(**aberrations_nm: float) -> Config:
    return make_config(
        background={"frames": None},
        camera={"frame_rate_hz": 331.0},
        fit={"mode": "track", "frames": None, "roi_nm": ROI * PIXEL_NM},
        track={"free": "mass"},
        simulation={"shape": [SIDE, SIDE]},
        optics={"aberrations_nm": aberrations_nm},
    )


def _found(
    config: Config, particles: list[tuple[float, float, float]], *, seen_through: Config
) -> Localizations:
    """Search a frame with particles (x, y [pixels], mass), made through some optics."""
    context = tracking_context(config, (SIDE, SIDE), 1000)
    picture = tracking_context(seen_through, (SIDE, SIDE), 1000).wide
    grid = PixelGrid.region((0, SIDE), (0, SIDE), PIXEL_NM)
    signal = sum(
        picture.image(grid, x * PIXEL_NM, y * PIXEL_NM, picture.height_nm, mass)
        for x, y, mass in particles
    )
    level = np.full((SIDE, SIDE), LEVEL_E)
    counts = np.random.default_rng(1).poisson(level * (1 + signal))
    search = FrameFilter(
        context.templates, level, np.zeros_like(level), np.ones(level.shape, dtype=bool),
        polarity=config.detection.sign, roi_px=context.roi_px, cautious=False,
    )  # fmt: skip
    return search.find((counts - level)[None].astype(np.float32), np.ones(1), [np.zeros((0, 3))])


@pytest.mark.parametrize("away", [13.0, 18.0, 25.0])
def test_a_faint_particle_beside_a_bright_one_is_found_at_once(away):
    config = _config()
    found = _found(config, [(40.0, 48.0, 400.0), (40.0 + away, 48.0, 170.0)], seen_through=config)
    assert len(found.frame) == 2
    np.testing.assert_allclose(found.theta[:, 0], [40.0, 40.0 + away], atol=0.5)


@pytest.mark.parametrize("mass", [400.0, 4000.0])
def test_rings_of_a_bright_particle_are_no_particles(mass):
    config = _config()
    assert len(_found(config, [(47.3, 48.6, mass)], seen_through=config).frame) == 1


@pytest.mark.parametrize("nm", [20.0, -20.0])
def test_those_of_another_microscope_are_none_beyond_its_first_ring(nm):
    found = _found(_config(), [(47.3, 48.6, 400.0)], seen_through=_config(z11=nm))
    assert len(found.frame) == 1
