"""Steps whose light goes on changing are told from those that the model does not describe."""

from __future__ import annotations

import pandas as pd

from iscat_analysis.diagnosis.causes import landing_rate_warning


def _table(ok: int, changing: int, undescribed: int) -> pd.DataFrame:
    flags = [""] * ok + ["changing"] * changing + ["poor_fit"] * undescribed
    return pd.DataFrame({"status": [flag or "ok" for flag in flags], "flags": flags})


def test_many_steps_that_are_none_are_told() -> None:
    told = landing_rate_warning(_table(20, 15, 5))
    assert told.startswith("the light of 15 of 40 events, flagged changing, goes on changing")


def test_few_of_them_and_a_wrong_model_are_not() -> None:
    assert not landing_rate_warning(_table(20, 0, 20))
    assert not landing_rate_warning(_table(20, 4, 4))
    assert not landing_rate_warning(_table(200, 10, 0))
    assert not landing_rate_warning(_table(0, 0, 0))
