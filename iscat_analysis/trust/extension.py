"""Particles whose pictures are wider than a point's: they wiggle, or have parts that are apart.

Three things tell the variance q of a particle's places along each axis.  The width of its pictures,
which is weak, since a wider picture is nearly a fainter one.  Their length, for particles that lie
at random: parts that are apart make pictures long, each its own way, and a covariance of places has
a mean variance q at least as large as what one axis has beyond the other.  And time: particles that
wiggle from frame to frame have positions that scatter from frame to frame by more than the noise of
places without a particle, on the side of the step where they are.  What moves within a frame does
not scatter from frame to frame.  Length and time thus say that there is a spread, and how large it
is at least; how large it is, the width says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc, chdtri, log_ndtr

from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.records import BoolArray, FloatArray, Status

FEWEST = 6
"""Events without which nothing is said of a spread that all particles have."""

_SIGNIFICANT = 4.0  # standard errors of the mean variance beyond which all particles have it,
_SYSTEMATIC_SIGMAS = 2.5  # and beyond which systematic errors have it
_CHANCE = 1e-5  # of one event that is flagged with no spread, and of pictures of all that are long
# Shift of a mass, in σ, from which on its row is flagged where all particles are extended.
_LEAST_SHIFT_SIGMAS = 0.5
_OUTLIER_SIGMAS = 4.0  # standard errors beyond which an event is not one of many
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value})


@dataclass(frozen=True)
class Extension:
    """What all events say of the width of their pictures.

    Attributes
    ----------
    variance_nm2, variance_se_nm2 : float
        Mean variance of places along each axis beyond what the model has, and its error [nm²].
    is_common : bool
        Whether all particles are extended.
    flagged : ndarray of bool
        Rows whose masses are too small because of it.
    mass_shift_kda : ndarray
        What it changes of every mass [kDa].
    """

    variance_nm2: float
    variance_se_nm2: float
    is_common: bool
    flagged: BoolArray
    mass_shift_kda: FloatArray

    @classmethod
    def of(
        cls,
        table: pd.DataFrame,
        evidence: Evidence,
        in_time: Mapping[str, EmpiricalSpread],
        wiggle_nm: float = 0.0,
    ) -> Extension | None:
        """Estimate the extension from all rows, beyond a known wiggle; None where there is none."""
        marks = zip(table["status"], table["flags"].fillna(""), strict=True)
        good = np.array([{s, *str(f).split(";")} - {""} <= _JUDGED for s, f in marks], dtype=bool)
        q, se = evidence.spread_nm2, evidence.sigma_spread_nm2
        known = np.isfinite(q) & np.isfinite(se) & np.isfinite(evidence.sigma_across_nm2)
        if not known.any():
            return None
        own = known & (q > 0) & (np.nan_to_num(evidence.chi2_spread) > chdtri(3, _CHANCE))
        many = good & known
        mean, error, significance = math.nan, math.nan, 0.0
        shift = np.zeros(len(table))
        if many.sum() >= FEWEST:
            mean, error = _mean(q[many], se[many])
            least = [
                _length(*(part[many] for part in evidence[7:10])),
                _wiggle(table[many], in_time, wiggle_nm),
            ]
            significance = max(size / sigma for size, sigma in [(mean, error), *least])
            if significance > _SYSTEMATIC_SIGMAS:
                clear = [size for size, sigma in least if size > _SYSTEMATIC_SIGMAS * sigma]
                mean, error = _at_least(mean, error, max(clear, default=0.0))
                shift = np.abs(np.nan_to_num(evidence.mass_per_spread)) * math.hypot(mean, error)
        if significance > _SIGNIFICANT:
            own = own | (
                known & (shift > _LEAST_SHIFT_SIGMAS * table["sigma_mass_kda"].to_numpy(float))
            )
        return cls(mean, error, significance > _SIGNIFICANT, own, shift)

    @property
    def message(self) -> str:
        """Message for the user; empty where pictures are as wide as the model's."""
        if not self.is_common:
            return ""
        wide = math.sqrt(self.variance_nm2)
        error = self.variance_se_nm2 / (2 * wide)
        return (
            f"pictures are wider than a point's, as of particles that wiggle by {wide:.1f} ± "
            f"{error:.1f} nm along each axis beyond particle.wiggle_nm, or have parts that are "
            "apart: masses are too small, flagged extended where by more than half of σ; set "
            "particle.wiggle_nm to it (adding squares), if all particles may move alike"
        )

    @property
    def summary(self) -> Mapping[str, Any]:
        """What ``summary.json`` says."""
        return {
            "variance_nm2": None if math.isnan(self.variance_nm2) else self.variance_nm2,
            "variance_se_nm2": None if math.isnan(self.variance_se_nm2) else self.variance_se_nm2,
            "flagged": int(self.flagged.sum()),
        }


def _mean(q: FloatArray, se: FloatArray) -> tuple[float, float]:
    """Weighted mean and its error, without those far from the median.

    Shapes: `q, se` (n,).
    """
    away = np.abs(q - np.median(q))
    wide = np.sqrt((1.48 * np.median(away)) ** 2 + se**2)
    kept = away <= _OUTLIER_SIGMAS * wide
    weight = se[kept] ** -2.0
    mean = float(np.average(q[kept], weights=weight))
    chi2_reduced = float(np.sum(weight * (q[kept] - mean) ** 2)) / max(int(kept.sum()) - 1, 1)
    return mean, math.sqrt(max(chi2_reduced, 1.0) / float(weight.sum()))


def _at_least(mean: float, error: float, least: float) -> tuple[float, float]:
    """Mean and standard deviation of a normal law that is cut off below."""
    cut = (least - mean) / error
    rise = math.exp(-(cut**2) / 2 - float(log_ndtr(-cut))) / math.sqrt(2 * math.pi)
    return mean + error * rise, error * math.sqrt(max(1 + cut * rise - rise**2, 0.0))


def _length(across: FloatArray, along: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Least mean variance that elongated pictures show, and its error.

    Each particle has its own direction of elongation; what all have in common belongs to the
    optics.

    Shapes: `across, along, sigma` (n,).
    """
    parts = [part - np.average(part, weights=sigma**-2.0) for part in (across, along)]
    squares = (parts[0] ** 2 + parts[1] ** 2) / sigma**2
    squares = squares[squares < np.median(squares) * _OUTLIER_SIGMAS**2]
    n = squares.size
    if n < FEWEST or chdtrc(2 * n - 2, squares.sum()) > _CHANCE:
        return 0.0, 1.0
    beyond = squares.sum() / n - 2
    error = squares.std() / math.sqrt(n)
    wide2 = beyond * float(np.median(sigma)) ** 2
    # of the root of the mean square, from that of the square
    return math.sqrt(wide2), math.sqrt(wide2) * error / (2 * beyond)


def _wiggle(
    table: pd.DataFrame, in_time: Mapping[str, EmpiricalSpread], known_nm: float
) -> tuple[float, float]:
    """Variance of positions from frame to frame beyond the noise, and its error.

    Half of the frames that are compared hold no particle; its wiggle is twice the mean.
    """
    before, after = table["n_before"].to_numpy(float), table["n_after"].to_numpy(float)
    frames = before * after / np.maximum(before + after, 1.0)
    found = []
    for name in ("x_nm", "y_nm"):
        spread = in_time.get(name)
        if spread is None or spread.single or not spread.by_frames or not spread.empty:
            return 0.0, 1.0
        one = float(np.median(table[f"crb_{name}"].to_numpy(float) ** 2 * frames))
        excess = spread.by_frames[0] ** 2 - spread.empty[0] ** 2
        error = 2 * spread.by_frames[0] * spread.by_frames_se[0]
        found.append((2 * excess * one, 2 * error * one))
    (x, x_se), (y, y_se) = found
    return (x + y) / 2 - known_nm**2, math.hypot(x_se, y_se) / 2
