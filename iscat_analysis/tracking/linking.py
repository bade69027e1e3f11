"""Linking of rows to tracks, and the rejection of tracks that are no particles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.tracking.extension import LEAST_SHARE
from iscat_analysis.tracking.frame_search import gaps, link
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import Judged, Localizations

OUTLYING = 5.0
"""Standard deviations from its track's mass beyond which a row is not of that particle alone."""

AS_FOUND = 0.9
"""Of the threshold, that a fit must keep to have found its particle."""

# Of the farthest that a particle goes: what an error of the mass counts in linking
_MASS_STEP_SHARE = 0.1
_MASS_ERROR_FREE_Z = 0.25  # of the mass, where z is free
_NEAR_RESOLUTIONS = 0.75  # resolutions λ/NA within which two rows may be one particle
_BRIDGE_FRAMES = 100  # that a slow particle may hide
_MEETING = 5  # frames before and after two were crowded, in which one of them may be hidden

IntArray = NDArray[np.int64]


def linked(
    config: Config,
    rows: Localizations,
    places: FloatArray,
    *,
    bridged: bool = False,
    inner: tuple[int, int] | None = None,
) -> Localizations:
    """Link rows, drop tracks that are too short, and fill gaps; tracks are numbered in time order.

    Shapes: `places` (n, axes).
    """
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


def mass_places(config: Config, rows: Localizations) -> FloatArray:
    """Positions for linking: x, y, and the mass expressed as a length.

    A change of the mass by its own error counts as `_MASS_STEP_SHARE` of the largest step, so that
    particles of different mass keep their identities where they cross.

    Shapes: result (n, 3).
    """
    if not len(rows.frame):
        return rows.theta[:, :2]
    return with_mass(config, rows, typical_error(rows.fisher))


def with_mass(config: Config, rows: Localizations, error: float) -> FloatArray:
    """Append the mass, as a length, to positions.

    Shapes: result (n, 3).
    """
    length = _MASS_STEP_SHARE * config.track.max_step_nm / mass_error(config, rows, error)
    return np.column_stack([rows.theta[:, :2], rows.theta[:, 3] * length])


def mass_error(config: Config, rows: Localizations, error: float) -> float:
    """Give the error of the mass that linking assumes between frames."""
    if config.track.free == "joint" and len(rows.frame):
        return max(error, _MASS_ERROR_FREE_Z * float(np.median(rows.theta[:, 3])))
    return error


def typical_error(fisher: FloatArray) -> float:
    """Give the error of an amplitude in one frame, at known places.

    Shapes: `fisher` (n, 4, 4).
    """
    return 1 / math.sqrt(max(float(np.nanmedian(fisher[:, 3, 3])), 1e-300))


def typical(rows: Localizations) -> Localizations:
    """Give every row the median amplitude of its track."""
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = rows.track == k
        theta[mine, 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)


def alone(
    context: AnalysisContext, rows: Localizations, *, inner: tuple[int, int] | None = None
) -> Localizations:
    """Leave out tracks that are rarely isolated or rarely seen: they may be parts of neighbours."""
    config = context.config
    if not len(rows.frame):
        return rows
    near = crowded(rows, _NEAR_RESOLUTIONS * config.optics.wavelength_nm / config.optics.na)
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
    reach = config.optics.wavelength_nm / config.optics.na
    frame, track, theta, group = [], [], [], []
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        if _step_nm2(rows, mine) * _BRIDGE_FRAMES > reach**2:
            continue
        middle = float(np.median(rows.theta[mine, 3]))
        for end, direction in ((mine[0], -1), (mine[-1], 1)):
            first = int(rows.frame[end])
            extrapolated = np.clip(
                first + direction * np.arange(1, _BRIDGE_FRAMES + 1), 0, field.frames - 1
            )
            for t in np.unique(extrapolated[extrapolated != first]):
                frame.append(int(t))
                track.append(int(k))
                theta.append(np.append(rows.theta[end, :3], [middle, 0.0]))
                group.append(int(rows.group[end]))
    if not frame:
        return rows, 0
    frames, tracks, groups = (np.array(v, dtype=np.int64) for v in (frame, track, group))
    return rows.joined(frames, tracks, np.array(theta), groups), len(frame)


def trimmed(rows: Localizations) -> Localizations:
    """Cut frames with too little mass off both ends of tracks."""
    keep = np.ones(len(rows.frame), dtype=bool)
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        amplitude = rows.theta[mine, 3]
        full = np.flatnonzero(amplitude > LEAST_SHARE * np.median(amplitude))
        if len(full):
            keep[mine[: full[0]]] = keep[mine[full[-1] + 1 :]] = False
    return rows.only(keep)


def shares_mass(rows: Localizations, judged: Judged) -> BoolArray:
    """Tell which rows hold a part of the mass of another track.

    Shapes: result (n,).
    """
    error = 1 / np.sqrt(np.maximum(judged.fisher[:, 3, 3], 1e-300))
    return has_other_mass(rows.track, rows.theta[:, 3], error)


def has_other_mass(track: IntArray, mass: FloatArray, error: FloatArray) -> BoolArray:
    """Tell which rows have a mass that is not that of their track.

    Shapes: `track` (n,), `mass, error` (n,), result (n,).
    """
    out = np.zeros(len(track), dtype=bool)
    for k in np.unique(track):
        mine = track == k
        off = (mass[mine] - np.median(mass[mine])) / error[mine]
        scale = max(1.0, float(np.median(np.abs(off))) / 0.6745)
        out[mine] = np.abs(off) > OUTLYING * scale
    return out


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
    times = np.sort(when[near])
    if not times.size:
        return near
    after = np.searchsorted(times, when).clip(0, times.size - 1)
    before = np.maximum(after - 1, 0)
    gap = np.minimum(np.abs(times[after] - when), np.abs(times[before] - when))
    return np.asarray(gap <= _MEETING)


def bridge(config: Config, rows: Localizations) -> IntArray:
    """Join tracks of a particle that hardly moved while it was not detected.

    A slow particle is a part of the first background, the median of the frames, and is detected
    again near where it was.  In the gap it must not have gone farther than a resolution.

    Shapes: result (n,).
    """
    reach = config.optics.wavelength_nm / config.optics.na
    tracks = [np.flatnonzero(rows.track == k) for k in np.unique(rows.track)]
    last, first = (np.array([mine[end] for mine in tracks], dtype=np.int64) for end in (-1, 0))
    square = np.array([_step_nm2(rows, mine) for mine in tracks])
    gap = rows.frame[first] - rows.frame[last][:, None]
    apart = scipy.spatial.distance.cdist(rows.theta[last, :2], rows.theta[first, :2])
    may = (gap > 0) & (gap <= _BRIDGE_FRAMES + 1) & (apart < reach)
    may &= np.maximum(square, square[:, None]) * np.maximum(gap, 1) < reach**2
    if not may.any():
        return rows.track
    before, after = scipy.optimize.linear_sum_assignment(np.where(may, apart, reach) ** 2)
    track = rows.track.copy()
    for i, j in zip(before.tolist(), after.tolist(), strict=True):
        if may[i, j]:
            track[track == track[first[j]]] = track[first[i]]
    return track


def _step_nm2(rows: Localizations, mine: IntArray) -> float:
    """Return the mean square of a track's steps from frame to frame, from its median."""
    next_ = np.diff(rows.frame[mine]) == 1
    steps = np.diff(rows.theta[mine, :2], axis=0)[next_]
    return mean_square(steps) if len(steps) else np.inf


def mean_square(steps: FloatArray) -> float:
    """Mean square of normal steps from their median, which is robust against outliers.

    Shapes: `steps` (n, 2).
    """
    return float(np.median((steps**2).sum(axis=1)) / np.log(2))


def numbered(rows: Localizations) -> Localizations:
    """Give tracks numbers by first frame and position."""
    _, first = np.unique(rows.track, return_index=True)
    numbers = np.full(int(rows.track.max(initial=0)) + 1, -1)
    order = np.lexsort((rows.theta[first, 0], rows.theta[first, 1], rows.frame[first]))
    numbers[rows.track[first[order]]] = np.arange(first.size)
    track = numbers[rows.track] if len(rows.track) else rows.track
    return replace(rows, track=track).in_order()
