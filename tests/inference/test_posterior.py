"""The posterior against analytic covariance, its priors, its seeds, and when it is refused."""

from __future__ import annotations

from concurrent.futures import CancelledError

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.config import Config
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference import posterior
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.posterior import Prior, sample_posterior
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.records import Candidate, FitResult

SIGMAS = 5.0

GRID = PixelGrid.region((0, 24), (0, 24), PIXEL_NM)
X, Y = 11.3, 12.1

Case = tuple[Likelihood, FitResult]
JOINT = {"optics": {"focus_nm": -500.0}}


def _case(
    config: Config, z_nm: float, mass: float, mode: str, z_range: tuple[float, float]
) -> Case:
    model = forward_model(config, 4000.0)
    signal = model.image(GRID, X * PIXEL_NM, Y * PIXEL_NM, z_nm, mass)
    rng = np.random.default_rng(2)
    before, after = (rng.poisson(2e6 * s).astype(float) for s in (1 + 0 * signal, 1 + signal))
    likelihood = noise.conditional(model, GRID, before, after, 1.0)
    fit = fit_particle(likelihood, Candidate(X, Y, z_nm, mass, 10.0), mode, z_range, level=False)
    return likelihood, fit


@pytest.fixture(scope="module")
def gaussian() -> Case:
    """Fit a strong particle, whose likelihood is normal within its σ."""
    return _case(make_config(**JOINT), 150.0, 2000.0, "joint", (0.0, 500.0))


def test_a_strong_particle_has_the_analytic_posterior(gaussian: Case) -> None:
    likelihood, fit = gaussian
    result = sample_posterior(likelihood, fit, walkers=32, steps=1500, seed=4)
    assert result.converged
    assert result.names == fit.free
    draws = result.samples.reshape(-1, 4)
    ess = result.ess_bulk.min()
    centre = np.array([fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda])
    pulls = (draws.mean(axis=0) - centre) / fit.sigma * np.sqrt(ess)
    # The maximum was settled to 0.02 σ.
    assert np.abs(pulls).max() < SIGMAS + 0.02 * np.sqrt(ess)
    scale = np.outer(fit.sigma, fit.sigma)
    difference = (np.cov(draws.T) - fit.covariance) / scale
    assert np.abs(difference).max() < SIGMAS * np.sqrt(2 / ess) + 0.02
    assert (result.r_hat < posterior.MAX_R_HAT).all()
    assert (result.ess_tail > posterior.MIN_ESS).all()
    assert (result.samples.shape[1] > posterior.MIN_TAUS * result.tau).all()


def test_a_normal_prior_narrows_the_posterior_as_it_must(gaussian: Case) -> None:
    """Likelihood and prior are normal: precisions add, the mean is their weighted mean."""
    likelihood, fit = gaussian
    width = 0.5 * fit.sigma
    centre = np.array([0.0, 0.0, fit.z_nm + fit.sigma[2], fit.mass_kda - fit.sigma[3]])
    prior = Prior({"z_nm": (centre[2], width[2]), "mass_kda": (centre[3], width[3])})
    result = sample_posterior(likelihood, fit, walkers=32, steps=1500, seed=4, prior=prior)
    assert result.converged, result.message
    known = np.diag([0.0, 0.0, width[2] ** -2, width[3] ** -2])
    seen = np.linalg.inv(fit.covariance)
    total = np.linalg.inv(seen + known)
    at = np.array([fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda])
    expected = total @ (seen @ at + known @ centre)
    draws = result.samples.reshape(-1, 4)
    sigma = np.sqrt(np.diag(total))
    ess = result.ess_bulk.min()
    assert np.abs((draws.mean(axis=0) - expected) / sigma).max() < SIGMAS / np.sqrt(ess) + 0.02
    assert draws.std(axis=0) / sigma == pytest.approx([1] * 4, abs=SIGMAS / np.sqrt(2 * ess) + 0.02)
    assert result.van_trees == pytest.approx(sigma, rel=0.02)
    assert np.all(result.van_trees[2:] < 0.5 * fit.sigma[2:])
    thetas = np.tile(fit.theta, (32, 1))  # what is kept is the likelihood without the prior
    thetas[:, :3] = result.samples[:, 7, :3]
    thetas[:, 3] = [likelihood.model.scale.amplitude(m) for m in result.samples[:, 7, 3]]
    np.testing.assert_allclose(
        likelihood.values(thetas, pictured=True), result.log_likelihood[:, 7], rtol=1e-9
    )


def test_the_same_seed_draws_the_same(gaussian: Case) -> None:
    draws = [
        sample_posterior(*gaussian, walkers=10, steps=200, seed=seed).samples for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


def test_priors_bound_the_draws() -> None:
    """Close to the glass half of the peak lies beyond z = 0, and none of it is drawn."""
    likelihood, fit = _case(make_config(**JOINT), 0.3, 150.0, "joint", (0.0, 500.0))
    result = sample_posterior(likelihood, fit, walkers=32, steps=1500, seed=1)
    z = result.samples[..., 2]
    assert z.min() >= 0
    assert z.max() <= 500
    sigma = np.sqrt(np.linalg.inv(likelihood.score_fisher(fit.theta)[2][:4, :4])[2, 2])
    assert z.std() < 0.9 * sigma
    assert np.mean(z < 0.1 * sigma) > 0.02  # and the density does not vanish at the wall


def _mode_share(result: posterior.PosteriorResult, near_nm: float) -> float:
    return float(np.mean(np.abs(result.samples[..., 2] - near_nm) < 60))


def test_two_fringes_are_both_visited() -> None:
    """The share of each is its evidence: height of the peak times its width."""
    likelihood, fit = _case(make_config(**JOINT), 700.0, 25.0, "joint", (600.0, 1000.0))
    assert fit.alternatives
    other = fit.alternatives[0]
    result = sample_posterior(likelihood, fit, walkers=40, steps=3000, seed=1)
    first, second = _mode_share(result, fit.z_nm), _mode_share(result, other.z_nm)
    assert first + second > 0.6
    assert min(first, second) > 0.01
    # Reference: the profile of the likelihood along z, integrated on a fine grid.
    heights = np.linspace(600, 1000, 400)
    values, _ = likelihood.scan_heights(heights, fit.theta, (0.0, 1e9))
    weight = np.exp(values - values.max())
    shares = [weight[np.abs(heights - z) < 60].sum() / weight.sum() for z in (fit.z_nm, other.z_nm)]
    assert first / second == pytest.approx(shares[0] / shares[1], rel=0.6)


def test_a_chain_that_has_not_converged_is_refused(
    gaussian: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A budget too small for any verdict but no; and what is missing is named."""
    monkeypatch.setattr(posterior, "EXTENSIONS", 1)
    result = sample_posterior(*gaussian, walkers=10, steps=40, seed=1)
    assert not result.converged
    assert "effective sample size" in result.message or "draws are fewer" in result.message


def test_a_chain_grows_until_it_converges(gaussian: Case) -> None:
    short = sample_posterior(*gaussian, walkers=32, steps=120, seed=1)
    assert short.samples.shape[1] > 120
    assert short.samples.shape[1] <= 120 * posterior.EXTENSIONS


def test_a_chain_that_is_interrupted_prints_nothing(
    gaussian: Case, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Likelihood, "values", interrupt)
    with pytest.raises(KeyboardInterrupt):
        sample_posterior(*gaussian, walkers=10, steps=10, seed=1)
    assert capfd.readouterr() == ("", "")


def test_a_chain_that_is_stopped_ends_there(gaussian: Case) -> None:
    asked = iter([False, False, True])
    with pytest.raises(CancelledError):
        sample_posterior(*gaussian, walkers=10, steps=1000, seed=1, stopped=lambda: next(asked))
    assert next(asked, None) is None
