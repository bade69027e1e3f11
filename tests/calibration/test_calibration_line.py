"""A line between contrast and mass: what it cannot tell off zero, and when its sign is doubted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
from scenes import make_config

from iscat_analysis.config import Calibration, Config
from iscat_analysis.diagnosis import sign_warning
from iscat_analysis.findings import Finding
from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.model import MassScale
from iscat_analysis.pipeline import analyse
from iscat_analysis.records import Analysis

GRADIENT = -3.1e-5
CROSSING = 64.0  # kDa
ERROR = 2.0  # kDa, of every mass below
LINEAR = -5e-5
FRAMES = 20
SHAPE = (72, 72)
LEVEL_E = 4e6


def _scale(offset: float) -> MassScale:
    return MassScale(Calibration(gradient_per_kda=GRADIENT, offset=offset), LINEAR, 1e-9)


def _off(scale: MassScale, contrast_kda: list[float], sigma_kda: float = ERROR) -> list[bool]:
    """Ask of contrasts in kDa along the gradient."""
    straight = MassScale(Calibration(gradient_per_kda=GRADIENT), LINEAR, 1e-9)
    amplitude = np.array([straight.amplitude(c) for c in contrast_kda])
    told: list[bool] = scale.off_line(amplitude, np.full(amplitude.shape, sigma_kda), 3.0).tolist()
    return told


@pytest.mark.parametrize("sign", [1, -1])
def test_contrasts_of_two_masses_are_told(sign: int) -> None:
    """Where the line is at zero at 64 kDa, +100 and −28 kDa have one contrast, as ±64 have none."""
    scale = _scale(-GRADIENT * CROSSING)
    assert scale.amplitude(sign * 100.0) == pytest.approx(scale.amplitude(-sign * 28.0))
    told = _off(scale, [sign * c for c in (0.1, 36.0, CROSSING + 5.0, CROSSING + 7.0, 500.0)])
    assert told == [True, True, True, False, False]


@pytest.mark.parametrize("sign", [1, -1])
def test_contrasts_of_no_mass_are_told(sign: int) -> None:
    """Where all masses have more contrast than 64 kDa would, what has less is none of them."""
    told = _off(
        _scale(GRADIENT * CROSSING),
        [sign * c for c in (0.1, CROSSING - 7.0, CROSSING - 5.0, CROSSING, 500.0)],
    )
    assert told == [True, True, False, False, False]


def test_nothing_is_told_where_it_does_not_matter() -> None:
    """Two masses nearer than their error are one result; a line through zero has no doubt."""
    assert not any(_off(_scale(-GRADIENT * 0.4 * ERROR), [0.1, 3.0, 50.0]))
    assert not any(_off(_scale(0.0), [0.1, 3.0, 50.0]))
    assert not MassScale().off_line(np.array([0.1]), np.array([1.0]), 3.0).any()


def _config(mode: str, offset: float) -> Config:
    return make_config(
        background={"frames": [0, FRAMES]},
        fit={"mode": mode, "frames": [FRAMES, 2 * FRAMES], "roi_nm": 2200.0},
        calibration={"offset": offset},
        optics={"calibrate": "never"},
        camera={"well_depth_e": 1e9, "frame_rate_hz": 331.0, "exposure_ms": 2.0},
        track={"min_frames": 4},
    )


def _analysed(folder: Path, mode: str, masses: tuple[float, float], offset: float) -> Analysis:
    """Analyse a movie of two particles that stand still."""
    config, rng = _config(mode, offset), np.random.default_rng(5)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), 84.4)
    model = forward_model(config, grid.diagonal_nm)
    signal = np.zeros(SHAPE)
    for place, mass in zip(((1700.0, 1800.0), (4200.0, 4300.0)), masses, strict=True):
        signal += model.image(grid, *place, 5.0, mass)
    after = np.repeat([np.zeros(SHAPE), signal], FRAMES, axis=0)
    counts = rng.poisson(LEVEL_E * (1 + after)).astype(np.uint32)
    tifffile.imwrite(folder / "movie.tif", counts, photometric="minisblack")
    with open_stack(folder / "movie.tif") as movie:
        return analyse(movie, config)


@pytest.mark.parametrize(
    ("mode", "light", "heavy"), [("mass", 20.0, 200.0), ("track", 100.0, 300.0)]
)
def test_the_user_is_told_which_masses_the_line_does_not_tell(
    tmp_path: Path, mode: str, light: float, heavy: float
) -> None:
    """A particle of 20 kDa came out at −108 kDa, and was said to be ok."""
    found = _analysed(tmp_path, mode, (light, heavy), -GRADIENT * CROSSING)
    near = found.table["x_px"] < 36
    assert 0 < near.sum() < len(near)
    assert (found.table["status"][near] == "at_bound").all()
    assert (found.table["status"][~near] == "ok").all()
    told = [text for text in found.summary["warnings"] if "64 kDa" in text and "128 kDa" in text]
    assert len(told) == 1
    assert f"{near.sum()} fit" in told[0]


def test_the_user_is_told_of_contrasts_below_the_line(tmp_path: Path) -> None:
    config = _config("mass", 0.0)
    assert config.calibration is not None
    found = _analysed(tmp_path, "mass", (40.0, 200.0), 0.0)  # the control: a line through zero
    assert (found.table["status"] == "ok").all()
    assert not any("[calibration]" in text for text in found.summary["warnings"])
    changed = _config("mass", GRADIENT * CROSSING)
    with open_stack(tmp_path / "movie.tif") as movie:
        off = analyse(movie, changed)
    near = off.table["x_px"] < 36
    assert off.table["status"].tolist() == ["at_bound" if left else "ok" for left in near]
    assert any("they have less" in text for text in off.summary["warnings"])


def _signed(
    negative: int, positive: int, *, flagged: int = 0, contrast: float = 5e-3
) -> Finding | None:
    """Ask of particles with masses of either sign, and some whose fits are poor."""
    mass = [-200.0] * negative + [200.0] * (positive + flagged)
    table = pd.DataFrame({
        "mass_kda": mass,
        "contrast": [contrast * -np.sign(m) for m in mass],
        "status": ["ok"] * (negative + positive) + ["poor_fit"] * flagged,
    })  # fmt: skip
    return sign_warning(make_config(), table)


def test_nearly_all_particles_of_the_other_sign_are_told() -> None:
    told = _signed(9, 1, flagged=30)
    assert told is not None
    assert "9 of 10 particles have a negative mass" in told.text
    assert "they brighten the image, and by calibration.gradient_per_kda" in told.text
    dark = _signed(9, 1, contrast=-5e-3)
    assert dark is not None
    assert "they darken the image" in dark.text


def test_particles_that_may_leave_are_not_told() -> None:
    """As many may leave as land, and few are all of one sign by chance."""
    assert not _signed(8, 2)
    assert not _signed(4, 0)
    assert not _signed(0, 0)
