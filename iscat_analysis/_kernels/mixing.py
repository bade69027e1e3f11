"""Linear combinations of four arrays, the innermost loop of interpolation.

With more arrays that might overlap, the compiler uses no vector registers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]


@kernel(forceinline=True, fastmath=FAST)
def mix(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, w: FloatArray, k: int,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` with the combination of four arrays by w[k…k + 3], or add it where k > 0."""
    wa, wb, wc, wd = w[k], w[k + 1], w[k + 2], w[k + 3]
    if k == 0:
        for j in range(out.size):
            out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
    else:
        for j in range(out.size):
            out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@kernel(forceinline=True, fastmath=FAST)
def mix_both(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, w: FloatArray, v: FloatArray,
    k: int, out: FloatArray, other: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` and `other` with two combinations of the same arrays, or add them; see `mix`."""
    wa, wb, wc, wd = w[k], w[k + 1], w[k + 2], w[k + 3]
    va, vb, vc, vd = v[k], v[k + 1], v[k + 2], v[k + 3]
    if k == 0:
        for j in range(out.size):
            out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
            other[j] = va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]
    else:
        for j in range(out.size):
            out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
            other[j] += va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]
