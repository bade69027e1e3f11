"""Quadrature over the pupil, Fresnel coefficients (D21, section II; physics.md, 8) and aberrations.

Lengths are nm, wavenumbers rad/nm.  Angles θ are those in the immersion oil.  Zernike polynomials
have Noll's order and normalisation (J. Opt. Soc. Am. 66, 207, 1976): root mean square 1 over the
unit disc, the cosine term of each pair at even j.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from iscat_analysis._kernels import ComplexArray, FloatArray

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


@dataclass(frozen=True)
class Pupil:
    """The scattered wave on a quadrature of polar angles."""

    theta: FloatArray
    weight: FloatArray
    transverse: FloatArray
    t_p_cos: ComplexArray
    t_p_sin: ComplexArray
    t_s: ComplexArray
    axial: ComplexArray
    oil: FloatArray
    apodization: FloatArray


def gauss_legendre(
    alpha: float, critical: float | None, nodes: int, nodes_above: int, edge: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights on [0, α], spectrally exact across the critical angle and a mask's edge.

    cosθ_s has a square-root branch at θ_c; θ = θ_c ∓ u² on either side makes the integrand
    analytic in u.
    """
    ends = {0.0, alpha} | {b for b in (critical, edge) if b is not None and 0 < b < alpha}
    bounds = sorted(ends)
    panels = []
    for low, high in pairwise(bounds):
        above = critical is not None and low >= critical
        x, w = _unit_gauss_legendre(nodes_above if above else nodes)
        if critical is None:
            panels.append((low + (high - low) * x, (high - low) * w))
            continue
        sign = 1.0 if above else -1.0
        first, last = math.sqrt(abs(low - critical)), math.sqrt(abs(high - critical))
        u = first + (last - first) * x
        panels.append((critical + sign * u**2, 2 * abs(last - first) * u * w))
    return (
        np.concatenate([theta for theta, _ in panels]),
        np.concatenate([weight for _, weight in panels]),
    )


@cache
def _unit_gauss_legendre(nodes: int) -> tuple[FloatArray, FloatArray]:
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = (x + 1) / 2, w / 2
    x.flags.writeable = w.flags.writeable = False
    return x, w


def rectangle(alpha: float, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Make the rule of D21's program: both ends included, step α/n (physics.md, section 7).

    Shapes: `theta, weight` (nodes,).
    """
    return np.linspace(0.0, alpha, nodes), np.full(nodes, alpha / nodes)


def make_pupil(
    theta: FloatArray,
    weight: FloatArray,
    *,
    wavenumber: float,
    n_immersion: float,
    n_glass: float,
    n_sample: float,
    direction: float,
    reciprocal: bool,
) -> Pupil:
    """Evaluate the wave at given angles.

    Shapes: `theta, weight` (n,).
    """
    sin, cos = np.sin(theta), np.cos(theta)
    cos_s = np.sqrt(1 - (n_immersion * sin / n_sample) ** 2 + 0j)
    cos_g = np.sqrt(1 - (n_immersion * sin / n_glass) ** 2 + 0j)
    numerator = 2 * n_glass * cos_g if reciprocal else 2 * n_sample * cos_s
    t_p = numerator / (n_glass * cos_s + n_sample * cos_g)
    t_s = numerator / (n_glass * cos_g + n_sample * cos_s)
    return Pupil(
        theta=theta,
        weight=weight,
        transverse=n_immersion * wavenumber * sin,
        t_p_cos=t_p * cos_s,
        t_p_sin=t_p * (n_immersion * sin / n_sample),
        t_s=t_s,
        axial=wavenumber * n_sample * (cos_s + direction),
        oil=wavenumber * n_immersion * (cos - 1),
        apodization=sin * np.sqrt(cos),
    )
