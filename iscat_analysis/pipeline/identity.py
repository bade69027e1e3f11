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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.inference.rows import Rows

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
    def of(cls, rows: Rows, mine: IntArray) -> _Part:
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
            mine = np.flatnonzero(track == k)
            when = rows.frame[mine]
            parts += [
                _Part.of(rows, mine[when < met.first]),
                _Part.of(rows, mine[(when > met.last) & (when < until)]),
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
        of_two, of_new = (np.flatnonzero(track == k) for k in (two, new))
        when, begun = rows.frame[of_two], rows.frame[of_new[0]]
        mine, fresh = (_Part.of(rows, own) for own in (of_one, of_new))
        before = _Part.of(rows, of_two[when < rows.frame[end]])
        after = _Part.of(rows, of_two[when > begun])
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
    beside = _beside(rows, end, near_nm)
    if not beside.size:
        return None
    first, stop = np.searchsorted(rows.frame, [last + 1, last + MERGED_FRAMES + 1])
    numbers, births = np.unique(track[first:stop], return_index=True)
    for born in np.sort(first + births[~np.isin(numbers, track[:first])]):
        for i in _beside(rows, born, near_nm):
            if track[i] in track[beside] and track[i] != track[end]:
                return int(track[i]), int(track[born])
    return None


def _beside(rows: Rows, row: int, near_nm: float) -> IntArray:
    """Give the rows near another one of their frame."""
    first, stop = np.searchsorted(rows.frame, rows.frame[row] + np.arange(2))
    apart = np.hypot(*(rows.theta[first:stop, :2] - rows.theta[row, :2]).T)
    near = first + np.flatnonzero(apart < near_nm)
    return np.asarray(near[near != row])


class _Meeting(NamedTuple):
    """When two tracks were within reach; the frame in which they were nearest comes last."""

    first: int
    last: int
    tracks: tuple[int, int]
    closest: int


def _meetings(rows: Rows, near_nm: float) -> Iterator[_Meeting]:
    """Give the meetings of every pair of tracks."""
    one, two = rows.pairs_within(near_nm).T
    swapped = rows.track[one] > rows.track[two]
    one, two = np.where(swapped, two, one), np.where(swapped, one, two)
    order = np.lexsort((rows.frame[one], rows.track[two], rows.track[one]))
    one, two = one[order], two[order]
    frame, tracks = rows.frame[one], np.stack([rows.track[one], rows.track[two]], axis=1)
    apart = np.hypot(*(rows.theta[one, :2] - rows.theta[two, :2]).T)
    others = (np.diff(tracks, axis=0) != 0).any(axis=1) | (np.diff(frame) > _APART_FRAMES)
    for together in np.split(np.arange(len(one)), np.flatnonzero(others) + 1):
        if together.size:
            first, last = together[[0, -1]]
            closest = together[np.argmin(apart[together])]
            of = int(tracks[first, 0]), int(tracks[first, 1])
            yield _Meeting(int(frame[first]), int(frame[last]), of, int(frame[closest]))


def _groups(rows: Rows, track: IntArray) -> IntArray:
    """Give every row the blur that most rows of its track have."""
    group = rows.group.copy()
    for k in np.unique(track[track != rows.track]):
        mine = track == k
        group[mine] = np.bincount(rows.group[mine]).argmax()
    return group
