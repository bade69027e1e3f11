"""Score, information and likelihood of a particle in a frame, in one pass over its square.

The results are those of `image_score` and `image_value` of `iscat_analysis._kernels.scoring` for a
POISSON image at level 1, without the parameters that a fit of a frame does not need: the level and,
for an image at one height, z.  All three share the expected counts and one division per pixel.

For n counts, of which b are expected without the particle and δ more with it, and w = δ/(2b + δ),
the log-likelihood n ln(1 + δ/b) − δ is computed as

    (n − b) 2 artanh w + w² (2 b w (1/3 + w²/5 + …) − 2 b − δ),

with artanh from its series.  No term is much larger than the result, so that single precision is
enough, which is twice as fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lens import STAMP, Lens
from iscat_analysis._kernels.noise import FLOOR, POISSON, SERIES, twice_artanh
from iscat_analysis._kernels.scoring import image_score, image_value

FloatArray = NDArray[np.float64]
AnyFloatArray = NDArray[np.floating[Any]]

LEAST = 1e-15
"""Smallest expected count, like `FLOOR` of `noise`; its square is above 0 in single precision."""


@kernel(_nrt=False)
def place_score(
    data: AnyFloatArray, here: AnyFloatArray, lens: Lens, score: FloatArray, fisher: FloatArray
) -> float:
    """Fill score and Fisher matrix of (x, y, z, a), and give the log-likelihood.

    Shapes: `data` (4, ny, nx), `here` (ny, 5, nx), `score, fisher` (5,).
    """
    if len(lens) != STAMP:
        image_score(np.int64(POISSON), data, 1.0, here, score, fisher)
        score[4] = 0.0
        for i in range(5):
            fisher[i, 4] = fisher[4, i] = 0.0
        value: float = image_value(np.int64(POISSON), data, 1.0, here)
        return value
    value, beyond = _flat_score(data, here, score, fisher)
    if beyond:
        value = _bright_value(data, here)
    return value


@kernel(_nrt=False)
def _bright_value(data: AnyFloatArray, here: AnyFloatArray) -> float:
    """Log-likelihood in double precision, by the logarithm itself where its series fails."""
    total = 0.0
    for i in range(data.shape[1]):
        c0, c1, c2, c3, s = data[0, i], data[1, i], data[2, i], data[3, i], here[i, 0]
        for j in range(s.size):
            base, change = max(float(c1[j]) + c3[j], FLOOR), float(c2[j]) * s[j]
            if abs(change) < SERIES * base:
                total += c0[j] * twice_artanh(change / (2.0 * base + change)) - change
            else:
                total += c0[j] * np.log(max(base + change, FLOOR) / base) - change
    return total


@kernel(fastmath=FAST, _nrt=False)
def _flat_score(
    data: AnyFloatArray, here: AnyFloatArray, score: FloatArray, fisher: FloatArray
) -> tuple[float, float]:
    """Do it without z; also count the pixels in which the series of the logarithm fails."""
    zero, one, two = data.dtype.type(0.0), data.dtype.type(1.0), data.dtype.type(2.0)
    least, series = data.dtype.type(LEAST), data.dtype.type(SERIES)
    t3, t5, t7 = one / data.dtype.type(3.0), one / data.dtype.type(5.0), one / data.dtype.type(7.0)
    t9, t11 = one / data.dtype.type(9.0), one / data.dtype.type(11.0)
    b0 = b1 = b3 = f00 = f01 = f03 = f11 = f13 = f33 = value = beyond = zero
    for i in range(data.shape[1]):
        c0, c1, c2, c3 = data[0, i], data[1, i], data[2, i], data[3, i]
        s, gx, gy, ga = here[i, 0], here[i, 1], here[i, 2], here[i, 4]
        for j in range(s.size):
            base, change = max(c1[j] + c3[j], least), c2[j] * s[j]
            rate, middle = max(base + change, least), two * base + change
            per = one / (rate * middle)  # one division for both quotients, since it is slow
            beyond += one if abs(change) >= series * base else zero
            w = change * (rate * per)
            w2 = w * w
            tail = w * (t3 + w2 * (t5 + w2 * (t7 + w2 * (t9 + w2 * t11))))
            value += two * (c0[j] - base) * (w + w2 * tail) + w2 * (two * base * tail - middle)
            bend = c2[j] * (middle * per)
            pull = (c0[j] - rate) * bend
            bend *= c2[j]
            b0 += pull * gx[j]
            b1 += pull * gy[j]
            b3 += pull * ga[j]
            hx, hy, ha = bend * gx[j], bend * gy[j], bend * ga[j]
            f00 += hx * gx[j]
            f01 += hx * gy[j]
            f03 += hx * ga[j]
            f11 += hy * gy[j]
            f13 += hy * ga[j]
            f33 += ha * ga[j]
    score[:] = 0.0
    fisher[:] = 0.0
    score[0], score[1], score[3] = b0, b1, b3
    fisher[0, 0], fisher[1, 1], fisher[3, 3] = f00, f11, f33
    fisher[0, 1] = fisher[1, 0] = f01
    fisher[0, 3] = fisher[3, 0] = f03
    fisher[1, 3] = fisher[3, 1] = f13
    return float(value), float(beyond)
