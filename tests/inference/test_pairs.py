"""Particles of two halves: their mass, distance and direction reach the bound; points stay points.

The pictures are those of ``tests/instruments.py``, which share nothing with the package.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from instruments import PEAK_PER_KDA, Instrument, Pictures

from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.nuisances import Evidence, Pair, evidence_of, pair_of
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.records import Candidate, FitResult
from iscat_analysis.trust.extension import Extension, told_as_pairs, with_masses_of_pairs

LIGHT_E, SIGMAS = 6e6, 4.0
GRID = PixelGrid.centred(33, 84.0)


@cache
def pictures() -> Pictures:
    return Pictures(Instrument(emission="reciprocal"), 4000.0)


@cache
def config() -> Config:
    settings = {
        "camera.pixel_size_nm": 84.0, "optics.focus_nm": -300.0, "particle.height_nm": 5.0,
        "calibration.gradient_per_kda": pictures().sign * PEAK_PER_KDA,
    }  # fmt: skip
    return load_config(None, [f"{name}={value}" for name, value in settings.items()])


@cache
def model() -> ForwardModel:
    return forward_model(config(), 4500.0)


def seen(apart_nm: float, mass_kda: float, seed: int) -> tuple[Likelihood, FitResult, float]:
    """Fit a point to two halves; with their direction [°]."""
    rng = np.random.default_rng(seed)
    x, y, angle = *rng.uniform(-40, 40, 2), rng.uniform(0, math.pi)
    dx, dy = apart_nm / 2 * math.cos(angle), apart_nm / 2 * math.sin(angle)
    away = (
        ((GRID.x_nm - x - side * dx)[None, :], (GRID.y_nm - y - side * dy)[:, None])
        for side in (-1, 1)
    )
    signal = sum(pictures().contrast(*at, mass_kda / 2) for at in away)
    before, after = rng.poisson(LIGHT_E, GRID.shape), rng.poisson(LIGHT_E * (1 + signal))
    counts = (each.astype(float) for each in (before, after))
    likelihood = conditional(model(), GRID, *counts, np.ones(GRID.shape))
    start = Candidate(0.0, 0.0, 5.0, mass_kda, 50.0)
    return (
        likelihood,
        fit_particle(likelihood, start, "mass", (0.0, 1000.0), level=True),
        math.degrees(angle),
    )


def paired(likelihood: Likelihood, fit: FitResult) -> Pair:
    return pair_of(likelihood, fit, Evidence(*evidence_of(likelihood, fit)))


@pytest.mark.parametrize(("apart_nm", "mass_kda"), [(70.0, 430.0), (100.0, 430.0), (200.0, 92.0)])
def test_mass_distance_and_direction_reach_their_bounds(apart_nm: float, mass_kda: float) -> None:
    trials, pulls, points = 30, [], []
    for seed in range(trials):
        likelihood, fit, angle = seen(apart_nm, mass_kda, 100 + seed)
        pair = paired(likelihood, fit)
        turned = (pair.angle_deg - angle + 90) % 180 - 90
        pulls.append((
            (pair.pair_mass_kda - mass_kda) / pair.sigma_pair_mass_kda,
            (pair.separation_nm - apart_nm) / pair.sigma_separation_nm,
            turned / pair.sigma_angle_deg,
        ))  # fmt: skip
        points.append((fit.mass_kda - mass_kda) / pair.sigma_pair_mass_kda)
    mean, spread = np.mean(pulls, axis=0), np.std(pulls, axis=0, ddof=1)
    assert np.all(np.abs(mean) < SIGMAS / trials**0.5)
    assert np.all(np.abs(spread - 1) < SIGMAS / (2 * trials) ** 0.5)
    assert np.mean(points) < -SIGMAS / trials**0.5  # the control


def test_points_are_told_from_pairs_no_more_often_than_is_said() -> None:
    trials = 60
    chances = np.array([paired(*seen(0.0, 430.0, 500 + k)[:2]).p_point for k in range(trials)])
    known = chances[np.isfinite(chances)]  # at no distance at all, a fit has nothing to converge to
    assert np.count_nonzero(known < 0.05) <= 0.05 * trials + SIGMAS * (0.05 * trials) ** 0.5
    assert np.all(known > 1e-4)
    sure = [paired(*seen(200.0, 430.0, 600 + k)[:2]).p_point for k in range(5)]
    assert np.all(np.array(sure) < 1e-5)


def test_extended_rows_get_the_mass_of_two_halves_where_these_are_told() -> None:
    table = pd.DataFrame({
        "mass_kda": [90.0, 180.0, -180.0, 180.0], "sigma_mass_kda": 6.0, "crb_mass_kda": 6.0,
        "chi2_reduced": 1.2, "p_value": 1e-6, "status": "poor_fit", "flags": "poor_fit",
        "pair_mass_kda": [100.0, 200.0, -200.0, 200.0], "sigma_pair_mass_kda": 10.0,
        "separation_nm": 100.0, "sigma_separation_nm": [40.0, 15.0, 15.0, 15.0],
        "p_point": [0.1, 0.01, 0.01, 0.01], "pair_chi2_reduced": 1.0,
        "pair_p_value": [0.5, 0.5, 1e-6, 0.5],
    })  # fmt: skip
    flagged = np.array([True, True, True, False])
    nowhere = np.zeros(4, dtype=bool)
    wide = Extension(
        1250.0, 250.0, 1250.0, 250.0, True, False, nowhere, flagged, np.full(4, 9.0)
    )  # fmt: skip
    assert not told_as_pairs(table, wide).any()  # all may wiggle
    long_ones = replace(wide, long=np.array([True, False, False, True]))
    assert told_as_pairs(table, long_ones).tolist() == [True, False, False, False]
    which = told_as_pairs(table, replace(wide, is_long=True))
    assert which.tolist() == [False, True, True, False]
    out, left = with_masses_of_pairs(table, which), wide.without(which)
    assert out["mass_kda"].tolist() == [90.0, 200.0, -200.0, 180.0]
    assert out["sigma_mass_kda"].tolist() == [6.0, 10.0, 10.0, 6.0]
    assert out["status"].tolist() == ["poor_fit", "ok", "poor_fit", "poor_fit"]
    assert left.flagged.tolist() == [True, False, False, False]
    assert left.paired == 2
    assert "2 rows have the mass of two halves" in left.finding.text
    assert left.mass_shift_kda.tolist() == [9.0, 0.0, 0.0, 9.0]


@pytest.mark.parametrize(
    "other", ["fit.mode=joint", "optics.scheme=darkfield", "particle.height_sd_nm=5"]
)
def test_pairs_are_refused_where_they_are_not_fitted(other: str) -> None:
    settings = ["camera.pixel_size_nm=84", "background.frames=[0, 50]", "fit.pairs=true", other]
    with pytest.raises(ConfigError, match=r"fit\.pairs = true does not go together with"):
        load_config(None, settings)
