"""Particles too heavy for a line of light standards are named, and by how much masses are off."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from instruments import Instrument, InstrumentMovie, Pictures, draw_landings
from shared_errors import systematic

import iscat_analysis as ia
from iscat_analysis.config import Uncertainty, configure
from iscat_analysis.diagnosis import nonlinearity_warning
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.optics.model import MassScale

GRADIENT = -3.1e-5
INSTRUMENT = Instrument(emission="reciprocal")
SETTINGS = {
    "camera.pixel_size_nm": 84.0,
    "calibration.gradient_per_kda": GRADIENT,
    "optics.calibrate": "never",
    "posterior.enabled": False,
    **{f"uncertainty.{key}": 0.0 for key in Uncertainty.model_fields if key != "optics"},
}


def _scale() -> MassScale:
    return forward_model(configure(settings=SETTINGS), 1e3).scale


@pytest.mark.parametrize("mass_kda", [430.0, 2000.0, 5000.0, -5000.0])
def test_how_far_a_faint_line_is_off_is_that_of_pictures_made_elsewhere(mass_kda: float) -> None:
    pictures, near = Pictures(INSTRUMENT, pixel_nm=0.0), np.linspace(-300.0, 300.0, 121)

    def peak(mass: float) -> float:
        picture = pictures.contrast(near[None], near[:, None], mass).ravel()
        return float(picture[np.argmax(np.abs(picture))])

    gradient = peak(1.0)
    by_line = peak(abs(mass_kda)) / gradient
    bend = _scale().bend(np.array([np.copysign(by_line, mass_kda)]))[0]
    assert bend == pytest.approx(abs(mass_kda) / by_line - 1, rel=0.02)
    assert (bend > 0.01) == (abs(mass_kda) > 1500)


def _table(mass_kda: float, sigma_kda: float, status: str = "ok") -> pd.DataFrame:
    return pd.DataFrame(
        {"mass_kda": [300.0, mass_kda], "sigma_mass_kda": sigma_kda, "status": status, "flags": ""}
    )


def test_only_what_chance_does_not_hide_is_told() -> None:
    scale, config = _scale(), configure(settings=SETTINGS)
    heavy = _table(5000.0, 10.0)
    assert re.match(
        r"1 particle, of up to 5000 kDa, is so heavy .* 4\.\d % too light",
        nonlinearity_warning(scale, heavy).text,
    )
    shared = systematic(config, heavy, scale=scale)["mass_kda"]
    assert 0.04 < shared[1] / 5000 < 0.05
    assert shared[0] < 1.0
    for quiet in (_table(500.0, 10.0), _table(5000.0, 1e3), _table(5000.0, 10.0, "poor_fit")):
        assert not nonlinearity_warning(scale, quiet)
        assert not systematic(config, quiet, scale=scale)
    assert not nonlinearity_warning(MassScale(), heavy)  # the absolute model has the square


@pytest.mark.parametrize(("sigma_kda", "told", "warned"), [(6, 1, 1), (15, 1, 0), (70, 0, 0)])
def test_two_megadaltons_are_told_by_their_own_errors(
    sigma_kda: float, told: bool, warned: bool
) -> None:
    """The line is 1.6 % off: 33 kDa, five errors, two, and half of one."""
    scale, table = _scale(), _table(2000.0, sigma_kda)
    off = systematic(configure(settings=SETTINGS), table, scale=scale)
    assert bool(off) == told
    assert not told or off["mass_kda"][1] == pytest.approx(33.0, rel=0.05)
    assert bool(nonlinearity_warning(scale, table)) == warned


def test_a_movie_of_heavy_particles_says_so_and_nothing_of_its_noise() -> None:
    shape = (200, 64, 64)
    found = {}
    for mass in (500.0, 5000.0):
        movie = InstrumentMovie(
            INSTRUMENT, shape, draw_landings(shape, 4, seed=3, masses=(mass,), apart_px=20), seed=1
        )
        settings = {
            **SETTINGS, "camera.gain_e_per_adu": 4.0, "particle.mass_kda": mass,
            "background.method": "sliding",
        }  # fmt: skip
        found[mass] = ia.fit_movie(movie.counts, settings=settings)
    assert not any("so heavy" in text for text in found[500.0].warnings)
    shared = [one for one in found[500.0].summary["budget"] if one["common"] and one["sigma_rel"]]
    assert [one["name"] for one in shared] == ["offset of the camera"]  # assumed, and no other
    said = found[5000.0].warnings
    assert any("so heavy that contrast is not in proportion" in text for text in said)
    assert not any("correlated" in text for text in said)
    rows = found[5000.0].table.query("status == 'ok'")
    assert len(rows) >= 3
    assert (abs(rows["mass_kda"] - 5000) < 2 * rows["systematic_mass_kda"]).all()
    assert (abs(rows["mass_kda"] - 5000) > 5 * rows["sigma_mass_kda"]).all()  # what went unsaid
