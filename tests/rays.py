"""Pictures of spheres and dipoles: sums over all rays of the pupil, each field a vector."""

from __future__ import annotations

import math
from typing import Any

import miepython
import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.typing import NDArray

from iscat_analysis.config import Optics
from iscat_analysis.optics.forward import PixelGrid

ComplexArray = NDArray[np.complex128]


def slow_amplitudes(x: float, m: complex, mu: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """S₁ and S₂ at complex angles, from derivatives of Legendre polynomials."""
    a, b = miepython.an_bn(np.conj(np.complex128(m)), x, 18)
    s1, s2 = np.zeros((2, *mu.shape), dtype=complex)
    for n in range(1, a.size + 1):
        p: Any = Legendre.basis(n).convert(kind=Polynomial).deriv()
        slope = mu * p(mu) - (1 - mu**2) * p.deriv()(mu)
        share = (2 * n + 1) / (n * (n + 1))
        s1 += share * (a[n - 1] * p(mu) + b[n - 1] * slope)
        s2 += share * (a[n - 1] * slope + b[n - 1] * p(mu))
    return s1, s2


def picture_of_rays(
    optics: Optics,
    index: complex,
    diameter_nm: float,
    height_nm: float,
    focused_nm: float,
    grid: PixelGrid,
    place_nm: tuple[float, float],
    tensor: ComplexArray | None = None,
    incident: tuple[complex, complex] = (1.0, 0.0),
) -> NDArray[np.float64]:
    """Contrast of a sphere at a height; the focus is that of a particle at another height.

    With a `tensor` of polarisability [nm³] it is that of a dipole in light of any polarisation.
    """
    o = optics
    k, ns, n = 2 * math.pi / o.wavelength_nm, o.n_sample, o.n_immersion
    x = ns * k * diameter_nm / 2
    down = o.scheme == "iscat"  # the light comes from below and is scattered back
    grazing = math.asin(min(ns / n, o.na / n))
    rim, t = math.asin(o.na / n), np.polynomial.legendre.leggauss(120)
    nodes, weights = [], []
    for low, high in ((0.0, grazing), (grazing, rim)):
        u = math.sqrt(high - low) * (t[0] + 1) / 2  # a square root begins where light grazes
        inner = low == 0.0
        nodes.append(high - u**2 if inner else low + u**2)
        weights.append(math.sqrt(high - low) * t[1] * u)
    theta, w = np.concatenate(nodes), np.concatenate(weights)
    phi = np.arange(96) * (2 * math.pi / 96)
    cos_s = np.sqrt(1 - (n * np.sin(theta) / ns) ** 2 + 0j)
    sin_s, cos_g = n * np.sin(theta) / ns, np.cos(theta)
    s1, s2 = slow_amplitudes(x, index / ns, -cos_s if down else cos_s)
    c, s = np.cos(phi), np.sin(phi)
    ahead = 1.0 if down else -1.0  # the incident ray along z
    zeros = np.zeros_like(c)
    across = np.array([-s, c, zeros])  # unit vector across the plane of scattering
    incident_along = np.array([c, s, zeros])
    # vectors of the scattered ray (angles, 3, azimuths): e_along × ray stays as for the incident
    ray = np.stack([sin_s[:, None] * c, sin_s[:, None] * s, -cos_s[:, None] * np.ones_like(c)], 1)
    turn = ahead * (-cos_s)  # cosine of the angle between the two rays
    along = (turn[:, None, None] * incident_along - sin_s[:, None, None]
             * np.array([zeros, zeros, ahead + zeros]))  # fmt: skip
    assert np.abs(np.einsum("icj,icj->ij", along, ray)).max() < 1e-12
    far = 1j / (ns * k) * (s2[:, None, None] * along * c - s1[:, None, None] * across * s)
    if tensor is not None:
        dipole = tensor[:, :2] @ np.array(incident)
        far = (ns * k) ** 2 / (4 * math.pi) * dipole[None, :, None] * np.ones_like(far)
    # the coverslip: p along the vector that lies in the plane of incidence, s across it
    p_vector = np.stack([cos_s[:, None] * c, cos_s[:, None] * s, sin_s[:, None] + 0 * c], 1)
    p = np.einsum("icj,icj->ij", far, p_vector)
    q = np.einsum("icj,cj->ij", far, across)
    front = 2 * n * cos_g
    p = p * (front / (n * cos_s + ns * cos_g))[:, None]
    q = q * (front / (n * cos_g + ns * cos_s))[:, None]
    ex, ey = p * c - q * s, p * s + q * c
    oil = focused_nm - o.focus_nm - focused_nm * n / ns
    path = ns * height_nm * (cos_s + (1 if down else -1)) + n * oil * (np.cos(theta) - 1)
    weight = np.sin(theta) * np.sqrt(np.cos(theta)) * w * np.exp(1j * k * path)
    r = (n - ns) / (n + ns)
    come, reference = (2 * n / (n + ns), r) if down else (1.0, 2 * ns / (ns + n))
    reference *= o.attenuation
    factor = -1j * k * n / (2 * math.pi) * come * (2 * math.pi / phi.size)
    turns = k * n * np.sin(theta)[:, None]
    along_x = np.exp(1j * np.multiply.outer(grid.x_nm - place_nm[0], turns * c))
    along_y = np.exp(1j * np.multiply.outer(grid.y_nm - place_nm[1], turns * s))
    ex, ey = (
        factor / reference * np.einsum("yr,xr->yx", (along_y * (weight[:, None] * e)).reshape(
            grid.y_nm.size, -1), along_x.reshape(grid.x_nm.size, -1), optimize=True)
        for e in (ex, ey)
    )  # fmt: skip
    return np.asarray(np.abs(incident[0] + ex) ** 2 + np.abs(incident[1] + ey) ** 2 - 1)
