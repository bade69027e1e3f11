"""Who is who after a meeting.

Within a resolution two particles make one picture, and the fits of each may go on with the other.
What they did before and after tells: their steps, by how fast each diffuses, and their masses.  Of
two ways to join the parts before with those after, each part of a particle with n steps whose
squares add up to 2 S along the two axes has the log-likelihood −N ln (S/N), N and S of both of its
parts, less ½ n n'/(n + n') (m − m')²/σ² for mean masses m and m' of n and n' frames.

Of two that were one for a while, one track may have ended when they met, and a new one begun when
they parted: no particle vanishes beside another.  It goes on either in that one or in the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.inference.rows import Rows
from iscat_analysis.records import BoolArray

LEAST_GAIN = 8.0
"""In log-likelihood, from which on two tracks exchange what comes after a meeting: of pairs that
were followed rightly, one in e⁸ at most is exchanged by chance."""

MERGED_FRAMES = 30
"""For which two particles may be one picture, and one track."""

_LEAST_STEPS = 5  # of each part
_APART_FRAMES = 5  # in which two must be apart before they meet again

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class _Part:
    """What a track did for a while.

    Attributes
    ----------
    steps : int
        From frame to frame.
    square : float
        Half the sum of their squares [nm²].
    frames : int
        In which its amplitude was fitted.
    mass : float
        Mean amplitude.
    """

    steps: int
    square: float
    frames: int
    mass: float

    @classmethod
    def of(cls, rows: Rows, mine: BoolArray) -> _Part:
        """Gather it from some of the rows."""
        theta = rows.theta[mine]
        moved = np.diff(theta[:, :2], axis=0)[np.diff(rows.frame[mine]) == 1]
        mass = float(theta[:, 3].mean()) if len(theta) else 0.0
        return cls(len(moved), float((moved**2).sum()) / 2, len(theta), mass)

    def alone(self) -> float:
        """Log-likelihood of a particle of which there is no more."""
        return float(-self.steps * np.log(self.square / self.steps))

    def with_(self, other: _Part, error: float) -> float:
        """Log-likelihood that both are one particle."""
        steps, square = self.steps + other.steps, self.square + other.square
        weight = self.frames * other.frames / (self.frames + other.frames)
        apart = (self.mass - other.mass) / error
        return float(-steps * np.log(square / steps) - 0.5 * weight * apart**2)


def identified(rows: Rows, *, near_nm: float, error: float) -> Rows:
    """Exchange what comes after a meeting between two tracks where that is far more likely.

    Parameters
    ----------
    rows : Rows
        Particles with their tracks.
    near_nm : float
        Distance within which two may be taken for each other [nm].
    error : float
        Of an amplitude in one frame.

    Returns
    -------
    Rows
        The same places, some of them in other tracks.
    """
    track = _continued(rows, near_nm, error)
    rows = Rows.of(rows.frame, track, rows.theta, _groups(rows, track))
    track = rows.track.copy()
    meetings = sorted(_meetings(rows, near_nm))
    for number, met in enumerate(meetings):
        one, two = met.tracks
        parts = []
        for k in met.tracks:
            until = next((m.first for m in meetings[number + 1 :] if k in m.tracks), np.inf)
            later = (rows.frame > met.last) & (rows.frame < until)
            parts += [
                _Part.of(rows, (track == k) & (rows.frame < met.first)),
                _Part.of(rows, (track == k) & later),
            ]
        if min(part.steps for part in parts) < _LEAST_STEPS:
            continue
        (a, a_later), (b, b_later) = parts[:2], parts[2:]
        kept = a.with_(a_later, error) + b.with_(b_later, error)
        exchanged = a.with_(b_later, error) + b.with_(a_later, error)
        if exchanged - kept > LEAST_GAIN:
            later = rows.frame > met.closest
            mine, other = later & (track == one), later & (track == two)
            track[mine], track[other] = two, one
    return Rows.of(rows.frame, track, rows.theta, _groups(rows, track))


def _continued(rows: Rows, near_nm: float, error: float) -> IntArray:
    """Let tracks that ended beside another go on, with what began beside it or with the other."""
    track = rows.track.copy()
    waiting = np.unique(track).tolist()
    while waiting:
        one = waiting.pop(0)
        of_one = np.flatnonzero(track == one)
        found = _parted(rows, track, of_one[-1], near_nm) if of_one.size else None
        if found is None:
            continue
        end = of_one[-1]
        two, new = found
        begun = rows.frame[track == new][0]
        mine, fresh = (_Part.of(rows, track == k) for k in (one, new))
        before = _Part.of(rows, (track == two) & (rows.frame < rows.frame[end]))
        after = _Part.of(rows, (track == two) & (rows.frame > begun))
        if min(part.steps for part in (mine, fresh, before, after)) < _LEAST_STEPS:
            continue
        straight = mine.with_(fresh, error) + before.with_(after, error)
        crossed = mine.with_(after, error) + before.with_(fresh, error)
        apart = mine.alone() + fresh.alone() + before.with_(after, error)
        if max(straight, crossed) - apart < -LEAST_GAIN:
            continue
        if crossed > straight:
            track[(track == two) & (rows.frame > rows.frame[end])] = one
            track[track == new] = two
        else:
            track[track == new] = one
        waiting += [one, two]
    return track


def _parted(rows: Rows, track: IntArray, end: int, near_nm: float) -> tuple[int, int] | None:
    """Find a track beside which another ended, and the first that began beside that one then."""
    last = int(rows.frame[end])
    beside = _beside(rows, rows.frame == last, end, near_nm)
    for t in range(last + 1, last + MERGED_FRAMES + 1):
        here = np.flatnonzero(rows.frame == t)
        for born in here[[not (track[: here[0]] == track[i]).any() for i in here]]:
            for i in _beside(rows, rows.frame == t, born, near_nm):
                if track[i] in track[beside] and track[i] != track[end]:
                    return int(track[i]), int(track[born])
    return None


def _beside(rows: Rows, among: BoolArray, row: int, near_nm: float) -> IntArray:
    """Give the rows near another one."""
    apart = np.hypot(*(rows.theta[:, :2] - rows.theta[row, :2]).T)
    near = among & (apart < near_nm)
    near[row] = False
    return np.flatnonzero(near)


class _Meeting(NamedTuple):
    """When two tracks were within reach; the frame in which they were nearest comes last."""

    first: int
    last: int
    tracks: tuple[int, int]
    closest: int


def _meetings(rows: Rows, near_nm: float) -> Iterator[_Meeting]:
    """Give the meetings of every pair of tracks."""
    each = [(k, rows.only(rows.track == k)) for k in np.unique(rows.track).tolist()]
    for (one, mine), (two, other) in combinations(each, 2):
        if mine.frame[0] > other.frame[-1] or other.frame[0] > mine.frame[-1]:
            continue
        frames, i, j = np.intersect1d(mine.frame, other.frame, return_indices=True)
        apart = np.hypot(*(mine.theta[i, :2] - other.theta[j, :2]).T)
        near = np.flatnonzero(apart < near_nm)
        for together in np.split(near, np.flatnonzero(np.diff(frames[near]) > _APART_FRAMES) + 1):
            if together.size:
                closest = together[np.argmin(apart[together])]
                first, last = int(frames[together[0]]), int(frames[together[-1]])
                yield _Meeting(first, last, (one, two), int(frames[closest]))


def _groups(rows: Rows, track: IntArray) -> IntArray:
    """Give every row the blur that most rows of its track have."""
    group = rows.group.copy()
    for k in np.unique(track[track != rows.track]):
        mine = track == k
        group[mine] = np.bincount(rows.group[mine]).argmax()
    return group
