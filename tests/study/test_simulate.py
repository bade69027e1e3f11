"""Movies with known truth: bytes that repeat, counts that scatter as light does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from scenes import PIXEL_NM, make_config
from scipy.stats import kstest, norm

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.study import Movie, write_stack
from iscat_analysis.study.simulate import TRUTH_COLUMNS

SIGMAS = 5.0
TABLE = 1e-7  # the model's radial interpolation

SHAPE = (40, 44)
EVENT = {"frame": 5, "x_px": 17.3, "y_px": 21.8}


def _config(simulation: dict[str, Any] | None = None, **sections: Any) -> Config:
    values = {"shape": list(SHAPE), "frames": 12, "events": [EVENT]} | (simulation or {})
    sections.setdefault("background", {"frames": [0, 5]})
    sections.setdefault("fit", {"frames": None})
    return make_config(**sections, simulation=values)


def _counts(config: Config, seed: int = 1) -> np.ndarray:
    return np.stack(list(Movie(config, seed).frames())).astype(float)


# ---- the same seed ---------------------------------------------------------------------------


@pytest.mark.parametrize("background", ["flat", "speckle"])
def test_the_same_seed_writes_the_same_bytes(background: str, tmp_path: Path) -> None:
    simulation = {"background": background, "power_noise": 0.02, "frames": 70}
    camera = {"read_noise_e": 3.0}
    files = []
    for name, workers in (("a", 1), ("b", 1), ("c", 3)):
        config = _config(simulation, camera=camera, compute={"workers": workers})
        write_stack(config, tmp_path / f"{name}.tif", seed=9)
        content = (tmp_path / f"{name}.tif").read_bytes().replace(f"{name}.tif".encode(), b"")
        files.append((content, (tmp_path / f"{name}.truth.csv").read_bytes()))
    assert files[0] == files[1] == files[2]
    write_stack(_config(simulation, camera=camera), tmp_path / "d.tif", seed=10)
    assert (tmp_path / "d.tif").read_bytes() != files[0][0]


# ---- counts ----------------------------------------------------------------------------------


def test_counts_are_poisson() -> None:
    config = _config({"photons_per_pixel": 500.0, "frames": 200, "events": []})
    counts = _counts(config)
    pixels = counts.size
    assert abs(counts.mean() - 500) < SIGMAS * np.sqrt(500 / pixels)
    assert abs(counts.var() / 500 - 1) < SIGMAS * np.sqrt(2 / pixels)
    skewness = np.mean((counts - 500) ** 3) / 500**1.5
    assert abs(skewness - 500**-0.5) < SIGMAS * np.sqrt(6 / pixels)
    neighbours = (counts[:, :, 1:] - 500) * (counts[:, :, :-1] - 500) / 500
    successors = (counts[1:] - 500) * (counts[:-1] - 500) / 500
    for product in (neighbours, successors):
        assert abs(product.mean()) < SIGMAS / np.sqrt(product.size)


def test_camera_counts() -> None:
    camera = {"gain_e_per_adu": 2.5, "offset_adu": 110.0, "read_noise_e": 30.0}
    config = _config({"photons_per_pixel": 2000.0, "frames": 100, "events": []}, camera=camera)
    counts = _counts(config)
    variance = (2000 + 30**2) / 2.5**2 + 1 / 12
    assert abs(counts.mean() - (110 + 800)) < SIGMAS * np.sqrt(variance / counts.size)
    assert abs(counts.var() / variance - 1) < SIGMAS * np.sqrt(2 / counts.size)


def test_a_full_well_is_full() -> None:
    camera = {"well_depth_e": 2000.0}
    config = _config({"photons_per_pixel": 2000.0, "events": []}, camera=camera)
    counts = _counts(config)
    assert counts.max() == 2000
    assert 0.4 < np.mean(counts == 2000) < 0.6


@pytest.mark.parametrize("contrast", [0.02, 0.1, 0.3])
def test_speckle_has_its_contrast(contrast: float) -> None:
    simulation = {"background": "speckle", "speckle_contrast": contrast}
    background = Movie(_config(simulation), 1).background_e
    assert background.std() / background.mean() == pytest.approx(contrast, rel=0.03)
    assert background.mean() == pytest.approx(1e4, rel=0.01)
    centred = background - background.mean()
    neighbours = np.mean(centred[:, 1:] * centred[:, :-1]) / centred.var()
    assert 0.3 < neighbours < 0.95  # grains, not white noise
    assert not np.array_equal(background, Movie(_config(simulation), 2).background_e)


def test_laser_power_multiplies_the_light() -> None:
    simulation = {"power_noise": 0.03, "frames": 2000, "events": [], "shape": [8, 8]}
    movie = Movie(_config(simulation), 4)
    power, frames = movie.power, movie.expected_frames()
    assert kstest((power - 1) / 0.03, norm.cdf).pvalue > 1e-4
    assert abs(np.corrcoef(power[1:], power[:-1])[0, 1]) < SIGMAS / np.sqrt(2000)
    first, second = next(frames), next(frames)
    np.testing.assert_allclose(second / power[1], first / power[0], rtol=1e-12)
    np.testing.assert_array_equal(Movie(_config(simulation | {"power_noise": 0.0}), 4).power, 1.0)


def test_the_background_may_be_an_image(tmp_path: Path) -> None:
    image = np.random.default_rng(3).uniform(1, 3, SHAPE)
    path = tmp_path / "background.tif"
    tifffile.imwrite(path, image, photometric="minisblack")
    background = Movie(_config({"background": str(path)}), 1).background_e
    np.testing.assert_allclose(background, 1e4 * image / image.mean())


# ---- particles -------------------------------------------------------------------------------


def _signal(config: Config, x_px: float, y_px: float, z_nm: float, mass: float) -> np.ndarray:
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    model = forward_model(config, grid.diagonal_nm + PIXEL_NM, z_max_nm=500.0)
    return model.image(grid, x_px * PIXEL_NM, y_px * PIXEL_NM, z_nm, mass)


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("psi", [0.0, 35.0])
def test_images_are_the_models(samples: int, psi: float) -> None:
    config = _config(
        {"events": [EVENT | {"z_nm": 220.0, "mass_kda": 1500.0}]},
        camera={"samples_per_pixel": samples},
        optics={"polarization_deg": psi},
    )
    frames = list(Movie(config, 1).expected_frames())
    signal = _signal(config, 17.3, 21.8, 220.0, 1500.0)
    np.testing.assert_allclose(frames[4], 1e4)
    np.testing.assert_allclose(frames[5], 1e4 * (1 + signal), rtol=TABLE)
    np.testing.assert_array_equal(frames[5], frames[11])


def test_an_analyser_leaves_one_component() -> None:
    """Of gold, whose square matters: the light across the reference is gone, not counted twice."""
    options: dict[str, Any] = {
        "calibrated": False, "optics": {"analyzer": True},
        "particle": {"kind": "gold", "mass_kda": None, "diameter_nm": 60.0},
    }  # fmt: skip
    frame = list(Movie(_config(**options), 1).expected_frames())[5]
    mass = forward_model(_config(**options), 6000.0).material.mass_kda
    signal = _signal(_config(**options), 17.3, 21.8, 5.0, mass)
    np.testing.assert_allclose(frame, 1e4 * (1 + signal), rtol=TABLE)


def test_pixels_integrate() -> None:
    """Nine samples inside a pixel against the plain mean of a fine grid."""
    config = _config({"events": [EVENT]}, camera={"samples_per_pixel": 3})
    frame = list(Movie(config, 1).expected_frames())[5] / 1e4 - 1
    fine = 15
    axis = (np.arange(fine) + 0.5) / fine - 0.5
    model = forward_model(_config(), 6000.0)
    rows, columns = 22, 18
    dx, dy = np.meshgrid((columns + axis - 17.3) * PIXEL_NM, (rows + axis - 21.8) * PIXEL_NM)
    field = model.field(dx, dy, 5.0, 1000.0)
    mean = np.mean(np.abs(1 + field[0]) ** 2 + np.abs(field[1]) ** 2) - 1
    assert frame[rows, columns] == pytest.approx(mean, rel=2e-3)


def test_fields_add_before_they_are_squared() -> None:
    """Two strong particles near each other interfere; their images do not simply add."""
    gold = {"kind": "gold", "mass_kda": None, "diameter_nm": 60.0}
    events = [EVENT, EVENT | {"x_px": 19.0}]
    options = {"calibrated": False, "particle": gold, "camera": {"samples_per_pixel": 1}}
    both, one, two = (
        list(Movie(_config({"events": chosen}, **options), 1).expected_frames())[5] / 1e4
        for chosen in (events, events[:1], events[1:])
    )
    model = forward_model(_config(**options), 6000.0)
    y, x = np.indices(SHAPE) * PIXEL_NM
    mass = model.material.mass_kda
    field = sum(
        model.field(x - e["x_px"] * PIXEL_NM, y - e["y_px"] * PIXEL_NM, 5.0, mass) for e in events
    )
    expected = np.abs(1 + field[0]) ** 2 + np.abs(field[1]) ** 2
    np.testing.assert_allclose(both, expected, rtol=TABLE)
    assert np.abs(both - (one + two - 1)).max() > 0.1


def test_particles_come_and_leave() -> None:
    config = _config({"events": [EVENT | {"leave": 9}]})
    frames = np.array(list(Movie(config, 1).expected_frames()))
    present = np.abs(frames - 1e4).max(axis=(1, 2)) > 1
    assert np.flatnonzero(present).tolist() == [5, 6, 7, 8]
    np.testing.assert_allclose(frames[9:], 1e4, rtol=1e-12)


def test_a_sample_that_drifts_takes_its_particles_along() -> None:
    """After 20 frames it has moved by whole pixels, so that two frames can be compared."""
    event = {"frame": 5, "x_px": 12.3, "y_px": 13.1}
    movie = Movie(
        _config({"drift_px_per_frame": [0.1, -0.05], "background": "speckle", "frames": 30,
                 "shape": [32, 36], "events": [event]}), 3,
    )  # fmt: skip
    frames = np.array([f / p for f, p in zip(movie.expected_frames(), movie.power, strict=True)])
    np.testing.assert_allclose(frames[26][:-1, 2:], frames[6][1:, :-2], rtol=1e-9)
    np.testing.assert_allclose(frames[0], movie.background_e, rtol=1e-12)
    still = Movie(_config({"events": [event], "frames": 8, "shape": [32, 36]}), 3)
    expected = np.array(list(still.expected_frames()))
    with np.errstate(all="raise"):
        contrast = expected[5] / expected[0] - 1
    before = Movie(_config({**movie._config.simulation.model_dump(), "events": []}), 3)
    empty = list(before.expected_frames())[5] / before.power[5]
    found = frames[5] / empty - 1
    assert np.abs(found - contrast).max() < 0.02 * np.abs(contrast).max()
    assert movie.truth["x_px"][0] == 12.3


def test_a_measured_background_goes_on_as_its_reflection(tmp_path: Path) -> None:
    path = tmp_path / "background.tif"
    y, x = np.indices((32, 32))
    tifffile.imwrite(path, (1000 + 5 * x + 100 * np.cos(y / 3)).astype("f4"))
    simulation = {"background": str(path), "shape": [32, 32], "frames": 20, "events": []}
    still = Movie(_config(simulation), 1).background_e
    movie = Movie(_config({**simulation, "drift_px_per_frame": [0.5, 0.0]}), 1)
    last = list(movie.expected_frames())[10] / movie.power[10]
    np.testing.assert_allclose(last[:, 5:], still[:, :-5], rtol=1e-9)
    np.testing.assert_allclose(last[:, :5], still[:, 4::-1], rtol=1e-9)


def test_dark_field_counts_the_collected_photons() -> None:
    """All the light of a particle, on a field wide enough, is what was asked for."""
    event = EVENT | {"x_px": 100.0, "y_px": 99.4}
    simulation = {"photons_per_pixel": 5e4, "events": [event], "shape": [200, 200]}
    config = _config(
        simulation,
        calibrated=False,
        optics={"scheme": "darkfield", "focus_nm": 0.0, "na": 1.2},
        particle={"kind": "gold", "mass_kda": None, "diameter_nm": 30.0},
        background={"level_e": 7.0, "frames": [0, 5]},
    )
    frames = list(Movie(config, 1).expected_frames())
    np.testing.assert_allclose(frames[0], 7.0)
    collected = (frames[5] - 7).sum()
    assert 0.97 * 5e4 < collected < 5e4
    assert Movie(config, 1).truth["contrast"].isna().all()


# ---- random particles ------------------------------------------------------------------------


def test_random_particles() -> None:
    simulation = {
        "events": [], "count": 90, "leavings": 30, "species": [100.0, 200.0, 300.0], "frames": 900,
        "shape": [128, 128],
    }  # fmt: skip
    truth = Movie(_config(simulation), 3).truth
    assert truth["mass_kda"].value_counts().to_dict() == {100.0: 30, 200.0: 30, 300.0: 30}
    assert truth["leave"].notna().sum() == 30
    assert (truth["frame"] >= 5).all()
    assert truth["frame"].is_monotonic_increasing
    left = truth.dropna(subset="leave")
    assert (left["leave"] > left["frame"]).all()
    for column in ("x_px", "y_px"):
        assert truth[column].between(15, 112).all()
        scaled = (truth[column] - 16) / (127 - 32)
        assert kstest(scaled, "uniform").pvalue > 1e-4
    other = Movie(_config(simulation), 4).truth
    assert not truth["x_px"].equals(other["x_px"])


# ---- files -----------------------------------------------------------------------------------


def test_the_movie_says_its_units_and_truth_lies_beside_it(tmp_path: Path) -> None:
    events = [EVENT, EVENT | {"leave": 9, "mass_kda": 300.0, "x_px": 3.25}]
    config = _config({"events": events}, camera={"frame_rate_hz": 250.0})
    returned = write_stack(config, tmp_path / "movie.tif")
    with tifffile.TiffFile(tmp_path / "movie.tif") as file:
        assert file.is_ome
        assert file.series[0].shape == (12, *SHAPE)
        assert file.series[0].dtype == np.uint16
        assert 'PhysicalSizeX="0.0844"' in file.ome_metadata
        assert 'TimeIncrement="0.004"' in file.ome_metadata
    truth = pd.read_csv(tmp_path / "movie.truth.csv")
    assert tuple(truth.columns) == TRUTH_COLUMNS
    assert len(returned) == 2
    assert truth["x_px"].tolist() == [17.3, 3.25]
    np.testing.assert_allclose(truth["x_nm"], truth["x_px"] * PIXEL_NM)
    assert truth["leave"].isna().tolist() == [True, False]
    # One calibrated contrast: gradient times mass.
    np.testing.assert_allclose(truth["contrast"], -3.1e-5 * truth["mass_kda"], rtol=1e-6)


def test_nothing_is_overwritten_or_left_half_done(tmp_path: Path) -> None:
    config = _config()
    path = tmp_path / "movie.tif"
    write_stack(config, path)
    before = path.read_bytes()
    with pytest.raises(DataError, match="pass `overwrite`"):
        write_stack(config, path, seed=2)
    assert path.read_bytes() == before
    write_stack(config, path, seed=2, overwrite=True)
    assert path.read_bytes() != before

    def broken(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_stack(config, tmp_path / "other.tif", progress=broken)
    assert {p.name for p in tmp_path.iterdir()} == {"movie.tif", "movie.truth.csv"}


def test_counts_beyond_16_bits_and_drifts_out_of_sight_are_refused() -> None:
    with pytest.raises(ConfigError, match="16 bits"):
        Movie(_config({"photons_per_pixel": 7e4}, camera={"gain_e_per_adu": 1.0}), 1)
    Movie(_config({"photons_per_pixel": 7e4}, camera={"gain_e_per_adu": 2.0}), 1)
    with pytest.raises(ConfigError, match="out of a field of"):
        Movie(_config({"drift_px_per_frame": [5.0, 0.0], "frames": 100}), 1)
