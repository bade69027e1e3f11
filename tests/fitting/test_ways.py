"""Three ways to say which frames stand against which, and one record of what is found."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scenes import PIXEL_NM, Stack

from iscat_analysis import Preview
from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config, configure
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import Event, fit_flags, standing_out
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.fitting.ranges import BackgroundMode, background_mode, describe_background_mode
from iscat_analysis.fitting.run import Run
from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.pipeline import analyse
from iscat_analysis.pipeline.kinds import kind_of
from iscat_analysis.records import EVENT_COLUMNS, SEVERITY, Analysis, Status, Windows, silent
from iscat_analysis.study import Movie
from iscat_analysis.tracking.frames import Recording, load_field, tracking_context
from iscat_analysis.tracking.joint import first_background

SIDE = 48
PLACES = ((14.3, 15.7), (33.2, 31.6))
BASE = [
    f"camera.pixel_size_nm={PIXEL_NM}", "camera.gain_e_per_adu=8", "camera.frame_rate_hz=200",
    "camera.exposure_ms=5", "particle.mass_kda=480", "calibration.gradient_per_kda=-3.1e-5",
    f"simulation.shape=[{SIDE}, {SIDE}]", "simulation.photons_per_pixel=2e5",
    "simulation.background=speckle", "posterior.enabled=false", "optics.calibrate=never",
    "fit.roi_nm=2000",
]  # fmt: skip


def _bound(frame: int) -> dict[str, object]:
    return {"events": [{"frame": frame, "x_px": x, "y_px": y} for x, y in PLACES]}


MOVIES: dict[BackgroundMode, tuple[list[str], dict[str, object]]] = {
    "fixed": (["background.frames=[0, 40]", "simulation.frames=80"], _bound(40)),
    "sliding": (["background.window_frames=30", "simulation.frames=120"], _bound(60)),
    "tracks": (
        ["fit.mode=track", "track.free=mass", "simulation.frames=30"],
        {"movers": [{"d_um2_s": 0.1, "x_px": x, "y_px": y} for x, y in PLACES]},
    ),
}


def _config(way: BackgroundMode) -> Config:
    settings, simulated = MOVIES[way]
    return configure({"simulation": simulated}, settings=[*BASE, *settings])


@pytest.fixture(scope="module")
def analyses(tmp_path_factory: pytest.TempPathFactory) -> dict[BackgroundMode, Analysis]:
    """Analyse a movie in each way."""
    folder, found = tmp_path_factory.mktemp("ways"), {}
    for way in MOVIES:
        config, path = _config(way), Path(folder / f"{way}.npy")
        np.save(path, np.array(list(Movie(config, 1).frames())))
        with open_stack(path) as movie:
            found[way] = analyse(movie, config)
    return found


def test_every_way_is_found() -> None:
    assert set(get_args(BackgroundMode)) == set(MOVIES)
    assert len({kind_of(_config(way)).heading for way in MOVIES}) == len(MOVIES)
    assert [background_mode(_config(way)) for way in MOVIES] == list(MOVIES)


@pytest.mark.parametrize("way", list(MOVIES))
def test_every_way_gives_the_same_record(
    analyses: dict[BackgroundMode, Analysis], way: BackgroundMode
) -> None:
    found = analyses[way]
    table = found.table
    assert tuple(table.columns[: len(EVENT_COLUMNS)]) == EVENT_COLUMNS
    numbers = table["event"].unique().tolist()
    assert numbers == list(range(len(PLACES)))
    assert [view.event for view in found.views] == numbers
    assert f'method = "{way}"' in found.config_toml
    assert found.ratio_image.shape == (SIDE, SIDE)
    assert found.power.shape == found.power_frames.shape
    assert np.all(np.diff(found.power_frames) > 0)  # a line through them never runs back
    for flags, status in zip(table["flags"], table["status"], strict=True):
        own = [Status(flag) for flag in flags.split(";") if flag]
        assert own == sorted(own, key=SEVERITY.index)
        assert status == (own[0] if own else "ok")
    for view in found.views:
        rows = table[table["event"] == view.event]
        inside = rows["x_px"] - view.column_px
        assert ((inside > 0) & (inside < view.contrast.shape[1])).any()


@pytest.mark.parametrize("way", list(MOVIES))
def test_every_way_weighs_the_particles_alike(
    analyses: dict[BackgroundMode, Analysis], way: BackgroundMode
) -> None:
    """Each particle once: the rows of a track share the error of their background."""
    found = analyses[way]
    table = found.table if found.tracks is None else found.tracks
    pulls = (table["mass_kda"] - 480) / table["sigma_mass_kda"]
    assert len(pulls) == len(PLACES)
    assert pulls.abs().max() < 4.5


@pytest.mark.parametrize("way", list(MOVIES))
def test_frames_that_are_not_there_are_refused_alike(way: BackgroundMode, tmp_path: Path) -> None:
    config = configure(_config(way), settings={"fit.frames": [50, 900]})
    np.save(tmp_path / "movie.npy", np.full((100, SIDE, SIDE), 1000, dtype=np.uint16))
    for job in (analyse, Preview):
        with open_stack(tmp_path / "movie.npy") as movie, pytest.raises(DataError) as refused:
            job(movie, config)
        assert "has 100 frames, but fit.frames asks for 50:900" in str(refused.value)


def _event() -> tuple[AnalysisContext, Event]:
    """Fit a particle at the first of `PLACES` to counts without noise."""
    config = _config("fixed")
    context = make_context(config, (SIDE, SIDE))
    grid = PixelGrid.region((0, SIDE), (0, SIDE), PIXEL_NM)
    place = (PIXEL_NM * axis for axis in PLACES[0])
    before, none = np.full((SIDE, SIDE), 8e6), np.zeros((SIDE, SIDE))
    windows = Windows(
        before_e=before,
        after_e=before * (1 + context.wide.image(grid, *place, context.model.height_nm, 480.0)),
        n_before=40, n_after=40, power_ratio=1.0,
        read_variance_before_e2=none, read_variance_after_e2=none,
        masked=none > 0, saturated=none > 0,
        frames_before=(0, 40), frames_after=(40, 80), power=np.ones(80),
    )  # fmt: skip
    with ThreadPoolExecutor(1) as pool:
        (event,) = fit_field(context, windows, pool=pool)[0]
    return context, event


def test_remarks_on_surroundings_are_put_in_order() -> None:
    """A saturated pixel beside the particle, and one too far away to matter."""
    context, event = _event()
    assert Status.SATURATED not in event.flags
    top, left = event.region.rows[0], event.region.columns[0]
    column, row = (round(axis) for axis in PLACES[0])
    for away, spoiled in ((2, True), (9, False)):
        saturated = np.zeros(event.region.shape, dtype=bool)
        saturated[row + away - top, column - left] = True
        windows = replace(event.windows, saturated=saturated)
        said = fit_flags(context, event, windows, sidelobe=True, too_close=True)
        assert said[0] == Status.SIDELOBE
        assert Status.TOO_CLOSE in said
        assert (Status.SATURATED in said) is spoiled
        assert list(said) == sorted(said, key=SEVERITY.index)


def test_events_that_stand_out_are_judged_first() -> None:
    _, event = _event()
    clean, flagged = replace(event, flags=()), replace(event, flags=(Status.TOO_CLOSE,))
    assert standing_out([flagged, clean]) == [clean]
    assert standing_out([flagged]) == [flagged]


def test_the_sums_of_a_region_are_views() -> None:
    _, event = _event()
    part = event.windows.cut((slice(1, 4), slice(2, 7)))
    assert part.before_e.shape == part.masked.shape == part.saturated.shape == (3, 5)
    assert np.shares_memory(part.after_e, event.windows.after_e)
    assert part.power_ratio == event.windows.power_ratio


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ([], '"sliding": frames just after'),
        (["fit.mode=track"], '"tracks": frames are compared with the light that all have'),
        (
            ["background.frames=[0, 40]"],
            '"fixed": frames are compared with the mean of frames 0:40',
        ),
        (["background.method=median", "background.frames=[0, 40]"], "the median of frames 0:40"),
        (["background.frames=all", "fit.mode=track"], '"median": frames are compared with the med'),
        (
            ["background.frames=all", "background.method=fixed", "fit.mode=track"],
            '"fixed": frames are compared with the mean of all of them',
        ),
        (["background.method=known", "background.level_e=2e4"], "background.level_e = 20000"),
        (["optics.scheme=darkfield"], "the mean of background.frames"),
    ],
)
def test_the_method_is_said_whether_it_was_written_or_not(settings: list[str], words: str) -> None:
    assert words in describe_background_mode(configure(settings=settings))


@pytest.mark.parametrize("method", ["fixed", "median"])
def test_a_background_of_all_frames_is_their_mean_or_their_median(method: str) -> None:
    config = configure(
        _config("tracks"), settings={"background.frames": "all", "background.method": method}
    )
    counts = np.array(list(Movie(config, 1).frames()))
    with open_stack(counts) as movie:
        found = analyse(movie, config)
    assert 'frames = "all"' in found.config_toml
    assert f'method = "{method}"' in found.config_toml
    assert len(found.tracks) == len(PLACES)
    assert (found.tracks["mass_kda"] < 480).all()  # of which a part is in the background
    camera = camera_from_config(config.camera, counts.shape[1:], counts.dtype)
    context = tracking_context(config, counts.shape[1:], len(counts))
    with ThreadPoolExecutor(1) as pool:
        span = (0, len(counts))
        recording = Recording(Stack(counts), camera, lambda *_: None, pool, silent)
        field = load_field(context, recording, span)
        ground = first_background(field, config.background)
    light = counts * 8.0 / ground.power[:, None, None]
    middle = {"fixed": np.mean, "median": np.median}[method](light, axis=0)
    np.testing.assert_allclose(ground.level, middle, rtol=3e-4)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["fit.mode=track"], ['"tracks"', 'background.frames = "all"', '"fixed" their mean']),
        (["fit.mode=mass"], ['"sliding"']),
    ],
)
def test_what_needs_no_frames_before_the_particles_is_named(
    settings: list[str], words: list[str]
) -> None:
    counts = np.random.default_rng(1).poisson(2e4, (60, SIDE, SIDE)).astype(np.uint16)
    config = configure(settings=[*BASE, *settings, "background.method=fixed"])
    whole = configure(settings=[*BASE, *settings, "background.frames=[0, 60]"])
    for one, kind, begins in ((config, ConfigError, "which frames"), (whole, DataError, "array")):
        told: list[str] = []
        with open_stack(counts) as movie, pytest.raises(kind, match=begins) as refused:
            analyse(movie, one, Run(told.append))
        assert all(word in str(refused.value) for word in words)
        assert not any("diffusion coefficient" in line for line in told)


def test_a_run_says_its_method_first() -> None:
    told: list[str] = []
    config = _config("fixed")
    counts = np.array(list(Movie(config, 1).frames(1)))
    with open_stack(counts) as movie:
        analyse(movie, config, Run(told.append))
    said = describe_background_mode(config)
    assert [text for text in told if "background.method" in text] == [said]
