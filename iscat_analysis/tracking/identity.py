"""Who is who after a meeting.

Within a resolution two particles make one picture, and the fits of each may go on with the other.
What they did before and after tells: how fast each diffuses, how far it went meanwhile, and its
mass.  The evidence that a part before a meeting and one after it are of one particle is the Bayes
factor against two particles that have nothing to do with each other:

- N steps from frame to frame are normal along two axes, of an unknown variance whose inverse is
  exponential, with the mean 1/b of the movie.  If their squares add up to 2 S, their marginal
  likelihood is (2π)^−N N! b/(b + S)^(N+1).  The way from one part to the other, in τ frames, is one
  more step, of τ times the variance; that to another particle leads anywhere within reach.
- Masses are median amplitudes.  That of n frames has the variance π σ²/2n, and that of what its
  neighbours do to all of them; masses of two particles differ as those of the movie.

Three may meet when one comes to two that are together.  A track may end in a meeting, and another
begin there: two particles had one track for a while, or one of them two.  So the parts before and
after are joined in that way, of all, which has most evidence.  What was linked weighs something in
it, and so does that no particle vanishes beside another.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis.records import FloatArray
from iscat_analysis.tracking.joint.localizations import Localizations
from iscat_analysis.tracking.linking import mean_square

LEAST_GAIN = 8.0
"""In log-likelihood, from which on two tracks exchange what comes after a meeting: of pairs that
were followed rightly, one in e⁸ at most is exchanged by chance.  As much speaks against a particle
that ends in a meeting in which another begins."""

MERGED_FRAMES = 100
"""For which two particles may be one picture, and one track."""

_APART_FRAMES = 5  # in which two must be apart before they meet again
_NEIGHBOURS_FRAMES = 300  # who stay beside each other for longer are met by others one by one
_LOG_ZERO = -1e9  # in log-likelihood
_MASS_ERROR = 0.02  # of what neighbours do to all frames of a part, relative

IntArray = NDArray[np.int64]


def identified(rows: Localizations, *, near_nm: float, error: float) -> Localizations:
    """Exchange what comes after meetings between tracks where that is far more likely."""
    track = rows.track.copy()
    typical = _Typical.of(rows, near_nm, error)
    meetings = _meetings(rows, near_nm)
    number = np.repeat(np.arange(len(meetings)), [len(met.rows) for met in meetings])
    met_rows = np.concatenate([track[:0], *(met.rows for met in meetings)])
    for k, met in enumerate(meetings):
        later = met_rows[number > k]
        labels = np.unique(track[met.rows])
        sides = [
            _track_side(rows, track, int(one), met, later, typical) for one in labels if one >= 0
        ]
        for path in _chains(sides, typical):
            _continue_chain(rows, track, path, met)
    kept = track >= 0
    group = _groups(rows, track)
    return Localizations.of(rows.frame[kept], track[kept], rows.theta[kept], group[kept])


@dataclass(frozen=True)
class _Part:
    """Steps, mass and positions of a track before or after a meeting."""

    steps: float
    square: float
    mass: float
    variance: float
    frames: IntArray
    places: FloatArray


@dataclass(frozen=True)
class _Typical:
    """Prior of a particle: step, mass and its variance, from all particles of the movie."""

    step_nm2: float
    mass: float
    variance: float
    near_nm: float
    error: float

    @classmethod
    def of(cls, rows: Localizations, near_nm: float, error: float) -> _Typical:
        """Estimate it from all rows."""
        order = np.lexsort((rows.frame, rows.track))
        next_ = (np.diff(rows.track[order]) == 0) & (np.diff(rows.frame[order]) == 1)
        step = _step_nm2(np.diff(rows.theta[order, :2], axis=0)[next_])
        mass = rows.theta[:, 3] if len(order) else np.zeros(1)
        least = (1e-3 * near_nm) ** 2  # of what does not move at all
        return cls(max(step, least), float(np.median(mass)), float(mass.var()), near_nm, error)

    def part(self, rows: Localizations, mine: IntArray) -> _Part | None:
        """Summarise some rows of a track; None where there are none."""
        if not mine.size:
            return None
        theta, frame = rows.theta[mine], rows.frame[mine]
        moved = np.diff(theta[:, :2], axis=0)[np.diff(frame) == 1]
        steps = len(moved) * math.log(2) ** 2  # a median is as good as the mean of so many
        mass = float(np.median(theta[:, 3]))
        variance = math.pi / 2 * self.error**2 / len(mine) + (_MASS_ERROR * mass) ** 2
        square = steps * _step_nm2(moved)
        return _Part(steps, square, mass, variance, frame[[0, -1]], theta[[0, -1], :2])

    def evidence(self, before: _Part | None, after: _Part | None) -> float:
        """Log Bayes factor that two parts are of one particle; 0 where a part is missing."""
        if before is None or after is None:
            return 0.0
        took = int(after.frames[0] - before.frames[1])
        if took <= 0:
            return -math.inf  # one particle is not twice in a frame
        distance_squared = float(((after.places[0] - before.places[1]) ** 2).sum()) / (2 * took)
        moved = (
            self._marginal(
                before.steps + after.steps + 1, before.square + after.square + distance_squared
            )
            - self._marginal(before.steps, before.square)
            - self._marginal(after.steps, after.square)
            + math.log(self.near_nm**2 / (2 * took))
        )
        known = self.variance / (self.variance + before.variance)
        mass = self.mass + known * (before.mass - self.mass)
        variance = known * before.variance + after.variance
        weighed = _normal(after.mass - mass, variance)
        return moved + weighed - _normal(after.mass - self.mass, self.variance + after.variance)

    def _marginal(self, steps: float, square: float) -> float:
        """Log-likelihood of steps whatever their variance, but for (2π)^−N."""
        prior = math.log(self.step_nm2)
        return math.lgamma(steps + 1) + prior - (steps + 1) * math.log(self.step_nm2 + square)


def _step_nm2(moved: FloatArray) -> float:
    """Variance of steps along an axis; 0 of none."""
    return mean_square(moved) / 2 if len(moved) else 0.0


def _normal(off: float, variance: float) -> float:
    """Logarithm of a normal density, but for 2π."""
    return -(off**2 / variance + math.log(variance)) / 2


class _Meeting(NamedTuple):
    """Rows of the tracks that met, and their pairs, the closest first."""

    rows: IntArray
    pairs: IntArray


@dataclass(frozen=True, eq=False)
class _Side:
    """A track in a meeting: its parts before and after, and whether it begins or ends there."""

    track: int
    first: int
    last: int
    before: _Part | None
    after: _Part | None
    begins: bool
    ends: bool


def _track_side(
    rows: Localizations,
    track: IntArray,
    one: int,
    met: _Meeting,
    later: IntArray,
    typical: _Typical,
) -> _Side:
    """Summarise one track of a meeting; `later` are the rows of the meetings that follow."""
    mine = np.flatnonzero(track == one)
    frame = rows.frame[mine]
    first, last = rows.frame[met.rows[track[met.rows] == one]][[0, -1]].tolist()
    coming = rows.frame[later[track[later] == one]]
    until = coming[coming > last].min(initial=int(frame[-1]) + 1)
    before = typical.part(rows, mine[frame < first])
    after = typical.part(rows, mine[(frame > last) & (frame < until)])
    begins, ends = first - frame[0] <= _APART_FRAMES, frame[-1] - last <= _APART_FRAMES
    return _Side(one, first, last, before, after, bool(begins), bool(ends))


def _chains(sides: list[_Side], typical: _Typical) -> Iterator[list[_Side]]:
    """Find tracks whose continuations are exchanged, by the assignment with the most evidence.

    In a chain each track is continued by the rows that the next track has after the meeting.  Where
    tracks are exchanged in a cycle, as when two are swapped, the first track stands at the end
    again.
    """
    come = [side for side in sides if not side.begins]
    go = [side for side in sides if not side.ends]
    if not come or not go:
        return
    gain = LEAST_GAIN + np.array([[typical.evidence(a.before, b.after) for b in go] for a in come])
    linked = np.array([[a is b for b in go] for a in come])
    # what fits nothing may end or begin here if it does, and else goes on all the same
    least = np.array([[0.0 if a.ends or b.begins else _LOG_ZERO for b in go] for a in come])
    worth = np.maximum(gain, least) + LEAST_GAIN / 2 * linked
    moves: dict[_Side, _Side] = {}
    for i, j in zip(*scipy.optimize.linear_sum_assignment(worth, maximize=True), strict=True):
        a, b = come[i], go[j]
        if not linked[i, j] and gain[i, j] > least[i, j]:
            moves[a] = b
    while moves:
        path = [next((side for side in moves if side not in moves.values()), next(iter(moves)))]
        while path[-1] in moves:
            path.append(moves.pop(path[-1]))
        yield path


def _continue_chain(rows: Localizations, track: IntArray, path: list[_Side], met: _Meeting) -> None:
    """Give each track of a chain the rows that the next one has after the meeting.

    All are cut at one frame, that in which the tracks were closest.
    """
    numbers = [side.track for side in path]
    mine = [np.flatnonzero(track == k) for k in numbers]
    low, high = max(side.first for side in path), min(side.last for side in path)
    near = rows.frame[met.pairs[np.isin(track[met.pairs], numbers).all(axis=1), 0]]
    near = near[(near >= low) & (near <= high)]
    cut = int(near[0]) if near.size else (low + high) // 2
    cycle = path[0] is path[-1]
    end = int(rows.frame[mine[0][-1]]) if path[0].ends and not cycle else -1
    begin = rows.frame[mine[-1][0]] if path[-1].begins and not cycle else rows.frame[-1] + 1
    cuts = np.full(len(path), max(end, min(cut, begin - 1)))
    if begin <= end:  # in these frames there is a track too many
        both = [own[(rows.frame[own] >= begin) & (rows.frame[own] <= end)] for own in mine]
        faintest = int(np.argmin([rows.theta[own, 3].sum() for own in both]))
        track[both[faintest]] = -1
        cuts[faintest + 1 :] = begin - 1
    elif not cycle and not path[0].ends:
        track[mine[0][rows.frame[mine[0]] > cuts[0]]] = numbers[-1]
    for k in range(1, len(path)):
        track[mine[k][rows.frame[mine[k]] > cuts[k]]] = numbers[k - 1]


class _Pair(NamedTuple):
    """A time during which two tracks were close: its frames, the tracks and their pairs of rows."""

    first: int
    last: int
    tracks: tuple[int, int]
    rows: IntArray


def _meetings(rows: Localizations, near_nm: float) -> list[_Meeting]:
    """Join close pairs into meetings, sorted by frame."""
    pairs = sorted(_pairs(rows, near_nm))
    number = np.arange(len(pairs))
    for one, two in _of_one(rows, pairs):
        number[number == number[two]] = number[one]
    out = []
    for k in np.unique(number):
        met = np.concatenate([pairs[i].rows for i in np.flatnonzero(number == k)])
        apart = np.hypot(*(rows.theta[met[:, 0], :2] - rows.theta[met[:, 1], :2]).T)
        out.append(_Meeting(np.unique(met), met[np.argsort(apart)]))
    return sorted(out, key=lambda met: int(met.rows[0]))


def _of_one(rows: Localizations, pairs: list[_Pair]) -> Iterator[tuple[int, int]]:
    """Find pairs of tracks that belong to one meeting.

    Two pairs do if they share a track, at once or shortly after one another.  A track that ends
    close to another one is taken to be merged with it until a new track begins close to that one.
    """
    numbers, firsts = np.unique(rows.track, return_index=True)
    begins = dict(zip(numbers.tolist(), rows.frame[firsts].tolist(), strict=True))
    ends = dict(zip(rows.track.tolist(), rows.frame.tolist(), strict=True))  # the last one stays
    born: dict[int, list[tuple[int, int]]] = defaultdict(list)
    spans: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for k, pair in enumerate(pairs):
        for one, other in (pair.tracks, pair.tracks[::-1]):
            if pair.first - begins[other] <= _APART_FRAMES:
                born[one].append((pair.first, k))
    for k, pair in enumerate(pairs):
        brief = pair.last - pair.first <= _NEIGHBOURS_FRAMES
        for one, other in (pair.tracks, pair.tracks[::-1]):
            until = pair.last
            if ends[other] - pair.last <= _APART_FRAMES:
                soon = (b for b in born[one] if 0 < b[0] - pair.last <= MERGED_FRAMES)
                until, parted = next(soon, (until, k))
                yield k, parted
            if brief or until > pair.last:
                spans[one].append((pair.first if brief else pair.last, until, k))
    for of_track in spans.values():
        reach, held = -math.inf, -1
        for first, last, k in sorted(of_track):
            if first <= reach + _APART_FRAMES:
                yield held, k
            reach, held = max(reach, last), k


def _pairs(rows: Localizations, near_nm: float) -> Iterator[_Pair]:
    """Find the times during which two tracks are closer than `near_nm`."""
    one, two = rows.pairs_within(near_nm).T
    swapped = rows.track[one] > rows.track[two]
    one, two = np.where(swapped, two, one), np.where(swapped, one, two)
    order = np.lexsort((rows.frame[one], rows.track[two], rows.track[one]))
    one, two = one[order], two[order]
    frame, tracks = rows.frame[one], np.stack([rows.track[one], rows.track[two]], axis=1)
    others = (np.diff(tracks, axis=0) != 0).any(axis=1) | (np.diff(frame) > _APART_FRAMES)
    for run in np.split(np.arange(len(one)), np.flatnonzero(others) + 1):
        if run.size:
            first, last = frame[run[[0, -1]]].tolist()
            of = int(tracks[run[0], 0]), int(tracks[run[0], 1])
            yield _Pair(first, last, of, np.stack([one[run], two[run]], axis=1))


def _groups(rows: Localizations, track: IntArray) -> IntArray:
    """Give each row the blur that most rows of its new track have."""
    group = rows.group.copy()
    for k in np.unique(track[track != rows.track]):
        mine = track == k
        group[mine] = np.bincount(rows.group[mine]).argmax()
    return group
