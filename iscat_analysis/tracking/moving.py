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
from scipy.ndimage import median_filter

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.optics.model import path_variance_nm2
from iscat_analysis.records import BoolArray, CountSource, FloatArray, Progress
from iscat_analysis.species.diffusion import estimate_diffusion
from iscat_analysis.threads import start_in_thread
from iscat_analysis.tracking.extension import extended
from iscat_analysis.tracking.frame_search import FrameCandidates, load_linker
from iscat_analysis.tracking.heights import decide_heights
from iscat_analysis.tracking.identity import identified
from iscat_analysis.tracking.joint.common import (
    CommonAmplitudes,
    common_amplitudes,
    shared_errors,
    variances_left,
)
from iscat_analysis.tracking.joint.joint_fit import MOST_TURNS, fit_jointly
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Judged, Localizations
from iscat_analysis.tracking.linking import (
    AS_FOUND,
    alone,
    crowded,
    extrapolated,
    linked,
    mass_error,
    mass_places,
    mean_square,
    meeting,
    numbered,
    seen,
    shares_mass,
    trimmed,
    typical,
    typical_error,
)
from iscat_analysis.tracking.moving_field import (
    exposure_of,
    initial_background,
    load_field,
    restore_particle_light,
    search_frames,
)

ROUNDS = 8
"""Searches of the whole movie; each sees what the fits so far leave over."""

_FIRST_TURNS = 2  # of background and particles after each of the first `_FULL` searches; after one
# turn what hardly moves would be lost
_NEXT_TURNS = 2  # between two extensions of the tracks
_LEAST_POSITIONS = 4  # of a track whose D is fitted
_LARGEST_ERROR_RATIO = 300.0  # times the median error of a track: such a place says nothing
_FINEST_NM2 = 6.0  # difference of blurs that is one: 0.05 % of the mass
_BLUR_STEP = 0.03  # the same, relative
_FEW = 0.01  # of all rows: a search that adds no more is the last, and an extension
_FEW_TRIED = 5e-3  # the same, of one with places that are only tried, which the next one judges
_AROUND = 5  # rows of a track, to whose median each is compared
_OUTLIER_RMS = 5.0  # rms of the distance from there; of normal errors 1 in 10¹¹ is larger
_LINKER_ROWS_PER_FRAME = 1.5  # rows in a frame, from which some will be linked by trackpy
_MOST_ROWS_PER_AREA = 0.15  # rows in an area of (λ/NA)², beyond which they are no particles
_FULL = 2  # searches of all frames, after which some of them tell whether to go on
_FIRST_HEIGHTS = 1  # searches after which every row is put into its fringe
_HELD_ROUNDS = 2  # in which slow particles are tried where they were not seen

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class TrackedRows:
    """All that was found in a movie of moving particles."""

    rows: Localizations
    ground: BackgroundEstimate
    judged: Judged
    converged: BoolArray
    close: BoolArray
    variances_nm2: FloatArray
    diffusion: FloatArray
    field: MovingField
    shared: FloatArray
    common: CommonAmplitudes

    @property
    def smear_nm(self) -> FloatArray:
        """Spread of the path of every row about its mean, along each axis, shape (n,) [nm]."""
        return np.asarray(np.sqrt(self.variances_nm2)[self.rows.group])


def find_rows_and_background(
    context: AnalysisContext,
    movie: CountSource,
    camera: Camera,
    span: tuple[int, int],
    *,
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
    progress: Progress,
    inner: tuple[int, int] | None = None,
    cautious: bool = False,
) -> TrackedRows:
    """Find and fit every particle in every frame."""
    config = context.config
    field = load_field(context, movie, camera, span, check, pool, progress)
    follow_power = config.background.power_normalization
    follow_level = config.background.method == "tracks"
    ground = initial_background(config, field)
    nothing = np.zeros(0, dtype=np.int64)
    rows = Localizations.of(nothing, nothing, np.zeros((0, 5)))
    total = ROUNDS + 3
    for number in range(ROUNDS):
        progress("track", number, total)
        before = len(rows.frame)
        enough = round(_FEW * before) if number >= _FULL else 0
        found = search_frames(context, field, ground, rows, pool, enough=enough, cautious=cautious)
        if number and len(found.frame) <= _FEW * before:
            break
        rows = _joined(context, rows, found)
        if len(rows.frame) > _LINKER_ROWS_PER_FRAME * len(
            np.unique(rows.frame)
        ):  # there will be a choice
            start_in_thread(load_linker)
        rows, ground, done = fit_jointly(
            field,
            ground,
            rows,
            follow_power=follow_power,
            follow_level=follow_level,
            turns=_FIRST_TURNS if number < _FULL else 1,
            coarse=True,
        )
        if context.mode == "joint" and number < _FIRST_HEIGHTS:
            rows = _with_fringes_decided(context, field, ground, rows)
            rows, _, done = field.fit(ground, rows, coarse=True)
        rows = _credible(context, field, rows, done)
        if (
            context.mode == "joint" and number == 0
        ):  # sharp pictures leave over of gold what is seen
            rows = linked(config, rows, mass_places(config, rows))
            rows, variances, _ = _with_blurs(config, field, rows)
            field.set_blurs(variances)
            rows, ground, done = fit_jointly(
                field, ground, rows, follow_power=follow_power, follow_level=follow_level,
                turns=_NEXT_TURNS, coarse=True,
            )  # fmt: skip
        _refuse_flood(config, field, rows)
        if number and len(rows.frame) <= (1 + _FEW) * before:
            break
    progress("track", ROUNDS, total)
    rows = linked(config, rows, mass_places(config, rows), inner=inner)
    resolution = config.optics.wavelength_nm / config.optics.na
    for number in range(ROUNDS):
        # at first nothing is only tried, and the search has settled nearly all
        rows, ground, done = fit_jointly(
            field, ground, rows, follow_power=follow_power, follow_level=follow_level,
            turns=_NEXT_TURNS if number else 1, coarse=True,
        )  # fmt: skip
        rows, added = trimmed(rows), 0
        if not cautious:
            rows, added = extended(
                field, ground, rows, resolution_nm=resolution, reach_nm=config.track.max_step_nm
            )
        rows = linked(config, rows, mass_places(config, rows), bridged=True, inner=inner)
        rows = alone(context, rows, inner=inner)
        if number < _HELD_ROUNDS and follow_level and not cautious:
            rows, tried = extrapolated(config, field, rows)
            added += tried
        # the background that is told of all frames, before these are fitted over it
        _, found_ground, _ = field.fit(ground, typical(rows), sweeps=0, coarse=True)
        ground = replace(ground, level=found_ground.level) if follow_level else ground
        if added <= (_FEW_TRIED if number < _HELD_ROUNDS else _FEW) * len(rows.frame):
            break
    rows = _with_identities(config, trimmed(rows))
    for stage in range(2):
        restore_particle_light(context, field, movie, camera, span[0], ground, rows)
        if context.mode == "joint":
            rows = _with_fringes_decided(context, field, ground, rows)
        rows, ground, done = fit_jointly(
            field, ground, without_outliers(rows), follow_power=follow_power,
            follow_level=follow_level, turns=MOST_TURNS if stage else 1, coarse=not stage,
        )  # fmt: skip
        progress("track", ROUNDS + 1 + stage, total)
        if stage == 0:
            rows, variances, diffusion = _with_blurs(config, field, rows)
            field.set_blurs(variances)
    there = seen(context, rows)  # the rings of others, drawn far out, may explain a track
    if not there.all():
        numbers = np.cumsum(there) - 1
        rows = rows.only(there[rows.track])
        rows, diffusion = replace(rows, track=numbers[rows.track]), diffusion[there]
        rows, ground, done = fit_jointly(
            field, ground, rows, follow_power=follow_power, follow_level=follow_level, turns=1
        )
    judged = field.judge(ground, rows)
    shared = shared_errors(field, ground, rows, judged)
    near = meeting(rows, config.detection.min_separation_nm)
    unlike = shares_mass(rows, judged)
    close = near | unlike
    if context.mode == "joint":  # a path along z takes as much of the mass, and must count
        unlike = unlike & crowded(rows, context.roi_px * context.pixel_nm)
    counted = done & field.holds(rows.theta) & ~near & ~unlike
    common = common_amplitudes(field, ground, rows, judged, counted)
    progress("track", total, total)
    return TrackedRows(
        rows, ground, judged, done, close, variances, diffusion, field, shared, common
    )


def _refuse_flood(config: Config, field: MovingField, rows: Localizations) -> None:
    """Refuse a frame with more rows than particles that could be resolved."""
    side_um = field.pixel_nm / 1e3
    area = side_um**2 * float(field.used.sum())
    resolution = config.optics.wavelength_nm / config.optics.na / 1e3
    each = len(rows.frame) / field.frames
    if each > _MOST_ROWS_PER_AREA * area / resolution**2:
        raise DataError(
            f"{each:.0f} places in every frame of {area:.0f} um2 look like particles, more than "
            "can be told apart: the light changes from frame to frame, as where the stage drifts "
            "or vibrates, or the optics are far off; record a steadier movie or fewer particles, "
            "or analyse fewer frames (fit.frames), in which it stands still"
        )


def _with_fringes_decided(
    context: AnalysisContext, field: MovingField, ground: BackgroundEstimate, rows: Localizations
) -> Localizations:
    """Choose the interference fringe of every row by its track."""
    return decide_heights(
        field, ground, rows,
        fringe_nm=context.model.fringe_nm, z_range_nm=context.config.fit.z_range_nm,
    )  # fmt: skip


def _with_identities(config: Config, rows: Localizations) -> Localizations:
    """Exchange the identities of particles after meetings, where that is more likely."""
    if not len(rows.frame):
        return rows
    error = mass_error(config, rows, typical_error(rows.fisher))
    resolution = config.optics.wavelength_nm / config.optics.na
    rows_identified = identified(rows, near_nm=resolution, error=error)
    return numbered(rows_identified)


def _joined(context: AnalysisContext, rows: Localizations, found: FrameCandidates) -> Localizations:
    """Add candidates to the rows as starting points of fits."""
    n = len(found.frame)
    pixel = context.pixel_nm
    theta = np.column_stack(
        [found.x_px * pixel, found.y_px * pixel, found.z_nm, found.strength, np.zeros(n)]
    )
    unknown = replace(rows, track=np.full(len(rows.frame), -1))
    blur = int(np.bincount(rows.group).argmax()) if len(rows.group) else 0
    return unknown.joined(found.frame, np.full(n, -1), theta, np.full(n, blur, dtype=np.int64))


def _credible(
    context: AnalysisContext, field: MovingField, rows: Localizations, done: BoolArray
) -> Localizations:
    """Keep rows that are bright enough to be particles, and each particle once."""
    # of light that is no picture a fit may be lost
    known = np.asarray(np.isfinite(rows.theta).all(axis=1), dtype=np.bool_)
    rows, done = rows.only(known), done[known]
    kept = done & (rows.theta[:, 3] > 0) & (rows.snr > AS_FOUND * context.templates.threshold)
    near = context.config.optics.wavelength_nm / (4 * context.config.optics.na)
    starts = rows.starts(field.frames)
    for t in np.unique(rows.frame[crowded(rows, near)]):
        order = starts[t] + np.argsort(-rows.snr[starts[t] : starts[t + 1]])
        for i, a in enumerate(order):
            for b in order[:i]:
                apart = np.hypot(*(rows.theta[a, :2] - rows.theta[b, :2]))
                if kept[a] and kept[b] and apart < near:
                    kept[a] = False
    return rows.only(kept)


def _with_blurs(
    config: Config, field: MovingField, rows: Localizations
) -> tuple[Localizations, FloatArray, FloatArray]:
    """Give tracks their blurs, with the variances and the D that these come from."""
    diffusion = diffusion_of(config, field.free, rows)
    _, exposure = exposure_of(config)
    return *blurred_rows(rows, diffusion, exposure), diffusion


def diffusion_of(config: Config, free: BoolArray, rows: Localizations) -> FloatArray:
    """Fit D to each track where its particle is isolated.

    Positions during a meeting have larger errors than stated, and would count as steps.

    Shapes: `free` (5,), result (tracks, 2).
    """
    tracks = int(rows.track.max(initial=-1)) + 1
    out = np.zeros((tracks, 2))
    sigma = np.sqrt(variances_left(rows.fisher, np.flatnonzero(free[:4])))
    axes = [0, 1]
    rate, exposure = exposure_of(config)
    apart = ~meeting(rows, config.detection.min_separation_nm)
    for k in range(tracks):
        mine = apart & (rows.track == k)
        error = sigma[:, axes].max(axis=1)
        if mine.any():
            mine &= error < _LARGEST_ERROR_RATIO * np.nanmedian(error[mine])
        if mine.sum() < _LEAST_POSITIONS:
            continue
        out[k] = estimate_diffusion(
            rows.frame[mine],
            rows.theta[mine][:, axes],
            sigma[mine][:, axes],
            frame_rate_hz=rate,
            exposure_ms=1e3 * exposure,
        )
    return out


def blurred_rows(
    rows: Localizations, diffusion: FloatArray, exposure_s: float
) -> tuple[Localizations, FloatArray]:
    """Give the blurs of tracks numbers; those that hardly differ get the same one.

    Shapes: `diffusion` (tracks, 1 or more), `variances_nm2` (groups,).
    """
    d = np.nan_to_num(diffusion[:, 0])
    q = np.array([path_variance_nm2(float(v), exposure_s) for v in d]).reshape(-1)
    scale = _FINEST_NM2 / _BLUR_STEP  # steps are even below, relative above
    steps = np.rint(np.arcsinh(q / scale) / _BLUR_STEP)
    numbers, group = np.unique(steps, return_inverse=True)
    variances = np.maximum(scale * np.sinh(numbers * _BLUR_STEP), 0.0)
    if not len(variances):
        return rows, np.zeros(1)
    return replace(rows, group=group[rows.track].astype(np.int64)), variances


def without_outliers(rows: Localizations) -> Localizations:
    """Replace outlying positions of each track by the median of those before and after."""
    # In single frames the best place of a particle may be beside it: on its ring, or where another
    # was while the background was still wrong.  Such a row says that the particle was not where the
    # background of all other frames has it, so that the mass of one that hardly moves hangs on it.
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        if len(mine) < _AROUND:
            continue
        positions = theta[mine, :2]
        usual = median_filter(positions, size=(_AROUND, 1), mode="nearest")
        distance_squared = ((positions - usual) ** 2).sum(axis=1)
        outliers = distance_squared > _OUTLIER_RMS**2 * mean_square(positions - usual)
        theta[mine[outliers], :2] = usual[outliers]
        theta[mine[outliers], 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)
