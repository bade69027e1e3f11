"""The diffusion coefficient of a track, against dense covariances that are made another way.

The reference has the covariance of *positions*, from E[x(s) x(t)] = 2D min(s, t) averaged over two
exposures, and matrices of full size; the code under test has displacements and three bands.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import multivariate_normal, norm

import iscat_analysis as ia
from iscat_analysis._kernels.diffusion import displacement_likelihoods
from iscat_analysis._kernels.harmonic_trap import harmonic_likelihoods, most_likely_well
from iscat_analysis.species import diffusion, motion
from iscat_analysis.species.diffusion import Displacements, gather

EXACT = 1e-9  # of float64, after a factorisation of a hundred rows
SLOPE = 1e-5  # central differences
RATE_HZ = 331.0
SIGMAS = 4.0


def make_track(
    n: int = 40, axes: int = 2, *, exposure: float = 1.0, missing: float = 0.2, seed: int = 1
) -> Displacements:
    rng = np.random.default_rng(seed)
    frames = np.sort(rng.choice(round(n / (1 - missing)), n, replace=False))
    track = gather(
        frames, np.zeros((n, axes)), rng.uniform(10, 30, (n, axes)),
        frame_rate_hz=RATE_HZ, exposure_ms=exposure * 1e3 / RATE_HZ,
    )  # fmt: skip
    return motion.free_track(track, 0.15e6, rng)


def given(track: Displacements) -> dict[str, Any]:
    return {
        "frames": track.frames,
        "positions_nm": track.positions_nm.T,
        "sigma_nm": np.sqrt(track.variance_nm2.T),
        "frame_rate_hz": 1 / track.interval_s,
        "exposure_ms": 1e3 * track.exposure_s,
    }


def position_covariance(track: Displacements) -> np.ndarray:
    """Of averages over exposures, for D = 1, from the start of the first exposure."""
    start = (track.frames - track.frames[0]) * track.interval_s
    earlier = np.minimum.outer(start, start)
    share = np.where(np.eye(start.size, dtype=bool), 1 / 3, 1 / 2)
    return 2 * (earlier + share * track.exposure_s)


def dense(track: Displacements, d: float, motion_of_one: np.ndarray | None = None) -> float:
    one = position_covariance(track) if motion_of_one is None else motion_of_one
    difference = np.diff(np.eye(track.frames.size), axis=0)
    value = 0.0
    for places, variance in zip(track.positions_nm, track.variance_nm2, strict=True):
        sigma = difference @ (d * one + np.diag(variance)) @ difference.T
        value += multivariate_normal(cov=sigma).logpdf(difference @ places)
    return value


# ---- the likelihood --------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("exposure", [0.0, 0.4, 1.0])
def test_three_bands_are_the_whole_likelihood(axes: int, exposure: float) -> None:
    track = make_track(axes=axes, exposure=exposure)
    for d in (0.0, 1e3, 0.15e6, 3e6):
        assert track.likelihood(d).value == pytest.approx(dense(track, d), rel=EXACT)


@pytest.mark.parametrize("kept", [1.0, 0.8])
def test_likelihoods_of_many_d_are_those_of_each(kept: float) -> None:
    arguments = given(make_track(n=90))
    counted = np.random.default_rng(5).random(89) <= kept
    track = gather(**arguments, counted=counted)
    ladder = np.array([0.0, 1e2, 1e4, 0.15e6, 3e6, 1e8, 5.0])
    found = displacement_likelihoods((track.steps_nm, *track.error, *track.rate), ladder)
    assert found == pytest.approx([track.likelihood(d).value for d in ladder], rel=1e-12)


def test_derivatives_and_information() -> None:
    track = make_track()
    difference = np.diff(np.eye(track.frames.size), axis=0)
    for d in (0.05e6, 0.6e6):
        here, h = track.likelihood(d), 1e-4 * d
        low, high = track.likelihood(d - h), track.likelihood(d + h)
        slope, curvature = ((b - a) / (2 * h) for a, b in ((low[0], high[0]), (low[1], high[1])))
        assert here.slope == pytest.approx(slope, rel=SLOPE, abs=1e-3 * SLOPE / d)
        assert here.curvature == pytest.approx(curvature, rel=SLOPE)
        information, log_determinant = 0.0, 0.0
        for variance in track.variance_nm2:
            one = difference @ position_covariance(track) @ difference.T
            sigma = d * one + difference @ np.diag(variance) @ difference.T
            product = np.linalg.solve(sigma, one)
            information += 0.5 * np.trace(product @ product)
            log_determinant += np.linalg.slogdet(sigma)[1]
        assert here.information == pytest.approx(information, rel=EXACT)
        assert here.log_determinant == pytest.approx(log_determinant, rel=EXACT)


def test_the_maximum_is_the_brute_ones() -> None:
    for seed in range(5):
        track = make_track(n=25, seed=seed)
        found = ia.fit_diffusion(**given(track))
        brute = minimize_scalar(
            lambda d, track=track: -dense(track, d), bounds=(1.0, 3e6), method="bounded",
            options={"xatol": 1e-3},
        )  # fmt: skip
        assert found.d_um2_s == pytest.approx(brute.x / 1e6, rel=1e-6)
        assert found.log_likelihood == pytest.approx(-brute.fun, rel=EXACT)
        assert found.n_positions == 25


def test_the_bound_is_berglunds() -> None:
    """Equal errors and no gaps: cosines diagonalise the covariance (Berglund 2010, equation 15).

    100 positions on two axes, D 0.15 µm²/s, 331 Hz, 20 nm, full exposure: 0.0260052 µm²/s by the
    sum over cosines, 17 % of D.
    """
    n, sigma, dt = 100, 20.0, 1 / RATE_HZ
    track = gather(np.arange(n), np.zeros((n, 2)), sigma, frame_rate_hz=RATE_HZ, exposure_ms=None)
    wave = 1 - np.cos(np.pi * np.arange(1, n) / n)
    rate = 2 * dt - 2 * dt / 3 * wave
    information = 2 * 0.5 * np.sum((rate / (0.15e6 * rate + 2 * sigma**2 * wave)) ** 2)
    bound = 1 / math.sqrt(track.likelihood(0.15e6).information)
    assert bound == pytest.approx(1 / math.sqrt(information), rel=EXACT)
    assert bound / 1e6 == pytest.approx(0.0260052, rel=1e-5)


def test_without_errors_and_blur_it_is_the_mean_square() -> None:
    rng = np.random.default_rng(4)
    frames = np.cumsum(rng.integers(1, 4, 50))
    places = rng.normal(size=(50, 2)).cumsum(axis=0) * 40
    found = ia.fit_diffusion(frames, places, 1e-3, frame_rate_hz=100.0, exposure_ms=0.0)
    gaps = np.diff(frames)[:, np.newaxis] / 100
    expected = np.mean(np.diff(places, axis=0) ** 2 / (2 * gaps)) / 1e6
    assert found.d_um2_s == pytest.approx(expected, rel=1e-6)
    assert found.crb_d_um2_s == pytest.approx(expected * math.sqrt(2 / 98), rel=1e-6)
    assert found.sigma_d_um2_s == pytest.approx(found.crb_d_um2_s, rel=1e-5)


def test_what_does_not_matter() -> None:
    track = make_track()
    arguments = given(track)
    found = ia.fit_diffusion(**arguments)
    moved = arguments | {
        "frames": track.frames + 1000,
        "positions_nm": arguments["positions_nm"][:, ::-1] + [5e4, -3e3],
        "sigma_nm": arguments["sigma_nm"][:, ::-1],
    }
    again = ia.fit_diffusion(**moved)
    assert again.d_um2_s == pytest.approx(found.d_um2_s, rel=1e-6)
    assert again.interval_um2_s == pytest.approx(found.interval_um2_s, rel=1e-6)
    full = {**arguments, "exposure_ms": None}
    assert ia.fit_diffusion(**full) == found


def test_any_track_gives_numbers() -> None:
    """Lengths, errors, gaps and rates over many orders of magnitude."""
    rng = np.random.default_rng(0)
    for _ in range(150):
        n, axes = rng.choice([4, 5, 8, 60]), rng.integers(1, 4)
        rate = 10 ** rng.uniform(-5, 8)
        places = rng.choice([0, 1, 1]) * 10 ** rng.uniform(-6, 8) * rng.standard_normal((n, axes))
        found = ia.fit_diffusion(
            np.cumsum(rng.integers(1, rng.choice([2, 4, 10**6]), n)),
            places.cumsum(axis=0) if rng.random() < 0.5 else places,
            10 ** (rng.uniform(-6, 4) + rng.uniform(0, 4.9, (n, axes))),
            frame_rate_hz=rate, exposure_ms=rng.choice([0, 0.3, 1]) * 1e3 / rate,
        )  # fmt: skip
        low, high = found.interval_um2_s
        assert 0 <= low <= found.d_um2_s <= high < math.inf
        assert 0 < found.sigma_d_um2_s < math.inf
        assert math.isfinite(found.covariance_d_um2_s + found.log_likelihood)


# ---- the interval and the second opinion -----------------------------------------------------


def test_the_interval_ends_where_the_likelihood_has_fallen() -> None:
    track = make_track(n=200)
    for level in (0.6827, 0.95):
        found = ia.fit_diffusion(**given(track), level=level)
        fall = norm.ppf(0.5 + level / 2) ** 2 / 2
        for end in found.interval_um2_s:
            assert dense(track, end * 1e6) == pytest.approx(found.log_likelihood - fall, abs=1e-6)


def test_critical_values_cover() -> None:
    """Draw N(μ, 1), estimate max(x, 0), and count the intervals that hold μ."""
    x = np.random.default_rng(8).standard_normal(400_000)
    for mu in (0.0, 0.05, 0.5, 1.0, 1.5, 1.9, 3.0):
        best = np.maximum(x + mu, 0)
        ratio = (x + mu - mu) ** 2 - (x + mu - best) ** 2
        held = np.mean(ratio <= diffusion.critical_value(mu, 0.95) ** 2)
        assert abs(held - 0.95) < SIGMAS * math.sqrt(0.95 * 0.05 / x.size)
    assert diffusion.critical_value(0.0, 0.95) == pytest.approx(1.6449, abs=1e-4)
    assert diffusion.critical_value(2.5, 0.95) == pytest.approx(1.9600, abs=1e-4)


def test_a_particle_that_stands_still() -> None:
    found = ia.fit_diffusion(np.arange(50), np.zeros((50, 2)), 15.0, frame_rate_hz=RATE_HZ)
    assert found.d_um2_s == 0
    assert found.interval_um2_s[0] == 0
    assert 0 < found.interval_um2_s[1] < 0.01
    assert found.sigma_d_um2_s == found.crb_d_um2_s > 0


def test_the_covariance_based_estimate_needs_no_errors() -> None:
    """Its mean is D whatever the errors, gaps and blur: trace of its weights with Σ, exactly."""
    track = make_track(n=12, axes=1)
    difference = np.diff(np.eye(12), axis=0)
    for exposure, d in ((0.0, 0.3e6), (0.7, 0.3e6), (1.0, 0.0)):
        blurred = gather(**given(track) | {"exposure_ms": exposure * 1e3 / RATE_HZ})
        noise = np.diag(blurred.variance_nm2[0])
        sigma = difference @ (d * position_covariance(blurred) + noise) @ difference.T
        values, directions = np.linalg.eigh(sigma)
        mean = 0.0
        for value, direction in zip(values, directions.T, strict=True):
            places = np.concatenate([[0.0], np.cumsum(math.sqrt(value) * direction)])
            one = gather(**given(blurred) | {"positions_nm": places})
            mean += diffusion.covariance_based(one, d)[0]
        assert mean == pytest.approx(d, rel=1e-9, abs=1e-3)


def test_the_covariance_based_estimate_has_its_error() -> None:
    rng, d = np.random.default_rng(5), 0.3e6
    track = make_track(n=30)
    drawn = [diffusion.covariance_based(motion.free_track(track, d, rng), d) for _ in range(1000)]
    values, errors = np.array(drawn).T
    assert abs(values.mean() - d) < SIGMAS * values.std() / math.sqrt(values.size)
    assert values.std() / errors[0] == pytest.approx(1, abs=SIGMAS / math.sqrt(values.size))


# ---- other motion ----------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.6])
@pytest.mark.parametrize("exposure", [0.0, 0.005, 0.6, 1.0])
def test_blur_of_anomalous_motion(exponent: float, exposure: float) -> None:
    track = make_track(n=5, missing=0.5, exposure=exposure)
    lags = motion.Lags.of(track)
    found = motion.covariance(
        lags, motion.mean_squared_displacement(track, lags.distinct, exponent)
    )
    dt, start = track.interval_s, track.frames.astype(float)

    def averaged(lag: float) -> float:
        if exposure == 0:
            return abs(lag) ** exponent
        # the difference of two uniform times has a triangle for its density
        density = lambda u, _: abs(lag + u * exposure) ** exponent * (1 - abs(u))  # noqa: E731
        pieces = [(-1, 0), (0, 1)]
        return sum(dblquad(density, 0, 1, a, b, epsabs=1e-12, epsrel=1e-10)[0] for a, b in pieces)

    msd = np.array([[2 * dt * (averaged(a - b) - averaged(0)) for a in start] for b in start])
    expected = -0.5 * np.diff(np.diff(msd, axis=0), axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * dt)


@pytest.mark.parametrize("exposure", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("stiffness", [0.5, 20.0, 900.0])
def test_the_filter_of_a_well_is_the_dense_likelihood(exposure: float, stiffness: float) -> None:
    track, d = make_track(n=30, exposure=exposure), 0.2e6
    e = exposure * track.interval_s
    lag = np.abs(np.subtract.outer(track.frames, track.frames)) * track.interval_s
    mean = np.exp(-stiffness * lag)
    if e:
        u = stiffness * e
        mean *= 2 * (np.cosh(u) - 1) / u**2
        np.fill_diagonal(mean, 2 * (u - 1 + np.exp(-u)) / u**2)
    wells = np.array([7.0, stiffness, 3.0])
    timed = track.positions_nm, track.variance_nm2, track.gaps_s, e
    found = harmonic_likelihoods(timed, np.array([1e4, d, 1e7]), wells)[1]
    assert found == pytest.approx(dense(track, d, mean / stiffness), rel=1e-8)


def test_a_soft_well_is_none() -> None:
    track = make_track()
    timed = track.positions_nm, track.variance_nm2, track.gaps_s, track.exposure_s
    (soft,) = harmonic_likelihoods(timed, np.array([0.15e6]), np.array([1e-4]))
    assert soft == pytest.approx(track.likelihood(0.15e6).value, abs=1e-3)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("walled", [False, True])
def test_the_best_well_is_that_of_a_simplex_search(walled: bool, seed: int) -> None:
    arguments = in_a_well(60.0, 120, seed) if walled else given(make_track(n=120, seed=seed))
    track, d = gather(**({"exposure_ms": None} | arguments)), 0.15e6
    soft, stiff = 0.3 / float(track.gaps_s.sum()), 3 / track.interval_s
    given_ones = track.positions_nm, track.variance_nm2, track.gaps_s, track.exposure_s

    def lost(theta: np.ndarray) -> float:
        wells = d * np.exp(theta[:1]), np.exp(theta[1:])
        return -float(harmonic_likelihoods(given_ones, *wells)[0])

    rungs = np.linspace(math.log(soft), math.log(stiff), 6)
    limits = [(-10.0, 10.0), (rungs[0], rungs[-1])]
    best = min(
        minimize(lost, (0.0, rung), method="Nelder-Mead", tol=1e-6, bounds=limits).fun
        for rung in rungs
    )
    value, d_there, stiffness = most_likely_well(given_ones, d, soft, stiff)
    assert value == pytest.approx(-best, abs=1e-3)
    assert value == pytest.approx(-lost(np.log([d_there / d, stiffness])), rel=1e-12)


def test_drawn_tracks_have_the_covariance() -> None:
    track, rng, trials = make_track(n=6), np.random.default_rng(3), 8000
    drawn = np.array([motion.free_track(track, 0.15e6, rng).steps_nm[0] for _ in range(trials)])
    main, beside = (band[0] for band in track.error)
    main, beside = main + 0.15e6 * track.rate[0], beside + 0.15e6 * track.rate[1]
    expected = np.diag(main) + np.diag(beside, 1) + np.diag(beside, -1)
    error = np.sqrt((np.outer(main, main) + expected**2) / trials)
    assert (np.abs(drawn.T @ drawn / trials - expected) < SIGMAS * error).all()


def in_a_well(size_nm: float, n: int, seed: int) -> dict[str, Any]:
    """Draw a particle of 0.15 µm²/s in a well, 50 steps to a frame."""
    rng, parts = np.random.default_rng(seed), 50
    decay = math.exp(-0.15e6 / size_nm**2 / RATE_HZ / parts)
    kicks = size_nm * math.sqrt(1 - decay**2) * rng.standard_normal((n * parts, 2))
    kicks[0] = size_nm * rng.standard_normal(2)
    for i in range(1, len(kicks)):
        kicks[i] += decay * kicks[i - 1]
    sigma = rng.uniform(10, 30, (n, 2))
    places = kicks.reshape(n, parts, 2).mean(axis=1) + sigma * rng.standard_normal((n, 2))
    return {
        "frames": np.arange(n), "positions_nm": places, "sigma_nm": sigma, "frame_rate_hz": RATE_HZ,
    }  # fmt: skip


def test_a_well_is_found() -> None:
    """τ = L²/D is 24 ms for 60 nm, so that 0.6 s are 25 of them."""
    for seed in range(3):
        arguments = in_a_well(60.0, 200, seed)
        found = ia.confinement_test(**arguments, resamples=99)
        assert found.p_value == 0.01
        assert found.confinement_nm == pytest.approx(60, rel=0.4)
        assert found.d_um2_s == pytest.approx(0.15, rel=0.5)
        repeated = ia.confinement_test(**arguments, resamples=99)
        assert repeated == found
    free = ia.confinement_test(**given(make_track(n=100)), resamples=39)
    assert free.p_value > 0.05


def test_a_free_track_soon_says_so() -> None:
    """What stops early gives the share of those drawn, by the same tracks in the same order."""
    arguments = given(make_track(n=60))
    soon = ia.confinement_test(**arguments, resamples=99, enough=3, rng=np.random.default_rng(4))
    drawn = round(3 / soon.p_value)
    assert 3 <= drawn < 99
    assert soon.p_value == 3 / drawn
    exact = ia.confinement_test(**arguments, resamples=drawn, rng=np.random.default_rng(4))
    assert exact.p_value == (3 + 1) / (drawn + 1)
    assert (exact.ratio, exact.confinement_nm) == (soon.ratio, soon.confinement_nm)
    walled = in_a_well(60.0, 200, 0)
    assert ia.confinement_test(**walled, resamples=99, enough=3).p_value == 0.01


def test_a_track_that_another_took_over_has_no_one_d() -> None:
    """100 of 900 steps of a particle five times as fast; of free tracks few say so, and evenly."""
    rng = np.random.default_rng(3)

    def p_of(n: int, fast: int) -> float:
        d = np.where(np.arange(n) < n - fast, 0.15e6, 0.8e6)[:, None, None]
        kicks = np.sqrt(2 * d / RATE_HZ / 8) * rng.standard_normal((n, 8, 2))
        mean = np.cumsum(kicks.reshape(-1, 2), axis=0).reshape(n, 8, 2).mean(axis=1)
        places = mean + 25.0 * rng.standard_normal((n, 2))
        track = gather(np.arange(n), places, 25.0, frame_rate_hz=RATE_HZ, exposure_ms=None)
        return motion.steadiness_of(track)

    assert p_of(900, 100) < 1e-6
    assert p_of(motion.STRETCH * 2, 0) == 1.0  # one displacement fewer than two stretches
    free = np.array([p_of(400, 0) for _ in range(60)])
    assert abs(free.mean() - 0.5) < 4 / math.sqrt(12 * 60)


@pytest.mark.parametrize("exponent", [0.4, 1.0, 1.7])
def test_slopes_of_the_likelihood_of_an_exponent(exponent: float) -> None:
    track = make_track(n=40, missing=0.3, exposure=0.7)
    lags, at = motion.Lags.of(track), np.array([math.log(0.1e6), exponent])
    part = 1e-5 * np.eye(2)

    def told(at: np.ndarray) -> Any:
        return motion.likelihood_at(track, lags, at)

    def covariances(at: np.ndarray) -> np.ndarray:
        one = motion.covariance(lags, motion.mean_squared_displacement(track, lags.distinct, at[1]))
        sigma = np.array([math.exp(at[0]) * one + np.diag(main) for main in track.error[0]])
        for among, beside in zip(sigma, track.error[1], strict=True):
            among += np.diag(beside, 1) + np.diag(beside, -1)
        return sigma

    there, sigma = told(at), covariances(at)
    value = sum(
        multivariate_normal.logpdf(steps, cov=one)
        for steps, one in zip(track.steps_nm, sigma, strict=True)
    )
    assert there.value == pytest.approx(value, rel=EXACT)
    sides = [(told(at - h), told(at + h)) for h in part]
    slope = [(b.value - a.value) / 2e-5 for a, b in sides]
    assert there.slope == pytest.approx(slope, rel=SLOPE, abs=1e-4)
    bends = [(a.slope - b.slope) / 2e-5 for a, b in sides]
    close = 1e-3 * float(there.information[1, 1])  # of the MSD, second differences of α
    assert there.curvature == pytest.approx(np.array(bends), rel=1e-4, abs=close)
    turns = [(covariances(at + h) - covariances(at - h)) / 2e-5 for h in part]
    by = [np.linalg.solve(sigma, turn) for turn in turns]
    information = [[np.einsum("cij,cji", one, other) / 2 for one in by] for other in by]
    assert there.information == pytest.approx(np.array(information), rel=1e-4)


def test_the_most_likely_exponent() -> None:
    """From a start far off, against a search that knows no slopes; at the end of its range too."""
    track = make_track(n=80, missing=0.2)
    lags = motion.Lags.of(track)
    straight = np.outer([30.0, -30.0], track.frames)
    for moved in (track, replace(track, positions_nm=track.positions_nm + straight)):

        def lost(at: np.ndarray, moved: Displacements = moved) -> float:
            inside = np.clip(at, [-math.inf, 0.02], [math.inf, 1.98])
            return -motion.likelihood_at(moved, lags, inside).value

        best = minimize(lost, [12.0, 1.2], method="Nelder-Mead", options={"xatol": 1e-6})
        at, found = motion.most_likely_power(moved, 0.5 * math.exp(best.x[0]))
        assert found.value == pytest.approx(-best.fun, abs=1e-3)
        assert abs(at[1] - best.x[1]) < 0.03 * np.linalg.inv(found.information)[1, 1] ** 0.5


def test_a_direction_is_found() -> None:
    """4 µm/s along each axis: 3 µm in 0.75 s, six times what diffusion makes of it."""
    track = make_track(n=200)
    arguments = given(track)
    straight = np.outer(track.frames * track.interval_s, [4000.0, -4000.0])
    found = ia.anomalous_test(**arguments | {"positions_nm": arguments["positions_nm"] + straight})
    assert found.p_value < 1e-3
    assert found.exponent > 1.1
    free = ia.anomalous_test(**arguments)
    assert free.p_value > 0.05
    assert abs(free.exponent - 1) < 2.5 * free.sigma_exponent
    assert free.ratio == pytest.approx(((free.exponent - 1) / free.sigma_exponent) ** 2, abs=0.1)


def test_tests_of_a_particle_that_stands_still() -> None:
    still = {"frames": range(50), "positions_nm": np.zeros(50), "sigma_nm": 9.0,
             "frame_rate_hz": 50.0}  # fmt: skip
    assert ia.confinement_test(**still) == ia.ConfinementTest(1.0, 0.0, math.inf, 0.0)
    found = ia.anomalous_test(**still)
    assert (found.p_value, found.d_um2_s) == (1.0, 0.0)
    assert math.isnan(found.exponent)


# ---- size ------------------------------------------------------------------------------------


def test_stokes_and_einstein() -> None:
    """In k T/(3π η D) the factor is 490.746 nm µm²/s in water at 25 °C."""
    diameter, sigma = ia.hydrodynamic_diameter([1.0, 10.0, 0.0], [0.05, 0.1, 0.1])
    np.testing.assert_allclose(diameter, [490.7462, 49.07462, np.inf], rtol=1e-6)
    np.testing.assert_allclose(sigma, [24.53731, 0.4907462, np.inf], rtol=1e-6)
    thick, _ = ia.hydrodynamic_diameter(1.0, viscosity_mpa_s=1.78, temperature_c=25.0)
    assert float(thick) == pytest.approx(490.7462 / 2, rel=1e-6)


# ---- what cannot be --------------------------------------------------------------------------

GOOD: dict[str, Any] = {
    "frames": [0, 1, 2, 4, 5],
    "positions_nm": np.arange(10.0).reshape(5, 2),
    "sigma_nm": 5.0,
    "frame_rate_hz": 100.0,
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frame_rate_hz": 0.0}, "frame_rate_hz = 0: give one number of frames per second"),
        ({"frame_rate_hz": math.nan}, "frame_rate_hz = nan"),
        ({"exposure_ms": -1.0}, "exposure_ms = -1: give one number of at least 0"),
        ({"exposure_ms": 11.0}, "exposure_ms = 11 is longer than the 10 ms from frame to frame"),
        ({"frames": [0, 1, 2]}, "at least 4 positions"),
        ({"frames": [0, 1, 1, 4, 5]}, "whole numbers that increase"),
        ({"frames": [0, 1, 2.5, 4, 5]}, "whole numbers that increase"),
        ({"frames": [5, 4, 2, 1, 0]}, "whole numbers that increase"),
        ({"positions_nm": np.zeros((4, 2))}, "positions_nm: has shape (4, 2); give (5,) or"),
        ({"positions_nm": np.zeros((5, 0))}, "positions_nm: has shape (5, 0)"),
        (
            {"positions_nm": [0, 1, math.nan, 3, 4]},
            "positions_nm = nan: give each position in nanometres",
        ),
        (
            {"positions_nm": [0, 1, 1e12, 3, 4]},
            "positions_nm = 1e+12: give each position in nanometres",
        ),
        ({"positions_nm": ["a"] * 5}, "positions_nm: holds"),
        ({"sigma_nm": 0.0}, "sigma_nm = 0: give the standard error"),
        ({"sigma_nm": [1.0, 2.0, 3.0]}, "sigma_nm: has shape (3,)"),
        ({"sigma_nm": [1.0, 2.0, 3.0, math.inf, 2.0]}, "sigma_nm = inf"),
        ({"sigma_nm": [1.0, 2.0, 3.0, 1e6, 2.0]}, "sigma_nm: goes from 1 to 1e+06 nm; leave out"),
    ],
)
def test_impossible_tracks(change: dict[str, Any], said: str) -> None:
    for function in (ia.fit_diffusion, ia.anomalous_test, ia.confinement_test):
        with pytest.raises(ia.IscatError) as caught:
            function(**GOOD | change)
        assert said in str(caught.value)


def test_other_impossible_arguments() -> None:
    for level in (0.0, 1.0, math.nan):
        with pytest.raises(ia.ConfigError, match="level = "):
            ia.fit_diffusion(**GOOD, level=level)
    for resamples in (0, 1.5, True):
        with pytest.raises(ia.ConfigError, match="resamples = "):
            ia.confinement_test(**GOOD, resamples=resamples)  # type: ignore[arg-type]
        with pytest.raises(ia.ConfigError, match="enough = "):
            ia.confinement_test(**GOOD, enough=resamples)  # type: ignore[arg-type]
    many = motion.MOST_POSITIONS + 1
    with pytest.raises(ia.DataError, match="give a part of the track"):
        ia.anomalous_test(range(many), np.zeros(many), 5.0, frame_rate_hz=100.0)
    for wrong in ({"viscosity_mpa_s": 0.0}, {"temperature_c": -300.0}):
        with pytest.raises(ia.ConfigError, match=next(iter(wrong))):
            ia.hydrodynamic_diameter(1.0, **wrong)
    for d, sigma in ((-1.0, 0.0), (1.0, -0.1), (math.nan, 0.0), ([1.0, 2.0], [1.0, 2.0, 3.0])):
        with pytest.raises(ia.DataError, match="d_um2_s"):
            ia.hydrodynamic_diameter(d, sigma)
