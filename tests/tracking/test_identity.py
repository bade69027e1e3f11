"""Particles that met have their own numbers again, told by how fast they go and by their masses."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.config import Config, load_config
from iscat_analysis.tracking.linking import bridge, identified, meeting
from iscat_analysis.tracking.rows import Localizations

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
    return Localizations.of(frame, track, np.concatenate(tables), track)


def _exchanged(rows: Localizations, after: int) -> Localizations:
    track = np.where(rows.frame > after, 1 - rows.track, rows.track)
    return Localizations.of(rows.frame, track, rows.theta, rows.group)


def _same(one: Localizations, two: Localizations) -> bool:
    """Whether all places are in the same tracks, by which the rows of a frame are in order."""
    return np.array_equal(one.track, two.track) and np.array_equal(one.theta, two.theta)


def _outside(rows: Localizations) -> dict[tuple[int, int], tuple[float, ...]]:
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
        Localizations.of(rest.frame, track, rest.theta, rest.group), near_nm=NEAR_NM, error=ERROR
    )
    assert _outside(found) == _outside(true)


def test_what_ends_and_begins_far_from_others_stays_apart() -> None:
    true = _pair(np.random.default_rng(0), (30.0, 70.0), (20.0, 20.0))
    away = np.where(true.track[:, None] == 1, [0.0, 5000.0, 0.0, 0.0, 0.0], 0.0)
    track = np.where((true.frame > MEET) & (true.track == 0), 2, true.track)
    given = Localizations.of(true.frame, track, true.theta + away, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert _same(found, given)


def test_a_particle_of_another_mass_is_a_new_one() -> None:
    true = _pair(np.random.default_rng(0), (30.0, 70.0), (20.0, 20.0))
    later = (true.frame > MEET) & (true.track == 0)
    track = np.where(later, 2, true.track)
    heavier = np.where(later[:, None], [0.0, 0.0, 0.0, 20.0, 0.0], 0.0)
    given = Localizations.of(true.frame, track, true.theta + heavier, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert _same(found, given)


def test_particles_that_are_alike_keep_the_numbers_that_they_have() -> None:
    """By chance one pair in e⁸ would change its numbers; of 200, none may."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        true = _pair(rng, (30.0, 30.0), (20.0, 20.0))
        assert _same(identified(true, near_nm=NEAR_NM, error=ERROR), true)


def test_particles_that_never_meet_are_left_alone() -> None:
    true = _pair(np.random.default_rng(1), (30.0, 70.0), (20.0, 20.0))
    wrong = _exchanged(true, MEET)
    far = identified(wrong, near_nm=1e-6, error=ERROR)
    assert _same(far, wrong)


def test_of_two_meetings_each_is_judged_by_what_lies_between() -> None:
    rng = np.random.default_rng(3)
    one, two = _pair(rng, (30.0, 70.0), (20.0, 20.0)), _pair(rng, (30.0, 70.0), (20.0, 20.0))
    true = Localizations.of(
        np.append(one.frame, two.frame + FRAMES), np.append(one.track, two.track),
        np.concatenate([one.theta, two.theta]), np.append(one.group, two.group),
    )  # fmt: skip
    between = (true.frame > MEET) & (true.frame <= MEET + FRAMES)
    track = np.where(between, 1 - true.track, true.track)
    given = Localizations.of(true.frame, track, true.theta, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert _outside(found) == _outside(true)


def _three(rng: np.random.Generator, frames: int = FRAMES) -> Localizations:
    """Three particles that meet in the middle: two of one speed, and two of one mass."""
    tables = []
    for k, (step, mass) in enumerate(((30.0, 20.0), (30.0, 40.0), (70.0, 40.0))):
        walk = np.cumsum(rng.normal(0.0, step, (frames, 2)), axis=0)
        angle = 2 * np.pi * k / 3
        away = 40.0 * np.abs(np.arange(frames) - frames // 2) + 50.0
        there = walk - walk[frames // 2] + away[:, None] * [np.cos(angle), np.sin(angle)]
        amplitude = mass + ERROR * rng.standard_normal(frames)
        tables.append(np.column_stack([there, np.zeros(frames), amplitude, np.zeros(frames)]))
    track = np.repeat(np.arange(3), frames)
    return Localizations.of(np.tile(np.arange(frames), 3), track, np.concatenate(tables), track)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("later", [(1, 2, 0), (2, 0, 1), (0, 2, 1), (0, 1, 2)])
def test_three_that_meet_are_told_apart(seed: int, later: tuple[int, int, int]) -> None:
    true = _three(np.random.default_rng(seed))
    track = np.where(true.frame > MEET, np.array(later)[true.track], true.track)
    given = Localizations.of(true.frame, track, true.theta, true.group)
    assert _outside(identified(given, near_nm=NEAR_NM, error=ERROR)) == _outside(true)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("faint", [0, 2, 3])
def test_a_track_that_ends_among_others_goes_on_though_another_had_begun(
    seed: int, faint: int
) -> None:
    """Of three particles four tracks for a while, one of them of hardly any light."""
    true = _three(np.random.default_rng(seed))
    early, late = true.frame < MEET - 3, true.frame > MEET + 3
    # the third ends late, what goes on as the second began early, and the first jumps to the third
    track = np.where(late, np.array([1, 3, 0])[true.track], true.track)
    extra = true.only((true.track == 1) & ~early & ~late)
    theta = np.concatenate([true.theta, extra.theta + np.array([0.0, 60.0, 0.0, 0.0, 0.0])])
    track = np.append(track, np.full(len(extra.frame), 3))
    frame = np.append(true.frame, extra.frame)
    theta[(np.abs(frame - MEET) <= 3) & (track == faint), 3] = 1.0
    given = Localizations.of(frame, track, theta, np.append(true.group, extra.group))
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    assert _outside(found) == _outside(true)
    assert len(found.frame) == len(true.frame)
    assert found.theta[:, 3].min() > 10.0  # the faint rows are those that are left out


@pytest.mark.parametrize("seed", range(5))
def test_what_goes_on_alone_is_the_one_that_it_is_like(seed: int) -> None:
    """The other one ends where they met, as at the border of the field."""
    true = _pair(np.random.default_rng(seed), (30.0, 70.0), (20.0, 20.0))
    rest = true.only((true.track == 0) | (true.frame <= MEET))
    for given in (rest, _exchanged(rest, MEET)):
        found = identified(given, near_nm=NEAR_NM, error=ERROR)
        assert _outside(found) == _outside(rest)


@pytest.mark.parametrize("seed", range(5))
def test_two_may_be_one_picture_for_long(seed: int) -> None:
    """Both diffuse together, and have one track while they are one picture."""
    rng = np.random.default_rng(seed)
    true = _pair(rng, (30.0, 70.0), (20.0, 20.0))
    met = np.abs(true.frame - MEET) <= 1
    rest = true.only(~met | ((true.track == 1) & (true.frame <= MEET)))
    late = 40 * (rest.frame > MEET)  # frames in which there is a row of one of them only
    track = np.where((rest.frame > MEET), np.array([1, 2])[rest.track], rest.track)
    between = np.arange(MEET + 1, MEET + 41)
    theta = np.repeat(rest.theta[(rest.frame == MEET) & (rest.track == 1)], 40, axis=0)
    theta[:, 3] = 40.0
    given = Localizations.of(
        np.append(rest.frame + late, between), np.append(track, np.full(40, 1)),
        np.concatenate([rest.theta, theta]), np.append(rest.group, np.full(40, 1)),
    )  # fmt: skip
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    for k in range(2):
        after = found.only((found.track == k) & (found.frame > MEET + 40 + AROUND))
        mine = rest.only((rest.track == k) & (rest.frame > MEET + AROUND))
        assert np.array_equal(after.theta, mine.theta)


@pytest.mark.parametrize("seed", range(5))
def test_a_meeting_after_an_exchange_is_judged_by_who_is_there(seed: int) -> None:
    """The second meets the first, which is taken for it from there on, and then a third."""
    rng = np.random.default_rng(seed)
    true = _pair(rng, (30.0, 30.0), (20.0, 40.0))
    second, third = 160, true.only(true.track == 1)
    here = third.theta[second, :2]
    theta = third.theta.copy()
    theta[:, :2] = here + np.cumsum(rng.normal(0.0, 70.0, (FRAMES, 2)), axis=0)
    theta[:, :2] += here - theta[second, :2] + [50.0, 0.0]
    theta[:, 0] += 40.0 * np.abs(np.arange(FRAMES) - second)
    true = Localizations.of(
        np.append(true.frame, third.frame), np.append(true.track, np.full(FRAMES, 2)),
        np.concatenate([true.theta, theta]), np.append(true.group, np.full(FRAMES, 2)),
    )  # fmt: skip
    track = np.where(true.frame > MEET, np.array([1, 0, 2])[true.track], true.track)
    track = np.where(true.frame > second, np.array([1, 2, 0])[true.track], track)
    given = Localizations.of(true.frame, track, true.theta, true.group)
    found = identified(given, near_nm=NEAR_NM, error=ERROR)
    plain = np.abs(found.frame - second) > AROUND
    assert _outside(found.only(plain)) == _outside(true.only(np.abs(true.frame - second) > AROUND))


@pytest.mark.parametrize("seed", range(5))
def test_who_passes_neighbours_is_told_from_them(seed: int) -> None:
    """Two that stay beside each other, met by a third of another mass."""
    rng = np.random.default_rng(seed)
    frames, met = 800, 400
    walk = np.cumsum(rng.normal(0.0, 30.0, (frames, 2)), axis=0)
    places = [[0.0, 0.0], [300.0, 0.0], None]
    tables = []
    for place, mass in zip(places, (20.0, 20.0, 40.0), strict=True):
        still = rng.normal(0.0, 5.0, (frames, 2)) + (place or 0.0)
        away = [0.0, 30.0] * np.abs(np.arange(frames) - met)[:, None] + [0.0, 50.0]
        xy = still if place else walk - walk[met] + away
        amplitude = mass + ERROR * rng.standard_normal(frames)
        tables.append(np.column_stack([xy, np.zeros(frames), amplitude, np.zeros(frames)]))
    track = np.repeat(np.arange(3), frames)
    true = Localizations.of(np.tile(np.arange(frames), 3), track, np.concatenate(tables), track)
    wrong = np.where(true.frame > met, np.array([2, 1, 0])[true.track], true.track)
    for given in (true.track, wrong):
        found = identified(
            Localizations.of(true.frame, given, true.theta, true.group),
            near_nm=NEAR_NM,
            error=ERROR,
        )
        late = found.frame > met + AROUND
        assert found.theta[late & (found.track == 2), 3].mean() == pytest.approx(40.0, abs=0.5)
        assert found.theta[late & (found.track < 2), 3].mean() == pytest.approx(20.0, abs=0.5)


def test_masses_that_neighbours_change_a_little_exchange_nobody() -> None:
    """Parts of one particle differ by 2 %, ten standard errors of their frames."""
    rng = np.random.default_rng(11)
    for _ in range(200):
        true = _pair(rng, (30.0, 30.0), (100.0, 100.0))
        part = 2 * true.track + (true.frame > MEET)
        theta = true.theta.copy()
        theta[:, 3] *= 1 + 0.02 * rng.standard_normal(4)[part]
        given = Localizations.of(true.frame, true.track, theta, true.group)
        assert _same(identified(given, near_nm=NEAR_NM, error=ERROR), given)


def test_no_rows_and_one_track_stay_as_they_are() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    empty = Localizations.of(nothing, nothing, np.zeros((0, 5)))
    assert len(identified(empty, near_nm=NEAR_NM, error=ERROR).frame) == 0
    single = _pair(np.random.default_rng(2), (30.0, 70.0), (20.0, 20.0))
    single = single.only(single.track == 0)
    assert _same(identified(single, near_nm=NEAR_NM, error=ERROR), single)


def test_rows_shortly_before_and_after_a_meeting_are_of_it() -> None:
    """The partner of a row may be hidden where there is none beside it."""
    frame = np.array([10, 10, 11, 12, 13, 20, 20, 40, 41])
    track = np.array([0, 1, 0, 0, 0, 0, 1, 1, 2])
    theta = np.zeros((9, 5))
    theta[1, 0], theta[6, 0], theta[8, 1] = 300.0, 3000.0, 100.0  # close, far, and of another time
    rows = Localizations.of(frame, track, theta, track)
    assert meeting(rows, 500.0).tolist() == [True] * 5 + [False] * 4
    assert not meeting(rows, 200.0).any()
    assert not meeting(rows.only(np.zeros(9, dtype=bool)), 500.0).size


def _still(*parts: tuple[range, float, float]) -> Localizations:
    """Rows of particles at places x [nm], whose steps are so long along y [nm]."""
    tables = []
    for track, (frames, x, step) in enumerate(parts):
        y = step * (np.arange(len(frames)) % 2)
        tables += [(t, track, x, v) for t, v in zip(frames, y.tolist(), strict=True)]
    frame, track, x, y = np.array(sorted(tables)).T
    theta = np.zeros((len(frame), 5))
    theta[:, 0], theta[:, 1] = x, y
    return Localizations.of(frame.astype(np.int64), track.astype(np.int64), theta)


def _bridged(rows: Localizations) -> list[int]:
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
