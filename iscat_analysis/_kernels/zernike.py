"""Zernike polynomials in Noll's order and normalisation.

R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976): root mean square 1 over the unit disc, the cosine term
of each pair at even j.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FIRST, LAST = 5, 37
"""Noll's indices that can be set: piston and tilts have no effect, defocus is the focus."""


def orders(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order |m| of Noll's index j ≥ 1."""
    n = int((math.sqrt(8 * j - 7) - 1) / 2)
    k = j - n * (n + 1) // 2
    return n, 2 * (k // 2) if n % 2 == 0 else 2 * ((k - 1) // 2) + 1


def zernike(j: int, rho: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Z_j(ρ, φ) − Z_j(0) and its derivative along ρ."""
    n, m = orders(j)
    radial, slope = np.zeros_like(rho), np.zeros_like(rho)
    for k in range((n - m) // 2 + 1):
        power = n - 2 * k
        factor = (-1) ** k * math.factorial(n - k) / (
            math.factorial(k)
            * math.factorial((n + m) // 2 - k)
            * math.factorial((n - m) // 2 - k)
        )  # fmt: skip
        if power:
            radial = radial + factor * rho**power
            slope = slope + factor * power * rho ** (power - 1)
    norm = math.sqrt(n + 1) * (math.sqrt(2) if m else 1.0)
    turn = norm * (np.cos(m * phi) if j % 2 == 0 or m == 0 else np.sin(m * phi))
    return radial * turn, slope * turn
