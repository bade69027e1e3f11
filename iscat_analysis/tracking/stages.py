"""Particles that move in every frame of a movie: background, tracks and fits, each from the others.

median → find → fit over the background under the fits → find what is left → link → drop what
is no track, fill gaps → D of each track → blurred pictures → fit until nothing changes

Along z the likelihood of a frame has a maximum in every interference fringe, λ/(2 n_s) apart, and
one frame may hardly tell them apart.  A particle does not jump a fringe between two frames.  Every
row is fitted in each fringe, and of all sequences of fringes that is taken whose likelihood, times
that of the steps that it implies, is the largest (A. J. Viterbi, IEEE Trans. Inf. Theory 13, 260,
1967).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.optics.model import path_variance_nm2
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.threads import start_in_thread
from iscat_analysis.tracking.field import BLOCK, MovingField
from iscat_analysis.tracking.frames import (
    Recording,
    diffusion_of_positions,
    exposure_of,
    load_field,
    restore_particle_light,
)
from iscat_analysis.tracking.joint import (
    MOST_TURNS,
    CommonAmplitudes,
    common_amplitudes,
    first_background,
    fit_jointly,
    shared_errors,
    variances_left,
)
from iscat_analysis.tracking.linking import (
    AS_FOUND,
    alone,
    crowded,
    extended,
    extrapolated,
    has_other_mass,
    identified,
    linked,
    load_linker,
    mass_error,
    mean_square,
    meeting,
    numbered,
    seen,
    trimmed,
    typical,
    typical_error,
)
from iscat_analysis.tracking.rows import NO_ROWS, BackgroundEstimate, Judged, Localizations
from iscat_analysis.tracking.search import search_frames


def decide_heights(
    field: MovingField, ground: BackgroundEstimate, rows: Localizations
) -> Localizations:
    """Choose the interference fringe of every row by the likelihood of its whole track."""
    if not len(rows.frame):
        return rows
    rank = np.arange(len(rows.frame)) - rows.starts(field.frames)[rows.frame]
    rungs = 2 * math.ceil(np.ptp(field.heights_nm) / field.fringe_nm) + 5
    candidates = np.repeat(rows.theta[:, None], rungs, axis=1)
    values = np.full((len(rows.frame), rungs), -np.inf)
    for turn in range(int(rank.max()) + 1):  # one particle of each frame climbs at a time
        mine = rank == turn
        for rung, (fitted, gain) in enumerate(_ladder(field, ground, rows, mine)):
            candidates[mine, rung], values[mine, rung] = fitted, gain
    # Where no fit converged, the other rows of the track decide.
    values[~np.isfinite(values).any(axis=1)] = 0.0
    out = candidates[np.arange(len(rank)), values.argmax(axis=1)]
    for k in np.unique(rows.track[rows.track >= 0]):
        mine = np.flatnonzero(rows.track == k)
        apart = np.diff(rows.frame[mine])
        step = np.diff(rows.theta[mine, :2], axis=0) / np.sqrt(2 * apart)[:, None]
        # no particle is taken to move by less than 0.05 fringes between two frames
        per_frame = max(mean_square(step), (0.05 * field.fringe_nm) ** 2)
        path = _best_path(candidates[mine, :, 2], values[mine], per_frame * apart)
        out[mine] = candidates[mine, path]
    return replace(rows, theta=out)


def _ladder(
    field: MovingField, ground: BackgroundEstimate, rows: Localizations, climbs: BoolArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Fit some rows in every fringe, each fit starting from the one in the fringe before.

    The other rows of their frames stay as they are.  Yields what was fitted, shape (n, 5), and its
    log-likelihood, (n,).
    """
    fringe_nm, (low, high) = field.fringe_nm, field.heights_nm
    with_others = np.isin(rows.frame, rows.frame[climbs])
    rows, mine = rows.only(with_others), climbs[with_others]
    usual = typical(rows).theta[:, 3]
    yield rows.theta[mine], _values(field, ground, rows)[mine]
    for direction in (1, -1):
        here = rows.theta.copy()
        # A fit that has reached zero mass in a wrong fringe would stay there.
        here[mine, 3] = usual[mine]
        while True:
            here[mine, 2] += direction * fringe_nm
            inside = (here[:, 2] > low - fringe_nm / 2) & (here[:, 2] < high + fringe_nm / 2) & mine
            if not inside.any():
                break
            start = np.where(inside[:, None], here, rows.theta)
            start[:, 2] = np.clip(start[:, 2], low, high)
            fitted, _, done = field.fit(ground, replace(rows, theta=start), sweeps=1)
            gain = np.where(inside & done, _values(field, ground, fitted), -np.inf)
            yield fitted.theta[mine], gain[mine]
            stayed = inside & (np.abs(fitted.theta[:, 2] - start[:, 2]) < fringe_nm / 2)
            here[stayed, 2] = fitted.theta[stayed, 2]


def _values(field: MovingField, ground: BackgroundEstimate, rows: Localizations) -> FloatArray:
    """Log-likelihood of the whole frame of each row, but for a constant of the frame.

    Squares around fits in two fringes do not hold the same pixels, and one more column of rings
    counts for more than a fringe does.
    """
    out = np.zeros(field.frames)
    field.draw(ground, rows)
    for first in range(0, field.frames, BLOCK):
        last = min(first + BLOCK, field.frames)
        left = field.residual(ground, rows, first, last)
        noise = ground.power[first:last, None, None] * ground.level + field.read_e2
        out[first:last] = -np.einsum("tyx,tyx->t", left, left / noise) / 2
    return out[rows.frame]


def _best_path(heights: FloatArray, gains: FloatArray, variances: FloatArray) -> np.ndarray:
    """Find the likeliest sequence of states by the Viterbi algorithm, shape (n,)."""
    score = gains[0]
    back = np.zeros(heights.shape, dtype=np.int64)
    for t in range(1, len(heights)):
        steps = heights[t][:, None] - heights[t - 1][None]
        through = score[None] - steps**2 / (2 * variances[t - 1])
        back[t] = through.argmax(axis=1)
        score = gains[t] + through.max(axis=1)
    path = np.empty(len(heights), dtype=np.int64)
    path[-1] = int(score.argmax())
    for t in range(len(heights) - 1, 0, -1):
        path[t - 1] = back[t, path[t]]
    return path


ROUNDS = 8
"""Searches of the whole movie; each sees what the fits so far leave over."""

_FIRST_TURNS = 2  # of background and particles after each of the first `_FULL` searches; after one
# turn what hardly moves would be lost
_NEXT_TURNS = 2  # between two extensions of the tracks
_FINEST_NM2 = 6.0  # difference of blurs that is one: 0.05 % of the mass
_BLUR_STEP = 0.03  # the same, relative
_FEW = 0.01  # of all rows: a search that adds no more is the last, and an extension
_FEW_TRIED = 5e-3  # the same, of one with places that are only tried, which the next one judges
_AROUND = 5  # rows of a track, to whose median each is compared
_FULL = 2  # searches of all frames, after which some of them tell whether to go on


@dataclass(frozen=True)
class Task:
    """The frames in which particles are followed, and how.

    `inner` are the first frame, and the one after the last, beyond which a track may go on in
    another block.  A cautious search takes only what stands alone.
    """

    context: AnalysisContext
    recording: Recording
    first: int
    field: MovingField
    inner: tuple[int, int] | None
    cautious: bool

    @property
    def config(self) -> Config:
        """Configuration of the analysis."""
        return self.context.config

    @property
    def heights_free(self) -> bool:
        """Whether particles move along z as well."""
        return bool(self.field.free[2])

    def fitted(self, state: State, turns: int = MOST_TURNS, *, coarse: bool = True) -> State:
        """Fit rows and background in turn."""
        movie = self.field, state.ground, state.rows, self.config.background
        rows, ground, done = fit_jointly(*movie, turns=turns, coarse=coarse)
        return replace(state, rows=rows, ground=ground, done=done)

    def in_fringes(self, state: State) -> State:
        """Choose the interference fringe of every row by its track, where heights are free."""
        if not self.heights_free:
            return state
        return replace(state, rows=decide_heights(self.field, state.ground, state.rows))

    def blurred(self, state: State) -> State:
        """Give tracks the blur that their D makes."""
        diffusion = diffusion_of(self.config, self.field.free, state.rows)
        rows, variances = blurred_rows(state.rows, diffusion, exposure_of(self.config))
        self.field.set_blurs(variances)
        return replace(state, rows=rows, variances_nm2=variances, diffusion=diffusion)


@dataclass(frozen=True)
class State:
    """Rows and background so far, which fits converged, and the blurs and D of tracks."""

    rows: Localizations
    ground: BackgroundEstimate
    done: BoolArray
    variances_nm2: FloatArray
    diffusion: FloatArray


@dataclass(frozen=True)
class TrackedRows(State):
    """All that was found in a movie of moving particles."""

    judged: Judged
    close: BoolArray
    field: MovingField
    shared: FloatArray
    common: CommonAmplitudes

    @property
    def smear_nm(self) -> FloatArray:
        """Spread of the path of every row about its mean, along each axis, shape (n,) [nm]."""
        return np.asarray(np.sqrt(self.variances_nm2)[self.rows.group])


def search(task: Task, state: State) -> State:
    """Look for particles in what the fits so far leave over, until little is added."""
    for number in range(ROUNDS):
        before = len(state.rows.frame)
        enough = round(_FEW * before) if number >= _FULL else 0
        where = task.context, task.field, state.ground, state.rows
        found = search_frames(*where, enough=enough, cautious=task.cautious)
        if number and len(found.frame) <= _FEW * before:
            break
        rows = _joined(state.rows, found)
        # from 1.5 rows in a frame on, trackpy will link some
        if len(rows.frame) > 1.5 * len(np.unique(rows.frame)):
            start_in_thread(load_linker)  # there will be a choice
        state = replace(state, rows=rows)
        state = task.fitted(state, _FIRST_TURNS if number < _FULL else 1)
        if task.heights_free and number == 0:
            state = task.in_fringes(state)
            rows, _, done = task.field.fit(state.ground, state.rows, coarse=True)
            state = replace(state, rows=rows, done=done)
        state = replace(state, rows=_credible(task, state.rows, state.done))
        if task.heights_free and number == 0:  # sharp pictures leave over of gold what is seen
            state = task.blurred(
                replace(state, rows=linked(task.config, state.rows, inner=task.inner))
            )
            state = task.fitted(state, _NEXT_TURNS)
        _refuse_flood(task, state.rows)
        if number and len(state.rows.frame) <= (1 + _FEW) * before:
            break
    return replace(state, rows=linked(task.config, state.rows, inner=task.inner))


def extend(task: Task, state: State) -> State:
    """Continue tracks and leave out what is none, until little changes."""
    for number in range(ROUNDS):
        # at first nothing is only tried, and the search has settled nearly all
        state = task.fitted(state, _NEXT_TURNS if number else 1)
        rows, added = trimmed(state.rows), 0
        if not task.cautious:
            reach_nm, near_nm = task.config.track.max_step_nm, task.config.optics.resolution_nm
            rows, added = extended(
                task.field, state.ground, rows, resolution_nm=near_nm, reach_nm=reach_nm
            )
        rows = linked(task.config, rows, bridged=True, inner=task.inner)
        rows = alone(task.context, rows, inner=task.inner)
        # in two rounds slow particles are tried where they were not detected
        ground, trial = state.ground, number < 2
        learns = task.config.background.learnt_with_tracks
        if trial and learns and not task.cautious:
            rows, tried = extrapolated(task.config, task.field, rows)
            added += tried
        if learns:  # of all frames, before these are fitted over it
            _, found, _ = task.field.fit(ground, typical(rows), sweeps=0, coarse=True)
            ground = replace(ground, level=found.level)
        state = replace(state, rows=rows, ground=ground)
        if added <= (_FEW_TRIED if trial else _FEW) * len(rows.frame):
            break
    return replace(state, rows=trimmed(state.rows))


def identify(task: Task, state: State) -> State:
    """Exchange the identities of particles after meetings, where that is more likely."""
    rows = state.rows
    if not len(rows.frame):
        return state
    error = mass_error(task.config, rows, typical_error(rows.fisher))
    rows = identified(rows, near_nm=task.config.optics.resolution_nm, error=error)
    return replace(state, rows=numbered(rows))


def settle(task: Task, state: State) -> State:
    """Fit rows with sharp pictures, and give tracks their blurs."""
    return task.blurred(task.fitted(_restored(task, state), 1))


def refine(task: Task, state: State) -> State:
    """Fit rows and background until neither changes, and once more without what is no track.

    The rings of others, drawn far out by then, may explain a track.
    """
    state = task.fitted(_restored(task, state), coarse=False)
    there = seen(task.context, state.rows)
    if there.all():
        return state
    rows = state.rows.only(there[state.rows.track])
    rows = replace(rows, track=(np.cumsum(there) - 1)[rows.track])
    left = replace(state, rows=rows, diffusion=state.diffusion[there])
    return task.fitted(left, 1, coarse=False)


def _restored(task: Task, state: State) -> State:
    """Undo what was divided out with the particles, and choose the fringes of their rows."""
    where = task.field, state.ground, state.rows
    restore_particle_light(task.context, task.recording, task.first, *where)
    state = task.in_fringes(state)
    return replace(state, rows=without_outliers(state.rows))


STAGES = (search, extend, identify, settle, refine)
"""From frames to tracks: each takes the task and what the one before it found."""


def find_rows_and_background(
    context: AnalysisContext,
    recording: Recording,
    span: tuple[int, int],
    *,
    inner: tuple[int, int] | None = None,
    cautious: bool = False,
) -> TrackedRows:
    """Find and fit every particle in every frame."""
    field, progress = load_field(context, recording, span), recording.progress
    task = Task(context, recording, span[0], field, inner, cautious)
    ground = first_background(field, context.config.background)
    state = State(NO_ROWS, ground, np.zeros(0, dtype=np.bool_), np.zeros(1), np.zeros((0, 2)))
    for number, stage in enumerate(STAGES):
        progress("track", number, len(STAGES) + 1)
        state = stage(task, state)
    progress("track", len(STAGES), len(STAGES) + 1)
    tracked = _judged(task, state)
    progress("track", 1, 1)
    return tracked


def _judged(task: Task, state: State) -> TrackedRows:
    """Compute what the likelihood says of each row and of each track."""
    field, ground, rows = task.field, state.ground, state.rows
    judged = field.judge(ground, rows)
    near = meeting(rows, task.config.detection.min_separation_nm)
    error = 1 / np.sqrt(np.maximum(judged.fisher[:, 3, 3], 1e-300))
    unlike = shared_mass = has_other_mass(rows.track, rows.theta[:, 3], error)
    if task.heights_free:  # a path along z takes as much of the mass, and must count
        unlike = shared_mass & crowded(rows, task.context.roi_px * task.context.pixel_nm)
    counted = state.done & field.holds(rows.theta) & ~near & ~unlike
    common = common_amplitudes(field, ground, rows, judged, counted)
    shared = shared_errors(field, ground, rows, judged)
    found: dict[str, Any] = {"judged": judged, "field": field, "shared": shared, "common": common}
    return TrackedRows(**vars(state), **found, close=near | shared_mass)


def _refuse_flood(task: Task, rows: Localizations) -> None:
    """Refuse a frame with more rows than particles that could be resolved."""
    area = (task.field.pixel_nm / 1e3) ** 2 * float(task.field.used.sum())
    each = len(rows.frame) / task.field.frames
    # more than 0.15 rows in an area of (λ/NA)² are no particles
    if each > 0.15 * area / (task.config.optics.resolution_nm / 1e3) ** 2:
        raise DataError(
            f"{each:.0f} places in every frame of {area:.0f} um2 look like particles, more than "
            "can be told apart: the light changes from frame to frame, as where the stage drifts "
            "or vibrates, or the optics are far off; record a steadier movie or fewer particles, "
            "or analyse fewer frames (fit.frames), in which it stands still"
        )


def _joined(rows: Localizations, found: Localizations) -> Localizations:
    """Add candidates to the rows as starting points of fits."""
    blur = np.bincount(rows.group).argmax() if len(rows.group) else 0
    found = replace(found, group=np.full_like(found.group, blur))
    unknown = replace(rows, track=np.full_like(rows.track, -1))
    return Localizations.together([unknown, found]).in_order()


def _credible(task: Task, rows: Localizations, done: BoolArray) -> Localizations:
    """Keep rows that are bright enough to be particles, and each particle once."""
    # of light that is no picture a fit may be lost
    known = np.asarray(np.isfinite(rows.theta).all(axis=1), dtype=np.bool_)
    rows, done = rows.only(known), done[known]
    kept = done & (rows.theta[:, 3] > 0) & (rows.snr > AS_FOUND * task.context.templates.threshold)
    rows = rows.only(kept)
    pairs = rows.pairs_within(task.config.optics.resolution_nm / 4)
    fainter = np.argmin(rows.snr[pairs], axis=1)[:, None]
    return rows.only(~np.isin(np.arange(len(rows.frame)), np.take_along_axis(pairs, fainter, 1)))


def diffusion_of(config: Config, free: BoolArray, rows: Localizations) -> FloatArray:
    """Fit D to each track where its particle is isolated.

    Positions during a meeting have larger errors than stated, and would count as steps.

    Shapes: `free` (5,), result (tracks, 2).
    """
    out = np.zeros((int(rows.track.max(initial=-1)) + 1, 2))
    sigma = np.sqrt(variances_left(rows.fisher, np.flatnonzero(free[:4])))[:, :2]
    error = sigma.max(axis=1)
    apart = ~meeting(rows, config.detection.min_separation_nm)
    for k in range(len(out)):
        mine = apart & (rows.track == k)
        if mine.any():
            # a place with 300 times the median error of its track tells nothing
            mine &= error < 300.0 * np.nanmedian(error[mine])
        if mine.sum() >= 4:
            places = rows.theta[mine, :2], sigma[mine]
            out[k] = diffusion_of_positions(config, rows.frame[mine], *places)
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
    theta, mass = rows.theta.copy(), typical(rows).theta[:, 3]
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        if len(mine) < _AROUND:
            continue
        places = theta[mine, :2]
        usual = median_filter(places, size=(_AROUND, 1), mode="nearest")
        away = places - usual
        # of normal errors 1 in 10¹¹ is larger than 5 root mean squares
        outliers = (away**2).sum(axis=1) > 5.0**2 * mean_square(away)
        theta[mine[outliers], :2] = usual[outliers]
        theta[mine[outliers], 3] = mass[mine[outliers]]
    return replace(rows, theta=theta)
