"""Analytic derivatives of the signal with respect to the parameters of the microscope.

Every parameter of the optics changes the light of each ray in the pupil.  The derivative of the
field is the integral of this change: a factor inside the pupil, and the light on an edge that moves
(aperture, mask).  Each derivative is tabulated on the lattice of the field, once for each height,
and combined with the field at the pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Pixels
from iscat_analysis._kernels.lattice_rows import lattice_values
from iscat_analysis._kernels.lens import LatticeLens
from iscat_analysis._kernels.zernike import zernike
from iscat_analysis.config import MEASURABLE, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.aperture import Aperture, aperture_on, harmonics, weight_on
from iscat_analysis.optics.coherence import (
    Ray,
    band_of,
    cone_of,
    factor_at,
    over_spectrum,
    spectrum,
)
from iscat_analysis.optics.rods import ANGLES, Rod
from iscat_analysis.optics.waves import LatticeField

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEGLIGIBLE_CHANGE = 1e-6
"""Share of the change of light below which its azimuthal harmonics are left out."""

STEP_RATIO = 2
"""Radial step of these tables over that of the field: their error is one part in 10⁶."""


def check_names(opening: Aperture, names: Sequence[str]) -> None:
    """Refuse parameters that have no derivative."""
    optics, known = opening.optics, MEASURABLE
    if isinstance(opening.scatterer, Rod):
        known = (*(name for name in MEASURABLE if name != "polarization_deg"), *ANGLES)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"names = {unknown}: choose among {', '.join(known)}")
    if optics.convention == "dong2021":
        raise ConfigError(
            'optics.convention = "dong2021" has no derivatives: use convention = "exact"'
        )
    if "polarization_deg" in names and optics.polarization != "linear":
        raise ConfigError(
            f'polarization_deg: optics.polarization = "{optics.polarization}" has no direction'
        )


def sensitivity_lattices(
    opening: Aperture,
    factor: complex,
    oil_nm: float,
    z_nm: float,
    names: tuple[str, ...],
    *,
    rho: float,
    reach_nm: float,
) -> tuple[LatticeLens, FloatArray]:
    """Lattices of the field and of its derivatives at one height.

    Shapes: `stack` (2 + len(names).
    """
    optics, phi = opening.optics, opening.azimuths()
    light = over_spectrum(
        [
            _changes(opening, each, factor_at(factor, each, optics), oil_nm, z_nm, names, rho, phi)
            for each in spectrum(optics)
        ]
    )
    waves = light.waves.reshape(-1, *light.waves.shape[2:])
    series = harmonics(waves, np.abs(light.weight), NEGLIGIBLE_CHANGE) * light.weight
    count = light.waves.shape[1]
    lattice = LatticeField(
        series[:count], light.axial, light.transverse, band_of(optics), reach_nm, cone_of(optics)
    )
    stack = lattice.lattices(series, light.transverse, STEP_RATIO)
    whole = stack.reshape(2 + len(names), lattice.count, *stack.shape[1:])
    return lattice.lens(rho), whole


def _changes(
    opening: Aperture,
    optics: Optics,
    factor: complex,
    oil_nm: float,
    z_nm: float,
    names: tuple[str, ...],
    rho: float,
    phi: FloatArray,
) -> Ray:
    """Light of one wavelength in the pupil, how it rises with the height, and its derivatives."""
    rim, edge = (math.asin(na / optics.n_immersion) for na in (optics.na, optics.mask_na))
    # two more directions, with zero weight except where an edge moves
    theta = np.concatenate([opening.pupil.theta, [rim, edge]])
    weights = np.concatenate([opening.pupil.weight, [1.0, 1.0]])
    whole = aperture_on(optics, theta, weights, opening.scatterer)
    weight, axial = weight_on(whole, factor, oil_nm)
    weight = weight * np.exp(1j * axial * z_nm)
    inner = np.ones(theta.size)
    inner[-2:] = 0.0
    at_rim, at_edge = np.zeros(theta.size), np.zeros(theta.size)
    at_rim[-2] = 1 / (optics.n_immersion * math.cos(rim))
    at_edge[-1] = 1 / (optics.n_immersion * math.cos(edge)) if optics.mask_na else 0.0
    k = whole.wavenumber
    seen, clear = whole.seen(phi), whole.seen(phi, masked=False)
    behind = inner * (optics.n_immersion * np.sin(theta) < optics.mask_na)
    field = seen * inner[:, None]

    def change(name: str) -> Any:
        if name == "focus_nm":
            return field * (-1j * whole.pupil.oil[:, None])
        if name == "na":
            stretch = -1j * k / optics.na * whole.rho[:, None] * whole.path_slope_nm(phi)
            return field * (stretch + _log_efficiency_slope(optics)) + seen * at_rim[:, None]
        if name == "reference_phase_deg":
            return field * (-1j * math.pi / 180 * rho)
        if name == "mask_na":
            return clear * ((optics.attenuation - 1) * at_edge[:, None])
        if name == "attenuation":
            return clear * behind[:, None] - field * (rho / (optics.attenuation or 1.0))
        if name == "polarization_deg" or name in ANGLES:
            return whole.seen(phi, along=name) * inner[:, None]
        path: FloatArray = zernike(int(name[1:]), whole.rho[:, None], phi)[0]
        return field * (1j * k * path)

    lift = field * (1j * axial[:, None])
    waves = np.stack([field, lift, *(change(name) for name in names)])
    return Ray(waves, weight, axial, whole.pupil.transverse)


def _log_efficiency_slope(optics: Optics) -> float:
    """∂ ln η/∂NA: D21's scattered amplitude grows with the collected angle (physics.md, 2)."""
    if optics.emission == "reciprocal" or optics.na >= optics.n_sample:
        return 0.0
    sine = optics.na / optics.n_sample
    return 1 / (optics.n_sample * math.sqrt(1 - sine**2) * math.asin(sine))


def signal_derivatives(
    stack: FloatArray, lens: LatticeLens, pixels: Pixels, x_nm: float, y_nm: float, amplitude: float
) -> FloatArray:
    """Combine lattices to derivatives of the signal.

    Shapes: `stack` (2 + n, components, 2, nodes, nodes), result (n, ny, nx).
    """
    count, components = stack.shape[:2]
    out = np.empty((count, pixels.y.size, pixels.x.size))
    flat = stack.reshape(count * components * 2, *stack.shape[3:])
    lattice_values(flat, lens, pixels, x_nm, y_nm, amplitude, components, out)
    return out[2:]
