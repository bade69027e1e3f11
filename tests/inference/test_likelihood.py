"""The noise models, judged by scipy's distributions, numerical derivatives and Monte Carlo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scenes import PIXEL_NM, gold, make_config, observed_information
from scipy.stats import binom, poisson

from iscat_analysis._kernels.radial import profile_at
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model

# Sums of a few hundred logarithms of counts near 1e6 carry this much rounding.
ROUNDING = 1e-7
# Interpolation along z against the pupil sum, relative to the largest value of each channel.
INTERPOLATED = 1e-7
# Central differences of smooth functions: truncation and rounding balanced.
NUMERICAL = 2e-6
# Monte Carlo, in standard errors; among some 100 numbers 5 is exceeded once in 2e4 runs.
SIGMAS = 5.0

GRID = PixelGrid.centred(11, PIXEL_NM)


@dataclass(frozen=True)
class Case:
    """A microscope and a particle in it: θ, and how far the counts are from it."""

    model: ForwardModel
    theta: np.ndarray


def _case(amplitude: float = 1.0, level: float = 0.0, z_nm: float = 60.0, **sections) -> Case:
    config = make_config(calibrated=False, **sections)
    model = forward_model(config, 1500.0)
    theta = np.array([31.0, -52.0, z_nm, amplitude * model.material.mass_kda, level])
    return Case(model, theta)


@pytest.fixture(scope="module")
def weak() -> Case:
    return _case()


@pytest.fixture(scope="module")
def strong() -> Case:
    """Gold, with contrasts beyond ±0.2: outside the series of the logarithm."""
    case = _case(level=0.15, **gold())
    signal = case.model.image(GRID, *case.theta[:4])
    assert np.abs(signal).max() > 0.5
    return case


@pytest.fixture(scope="module")
def dark() -> Case:
    return _case(optics={"scheme": "darkfield"})


def _level(seed: int = 3) -> np.ndarray:
    """Speckle, so that no two pixels are alike."""
    return np.random.default_rng(seed).uniform(0.7, 1.3, GRID.shape)


def _conditional(case: Case, seed: int = 1, *, per_pixel: float = 1e5, **options) -> Likelihood:
    rng = np.random.default_rng(seed)
    light = per_pixel * _level()
    ratio = 1.3
    signal = case.model.image(GRID, *case.theta[:4])
    before = rng.poisson(light).astype(float)
    after = rng.poisson(ratio * light * np.exp(case.theta[LEVEL]) * (1 + signal)).astype(float)
    return noise.conditional(case.model, GRID, before, after, ratio, **options)


def _poisson(case: Case, seed: int = 1, *, per_pixel: float = 1e5, **options) -> Likelihood:
    rng = np.random.default_rng(seed)
    signal = case.model.image(GRID, *case.theta[:4])
    if case.model.rho:
        background = scale = per_pixel * _level()
    else:
        background, scale = 30 * _level(), per_pixel / signal.max() * np.ones(GRID.shape)
    rate = np.exp(case.theta[LEVEL]) * (background + scale * signal)
    counts = rng.poisson(rate).astype(float)
    return noise.poisson(case.model, GRID, counts, background, scale, **options)


def _any(kind: str, case: Case, reads: tuple[float, float] | None = None, **options) -> Likelihood:
    """Give one of both, with variances of what was read before and after."""
    if kind == "poisson":
        return _poisson(case, extra_variance_e2=sum(reads or (0.0,)), **options)
    return _conditional(case, read_variances_e2=reads or (0.0, 0.0), **options)


def _slopes(which: Likelihood, theta: np.ndarray, steps: np.ndarray, of: int) -> np.ndarray:
    """Differentiate the value (0) or the score (1) along θ, by four points."""
    out = []
    for step in np.diag(steps)[: np.count_nonzero(steps)]:
        at = [which.score_fisher(theta + k * step)[of] for k in (-2, -1, 1, 2)]
        out.append((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step.sum()))
    return np.array(out)


def _thetas(case: Case, count: int = 6) -> np.ndarray:
    """Points around the truth, with and without a level."""
    rng = np.random.default_rng(8)
    spread = np.array([40.0, 40.0, 15.0, 0.2 * case.theta[3], 0.03])
    return case.theta + spread * rng.uniform(-1, 1, (count, 5))


def _log_pmf(which: Likelihood, theta: np.ndarray) -> float:
    """Sum the logarithms of the probabilities, pixel by pixel, with scipy."""
    data0, data1, data2, _ = which.data
    level = np.exp(theta[LEVEL])
    signal = which.model.image(which.grid, *theta[:4])
    if which.noise == CONDITIONAL:
        q = data2 * level * (1 + signal)
        return float(binom.logpmf(data0, data1, q / (1 + q)).sum())
    return float(poisson.logpmf(data0, level * (data1 + data2 * signal)).sum())


KINDS = ["conditional", "poisson"]
CASES = [("conditional", "weak"), ("conditional", "strong"), ("poisson", "weak"),
         ("poisson", "strong"), ("poisson", "dark")]  # fmt: skip


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_values_are_scipys(kind: str, name: str, request) -> None:
    case = request.getfixturevalue(name)
    which = _any(kind, case)
    nothing = case.theta * np.array([1, 1, 1, 0, 0])
    reference = _log_pmf(which, nothing)
    thetas = _thetas(case)
    expected = np.array([_log_pmf(which, theta) - reference for theta in thetas])
    # log Γ of counts near 1e6, in a few hundred pixels, is what scipy rounds.
    np.testing.assert_allclose(which.values(thetas), expected, rtol=ROUNDING, atol=1e-5)


def test_masses_that_turn_the_field_round_are_valued(strong: Case) -> None:
    which = _conditional(strong)
    theta = strong.theta * np.array([1, 1, 1, -0.3, 1])
    nothing = strong.theta * np.array([1, 1, 1, 0, 0])
    expected = _log_pmf(which, theta) - _log_pmf(which, nothing)
    assert which.values(theta[None])[0] == pytest.approx(expected, rel=ROUNDING)


@pytest.mark.parametrize("kind", KINDS)
def test_the_series_meets_the_logarithm(kind: str, strong: Case) -> None:
    """Across the border between the two branches the value has no step."""
    which = _any(kind, strong)
    nothing = strong.theta * np.array([1, 1, 1, 0, 0])
    reference = _log_pmf(which, nothing)
    signal = strong.model.image(GRID, *strong.theta[:4])
    border = 0.2 / np.abs(signal).max()
    for factor in np.linspace(0.8, 1.2, 9):
        theta = nothing.copy()
        theta[3] = factor * border * strong.theta[3]
        expected = _log_pmf(which, theta) - reference
        assert which.values(theta[None])[0] == pytest.approx(expected, rel=ROUNDING, abs=1e-4)


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_score_pass_and_batch_agree_on_the_value(kind: str, name: str, request) -> None:
    case = request.getfixturevalue(name)
    which = _any(kind, case)
    for theta in _thetas(case, 3):
        value = which.score_fisher(theta)[0]
        assert value == pytest.approx(which.values(theta[None])[0], rel=1e-6, abs=1e-4)


def _steps(case: Case) -> np.ndarray:
    return np.array([0.02, 0.02, 0.02, 1e-4 * case.theta[3], 1e-5])


@pytest.mark.parametrize("read", [0.0, 4e4])
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_score_is_the_gradient(kind: str, name: str, read: float, request) -> None:
    case = request.getfixturevalue(name)
    which, steps = _any(kind, case, (0.0, read)), _steps(case)
    for theta in _thetas(case, 3):
        _, score, fisher = which.score_fisher(theta)
        near = 1e-9 / steps + NUMERICAL * (np.abs(score) + np.sqrt(np.diag(fisher)))  # and rounding
        assert np.all(np.abs(_slopes(which, theta, steps, 0) - score) < near)


@pytest.mark.parametrize("read", [0.0, 4e4])
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_observed_information_is_the_hessian(kind: str, name: str, read: float, request) -> None:
    case = request.getfixturevalue(name)
    which, theta = _any(kind, case, (read, 0.0)), _thetas(case, 1)[0]
    observed = observed_information(which, theta)
    np.testing.assert_allclose(observed, observed.T, rtol=1e-12)
    numerical = -_slopes(which, theta, _steps(case), 1)
    size = np.sqrt(np.diag(which.score_fisher(theta)[2]))
    scale = np.outer(size, size)
    np.testing.assert_allclose(observed / scale, numerical / scale, atol=NUMERICAL)


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_observed_equals_expected_on_expected_counts(kind: str, name: str, request) -> None:
    case = request.getfixturevalue(name)
    theta = case.theta * np.array([1, 1, 1, 1, 0])
    if kind == "conditional":
        asimov = noise.asimov_conditional(case.model, GRID, theta, 1e4 * _level(), 150, 200)
    else:
        background = (1e6 if case.model.rho else 30) * _level()
        scale = background if case.model.rho else 1e3
        asimov = noise.asimov_poisson(case.model, GRID, theta, background, scale)
    _, score, fisher = asimov.score_fisher(theta)
    size = np.sqrt(np.diag(fisher))
    np.testing.assert_allclose(score / size, 0, atol=1e-6)
    expected = fisher / np.outer(size, size)
    observed = observed_information(asimov, theta) / np.outer(size, size)
    np.testing.assert_allclose(observed, expected, atol=1e-10)


def test_fisher_is_the_written_sum(strong: Case) -> None:
    """physics.md, section 4, written out."""
    theta = strong.theta * np.array([1, 1, 1, 1, 0])
    n_before, n_after, light = 150, 220, 1e4 * _level()
    asimov = noise.asimov_conditional(strong.model, GRID, theta, light, n_before, n_after)
    signal, gradient = strong.model.gradient(GRID, *theta[:4])
    rho = n_after / n_before
    weight = n_after * light / (1 + signal) / (1 + rho * (1 + signal))
    expected = np.einsum("yx,iyx,jyx->ij", weight, gradient, gradient)
    # The reference is in kDa and the likelihood's amplitude too: no calibration here.
    np.testing.assert_allclose(asimov.score_fisher(theta)[2][:4, :4], expected, rtol=1e-10)


@pytest.mark.parametrize("trials", [4000])
@pytest.mark.parametrize(
    ("kind", "read_noise_e"), [("conditional", 0.0), ("conditional", 25.0), ("poisson", 25.0)]
)
def test_scores_scatter_as_the_information_says(
    kind: str, read_noise_e: float, trials: int, weak: Case
) -> None:
    """Monte Carlo: the score has mean 0 and covariance F, read noise included."""
    pulls = _score_pulls(kind, weak, trials, read_noise_e, told=read_noise_e)
    _assert_standard(pulls)


def test_untold_read_noise_is_noticed(weak: Case) -> None:
    """Control: the test above can fail."""
    pulls = _score_pulls("conditional", weak, 4000, 25.0, told=0.0)
    with pytest.raises(AssertionError):
        _assert_standard(pulls)


def _score_pulls(
    kind: str, case: Case, trials: int, read_noise_e: float, told: float
) -> np.ndarray:
    """Scores at the truth, whitened with the information, shape (trials, 5)."""
    rng = np.random.default_rng(11)
    light, n_before, n_after = 400 * _level(), 3, 2
    signal = case.model.image(GRID, *case.theta[:4])
    theta = case.theta * np.array([1, 1, 1, 1, 0])
    pulls = np.empty((trials, 5))
    for k in range(trials):
        before, after = (
            rng.poisson(n * light * bright)
            + np.sqrt(n) * read_noise_e * rng.normal(size=GRID.shape)
            for n, bright in ((n_before, 1.0), (n_after, 1 + signal))
        )
        if kind == "conditional":
            which = noise.conditional(
                case.model, GRID, before, after, n_after / n_before,
                read_variances_e2=(n_before * told**2, n_after * told**2),
            )  # fmt: skip
        else:
            which = noise.poisson(
                case.model, GRID, after, n_after * light, n_after * light,
                extra_variance_e2=n_after * told**2,
            )  # fmt: skip
        _, score, fisher = which.score_fisher(theta)
        values, vectors = np.linalg.eigh(fisher / np.sqrt(np.outer(*2 * [np.diag(fisher)])))
        pulls[k] = (vectors.T @ (score / np.sqrt(np.diag(fisher)))) / np.sqrt(values)
    return pulls


def _assert_standard(pulls: np.ndarray) -> None:
    trials = len(pulls)
    mean = pulls.mean(axis=0) * np.sqrt(trials)
    spread = (pulls.T @ pulls / trials - np.eye(5)) * np.sqrt(trials)
    spread[np.diag_indices(5)] /= np.sqrt(2)
    assert np.abs(mean).max() < SIGMAS
    assert np.abs(spread).max() < SIGMAS


# ---- limits ----------------------------------------------------------------------------------


def test_a_long_background_is_a_known_one(weak: Case) -> None:
    theta = weak.theta
    light = 1e4 * _level()
    known = noise.asimov_poisson(weak.model, GRID, theta, 200 * light, 200 * light)
    expected = known.score_fisher(theta)[2]
    for n_before in (10**6, 10**8):
        measured = noise.asimov_conditional(weak.model, GRID, theta, light, n_before, 200)
        ratio = measured.score_fisher(theta)[2] / expected
        np.testing.assert_allclose(ratio, 1, atol=3 * 200 / n_before)


def test_dark_field_with_nothing_behind_it(dark: Case) -> None:
    """Zero background, pixels without a photon: values, score and residuals stay finite."""
    theta = dark.theta
    signal = dark.model.image(GRID, *theta[:4])
    scale = 8.0 / signal.max()
    counts = np.random.default_rng(4).poisson(scale * signal).astype(float)
    assert (counts == 0).any()
    which = noise.poisson(dark.model, GRID, counts, 0.0, scale)
    value, score, fisher = which.score_fisher(theta)
    unit = np.sqrt(np.diag(fisher))[:4]
    slopes = _slopes(which, theta, _steps(dark) * [1, 1, 1, 1, 0], 0)
    np.testing.assert_allclose(slopes / unit, score[:4] / unit, atol=1e-4)
    other = theta * np.array([1, 1, 1, 1.1, 1])
    expected = sum(
        sign * poisson.logpmf(counts, scale * dark.model.image(GRID, *t[:4])).sum()
        for sign, t in ((1, other), (-1, theta))
    )
    assert which.values(other[None])[0] - value == pytest.approx(expected, abs=1e-6)
    assert np.isfinite(which.residuals(theta)).all()
    assert np.isfinite(observed_information(which, theta)).all()


# ---- masks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_masked_pixel_says_nothing(kind: str, weak: Case) -> None:
    masked = np.random.default_rng(5).random(GRID.shape) < 0.2
    with_mask = _any(kind, weak, masked=masked)
    data = with_mask.data.copy()
    assert with_mask.n_pixels == np.count_nonzero(~masked)
    assert not data[:, masked].any()
    everything = _any(kind, weak)
    signal, gradient = weak.model.gradient(GRID, *weak.theta[:4])
    weight = everything.signal_information(signal) * ~masked
    expected = np.einsum("yx,iyx,jyx->ij", weight, gradient, gradient)
    fisher = with_mask.score_fisher(weak.theta)[2][:4, :4]
    # signal_information keeps the measured total in place of its expectation, as the kernel does.
    np.testing.assert_allclose(fisher, expected, rtol=1e-9)
    assert np.isnan(with_mask.residuals(weak.theta)[masked]).all()
    assert np.isnan(with_mask.measured_signal()[masked]).all()
    assert (with_mask.signal_information()[masked] == 0).all()
    assert np.isfinite(observed_information(with_mask, weak.theta)).all()


# ---- interpolation along z --------------------------------------------------------------------


@pytest.mark.parametrize(
    "optics",
    [
        {"focus_nm": -300.0},
        {"focus_nm": 1000.0, "na": 1.3},
        {"scheme": "cobri", "attenuation": 0.06},
        {"scheme": "darkfield", "na": 1.49},
        {"emission": "reciprocal", "axial": "refocus"},
    ],
)
def test_profiles_between_the_tabulated_heights(optics: dict) -> None:
    config = make_config(calibrated=False, optics=optics, fit={"z_range_nm": [0.0, 2000.0]})
    model = forward_model(config, 2000.0)
    table = model.axial_table
    width = table.heights.shape[3]
    rng = np.random.default_rng(12)
    for z in [0.0, 2000.0, *rng.uniform(0, 2000, 12)]:
        direct = model.profile(z, 2)
        got = np.empty((width // 6, 6, 8))
        profile_at(table, z, 0, width, got)
        for pair in range(0, 8, 2):  # real and imaginary part of F0, F2 and their ∂/∂z
            size = np.abs(direct[:, 0, pair : pair + 2]).max()
            # nodes of the radial spline, then its polynomial inside the intervals
            difference = (got - direct)[:, :, pair : pair + 2]
            tolerance = INTERPOLATED if pair < 4 else 10 * INTERPOLATED
            assert np.abs(difference[:, 0]).max() < tolerance * size
            assert np.abs(difference.sum(axis=1)).max() < tolerance * size
