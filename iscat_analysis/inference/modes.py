"""What the rows of a track change of the light of its pixels, and what its background hides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.inference.moving import MovingField
from iscat_analysis.inference.rows import Ground, Rows
from iscat_analysis.records import FloatArray


def lost(field: MovingField, ground: Ground, rows: Rows) -> FloatArray:
    """Information on what the rows of one track have in common that their background takes.

    Parameters
    ----------
    field : MovingField
        The movie.
    ground : Ground
        Background.
    rows : Rows
        All of one track.

    Returns
    -------
    ndarray, shape (free, free)
        Σ over pixels of (Σ_t w B ∂C)(Σ_t w B ∂C)ᵀ / Σ_t w B (1 + C), in the free ones of
        (x, y, z, a).
    """
    cut = _box(field, rows)
    modes = np.zeros((1, int(field.free[:4].sum()), *ground.level[cut].shape))
    together = np.zeros(len(rows.frame), dtype=np.int64)
    field.add_modes(ground, rows, (cut[0].start, cut[1].start), together, modes)
    return np.asarray(np.einsum("ayx,byx,yx->ab", *modes, *modes, _weight(field, ground, cut)))


def pixels_of(field: MovingField, rows: Rows) -> int:
    """Count the pixels of the box in which all rows are fitted.

    Parameters
    ----------
    field : MovingField
        The movie.
    rows : Rows
        All of one track.

    Returns
    -------
    int
        Rows times columns.
    """
    rows_, columns = _box(field, rows)
    return int((rows_.stop - rows_.start) * (columns.stop - columns.start))


def patterns(
    field: MovingField, ground: Ground, rows: Rows
) -> tuple[NDArray[np.float32], FloatArray]:
    """Give what each row changes of the light of every pixel of its track.

    Parameters
    ----------
    field : MovingField
        The movie.
    ground : Ground
        Background.
    rows : Rows
        All of one track.

    Returns
    -------
    patterns : ndarray of float32, shape (n, free, y, x)
        w B ∂C of each row, in the free ones of (x, y, z, a) [e per unit].
    weight : ndarray, shape (y, x)
        One over the counts of all frames; less where there is read noise, 0 where not used.
    """
    cut, each = _box(field, rows), np.arange(len(rows.frame))
    free = int(field.free[:4].sum())
    out = np.zeros((each.size, free, *ground.level[cut].shape), dtype=np.float32)
    field.add_modes(ground, rows, (cut[0].start, cut[1].start), each, out)
    return out, _weight(field, ground, cut)


def _box(field: MovingField, rows: Rows) -> tuple[slice, slice]:
    """Give the pixels that the squares of rows cover."""
    spans = []
    for axis, size in ((1, field.used.shape[0]), (0, field.used.shape[1])):
        first = np.rint(rows.theta[:, axis] / field.pixel_nm - (field.roi_px - 1) / 2)
        low = int(np.clip(first.min(), 0, size - 1))
        spans.append(slice(low, int(np.clip(first.max() + field.roi_px, low + 1, size))))
    return spans[0], spans[1]


def _weight(field: MovingField, ground: Ground, cut: tuple[slice, slice]) -> FloatArray:
    """One over the information of the pixels on the logarithm of their light."""
    level = ground.level[cut]
    share = np.where(field.used[cut], level / (level + field.read_e2[cut]), 0.0)
    return np.asarray(share / np.maximum(field.total_e[cut], 1.0))
