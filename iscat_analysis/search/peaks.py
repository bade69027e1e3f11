"""Peaks of smooth fields that are known at pixels only."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

SAMPLED = 0.85
"""Of a peak's height that the pixel next to it has at least."""


def vertex(line: NDArray[Any], index: int) -> tuple[float, float]:
    """Vertex of the parabola through a maximum and its two neighbours.

    Parameters
    ----------
    line : ndarray, shape (n,)
        The field along one axis.
    index : int
        Where it has a maximum.

    Returns
    -------
    shift : float
        From the maximum to the vertex, at most half a step; 0 at an end of the line.
    above : float
        Height of the vertex above the maximum.
    """
    if not 0 < index < line.size - 1:
        return 0.0, 0.0
    low, mid, high = (float(v) for v in line[index - 1 : index + 2])
    bend = low - 2 * mid + high
    if bend >= 0:
        return 0.0, 0.0
    shift = max(-0.5, min(0.5 * (low - high) / bend, 0.5))
    return shift, 0.25 * (high - low) * shift
