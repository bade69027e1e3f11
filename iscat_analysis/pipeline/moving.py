"""Particles that move in every frame of a movie: background, tracks and fits, each from the others.

median → find → fit over the background under the fits → find what is left → link → drop what
is no track, fill gaps → D of each track → blurred pictures → fit until nothing changes
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.common import (
    CommonAmplitudes,
    common_amplitudes,
    polish,
    shared_errors,
)
from iscat_analysis.inference.moving import Ground, Judged, MovingField, Rows
from iscat_analysis.movie.background import find_defects
from iscat_analysis.movie.camera import Camera
from iscat_analysis.optics.blur import path_variance_nm2
from iscat_analysis.pipeline.extension import LEAST_SHARE, extended
from iscat_analysis.pipeline.scene import Scene, make_scene
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress
from iscat_analysis.search.moving import FrameFilter, Sightings, gaps, link
from iscat_analysis.species import fit_diffusion

LEAST_FRAMES = 20
"""Frames in a movie at least: fewer leave the background to the particles."""

OUTLYING = 5.0
"""Standard deviations from its track's mass beyond which a row is not of that particle alone."""

ROUNDS = 8
"""Searches of the whole movie; each sees what the fits so far leave over."""

_FIRST_TURNS = 3  # of background and particles between two searches
_NEXT_TURNS = 8  # between two extensions of the tracks
_BLOCK = 64  # frames that are searched at a time
_LEAST_POSITIONS = 4  # of a track whose D is fitted
_FINEST_NM2 = 6.0  # difference of blurs that is one: 0.05 % of the mass
_BLUR_STEP = 0.03  # the same, relative
_AS_FOUND = 0.9  # of the threshold, that a fit must keep to have found its particle
_FEW = 2e-3  # of all rows: a search that adds no more is the last
_STEP = 0.1
_BESIDE = 0.75  # resolutions λ/NA within which two rows may be one particle
_HELD_ROUNDS = 2  # in which slow particles are tried where they were not seen
_BRIDGE_FRAMES = 100  # that a slow particle may hide
_BYTES = 6  # of memory for each pixel and frame

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Moving:
    """What was found in a movie.

    Attributes
    ----------
    rows : Rows
        Every particle in every frame of its life.
    ground : Ground
        The light without them.
    judged : Judged
        What the likelihood says of each row.
    converged : ndarray of bool, shape (n,)
        Which fits did.
    variances_nm2 : ndarray, shape (groups,)
        Variance of the path about its mean, of every group of rows.
    diffusion : ndarray, shape (tracks, 2)
        D and its standard error, as the blur was made of [µm²/s].
    change : float
        What the last turn changed of the background [its standard deviations].
    field : MovingField
        The movie.
    shared : ndarray, shape (n, 4, 4)
        Covariance of (x, y, z, a) of each row that its background adds.
    common : CommonAmplitudes
        One amplitude for each track.
    """

    rows: Rows
    ground: Ground
    judged: Judged
    converged: BoolArray
    variances_nm2: FloatArray
    diffusion: FloatArray
    change: float
    field: MovingField
    shared: FloatArray
    common: CommonAmplitudes


def exposure_of(config: Config) -> tuple[float, float]:
    """Give the frame rate and the exposure.

    Parameters
    ----------
    config : Config
        Its camera.

    Returns
    -------
    rate_hz, exposure_s : float
        Where the rate is not known one frame is the unit of time, which it lasts as a whole: how
        far a particle goes in it, and so its blur, is seen all the same.
    """
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if rate is None:
        return 1.0, 1.0
    return rate, 1 / rate if exposure is None else exposure / 1e3


def track_scene(config: Config, field_px: tuple[int, int], frames: int) -> Scene:
    """Make models and matched filter for single frames.

    Parameters
    ----------
    config : Config
        In mode track.
    field_px : (int, int)
        Rows and columns.
    frames : int
        They share the expected false alarms.

    Returns
    -------
    Scene
        In mode mass or joint, as `track.free` says.
    """
    fit = config.fit.model_copy(update={"mode": config.track.free})
    return make_scene(config.model_copy(update={"fit": fit}), field_px, searches=frames)


def follow(
    scene: Scene,
    movie: FrameSource,
    camera: Camera,
    span: tuple[int, int],
    *,
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> Moving:
    """Find and fit every particle in every frame.

    Parameters
    ----------
    scene : Scene
        From `track_scene`.
    movie : FrameSource
        The movie.
    camera : Camera
        Counts → photoelectrons.
    span : (int, int)
        Half-open range of frames.
    check : callable
        Refuses impossible counts.
    pool : ThreadPoolExecutor
        Runs blocks of frames; the result does not depend on its size.
    progress : Progress
        Told the stages.

    Returns
    -------
    Moving
        Tracks, numbered in the order of their first frames.

    Raises
    ------
    DataError
        The movie is too short, or larger than `compute.memory_limit_mb`.
    """
    config = scene.config
    _, exposure = exposure_of(config)
    field = _load(scene, movie, camera, span, check, pool, progress)
    follow_power = config.background.power_normalization
    follow_level = config.background.method != "median"
    ground = field.first_ground(follow_power=follow_power)
    nothing = np.zeros(0, dtype=np.int64)
    rows = Rows.of(nothing, nothing, np.zeros((0, 5)))
    total = ROUNDS + 3
    for number in range(ROUNDS):
        progress("track", number, total)
        found = _search(scene, field, ground, rows, pool)
        before = len(rows.frame)
        if number and len(found.frame) <= _FEW * before:
            break
        rows = _joined(scene, rows, found)
        rows, ground, done, _ = field.settle(
            ground,
            rows,
            follow_power=follow_power,
            follow_level=follow_level,
            turns=_FIRST_TURNS,
            coarse=True,
        )
        rows = _credible(scene, field, ground, rows, done)
        if number and len(rows.frame) <= (1 + _FEW) * before:
            break
    progress("track", ROUNDS, total)
    rows = _linked(config, rows, _places(config, field, ground, rows))
    resolution = config.optics.wavelength_nm / config.optics.na
    for number in range(ROUNDS):
        rows, ground, done, _ = field.settle(
            ground, rows, follow_power=follow_power, follow_level=follow_level,
            turns=_NEXT_TURNS, coarse=True,
        )  # fmt: skip
        rows = _trimmed(rows)
        rows, added = extended(
            field, ground, rows, resolution_nm=resolution, reach_nm=config.track.max_step_nm
        )
        rows = _linked(config, rows, _places(config, field, ground, rows), bridged=True)
        rows = _alone(scene, field, ground, rows)
        if number < _HELD_ROUNDS and follow_level:
            rows, held = _held(config, field, rows)
            added += held
        # the background that is told of all frames, before these are fitted over it
        _, found_ground, _ = field.fit(ground, _typical(rows), sweeps=0)
        ground = replace(ground, level=found_ground.level) if follow_level else ground
        if added <= _FEW * len(rows.frame):
            break
    rows = _trimmed(rows)
    for stage in range(2):
        rows, ground, done, change = field.settle(
            ground, rows, follow_power=follow_power, follow_level=follow_level,
            coarse=stage == 0,
        )  # fmt: skip
        progress("track", ROUNDS + 1 + stage, total)
        if stage == 0:
            judged = field.judge(ground, rows)
            diffusion = _diffusion(config, field, rows, judged)
            rows, variances = _blurred(rows, diffusion, exposure)
            field.set_blurs(variances)
    if follow_level:
        rows, ground, done = polish(field, ground, rows, follow_power=follow_power)
    judged = field.judge(ground, rows)
    shared = shared_errors(field, ground, rows, judged)
    inside = np.array([field.holds(theta) for theta in rows.theta], dtype=bool)
    alone = (
        done
        & inside
        & ~shares_mass(rows, judged)
        & ~crowded(rows, field, config.detection.min_separation_nm)
    )
    common = common_amplitudes(field, ground, rows, judged, alone, shared)
    progress("track", total, total)
    return Moving(
        rows, ground, judged, done, variances, diffusion, change, field, shared.covariance, common
    )


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


def _load(
    scene: Scene,
    movie: FrameSource,
    camera: Camera,
    span: tuple[int, int],
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> MovingField:
    """Read the frames as photoelectrons."""
    first, last = span
    frames, shape = last - first, (movie.shape[1], movie.shape[2])
    if frames < LEAST_FRAMES:
        raise DataError(
            f"{movie.name}: {frames} frames are too few to tell particles that move from what they "
            f"move over; {LEAST_FRAMES} are needed, or background.frames without particles"
        )
    need = _BYTES * frames * shape[0] * shape[1] / 1e6
    if need > scene.config.compute.memory_limit_mb:
        raise DataError(
            f"{movie.name}: {frames} frames take {need:.0f} MB of memory together, more than "
            f"compute.memory_limit_mb = {scene.config.compute.memory_limit_mb}: raise it, or take "
            "a part of the movie with fit.frames"
        )
    counts = np.empty((frames, *shape), dtype=np.float32)
    saturated = np.zeros(shape, dtype=bool)
    for start in range(first, last, _BLOCK):
        stop = min(start + _BLOCK, last)
        raw = movie.read(start, stop)
        check(raw, start)
        saturated |= camera.saturated(raw).any(axis=0)
        counts[start - first : stop - first] = camera.to_electrons(raw)
        progress("background", stop - first, frames)
    read = np.broadcast_to(camera.read_variance_e2(shape), shape)
    masked = saturated | find_defects(counts.sum(axis=0, dtype=np.float64), frames * read)
    nominal = abs(scene.model.scale.amplitude(scene.model.material.mass_kda))
    free_z = scene.mode == "joint"
    return MovingField(
        counts, read, ~masked, scene.model, scene.wide,
        pixel_nm=scene.pixel_nm, roi_px=scene.roi_px,
        z_range_nm=scene.config.fit.z_range_nm if free_z else None,
        largest=100 * nominal, pool=pool,
    )  # fmt: skip


def _search(
    scene: Scene, field: MovingField, ground: Ground, rows: Rows, pool: ThreadPoolExecutor
) -> Sightings:
    """Find candidates in what the rows leave over."""
    polarity = {"both": 0, "bright": 1, "dark": -1}[scene.config.detection.polarity]
    search = FrameFilter(
        scene.templates, ground.level, field.read_e2, field.used,
        polarity=polarity, roi_px=scene.roi_px,
    )  # fmt: skip
    starts = rows.starts(field.frames)
    pixel = field.pixel_nm
    snr = field.snr_of(ground, rows) if len(rows.frame) else np.zeros(0)
    places = np.column_stack([rows.theta[:, :2] / pixel, snr])

    def block(first: int) -> Sightings:
        last = min(first + _BLOCK, field.frames)
        residual = field.residual(ground, rows, first, last)
        known = [places[starts[t] : starts[t + 1]] for t in range(first, last)]
        return search.find(residual, ground.power[first:last], first, known)

    parts = list(pool.map(block, range(0, field.frames, _BLOCK)))
    return Sightings(
        *(np.concatenate([getattr(part, name) for part in parts])
          for name in ("frame", "x_px", "y_px", "z_nm", "strength", "snr"))
    )  # fmt: skip


def _joined(scene: Scene, rows: Rows, found: Sightings) -> Rows:
    """Add candidates to the rows."""
    n = len(found.frame)
    pixel = scene.pixel_nm
    theta = np.column_stack([
        found.x_px * pixel, found.y_px * pixel, found.z_nm, found.strength, np.zeros(n),
    ])  # fmt: skip
    return Rows.of(
        np.concatenate([rows.frame, found.frame]),
        np.full(n + len(rows.frame), -1),
        np.concatenate([rows.theta, theta]),
        np.concatenate([rows.group, np.zeros(n, dtype=np.int64)]),
    )


def _credible(
    scene: Scene, field: MovingField, ground: Ground, rows: Rows, done: BoolArray
) -> Rows:
    """Keep the rows that a particle explains, each particle once."""
    if not len(rows.frame):
        return rows
    snr = field.snr_of(ground, rows)
    kept = done & (rows.theta[:, 3] > 0) & (snr > _AS_FOUND * scene.templates.threshold)
    near = scene.config.optics.wavelength_nm / (4 * scene.config.optics.na)
    starts = rows.starts(field.frames)
    for t in np.flatnonzero(np.diff(starts) > 1):
        order = starts[t] + np.argsort(-snr[starts[t] : starts[t + 1]])
        for i, a in enumerate(order):
            for b in order[:i]:
                apart = np.hypot(*(rows.theta[a, :2] - rows.theta[b, :2]))
                if kept[a] and kept[b] and apart < near:
                    kept[a] = False
    return rows.only(kept)


def _places(config: Config, field: MovingField, ground: Ground, rows: Rows) -> FloatArray:
    """Places by which rows are linked: x, y, and the mass as a length.

    A step of the mass by its own error counts as much as one of `_STEP` of the farthest that a
    particle goes, so that particles of unlike mass keep their numbers where they cross.
    """
    if not len(rows.frame):
        return rows.theta[:, :2]
    fisher = field.judge(ground, rows, brief=True, coarse=True).fisher
    error = 1 / np.sqrt(max(float(np.median(fisher[:, 3, 3])), 1e-300))
    return np.column_stack(
        [rows.theta[:, :2], rows.theta[:, 3] * (_STEP * config.track.max_step_nm / error)]
    )


def _typical(rows: Rows) -> Rows:
    """Give every row the median amplitude of its track."""
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = rows.track == k
        theta[mine, 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)


def _alone(scene: Scene, field: MovingField, ground: Ground, rows: Rows) -> Rows:
    """Leave out tracks that are hardly ever alone, or seen: they may be parts of neighbours."""
    config = scene.config
    if not len(rows.frame):
        return rows
    near = crowded(rows, field, _BESIDE * config.optics.wavelength_nm / config.optics.na)
    tracks = int(rows.track.max(initial=0)) + 1
    free = np.bincount(rows.track[~near], minlength=tracks)
    snr = np.where(rows.theta[:, 3] > 0, field.snr_of(ground, rows), 0.0)
    median = np.array([np.median(snr[rows.track == k]) for k in range(tracks)])
    kept = (free >= config.track.min_frames) & (median > _AS_FOUND * scene.templates.threshold)
    return _numbered(rows.only(kept[rows.track]))


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


def _held(config: Config, field: MovingField, rows: Rows) -> tuple[Rows, int]:
    """Let slow particles stay where they were before and after they were seen, to be tried."""
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


def _trimmed(rows: Rows) -> Rows:
    """Cut tracks where they begin and end with frames that hold too little of their mass."""
    kept = np.ones(len(rows.frame), dtype=bool)
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        amplitude = rows.theta[mine, 3]
        full = np.flatnonzero(amplitude > LEAST_SHARE * np.median(amplitude))
        if len(full):
            kept[mine[: full[0]]] = kept[mine[full[-1] + 1 :]] = False
    return rows.only(kept)


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


def _linked(config: Config, rows: Rows, places: FloatArray, *, bridged: bool = False) -> Rows:
    """Link, drop what is too short, and fill gaps; tracks are numbered by first frame and place."""
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


def _diffusion(config: Config, field: MovingField, rows: Rows, judged: Judged) -> FloatArray:
    """D of every track and its standard error [µm²/s]; 0 where a track is too short to tell."""
    tracks = int(rows.track.max(initial=-1)) + 1
    out = np.zeros((tracks, 2))
    index = np.flatnonzero(field.free[:4])
    sigma = np.sqrt(_inverse_diagonal(judged.fisher, index))
    axes = [0, 1]
    rate, exposure = exposure_of(config)
    for k in range(tracks):
        mine = rows.track == k
        mine &= np.isfinite(sigma[:, axes]).all(axis=1)
        if mine.sum() < _LEAST_POSITIONS:
            continue
        found = fit_diffusion(
            rows.frame[mine], rows.theta[mine][:, axes], sigma[mine][:, axes],
            frame_rate_hz=rate,
            exposure_ms=1e3 * exposure,
        )  # fmt: skip
        out[k] = found.d_um2_s, found.sigma_d_um2_s
    return out


def _inverse_diagonal(fisher: FloatArray, index: IntArray) -> FloatArray:
    """Diagonal of the inverse information (n, 4); NaN where not free or singular."""
    out = np.full(fisher.shape[:2], np.nan)
    part = fisher[:, index][:, :, index]
    scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-300))
    scaled = part * scale[:, :, None] * scale[:, None, :]
    good = np.isfinite(scaled).all(axis=(1, 2)) & (np.abs(np.linalg.det(scaled)) > 1e-12)
    inverse = np.einsum("nii->ni", np.linalg.inv(scaled[good])) * scale[good] ** 2
    where = np.flatnonzero(good)
    out[where[:, None], index[None]] = np.where(inverse > 0, inverse, np.nan)
    return out


def _blurred(rows: Rows, diffusion: FloatArray, exposure_s: float) -> tuple[Rows, FloatArray]:
    """Give the blurs of tracks numbers, those that hardly differ the same."""
    d = np.nan_to_num(diffusion[:, 0])
    q = np.array([path_variance_nm2(float(v), exposure_s) for v in d]).reshape(-1)
    scale = _FINEST_NM2 / _BLUR_STEP  # steps are even below, relative above
    steps = np.rint(np.arcsinh(q / scale) / _BLUR_STEP)
    numbers, group = np.unique(steps, return_inverse=True)
    variances = np.maximum(scale * np.sinh(numbers * _BLUR_STEP), 0.0)
    if not len(variances):
        return rows, np.zeros(1)
    return replace(rows, group=group[rows.track].astype(np.int64)), variances
