"""Fringes of height: wrong ones are flagged, at 3000 photons and far below."""

from __future__ import annotations

import numpy as np
import pytest
from microscopes import setting
from scipy.stats import binom

from iscat_analysis.records import Status
from iscat_analysis.study import Setting, Trials, run_trials

pytestmark = pytest.mark.large

SEED = 8
TRIALS = 400
WRONG_FRINGES = 1e-3
SURPRISE = 1e-4
FAR = 6.0
"""Standard deviations beyond which an unflagged estimate is an error."""


def _anywhere(experiment: Setting, count: int) -> Trials:
    """Trials at heights spread evenly over [0, 1 µm]."""
    truths = np.tile(experiment.truth, (count, 1))
    truths[:, 2] = np.random.default_rng(SEED).uniform(0.0, 1000.0, count)
    return run_trials(experiment, count, seed=SEED, truths=truths)


@pytest.mark.parametrize("mode", ["localize", "joint"])
def test_wrong_fringes_are_flagged_at_3000_photons(mode: str) -> None:
    experiment = setting("iscat", mode, photons=3000.0, z_nm=500.0)
    trials = _anywhere(experiment, TRIALS)
    wrong = np.abs(trials.estimate - trials.truth)[:, 2] > experiment.context.model.fringe_nm / 4
    silent = int(np.sum(wrong & trials.unflagged))
    assert binom.sf(silent - 1, TRIALS, WRONG_FRINGES) > SURPRISE
    assert np.mean(trials.unflagged) > 0.98


@pytest.mark.parametrize(
    ("scheme", "mode"),
    [("iscat", "mass"), ("iscat", "localize"), ("iscat", "joint"), ("cobri", "joint"),
     ("darkfield", "mass"), ("darkfield", "joint")],
)  # fmt: skip
def test_no_silent_estimate_is_far_off_at_300_photons(scheme: str, mode: str) -> None:
    trials = _anywhere(setting(scheme, mode, photons=300.0, z_nm=500.0), TRIALS // 2)
    silent = trials.unflagged
    assert silent.any()
    assert np.all(np.isfinite(trials.estimate[silent]))
    pull = np.abs(trials.estimate - trials.truth)[silent] / trials.sigma[silent]
    assert np.nanmax(pull) < FAR


def test_wrong_fringes_exist_and_carry_the_flag() -> None:
    """At 100 photons heights are often wrong; without the flag this study would see them."""
    experiment = setting("iscat", "localize", photons=100.0, z_nm=500.0)
    trials = _anywhere(experiment, TRIALS)
    wrong = np.abs(trials.estimate - trials.truth)[:, 2] > experiment.context.model.fringe_nm / 4
    assert wrong.sum() > 10
    assert np.mean(trials.flagged(Status.AMBIGUOUS_Z)[wrong]) > 0.9
    silent = int(np.sum(wrong & trials.unflagged))
    assert binom.sf(silent - 1, TRIALS, WRONG_FRINGES) > SURPRISE
