"""Which interference fringe a particle is in, decided over its track.

Along z the likelihood of a frame has a maximum in every fringe, λ/(2 n_s) apart, and one frame may
hardly tell them apart.  A particle does not jump a fringe between two frames.  Every row is fitted
in each fringe, and of all sequences of fringes that is taken whose likelihood, times that of the
steps that it implies, is the largest (A. J. Viterbi, IEEE Trans. Inf. Theory 13, 260, 1967).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from iscat_analysis.inference.moving import Ground, MovingField, Rows
from iscat_analysis.records import FloatArray

_LEAST_STEP = 0.05  # fringes: no particle is taken to move less between two frames


def decide_heights(
    field: MovingField,
    ground: Ground,
    rows: Rows,
    *,
    fringe_nm: float,
    z_range_nm: tuple[float, float],
) -> Rows:
    """Put every row into the fringe that its track says.

    Parameters
    ----------
    field : MovingField
        The movie, with z free.
    ground : Ground
        The background.
    rows : Rows
        Particles with their tracks.
    fringe_nm : float
        Distance of the fringes [nm].
    z_range_nm : tuple of float
        Where z is searched [nm].

    Returns
    -------
    Rows
        Fitted in their fringes.
    """
    if not len(rows.frame):
        return rows
    low, high = z_range_nm
    most = math.ceil((high - low) / fringe_nm)
    thetas, gains = [], []
    for k in range(-most, most + 1):
        theta = rows.theta.copy()
        theta[:, 2] += k * fringe_nm
        inside = (theta[:, 2] > low - fringe_nm / 2) & (theta[:, 2] < high + fringe_nm / 2)
        if not inside.any():
            continue
        theta[:, 2] = np.clip(np.where(inside, theta[:, 2], rows.theta[:, 2]), low, high)
        fitted, _, done = field.fit(ground, replace(rows, theta=theta), sweeps=1, coarse=True)
        gain = field.judge(ground, fitted, brief=True, coarse=True).gain
        thetas.append(fitted.theta)
        gains.append(np.where(inside & done, gain, -np.inf))
    places, values = np.stack(thetas, axis=1), np.stack(gains, axis=1)
    values[~np.isfinite(values).any(axis=1)] = 0.0  # no fit converged: its neighbours decide
    out = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        steps = np.diff(rows.theta[mine, :2], axis=0)
        apart = np.diff(rows.frame[mine])
        square = (steps**2).mean(axis=1) / apart
        per_frame = max(
            float(np.median(square)) / 0.6931 if len(square) else 0.0,
            (_LEAST_STEP * fringe_nm) ** 2,
        )
        path = _best_path(places[mine, :, 2], values[mine], per_frame * apart)
        out[mine] = places[mine, path]
    return replace(rows, theta=out)


def _best_path(heights: FloatArray, gains: FloatArray, variances: FloatArray) -> np.ndarray:
    """Give the state of every frame, (n,), of the likeliest sequence of states (n, states)."""
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
