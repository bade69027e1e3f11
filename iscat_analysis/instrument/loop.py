"""Which microscope was it?  One loop, whoever the particles are: collect, test, fit, accept, again.

The loop collects pictures of particles, tests whether the optics with which they were found
describe them, fits optics to them, and accepts or refuses the result.  Where pictures depend on the
optics, it collects them again with what was learned, until nothing changes.

Pictures of tracks do.  The light under particles that move is learned with their tracks.  With
wrong optics it takes up a part of what they leave over, and the pictures show only the rest: what
is learned from them is nearer to the truth, but not there, though it may describe the pictures.
Each round leaves a share of the error of the round before.  The share is seen in how much less a
round changes than the one before, and with it what is still to come.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.instrument.fit_optics import Collected, fit_optics
from iscat_analysis.instrument.microscope import with_sign
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.optics.parameters import (
    Settings,
    change_of,
    optics_limits,
    settings_of,
    with_settings,
)
from iscat_analysis.records import FloatArray, Mapper

SETTLED = 1.0
"""Standard errors that are still to come, below which no other round is made."""

_FIRST_SHARE = 0.5  # of an error that a round leaves, where one round says nothing of it
_MOST_SHARE = 0.8
_FARTHEST = 0.7  # times the last change that is added to it: some directions change back then


class PictureSource(Protocol):
    """Where pictures of particles come from: landings, a field before and after, tracks, a scan."""

    def collect(self, rounds: Rounds) -> Collected | None:
        """Give pictures for the next round; None where it would tell nothing more."""

    def describes(self, seen: Collected) -> bool:
        """Tell whether the optics with which pictures were found describe them."""


def learn(
    source: PictureSource,
    config: Config,
    groups: Sequence[str],
    origin: Mapping[str, str],
    mapper: Mapper = map,
) -> Rounds:
    """Learn the optics of a movie from pictures of its particles."""
    rounds = Rounds()
    while (seen := _collected(source, rounds)) is not None:
        described = source.describes(seen)
        found = fit_optics(seen, groups, origin, mapper)
        learned, reason = accepted(found, config)
        ahead = learned or with_sign(with_settings(config, found.measured.settings))[0]
        rounds = rounds.with_one(Round(seen, described, found, learned, ahead, reason))
    return rounds


def _collected(source: PictureSource, rounds: Rounds) -> Collected | None:
    """Collect pictures; where that fails with what was learned last, the best so far stays."""
    try:
        return source.collect(rounds)
    except DataError:
        if rounds.best is None:
            raise
        return None


def accepted(found: OpticsCalibration, config: Config) -> tuple[Config | None, str]:
    """Give the configuration with the learned optics, or why there is none."""
    if not found.accepted:
        return None, "; ".join(found.measured.refusals)
    return with_sign(config.model_copy(update={"optics": found.config.optics}))


@dataclass(frozen=True)
class Round:
    """Pictures, and the optics that were learned from them."""

    seen: Collected
    described: bool
    found: OpticsCalibration
    learned: Config | None
    """What may be used."""

    ahead: Config | None
    """What pictures may be found with: what was learned, or is near it; None where particles would
    have the wrong sign."""

    reason: str
    """Why nothing was learned."""

    @property
    def step(self) -> FloatArray:
        """Change of the measured parameters, shape (n,)."""
        return change_of(self.before, self.after, self.found.names)

    @property
    def same_kind(self) -> bool:
        """Whether polarisation, analyser and mask were what they are."""
        return _kind(self.before) == _kind(self.after)

    @property
    def before(self) -> Settings:
        """The optics with which the pictures were found."""
        return settings_of(self.seen.found_with or self.seen.config)

    @property
    def after(self) -> Settings:
        """The optics that were learned, whether or not they may be used."""
        return self.before if self.ahead is None else settings_of(self.ahead)


@dataclass(frozen=True)
class Rounds:
    """One round after the other."""

    all: tuple[Round, ...] = ()

    def with_one(self, last: Round) -> Rounds:
        """Add a round."""
        return Rounds((*self.all, last))

    @property
    def best(self) -> Round | None:
        """The last one whose optics may be used, of pictures that were found with right ones."""
        if self.all and self.all[-1].seen.refusal:
            return None
        good = (one for one in reversed(self.all) if one.learned is not None and one.described)
        return next(good, None)

    @property
    def outcome(self) -> OpticsCalibration:
        """What was learned, or else what was found last, with the reasons against it."""
        return (self.best or self.all[-1]).found

    @property
    def _steps(self) -> tuple[Round, ...]:
        """Those that led on."""
        return tuple(one for one in self.all if one.ahead is not None)

    @property
    def share(self) -> float | None:
        """Of an error, what a round leaves; None where the rounds do not tell."""
        if len(self._steps) < 2:
            return None
        then, now = self._steps[-2:]
        if not (then.same_kind and now.same_kind):
            return None
        names = [name for name in now.found.names if name in then.found.names]
        own = [now.found.names.index(name) for name in names]
        moved = change_of(then.before, now.before, names)
        changed = now.step[own] - then.step[[then.found.names.index(name) for name in names]]
        weight = np.linalg.pinv(now.found.covariance[np.ix_(own, own)], hermitian=True)
        square = float(moved @ weight @ moved)
        if square == 0:
            return None
        turned = float(moved @ weight @ changed)
        return min(max(1 + turned / square, 0.0), _MOST_SHARE)

    @property
    def to_come(self) -> FloatArray:
        """Change of the latest parameters that other rounds would make, shape (n,)."""
        share = _FIRST_SHARE if self.share is None else self.share
        return self._steps[-1].step * share / (1 - share)

    @property
    def settled(self) -> bool:
        """Whether other rounds would change nothing worth the time."""
        last, rest = self._steps[-1], self.to_come
        weight = np.linalg.pinv(last.found.covariance, hermitian=True)
        return last.same_kind and float(rest @ weight @ rest) < SETTLED**2

    @property
    def next(self) -> Config | None:
        """Optics to look with: what was learned, and what is to come where known."""
        last = self.all[-1]
        if self.share is None or last.ahead is None:
            return last.ahead
        values = settings_of(last.ahead)
        optics = last.ahead.optics
        limits = optics_limits(optics.n_immersion, optics.n_glass)
        ahead = min(self.share / (1 - self.share), _FARTHEST) * last.step
        for name, change in zip(last.found.names, ahead.tolist(), strict=True):
            low, high = limits.get(name, (-np.inf, np.inf))
            values[name] = float(min(max(values[name] + change, low), high))
        return with_settings(last.ahead, values)

    def error_of(self, taken: Round) -> FloatArray:
        """Give what later rounds changed of a round, and others would, shape (n,)."""
        last, names = self._steps[-1], taken.found.names
        rest = dict(zip(last.found.names, self.to_come.tolist(), strict=True))
        to_come = np.array([rest.get(name, 0.0) for name in names], dtype=float)
        return np.asarray(change_of(taken.after, last.after, names) + to_come)


def _kind(settings: Settings) -> tuple[object, ...]:
    return settings["polarization"], settings["analyzer"], settings["mask_na"] > 0
