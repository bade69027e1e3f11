"""Tracks go on where the matched filter lost them.

A particle is lost where another comes so near that both make one peak, and where it was so slow
that the first background took most of it.  The place where it was last seen predicts the next one:
it is fitted there together with its neighbours, which start from their own last places with the
masses that their tracks have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.records import FloatArray
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations

LEAST_SNR = 4.0
"""Signal-to-noise ratio, with its neighbours in place, that a predicted particle needs."""

LEAST_SHARE = 0.5
"""Of its track's mass that it needs beside another: one particle is not two of half the mass."""

_SWEEPS = 6  # fits in turn of particles that overlap
# Resolutions λ/NA within which particles are fitted from their predictions
_MEETING_RESOLUTIONS = 1.5
_SAME_RESOLUTIONS = 0.25  # resolutions within which two rows are one particle


@dataclass(frozen=True)
class _End:
    """An open end of a track: the frame of its last row there, and the direction."""

    track: int
    frame: int
    direction: int


def extended(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    *,
    resolution_nm: float,
    reach_nm: float,
) -> tuple[Localizations, int]:
    """Continue tracks beyond their ends as long as the movie shows their particles."""
    tracks = int(rows.track.max(initial=-1)) + 1
    if not tracks:
        return rows, 0
    blur = np.zeros(tracks, dtype=np.int64)
    blur[rows.track] = rows.group
    frames, typical, ends = _Frames(rows, field.frames), np.zeros(tracks), []
    for k in range(tracks):
        mine = np.flatnonzero(rows.track == k)
        typical[k] = np.median(rows.theta[mine, 3])
        ends += [_End(k, int(rows.frame[mine[-1]]), 1), _End(k, int(rows.frame[mine[0]]), -1)]
    refitted: dict[int, Localizations] = {}
    added = 0
    meeting, same = _MEETING_RESOLUTIONS * resolution_nm, _SAME_RESOLUTIONS * resolution_nm
    while ends:
        proposed: dict[int, dict[int, _End]] = {}
        for end in ends:
            t = end.frame + end.direction
            if not 0 <= t < field.frames or end.track in frames[t]:
                continue
            here = frames[end.frame][end.track]
            newborn = any(
                k not in frames[end.frame] and np.hypot(*(theta - here)[:2]) < same
                for k, theta in frames[t].items()
            )
            if field.holds(here) and not newborn:
                proposed.setdefault(t, {})[end.track] = end
        if not proposed:
            break
        trial = _starts(frames, proposed, typical, blur, meeting)
        fitted, done = field.refit(ground, trial, sweeps=_SWEEPS)
        good = done & (fitted.snr > LEAST_SNR)
        ends = []
        for t, new in proposed.items():
            of_frame = np.flatnonzero(fitted.frame == t)
            found = {int(fitted.track[i]): fitted.theta[i] for i in of_frame}
            sure = {int(fitted.track[i]): bool(good[i]) for i in of_frame}
            accepted = []
            for k, end in new.items():
                theta, last = found[k], frames[end.frame][k]
                distances = [np.hypot(*(theta - o)[:2]) for j, o in found.items() if j != k]
                alone = min(distances, default=np.inf) > meeting
                heavy = theta[3] > LEAST_SHARE * typical[k]
                step = np.hypot(*(theta - last)[:2])
                apart = min(distances, default=np.inf) > same
                if sure[k] and (alone or heavy) and apart and step < reach_nm:
                    accepted.append(end)
            if not accepted:
                continue
            for k, theta in found.items():
                if k in frames[t] or k in {end.track for end in accepted}:
                    frames[t][k] = theta
            added += len(accepted)
            refitted[t] = fitted.only(of_frame)
            ends += [_End(end.track, t, end.direction) for end in accepted]
    rows = replace(rows, group=blur[rows.track])
    if not refitted:
        return rows, 0
    changed = sorted(refitted)
    frame = np.array([t for t in changed for _ in frames[t]], dtype=np.int64)
    track = np.array([k for t in changed for k in frames[t]], dtype=np.int64)
    theta = np.array([theta for t in changed for theta in frames[t].values()])
    longer = Localizations.of(frame, track, theta, blur[track]).recalling(rows)
    longer = longer.recalling(Localizations.together([refitted[t] for t in changed]))
    others = rows.only(~np.isin(rows.frame, changed))
    return Localizations.together([others, longer]).in_order(), added


class _Frames(dict[int, dict[int, FloatArray]]):
    """Parameters of every particle by frame and track; an entry is made when it is asked for."""

    def __init__(self, rows: Localizations, frames: int) -> None:
        super().__init__()
        self._rows, self._starts = rows, rows.starts(frames)

    def __missing__(self, t: int) -> dict[int, FloatArray]:
        here = slice(self._starts[t], self._starts[t + 1])
        tracks, thetas = self._rows.track[here].tolist(), self._rows.theta[here]
        self[t] = dict(zip(tracks, thetas, strict=True))
        return self[t]


def _starts(
    frames: _Frames,
    proposed: dict[int, dict[int, _End]],
    typical: FloatArray,
    blur: np.ndarray,
    meeting_nm: float,
) -> Localizations:
    """Give the starting rows of frames into which tracks are extended, with their neighbours."""
    frame, track, theta = [], [], []
    for t, new in proposed.items():
        rows = {k: value.copy() for k, value in frames[t].items()}
        for k, end in new.items():
            start = frames[end.frame][k].copy()
            start[3] = typical[k]
            for j, other in frames[t].items():
                if np.hypot(*(other - start)[:2]) < meeting_nm:
                    rows[j] = frames[end.frame].get(j, other).copy()
                    rows[j][3] = typical[j]
            rows[k] = start
        for k, value in rows.items():
            frame.append(t)
            track.append(k)
            theta.append(value)
    tracks = np.array(track, dtype=np.int64)
    return Localizations.of(np.array(frame, dtype=np.int64), tracks, np.array(theta), blur[tracks])
