"""Images of spheres, whose field is not proportional to their mass.

The amplitude a of a sphere is its mass, as that of a dipole on the scale of the model.  Its pattern
in the pupil changes with a, so that each mass has a model of its own, `SizedModel.at`: this one is
linear, and its pictures at the amplitude a are those of the sphere.  Derivatives along x, y and z
are analytic.  Those along a are differences between masses that differ by `MASS_STEP` of the mass;
their error is 1e-6 of the derivative, and 1e-5 of the second one.

`SeatedModel` is of spheres that stand on the coverslip: one number gives their size and their
height.  The image of a small sphere shows its brightness and, by its phase, the height of its
centre.  A sphere that touches the coverslip has its centre one radius above it, so that a known
refractive index leaves the diameter as the only parameter beside the place, as the mass is of a
dipole.  Which of several materials it is follows from the image: each brightness goes with one
height.

The parameter z of these models is the gap between the sphere and the coverslip.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from iscat_analysis._kernels.hessian import PAIRS
from iscat_analysis.config import Optics, Particle, SphereKind
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import kept
from iscat_analysis.optics.model import ForwardModel, MassScale, Values
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.optics.scatterers import SMALLEST_NM, Sphere, has_shells, material
from iscat_analysis.optics.waves import aperture_on, with_light_of
from iscat_analysis.records import ComplexArray, FloatArray
from iscat_analysis.units import sphere_mass_kda

MASS_STEP = 5e-4
"""Relative step of the mass in differences, a 6000th of the diameter."""

_SECOND = {pair: 5 + k for k, pair in enumerate(PAIRS)}  # rows of second derivatives


@dataclass(frozen=True)
class SizedModel(ForwardModel):
    """Expected images of a sphere in one microscope; its tables are of the nominal mass."""

    sphere: Sphere = field(kw_only=True)
    """The nominal sphere."""

    mass_range_kda: tuple[float, float] = field(kw_only=True)
    """Masses among which a fit searches."""

    dimming: ComplexArray | float = field(default=1.0, kw_only=True)
    """What every plane wave was multiplied by: spheres of all masses move alike."""

    @property
    def is_sized(self) -> bool:
        """Whether particles are spheres, whose picture changes its shape with their size."""
        return True

    @kept(48)
    def at(self, amplitude: float) -> ForwardModel:
        """Give the model whose pictures grow in proportion to the amplitude near this one."""
        return self._linear(self.sphere.of_mass(amplitude))

    @kept(64)
    def scanned(self, amplitude: float) -> ForwardModel:
        """Give `at`, kept with its table along z apart from the masses that a fit passes by."""
        return self._linear(self.sphere.of_mass(amplitude))

    @kept(6)
    def of_index(self, index: float) -> SizedModel:
        """Give the model of spheres, or of cores in the same shell, of another index."""
        return replace(self, sphere=replace(self.sphere, index=complex(index)))

    def _linear(self, sphere: Sphere) -> ForwardModel:
        """Make the model of the pattern of one sphere."""
        pupil = self.aperture.pupil
        opening = aperture_on(self.optics, pupil.theta, pupil.weight, sphere)
        wave = with_light_of(self.wave, opening, self.factor, self.oil_nm)
        linear = ForwardModel(**{**parts_of(self), "aperture": opening, "wave": wave})
        return linear.dimmed(np.asarray(self.dimming, dtype=complex))

    def dimmed(self, factor: ComplexArray | float) -> Self:
        """As `ForwardModel.dimmed`."""
        return replace(super().dimmed(factor), dimming=self.dimming * factor)

    def step_of(self, amplitude: float) -> float:
        """Give the step of the mass with which differences are taken [kDa]."""
        return MASS_STEP * self.sphere.of_mass(amplitude).mass_kda

    def signal(
        self, grid: PixelGrid, values: Values, names: Sequence[str] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """As `ForwardModel.signal`."""
        x, y, z, amplitude = map(float, values)
        signal, gradient = self.at(amplitude).signal(grid, values, names)
        step = self.step_of(amplitude)
        below, above = (
            self.amplitude_image(grid, x, y, z, a) for a in (amplitude - step, amplitude + step)
        )
        gradient[3] = (above - below) / (2 * step)
        return signal, gradient

    def derivative_rows(
        self, grid: PixelGrid, theta: FloatArray, height: str = "exact"
    ) -> FloatArray:
        """As `ForwardModel.derivative_rows`; no mass has a table along z."""
        exact = "exact" if height == "between" else height
        amplitude = float(theta[3])
        step = self.step_of(amplitude)
        below, rows, above = (
            self.at(a).derivative_rows(grid, np.array([*theta[:3], a]), exact)
            for a in (amplitude - step, amplitude, amplitude + step)
        )
        rows[:, 4] = (above[:, 0] - below[:, 0]) / (2 * step)
        for k in range(3):
            rows[:, _SECOND[k, 3]] = (above[:, 1 + k] - below[:, 1 + k]) / (2 * step)
        rows[:, _SECOND[3, 3]] = (above[:, 0] - 2 * rows[:, 0] + below[:, 0]) / step**2
        return rows


def sized(model: ForwardModel, sphere: Sphere, diameters_nm: tuple[float, float]) -> SizedModel:
    """Make the model of spheres of all masses from that of one, with the diameters to search."""
    low, high = (sphere_mass_kda(diameter, sphere.density_kg_m3) for diameter in diameters_nm)
    return SizedModel(**parts_of(model), sphere=sphere, mass_range_kda=(low, high))


def parts_of(model: ForwardModel) -> dict[str, Any]:
    """Name the parts of which a linear model is made."""
    return {each.name: getattr(model, each.name) for each in fields(ForwardModel)}


VESICLE, SPHERE = "vesicle", "sphere"
LEAST_CONTRAST, MIDDLE_CONTRAST, LARGEST_INDEX = 0.005, 0.07, 1.8
"""Of the index of a sphere that is fitted: its least and a middling difference from the sample's,
and the largest one."""

BILAYER_NM, BILAYER_INDEX = 5.0, 1.46
"""Shell of a vesicle that is filled with the sample's medium: a bilayer of lipids."""

_MOST_STRENGTH = 0.9  # an index of five times the sample's


def largest_dipole_nm(optics: Optics) -> float:
    """Give the diameter of a compact particle beyond which it is no dipole."""
    # Diameter of a compact particle over the wavelength in the sample beyond which it is no
    # dipole: light from its far side is an eighth of a period late
    return (1 / 16) * optics.wavelength_nm / optics.n_sample


@dataclass(frozen=True)
class SeatedModel(SizedModel):
    """Expected images of a sphere above the coverslip, whose z is the gap between the two."""

    name: str = field(kw_only=True)
    """What it is made of."""

    indices: tuple[float, float] = field(kw_only=True)
    """Refractive indices among which a fit searches; both are that of a known material."""

    @property
    def fits_index(self) -> bool:
        """Whether the refractive index is fitted."""
        return self.indices[0] < self.indices[1]

    def in_place_of(self, model: ForwardModel) -> SeatedModel:
        """Give the model of the same spheres as far as a wider one of the same microscope goes."""
        kept = {name: getattr(self, name) for name in ("factor", "strength", "scale", "z_range_nm")}
        return replace(self, **parts_of(model) | kept)

    def of_index(self, index: float) -> SeatedModel:
        """Give the model of the same spheres with another refractive index."""
        return replace(self, sphere=replace(self.sphere, index=complex(index)))

    def of_strength(self, strength: float) -> SeatedModel:
        """Give that of the index with which small spheres scatter so much light per volume."""
        return self.of_index(min(max(self.index_of(strength), self.indices[0]), self.indices[1]))

    def strength_of(self, index: float) -> float:
        """Give the light of a small sphere per volume, (n² − n_s²)/(n² + 2 n_s²)."""
        medium = self.optics.n_sample**2
        return (index**2 - medium) / (index**2 + 2 * medium)

    def index_of(self, strength: float) -> float:
        """Give the index of that much light."""
        ratio = min(strength, _MOST_STRENGTH)
        return self.optics.n_sample * math.sqrt((1 + 2 * ratio) / (1 - ratio))

    def index_slope(self, strength: float) -> float:
        """Give the change of the index with the light."""
        ratio = min(strength, _MOST_STRENGTH)
        return 1.5 * self.optics.n_sample**2 / (self.index_of(ratio) * (1 - ratio) ** 2)

    def centre_nm(self, z_nm: float, amplitude: float) -> float:
        """As `ForwardModel.centre_nm`."""
        return z_nm + self.sphere.of_mass(amplitude).diameter_nm / 2

    def _linear(self, sphere: Sphere) -> ForwardModel:
        linear = super()._linear(sphere)
        return linear.dimmed(np.exp(0.5j * linear.wave.axial * sphere.diameter_nm))


def seated_models(
    model: ForwardModel, kinds: Iterable[SphereKind], diameters_nm: tuple[float, float]
) -> tuple[SeatedModel, ...]:
    """Make models of spheres in the microscope of a dipole's model.

    Their amplitude is the mass of as large a sphere with the dipole's density, and they scatter as
    much more than the optics say as a calibration says that dipoles do.  A material that is
    not known at the wavelength is left out, and so are vesicles without the library for shells.
    """
    density = model.material.density_kg_m3
    optics = model.optics
    medium = optics.n_sample**2
    permittivity = model.material.permittivity
    of_dipole = (permittivity - medium) / (permittivity + 2 * medium)
    brighter = 1 / abs(model.scale.slope(model.nominal_amplitude)) / of_dipole
    models = []
    for kind in kinds:
        sphere = _sphere_of(kind, optics, model.material.mass_kda, density)
        if sphere is None:
            continue
        indices = (sphere.index.real,) * 2
        if kind == SPHERE:
            indices = optics.n_sample + LEAST_CONTRAST, LARGEST_INDEX
        # the smallest vesicle is 1.1 times as wide as twice its shell
        low = max(diameters_nm[0], SMALLEST_NM, 2 * 1.1 * sphere.shell_nm)
        if not sphere.index.imag:  # a smaller one that does not absorb is a dipole like a protein
            low = max(low, largest_dipole_nm(optics))
        if low >= diameters_nm[1]:
            continue
        parts = parts_of(model) | {
            "factor": model.factor * brighter,  # the polarisability is in the sphere's pattern
            "strength": model.strength * brighter,
            "scale": MassScale(),
            "z_range_nm": (0.0, model.z_range_nm[1]),
        }
        low_kda, high_kda = (sphere_mass_kda(d, density) for d in (low, diameters_nm[1]))
        models.append(
            SeatedModel(
                **parts,
                sphere=sphere.of_mass(low_kda),
                mass_range_kda=(low_kda, high_kda),
                name=str(kind),
                indices=indices,
            )
        )
    return tuple(models)


def _sphere_of(
    kind: SphereKind, optics: Optics, mass_kda: float, density_kg_m3: float
) -> Sphere | None:
    """Make a sphere of a material; None where it cannot be computed."""
    if kind == VESICLE:
        if not has_shells():
            return None
        return Sphere(mass_kda, density_kg_m3, optics.n_sample, BILAYER_NM, BILAYER_INDEX)
    if kind == SPHERE:
        return Sphere(mass_kda, density_kg_m3, complex(optics.n_sample + MIDDLE_CONTRAST))
    if isinstance(kind, float):
        return Sphere(mass_kda, density_kg_m3, complex(kind))
    try:
        permittivity = material(Particle(kind=kind), optics.wavelength_nm).permittivity
    except ConfigError:
        return None
    return Sphere(mass_kda, density_kg_m3, complex(np.sqrt(permittivity)))
