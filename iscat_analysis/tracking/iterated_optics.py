"""Optics learned from tracks again and again, until nothing changes.

The light under the particles is learned with the tracks.  Where these were followed with wrong
optics, it has taken up a part of what these left over, and the pictures show only the rest: what is
learned from them is nearer to the truth, but not there, though it may describe the pictures.  Each
round leaves a share of the error of the round before.  The share is seen in how much less a round
changes than the one before, and with it what is still to come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.instrument.learner import OpticsCalibration, Settings, optics_limits
from iscat_analysis.instrument.learner.settings import settings_of, with_settings
from iscat_analysis.records import FloatArray

SETTLED = 1.0
"""Standard errors that are still to come, below which no other round is made."""

_PERIODS = {"reference_phase_deg": 360.0, "polarization_deg": 180.0}
_FIRST_SHARE = 0.5  # of an error that a round leaves, where one round says nothing of it
_MOST_SHARE = 0.8
_FARTHEST = 0.7  # times the last change that is added to it: some directions change back then


@dataclass(frozen=True)
class Round:
    """The optics that tracks were followed with, and those learned from these tracks."""

    before: Config
    after: Config
    found: OpticsCalibration

    @property
    def step(self) -> FloatArray:
        """Change of the measured parameters in this round, shape (n,)."""
        return _change(self.before, self.after, self.found.names)

    @property
    def same_kind(self) -> bool:
        """Whether polarisation, analyser and mask were what they are."""
        return _kind(settings_of(self.before)) == _kind(settings_of(self.after))


@dataclass(frozen=True)
class Rounds:
    """All rounds so far."""

    all: tuple[Round, ...] = ()

    def with_one(self, last: Round) -> Rounds:
        """Add a round."""
        return Rounds((*self.all, last))

    @property
    def share(self) -> float | None:
        """Share of an error that a round leaves; None where that cannot be estimated."""
        if len(self.all) < 2:
            return None
        then, now = self.all[-2:]
        if not (then.same_kind and now.same_kind):
            return None
        names = [name for name in now.found.names if name in then.found.names]
        own = [now.found.names.index(name) for name in names]
        moved = _change(then.before, now.before, names)
        changed = _change(now.before, now.after, names) - _change(then.before, then.after, names)
        weight = np.linalg.pinv(now.found.covariance[np.ix_(own, own)], hermitian=True)
        square = float(moved @ weight @ moved)
        if square == 0:
            return None
        turned = float(moved @ weight @ changed)
        return min(max(1 + turned / square, 0.0), _MOST_SHARE)

    @property
    def to_come(self) -> FloatArray:
        """Change that all further rounds together would make, extrapolated, shape (n,)."""
        share = _FIRST_SHARE if self.share is None else self.share
        return self.all[-1].step * share / (1 - share)

    @property
    def settled(self) -> bool:
        """Whether further rounds would change less than the errors."""
        last, rest = self.all[-1], self.to_come
        weight = np.linalg.pinv(last.found.covariance, hermitian=True)
        return last.same_kind and float(rest @ weight @ rest) < SETTLED**2

    @property
    def next(self) -> Config:
        """Optics for the next round: those learned last, extrapolated where the share is known."""
        last = self.all[-1]
        if self.share is None:
            return last.after
        values = settings_of(last.after)
        optics = last.after.optics
        limits = optics_limits(optics.n_immersion, optics.n_glass)
        ahead = min(self.share / (1 - self.share), _FARTHEST) * last.step
        for name, change in zip(last.found.names, ahead.tolist(), strict=True):
            low, high = limits.get(name, (-np.inf, np.inf))
            values[name] = float(min(max(values[name] + change, low), high))
        return with_settings(last.after, values)

    def error_of(self, taken: Round) -> FloatArray:
        """Change of a result by later rounds, those to come included, shape (n,)."""
        last = self.all[-1]
        names = taken.found.names
        rest = dict(zip(last.found.names, self.to_come.tolist(), strict=True))
        to_come = np.array([rest.get(name, 0.0) for name in names], dtype=float)
        return np.asarray(_change(taken.after, last.after, names) + to_come)


def _change(before: Config, after: Config, names: Sequence[str]) -> FloatArray:
    """Change of parameters; of angles, the shorter way round."""
    was, now = settings_of(before), settings_of(after)
    out = np.array([now[name] - was[name] for name in names], dtype=float)
    for i, name in enumerate(names):
        if name in _PERIODS:
            out[i] -= _PERIODS[name] * np.rint(out[i] / _PERIODS[name])
    return out


def _kind(settings: Settings) -> tuple[object, ...]:
    return settings["polarization"], settings["analyzer"], settings["mask_na"] > 0
