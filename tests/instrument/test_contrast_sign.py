"""A focus of no contrast, or of the other sign, is named, and measured where the movie tells it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.errors import ConfigError
from iscat_analysis.instrument import learning
from iscat_analysis.instrument.learning import wrong_sign
from iscat_analysis.instrument.loop import fit_optics
from iscat_analysis.instrument.particle_image import Collected
from iscat_analysis.instrument.result import OpticsCalibration

MASSES = (800.0, 1000.0, 1500.0, 600.0, 1200.0, 2000.0, 900.0, 700.0, 1100.0)
HEIGHTS = (12.0, 65.0, 120.0, 175.0, 230.0, 285.0, 340.0, 395.0, 50.0)
SETUP: dict[str, Any] = {
    "camera.pixel_size_nm": 84.4,
    "particle.mass_kda": 1000.0,
    "background.frames": (0, 60),
    "fit.frames": (60, 120),
    "posterior.enabled": False,
    "calibration.gradient_per_kda": -3.1e-5,
    "compute.workers": 1,
}
JOINT: dict[str, Any] = {"fit.mode": "joint", "fit.z_range_nm": (0.0, 500.0)}


def _movie(path: Path, **changes: Any) -> Path:
    """Nine particles, 32 pixels apart."""
    light = {
        "simulation.shape": (120, 120),
        "simulation.frames": 120,
        "simulation.photons_per_pixel": 3e4,
    }
    events = [
        {"frame": 60, "x_px": 20.3 + 32 * (k % 3), "y_px": 19.5 + 0.7 * (k % 3) + 32 * (k // 3),
         "mass_kda": mass, "z_nm": height}
        for k, (mass, height) in enumerate(zip(MASSES, changes.pop("heights"), strict=True))
    ]  # fmt: skip
    ia.simulate_movie({**SETUP, **light, **changes, "simulation.events": events}, path, seed=1)
    return path


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Particles on the glass, at a focus of −300 nm."""
    path = tmp_path_factory.mktemp("flat") / "movie.tif"
    return _movie(path, heights=(5.0,) * 9, **{"optics.focus_nm": -300.0})


def _focus_is(result: ia.Result, focus_nm: float) -> bool:
    (focus,) = (p for p in result.summary["optics"]["parameters"] if p["parameter"] == "focus_nm")
    return bool(abs(focus["value"] - focus_nm) < 4 * focus["sigma"] < 10.0)


def _refused(movie: Path, changes: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        ia.fit_movie(movie, config={**SETUP, **changes})
    return str(caught.value)


@pytest.mark.parametrize("focus_nm", [pytest.param(-25.0, marks=pytest.mark.large), -10.0, 20.0])
def test_the_movie_tells_a_focus_that_gives_no_contrast(flat: Path, focus_nm: float) -> None:
    result = ia.fit_movie(flat, config={**SETUP, "optics.focus_nm": focus_nm})
    said = " ".join(result.warnings)
    assert f"at optics.focus_nm = {focus_nm:g} particles have next to no contrast" in said
    assert "what they have is bright" in said
    assert "as configured;" not in said
    assert _focus_is(result, -300.0)
    assert len(result.table) == len(MASSES)
    pulls = (result.table["mass_kda"] - np.array(MASSES)) / result.table["sigma_mass_kda"]
    assert np.abs(pulls).max() < 4.0


@pytest.mark.large
def test_heights_of_their_own_tell_the_focus_too(tmp_path: Path) -> None:
    movie = _movie(tmp_path / "movie.tif", heights=HEIGHTS, **{"optics.focus_nm": -500.0}, **JOINT)
    result = ia.fit_movie(movie, config={**SETUP, **JOINT, "optics.focus_nm": -10.0})
    assert "next to no contrast" in " ".join(result.warnings)
    assert _focus_is(result, -500.0)
    assert (result.table["status"] == "ok").all()
    pulls = (result.table["z_nm"] - np.array(HEIGHTS)) / result.table["sigma_z_nm"]
    assert np.abs(pulls).max() < 4.0


def test_what_the_movie_does_not_tell_is_not_said_to_go_on(
    flat: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The optics may not be learned; or a focus alone is, which describes no particle."""
    wrong = {"optics.focus_nm": -10.0}
    never = _refused(flat, {**wrong, "optics.calibrate": "never"})
    assert "next to no contrast" in never
    assert 'by optics.calibrate = "never" the optics are not learned' in never

    def the_focus_alone(
        seen: Collected, _recording: Any, _free: Any, origin: Any
    ) -> OpticsCalibration:
        return fit_optics(seen, ("focus",), origin)

    monkeypatch.setattr(learning, "learned_from", the_focus_alone)
    more = _refused(flat, {**wrong, "optics.na": 1.38})
    assert "as where more than the focus is wrong" in more
    assert "describes the brightest particles best, but not well" in more


def test_a_wrong_aperture_is_measured_with_the_focus(flat: Path) -> None:
    """Nine particles tell both: no focus alone describes them, and all of the optics do."""
    result = ia.fit_movie(flat, config={**SETUP, "optics.focus_nm": -10.0, "optics.na": 1.38})
    assert "next to no contrast" in " ".join(result.warnings)
    assert _focus_is(result, -300.0)
    (na,) = (p for p in result.summary["optics"]["parameters"] if p["parameter"] == "na")
    assert na["state"] == "measured"
    assert abs(na["value"] - 1.42) < 4 * na["sigma"] < 0.01
    pulls = (result.table["mass_kda"] - np.array(MASSES)) / result.table["sigma_mass_kda"]
    assert np.abs(pulls).max() < 4.0


def test_a_wrong_sign_of_the_line_is_told_from_a_wrong_focus(flat: Path) -> None:
    line = {"optics.focus_nm": -300.0, "calibration.gradient_per_kda": 3.1e-5}
    said = _refused(flat, line)
    assert "at optics.focus_nm = -300 particles are dark, where" in said
    assert "with it the optics describe the particles of the movie" in said
    elsewhere = _refused(flat, {**line, "optics.focus_nm": -200.0})
    assert "by the movie the focus is -300 nm, which has that sign too" in elsewhere


def test_optics_that_have_the_sign_are_left_alone() -> None:
    assert wrong_sign(ia.configure({**SETUP, "optics.focus_nm": -300.0})) is None
    without = {key: value for key, value in SETUP.items() if "calibration" not in key}
    assert wrong_sign(ia.configure({**without, "optics.focus_nm": -10.0})) is None
