"""What the collected light knows: quantum Fisher information (physics.md, section 5).

The scattered light is a product of coherent states, one for each direction (θ, φ) of the pupil.
Photons in dθ dφ are |A|² sinθ, so the amplitude of one collected photon is ε = A √sinθ / √𝒜, and

    Q_ij = 4 ∫ ∂_iε*·∂_jε dθ dφ        over (x, y, z, ln m).

Re Q is the quantum Fisher matrix.  Im Q is the mean commutator of the two optimal measurements:
where it is not zero, no single measurement is optimal for both parameters (weak commutativity).

Moving the particle multiplies ε by −i k n_i sinθ (cosφ, sinφ) and by iκ, κ = k n_s (cosθ_s + ξ);
beyond the critical angle κ is complex and Im κ is the evanescent decay, which ties z to the mass.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.pupil import Pupil, gauss_legendre, make_pupil
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import NEAR_CRITICAL, ForwardModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Measure = Literal["exact", "dong2021"]

NAMES = ("x_nm", "y_nm", "z_nm", "mass_rel")
"""Parameters of the quantum matrix: position and relative mass."""

NODES = 96
"""Gauss–Legendre nodes on each side of the critical angle; the integrals converge below 1e-12."""

COMMUTES = 1e-9
"""|Im Q_ij| over √(Q_ii Q_jj) below which a pair counts as commuting: rounding."""


def quantum_information(
    model: ForwardModel, z_nm: float, *, measure: Measure = "exact"
) -> ComplexArray:
    """Quantum Fisher information of one collected scattered photon.

    Parameters
    ----------
    model : ForwardModel
        Optics; its quadrature and `axial` do not matter, since moving light refocuses nothing.
    z_nm : float
        Height of the particle [nm]; only evanescent waves depend on it.
    measure : {"exact", "dong2021"}
        Weight of the directions: |A|² sinθ, or D21's |sinθ √cosθ A|² with n_s dropped from the
        axial phase where the light passes the particle first, as in D21's program
        (physics.md, section 7, points 3 and 4).

    Returns
    -------
    complex ndarray, shape (4, 4)
        Q over (x [nm], y [nm], z [nm], ln m), Hermitian.  Its real part is the quantum Fisher
        matrix, its imaginary part the mean commutator.

    Raises
    ------
    ConfigError
        The height is negative.
    """
    light = _collected(model, z_nm, measure)
    pupil, ns = light.pupil, model.optics.n_sample
    kappa = pupil.axial
    if measure == "dong2021" and model.optics.scheme != "iscat":
        kappa = kappa / ns
    q2 = pupil.transverse**2
    along = light.mean(q2, light.p * 0.75 + light.s * 0.25)
    across = light.mean(q2, light.p * 0.25 + light.s * 0.75)
    both = light.p + light.s
    psi = math.radians(model.optics.polarization_deg)
    c, s = math.cos(psi), math.sin(psi)
    out = np.zeros((4, 4), dtype=np.complex128)
    out[0, 0] = c**2 * along + s**2 * across
    out[1, 1] = s**2 * along + c**2 * across
    out[0, 1] = out[1, 0] = c * s * (along - across)
    out[2, 2] = light.mean(np.abs(kappa) ** 2, both)
    out[2, 3] = light.mean(-1j * kappa.conj(), both)
    out[3, 2] = out[2, 3].conjugate()
    out[3, 3] = 1.0
    return 4 * out


def z_nm_phase_free(model: ForwardModel, z_nm: float) -> float:
    """Quantum bound on z of one collected photon when the phase of the light is unknown.

    Dark field has no reference, so that the global phase is a nuisance: K_zz becomes
    4 (⟨|κ|²⟩ − ⟨Re κ⟩²), the variance of the axial wavenumber where nothing is evanescent.

    Parameters
    ----------
    model : ForwardModel
        Optics.
    z_nm : float
        Height of the particle [nm].

    Returns
    -------
    float
        Standard deviation for one collected photon [nm].
    """
    light = _collected(model, z_nm, "exact")
    both, kappa = light.p + light.s, light.pupil.axial
    # centred before squaring: the mean is large beside the spread
    centre = light.mean(kappa.real, both).real
    spread = light.mean((kappa.real - centre) ** 2 + kappa.imag**2, both).real
    return 1 / math.sqrt(4 * spread)


def quantum_bounds(information: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Single and joint quantum bounds.

    Parameters
    ----------
    information : complex ndarray, shape (4, 4)
        From `quantum_information`, times the number of photons where wanted.

    Returns
    -------
    single, joint : ndarray, shape (4,)
        1/√K_jj and √[(K⁻¹)_jj] over (x, y, z [nm], relative mass).
    """
    real = information.real
    scale = 1 / np.sqrt(np.diag(real))
    inverse = np.linalg.inv(real * np.outer(scale, scale))
    return scale, scale * np.sqrt(np.diag(inverse))


def incompatible_pairs(information: ComplexArray) -> dict[tuple[str, str], float]:
    """Pairs of parameters that no single measurement can saturate.

    Parameters
    ----------
    information : complex ndarray, shape (4, 4)
        From `quantum_information`.

    Returns
    -------
    dict
        (name, name) → |Im Q_ij|/√(Q_ii Q_jj), between 0 and 1: 1 for a conjugate pair such as the
        phase and amplitude of a wave, whose bounds cost √2 each to approach together.
    """
    scale = 1 / np.sqrt(np.diag(information.real))
    curl = np.abs(information.imag) * np.outer(scale, scale)
    return {
        (NAMES[i], NAMES[j]): float(curl[i, j])
        for i in range(4)
        for j in range(i + 1, 4)
        if curl[i, j] > COMMUTES
    }


class _Light:
    """The collected light: p- and s-polarised photons at each angle, normalised to one in all."""

    def __init__(self, pupil: Pupil, density: FloatArray) -> None:
        self.pupil = pupil
        p = np.abs(pupil.t_p_cos) ** 2 * density
        s = np.abs(pupil.t_s) ** 2 * density
        total = float(np.sum(p + s))
        self.p, self.s = p / total, s / total

    def mean(self, values: NDArray[np.number], weight: FloatArray) -> complex:
        return complex(np.sum(values * weight))


def _collected(model: ForwardModel, z_nm: float, measure: Measure) -> _Light:
    if not z_nm >= 0:
        raise ConfigError(
            f"z_nm = {z_nm:g}: the particle would lie inside the coverslip; give a height >= 0"
        )
    optics = model.optics
    alpha = math.asin(optics.na / optics.n_immersion)
    critical = None
    if NEAR_CRITICAL * optics.n_sample < optics.na and optics.n_sample < optics.n_immersion:
        critical = math.asin(optics.n_sample / optics.n_immersion)
    theta, weight = gauss_legendre(alpha, critical, NODES, NODES)
    pupil = make_pupil(
        theta,
        weight,
        wavenumber=model.wavenumber,
        n_immersion=optics.n_immersion,
        n_glass=optics.n_glass,
        n_sample=optics.n_sample,
        direction=1.0 if optics.scheme == "iscat" else -1.0,
        reciprocal=optics.emission == "reciprocal",
    )
    solid = np.sin(theta)
    if measure == "dong2021":
        solid = solid**2 * np.cos(theta)
    return _Light(pupil, weight * solid * np.exp(-2 * pupil.axial.imag * z_nm))
