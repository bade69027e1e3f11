"""A short movie with many particles that hardly move, through an instrument of its own.

What overlaps answers a change of the background together.  Taken for answers of their own, steps of
the background grew from turn to turn: of this movie 1468 of 2295 positions were found.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from wanderers import SETTINGS, wander

import iscat_analysis as ia

pytestmark = pytest.mark.large

NEAR_NM = 300.0
SPECIES = ((200.0, 0.15, 3), (200.0, 0.8, 2), (400.0, 0.15, 3), (400.0, 0.8, 2))


def test_overlapping_particles_do_not_drive_the_background_away() -> None:
    movie = wander((300, 112, 112), seed=4, species=SPECIES)
    rows = ia.fit_movie(movie.counts, settings=SETTINGS).table
    apart = 2 * NEAR_NM  # between frames
    seen, true = (
        table[["x_nm", "y_nm"]].assign(t=apart * table["frame"])
        for table in (rows, movie.truth[movie.truth["inside"]])
    )
    anywhere = movie.truth[["x_nm", "y_nm"]].assign(t=apart * movie.truth["frame"])
    from_true, _ = cKDTree(seen).query(true)
    from_seen, _ = cKDTree(anywhere).query(seen)
    assert np.mean(from_true < NEAR_NM) > 0.97
    assert np.mean(from_seen > NEAR_NM) < 0.01
    assert rows["chi2_reduced"].median() == pytest.approx(1.0, abs=0.02)
