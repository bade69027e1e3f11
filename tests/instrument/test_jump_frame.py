"""The frame at which the focus jumps is the one in which all that has landed changes at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibrations import GRID, make_particle_images
from scenes import Stack
from scipy.ndimage import gaussian_filter

from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.instrument.uneven import FieldOfView, jump_frame

PIXEL_NM = GRID.pixel_nm
JUMP = 421
SIDE, FRAMES = 48, 600
CENTRES_PX = ((14.0, 16.0), (30.0, 33.0))


def _movie(dark: slice) -> Stack:
    """Two spots that are there from the beginning, and are wider after the jump."""
    rng = np.random.default_rng(4)
    spots = np.zeros((SIDE, SIDE))
    for y, x in CENTRES_PX:
        spots[round(y), round(x)] = 1.0
    before, after = (1 - depth * gaussian_filter(spots, width) for depth, width in
                     ((0.4, 1.5), (0.4, 2.2)))  # fmt: skip
    light = np.repeat([before, after], [JUMP, FRAMES - JUMP], axis=0) * 1e4
    light[dark] = 20.0
    return Stack(rng.poisson(light).astype(np.uint16))


def _image(y_px: float, x_px: float, frames: tuple[float, float]) -> ParticleImage:
    ((image,), *_) = make_particle_images({}, 1, seed=1, leaving=0.0)
    grid = replace(
        GRID,
        x_nm=GRID.x_nm - GRID.x_nm.mean() + x_px * PIXEL_NM,
        y_nm=GRID.y_nm - GRID.y_nm.mean() + y_px * PIXEL_NM,
    )
    place = {"x_nm": x_px * PIXEL_NM, "y_nm": y_px * PIXEL_NM}
    return replace(image, grid=grid, frames=frames, mass_kda=500.0, **place)


@pytest.mark.parametrize(
    "dark", [slice(0), slice(330, 380), slice(180, 200), slice(395, 421), slice(160, 172)]
)
def test_the_frame_of_a_jump_is_found_with_dark_frames_around(dark: slice) -> None:
    movie: Any = _movie(dark)
    images = [
        *(_image(y, x, (20.0, 60.0)) for y, x in CENTRES_PX),
        _image(40.0, 40.0, (180.0, 220.0)),
        _image(8.0, 40.0, (560.0, 590.0)),
    ]
    view = FieldOfView((24.0, 24.0, 24.0), PIXEL_NM, (0, FRAMES), True, movie)
    assert abs(jump_frame(view, images, (2, 3)) - JUMP) <= 1
