"""Steps whose light goes on changing, because the particle is there already or lands slowly.

The light of a particle that settles, bleaches or breathes changes repeatedly at its place, and each
change is found as a step.  A second particle at exactly the same place is rare, and cannot be told
from that.  A particle that moves by a few nanometres, or wiggles, leaves a faint step beside it,
within the distance that the microscope resolves.

If particles take several frames to land, noise hides the rise of a faint one.  The duration of the
rise is therefore estimated from all steps of a chunk of the movie, and all are fitted with it.  If
their durations differ, a faint particle may still be fitted as a step, and its mass is too small;
the rises of bright particles show whether this may happen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.records import BoolArray, FloatArray, Status

SAME_NM = 150.0
"""Distance within which two steps are at one place."""

# Mass of a particle over that of a step, from which on the step may be a change of its light.
_LEAST_MASS_RATIO = 3.0
# Change of a mean over a window, in standard deviations of the fluctuation of a frame, that hardly
# ever is exceeded: four of a difference of two.
_LARGEST_CHANGE = 4 * math.sqrt(2)
# Mass of a particle over that of a step beside it, from which on it may have moved: 20 nm change a
# image by a fifth.
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

    These are steps much smaller than that particle, at its place or, smaller still, beside it.  A
    resolution is λ/NA; contrasts fluctuate by a relative standard deviation.

    Shapes: result (rows,).
    """
    least_here = 1 / max(1 / _LEAST_MASS_RATIO, _LARGEST_CHANGE * relative)
    flagged = np.zeros(len(table), dtype=bool)
    steps = _Steps.of(table)
    for i, j in steps.pairs(max(SAME_NM, _BESIDE * resolution_nm)):
        mass, frame, window = steps.mass, steps.frame, steps.window
        near = abs(frame[i] - frame[j]) < max(window[i], window[j])
        there = frame[j] > frame[i] if mass[i] > 0 else frame[j] < frame[i]
        both = mass[i] + mass[j]
        gone = mass[i] * mass[j] < 0 and abs(both) < 4 * np.hypot(steps.error[i], steps.error[j])
        same = math.dist(steps.place[i], steps.place[j]) < SAME_NM
        least = least_here if same else _LEAST_MASS_RATIO_BESIDE
        if (there or near) and not gone and abs(mass[i]) > least * abs(mass[j]):
            flagged[steps.row[j]] = True
    return flagged


def in_parts(table: pd.DataFrame, rise_frames: FloatArray) -> BoolArray:
    """Flag steps of the same sign, mass and place within one window: parts of one landing.

    Shapes: `rise_frames` (rows,), which stay out of the windows; result (rows,).
    """
    flagged = np.zeros(len(table), dtype=bool)
    steps = _Steps.of(table)
    window = steps.window + np.nan_to_num(rise_frames)[steps.row]
    for i, j in steps.pairs(SAME_NM):
        ratio = steps.mass[i] / steps.mass[j]
        near = abs(steps.frame[i] - steps.frame[j]) < max(window[i], window[j])
        if near and 0 < ratio <= _MOST_MASS_RATIO:
            flagged[steps.row[[i, j]]] = True
    return flagged


@dataclass(frozen=True)
class _Steps:
    """The rows of a table that are steps.

    Shapes: `row, mass, error, frame, window` (n,), `place` (n, 2).
    """

    row: NDArray[np.int64]
    place: FloatArray
    mass: FloatArray
    error: FloatArray
    frame: FloatArray
    window: FloatArray

    @classmethod
    def of(cls, table: pd.DataFrame) -> _Steps:
        real = ~table["status"].isin(_NO_STEP) & table["mass_kda"].notna()
        row = np.flatnonzero(real.to_numpy())
        names = "mass_kda", "sigma_mass_kda", "frame"
        mass, error, frame = (table[name].to_numpy(float)[row] for name in names)
        window = np.maximum(table["n_before"], table["n_after"]).to_numpy(float)[row]
        return cls(row, table[["x_nm", "y_nm"]].to_numpy(float)[row], mass, error, frame, window)

    def pairs(self, farthest_nm: float) -> Iterator[tuple[int, int]]:
        """Give those that are near each other, the larger mass first."""
        if self.row.size > 1:
            for i, j in scipy.spatial.cKDTree(self.place).query_pairs(farthest_nm):
                yield (i, j) if abs(self.mass[i]) >= abs(self.mass[j]) else (j, i)


def may_rise(
    table: pd.DataFrame, evidence: Evidence, shared_place: BoolArray
) -> tuple[BoolArray, float]:
    """Flag steps that may rise slowly without showing it, and give the duration of rises.

    Steps at the place of a particle that is there are no landings, and are left out.  If many
    rises continue after the end of their lines, all steps may.  A line over r frames and the
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
    also = ""
    if unseen:
        also = f"; {unseen} steps may rise unseen: their masses may be too small, flagged changing"
    return (
        f"the light of {rising} of {rows} steps rises over some {math.ceil(frames)} frames, which "
        f"are left out of their fits{also}"
    )
