"""Contrast of particles that fluctuates slowly while they are there, and what is left in the mean.

Particles breathe, turn or move in the light, so that their contrast is c (1 + ε_t), with ε of
variance s² and correlation exp(−t/τ).  Means of neighbouring blocks of L frames then differ by more
than the noise: the mean square of the difference over its expectation is

    1 + s² λ L (V_L − C_L),

V_L and C_L the variance of a block's mean and the covariance of neighbours over s², and λ the
squared signal-to-noise ratio of one frame.  The blocks of all events together tell s and τ; the
mean over the n frames of an event has the relative variance s² V_n, which its error must have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.inference.split_frames import LENGTHS
from iscat_analysis.records import FREE_PARAMETERS, BoolArray, FloatArray, Status

FEWEST = 6
"""Events without which nothing is said of fluctuations."""

_SIGNIFICANT = 3.0  # standard errors of the variance beyond which it is there; 1 of 300 by chance
_AMONG_OTHERS = 2.0  # standard errors that the events have without the one that says most
_LEAST_LENGTHS = 3
_CORRELATIONS = np.geomspace(1.0, 300.0, 25)  # frames
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value, Status.CHANGING.value})


@dataclass(frozen=True)
class Fluctuation:
    """Relative fluctuation of the particles' contrasts.

    Attributes
    ----------
    relative : float
        Standard deviation over the contrast.
    relative_se : float
        Its standard error.
    frames : float
        Correlation time [frames].
    variance_kda2 : ndarray
        What it adds to the variance of every mass [kDa²].
    """

    relative: float
    relative_se: float
    frames: float
    variance_kda2: FloatArray

    @classmethod
    def of(
        cls,
        mode: str,
        table: pd.DataFrame,
        repeats: Sequence[FloatArray],
        achieved: Mapping[str, EmpiricalSpread],
    ) -> Fluctuation | None:
        """Look for it in the blocks of all events; None where it is not seen."""
        pooled = achieved.get("mass_kda")
        if mode != "mass" or pooled is None or pooled.single or len(pooled.empty) < 2:
            return None
        mass, crb = (table[name].to_numpy(float) for name in ("mass_kda", "crb_mass_kda"))
        before, after = (table[name].to_numpy(float) for name in ("n_before", "n_after"))
        there = np.where(mass > 0, after, before)
        one = crb**2 * before * after / (before + after)  # variance of a single frame
        strength = there / (before + after) * mass**2 / one
        marks = zip(table["status"], table["flags"].fillna(""), strict=True)
        good = np.array([{s, *str(f).split(";")} - {""} <= _JUDGED for s, f in marks], dtype=bool)
        good &= np.isfinite(strength)
        if good.sum() < FEWEST:
            return None
        own = np.stack([repeat for repeat, kept in zip(repeats, good, strict=True) if kept])[:, 1:]
        squares, counts = own[:, :, FREE_PARAMETERS[mode].index("mass_kda")], own[:, :, -1]
        enough = counts.sum(axis=0) >= 2
        lengths = np.array(LENGTHS, dtype=float)[enough]
        if lengths.size < _LEAST_LENGTHS:
            return None
        squares, counts, strength = squares[:, enough], counts[:, enough], strength[good]
        level = _without(pooled, lengths, float(np.median(there)))
        best = _Search(squares, counts, strength, lengths, level, float(np.median(there))).best()
        if best is None:
            return None
        s2, error, tau = best
        remains = np.array([_of_mean(int(n), tau) for n in there])
        added = np.nan_to_num(mass**2 * s2 * remains)
        return cls(math.sqrt(s2), error / (2 * math.sqrt(s2)), tau, added)

    @property
    def message(self) -> str:
        """Message for the user."""
        return (
            f"contrasts fluctuate by {100 * self.relative:.2g} ± {100 * self.relative_se:.1g} % "
            f"while particles are there, over some {self.frames:.2g} frames: sigma_mass_kda has "
            "what is left of that in the mean of an event's frames, beyond the noise of the light"
        )

    @property
    def summary(self) -> Mapping[str, Any]:
        """What ``summary.json`` says."""
        return {
            "relative": self.relative, "relative_se": self.relative_se, "frames": self.frames,
        }  # fmt: skip


@dataclass(frozen=True)
class _Search:
    """Squares between blocks of all events, and the search for s² and τ in them.

    Events count as their strength, which is best for a small s².  Whether it is there is judged by
    its error if particles do not fluctuate, about which squares are χ²; how large it is, by the
    scatter between events.

    Shapes: `squares, counts` (events, lengths), `strength` (events,), `lengths, level` (lengths,).
    """

    squares: FloatArray
    counts: FloatArray
    strength: FloatArray
    lengths: FloatArray
    level: FloatArray
    window: float

    def best(self) -> tuple[float, float, float] | None:
        """s², its error and τ; None where it is not seen, or in one event only."""
        every = np.ones(self.strength.size, dtype=bool)
        s2, error, _ = self._of(every, steady=True)
        if s2 <= _SIGNIFICANT * error:
            return None
        beyond = self.strength * (self.squares - self.counts * self.level).sum(axis=1)
        every[np.argmax(beyond)] = False
        s2, error, _ = self._of(every, steady=True)
        if s2 <= _AMONG_OTHERS * error:
            return None
        found = self._of(np.ones_like(every), steady=False)
        return found if found[0] > 0 else None

    def _of(self, used: BoolArray, *, steady: bool) -> tuple[float, float, float]:
        weight, counts = self.strength[used, None], self.counts[used]
        information = np.sum(weight**2 * counts, axis=0)
        beyond = self.squares[used] - counts * self.level
        excess = np.sum(weight * beyond, axis=0) / information
        error2 = 2 * self.level**2 / information
        if not steady:
            left = weight * (beyond - counts * weight * excess)
            error2 = np.maximum(error2, np.sum(left**2, axis=0) / information**2)
        best = (0.0, 0.0, 1.0, 1.0)  # gain, s², its error, τ
        # what is slower than a window is a course, and not a fluctuation
        for tau in _CORRELATIONS[self.window >= _CORRELATIONS].tolist():
            shape = self.lengths * np.array([_difference(int(n), tau) for n in self.lengths])
            known = float(np.sum(shape**2 / error2))
            s2 = float(np.sum(shape * excess / error2)) / known
            if s2 > 0 and s2**2 * known > best[0]:
                best = s2**2 * known, s2, known**-0.5, tau
        # blocks of different lengths share frames: their errors are not independent
        return best[1], best[2] * math.sqrt(2), best[3]


def _without(pooled: EmpiricalSpread, lengths: FloatArray, window: float) -> FloatArray:
    """Mean square between blocks of so many frames where there is no particle.

    Shapes: `lengths` (n,), result (n,).
    """
    levels = np.square(pooled.empty[1:-1] or pooled.empty[:1])
    parts = window / 8 * 2.0 ** np.arange(levels.size)
    return np.asarray(np.interp(lengths, parts, levels))


def _of_mean(frames: int, tau: float) -> float:
    """Variance of a mean over frames, over that of one frame."""
    lags = np.arange(1, frames)
    return float(1 + 2 * np.sum((1 - lags / frames) * np.exp(-lags / tau))) / max(frames, 1)


def _difference(frames: int, tau: float) -> float:
    """Give V_L − C_L: half the mean square by which means of neighbouring blocks differ."""
    return 2 * (_of_mean(frames, tau) - _of_mean(2 * frames, tau))
