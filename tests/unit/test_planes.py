"""Tracks that stay at one height while their height is fitted in every frame."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scenes import make_config

from iscat_analysis.pipeline.diagnosis import plane_warning

STEP_NM, SIGMA_NM = 30.0, 5.0


def _table(along: float, frames: int = 60, seed: int = 1) -> pd.DataFrame:
    """Two tracks whose steps along z have a share of the variance of those along x."""
    rng = np.random.default_rng(seed)
    rows = []
    for track in range(2):
        steps = STEP_NM * rng.standard_normal((frames, 3)) * [1, 1, np.sqrt(along)]
        places = np.cumsum(steps, axis=0) + np.array([3000, 3000, 400])
        places += rng.standard_normal((frames, 3)) * [SIGMA_NM, SIGMA_NM, 1.0]
        rows.append(pd.DataFrame(places, columns=["x_nm", "y_nm", "z_nm"]))
        rows[-1] = rows[-1].assign(track=track, frame=np.arange(frames))
    return pd.concat(rows).assign(sigma_x_nm=SIGMA_NM, sigma_y_nm=SIGMA_NM, status="ok")


JOINT = make_config(fit={"mode": "track"}, track={"free": "joint"})


def test_a_membrane_is_recognised() -> None:
    said = plane_warning(JOINT, _table(0.0).sample(frac=1, random_state=3))
    assert 'set track.free = "mass" and particle.height_nm = 400' in said
    across, along = (float(part.split()[0]) for part in said.split(" by ")[1:3])
    assert across == pytest.approx(STEP_NM, rel=0.2)
    assert along == pytest.approx(np.sqrt(2), rel=0.3)  # noise of two heights


@pytest.mark.parametrize("along", [1.0, 0.15])
def test_particles_that_move_along_z_are_none(along: float) -> None:
    """Near the coverslip they move less along z than along it."""
    assert plane_warning(JOINT, _table(along)) == ""


def test_nothing_is_said_where_little_is_known() -> None:
    assert plane_warning(JOINT, _table(0.0, frames=12)) == ""
    assert plane_warning(JOINT, _table(0.0).assign(status="poor_fit")) == ""
    assert plane_warning(JOINT, _table(0.0).assign(frame=np.arange(120) * 2)) == ""
    held = make_config(fit={"mode": "track"}, track={"free": "mass"})
    assert plane_warning(held, _table(0.0)) == ""
