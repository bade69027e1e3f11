"""What a wrong number of the microscope leaves over names that number."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.errors import ConfigError
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.cause import Cause, likely_cause
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.records import Candidate

SIDE, LIGHT = 32, 2e7
GRID = PixelGrid.region((0, SIDE), (0, SIDE), PIXEL_NM)
PARTICLE = (5.0, 1000.0)
"""Height and mass."""


def _cause(
    seen: dict[str, Any],
    *,
    stretch: float = 1.0,
    turned: bool = False,
    count: int = 4,
    focus_nm: float = -300.0,
    averaged: int = 1,
) -> Cause | None:
    """Fit bright particles of another microscope, with pixels of another size, or transposed.

    `averaged` frames were made one before.
    """
    config, rng = make_config(optics={"focus_nm": focus_nm}), np.random.default_rng(4)
    true = PixelGrid.region((0, SIDE), (0, SIDE), PIXEL_NM * stretch)
    other = forward_model(make_config(optics={"focus_nm": focus_nm} | seen), true.diagonal_nm)
    model = forward_model(config, GRID.diagonal_nm)
    fits = []
    for x, y in rng.uniform(15.0, 17.0, (count, 2)):
        after = LIGHT * (1 + other.image(true, x * true.pixel_nm, y * true.pixel_nm, *PARTICLE))
        light = averaged * np.array([np.full(GRID.shape, LIGHT), after.T if turned else after])
        counts = rng.poisson(light) / averaged
        likelihood = noise.conditional(model, GRID, *counts, 1.0)
        fits.append(_fitted(likelihood, *((y, x) if turned else (x, y))))
    return likely_cause(config, fits)


def _fitted(likelihood: Likelihood, x: float, y: float) -> tuple[Likelihood, Any, Any]:
    start = Candidate(x, y, *PARTICLE, 10.0)
    fit = fit_particle(likelihood, start, "mass", (0, 1000), level=False)
    return likelihood, fit.theta, fit.box.free


@pytest.mark.parametrize(
    ("name", "key", "off"),
    [
        ("focus", "focus_nm", 60.0),
        ("focus", "focus_nm", -150.0),
        ("wavelength", "wavelength_nm", 45.0),
        ("spherical aberration", "z11", 25.0),
    ],
)
def test_the_wrong_number_is_named_with_its_error(name: str, key: str, off: float) -> None:
    usual = {"focus_nm": -300.0, "wavelength_nm": 525.0}
    seen = {"aberrations_nm": {key: off}} if key == "z11" else {key: usual[key] + off}
    cause = _cause(seen)
    assert cause is not None
    assert cause.name == name
    assert cause.step == pytest.approx(off, rel=0.35)  # neither is of first order
    assert f"off by about {math.copysign(1, off):+g}"[:-1] in cause.message


@pytest.mark.parametrize(("configured", "true"), [(-380.0, -300.0), (-500.0, -400.0)])
def test_a_focus_is_tried_whole(configured: float, true: float) -> None:
    """To first order both were 170 nm off."""
    cause = _cause({"focus_nm": true}, focus_nm=configured)
    assert cause is not None
    assert cause.name == "focus"
    assert cause.step == pytest.approx(true - configured, abs=30)


@pytest.mark.parametrize("off", [25.0, 40.0, -40.0, 60.0])
def test_a_wrong_phase_is_named_with_its_angle(off: float) -> None:
    """Of the tangent that is left over beside a fitted mass, 60° seem to be 87° or more."""
    cause = _cause({"reference_phase_deg": off})
    assert cause is not None
    assert cause.name == "reference phase"
    assert cause.step == pytest.approx(off, rel=0.2)


def _dark_cause(
    configured: dict[str, Any], seen: dict[str, Any], scale: float = 1e14
) -> Cause | None:
    """Fit particles of another microscope in dark field."""
    dark = {"scheme": "darkfield"}
    config = make_config(calibrated=False, optics=dark | configured)
    model = forward_model(config, GRID.diagonal_nm)
    other = forward_model(make_config(calibrated=False, optics=dark | seen), GRID.diagonal_nm)
    level, rng = np.full(GRID.shape, 2e4), np.random.default_rng(5)
    fits = []
    for x, y in rng.uniform(15.0, 17.0, (4, 2)):
        light = level + scale * other.image(GRID, x * PIXEL_NM, y * PIXEL_NM, *PARTICLE)
        counts = rng.poisson(light).astype(float)
        fits.append(_fitted(noise.poisson(model, GRID, counts, level, scale), x, y))
    return likely_cause(config, fits)


@pytest.mark.parametrize(
    ("name", "key", "off", "found"),
    [
        ("spherical aberration", "z11", 20.0, 20.0),
        ("focus", "focus_nm", 100.0, 100.0),
        ("numerical aperture", "na", -0.06, -0.06),
        ("focus", "focus_nm", -100.0, -100.0),  # by first order, NA 1.52 in oil of 1.515
    ],
)
def test_the_wrong_number_is_named_in_dark_field(
    name: str, key: str, off: float, found: float
) -> None:
    usual = {"focus_nm": -300.0, "na": 1.42}
    seen = {"aberrations_nm": {key: off}} if key == "z11" else {key: usual[key] + off}
    cause = _dark_cause({}, seen)
    assert cause is not None
    assert cause.name == name
    assert cause.step == pytest.approx(found, rel=0.5)
    assert "with an interferometric movie" in cause.message


@pytest.mark.parametrize(
    ("configured", "true"),
    [(-300.0, 500.0), (-300.0, 200.0), (-300.0, -800.0), (300.0, -400.0), (300.0, 800.0)],
)
def test_a_focus_that_is_far_off_in_dark_field_is_named_on_its_side(
    configured: float, true: float
) -> None:
    """To first order -280 nm explained most of what +800 nm leaves over."""
    cause = _dark_cause({"focus_nm": configured}, {"focus_nm": true})
    assert cause is not None
    assert cause.name == "focus"
    assert cause.step == pytest.approx(true - configured, abs=50)
    assert not cause.other_steps


@pytest.mark.parametrize("na", [1.2, 1.42])
@pytest.mark.parametrize(("configured", "true"), [(0.0, -300.0), (-300.0, -500.0)])
def test_the_side_of_focus_that_dark_field_does_not_tell_is_left_open(
    configured: float, true: float, na: float
) -> None:
    """A picture of |E|² is nearly that on the other side, the less so the larger the aperture."""
    here, there = ({"focus_nm": focus, "na": na} for focus in (configured, true))
    cause = _dark_cause(here, there, scale=1e13 if configured else 1e14)
    assert cause is not None
    assert cause.name == "focus"
    steps = (cause.step or 0.0, *cause.other_steps)
    assert min(abs(step - (true - configured)) for step in steps) <= 100
    sides = {math.copysign(1, configured + step) for step in steps}
    assert sides == {-1.0, 1.0}
    assert "which these pictures do not tell apart" in cause.message


def test_the_wrong_number_is_named_where_frames_were_averaged_before() -> None:
    """With less noise than a count has, several numbers explain more than all of χ² in excess."""
    cause = _cause({"reference_phase_deg": 8.0}, averaged=100)
    assert cause is not None
    assert cause.name == "reference phase"
    assert cause.share == 1.0


@pytest.mark.parametrize("stretch", [0.8, 0.95, 1.03, 1.1, 1.2])
def test_a_wrong_pixel_size_is_named(stretch: float) -> None:
    cause = _cause({}, stretch=stretch)
    assert cause is not None
    assert cause.name == "camera.pixel_size_nm"
    assert cause.step == pytest.approx(100 * (stretch - 1), rel=0.35)


@pytest.mark.parametrize(
    ("seen", "stretch"), [({}, 0.96), ({}, 1.04), ({"wavelength_nm": 505.0}, 1.0)]
)
def test_wavelength_and_pixel_size_are_named_together(
    seen: dict[str, float], stretch: float
) -> None:
    """Near focus both stretch the picture, and only one of them was named."""
    cause = _cause(seen, stretch=stretch, focus_nm=-100.0)
    assert cause is not None
    (rival,) = cause.rivals
    steps = {cause.name: cause.step or 0.0, rival[0]: rival[1]}
    larger = 100 * (stretch * 525.0 / seen.get("wavelength_nm", 525.0) - 1)
    assert steps["camera.pixel_size_nm"] == pytest.approx(larger, rel=0.35)
    assert steps["wavelength"] == pytest.approx(-5.25 * larger, rel=0.35)
    assert f"or {rival[0]}, by " in cause.message
    assert "which these pictures do not tell apart" in cause.message


@pytest.mark.parametrize(
    ("seen", "stretch", "name"),
    [({}, 1.04, "camera.pixel_size_nm"), ({"wavelength_nm": 480.0}, 1.0, "wavelength")],
)
def test_far_from_focus_bright_particles_tell_wavelength_from_pixel_size(
    seen: dict[str, float], stretch: float, name: str
) -> None:
    cause = _cause(seen, stretch=stretch, focus_nm=-600.0)
    assert cause is not None
    assert cause.name == name
    assert not cause.rivals


def test_a_transposed_movie_is_named() -> None:
    cause = _cause({}, turned=True)
    assert cause is not None
    assert "turned by 90° (or the movie transposed)" in cause.message
    circular = _cause({"polarization": "circular", "analyzer": True})
    assert circular is not None
    assert "circular" in circular.message


def test_a_microscope_with_particles_of_the_other_sign_is_no_cause() -> None:
    """At this focus they are bright where a mask is in the pupil, and the configured line dark."""
    defocused = {"focus_nm": -500.0}
    with pytest.raises(ConfigError, match="wrong sign"):
        forward_model(make_config(optics=defocused | {"mask_na": 0.6, "attenuation": 0.3}), 1500.0)
    cause = _cause({"aberrations_nm": {"z11": 25.0}}, **defocused)
    assert cause is not None
    assert cause.name == "spherical aberration"


def test_nothing_is_named_where_all_is_right() -> None:
    assert _cause({}) is None
    assert likely_cause(make_config(), []) is None


def test_a_part_of_what_is_wrong_is_not_told_to_be_corrected() -> None:
    """Where several parts are wrong at once the likeliest explains little; control: one alone."""
    cause = _cause({"na": 1.34, "aberrations_nm": {"z5": 20.0, "z7": 20.0}})
    assert cause is not None
    assert "explains only a part, so calibrate the optics" in cause.message
    assert "correct it" not in cause.message
    alone = _cause({"aberrations_nm": {"z11": 25.0}})
    assert alone is not None
    assert "correct it, or calibrate the optics" in alone.message
