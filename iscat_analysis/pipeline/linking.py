"""From rows to tracks: which rows are one particle, and which tracks are particles."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.inference.moving import Ground, Judged, MovingField, Rows
from iscat_analysis.pipeline.extension import LEAST_SHARE
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.search.moving import gaps, link

OUTLYING = 5.0
"""Standard deviations from its track's mass beyond which a row is not of that particle alone."""

AS_FOUND = 0.9
"""Of the threshold, that a fit must keep to have found its particle."""

_STEP = 0.1  # of the farthest that a particle goes: what an error of the mass counts in linking
_BESIDE = 0.75  # resolutions λ/NA within which two rows may be one particle
_BRIDGE_FRAMES = 100  # that a slow particle may hide

IntArray = NDArray[np.int64]


def linked(config: Config, rows: Rows, places: FloatArray, *, bridged: bool = False) -> Rows:
    """Link, drop what is too short, and fill gaps; tracks are numbered by first frame and place.

    Parameters
    ----------
    config : Config
        Its ``[track]``.
    rows : Rows
        Particles, in any tracks or none.
    places : ndarray, shape (n, axes)
        From `mass_places`.
    bridged : bool
        Join tracks of slow particles over gaps longer than the memory too.

    Returns
    -------
    Rows
        With tracks of `track.min_frames` and more, numbered by first frame and place.
    """
    track = link(
        rows.frame, places,
        reach_nm=config.track.max_step_nm, memory=config.track.memory_frames,
    )  # fmt: skip
    counts = np.bincount(track, minlength=1)
    rows = replace(rows, track=track).only(counts[track] >= config.track.min_frames)
    if bridged:
        rows = replace(rows, track=_bridged(config, rows))
    missed, before, after, share = gaps(rows.frame, rows.track)
    between = (1 - share)[:, None] * rows.theta[before] + share[:, None] * rows.theta[after]
    rows = Rows.of(
        np.concatenate([rows.frame, missed]),
        np.concatenate([rows.track, rows.track[before]]),
        np.concatenate([rows.theta, between]),
        np.concatenate([rows.group, rows.group[before]]),
    )
    return _numbered(rows)


def mass_places(config: Config, field: MovingField, ground: Ground, rows: Rows) -> FloatArray:
    """Places by which rows are linked: x, y, and the mass as a length.

    A step of the mass by its own error counts as much as one of `_STEP` of the farthest that a
    particle goes, so that particles of unlike mass keep their numbers where they cross.

    Parameters
    ----------
    config : Config
        Its ``[track]``.
    field : MovingField
        The movie.
    ground : Ground
        The background.
    rows : Rows
        Particles.

    Returns
    -------
    ndarray, shape (n, 3)
        As lengths [nm].
    """
    if not len(rows.frame):
        return rows.theta[:, :2]
    fisher = field.judge(ground, rows, brief=True, coarse=True).fisher
    error = 1 / np.sqrt(max(float(np.median(fisher[:, 3, 3])), 1e-300))
    return np.column_stack(
        [rows.theta[:, :2], rows.theta[:, 3] * (_STEP * config.track.max_step_nm / error)]
    )


def typical(rows: Rows) -> Rows:
    """Give every row the median amplitude of its track.

    Parameters
    ----------
    rows : Rows
        Particles with their tracks.

    Returns
    -------
    Rows
        At the same places.
    """
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = rows.track == k
        theta[mine, 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)


def alone(scene: Scene, field: MovingField, ground: Ground, rows: Rows) -> Rows:
    """Leave out tracks that are hardly ever alone, or seen: they may be parts of neighbours.

    Parameters
    ----------
    scene : Scene
        Configuration and threshold.
    field : MovingField
        The movie.
    ground : Ground
        The background.
    rows : Rows
        Particles with their tracks.

    Returns
    -------
    Rows
        Of the tracks that are kept, numbered anew.
    """
    config = scene.config
    if not len(rows.frame):
        return rows
    near = crowded(rows, field, _BESIDE * config.optics.wavelength_nm / config.optics.na)
    tracks = int(rows.track.max(initial=0)) + 1
    free = np.bincount(rows.track[~near], minlength=tracks)
    snr = np.where(rows.theta[:, 3] > 0, field.snr_of(ground, rows), 0.0)
    median = np.array([np.median(snr[rows.track == k]) for k in range(tracks)])
    kept = (free >= config.track.min_frames) & (median > AS_FOUND * scene.templates.threshold)
    return _numbered(rows.only(kept[rows.track]))


def held(config: Config, field: MovingField, rows: Rows) -> tuple[Rows, int]:
    """Let slow particles stay where they were before and after they were seen, to be tried.

    Parameters
    ----------
    config : Config
        Its ``[track]``.
    field : MovingField
        The movie.
    rows : Rows
        Particles with their tracks.

    Returns
    -------
    rows : Rows
        With the frames to be tried.
    tried : int
        How many.
    """
    reach = config.optics.wavelength_nm / config.optics.na
    frame, track, theta, group = [], [], [], []
    for k in np.unique(rows.track):
        mine = rows.only(rows.track == k)
        if _step_nm2(mine) * _BRIDGE_FRAMES > reach**2:
            continue
        middle = float(np.median(mine.theta[:, 3]))
        for end, way in ((0, -1), (-1, 1)):
            first = int(mine.frame[end])
            held = np.clip(first + way * np.arange(1, _BRIDGE_FRAMES + 1), 0, field.frames - 1)
            for t in np.unique(held[held != first]):
                frame.append(int(t))
                track.append(int(k))
                theta.append(np.append(mine.theta[end, :3], [middle, 0.0]))
                group.append(int(mine.group[end]))
    if not frame:
        return rows, 0
    more = (np.array(v, dtype=np.int64) for v in (frame, track, group))
    frames, tracks, groups = more
    return Rows.of(
        np.concatenate([rows.frame, frames]),
        np.concatenate([rows.track, tracks]),
        np.concatenate([rows.theta, np.array(theta)]),
        np.concatenate([rows.group, groups]),
    ), len(frame)


def trimmed(rows: Rows) -> Rows:
    """Cut tracks where they begin and end with frames that hold too little of their mass.

    Parameters
    ----------
    rows : Rows
        Particles with their tracks.

    Returns
    -------
    Rows
        Those that are kept.
    """
    kept = np.ones(len(rows.frame), dtype=bool)
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        amplitude = rows.theta[mine, 3]
        full = np.flatnonzero(amplitude > LEAST_SHARE * np.median(amplitude))
        if len(full):
            kept[mine[: full[0]]] = kept[mine[full[-1] + 1 :]] = False
    return rows.only(kept)


def shares_mass(rows: Rows, judged: Judged) -> BoolArray:
    """Tell which rows differ so much from their track's mass that they hold part of another's.

    Parameters
    ----------
    rows : Rows
        Particles, at their estimates.
    judged : Judged
        Of these rows.

    Returns
    -------
    ndarray of bool, shape (n,)
        Where the mass is `OUTLYING` standard deviations, as its track scatters, from the median.
    """
    out = np.zeros(len(rows.frame), dtype=bool)
    error = 1 / np.sqrt(np.maximum(judged.fisher[:, 3, 3], 1e-300))
    for k in np.unique(rows.track):
        mine = rows.track == k
        off = (rows.theta[mine, 3] - np.median(rows.theta[mine, 3])) / error[mine]
        scale = max(1.0, float(np.median(np.abs(off))) / 0.6745)
        out[mine] = np.abs(off) > OUTLYING * scale
    return out


def crowded(rows: Rows, field: MovingField, limit_nm: float) -> BoolArray:
    """Tell which rows have another particle of their frame nearer than a limit.

    Parameters
    ----------
    rows : Rows
        Particles.
    field : MovingField
        The movie.
    limit_nm : float
        Distance [nm].

    Returns
    -------
    ndarray of bool, shape (n,)
        True for both of a pair.
    """
    out = np.zeros(len(rows.frame), dtype=bool)
    starts = rows.starts(field.frames)
    for t in np.flatnonzero(np.diff(starts) > 1):
        span = slice(starts[t], starts[t + 1])
        places = rows.theta[span, :2]
        apart = np.hypot(*(places[:, None] - places).T)
        np.fill_diagonal(apart, np.inf)
        out[span] = apart.min(axis=0) < limit_nm
    return out


def _bridged(config: Config, rows: Rows) -> IntArray:
    """Join tracks of a particle that hardly moved while it was not seen.

    What moves slowly hides in the first background, which is that of most of the frames; it is seen
    again near where it was.  In the gap it must not have gone farther than a resolution.
    """
    reach = config.optics.wavelength_nm / config.optics.na
    again = link(rows.frame, rows.theta[:, :2], reach_nm=reach, memory=_BRIDGE_FRAMES)
    track = rows.track.copy()
    order = np.lexsort((rows.frame, again))
    for i, j in pairwise(order.tolist()):
        if again[i] != again[j] or track[i] == track[j]:
            continue
        one, two = track == track[i], track == track[j]
        if rows.frame[one].max() != rows.frame[i] or rows.frame[two].min() != rows.frame[j]:
            continue
        square = max(_step_nm2(rows.only(one)), _step_nm2(rows.only(two)))
        if square * (rows.frame[j] - rows.frame[i]) < reach**2:
            track[two] = track[i]
    return track


def _step_nm2(rows: Rows) -> float:
    """Return the mean square of a track's steps from frame to frame, from its median."""
    next_ = np.diff(rows.frame) == 1
    steps = np.diff(rows.theta[:, :2], axis=0)[next_]
    return float(np.median((steps**2).sum(axis=1)) / np.log(2)) if len(steps) else np.inf


def _numbered(rows: Rows) -> Rows:
    """Give tracks numbers by their first frame and place."""
    _, first = np.unique(rows.track, return_index=True)
    numbers = np.full(int(rows.track.max(initial=0)) + 1, -1)
    order = np.lexsort((rows.theta[first, 0], rows.theta[first, 1], rows.frame[first]))
    numbers[rows.track[first[order]]] = np.arange(first.size)
    track = numbers[rows.track] if len(rows.track) else rows.track
    return Rows.of(rows.frame, track, rows.theta, rows.group)
