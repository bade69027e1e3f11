"""Learned optics scatter over repeated movies as their Cramér–Rao bound says, and no more."""

from __future__ import annotations

import numpy as np
import pytest
from calibrations import configuration
from instruments import Instrument, Pictures

from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.instrument.joint_fit import maximise
from iscat_analysis.instrument.particle_image import ParticleImage, build_microscope, with_masses
from iscat_analysis.optics.parameters import settings_of
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.records import FloatArray

MOVIES = 30
IMAGES = 24
PHOTONS = 4e6
"""Background photoelectrons per pixel, before and after."""

GRID = PixelGrid.centred(28, 84.0)
MASSES_KDA = (205.0, 430.0)
WITHIN = 0.2
"""Promised distance of the spread from the bound, relative."""

TRUTH = Instrument(
    emission="reciprocal", focus_nm=-340.0, na=1.405, reference_phase_deg=10.0, circular=True,
    mask_na=0.55, attenuation=0.4, aberrations_nm={5: 5.0, 6: -8.0, 7: 9.0, 8: -6.0, 11: 12.0},
)  # fmt: skip
TRUE = {
    "focus_nm": -340.0, "na": 1.405, "reference_phase_deg": 10.0, "mask_na": 0.55,
    "attenuation": 0.4, "z5": 5.0, "z6": -8.0, "z7": 9.0, "z8": -6.0, "z11": 12.0,
    "z9": 0.0, "z10": 0.0, "z22": 0.0,
}  # fmt: skip


def _movie(pictures: Pictures, random: np.random.Generator) -> list[ParticleImage]:
    """Draw a movie's worth of pictures, made by the quadrature, which shares nothing."""
    model = build_microscope(configuration(), 2600.0, settings_of(configuration()))
    images = []
    for _ in range(IMAGES):
        x, y = random.uniform(-42.0, 42.0, 2)
        contrast = pictures.contrast(
            (GRID.x_nm - x)[None, :], (GRID.y_nm - y)[:, None], float(random.choice(MASSES_KDA))
        )
        before = random.poisson(PHOTONS, GRID.shape).astype(float)
        after = random.poisson(PHOTONS * (1 + contrast)).astype(float)
        data = conditional(model, GRID, before, after, 1.0).data
        images.append(ParticleImage(GRID, CONDITIONAL, data, float(x), float(y), 5.0))
    return images


def _spreads(movies: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Learn every movie; errors over their bounds (movies, parameters), and χ² of all together."""
    config, random = configuration(), np.random.default_rng(seed)
    pictures = Pictures(TRUTH)
    names = tuple(TRUE)
    start = {**settings_of(config), **TRUE, "polarization": "circular"}

    def build(settings):  # type: ignore[no-untyped-def]
        return build_microscope(config, 2600.0, settings)

    pulls, whole = [], []
    for _ in range(movies):
        placed = with_masses(_movie(pictures, random), build, start)
        found = maximise(placed, build, {**start, "focus_nm": -350.0, "z11": 9.0}, names)
        assert found.converged
        error = np.array([found.values[name] - TRUE[name] for name in names])
        pulls.append(error / np.sqrt(np.diag(found.bound)))
        whole.append(error @ found.information @ error)
    return np.array(pulls), np.array(whole)


@pytest.mark.large
def test_parameters_scatter_as_their_bound_says() -> None:
    """The spread of every parameter is known to 1/√(2·29); all together to 1/√(2·29·13)."""
    pulls, whole = _spreads(MOVIES, seed=41)
    spread, error = pulls.std(axis=0, ddof=1), 1 / np.sqrt(2 * (MOVIES - 1))
    for name, value in zip(TRUE, spread, strict=True):
        assert abs(value - 1) < WITHIN + 2 * error, (name, value)
    # mean of a χ² with as many degrees of freedom as parameters, correlations included
    joint = float(np.sqrt(whole.mean() / len(TRUE)))
    assert abs(joint - 1) < 3 / np.sqrt(2 * MOVIES * len(TRUE))
    assert np.abs(pulls.mean(axis=0)).max() < 4 / np.sqrt(MOVIES)
