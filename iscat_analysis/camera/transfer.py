"""Photon transfer of one movie: noise and response to the laser, against the light.

Pixels of one movie have different light.  The variance between frames and the slope against the
laser power are measured for each pixel, and averaged over pixels of like brightness.

Where the light of a movie ends, beside where the camera's numbers say that it does.

A contrast is a change divided by the light above the offset: an offset that is too low by a share s
of the light makes contrasts, and masses, too small by s.  Two properties of the pixels know where
the light is zero, neither of which needs the gain: how strongly they follow the laser's power,
dm_p/dρ ∝ m_p − o, and their noise, v_p = (m_p − o)/g.  See the module's page.

Whether counts have a true zero: whether their noise is that of light, where the light is even.

Contrast is a change of counts over counts above zero light.  A movie that was divided by its own
background, or had it taken off, is flat; scaled to other numbers, its zero is anywhere.  The noise
knows: raw counts m with the zero o have the variance (m − o)/g.  Where light is uneven over the
field its pixels tell o (see `transfer`); where it is even, frames do, as the laser flickers:

    κ = d ln v/d ln m = m/(m − o) .

Where the laser is steady as well nothing tells o, but what was done to the movie may still show:
its noise is uneven as the background was, although its light is even, or its mean is smoother than
the noise of its frames allows.

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
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import scipy
from numpy.typing import DTypeLike, NDArray

from iscat_analysis.camera.background import unlike_neighbours
from iscat_analysis.camera.calibration import (
    LEAST_RELIABILITY,
    Estimate,
    Moments,
    brightness_bins,
    moments_of,
    stand_out,
    unsteady,
    variance_line,
    zero_of_flicker,
    zero_of_line,
)
from iscat_analysis.camera.counts import Camera, converter_ceiling, float_type, full_scale_of
from iscat_analysis.config import CameraConfig
from iscat_analysis.errors import DataError
from iscat_analysis.movie import ChangedFrames, Stack, open_stack
from iscat_analysis.records import BoolArray, FloatArray

TOLERANCE = 0.01
"""Share of the light, and of masses, that may be wrong before it is said."""


SIGMAS = 4.0
"""And the excess over the tolerance that chance must not explain."""


_LEAST_FRAMES = 16
_LEAST_PIXELS = 256
_TILE_PX = 16  # within which pixels may differ from the line together, as a speckle that shakes


@dataclass(frozen=True, eq=False)
class Transfer:
    """Variance and slope of pixels, in bins of like brightness [e]; and where lines end.

    Without `flicker` the laser is too steady, or the scene moved, and `slope` says nothing.
    Shapes: `light, variance, variance_se, slope, slope_se` (bins,).
    """

    light: FloatArray
    variance: FloatArray
    variance_se: FloatArray
    slope: FloatArray
    slope_se: FloatArray
    level: float
    noise: Estimate | None
    flicker: Estimate | None


def measure_transfer(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> Transfer | None:
    """Measure photon transfer; None where the pixels are too alike, too few, or not raw.

    Notes
    -----
    The variance of the read noise and of rounding is taken off.  Where a bright particle lands, its
    pixels change and the light of the field with them, which is no flicker.  Errors are from the
    scatter of pixels, times what squares of `_TILE_PX` pixels scatter more than these.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    if len(counts) < _LEAST_FRAMES:
        return None
    electrons = camera.to_electrons(counts)
    light = electrons.mean(axis=0)
    dark, bright = unlike_neighbours(light)
    used = camera.usable(counts, masked) & (light > 0) & ~dark & ~bright
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    try:
        jumps = _jumps(electrons, light, used)
        found = moments_of(open_stack(electrons), used, lambda _: None, jumps=jumps)
    except DataError:
        return None
    # of the shot noise; what has less, as a picture that was copied, has none
    used &= ~unsteady([found], used) & (found.variance > 1e-6 * light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    own = float((found.variance[used] / found.n_frames).mean())
    if own > (1 - LEAST_RELIABILITY) * float(found.mean[used].var()):
        return None
    return _binned(found, used, camera.dark_variance_e2(counts)[used])


def _jumps(electrons: FloatArray, light: FloatArray, used: BoolArray) -> BoolArray:
    """Find successive frames that differ by more than noise and power, as where a particle lands.

    Shapes: `electrons` (t, y, x), `light, used` (y, x), result (t − 1,).
    """
    mean = light[used]
    excess = np.empty(len(electrons) - 1)
    for number, (before, after) in enumerate(pairwise(electrons)):
        step = after[used] - before[used]
        step -= step.mean() / mean.mean() * mean
        excess[number] = np.mean(step**2 / mean)
    return stand_out(excess)


def _binned(found: Moments, used: BoolArray, other: FloatArray) -> Transfer:
    """Average over pixels of like brightness; find the zeros of the lines through all pixels."""
    mean, variance = found.mean[used], found.variance[used] - other
    level = float(mean.mean())
    y, x = np.nonzero(used)
    tiles = (y // _TILE_PX) * (1 + used.shape[1] // _TILE_PX) + x // _TILE_PX
    freedom = np.full(mean.shape, found.n_frames - 1.0)
    line, cov = variance_line(mean, variance, freedom, tiles)
    # the zero is a quotient by the slope
    noise = zero_of_line(line, cov) if line[1] > 5.0 * math.sqrt(cov[1, 1]) else None
    seen = found.slope[used], found.slope_variance[used], mean
    flicker = zero_of_flicker(*seen, tiles)
    _, alone = variance_line(mean, variance, freedom)
    wider = [math.sqrt(max(1.0, float(cov[1, 1] / alone[1, 1]))), 1.0]
    if flicker is not None:
        single = zero_of_flicker(*seen)
        wider[1] = max(1.0, flicker.se / single.se) if single is not None else 1.0
    rates, rates2 = found.slope[used], found.slope_variance[used]
    bins = []
    for part in brightness_bins(mean):
        noise_sd, rate_sd = variance[part].std(ddof=1), math.sqrt(rates2[part].mean())
        levels = mean[part].mean(), variance[part].mean(), rates[part].mean()
        bins.append((*levels, wider[0] * noise_sd, wider[1] * rate_sd, part.size))
    light, noises, slopes, noises_sd, slopes_sd, number = np.array(bins).T
    errors = noises_sd / np.sqrt(number), slopes_sd / np.sqrt(number)
    return Transfer(light, noises, errors[0], slopes, errors[1], level, noise, flicker)


@dataclass(frozen=True)
class LightZero:
    """Where the light is zero."""

    share: float
    se: float
    electrons: float
    flickers: bool

    @property
    def off(self) -> bool:
        """Whether the offset is wrong by more than 1 % of the light, not by chance."""
        return abs(self.share) > TOLERANCE + SIGMAS * self.se

    def may_be(self, share: float) -> bool:
        """Tell whether another share may be no light."""
        return abs(self.share - share) < TOLERANCE + SIGMAS * self.se


def find_zero(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> LightZero | None:
    """Find where the light is zero.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    pixels = counts.shape[1] * counts.shape[2]
    most = min(256, max(_LEAST_FRAMES, (2**22) // pixels))  # a tenth of a second
    found = measure_transfer(counts[:most], camera, masked=masked)
    if found is None:
        return None
    known = [
        LightZero(one.value / found.level, one.se / found.level, one.value, flickers)
        for one, flickers in ((found.flicker, True), (found.noise, False))
        if one is not None
    ]
    return min(known, key=lambda one: one.se, default=None)


TOLD = 0.1
"""Error of the zero, as a share of the light, up to which the pixels tell it well enough."""

_LEAST_UNEVEN, _OVER_LIGHT = 0.03, 2.0  # of the noise, and times that of the light
_CLEAR = 6.0  # standard errors of what was done to the movie
_QUANTILE = 0.15866  # of a normal law, one standard deviation below its middle
_QUANTILE_ERROR = 3.2  # √n times the relative error of the square of that deviation


@dataclass(frozen=True)
class Zero:
    """What the noise says of the zero that is assumed.

    `error` is of it, as a share of the light, None where nothing tells; `cause` why it is none.
    """

    error: float | None
    cause: str
    level_e: float


def judge_zero(
    counts: NDArray[Any], camera: Camera, *, most_read_e2: float, moving: bool
) -> Zero | None:
    """Judge the zero of counts whose light is even over the field; None of too few counts.

    `most_read_e2` is the variance of read noise that nobody need say.  Where particles are
    `moving`, noise is uneven by them.

    Shapes: `counts` (t, y, x).
    """
    if len(counts) < _LEAST_FRAMES or counts[0].size < _LEAST_PIXELS:
        return None
    light = camera.to_electrons(counts).reshape(len(counts), -1)
    power, mean = light.mean(axis=1), light.mean(axis=0)
    level = float(power.mean())
    if level <= 0:
        return None
    steps = np.diff(light, axis=0)
    steps -= np.diff(power)[:, None] / level * mean
    variance = np.mean(steps**2, axis=0) / 2
    if not np.median(variance) > 0:
        return None
    other = float(camera.dark_variance_e2(counts).mean())
    growth, error = _growth(steps, variance, power / level, other)
    if error <= 0.25:  # frames tell nothing
        if abs(growth - 1) <= SIGMAS * error:
            return Zero(math.hypot(growth - 1, error), "", level)
        if growth + SIGMAS * error < level / (level + most_read_e2):
            return Zero(
                None,
                f"from frame to frame the variance grows {growth:.2g} ± {error:.1g} times as fast "
                "as the light, and in raw counts as fast as that",
                level,
            )
    return Zero(None, "" if moving else _traces(steps, variance, mean), level)


def _growth(
    steps: FloatArray, variance: FloatArray, power: FloatArray, other: float
) -> tuple[float, float]:
    """Give how fast the variance grows with the power, relative, and its standard error.

    Shapes: `steps` (t − 1, n), `variance` (n,), `power` (t,).
    """
    floor = np.maximum(variance, 1e-3 * np.median(variance))
    seen = np.minimum(steps**2 / (2 * floor), 25.0).mean(axis=1)  # more is of a particle
    seen /= seen.mean()
    light = (power[1:] + power[:-1]) / 2
    light = light - light.mean()
    spread = float(light @ light)
    if not spread > 0:
        return 0.0, math.inf
    slope = float(light @ seen) / spread
    rest = float(np.var(seen - 1 - slope * light))
    share = max(1 - other / float(np.mean(variance)), 0.1)  # of the variance, that is of light
    # successive differences share a frame
    return slope / share, math.sqrt(1.5 * rest / spread) / share


def _traces(steps: FloatArray, variance: FloatArray, mean: FloatArray) -> str:
    """Say what in a movie shows that it was divided by its background, or had it taken off.

    Deviations are those below the middle: where particles come, the variance is only more.  What
    both halves of the frames share is no chance.

    Shapes: `steps` (t − 1, n), `variance, mean` (n,).
    """
    half = len(steps) // 2
    first, last = (np.mean(part**2, axis=0) / 2 for part in (steps[:half], steps[half:]))
    usual, chance = float(np.median(variance)), 1 / math.sqrt(variance.size)
    sum2, difference2 = (
        _below(part) / usual**2 for part in ((first + last) / 2, (first - last) / 2)
    )
    uneven2 = sum2 - difference2
    own = usual / (len(steps) + 1)  # variance of the mean of raw counts
    light2 = max(_below(mean) - own, 0.0) / float(mean.mean()) ** 2
    clear = uneven2 > _CLEAR * _QUANTILE_ERROR * chance * sum2
    if clear and uneven2 > max(_LEAST_UNEVEN**2, _OVER_LIGHT**2 * light2):
        return (
            f"the variance differs over the field by {100 * math.sqrt(uneven2):.2g} %, the light "
            f"by {100 * math.sqrt(light2):.1g} %, and in raw counts they are alike"
        )
    low, high = np.quantile(mean, [_QUANTILE, 1 - _QUANTILE])
    smooth = ((high - low) / 2) ** 2 / own
    if smooth * (1 + _CLEAR * _QUANTILE_ERROR / 2 * chance) < 1:
        return (
            f"the mean of the frames is smoother than their noise lets it be, with {smooth:.2g} of "
            "its variance"
        )
    return ""


def _below(values: FloatArray) -> float:
    """Square of the deviation below the median that a normal law would have."""
    middle, low = np.quantile(values, [0.5, _QUANTILE])
    return float(middle - low) ** 2


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
            return -np.log1p(-above / full)

        n = light(np.minimum(mean, _HIGHEST * full))
        contrast = n / np.expm1(n)
    scale = float(np.average(np.square(contrast * mean) / variance / light(mean), weights=weight))
    counts = np.linspace(zero, end, 1025)  # points of the curve
    return Response(counts, scale * light(counts - zero))
