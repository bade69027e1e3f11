"""What the frames of one track have in common: one mass, and the errors of its background.

The information on all parameters of a track over an unknown background is, per pixel,

    J = Σ_t w_t B ∂C_t ∂C_tᵀ/(1 + C_t) − (Σ_t w_t B ∂C_t)(Σ_t w_t B ∂C_t)ᵀ / Σ_t w_t B (1 + C_t).

The second part, of rank one in each pixel, is what the background takes.  Shared among the frames
it takes 1/T from each, but adds up for what they have in common: a particle that hardly moves is
told from its background by its motion alone, and how it moved must be told as well.

With F_t the information of frame t on its own (x, y, z, a), G_t = w_t B ∂C_t and N the counts of
each pixel, the background that is left undetermined when every frame follows its own noise has the
information M = N − Σ_t G_tᵀ F_t⁻¹ G_t, and a row the covariance

    F_t⁻¹ + F_t⁻¹ G_t M⁻¹ G_tᵀ F_t⁻¹.

With F_t⁻¹ = R_t R_tᵀ and K = Rᵀ G N⁻¹ Gᵀ R of all rows together, which is smaller than M for a
short track, what is added is R ((1 − K)⁻¹ − 1) Rᵀ (Woodbury).

A mass that is common to the frames keeps Σ_t J_t − cᵀ M⁻¹ c, with M, c and J_t those that are left
when the places alone follow.  M couples all pixels of a track.  Where it covers so many that it
moved far (`MOST_PIXELS`), only the errors common to all frames are kept: with F = Σ_t F_t and
L = (Σ_t G_t)(Σ_t G_t)ᵀ/N their covariance is (F − L)⁻¹ − F⁻¹.  Tracks are taken one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from iscat_analysis.inference.modes import lost, patterns, pixels_of
from iscat_analysis.inference.moving import MovingField
from iscat_analysis.inference.rows import Ground, Judged, Rows
from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]

MOST_PIXELS = 1800
"""Pixels of a track whose information is taken as a whole."""

_SINGULAR = 1e-9
_TOGETHER = 128  # rows whose products are added in single precision
_SOLVED = 256  # rows whose triangular systems are solved at a time, in the caches
_DOUBTFUL = 2.5  # logarithm of the largest pivot over the least, where 1e-7 may count
_STEPS = 4  # of Newton's method
_SETTLED = 0.3  # standard deviations; what a step leaves is a fiftieth of it
_SHORT = 0.5  # unknowns of a track over its pixels, below which the matrix of these is larger
_AT_ONCE = 128  # unknowns of a triangular system that are solved without products


@dataclass(frozen=True)
class CommonAmplitudes:
    """Amplitudes that are common to the frames of each track, by the exact likelihood.

    Attributes
    ----------
    amplitude : ndarray, shape (tracks,)
        Where the likelihood has its maximum, its bias of order 1/N taken off; NaN where no frame
        counts.
    variance : ndarray, shape (tracks,)
        Its variance, with what the background takes.
    known : ndarray, shape (tracks,)
        The same over a background that is known.
    frames : ndarray, shape (tracks,)
        How many frames would weigh as much, were they alike: (Σ J_t)²/Σ J_t².
    """

    amplitude: FloatArray
    variance: FloatArray
    known: FloatArray
    frames: FloatArray


@dataclass(frozen=True)
class Shared:
    """What the background takes from tracks.

    Attributes
    ----------
    covariance : ndarray, shape (n, 4, 4)
        Covariance of (x, y, z, a) of each row besides that over a known background; infinite on the
        diagonal where nothing is known, 0 where not free.
    taken : ndarray, shape (tracks,)
        Share of the information on a common amplitude that is lost, of tracks that moved far.
    together : mapping of int to (ndarray of int, ndarray)
        Of the other tracks: their rows and the covariance of the amplitudes of these.
    """

    covariance: FloatArray
    taken: FloatArray
    together: Mapping[int, tuple[IntArray, FloatArray]]


def shared_errors(field: MovingField, ground: Ground, rows: Rows, judged: Judged) -> Shared:
    """Say what the background takes from the rows and from the tracks.

    Parameters
    ----------
    field : MovingField
        The movie.
    ground : Ground
        The background.
    rows : Rows
        Particles, at their estimates.
    judged : Judged
        Of these rows.

    Returns
    -------
    Shared
        By row and by track.
    """
    tracks = int(rows.track.max(initial=-1)) + 1
    index = np.flatnonzero(field.free[:4])
    covariance, taken = np.zeros((len(rows.frame), 4, 4)), np.zeros(tracks)
    together: dict[int, tuple[IntArray, FloatArray]] = {}

    def of_one(k: int) -> None:
        mine = np.flatnonzero(rows.track == k)
        mine = mine[np.linalg.det(_scaled(judged.fisher[mine], index)[0]) > _SINGULAR]
        if not mine.size:
            return
        fisher, of_track = judged.fisher[mine], rows.only(mine)
        if pixels_of(field, of_track) <= MOST_PIXELS:
            extra, amplitudes = _all_pixels(field, ground, of_track, fisher, index)
            together[k] = mine, amplitudes
        else:
            hidden = lost(field, ground, of_track)
            extra, taken[k] = _common_modes(fisher, hidden, index)
        covariance[np.ix_(mine, index, index)] = extra

    field.share(of_one, tracks)
    return Shared(covariance, taken, together)


def variances_left(information: FloatArray, index: IntArray) -> FloatArray:
    """Give the variances that matrices of information leave.

    Parameters
    ----------
    information : ndarray, shape (n, 4, 4)
        In (x, y, z, a).
    index : ndarray of int
        Free parameters.

    Returns
    -------
    ndarray, shape (n, 4)
        NaN where not free, or where a matrix is not positive definite.
    """
    out = np.full(information.shape[:2], np.nan)
    scaled, scale = _scaled(information, index)
    good = np.flatnonzero(np.isfinite(scaled).all(axis=(1, 2)))
    if not good.size:
        return out
    values = np.linalg.eigvalsh(scaled[good])
    good = good[values[:, 0] > _SINGULAR]
    inverse = np.einsum("nii->ni", np.linalg.inv(scaled[good])) * scale[good] ** 2
    out[good[:, None], index[None]] = inverse
    return out


def _all_pixels(
    field: MovingField, ground: Ground, rows: Rows, fisher: FloatArray, index: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance of every row besides its own, and that of the amplitudes of all rows."""
    inverse = _inverse(fisher, index)
    slopes, weight = _slopes(field, ground, rows)
    if slopes.shape[0] * slopes.shape[1] < _SHORT * weight.size:
        return _of_a_short_one(slopes, weight, inverse)
    left = _undetermined(slopes, weight, inverse)
    if left is None or np.ptp(np.log(left.diagonal())) > _DOUBTFUL:
        slopes = _slopes(field, ground, rows)[0].astype(np.float64)
        left = _undetermined(slopes, weight, inverse)
    if left is None:
        return _unknown(inverse)
    own = np.diag(inverse[:, -1, -1])
    root, left = slopes, left.astype(slopes.dtype)
    for first in range(0, len(root), _SOLVED):
        _forward(left, root[first : first + _SOLVED].reshape(-1, weight.size).T)
    extra = (root @ np.swapaxes(root, 1, 2)).astype(np.float64)
    return extra, own + (root[:, -1] @ root[:, -1].T).astype(np.float64)


def _slopes(field: MovingField, ground: Ground, rows: Rows) -> tuple[NDArray[Any], FloatArray]:
    """Give G, shape (n, free, m), and 1/N of the m pixels that say something."""
    changes, weight = patterns(field, ground, rows)
    slopes = changes.reshape(*changes.shape[:2], -1)
    pixels = np.flatnonzero(weight > 0)
    if pixels.size < weight.size:
        slopes = slopes[:, :, pixels]
    return slopes, weight.flat[pixels]


def _of_a_short_one(
    slopes: NDArray[np.float32], weight: FloatArray, inverse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Give the same of a track with fewer unknowns than pixels."""
    n, free, _ = slopes.shape
    root = np.linalg.cholesky(inverse)
    felt = (np.swapaxes(root, 1, 2) @ slopes * np.sqrt(weight)).reshape(n * free, -1)
    factor = _factor(np.eye(n * free) - felt @ felt.T)
    if factor is None:
        return _unknown(inverse)
    half = np.linalg.inv(factor)
    more = (half.T @ half - np.eye(n * free)).reshape(n, free, n, free)
    each = np.arange(n)
    extra = root @ more[each, :, each] @ np.swapaxes(root, 1, 2)
    amplitudes = np.einsum("ia,iajb,jb->ij", root[:, -1], more, root[:, -1], optimize=True)
    return extra, np.diag(inverse[:, -1, -1]) + amplitudes


def _unknown(inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances where the background takes all that was known."""
    diagonal = np.diag(np.full(inverse.shape[1], np.inf))
    every = np.diag(inverse[:, -1, -1])
    return np.broadcast_to(diagonal, inverse.shape), np.full_like(every, np.inf)


def _undetermined(
    slopes: NDArray[Any], weight: FloatArray, inverse: FloatArray
) -> NDArray[Any] | None:
    """Give the lower factor of M, and put F⁻¹ G in the place of the slopes G."""
    root = np.linalg.cholesky(inverse).astype(slopes.dtype)
    left = np.zeros((weight.size, weight.size))
    products = np.empty(left.shape, dtype=slopes.dtype)
    for first in range(0, len(slopes), _TOGETHER):
        some = slice(first, first + _TOGETHER)
        felt = np.swapaxes(root[some], 1, 2) @ slopes[some]
        np.matmul(root[some], felt, out=slopes[some])
        flat = felt.reshape(-1, weight.size)
        np.matmul(flat.T, flat, out=products)
        left -= products
    left.flat[:: weight.size + 1] += 1 / weight
    return _factor(left)


def _factor(matrix: FloatArray) -> NDArray[Any] | None:
    """Lower Cholesky factor of a matrix, None where that is not positive."""
    diagonal = matrix.flat[:: len(matrix) + 1]
    matrix.flat[:: len(matrix) + 1] = diagonal + _SINGULAR * diagonal.max()
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return None


def _forward(lower: NDArray[Any], right: NDArray[Any]) -> None:
    """Solve a lower triangular system in the place of its right sides, shape (n, m).

    By halves, whose products let other threads run, as the solver of SciPy does not.
    """
    if len(lower) <= _AT_ONCE:
        right[:] = solve_triangular(lower, right, lower=True, check_finite=False)
        return
    half = len(lower) // 2
    _forward(lower[:half, :half], right[:half])
    right[half:] -= lower[half:, :half] @ right[:half]
    _forward(lower[half:, half:], right[half:])


def _common_modes(
    fisher: FloatArray, lost: FloatArray, index: IntArray
) -> tuple[FloatArray, float]:
    """Covariance that all rows share, and the share of a common amplitude that is lost."""
    whole = fisher.sum(axis=0)[np.ix_(index, index)]
    scale = 1 / np.sqrt(np.diag(whole))
    whole, part = (m * np.outer(scale, scale) for m in (whole, lost))
    taken = float(np.clip(part[-1, -1], 0.0, 1.0 - _SINGULAR))
    if np.linalg.eigvalsh(whole - part)[0] < _SINGULAR:
        return np.diag(np.full(index.size, np.inf)), taken
    return (np.linalg.inv(whole - part) - np.linalg.inv(whole)) * np.outer(scale, scale), taken


def _scaled(fisher: FloatArray, index: IntArray) -> tuple[FloatArray, FloatArray]:
    """Informations of some parameters with ones on the diagonal, and what made them so."""
    part = fisher[:, index][:, :, index]
    scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-300))
    return part * scale[:, :, None] * scale[:, None, :], scale


def _inverse(fisher: FloatArray, index: IntArray) -> FloatArray:
    """Invert informations on some parameters, shape (n, len(index), len(index))."""
    scaled, scale = _scaled(fisher, index)
    return np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]


def common_amplitudes(
    field: MovingField,
    ground: Ground,
    rows: Rows,
    judged: Judged,
    counted: BoolArray,
    shared: Shared,
) -> CommonAmplitudes:
    """Fit one amplitude to all frames of each track, with the background that is most likely then.

    Parameters
    ----------
    field : MovingField
        The movie.
    ground : Ground
        Under the rows.
    rows : Rows
        Particles, at their estimates.
    judged : Judged
        Of these rows.
    counted : ndarray of bool, shape (n,)
        Rows that count; the others stay as they are.
    shared : Shared
        From `shared_errors`.

    Returns
    -------
    CommonAmplitudes
        By Newton's method on the likelihood with the background put in, the places following the
        amplitude to first order.  Of tracks whose pixels are taken as a whole it is the mean of
        generalised least squares over their rows, whose maximum is that of the same likelihood.
    """
    tracks, taken = int(rows.track.max(initial=-1)) + 1, shared.taken
    where = np.flatnonzero(counted)
    owner = rows.track[where]
    theta = rows.theta.copy()

    def summed(values: FloatArray) -> FloatArray:
        return np.bincount(owner, weights=values, minlength=tracks).astype(np.float64)

    others = np.flatnonzero(field.free[:3])
    _, information = _marginal(judged, where, others)
    total = summed(information)
    safe = np.maximum(total, 1e-300)
    amplitude = summed(information * theta[where, 3]) / safe
    bias = summed(information * judged.bias[where, 3]) / safe
    far = total > 0
    far[list(shared.together)] = False
    for _ in range(_STEPS if far.any() else 0):
        theta[where, 3] = amplitude[owner]
        same = replace(rows, theta=theta)
        _, found, _ = field.fit(ground, same, sweeps=0)
        ground = Ground(found.level, ground.power)
        at = field.judge(ground, same, brief=True)
        score, there = _marginal(at, where, others)
        information = np.where(far[owner], there, information)
        total = summed(information)
        safe = np.maximum(total, 1e-300)
        step = np.where(far, summed(score) / (safe * (1 - taken)), 0.0)
        amplitude = amplitude + step
        if np.all(np.abs(step) * np.sqrt(safe) < _SETTLED):
            break
    known = np.where(total > 0, 1 / safe, np.nan)
    frames = total**2 / np.maximum(summed(information**2), 1e-300)
    amplitude = np.where(total > 0, amplitude - bias, np.nan)
    variance = known / (1 - taken)
    for k, (mine, covariance) in shared.together.items():
        used = counted[mine] & np.isfinite(np.diag(covariance))
        if not used.any():
            amplitude[k] = variance[k] = np.nan
            continue
        weights = np.linalg.solve(covariance[np.ix_(used, used)], np.ones(int(used.sum())))
        variance[k] = 1 / weights.sum()
        each = (rows.theta[:, 3] - judged.bias[:, 3])[mine][used]
        amplitude[k] = variance[k] * weights @ each
    return CommonAmplitudes(amplitude, variance, known, frames)


def _marginal(judged: Judged, where: IntArray, others: IntArray) -> tuple[FloatArray, FloatArray]:
    """Score and information on the amplitude of rows, their places following it."""
    fisher, score = judged.fisher[where], judged.score[where]
    cross = fisher[:, others, 3]
    scaled, scale = _scaled(fisher, others)
    scaled = scaled + 1e-12 * np.eye(others.size)
    along = np.linalg.solve(scaled, (cross * scale)[..., None])[..., 0] * scale
    return (
        score[:, 3] - np.einsum("ni,ni->n", along, score[:, others]),
        np.maximum(fisher[:, 3, 3] - np.einsum("ni,ni->n", along, cross), 0.0),
    )
