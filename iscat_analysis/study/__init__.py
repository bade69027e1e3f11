"""How near the bound the fits come: the same experiment again and again, with known truth.

`setting` says what is repeated, `trials` repeats it, `scores` sets the estimates beside the bounds,
`baselines` are the estimators to be beaten, `calibration` asks whether posteriors are right, and
`study` is all of it for one configuration, written as a folder.

Other people's estimators: `estimators` says what they are given and which there are, `contest` lets
them see the same counts, `yardstick` scores them, `efficiency` does so for those who simulated by
themselves, and `challenge` writes movies whose truth is withheld.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iscat_analysis.inference.prior import van_trees as van_trees
    from iscat_analysis.study.baselines import Baselines as Baselines
    from iscat_analysis.study.posteriors import PosteriorRanks as PosteriorRanks
    from iscat_analysis.study.posteriors import calibrate_posterior as calibrate_posterior
    from iscat_analysis.study.scores import Score as Score
    from iscat_analysis.study.scores import pull_histogram as pull_histogram
    from iscat_analysis.study.scores import rank_test as rank_test
    from iscat_analysis.study.scores import score as score
    from iscat_analysis.study.scores import share_interval as share_interval
    from iscat_analysis.study.scores import spread_error as spread_error
    from iscat_analysis.study.scores import spread_interval as spread_interval
    from iscat_analysis.study.setting import Setting as Setting
    from iscat_analysis.study.setting import make_setting as make_setting
    from iscat_analysis.study.study import check_benchmark_output as check_benchmark_output
    from iscat_analysis.study.study import run_benchmark as run_benchmark
    from iscat_analysis.study.study import write_benchmark as write_benchmark
    from iscat_analysis.study.trials import Trials as Trials
    from iscat_analysis.study.trials import run_trials as run_trials
    from iscat_analysis.study.trials import trial_generator as trial_generator

_HOME = {
    "Baselines": "study.baselines",
    "PosteriorRanks": "study.posteriors",
    "Score": "study.scores",
    "Setting": "study.setting",
    "Trials": "study.trials",
    "calibrate_posterior": "study.posteriors",
    "check_benchmark_output": "study.study",
    "make_setting": "study.setting",
    "pull_histogram": "study.scores",
    "rank_test": "study.scores",
    "run_benchmark": "study.study",
    "run_trials": "study.trials",
    "score": "study.scores",
    "share_interval": "study.scores",
    "spread_error": "study.scores",
    "spread_interval": "study.scores",
    "trial_generator": "study.trials",
    "van_trees": "inference.prior",
    "write_benchmark": "study.study",
}
"""Where each name is; it is imported when it is first used, so that estimators start soon."""

__all__ = [
    "Baselines",
    "PosteriorRanks",
    "Score",
    "Setting",
    "Trials",
    "calibrate_posterior",
    "check_benchmark_output",
    "make_setting",
    "pull_histogram",
    "rank_test",
    "run_benchmark",
    "run_trials",
    "score",
    "share_interval",
    "spread_error",
    "spread_interval",
    "trial_generator",
    "van_trees",
    "write_benchmark",
]


def __getattr__(name: str) -> Any:
    """Import a name where it is asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"iscat_analysis.{_HOME[name]}"), name)
