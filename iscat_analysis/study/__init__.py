"""How near the bound estimates come: the same experiment again and again, with known truth.

`simulate` makes movies, `setting` says what trials share, `trials` repeats them and asks whether
posteriors are right, `scores` sets the estimates beside the bounds, and `yardstick` and
`efficiency` score anybody's estimates.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iscat_analysis.study.efficiency import limits_of_many, matched
    from iscat_analysis.study.estimator_setup import EstimatorSetup
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
    from iscat_analysis.study.trials import (
        RANKS,
        PosteriorRanks,
        Trials,
        calibrate_posterior,
        run_trials,
        trial_generator,
    )
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
    "estimator_setup", "scores", "simulate", "yardstick", "setting", "trials", "efficiency",
)  # fmt: skip
"""Searched in this order when a name is first used, so that estimators start soon."""


def __getattr__(name: str) -> Any:
    """Import a name where it is first used."""
    for module in () if name in _MODULES or name.startswith("_") else _MODULES:
        found = vars(import_module(f"iscat_analysis.study.{module}"))
        if name in found:
            return found[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
