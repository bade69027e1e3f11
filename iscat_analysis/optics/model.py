"""Expected images of one particle, and their derivatives.

Simulation, fits, posterior and bounds all use `ForwardModel`.  Its *signal* is
the contrast C in the interferometric schemes and |E_sca|² for unit incident amplitude in dark field
(D21, section II; physics.md, sections 1–3 and 8).

Beside it are the scattered light that the pupil collects, as an area and in photons (physics.md,
section 1), and images of particles that move during the exposure.

Such an image is the average along the path.  During the exposure E, free diffusion has the variance
D E/3 along each axis about the mean position: the variance 2Dt about the start averages to D E, and
that of the mean is 2D E/3.  At time t of the exposure the position is normal about the mean, with
the variance v(t) = 2D E (1/3 − t/E + t²/E²), which averages to q = D E/3.  Each plane wave of the
field, with wave vector k along the axis, is multiplied by the average of exp(−k²v(t)/2) over the
exposure.  The interference is linear in the field, so that this average is exact and takes no
additional time: the pupil becomes darker towards its edge.  A normal distribution of variance q
would make it too dark, by 0.05 % of the mass at 0.8 µm²/s and 1.5 % at 5 µm²/s in 3 ms.  The
variance of a single path differs from frame to frame by 63 % of its mean (standard deviation of
both axes together, from the eigenvalues (2/π²n²) D E of Brownian motion about its mean,
Σ n⁻⁴ / (Σ n⁻²)² = 2/5); this scatters masses, `PATH_SPREAD`.

For the scattered light |e|² the square of the averaged field is used, which is too small by
q |∇e|².  This is a small part of |e|², which is itself a small part of the contrast of a protein.

Mass and the amplitude of the scattered field: by the absolute model, or by a calibration.

A particle of mass m scatters a field of amplitude a, in any microscope.  The contrast of this
amplitude, C = L·a + Q·a², depends on the optics: L and Q depend on focus, aperture, phase and
height.  The line of a calibration was measured with the optics of its standards, so that

    gradient·m + sign(m)·offset = L_there·a + Q_there·a²

gives the mass of an amplitude that was fitted with any other optics.  For faint particles this is
the gradient times the contrast per kDa of the model here over that of the model there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis._kernels.hessian import PAIRS, ROWS, derivatives_between, signal_hessian
from iscat_analysis._kernels.image import signal_gradient, signal_image
from iscat_analysis._kernels.lattice import lattice_values
from iscat_analysis._kernels.lens import Lens, Pixels, RoundLens
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import blank_profile
from iscat_analysis.config import Calibration, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import kept
from iscat_analysis.optics.pixels import PixelArea, PixelGrid, sample_picture
from iscat_analysis.optics.scatterers import Material
from iscat_analysis.optics.waves import (
    Aperture,
    Field,
    LatticeField,
    MeasuredField,
    RadialField,
    axial_table,
    check_names,
    sensitivity_lattices,
)
from iscat_analysis.records import BoolArray, ComplexArray, FloatArray

LARGEST_SCALE_CHANGE = 1 / 3
"""Largest change of the contrast per kDa, from the optics of the standards to others, for which the
model converts the scale: beyond it, small errors of the optics are large errors of the mass."""


def carry_refusal(here: Optics, there: Optics, ratio: float) -> str:
    """Say why the model does not convert the scale of standards to other optics; else nothing."""
    for key in ("scheme", "polarization", "analyzer", "psf"):
        mine, theirs = getattr(here, key), getattr(there, key)
        if mine != theirs:
            return f"they were measured with optics.{key} = {theirs}, and this is {mine}"
    # Two wavelengths that differ by less are of the same laser line
    if abs(here.wavelength_nm - there.wavelength_nm) > 1.0:
        return (
            f"they were measured at {there.wavelength_nm:g} nm, and this is at "
            f"{here.wavelength_nm:g} nm"
        )
    if not abs(ratio - 1) <= LARGEST_SCALE_CHANGE:
        return (
            f"by the model the contrast per kDa is {ratio:.3g} of that with the standards' optics, "
            "a change of more than a third"
        )
    return ""


@dataclass(frozen=True)
class MassScale:
    """The map between mass and the amplitude a of the model's field.

    Without a calibration a is the mass in kDa.  With one, the signed peak contrast
    C = L·a + Q·a² of the model, at the optics and the height of the standards, equals
    gradient·m + sign(m)·offset, which replaces the model's absolute scale.  `here` is L at the
    optics of the model; `refusal` says why the scale cannot be converted to these optics.

    The line crosses zero contrast at the mass −offset/gradient.  If this mass is positive, each
    contrast up to the offset belongs to two masses of opposite sign, which differ by twice this
    mass; `mass` gives the one with the sign of the contrast.  If it is negative, contrasts below
    the offset belong to no mass, and `mass` continues the line below zero.
    """

    calibration: Calibration | None = None
    linear: float = 0.0
    quadratic: float = 0.0
    here: float | None = None
    refusal: str = ""

    @property
    def carried(self) -> float:
        """Contrast per kDa at the model's own optics over that at the optics of the standards."""
        return 1.0 if self.here is None else self.here / self.linear

    def peak(self, amplitude: FloatArray) -> FloatArray:
        """Contrast of amplitudes of any shape at the optics of the standards."""
        return self.linear * amplitude + self.quadratic * amplitude**2

    def amplitude(self, mass_kda: float) -> float:
        """Amplitude a of a particle of a given mass [kDa]."""
        return float(self.amplitudes(mass_kda))

    def amplitudes(self, mass_kda: ArrayLike) -> FloatArray:
        """`amplitude` of masses of any shape."""
        mass_kda = np.asarray(mass_kda, dtype=float)
        if self.calibration is None:
            return mass_kda
        line = self.calibration
        contrast = line.gradient_per_kda * mass_kda + np.copysign(1.0, mass_kda) * line.offset
        root = np.sqrt(np.maximum(self.linear**2 + 4 * self.quadratic * contrast, 0.0))
        return np.asarray(2 * contrast / (self.linear + np.copysign(root, self.linear)))

    def mass(self, amplitude: FloatArray) -> FloatArray:
        """Mass [kDa] of amplitudes of any shape; the inverse of `amplitude`."""
        amplitude = np.asarray(amplitude, dtype=float)
        if self.calibration is None:
            return amplitude
        line = self.calibration
        contrast = self.peak(amplitude)
        sign = np.sign(contrast * line.gradient_per_kda)
        return (contrast - sign * line.offset) / line.gradient_per_kda

    def slope(self, amplitude: float) -> float:
        """Return dm/da [kDa per unit amplitude]."""
        return float(self.slopes(np.asarray(amplitude)))

    def bend(self, mass_kda: FloatArray) -> FloatArray:
        """Give the relative error of a line of faint standards for heavy particles.

        The scattered field is proportional to the mass, but the contrast also contains its square.
        If the standards are faint, the contrast of a line differs from C = L·a + Q·a² by −Q·a/L.
        """
        sizes = np.abs(np.asarray(mass_kda, dtype=float))
        if self.calibration is None:
            return np.zeros(sizes.shape)
        whole = self.linear + self.quadratic * self.amplitudes(sizes)
        return np.asarray(self.linear / whole - 1)

    def slopes(self, amplitude: FloatArray) -> FloatArray:
        """`slope` of amplitudes of any shape."""
        amplitude = np.asarray(amplitude, dtype=float)
        if self.calibration is None:
            return np.ones(amplitude.shape)
        rise = self.linear + 2 * self.quadratic * amplitude
        return np.asarray(rise / self.calibration.gradient_per_kda)

    def off_line(self, amplitude: FloatArray, sigma_kda: FloatArray, errors: float) -> BoolArray:
        """Tell which contrasts do not belong to a single mass on the line of a calibration."""
        amplitude, sigma_kda = np.asarray(amplitude, dtype=float), np.asarray(sigma_kda)
        if self.calibration is None or self.calibration.offset == 0.0:
            return np.zeros(amplitude.shape, dtype=np.bool_)
        line = self.calibration
        size = np.abs(self.peak(amplitude) / line.gradient_per_kda)
        crossing = -line.offset / line.gradient_per_kda
        if crossing > 0:
            return (size < crossing + errors * sigma_kda) & (2 * crossing > sigma_kda)
        return np.asarray(size < -crossing - errors * sigma_kda)


Values = Sequence[float] | FloatArray
"""Values of the parameters of a particle model."""

_TABLES_KEPT = 4  # cached heights with their derivatives or tables, some MB each


@dataclass(frozen=True)
class Parameter:
    """One number that a particle model depends on.

    Attributes
    ----------
    name, unit : str
        What it is, and the unit of its values.
    limits : (float, float)
        Values for which the model is known.
    step, growth : float
        Largest change in one step of a fit, and the same over its size.
    prior : (float, float), optional
        Mean and standard deviation of a normal prior.
    scale : MassScale, optional
        How a fitted amplitude becomes the mass that is reported.
    """

    name: str
    unit: str = ""
    limits: tuple[float, float] = (-math.inf, math.inf)
    step: float = math.inf
    growth: float = math.inf
    prior: tuple[float, float] | None = None
    scale: MassScale | None = None

    def reported(self, values: FloatArray) -> FloatArray:
        """Give the values that are reported, of fitted ones."""
        return values if self.scale is None else self.scale.mass(values)

    def slope(self, value: float) -> float:
        """Give the change of the reported value with the fitted one."""
        return 1.0 if self.scale is None else self.scale.slope(value)

    def fitted(self, value: float) -> float:
        """Give the fitted value of a reported one."""
        return value if self.scale is None else self.scale.amplitude(value)


@dataclass(frozen=True)
class ForwardModel:
    """Expected images of one particle in one microscope; build it with `forward_model`."""

    optics: Optics
    material: Material
    aperture: Aperture
    height_nm: float
    reference: float
    rho: float
    factor: complex
    oil_nm: float
    wave: Field
    strength: complex
    reach_nm: float
    z_range_nm: tuple[float, float]
    area: PixelArea
    scale: MassScale = field(default_factory=MassScale)

    @property
    def is_sized(self) -> bool:
        """Whether particles are spheres, whose picture changes its shape with their size."""
        return False

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Place and mass, of which fits take the amplitude."""
        wavelength = self.optics.wavelength_nm
        return (
            *(Parameter(name, "nm", step=wavelength / 4) for name in ("x_nm", "y_nm")),
            Parameter("z_nm", "nm", self.z_range_nm, wavelength / 10),
            Parameter("mass_kda", "kDa", growth=0.5, scale=self.scale),
        )

    def at(self, amplitude: float) -> ForwardModel:
        """Give the model whose pictures grow in proportion to the amplitude near this one."""
        del amplitude  # a dipole has one picture
        return self

    def dimmed(self, factor: ComplexArray | float) -> Self:
        """Multiply every plane wave of the light by a complex factor; shapes: `factor` (n,)."""
        wave = self.wave
        if isinstance(wave, RadialField):
            return replace(self, wave=replace(wave, source=wave.source * factor))
        if isinstance(wave, LatticeField):
            return replace(self, wave=replace(wave, harmonics=wave.harmonics * factor))
        return self

    def centre_nm(self, z_nm: float, amplitude: float) -> float:
        """Give the height of a particle's centre, of its height as a parameter."""
        del amplitude  # they are the same
        return z_nm

    @property
    def wavenumber(self) -> float:
        """2π over the vacuum wavelength [rad/nm]."""
        return 2 * math.pi / self.optics.wavelength_nm

    @property
    def is_measured(self) -> bool:
        """Whether the image was measured, so that the light in the pupil is not known."""
        return isinstance(self.wave, MeasuredField)

    @cached_property
    def lens(self) -> Lens:
        """Constants with which the kernels turn a profile into a signal."""
        return self.wave.lens(self.rho)

    def pixels(self, grid: PixelGrid) -> Pixels:
        """Return a grid with the samples inside its pixels, as the kernels take them."""
        return Pixels(grid.x_nm, grid.y_nm, *self.area.points(grid.pixel_nm))

    @property
    def fringe_nm(self) -> float:
        """Period λ/(2 n_s) of the interference with height in iSCAT [nm]."""
        return self.optics.wavelength_nm / (2 * self.optics.n_sample)

    @cached_property
    def nominal_amplitude(self) -> float:
        """Amplitude of the material's nominal mass."""
        return self.scale.amplitude(self.material.mass_kda)

    def profile(self, z_nm: float, orders: int = 2) -> FloatArray:
        """Profile of the field at a height."""
        return self.wave.profile(z_nm, orders)

    @cached_property
    def axial_table(self) -> AxialTable:
        """Profiles at the heights of `z_range_nm`, for the kernels that interpolate along z."""
        return axial_table(self.wave, self.z_range_nm)

    @kept(_TABLES_KEPT)
    def height_table(self, z_nm: float) -> AxialTable:
        """Profiles at one height, in the form of `axial_table`."""
        return axial_table(self.wave, (z_nm, z_nm))

    @kept(_TABLES_KEPT)
    def picture_table(self, pixel_nm: float, half_px: int) -> tuple[Lens, AxialTable]:
        """Image at `height_nm` on the grid of the pixels."""
        lens, samples = sample_picture(self, pixel_nm, half_px)
        return lens, AxialTable(samples.reshape(1, 1, 2, -1), self.height_nm, 1.0, 0.0)

    def image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> FloatArray:
        """Signal of one particle.

        Shapes: result (ny, nx).
        """
        return self.amplitude_image(grid, x_nm, y_nm, z_nm, self.scale.amplitude(mass_kda))

    def amplitude_image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> FloatArray:
        """Signal of one particle whose amplitude is known instead of its mass.

        Below the offset of a calibration two amplitudes have the same mass, so that a fitted
        amplitude must be drawn from the amplitude and not from the mass.

        Shapes: result (ny, nx).
        """
        model, out = self.at(amplitude), np.empty(grid.shape)
        theta = np.array([x_nm, y_nm, z_nm, amplitude])
        signal_image(model.profile(z_nm, 1), *model._geometry(grid, theta), theta, out)
        return out

    def gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float,
        names: Sequence[str] = (),
    ) -> tuple[FloatArray, FloatArray]:  # fmt: skip
        """Signal and its analytic derivatives, as `signal` does it, for a mass."""
        amplitude = self.scale.amplitude(mass_kda)
        signal, gradient = self.signal(grid, (x_nm, y_nm, z_nm, amplitude), names)
        gradient[3] /= self.scale.slope(amplitude)
        return signal, gradient

    def signal(
        self, grid: PixelGrid, values: Values, names: Sequence[str] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Signal and its derivatives in `values` = (x, y, z, a), and in parameters of the optics.

        a is the amplitude.

        Shapes: `values` (4,), `signal` (ny, nx), `gradient` (4 + len(names), ny, nx).
        """
        theta = np.array(values, dtype=float)
        lens, pixels = self._geometry(grid, theta)
        rows, stack = np.empty((grid.shape[0], 5, grid.shape[1])), None
        if names:
            check_names(self.aperture, names)
            if self.is_measured:
                raise ConfigError('optics.psf = "measured" knows no parameters of the optics')
            lens, stack = self._sensitivities(float(theta[2]), tuple(names))
            profile = stack[:2].reshape(-1, *stack.shape[3:])
        else:
            profile = self.profile(float(theta[2]), 2)
        signal_gradient(profile, lens, pixels, theta, rows)
        out = np.moveaxis(rows, 1, 0)
        if stack is None:
            return out[0], out[1:]
        slopes, flat = np.empty((len(stack), *grid.shape)), stack.reshape(-1, *stack.shape[3:])
        lattice_values(flat, lens, pixels, theta, stack.shape[1], slopes)
        return out[0], np.concatenate([out[1:], slopes[2:]])

    @kept(_TABLES_KEPT)
    def _sensitivities(self, z_nm: float, names: tuple[str, ...]) -> tuple[Lens, FloatArray]:
        return sensitivity_lattices(self, z_nm, names)

    def amplitude_hessian(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal, gradient and second derivatives in (x, y, z, a), a the amplitude.

        Shapes: `signal` (ny, nx), `gradient` (4, ny, nx), `hessian` (4, 4, ny, nx).
        """
        rows = self.derivative_rows(grid, np.array([x_nm, y_nm, z_nm, amplitude]))
        out = np.moveaxis(rows, 1, 0)
        second = np.empty((4, 4, *grid.shape))
        for values, (i, j) in zip(out[5:], PAIRS, strict=True):
            second[i, j] = second[j, i] = values
        return out[0], out[1:5], second

    def derivative_rows(
        self, grid: PixelGrid, theta: FloatArray, height: str = "exact"
    ) -> FloatArray:
        """Signal and its derivatives up to the second, as the kernels of a fit take them.

        Shapes: `theta` (4,), result (ny, ROWS, nx).
        """
        rows = np.empty((grid.shape[0], ROWS, grid.shape[1]))
        geometry = self._geometry(grid, theta)
        if height == "between":
            derivatives_between(self.axial_table, *geometry, theta, rows)
            return rows
        orders = 1 if height == "fixed" and isinstance(self.lens, RoundLens) else 3
        signal_hessian(self.profile(float(theta[2]), orders), *geometry, theta, rows)
        return rows

    def field(
        self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float, mass_kda: float
    ) -> ComplexArray:
        """Scattered field over the reference (dark field: over the incident amplitude).

        Shapes: result (1 or 2, *dx_nm.shape).
        """
        amplitude = self.scale.amplitude(mass_kda)
        return amplitude * self.at(mass_kda).wave.components(dx_nm, dy_nm, z_nm)

    def peak_contrast(self, z_nm: float, mass_kda: float) -> float:
        """Signal of largest magnitude over the plane, with its sign."""
        return self.amplitude_contrast(z_nm, self.scale.amplitude(mass_kda))

    def amplitude_contrast(self, z_nm: float, amplitude: float, height: str = "exact") -> float:
        """Peak contrast of an amplitude; a sphere of one mass has no table along z."""
        model = self.at(amplitude)
        if height == "exact" or model is not self or isinstance(self.wave, MeasuredField):
            return sum(model.wave.peak(z_nm, amplitude, self.rho))
        table, orders = self.axial_table, 1 if isinstance(self.wave, RadialField) else 3
        profile = blank_profile(table, self.lens, orders)
        profile_at(table, z_nm, 0, table.heights.shape[3], profile)
        return sum(self.wave.peak(z_nm, amplitude, self.rho, profile))

    def _geometry(self, grid: PixelGrid, theta: FloatArray) -> tuple[Lens, Pixels]:
        """Give what every image kernel takes between profile and θ, unless θ is too far away."""
        far_nm = grid.farthest_nm(float(theta[0]), float(theta[1]))
        if far_nm > self.reach_nm:
            raise ConfigError(
                f"the grid extends {far_nm:.0f} nm from the particle, the model "
                f"was built for {self.reach_nm:.0f} nm: give forward_model a larger reach_nm"
            )
        return self.lens, self.pixels(grid)


def collected_area_nm2(model: ForwardModel, z_nm: float, mass_kda: float) -> float:
    """Scattered light that the pupil collects, as an equivalent area of reference.

    It is counted before mask and analyser; aberrations do not change it.  Multiplied by the
    background per area it gives the collected scattered photons.
    """
    if model.is_measured:
        return math.nan
    amplitude = model.scale.amplitude(mass_kda)
    opening = model.at(amplitude).aperture
    # the light of a dipole is a trigonometric polynomial of order 4: 8 azimuths
    p, phi = opening.pupil, np.linspace(0.0, 2 * math.pi, 8, endpoint=False)
    decay = np.exp(-2 * p.axial.imag * model.centre_nm(z_nm, amplitude))
    density = (np.abs(opening.polarised(phi)) ** 2).sum(0).mean(1) * np.sin(p.theta) * decay
    pupil_integral = 2 * math.pi * float(np.sum(p.weight * density))
    medium = 1.0 if model.optics.emission == "reciprocal" else 1 / model.optics.n_immersion**2
    over = model.reference**2 if model.rho else 1.0
    e1 = abs(model.strength) * amplitude
    return e1**2 * medium * pupil_integral / over


def photons_per_intensity(model: ForwardModel, photons_per_frame: float, pixel_nm: float) -> float:
    """Dark field's scale s: photoelectrons per pixel and frame for unit |E_sca|²."""
    area = collected_area_nm2(model, model.height_nm, model.material.mass_kda)
    return photons_per_frame * pixel_nm**2 / area


def signals_within(model: ForwardModel, grid: PixelGrid, theta: FloatArray) -> FloatArray:
    """Draw each particle alone, if it is within the reach of its model.

    Shapes: `theta` (n, 4), result (n, ny, nx).
    """
    out = np.zeros((len(theta), *grid.shape))
    lens, pixels = model.lens, model.pixels(grid)
    for own, signal in zip(theta, out, strict=True):
        x, y, z = own[:3].tolist()
        if grid.farthest_nm(x, y) <= model.reach_nm:
            signal_image(model.profile(z, 1), lens, pixels, own, signal)
    return out


Model = TypeVar("Model", bound=ForwardModel)

PATH_SPREAD = math.sqrt(2 / 5)
"""Standard deviation of a path's variance in one exposure over its mean, both axes together."""

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_TIMES = (_POINTS + 1) / 4  # of the first half of the exposure, which the second mirrors
_SHARES: list[float] = (_WEIGHTS / 2).tolist()
_SPREADS: list[float] = (2 - 6 * _TIMES + 6 * _TIMES**2).tolist()
"""v(t)/q: exact to 1e-6 of the image for blurs up to half the resolution."""


def spreads(variance_nm2: float, *, each_axis: bool = False) -> list[tuple[float, float]]:
    """Give the weights and variances of the normal distributions that make up a blur."""
    wider = math.sqrt(4 / 3) if each_axis else 1.0
    ratios = [1 + wider * (v - 1) for v in _SPREADS]
    return [(share, variance_nm2 * v) for share, v in zip(_SHARES, ratios, strict=True)]


def path_variance_nm2(d_um2_s: float, exposure_s: float) -> float:
    """Variance of a path about its mean position during an exposure."""
    return d_um2_s * 1e6 * exposure_s / 3


def blurred(model: Model, variance_nm2: float, *, upwards: bool) -> Model:
    """Average a model over the path of a particle that diffuses."""
    if variance_nm2 == 0:
        return model
    wave = model.wave
    if not isinstance(wave, RadialField | LatticeField):
        raise ConfigError('optics.psf = "measured" cannot be averaged along a path')
    exponent = np.asarray(wave.transverse**2, dtype=complex)
    if upwards:
        exponent = exponent + wave.axial**2
    dimmed = sum(share * np.exp(-exponent * v / 2) for share, v in spreads(variance_nm2))
    return model.dimmed(np.asarray(dimmed))


def wiggled(model: Model, sd_nm: float) -> Model:
    """Average a model over the positions of a wiggling particle, normal about their mean."""
    if sd_nm == 0:
        return model
    wave = model.wave
    if not isinstance(wave, RadialField | LatticeField):
        raise ConfigError('optics.psf = "measured" has the wiggle of the particles it shows')
    return model.dimmed(np.exp(-0.5 * (wave.transverse * sd_nm) ** 2))
