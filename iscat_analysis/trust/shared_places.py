"""Steps at the place of a particle that is there: of its own light, or of another one on top.

The light of a particle that settles, bleaches or breathes changes again and again at its place, and
each change is found as a step of its own.  A second particle at the very place of a first one is
rare, and cannot be told from that.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from iscat_analysis.records import BoolArray, Status

SAME_NM = 150.0
"""Distance within which two steps are at one place."""

_MUCH = 3.0  # times a step's own mass that a particle must have, whose light the step may be of
_ALIKE = 3.0  # ratio of masses up to which two steps close in time may be the halves of one
_NO_STEP = (Status.SIDELOBE.value, Status.NOT_CONVERGED.value)


def at_a_shared_place(table: pd.DataFrame) -> BoolArray:
    """Tell which steps of a landing movie may be changes of a particle that is there.

    These are the much smaller ones while it is there, and of two alike in sign, mass and place that
    follow each other within one window, both.

    Shapes: result (rows,).
    """
    flagged = np.zeros(len(table), dtype=bool)
    real = np.flatnonzero(
        ~table["status"].isin(_NO_STEP).to_numpy() & table["mass_kda"].notna().to_numpy()
    )
    if real.size < 2:
        return flagged
    place = table[["x_nm", "y_nm"]].to_numpy(float)[real]
    mass, frame = table["mass_kda"].to_numpy(float)[real], table["frame"].to_numpy(float)[real]
    error = table["sigma_mass_kda"].to_numpy(float)[real]
    window = np.maximum(table["n_before"], table["n_after"]).to_numpy(float)[real]
    for i, j in cKDTree(place).query_pairs(SAME_NM):
        if abs(mass[i]) < abs(mass[j]):
            i, j = j, i  # i is the larger
        apart = abs(frame[i] - frame[j])
        near = apart < max(window[i], window[j])
        there = frame[j] > frame[i] if mass[i] > 0 else frame[j] < frame[i]
        gone = mass[i] * mass[j] < 0 and abs(mass[i] + mass[j]) < 4 * np.hypot(error[i], error[j])
        if (there or near) and not gone and abs(mass[i]) > _MUCH * abs(mass[j]):
            flagged[real[j]] = True
        elif near and mass[i] * mass[j] > 0 and abs(mass[i]) <= _ALIKE * abs(mass[j]):
            flagged[real[[i, j]]] = True
    return flagged
