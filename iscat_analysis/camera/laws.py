"""Which law the counts of a movie follow, and the curve that linearises them.

Which law the counts of a movie follow: a line, a wrong offset, gamma, saturation, other light.

Let c = f(N) be the counts above the offset that N photoelectrons make, with light N that is Poisson
and follows the laser's power ρ.  Pixels then have the variance and the slope

    v = f′(N)²·N,        dm/d ln ρ = f′(N)·N ,

so that against m = f(N) both are straight lines through zero for f linear, and for nothing else:

===================  =======================  =================  ==========================
law                  v                        dm/d ln ρ          contrast, measured over true
===================  =======================  =================  ==========================
linear               m/g                      m                  1
offset wrong by s    (m − s)/g                m − s              (m − s)/m
other light s        m/g                      m − s              (m − s)/m
read noise           m/g + σ²                 m                  1
noisy light          m/g + κm²                m                  1
gamma, c ∝ N^γ       ∝ m^(2 − 1/γ)            γm                 γ
saturation           N·e^(−2N/F)              N·e^(−N/F)         x/(eˣ − 1),  x = N/F
===================  =======================  =================  ==========================

with m = F(1 − e^(−N/F)) in the last row.  "Other light" is light that does not follow the laser, as
a room's: it has shot noise, and no particle changes it.  The two lines end, as shares of the mean
light, at (0, −(1 − γ)/(2γ − 1)) for gamma, at (−x/2, −3x/2) for weak saturation, at (s, s) for an
offset and at (s, 0) for other light: with a laser that flickers by 1 % these are told apart.

Without flicker there is the noise alone.  A noise that rises faster than the light above the offset
says that the offset is too low: nothing that compresses does so.  One that rises more slowly is
read noise, as far as cameras have it, or a law that bends: gamma and saturation are then alike.

A camera whose counts are not linear in light, and the curve that linearises them.

The curve is a CSV file of two rising columns, ``counts`` and ``photoelectrons``.  Each frame is
converted before anything else, so that all later stages see a camera of gain 1 and offset 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import scipy
from numpy.typing import DTypeLike, NDArray

from iscat_analysis.camera.counts import Camera, converter_ceiling, float_type, full_scale_of
from iscat_analysis.camera.transfer import SIGMAS, TOLERANCE, Transfer
from iscat_analysis.config import CameraConfig
from iscat_analysis.errors import DataError
from iscat_analysis.movie import ChangedFrames, Stack
from iscat_analysis.records import FloatArray

Kind = Literal[
    "linear", "offset", "other light", "read noise", "noisy light", "gamma", "saturation"
]
Curves = tuple[FloatArray, FloatArray]
"""Variance and slope, each up to a factor."""

BENT: tuple[Kind, ...] = ("gamma", "saturation")
"""Laws by which counts are no line in light, so that masses are wrong whatever the numbers."""


_RARE = {"noisy light": 6.0, "other light": 2.0}  # of χ², by which these must be better still


@dataclass(frozen=True)
class Law:
    """A law of the counts and its number.

    `value` is γ, N/F at the mean light, or the share s of the mean light; `offset` is the share by
    which the offset is wrong besides; `contrast` is the measured over the true contrast of a faint
    particle in the mean light.
    """

    kind: Kind
    value: float
    se: float
    contrast: float
    contrast_se: float
    offset: float = 0.0
    chi2: float = 0.0
    alike: tuple[Kind, ...] = ()
    flickers: bool = False

    @property
    def bent(self) -> bool:
        """Whether counts are not linear in light, so that no offset makes masses right."""
        # that it is no chance is known already: a line describes the pixels clearly worse
        return self.kind in BENT and abs(1 - self.contrast) > TOLERANCE

    @property
    def dilutes(self) -> bool:
        """Whether an offset, or light that no particle changes, makes masses wrong."""
        wrong = abs(1 - self.contrast) > TOLERANCE + SIGMAS * self.contrast_se
        return self.kind in ("offset", "other light") and wrong

    @property
    def below_nothing(self) -> bool:
        """Whether counts are a line in light whose zero lies clearly below no counts."""
        line = self.contrast / (1 - self.offset)
        error = SIGMAS * self.contrast_se
        straight = abs(1 - line) <= TOLERANCE + error
        return self.bent and straight and -self.offset > TOLERANCE + error

    @property
    def certain(self) -> bool:
        """Whether the error of masses is known, because no other kind of law fits as well."""
        return self.flickers or not self.alike


@dataclass(frozen=True)
class _Family:
    """Laws of one kind: their curve, and start and limits of their number."""

    kind: Kind
    curves: Callable[[FloatArray, float], Curves]
    contrast: Callable[[float], float]
    start: float
    ends: tuple[float, float]


def _filled(u: FloatArray, x: float) -> FloatArray:
    """Photoelectrons over those at full scale, of counts u over the mean; x at the mean."""
    return -np.log1p(-np.minimum(-math.expm1(-x) * u, 0.98))  # of full scale


def _saturation(u: FloatArray, x: float) -> Curves:
    n = _filled(u, x)
    return n * np.exp(-2 * n), n * np.exp(-n)


_OFFSET = _Family("offset", lambda u, s: (u - s, u - s), lambda s: 1 - s, 0.0, (-3.0, 0.95))
_FAMILIES = (
    _Family("read noise", lambda u, r: (u + r, u), lambda _: 1.0, 0.01, (0.0, 3.0)),
    _Family("gamma", lambda u, g: (np.power(u, 2 - 1 / g), u), lambda g: g, 0.9, (0.3, 1.0)),
    _Family("saturation", _saturation, lambda x: x / math.expm1(x), 0.1, (1e-4, 4.0)),
    _Family("other light", lambda u, s: (u, u - s), lambda s: 1 - s, 0.01, (0.0, 0.95)),
    _Family("noisy light", lambda u, k: (u + k * u * u, u), lambda _: 1.0, 0.01, (0.0, 10.0)),
)


def find_law(found: Transfer, *, most_read: float = 0.0, least_offset: float = -3.0) -> Law:
    """Find the law that describes the pixels best; a line unless another is clearly better.

    `most_read` is the variance of the read noise, over that of the mean light, that a camera may
    have without anybody saying so.  `least_offset` is how much too high the offset may be, as a
    share of the light below zero: no camera has an offset below no counts.
    """
    flickers = found.flicker is not None
    u = found.light / found.level
    linear = float(np.sum(_residuals(found, (u, u)) ** 2))
    offset = replace(_OFFSET, ends=(min(least_offset, -1e-6), _OFFSET.ends[1]))
    families = [k for k in (offset, *_FAMILIES) if flickers or k.kind != "other light"]
    laws = {family.kind: _fitted(found, family) for family in families}
    read = laws["read noise"]
    if read.value - 2 * read.se > most_read:
        del laws["read noise"]
    best = min(laws.values(), key=lambda law: law.chi2 + _RARE.get(law.kind, 0.0))
    if flickers:
        pairs = [_fitted(found, family, shifted=True) for family in families if family.kind in BENT]
        both = min(pairs, key=lambda law: law.chi2)
        if best.chi2 - both.chi2 > 20.0:  # with one number more
            return both
    if linear - best.chi2 < 16.0:  # a line is as good
        se = math.hypot(laws["offset"].value, laws["offset"].se)  # of zero, which is kept
        return Law("linear", 0.0, se, 1.0, se, chi2=linear, flickers=flickers)
    return _among(best, [law for law in laws.values() if law.chi2 - best.chi2 < 6.0])  # as good


def _among(best: Law, alike: list[Law]) -> Law:
    """Widen the error of a law by the contrasts of other laws that fit as well."""
    kinds = tuple(law.kind for law in alike if law.kind != best.kind)
    if best.kind in BENT:
        alike = [law for law in alike if law.kind in BENT]
        weight = np.exp([(best.chi2 - law.chi2) / 2 for law in alike])
        apart = [law.contrast_se**2 + (law.contrast - best.contrast) ** 2 for law in alike]
        spread = math.sqrt(float(np.average(apart, weights=weight)))
        return replace(best, alike=kinds, contrast_se=max(best.contrast_se, spread))
    return replace(best, alike=kinds)


def _residuals(found: Transfer, curves: Curves) -> FloatArray:
    """Residuals of the best multiples of two curves, in standard errors."""
    seen = [(found.variance, found.variance_se), (found.slope, found.slope_se)]
    rest = []
    for (values, se), curve in zip(seen if found.flicker else seen[:1], curves, strict=False):
        model, values = curve / se, values / se
        rest.append(values - model * float(model @ values) / float(model @ model))
    return np.concatenate(rest)


def _fitted(found: Transfer, family: _Family, *, shifted: bool = False) -> Law:
    """Fit the number of a law and, where it is `shifted`, the share that is no light."""
    numbers = 2 if shifted else 1

    def residuals(theta: FloatArray) -> FloatArray:
        value, shift = (*theta.tolist(), 0.0)[:2]
        above = np.maximum(found.light / found.level - shift, 1e-3) / (1 - shift)
        return _residuals(found, family.curves(above, value))

    ends = np.array([family.ends, (-3.0, 0.9)])[:numbers].T
    start = np.clip([family.start, 0.0][:numbers], *ends)
    best = scipy.optimize.least_squares(residuals, start, bounds=ends, xtol=1e-10, x_scale="jac")
    value, shift = (*best.x.tolist(), 0.0)[:2]
    covariance = np.linalg.pinv(best.jac.T @ best.jac)
    contrast, step = family.contrast(value), 1e-4
    slope = (family.contrast(value + step) - contrast) / step
    gradient = np.array([slope * (1 - shift), -contrast])[:numbers]
    return Law(
        kind=family.kind,
        value=value,
        se=math.sqrt(float(covariance[0, 0])),
        contrast=contrast * (1 - shift),
        contrast_se=math.sqrt(max(float(gradient @ covariance @ gradient), 0.0)),
        offset=shift,
        chi2=2 * float(best.cost),
        flickers=found.flicker is not None,
    )


COLUMNS = ("counts", "photoelectrons")
"""Of a response curve."""

_HIGHEST = 0.98  # of the counts at which a camera saturates, up to which the curve goes


@dataclass(frozen=True, eq=False)
class Response:
    """Photoelectrons against counts, linear between points; beyond the last one a pixel is full.

    Shapes: `counts` (n,), `photoelectrons` (n,).
    """

    counts: FloatArray
    photoelectrons: FloatArray

    def of(self, counts: NDArray[Any]) -> FloatArray:
        """Convert counts; below the first point with the slope there, because of noise."""
        seen = np.asarray(counts, dtype=np.float64)
        slope = np.diff(self.photoelectrons[:2]) / np.diff(self.counts[:2])
        out: FloatArray = np.interp(seen, self.counts, self.photoelectrons)
        out += np.minimum(seen - self.counts[0], 0.0) * slope
        return out

    @property
    def full(self) -> float:
        """Photoelectrons from which a pixel is full."""
        return float(self.photoelectrons[-1])

    @property
    def table(self) -> pd.DataFrame:
        """The curve as it is written."""
        return pd.DataFrame(dict(zip(COLUMNS, (self.counts, self.photoelectrons), strict=True)))


@dataclass(frozen=True, eq=False)
class LinearFrames(ChangedFrames):
    """Frames of a movie as photoelectrons."""

    response: Response

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the photoelectrons."""
        return float_type(self.source.dtype)

    @cached_property
    def _known(self) -> NDArray[Any] | None:
        """Photoelectrons of every number that the stored type has, if these are few."""
        stored = self.source.dtype
        if not np.issubdtype(stored, np.unsignedinteger) or stored.itemsize > 2:
            return None
        known = self.response.of(np.arange(np.iinfo(stored).max + 1)).astype(self.dtype)
        known[-1] = self.response.full
        return known

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        counts = self.source.read(start, stop)
        if self._known is None:
            out: NDArray[Any] = self.response.of(counts).astype(self.dtype)
        else:
            out = self._known[counts]
        ceiling = converter_ceiling(counts)
        if math.isfinite(ceiling):
            out[counts >= ceiling] = self.response.full
        return out


def linear(movie: Stack, config: CameraConfig) -> Stack:
    """Linearise a movie with its response curve."""
    if config.response is None:
        return movie
    return movie.seen_as(LinearFrames(movie, read_response(Path(config.response))))


def full_scale(config: CameraConfig, dtype: DTypeLike) -> float | None:
    """Largest number that a pixel can have: the end of the curve, or of the stored type."""
    if config.response is not None:
        return read_response(Path(config.response)).full
    return full_scale_of(dtype)


def read_response(path: Path) -> Response:
    """Read a response curve."""
    where = f"{path}: camera.response"
    try:
        table = pd.read_csv(path, comment="#")
    except FileNotFoundError:
        raise DataError(f"{where} names a file that does not exist; check the path") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{where} cannot be read as CSV ({error})") from None
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        raise DataError(
            f"{where} needs the columns {' and '.join(COLUMNS)}, but has no {missing[0]}"
        )
    try:
        counts, electrons = (table[name].to_numpy(float) for name in COLUMNS)
    except ValueError:
        raise DataError(f"{where} holds text; give numbers") from None
    rising = all(
        np.isfinite(values).all() and (np.diff(values) > 0).all() for values in (counts, electrons)
    )
    if len(counts) < 2 or not rising:
        raise DataError(f"{where} needs two rows or more, in which both columns rise")
    return Response(counts, electrons)


def response_of(law: Law, found: Transfer, camera: Camera, top: float) -> Response:
    """Make the curve of a law that the pixels of a movie follow, up to the highest count.

    Notes
    -----
    The law has light up to a factor; the variance has it whole: N = κ²m²/v, with κ = d ln m/d ln N.
    """
    gain, offset = (float(np.mean(v)) for v in (camera.gain_e_per_adu, camera.offset_adu))
    level = found.level / gain  # in counts above the offset
    zero = offset + law.offset * level
    mean, variance = found.light / gain - law.offset * level, found.variance / gain**2
    weight = np.square(found.variance / found.variance_se)
    end = top
    if law.kind == "gamma":

        def light(above: FloatArray) -> FloatArray:
            return np.power(above / level, 1 / law.value)

        contrast = np.full(mean.shape, law.value)
    else:
        full = (1 - law.offset) * level / -math.expm1(-law.value)
        end = min(top, zero + _HIGHEST * full)

        def light(above: FloatArray) -> FloatArray:
            return np.asarray(-np.log1p(-above / full))

        n = light(np.minimum(mean, _HIGHEST * full))
        contrast = n / np.expm1(n)
    scale = float(np.average(np.square(contrast * mean) / variance / light(mean), weights=weight))
    counts = np.linspace(zero, end, 1025)  # points of the curve
    return Response(counts, scale * light(counts - zero))
