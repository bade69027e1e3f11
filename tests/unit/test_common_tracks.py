"""What the frames of a track have in common: one mass, and the errors of its background."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.inference import common
from iscat_analysis.inference.common import common_amplitudes, shared_errors
from iscat_analysis.inference.modes import lost
from iscat_analysis.inference.moving import MovingField
from iscat_analysis.inference.rows import Ground, Rows
from iscat_analysis.inference.settling import settle
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.pipeline.extension import extended

SHAPE, FRAMES, LEVEL_E, ROI, MASS = (30, 30), 40, 4e5, 20, 400.0
TRIALS, SIGMAS = 40, 4.0


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


def _expected(model: ForwardModel, paths: np.ndarray) -> tuple[np.ndarray, Rows]:
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
    rows = Rows.of(np.array(frame), np.array(track), np.array(theta))
    return _level() * (1 + signal), rows


def _field(model: ForwardModel, counts: np.ndarray, pool: ThreadPoolExecutor) -> MovingField:
    near = forward_model(make_config(), math.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    return MovingField(
        counts.astype(np.float32), np.zeros(SHAPE), np.ones(SHAPE, dtype=bool), near, model,
        pixel_nm=PIXEL_NM, roi_px=ROI, z_range_nm=None, largest=1e6, pool=pool,
    )  # fmt: skip


def test_information_lost_is_that_of_all_parameters(
    model: ForwardModel, pool: ThreadPoolExecutor
) -> None:
    """One mass and the light of every pixel: the Schur complement of their Fisher matrix."""
    path = np.random.default_rng(4).normal(1250.0, 40.0, (1, FRAMES, 2))
    counts, rows = _expected(model, path)
    field = _field(model, counts, pool)
    ground = Ground(counts.mean(axis=0), np.ones(FRAMES))
    _, ground, _ = field.fit(ground, rows, sweeps=0)
    ground = Ground(ground.level, np.ones(FRAMES))
    taken = lost(field, ground, rows)[-1, -1]
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    own = across = within = 0.0
    for theta in rows.theta:
        first = [round(c / PIXEL_NM - (ROI - 1) / 2) for c in theta[1::-1]]
        seen = np.zeros(SHAPE)
        seen[first[0] : first[0] + ROI, first[1] : first[1] + ROI] = 1.0
        signal, slopes = model.amplitude_gradient(grid, *theta[:4])
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
        start = Ground(mean.mean(axis=0), np.ones(FRAMES))
        rows, ground, done = settle(field, start, truth, follow_power=False)
        judged = field.judge(ground, rows)
        shared = shared_errors(field, ground, rows, judged)
        found = common_amplitudes(field, ground, rows, judged, done, shared)
        amplitude.append(found.amplitude[0])
        variance.append(found.variance[0])
        index = np.array([0, 1, 3])
        own = np.linalg.inv(judged.fisher[:, index][:, :, index])
        spread = own + shared.covariance[:, index][:, :, index]
        off = (rows.theta[:, :4] - judged.bias - truth.theta[:, :4])[:, index]
        errors.append(off / np.sqrt(np.einsum("nii->ni", spread)))
        assert found.variance[0] > 2 * found.known[0]
    sigma = math.sqrt(np.mean(variance))
    true = model.scale.amplitude(MASS)
    assert abs(np.mean(amplitude) - true) < SIGMAS * sigma / math.sqrt(TRIALS)
    assert abs(np.std(amplitude) / sigma - 1) < SIGMAS / math.sqrt(2 * TRIALS)
    for pulls in np.moveaxis(np.array(errors), 2, 0):  # of x, y, a: (trials, frames)
        assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * TRIALS)


def test_a_particle_that_hardly_moves_is_worked_out_in_double_precision(
    model: ForwardModel, pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over its background it is known so badly that single precision makes errors of its own."""
    path = np.random.default_rng(4).normal(0.0, 0.01 * PIXEL_NM, (1, FRAMES, 2)) + 1250.0
    mean, truth = _expected(model, path)
    field, ground = _field(model, 100 * mean, pool), Ground(100 * _level(), np.ones(FRAMES))
    judged = field.judge(ground, truth)

    usual = common._DOUBTFUL

    def amplitude_error(doubtful: float) -> float:
        monkeypatch.setattr(common, "_DOUBTFUL", doubtful)
        (mine, covariance) = shared_errors(field, ground, truth, judged).together[0]
        return float(1 / math.sqrt(np.linalg.solve(covariance, np.ones(mine.size)).sum()))

    with monkeypatch.context() as patch:
        patch.setattr(common, "_SINGULAR", 0.0)  # which is added to either matrix
        by_rows = amplitude_error(usual)
        patch.setattr(common, "_SHORT", 0.0)
        assert by_rows == pytest.approx(amplitude_error(-1.0), rel=1e-6)
    monkeypatch.setattr(common, "_SHORT", 0.0)
    exact = amplitude_error(-1.0)
    assert amplitude_error(usual) == pytest.approx(exact, rel=1e-2)
    assert amplitude_error(math.inf) != pytest.approx(exact, rel=0.1)


def test_short_tracks_are_worked_out_by_their_rows(
    model: ForwardModel, pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is the same as by their pixels, but for the rounding of single precision."""
    path = np.cumsum(np.random.default_rng(4).normal(0.0, 60.0, (1, FRAMES, 2)), axis=1) + 1250.0
    mean, truth = _expected(model, path)
    field, ground = _field(model, mean, pool), Ground(_level(), np.ones(FRAMES))
    judged = field.judge(ground, truth)
    found = []
    for short in (0.0, math.inf):
        monkeypatch.setattr(common, "_SHORT", short)
        shared = shared_errors(field, ground, truth, judged)
        found.append((shared.covariance, shared.together[0][1]))
    for one, two in zip(*found, strict=True):
        scale = np.sqrt(np.abs(np.diagonal(one, axis1=-2, axis2=-1)))
        scale = scale[..., :, None] * scale[..., None, :] + 1e-300
        assert np.abs((two - one) / scale).max() < 1e-3
        assert np.abs(one).max() > 0


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
    start = Ground(mean.mean(axis=0), np.ones(FRAMES))
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
    ground = Ground(mean[-1], np.ones(FRAMES))
    _, added = extended(field, ground, truth, resolution_nm=370.0, reach_nm=600.0)
    assert added == 0
