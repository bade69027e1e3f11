"""Steps whose light goes on changing are told from those that the model does not describe."""

from __future__ import annotations

import numpy as np
import pandas as pd

from iscat_analysis.diagnosis import landing_rate_warning, residue_warning


def _table(ok: int, changing: int, undescribed: int) -> pd.DataFrame:
    flags = [""] * ok + ["changing"] * changing + ["poor_fit"] * undescribed
    return pd.DataFrame({"status": [flag or "ok" for flag in flags], "flags": flags})


def test_many_steps_that_are_none_are_told() -> None:
    told = landing_rate_warning(_table(20, 15, 5))
    assert told is not None
    assert (told.values["slow"], told.values["of"]) == (15, 40)


def test_few_of_them_and_a_wrong_model_are_not() -> None:
    assert not landing_rate_warning(_table(20, 0, 20))
    assert not landing_rate_warning(_table(20, 4, 4))
    assert not landing_rate_warning(_table(200, 10, 0))
    assert not landing_rate_warning(_table(0, 0, 0))


def _rows(residues: np.ndarray, others: int) -> pd.DataFrame:
    status = ["sidelobe"] * len(residues) + ["ok"] * others
    return pd.DataFrame({"frame": [*residues, *range(others)], "status": status})


def test_many_residues_are_one_sentence_with_their_frames() -> None:
    """They were hundreds of rows, and nothing said that the light was the cause."""
    at_once = np.random.default_rng(1).integers(480, 520, 40)
    anywhere = np.random.default_rng(2).integers(0, 1000, 10)
    found = residue_warning(_rows(np.concatenate([at_once, anywhere]), 30), 40)
    assert found is not None
    assert found.values["rows"] == 50
    inside, frames = str(found.values["where"]).split(" of them in frames ")
    start, stop = (int(frame) for frame in frames.split(":", 2)[:2])
    assert int(inside) >= 40
    assert start <= 480 + 3
    assert 517 <= stop <= start + 81
    steadily = residue_warning(_rows(np.arange(0, 1000, 20), 30), 40)
    assert steadily is not None
    assert "all through the movie" in steadily.text
    assert not residue_warning(_rows(at_once[:8], 3), 40)  # few
    assert not residue_warning(_rows(at_once, 100), 40)  # a few for each particle
