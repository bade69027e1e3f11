"""The forward model: optics, particle and pixel grid → expected image and its derivatives.

One `ForwardModel` serves the simulator, the fits, the posterior and the bounds.  Its *signal* is
the contrast C in the interferometric schemes and |E_sca|² for unit incident amplitude in dark field
(D21, section II; physics.md, sections 1–3 and 8).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.hessian import signal_hessian
from iscat_analysis._kernels.image import Lens, Pixels, signal_gradient, signal_image
from iscat_analysis._kernels.pupil import Pupil, gauss_legendre, make_pupil, rectangle
from iscat_analysis._kernels.radial import STEP, AxialTable, bessel_table, radial_profile
from iscat_analysis.config import Calibration, Config, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.optics.materials import Material, material
from iscat_analysis.optics.scale import MassScale
from iscat_analysis.units import KILODALTON_KG, NM

__all__ = ["ForwardModel", "MassScale", "PixelGrid", "forward_model"]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEAR_CRITICAL = 0.98
"""NA over n_sample from which the quadrature minds the critical angle."""

_HEIGHTS_KEPT = 8  # profiles at hand; where z is fixed, every image asks for the same one

TABLE_LIMIT_MB = 400
"""No table of the model is larger: a length in the wrong unit would fill the memory."""

DONG2021_FIELD_NODES = 110
"""Nodes of the rectangle rule in D21's program for fields."""


@dataclass(frozen=True)
class ForwardModel:
    """Expected images of one particle in one microscope; build it with `forward_model`.

    Attributes
    ----------
    optics : Optics
        The ``[optics]`` section.
    material : Material
        Permittivity, density, nominal mass.
    pupil : Pupil
        The scattered wave on the quadrature.
    height_nm : float
        The height for which the focus was set [nm].
    reference : float
        |E_ref| for unit incident amplitude; 0 in dark field.
    rho : float
        1 with a reference, 0 in dark field: the reference in the unit of the field.
    source : complex ndarray, shape (2, n)
        Pupil weights of F0 and F2 per unit amplitude, over the reference.
    axial : complex ndarray, shape (n,)
        Phase per height of the particle [rad/nm], for the configured `axial`.
    strength : complex
        E1·e^{iψ0} per unit amplitude [nm].
    table : ndarray, shape (2, n, 3, intervals + 1)
        Bessel matrices.
    step_nm : float
        Radial step [nm].
    z_range_nm : (float, float)
        Heights that fits may ask for [nm].
    samples : (ndarray, ndarray)
        Sample offsets inside a pixel, as fractions of it, and their weights.
    scale : MassScale
        Mass ↔ amplitude.
    """

    optics: Optics
    material: Material
    pupil: Pupil
    height_nm: float
    reference: float
    rho: float
    source: ComplexArray
    axial: ComplexArray
    strength: complex
    table: FloatArray
    step_nm: float
    z_range_nm: tuple[float, float]
    samples: tuple[FloatArray, FloatArray]
    scale: MassScale = field(default_factory=MassScale)

    @property
    def wavenumber(self) -> float:
        """2π over the vacuum wavelength [rad/nm]."""
        return 2 * math.pi / self.optics.wavelength_nm

    @property
    def reach_nm(self) -> float:
        """Largest distance from the particle that the radial table covers [nm]."""
        return self.step_nm * float(self.table.shape[3] - 1)

    @property
    def lens(self) -> Lens:
        """Step, reference and polarisation, as the kernels take them."""
        psi = math.radians(self.optics.polarization_deg)
        return Lens(1 / self.step_nm, self.rho, math.cos(psi), math.sin(psi))

    def pixels(self, grid: PixelGrid) -> Pixels:
        """Return a grid with the samples inside its pixels, as the kernels take them."""
        offsets, weights = self.samples
        return Pixels(grid.x_nm, grid.y_nm, offsets * grid.pixel_nm, weights)

    @property
    def fringe_nm(self) -> float:
        """Period λ/(2 n_s) of the interference with height in iSCAT [nm]."""
        return self.optics.wavelength_nm / (2 * self.optics.n_sample)

    def profile(self, z_nm: float, orders: int = 2) -> FloatArray:
        """Radial profile at a height.

        Parameters
        ----------
        z_nm : float
            Height [nm].
        orders : int
            1, 2 or 3: fields, with ∂/∂z, with ∂²/∂z².

        Returns
        -------
        ndarray, shape (4·orders, intervals, 6)
            See `iscat_analysis._kernels.radial`.  The last few are kept: not to be written to.
        """
        return self._profiles(z_nm, orders)

    @cached_property
    def _profiles(self) -> Callable[[float, int], FloatArray]:
        return lru_cache(_HEIGHTS_KEPT)(self._profile)

    def _profile(self, z_nm: float, orders: int) -> FloatArray:
        points = self.table.shape[3]
        nodes = np.empty((4 * orders, 3 * points))
        out = np.empty((4 * orders, points - 1, 6))
        radial_profile(self.table, self.source, self.axial, z_nm, orders, nodes, out)
        return out

    @cached_property
    def axial_table(self) -> AxialTable:
        """Profiles at the heights of `z_range_nm`, for the kernels that interpolate along z."""
        low, high = self.z_range_nm
        kappa = float(self.axial.real.min() + self.axial.real.max()) / 2
        step = STEP / float(np.abs(self.axial - kappa).max())
        count = max(math.ceil((high - low) / step), 1) + 1
        points = self.table.shape[3]
        check_table("the table along z", 72.0 * count * (points - 1))
        nodes, out = np.empty((12, 3 * points)), np.empty((12, points - 1, 6))
        heights = np.empty((count, 3, 4, 6 * (points - 1)))
        for i in range(count):
            z = low + i * step
            radial_profile(self.table, self.source, self.axial - kappa, z, 3, nodes, out)
            heights[i] = out.reshape(3, 4, -1) * (step ** np.arange(3))[:, None, None]
        return AxialTable(heights, low, step, kappa)

    def image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> FloatArray:
        """Signal of one particle.

        Parameters
        ----------
        grid : PixelGrid
            Where to evaluate it.
        x_nm, y_nm, z_nm : float
            Particle [nm].
        mass_kda : float
            Mass [kDa]; negative for a field of opposite sign.

        Returns
        -------
        ndarray, shape (ny, nx)
            Contrast C, or |E_sca|² in dark field.
        """
        return self.amplitude_image(grid, x_nm, y_nm, z_nm, self.scale.amplitude(mass_kda))

    def amplitude_image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> FloatArray:
        """Signal of one particle whose amplitude is known instead of its mass.

        Below the offset of a calibration two amplitudes have one mass, so that what was fitted as
        an amplitude must be drawn from it.

        Parameters
        ----------
        grid : PixelGrid
            Where to evaluate it.
        x_nm, y_nm, z_nm : float
            Particle [nm].
        amplitude : float
            Amplitude, see `MassScale`.

        Returns
        -------
        ndarray, shape (ny, nx)
            As `image` gives it.
        """
        out = np.empty(grid.shape)
        signal_image(self.profile(z_nm, 1), *self._geometry(grid, x_nm, y_nm, amplitude), out)
        return out

    def gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> tuple[FloatArray, FloatArray]:
        """Signal and its analytic derivatives.

        Parameters
        ----------
        grid : PixelGrid
            Where to evaluate it.
        x_nm, y_nm, z_nm : float
            Particle [nm].
        mass_kda : float
            Mass [kDa].

        Returns
        -------
        signal : ndarray, shape (ny, nx)
            As `image` gives it.
        gradient : ndarray, shape (4, ny, nx)
            Derivatives with respect to x, y, z [1/nm] and mass [1/kDa].
        """
        amplitude = self.scale.amplitude(mass_kda)
        signal, gradient = self.amplitude_gradient(grid, x_nm, y_nm, z_nm, amplitude)
        gradient[3] /= self.scale.slope(amplitude)
        return signal, gradient

    def amplitude_gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray]:
        """Signal and its derivatives in (x, y, z, a), a the amplitude.

        Parameters
        ----------
        grid : PixelGrid
            Where to evaluate it.
        x_nm, y_nm, z_nm : float
            Particle [nm].
        amplitude : float
            Amplitude, see `MassScale`.

        Returns
        -------
        signal : ndarray, shape (ny, nx)
            As `image` gives it.
        gradient : ndarray, shape (4, ny, nx)
            Derivatives with respect to x, y, z [1/nm] and the amplitude.
        """
        rows = np.empty((grid.shape[0], 5, grid.shape[1]))
        signal_gradient(self.profile(z_nm, 2), *self._geometry(grid, x_nm, y_nm, amplitude), rows)
        out = np.moveaxis(rows, 1, 0)
        return out[0], out[1:]

    def amplitude_hessian(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal, gradient and second derivatives in (x, y, z, a), a the amplitude.

        Parameters
        ----------
        grid : PixelGrid
            Where to evaluate it.
        x_nm, y_nm, z_nm : float
            Particle [nm].
        amplitude : float
            Amplitude, see `MassScale`.

        Returns
        -------
        signal : ndarray, shape (ny, nx)
            As `image` gives it.
        gradient : ndarray, shape (4, ny, nx)
            First derivatives.
        hessian : ndarray, shape (4, 4, ny, nx)
            Second derivatives.
        """
        first = np.empty((5, *grid.shape))
        second = np.empty((4, 4, *grid.shape))
        geometry = self._geometry(grid, x_nm, y_nm, amplitude)
        signal_hessian(self.profile(z_nm, 3), *geometry, first, second)
        return first[0], first[1:], second

    def field(
        self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float, mass_kda: float
    ) -> ComplexArray:
        """Scattered field over the reference (dark field: over the incident amplitude).

        Parameters
        ----------
        dx_nm, dy_nm : ndarray
            Camera position minus the particle's [nm], same shape.
        z_nm : float
            Height [nm].
        mass_kda : float
            Mass [kDa].

        Returns
        -------
        complex ndarray, shape (2, *dx_nm.shape)
            Components along and across the polarisation.
        """
        _, _, c, s = self.lens
        u, v = c * dx_nm + s * dy_nm, c * dy_nm - s * dx_nm
        f0, f2 = self._radial(np.hypot(u, v), z_nm)
        amplitude = self.scale.amplitude(mass_kda)
        return amplitude * np.stack([f0 + f2 * (u**2 - v**2), f2 * (2 * u * v)])

    def peak_contrast(self, z_nm: float, mass_kda: float) -> float:
        """Signal of largest magnitude over the plane, with its sign.

        At fixed r the signal is linear in cos 2φ, so its extremes lie along or across the
        polarisation.

        Parameters
        ----------
        z_nm : float
            Height [nm].
        mass_kda : float
            Mass [kDa].

        Returns
        -------
        float
            Peak contrast, or the peak of |E_sca|² in dark field.
        """
        return self.amplitude_contrast(z_nm, self.scale.amplitude(mass_kda))

    def amplitude_contrast(self, z_nm: float, amplitude: float) -> float:
        """Peak contrast of an amplitude; see `peak_contrast` and `amplitude_image`.

        Parameters
        ----------
        z_nm : float
            Height [nm].
        amplitude : float
            Amplitude, see `MassScale`.

        Returns
        -------
        float
            Peak contrast, or the peak of |E_sca|² in dark field.
        """
        linear, quadratic, _ = self._peak(z_nm, amplitude)
        return linear + quadratic

    def collected_area_nm2(self, z_nm: float, mass_kda: float) -> float:
        """Scattered light that the pupil collects, as an equivalent area of reference.

        Multiplied by the background per area it gives the collected scattered photons
        (physics.md, section 1).

        Parameters
        ----------
        z_nm : float
            Height [nm]; evanescent waves weaken with it.
        mass_kda : float
            Mass [kDa].

        Returns
        -------
        float
            Area [nm²]; in dark field per unit incident intensity.
        """
        p = self.pupil
        decay = np.exp(-2 * self.axial.imag * z_nm)
        density = (np.abs(p.t_p_cos) ** 2 + np.abs(p.t_s) ** 2) * np.sin(p.theta) * decay
        pupil_integral = math.pi * float(np.sum(p.weight * density))
        medium = 1.0 if self.optics.emission == "reciprocal" else 1 / self.optics.n_immersion**2
        over = self.reference**2 if self.rho else 1.0
        e1 = abs(self.strength) * self.scale.amplitude(mass_kda)
        return e1**2 * medium * pupil_integral / over

    def photons_per_intensity(self, photons_per_frame: float, pixel_nm: float) -> float:
        """Dark field's scale s: photoelectrons per pixel and frame for unit |E_sca|².

        Parameters
        ----------
        photons_per_frame : float
            Scattered photons collected per frame from a particle of the nominal mass.
        pixel_nm : float
            Pixel side [nm].

        Returns
        -------
        float
            s.
        """
        area = self.collected_area_nm2(self.height_nm, self.material.mass_kda)
        return photons_per_frame * pixel_nm**2 / area

    def _radial(self, r: FloatArray, z_nm: float) -> tuple[ComplexArray, ComplexArray]:
        """F0 and F2 at distances r, from the table."""
        profile = self.profile(z_nm, 1)
        index = np.minimum((r / self.step_nm).astype(int), profile.shape[1] - 1)
        t = r / self.step_nm - index
        powers = t[..., None] ** np.arange(6)
        values = np.einsum("...p,c...p->...c", powers, profile[:, index])
        return values[..., 0] + 1j * values[..., 1], values[..., 2] + 1j * values[..., 3]

    def _peak(self, z_nm: float, amplitude: float) -> tuple[float, float, float]:
        """Linear and quadratic part of the extreme signal, and its distance [nm]."""
        r, fields = self._axes(z_nm)

        def parts(along: ComplexArray) -> tuple[FloatArray, FloatArray]:
            return 2 * self.rho * amplitude * along.real, amplitude**2 * np.abs(along) ** 2

        linear, quadratic = parts(fields)
        axis, best = np.unravel_index(np.argmax(np.abs(linear + quadratic)), linear.shape)
        if 0 < best < r.size - 1:
            low, mid, high = (linear + quadratic)[axis, best - 1 : best + 2]
            bend = low - 2 * mid + high
            shift = 0.5 * (low - high) / bend if bend else 0.0
            r_peak = r[best] + shift * r[1]
        else:
            r_peak = r[best]
        linear, quadratic = parts(self._along(np.array([r_peak]), z_nm))
        return float(linear[axis, 0]), float(quadratic[axis, 0]), float(r_peak)

    def _along(self, r: FloatArray, z_nm: float) -> ComplexArray:
        """Field along the polarisation and across it, shape (2, n)."""
        f0, f2 = self._radial(r, z_nm)
        return np.stack([f0 + f2 * r**2, f0 - f2 * r**2])

    @cached_property
    def _axes(self) -> Callable[[float], tuple[FloatArray, ComplexArray]]:
        r = np.linspace(0, self.reach_nm, 8 * (self.table.shape[3] - 1), endpoint=False)
        return lru_cache(_HEIGHTS_KEPT)(lambda z_nm: (r, self._along(r, z_nm)))

    def _geometry(
        self, grid: PixelGrid, x_nm: float, y_nm: float, amplitude: float
    ) -> tuple[Lens, Pixels, float, float, float]:
        """Arguments every image kernel takes after the profile."""
        half = grid.pixel_nm / 2
        far_x = max(abs(grid.x_nm[0] - x_nm), abs(grid.x_nm[-1] - x_nm)) + half
        far_y = max(abs(grid.y_nm[0] - y_nm), abs(grid.y_nm[-1] - y_nm)) + half
        if math.hypot(far_x, far_y) > self.reach_nm:
            raise ConfigError(
                f"the grid extends {math.hypot(far_x, far_y):.0f} nm from the particle, the model "
                f"was built for {self.reach_nm:.0f} nm: give forward_model a larger reach_nm"
            )
        return self.lens, self.pixels(grid), x_nm, y_nm, amplitude


def forward_model(
    config: Config,
    reach_nm: float,
    *,
    z_max_nm: float | None = None,
    nodes: int | None = None,
    like: ForwardModel | None = None,
) -> ForwardModel:
    """Build the forward model of a configuration.

    Parameters
    ----------
    config : Config
        Optics, camera, particle and calibration are used.
    reach_nm : float
        Largest distance from the particle at which images are wanted [nm].
    z_max_nm : float, optional
        Largest height that will be asked for; default the larger of ``fit.z_range_nm`` and
        ``particle.height_nm`` [nm].  It sets the number of quadrature nodes.
    nodes : int, optional
        Quadrature nodes per panel, or of D21's rectangle rule; by default chosen from the phase
        that turns across the pupil.
    like : ForwardModel, optional
        A neighbour in a scan; its Bessel table is taken over where it is the same.

    Returns
    -------
    ForwardModel
        Ready to evaluate.

    Raises
    ------
    ConfigError
        The particle's material has no data at this wavelength, or a calibration has the sign that
        this focus cannot give.
    """
    optics = config.optics
    height = config.particle.height_nm
    matter = material(config.particle, optics.wavelength_nm)
    k = 2 * math.pi / optics.wavelength_nm
    ns, ng, ni = optics.n_sample, optics.n_glass, optics.n_immersion
    paper = optics.convention == "dong2021"
    reciprocal = optics.emission == "reciprocal"
    oil_nm = height - optics.focus_nm - height * ni / ns
    if z_max_nm is None:
        z_max_nm = max(config.fit.z_range_nm[1], height)
    alpha = math.asin(optics.na / ni)
    near = NEAR_CRITICAL * ns < optics.na and ns < ni
    critical = math.asin(ns / ni) if near else None
    step = STEP / (k * optics.na)
    intervals = math.ceil(reach_nm / step) + 1
    turns = k * (optics.na * reach_nm + ns * z_max_nm + ni * abs(oil_nm) * (1 - math.cos(alpha)))
    check_table("the radial table", 6 * (30 + 0.45 * turns) * (intervals + 1))
    if paper:
        theta, weight = rectangle(alpha, nodes or DONG2021_FIELD_NODES)
    else:
        beyond = max(0.0, (alpha - critical) / alpha) if critical else 0.0
        theta, weight = gauss_legendre(
            alpha,
            critical,
            nodes or 16 + math.ceil(0.45 * turns),
            nodes or 14 + math.ceil(0.45 * turns * beyond),
        )
    padding = -theta.size % 4  # the radial kernel takes the nodes in fours
    pupil = make_pupil(
        np.pad(theta, (0, padding), mode="edge"),
        np.pad(weight, (0, padding)),
        wavenumber=k,
        n_immersion=ni,
        n_glass=ng,
        n_sample=ns,
        direction=1.0 if optics.scheme == "iscat" else -1.0,
        reciprocal=reciprocal,
    )
    reflection = (ng - ns) / (ng + ns)
    transmission = math.sqrt(1 - reflection**2) if paper else 2 * ng / (ng + ns)
    if optics.scheme == "darkfield":
        reference = 0.0
    elif optics.scheme == "iscat":
        reference = optics.attenuation * abs(reflection)
    else:
        forward = 2 * ns / (ns + ng) if reciprocal else transmission
        reference = optics.attenuation * forward
    polarizability_nm3 = (
        3 * (KILODALTON_KG / matter.density_kg_m3) / NM**3
        * (matter.permittivity - ns**2) / (matter.permittivity + 2 * ns**2)
    )  # fmt: skip
    if reciprocal:
        incident = transmission if optics.scheme == "iscat" else 1.0
        strength = (ns * k) ** 2 * polarizability_nm3 * incident / (4 * math.pi)
        front = -1j * k * ni / 2
    else:
        eta = math.asin(min(optics.na / (ni if paper else ns), 1.0)) / math.pi
        strength = eta * k**2 / math.sqrt(6 * math.pi) * polarizability_nm3 * transmission
        if paper:
            strength *= ns**2
        front = -1j * k / 2
    axial = pupil.axial
    fixed_oil_nm = oil_nm
    if optics.axial == "refocus":
        axial = axial + (1 - ni / ns) * pupil.oil
        fixed_oil_nm = -optics.focus_nm
    common = pupil.weight * pupil.apodization * np.exp(1j * pupil.oil * fixed_oil_nm)
    common = common * front * strength / (reference or 1.0)
    source = np.stack([common * (pupil.t_s + pupil.t_p_cos), common * (pupil.t_s - pupil.t_p_cos)])
    same = (
        like is not None
        and like.step_nm == step
        and like.table.shape[3] == intervals + 1
        and np.array_equal(like.pupil.transverse, pupil.transverse)
    )
    table = like.table if same and like else bessel_table(pupil.transverse, step, intervals)
    points, weights = np.polynomial.legendre.leggauss(config.camera.samples_per_pixel)
    model = ForwardModel(
        optics=optics,
        material=matter,
        pupil=pupil,
        height_nm=height,
        reference=reference,
        rho=1.0 if reference else 0.0,
        source=source,
        axial=axial,
        strength=strength,
        table=table,
        step_nm=step,
        z_range_nm=(min(config.fit.z_range_nm[0], height), z_max_nm),
        samples=(points / 2, weights / 2),
    )
    if config.calibration is None:
        return model
    return replace(model, scale=_mass_scale(model, config.calibration))


def check_table(what: str, numbers: float) -> None:
    """Refuse a table that would not fit into the memory, before it is allocated.

    Parameters
    ----------
    what : str
        What the message calls it.
    numbers : float
        How many 8-byte numbers it holds.

    Raises
    ------
    ConfigError
        It is larger than `TABLE_LIMIT_MB`.
    """
    megabytes = 8e-6 * numbers
    if megabytes > TABLE_LIMIT_MB:
        raise ConfigError(
            f"{what} of the model would take {megabytes:,.0f} MB, more than {TABLE_LIMIT_MB} MB: "
            "check that optics.wavelength_nm, optics.focus_nm, particle.height_nm, "
            "fit.z_range_nm, fit.roi_nm and camera.pixel_size_nm are in nanometres, or take a "
            "smaller field or range"
        )


def _mass_scale(model: ForwardModel, line: Calibration) -> MassScale:
    if not model.rho:
        raise ConfigError("[calibration] relates contrast to mass; dark field has no contrast")
    weak = 1e-6 / math.sqrt(model.collected_area_nm2(model.height_nm, 1.0))
    linear, quadratic, _ = model._peak(model.height_nm, weak)
    linear, quadratic = linear / weak, quadratic / weak**2
    if linear * line.gradient_per_kda < 0:
        seen = "bright" if linear > 0 else "dark"
        raise ConfigError(
            f"calibration.gradient_per_kda = {line.gradient_per_kda:g} has the wrong sign: with "
            f"optics.focus_nm = {model.optics.focus_nm:g} the model's particles are {seen}; "
            "change the sign or the focus"
        )
    return MassScale(line, linear, quadratic)
