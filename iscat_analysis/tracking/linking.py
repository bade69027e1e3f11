"""Which rows are one particle: links from frame to frame, gaps, extensions, and who is who.

A particle is lost where another comes so near that both make one peak, and where it was so slow
that the first background took most of it.  The place where it was last seen predicts the next one:
`extended` fits it there together with its neighbours, which start from their own last places with
the masses that their tracks have.

Within a resolution two particles make one picture, and the fits of each may go on with the other.
What they did before and after tells: how fast each diffuses, how far it went meanwhile, and its
mass.  The evidence of `identified` that a part before a meeting and one after it are of one
particle is the Bayes factor against two particles that have nothing to do with each other:

- N steps from frame to frame are normal along two axes, of an unknown variance whose inverse is
  exponential, with the mean 1/b of the movie.  If their squares add up to 2 S, their marginal
  likelihood is (2π)^−N N! b/(b + S)^(N+1).  The way from one part to the other, in τ frames, is one
  more step, of τ times the variance; that to another particle leads anywhere within reach.
- Masses are median amplitudes.  That of n frames has the variance π σ²/2n, and that of what its
  neighbours do to all of them; masses of two particles differ as those of the movie.

Three may meet when one comes to two that are together.  A track may end in a meeting, and another
begin there: two particles had one track for a while, or one of them two.  So the parts before and
after are joined in that way, of all, which has most evidence.  The links weigh something in it, and
so does that no particle vanishes beside another.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy

from iscat_analysis._kernels.moving import link_surely
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.records import BoolArray, FloatArray, IntArray
from iscat_analysis.tracking.field import MovingField
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations, medians_of_tracks

LEAST_SNR = 4.0
"""Signal-to-noise ratio, with its neighbours in place, that a predicted particle needs."""

LEAST_SHARE = 0.5
"""Of its track's mass that it needs beside another: one particle is not two of half the mass."""

# Resolutions λ/NA within which particles are fitted from their predictions
_MEETING_RESOLUTIONS = 1.5


class _End(NamedTuple):
    """An open end of a track: the frame of its last row there, and the direction."""

    track: int
    frame: int
    direction: int


def _apart(one: FloatArray, other: FloatArray) -> float:
    """Distance of two particles in the plane [nm]."""
    return math.hypot(*(one - other)[:2])


def extended(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    *,
    resolution_nm: float,
    reach_nm: float,
) -> tuple[Localizations, int]:
    """Continue tracks beyond their ends as long as the movie shows their particles."""
    if not len(rows.frame):
        return rows, 0
    begun, ended = track_ends(rows, 0), track_ends(rows, -1)
    typical, blur = ended.theta[:, 3], ended.group
    ends = [_End(k, t, 1) for k, t in enumerate(ended.frame.tolist())]
    ends += [_End(k, t, -1) for k, t in enumerate(begun.frame.tolist())]
    pairs = zip(rows.track.tolist(), rows.theta, strict=True)  # of frame after frame
    frames = [dict(islice(pairs, n)) for n in np.diff(rows.starts(field.frames)).tolist()]
    refitted, added = dict[int, Localizations](), 0
    meeting_nm, same_nm = _MEETING_RESOLUTIONS * resolution_nm, resolution_nm / 4

    def with_neighbours(t: int, new: dict[int, _End]) -> dict[int, FloatArray]:
        """Give starts of fits: the last places of what is new in a frame, and of what is near."""
        starts = dict(frames[t])
        for k, end in new.items():
            last = frames[end.frame]
            near = [j for j in frames[t] if _apart(frames[t][j], last[k]) < meeting_nm]
            for j in (k, *near):
                starts[j] = (last if j in last else frames[t])[j].copy()
                starts[j][3] = typical[j]
        return starts

    def is_seen(end: _End, there: dict[int, FloatArray]) -> bool:
        """Whether a fit shows the particle of a track, and no other one."""
        theta = there[end.track]
        nearest = min(
            (_apart(theta, other) for k, other in there.items() if k != end.track), default=np.inf
        )
        alike = nearest > meeting_nm or theta[3] > LEAST_SHARE * typical[end.track]
        step = _apart(theta, frames[end.frame][end.track])
        return alike and nearest > same_nm and step < reach_nm

    while ends:
        proposed: dict[int, dict[int, _End]] = defaultdict(dict)
        for end in ends:
            t, here = end.frame + end.direction, frames[end.frame]
            if not 0 <= t < field.frames or end.track in frames[t]:
                continue
            newborn = (theta for k, theta in frames[t].items() if k not in here)
            taken = any(_apart(theta, here[end.track]) < same_nm for theta in newborn)
            if field.holds(here[end.track]) and not taken:
                proposed[t][end.track] = end
        if not proposed:
            break
        starts = {t: with_neighbours(t, new) for t, new in proposed.items()}
        keys = np.array([(t, k) for t, rows_of in starts.items() for k in rows_of], dtype=np.int64)
        theta = np.array([start for rows_of in starts.values() for start in rows_of.values()])
        frame, track = keys.T
        trial = Localizations.of(frame, track, theta, blur[track])
        fitted, done = field.refit(ground, trial, sweeps=6)
        good = done & (fitted.snr > LEAST_SNR)
        ends = []
        for t, new in proposed.items():
            of_frame = fitted.frame == t
            tracks = fitted.track[of_frame].tolist()
            there = dict(zip(tracks, fitted.theta[of_frame], strict=True))
            sure = dict(zip(tracks, good[of_frame].tolist(), strict=True))
            accepted = [k for k, end in new.items() if sure[k] and is_seen(end, there)]
            if accepted:
                there = {k: v for k, v in there.items() if k in frames[t] or k in accepted}
                frames[t].update(there)
                refitted[t] = fitted.only(of_frame & np.isin(fitted.track, [*there]))
                ends += [_End(k, t, new[k].direction) for k in accepted]
        added += len(ends)
    rows = replace(rows, group=blur[rows.track])
    if not refitted:
        return rows, 0
    others = rows.only(~np.isin(rows.frame, [*refitted]))
    return Localizations.together([others, *refitted.values()]).in_order(), added


OUTLYING = 5.0
"""Standard deviations from its track's mass beyond which a row is not of that particle alone."""

AS_FOUND = 0.9
"""Of the threshold, that a fit must keep to have found its particle."""

# Of the farthest that a particle goes: what an error of the mass counts in linking
_MASS_STEP_SHARE = 0.1
_BRIDGE_FRAMES = 100  # that a slow particle may hide
_MEETING = 5  # frames before and after two were crowded, in which one of them may be hidden


def linked(
    config: Config,
    rows: Localizations,
    *,
    bridged: bool = False,
    inner: tuple[int, int] | None = None,
) -> Localizations:
    """Link rows, drop tracks that are too short, and fill gaps; number tracks in time order."""
    error = typical_error(rows.fisher) if len(rows.frame) else 1.0
    places = with_mass(config, rows, error)
    if not np.isfinite(places).all():
        raise DataError(
            "the light under the particles cannot be told from them: it changes from frame to "
            "frame, as where the stage drifts or vibrates; record a steadier movie, or analyse "
            "fewer frames (fit.frames), in which it stands still"
        )
    track = link(
        rows.frame, places, reach_nm=config.track.max_step_nm, memory=config.track.memory_frames
    )
    rows = replace(rows, track=track)
    rows = rows.only((np.bincount(track, minlength=1) >= _least(config, rows, inner))[track])
    if bridged:
        rows = replace(rows, track=bridge(config, rows))
    missed, before, after, share = gaps(rows.frame, rows.track)
    steps = rows.theta[after] - rows.theta[before]  # a height that is fixed stays what it is
    between = rows.theta[before] + share[:, None] * steps
    return numbered(rows.joined(missed, rows.track[before], between, rows.group[before]))


def _least(config: Config, rows: Localizations, inner: tuple[int, int] | None) -> IntArray:
    """Frames that each track must have; one that may continue in another block needs fewer."""
    counts = np.bincount(rows.track, minlength=1)
    least = np.full(counts.size, config.track.min_frames)
    if inner is not None:
        outer = (rows.frame < inner[0]) | (rows.frame >= inner[1])
        open_ = np.bincount(rows.track[outer], minlength=counts.size) > 0
        least = np.where(open_, np.minimum(least, counts), least)
    return least


def with_mass(config: Config, rows: Localizations, error: float) -> FloatArray:
    """Positions for linking: x, y, and the mass expressed as a length.

    A change of the mass by its own error counts as `_MASS_STEP_SHARE` of the largest step, so that
    particles of different mass keep their identities where they cross.

    Shapes: result (n, 3).
    """
    length = _MASS_STEP_SHARE * config.track.max_step_nm / mass_error(config, rows, error)
    return np.column_stack([rows.theta[:, :2], rows.theta[:, 3] * length])


def mass_error(config: Config, rows: Localizations, error: float) -> float:
    """Give the error of the mass that linking assumes between frames."""
    if config.track.heights_free and len(rows.frame):
        return max(error, 0.25 * float(np.median(rows.theta[:, 3])))  # of the mass
    return error


def typical_error(fisher: FloatArray) -> float:
    """Give the error of an amplitude in one frame, at known places.

    Shapes: `fisher` (n, 4, 4).
    """
    return 1 / math.sqrt(max(float(np.nanmedian(fisher[:, 3, 3])), 1e-300))


def typical(rows: Localizations) -> Localizations:
    """Give every row the median amplitude of its track."""
    theta = rows.theta.copy()
    theta[:, 3] = medians_of_tracks(rows.track, theta[:, 3])
    return replace(rows, theta=theta)


def track_ends(rows: Localizations, which: int) -> Localizations:
    """First (0) or last (−1) row of every track, with the median mass of the track."""
    order = np.lexsort((rows.frame, rows.track))
    edges = np.flatnonzero(np.diff(rows.track[order], prepend=-1, append=-1))
    return typical(rows).only(order[edges[:-1] if which == 0 else edges[1:] - 1])


def alone(
    context: AnalysisContext, rows: Localizations, *, inner: tuple[int, int] | None = None
) -> Localizations:
    """Leave out tracks that are rarely isolated or rarely seen: they may be parts of neighbours."""
    config = context.config
    if not len(rows.frame):
        return rows
    # within 0.75 λ/NA two rows may be one particle
    near = crowded(rows, 0.75 * config.optics.wavelength_nm / config.optics.na)
    tracks = int(rows.track.max(initial=0)) + 1
    free = np.bincount(rows.track[~near], minlength=tracks)
    keep = (free >= _least(config, rows, inner)) & seen(context, rows)
    return numbered(rows.only(keep[rows.track]))


def seen(context: AnalysisContext, rows: Localizations) -> BoolArray:
    """Tell which tracks are detected in most of the frames in which they are fitted.

    Shapes: result (tracks,).
    """
    fitted = rows.only(np.isfinite(rows.snr))
    snr = np.where(fitted.theta[:, 3] > 0, fitted.snr, 0.0)
    plain = snr > AS_FOUND * context.templates.threshold
    tracks = int(rows.track.max(initial=-1)) + 1
    fits, detections = (np.bincount(fitted.track, w, minlength=tracks) for w in (None, plain))
    return np.asarray(2 * detections > fits)


def extrapolated(
    config: Config, field: MovingField, rows: Localizations
) -> tuple[Localizations, int]:
    """Add trial rows where slow particles were not detected, at their last and next positions."""
    reach = config.optics.resolution_nm
    slow = _steps_nm2(rows) * _BRIDGE_FRAMES <= reach**2
    longer = rows
    for which, direction in ((0, -1), (-1, 1)):
        end = track_ends(rows, which).only(slow)
        frame = end.frame[:, None] + direction * np.arange(1, _BRIDGE_FRAMES + 1)
        of, step = np.nonzero((frame >= 0) & (frame < field.frames))
        longer = longer.joined(frame[of, step], end.track[of], end.theta[of], end.group[of])
    return longer, len(longer.frame) - len(rows.frame)


def trimmed(rows: Localizations) -> Localizations:
    """Cut frames with too little mass off both ends of tracks."""
    light = pd.Series(rows.theta[:, 3] > LEAST_SHARE * typical(rows).theta[:, 3])
    light |= ~light.groupby(rows.track).transform("any")
    begun = light.groupby(rows.track).cummax()
    goes_on = light[::-1].groupby(rows.track[::-1]).cummax()[::-1]
    return rows.only((begun & goes_on).to_numpy())


def has_other_mass(track: IntArray, mass: FloatArray, error: FloatArray) -> BoolArray:
    """Tell which rows have a mass that is not that of their track.

    Shapes: `track` (n,), `mass, error` (n,), result (n,).
    """
    off = np.abs(mass - medians_of_tracks(track, mass)) / error
    scale = np.maximum(SIGMA_PER_MAD * medians_of_tracks(track, off), 1.0)
    return np.asarray(off > OUTLYING * scale)


def crowded(rows: Localizations, limit_nm: float) -> BoolArray:
    """Tell which rows have another row of their frame within a distance.

    Shapes: result (n,).
    """
    out = np.zeros(len(rows.frame), dtype=bool)
    out[rows.pairs_within(limit_nm)] = True
    return out


def meeting(rows: Localizations, limit_nm: float) -> BoolArray:
    """Tell which rows are of particles that meet: crowded, or shortly before or after that.

    While one fit takes the light of two close particles, the other particle has no row.

    Shapes: result (n,).
    """
    near = crowded(rows, limit_nm)
    apart = _MEETING + 1  # between tracks, so that frames of one are not near those of another
    when = rows.track * (int(rows.frame.max(initial=0)) + apart) + rows.frame
    around = when[near][:, None] + np.arange(-_MEETING, _MEETING + 1)
    return np.isin(when, around)


def bridge(config: Config, rows: Localizations) -> IntArray:
    """Join tracks of a particle that hardly moved while it was not detected.

    A slow particle is a part of the first background, the median of the frames, and is detected
    again near where it was.  In the gap it must not have gone farther than a resolution.

    Shapes: result (n,).
    """
    reach = config.optics.resolution_nm
    first, last, square = track_ends(rows, 0), track_ends(rows, -1), _steps_nm2(rows)
    gap = first.frame - last.frame[:, None]
    apart = scipy.spatial.distance.cdist(last.theta[:, :2], first.theta[:, :2])
    may = (gap > 0) & (gap <= _BRIDGE_FRAMES + 1) & (apart < reach)
    may &= np.maximum(square, square[:, None]) * np.maximum(gap, 1) < reach**2
    if not may.any():
        return rows.track
    before, after = scipy.optimize.linear_sum_assignment(np.where(may, apart, reach) ** 2)
    label = first.track.copy()
    for k in np.argsort(first.frame[after], kind="stable"):  # so that those before are known
        if may[before[k], after[k]]:
            label[after[k]] = label[before[k]]
    return label[np.searchsorted(first.track, rows.track)]


def _steps(rows: Localizations) -> tuple[IntArray, FloatArray]:
    """Give the steps (n, 2) from frame to frame within tracks, and their tracks (n,)."""
    order = np.lexsort((rows.frame, rows.track))
    track = rows.track[order]
    next_ = (np.diff(track) == 0) & (np.diff(rows.frame[order]) == 1)
    return track[1:][next_], np.diff(rows.theta[order, :2], axis=0)[next_]


def _steps_nm2(rows: Localizations) -> FloatArray:
    """Mean square of the steps of each track from frame to frame; infinite where it has none."""
    track, steps = _steps(rows)
    squares = pd.Series((steps**2).sum(axis=1)).groupby(track).median() / math.log(2)
    return np.asarray(squares.reindex(np.unique(rows.track), fill_value=np.inf), dtype=float)


def mean_square(steps: FloatArray) -> float:
    """Mean square of normal steps from their median, which is robust against outliers; 0 of none.

    Shapes: `steps` (n, 2).
    """
    return float(np.median((steps**2).sum(axis=1)) / math.log(2)) if len(steps) else 0.0


def numbered(rows: Localizations) -> Localizations:
    """Give tracks numbers by first frame and position."""
    _, first = np.unique(rows.track, return_index=True)
    numbers = np.full(int(rows.track.max(initial=0)) + 1, -1)
    order = np.lexsort((rows.theta[first, 0], rows.theta[first, 1], rows.frame[first]))
    numbers[rows.track[first[order]]] = np.arange(first.size)
    track = numbers[rows.track] if len(rows.track) else rows.track
    return replace(rows, track=track).in_order()


LEAST_GAIN = 8.0
"""In log-likelihood, from which on two tracks exchange what comes after a meeting: of pairs that
were followed rightly, one in e⁸ at most is exchanged by chance.  As much speaks against a particle
that ends in a meeting in which another begins."""

MERGED_FRAMES = 100
"""For which two particles may be one picture, and one track."""

_APART_FRAMES = 5  # in which two must be apart before they meet again


def identified(rows: Localizations, *, near_nm: float, error: float) -> Localizations:
    """Exchange what comes after meetings between tracks where that is far more likely."""
    track, prior = rows.track.copy(), _Prior(rows, near_nm, error)
    meetings = _meetings(rows, near_nm)
    latest = np.full(len(track), -1)  # meeting of each row
    for k, met in enumerate(meetings):
        latest[met.rows] = k
    for k, met in enumerate(meetings):
        labels, later = np.unique(track[met.rows]), latest > k
        sides = [_Side(prior, track, one, met, later) for one in labels[labels >= 0]]
        for path in _chains(sides, prior):
            _continue_chain(rows, track, path, met)
    group = rows.group.copy()
    for one in np.unique(track[track != rows.track]):  # the blur that most rows of it have
        group[track == one] = np.bincount(rows.group[track == one]).argmax()
    return replace(rows, track=track, group=group).only(track >= 0).in_order()


class _Part(NamedTuple):
    """Steps, mass and positions of a track before or after a meeting."""

    steps: float
    square: float
    mass: float
    variance: float
    frames: IntArray
    places: FloatArray


class _Prior:
    """Step, mass and its variance of a particle, from all particles of the movie."""

    def __init__(self, rows: Localizations, near_nm: float, error: float) -> None:
        self.rows, self._near_nm, self._error = rows, near_nm, error
        mass = rows.theta[:, 3] if len(rows.frame) else np.zeros(1)
        least = (1e-3 * near_nm) ** 2  # of what does not move at all
        self._step_nm2 = max(mean_square(_steps(rows)[1]) / 2, least)
        self._mass, self._variance = float(np.median(mass)), float(mass.var())

    def part(self, mine: IntArray) -> _Part | None:
        """Summarise some rows of a track; None where there are none."""
        if not mine.size:
            return None
        theta, frame = self.rows.theta[mine], self.rows.frame[mine]
        moved = np.diff(theta[:, :2], axis=0)[np.diff(frame) == 1]
        steps = len(moved) * math.log(2) ** 2  # a median is as good as the mean of so many
        mass = float(np.median(theta[:, 3]))
        # neighbours change all frames of a part by 2 % alike
        variance = math.pi / 2 * self._error**2 / len(mine) + (0.02 * mass) ** 2
        square = steps * mean_square(moved) / 2
        return _Part(steps, square, mass, variance, frame[[0, -1]], theta[[0, -1], :2])

    def evidence(self, before: _Part | None, after: _Part | None) -> float:
        """Log Bayes factor that two parts are of one particle; 0 where a part is missing."""
        if before is None or after is None:
            return 0.0
        took = int(after.frames[0] - before.frames[1])
        if took <= 0:
            return -math.inf  # one particle is not twice in a frame
        distance_squared = float(((after.places[0] - before.places[1]) ** 2).sum()) / (2 * took)
        steps, square = before.steps + after.steps + 1, before.square + after.square
        moved = (
            self._marginal(steps, square + distance_squared)
            - self._marginal(before.steps, before.square)
            - self._marginal(after.steps, after.square)
            + math.log(self._near_nm**2 / (2 * took))
        )
        known = self._variance / (self._variance + before.variance)
        mass = self._mass + known * (before.mass - self._mass)
        weighed = _normal(after.mass - mass, known * before.variance + after.variance)
        return moved + weighed - _normal(after.mass - self._mass, self._variance + after.variance)

    def _marginal(self, steps: float, square: float) -> float:
        """Log-likelihood of steps whatever their variance, but for (2π)^−N."""
        prior = math.log(self._step_nm2)
        return math.lgamma(steps + 1) + prior - (steps + 1) * math.log(self._step_nm2 + square)


def _normal(off: float, variance: float) -> float:
    """Logarithm of a normal density, but for 2π."""
    return -(off**2 / variance + math.log(variance)) / 2


class _Meeting(NamedTuple):
    """Rows of the tracks that met, and their pairs, the closest first."""

    rows: IntArray
    pairs: IntArray


class _Side:
    """A track in a meeting: its parts before and after, and whether it begins or ends there.

    `later` are the rows of the meetings that follow.
    """

    def __init__(
        self, prior: _Prior, track: IntArray, number: int, met: _Meeting, later: BoolArray
    ) -> None:
        self.track, rows, mine = number, prior.rows, np.flatnonzero(track == number)
        frame, there = rows.frame[mine], rows.frame[met.rows[track[met.rows] == number]]
        self.first, self.last = first, last = there[[0, -1]].tolist()
        until = frame[later[mine] & (frame > last)].min(initial=int(frame[-1]) + 1)
        self.before = prior.part(mine[frame < first])
        self.after = prior.part(mine[(frame > last) & (frame < until)])
        self.begins = bool(first - frame[0] <= _APART_FRAMES)
        self.ends = bool(frame[-1] - last <= _APART_FRAMES)


def _chains(sides: list[_Side], prior: _Prior) -> Iterator[list[_Side]]:
    """Find tracks whose continuations are exchanged, by the assignment with the most evidence.

    In a chain each track is continued by the rows that the next track has after the meeting.  Where
    tracks are exchanged in a cycle, as when two are swapped, the first track stands at the end
    again.
    """
    come = [side for side in sides if not side.begins]
    go = [side for side in sides if not side.ends]
    if not come or not go:
        return
    gain = LEAST_GAIN + np.array([[prior.evidence(a.before, b.after) for b in go] for a in come])
    linked = np.array([[a is b for b in go] for a in come])
    # what fits nothing may end or begin here if it does, and else goes on all the same
    least = np.array([[0.0 if a.ends or b.begins else -1e9 for b in go] for a in come])
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
    one: int
    other: int
    rows: IntArray


def _meetings(rows: Localizations, near_nm: float) -> list[_Meeting]:
    """Join close pairs into meetings, sorted by frame."""
    pairs = _pairs(rows, near_nm)
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
    frames = pd.Series(rows.frame).groupby(rows.track)
    begins, ends = frames.first(), frames.last()
    sides = [
        (k, pair, one, other)
        for k, pair in enumerate(pairs)
        for one, other in ((pair.one, pair.other), (pair.other, pair.one))
    ]
    born: dict[int, list[tuple[int, int]]] = defaultdict(list)
    spans: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for k, pair, one, other in sides:
        if pair.first - begins[other] <= _APART_FRAMES:
            born[one].append((pair.first, k))
    for k, pair, one, other in sides:
        brief = pair.last - pair.first <= 300  # others meet lasting neighbours one by one
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


def _pairs(rows: Localizations, near_nm: float) -> list[_Pair]:
    """Find the times during which two tracks are closer than `near_nm`, in the order of time."""
    both = rows.pairs_within(near_nm)
    both = np.take_along_axis(both, np.argsort(rows.track[both], axis=1), axis=1)
    frame, tracks = rows.frame[both[:, 0]], rows.track[both]
    order = np.lexsort((frame, *tracks.T))
    both, frame, tracks = both[order], frame[order], tracks[order]
    others = (np.diff(tracks, axis=0) != 0).any(axis=1) | (np.diff(frame) > _APART_FRAMES)
    runs = np.split(np.arange(len(both)), np.flatnonzero(others) + 1) if len(both) else []
    pairs = []
    for run in runs:
        (first, last), (one, other) = frame[run[[0, -1]]].tolist(), tracks[run[0]].tolist()
        pairs.append(_Pair(first, last, one, other, both[run]))
    return sorted(pairs, key=lambda pair: pair[:4])


def link(frame: IntArray, places_nm: FloatArray, *, reach_nm: float, memory: int) -> IntArray:
    """Say which positions are one particle.

    Notes
    -----
    What has no choice is linked at once, and the rest of each frame by
    trackpy (D. B. Allan et al., doi:10.5281/zenodo.4682814), after J. C. Crocker and D. G. Grier,
    J. Colloid Interface Sci. 179, 298 (1996).

    Shapes: `frame` (n,), `places_nm` (n, axes), result (n,).
    """
    n = len(frame)
    track = np.zeros(n, dtype=np.int64)
    if not n:
        return track
    places = np.ascontiguousarray(places_nm, dtype=np.float64)
    starts = np.searchsorted(frame, np.arange(frame[0], frame[-1] + 2)).astype(np.int64)
    taken, waiting, doubtful = np.zeros(n, dtype=bool), track.copy(), track.copy()
    state, t = np.zeros(4, dtype=np.int64), 0
    while True:
        t = link_surely(places, starts, t, reach_nm, memory, track, taken, waiting, state, doubtful)
        if t == starts.size - 1:
            break
        _, number, some, others = state.tolist()
        old, new = doubtful[:some], doubtful[some : some + others]
        before = _chosen(places[old], places[new], reach_nm)
        begun = before < 0
        track[new[begun]] = number + np.arange(np.count_nonzero(begun))
        last = old[before[~begun]]
        track[new[~begun]], taken[last] = track[last], True
        state[1] += np.count_nonzero(begun)
        t += 1
    _, first, numbers = np.unique(track, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[numbers]


def _chosen(old: FloatArray, new: FloatArray, reach_nm: float) -> IntArray:
    """Give the old position that trackpy links to each new one, -1 where there is none."""
    trackpy = load_linker()
    try:
        (_, one), (_, two) = trackpy.link_iter(iter([(0, old), (1, new)]), search_range=reach_nm)
    except trackpy.SubnetOversizeException as trouble:
        raise DataError(
            f"too many particles are within track.max_step_nm = {reach_nm:g} of each other to tell "
            "which is which from frame to frame: lower it to the farthest that one goes, or record "
            "fewer particles or more frames a second"
        ) from trouble
    where = {number: i for i, number in enumerate(one)}
    return np.array([where.get(number, -1) for number in two], dtype=np.int64)


@cache
def load_linker() -> Any:
    """Import trackpy without its log messages.

    The import takes about a second, so that it is worth starting it in a thread.
    """
    import trackpy

    logging.getLogger("trackpy").setLevel(logging.WARNING)
    return trackpy


def gaps(frame: IntArray, track: IntArray) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Give the frames inside tracks in which the particle was not found.

    Shapes: `frame, track` (n,), `missed` (m,), `before, after` (m,), `share` (m,).
    """
    order = np.lexsort((frame, track))
    before, after = order[:-1], order[1:]
    wide = (track[before] == track[after]) & (frame[after] > frame[before] + 1)
    before, after = before[wide], after[wide]
    length = frame[after] - frame[before] - 1
    first = np.cumsum(length) - length  # of the missed frames, that of each gap
    steps = 1 + np.arange(length.sum()) - np.repeat(first, length)
    before, after = np.repeat(before, length), np.repeat(after, length)
    return frame[before] + steps, before, after, steps / (frame[after] - frame[before])
