"""A measured image of a particle, in place of a computed one.

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
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.lattice import (
    BENT,
    FILTER,
    LATTICE_STEP,
    lattice_half,
    lattice_waves,
    undo_window,
    window,
)
from iscat_analysis._kernels.lens import LatticeLens
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import kept
from iscat_analysis.reading import LARGEST_TEMPLATE_BYTES, npz_of, read_bytes

FloatArray = NDArray[np.float64]

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
        stored = npz_of(content, (), LARGEST_TEMPLATE_BYTES)
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
        step = self.template.step_nm
        return LatticeLens(1 / step, rho, self.half, 1, window()[0])

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
