"""Counts to photoelectrons, the checks on both, and the gain that the noise itself shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from iscat_analysis.camera import (
    Camera,
    GainDiagnosis,
    camera_from_config,
    check_counts,
    diagnose_gain,
    refuse_ratio,
    resolve_metadata,
)
from iscat_analysis.config import CameraConfig, parse_config
from iscat_analysis.errors import DataError
from iscat_analysis.records import StackMetadata

SHAPE = (6, 8)
STANDARD_ERRORS = 4.0  # a true value lies further away once in 16 000 times


# --- camera ------------------------------------------------------------------------------------


def test_electrons() -> None:
    camera = Camera(gain_e_per_adu=2.5, offset_adu=100.0)
    counts = np.array([[[100, 104], [90, 65535]]], dtype="u2")
    electrons = camera.to_electrons(counts)
    assert electrons.dtype == np.float64
    np.testing.assert_array_equal(electrons, [[[0, 10], [-25, 163587.5]]])
    assert counts[0, 0, 1] == 104
    gain, offset = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[0.0, 1.0], [2.0, 3.0]])
    maps = Camera(gain_e_per_adu=gain, offset_adu=offset)
    np.testing.assert_array_equal(
        maps.to_electrons(np.full((3, 2, 2), 5.0)), [[[5, 8], [9, 8]]] * 3
    )


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        (Camera(), [False, False, False]),
        (Camera(full_scale_adu=65535.0), [False, False, True]),
        (Camera(well_depth_e=200.0), [False, True, True]),
        (Camera(gain_e_per_adu=2.0, offset_adu=50.0, well_depth_e=300.0), [False, True, True]),
        (Camera(gain_e_per_adu=2.0, offset_adu=50.0, well_depth_e=300.1), [False, False, True]),
    ],
)
def test_saturation(camera: Camera, expected: list[bool]) -> None:
    counts = np.array([[10, 200, 65535]], dtype="u2")
    found = camera.saturated(counts)
    assert found.dtype == np.bool_
    np.testing.assert_array_equal(found, [expected])


def test_read_variance() -> None:
    np.testing.assert_array_equal(
        Camera(read_noise_e=3.0).read_variance_e2((2, 2)), np.full((2, 2), 9)
    )
    noise = np.array([[1.0, 2.0]])
    np.testing.assert_array_equal(Camera(read_noise_e=noise).read_variance_e2((1, 2)), [[1, 4]])


@pytest.mark.parametrize(
    ("dtype", "full_scale"), [("u1", 255), ("u2", 65535), ("i2", 32767), ("f4", None)]
)
def test_full_scale_is_the_largest_integer(dtype: str, full_scale: float | None) -> None:
    camera = camera_from_config(CameraConfig(well_depth_e=9.0), SHAPE, np.dtype(dtype))
    assert camera.full_scale_adu == full_scale
    assert camera.well_depth_e == 9.0


def test_maps_are_read(tmp_path: Path) -> None:
    values = np.random.default_rng(1).uniform(1, 2, SHAPE)
    for key in ("gain", "offset", "noise"):
        tifffile.imwrite(tmp_path / f"{key}.tif", values)
    config = CameraConfig(
        gain_e_per_adu=str(tmp_path / "gain.tif"),
        offset_adu=str(tmp_path / "offset.tif"),
        read_noise_e=str(tmp_path / "noise.tif"),
    )
    camera = camera_from_config(config, SHAPE, np.uint16)
    np.testing.assert_array_equal(camera.gain_e_per_adu, values)
    np.testing.assert_array_equal(camera.offset_adu, values)
    np.testing.assert_array_equal(camera.read_noise_e, values)


def _with(value: float) -> np.ndarray:
    values = np.ones(SHAPE)
    values[2, 3] = value
    return values


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("gain_e_per_adu", np.ones((6, 7)), "6 x 7 pixels but the movie has 6 x 8"),
        ("gain_e_per_adu", _with(np.nan), "not finite in 1 pixel, the first at y = 2, x = 3"),
        ("gain_e_per_adu", _with(0), "must be positive"),
        ("gain_e_per_adu", np.ones(SHAPE, "c8"), "real numbers"),
        ("offset_adu", _with(np.inf), "not finite"),
        ("read_noise_e", _with(-1), "must not be negative"),
    ],
)
def test_impossible_maps_are_refused(
    tmp_path: Path, key: str, values: np.ndarray, message: str
) -> None:
    path = tmp_path / "map.tif"
    tifffile.imwrite(path, values)
    with pytest.raises(DataError, match=message) as error:
        camera_from_config(CameraConfig(**{key: str(path)}), SHAPE, np.uint16)
    assert f"{path}: camera.{key}" in str(error.value)


def test_unreadable_maps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.tif"
    with pytest.raises(DataError, match="does not exist"):
        camera_from_config(CameraConfig(gain_e_per_adu=str(path)), SHAPE, np.uint16)
    path.write_text("no TIFF")
    with pytest.raises(DataError, match="cannot be read"):
        camera_from_config(CameraConfig(gain_e_per_adu=str(path)), SHAPE, np.uint16)


# --- metadata ----------------------------------------------------------------------------------


def test_metadata_fills_what_is_absent() -> None:
    config = parse_config({"camera": {"exposure_ms": 5.0}})
    resolved, notes = resolve_metadata(config, StackMetadata(84.4, 5.04, 200.0, source="ome"))
    assert resolved.camera.pixel_size_nm == 84.4
    assert resolved.camera.exposure_ms == 5.0
    assert resolved.camera.frame_rate_hz == 200.0
    assert notes == []
    assert config.camera.pixel_size_nm is None


def test_the_configuration_wins_and_says_so() -> None:
    config = parse_config({"camera": {"pixel_size_nm": 84.4, "frame_rate_hz": 100.0}})
    resolved, notes = resolve_metadata(config, StackMetadata(50.0, None, 102.0, source="imagej"))
    assert resolved.camera.pixel_size_nm == 84.4
    assert len(notes) == 2
    assert [note.code for note in notes] == ["metadata-disagrees"] * 2
    assert notes[0].text.startswith("the pixel size is 84.4 nm in the configuration")
    assert "50 nm in the movie's imagej metadata" in notes[0].text
    assert "frame rate" in notes[1].text


@pytest.mark.parametrize("size_nm", [6.5e6, 6500.0, 0.0844])
def test_a_pixel_size_that_no_microscope_has_is_refused(size_nm: float) -> None:
    with pytest.raises(DataError, match=r"ome metadata.*sample plane.*as in camera\.pixel_size"):
        resolve_metadata(parse_config({}), StackMetadata(size_nm, source="ome"))


@pytest.mark.parametrize(
    ("size_nm", "said"), [(84.4, ""), (184.0, ""), (186.0, "not resolved; unless it was binned")]
)
def test_pixels_larger_than_a_spot_are_named(size_nm: float, said: str) -> None:
    config = parse_config({"camera": {"pixel_size_nm": size_nm}})  # 525 nm, NA 1.42
    _, notes = resolve_metadata(config, StackMetadata())
    assert [said in note.text for note in notes] == [True] * bool(said)


def test_pixels_twice_as_large_as_a_spot_are_refused_wherever_they_come_from() -> None:
    """One micrometre, as in files that nobody calibrated: every row was a poor fit."""
    with pytest.raises(DataError, match=r"1000 nm, as in the movie's ome metadata, .* 185 nm"):
        resolve_metadata(parse_config({}), StackMetadata(1000.0, source="ome"))
    with pytest.raises(DataError, match=r"1000 nm, as in the configuration, .*give its size in"):
        resolve_metadata(parse_config({"camera": {"pixel_size_nm": 1000.0}}), StackMetadata())


def test_a_pixel_size_is_needed() -> None:
    with pytest.raises(DataError, match=r"set camera\.pixel_size_nm, as in camera") as error:
        resolve_metadata(parse_config({}), StackMetadata())
    assert error.value.exit_status == 1


# --- frames ------------------------------------------------------------------------------------


def good(dtype: str = "u2") -> np.ndarray:
    return np.random.default_rng(2).poisson(1000, (4, 20, 20)).astype(dtype)


@pytest.mark.parametrize("dtype", ["u2", "i4", "f4", "f8"])
def test_good_counts_pass(dtype: str) -> None:
    check_counts(good(dtype), 0, "m.tif")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, "frame 12 is NaN or infinite in 1 pixel, the first at y = 3, x = 5"),
        (np.inf, "frame 12 is NaN or infinite"),
        (-1.0, "frame 12 lies below the camera's offset"),
    ],
)
def test_impossible_counts_are_refused(value: float, message: str) -> None:
    counts = good("f8")
    counts[2, 3, 5] = value
    with pytest.raises(DataError, match=f"m.tif: {message}"):
        check_counts(counts, 10, "m.tif")


def test_of_pixels_that_are_no_number_in_every_frame_it_is_said_what_to_do() -> None:
    counts = good("f8")
    counts[:, :, :2] = np.nan
    with pytest.raises(DataError, match=r"in 40 pixels, .* crop the movie, or set these pixels"):
        check_counts(counts, 0, "m.tif")
    counts[1:] = 1000.0
    with pytest.raises(DataError, match=r"in 40 pixels, .*; leave the frame out"):
        check_counts(counts, 0, "m.tif")


def test_frames_without_information_are_refused() -> None:
    counts = good()
    counts[1] = 0
    with pytest.raises(DataError, match="frame 1 is zero throughout"):
        check_counts(counts, 0, "m.tif")
    counts[1] = 65535
    with pytest.raises(DataError, match="frame 1 is saturated throughout"):
        check_counts(counts, 0, "m.tif")
    counts = good()
    counts[3] = 1501
    camera = Camera(gain_e_per_adu=2.0, well_depth_e=2500.0)
    with pytest.raises(DataError, match="frame 3 is saturated throughout"):
        check_counts(counts, 0, "m.tif", camera=camera)
    counts[3] = good()[3] + 500
    with pytest.raises(DataError, match=r"frame 3 has .* counts, all beyond .* but they differ"):
        check_counts(counts, 0, "m.tif", camera=camera)


def test_ratios_are_refused_and_scaled_counts_are_not() -> None:
    """A ratio of frames, and the same floats where a gain says what a count of 1 stands for."""
    rng = np.random.default_rng(7)
    ratio = (rng.poisson(1e4, (4, 20, 20)) / rng.poisson(1e4, (4, 20, 20))).astype("f4")
    with pytest.raises(DataError, match=r"frame 5 is ratiometric.*raw counts"):
        check_counts(ratio, 5, "m.tif")
    with pytest.raises(DataError, match=r"frame 5 is ratiometric \(floats around 0\)"):
        refuse_ratio(ratio[0] - 1, "frame 5", Camera())
    with pytest.raises(DataError, match=r"frame 5 is ratiometric \(floats around 0\)"):
        refuse_ratio(ratio[0] - 0.98, "frame 5", Camera())  # its level was not divided out
    refuse_ratio(ratio[0] - 1, "a dark", Camera(gain_e_per_adu=1e4))
    check_counts(ratio, 5, "m.tif", camera=Camera(gain_e_per_adu=1e4))
    check_counts(good("f4") / 10, 5, "m.tif")  # floats around 100
    check_counts(rng.poisson(1.0, (4, 20, 20)), 5, "m.tif")  # dark field, in whole numbers


def test_read_noise_around_the_offset_passes() -> None:
    noise = np.random.default_rng(3).normal(100, 2, (4, 20, 20))
    check_counts(np.rint(noise).astype("u2"), 0, "m", camera=Camera(1.0, 100.0, 2.0))
    with pytest.raises(DataError, match=r"correct camera\.offset_adu"):
        check_counts(np.rint(noise).astype("u2"), 0, "m", camera=Camera(1.0, 120.0, 2.0))


def test_a_dead_pixel_is_left_to_the_mask() -> None:
    counts = good()
    counts[:, 4, 4] = 0
    check_counts(counts, 0, "m", camera=Camera(1.0, 100.0, 2.0))


def test_maps_decide_pixel_by_pixel() -> None:
    offset = np.zeros((20, 20))
    offset[:10] = 2000
    with pytest.raises(DataError, match="frame 0 lies below"):
        check_counts(good(), 0, "m", camera=Camera(offset_adu=offset))


# --- gain --------------------------------------------------------------------------------------


def recorded(
    seed: int,
    *,
    gain: float = 1.0,
    frames: int = 40,
    power_noise: float = 0.01,
    read_noise_e: float = 0.0,
    offset: float = 100.0,
    electrons: float = 4000.0,
) -> np.ndarray:
    """Speckled background as a camera of a given gain records it [counts]."""
    rng = np.random.default_rng(seed)
    speckle = electrons * np.clip(rng.normal(1, 0.1, (24, 24)), 0.5, 1.5)
    power = 1 + power_noise * rng.normal(size=(frames, 1, 1))
    signal = rng.poisson(power * speckle) + read_noise_e * rng.normal(size=(frames, 24, 24))
    return offset + signal / gain


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("gain", [0.25, 1.0, 4.0])
def test_gain_is_measured(seed: int, gain: float) -> None:
    counts = recorded(seed, gain=gain)
    found = diagnose_gain(counts, Camera(gain_e_per_adu=1.0, offset_adu=100.0))
    assert abs(found.gain_e_per_adu - gain) < STANDARD_ERRORS * found.gain_se
    assert found.gain_se < 0.02 * gain
    assert found.noise_ratio == pytest.approx(1 / gain, rel=0.05)
    assert found.off == (gain != 1.0)
    assert (found.n_frames, found.n_pixels) == (40, 576)


def test_the_message_names_the_remedy() -> None:
    camera = Camera(offset_adu=100.0)
    found = diagnose_gain(recorded(1, gain=0.25), camera).finding
    assert found is not None
    assert "times what camera.gain_e_per_adu = 1 predicts" in found.text
    assert "unless the light itself is noisy" in found.remedy
    assert float(found.remedy.rsplit(" = ")[-1]) == pytest.approx(0.25, rel=0.05)
    found = diagnose_gain(recorded(1, gain=4.0), camera).finding
    assert found is not None
    assert "noisy" not in found.text
    assert diagnose_gain(recorded(1), camera).finding is None


def _pulls(trials: int, truth: float, **settings: float) -> np.ndarray:
    camera = Camera(offset_adu=100.0, read_noise_e=settings.get("read_noise_e", 0.0))
    pulls = []
    for seed in range(trials):
        found = diagnose_gain(recorded(seed, frames=12, **settings), camera)
        pulls.append((found.noise_ratio - truth) / found.noise_ratio_se)
    return np.array(pulls)


def _is_standard(pulls: np.ndarray) -> bool:
    """Whether pulls have mean 0 and spread 1, within their own standard errors."""
    n = len(pulls)
    mean_off = abs(pulls.mean()) * np.sqrt(n)
    spread_off = abs(pulls.std(ddof=1) - 1) * np.sqrt(2 * (n - 1))
    return bool(mean_off < STANDARD_ERRORS and spread_off < STANDARD_ERRORS)


@pytest.mark.parametrize("settings", [{}, {"read_noise_e": 30.0}, {"power_noise": 0.05}])
def test_the_standard_error_is_honest(settings: dict) -> None:
    assert _is_standard(_pulls(200, 1.0, **settings))


def test_the_check_notices_two_percent() -> None:
    assert not _is_standard(_pulls(200, 1.02))


def test_the_lost_degree_of_freedom_counts_where_few_pixels_hold_the_light() -> None:
    rng = np.random.default_rng(5)
    light = np.array([[4000.0, 1000.0, 500.0, 500.0]])
    counts = rng.poisson(light * (1 + 0.01 * rng.normal(size=(4000, 1, 1)))).astype(float)
    used = light.ravel() / light.sum()
    lost = float(np.sum(used**2))
    found = diagnose_gain(counts, Camera())
    standard_error = np.sqrt(3 / 4000)  # of the brightest pixel alone, so an upper limit
    assert abs(found.noise_ratio - 1) < STANDARD_ERRORS * standard_error
    assert lost > 2 * STANDARD_ERRORS * standard_error  # without the correction it would fail


def test_without_power_normalisation_the_gain_would_be_wrong() -> None:
    counts = recorded(7) - 100.0
    naive = np.square(np.diff(counts, axis=0)).mean() / 2 / counts.mean()
    found = diagnose_gain(counts, Camera())
    assert abs(found.noise_ratio - 1) < STANDARD_ERRORS * found.noise_ratio_se
    assert abs(naive - 1) > 10 * found.noise_ratio_se


def test_read_noise_left_out_is_seen() -> None:
    counts = recorded(8, read_noise_e=60.0)
    unaware = diagnose_gain(counts, Camera(offset_adu=100.0))
    aware = diagnose_gain(counts, Camera(offset_adu=100.0, read_noise_e=60.0))
    assert unaware.noise_ratio == pytest.approx(1.9, rel=0.05)
    assert abs(aware.noise_ratio - 1) < STANDARD_ERRORS * aware.noise_ratio_se


def test_bad_pixels_do_not_matter() -> None:
    counts = recorded(9)
    counts[:, 3, 3] += np.where(np.arange(40) % 3 == 0, 3000.0, 0.0)  # blinks
    counts[:, 5, 5] = 65535  # saturated
    counts[:, 6, 6] = 0  # dead
    masked = np.zeros((24, 24), dtype=bool)
    masked[:2] = True
    counts[:, :2] *= 1 + 0.5 * np.random.default_rng(1).normal(size=(40, 2, 24))
    camera = Camera(offset_adu=100.0, full_scale_adu=65535.0)
    found = diagnose_gain(counts, camera, masked=masked)
    assert abs(found.noise_ratio - 1) < STANDARD_ERRORS * found.noise_ratio_se
    assert found.n_pixels == 24 * 22 - 3


def test_a_gain_map_is_scaled() -> None:
    gain = np.linspace(1, 3, 576).reshape(24, 24)
    counts = 100 + (recorded(10) - 100) / gain
    found = diagnose_gain(counts, Camera(gain_e_per_adu=2 * gain, offset_adu=100.0))
    assert found.configured_gain == pytest.approx(4.0)
    assert found.gain_e_per_adu == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        (np.ones((1, 4, 4)), "two background frames or more"),
        (np.zeros((5, 4, 4)), "no pixel is lit"),
        (np.full((5, 4, 4), 50.0), "no noisier than"),
        (np.concatenate([np.full((4, 4, 4), 50.0), np.zeros((1, 4, 4))]), "frame 4 is dark"),
    ],
)
def test_unusable_backgrounds_are_refused(counts: np.ndarray, message: str) -> None:
    with pytest.raises(DataError, match=message):
        diagnose_gain(counts, Camera())


def test_a_small_excess_with_a_large_error_is_not_reported() -> None:
    assert not GainDiagnosis(1.3, 0.1, 1.0, 1 / 1.3, 0.06, 3, 20).off
    assert GainDiagnosis(1.3, 0.01, 1.0, 1 / 1.3, 0.006, 100, 1000).off
    assert not GainDiagnosis(1.09, 0.001, 1.0, 1 / 1.09, 0.001, 100, 1000).off
