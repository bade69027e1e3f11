"""Particles that met have their own numbers again, told by how fast they go and by their masses."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.config import Config, load_config
from iscat_analysis.inference.rows import Rows
from iscat_analysis.pipeline.identity import identified
from iscat_analysis.pipeline.linking import bridge, meeting

FRAMES, MEET, AROUND = 200, 100, 25
NEAR_NM, ERROR = 370.0, 1.0


def _pair(rng: np.random.Generator, steps_nm: tuple[float, float], mass: tuple[float, float]):
    """Two particles that meet in the middle of a movie: their rows, under their true numbers."""
    tables = []
    for k in range(2):
        walk = np.cumsum(rng.normal(0.0, steps_nm[k], (FRAMES, 2)), axis=0)
        there = walk - walk[MEET] + [100.0 * k, 0.0]
        away = 40.0 * (2 * k - 1) * np.abs(np.arange(FRAMES) - MEET)[:, None] * [0.0, 1.0]
        amplitude = mass[k] + ERROR * rng.standard_normal(FRAMES)
        tables.append(
            np.column_stack([there + away, np.zeros(FRAMES), amplitude, np.zeros(FRAMES)])
        )
    frame = np.tile(np.arange(FRAMES), 2)
    track = np.repeat([0, 1], FRAMES)
    return Rows.of(frame, track, np.concatenate(tables), track)


def _exchanged(rows: Rows, after: int) -> Rows:
    track = np.where(rows.frame > after, 1 - rows.track, rows.track)
    return Rows.of(rows.frame, track, rows.theta, rows.group)


def _outside(rows: Rows) -> dict[tuple[int, int], tuple[float, ...]]:
    """Who is where, but for the frames around a meeting, in which it cannot be told."""
    rows = rows.only(np.abs(rows.frame % FRAMES - MEET) > AROUND)
    pairs = zip(rows.frame.tolist(), rows.track.tolist(), strict=True)
    return dict(zip(pairs, map(tuple, rows.theta.tolist()), strict=True))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("steps", "mass"), [((30.0, 70.0), (20.0, 20.0)), ((30.0, 30.0), (20.0, 21.5))]
)
def test_an_exchange_is_undone(
    seed: int, steps: tuple[float, float], mass: tuple[float, float]
) -> None:
    true = _pair(np.random.default_rng(seed), steps, mass)
    for given in (true, _exchanged(true, MEET)):
        found = identified(given, near_nm=NEAR_NM, error=ERROR)
        assert _outside(found) == _outside(true)
    assert set(zip(found.track.tolist(), found.group.tolist(), strict=True)) == {(0, 0), (1, 1)}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("crossed", [False, True])
@pytest.mark.parametrize(
    ("steps", "mass"), [((30.0, 70.0), (20.0, 20.0)), ((30.0, 30.0), (20.0, 21.5))]
)
def test_what_ends_beside_another_goes_on_where_that_parts(
    seed: int, crossed: bool, steps: tuple[float, float], mass: tuple[float, float]
) -> None:
    """One track for two while they are together; who goes on with it is not known."""
    true = _pair(np.random.default_rng(seed), steps, mass)
    after = true.frame > MEET
    lost = (true.track == (after if crossed else 0)) & (np.abs(true.frame - MEET) <= 1)
    rest = true.only(~lost)
    later = rest.frame > MEET
    track = np.where(later & (rest.track == 0), 2, rest.track)
    if crossed:
        track = np.where(later, np.where(rest.track == 0, 1, 2), rest.track)
    found = identified(
        Rows.of(rest.frame, track, rest.theta, rest.group), near_nm=NEAR_NM, error=ERROR
    )
    assert _outside(found) == _outside(true)


def test_what_ends_and_begins_far_from_others_stays_apart() -> None:
    true = _pair(np.random.default_rng(0), (30.0, 70.0), (20.0, 20.0))
    away = np.where(true.track[:, None] == 1, [0.0, 5000.0, 0.0, 0.0, 0.0], 0.0)
    track = np.where((true.frame > MEET) & (true.track == 0), 2, true.track)
    given = Rows.of(true.frame, track, true.theta + away, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert np.array_equal(found.track, given.track)


def test_a_particle_of_another_mass_is_a_new_one() -> None:
    true = _pair(np.random.default_rng(0), (30.0, 70.0), (20.0, 20.0))
    later = (true.frame > MEET) & (true.track == 0)
    track = np.where(later, 2, true.track)
    heavier = np.where(later[:, None], [0.0, 0.0, 0.0, 20.0, 0.0], 0.0)
    given = Rows.of(true.frame, track, true.theta + heavier, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert np.array_equal(found.track, given.track)


def test_particles_that_are_alike_keep_the_numbers_that_they_have() -> None:
    """By chance one pair in e⁸ would change its numbers; of 200, none may."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        true = _pair(rng, (30.0, 30.0), (20.0, 20.0))
        assert np.array_equal(identified(true, near_nm=NEAR_NM, error=ERROR).track, true.track)


def test_particles_that_never_meet_are_left_alone() -> None:
    true = _pair(np.random.default_rng(1), (30.0, 70.0), (20.0, 20.0))
    wrong = _exchanged(true, MEET)
    far = identified(wrong, near_nm=1e-6, error=ERROR)
    assert np.array_equal(far.track, wrong.track)


def test_of_two_meetings_each_is_judged_by_what_lies_between() -> None:
    rng = np.random.default_rng(3)
    one, two = _pair(rng, (30.0, 70.0), (20.0, 20.0)), _pair(rng, (30.0, 70.0), (20.0, 20.0))
    true = Rows.of(
        np.append(one.frame, two.frame + FRAMES), np.append(one.track, two.track),
        np.concatenate([one.theta, two.theta]), np.append(one.group, two.group),
    )  # fmt: skip
    between = (true.frame > MEET) & (true.frame <= MEET + FRAMES)
    track = np.where(between, 1 - true.track, true.track)
    given = Rows.of(true.frame, track, true.theta, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert _outside(found) == _outside(true)


def test_no_rows_and_one_track_stay_as_they_are() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    empty = Rows.of(nothing, nothing, np.zeros((0, 5)))
    assert len(identified(empty, near_nm=NEAR_NM, error=ERROR).frame) == 0
    single = _pair(np.random.default_rng(2), (30.0, 70.0), (20.0, 20.0))
    single = single.only(single.track == 0)
    assert np.array_equal(identified(single, near_nm=NEAR_NM, error=ERROR).track, single.track)


def test_rows_shortly_before_and_after_a_meeting_are_of_it() -> None:
    """The partner of a row may be hidden where there is none beside it."""
    frame = np.array([10, 10, 11, 12, 13, 20, 20, 40, 41])
    track = np.array([0, 1, 0, 0, 0, 0, 1, 1, 2])
    theta = np.zeros((9, 5))
    theta[1, 0], theta[6, 0], theta[8, 1] = 300.0, 3000.0, 100.0  # close, far, and of another time
    rows = Rows.of(frame, track, theta, track)
    assert meeting(rows, 500.0).tolist() == [True] * 5 + [False] * 4
    assert not meeting(rows, 200.0).any()
    assert not meeting(rows.only(np.zeros(9, dtype=bool)), 500.0).size


def _still(*parts: tuple[range, float, float]) -> Rows:
    """Rows of particles at places x [nm], whose steps are so long along y [nm]."""
    tables = []
    for track, (frames, x, step) in enumerate(parts):
        y = step * (np.arange(len(frames)) % 2)
        tables += [(t, track, x, v) for t, v in zip(frames, y.tolist(), strict=True)]
    frame, track, x, y = np.array(sorted(tables)).T
    theta = np.zeros((len(frame), 5))
    theta[:, 0], theta[:, 1] = x, y
    return Rows.of(frame.astype(np.int64), track.astype(np.int64), theta)


def _bridged(rows: Rows) -> list[int]:
    """Give the track that each of the given ones is part of then."""
    track = bridge(_config(), rows)
    return [int(track[rows.track == k][0]) for k in np.unique(rows.track)]


def _config() -> Config:
    return load_config(None, ["camera.pixel_size_nm=84", "fit.mode=track"])


def test_what_hides_in_the_background_for_a_while_is_one_particle() -> None:
    rest = (range(10, 40), 90.0, 1.0)
    assert _bridged(_still((range(6), 80.0, 1.0), rest, (range(90, 99), 95.0, 1.0))) == [0, 0, 0]
    assert _bridged(_still((range(6), 80.0, 1.0), (range(107, 120), 80.0, 1.0))) == [0, 1]
    assert _bridged(_still((range(6), 80.0, 90.0), (range(46, 99), 80.0, 90.0))) == [0, 1]
    assert _bridged(_still((range(6), 80.0, 1.0), (range(9, 20), 900.0, 1.0))) == [0, 1]
    assert _bridged(_still((range(6), 80.0, 1.0), (range(3, 20), 90.0, 1.0))) == [0, 1]


def test_of_two_that_vanished_the_nearer_one_comes_back() -> None:
    one, two = (range(20), 100.0, 1.0), (range(25), 300.0, 1.0)
    assert _bridged(_still(one, two, (range(40, 60), 240.0, 1.0))) == [0, 1, 1]
    both = _still(one, two, (range(40, 60), 220.0, 1.0), (range(45, 60), 130.0, 1.0))
    assert _bridged(both) == [0, 1, 1, 0]


def test_nothing_is_bridged_without_rows() -> None:
    rows = _still((range(3), 0.0, 1.0))
    assert not bridge(_config(), rows.only(rows.track > 0)).size
