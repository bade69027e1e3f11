"""Steps whose light goes on changing are told from those that the model does not describe."""

from __future__ import annotations

import pandas as pd

from iscat_analysis.diagnosis.causes import course_warning


def _table(ok: int, changing: int, undescribed: int) -> pd.DataFrame:
    return pd.DataFrame({
        "status": ["ok"] * ok + ["poor_fit"] * (changing + undescribed),
        "p_value": [0.4] * (ok + changing) + [1e-9] * undescribed,
    })  # fmt: skip


def test_many_steps_that_are_none_are_told() -> None:
    told = course_warning(_table(20, 15, 5))
    assert told.startswith("15 of 20 events that are poor_fit are described by the model")


def test_few_of_them_and_a_wrong_model_are_not() -> None:
    assert not course_warning(_table(20, 0, 20))
    assert not course_warning(_table(20, 4, 4))
    assert not course_warning(_table(200, 10, 0))
    assert not course_warning(_table(0, 0, 0))
