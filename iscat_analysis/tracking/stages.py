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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.optics.model import path_variance_nm2
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.diffusion import estimate_diffusion
from iscat_analysis.threads import start_in_thread
from iscat_analysis.tracking.field import MovingField
from iscat_analysis.tracking.frames import (
    Recording,
    exposure_of,
    initial_background,
    load_field,
    restore_particle_light,
)
from iscat_analysis.tracking.joint import (
    MOST_TURNS,
    CommonAmplitudes,
    common_amplitudes,
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
    identified,
    linked,
    load_linker,
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
from iscat_analysis.tracking.rows import BackgroundEstimate, Judged, Localizations
from iscat_analysis.tracking.search import FrameCandidates, search_frames

IntArray = NDArray[np.int64]

_BLOCK = 64  # frames at a time


def decide_heights(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    *,
    fringe_nm: float,
    z_range_nm: tuple[float, float],
) -> Localizations:
    """Choose the interference fringe of every row by the likelihood of its whole track."""
    if not len(rows.frame):
        return rows
    starts = rows.starts(field.frames)
    rank = np.arange(len(rows.frame)) - starts[rows.frame]
    ladders = []
    for turn in range(int(rank.max()) + 1):  # one particle of each frame climbs at a time
        ladders.append(_ladder(field, ground, rows, rank == turn, fringe_nm, z_range_nm))
    steps = max(candidates.shape[1] for candidates, _ in ladders)
    candidates = np.repeat(rows.theta[:, None], steps, axis=1)
    values = np.full((len(rows.frame), steps), -np.inf)
    for turn, (heights, gains) in enumerate(ladders):
        candidates[rank == turn, : heights.shape[1]] = heights
        values[rank == turn, : gains.shape[1]] = gains
    # Where no fit converged, the other rows of the track decide.
    values[~np.isfinite(values).any(axis=1)] = 0.0
    out = rows.theta.copy()
    single = np.flatnonzero(rows.track < 0)
    out[single] = candidates[single, values[single].argmax(axis=1)]
    for k in np.unique(rows.track[rows.track >= 0]):
        mine = np.flatnonzero(rows.track == k)
        steps = np.diff(rows.theta[mine, :2], axis=0)
        apart = np.diff(rows.frame[mine])
        square = (steps**2).mean(axis=1) / apart
        per_frame = max(
            float(np.median(square)) / 0.6931 if len(square) else 0.0,
            # no particle is taken to move by less than 0.05 fringes between two frames
            (0.05 * fringe_nm) ** 2,
        )
        path = _best_path(candidates[mine, :, 2], values[mine], per_frame * apart)
        out[mine] = candidates[mine, path]
    return replace(rows, theta=out)


def _ladder(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    climbs: BoolArray,
    fringe_nm: float,
    z_range_nm: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Fit some rows in every fringe, each fit starting from the one in the fringe before.

    The other rows of their frames stay as they are.  Returns the fits, shape (n, rungs, 5), and
    their log-likelihoods, (n, rungs).

    Returns what was fitted, shape (n, rungs, 5), and its log-likelihood, (n, rungs).
    """
    low, high = z_range_nm
    frames = np.zeros(field.frames, dtype=bool)
    frames[rows.frame[climbs]] = True
    with_others = frames[rows.frame]
    rows, mine = rows.only(with_others), climbs[with_others]
    usual = typical(rows).theta[:, 3]
    gain = _values(field, ground, rows)
    thetas, gains = [rows.theta[mine]], [gain[mine]]
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
            gain = _values(field, ground, fitted)
            thetas.append(fitted.theta[mine])
            gains.append(np.where(inside & done, gain, -np.inf)[mine])
            stayed = inside & (np.abs(fitted.theta[:, 2] - start[:, 2]) < fringe_nm / 2)
            here[stayed, 2] = fitted.theta[stayed, 2]
    return np.stack(thetas, axis=1), np.stack(gains, axis=1)


def _values(field: MovingField, ground: BackgroundEstimate, rows: Localizations) -> FloatArray:
    """Log-likelihood of the whole frame of each row, but for a constant of the frame.

    Squares around fits in two fringes do not hold the same pixels, and one more column of rings
    counts for more than a fringe does.
    """
    out = np.zeros(field.frames)
    field.draw(ground, rows)
    for first in range(0, field.frames, _BLOCK):
        last = min(first + _BLOCK, field.frames)
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
    def resolution_nm(self) -> float:
        """Length λ/NA [nm]."""
        return self.config.optics.wavelength_nm / self.config.optics.na

    @property
    def heights_free(self) -> bool:
        """Whether particles move along z as well."""
        return bool(self.field.free[2])

    @property
    def learns_background(self) -> bool:
        """Whether the background follows the rows."""
        return self.config.background.learnt_with_tracks

    def linked(self, rows: Localizations, *, bridged: bool = False) -> Localizations:
        """Link rows by their places and masses."""
        places = mass_places(self.config, rows)
        return linked(self.config, rows, places, bridged=bridged, inner=self.inner)

    def fitted(self, state: State, turns: int = MOST_TURNS, *, coarse: bool = True) -> State:
        """Fit rows and background in turn."""
        rows, ground, done = fit_jointly(
            self.field, state.ground, state.rows, turns=turns, coarse=coarse,
            follow_power=self.config.background.power_normalization,
            follow_level=self.learns_background,
        )  # fmt: skip
        return replace(state, rows=rows, ground=ground, done=done)

    def in_fringes(self, state: State) -> State:
        """Choose the interference fringe of every row by its track, where heights are free."""
        if not self.heights_free:
            return state
        rows = decide_heights(
            self.field, state.ground, state.rows,
            fringe_nm=self.context.model.fringe_nm, z_range_nm=self.config.fit.z_range_nm,
        )  # fmt: skip
        return replace(state, rows=rows)

    def blurred(self, state: State) -> State:
        """Give tracks the blur that their D makes."""
        diffusion = diffusion_of(self.config, self.field.free, state.rows)
        rows, variances = blurred_rows(state.rows, diffusion, exposure_of(self.config)[1])
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


def search(task: Task, state: State) -> State:
    """Look for particles in what the fits so far leave over, until little is added."""
    for number in range(ROUNDS):
        before = len(state.rows.frame)
        found = search_frames(
            task.context, task.field, state.ground, state.rows, task.recording.pool,
            enough=round(_FEW * before) if number >= _FULL else 0, cautious=task.cautious,
        )  # fmt: skip
        if number and len(found.frame) <= _FEW * before:
            break
        rows = _joined(task.context, state.rows, found)
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
            state = task.blurred(replace(state, rows=task.linked(state.rows)))
            state = task.fitted(state, _NEXT_TURNS)
        _refuse_flood(task, state.rows)
        if number and len(state.rows.frame) <= (1 + _FEW) * before:
            break
    return replace(state, rows=task.linked(state.rows))


def extend(task: Task, state: State) -> State:
    """Continue tracks and leave out what is none, until little changes."""
    for number in range(ROUNDS):
        # at first nothing is only tried, and the search has settled nearly all
        state = task.fitted(state, _NEXT_TURNS if number else 1)
        rows, added = trimmed(state.rows), 0
        if not task.cautious:
            rows, added = extended(
                task.field, state.ground, rows,
                resolution_nm=task.resolution_nm, reach_nm=task.config.track.max_step_nm,
            )  # fmt: skip
        rows = alone(task.context, task.linked(rows, bridged=True), inner=task.inner)
        # in two rounds slow particles are tried where they were not detected
        ground, trial = state.ground, number < 2
        if trial and task.learns_background and not task.cautious:
            rows, tried = extrapolated(task.config, task.field, rows)
            added += tried
        if task.learns_background:  # of all frames, before these are fitted over it
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
    rows = identified(rows, near_nm=task.resolution_nm, error=error)
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
    restore_particle_light(
        task.context, task.recording, task.first, task.field, state.ground, state.rows
    )
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
    nothing = np.zeros(0, dtype=np.int64)
    state = State(
        rows=Localizations.of(nothing, nothing, np.zeros((0, 5))),
        ground=initial_background(context.config, field),
        done=np.zeros(0, dtype=np.bool_), variances_nm2=np.zeros(1), diffusion=np.zeros((0, 2)),
    )  # fmt: skip
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
    shared = shared_errors(field, ground, rows, judged)
    near = meeting(rows, task.config.detection.min_separation_nm)
    unlike = shares_mass(rows, judged)
    close = near | unlike
    if task.heights_free:  # a path along z takes as much of the mass, and must count
        unlike = unlike & crowded(rows, task.context.roi_px * task.context.pixel_nm)
    counted = state.done & field.holds(rows.theta) & ~near & ~unlike
    common = common_amplitudes(field, ground, rows, judged, counted)
    return TrackedRows(
        rows, ground, judged, state.done, close, state.variances_nm2, state.diffusion, field,
        shared, common,
    )  # fmt: skip


def _refuse_flood(task: Task, rows: Localizations) -> None:
    """Refuse a frame with more rows than particles that could be resolved."""
    area = (task.field.pixel_nm / 1e3) ** 2 * float(task.field.used.sum())
    each = len(rows.frame) / task.field.frames
    # more than 0.15 rows in an area of (λ/NA)² are no particles
    if each > 0.15 * area / (task.resolution_nm / 1e3) ** 2:
        raise DataError(
            f"{each:.0f} places in every frame of {area:.0f} um2 look like particles, more than "
            "can be told apart: the light changes from frame to frame, as where the stage drifts "
            "or vibrates, or the optics are far off; record a steadier movie or fewer particles, "
            "or analyse fewer frames (fit.frames), in which it stands still"
        )


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


def _credible(task: Task, rows: Localizations, done: BoolArray) -> Localizations:
    """Keep rows that are bright enough to be particles, and each particle once."""
    # of light that is no picture a fit may be lost
    known = np.asarray(np.isfinite(rows.theta).all(axis=1), dtype=np.bool_)
    rows, done = rows.only(known), done[known]
    kept = done & (rows.theta[:, 3] > 0) & (rows.snr > AS_FOUND * task.context.templates.threshold)
    near = task.resolution_nm / 4
    starts = rows.starts(task.field.frames)
    for t in np.unique(rows.frame[crowded(rows, near)]):
        order = starts[t] + np.argsort(-rows.snr[starts[t] : starts[t + 1]])
        for i, a in enumerate(order):
            for b in order[:i]:
                apart = np.hypot(*(rows.theta[a, :2] - rows.theta[b, :2]))
                if kept[a] and kept[b] and apart < near:
                    kept[a] = False
    return rows.only(kept)


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
            # a place with 300 times the median error of its track tells nothing
            mine &= error < 300.0 * np.nanmedian(error[mine])
        if mine.sum() < 4:
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
        # of normal errors 1 in 10¹¹ is larger than 5 root mean squares
        outliers = distance_squared > 5.0**2 * mean_square(positions - usual)
        theta[mine[outliers], :2] = usual[outliers]
        theta[mine[outliers], 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)
