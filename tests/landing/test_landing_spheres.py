"""Spheres that land: their light is large, and adds up as fields do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.camera.transfer import find_law, measure_transfer
from iscat_analysis.config import Config
from iscat_analysis.fitting import events
from iscat_analysis.landing import steps
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.search.noise import measure_motion
from iscat_analysis.study import write_stack

DIAMETER_NM, INDEX = 150.0, 1.461
LANDINGS = [(70, 24.3, 30.6), (150, 30.2, 66.8), (160, 43.1, 70.4)]
"""Frame and place [pixels]; the last two are 1.2 µm from each other."""


def config_of(**keys: object) -> Config:
    """Make a movie in which three silica spheres land."""
    return ia.configure(
        {
            "optics": {"focus_nm": 0.0},
            "camera": {"pixel_size_nm": 90.0, "gain_e_per_adu": 1.0, "offset_adu": 0.0},
            "particle": {
                "kind": "custom", "model": "mie", "index": INDEX, "density_kg_m3": 2200.0,
                "diameter_nm": DIAMETER_NM,
            },
            "background": {"method": "sliding", "window_frames": 50},
            "fit": {
                "mode": "size", "roi_nm": 2200.0, "z_range_nm": [0.0, 300.0],
                "diameter_range_nm": [20.0, 200.0], **keys,
            },
            "posterior": {"enabled": False},
            "simulation": {
                "shape": [88, 80], "frames": 240, "photons_per_pixel": 1e4,
                "events": [{"frame": t, "x_px": x, "y_px": y} for t, x, y in LANDINGS],
            },
        }
    )  # fmt: skip


def test_neighbours_are_as_large_as_they_are(tmp_path: Path) -> None:
    """Without the product of fields both are 6 standard errors too small, and no fit is good.

    Rings beyond the largest image of a protein would be two rows more.
    """
    movie, told = tmp_path / "movie.tif", []
    write_stack(config_of(), movie, seed=5)
    table = fit_stack(movie, config_of(), notify=told.append).table
    assert table["frame"].tolist() == [t for t, *_ in LANDINGS]
    assert set(table["status"]) == {"ok"}
    pulls = (table["diameter_nm"] - DIAMETER_NM) / table["sigma_diameter_nm"]
    assert (np.abs(pulls) < 4).all()
    assert not any("moves" in text or "moved" in text for text in told)


@pytest.mark.large
def test_the_index_of_a_sphere_that_lands_is_fitted(tmp_path: Path) -> None:
    movie = tmp_path / "movie.tif"
    write_stack(config_of(), movie, seed=2)
    particle = {"kind": "custom", "index": 1.45, "diameter_nm": DIAMETER_NM}
    config = config_of(index=True)
    wrong = config.model_copy(update={"particle": config.particle.model_copy(update=particle)})
    table = fit_stack(movie, wrong).table
    told = table[table["refractive_index"].notna()]
    assert len(told) == len(LANDINGS)
    for value, truth in (("diameter_nm", DIAMETER_NM), ("refractive_index", INDEX)):
        assert (np.abs(told[value] - truth) < 4 * told[f"sigma_{value}"]).all()


def bright_landings(seed: int) -> np.ndarray:
    """Draw an even, steady light in which bright spots land, that have dark rings."""
    rng = np.random.default_rng(seed)
    spot = np.zeros((64, 64))
    spot[32, 32] = 1.0
    narrow, wide = (gaussian_filter(spot, width) for width in (1.5, 5.0))
    image = (narrow - 0.7 * narrow.max() / wide.max() * wide * 0.3) / narrow.max()
    light = np.full((240, 64, 64), 1e4)
    for frame in (60, 90, 150, 200):
        light[frame:] *= 1 + np.roll(image, rng.integers(0, 64, 2), axis=(0, 1))
    return rng.poisson(light).astype(np.uint32)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_lands_is_no_flicker_and_no_motion(seed: int) -> None:
    counts = bright_landings(seed)
    transfer = measure_transfer(counts, Camera())
    assert transfer is not None
    assert transfer.flicker is None
    assert find_law(transfer).kind == "linear"
    assert measure_motion(counts, Camera(), 40) < 0.01


def test_spheres_are_given_up_where_none_describes_the_brightest_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten points in optics that are wrong: eight were tried twice.  Control: good optics."""
    tried: list[str] = []
    for where in (steps, events):
        monkeypatch.setattr(
            where, "recognised", lambda *_, at=where.__name__, **__: tried.append(at)
        )
    points = [{"frame": 60 + 16 * k, "x_px": 16.0 + 19.2 * (k % 4), "y_px": 16.0 + 26.4 * (k // 4),
               "mass_kda": 4500.0} for k in range(10)]  # fmt: skip
    truth = ia.configure(
        {
            "optics": {"focus_nm": -300.0, "attenuation": 0.1, "calibrate": "never"},
            "camera": {"pixel_size_nm": 90.0, "gain_e_per_adu": 1.0, "offset_adu": 0.0},
            "particle": {"mass_kda": 4500.0},
            "background": {"method": "sliding", "window_frames": 30},
            "posterior": {"enabled": False},
            "simulation": {
                "shape": [88, 80], "frames": 240, "photons_per_pixel": 3e4, "events": points,
            },
        }
    )  # fmt: skip
    movie = tmp_path / "movie.tif"
    write_stack(truth, movie, seed=7)
    for focus_nm, most in ((-300.0, 0), (-150.0, 2 * events.IN_VAIN)):
        tried.clear()
        wrong = ia.configure(truth, settings={"optics.focus_nm": focus_nm})
        fit_stack(movie, wrong, out=tmp_path / f"at {focus_nm:g}")
        assert len(tried) == most
        assert set(tried) <= {steps.__name__}
