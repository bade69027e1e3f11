"""Particles that move over an unknown background: the likelihood, its maximum, what it knows."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import trackpy
from scenes import PIXEL_NM, make_config, observed_information

from iscat_analysis._kernels.background_response import Slopes, keep_slopes
from iscat_analysis._kernels.canvas import Light
from iscat_analysis._kernels.hessian import first_order_bias
from iscat_analysis._kernels.moving import Search
from iscat_analysis._kernels.stamp import add_stamp
from iscat_analysis.config import BackgroundConfig, Config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.counts import poisson
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import blurred, path_variance_nm2
from iscat_analysis.optics.pixels import BAND, RINGS, sample_picture
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.records import Box
from iscat_analysis.species import fit_diffusion
from iscat_analysis.tracking import field as frame_fits
from iscat_analysis.tracking import joint as settling
from iscat_analysis.tracking.field import Exposures, MovingField
from iscat_analysis.tracking.joint import ascend, first_background, fit_jointly, log_likelihood
from iscat_analysis.tracking.linking import extended, gaps, link
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations, Response
from iscat_analysis.tracking.stages import diffusion_of

SHAPE, FRAMES, LEVEL_E, ROI = (40, 44), 60, 4e5, 24
MASSES = (200.0, 400.0)
READ_E2 = 900.0
SIGMAS = 4.0
LEARNT = BackgroundConfig(method="tracks")
SAME = 1e-5  # as exact as the samples of a picture
SINGLE = 3e-7  # rounding of 1 in single precision, a few times
SECOND = 1e-4  # the same, of second derivatives
FITTED = 0.05  # standard deviations: where a fit ends, and the differences of its likelihood


def _config(camera: dict[str, object] | None = None) -> Config:
    return make_config(
        background={"frames": None},
        camera={"frame_rate_hz": 331.0} if camera is None else camera,
        fit={"mode": "track", "frames": None, "roi_nm": ROI * PIXEL_NM},
        track={"free": "mass"},
        simulation={"shape": list(SHAPE)},
    )


@pytest.fixture(scope="module")
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(2) as threads:
        yield threads


def _paths(step_nm: float) -> np.ndarray:
    """Two paths that do not meet, shape (2, frames, 2)."""
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.normal(0, step_nm, (2, FRAMES, 2)), axis=1)
    walk -= walk.mean(axis=1, keepdims=True)
    return walk + np.array([[1200.0, 1500.0], [2500.0, 1900.0]])[:, None]


def _movie(
    paths: np.ndarray, *, noise: bool
) -> tuple[np.ndarray, BackgroundEstimate, Localizations]:
    """Make counts (t, y, x), the light that made them, and the truth."""
    rng = np.random.default_rng(5)
    model = forward_model(_config(), 1e4)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    level = LEVEL_E * (1 + 0.15 * rng.standard_normal(SHAPE))
    power = 1 + 0.02 * rng.standard_normal(FRAMES)
    power /= power.mean()
    theta = np.zeros((2 * FRAMES, 5))
    expected = np.empty((FRAMES, *SHAPE))
    for t in range(FRAMES):
        signal = np.zeros(SHAPE)
        for k, mass in enumerate(MASSES):
            signal += model.image(grid, *paths[k, t], model.height_nm, mass)
            amplitude = model.scale.amplitude(mass)
            theta[2 * t + k] = *paths[k, t], model.height_nm, amplitude, 0.0
        expected[t] = power[t] * level * (1 + signal)
    counts = rng.poisson(expected) + rng.normal(0, math.sqrt(READ_E2), expected.shape)
    frame, track = np.divmod(np.arange(2 * FRAMES), 2)
    return (
        counts if noise else expected,
        BackgroundEstimate(level, power),
        Localizations.of(frame, track, theta),
    )


def _field(
    counts: np.ndarray | Exposures, pool: ThreadPoolExecutor, read_e2: float = 0.0
) -> MovingField:
    if isinstance(counts, np.ndarray):
        counts = Exposures(counts.astype(np.float32))
    config = _config()
    near = forward_model(config, math.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    return MovingField(
        counts, np.full(SHAPE, read_e2), np.ones(SHAPE, dtype=bool),
        near, forward_model(config, 1e4), pixel_nm=PIXEL_NM, roi_px=ROI, z_range_nm=None,
        pool=pool,
    )  # fmt: skip


def _square(theta: np.ndarray) -> tuple[slice, slice]:
    """Where a row is fitted."""
    spans = []
    for centre, size in zip((theta[1], theta[0]), SHAPE, strict=True):
        first = round(centre / PIXEL_NM - (ROI - 1) / 2)
        spans.append(slice(max(first, 0), min(first + ROI, size)))
    return spans[0], spans[1]


def _multinomial(counts: np.ndarray, power: np.ndarray, rows: Localizations) -> float:
    """Log-likelihood of counts given their sums over the frames, from exact pictures."""
    model = forward_model(_config(), 1e4)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    light = np.ones((FRAMES, *SHAPE))
    for frame, (x, y, z, amplitude, _) in zip(rows.frame, rows.theta, strict=True):
        light[frame] += model.amplitude_image(grid, x, y, z, amplitude)
    share = power[:, None, None] * light
    return float(np.sum(counts * np.log(share / share.sum(axis=0))))


def _stretched(rows: Localizations, by: float) -> Localizations:
    """Places farther from the middle of each track, and masses smaller, so that products stay."""
    theta = rows.theta.copy()
    for k in range(len(MASSES)):
        mine = rows.track == k
        middle = theta[mine, :2].mean(axis=0)
        theta[mine, :2] = middle + by * (theta[mine, :2] - middle)
        theta[mine, 3] /= by
    return replace(rows, theta=theta)


def test_log_likelihood_is_the_multinomial(pool: ThreadPoolExecutor) -> None:
    counts, ground, truth = _movie(_paths(20.0), noise=True)
    field = _field(counts, pool)
    rows = [_stretched(truth, by) for by in (1.0, 1.02, 1.2)]
    got = [log_likelihood(field, ground, some) for some in rows]
    exact = [_multinomial(field.exposures.counts, ground.power, some) for some in rows]
    assert np.ptp(exact) > 100
    np.testing.assert_allclose(np.diff(got), np.diff(exact), rtol=2e-3, atol=0.5)


def test_particles_that_hardly_move_end_at_the_maximum(
    pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From wherever; the control is Newton's step without a look at the likelihood."""
    counts, ground, truth = _movie(_paths(4.0), noise=True)
    field = _field(counts, pool)

    def height(by: float) -> float:
        rows, found, _ = fit_jointly(field, ground, _stretched(truth, by), LEARNT)
        return log_likelihood(field, found, rows)

    starts = (0.7, 1.0, 1.4)
    ends = [height(by) for by in starts]
    assert np.ptp(ends) < 2
    assert min(ends) > log_likelihood(field, ground, truth)
    rows, found, _ = ascend(field, ground, truth, follow_power=True)
    assert abs(log_likelihood(field, found, rows) - ends[1]) < 2
    monkeypatch.setattr(settling, "MOST_STEP_RATIO", np.inf)
    assert min(height(by) for by in starts) < min(ends) - 5


@pytest.mark.parametrize(
    ("step_nm", "taken_least", "left_most"), [(20.0, 0.2, 0.02), (60.0, 0.05, 3e-4)]
)
def test_background_takes_nothing_of_particles(
    pool: ThreadPoolExecutor, step_nm: float, taken_least: float, left_most: float
) -> None:
    """Without noise the truth is the fixed point.

    A median of the frames takes off the particles what they left there: 8 % at 60 nm a frame, 58 %
    and 23 % of these two at 20 nm, where they stay within 100 nm.
    """
    counts, ground, truth = _movie(_paths(step_nm), noise=False)
    field = _field(counts, pool)
    start = first_background(field, LEARNT)
    over_median, _, _ = field.fit(start, truth)
    rows, found, done = fit_jointly(field, start, truth, LEARNT)
    taken = 1 - over_median.theta[:, 3] / truth.theta[:, 3]
    left = rows.theta[:, 3] / truth.theta[:, 3] - 1
    assert done.all()
    assert taken.reshape(-1, 2).mean(axis=0).min() > taken_least
    assert np.abs(left).max() < left_most
    assert np.abs(found.power / ground.power - 1).max() < 1e-6


def test_fixed_point_is_the_maximum_of_the_multinomial(pool: ThreadPoolExecutor) -> None:
    """Its gradient on a row's square, by differences, vanishes within the tolerance of a fit."""
    counts, _, truth = _movie(_paths(40.0), noise=True)
    field = _field(counts, pool)
    start = first_background(field, LEARNT)
    rows, ground, _ = fit_jointly(field, start, truth, LEARNT)
    for _ in range(3):  # beyond what is asked of it
        rows, found, _ = field.fit(ground, rows)
        ground = BackgroundEstimate(found.level, ground.power)
    model = forward_model(_config(), 1e4)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    kept = counts.astype(np.float32).astype(float)
    images = np.array([model.amplitude_image(grid, *theta[:4]) for theta in rows.theta])

    def value(row: int, theta: np.ndarray) -> float:
        changed = images.copy()
        changed[row] = model.amplitude_image(grid, *theta[:4])
        share = ground.power[:, None, None] * (1 + changed.reshape(FRAMES, 2, *SHAPE).sum(axis=1))
        of_pixel = np.sum(kept * np.log(share / share.sum(axis=0)), axis=0)
        return float(of_pixel[_square(rows.theta[row])].sum())

    judged = field.judge(ground, rows)
    for row in (0, 37, 98):
        for parameter in (0, 1, 3):
            sigma = 1 / math.sqrt(judged.fisher[row, parameter, parameter])
            step = np.zeros(5)
            step[parameter] = 0.3 * sigma
            here = rows.theta[row]
            slope = (value(row, here + step) - value(row, here - step)) / 0.6
            assert abs(slope) < FITTED, (row, parameter)


def test_rows_are_fitted_by_the_one_likelihood(pool: ThreadPoolExecutor) -> None:
    """Estimate, informations, bias and fit of a row are those of `Likelihood` on its square."""
    counts, ground, truth = _movie(_paths(40.0), noise=True)
    field = _field(counts, pool, READ_E2)
    rows, _, done = field.fit(ground, truth, sweeps=3)
    judged = field.judge(ground, rows)
    assert done.all()
    model = forward_model(_config(), math.sqrt(2) * (ROI / 2 + 6) * PIXEL_NM)
    wide = forward_model(_config(), 1e4)
    for row in (4, 51):
        t, theta = rows.frame[row], rows.theta[row]
        other = rows.theta[row ^ 1]
        cut = _square(theta)
        grid = PixelGrid.region(*((side.start, side.stop) for side in cut), PIXEL_NM)
        light = ground.power[t] * ground.level[cut]
        base = light * (1 + wide.amplitude_image(grid, *other[:4]))
        likelihood = poisson(
            model, grid, counts.astype(np.float32)[t][cut], base, light, extra_variance_e2=READ_E2
        )
        free = np.array([True, True, False, True, False])
        margin = np.array([300.0, 300.0, 0.0, 1e5, 0.0])
        best = likelihood.maximize(truth.theta[row], Box(free, theta - margin, theta + margin))
        index = np.array([0, 1, 3])
        fisher = likelihood.score_fisher(theta)[2][:4, :4]
        sigma = 1 / np.sqrt(np.diag(fisher))
        assert np.all(np.abs(best.theta - theta)[index] < FITTED * sigma[index])
        scale = np.outer(sigma, sigma)
        free_only = np.ix_(index, index)
        assert np.allclose((judged.fisher[row] * scale)[free_only], (fisher * scale)[free_only],
                           atol=SAME)  # fmt: skip
        observed = observed_information(likelihood, theta)
        square = np.ix_(index, index)
        assert np.allclose((judged.observed[row] * scale)[square],
                           (observed[:4, :4] * scale)[square], atol=SECOND)  # fmt: skip
        bias = first_order_bias(likelihood.measured, 1.0, likelihood.derivatives(theta), free)
        assert np.allclose(judged.bias[row] / sigma, bias[:4] / sigma, atol=SECOND)
        residuals = likelihood.residuals(theta)
        assert judged.chi2[row] == pytest.approx(np.nansum(residuals**2), rel=1e-5)
        assert judged.worst[row] == pytest.approx(np.nanmax(np.abs(residuals)), rel=1e-4)
        gain = likelihood.values(theta[None])[0]
        assert judged.gain[row] == pytest.approx(gain, rel=1e-4)


def test_rows_that_plain_steps_do_not_fit_are_fitted(
    pool: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts, ground, truth = _movie(_paths(30.0), noise=True)
    field, asked, search = _field(counts, pool), [], frame_fits.fit_with_search

    def climbed(*given: Any) -> tuple[float, int]:
        asked.append(given)
        return search(*given)

    monkeypatch.setattr(frame_fits, "fit_with_search", climbed)
    near, _, done = field.fit(ground, truth, sweeps=4)
    assert done.all()
    assert not asked
    away = np.array([90.0, -90.0, 0.0, 0.0, 0.0])
    far, _, done = field.fit(ground, replace(truth, theta=truth.theta + away), sweeps=4)
    assert done.all()
    assert 0 < len(asked) < 2 * FRAMES
    sigma = 1 / np.sqrt(near.fisher[:, (0, 1, 3), (0, 1, 3)])
    assert np.all(np.abs(far.theta - near.theta)[:, [0, 1, 3]] < 0.5 * sigma)  # other squares


def test_rows_know_what_their_last_fit_saw(pool: ThreadPoolExecutor) -> None:
    """Information and signal-to-noise ratio of a fit are those of a judgement without another.

    But for what the neighbour moves afterwards, whose rings reach into the square.
    """
    counts, ground, truth = _movie(_paths(40.0), noise=True)
    field = _field(counts, pool, READ_E2)
    assert np.isnan(truth.snr).all()
    rows, _, _ = field.fit(ground, truth, sweeps=3)
    judged = field.judge(ground, rows)
    error = np.sqrt(judged.fisher[:, 3, 3] / rows.fisher[:, 3, 3])
    assert np.abs(error - 1).max() < 1e-3
    difference = np.abs(rows.snr / np.sqrt(2 * judged.gain) - 1)
    assert np.median(difference) < 1e-3
    assert difference.max() < 0.03
    few, done = field.refit(ground, truth.only(truth.frame < 3), sweeps=3)
    assert done.all()
    smaller = few.snr / rows.snr[:6]  # in a quarter of the pixels
    assert np.all((smaller > 0.7) & (smaller < 1.0))


@pytest.mark.parametrize("beside_nm", [None, 320.0])
def test_rows_follow_a_step_of_their_background(
    pool: ThreadPoolExecutor, beside_nm: float | None
) -> None:
    """To first order, expected information for observed, as a fit over the new one moves them.

    Where two overlap they do so together: each by itself would go much too far.
    """
    paths = _paths(40.0)
    if beside_nm is not None:
        paths[1] = paths[0] + [beside_nm, 0.0]
    counts, ground, truth = _movie(paths, noise=True)
    field = _field(counts, pool)
    for _ in range(3):
        truth, _, _ = field.fit(ground, truth, sweeps=6)
    step = 1e-3 * np.random.default_rng(2).standard_normal(SHAPE)  # two thirds of a frame's noise
    foreseen = field.response.followed(truth, step).theta - truth.theta
    field = _field(counts, pool)
    rows = truth
    for _ in range(3):
        rows, _, _ = field.fit(replace(ground, level=ground.level * np.exp(step)), rows, sweeps=6)
    moved = rows.theta - truth.theta
    index = np.array([0, 1, 3])
    error = np.sqrt(np.mean((moved - foreseen)[:, index] ** 2, axis=0))
    assert np.all(error < 0.25 * np.sqrt(np.mean(moved[:, index] ** 2, axis=0)))
    assert np.all(foreseen[:, [2, 4]] == 0)


@pytest.mark.parametrize("rounded", [1.0, 0.98])
def test_rows_in_one_place_follow_as_one(pool: ThreadPoolExecutor, rounded: float) -> None:
    """Whatever rounding makes of what each knows alone, each takes up half of what both see."""
    side, level = 12, 100.0
    slope = np.random.default_rng(4).standard_normal((1, 1, side * side))
    squares = np.tile([0, side, 0, side], (2, 1))
    unit = 1e-4
    values = np.repeat(np.rint(slope / unit).astype(np.int16), 2, axis=0)
    slopes = Slopes(squares, values, np.full((2, 1), unit), np.zeros((2, 1)))
    light = Light(
        np.full((1, side, side), level, dtype=np.float32), 1.0, 0.0, np.ones(1),
        np.full((side, side), level), np.zeros((side, side)),
    )  # fmt: skip
    own = float(np.sum(slope**2)) / level
    free, nothing = np.array([False, False, False, True, False]), np.zeros(2, dtype=int)
    wide = np.full(5, np.inf)
    search = Search(free, wide, -wide, wide, wide, 0.0, 0)
    information = np.full((2, 1, 1), rounded * own)
    drawn = np.zeros((1, side, side), dtype=np.float32)
    response = Response(slopes, np.array([0, 2]), light, drawn, information, search, pool)
    rows = Localizations.of(nothing, np.arange(2), np.zeros((2, 5)))
    moved = response.followed(rows, slope.reshape(side, side) / level).theta[:, 3]
    assert moved == pytest.approx(-0.5, rel=0.05)


def test_slopes_are_kept_in_half_the_memory() -> None:
    """To a few ten-thousandths of a slope, of squares at the edge too; of nothing, nothing."""
    rng = np.random.default_rng(6)
    ny, nx, side = 11, 7, 16
    level = rng.uniform(900.0, 1100.0, (ny, nx))
    gradient = rng.standard_normal((ny, 5, nx)) * np.array([1.0, 1e-6, 3.0, 5.0, 1e3])[:, None]
    gradient[:, 2] = 0.0
    index = np.array([0, 1, 3])
    slopes = Slopes(
        np.zeros((1, 4), dtype=np.int64), np.zeros((1, 3, side**2), dtype=np.int16),
        np.zeros((1, 3)), np.zeros((1, 3)),
    )  # fmt: skip
    room = np.zeros(side**2, dtype=np.float32)
    keep_slopes(level, gradient, index, slopes, 0, (0, ny, 0, nx), room)
    kept = (slopes.values[0, :, : ny * nx] * slopes.units[0][:, None]).reshape(3, ny, nx)
    exact = level * np.moveaxis(gradient, 1, 0)[1 + index]
    assert np.all(kept[1] == 0.0)
    for k in (0, 2):
        assert np.linalg.norm(kept[k] - exact[k]) < 5e-4 * np.linalg.norm(exact[k])


@pytest.mark.parametrize(("brighter", "most"), [(1.0, 1e-3), (100.0, 5e-3)])
def test_rings_are_drawn_from_half_the_samples(brighter: float, most: float) -> None:
    """Their error is small beside them, of gold too, whose scattered light these samples miss."""
    model = forward_model(_config(), 1e4)
    grid = PixelGrid.region((0, 61), (0, 61), PIXEL_NM)
    mass = brighter * MASSES[0]
    x, y, amplitude = 30.3 * PIXEL_NM, 29.6 * PIXEL_NM, float(model.scale.amplitude(mass))
    exact = model.image(grid, x, y, model.height_nm, mass)
    far = np.maximum(*np.abs(np.indices((61, 61)) - 30)) > ROI / 2
    errors, fine = {}, {}
    for band in (BAND, RINGS):
        lens, samples = sample_picture(model, PIXEL_NM, 33.0, band)
        drawn = np.zeros(exact.shape, dtype=np.float32)
        theta = np.array([x, y, 0.0, amplitude])
        add_stamp(samples.astype(np.float32), lens, model.pixels(grid), theta, 1.0, drawn)
        errors[band], fine[band] = (drawn - exact)[far].std() / exact[far].std(), lens.fine
    assert fine == {BAND: 2, RINGS: 1}
    assert errors[RINGS] < most
    assert errors[BAND] < errors[RINGS] / 10


def test_rows_that_overlap_follow_one_another(pool: ThreadPoolExecutor) -> None:
    """One fit of each ends nearer to the maximum of both than fits of each alone do."""
    counts, ground, rows = _movie(_paths(0.0) - [[[0.0, 0.0]], [[950.0, 500.0]]], noise=True)
    field = _field(counts, pool, READ_E2)
    start = replace(rows, theta=rows.theta + np.array([10.0, -10.0, 0.0, 0.0, 0.0]))
    end, _, _ = field.fit(ground, start, sweeps=40)
    together, _, _ = field.fit(ground, start)
    end_alone, _, _ = field.fit(ground, start, sweeps=40, coarse=True)
    alone, _, _ = field.fit(ground, start, coarse=True)
    index = [0, 1, 3]
    error = 1 / np.sqrt(end.fisher[:, index, index])
    left = np.median(np.abs(together.theta - end.theta)[:, index] / error)
    assert left < np.median(np.abs(alone.theta - end_alone.theta)[:, index] / error) / 3


def test_residuals_are_of_the_rows_that_are_asked_for(pool: ThreadPoolExecutor) -> None:
    """Whatever the canvas holds: rows drawn together, alone, or moved by a fit in between."""
    counts, ground, rows = _movie(_paths(30.0), noise=True)
    field = _field(counts, pool, READ_E2)
    start = replace(rows, theta=rows.theta + np.array([8.0, -8.0, 0.0, 0.0, 0.0]))
    alone = field.residual(ground, start, 0, FRAMES)
    fitted, _, _ = field.fit(ground, start, coarse=True)
    assert np.abs(field.residual(ground, start, 0, FRAMES) - alone).max() < 1.0  # e, of noise 630
    assert np.abs(field.residual(ground, fitted, 0, FRAMES) - alone).max() > 30.0
    field.draw(ground, rows)
    field.draw(ground, start)
    assert np.abs(field.residual(ground, start, 0, FRAMES) - alone).max() < 1.0


def test_counts_are_fitted_as_the_photoelectrons_that_they_stand_for(
    pool: ThreadPoolExecutor,
) -> None:
    """As stored, with a gain and an offset, or converted: fits, sums and what is left over."""
    gain, offset = 12.5, 96.0
    electrons, ground, rows = _movie(_paths(30.0), noise=True)
    counts = np.rint(electrons / gain + offset).astype(np.uint16)
    converted = _field(gain * (counts - offset), pool, READ_E2)
    stored = _field(Exposures(counts, gain, offset), pool, READ_E2)
    (one, light, _), (other, same, _) = (f.fit(ground, rows) for f in (converted, stored))
    np.testing.assert_allclose(other.theta, one.theta, rtol=1e-6)
    np.testing.assert_allclose(same.level, light.level, rtol=1e-6)
    np.testing.assert_allclose(same.power, light.power, rtol=1e-6)
    first = first_background(converted, LEARNT)
    np.testing.assert_allclose(first_background(stored, LEARNT).level, first.level, 1e-6)
    left, over = (f.residual(ground, rows, 3, 9) for f in (converted, stored))
    np.testing.assert_allclose(over, left, atol=0.1)  # e, of noise 630


def test_what_extends_tracks_is_told_as_it_was_fitted(pool: ThreadPoolExecutor) -> None:
    """Also where no row of a movie stays what it was."""
    counts, ground, truth = _movie(_paths(30.0), noise=True)
    field = _field(counts, pool)
    fitted, _, _ = field.fit(ground, truth)
    some = fitted.only(fitted.frame % 60 < 30)
    longer, added = extended(field, ground, some, resolution_nm=370.0, reach_nm=600.0)
    assert added == 60
    assert np.isfinite(longer.snr).all()
    error = 1 / np.sqrt(longer.fisher[:, 3, 3])
    assert (np.abs(longer.theta - truth.theta)[:, 3] < 6 * error).all()


@pytest.mark.parametrize("rows_moved", [[4], [0, 3], [1, 2, 3, 5, 8]])
def test_rows_that_move_are_redrawn_as_if_all_were(
    pool: ThreadPoolExecutor, rows_moved: list[int]
) -> None:
    field = _field(np.ones((1, *SHAPE)), pool)
    ground = BackgroundEstimate(np.ones(SHAPE), np.ones(1))
    size = forward_model(_config(), 1e4).scale.amplitude(400.0)
    z = forward_model(_config(), 1e4).height_nm
    theta = np.array(
        [[x, y, z, size, 0.0] for x in (700.0, 1800.0, 2900.0) for y in (600.0, 1600.0, 2600.0)]
    )
    rows = Localizations.of(np.zeros(9, dtype=int), np.arange(9), theta)
    for change in ([0.0, 0.0, 0.0, 0.3 * size, 0.0], [170.0, -90.0, 0.0, -0.4 * size, 0.0]):
        before = field.fit(ground, rows, sweeps=0, coarse=True)[0]
        there = before.theta.copy()
        there[rows_moved] += change
        moved = replace(before, theta=there)
        stale = field.residual(ground, before, 0, 1)
        moved = field.fit(ground, moved, sweeps=0, coarse=True)[0]
        drawn = field.residual(ground, moved, 0, 1)
        field.draw(ground, moved)
        anew = field.residual(ground, moved, 0, 1)
        assert np.abs(drawn - anew).max() < SINGLE
        assert np.abs(stale - anew).max() > 1e3 * SINGLE


def test_squares_are_put_on_top_of_each_other(pool: ThreadPoolExecutor) -> None:
    """Also at the border, where a square has no pixels."""
    counts, ground, rows = _movie(_paths(30.0), noise=True)
    field = _field(counts, pool, READ_E2)
    field.used[20, 17] = False
    which, side = np.array([0, 5, 6, 31, 80]), 9
    corner = np.rint(rows.theta[which, 1::-1] / PIXEL_NM).astype(np.int64) - side // 2
    corner[3] = -4, SHAPE[1] - 3
    owner = np.array([0, 1, 0, 2, 1])
    slow = np.zeros((3, 3, side, side))
    sums = np.moveaxis(field.superposed(ground, rows, which, corner, owner, side), 0, 1)
    for row, (top, left), k in zip(which, corner, owner, strict=True):
        t = rows.frame[row]
        over = field.residual(ground, rows, t, t + 1)[0]
        for i in range(side):
            for j in range(side):
                y, x = top + i, left + j
                if 0 <= y < SHAPE[0] and 0 <= x < SHAPE[1] and field.used[y, x]:
                    here = over[y, x], ground.power[t] * ground.level[y, x], READ_E2
                    slow[k, :, i, j] += here
    assert np.allclose(sums, slow, rtol=1e-6, atol=1.0)  # e, of noise 630
    assert (slow[:, 1] > 0).any(axis=(1, 2)).all()
    assert (slow[2, 1] == 0).any()


def test_threads_do_not_change_the_result() -> None:
    counts, ground, truth = _movie(_paths(40.0), noise=True)
    found = []
    for workers in (1, 3):
        with ThreadPoolExecutor(workers) as threads:
            rows, light, _ = _field(counts, threads).fit(ground, truth)
        found.append((rows.theta, light.level))
    assert np.array_equal(found[0][0], found[1][0])
    assert np.array_equal(found[0][1], found[1][1])


def _along_paths(
    model: ForwardModel, grid: PixelGrid, place: tuple[float, float], q: float, mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Average over paths of variance q, and over a normal spread.

    At time t of the exposure, in units of it, a path lies about its mean with the variance
    6 q (1/3 − t + t²), the same before and after the middle: the second half stands for both.
    Gauss–Hermite points along both axes: five are right to 4e-7 of the peak.
    """
    points, weights = np.polynomial.hermite_e.hermegauss(5)
    weights = weights / weights.sum()

    def normal(variance: float) -> np.ndarray:
        images = (
            wx * wy * model.image(grid, place[0] + r * x, place[1] + r * y, 5.0, mass)
            for r in (math.sqrt(variance),)
            for x, wx in zip(points, weights, strict=True)
            for y, wy in zip(points, weights, strict=True)
        )
        return np.asarray(sum(images))

    times, parts = (half[4:] for half in np.polynomial.legendre.leggauss(8))
    spreads = 6 * q * (1 / 3 - (times + 1) / 2 + (times + 1) ** 2 / 4)
    path = sum(part * normal(v) for v, part in zip(spreads, parts, strict=True))
    return path, normal(q)


def test_blur_is_of_places_where_a_particle_is_alone() -> None:
    """Two that stay together for a while are lost in each other's pictures."""
    config, rng = _config(), np.random.default_rng(8)
    d, sigma_nm, frames = 0.15, 15.0, 600
    rate, exposure = 331.0, 1 / 331.0
    steps = rng.normal(0, math.sqrt(2 * d * 1e6 / rate / 16), (2, frames, 16, 2))
    path = np.cumsum(steps.reshape(2, -1, 2), axis=1).reshape(2, frames, 16, 2).mean(axis=2)
    first, last = 200, 260
    path[1, :first] += path[0, first] - path[1, first]
    path[1, last:] += path[0, last] - path[1, last]
    path[1, first:last] = path[0, first:last] + rng.normal(0, 60.0, (last - first, 2))
    places = path + rng.normal(0, sigma_nm, path.shape)
    theta = np.zeros((2 * frames, 5))
    theta[:, :2] = places.transpose(1, 0, 2).reshape(-1, 2)
    theta[:, 3] = 1.0
    frame, track = np.divmod(np.arange(2 * frames), 2)
    fisher = np.broadcast_to(np.diag([sigma_nm**-2, sigma_nm**-2, 0.0, 1.0]), (2 * frames, 4, 4))
    rows = replace(Localizations.of(frame, track, theta), fisher=fisher)
    free = np.array([True, True, False, True, False])
    found, error = diffusion_of(config, free, rows).T
    assert np.all(np.abs(found - d) < SIGMAS * error)
    worse = fit_diffusion(
        frame[track == 1], places[1], np.full((frames, 2), sigma_nm), frame_rate_hz=rate,
        exposure_ms=1e3 * exposure,
    )  # fmt: skip
    assert worse.d_um2_s - d > 2 * SIGMAS * error[1]


@pytest.mark.parametrize("optics", [{}, {"aberrations_nm": {"z7": 10.0}}])
def test_blurred_model_is_the_average(optics: dict[str, object]) -> None:
    model = forward_model(make_config(optics=optics), 3000.0)
    grid, variance = PixelGrid.centred(25, PIXEL_NM), 1600.0
    average, normal = _along_paths(model, grid, (0.0, 0.0), variance, 0.1)
    picture = blurred(model, variance, upwards=False).image(grid, 0.0, 0.0, 5.0, 0.1)
    peak = np.abs(model.image(grid, 0.0, 0.0, 5.0, 0.1)).max()
    assert np.abs(picture - average).max() < 2e-5 * peak
    assert np.abs(normal - average).max() > 1e-3 * peak


def test_fast_particles_weigh_what_they_weigh(pool: ThreadPoolExecutor) -> None:
    """Without noise, over the light that is: 2 µm²/s in 3 ms.

    Over a normal spread they would be 0.27 % too heavy.
    """
    variance = path_variance_nm2(2.0, 3.02e-3)
    model = forward_model(_config(), 1e4)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    place, mass = (1712.0, 1655.0), 20.0
    average, normal = _along_paths(model, grid, place, variance, mass)
    ground = BackgroundEstimate(np.full(SHAPE, LEVEL_E), np.ones(3))
    amplitude = model.scale.amplitude(mass)
    truth = Localizations.of(
        np.arange(3), np.zeros(3, dtype=int),
        np.tile([*place, model.height_nm, amplitude, 0.0], (3, 1)),
    )  # fmt: skip
    heavier = []
    for picture in (average, normal):
        field = _field(np.broadcast_to(LEVEL_E * (1 + picture), (3, *SHAPE)), pool)
        field.set_blurs(np.array([variance]))
        found, _, done = field.fit(ground, truth, sweeps=2)
        assert done.all()
        heavier.append(found.theta[0, 3] / amplitude - 1)
    assert abs(heavier[0]) < 1e-4
    assert heavier[0] - heavier[1] == pytest.approx(2.7e-3, rel=0.1)


def test_blur_is_that_of_a_brownian_path() -> None:
    rng = np.random.default_rng(1)
    d, exposure, steps = 0.8, 3e-3, 400
    walk = np.cumsum(rng.normal(0, math.sqrt(2 * d * 1e6 * exposure / steps), (4000, steps)), 1)
    spread = walk.var(axis=1)
    expected = path_variance_nm2(d, exposure)
    assert spread.mean() == pytest.approx(expected, rel=SIGMAS * math.sqrt(0.8 / 4000))
    assert spread.var() / expected**2 == pytest.approx(0.8, rel=0.15)


def test_links_survive_gaps() -> None:
    """And garbage is looked for again after them."""
    frame = np.array([0, 0, 1, 1, 2, 4, 4, 5])
    places = np.array([[0.0, 0], [900, 0], [50, 0], [950, 0], [940, 0], [60, 0], [930, 0], [0, 0]])
    track = link(frame, places, reach_nm=200.0, memory=3)
    assert track[0] == track[2] == track[5] == track[7]
    assert track[1] == track[3] == track[4] == track[6]
    assert gc.isenabled()
    missed, before, after, share = gaps(frame, track)
    assert sorted(zip(missed.tolist(), track[before].tolist(), strict=True)) == sorted(
        [(2, track[0]), (3, track[0]), (3, track[1])]
    )
    assert np.all(track[before] == track[after])
    between = (1 - share) * places[before, 0] + share * places[after, 0]
    assert np.all((between >= 50) & (between <= 60) | (between >= 930) & (between <= 940))


def _linked_by_trackpy(frame, places, reach_nm, memory) -> np.ndarray:
    """Give every frame to trackpy as it is."""
    frames = range(frame[0], frame[-1] + 1)
    linked = trackpy.link_iter(
        ((t, places[frame == t]) for t in frames), search_range=reach_nm, memory=memory
    )
    return np.concatenate([numbers for _, numbers in linked])


@pytest.mark.parametrize("memory", [0, 1, 3])
@pytest.mark.parametrize("side", [3.0, 6.0, 12.0])
def test_links_are_those_of_trackpy(memory: int, side: float) -> None:
    """Where there is no choice too, in fields that are full or empty, with places that are none."""
    trackpy.quiet()
    rng = np.random.default_rng([memory, int(side)])
    for _ in range(5):
        x, frame, places = rng.uniform(0, side, (rng.integers(3, 12), 3)), [], []
        for t in range(60):
            x = (x + rng.normal(0, 0.3, x.shape)) % side
            seen = [x[rng.random(len(x)) < 0.9], rng.uniform(0, side, (rng.poisson(0.5), 3))]
            places.append(np.concatenate(seen))
            frame += [t] * len(places[-1])
        at, where = np.array(frame), np.concatenate(places)
        track = link(at, where, reach_nm=1.0, memory=memory)
        expected = _linked_by_trackpy(at, where, 1.0, memory)
        pairs = set(zip(track.tolist(), expected.tolist(), strict=True))
        assert len(pairs) == len(set(track)) == len(set(expected))
        _, first = np.unique(track, return_index=True)
        assert np.all(np.diff(first) > 0)


@pytest.mark.parametrize(("count", "apart"), [(31, 0.6), (9, 0.01)])
def test_links_of_a_crowd_are_refused(count: int, apart: float) -> None:
    """Of a row that hangs together, and of places that are all in reach of one another."""

    def linked(n: int) -> np.ndarray:
        x = np.tile(apart * np.arange(n), 2)
        at = np.column_stack([x, np.zeros(2 * n)])
        return link(np.repeat([0, 1], n), at, reach_nm=1.0, memory=0)

    assert linked(count - 1).tolist() == 2 * list(range(count - 1))
    with pytest.raises(DataError, match="which is which"):
        linked(count)


# ---- the whole job ---------------------------------------------------------------------------


def test_raw_movie_becomes_tracks(tmp_path: Path) -> None:
    paths = _paths(40.0)
    counts, _, _ = _movie(paths, noise=True)
    movie = tmp_path / "movie.tif"
    tifffile.imwrite(movie, np.round(counts).astype(np.uint32), photometric="minisblack")
    config = _config(camera={"frame_rate_hz": 331.0, "exposure_ms": 0.01, "read_noise_e": 30.0})
    assert config.background.method == "tracks"
    found = fit_stack(movie, config)
    table = found.table
    assert len(table) == 2 * FRAMES
    assert table.groupby("track")["frame"].nunique().tolist() == [FRAMES, FRAMES]
    assert len(found.views) == 2
    assert table["sigma_z_nm"].isna().all()
    assert (table["status"] == "ok").mean() > 0.9
    for _, rows in table.groupby("track"):
        k = int(np.argmin([abs(rows["mass_kda"].median() - mass) for mass in MASSES]))
        pulls = ((rows["mass_kda"] - MASSES[k]) / rows["sigma_mass_kda"]).to_numpy()
        assert abs(pulls.mean()) < SIGMAS / math.sqrt(FRAMES)
        assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * FRAMES)
        for axis, name in enumerate(("x_nm", "y_nm")):
            pulls = ((rows[name] - paths[k, :, axis]) / rows[f"sigma_{name}"]).to_numpy()
            assert abs(pulls.mean()) < SIGMAS / math.sqrt(FRAMES)
            assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * FRAMES)


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    movie = tmp_path / "movie.tif"
    counts = np.random.default_rng(1).poisson(1e4, (12, *SHAPE)).astype(np.uint16)
    tifffile.imwrite(movie, counts, photometric="minisblack")
    with pytest.raises(DataError, match="12 frames, too few"):
        fit_stack(movie, _config())


def test_an_empty_movie_has_no_tracks(tmp_path: Path) -> None:
    """The frame rate is not needed for that, nor for the blur of a whole frame."""
    movie = tmp_path / "movie.tif"
    rng = np.random.default_rng(1)
    counts = rng.poisson(1e4, (25, *SHAPE)).astype(np.uint16)
    counts[:, 11, 17] = 0  # a dead pixel is no particle, and is said
    counts[:, :, 30] = np.rint(rng.normal(1e4, 900.0, (25, SHAPE[0])))  # nor is a noisy column
    tifffile.imwrite(movie, counts, photometric="minisblack")
    found = fit_stack(movie, _config(camera={"frame_rate_hz": None}))
    assert len(found.table) == 0
    assert f"{1 + SHAPE[0]} dead, hot or noisy pixels are left out" in found.warnings
