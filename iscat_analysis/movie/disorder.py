"""Plain numbers whose bytes or axes lie in another order than was said, told by their smoothness.

Read in the right order, a pixel changes by its noise from frame to frame, and neighbours have
similar light.  With its bytes the other way round it changes by a third of the range of its type;
where rows are taken for columns, neighbours are pixels from all over the frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LEAST_BYTE_GAIN = 8.0  # of the smoothness, if bytes are swapped; 3 for the noisiest real movies
_LEAST_AXES_GAIN = 2.0  # of the smoothness across rows, if columns are stored one after the other
_LEAST_PIXELS = 1024  # of a frame that tell an order
_LOOKED_AT = 4  # pairs of frames


def looked_at(frames: int) -> Iterator[tuple[int, int]]:
    """Choose pairs of successive frames, all over a movie."""
    for start in dict.fromkeys(np.linspace(0, frames - 2, _LOOKED_AT, dtype=int).tolist()):
        yield start, start + 2


def bytes_are_swapped(counts: NDArray[Any]) -> bool:
    """Tell whether numbers are far smoother in time with their bytes the other way round.

    Shapes: `counts` (t, y, x), in pairs of successive frames.
    """
    if counts.dtype.itemsize < 2 or counts.size < _LEAST_PIXELS:
        return False
    given, swapped = (_change(numbers) for numbers in (counts, counts.byteswap()))
    return given > _LEAST_BYTE_GAIN * swapped


def _change(counts: NDArray[Any]) -> float:
    """Mean change of a pixel within pairs of frames, in steps; of the logarithm of a float."""
    if counts.dtype.kind == "f":
        limits = np.finfo(counts.dtype)
        size = np.abs(np.nan_to_num(counts, nan=limits.max, posinf=limits.max, neginf=limits.max))
        values, step = np.log2(np.maximum(size, limits.smallest_subnormal).astype(np.float64)), 1
    else:  # few bits may stand in the upper bytes, all counts being multiples of a step
        bits = int(np.bitwise_or.reduce(counts, axis=None))
        values, step = counts.astype(np.float64), max(bits & -bits, 1)
    pairs = values[: len(values) // 2 * 2].reshape(-1, 2, *values.shape[1:])
    return float(np.abs(pairs[:, 1] - pairs[:, 0]).mean()) / step


def lines_are_exchanged(counts: NDArray[Any]) -> bool:
    """Tell whether frames are far smoother if they have as many lines as a line has pixels.

    A square frame is only turned over its diagonal by that, which nothing tells.

    Shapes: `counts` (t, y, x), or (t, x, y) where columns are stored one after the other.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of floats that are none
        mean = counts.mean(axis=0, dtype=np.float64)
    if mean.size < _LEAST_PIXELS or not np.isfinite(mean).all():
        return False
    given, other = (
        float(np.mean(np.diff(lines, axis=0) ** 2)) for lines in (mean, mean.reshape(mean.T.shape))
    )
    return given > _LEAST_AXES_GAIN * other
