"""Blocks of frames with a background each: how long they are, how tracks go on, what is kept."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from scenes import Stack, make_config
from scipy.ndimage import gaussian_filter
from wanderers import Wanderers, wander

import iscat_analysis.pipeline.finish as finish_module
import iscat_analysis.tracking.find as tracking_module
import iscat_analysis.tracking.frames as blocks_module
from iscat_analysis import pipeline
from iscat_analysis.calibration import with_standards
from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.fitting.run import RESUMPTION_HINT, partial_folder
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.records import Windows, silent
from iscat_analysis.threads import threads
from iscat_analysis.tracking.blocks import Block, combine_masses, join_tracks
from iscat_analysis.tracking.frames import (
    MOST_DRIFT_OVER_COUNTING,
    SHORTEST,
    Plan,
    Recording,
    drift_over_counting,
    follow_light,
    load_field,
    plan_blocks,
    tracking_context,
)
from iscat_analysis.tracking.linking import has_other_mass
from iscat_analysis.tracking.rows import Localizations
from iscat_analysis.tracking.stages import find_rows_and_background
from iscat_analysis.tracking.table import common_masses, moving_table, table_of_tracks

SHAPE = (120, 40, 40)
SPECIES = ((400.0, 0.15, 1), (300.0, 0.4, 1))
NEAR_NM = 300.0
GAIN = 20.0
LEVEL_E, ROUGH, LENGTH_PX = 4e5, 0.1, 3.0
SIGMAS = 4.0


def _config(**track: Any) -> Config:
    return make_config(
        background={"frames": None},
        camera={"pixel_size_nm": 84.0, "frame_rate_hz": 331.0, "gain_e_per_adu": GAIN},
        optics={"calibrate": "never"},
        particle={"mass_kda": 300.0},
        fit={"mode": "track", "frames": None, "roi_nm": 1800.0},
        track={"free": "mass", **track},
        simulation={"shape": list(SHAPE[1:])},
    )


def _unchecked(counts: Any, first: int) -> None:
    """Refuse nothing."""


@pytest.fixture(scope="module")
def wanderers() -> Wanderers:
    return wander(SHAPE, seed=4, species=SPECIES)


@pytest.fixture
def movie(wanderers: Wanderers, tmp_path: Path) -> Path:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, wanderers.counts, photometric="minisblack")
    return path


# ---- how long --------------------------------------------------------------------------------


def _drifting(frames: int, velocity_px: float, *, noise: bool = True) -> np.ndarray:
    """Make counts of a rough pattern that moves along x, without particles."""
    rng = np.random.default_rng(2)
    rough = gaussian_filter(rng.standard_normal((64, 64)), LENGTH_PX, mode="wrap")
    light = LEVEL_E * (1 + ROUGH * rough / rough.std())
    turn = -2j * np.pi * np.fft.rfftfreq(64) * velocity_px
    spectrum = np.fft.rfft2(light)
    moved = np.array([np.fft.irfft2(spectrum * np.exp(turn * t), s=(64, 64))
                      for t in range(frames)])  # fmt: skip
    electrons = rng.poisson(moved) if noise else moved
    return (electrons / GAIN).astype(np.float32)


def _plan(counts: np.ndarray, **sections: Any) -> Plan:
    config = _config(**sections.pop("track", {}))
    for name, changes in sections.items():
        part = getattr(config, name).model_copy(update=changes)
        config = config.model_copy(update={name: part})
    stack, camera = Stack(counts), Camera(gain_e_per_adu=GAIN)
    span = fitted_frames(stack, config)
    with threads(1) as pool:
        return plan_blocks(Recording(stack, camera, _unchecked, pool, silent), config, span)


def test_a_block_ends_where_drift_costs_more_than_counting() -> None:
    """Of a pattern of width s and roughness r K = B r²/(2 s²), and C = K v² T³/12."""
    frames, velocity = 600, 4e-4
    stiffness = LEVEL_E * ROUGH**2 / (2 * LENGTH_PX**2)
    expected = (12 * MOST_DRIFT_OVER_COUNTING / (stiffness * velocity**2)) ** (1 / 3)
    plan = _plan(_drifting(frames, velocity))
    assert plan.moved_px == pytest.approx((0.0, velocity * (frames - 1)), abs=2e-3)
    assert 0.8 * expected < plan.frames < 1.1 * expected  # blocks are whole parts of a movie
    assert plan.drifts
    assert plan.drift_over_counting is not None
    assert plan.drift_over_counting <= MOST_DRIFT_OVER_COUNTING
    share = MOST_DRIFT_OVER_COUNTING * (plan.frames / expected) ** 3
    assert plan.drift_over_counting == pytest.approx(share, rel=0.15)
    assert [a for a, _ in plan.spans[1:]] == [b for _, b in plan.spans[:-1]]
    assert (plan.spans[0][0], plan.spans[-1][1]) == (0, frames)
    assert f"{len(plan.spans)} blocks of {plan.frames} frames" in plan.finding("movie").text


def test_a_pattern_that_stands_still_is_one_block() -> None:
    plan = _plan(_drifting(300, 0.0))
    assert plan.spans == ((0, 300),)
    assert plan.drift_over_counting is not None
    assert plan.drift_over_counting < 0.2
    assert plan.finding("movie") is None


def test_particles_are_no_drift(wanderers: Wanderers) -> None:
    assert _plan(wanderers.counts).spans == ((0, SHAPE[0]),)


def test_fast_drift_ends_at_the_shortest_block_and_is_said() -> None:
    plan = _plan(_drifting(300, 0.02))
    assert plan.frames == SHORTEST
    assert plan.drift_over_counting is not None
    assert plan.drift_over_counting > 5
    assert "still change by" in plan.finding("movie").text


def test_cost_of_drift_is_that_of_single_pixels() -> None:
    """Mean over the frames of a block of (B(t) − B̄)²/B, times T: computed pixel by pixel."""
    frames, spans = 60, ((0, 20), (20, 60))
    counts = _drifting(frames, 0.004, noise=False) * GAIN
    inside = counts[:, 8:-8, 8:-8].astype(float)
    change = [
        (b - a) * np.sum((inside[a:b] - inside[a:b].mean(axis=0)) ** 2 / inside[a:b].mean(axis=0))
        for a, b in spans
    ]
    expected = sum(change) / inside.size
    stack, camera = Stack((counts / GAIN).astype(np.float32)), Camera(gain_e_per_adu=GAIN)
    with threads(1) as pool:
        recording = Recording(stack, camera, _unchecked, pool, silent)
        _, stiffness = follow_light(recording, _config(), (0, frames))
    shift = np.column_stack([np.zeros(frames), 0.004 * np.arange(frames)])
    assert drift_over_counting(shift, stiffness, spans) == pytest.approx(expected, rel=0.1)


def test_what_pulls_at_single_shifts_is_no_drift() -> None:
    """Second differences of independent shifts have 1 + 4 + 1 times their variance."""
    rng = np.random.default_rng(3)
    steady = np.outer(np.arange(2000), [0.3, -0.1])
    assert np.abs(blocks_module.jitter_covariance(steady)).max() < 1e-20
    found = blocks_module.jitter_covariance(steady + rng.normal(0, [0.02, 0.05], (2000, 2)))
    assert np.allclose(np.sqrt(np.diag(found)), [0.02, 0.05], rtol=SIGMAS * 0.03)
    assert abs(found[0, 1]) < SIGMAS * 0.02 * 0.05 / math.sqrt(600)


def test_memory_makes_blocks_of_equal_length(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = np.full((200, 8, 8), 1000, dtype=np.uint16)
    monkeypatch.setattr(blocks_module, "BYTES", 64e6 / (70 * 64))  # 70 frames in the least memory
    plan = _plan(counts, compute={"memory_limit_mb": 64})
    assert [b - a for a, b in plan.spans] == [66, 67, 67]
    assert not plan.drifts
    with pytest.raises(DataError, match=r"or lower track\.block_frames"):
        _plan(counts, compute={"memory_limit_mb": 64}, track={"block_frames": 100})
    monkeypatch.setattr(blocks_module, "BYTES", 64e6 / (19 * 64))
    with pytest.raises(DataError, match="a block of 20 frames takes 67 MB"):
        _plan(counts, compute={"memory_limit_mb": 64})


def test_the_length_may_be_given() -> None:
    counts = np.full((205, 40, 40), 1000, dtype=np.uint16)
    assert len(_plan(counts, track={"block_frames": 500}).spans) == 1
    assert [b - a for a, b in _plan(counts, track={"block_frames": 100}).spans] == [68, 68, 69]
    short = _plan(counts, track={"block_frames": 20}, fit={"frames": (10, 49)})
    assert short.spans == ((10, 49),)  # two would have fewer than 20 frames


# ---- how tracks go on ------------------------------------------------------------------------


def _block(span: tuple[int, int], tracks: list[tuple[range, float, float, float]]) -> Block:
    """Give a block of particles that stand still: frames, x, y and amplitude of each."""
    frame = np.concatenate([np.array(t, dtype=np.int64) for t, *_ in tracks])
    track = np.repeat(np.arange(len(tracks)), [len(t) for t, *_ in tracks])
    theta = np.array([[*tracks[k][1:3], 5.0, tracks[k][3], 0.0] for k in track])
    nothing, n = np.zeros((4, 4)), span[1] - span[0]
    return Block(
        span=span, rows=Localizations.of(frame, track, theta), error=1.0, table=pd.DataFrame(),
        inside=np.ones(len(frame), dtype=bool), masses=pd.DataFrame(), views=(),
        windows=Windows(
            nothing, nothing, n, n, 1.0, nothing, nothing, nothing > 0, nothing > 0, span, span,
            np.ones(2 * n),
        ),
    )  # fmt: skip


def test_tracks_go_on_where_they_ended() -> None:
    one = _block((0, 50), [(range(50), 0.0, 0.0, 40.0), (range(30, 48), 3000.0, 0.0, 40.0)])
    two = _block((50, 90), [
        (range(51, 90), 3200.0, 0.0, 40.0), (range(50, 90), 250.0, 0.0, 40.0),
        (range(60, 90), 6000.0, 0.0, 40.0),
    ])  # fmt: skip
    three = _block((90, 120), [(range(90, 120), 3300.0, 0.0, 40.0)])
    numbers = join_tracks(_config(), [one, two, three])
    assert [n.tolist() for n in numbers] == [[0, 1], [1, 0, 2], [1]]


@pytest.mark.parametrize(
    ("last", "begins", "x_nm", "joined"),
    [(49, 49, 500.0, True), (49, 52, 500.0, True), (49, 53, 500.0, False), (30, 70, 30.0, True)],
)
def test_a_particle_may_be_missed_at_a_border(
    last: int, begins: int, x_nm: float, joined: bool
) -> None:
    """By `track.memory_frames`; for longer where it is so slow that nobody else can be there."""
    one = _block((0, 50), [(range(last), 0.0, 0.0, 40.0)])
    two = _block((50, 90), [(range(begins, 90), x_nm, 0.0, 40.0)])
    numbers = join_tracks(_config(), [one, two])
    assert bool(numbers[0][0] == numbers[1][0]) is joined


def test_particles_of_unlike_mass_keep_their_numbers_where_they_cross() -> None:
    """They change places within the reach from one block to the next, 200 nm apart."""
    one = _block((0, 50), [(range(50), 0.0, 0.0, 40.0), (range(50), 200.0, 0.0, 20.0)])
    two = _block((50, 90), [(range(50, 90), 0.0, 0.0, 20.0), (range(50, 90), 200.0, 0.0, 40.0)])
    numbers = join_tracks(_config(), [one, two])
    assert numbers[0].tolist() == numbers[1].tolist()[::-1]


def test_an_empty_block_is_passed_over() -> None:
    nothing = Localizations.of(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 5)))
    one, two = (_block(s, [(range(*s), 0.0, 0.0, 40.0)]) for s in ((0, 30), (60, 90)))
    between = _block((30, 60), [(range(30, 60), 0.0, 0.0, 40.0)])
    between = Block(**{**vars(between), "rows": nothing})
    numbers = join_tracks(_config(), [one, between, two])
    assert [n.tolist() for n in numbers] == [[0], [], [0]]  # it hardly moved: bridged


def _parts(*parts: tuple[list[float], list[float], list[float]]) -> list[pd.DataFrame]:
    return [
        pd.DataFrame(
            {"mass_kda": m, "sigma_mass_kda": s, "crb_mass_kda": s, "blur": b, "told": 0.5}
        )
        for m, s, b in parts
    ]


def test_masses_of_parts_are_combined_by_their_variances() -> None:
    parts = _parts(
        ([100.0, 60.0], [3.0, 1.0], [1.0, 0.0]),
        ([110.0, np.nan, 64.0], [4.0, np.inf, 2.0], [1.0, 1.0, 0.0]),
    )
    numbers = [np.array([0, 1]), np.array([0, 1, 1])]
    table = pd.DataFrame({"track": [0, 0, 0, 1], "mass_kda": [104.0, 99.0, 108.0, 61.0]})
    found = combine_masses(parts, numbers, table)
    weights = np.array([1 / 9, 1 / 16])
    assert found.loc[0, "mass_kda"] == pytest.approx(weights @ [100.0, 110.0] / weights.sum())
    assert found.loc[0, "sigma_mass_kda"] == pytest.approx(2.4)
    # none of the second knows its blur and counts nevertheless: there is no better part
    assert found.loc[1, "mass_kda"] == pytest.approx((60 + 64 / 4) / 1.25)
    parts[1].loc[2, "blur"] = 1.0
    assert combine_masses(parts, numbers, table).loc[1, "mass_kda"] == pytest.approx(64.0)


def test_a_part_that_is_no_part_of_its_track_does_not_count() -> None:
    """As where a particle that stands still in a block is taken for background, or for a hole."""
    parts = _parts(([400.0], [4.0], [1.0]), ([-300.0], [4.0], [1.0]), ([406.0], [4.0], [1.0]))
    mass = np.concatenate([np.full(40, 400.0), np.full(30, -300.0), np.full(40, 404.0)])
    table = pd.DataFrame({"track": 0, "mass_kda": mass})
    found = combine_masses(parts, [np.zeros(1, dtype=np.int64)] * 3, table)
    assert found.loc[0, "mass_kda"] == pytest.approx(403.0)
    rng = np.random.default_rng(1)
    off = has_other_mass(
        np.zeros(110, dtype=np.int64), mass + rng.normal(0, 20, 110), np.full(110, 20.0)
    )
    assert np.array_equal(off, mass < 0)


# ---- the whole job ---------------------------------------------------------------------------


def _whole(counts: np.ndarray, config: Config) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Give the rows and masses of a movie that is followed as one."""
    stack, camera = Stack(counts), Camera(gain_e_per_adu=GAIN)
    context = tracking_context(config, (counts.shape[1], counts.shape[2]), len(counts))
    with threads(2) as pool:
        recording = Recording(stack, camera, _unchecked, pool, silent)
        moving = find_rows_and_background(context, recording, (0, len(counts)))
    inside = moving.field.holds(moving.rows.theta)
    table = table_of_tracks(
        moving_table(context, moving, 0), moving.rows.track, inside, config.track.min_frames,
        parted=False,
    )  # fmt: skip
    return table, common_masses(context, moving)


@pytest.mark.parametrize(
    ("stored", "offset", "kept"),
    [
        (np.uint16, 5.0, np.uint16),
        (np.uint8, 5.0, np.uint16),
        (np.int16, 5.0, np.float32),
        (np.float32, 5.0, np.float32),
        (np.uint16, np.linspace(4.0, 6.0, 576).reshape(24, 24), np.float32),
    ],
)
def test_frames_are_kept_as_they_are_stored_where_one_gain_is_theirs(
    stored: type, offset: Any, kept: type
) -> None:
    counts = np.random.default_rng(1).integers(90, 110, (30, 24, 24)).astype(stored)
    camera = Camera(gain_e_per_adu=GAIN, offset_adu=offset)
    context = tracking_context(_config(), (24, 24), len(counts))
    electrons = camera.to_electrons(counts[4:])
    with threads(2) as pool:
        recording = Recording(Stack(counts), camera, _unchecked, pool, silent)
        field = load_field(context, recording, (4, 30))
        total, totals = field.total_e, field.frame_totals
    assert field.exposures.counts.dtype == kept
    np.testing.assert_allclose(field.exposures.electrons(slice(None)), electrons, rtol=1e-6)
    np.testing.assert_allclose(total, electrons.sum(axis=0), rtol=1e-6)
    np.testing.assert_allclose(totals, electrons[:, field.used].sum(axis=1), rtol=1e-6)


def test_a_movie_that_fits_and_stands_still_is_followed_as_one(
    movie: Path, wanderers: Wanderers
) -> None:
    with open_stack(movie) as stack:
        found = analyse(stack, _config())
    assert found.summary["blocks"]["number"] == 1
    table, masses = _whole(wanderers.counts, with_standards(_config()))
    pd.testing.assert_frame_equal(found.table[table.columns], table, check_exact=True)
    assert found.tracks is not None
    for row in found.tracks.itertuples():
        assert row.mass_kda == masses.loc[row.track, "mass_kda"]
        assert row.sigma_mass_kda == masses.loc[row.track, "sigma_mass_kda"]


@pytest.fixture(scope="module")
def in_blocks(wanderers: Wanderers, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("blocks") / "movie.tif"
    tifffile.imwrite(path, wanderers.counts, photometric="minisblack")
    with open_stack(path) as stack:
        return analyse(stack, _config(block_frames=40))


def test_tracks_and_masses_go_through_blocks(in_blocks: Any, wanderers: Wanderers) -> None:
    """Every particle has one number, its mass and its rows; pulls are those of one block."""
    assert in_blocks.summary["blocks"]["number"] == 3
    table, truth = in_blocks.table, wanderers.truth
    assert set(table["n_before"]) == {40}
    pulls = []
    for particle, path in truth.groupby("track"):
        there = path[path["inside"]].set_index("frame")
        rows = table[table["frame"].isin(there.index)]
        here = there.loc[rows["frame"]]
        away = np.hypot(rows["x_nm"].to_numpy() - here["x_nm"].to_numpy(),
                        rows["y_nm"].to_numpy() - here["y_nm"].to_numpy())  # fmt: skip
        mine = rows[away < NEAR_NM]
        assert mine["track"].nunique() == 1, particle
        assert len(mine) > 0.97 * len(there)
        row = in_blocks.tracks.set_index("track").loc[mine["track"].iloc[0]]
        assert abs(row["mass_kda"] - here["mass_kda"].iloc[0]) < SIGMAS * row["sigma_mass_kda"]
        assert row["sigma_mass_kda"] < 0.02 * row["mass_kda"]
        assert row["n_frames"] >= len(mine)
        pulls.append((mine["mass_kda"] - here["mass_kda"].iloc[0]) / mine["sigma_mass_kda"])
    joined = np.concatenate(pulls)
    assert abs(joined.mean()) < SIGMAS / math.sqrt(joined.size)
    assert abs(joined.std() - 1) < SIGMAS / math.sqrt(2 * joined.size)
    assert len(in_blocks.views) == len(in_blocks.tracks)
    for film in in_blocks.films:  # each block over its own background
        assert abs(np.nanstd(film.residual) - 1) < 0.1


# ---- interrupts, resumption ----------------------------------------------------------


def _stop_at(share: float) -> Callable[[str, int, int], None]:
    def stop(stage: str, done: int, total: int) -> None:
        if stage == "track" and done > share * total:
            raise KeyboardInterrupt

    return stop


def test_an_interrupted_run_resumes_to_the_same_result(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_blocks: Any
) -> None:
    calls: list[tuple[int, int]] = []
    real = tracking_module.analyse_block

    def counted(*arguments: Any, **named: Any) -> Block:
        calls.append(arguments[2])
        return real(*arguments, **named)

    monkeypatch.setattr(tracking_module, "analyse_block", counted)
    config, out = _config(block_frames=40), tmp_path / "cut.iscat"
    stop, stages = _stop_at(0.75), []

    def told(stage: str, done: int, total: int) -> None:
        stages.append(stage)
        stop(stage, done, total)

    lines: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        fit_stack(movie, config, out=out, progress=told, notify=lines.append)
    assert lines[-1].endswith(f"is in {out}, and the same command goes on from there")
    after = stages[len(stages) - stages[::-1].index("track") :]
    assert set(after) == {"report"}  # the command line gives time for it, and for nothing else
    assert calls == [(0, 40), (40, 80), (80, 120)]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"]
    cut = pd.read_csv(out / "fits.csv")
    assert cut["frame"].max() == 79
    assert len(list(partial_folder(out).glob("*.npz"))) == 2
    said: list[str] = []
    whole = fit_stack(movie, config, out=out, notify=said.append)  # no --overwrite: it goes on
    assert calls[3:] == [(80, 120)]
    assert not whole.summary["interrupted"]
    assert not partial_folder(out).exists()
    pd.testing.assert_frame_equal(whole.table, in_blocks.table, check_exact=True)
    pd.testing.assert_frame_equal(whole.tracks, in_blocks.tracks, check_exact=True)
    assert len(whole.views) == len(in_blocks.views)
    for one, two in zip(whole.views, in_blocks.views, strict=True):
        assert one.event == two.event
        assert np.array_equal(one.residual, two.residual, equal_nan=True)


def test_an_interrupt_before_anything_is_finished_leaves_nothing(
    movie: Path, tmp_path: Path
) -> None:
    out = tmp_path / "cut.iscat"
    with pytest.raises(KeyboardInterrupt, match=r"nothing is kept.* in one of 120 frames"):
        fit_stack(movie, _config(), out=out, progress=_stop_at(0.0))
    assert not out.exists()
    assert not partial_folder(out).exists()
    with pytest.raises(KeyboardInterrupt, match=r"nothing is kept.* in 3 of them"):
        fit_stack(movie, _config(block_frames=40), out=out, progress=_stop_at(0.0))


@pytest.mark.parametrize("late", ["tracks", "report"])
def test_tracks_are_kept_where_their_report_is_interrupted(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late: str
) -> None:
    """There is no folder yet, but a hidden one that the same command goes on from, as it says."""

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt("SIGTERM was received")

    config, out = _config(), tmp_path / "cut.iscat"
    with monkeypatch.context() as patch:
        where = (finish_module, "summary_of") if late == "tracks" else (pipeline, "write_report")
        patch.setattr(*where, stop)
        with pytest.raises(KeyboardInterrupt) as stopped:
            fit_stack(movie, config, out=out)
    assert str(stopped.value) == f"SIGTERM was received; {RESUMPTION_HINT}"
    assert not out.exists()
    monkeypatch.setattr(tracking_module, "analyse_block", stop)  # which is not needed again
    assert len(fit_stack(movie, config, out=out).table)
    assert not partial_folder(out).exists()
