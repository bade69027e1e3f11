"""The judge: the model of physics.md written out as directly as it can be.

Every pupil integral is a plain Gauss–Legendre sum at every pixel, with scipy's Bessel functions
and no table, interpolation or compiled kernel.  Slow, and short enough to be checked by eye.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv, jvp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Setup:
    """One golden set-up; lengths in nm."""

    wavelength_nm: float
    na: float
    n_immersion: float
    n_glass: float
    n_sample: float
    scheme: str
    attenuation: float
    emission: str
    permittivity: complex
    radius_nm: float
    oil_minus_design_nm: float
    axial: str = "stage"


def pupil(setup: Setup, nodes: int = 200) -> tuple[Array, Array]:
    """θ nodes and weights, split at the critical angle with θ = θ_c ∓ u²."""
    alpha = np.arcsin(setup.na / setup.n_immersion)
    x, w = np.polynomial.legendre.leggauss(nodes)
    if setup.na <= setup.n_sample:
        return alpha * (x + 1) / 2, alpha * w / 2
    critical = np.arcsin(setup.n_sample / setup.n_immersion)
    below, above = np.sqrt(critical), np.sqrt(alpha - critical)
    u1, u2 = below * (x + 1) / 2, above * (x + 1) / 2
    theta = np.concatenate([critical - u1**2, critical + u2**2])
    weight = np.concatenate([below * w / 2 * 2 * u1, above * w / 2 * 2 * u2])
    return theta, weight


def reference_amplitude(setup: Setup) -> float:
    ng, ns = setup.n_glass, setup.n_sample
    if setup.scheme == "iscat":
        return setup.attenuation * (ng - ns) / (ng + ns)
    forward = 2 * ns / (ns + ng) if setup.emission == "reciprocal" else 2 * ng / (ng + ns)
    return setup.attenuation * forward


def fields(
    setup: Setup, dx_nm: Array, dy_nm: Array, z_nm: float
) -> tuple[NDArray[np.complex128], ...]:
    """(E, ∂E/∂x_p, ∂E/∂y_p, ∂E/∂z_p), each (..., 2), at camera minus particle; per nm."""
    nm = 1e-9
    ni, ng, ns = setup.n_immersion, setup.n_glass, setup.n_sample
    k = 2 * np.pi / (setup.wavelength_nm * nm)
    xi = 1.0 if setup.scheme == "iscat" else -1.0
    theta, weight = pupil(setup)
    sin, cos = np.sin(theta), np.cos(theta)
    cos_s = np.sqrt(1 - (ni * sin / ns) ** 2 + 0j)
    cos_g = np.sqrt(1 - (ni * sin / ng) ** 2 + 0j)
    numerator = 2 * ng * cos_g if setup.emission == "reciprocal" else 2 * ns * cos_s
    t_p = numerator / (ng * cos_s + ns * cos_g)
    t_s = numerator / (ng * cos_g + ns * cos_s)
    eps = setup.permittivity
    volume = 4 / 3 * np.pi * (setup.radius_nm * nm) ** 3
    alpha_p = 3 * volume * (eps - ns**2) / (eps + 2 * ns**2)
    t = 2 * ng / (ng + ns)
    if setup.emission == "reciprocal":
        incident = t if setup.scheme == "iscat" else 1.0
        e1, front = (ns * k) ** 2 * alpha_p * incident / (4 * np.pi), -1j * k * ni / 2
    else:
        eta = np.arcsin(min(setup.na / ns, 1.0)) / np.pi
        e1, front = eta * k**2 / np.sqrt(6 * np.pi) * alpha_p * t, -1j * k / 2
    path = ns * z_nm * nm * (cos_s + xi) + ni * setup.oil_minus_design_nm * nm * (cos - 1)
    slope = ns * (cos_s + xi)
    if setup.axial == "refocus":
        slope = slope + ni * (1 - ni / ns) * (cos - 1)
    common = weight * sin * np.sqrt(cos) * np.exp(1j * k * path) * e1 * front
    w0, w2 = common * (t_s + t_p * cos_s), common * (t_s - t_p * cos_s)
    r = np.hypot(dx_nm, dy_nm) * nm
    phi = np.arctan2(dy_nm, dx_nm)
    a = ni * k * sin
    arg = r[..., None] * a
    i0, i2 = (jv(0, arg) * w0).sum(-1), (jv(2, arg) * w2).sum(-1)
    i0_r, i2_r = (jvp(0, arg) * a * w0).sum(-1), (jvp(2, arg) * a * w2).sum(-1)
    rate = 1j * k * slope
    i0_z, i2_z = (jv(0, arg) * w0 * rate).sum(-1), (jv(2, arg) * w2 * rate).sum(-1)
    c, s, c2, s2 = np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)
    safe = np.where(r > 0, r, 1.0)
    inv_r = np.where(r > 0, 1 / safe, 0.0)

    def vector(u: NDArray[np.complex128], v: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return np.stack([u, v], axis=-1)

    e = vector(i0 + i2 * c2, i2 * s2)
    along_r = vector(i0_r + i2_r * c2, i2_r * s2)
    along_phi = vector(-2 * i2 * s2, 2 * i2 * c2) * inv_r[..., None]
    d_camera_x = along_r * c[..., None] - along_phi * s[..., None]
    d_camera_y = along_r * s[..., None] + along_phi * c[..., None]
    e_z = vector(i0_z + i2_z * c2, i2_z * s2)
    return e, -d_camera_x * nm, -d_camera_y * nm, e_z * nm


@dataclass(frozen=True)
class Instrument:
    """What the pupil does to the light (microscope.md, section 2); angles in radians."""

    polarization: str = "linear"
    psi: float = 0.0
    analyzer: bool = False
    mask_na: float = 0.0
    reference_phase: float = 0.0
    aberrations_nm: tuple[tuple[int, float], ...] = ()


def zernike(j: int, rho: Array, phi: Array) -> Array:
    """Noll's Z_j, written out from his list of (n, m) and the radial sum."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    row = [m for m in range(-n, n + 1) if (n - m) % 2 == 0]
    row.sort(key=lambda m: (abs(m), 0))
    # within a pair ±m the cosine has the even index
    place = j - n * (n + 1) // 2 - 1
    m = abs(row[place])
    radial = sum(
        (-1) ** k * factorial(n - k) * rho ** (n - 2 * k)
        / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        for k in range((n - m) // 2 + 1)
    )  # fmt: skip
    if m == 0:
        return np.sqrt(n + 1) * radial * np.ones_like(phi)
    return np.sqrt(2 * (n + 1)) * radial * (np.cos(m * phi) if j % 2 == 0 else np.sin(m * phi))


def pupil_fields(
    setup: Setup,
    instrument: Instrument,
    dx_nm: Array,
    dy_nm: Array,
    z_nm: float,
    nodes: int = 90,
    azimuths: int = 240,
) -> NDArray[np.complex128]:
    """E at the camera by a plain sum over the pupil, (n, 2): components p*·E and the other."""
    nm = 1e-9
    ni, ng, ns = setup.n_immersion, setup.n_glass, setup.n_sample
    k = 2 * np.pi / (setup.wavelength_nm * nm)
    xi = 1.0 if setup.scheme == "iscat" else -1.0
    theta, weight = _panels(setup, instrument.mask_na, nodes)
    phi = np.arange(azimuths) * 2 * np.pi / azimuths
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    cos_s = np.sqrt(1 - (ni * sin / ns) ** 2 + 0j)
    cos_g = np.sqrt(1 - (ni * sin / ng) ** 2 + 0j)
    numerator = 2 * ng * cos_g if setup.emission == "reciprocal" else 2 * ns * cos_s
    t_p = numerator / (ng * cos_s + ns * cos_g)
    t_s = numerator / (ng * cos_g + ns * cos_s)
    if instrument.polarization == "circular":
        p = np.array([1, 1j]) / np.sqrt(2)
        other = p.conj()
    else:
        p = np.array([np.cos(instrument.psi), np.sin(instrument.psi)], dtype=complex)
        other = np.array([-np.sin(instrument.psi), np.cos(instrument.psi)], dtype=complex)
    along = np.array([np.cos(phi), np.sin(phi)])
    across = np.array([-np.sin(phi), np.cos(phi)])
    wave = t_p * cos_s * (p @ along) * along[:, None] + t_s * (p @ across) * across[:, None]
    eps = setup.permittivity
    alpha_p = 4 * np.pi * (setup.radius_nm * nm) ** 3 * (eps - ns**2) / (eps + 2 * ns**2)
    t = 2 * ng / (ng + ns)
    if setup.emission == "reciprocal":
        e1 = (ns * k) ** 2 * alpha_p * (t if setup.scheme == "iscat" else 1.0) / (4 * np.pi)
        gain = ni
    else:
        eta = np.arcsin(min(setup.na / ns, 1.0)) / np.pi
        e1, gain = eta * k**2 / np.sqrt(6 * np.pi) * alpha_p * t, 1.0
    path = ns * z_nm * (cos_s + xi) + ni * setup.oil_minus_design_nm * (cos - 1)
    rho = ni * sin / setup.na
    for j, size in instrument.aberrations_nm:
        path = path + size * (zernike(j, rho, phi) - zernike(j, np.zeros((1, 1)), phi[:1]))
    mask = np.where(ni * sin < instrument.mask_na, setup.attenuation, 1.0)
    ray = mask * sin * np.sqrt(cos) * np.exp(1j * k * nm * path) * weight[:, None]
    light = wave * ray * (2 * np.pi / azimuths)
    out = np.empty((len(dx_nm), 2), dtype=complex)
    for i, (x, y) in enumerate(zip(dx_nm, dy_nm, strict=True)):
        turn = np.exp(1j * k * nm * ni * sin * (x * along[0] + y * along[1]))
        field = np.einsum("cij,ij->c", light, turn)
        out[i] = p.conj() @ field, other.conj() @ field
    return -1j * k * e1 * gain / (2 * np.pi) * out


def _panels(setup: Setup, mask_na: float, nodes: int) -> tuple[Array, Array]:
    """θ nodes and weights, split at the mask's edge and at the critical angle."""
    ends = [0.0, np.arcsin(setup.na / setup.n_immersion)]
    if mask_na:
        ends.append(np.arcsin(mask_na / setup.n_immersion))
    critical = np.arcsin(min(setup.n_sample / setup.n_immersion, 1.0))
    if critical < ends[1]:
        ends.append(critical)
    ends.sort()
    x, w = np.polynomial.legendre.leggauss(nodes)
    theta, weight = [], []
    for a, b in pairwise(ends):
        # θ = θ_c ∓ u², whichever side of the critical angle the panel lies on
        side = 1.0 if a >= critical else -1.0
        u0, u1 = np.sqrt(abs(a - critical)), np.sqrt(abs(b - critical))
        u = (u0 + u1) / 2 + (u1 - u0) / 2 * x
        theta.append(critical + side * u**2)
        weight.append(abs(u1 - u0) / 2 * w * 2 * u)
    return np.concatenate(theta), np.concatenate(weight)
