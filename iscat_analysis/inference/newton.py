"""Newton's step of a background that the particles over it follow."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from iscat_analysis._kernels.moving import Response, follow_rows
from iscat_analysis.records import BoolArray, FloatArray

_PARTS = 8  # of the rows, that threads take in turn
_RESIDUE = 0.02  # of a step that is left to the next
_MOST_STEPS = 40  # of the conjugate gradients
_FARTHEST = 0.05  # step of the logarithm of the background


def newton_step(
    move: FloatArray,
    response: Response,
    total: FloatArray,
    used: BoolArray,
    pool: ThreadPoolExecutor,
) -> FloatArray:
    """Tell where turns of background and rows would end.

    The rows follow the background and the background them: what a step δ leaves over is
    move − δ + N⁻¹ Σ Gᵀ F⁻¹ G δ.  It vanishes where M δ = N move; the conjugate gradients that
    solve it see M only by what it does to an image.

    Parameters
    ----------
    move : ndarray, shape (y, x)
        What one turn changes of the logarithm of the background.
    response : Response
        How the rows follow.
    total : ndarray, shape (y, x)
        N, photoelectrons of all frames.
    used : ndarray of bool, shape (y, x)
        Pixels that may be used.
    pool : ThreadPoolExecutor
        Runs parts of the rows; the result does not depend on its size.

    Returns
    -------
    ndarray, shape (y, x)
        Change of the logarithm of the background.
    """
    counts = np.where(used, total, 0.0)
    rows = len(response.squares)
    share = max(rows // _PARTS, 1)

    def part(first: int, image: FloatArray) -> FloatArray:
        out = np.zeros(used.shape)
        follow_rows(response, first, min(first + share, rows), image, out)
        return out

    def undetermined(step: FloatArray) -> FloatArray:
        image = step.reshape(used.shape)
        out = counts * image
        for taken in pool.map(partial(part, image=image), range(0, rows, share)):
            out -= taken
        return np.where(used, out, image).ravel()

    weight = np.where(used, np.maximum(counts, 1.0), 1.0).ravel()
    step, _ = cg(
        LinearOperator((move.size, move.size), undetermined, dtype=np.float64),
        (counts * move).ravel(),
        x0=move.ravel(),
        rtol=_RESIDUE,
        maxiter=_MOST_STEPS,
        M=LinearOperator((move.size, move.size), lambda v: v.ravel() / weight, dtype=np.float64),
    )
    return np.asarray(np.clip(step.reshape(move.shape), -_FARTHEST, _FARTHEST))
