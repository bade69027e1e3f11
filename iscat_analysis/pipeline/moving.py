"""Particles that move in every frame of a movie: background, tracks and fits, each from the others.

median → find → fit over the background under the fits → find what is left → link → drop what
is no track, fill gaps → D of each track → blurred pictures → fit until nothing changes
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
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
from iscat_analysis.pipeline.extension import extended
from iscat_analysis.pipeline.heights import decide_heights
from iscat_analysis.pipeline.linking import (
    AS_FOUND,
    alone,
    crowded,
    held,
    linked,
    mass_places,
    shares_mass,
    trimmed,
    typical,
)
from iscat_analysis.pipeline.scene import Scene, make_scene
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress
from iscat_analysis.search.moving import FrameFilter, Sightings
from iscat_analysis.species import fit_diffusion

LEAST_FRAMES = 20
"""Frames in a movie at least: fewer leave the background to the particles."""

ROUNDS = 8
"""Searches of the whole movie; each sees what the fits so far leave over."""

_FIRST_TURNS = 3  # of background and particles between two searches
_NEXT_TURNS = 8  # between two extensions of the tracks
_BLOCK = 64  # frames that are searched at a time
_LEAST_POSITIONS = 4  # of a track whose D is fitted
_FINEST_NM2 = 6.0  # difference of blurs that is one: 0.05 % of the mass
_BLUR_STEP = 0.03  # the same, relative
_FEW = 2e-3  # of all rows: a search that adds no more is the last
_HELD_ROUNDS = 2  # in which slow particles are tried where they were not seen
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
    rows = linked(config, rows, mass_places(config, field, ground, rows))
    resolution = config.optics.wavelength_nm / config.optics.na
    for number in range(ROUNDS):
        rows, ground, done, _ = field.settle(
            ground, rows, follow_power=follow_power, follow_level=follow_level,
            turns=_NEXT_TURNS, coarse=True,
        )  # fmt: skip
        rows = trimmed(rows)
        rows, added = extended(
            field, ground, rows, resolution_nm=resolution, reach_nm=config.track.max_step_nm
        )
        rows = linked(config, rows, mass_places(config, field, ground, rows), bridged=True)
        rows = alone(scene, field, ground, rows)
        if number < _HELD_ROUNDS and follow_level:
            rows, tried = held(config, field, rows)
            added += tried
        # the background that is told of all frames, before these are fitted over it
        _, found_ground, _ = field.fit(ground, typical(rows), sweeps=0)
        ground = replace(ground, level=found_ground.level) if follow_level else ground
        if added <= _FEW * len(rows.frame):
            break
    rows = trimmed(rows)
    if scene.mode == "joint":
        rows = decide_heights(
            field, ground, rows,
            fringe_nm=scene.model.fringe_nm, z_range_nm=config.fit.z_range_nm,
        )  # fmt: skip
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
    counted = (
        done
        & inside
        & ~shares_mass(rows, judged)
        & ~crowded(rows, field, config.detection.min_separation_nm)
    )
    common = common_amplitudes(field, ground, rows, judged, counted, shared)
    progress("track", total, total)
    return Moving(
        rows, ground, judged, done, variances, diffusion, change, field, shared.covariance, common
    )


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
    kept = done & (rows.theta[:, 3] > 0) & (snr > AS_FOUND * scene.templates.threshold)
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
