"""Link positions in successive frames if no other particle is within reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_ROUNDING = 1e-9  # share of the reach by which rounding may change a distance


@kernel()
def link_surely(
    places: FloatArray, starts: IntArray, first: int, reach: float, memory: int, track: IntArray,
    taken: BoolArray, waiting: IntArray, state: IntArray, doubtful: IntArray,
) -> int:  # fmt: skip
    """Link positions from frame to frame until there is a choice.

    A particle waits at its last position until it is linked, at most `memory` frames beyond the
    next one.  If it has one new position within reach, and this position no other particle, the two
    are linked.  A position without a particle within reach begins a track.

    Shapes: `places` (n, axes), `starts` (t + 1,), `track` (n,), `taken` (n,), `waiting` (n,),
    `state` (4,), `doubtful` (n,).
    """
    onward, backward = np.empty(len(places), dtype=np.int64), np.empty(len(places), dtype=np.int64)
    only = np.empty(len(places), dtype=np.int64)
    for t in range(first, starts.size - 1):
        begin, end = starts[t], starts[t + 1]
        oldest, count = starts[max(t - 1 - memory, 0)], 0
        for k in range(state[0]):
            i = waiting[k]
            if i >= oldest and not taken[i]:
                waiting[count] = i
                count += 1
        onward[:count], backward[begin:end] = 0, 0
        for k in range(count):
            for j in range(begin, end):
                if _within(places, waiting[k], j, reach * (1 + _ROUNDING)):
                    onward[k] += 1
                    backward[j] += 1
                    only[j] = k
        for j in range(begin, end):
            if backward[j] == 0:
                track[j] = state[1]
                state[1] += 1
            elif backward[j] == 1 and onward[only[j]] == 1:
                i = waiting[only[j]]
                if _within(places, i, j, reach * (1 - _ROUNDING)):
                    track[j], taken[i] = track[i], True
                    backward[j] = 0
        left = 0
        for k in range(count):
            if onward[k] > 0 and not taken[waiting[k]]:
                doubtful[left] = waiting[k]
                left += 1
        state[2] = left
        for j in range(begin, end):
            waiting[count] = j
            count += 1
            if backward[j] > 0:
                doubtful[left] = j
                left += 1
        state[0], state[3] = count, left - state[2]
        if left > 0:
            return t
    return starts.size - 1


@kernel()
def _within(places: FloatArray, i: int, j: int, reach: float) -> bool:
    square = 0.0
    for k in range(places.shape[1]):
        square += (places[i, k] - places[j, k]) ** 2
    return square <= reach**2
