"""How near the bound the fits come: the same experiment again and again, with known truth.

`setting` says what is repeated, `trials` repeats it, `scores` sets the estimates beside the bounds,
`baselines` are the estimators to be beaten, `calibration` asks whether posteriors are right, and
`study` is all of it for one configuration, written as a folder.

Other people's estimators: `estimators` says what they are given and which there are, `contest` lets
them see the same counts, `yardstick` scores them, `efficiency` does so for those who simulated by
themselves, and `challenge` writes movies whose truth is withheld.
"""

from __future__ import annotations

from iscat_analysis.inference.prior import van_trees
from iscat_analysis.study.baselines import Baselines
from iscat_analysis.study.posteriors import PosteriorRanks, calibrate_posterior
from iscat_analysis.study.scores import (
    Score,
    pull_histogram,
    rank_test,
    score,
    share_interval,
    spread_error,
    spread_interval,
)
from iscat_analysis.study.setting import Setting, make_setting
from iscat_analysis.study.study import (
    check_benchmark_output,
    run_benchmark,
    write_benchmark,
)
from iscat_analysis.study.trials import Trials, run_trials, trial_generator

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
