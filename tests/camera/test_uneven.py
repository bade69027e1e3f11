"""Light that is uneven over a known level is said to be, and particles are not blamed for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import iscat_analysis as ia
from iscat_analysis.errors import DataError

LEVEL_E = 3e4
SETUP: dict[str, Any] = {
    "camera.pixel_size_nm": 84.4,
    "particle.mass_kda": 1000.0,
    "fit.frames": (60, 100),
    "posterior.enabled": False,
    "calibration.gradient_per_kda": -3.1e-5,
    "optics.calibrate": "never",
    "compute.workers": 1,
}
KNOWN = {"background.method": "known", "background.level_e": LEVEL_E}
MEASURED = {"background.frames": (0, 60)}
DIPOLES = {"fit.spheres": ()}
"""No spheres are tried for poor fits, of which these movies are full, and most of the time goes."""


@pytest.fixture(scope="module")
def movies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Record light that is even or not, and particles whose rings are everywhere."""
    folder = tmp_path_factory.mktemp("uneven")
    kinds = {"even": 0.0, "little": 0.003, "much": 0.03, "heavy": 0.0}
    return {
        kind: _movie(folder / f"{kind}.tif", speckle=speckle, heavy=kind == "heavy")
        for kind, speckle in kinds.items()
    }


def _movie(path: Path, *, speckle: float, heavy: bool) -> Path:
    """Record four particles, or sixteen heavy ones whose rings are everywhere."""
    side, apart, mass, field = (4, 20, 3000.0, 96) if heavy else (2, 29, 1000.0, 72)
    events = [
        {"frame": 60, "x_px": 19.7 + apart * (k % side), "y_px": 20.2 + apart * (k // side),
         "mass_kda": mass}
        for k in range(side**2)
    ]  # fmt: skip
    light = {
        "simulation.shape": (field, field),
        "simulation.frames": 100,
        "simulation.photons_per_pixel": LEVEL_E,
        "simulation.background": "speckle",
        "simulation.speckle_contrast": speckle,
        "simulation.events": events,
    }
    ia.simulate_movie({**SETUP, **MEASURED, **light}, path, seed=1)
    return path


def _said(path: Path, changes: dict[str, Any]) -> list[str]:
    result = ia.fit_movie(path, config={**SETUP, **changes})
    return [text for text in result.warnings if "from pixel to pixel" in text]


@pytest.mark.parametrize(("kind", "speckle"), [("little", 0.003), ("much", 0.03)])
def test_an_uneven_field_over_a_known_level_is_named(
    movies: dict[str, Path], kind: str, speckle: float
) -> None:
    """Every row was a poor fit without a word."""
    movie = movies[kind]
    (said,) = _said(movie, KNOWN | DIPOLES)
    percent = float(said.split("differs by ")[1].split(" %")[0])
    assert percent == pytest.approx(100 * speckle, rel=0.15)
    assert f'background.method = "known" has {LEVEL_E:g} in all of them' in said
    assert not _said(movie, MEASURED)  # where it divides out


@pytest.mark.parametrize("kind", ["even", "heavy"])
def test_rings_of_particles_are_not_called_uneven(movies: dict[str, Path], kind: str) -> None:
    assert not _said(movies[kind], KNOWN | DIPOLES)


def test_what_a_wrong_focus_leaves_over_is_not_called_uneven(movies: dict[str, Path]) -> None:
    assert not _said(movies["heavy"], {**KNOWN, **DIPOLES, "optics.focus_nm": -380.0})


def test_an_uneven_field_is_not_followed(movies: dict[str, Path]) -> None:
    """Of particles that move the light is judged first, and what looks like some is its pattern."""
    track = {"fit.mode": "track", "track.free": "mass", "fit.frames": (60, 62)}
    with pytest.raises(DataError, match=r'light differs by 3\.1 %.*background\.method = "tracks"'):
        _said(movies["much"], {**KNOWN, **track})
