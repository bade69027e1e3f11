"""What the collected light knows: quantum Fisher information (physics.md, section 5).

The scattered light is a product of coherent states, one for each direction (θ, φ) of the pupil.
Photons in dθ dφ are |A|² sinθ, so the amplitude of one collected photon is ε = A √sinθ / √𝒜, and

    Q_ij = 4 ∫ ∂_iε*·∂_jε dθ dφ        over (x, y, z, ln m).

Re Q is the quantum Fisher matrix.  Im Q is the mean commutator of the two optimal measurements:
where it is not zero, no single measurement is optimal for both parameters (weak commutativity).

Moving the particle multiplies ε by −i k n_i sinθ (cosφ, sinφ) and by iκ, κ = k n_s (cosθ_s + ξ);
beyond the critical angle κ is complex and Im κ is the evanescent decay, which ties z to the mass.

A sphere that grows also changes its pattern: then ∂ε/∂ln m is a difference between two masses.

Aberrations multiply ε by the same phase for every position of the particle and change nothing.  A
mask and an analyser take light away: what they let through is bounded like what was collected.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.scatterers import Rod
from iscat_analysis.optics.sized import MASS_STEP, SizedModel
from iscat_analysis.optics.waves import Aperture, aperture
from iscat_analysis.records import ComplexArray, FloatArray

Measure = Literal["exact", "dong2021"]
Light = Literal["collected", "transmitted"]
LIGHTS: tuple[Light, Light] = ("transmitted", "collected")

NAMES = ("x_nm", "y_nm", "z_nm", "mass_rel")
"""Parameters of the quantum matrix: position and relative mass."""

NODES = 96
"""Gauss–Legendre nodes on each side of the critical angle; the integrals converge below 1e-12."""

AZIMUTHS = 16
"""Equally spaced azimuths; |A|² times a squared slope is a trigonometric polynomial of order 8."""


def quantum_information(
    model: ForwardModel,
    z_nm: float,
    *,
    measure: Measure = "exact",
    light: Light = "collected",
    amplitude: float | None = None,
) -> ComplexArray:
    """Quantum Fisher information of one scattered photon, for a sphere of some amplitude.

    Shapes: result (4, 4).
    """
    if model.is_measured:
        raise ConfigError(
            'optics.psf = "measured" has no quantum bound, because a picture does not say what '
            'light made it: use optics.psf = "model", or the CRB in the table of the fits'
        )
    centre = model.centre_nm(z_nm, model.nominal_amplitude if amplitude is None else amplitude)
    opening, wave, solid = _light(model, centre, measure, light, amplitude)
    pupil = opening.pupil
    kappa = pupil.axial
    if measure == "dong2021" and not model.optics.kind.reflected:
        kappa = kappa / model.optics.n_sample
    weight = solid[:, None] / (np.abs(wave) ** 2 * solid[:, None]).sum()
    phi = _azimuths()
    slopes = (
        -1j * pupil.transverse[:, None] * np.cos(phi) * wave,
        -1j * pupil.transverse[:, None] * np.sin(phi) * wave,
        1j * kappa[:, None] * wave,
        _growth(model, amplitude, light, wave)
        + 1j * kappa[:, None] * wave * (centre - z_nm) / 3,  # a seated sphere rises as it grows
    )
    rows = (np.array(slopes) * np.sqrt(weight)).reshape(4, -1)
    half = 2 * rows.conj() @ rows.T
    out = np.asarray(half + half.conj().T)
    if not isinstance(opening.scatterer, Rod):
        # the light is symmetric under reflection through the centre: exact zeros, not rounding
        out[:2, 2:] = out[2:, :2] = 0.0
    return out


def transmitted_over_collected(model: ForwardModel, z_nm: float) -> float:
    """Share of the collected light that mask and analyser let through."""
    passed, every = (_photons(model, z_nm, light)[1] for light in LIGHTS)
    return float(passed.sum() / every.sum())


def z_nm_phase_free(model: ForwardModel, z_nm: float) -> float:
    """Quantum bound on z of one collected photon when the phase of the light is unknown.

    Dark field has no reference, so that the global phase is a nuisance: K_zz becomes
    4 (⟨|κ|²⟩ − ⟨Re κ⟩²), the variance of the axial wavenumber where nothing is evanescent.
    """
    opening, photons = _photons(model, z_nm, "collected")
    density, kappa = photons.sum(1) / photons.sum(), opening.pupil.axial
    # centred before squaring: the mean is large beside the spread
    centre = np.sum(kappa.real * density)
    spread = float(np.sum(((kappa.real - centre) ** 2 + kappa.imag**2) * density))
    return 1 / math.sqrt(4 * spread)


def quantum_bounds(information: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Single and joint quantum bounds.

    Shapes: `information` (4, 4), `single, joint` (4,).
    """
    real = information.real
    scale = 1 / np.sqrt(np.diag(real))
    inverse = np.linalg.inv(real * np.outer(scale, scale))
    return scale, scale * np.sqrt(np.diag(inverse))


def incompatible_pairs(information: ComplexArray) -> dict[tuple[str, str], float]:
    """Pairs of parameters that no single measurement can saturate.

    Shapes: `information` (4, 4).
    """
    scale = 1 / np.sqrt(np.diag(information.real))
    curl = np.abs(information.imag) * np.outer(scale, scale)
    return {
        (NAMES[i], NAMES[j]): float(curl[i, j])
        for i in range(4)
        for j in range(i + 1, 4)
        # |Im Q_ij| over √(Q_ii Q_jj) below which a pair counts as commuting: rounding
        if curl[i, j] > 1e-9
    }


def _azimuths() -> FloatArray:
    return np.arange(AZIMUTHS, dtype=np.float64) * (2 * math.pi / AZIMUTHS)


def _photons(model: ForwardModel, z_nm: float, light: Light) -> tuple[Aperture, FloatArray]:
    """Pupil and the photons in each of its directions, shape (angles, AZIMUTHS)."""
    opening, wave, solid = _light(model, z_nm, "exact", light, None)
    density: FloatArray = (np.abs(wave) ** 2).sum(0) * solid[:, None]
    return opening, density


def _light(
    model: ForwardModel, z_nm: float, measure: Measure, light: Light, amplitude: float | None
) -> tuple[Aperture, ComplexArray, FloatArray]:
    """Pupil, its wave (components, angles, AZIMUTHS), and the weight of each angle."""
    if not z_nm >= 0:
        raise ConfigError(
            f"z_nm = {z_nm:g}: the particle would lie inside the coverslip; give a height >= 0"
        )
    opening = _opening(model, amplitude)
    pupil = opening.pupil
    solid = pupil.weight * np.sin(pupil.theta)
    if measure == "dong2021":
        solid = solid * np.sin(pupil.theta) * np.cos(pupil.theta)
    solid = solid * np.exp(-2 * pupil.axial.imag * z_nm)
    return opening, _seen(opening, light), solid


def _opening(model: ForwardModel, amplitude: float | None) -> Aperture:
    """Pupil with the light of a particle; the nominal one without an amplitude."""
    there = model.at(model.nominal_amplitude if amplitude is None else amplitude)
    return aperture(model.optics, NODES, NODES, there.aperture.scatterer)


def _seen(opening: Aperture, light: Light) -> ComplexArray:
    """Wave in the directions of the pupil, all of it or what mask and analyser let through."""
    wave = opening.polarised(_azimuths())
    if light == "transmitted":
        wave = wave[: 1 if opening.optics.analyzer else 2] * opening.transmission[:, None]
    return wave


def _growth(
    model: ForwardModel, amplitude: float | None, light: Light, wave: ComplexArray
) -> ComplexArray:
    """Change of the wave with the logarithm of the mass: itself, unless the pattern changes too."""
    if not isinstance(model, SizedModel):
        return wave
    mass = model.nominal_amplitude if amplitude is None else amplitude
    below, above = (
        (1 + step) * _seen(_opening(model, mass * (1 + step)), light)
        for step in (-MASS_STEP, MASS_STEP)
    )
    return np.asarray((above - below) / (2 * MASS_STEP))
