"""A measured image of a particle, in place of a computed one.

In any microscope, the light comes through the pupil.  The interference of a faint particle, 2 Re e,
is therefore band-limited at the largest wave vector in the glass, so that samples on a lattice
determine it between the pixels too.  The lattice is that of any other pupil
(`iscat_analysis._kernels.lattice`), with a real field: the imaginary part does not show in the
interference and is not known.  For the scattered light itself, |e|², its lower limit (Re e)² is
used.

The scattered field around one particle, per unit amplitude and over the reference.

Two tables have the same interface.  If only the polarisation gives the pupil a direction, it has a
`RadialField`: quintics along r.  Any other pupil has a `LatticeField`.  Both give the kernels a
profile at a height, a table of profiles along z, and the field at any point.

Derivatives with respect to the microscope are analytic.  Every parameter of the optics changes the
light of each ray in the pupil.  The derivative of the field is the integral of this change: a
factor inside the pupil, and the light on an edge that moves (aperture, mask).  Each derivative is
tabulated on the lattice of the field, once for each height, and combined with the field at the
pixels.
"""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

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
from iscat_analysis._kernels.pupil import zernike
from iscat_analysis._kernels.radial import POWERS, STEP, AxialTable, bessel_table, radial_profile
from iscat_analysis._kernels.radial_rows import largest_signal
from iscat_analysis.config import MEASURABLE, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import LastUsed, kept
from iscat_analysis.optics.aperture import (
    Aperture,
    Ray,
    aperture_on,
    band_of,
    cone_of,
    factor_at,
    harmonics,
    in_cone,
    is_coherent,
    over_spectrum,
    spectrum,
    weight_on,
)
from iscat_analysis.optics.scatterers import ANGLES, Rod
from iscat_analysis.reading import LARGEST_TEMPLATE_BYTES, npz_of, read_bytes
from iscat_analysis.records import ComplexArray, FloatArray

if TYPE_CHECKING:
    from iscat_analysis.optics.model import ForwardModel

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
