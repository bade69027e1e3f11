"""Small loops that many kernels share: indices, lines of numbers, combinations, dense systems.

Kernels do not check array bounds, and the integer part of a number that is too large, or of NaN, is
undefined.  Only `within` and `whole` convert numbers that depend on data to indices.

NumPy's versions of the operations on lines would be compiled again in each process, and for the
assignment of slices also the text of its error message: this takes a second or more.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis._kernels import FAST, BoolArray, FloatArray, IntArray, kernel


@kernel(_nrt=False)
def within(x: float, low: float, high: float) -> float:
    """Clip a number to a range; NaN becomes `low`."""
    if not x > low:
        return low
    if x > high:
        return high
    return x


@kernel(_nrt=False)
def whole(x: float, low: int, high: int) -> int:
    """Give the integer part of a number, clipped to a range; NaN becomes `low`."""
    return int(within(x, float(low), float(high)))


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
def marked(flags: BoolArray) -> IntArray:
    """Give the indices of the true flags (n)."""
    out, count = np.empty(flags.size, dtype=np.int64), 0
    for i in range(flags.size):
        if flags[i]:
            out[count] = i
            count += 1
    return out[:count]


@kernel(forceinline=True, fastmath=FAST)
def mix(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, w: FloatArray, k: int,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` with the combination of four arrays by w[k…k + 3], or add it where k > 0.

    With more arrays that might overlap, the compiler uses no vectors.
    """
    wa, wb, wc, wd = w[k], w[k + 1], w[k + 2], w[k + 3]
    if k == 0:
        for j in range(out.size):
            out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
    else:
        for j in range(out.size):
            out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@kernel(forceinline=True, fastmath=FAST)
def mix_both(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, w: FloatArray, k: int,
    out: FloatArray, other: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` and `other` with two combinations w (2, n) of the same arrays; see `mix`."""
    wa, wb, wc, wd = w[0, k], w[0, k + 1], w[0, k + 2], w[0, k + 3]
    va, vb, vc, vd = w[1, k], w[1, k + 1], w[1, k + 2], w[1, k + 3]
    if k == 0:
        for j in range(out.size):
            out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
            other[j] = va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]
    else:
        for j in range(out.size):
            out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
            other[j] += va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]


LEAST = 1e-13
"""Smallest pivot of a matrix with ones on its diagonal that counts as information."""


@kernel(forceinline=True, _nrt=False)
def factorise(
    matrix: FloatArray, index: IntArray, scale: FloatArray, damping: float, lower: FloatArray
) -> bool:
    """Fill `lower` (n, n) with Cholesky's factor of the parameters `index` (n); False if singular.

    `scale` (n) makes a diagonal near one, to which `damping` is added.
    """
    for i in range(index.size):
        for j in range(i + 1):
            total = matrix[index[i], index[j]] * scale[i] * scale[j]
            if i == j:
                total += damping
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if j < i:
                lower[i, j] = total / lower[j, j]
            elif total > LEAST:
                lower[i, i] = np.sqrt(total)
            else:
                return False
    return True


@kernel(forceinline=True, _nrt=False)
def solve(lower: FloatArray, values: FloatArray) -> None:
    """Solve L Lᵀ x = values (n) with a factor L (n, n) from `factorise`, in place."""
    n = values.size
    for i in range(n):
        total = values[i]
        for k in range(i):
            total -= lower[i, k] * values[k]
        values[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * values[k]
        values[i] = total / lower[i, i]
