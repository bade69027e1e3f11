"""The search in the frames that one is looking at is the one with which an analysis begins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
from looked_at import bound_settings, landing_settings, moving_settings

import iscat_analysis as ia
from iscat_analysis.camera import camera_from_config, measure_windows
from iscat_analysis.study import Movie

WINDOW, LANDS, LEAVES = 24, 60, 120
LANDING = landing_settings(
    180, {"frame": LANDS, "leave": LEAVES, "x_px": 20.3, "y_px": 40.8, "mass_kda": 700.0}
) | {"simulation.species": [480.0]}
BOUND = bound_settings(
    120,
    {"x_px": 20.2, "y_px": 22.8, "mass_kda": 900.0},
    {"x_px": 45.9, "y_px": 41.1, "mass_kda": 1500.0},
)
MOVING = moving_settings(40, 40, d_um2_s=0.3, x_px=12.0, y_px=20.0, drift_um_s=[8.0, 0.0])


def _written(folder: Path, config: ia.Config, seed: int = 5) -> tuple[Path, pd.DataFrame]:
    path = folder / "movie.tif"
    return path, ia.simulate_movie(config, path, seed=seed)


@pytest.fixture(scope="module")
def landing(sample_configs, tmp_path_factory) -> tuple[Path, ia.Config]:
    config = ia.configure(sample_configs["landing"], settings=LANDING)
    return _written(tmp_path_factory.mktemp("landing"), config)[0], config


@pytest.fixture(scope="module")
def bound(sample_configs, tmp_path_factory) -> tuple[Path, ia.Config]:
    config = ia.configure(sample_configs["mass"], settings=BOUND)
    return _written(tmp_path_factory.mktemp("bound"), config)[0], config


def test_what_lands_and_leaves_is_found_where_and_when_it_does(landing) -> None:
    path, config = landing
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        for frame, sign in ((LANDS, 1), (LEAVES, -1)):
            look = preview.look(frame)
            found = look.found()
            assert (look.before, look.after) == ((frame - WINDOW, frame), (frame, frame + WINDOW))
            assert len(found) == 1
            assert found[["x_px", "y_px"]].iloc[0].tolist() == pytest.approx([20.3, 40.8], abs=0.2)
            assert sign * found["mass_kda"].iloc[0] == pytest.approx(700.0, rel=0.1)
            assert np.sign(found["contrast"].iloc[0]) == -sign  # the particle is dark
        assert len(preview.look((LANDS + LEAVES) // 2).found()) == 0


def test_the_threshold_is_the_one_of_an_analysis(landing) -> None:
    path, config = landing
    analysed = ia.fit_movie(path, config=config)
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        assert preview.window == analysed.summary["landing"]["window_frames"] == WINDOW
        assert preview.threshold() == analysed.summary["detection_threshold_snr"]


STEADY = {
    "optics.calibrate": "never",
    "camera.pixel_size_nm": 84.0,
    "camera.gain_e_per_adu": 4.0,
    "particle.mass_kda": 146.0,
    "calibration.gradient_per_kda": -3.1e-5,
    "fit.spheres": (),
    "simulation.shape": [64, 64],
    "simulation.frames": 320,
    "simulation.count": 4,
    "simulation.leavings": 0,
    "simulation.species": [480.0],
    "simulation.photons_per_pixel": 1e5,
    "simulation.background": "speckle",
    "simulation.speckle_contrast": 0.1,
}


def _counts(seed: int, **settings: object) -> tuple[np.ndarray, ia.Config]:
    config = ia.configure(settings=STEADY | settings)
    return np.array(list(Movie(config, seed).frames(seed))), config


def _drifting() -> tuple[np.ndarray, ia.Config]:
    return _counts(3, **{"simulation.drift_px_per_frame": [2e-3, 0.0]})


def _joined() -> tuple[np.ndarray, ia.Config]:
    (one, config), (other, _) = _counts(3), _counts(4)
    return np.concatenate([one[:160], other[160:]]), config


@pytest.mark.parametrize("make", [_drifting, _joined])
def test_a_movie_that_drifts_or_breaks_is_prepared_as_for_an_analysis(make) -> None:
    counts, config = make()
    config = ia.configure(config, settings={"camera.gain_e_per_adu": "auto"})
    analysed = ia.fit_movie(counts, config=config)
    landing = analysed.summary["landing"]
    with ia.open_stack(counts) as movie:
        preview = ia.Preview(movie, config)
        window = preview.window
        assert window == landing["window_frames"]
        assert preview.threshold() == analysed.summary["detection_threshold_snr"]
        ready = preview.prepared
        assert ready.opening.noise.summary == landing["noise_spectrum"]
        curve = list(ready.opening.curve.variance_over_shot)
        assert curve == landing["noise_variance_over_shot"]
        assert {key: analysed.summary[key] for key in ready.summary} == ready.summary
        assert set(preview.notes) <= {one["text"] for one in analysed.summary["findings"]}
        assert preview.frames == (0, 320)
        for event in analysed.table.itertuples():  # each is found where and when it lands
            found = preview.look(event.frame).found()
            near = np.hypot(found["x_px"] - event.x_px, found["y_px"] - event.y_px)
            assert near.min() < 1.0
        # and nothing else: in windows side by side, each event is seen in two at most
        looks = [preview.look(frame).found() for frame in range(window, 320, window)]
        assert len(analysed.table) > 1
        assert sum(map(len, looks)) <= 2 * len(analysed.table)


def test_what_is_shown_of_a_movie_that_breaks_is_of_one_part_of_it() -> None:
    counts, config = _joined()
    with ia.open_stack(counts) as movie:
        preview = ia.Preview(movie, config)
        assert any("0:160, 160:320 are analysed" in note for note in preview.notes)
        for frame in (150, 159, 160, 170):
            look = preview.look(frame)
            assert (look.before[0] >= 160) == (look.after[1] > 160) == (frame >= 160)


def test_frames_that_repeat_are_left_out_and_the_others_keep_their_numbers(bound) -> None:
    path, config = bound
    counts = tifffile.imread(path)
    counts[30], counts[80:82] = counts[29], counts[79]
    analysed = ia.fit_movie(counts, config=config)
    with ia.open_stack(counts) as movie:
        preview = ia.Preview(movie, config)
        assert preview.threshold() == analysed.summary["detection_threshold_snr"]
        assert (preview.frames, preview.window) == ((60, 120), 58)
        look = preview.look(80, 15)  # 80 and 81 are not there
        assert (look.frame, look.before, look.after) == (82, (0, 60), (82, 97))


@pytest.mark.parametrize("setup", ["landing", "bound"])
def test_the_false_alarms_of_a_threshold_have_that_threshold(setup, request) -> None:
    path, config = request.getfixturevalue(setup)
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        usual = config.detection.false_alarms_per_movie
        assert preview.false_alarms(preview.threshold()) == pytest.approx(usual)
        alarms = preview.false_alarms(4.0)
        assert alarms > usual
        again = ia.configure(config, settings={"detection.false_alarms_per_movie": alarms})
        assert ia.Preview(movie, again).threshold() == pytest.approx(4.0, abs=1e-6)
        assert preview.false_alarms(4.5) < alarms


def test_the_image_is_the_mean_after_over_the_mean_before(landing) -> None:
    path, config = landing
    counts = tifffile.imread(path).astype(float)
    before, after = counts[LANDS - WINDOW : LANDS].sum(0), counts[LANDS : LANDS + WINDOW].sum(0)
    expected = after / before * before.sum() / after.sum() - 1
    with ia.open_stack(path) as movie:
        image = ia.Preview(movie, config).look(LANDS).image
    np.testing.assert_allclose(image, expected, atol=1e-6)  # single precision


def test_a_lower_threshold_finds_more_and_a_higher_one_nothing(landing) -> None:
    path, config = landing
    with ia.open_stack(path) as movie:
        look = ia.Preview(movie, config).look(LANDS)
        numbers = [len(look.found(threshold)) for threshold in (2.5, look.threshold, 500.0)]
    assert numbers[0] > numbers[1] == 1
    assert numbers[2] == 0


def test_near_the_ends_the_windows_are_as_long_as_there_are_frames(landing) -> None:
    path, config = landing
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        stride = WINDOW // 4
        first, last = preview.look(-5), preview.look(10_000)
        assert (first.before, first.after) == ((0, stride), (stride, stride + WINDOW))
        assert last.after == (180 - stride, 180)
        assert np.isfinite(first.image).all()
        assert np.isfinite(last.image).all()


def test_over_a_background_the_search_is_the_first_one_of_the_analysis(bound) -> None:
    path, config = bound
    analysed = ia.fit_movie(path, config=config)
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        whole, few = preview.look(0), preview.look(70, 15)
        assert (whole.before, whole.after, preview.window) == ((0, 60), (60, 120), 60)
        assert few.after == (70, 85)
        assert whole.threshold == analysed.summary["detection_threshold_snr"]
        found = whole.found().sort_values("y_px")
        np.testing.assert_allclose(found["mass_kda"], analysed.table["mass_kda"], rtol=0.05)
        np.testing.assert_allclose(found["snr"], analysed.table["snr"], rtol=0.1)
        windows = measure_windows(
            movie, camera_from_config(config.camera, (64, 64), movie.dtype), (0, 60), (70, 85)
        )
    # a background of n frames costs √(1 + m/n) over m frames: 60/√2 against 15/√1.25
    share = few.found()["snr"].to_numpy() / whole.found()["snr"].to_numpy()
    np.testing.assert_allclose(share, np.sqrt(15 / 1.25 / 30), rtol=0.1)
    contrast = windows.after_e / (windows.power_ratio * windows.before_e) - 1
    np.testing.assert_allclose(few.image, contrast, atol=1e-12)


def test_what_moves_is_found_in_the_frame_itself(tmp_path) -> None:
    config = ia.configure(None, settings=MOVING)
    path, truth = _written(tmp_path, config)
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        for frame in (3, 30):
            found = preview.look(frame).found()
            place = truth[truth["frame"] == frame][["x_px", "y_px"]].to_numpy()
            assert len(found) == 1
            np.testing.assert_allclose(found[["x_px", "y_px"]].to_numpy(), place, atol=1.0)
            assert found["mass_kda"].iloc[0] > 0


def test_bad_arguments_are_refused(landing) -> None:
    path, config = landing
    with ia.open_stack(path) as movie:
        preview = ia.Preview(movie, config)
        for window in (0, preview.longest + 1):
            with pytest.raises(ia.ConfigError, match=f"window = {window}"):
                preview.look(60, window)
        for threshold in (0.0, -1.0, float("nan")):
            with pytest.raises(ia.ConfigError, match="threshold"):
                preview.look(60).found(threshold)
            with pytest.raises(ia.ConfigError, match="threshold"):
                preview.false_alarms(threshold)
        late = ia.configure(config, settings={"fit.frames": (0, 500)})
        with pytest.raises(ia.DataError, match=r"change fit\.frames"):
            ia.Preview(movie, late)
        long = ia.configure(config, settings={"background.window_frames": 100})
        with pytest.raises(ia.DataError, match="window_frames"):
            ia.Preview(movie, long)


class _Long:
    """Frames of a movie again and again, without end; counts how many are read."""

    dtype = np.dtype(np.uint16)

    def __init__(self, counts: np.ndarray, frames: int) -> None:
        self._counts, self.read = counts, 0
        self.shape = (frames, *counts.shape[1:])

    def __getitem__(self, key: slice) -> np.ndarray:
        self.read += key.stop - key.start
        return self._counts[np.arange(key.start, key.stop) % len(self._counts)]


def test_a_quarter_of_the_frames_is_read_of_long_movies_where_they_may_break(landing) -> None:
    """An analysis looks for breaks in every fourth frame; the rest is a sample of one size."""
    path, config = landing
    counts, read = tifffile.imread(path).astype(np.uint16), []
    for frames in (6_000, 60_000):
        movie = _Long(counts, frames)
        with ia.open_stack(movie) as stack:
            look = ia.Preview(stack, config).look(frames // 2)
            sampled = movie.read
            look.found()
        assert movie.read == sampled  # what was looked at is searched
        read.append(sampled - frames // 4)
    assert read[0] == read[1] < 4_000
