"""Simple NumPy operations on a line of numbers, written as loops.

Each process would compile NumPy's versions again, and for the assignment of slices also the text of
its error message: this takes a second or more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]


@kernel(_nrt=False)
def copy_line(values: FloatArray, out: FloatArray) -> None:
    """Copy numbers (n) into `out`."""
    for i in range(values.size):
        out[i] = values[i]


@kernel(_nrt=False)
def largest(values: FloatArray) -> int:
    """Give the index of the largest of some numbers (n), the first if several are equal."""
    at = 0
    for i in range(1, values.size):
        if values[i] > values[at]:
            at = i
    return at


@kernel()
def marked(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Give the indices of the true flags (n)."""
    out, count = np.empty(flags.size, dtype=np.int64), 0
    for i in range(flags.size):
        if flags[i]:
            out[count] = i
            count += 1
    return out[:count]
