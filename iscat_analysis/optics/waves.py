"""The scattered field around one particle, per unit amplitude and over the reference.

Two tables have the same interface.  If only the polarisation gives the pupil a direction, it has a
`RadialField`: quintics along r.  Any other pupil has a `LatticeField`.  Both give the kernels a
profile at a height, a table of profiles along z, and the field at any point.

Derivatives with respect to the microscope are analytic.  Every parameter of the optics changes the
light of each ray in the pupil.  The derivative of the field is the integral of this change: a
factor inside the pupil, and the light on an edge that moves (aperture, mask).  Each derivative is
tabulated on the lattice of the field, once for each height, and combined with the field at the
pixels.

The pupil of the microscope and its effect on the scattered light (microscope.md, section 2).

Polarisation, analyser, mask, aberrations and the phase of the reference are evaluated on a
quadrature of polar angles θ and azimuths φ; the field is computed from a Fourier series along φ.

Light that is not one plane wave of one wavelength: a cone of illumination, and a spectrum.

A cone.  Every point of the lamp in the illumination's aperture makes a plane wave exp(iq·r) of its
own, and waves of different points do not interfere.  The reference carries exp(iq·r) to the camera;
the particle is driven with exp(iq·r_p), and its light is the field of physics.md.  With Δ the place
on the camera relative to the particle, the interference has the factor exp(−iq·Δ).  Its average
over a disc of illumination that is filled evenly, |q| ≤ κ = k·illumination_na, is

    C(Δ) = 2 J_1(κΔ)/(κΔ),        s = 2ρ a Re [C e_u] + a² (|e_u|² + |e_v|²):

the interference fades away from the particle, the scattered light itself does not.  Neglected, all
of second order in the angle: the phase k·d·(1 − cos) of the reference over the defocus d (1 % of a
turn at NA 0.1 and 1 µm), the same over the height, and how reflection and polarisation change.

The kernels take a field e and give 2ρ a Re e_0 + a² Σ|e_c|².  With e_0 = C e_u this lacks
(1 − C²)|e_u|², which two more components give, h_x e_u and h_y e_u, h = (Δ/|Δ|)·√(1 − C²): smooth,
because 1 − C² begins with (κΔ/2)².

A spectrum.  Waves of different wavelength do not interfere either: fields and their squares are
averaged over a normal spectrum of the full width at half maximum `bandwidth_nm`, by three nodes of
Gauss and Hermite.  The average of the square exceeds the square of the average by the variance of
the field, (σ ∂e/∂λ)², another component.

A measured image of a particle, in place of a computed one.

In any microscope, the light comes through the pupil.  The interference of a faint particle, 2 Re e,
is therefore band-limited at the largest wave vector in the glass, so that samples on a lattice
determine it between the pixels too.  The lattice is that of any other pupil
(`iscat_analysis._kernels.lattice`), with a real field: the imaginary part does not show in the
interference and is not known.  For the scattered light itself, |e|², its lower limit (Re e)² is
used.
"""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from iscat_analysis._kernels.hessian import ROWS, signal_hessian
from iscat_analysis._kernels.image import signal_image
from iscat_analysis._kernels.lattice import (
    BENT,
    FILTER,
    LATTICE_STEP,
    lattice_half,
    lattice_waves,
    radial_waves,
    reach_of_samples,
    sampled,
    sum_waves,
    undo_window,
    window,
)
from iscat_analysis._kernels.lens import LatticeLens, Pixels, RoundLens
from iscat_analysis._kernels.pupil import Pupil, gauss_legendre, make_pupil, orders, zernike
from iscat_analysis._kernels.radial import POWERS, STEP, AxialTable, bessel_table, radial_profile
from iscat_analysis._kernels.radial_rows import largest_signal
from iscat_analysis.config import MEASURABLE, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import LastUsed, kept
from iscat_analysis.optics.scatterers import ANGLES, Rod, Sphere
from iscat_analysis.reading import LARGEST_TEMPLATE_BYTES, npz_of, read_bytes
from iscat_analysis.records import ComplexArray, FloatArray

if TYPE_CHECKING:
    from iscat_analysis.optics.model import ForwardModel

NEAR_CRITICAL = 0.98
"""NA over n_sample above which the quadrature treats the critical angle."""

NEGLIGIBLE = 1e-8
"""Share of the pupil's light amplitude below which azimuthal harmonics are left out."""

_FEWEST_AZIMUTHS, _MOST_AZIMUTHS = 64, 1024


@dataclass(frozen=True)
class Aperture:
    """A pupil on a quadrature; build it with `aperture`."""

    optics: Optics
    pupil: Pupil
    scatterer: Sphere | Rod | None = None

    @property
    def wavenumber(self) -> float:
        """2π over the vacuum wavelength [rad/nm]."""
        return 2 * math.pi / self.optics.wavelength_nm

    @property
    def rho(self) -> FloatArray:
        """Radius in the pupil, 1 at its edge, shape (n,)."""
        return self.optics.n_immersion * np.sin(self.pupil.theta) / self.optics.na

    @property
    def is_round(self) -> bool:
        """Whether neither an aberration nor the particle depends on the azimuth."""
        return not isinstance(self.scatterer, Rod) and all(orders(j)[1] == 0 for j, _ in self.terms)

    @property
    def terms(self) -> tuple[tuple[int, float], ...]:
        """Noll's index and size [nm] of every aberration."""
        return tuple((int(k[1:]), v) for k, v in self.optics.aberrations_nm.items() if v)

    @property
    def transmission(self) -> FloatArray:
        """Amplitude that the mask lets through, shape (n,)."""
        inside = self.optics.n_immersion * np.sin(self.pupil.theta) < self.optics.mask_na
        return np.where(inside, self.optics.attenuation, 1.0)

    def paths_nm(self, phi: FloatArray) -> FloatArray:
        """Aberration W and ∂W/∂ρ [nm], shape (2, n, phi.size)."""
        total = np.zeros((2, self.pupil.theta.size, phi.size))
        for j, size in self.terms:
            total += size * np.array(zernike(j, self.rho[:, None], phi))
        return total

    def polarised(self, phi: FloatArray) -> ComplexArray:
        """Wave without aberrations: components along the reference's polarisation and across it.

        Shapes: `phi` (m,), result (2, n, m).
        """
        if isinstance(self.scatterer, Rod):
            return self._of_dipole(phi, self.scatterer.dipole(self.optics))
        p, s = self.pupil.t_p_cos[:, None], self.pupil.t_s[:, None]
        if self.optics.polarization == "circular":
            return np.stack([(p + s) / 2 * np.ones(phi.size), (p - s) / 2 * np.exp(2j * phi)])
        turned = phi - math.radians(self.optics.polarization_deg)
        c, d = np.cos(turned), np.sin(turned)
        return np.stack([p * c**2 + s * d**2, (p - s) * (c * d)])

    def _of_dipole(self, phi: FloatArray, dipole: ComplexArray) -> ComplexArray:
        """Wave of a dipole along the polarisation, across it and along the optical axis.

        Shapes: `phi` (m,), `dipole` (3,), result (2, n, m).
        """
        if self.optics.polarization == "circular":
            meridian = np.exp(np.multiply.outer([-1j, 1j], phi)) / math.sqrt(2)
        else:
            turned = phi - math.radians(self.optics.polarization_deg)
            meridian = np.stack([np.cos(turned), np.sin(turned)]).astype(complex)
        p, s, q = (
            part[:, None] for part in (self.pupil.t_p_cos, self.pupil.t_s, self.pupil.t_p_sin)
        )
        radial = meridian.conj().T @ dipole[:2]
        across = s[None] * (dipole[:2, None, None] - meridian[:, None] * radial)
        return np.asarray(across + meridian[:, None] * (p * radial + q * dipole[2]))

    def turning(self, phi: FloatArray, name: str) -> ComplexArray:
        """Slope of `polarised` along an angle [1/degree], shape (2, n, m).

        It is the angle of linear polarisation, for round particles, or one of a rod.
        """
        if isinstance(self.scatterer, Rod):
            return self._of_dipole(phi, self.scatterer.dipole_slope(self.optics, name))
        difference = (self.pupil.t_p_cos - self.pupil.t_s)[:, None]
        turned = 2 * (phi - math.radians(self.optics.polarization_deg))
        slope = np.stack([difference * np.sin(turned), -difference * np.cos(turned)])
        return np.asarray(slope * math.radians(1.0))

    def seen(self, phi: FloatArray, *, masked: bool = True, along: str = "") -> ComplexArray:
        """Components that reach the camera, with mask and aberrations, or their slopes `along`.

        Shapes: result (1 or 2, n, m).
        """
        whole = self.turning(phi, along) if along else self.polarised(phi)
        components = whole[: 1 if self.optics.analyzer else 2]
        wave: ComplexArray = components * np.exp(1j * self.wavenumber * self.paths_nm(phi)[0])
        return wave * self.transmission[:, None] if masked else wave

    def azimuths(self) -> FloatArray:
        """Azimuths that resolve the pupil's finest harmonic, equally spaced from 0 [rad]."""
        count = _FEWEST_AZIMUTHS
        while True:
            phi: FloatArray = np.arange(count, dtype=np.float64) * (2 * math.pi / count)
            size = np.abs(np.fft.fft(self.seen(phi), axis=2)).sum((0, 1))
            fine = size[count // 4 : -(count // 4)]
            if fine.max() < NEGLIGIBLE * size.sum():
                return phi
            count *= 2
            if count > _MOST_AZIMUTHS:
                raise ConfigError(
                    "optics.aberrations_nm: these terms turn the phase too fast across the pupil "
                    "to be computed; lower them"
                )


def harmonics(
    waves: ComplexArray, weight: FloatArray, negligible: float = NEGLIGIBLE
) -> ComplexArray:
    """Fourier series along the azimuth, as far as it is not negligible.

    Shapes: `waves` (k, n, m), `weight` (n,), result (k, 2·M + 1, n).
    """
    series = np.fft.fft(waves, axis=2) / waves.shape[2]
    size = (np.abs(series) * weight[:, None]).sum(1)
    half = waves.shape[2] // 2 - 1
    both = np.maximum(size[:, 1 : half + 1], size[:, : -half - 1 : -1])
    kept = np.nonzero((both > negligible * size.sum(1, keepdims=True)).any(0))[0]
    largest = int(kept[-1]) + 1 if kept.size else 0
    order = np.arange(-largest, largest + 1)
    return np.ascontiguousarray(np.moveaxis(series[:, :, order], 2, 1))


def critical_angle(optics: Optics) -> float | None:
    """Return the angle in the oil at which light grazes the sample."""
    near = NEAR_CRITICAL * optics.n_sample < optics.na and optics.n_sample < optics.n_immersion
    return math.asin(optics.n_sample / optics.n_immersion) if near else None


def aperture_on(
    optics: Optics, theta: FloatArray, weight: FloatArray, scatterer: Sphere | Rod | None = None
) -> Aperture:
    """Make the pupil on given angles, with the light of a dipole, a sphere or a rod.

    Shapes: `theta, weight` (n,).
    """
    wavenumber, direction = 2 * math.pi / optics.wavelength_nm, optics.direction
    pupil = make_pupil(
        theta,
        weight,
        wavenumber=wavenumber,
        n_immersion=optics.n_immersion,
        n_glass=optics.n_glass,
        n_sample=optics.n_sample,
        direction=direction,
        reciprocal=optics.emission == "reciprocal",
    )
    if isinstance(scatterer, Sphere):
        cos_s = pupil.axial / (wavenumber * optics.n_sample) - direction
        along, across = scatterer.pattern(cos_s, direction, optics.n_sample, wavenumber)
        pupil = replace(pupil, t_p_cos=pupil.t_p_cos / cos_s * along, t_s=pupil.t_s * across)
    return Aperture(optics, pupil, scatterer)


def aperture(
    optics: Optics, nodes: int, nodes_above: int, scatterer: Sphere | Rod | None = None
) -> Aperture:
    """Make the pupil on panels that end at the mask's edge and at the critical angle."""
    alpha = math.asin(optics.na / optics.n_immersion)
    edge = math.asin(optics.mask_na / optics.n_immersion)
    theta, weight = gauss_legendre(alpha, critical_angle(optics), nodes, nodes_above, edge)
    return aperture_on(optics, theta, weight, scatterer)


def weight_on(
    opening: Aperture, factor: complex, oil_nm: float
) -> tuple[ComplexArray, ComplexArray]:
    """Weigh the components in the field's integral at z = 0, and give the phase per height.

    Shapes: `weight, axial` (n,).
    """
    optics, pupil = opening.optics, opening.pupil
    axial = pupil.axial
    if optics.axial == "refocus":
        axial = axial + (1 - optics.n_immersion / optics.n_sample) * pupil.oil
    weight = pupil.weight * pupil.apodization * np.exp(1j * pupil.oil * oil_nm) * factor
    return weight, axial


FWHM = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a normal distribution over its standard deviation."""

_NODES = math.sqrt(3.0)  # places of the outer nodes, in standard deviations
_SHARES = (1 / 6, 2 / 3, 1 / 6)
_DIFFERENCE = 1 / (2 * _NODES)  # weight of the outer nodes in σ ∂e/∂λ
_SMALL = 1e-3  # of κΔ, below which the first terms of series are exact


def in_cone(fields: FloatArray, kappa: float, x_nm: FloatArray, y_nm: FloatArray) -> FloatArray:
    """Give the components of fields whose light is a cone, κ its largest wavenumber [rad/nm].

    Shapes: `fields` (n, components, 2, *points), `x_nm, y_nm` broadcast to points.
    """
    if not kappa:
        return fields
    turn = kappa * np.hypot(x_nm, y_nm)
    far = np.maximum(turn, _SMALL)
    coherence = np.where(turn > _SMALL, 2 * j1(far) / far, 1 - turn**2 / 8)
    lost = np.sqrt(np.maximum(1 - (2 * j1(far) / far) ** 2, 0.0)) / far
    across = np.stack([coherence, *(kappa * lost * axis for axis in (x_nm, y_nm))])
    along = fields[:, :1] * across[None, :, None]
    return np.concatenate([along[:, :1], fields[:, 1:], along[:, 1:]], axis=1)


class Ray(NamedTuple):
    """Light of one wavelength in the pupil: components by angle and azimuth, and their weights."""

    waves: ComplexArray
    weight: ComplexArray
    axial: ComplexArray
    transverse: FloatArray


def cone_of(optics: Optics) -> float:
    """Give the largest wavenumber across the axis of the illumination [rad/nm]."""
    return 2 * math.pi / optics.wavelength_nm * optics.illumination_na


def is_coherent(optics: Optics) -> bool:
    """Whether the light is one plane wave of one wavelength."""
    return not optics.illumination_na and not optics.bandwidth_nm


def band_of(optics: Optics) -> float:
    """Largest wavenumber across the axis of what interferes [rad/nm]."""
    shortest = min(each.wavelength_nm for each in spectrum(optics))
    return 2 * math.pi / shortest * (optics.na + optics.illumination_na)


def spectrum(optics: Optics) -> list[Optics]:
    """Give optics at the wavelengths of their spectrum, the middle one first."""
    far = _NODES * optics.bandwidth_nm / FWHM
    places = (0.0, -far, far) if far else (0.0,)
    return [
        optics.model_copy(update={"wavelength_nm": optics.wavelength_nm + place})
        for place in places
    ]


def factor_at(factor: complex, optics: Optics, middle: Optics) -> complex:
    """Factor of the field at a wavelength: a dipole radiates k², and its far field has another k.

    The material is that of the wavelength in the middle.
    """
    return factor * (middle.wavelength_nm / optics.wavelength_nm) ** 3


def over_spectrum(rays: Sequence[Ray]) -> Ray:
    """Put the light of all wavelengths of `spectrum` together, with the component it adds.

    Shapes: `waves` of a ray (n, components, angles, azimuths).
    """
    if len(rays) == 1:
        return rays[0]
    shares = (_SHARES[1], _SHARES[0], _SHARES[2])
    signs = (0.0, -_DIFFERENCE, _DIFFERENCE)
    waves = [
        np.concatenate([ray.waves, sign / share * ray.waves[:, :1]], axis=1)
        for ray, share, sign in zip(rays, shares, signs, strict=True)
    ]
    weight = [share * ray.weight for ray, share in zip(rays, shares, strict=True)]
    return Ray(
        np.concatenate(waves, axis=2),
        np.concatenate(weight),
        np.concatenate([ray.axial for ray in rays]),
        np.concatenate([ray.transverse for ray in rays]),
    )


_MOST_LATTICES = 4  # cached lattices, one for each number of orders
_AXIAL_RATE = 1e-3  # a rate [rad/nm] for tables along z, although nothing changes along z
_STORED = ("contrast", "sigma", "step_nm", "pixel_nm", "roi_nm", "peak_se", "sights", "side")
_LARGEST_NUMBER = 1e9  # of its numbers
_SAME_PIXEL = 1e-3  # relative difference of pixel sizes that is rounding


@dataclass(frozen=True, eq=False)
class Template:
    """The measured contrast of a faint particle, as pixels would see it that are points.

    `side` is that of the pixels' active square over their spacing, of which the picture was freed;
    0 in files of versions that did not do that, whose picture is used as it is.
    """

    contrast: FloatArray
    sigma: FloatArray
    step_nm: float
    pixel_nm: float
    roi_nm: float
    peak_se: float
    sights: int
    side: float = 1.0

    def to_bytes(self) -> bytes:
        """Give the content of an ``.npz`` file, the same bytes for the same template."""
        out = io.BytesIO()
        values: dict[str, Any] = {k: np.asarray(getattr(self, k)) for k in _STORED}
        np.savez(out, **values)
        return out.getvalue()

    @classmethod
    def read(cls, path: Path) -> Template:
        """Read a file that holds the bytes of `to_bytes`."""
        try:
            content = read_bytes(path, LARGEST_TEMPLATE_BYTES)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
        return _parsed(str(path), content)

    def refuse_mismatch(self, pixel_nm: float | None, roi_nm: float) -> None:
        """Refuse a pixel size or a square for which the template was not measured."""
        if pixel_nm is not None and abs(pixel_nm / self.pixel_nm - 1) > _SAME_PIXEL:
            raise ConfigError(
                f"optics.template was measured with pixels of {self.pixel_nm:g} nm, and "
                f"camera.pixel_size_nm = {pixel_nm:g}: run `iscat calibrate optics --measured` on "
                "a movie with these pixels"
            )
        if roi_nm > self.roi_nm * (1 + _SAME_PIXEL):
            raise ConfigError(
                f"optics.template is known in a square of {self.roi_nm:g} nm, and fit.roi_nm = "
                f"{roi_nm:g}: lower fit.roi_nm, or measure a larger template with it"
            )


def sha256_of(content: bytes) -> str:
    """Give the checksum of a template, which ``optics.toml`` stores."""
    return hashlib.sha256(content).hexdigest()


@lru_cache(_MOST_LATTICES)
def _parsed(name: str, content: bytes) -> Template:
    try:
        stored = npz_of(content, LARGEST_TEMPLATE_BYTES)
        values: dict[str, Any] = {key: stored[key] for key in _STORED if key != "side"}
        values["side"] = stored.get("side", 0.0)
        for key in _STORED[2:]:
            values[key] = float(values[key])
        values["sights"] = int(values["sights"])
        picture, error = values["contrast"], values["sigma"]
        numbers = [picture, error, *(values[key] for key in _STORED[2:])]
        if not (picture.ndim == 2 and picture.shape == error.shape == picture.shape[::-1]):
            raise ValueError("no picture")
        if not all(bool((np.abs(number) <= _LARGEST_NUMBER).all()) for number in numbers):
            raise ValueError("no numbers")
        if not 0 <= values["side"] <= 1:
            raise ValueError("no share")
        if not min(values["step_nm"], values["pixel_nm"], values["roi_nm"]) > 1 / _LARGEST_NUMBER:
            raise ValueError("no lengths")
        values["contrast"], values["sigma"] = picture.astype(float), error.astype(float)
    except (KeyError, ValueError, TypeError, OverflowError):
        raise ConfigError(
            f"{name}: is no template of `iscat calibrate optics --measured`"
        ) from None
    return Template(**values)


@dataclass(frozen=True, eq=False)
class MeasuredField:
    """Field of a measured image, the same at all heights; used like `RadialField`."""

    template: Template
    gain: float
    reach_nm: float

    @property
    def axial(self) -> NDArray[np.complex128]:
        """Phases per height, for tables along z; nothing changes along z [rad/nm]."""
        return np.array([-_AXIAL_RATE, _AXIAL_RATE], dtype=np.complex128)

    @property
    def half(self) -> int:
        """Nodes on either side of the particle."""
        return lattice_half(self.reach_nm, self.template.step_nm)

    @property
    def width(self) -> int:
        """Numbers in the profile of one order."""
        return 2 * (2 * self.half + 1) ** 2

    def lens(self, rho: float) -> LatticeLens:
        """How the kernels make a signal of a profile, with the reference ρ."""
        return LatticeLens(1 / self.template.step_nm, rho, self.half, 1, window()[0])

    def profile(self, _z_nm: float, orders: int) -> FloatArray:
        """Profile at any height, shape (2·orders, nodes, nodes)."""
        return self._profile(orders)

    def profiles(self, heights_nm: FloatArray, _kappa: float) -> FloatArray:
        """Profiles with ∂/∂z and ∂²/∂z², shape (n, 3, channels, width)."""
        one = self.profile(0.0, 3).reshape(1, 3, 2, -1)
        return np.repeat(one, heights_nm.size, axis=0)

    @kept(_MOST_LATTICES)
    def _profile(self, orders: int) -> FloatArray:
        """Sample Re e on a lattice over the reach, and undo the smoothing of its window."""
        side = 2 * (self.half + FILTER) + 1
        samples = np.zeros((side, side))
        known = self.template.contrast.T * (self.gain / 2)
        have = (known.shape[0] - 1) // 2
        half = min(have, self.half + FILTER)
        inner, there = (slice(c - half, c + half + 1) for c in (self.half + FILTER, have))
        samples[inner, inner] = known[there, there]
        out = np.zeros((2 * orders, 2 * self.half + 1, 2 * self.half + 1))
        out[:1] = undo_window(samples[None])
        return out

    def components(
        self, dx_nm: FloatArray, dy_nm: FloatArray, _z_nm: float
    ) -> NDArray[np.complex128]:
        """Real field at points, shape (1, *dx_nm.shape)."""
        dx, dy = (np.ascontiguousarray(d, dtype=float) for d in np.broadcast_arrays(dx_nm, dy_nm))
        out = np.empty((2 * BENT, dx.size))
        lattice_waves(self._profile(3), self.lens(1.0), 0, dx.ravel(), dy.ravel(), out)
        return np.asarray(out[0].reshape(1, *dx.shape), dtype=np.complex128)

    def peak(self, _z_nm: float, amplitude: float, rho: float) -> tuple[float, float]:
        """Parts of the signal of largest magnitude that are linear and quadratic in a."""
        top = self._sign * self.gain * amplitude
        return rho * top, top**2 / 4

    @cached_property
    def _sign(self) -> float:
        contrast = self.template.contrast
        return float(np.sign(contrast.flat[np.argmax(np.abs(contrast))]))


def lattice_step_nm(wavelength_nm: float, n_glass: float) -> float:
    """Step of a lattice that resolves light of a wavelength from any pupil."""
    return LATTICE_STEP * wavelength_nm / (2 * math.pi * n_glass)


TABLE_LIMIT_MB = 400
"""Largest table of the model: a length in the wrong unit would fill the memory."""

_HEIGHTS_KEPT = 8  # cached profiles; if z is fixed, every image needs the same one
_PEAK_STEP = 1 / 3  # of the lattice: the grid on which the largest signal is searched
_PEAK_POINTS = 8  # the same, in each step of the radial table
_HEIGHTS_AT_ONCE = 16  # heights of the axial table made together
# Bessel matrices: models that differ in focus or phase need the same ones
_TABLES: LastUsed[FloatArray] = LastUsed(16_000_000)


def check_table(what: str, numbers: float) -> None:
    """Refuse a table that would not fit into the memory, before it is allocated."""
    megabytes = 8e-6 * numbers
    if megabytes > TABLE_LIMIT_MB:
        raise ConfigError(
            f"{what} of the model would take {megabytes:,.0f} MB, more than {TABLE_LIMIT_MB} MB: "
            "check that optics.wavelength_nm, optics.focus_nm, particle.height_nm, "
            "fit.z_range_nm, fit.roi_nm and camera.pixel_size_nm are in nanometres, or take a "
            "smaller field or range"
        )


@dataclass(frozen=True)
class RadialField:
    """Field of a pupil whose only direction is that of the polarisation."""

    source: ComplexArray
    axial: ComplexArray
    transverse: FloatArray
    table: FloatArray
    step_nm: float
    psi: float
    circular: bool
    analyzer: bool

    @property
    def reach_nm(self) -> float:
        """Largest distance from the particle that the table covers [nm]."""
        return self.step_nm * float(self.table.shape[3] - 1)

    @property
    def width(self) -> int:
        """Numbers in the profile of one order."""
        return 24 * (int(self.table.shape[3]) - 1)

    def lens(self, rho: float) -> RoundLens:
        """How the kernels make a signal of a profile, with the reference ρ."""
        seen = 0.0 if self.analyzer else 1.0
        linear = 0.0 if self.circular else 1.0
        return RoundLens(
            1 / self.step_nm, rho, math.cos(self.psi), math.sin(self.psi),
            linear, linear * seen, (1 - linear) * seen,
        )  # fmt: skip

    @kept(_HEIGHTS_KEPT)
    def profile(self, z_nm: float, orders: int) -> FloatArray:
        """Profile at a height, shape (intervals, 6, 4·orders)."""
        return self._profile(z_nm, orders, 0.0)

    def _profile(self, z_nm: float, orders: int, kappa: float) -> FloatArray:
        points = self.table.shape[3]
        nodes = np.empty((4 * orders, 3 * points))
        out = np.empty((points - 1, POWERS, 4 * orders))
        radial_profile(self.table, self.source, self.axial - kappa, z_nm, orders, nodes, out)
        return out

    def profiles(self, heights_nm: FloatArray, kappa: float) -> FloatArray:
        """Profiles with ∂/∂z and ∂²/∂z² without exp(iκz), shape (n, 3, channels, width)."""
        every = (self._profile(float(z), 3, kappa) for z in heights_nm)
        return np.ascontiguousarray([np.moveaxis(one, 2, 0).reshape(3, 4, -1) for one in every])

    def components(self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float) -> ComplexArray:
        """Components of the field at points, shape (1 or 2, *dx_nm.shape); see `ForwardModel`."""
        c, s = math.cos(self.psi), math.sin(self.psi)
        u, v = c * dx_nm + s * dy_nm, c * dy_nm - s * dx_nm
        f0, f2 = self._radial(np.hypot(u, v), z_nm)
        if self.circular:
            both = np.stack([f0, f2 * (u + 1j * v) ** 2])
        else:
            both = np.stack([f0 + f2 * (u**2 - v**2), f2 * (2 * u * v)])
        return both[:1] if self.analyzer else both

    def peak(
        self, z_nm: float, amplitude: float, rho: float, profile: FloatArray | None = None
    ) -> tuple[float, float]:
        """Parts of the signal of largest magnitude that are linear and quadratic in a."""
        if profile is None:
            profile = self.profile(z_nm, 1)
        parts: tuple[float, float] = largest_signal(
            profile, self.lens(rho), _PEAK_POINTS, amplitude
        )
        return parts

    def _radial(self, r: FloatArray, z_nm: float) -> tuple[ComplexArray, ComplexArray]:
        """F0 and F2 at distances r, from the table."""
        profile = self.profile(z_nm, 1)
        index = np.minimum((r / self.step_nm).astype(int), profile.shape[0] - 1)
        t = r / self.step_nm - index
        powers = t[..., None] ** np.arange(POWERS)
        values = np.einsum("...p,...pc->...c", powers, profile[index])
        return values[..., 0] + 1j * values[..., 1], values[..., 2] + 1j * values[..., 3]


@dataclass(frozen=True)
class LatticeField:
    """Field of any pupil."""

    harmonics: ComplexArray
    axial: ComplexArray
    transverse: FloatArray
    band: float
    reach_nm: float
    cone: float = 0.0

    @property
    def count(self) -> int:
        """Components whose light is added up; the first interferes with the reference."""
        return len(self.harmonics) + (2 if self.cone else 0)

    @property
    def step_nm(self) -> float:
        """Step of the lattice [nm]."""
        return LATTICE_STEP / self.band

    @property
    def radial_step_nm(self) -> float:
        """Step of the radial functions [nm]."""
        return STEP / self.band

    @property
    def half(self) -> int:
        """Nodes on either side of the particle."""
        return lattice_half(self.reach_nm, self.step_nm)

    @property
    def width(self) -> int:
        """Numbers in the profile of one order."""
        return 2 * self.count * (2 * self.half + 1) ** 2

    def lens(self, rho: float) -> LatticeLens:
        """How the kernels make a signal of a profile, with the reference ρ."""
        return LatticeLens(1 / self.step_nm, rho, self.half, self.count, window()[0])

    @kept(_HEIGHTS_KEPT)
    def profile(self, z_nm: float, orders: int) -> FloatArray:
        """Profile at a height, shape (channels, nodes, nodes)."""
        side = 2 * self.half + 1
        check_table("the field around a particle", orders * self.width)
        return self._stack(np.array([z_nm]), orders, 0.0).reshape(-1, side, side)

    def profiles(self, heights_nm: FloatArray, kappa: float) -> FloatArray:
        """Profiles with ∂/∂z and ∂²/∂z² without exp(iκz), shape (n, 3, channels, width)."""
        parts = [
            self._stack(heights_nm[i : i + _HEIGHTS_AT_ONCE], 3, kappa)
            for i in range(0, heights_nm.size, _HEIGHTS_AT_ONCE)
        ]
        return np.concatenate(parts).reshape(heights_nm.size, 3, 2 * self.count, -1)

    def lattices(
        self, harmonics: ComplexArray, transverse: FloatArray, coarser: int = 1
    ) -> FloatArray:
        """Coefficients of any fields in this pupil, all their components, (k, 2, nodes, nodes)."""
        step = coarser * self.radial_step_nm
        waves = self._waves(harmonics, transverse, step)
        fields = sampled(waves, step, self.step_nm, self.half)
        side = fields.shape[2]
        axis = self.step_nm * (np.arange(side, dtype=np.float64) - side // 2)
        grouped = fields.reshape(-1, len(self.harmonics), 2, side, side)
        whole = in_cone(grouped, self.cone, axis[:, None], axis)
        out = undo_window(whole.reshape(-1, side, side))
        return out.reshape(-1, 2, side - 2 * FILTER, side - 2 * FILTER)

    def _waves(
        self, harmonics: ComplexArray, transverse: FloatArray, radial_step_nm: float
    ) -> FloatArray:
        reach = reach_of_samples(self.reach_nm, self.step_nm)
        intervals = math.ceil(reach / radial_step_nm)
        return radial_waves(harmonics, transverse, radial_step_nm, intervals)

    def _stack(self, heights_nm: FloatArray, orders: int, kappa: float) -> FloatArray:
        """Lattices of every height, order and component."""
        weights = self._weights(heights_nm, orders, kappa)
        return self.lattices(weights.reshape(-1, *self.harmonics.shape[1:]), self.transverse)

    def _weights(self, heights_nm: FloatArray, orders: int, kappa: float) -> ComplexArray:
        """Harmonics at heights, times (i·axial)^order: (heights, orders, components, 2M+1, n)."""
        rate = 1j * (self.axial - kappa)
        turn = np.exp(np.multiply.outer(heights_nm, rate))[:, None] * (
            rate ** np.arange(orders)[:, None]
        )
        return turn[:, :, None, None] * self.harmonics

    def components(self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float) -> ComplexArray:
        """Components of the field at points, shape (1 or 2, *dx_nm.shape); see `ForwardModel`."""
        dx, dy = (np.ascontiguousarray(d, dtype=float).ravel() for d in (dx_nm, dy_nm))
        out = np.empty((dx.size, 2, len(self.harmonics)))
        sum_waves(self._waves_at(z_nm), 1 / self.radial_step_nm, dx, dy, out)
        parts = in_cone(out.transpose(2, 1, 0)[None], self.cone, dx, dy)[0]
        return np.asarray(parts[:, 0] + 1j * parts[:, 1]).reshape(-1, *np.shape(dx_nm))

    @kept(_HEIGHTS_KEPT)
    def _waves_at(self, z_nm: float) -> FloatArray:
        weights = self._weights(np.array([z_nm]), 1, 0.0)[0, 0]
        return self._waves(weights, self.transverse, self.radial_step_nm)

    def peak(
        self, z_nm: float, amplitude: float, rho: float, profile: FloatArray | None = None
    ) -> tuple[float, float]:
        """Parts of the signal of largest magnitude that are linear and quadratic in a.

        The largest signal on a fine grid is the start of Newton's method.
        """
        grid = self._grid
        if profile is None:
            profile = self.profile(z_nm, 3)
            along, power = self._plane(z_nm)
        else:
            along, power = self._parts(profile, grid)
        signal = 2 * rho * amplitude * along + amplitude**2 * power
        row, column = np.unravel_index(np.argmax(np.abs(signal)), signal.shape)
        x, y = float(grid.x[column]), float(grid.y[row])
        lens, step = self.lens(rho), float(grid.x[1] - grid.x[0])
        point, one, theta = np.zeros(1), np.ones(1), np.array([0.0, 0.0, z_nm, amplitude])
        out = np.empty((1, ROWS, 1))
        if 0 < row < grid.y.size - 1 and 0 < column < grid.x.size - 1:
            # Newton's steps
            for _ in range(4):
                pixels = Pixels(np.array([x]), np.array([y]), point, one)
                signal_hessian(profile, lens, pixels, theta, out)
                # the particle's derivatives: those of the camera's position with the sign changed
                _, s_x, s_y, _, _, s_xx, s_xy, s_yy = out[0, :8, 0]
                move = np.linalg.solve([[s_xx, s_xy], [s_xy, s_yy]], [s_x, s_y])
                x, y = (np.array([x, y]) + np.clip(move, -step, step)).tolist()
        at_top = self._parts(profile, Pixels(np.array([x]), np.array([y]), point, one))
        re, square = (float(part[0, 0]) for part in at_top)
        return 2 * rho * amplitude * re, amplitude**2 * square

    @cached_property
    def _grid(self) -> Pixels:
        """Points on which the largest signal is searched."""
        half = int(self.reach_nm / math.sqrt(2) / (self.step_nm * _PEAK_STEP))
        axis = self.step_nm * _PEAK_STEP * np.arange(-half, half + 1, dtype=np.float64)
        return Pixels(axis, axis, np.zeros(1), np.ones(1))

    @kept(_HEIGHTS_KEPT)
    def _plane(self, z_nm: float) -> tuple[FloatArray, FloatArray]:
        return self._parts(self.profile(z_nm, 3), self._grid)

    def _parts(self, profile: FloatArray, pixels: Pixels) -> tuple[FloatArray, FloatArray]:
        """Re e_u and |e|² at points, from a profile."""
        above, below = np.empty((2, pixels.y.size, pixels.x.size))
        for sign, out in ((1.0, above), (-1.0, below)):
            signal_image(profile, self.lens(1.0), pixels, np.array([0.0, 0.0, 0.0, sign]), out)
        return (above - below) / 4, (above + below) / 2


Field = RadialField | LatticeField | MeasuredField


def axial_table(field: Field, z_range_nm: tuple[float, float]) -> AxialTable:
    """Profiles along z, for the kernels that interpolate there."""
    low, high = z_range_nm
    kappa = float(field.axial.real.min() + field.axial.real.max()) / 2
    step = STEP / float(np.abs(field.axial - kappa).max())
    count = max(math.ceil((high - low) / step), 1) + 1
    check_table("the table along z", 3.0 * count * field.width)
    heights = field.profiles(low + step * np.arange(count, dtype=np.float64), kappa)
    heights *= (step ** np.arange(3))[:, None, None]
    return AxialTable(heights, low, step, kappa)


def field_of(
    opening: Aperture, factor: complex, oil_nm: float, reach_nm: float
) -> RadialField | LatticeField:
    """Tabulate the field of a pupil, as the pupil's symmetry and the light allow."""
    optics = opening.optics
    if not (opening.is_round and is_coherent(optics)):
        whole, series = _series(opening, factor, oil_nm)
        return LatticeField(
            series, whole.axial, whole.transverse, band_of(optics), reach_nm, cone_of(optics)
        )
    source, axial = _source(opening, factor, oil_nm)
    transverse = _in_fours(opening.pupil.transverse, "edge")
    step = STEP / (opening.wavenumber * optics.na)
    table = _bessel_table(transverse, step, math.ceil(reach_nm / step) + 1)
    return RadialField(
        source, axial, transverse, table, step, math.radians(optics.polarization_deg),
        optics.polarization == "circular", optics.analyzer,
    )  # fmt: skip


def _bessel_table(transverse: FloatArray, step_nm: float, intervals: int) -> FloatArray:
    """Bessel matrices of the radial grid, of which the last are held."""
    key = transverse.tobytes(), step_nm, intervals
    table = _TABLES.get(key)
    if table is None:
        table = bessel_table(transverse, step_nm, intervals)
        _TABLES.hold(key, table, table.nbytes)
    return table


def with_light_of(field: Field, opening: Aperture, factor: complex, oil_nm: float) -> Field:
    """Give the table of a field the light of another particle in the same pupil."""
    if isinstance(field, RadialField):
        return replace(field, source=_source(opening, factor, oil_nm)[0])
    if isinstance(field, LatticeField):
        return replace(field, harmonics=_series(opening, factor, oil_nm)[1])
    return field


def _source(opening: Aperture, factor: complex, oil_nm: float) -> tuple[ComplexArray, ComplexArray]:
    """Light of a round pupil in the sums of F0 and F2, and its phase per height."""
    pupil = opening.pupil
    weight, axial = weight_on(opening, factor, oil_nm)
    turn = np.exp(1j * opening.wavenumber * opening.paths_nm(np.zeros(1))[0, :, 0])
    common = weight / 2 * turn * opening.transmission
    source = np.stack([common * (pupil.t_s + pupil.t_p_cos), common * (pupil.t_s - pupil.t_p_cos)])
    return _in_fours(source), _in_fours(axial, "edge")


def _series(opening: Aperture, factor: complex, oil_nm: float) -> tuple[Ray, ComplexArray]:
    """Light of any pupil at all its wavelengths, and its harmonics along the azimuth."""
    optics, pupil = opening.optics, opening.pupil
    phi = opening.azimuths()
    rays = []
    for each in spectrum(optics):
        there = opening
        if each is not optics:
            there = aperture_on(each, pupil.theta, pupil.weight, opening.scatterer)
        weight, axial = weight_on(there, factor_at(factor, each, optics), oil_nm)
        rays.append(Ray(there.seen(phi)[None], weight, axial, there.pupil.transverse))
    whole = over_spectrum(rays)
    return whole, harmonics(whole.waves[0], np.abs(whole.weight)) * whole.weight


def _in_fours(values: Any, mode: Literal["constant", "edge"] = "constant") -> Any:
    """Pad the angles, the last axis: the radial kernel takes them in fours."""
    padding = [(0, 0)] * (values.ndim - 1) + [(0, -values.shape[-1] % 4)]
    return np.pad(values, padding, mode=mode)


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
    model: ForwardModel, z_nm: float, names: tuple[str, ...]
) -> tuple[LatticeLens, FloatArray]:
    """Lattices of the field, and of its derivatives along z and parameters of the optics.

    Shapes: `stack` (2 + len(names), components, 2, nodes, nodes).
    """
    optics, phi = model.optics, model.aperture.azimuths()
    light = over_spectrum([_changes(model, each, z_nm, names, phi) for each in spectrum(optics)])
    waves = light.waves.reshape(-1, *light.waves.shape[2:])
    # Share of the change of light below which its azimuthal harmonics are left out
    series = harmonics(waves, np.abs(light.weight), 1e-6) * light.weight
    count, band, cone = light.waves.shape[1], band_of(optics), cone_of(optics)
    first = series[:count]
    lattice = LatticeField(first, light.axial, light.transverse, band, model.reach_nm, cone)
    # Radial step of these tables over that of the field: their error is one part in 10⁶
    stack = lattice.lattices(series, light.transverse, 2)
    return lattice.lens(model.rho), stack.reshape(2 + len(names), lattice.count, *stack.shape[1:])


def _changes(
    model: ForwardModel, optics: Optics, z_nm: float, names: tuple[str, ...], phi: FloatArray
) -> Ray:
    """Light of one wavelength in the pupil, how it rises with the height, and its derivatives."""
    opening, rho = model.aperture, model.rho
    rim, edge = (math.asin(na / optics.n_immersion) for na in (optics.na, optics.mask_na))
    # two more directions, with zero weight except where an edge moves
    theta = np.concatenate([opening.pupil.theta, [rim, edge]])
    weights = np.concatenate([opening.pupil.weight, [1.0, 1.0]])
    whole = aperture_on(optics, theta, weights, opening.scatterer)
    weight, axial = weight_on(whole, factor_at(model.factor, optics, model.optics), model.oil_nm)
    weight = weight * np.exp(1j * axial * z_nm)
    inner, at_rim, at_edge = np.ones(theta.size), np.zeros(theta.size), np.zeros(theta.size)
    inner[-2:] = 0.0
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
            stretch = -1j * k / optics.na * whole.rho[:, None] * whole.paths_nm(phi)[1]
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
