"""Pictures of particles in a known microscope, for tests of its calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from iscat_analysis.config import Config, parse_config
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.instrument.particle_image import ParticleImage, build_microscope
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.parameters import settings_of
from iscat_analysis.optics.pixels import PixelGrid

PIXEL_NM = 84.4
GRID = PixelGrid.centred(28, PIXEL_NM)
PHOTONS = 4e5
"""Background photoelectrons per pixel, before and after."""

MASSES_KDA = (3000.0, 6000.0, 12000.0)
"""With these and `PHOTONS` a picture has a signal-to-noise ratio of 20 to 80."""

START_NM = 80.0
"""Standard deviation of the first guess of a place."""

Build = Callable[[Any], ForwardModel]


def configuration(**optics: Any) -> Config:
    """Protein under an oil objective, with a reference that is dimmed to a tenth."""
    return parse_config({
        "optics": {"wavelength_nm": 525.0, "na": 1.42, "attenuation": 0.1, "focus_nm": -300.0}
        | optics,
        "camera": {"pixel_size_nm": PIXEL_NM},
        "particle": {"kind": "protein", "height_nm": 5.0},
    })  # fmt: skip


def microscope(config: Config, changes: dict[str, Any]) -> ForwardModel:
    """Build a configuration's microscope with some parameters changed."""
    return build_microscope(config, 2600.0, {**settings_of(config), **changes})


def make_particle_images(
    changes: dict[str, Any],
    count: int,
    *,
    seed: int,
    config: Config | None = None,
    photons: float = PHOTONS,
    masses_kda: tuple[float, ...] = MASSES_KDA,
    leaving: float = 0.1,
    height_nm: float = 5.0,
) -> tuple[list[ParticleImage], list[ParticleImage], Build]:
    """Draw pictures in a microscope that differs from the configured one.

    Particles are at `height_nm` and taken for 5 nm high.

    Returns
    -------
    images, truth : list of Image
        With a rough start, and with the true place and mass.
    build : callable
        Makes microscopes from settings.
    """
    config = configuration() if config is None else config
    model = microscope(config, changes)
    random = np.random.default_rng(seed)
    images, truth = [], []
    for _ in range(count):
        x, y = random.uniform(-PIXEL_NM / 2, PIXEL_NM / 2, 2)
        mass = random.choice(masses_kda) * (-1 if random.random() < leaving else 1)
        signal = model.image(GRID, x, y, height_nm, mass)
        before = random.poisson(photons, GRID.shape).astype(float)
        after = random.poisson(photons * (1 + signal)).astype(float)
        data = conditional(model, GRID, before, after, 1.0).data
        snr = float(np.sqrt(np.sum(signal**2) * photons / 2))
        image = ParticleImage(
            GRID, CONDITIONAL, data, float(x), float(y), 5.0, mass_kda=mass, snr=snr
        )
        truth.append(image)
        dx, dy = START_NM * random.standard_normal(2)
        images.append(replace(image, x_nm=float(x + dx), y_nm=float(y + dy), mass_kda=0.0))
    return images, truth, lambda settings: build_microscope(config, 2600.0, settings)
