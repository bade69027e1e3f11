"""The smallest mass that is detected: rates of false alarms and misses in drawn frames."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import norm

from iscat_analysis.bounds import DetectionLimit, Experiment, detection_limit, plan, power_searched
from iscat_analysis.config import parse_config
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.records import Box, Candidate, FloatArray

DRAWS = 400
SIGMAS = 4.0
SIZE = 19


def _setup(n_after: int = 100, false: float = 0.02) -> tuple[Experiment, DetectionLimit]:
    config = parse_config(
        {
            "camera": {"pixel_size_nm": 84.4},
            "particle": {"mass_kda": 66.0},
            "bounds": {
                "pixels": SIZE, "n_before": 100, "n_after": n_after, "photons_per_pixel": 1e4,
                "false_alarm_probability": false, "miss_probability": 0.1,
            },
        }
    )  # fmt: skip
    experiment = plan(config, model=forward_model(config, 3000.0))  # room for a fitted place
    limit = detection_limit(experiment)
    assert limit is not None
    return experiment, limit


def _drawn(experiment: Experiment, mass: float, seed: int) -> Likelihood:
    rng = np.random.default_rng([31, seed])
    signal = experiment.model.image(experiment.grid, 0.0, 0.0, 5.0, mass)
    before, after = (rng.poisson(1e6 * (1 + s)).astype(float) for s in (0 * signal, signal))
    return noise.conditional(experiment.model, experiment.grid, before, after, 1.0)


def _known(experiment: Experiment, mass: float) -> FloatArray:
    """Signed √(2Δℓ) with only the amplitude free."""
    free = np.arange(5) == 3
    found = []
    for seed in range(DRAWS):
        start = experiment.theta.copy()
        start[3] = 0.0
        box = Box(free, *(np.where(free, end, start) for end in (-1e6, 1e6)))
        best = _drawn(experiment, mass, seed).maximize(start, box)
        found.append(math.copysign(math.sqrt(2 * max(best.log_likelihood, 0)), best.theta[3]))
    return np.array(found)


def _off(share: float, expected: float) -> float:
    return abs(share - expected) / math.sqrt(expected * (1 - expected) / DRAWS)


def test_a_known_place_keeps_its_false_alarms_and_misses() -> None:
    experiment, limit = _setup()
    z = norm.isf([0.02, 0.1])
    assert limit.snr_known == z.sum()
    false = np.mean(_known(experiment, 0.0) > limit.threshold_known)
    assert _off(float(false), 0.02) < SIGMAS
    found = np.mean(_known(experiment, limit.mass_known_kda) > limit.threshold_known)
    assert _off(float(found), 0.9) < SIGMAS
    # and the curve has this slope: a third less mass is another curve
    fainter = limit.snr_known * 2 / 3
    found = np.mean(_known(experiment, limit.mass_known_kda * 2 / 3) > limit.threshold_known)
    assert _off(float(found), norm.cdf(fainter - limit.threshold_known)) < SIGMAS
    assert _off(float(found), 0.9) > SIGMAS


def test_a_searched_place_is_found_as_often_as_said() -> None:
    experiment, limit = _setup()
    for share in (0.8, 1.0):
        mass = share * limit.mass_searched_kda
        found = 0
        for seed in range(DRAWS):
            fit = fit_particle(
                _drawn(experiment, mass, seed), Candidate(0.0, 0.0, 5.0, mass, 5.0), "mass",
                (0.0, 100.0), level=False,
            )  # fmt: skip
            found += fit.snr > limit.threshold_searched
        expected = power_searched(share * limit.snr_searched, limit.threshold_searched)
        assert _off(found / DRAWS, expected) < SIGMAS
        wrong = power_searched(0.85 * share * limit.snr_searched, limit.threshold_searched)
        assert _off(found / DRAWS, wrong) > SIGMAS  # a scale that is wrong by 15 % is noticed


def test_frames_and_fields_change_it_as_they_must() -> None:
    """Four times all frames halve the mass; a larger field needs more."""
    config = _setup()[0].config
    _, limit = _setup()
    bounds = config.bounds.model_copy(update={"n_before": 400, "n_after": 400})
    longer = detection_limit(plan(config.model_copy(update={"bounds": bounds})))
    assert longer is not None
    assert abs(2 * longer.mass_known_kda / limit.mass_known_kda - 1) < 1e-3
    wide = config.bounds.model_copy(update={"pixels": 151})
    field = detection_limit(plan(config.model_copy(update={"bounds": wide})))
    assert field is not None
    assert field.threshold_searched > limit.threshold_searched > limit.threshold_known
    dark = config.optics.model_copy(update={"scheme": "darkfield"})
    assert detection_limit(plan(config.model_copy(update={"optics": dark}))) is None
