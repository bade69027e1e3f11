"""Populations of diameters, with the errors of the spheres taken off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.findings.tables import TWO_STANDARDS
from iscat_analysis.pipeline.finish import sizes_of_tracks
from iscat_analysis.records import FloatArray
from iscat_analysis.species.diameters import describe_sizes
from iscat_analysis.units import sphere_mass_kda

MEDIAN_NM, WIDTH, ERROR = 100.0, np.log(1.12), 0.06
TRIALS = 12


def draw(
    seed: int, n: int = 300, error: float = ERROR, light: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Draw diameters of a log-normal population, and errors as the measurement states them.

    The noise of `light` moves the cube of a diameter, whose error does not depend on it; without,
    it moves the diameter itself.
    """
    rng = np.random.default_rng(seed)
    truth = MEDIAN_NM * np.exp(rng.normal(0, WIDTH, n))
    brightness = rng.uniform(0.6, 1.4, n)
    if not light:
        sigma = error * MEDIAN_NM * brightness
        return truth + rng.normal(0, sigma), sigma
    sigma = 3 * error * MEDIAN_NM**3 * brightness
    diameter = np.cbrt(np.abs(truth**3 + rng.normal(0, sigma)))
    return diameter, sigma / (3 * diameter**2)


@pytest.mark.parametrize("light", [True, False])
def test_median_and_width_are_those_of_the_population(light: bool) -> None:
    """Of 300 spheres, σ(ln median) ≈ √(WIDTH² + ERROR²)/√300; without deconvolution they fail."""
    found, plain = [], []
    for seed in range(TRIALS):
        diameter, sigma = draw(seed, light=light)
        sizes = describe_sizes(diameter, sigma, seed=1, draws=0)
        assert sizes is not None
        one = sizes.populations.iloc[0]
        found.append([np.log(one["diameter_nm"] / MEDIAN_NM), np.log(one["geometric_sd"])])
        plain.append(np.std(np.log(diameter)))
    middle, width = np.array(found).T
    assert abs(middle.mean()) < 4 * middle.std(ddof=1) / np.sqrt(TRIALS)
    assert abs(width.mean() - WIDTH) < 4 * width.std(ddof=1) / np.sqrt(TRIALS)
    assert np.mean(plain) - WIDTH > 4 * np.std(plain, ddof=1) / np.sqrt(TRIALS)


def test_two_populations_have_fractions_intervals_and_a_common_error() -> None:
    (small, small_error), (large, large_error) = draw(3, 150, 0.03), draw(4, 75, 0.03)
    diameter, sigma = np.append(small, 2 * large), np.append(small_error, 2 * large_error)
    known = [TWO_STANDARDS()]
    sizes = describe_sizes(diameter, sigma, seed=1, draws=20, common=0.05, findings=known)
    assert sizes is not None
    assert sizes.findings[0].code == "two-standards"
    table = sizes.populations
    for name, truth in (
        ("diameter", [100, 200]), ("geometric_sd", [1.12, 1.12]), ("fraction", [2 / 3, 1 / 3])
    ):  # fmt: skip
        low, high = table[f"{name}_low"], table[f"{name}_high"]
        assert (np.abs((low + high) / 2 - truth) < high - low).all()  # four standard errors
    assert np.allclose(table["diameter_systematic"], 0.05 * table["diameter_nm"])
    assert (table["diameter_high"] - table["diameter_low"] > 0.19 * table["diameter_nm"]).all()
    drawn = sizes.to_dict()
    step = np.diff(drawn["curve"]["diameter_nm"])[0]
    assert np.sum(drawn["curve"]["model"]) * step == pytest.approx(225, rel=0.01)


def test_what_tells_nothing_is_left_out_and_said() -> None:
    diameter, sigma = draw(1, 40)
    assert describe_sizes(diameter[:9], sigma[:9], seed=1) is None
    sigma[0] = diameter[0]
    diameter[1] = np.nan
    sizes = describe_sizes(diameter, sigma, seed=1, draws=0)
    assert sizes is not None
    assert sizes.spheres == 38
    assert any(note.startswith("2 spheres without a diameter") for note in sizes.notes)
    vague = describe_sizes(diameter, 3 * sigma, seed=1, draws=0)
    assert vague is not None
    assert any("median and width are biased" in n for n in vague.notes)


def test_tracks_are_left_out_for_their_pictures_and_not_for_their_motion() -> None:
    diameter, sigma = draw(1, 30, 0.02)
    flags = ["ok"] * 10 + ["near_wall"] * 10 + ["not_free;ambiguous_size"] * 5 + ["poor_fits"] * 5
    tracks = pd.DataFrame(
        {"optical_diameter_nm": diameter, "sigma_optical_diameter_nm": sigma, "flags": flags,
         "mass_kda": 500.0}
    )  # fmt: skip
    sizes = sizes_of_tracks(tracks, seed=1)
    assert sizes is not None
    assert sizes.spheres == 20
    assert sizes.notes[0].startswith("10 tracks of 30 left out")


@pytest.mark.large
def test_a_movie_of_spheres_has_the_width_of_its_population(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    truth = 100 * np.exp(rng.normal(0, 0.1, 12))
    places = [(24 + 48 * i, 24 + 48 * j) for i in range(4) for j in range(3)]
    settings = {
        "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": 0.0},
        "camera": {"pixel_size_nm": 90.0, "gain_e_per_adu": 1.0, "offset_adu": 0.0,
                   "read_noise_e": 0.0},
        "particle": {"kind": "silica", "model": "mie", "diameter_nm": 100.0},
        "background": {"frames": [0, 40]},
        "fit": {"mode": "size", "roi_nm": 1800.0, "z_range_nm": [0.0, 150.0],
                "diameter_range_nm": [60.0, 160.0]},
        "simulation": {
            "shape": [144, 192], "frames": 80, "photons_per_pixel": 500.0,
            "events": [
                {"frame": 40, "x_px": x, "y_px": y, "mass_kda": sphere_mass_kda(d, 2200.0)}
                for (x, y), d in zip(places, truth.tolist(), strict=True)
            ],
        },
    }  # fmt: skip
    path = tmp_path / "spheres.tif"
    ia.simulate_movie(settings, path, seed=2)
    result = ia.fit_movie(path, config=settings)
    assert result.summary["distribution"] is None
    sizes = result.summary["sizes"]
    assert sizes["spheres"] == (result.table["status"] == "ok").sum() >= 11
    (one,) = [each for each in sizes["populations"] if not each["outlier"]]
    assert one["diameter_low"] < np.exp(np.log(truth).mean()) < one["diameter_high"]
    assert one["geometric_sd_low"] < np.exp(np.log(truth).std()) < one["geometric_sd_high"]
    page = (result.save(tmp_path / "out") / "report.html").read_text("utf-8")
    assert page.count("<tr data-species") == 1
    assert '<th scope="col">diameter [nm]</th>' in page
