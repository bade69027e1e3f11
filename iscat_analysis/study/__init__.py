"""How near the bound estimates come: the same experiment again and again, with known truth.

`simulate` makes movies, `setting` says what trials share, `trials` repeats them, `scores` sets the
estimates beside the bounds, `posteriors` asks whether posteriors are right, and `yardstick` and
`efficiency` score anybody's estimates.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iscat_analysis.study.efficiency import limits_of_many, matched
    from iscat_analysis.study.estimator_setup import EstimatorSetup
    from iscat_analysis.study.posteriors import RANKS, PosteriorRanks, calibrate_posterior
    from iscat_analysis.study.scores import (
        MIN_TRIALS,
        Score,
        pull_histogram,
        rank_test,
        score,
        share,
        share_interval,
        spread_error,
        spread_interval,
    )
    from iscat_analysis.study.setting import OF_DIPOLES, OF_SPHERES, Setting, make_setting, setup_of
    from iscat_analysis.study.simulate import Movie, write_stack
    from iscat_analysis.study.trials import Trials, run_trials, trial_generator
    from iscat_analysis.study.yardstick import (
        Limits,
        beside_best,
        detection_snr,
        limits_of_alike,
        mean_interval,
        paired,
        power_bound,
        recall_at,
        resamples,
        score_estimates,
    )

_MODULES = (
    "estimator_setup", "scores", "simulate", "yardstick", "setting", "trials", "posteriors",
    "efficiency",
)  # fmt: skip
"""Searched in this order when a name is first used, so that estimators start soon."""

__all__ = [
    "MIN_TRIALS", "OF_DIPOLES", "OF_SPHERES", "RANKS", "EstimatorSetup", "Limits", "Movie",
    "PosteriorRanks", "Score", "Setting", "Trials", "beside_best",
    "calibrate_posterior", "detection_snr", "limits_of_alike", "limits_of_many",
    "make_setting", "matched", "mean_interval", "paired", "power_bound", "pull_histogram",
    "rank_test", "recall_at", "resamples", "run_trials", "score", "score_estimates",
    "setup_of", "share", "share_interval", "spread_error", "spread_interval",
    "trial_generator", "write_stack",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a name where it is first used."""
    for module in _MODULES if name in __all__ else ():
        found = vars(import_module(f"iscat_analysis.study.{module}"))
        if name in found:
            return found[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
