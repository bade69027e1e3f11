"""Landing movies from end to end, and what is odd about real ones."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from landings import CAMERA, PIXEL_NM, Found, analysed, drawn, landing_config, simulating
from scenes import Stack

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.fitting import events as events_module
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.fitting.run import Run, partial_folder
from iscat_analysis.landing import chunks as chunk_work
from iscat_analysis.landing.chunks import FinishedChunk, MergedChunks
from iscat_analysis.landing.find import analyse_landings, drift_findings, frame_findings
from iscat_analysis.landing.steps import ChunkFitter
from iscat_analysis.landing.tasks import TaskBuilder
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.pipeline.finish import summary_of
from iscat_analysis.pipeline.landings import inject_and_recover
from iscat_analysis.records import EVENT_COLUMNS, FRAME_COLUMN, EventView
from iscat_analysis.report.vega import figures_in
from iscat_analysis.search import chunks as chunks_module
from iscat_analysis.search import chunks as planning
from iscat_analysis.study import Movie

SIDE, FRAMES = 64, 420
EVENTS = [
    (80, None, 20.3, 21.7, 480.0),
    (150, 300, 44.2, 40.6, 480.0),
    (200, None, 22.6, 43.1, 146.0),
    (330, None, 46.1, 17.4, 480.0),
]


def _config(*settings: str, events: Any = EVENTS) -> Config:
    alarms = "detection.false_alarms_per_movie=0.01"
    return landing_config(SIDE, FRAMES, alarms, *settings, events=events)


class Memory(Stack):
    """A movie in memory that notes which frames are read."""

    identity = "movie"

    def __init__(self, counts: np.ndarray) -> None:
        super().__init__(counts)
        self.reads: list[tuple[int, int]] = []

    def read(self, start: int, stop: int) -> np.ndarray:
        """Frames [start, stop)."""
        self.reads.append((start, stop))
        return super().read(start, stop).copy()


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Draw the movie of `EVENTS` once."""
    return drawn(_config())


def _run(counts: np.ndarray, config: Config | None = None, **options: Any) -> Found:
    return analysed(Memory(counts), config or _config(), **options)


STEPS = sorted(
    [(f, 1, x, y, m) for f, _, x, y, m in EVENTS]
    + [(leave, -1, x, y, m) for _, leave, x, y, m in EVENTS if leave]
)


def _ready(counts: np.ndarray, camera: Camera) -> Any:
    """Give what an injection has to know of a movie."""
    return SimpleNamespace(
        movie=Memory(counts), camera=camera, stretches=SimpleNamespace(breaks=())
    )


def _assert_all_found(table: pd.DataFrame, *, frames: int = 1, sigmas: float = 4.5) -> None:
    """Every step of `EVENTS`, and nothing else."""
    assert len(table) == len(STEPS)
    for row, (frame, sign, x, y, mass) in zip(table.itertuples(), STEPS, strict=True):
        assert abs(row.frame - frame) <= max(frames, getattr(row, FRAME_COLUMN))
        for value, truth, sigma in (
            (row.x_nm, x * PIXEL_NM, row.sigma_x_nm),
            (row.y_nm, y * PIXEL_NM, row.sigma_y_nm),
            (row.mass_kda, sign * mass, row.sigma_mass_kda),
        ):
            assert abs(value - truth) < sigmas * sigma


# ---- the whole -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(counts: np.ndarray) -> Found:
    """Analyse it once."""
    return _run(counts)


def test_every_step_is_found_dated_and_weighed(plain: Found) -> None:
    result, told = plain
    assert told == []
    table = result.fits
    assert list(table.columns) == [*EVENT_COLUMNS, FRAME_COLUMN, "model"]
    assert set(table["model"]) == {"dipole"}
    _assert_all_found(table)
    assert set(table["status"]) == {"ok"}
    assert (table["contrast"] * table["mass_kda"] < 0).all()  # landing darkens here
    assert (table["qcrb_mass_kda"] < table["crb_mass_kda"]).all()
    np.testing.assert_allclose(table["sigma_mass_kda"] / table["crb_mass_kda"], 1, atol=0.1)
    assert result.summary["landings"] == 4
    assert result.summary["leavings"] == 1
    assert [v.event for v in result.views] == list(range(5))
    assert all(view.posterior is None for view in result.views)  # the configuration asks for none


def test_the_bound_is_that_of_the_frames_used(plain: Found) -> None:
    """n_b n_a/(n_b + n_a) frames inform: the 480 kDa steps differ by their windows alone."""
    table = plain[0].fits
    heavy = table[table["mass_kda"].abs() > 300]
    frames = heavy["n_before"] * heavy["n_after"] / (heavy["n_before"] + heavy["n_after"])
    scaled = heavy["crb_mass_kda"] * np.sqrt(frames)
    assert scaled.max() / scaled.min() < 1.1
    assert (table["n_before"] <= 40).all()
    assert (table["n_after"] <= 40).all()


def test_nothing_is_found_in_a_blank_movie() -> None:
    blank = drawn(_config(events=[]), 2)
    result, told = _run(blank)
    assert len(result.fits) == 0
    assert list(result.fits.columns) == [*EVENT_COLUMNS, FRAME_COLUMN]
    assert result.views == ()
    assert told == []


def test_chunks_change_nothing_but_the_last_digits(counts: np.ndarray, plain: Found) -> None:
    config = _config("compute.memory_limit_mb=64")
    movie = Memory(np.tile(counts, (4, 1, 1)))
    cut = analyse_landings(movie, config, CAMERA, Run())
    assert cut.summary["chunks"] > 1
    spans = sorted(set(movie.reads))
    assert sum(b - a for a, b in spans) <= 4 * FRAMES + 2 * 400  # the noise curve reads again
    table = cut.fits
    for part in range(4):
        here = table[
            (table["frame"] >= part * FRAMES + 60) & (table["frame"] < (part + 1) * FRAMES - 60)
        ]
        here = here.assign(frame=here["frame"] - part * FRAMES).reset_index(drop=True)
        _assert_all_found(here)
        np.testing.assert_allclose(here["mass_kda"], plain[0].fits["mass_kda"], rtol=3e-3)
    whole = [view.trace for view in cut.views if 80 <= view.trace.frame < 4 * FRAMES - 80]
    assert len(whole) > 15
    assert all(trace.contrast.size == 4 * 40 for trace in whole)  # a seam cuts none


# ---- traces ----------------------------------------------------------------------------------


def _misfit(view: EventView, factor: float = 1.0) -> float:
    """Say how far a trace is from its step, in standard errors: the worst of means and χ²."""
    trace = view.trace
    assert trace is not None
    frame = trace.first + np.arange(trace.contrast.size)
    level = factor * np.where(frame < trace.frame, trace.before, trace.after)
    away = (np.abs(frame - trace.frame) > 2) & np.isfinite(trace.contrast)
    residual = (trace.contrast - level)[away] / trace.sigma
    parts = [part for part in np.array_split(residual, 4) if part.size]
    means = [abs(part.mean()) * np.sqrt(part.size) for part in parts]
    return float(max(*means, abs((residual**2).mean() - 1) * np.sqrt(residual.size / 2)))


def test_a_trace_is_a_step_of_the_height_that_was_fitted(plain: Found) -> None:
    result = plain[0]
    for view, row in zip(result.views, result.fits.itertuples(), strict=True):
        trace = view.trace
        assert trace.after - trace.before == pytest.approx(row.contrast)
        assert (trace.before == 0) == (
            row.mass_kda > 0
        )  # it shows the particle, which comes or goes
        assert (trace.frame, trace.half_width) == (row.frame, row.frame_ci95)
        assert trace.first == max(row.frame - 80, 0)
        assert trace.used == (row.frame - row.n_before, row.frame + row.n_after)
        assert _misfit(view) < 4.5
        assert _misfit(view, 1.3) > 6.0


def test_a_trace_is_of_one_particle_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    events = [(150, None, 28.2, 31.6, 146.0), (195, None, 35.2, 31.6, 480.0)]
    config = _config(events=events)
    counts = drawn(config, 5)
    assert all(_misfit(view) < 4.5 for view in _run(counts, config)[0].views)
    monkeypatch.setattr(TaskBuilder, "added", lambda *_: 0.0)
    assert _misfit(_run(counts, config)[0].views[0]) > 6.0


def test_a_clip_rises_to_the_step_and_falls(plain: Found) -> None:
    for view in plain[0].views:
        clip, trace = view.clip, view.trace
        assert clip.window_frames == 40
        at = clip.frames.index(trace.frame)
        middle = clip.contrast.shape[1] // 2
        side = slice(middle - 2, middle + 3)
        height = clip.contrast[:, side, side].mean(axis=(1, 2))
        sign = np.sign(trace.after - trace.before)
        assert np.argmax(sign * height) in (at - 1, at, at + 1)
        assert clip.contrast.shape[1:] == (21, 21)
        if len(clip.frames) == 13:
            assert np.all(np.abs(height[[0, -1]]) < 0.3 * abs(height[at]))


def test_fine_pixels_of_a_clip_are_summed() -> None:
    config = _config("camera.pixel_size_nm=28", "fit.roi_nm=1200", events=[(90, None, 30, 32, 480)])
    config = simulating(config, frames=180)
    (view,) = _run(drawn(config), config)[0].views
    assert view.clip.contrast.shape[1:] == (21, 21)
    at = view.clip.frames.index(view.trace.frame)
    assert view.clip.contrast[at].min() == pytest.approx(view.trace.after, rel=0.2)


# ---- overlap ---------------------------------------------------------------------------------


def _close(second_frame: int, distance_px: float) -> pd.DataFrame:
    events = [(150, None, 30.2, 31.6, 480.0), (second_frame, None, 30.2 + distance_px, 31.6, 480.0)]
    config = _config(events=events)
    return _run(drawn(config, 5), config)[0].fits


def test_a_window_ends_where_a_close_neighbour_lands() -> None:
    table = _close(175, 3.0)
    assert table["frame"].tolist() == [150, 175]
    assert table["n_after"].tolist() == [25, 40]
    assert table["n_before"].tolist() == [40, 25]
    pulls = (table["mass_kda"] - 480) / table["sigma_mass_kda"]
    assert pulls.abs().max() < 4.5
    assert set(table["status"]) == {"ok"}


@pytest.mark.parametrize(("land", "leave"), [(159, 171), (163, 183), (163, 191)])
def test_a_short_visit_is_weighed_while_it_lasts(land: int, leave: int) -> None:
    """Where one step is dated anew, the other's window has to follow."""
    config = _config("background.window_frames=100", events=[(land, leave, 30.2, 31.7, 480.0)])
    table = _run(drawn(config, land), config)[0].fits
    assert table["frame"].tolist() == [land, leave]
    assert table["n_after"].tolist() == [leave - land, 100]
    assert table["n_before"].tolist() == [100, leave - land]
    pulls = (table["mass_kda"].abs() - 480) / table["sigma_mass_kda"]
    assert pulls.abs().max() < 4.5


def test_a_neighbour_farther_away_is_part_of_the_background() -> None:
    table = _close(165, 9.0)
    assert table["n_after"].tolist() == [40, 40]
    pulls = (table["mass_kda"] - 480) / table["sigma_mass_kda"]
    assert pulls.abs().max() < 4.5


def test_two_that_land_together_are_flagged() -> None:
    table = _close(152, 4.5)
    assert len(table) == 2
    assert set(table["status"]) == {"too_close"}


# ---- odd movies ------------------------------------------------------------------------------


def test_a_converter_that_clips_makes_no_steps(counts: np.ndarray) -> None:
    """Fourteen per cent of the pixels reach the full scale of twelve bits, stored as sixteen."""
    clipped = np.minimum(counts // 7, 4095).astype(np.uint16)
    result, told = _run(clipped, camera=Camera(gain_e_per_adu=28.0, full_scale_adu=65535.0))
    assert result.fits["frame"].tolist() == pytest.approx([s[0] for s in STEPS], abs=1)
    assert any("pixels are saturated" in line for line in told)


def test_stuck_and_dropped_frames_are_left_out(counts: np.ndarray) -> None:
    odd = counts.copy()
    odd[100] = odd[99]
    odd[210] = 0
    result, told = _run(odd)
    _assert_all_found(result.fits, frames=2)
    (line,) = told
    assert "100, 210" in line
    assert "left out" in line
    assert result.summary["frames_left_out"] == 2
    spread = summary_of(result.context, result.fits, result.compared, {}, {})["power_spread"]
    assert 0.005 < spread < 0.02, "of the other frames, whose light has 1 % of noise"


def test_frames_behind_a_closed_shutter_are_left_out(counts: np.ndarray) -> None:
    """Of three photoelectrons in a pixel no ratio is noise as of 1e5."""
    odd = counts.copy()
    odd[:12] = np.random.default_rng(1).poisson(3.0, odd[:12].shape)
    result, told = _run(odd)
    _assert_all_found(result.fits)
    (line,) = told
    assert "frames 0, 1, 2, 3 and 8 more are dark" in line
    assert result.summary["frames_left_out"] == 12


@pytest.mark.parametrize(("polarity", "sign"), [("dark", 1), ("bright", -1)])
def test_one_polarity_is_that_part_of_both(
    counts: np.ndarray, plain: Found, polarity: str, sign: int
) -> None:
    table = plain[0].fits
    found = _run(counts, _config(f"detection.polarity={polarity}"))[0].fits
    wanted = table[sign * table["mass_kda"] > 0]
    assert len(found) == len(wanted) > 0
    for name in ("frame", "x_px", "y_px", "mass_kda"):
        assert found[name].to_numpy() == pytest.approx(wanted[name].to_numpy(), rel=1e-3)


def test_what_was_injected_is_looked_for_in_the_polarity_that_is_reported(
    counts: np.ndarray,
) -> None:
    config = _config("detection.polarity=dark")
    camera = CAMERA
    result, _ = _run(counts, config)
    found = inject_and_recover(_ready(counts, camera), Run(inject=3), result)
    assert found["added"] == 3
    assert found["recovered"] >= 2


@pytest.mark.large
def test_pulls_of_injected_particles_are_in_units_of_the_errors_that_are_reported(
    counts: np.ndarray,
) -> None:
    """The camera claims half as many photoelectrons again: σ is too small by √1.5."""
    excess, pulls = 1.5, []
    camera = Camera(gain_e_per_adu=4.0 * excess)
    for kind in ("curvature", "measured"):
        config = _config(f"fit.sigma={kind}")
        result, _ = _run(counts, config, camera=camera)
        found = inject_and_recover(_ready(counts, camera), Run(inject=8), result)
        pulls.append(found["pull_std"])
    assert pulls[0] > 1.1 * pulls[1]


def test_what_is_shown_of_events_is_made_of_the_first_alone(
    counts: np.ndarray, plain: Found, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks_module, "MEMORY_SHARE", 0.004)
    monkeypatch.setattr(chunk_work, "VIEWS", 2)
    monkeypatch.setattr(chunk_work, "CLIPS", 1)
    real, made = ChunkFitter.shown, []

    def shown(self: ChunkFitter, fitted: Any, clips: int) -> Any:
        made.append((len(fitted), clips))
        return real(self, fitted, clips)

    monkeypatch.setattr(ChunkFitter, "shown", shown)
    found = _run(counts, _config("compute.workers=1"))[0]
    # cores begin at 0, 140 and 280; what is a window earlier is known to come before
    assert made == [(1, 1), (1, 0), (0, 0)]
    assert [view.event for view in found.views] == [0, 1]
    assert [view.clip is not None for view in found.views] == [True, False]
    for mine, whole in zip(found.views, plain[0].views[:2], strict=True):
        assert mine.model == pytest.approx(whole.model, abs=1e-6)
    assert len(found.fits) == len(STEPS)


def test_lines_of_chunks_have_no_numbers(
    counts: np.ndarray, plain: Found, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row is numbered when it is made, and that is when all chunks are there."""
    monkeypatch.setattr(chunks_module, "MEMORY_SHARE", 0.005)
    real, lines = chunk_work.analyse_chunk, []

    def looked_at(*arguments: Any) -> FinishedChunk:
        done = real(*arguments)
        lines.append(done.lines)
        return done

    monkeypatch.setattr(chunk_work, "analyse_chunk", looked_at)
    fits = _run(counts)[0].fits
    assert len(lines) > 1
    assert not any("event" in part for part in lines)
    assert fits["event"].tolist() == list(range(len(STEPS)))
    assert fits.dtypes.equals(plain[0].fits.dtypes)


def test_a_movie_that_freezes_has_no_odd_numbers(counts: np.ndarray) -> None:
    odd = counts.copy()
    odd[250:] = odd[249]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result, told = _run(odd)
    assert len(result.fits) == 3
    assert result.summary["frames_left_out"] == FRAMES - 250
    assert len(told) == 1


def test_power_that_is_not_to_be_normalised_is_named(counts: np.ndarray) -> None:
    _, told = _run(counts, _config("background.power_normalization=false"))
    assert any("background.power_normalization" in text for text in told)


def test_a_brightness_jump_is_divided_out_and_named(counts: np.ndarray) -> None:
    odd = counts.copy()
    thinned = np.random.default_rng(1).binomial(counts[250:].astype(int) * 4, 0.7)
    odd[250:] = np.rint(thinned / 4)
    result, told = _run(odd)
    _assert_all_found(result.fits, sigmas=6.0)
    (line,) = [text for text in told if "jumps" in text]
    assert "frame 250 " in line
    assert "by up to -3" in line


@pytest.mark.parametrize(("shift", "named"), [(0, False), (1, True)])
def test_a_moving_pattern_is_named(shift: int, named: bool) -> None:
    image = Movie(_config(), 3).background_e
    nothing = np.zeros((SIDE, SIDE), dtype=bool)
    merged = MergedChunks((SIDE, SIDE))
    merged.add(
        FinishedChunk(
            core=(0, 400),
            lines=pd.DataFrame(),
            repeats=np.empty(0),
            views=(),
            good=np.ones(400, dtype=bool),
            light=np.ones(400),
            masked=nothing,
            saturated=nothing,
            strongest=np.zeros((2, SIDE, SIDE)),
            ends_e=np.stack([image, np.roll(image, shift, axis=1)]),
        )
    )
    said = [one.text for one in drift_findings("movie", merged, 10.0)]
    told = [text for text in said if "moved" in text]
    assert len(told) == named
    if named:
        assert "not corrected" in told[0]
        assert "background.drift_correction" in told[0]
        assert merged.drift() == pytest.approx([0.0, 1.0], abs=0.1)


@pytest.mark.parametrize(
    ("frames", "setting", "words"),
    [
        (30, "background.window_frames=40", ["30 frames", "80", "background.window_frames"]),
        (30, "detection.polarity=both", ["30 frames", "background.frames = [0, N]"]),
    ],
)
def test_a_movie_shorter_than_its_windows(
    counts: np.ndarray, frames: int, setting: str, words: list[str]
) -> None:
    config = _config(setting)
    if "window" not in setting:
        free = config.background.model_copy(update={"window_frames": None})
        config = config.model_copy(update={"background": free})
    with pytest.raises(DataError) as refused:
        _run(counts[:frames], config)
    assert all(word in str(refused.value) for word in words)
    assert "\n" not in str(refused.value)


def test_a_calibration_of_the_wrong_sign(counts: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="wrong sign"):
        _run(counts, _config("calibration.gradient_per_kda=3.1e-5"))


def test_windows_that_do_not_fit_into_memory() -> None:
    movie = np.zeros((1, 1, 1), dtype="u2")
    large = Memory(movie)
    large.shape = (40, 1024, 1024)
    large.read = lambda a, b: np.random.default_rng(a).integers(  # type: ignore[method-assign]
        90, 110, (b - a, 1024, 1024), dtype="u2"
    )
    config = _config("compute.memory_limit_mb=64", "background.window_frames=5")
    with pytest.raises(DataError, match=r"compute\.memory_limit_mb = "):
        analyse_landings(large, config, Camera(), Run())


@pytest.mark.parametrize(
    ("frames", "cores"), [(150, [150]), (280, [70] * 4), (301, [*[65] * 4, 41]), (600, [75] * 8)]
)
def test_chunks_follow_one_another_and_fit_into_memory(frames: int, cores: list[int]) -> None:
    """There is room for 75 frames beside windows."""
    config = _config("compute.memory_limit_mb=136", "background.window_frames=20")
    movie = Memory(np.zeros((frames, 256, 256), dtype="u2"))
    reader = chunks_module.reader_of(movie, config, Camera(), (0, frames))
    plan = [(part.core, part.span) for (part,) in planning.plan_parts(reader, config, 20)]
    edges = np.cumsum([0, *cores]).tolist()
    assert plan == [
        ((begin, end), (max(begin - 40, 0), min(end + 40, frames)))
        for begin, end in pairwise(edges)
    ]


@pytest.mark.parametrize("mode", ["localize", "joint"])
def test_rings_of_neighbours_are_those_of_their_height(mode: str) -> None:
    """Two strong particles land one after the other, 30 nm above the nominal height."""
    events = [(60, None, 27.3, 30.2, 2000.0), (78, None, 38.4, 33.7, 2000.0)]
    config = _config(
        f"fit.mode={mode}", "particle.mass_kda=2000", "simulation.frames=140",
        "simulation.photons_per_pixel=2e5", "simulation.background=flat", events=events,
    )  # fmt: skip
    raised = [event.model_dump() | {"z_nm": 30.0} for event in config.simulation.events]
    counts = drawn(simulating(config, events=raised))
    table = _run(counts, config)[0].fits.sort_values("frame")
    assert table["status"].tolist() == ["ok", "ok"]
    for row, (_, _, x, y, _) in zip(table.itertuples(), events, strict=True):
        assert abs(row.x_nm - x * PIXEL_NM) < 4.5 * row.sigma_x_nm
        assert abs(row.y_nm - y * PIXEL_NM) < 4.5 * row.sigma_y_nm
        assert abs(row.z_nm - 30.0) < 4.5 * row.sigma_z_nm


@pytest.mark.parametrize(
    ("settings", "way"),
    [
        (["fit.mode=mass"], "sliding"),
        (["fit.mode=joint"], "sliding"),
        (["fit.mode=track"], "tracks"),
        (["fit.mode=track", "background.method=median", "background.frames=all"], "tracks"),
        (["fit.mode=track", "background.frames=all"], "tracks"),
        (["fit.mode=track", "background.method=median", "background.frames=[0, 100]"], "fixed"),
        (["fit.mode=track", "background.frames=[0, 100]"], "fixed"),
        (["background.frames=[0, 100]"], "fixed"),
        (["background.method=median"], "fixed"),
        (["background.method=known", "background.level_e=2"], "fixed"),
        (["optics.scheme=darkfield"], "fixed"),
    ],
)
def test_the_method_says_which_frames_stand_against_which(settings: list[str], way: str) -> None:
    assert background_mode(load_config(None, settings)) == way


def test_windows_that_slide_measure_a_background_that_poisson_takes_for_known() -> None:
    config = load_config(None, ["fit.likelihood=poisson"])
    with pytest.raises(ConfigError, match=r'fit.likelihood = "poisson".*"sliding" measures it'):
        background_mode(config)


# ---- on disk ---------------------------------------------------------------------------------


@pytest.fixture
def movie(counts: np.ndarray, tmp_path: Path) -> Path:
    """Write the movie."""
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, counts, photometric="minisblack")
    return path


def test_an_interrupted_run_resumes_to_the_same_result(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config("posterior.enabled=false", "background.window_frames=20", "compute.workers=1")
    monkeypatch.setattr(chunks_module, "MEMORY_SHARE", 0.0031)
    fit_stack(movie, config, out=tmp_path / "whole.iscat")
    assert not partial_folder(tmp_path / "whole.iscat").exists()
    real: Callable[..., Any] = chunk_work.analyse_chunk
    calls: list[int] = []

    def stopping(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) in (1, 3):
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(chunk_work, "analyse_chunk", stopping)
    out = tmp_path / "cut.iscat"
    for _ in range(2):  # before any chunk is finished, and after the first
        with pytest.raises(KeyboardInterrupt):
            fit_stack(movie, config, out=out)
    cut = json.loads((out / "summary.json").read_text())
    assert cut["interrupted"]
    assert cut["events"] < 5
    assert partial_folder(out).is_dir()
    resumed = fit_stack(movie, config, out=out)  # no --overwrite: it goes on
    chunks = resumed.summary["landing"]["chunks"]
    assert chunks > 2
    assert len(calls) == 2 + chunks
    assert not partial_folder(out).exists()
    assert (out / "fits.csv").read_bytes() == (tmp_path / "whole.iscat" / "fits.csv").read_bytes()
    pages = [(folder / "report.html").read_text() for folder in (out, tmp_path / "whole.iscat")]
    shown = [page.partition('id="data">')[2].partition("</script>")[0] for page in pages]
    assert shown[0] == shown[1]
    assert shown[0].count('"clip":{') == len(resumed.table)


def test_chunks_of_another_configuration_are_not_used(tmp_path: Path) -> None:
    from iscat_analysis.landing.chunks import ChunkStore

    one, two = _config(), _config("optics.focus_nm=-250")
    keys = {ChunkStore(tmp_path, c, "movie", (8, 8), (0, 9), Camera()).key for c in (one, two)}
    keys.add(ChunkStore(tmp_path, one, "another", (8, 8), (0, 9), Camera()).key)
    assert len(keys) == 3
    faster = one.model_copy(update={"compute": one.compute.model_copy(update={"workers": 7})})
    assert ChunkStore(tmp_path, faster, "movie", (8, 8), (0, 9), Camera()).key in keys


# ---- drift -----------------------------------------------------------------------------------

RATE = (0.004, -0.003)


@pytest.fixture(scope="module")
def drifting() -> np.ndarray:
    """Draw the movie of `EVENTS` once more, with the sample drifting."""
    config = _config(f"simulation.drift_px_per_frame={list(RATE)}")
    return drawn(config)


CORRECTED = "background.drift_correction=true"


def _assert_moved(table: pd.DataFrame) -> None:
    """Every step of `EVENTS` where it was when it came: `_assert_all_found` in the sample."""
    came = {(x, y): frame for frame, _, x, y, _ in EVENTS}
    still = table.copy()
    for i, (frame, _, x, y, _) in enumerate(STEPS):
        late = frame - came[x, y]
        still.loc[i, ["x_nm", "y_nm"]] -= np.array(RATE) * late * PIXEL_NM
    _assert_all_found(still)


@pytest.fixture(scope="module")
def followed(drifting: np.ndarray) -> Found:
    """Analyse it with its drift corrected."""
    return _run(drifting, _config(CORRECTED))


def test_a_drifting_movie_is_analysed_as_a_still_one(followed: Found) -> None:
    result, told = followed
    _assert_moved(result.fits)
    assert set(result.fits["status"]) == {"ok"}
    assert all(_misfit(view) < 4.5 for view in result.views)
    (line,) = told
    assert "+1.6" in line
    assert "-1.2" in line
    assert "corrected, to ±0.000" in line
    landing = result.summary
    assert landing["drift_corrected"]
    for axis, rate in zip("xy", RATE, strict=True):
        truth = rate * (np.array(landing["drift_frames"]) - landing["drift_frames"][0])
        np.testing.assert_allclose(landing[f"drift_{axis}_px"], truth, atol=0.01)
    assert landing["drift_px"] == [landing["drift_y_px"][-1], landing["drift_x_px"][-1]]


def test_its_result_does_not_depend_on_the_workers(drifting: np.ndarray, followed: Found) -> None:
    alone, _ = _run(drifting, _config(CORRECTED, "compute.workers=1"))
    pd.testing.assert_frame_equal(alone.fits, followed[0].fits)


@pytest.fixture(scope="module")
def cut(drifting: np.ndarray) -> Any:
    """Analyse it in several chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks_module, "MEMORY_SHARE", 0.005)
        return _run(drifting, _config(CORRECTED, "compute.workers=1"))[0]


def test_its_chunks_agree(cut: Any, followed: Found) -> None:
    assert cut.summary["chunks"] > 1
    _assert_moved(cut.fits)
    whole = followed[0]
    sigma = whole.fits["sigma_mass_kda"]
    assert ((cut.fits["mass_kda"] - whole.fits["mass_kda"]).abs() < 0.2 * sigma).all()
    np.testing.assert_allclose(cut.summary["drift_frames"], whole.summary["drift_frames"])
    np.testing.assert_allclose(
        cut.summary["drift_x_px"], whole.summary["drift_x_px"], atol=5 * 3e-4
    )


def test_where_nothing_drifts_the_correction_changes_nothing(
    counts: np.ndarray, plain: Found
) -> None:
    result, told = _run(counts, _config(CORRECTED))
    _assert_all_found(result.fits)
    for name in ("x_nm", "y_nm", "mass_kda"):
        sigma = plain[0].fits[f"sigma_{name}"]
        change = (result.fits[name] - plain[0].fits[name]) / sigma
        assert change.abs().max() < 0.2
    assert any("corrected, to" in line for line in told)


def test_without_a_pattern_there_is_nothing_to_correct() -> None:
    short = _config(
        CORRECTED, "simulation.background=flat", "simulation.frames=160", events=EVENTS[:1]
    )
    result, told = _run(drawn(short), short)
    assert not result.summary["drift_corrected"]
    assert result.summary["drift_x_px"] is None
    assert any("no fixed pattern" in line for line in told)


def test_chains_reach_the_report(movie: Path, tmp_path: Path) -> None:
    config = _config("posterior.enabled=true", "posterior.steps=300", "fit.frames=[40, 135]")
    out = tmp_path / "sampled.iscat"
    result = fit_stack(movie, config, out=out)
    (first,) = (view.posterior for view in result.views)
    assert first is not None
    assert first.names == ("x_nm", "y_nm", "mass_kda")
    row = result.table.iloc[0]
    assert first.samples[..., 2].std() == pytest.approx(row["sigma_mass_kda"], rel=0.15)
    assert "corner_0000" in figures_in(out / "report.html")


def test_an_interrupt_of_the_chains_keeps_the_fits(
    counts: np.ndarray, plain: Found, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(events_module, "sample_posterior", interrupt)
    result, _ = _run(counts, _config("posterior.enabled=true"))
    assert result.interrupted
    pd.testing.assert_frame_equal(result.fits, plain[0].fits)


def _interrupted_at_the_second_chunk(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Interrupt the second chunk that is begun; the list grows with every one."""
    real, calls = chunk_work.analyse_chunk, []

    def stopping(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(chunk_work, "analyse_chunk", stopping)
    return calls


def test_an_interrupted_injection_keeps_what_the_movie_gave(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config("posterior.enabled=false")
    calls = _interrupted_at_the_second_chunk(monkeypatch)
    out = tmp_path / "cut.iscat"
    with pytest.raises(KeyboardInterrupt):
        fit_stack(movie, config, out=out, inject=3)
    cut = json.loads((out / "summary.json").read_text())
    assert cut["interrupted"]
    assert cut["events"] == len(STEPS)
    assert "injection" not in cut
    whole = fit_stack(movie, config, out=out, inject=3)  # no --overwrite: it goes on
    assert len(calls) == 3
    assert whole.summary["injection"]["added"] == 6
    assert not partial_folder(out).exists()


def test_chunks_of_another_camera_map_are_not_used(counts: np.ndarray, tmp_path: Path) -> None:
    for gain in (4.0, 5.0):
        camera = Camera(gain_e_per_adu=np.full((SIDE, SIDE), gain))
        result, _ = _run(counts, camera=camera, partial=tmp_path)
        if gain == 4.0:
            first = result.fits["sigma_mass_kda"]
    assert (result.fits["sigma_mass_kda"] < first).all()


def test_a_corrected_run_resumes_to_the_same_result(
    drifting: np.ndarray, cut: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks_module, "MEMORY_SHARE", 0.005)
    config = _config(CORRECTED, "compute.workers=1")
    calls = _interrupted_at_the_second_chunk(monkeypatch)
    _run(drifting, config, partial=tmp_path)
    resumed, _ = _run(drifting, config, partial=tmp_path)
    assert len(calls) == 1 + cut.summary["chunks"]
    pd.testing.assert_frame_equal(resumed.fits, cut.fits)
    assert resumed.summary == cut.summary
    same = {"contrast": None}
    for view, other in zip(resumed.views, cut.views, strict=True):
        np.testing.assert_array_equal(view.trace.contrast, other.trace.contrast)
        np.testing.assert_array_equal(view.clip.contrast, other.clip.contrast)
        assert asdict(view.trace) | same == asdict(other.trace) | same


def test_injected_particles_drift_along(followed: Found) -> None:
    from iscat_analysis.pipeline.landings import Injected, InjectedMovie

    way = followed[0].trajectory
    y, x = np.indices((31, 31)) - 15.0
    spot = -0.3 * np.exp(-(x**2 + y**2) / 8)
    flat = Memory(np.full((FRAMES, SIDE, SIDE), 25000, dtype="u2"))
    movie = InjectedMovie(
        flat, CAMERA, [Injected(50, FRAMES, 30.0, 30.0, 1.0, (15, 15), spot)],
        1, way,
    )  # fmt: skip
    late = 350
    image = 25000.0 - movie.read(late - 20, late + 20).mean(axis=0)
    rows, columns = np.indices(image.shape)
    found = np.array([np.sum(columns * image), np.sum(rows * image)]) / image.sum()
    np.testing.assert_allclose(found, 30 + np.array(RATE) * (late - 0.5 - 50), atol=0.1)


def test_injected_particles_are_recovered(movie: Path) -> None:
    config = _config("posterior.enabled=false")
    with open_stack(movie) as stack:
        summary = analyse(stack, config, Run(inject=6)).summary["injection"]
    assert summary["added"] == 12
    assert summary["recall"] > 0.7
    assert summary["recall_isolated"] in (None, 1.0)


def test_injection_needs_sliding_windows(movie: Path) -> None:
    config = _config("background.frames=[0, 60]", "posterior.enabled=false")
    with open_stack(movie) as stack, pytest.raises(ConfigError, match="`inject` = "):
        analyse(stack, config, Run(inject=8))


@pytest.mark.parametrize(("missing", "lost"), [(3, ""), (400, "67% of the movie")])
def test_frames_left_out_are_told_with_what_is_lost(missing: int, lost: str) -> None:
    """A pixel that is NaN in two thirds of the frames costs two thirds of the landings."""
    light = np.full(600, 1e4)
    light[200 : 200 + missing] = np.nan
    (found,) = frame_findings("m.tif", np.arange(200, 200 + missing), light, 0)
    said = found.text
    assert said.startswith("m.tif: frames 200, 201, 202")
    assert ("lost" in said) == bool(lost)
    assert lost in said
