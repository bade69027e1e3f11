"""Which interference fringe a particle is in, decided over its track.

Along z the likelihood of a frame has a maximum in every fringe, λ/(2 n_s) apart, and one frame may
hardly tell them apart.  A particle does not jump a fringe between two frames.  Every row is fitted
in each fringe, and of all sequences of fringes that is taken whose likelihood, times that of the
steps that it implies, is the largest (A. J. Viterbi, IEEE Trans. Inf. Theory 13, 260, 1967).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations
from iscat_analysis.tracking.linking import typical

_BLOCK = 64  # frames at a time
_LEAST_STEP = 0.05  # fringes: no particle is taken to move less between two frames


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
            (_LEAST_STEP * fringe_nm) ** 2,
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
