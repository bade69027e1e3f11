"""How near the bound the fits come: the same experiment again and again, with known truth.

`setting` says what is repeated, `trials` repeats it, `scores` sets the estimates beside the bounds,
`baselines` are the estimators to be beaten, `calibration` asks whether posteriors are right, and
`study` is all of it for one configuration, written as a folder.
"""

from __future__ import annotations

from iscat_analysis.benchmark.baselines import Baselines
from iscat_analysis.benchmark.setting import Setting, make_setting
from iscat_analysis.benchmark.trials import Trials, run_trials, trial_generator

__all__ = ["Baselines", "Setting", "Trials", "make_setting", "run_trials", "trial_generator"]
