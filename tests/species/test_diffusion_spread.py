"""Diffusion coefficients of many tracks with known truth, against what was predicted for them.

331 Hz, exposed all the time, two axes, errors of 10 to 30 nm that differ from frame to frame, one
frame in eleven missing, D of 0.01, 0.15 and 0.8 µm²/s, 30 to 1000 positions.

Predicted before anything was drawn:

- Bias: none of order 1/n, because the covariance is linear in D (`species.diffusion`).
- Spread: the Cramér–Rao bound, which the test computes at the true D.
- Pull: the standard error changes with D, dσ/dD = s, and D is like χ² of 2/s² = ν degrees of
  freedom, shifted.  (D̂ − D)/σ(D̂) then has the mean −2/(ν − 2)·√(ν/2) and the standard deviation
  ν^(3/2)/((ν − 2) √(ν − 4)): 1.14 and −0.27 for 30 positions at 0.15 µm²/s, 1.004 for 1000 (equal
  errors of 20 nm).  The signed root of the likelihood ratio, which the interval rests on, has none
  of that: 0 and 1.
- Blur or errors left out: D where the mean log-likelihood of the wrong covariance is highest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import minimize_scalar

import iscat_analysis as ia
from iscat_analysis.species import motion
from iscat_analysis.species.diffusion import Displacements, gather

pytestmark = pytest.mark.large

RATE_HZ = 331.0
SIGMAS = 4.0
BIAS = 0.03
CLOSE = 0.1  # of pulls and of spread over bound
CASES = [(d, n) for d in (0.15, 0.8) for n in (30, 100, 1000)]


def still(n: int, seed: int) -> Displacements:
    rng = np.random.default_rng([seed, n])
    frames = np.sort(rng.choice(round(1.1 * n), n, replace=False))
    sigma = rng.uniform(10, 30, (n, 2))
    return gather(frames, np.zeros((n, 2)), sigma, frame_rate_hz=RATE_HZ, exposure_ms=None)


@dataclass(frozen=True)
class Trials:
    """What came of tracks with the same frames and errors."""

    d: np.ndarray
    sigma: np.ndarray
    root: np.ndarray  # signed root of the likelihood ratio
    covered: float
    from_zero: float
    other: np.ndarray
    disagreement: np.ndarray
    bound: float

    @property
    def error(self) -> float:
        return float(self.d.std() / math.sqrt(self.d.size))


def repeat(
    track: Displacements, d: float, trials: int, *, seed: int, told: Displacements | None = None
) -> Trials:
    """Draw tracks and analyse them, with what is told of them if that is not the truth."""
    rng, told = np.random.default_rng(seed), told or track
    rows = []
    for _ in range(trials):
        drawn = replace(told, positions_nm=motion.free_track(track, d * 1e6, rng).positions_nm)
        found = ia.fit_diffusion(
            drawn.frames, drawn.positions_nm.T, np.sqrt(drawn.variance_nm2.T),
            frame_rate_hz=RATE_HZ, exposure_ms=1e3 * drawn.exposure_s,
        )  # fmt: skip
        low, high = found.interval_um2_s
        ratio = 2 * (found.log_likelihood - drawn.likelihood(d * 1e6).value)
        rows.append((
            found.d_um2_s, found.sigma_d_um2_s,
            math.copysign(math.sqrt(max(ratio, 0.0)), found.d_um2_s - d), low <= d <= high,
            low == 0, found.covariance_d_um2_s, found.disagreement,
        ))  # fmt: skip
    estimate, sigma, root, covered, from_zero, other, disagreement = np.array(rows).T
    bound = 1e-6 / math.sqrt(track.likelihood(d * 1e6).information)
    return Trials(
        estimate, sigma, root, covered.mean(), from_zero.mean(), other, disagreement, bound
    )


def predicted_pull(track: Displacements, d: float) -> tuple[float, float]:
    """Mean and standard deviation of (D̂ − D)/σ(D̂)."""
    h = 1e-3 * d
    low, high = (1e-6 / math.sqrt(track.likelihood(1e6 * x).information) for x in (d - h, d + h))
    nu = 2 / ((high - low) / (2 * h)) ** 2
    return -2 / (nu - 2) * math.sqrt(nu / 2), nu**1.5 / ((nu - 2) * math.sqrt(nu - 4))


@pytest.mark.parametrize(("d", "n"), CASES)
def test_estimates_are_unbiased_and_reach_the_bound(
    d: float, n: int, repetitions: Callable[[int, int], int]
) -> None:
    trials = repetitions(150 if n == 1000 else 500, 2500)
    track = still(n, 11)
    found = repeat(track, d, trials, seed=int(1000 * d) + n)
    standard = 1 / math.sqrt(2 * trials)  # relative, of a standard deviation
    bias, spread = found.d.mean() - d, found.d.std() / found.bound
    pull = (found.d - d) / found.sigma
    mean, width = predicted_pull(track, d)
    print(
        f"D {d} n {n} trials {trials}: bias {bias / d:+.4f} ± {found.error / d:.4f}, spread/CRB "
        f"{spread:.3f} ± {standard:.3f}, pull {pull.mean():+.3f} (predicted {mean:+.3f}) and "
        f"{pull.std():.3f} ({width:.3f}), root {found.root.mean():+.3f} and {found.root.std():.3f},"
        f" coverage {found.covered:.3f}, covariance-based {found.other.std() / found.bound:.2f} CRB"
    )
    assert abs(bias) < SIGMAS * found.error
    assert abs(bias) < BIAS * d
    assert spread < 1 + CLOSE
    assert abs(spread - 1) < SIGMAS * standard + 1 / n
    assert abs(found.root.std() - 1) < CLOSE
    assert abs(found.root.mean()) < SIGMAS / math.sqrt(trials) + 1 / math.sqrt(n)
    assert abs(pull.mean() - mean) < SIGMAS * width / math.sqrt(trials) + 1 / n
    assert abs(pull.std() / width - 1) < SIGMAS * 1.3 * standard + 1 / n
    assert abs(found.covered - 0.95) < SIGMAS * math.sqrt(0.95 * 0.05 / trials)
    # the second opinion: unbiased too, wider, and as far from the first as it says
    assert abs(found.other.mean() - d) < SIGMAS * found.other.std() / math.sqrt(trials)
    assert found.other.std() > 1.15 * found.bound
    assert abs(found.disagreement.std() - 1) < CLOSE + SIGMAS * standard


def pseudo_true(track: Displacements, d: float, told: Displacements) -> float:
    """D of highest mean log-likelihood under a covariance that is not the true one."""

    def dense(of: Displacements, axis: int, value: float) -> np.ndarray:
        main, beside = (band[axis] for band in of.error)
        main, beside = main + value * of.rate[0], beside + value * of.rate[1]
        return np.diag(main) + np.diag(beside, 1) + np.diag(beside, -1)

    def lost(value: float) -> float:
        total = 0.0
        for axis in range(2):
            wrong = dense(told, axis, value * 1e6)
            total += np.linalg.slogdet(wrong)[1]
            total += np.trace(np.linalg.solve(wrong, dense(track, axis, d * 1e6)))
        return total

    return float(minimize_scalar(lost, bounds=(1e-4, 20 * d), method="bounded").x)


@pytest.mark.parametrize("d", [0.15, 0.8])
@pytest.mark.parametrize("ignored", ["blur", "errors"])
def test_what_is_ignored_shows(d: float, ignored: str) -> None:
    """Controls that must fail: the bias is as predicted, far beyond 3 %, and is noticed."""
    track = still(100, 11)
    told = {
        "blur": replace(track, exposure_s=0.0),
        "errors": replace(track, variance_nm2=np.full_like(track.variance_nm2, 1e-2)),
    }[ignored]
    expected = pseudo_true(track, d, told)
    found = repeat(track, d, 200, seed=5, told=told)
    print(
        f"D {d}, {ignored} ignored: {found.d.mean():.4f} ± {found.error:.4f}, predicted "
        f"{expected:.4f}; disagreement {found.disagreement.mean():+.2f}"
    )
    assert abs(found.d.mean() - expected) < SIGMAS * found.error + 0.01 * expected
    assert abs(found.d.mean() / d - 1) > BIAS + SIGMAS * found.error / d
    assert found.covered < 0.9
    assert abs(found.disagreement.mean()) > 0.5


@pytest.mark.parametrize("n", [30, 100, 1000])
def test_slow_particles(n: int, repetitions: Callable[[int, int], int]) -> None:
    """0.01 µm²/s, steps of 8 nm under errors of 20 nm: right within its error, or 0 admitted."""
    d, trials = 0.01, repetitions(150 if n == 1000 else 500, 2500)
    found = repeat(still(n, 12), d, trials, seed=n)
    print(
        f"n {n} trials {trials}: bias {found.d.mean() / d - 1:+.3f} ± {found.error / d:.3f}, "
        f"spread/CRB {found.d.std() / found.bound:.3f}, coverage {found.covered:.3f}, "
        f"0 admitted {found.from_zero:.2f}"
    )
    assert abs(found.d.mean() - d) < SIGMAS * found.error
    assert found.d.std() / found.bound < 1 + CLOSE
    assert abs(found.covered - 0.95) < SIGMAS * math.sqrt(0.95 * 0.05 / trials)


@pytest.mark.parametrize("n", [30, 200])
def test_particles_that_stand_still(n: int, repetitions: Callable[[int, int], int]) -> None:
    """D̂ = 0 as often as the slope at 0, Σ_j μ_j (z_j² − 1) of the eigenvalues of E⁻¹A, is below 0.

    The interval is one-sided there, and holds 0 in at least 95 of 100 tracks: a few eigenvalues
    have almost all of the information on such a D, so that the normal limit is not reached.
    """
    trials = repetitions(500, 2500)
    track = still(n, 13)
    weights = []
    for main, beside in zip(*track.error, strict=True):
        noise = np.diag(main) + np.diag(beside, 1) + np.diag(beside, -1)
        rate = np.diag(track.rate[0]) + np.diag(track.rate[1], 1) + np.diag(track.rate[1], -1)
        weights.append(eigh(rate, noise, eigvals_only=True))
    normal = np.random.default_rng(1).standard_normal((20_000, 2 * (n - 1)))
    expected = np.mean((normal**2 - 1) @ np.concatenate(weights) < 0)
    found = repeat(track, 0.0, trials, seed=n)
    zero = np.mean(found.d == 0)
    print(f"n {n}: at 0 {zero:.3f}, predicted {expected:.3f}; coverage {found.covered:.3f}")
    assert abs(zero - expected) < SIGMAS * math.sqrt(expected * (1 - expected) / trials)
    assert found.from_zero == found.covered
    assert found.covered > 0.95 - SIGMAS * math.sqrt(0.95 * 0.05 / trials)


def test_free_motion_is_not_called_otherwise(repetitions: Callable[[int, int], int]) -> None:
    trials = repetitions(60, 400)
    rng, anomalous, confined, pulls = np.random.default_rng(2), [], [], []
    for number in range(trials):
        drawn = motion.free_track(still(60, 100 + number), 0.15e6, rng)
        arguments = (drawn.frames, drawn.positions_nm.T, np.sqrt(drawn.variance_nm2.T))
        one = ia.anomalous_test(*arguments, frame_rate_hz=RATE_HZ)
        two = ia.confinement_test(*arguments, frame_rate_hz=RATE_HZ, resamples=19, rng=rng)
        anomalous.append(one.p_value <= 0.05)
        pulls.append((one.exponent - 1) / one.sigma_exponent)
        confined.append(two.p_value <= 0.05)
    error = math.sqrt(0.05 * 0.95 / trials)
    print(f"{trials}: {np.mean(anomalous):.3f}, {np.mean(confined):.3f}, pull {np.std(pulls):.3f}")
    assert abs(np.mean(anomalous) - 0.05) < SIGMAS * error
    assert abs(np.mean(confined) - 0.05) < SIGMAS * error
    assert abs(np.std(pulls) - 1) < SIGMAS / math.sqrt(2 * trials)
