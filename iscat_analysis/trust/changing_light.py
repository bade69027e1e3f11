"""Steps whose light goes on changing, because the particle is there already or lands slowly.

The light of a particle that settles, bleaches or breathes changes repeatedly at its place, and each
change is found as a step.  A second particle at exactly the same place is rare, and cannot be told
from that.  A particle that moves by a few nanometres, or wiggles, leaves a faint step beside it,
within the distance that the microscope resolves.

If particles take several frames to land, the rise of a faint one drowns in the noise of single
frames.  The steps of a chunk of the movie tell together how they rise, and all are fitted with that
rise.  Where they do not agree, a faint one may be fitted as a step, and its mass is too small.
Bright ones show that this happens.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import scipy

from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.records import BoolArray, Status

SAME_NM = 150.0
"""Distance within which two steps are at one place."""

# Mass of a particle over that of a step, from which on the step may be a change of its light.
_LEAST_MASS_RATIO = 3.0
# Change of a mean over a window, in standard deviations of the fluctuation of a frame, that hardly
# ever is exceeded: four of a difference of two.
_LARGEST_CHANGE = 4 * math.sqrt(2)
# Mass of a particle over that of a step beside it, from which on it may have moved: 20 nm change a
# picture by a fifth.
_LEAST_MASS_RATIO_BESIDE = 5.0
_BESIDE = 0.61  # λ/NA within which that is
# Ratio of masses up to which two steps close in time may be two halves of one landing.
_MOST_MASS_RATIO = 3.0
# Expected gain in log-likelihood of a rise over a step, from which on rises are mostly seen, and
# from which on a step without one does not rise. A rise that is missed makes the mass, and this
# gain with it, too small.
_LEAST_GAIN_SEEN, _LEAST_GAIN_CERTAIN = 10.0, 30.0
_FEWEST, _SHARE = 3, 0.2  # rises, and their share of the steps in which they would be seen
# Share of rising steps that go on rising, beyond which all may; by chance it is 0.002.
_LEAST_SHARE_CONTINUING = 0.1
_NO_STEP = (Status.SIDELOBE.value, Status.NOT_CONVERGED.value)


def at_a_shared_place(
    table: pd.DataFrame, resolution_nm: float = 0.0, relative: float = 0.0
) -> BoolArray:
    """Flag steps that may be changes of the light of a particle that is there already.

    These are steps much smaller than that particle, at its place or, smaller still, beside it.  Of
    two steps of the same sign, mass and place within one window, both are flagged.  A resolution
    is λ/NA; contrasts fluctuate by a relative standard deviation.

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
    farthest = max(SAME_NM, _BESIDE * resolution_nm)
    least_here = 1 / max(1 / _LEAST_MASS_RATIO, _LARGEST_CHANGE * relative)
    for i, j in scipy.spatial.cKDTree(place).query_pairs(farthest):
        if abs(mass[i]) < abs(mass[j]):
            i, j = j, i  # i is the larger
        apart = abs(frame[i] - frame[j])
        near = apart < max(window[i], window[j])
        there = frame[j] > frame[i] if mass[i] > 0 else frame[j] < frame[i]
        gone = mass[i] * mass[j] < 0 and abs(mass[i] + mass[j]) < 4 * np.hypot(error[i], error[j])
        same = math.dist(place[i], place[j]) < SAME_NM
        least = least_here if same else _LEAST_MASS_RATIO_BESIDE
        if (there or near) and not gone and abs(mass[i]) > least * abs(mass[j]):
            flagged[real[j]] = True
        elif (
            same
            and near
            and mass[i] * mass[j] > 0
            and abs(mass[i]) <= _MOST_MASS_RATIO * abs(mass[j])
        ):
            flagged[real[[i, j]]] = True
    return flagged


def may_rise(
    table: pd.DataFrame, evidence: Evidence, shared_place: BoolArray
) -> tuple[BoolArray, float]:
    """Flag steps that may rise slowly without showing it, and give the duration of rises.

    Steps at the place of a particle that is there tell nothing of landings.  If many of the visible
    rises go on rising after the end of their lines, all steps may.  A line over r frames and the
    nearest step differ by r/12 times the squared signal-to-noise ratio of one frame, half of which
    is the gain in log-likelihood.

    Shapes: `shared_place` (rows,), result (rows,).
    """
    nothing = np.zeros(len(table), dtype=bool), 0.0
    rise = np.where(shared_place, 0.0, np.nan_to_num(evidence.rise_frames))
    rising = rise > 0
    if rising.sum() < _FEWEST:
        return nothing
    frames = float(np.median(rise[rising]))
    mass, crb = (table[name].to_numpy(float) for name in ("mass_kda", "crb_mass_kda"))
    before, after = (table[name].to_numpy(float) for name in ("n_before", "n_after"))
    one2 = (mass / crb) ** 2 * (before + after) / (before * after)
    gain = np.nan_to_num(one2) * frames / 24
    seen = (gain > _LEAST_GAIN_SEEN) & ~shared_place
    if (rising & seen).sum() < max(_FEWEST, _SHARE * seen.sum()):
        return nothing
    goes_on = table["flags"].fillna("").astype(str).str.contains(Status.CHANGING.value).to_numpy()
    many = (goes_on & rising).sum() >= max(_FEWEST, _LEAST_SHARE_CONTINUING * rising.sum())
    alike = rising if many else nothing[0]
    return (~rising & (gain < _LEAST_GAIN_CERTAIN)) | alike, frames


def rise_message(frames: float, unseen: int, rising: int, rows: int) -> str:
    """Say that particles take several frames to land; empty where they do not."""
    if not frames:
        return ""
    also = f"; {unseen} that may rise on unseen are flagged changing" if unseen else ""
    return (
        f"the light of {rising} of {rows} steps rises over some {math.ceil(frames)} frames, which "
        f"stay out of their fits{also}"
    )
