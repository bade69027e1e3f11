"""What the frames of a track have in common: one mass, and the errors of its background."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.config import BackgroundConfig
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.tracking import joint as common
from iscat_analysis.tracking.field import Exposures, MovingField
from iscat_analysis.tracking.joint import (
    Coupling,
    common_amplitudes,
    fit_jointly,
    shared_errors,
    variances_left,
)
from iscat_analysis.tracking.linking import extended
from iscat_analysis.tracking.rows import BackgroundEstimate, Judged, Localizations

SHAPE, FRAMES, LEVEL_E, ROI, MASS = (30, 30), 40, 4e5, 20, 400.0
TRIALS, SIGMAS = 40, 4.0
LEARNT = BackgroundConfig(method="tracks", power_normalization=False)


@pytest.fixture(scope="module")
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(2) as threads:
        yield threads


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return forward_model(make_config(), 1e4)


def _level() -> np.ndarray:
    """Light without particles."""
    return LEVEL_E * (1 + 0.1 * np.random.default_rng(2).standard_normal(SHAPE))


def _expected(model: ForwardModel, paths: np.ndarray) -> tuple[np.ndarray, Localizations]:
    """Mean counts of particles on paths (tracks, frames, 2), NaN where they are not, and rows."""
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    signal = np.zeros((FRAMES, *SHAPE))
    amplitude = model.scale.amplitude(MASS)
    frame, track, theta = [], [], []
    for k, path in enumerate(paths):
        for t, place in enumerate(path):
            if np.isfinite(place).all():
                signal[t] += model.image(grid, *place, model.height_nm, MASS)
                frame.append(t)
                track.append(k)
                theta.append([*place, model.height_nm, amplitude, 0.0])
    rows = Localizations.of(np.array(frame), np.array(track), np.array(theta))
    return _level() * (1 + signal), rows


def _field(model: ForwardModel, counts: np.ndarray, pool: ThreadPoolExecutor) -> MovingField:
    return MovingField(
        Exposures(counts.astype(np.float32)), np.zeros(SHAPE), np.ones(SHAPE, dtype=bool), model,
        model,
        pixel_nm=PIXEL_NM, roi_px=ROI, z_range_nm=None, pool=pool,
    )  # fmt: skip


def test_information_lost_is_that_of_all_parameters(
    model: ForwardModel, pool: ThreadPoolExecutor
) -> None:
    """One mass and the light of every pixel: the Schur complement of their Fisher matrix."""
    path = np.random.default_rng(4).normal(1250.0, 40.0, (1, FRAMES, 2))
    counts, rows = _expected(model, path)
    field = _field(model, counts, pool)
    ground = BackgroundEstimate(counts.mean(axis=0), np.ones(FRAMES))
    _, ground, _ = field.fit(ground, rows, sweeps=0)
    ground = BackgroundEstimate(ground.level, np.ones(FRAMES))
    judged = field.judge(ground, rows)
    one = np.array([0.0, 0.0, 1.0])
    coupling = Coupling(field, ground, judged.slopes, np.arange(FRAMES))
    taken = np.sum(coupling.sent(np.broadcast_to(one, (FRAMES, 1, 3))) ** 2)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    own = across = within = 0.0
    for theta in rows.theta:
        first = [round(c / PIXEL_NM - (ROI - 1) / 2) for c in theta[1::-1]]
        seen = np.zeros(SHAPE)
        seen[first[0] : first[0] + ROI, first[1] : first[1] + ROI] = 1.0
        signal, slopes = model.signal(grid, theta[:4])
        change = slopes[3] * seen
        own = own + np.sum(ground.level * change**2 / (1 + signal))
        across = across + ground.level * change / ground.level  # ∂λ/∂a ∂λ/∂B / λ
        within = within + (1 + signal) / ground.level
    assert taken == pytest.approx(np.sum(across**2 / within), rel=1e-3)
    assert 0.5 < taken / own < 1.0  # it hardly moves: most of what it says is lost


def test_common_mass_and_shared_errors_are_right(
    model: ForwardModel, pool: ThreadPoolExecutor
) -> None:
    """Over many movies: the mean of the masses, and their scatter, of a particle that is slow."""
    path = np.cumsum(np.random.default_rng(4).normal(0.0, 25.0, (1, FRAMES, 2)), axis=1) + 1250.0
    mean, truth = _expected(model, path)
    rng = np.random.default_rng(6)
    amplitude, variance, errors = [], [], []
    for _ in range(TRIALS):
        field = _field(model, rng.poisson(mean), pool)
        start = BackgroundEstimate(mean.mean(axis=0), np.ones(FRAMES))
        rows, ground, done = fit_jointly(field, start, truth, LEARNT)
        judged = field.judge(ground, rows)
        shared = shared_errors(field, ground, rows, judged)
        found = common_amplitudes(field, ground, rows, judged, done)
        amplitude.append(found.amplitude[0])
        variance.append(found.variance[0])
        index = np.array([0, 1, 3])
        own = np.linalg.inv(judged.fisher[:, index][:, :, index])
        spread = own + shared[:, index][:, :, index]
        off = (rows.theta[:, :4] - judged.bias - truth.theta[:, :4])[:, index]
        errors.append(off / np.sqrt(np.einsum("nii->ni", spread)))
        assert found.variance[0] > 2 * found.known[0]
    sigma = math.sqrt(np.mean(variance))
    true = model.scale.amplitude(MASS)
    assert abs(np.mean(amplitude) - true) < SIGMAS * sigma / math.sqrt(TRIALS)
    assert abs(np.std(amplitude) / sigma - 1) < SIGMAS / math.sqrt(2 * TRIALS)
    for pulls in np.moveaxis(np.array(errors), 2, 0):  # of x, y, a: (trials, frames)
        assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * TRIALS)


def _whole(
    model: ForwardModel,
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    judged: Judged,
) -> tuple[np.ndarray, np.ndarray]:
    """Give what its background adds to the rows of a track, and the covariance of all amplitudes.

    By the whole matrix of the pixels, from the slopes of the model itself.
    """
    grid, index = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM), np.array([0, 1, 3])
    slopes = np.zeros((len(rows.frame), 3, *SHAPE))
    for one, theta in zip(slopes, rows.theta, strict=True):
        r, c = (round(place / PIXEL_NM - (ROI - 1) / 2) for place in theta[1::-1])
        square = slice(max(r, 0), r + ROI), slice(max(c, 0), c + ROI)
        gradient = model.signal(grid, theta[:4])[1]
        one[:, *square] = (ground.level * gradient[index])[:, *square]
    own = np.linalg.inv(judged.fisher[:, index][:, :, index])
    follow = own @ slopes.reshape(len(own), 3, -1)
    left = np.diag(field.total_e.ravel())
    left -= np.einsum("nap,naq->pq", slopes.reshape(follow.shape), follow, optimize=True)
    inverse = np.linalg.inv(left)
    added = np.einsum("nap,pq,nbq->nab", follow, inverse, follow, optimize=True)
    amplitudes = follow[:, 2] @ inverse @ follow[:, 2].T + np.diag(own[:, 2, 2])
    return added, amplitudes


# steps of a particle [nm], and frames that it stays
TRACKS = {"fast": (60.0, FRAMES), "short": (60.0, 12), "slow": (8.0, FRAMES)}


@pytest.mark.parametrize("kind", TRACKS)
def test_shared_errors_are_those_of_all_pixels(
    model: ForwardModel, pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Within a thousandth of the variance, of rows and of a common mass."""
    step, frames = TRACKS[kind]
    path = np.cumsum(np.random.default_rng(4).normal(0.0, step, (1, FRAMES, 2)), axis=1) + 1250.0
    path[:, frames:] = np.nan
    mean, rows = _expected(model, path)
    field, ground = _field(model, mean, pool), BackgroundEstimate(_level(), np.ones(FRAMES))
    judged = field.judge(ground, rows)
    added, amplitudes = _whole(model, field, ground, rows, judged)
    index = np.array([0, 1, 3])
    scale = np.linalg.cholesky(np.linalg.inv(judged.fisher[:, index][:, :, index]) + added)

    def error() -> float:
        found = shared_errors(field, ground, rows, judged)[:, index][:, :, index]
        off = np.linalg.solve(scale, np.linalg.solve(scale, found - added).swapaxes(1, 2))
        return float(np.abs(np.linalg.eigvalsh(off)).max())

    assert error() < 1e-3
    monkeypatch.setattr(common, "MOST_VARIANCE_LEFT_OUT", math.inf)
    assert error() > 3e-3 or kind == "short"  # whose rows hardly feel one another
    found = common_amplitudes(field, ground, rows, judged, np.ones(frames, dtype=bool))
    weights = np.linalg.solve(amplitudes, np.ones(frames))
    assert found.variance[0] == pytest.approx(1 / weights.sum(), rel=1e-3)
    assert found.variance[0] > (1.001 if kind == "short" else 1.05) * found.known[0]


def test_a_particle_that_hardly_moves_is_worked_out_to_the_last_digit(
    model: ForwardModel, pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its background leaves less than 1e-5 of the information on its mass, a small difference."""
    path = np.random.default_rng(4).normal(0.0, 0.05 * PIXEL_NM, (1, FRAMES, 2)) + 1250.0
    mean, rows = _expected(model, path)
    field, ground = _field(model, mean, pool), BackgroundEstimate(_level(), np.ones(FRAMES))
    judged = field.judge(ground, rows)
    every = np.ones(FRAMES, dtype=bool)
    index = np.array([0, 1, 3])
    inverse = np.linalg.inv(judged.fisher[:, index][:, :, index])
    coupling = Coupling(field, ground, judged.slopes, np.arange(FRAMES))
    alone = np.eye(3 * FRAMES).reshape(3 * FRAMES, FRAMES, 3).swapaxes(0, 1)
    slopes = coupling.sent(alone).reshape(FRAMES, 3, -1)
    follow = inverse @ slopes
    left = np.eye(coupling.pixels) - np.einsum("nap,naq->pq", slopes, follow, optimize=True)
    amplitudes = follow[:, 2] @ np.linalg.solve(left, follow[:, 2].T) + np.diag(inverse[:, 2, 2])
    exact = 1 / np.linalg.solve(amplitudes, np.ones(FRAMES)).sum()
    found = common_amplitudes(field, ground, rows, judged, every)
    assert found.variance[0] == pytest.approx(exact, rel=1e-3)
    assert exact > 1e5 * found.known[0]
    monkeypatch.setattr(common, "MOST_STEPS", 2)
    rough = common_amplitudes(field, ground, rows, judged, every)
    assert rough.variance[0] != pytest.approx(exact, rel=0.1)


def test_weights_of_a_common_mass_do_not_go_with_the_noise(pool: ThreadPoolExecutor) -> None:
    """In dark field the most weight would be on the highest estimates."""
    model = forward_model(make_config(calibrated=False, optics={"scheme": "darkfield"}), 1e4)
    path = np.cumsum(np.random.default_rng(4).normal(0.0, 60.0, (1, FRAMES, 2)), axis=1) + 1250.0
    mean, same = _expected(model, path)
    field, ground = _field(model, mean, pool), BackgroundEstimate(_level(), np.ones(FRAMES))
    theta = same.theta * np.array([1.0, 1.0, 1.0, 1.1, 1.0])
    theta[::2, 3] *= 0.9 / 1.1
    noisy = replace(same, theta=theta)

    def found(judged: Judged, growth: float) -> float:
        judged = replace(judged, growth=growth * judged.growth)
        every = np.ones(FRAMES, dtype=bool)
        result = common_amplitudes(field, ground, noisy, judged, every)
        return float(result.amplitude[0] / same.theta[0, 3])

    exact = found(field.judge(ground, same), 0.0)
    judged = field.judge(ground, noisy)
    assert found(judged, 1.0) == pytest.approx(exact, abs=1e-3)
    assert found(judged, 0.0) != pytest.approx(exact, abs=0.02)


def test_tracks_go_on_through_a_meeting(model: ForwardModel, pool: ThreadPoolExecutor) -> None:
    """Two particles pass each other at 230 nm; one was lost while they were close."""
    way = np.linspace(-900.0, 900.0, FRAMES)
    paths = np.array([
        np.column_stack([1250 + way, np.full(FRAMES, 1150.0)]),
        np.column_stack([1250 - way, np.full(FRAMES, 1380.0)]),
    ])  # fmt: skip
    mean, truth = _expected(model, paths)
    counts = np.random.default_rng(8).poisson(mean)
    field = _field(model, counts, pool)
    near = np.hypot(*(paths[0] - paths[1]).T) < 400.0
    seen = ~((truth.track == 1) & near[truth.frame] & (truth.frame >= 5))
    seen &= ~((truth.track == 1) & (truth.frame > 20))
    start = BackgroundEstimate(mean.mean(axis=0), np.ones(FRAMES))
    _, ground, _ = field.fit(start, truth, sweeps=0)
    merged = truth.only(seen)
    rows, added = extended(field, ground, merged, resolution_nm=370.0, reach_nm=600.0)
    assert added == FRAMES - int(np.sum(merged.track == 1))
    for k in range(2):
        mine = rows.track == k
        assert np.array_equal(rows.frame[mine], np.arange(FRAMES))
        assert np.abs(rows.theta[mine, :2] - paths[k]).max() < 100.0
    rows, again = extended(field, ground, rows, resolution_nm=370.0, reach_nm=600.0)
    assert again == 0


def test_a_track_that_ends_is_not_made_longer(
    model: ForwardModel, pool: ThreadPoolExecutor
) -> None:
    path = np.full((1, FRAMES, 2), 1250.0)
    path[0, 25:] = np.nan
    mean, truth = _expected(model, path)
    field = _field(model, np.random.default_rng(8).poisson(mean), pool)
    ground = BackgroundEstimate(mean[-1], np.ones(FRAMES))
    _, added = extended(field, ground, truth, resolution_nm=370.0, reach_nm=600.0)
    assert added == 0


@pytest.mark.parametrize("index", [[0, 1, 3], [0, 1, 2, 3]])
def test_variances_left_are_those_of_inverses_where_there_are_any(index: list[int]) -> None:
    rng = np.random.default_rng(3)
    units = np.array([1.0, 1.0, 1e-3, 30.0])
    ways = rng.normal(size=(300, 6, 4)) * units
    information = np.swapaxes(ways, 1, 2) @ ways
    information[7], information[8], information[9] = 0.0, np.nan, -information[9]
    information[10, 1], information[10, :, 1] = information[10, 0], information[10, :, 0]
    information[10, 1, 1] = information[10, 0, 0]  # what cannot be told apart
    found = variances_left(information, np.array(index))
    assert np.isnan(found[7:11]).all()
    assert np.isnan(np.delete(found, index, axis=1)).all()
    sound = np.delete(np.arange(300), [7, 8, 9, 10])
    inverse = np.linalg.inv(information[np.ix_(sound, index, index)])
    assert found[np.ix_(sound, index)] == pytest.approx(np.einsum("nii->ni", inverse), rel=1e-9)
