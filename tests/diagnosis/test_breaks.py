"""Where movies break: named, left out, and the rest as if nothing had happened."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import make_config
from scipy.ndimage import fourier_shift

import iscat_analysis as ia
from iscat_analysis.camera import Camera, check_counts
from iscat_analysis.camera.background import boxes_of, find_text
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import find_stretches
from iscat_analysis.diagnosis.frames import channels_of
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline.finish import look_at
from iscat_analysis.schemas.fit import LeftOut, Timeline
from iscat_analysis.study import Movie

Counts = NDArray[np.uint16]

SIDE, FRAMES, GAIN = 64, 320, 4.0
EVENTS = [
    {"frame": frame, "x_px": x, "y_px": y, "mass_kda": 500.0}
    for frame, x, y in ((50, 20.3, 40.2), (100, 44.6, 22.1), (230, 41.2, 45.0), (290, 18.0, 26.0))
]


def _config(**changes: dict) -> Config:
    sections = {
        "background": {"method": "sliding", "frames": None, "window_frames": 20},
        "fit": {"frames": None, "roi_nm": 1300.0},
        "optics": {"calibrate": "never", "focus_nm": -300.0},
        "camera": {"gain_e_per_adu": "auto", "offset_adu": 0.0, "read_noise_e": 0.0},
        "simulation": {
            "shape": [SIDE, SIDE], "frames": FRAMES, "photons_per_pixel": 1e5,
            "background": "speckle", "events": EVENTS,
        },
    }  # fmt: skip
    return make_config(**{name: sections.get(name, {}) | changes.get(name, {}) for name in
                          {*sections, *changes}})  # fmt: skip


def _expected(config: Config, seed: int) -> NDArray[np.float64]:
    """Give the light of a movie, whose camera the analysis has to learn."""
    camera = config.camera.model_copy(update={"gain_e_per_adu": GAIN})
    movie = Movie(config.model_copy(update={"camera": camera}), seed)
    return np.array(list(movie.expected_frames()))


@cache
def _light(seed: int) -> NDArray[np.float64]:
    return _expected(_config(), seed)


def _counted(light: NDArray[np.float64], seed: int = 1) -> Counts:
    electrons = np.random.default_rng(seed).poisson(light)
    return np.round(electrons / GAIN).astype(np.uint16)


def _joined() -> Counts:
    other = _light(2)
    return _counted(np.concatenate([_light(1)[: FRAMES // 2], other[FRAMES // 2 :]]))


def _lamp() -> Counts:
    light = _light(1).copy()
    light[140:200] += 0.3 * light.mean()
    return _counted(light)


def _exchanged() -> Counts:
    turned = np.clip((np.arange(FRAMES) - 140) / 40, 0, 1)[:, None, None]
    light = _light(1) * (1 - turned) + _light(1) * (_light(2)[0] / _light(1)[0]) * turned
    return _counted(light)


def _passing() -> Counts:
    y, x = np.indices((SIDE, SIDE))
    light = _light(1).copy()
    for frame in range(130, 210):
        away = np.hypot(x - (frame - 170) - 32, y - 30)
        light[frame] *= 1 + 0.3 * np.exp(-((away / 14) ** 2)) * np.cos(away / 2)
    return _counted(light)


@pytest.mark.parametrize(
    ("make", "cause", "start", "stop", "found"),
    [
        (_joined, "another pattern", 160, 160, (50, 100, 230, 290)),
        (_lamp, "more light", 140, 200, (50, 100, 230, 290)),
        (_exchanged, "becomes another one", 128, 196, (50, 100, 230, 290)),
        (_passing, "something large", 112, 228, (50, 100, 230, 290)),
    ],
)
def test_a_break_is_named_left_out_and_the_rest_is_right(
    make: Callable[[], Counts], cause: str, start: int, stop: int, found: tuple[int, ...]
) -> None:
    result = ia.fit_movie(make(), config=_config())
    left_out = result.summary["left_out"]
    (one,) = left_out["breaks"]
    assert cause in one["cause"]
    assert start <= one["start"] <= one["stop"] <= stop
    assert (one["stop"] > one["start"]) == (stop > start)
    assert any(cause in text for text in result.warnings)
    assert not [text for text in result.warnings if "move rather than land" in text]
    table = result.table
    assert list(table["status"]) == ["ok"] * len(found)
    assert np.abs(table["frame"].to_numpy() - np.array(found)).max() <= 2
    pulls = (table["mass_kda"] - 500) / table["sigma_mass_kda"]
    assert np.abs(pulls).max() < 4.5  # of sixteen
    light = result.analysis.power
    assert np.isnan(light[one["start"] : one["stop"]]).all()
    timeline = result.summary["timeline"]
    assert any(each["start"] == one["start"] for each in timeline["intervals"])
    assert sum(timeline["events"]["ok"]) == len(found)
    for model, said in ((LeftOut, left_out), (Timeline, timeline)):
        assert model.model_validate(said).model_dump(mode="json") == said
    course = result.figure("course").data["course"]
    rows = dict.fromkeys(name.split()[0].strip(",") for name in course["series"])
    assert list(rows) == ["light", "noise", "focus", "drift", "events"]
    assert 0 <= min(course["frame"]) < max(course["frame"]) <= FRAMES


def test_frames_are_left_out_where_somebody_says() -> None:
    fit = {"roi_nm": 1300.0, "excluded_frames": [[110, 130], [80, 115]]}
    result = ia.fit_movie(_counted(_light(1)), config=_config(fit=fit))
    (one,) = result.summary["left_out"]["breaks"]
    assert (one["start"], one["stop"]) == (80, 130)
    assert "excluded" in one["cause"]
    assert result.summary["left_out"]["analysed"] == [[0, 80], [130, FRAMES]]
    assert np.abs(result.table["frame"].to_numpy() - np.array([50, 230, 290])).max() <= 2
    assert list(result.table["status"]) == ["ok"] * 3


def test_frames_are_left_out_of_landing_movies_only() -> None:
    movie = _counted(_light(1)[:60])
    with pytest.raises(DataError, match="excluded_frames leaves no"):
        ia.fit_movie(movie, config=_config(fit={"excluded_frames": [[4, 56]]}))
    fixed = {"method": "fixed", "frames": [0, 30], "window_frames": None}
    with pytest.raises(ConfigError, match="of landing movies only"):
        ia.fit_movie(movie, config=_config(background=fixed, fit={"excluded_frames": [[40, 50]]}))


@pytest.mark.parametrize(
    "kind", ["quiet", "drift", "landings", "heavy", "bright", "flicker", "dark"]
)
def test_what_is_no_break(kind: str) -> None:
    light = _light(1).copy()
    y, x = np.indices((SIDE, SIDE))
    rng = np.random.default_rng(8)
    if kind == "drift":  # a steady one, of 0.8 pixels
        wave = np.fft.fft2(light[0])
        light = np.array([np.fft.ifft2(fourier_shift(wave, (0.0025 * f, 0))).real for f in
                          range(FRAMES)])  # fmt: skip
    if kind == "landings":  # crowded, everywhere and all the time
        for frame in range(10, FRAMES, 3):
            a, b = rng.uniform(0, SIDE, 2)
            light[frame:] *= 1 - 0.01 * np.exp(-((y - a) ** 2 + (x - b) ** 2) / 4)
    if kind == "heavy":  # one of 30 %, with rings
        away = np.hypot(x - 30, y - 34)
        light[150:] *= 1 - 0.3 * np.exp(-away / 5) * np.cos(away / 1.5)
    if kind == "bright":  # a dozen of 10 %, whose rings reach over the field
        for _ in range(12):
            a, b = rng.uniform(0, SIDE, 2)
            away = np.hypot(y - a, x - b)
            light[rng.integers(FRAMES) :] *= 1 - 0.1 * np.exp(-away / 5) * np.cos(away / 1.5)
    if kind == "flicker":
        light *= rng.uniform(0.7, 1.3, (FRAMES, 1, 1))
    if kind == "dark":
        light[90:140] = 1.0
    stretches = find_stretches(ia.open_stack(_counted(light)), (0, FRAMES))
    assert not stretches.breaks
    assert stretches.kept == ((0, FRAMES),)


def _stamped(counts: Counts, ink: int) -> Counts:
    """Write digits of three pixels by five, which change from frame to frame, into a corner."""
    rng = np.random.default_rng(3)
    digits = rng.random((10, 5, 3)) < 0.6
    out = counts.copy()
    for frame, image in enumerate(out):
        for place, digit in enumerate(f"{frame * 7:06d}"):
            image[2:7, 3 + 4 * place : 6 + 4 * place][digits[int(digit)]] = ink
    return out


@pytest.mark.parametrize(
    ("ink", "way"),
    [
        (36000, "sliding"),
        (0, "fixed"),
        pytest.param(0, "sliding", marks=pytest.mark.large),
        pytest.param(65535, "sliding", marks=pytest.mark.large),
        pytest.param(65535, "fixed", marks=pytest.mark.large),
    ],
)
def test_a_text_costs_its_own_pixels(ink: int, way: str) -> None:
    config = _config()
    if way == "fixed":
        config = _config(
            background={"method": "fixed", "frames": [0, 40], "window_frames": None},
            fit={"frames": [60, 90]},
        )
    counts = _counted(_light(1))
    plain, stamped = (ia.fit_movie(c, config=config) for c in (counts, _stamped(counts, ink)))
    (said,) = [text for text in stamped.warnings if "burnt into" in text]
    (box,) = stamped.summary["left_out"]["texts"]
    assert box["rows"][0] <= 2
    assert box["rows"][1] >= 7
    assert box["columns"][1] <= 30
    assert f"columns {box['columns'][0]}:{box['columns'][1]}" in said
    assert list(stamped.table["status"]) == list(plain.table["status"]) == ["ok"] * len(plain.table)
    assert len(plain.table) == (4 if way == "sliding" else 1)
    shift = stamped.table["mass_kda"] - plain.table["mass_kda"]
    assert np.abs(shift / plain.table["sigma_mass_kda"]).max() < 0.5
    assert stamped.summary["camera"]["gain_e_per_adu"]["value"] == pytest.approx(GAIN, rel=0.02)


def test_light_pixels_that_switch_and_saturation_are_no_text() -> None:
    counts = _counted(_light(1))
    assert find_text(ia.open_stack(counts), (0, FRAMES)) is None
    full = np.minimum(counts, np.quantile(counts, 0.9).astype(np.uint16))
    assert find_text(ia.open_stack(full), (0, FRAMES)) is None
    blinking = counts.copy()
    blinking[::2, 20, 30] += 9000
    assert find_text(ia.open_stack(blinking), (0, FRAMES)) is None
    text = find_text(ia.open_stack(_stamped(counts, 50000)), (0, FRAMES))
    assert text is not None
    assert len(boxes_of(text)) == 1


def test_channels_that_take_turns_are_recognised_and_one_is_taken() -> None:
    counts = _counted(_light(1))
    both = np.empty((2 * FRAMES, SIDE, SIDE), np.uint16)
    both[::2], both[1::2] = counts, _counted(_light(2), seed=2)
    with pytest.raises(DataError, match=r"2 kinds take turns.*--channels 2:0, or 2:1"):
        ia.fit_movie(both, config=_config())
    alone = ia.fit_movie(counts, config=_config())
    taken = ia.fit_movie(both, config=_config(camera={"channels": [2, 0]}))
    np.testing.assert_array_equal(taken.table["mass_kda"], alone.table["mass_kda"])
    assert "channels = [2, 0]" in taken.analysis.config_toml
    three = np.concatenate([both, both])[: 2 * FRAMES].copy()
    three[2::3] = three[2::3] // 2 + 5000
    assert [channels_of(c[:64], Camera()) for c in (counts, both)] == [1, 2]
    with pytest.raises(ConfigError, match="how many channels take turns"):
        _config(camera={"channels": [2, 2]})


@pytest.mark.parametrize(
    "repeated", ["some", "first", pytest.param("all", marks=pytest.mark.large)]
)
def test_repeated_frames_are_dropped_after_a_recorded_background(repeated: str) -> None:
    config = _config(
        background={"method": "fixed", "frames": [0, 120], "window_frames": None},
        fit={"frames": [120, 320]},
        simulation={"events": [{"frame": 120, "x_px": 30.2, "y_px": 33.7, "mass_kda": 500.0}]},
    )
    counts = _counted(_expected(config, 1))
    whole = ia.fit_movie(counts, config=config)
    if repeated == "some":
        lost = [k for k in range(1, FRAMES) if k % 7 == 0]
        for k in lost:
            counts[k] = counts[k - 1]
    elif repeated == "first":
        lost = list(range(1, 80))
        counts[:80] = counts[0]
    else:
        counts, lost = np.repeat(counts, 2, axis=0), list(range(1, 2 * FRAMES, 2))
        config = _config(
            background={"method": "fixed", "frames": [0, 240], "window_frames": None},
            fit={"frames": [240, 640]},
        )
    result = ia.fit_movie(counts, config=config)
    (said,) = [text for text in result.warnings if "repeat" in text]
    assert "are left out" in said
    assert list(result.table["status"]) == ["ok"]
    row, other = result.table.iloc[0], whole.table.iloc[0]
    spans = config.background.recorded, config.fit.frames
    kept = [len(set(range(*span)) - set(lost)) for span in spans]
    assert [row["n_before"], row["n_after"]] == kept
    assert row["frame"] == spans[1][0] + (spans[1][0] in lost)
    assert abs(row["mass_kda"] - other["mass_kda"]) < 2 * row["sigma_mass_kda"]
    if repeated == "all":
        assert row["mass_kda"] == pytest.approx(other["mass_kda"], rel=1e-6)
    assert f"frames = [{spans[0][0]}, {spans[0][1]}]" in result.analysis.config_toml
    assert result.summary["timeline"]["intervals"][0]["what"].endswith("left out")


def test_wrong_numbers_of_the_camera_are_not_called_saturation() -> None:
    counts = _counted(_light(1)[:2])
    with pytest.raises(DataError, match=r"all beyond camera\.well_depth_e = 30000.*they differ"):
        check_counts(counts, 0, "m.tif", camera=Camera(40.0, well_depth_e=3e4))
    with pytest.raises(DataError, match="saturated throughout"):
        check_counts(
            np.full_like(counts, 65535), 0, "m.tif", camera=Camera(1.0, full_scale_adu=65535)
        )


@pytest.mark.parametrize("shape", [(120, 140), (640, 520)])
def test_a_large_field_tells_its_noise_by_a_sample_and_its_drift_by_its_middle(
    shape: tuple[int, int],
) -> None:
    """The noise has the value of all pixels, and the image is that of the middle."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[: shape[0], : shape[1]]
    light = 5000 * (1 + 0.3 * np.sin(y / 40) * np.cos(x / 37))
    flicker = 1 + 0.02 * rng.standard_normal((6, 1, 1))
    counts = rng.poisson(light * flicker).astype(np.uint16)
    camera = Camera(gain_e_per_adu=np.full(shape, 1.0), offset_adu=np.full(shape, 100.0))
    with open_stack(counts + np.uint16(100)) as movie:
        seen = look_at(movie, camera, 0, 6)
    assert seen.light_e == pytest.approx(counts.mean(), rel=1e-9)
    assert abs(seen.noise - 1) < 4 * np.sqrt(3 / 5 / min(counts[0].size, 2**16))
    power = counts.mean(axis=(1, 2), keepdims=True)
    mean = (counts * (power.mean() / power)).mean(axis=0)
    middle = tuple(slice((n - min(n, 256)) // 2, (n + min(n, 256)) // 2) for n in shape)
    np.testing.assert_allclose(seen.image, mean[middle], rtol=1e-3)
    # control: a place beside the middle is another image
    beside = np.roll(mean, 1, axis=1)[middle]
    assert np.abs(beside / seen.image - 1).max() > 0.02
