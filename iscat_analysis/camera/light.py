"""Light whose distribution over the field changes: found, and measured in every frame.

Changes of the light between frames that are far apart, in units of their noise.

`camera.amplifier_boundaries`, `camera.fringes` and `iscat_analysis.camera.lighting` look for
structure in them.

Boundaries between parts of a camera that are read out by different amplifiers.

The gain of each amplifier changes by itself.  Halves, quadrants or stripes of the field then change
from frame to frame as a whole: the sum over rows or columns has a step at the boundary, which
smooth light does not have.

Fringes that pass over the field: plane waves of light, and how long and how steep they are.

Where fringes are curved, or stronger in the middle of the field than at its border, the height of a
wave is a complex polynomial.  Two reflections of a coherent source make one wave, whose phase
drifts as they warm up.  In the spectrum of the changes of the light it is one point, where
particles, a pattern that moves and noise are spread over many: it is a wave where it stands far out
of the others at its distance from the middle, and out of those of its own row and column, in which
lines that flicker lie.

Light, or dark counts, that are added to all pixels equally and change with time.

Where light of the room or the offset of the camera drifts, pixels change relative to their own
light by one over it, dim ones most.  The size of that change is the same in all parts of the field.
Smooth changes of the light do not affect it; a pattern that moves makes it differ from part to
part.

A beam that wanders, fringes that pass or a lamp that warms up change the light of a pixel, and that
of its neighbours in the same way.  Over the mean frame such a change is a polynomial in x and y of
low degree, a few plane waves (`camera.fringes`), a factor of each part of a camera
that has several amplifiers (`camera.amplifier_boundaries`), and what is added to all pixels alike
(`camera.stray_light`), which least squares measure in every frame with an error far below
the noise of one pixel.  A particle is part of what is measured:
`iscat_analysis.camera.lines.Lines.left` says what that takes of it.

Whether there is such a change is asked of frames as far apart as the windows that are compared.
Particles that land between them, and pixels that blink, stand out of the polynomial in a few cells
of a grid, which are left out.  A fixed pattern that moves, or shaking, changes the light at every
scale, down to that of a particle: then nothing is divided out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander, legvander2d
from numpy.typing import NDArray
from scipy import fft
from scipy.special import chdtri

from iscat_analysis.camera.counts import Camera
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import LIGHT_ADDED, LIGHT_FRINGES, LIGHT_SEAMS, LIGHT_SMOOTH
from iscat_analysis.records import BoolArray, FloatArray

LEAST_CONTRAST_SHARE = 0.02
"""Of the noise variance of a pixel between two windows, below which no change does."""

_LEAST_LIGHT = 0.1  # of the median pixel's


@dataclass(frozen=True, eq=False)
class Changes:
    """Sums of frames, before and after."""

    sums_e: FloatArray
    frames: NDArray[np.int64]
    light_e: FloatArray
    noises: FloatArray

    @classmethod
    def of(
        cls, pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera
    ) -> Changes | None:
        """Sum frames.

        Shapes: `pairs` (t, y, x).
        """
        if not pairs:
            return None
        sums = np.array([[camera.to_electrons(k).sum(axis=0) for k in two] for two in pairs])
        frames = np.array([[len(k) for k in two] for two in pairs])
        light = sums.sum(axis=(0, 1)) / frames.sum()
        used = usable_pixels(pairs, light, camera)
        if not used.any() or sums[..., used].sum(axis=-1).min() <= 0:
            return None
        read = float(camera.read_variance_e2(used.shape)[used].mean() / light[used].mean())
        noises = (1 + read) * (1 / frames).sum(axis=1)
        if not used.all():
            sums[..., ~used] = 0.0
        return cls(sums, frames, np.where(used, light, 0.0), noises)

    @property
    def used(self) -> BoolArray:
        """Pixels with enough light, shape (y, x)."""
        return self.light_e > 0

    @property
    def error(self) -> float:
        """Variance of a contrast that is measured with all the light."""
        return float(self.noises.mean() / self.light_e.sum())

    def least(self, window: int) -> float:
        """Mean square contrast of two windows below which a change is ignored."""
        return LEAST_CONTRAST_SHARE * float(2 / (window * self.light_e[self.used].mean()))

    def divided(self, factors: FloatArray) -> Changes:
        """Divide the light of the sums by measured factors.

        Shapes: `factors` (pairs, 2, y, x).
        """
        return replace(self, sums_e=self.sums_e / factors)

    def binned(self, side: int) -> tuple[FloatArray, FloatArray]:
        """Give the changes of squares of pixels.

        Shapes: `changes` (pairs, y, x), `light_e` (y, x).
        """
        light = squares(self.light_e, side)
        before, after = np.moveaxis(squares(self.sums_e, side), 1, 0)
        changes = after / after.sum(axis=(1, 2), keepdims=True)
        changes -= before / before.sum(axis=(1, 2), keepdims=True)
        changes *= light.sum()
        changes /= np.sqrt(np.where(light > 0, light, 1.0) * self.noises[:, None, None])
        return np.where(light > 0, changes, 0.0), light


def squares(values: FloatArray, side: int) -> FloatArray:
    """Sum over squares of pixels.

    Shapes: `values` (…, y, x), result (…, y // side, x // side).
    """
    if side == 1:
        return values
    *before, rows, columns = values.shape
    high, wide = rows // side, columns // side
    cut = values[..., : high * side, : wide * side].reshape(*before, high, side, wide, side)
    return np.asarray(cut.sum(axis=(-3, -1)))


def usable_pixels(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], light_e: FloatArray, camera: Camera
) -> BoolArray:
    """Tell which pixels have enough light.

    Shapes: `pairs` (t, y, x), `light_e` (y, x), result (y, x).
    """
    highest = np.max([part.max(axis=0) for two in pairs for part in two], axis=0)
    lit: BoolArray = light_e > _LEAST_LIGHT * max(float(np.median(light_e)), 0.0)
    return lit & ~camera.saturated(highest)


AmplifierBoundaries = tuple[tuple[int, ...], tuple[int, ...]]
"""Rows and columns at which another part begins."""

_MOST_BOUNDARIES = 3  # along an axis
_SEAM_DEGREE = 6  # degree of the light along an axis over which a step must stand out
_FEWEST_LINES = 8  # lines of a part
_SEAM_CHANCE = 1e-12  # that the gains of pairs are as far above noise
# Times what nine in ten lines differ from those before, that they do at a seam
_LEAST_STEP_RATIO = 10.0
_MOST_UNEXPLAINED_SHARE = 0.5  # of what smooth light leaves over, more than which seams may not
_NINE_IN_TEN = 0.9
_NORMAL_SQUARE = 0.4549364231195724  # median of the square of a normal variable


def find_amplifier_boundaries(
    changes: Changes, window: int, known: AmplifierBoundaries = ((), ())
) -> AmplifierBoundaries:
    """Find rows and columns at which the change of the light has a step."""
    least = changes.least(window) / changes.error
    return _along(changes, 2, least, known[0]), _along(changes, 1, least, known[1])


def parts_of(
    shape: tuple[int, int], boundaries: AmplifierBoundaries
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Give indicator functions of the parts between boundaries.

    Shapes: `rows, columns` (y, k) and (x, m), `products` (k, m).
    """
    rows, columns = (
        np.equal.outer(np.searchsorted(cuts, np.arange(n), side="right"), np.arange(len(cuts) + 1))
        for n, cuts in zip(shape, boundaries, strict=True)
    )
    if not any(boundaries):
        rows, columns = rows[:, :0], columns[:, :0]
    products = np.ones((rows.shape[1], columns.shape[1]), dtype=np.bool_)
    return rows.astype(np.float64), columns.astype(np.float64), products


def _along(changes: Changes, axis: int, least: float, known: tuple[int, ...]) -> tuple[int, ...]:
    """Find the boundaries along an axis of (pairs, y, x)."""
    light = changes.light_e.sum(axis=axis - 1)
    lit = light > 0
    before, after = np.moveaxis(changes.sums_e.sum(axis=axis + 1)[..., lit], 1, 0)
    light, lit_positions = light[lit], np.flatnonzero(lit)
    change = after / after.sum(axis=1, keepdims=True) - before / before.sum(axis=1, keepdims=True)
    change *= light.sum() / np.sqrt(light * changes.noises[:, None])
    count = light.size
    if count < 2 * _FEWEST_LINES + _SEAM_DEGREE:
        return known
    differences = change[:, 2:-1] + change[:, 3:] - change[:, 1:-2] - change[:, :-3]
    jumps = np.zeros(count)
    jumps[2:-1] = np.median(np.square(differences), axis=0)
    sharp = jumps > _LEAST_STEP_RATIO * np.quantile(jumps, _NINE_IN_TEN)
    root = np.sqrt(light)[:, None]
    smooth = root * legvander(np.linspace(-1, 1, count), _SEAM_DEGREE)
    steps = root * (np.arange(count)[:, None] >= np.arange(count))
    tried = np.searchsorted(lit_positions, known).tolist()
    kept, unexplained = len(tried), np.inf
    significant = float(chdtri(len(change), _SEAM_CHANCE)) / len(change)
    while True:
        basis, _ = np.linalg.qr(np.hstack([smooth, steps[:, tried]]))
        rest = change - (change @ basis) @ basis.T
        left = float(np.median(np.square(rest).sum(axis=1))) - (count - basis.shape[1])
        if left < _MOST_UNEXPLAINED_SHARE * unexplained:
            kept, unexplained = len(tried), left
        if len(tried) == _MOST_BOUNDARIES:
            break
        independent_steps = steps - basis @ (basis.T @ steps)
        far = sharp.copy()
        for cut in (0, *tried, count):
            far[max(cut - _FEWEST_LINES + 1, 0) : cut + _FEWEST_LINES] = False
        size = np.where(far, np.linalg.norm(independent_steps, axis=0), np.inf)
        gains = np.square(rest @ (independent_steps / size))
        best = int(gains.sum(axis=0).argmax())
        if np.median(gains[:, best]) / _NORMAL_SQUARE - 1 < max(significant, least):
            break
        tried.append(best)
    return tuple(sorted(int(lit_positions[k]) for k in tried[:kept]))


_MOST_WAVES = 6  # waves: a source with two interfering reflections has one, with three three
_MOST_SQUARES = 160  # squares along an axis, at most, of which a spectrum is made
# Times what is around it, beyond noise, that a wave has in the spectrum: of a
_LEAST_POWER_RATIO = 100.0
# pattern that moves, the largest of 1e4 points has half of that
_BY_CHANCE = 1e-10  # that a point is as far above noise: a field has some 1e4
_FRINGE_CLIP_SIGMAS = 5.0  # robust standard deviations of the changes of a pixel
_SIGMA_PER_MAD = 1.4826  # standard deviation of a normal law over its median deviation
_ZOOMS = 4  # each to half the step, from half a wave over the field
_TURNS = 4  # of the fit of wave vectors that follows
_DEGREES_PER_WAVE = 4  # of a polynomial that follows waves of the field
_FEWEST_PERIODS = 2.5  # waves over the field that are left to polynomials
# Degree of the polynomial beside which waves are looked for: it follows fewer of them
_SMOOTH_DEGREE = 8
_MOST_AMPLITUDE_DEGREE = 4  # degree of the heights of waves
_PIXELS_PER_TERM = 150  # as of the polynomial
_LEAST_SQUARES = 24  # along an axis


@dataclass(frozen=True, eq=False)
class Fringes:
    """Plane waves whose amplitudes and phases change."""

    waves: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    degree: int = 0
    rms: float = 0.0

    @property
    def periods_px(self) -> FloatArray:
        """Periods, shape (n,) [pixels]."""
        return np.asarray(2 * np.pi / np.hypot(*self.waves.T))

    def axes(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Give what waves are made of, wherever their crests are.

        Shapes: `rows, columns` (y, k) and (x, k), `products` (k, k).
        """
        count, degrees = len(self.waves), np.arange(self.degree + 1)

        def functions(axis: int) -> FloatArray:
            n = shape[axis]
            phase = np.outer(np.arange(n) - (n - 1) / 2, self.waves[:, axis])
            turns = np.hstack([np.cos(phase), np.sin(phase)])
            heights = legvander(np.linspace(-1, 1, n), self.degree)
            return np.asarray((turns[:, :, None] * heights[:, None]).reshape(n, -1))

        envelope = np.add.outer(degrees, degrees) <= self.degree
        products = np.kron(np.tile(np.eye(count), (2, 2)), envelope) > 0
        return functions(0), functions(1), products


NO_FRINGES = Fringes()


def find_fringes(changes: Changes, window: int, highest: int) -> Fringes:
    """Find plane waves among changes of the light."""
    side = max(1, -(-max(changes.light_e.shape) // _MOST_SQUARES))
    change, light = changes.binned(side)
    if min(light.shape) < _LEAST_SQUARES:
        return NO_FRINGES
    smooth_degree = min(highest, _SMOOTH_DEGREE)
    spread = _SIGMA_PER_MAD * np.median(np.abs(change[:, light > 0]), axis=1)[:, None, None]
    change = _without_smooth(
        np.clip(change, -_FRINGE_CLIP_SIGMAS * spread, _FRINGE_CLIP_SIGMAS * spread), smooth_degree
    )
    slowest = min(highest / _DEGREES_PER_WAVE, _FEWEST_PERIODS)
    least = changes.least(window) / changes.error
    waves, square, rest = np.empty((0, 2)), 0.0, change
    while len(waves) < _MOST_WAVES:
        peak = _peak(rest, slowest)
        if peak is None:
            break
        found = _refined(change, light, np.vstack([waves, peak]), smooth_degree)
        beyond, left = _explained(change, light, Fringes(found), smooth_degree)
        if beyond - square < least:
            break
        waves, square, rest = found, beyond, left
    waves = waves[np.hypot(*(waves * light.shape).T) > 2 * np.pi * slowest]
    if not len(waves):  # the others are the foot of what the polynomial follows
        return NO_FRINGES
    room = changes.used.sum() / _PIXELS_PER_TERM
    most = max(
        k
        for k in range(_MOST_AMPLITUDE_DEGREE + 1)
        if not k or len(waves) * (k + 1) * (k + 2) <= room
    )
    squares = np.array(
        [_explained(change, light, Fringes(waves, k), smooth_degree)[0] for k in range(most + 1)]
    )
    degree = int(np.flatnonzero(squares > squares.max() - least).min())
    return Fringes(waves / side, degree, math.sqrt(max(squares[degree], 0.0) * changes.error))


def _refined(
    change: FloatArray, light: FloatArray, waves: FloatArray, smooth_degree: int
) -> FloatArray:
    """Refine wave vectors by Gauss–Newton steps, over a smooth polynomial.

    A wave whose vector is wrong by d leaves the residual i d·r times itself.
    """
    y, x = (np.arange(n) - (n - 1) / 2 for n in light.shape)
    flat, root = change.reshape(len(change), -1), np.sqrt(light)
    for _ in range(_TURNS):
        phase = waves[:, :1, None] * y[:, None] + waves[:, 1:, None] * x
        both = root * np.stack([np.cos(phase), np.sin(phase)])
        parts = np.concatenate([both, both * y[:, None], both * x])
        terms = _without_smooth(parts.reshape(-1, *light.shape), smooth_degree)
        found, *_ = np.linalg.lstsq(terms.reshape(len(terms), -1).T, flat.T, rcond=None)
        ahead, behind = np.moveaxis(found.reshape(3, 2, len(waves), -1), 1, 0)
        height, slope = ahead[0] - 1j * behind[0], ahead[1:] - 1j * behind[1:]
        off = (slope * np.conj(1j * height)).real.sum(axis=-1)
        waves = waves + (off / np.square(np.abs(height)).sum(axis=-1)).T
    return waves


def _explained(
    change: FloatArray, light: FloatArray, fringes: Fringes, smooth_degree: int
) -> tuple[float, FloatArray]:
    """Fit fringes over a smooth polynomial, which `change` has no part of.

    Returns their mean square beyond noise, in variances of it, and the residual.
    """
    rows, columns, products = fringes.axes(light.shape)
    down, along = np.nonzero(products)
    terms = np.sqrt(light) * rows.T[down][:, :, None] * columns.T[along][:, None]
    basis, _ = np.linalg.qr(_without_smooth(terms, smooth_degree).reshape(len(terms), -1).T)
    seen = change.reshape(len(change), -1) @ basis
    rest = change - (seen @ basis.T).reshape(change.shape)
    return float((np.square(seen) - 1).sum()) / len(change), rest


def _without_smooth(change: FloatArray, degree: int) -> FloatArray:
    """Subtract the polynomial of a degree from changes (pairs, y, x)."""
    rows, columns = (
        np.linalg.qr(legvander(np.linspace(-1, 1, n), degree))[0] for n in change.shape[1:]
    )
    degrees = np.arange(degree + 1)
    low_orders = np.add.outer(degrees, degrees) <= degree
    return np.asarray(change - rows @ (low_orders * (rows.T @ change @ columns)) @ columns.T)


def _peak(change: FloatArray, slowest: float) -> FloatArray | None:
    """Find the wave vector of the highest peak of the mean spectrum; None without one."""
    pairs, high, wide = change.shape
    windows = np.hanning(high)[:, None] * np.hanning(wide)
    seen = change * (windows / math.sqrt(float(np.square(windows).mean())))
    power = np.square(np.abs(fft.rfft2(seen))).mean(axis=0) / (high * wide)
    around = np.maximum(_around(power, wide), 1.0)
    waves = np.hypot(np.fft.fftfreq(high)[:, None] * high, np.fft.rfftfreq(wide) * wide)
    noise = float(chdtri(2 * pairs, _BY_CHANCE)) / (2 * pairs)
    most = np.maximum(noise, around + _LEAST_POWER_RATIO * (around - 1))
    above = np.where(waves > slowest, power / most, 0.0)
    at = np.unravel_index(int(above.argmax()), above.shape)
    if above[at] <= 1:
        return None
    sampled = (np.fft.fftfreq(high)[at[0]], np.fft.rfftfreq(wide)[at[1]])
    wave = 2 * np.pi * np.array(sampled)
    step = np.pi / np.array([high, wide])
    for _ in range(_ZOOMS):
        trial_waves = wave[:, None] + step[:, None] * np.arange(-2, 3)
        down, along = (
            np.exp(-1j * np.outer(trial, np.arange(n)))
            for trial, n in zip(trial_waves, (high, wide), strict=True)
        )
        near = np.square(np.abs(down @ seen @ along.T)).sum(axis=0)
        best = np.unravel_index(int(near.argmax()), near.shape)
        wave = np.array([trial_waves[0, best[0]], trial_waves[1, best[1]]])
        step = step / 2
    return wave


def _around(power: FloatArray, wide: int) -> FloatArray:
    """Give the median of a half spectrum (y, k) at the distance of each point, and of its lines."""
    high, _ = power.shape
    side = max(high, wide)
    ring = np.rint(side * np.hypot(np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide)))
    order = np.argsort(ring, axis=None, kind="stable")
    cuts = np.flatnonzero(np.diff(ring.ravel()[order])) + 1
    middle = np.array([np.median(part) for part in np.split(power.ravel()[order], cuts)])
    at_distance: NDArray[np.float64] = middle[np.searchsorted(np.unique(ring), ring)]
    lines = np.maximum(np.median(power, axis=1, keepdims=True), np.median(power, axis=0))
    return np.maximum(at_distance, lines)


_PARTS = 8  # along each axis
_SIGNIFICANT = 30.0  # squared standard errors, which follow from the differences of the parts
_RESIDUAL_SIGMAS = 4.0  # standard errors of what is left over in a part
_LEAST_PATTERN_RATIO = 10.0  # times what the noise of the mean frame tells, that its pattern must
_MOST_PATTERN_RATIO = 4.0  # times what the median part tells, more than which none should
_MOST_ADDED_SHARE = 0.25  # of the mean light, more than which is not added between windows
_LEAST_PARTS = 16
_LEAST_PATTERN_POWER = 1e-3  # by a part, of what others tell


def lift(light_e: FloatArray) -> FloatArray:
    """Relative change of pixels to which the same number is added.

    Shapes: `light_e` (y, x), result (y, x).
    """
    used = light_e > 0
    return np.where(used, light_e[used].mean() / np.where(used, light_e, 1.0), 0.0)


def find_stray_light(changes: Changes, window: int) -> float:
    """Measure a change that is added to all pixels equally, over the mean light; 0 if none."""
    light, more = changes.light_e, lift(changes.light_e)
    rows, columns = (
        np.equal.outer(np.arange(_PARTS), np.arange(n) * _PARTS // n).astype(np.float64)
        for n in light.shape
    )

    def summed(values: FloatArray) -> FloatArray:
        parts: FloatArray = rows @ values @ columns.T
        return parts.reshape(*values.shape[:-2], -1)

    held, once, twice = summed(light), summed(light * more), summed(light * more**2)
    pattern_power = np.maximum(twice - np.square(once) / np.where(held > 0, held, 1.0), 0.0)
    if not (pattern_power > 0).any():
        return 0.0
    usual = np.median(pattern_power[pattern_power > 0])
    lit = (pattern_power > 0) & (
        pattern_power < _MOST_PATTERN_RATIO * usual
    )  # without dust and particles
    if lit.sum() < _LEAST_PARTS:
        return 0.0
    mean, pattern_power = once[lit] / held[lit], pattern_power[lit]
    pixels = summed((light > 0).astype(np.float64))[lit]
    if pattern_power.sum() < _LEAST_PATTERN_RATIO * pixels.sum() * changes.noises.mean() / len(
        changes.noises
    ):
        return 0.0
    bright = np.where(light > 0, light, 1.0)
    levels, lifts, squares = [], [], []
    for sums in changes.sums_e:  # one pair after the other, to save memory
        each = sums * (light.sum() / sums.sum(axis=(1, 2), keepdims=True)) - light
        levels.append(summed(each)[:, lit])
        lifts.append(summed(each * more)[:, lit])
        squares.append(summed(np.square(each[1] - each[0]) / bright)[lit])
    level, lifted = np.array(levels), np.array(lifts)
    even = level[:, 1] - level[:, 0]
    seen = lifted[:, 1] - lifted[:, 0] - even * mean
    added = seen.sum(axis=1, keepdims=True) / pattern_power.sum()
    rest = seen - added * pattern_power
    spread = np.square(rest) / np.maximum(
        pattern_power, pattern_power.mean() * _LEAST_PATTERN_POWER
    )
    error = spread.sum(axis=1) / (lit.sum() - 1) / pattern_power.sum()
    square = float(np.median(np.square(added)))
    if square > _MOST_ADDED_SHARE**2:
        return 0.0
    if square * pattern_power.sum() / light.sum() < changes.least(window) + changes.error:
        return 0.0
    if np.median(np.square(added[:, 0]) / error) < _SIGNIFICANT:
        return 0.0
    # in variances of noise, of the pixels of a part
    noises = changes.noises[:, None]
    gain = np.square(added) * pattern_power / noises
    left = np.array(squares) / noises - np.square(even) / held[lit] / noises - gain - (pixels - 1)
    doubt = _RESIDUAL_SIGMAS * math.sqrt(2 * float(pixels.mean()) / left.size)
    if np.median(left) > np.median(gain) + doubt:
        return 0.0
    here = lifted - level * mean
    return float(np.ptp(here.sum(axis=-1))) / float(pattern_power.sum())


HIGHEST_DEGREE = 12
"""Of a polynomial that is divided out: over a field of 128 pixels it follows waves of 40."""

_PIXELS_PER_TERM = 150  # fewer would take more of a particle's light than its neighbours'
_CELLS = 20  # along each axis of the grid on which changes are looked for
_PASSES = 4
_ROUNDS = 2  # in which seams and fringes are looked for, each beside the other
_CLIP_SIGMAS = 4.0  # robust standard deviations beyond which a cell shows something else
_LEAST_SIGMAS = 8.0  # standard errors beyond which a change is one: it repeats in time and place
_LEAST_CELL_SHARE = 0.1  # of the cells, over which a change of the light is spread at least
# Times what a smooth change leaves over in a cell, that it must make there
_LEAST_SMOOTH_RATIO = 3.0
_LOWEST_HIGHEST = 3  # degree without which smooth is not told from fine
_SIGMA_PER_MAD = 1.4826  # standard deviation of a normal law over its median deviation
_LEAST_SHARE = 1e-10  # of what is told of the best known combination of terms


@dataclass(frozen=True, eq=False)
class Surface:
    """Measures how the light of frames differs from the mean light; made by `find_surface`."""

    light_e: FloatArray
    degree: int
    rms: float = math.nan
    fringes: Fringes = NO_FRINGES
    amplifier_boundaries: AmplifierBoundaries = ((), ())
    stray_light: float = 0.0

    @property
    def measures(self) -> bool:
        """Whether anything changes."""
        return bool(
            self.degree
            or len(self.fringes.waves)
            or any(self.amplifier_boundaries)
            or self.stray_light
        )

    def findings(self, name: str) -> Iterator[Finding]:
        """Give what the user should know, one finding for each kind of change."""
        if self.degree:
            values = {"percent": 100 * self.rms, "degree": self.degree}
            yield LIGHT_SMOOTH(values, where=name)
        if len(self.fringes.waves):
            periods = " and ".join(f"{period:.3g}" for period in self.fringes.periods_px)
            yield LIGHT_FRINGES({"periods": periods, "percent": 100 * self.fringes.rms}, where=name)
        if any(self.amplifier_boundaries):
            parts = " and ".join(
                f"{axis} {', '.join(map(str, cuts))}"
                for axis, cuts in zip(("row", "column"), self.amplifier_boundaries, strict=True)
                if cuts
            )
            yield LIGHT_SEAMS({"parts": parts}, where=name)
        if self.stray_light:
            yield LIGHT_ADDED({"percent": 100 * self.stray_light}, where=name)

    @cached_property
    def _axes(self) -> tuple[FloatArray, FloatArray]:
        """Functions of rows (y, k) and of columns (x, k), whose products are measured."""
        return self._functions[:2]

    @cached_property
    def _kept(self) -> NDArray[np.intp]:
        return np.flatnonzero(self._functions[2])

    @cached_property
    def _functions(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Functions of rows and columns, and of which of them there are products (k, k)."""
        from scipy.linalg import block_diag  # 30 ms to load, for light that changes

        shape = (self.light_e.shape[0], self.light_e.shape[1])
        degrees = np.arange(self.degree + 1)
        smooth = np.add.outer(degrees, degrees) <= self.degree
        parts = [
            (*(legvander(np.linspace(-1, 1, n), self.degree) for n in shape), smooth),
            self.fringes.axes(shape),
            parts_of(shape, self.amplifier_boundaries),
        ]
        rows, columns, products = zip(*parts, strict=True)
        return np.hstack(rows), np.hstack(columns), block_diag(*products) > 0

    @cached_property
    def _inverse(self) -> FloatArray:
        """Pseudoinverse that turns overlaps with the products into coefficients."""
        rows, columns = self._axes
        down, along = np.divmod(self._kept, columns.shape[1])
        gram = np.empty((self._kept.size, self._kept.size))
        for k, (i, j) in enumerate(zip(down, along, strict=True)):
            overlap = (
                (rows * rows[:, i : i + 1]).T @ self.light_e @ (columns * columns[:, j : j + 1])
            )
            gram[k] = overlap[down, along]
        if self.stray_light:
            light, more = self.light_e, lift(self.light_e)
            mixed = (rows.T @ (light * more) @ columns)[down, along]
            own = np.sum(light * more**2)
            gram = np.block([[gram, mixed[:, None]], [mixed, own]])
        return np.asarray(np.linalg.pinv(gram, rcond=_LEAST_SHARE, hermitian=True))

    def factors(self, electrons: FloatArray) -> FloatArray:
        """Give the light of frames over the mean light.

        Shapes: `electrons` (…, y, x), result (…, y, x).
        """
        used = self.light_e > 0
        seen = np.where(used, electrons, 0.0)
        total = seen.sum(axis=(-2, -1), keepdims=True)
        lit = total > 0
        seen *= self.light_e.sum() / np.where(lit, total, 1.0)
        rows, columns = self._axes
        change = np.where(lit, seen - self.light_e, 0.0)
        overlap = rows.T @ change @ columns
        flat = overlap.reshape(*overlap.shape[:-2], -1)
        overlaps = flat[..., self._kept]
        if self.stray_light:
            more = lift(self.light_e)
            overlaps = np.concatenate(
                [overlaps, np.sum(change * more, axis=(-2, -1))[..., None]], axis=-1
            )
        found = overlaps @ self._inverse
        terms = np.zeros_like(flat)
        terms[..., self._kept] = found[..., : self._kept.size]
        out = 1 + rows @ terms.reshape(overlap.shape) @ columns.T
        if self.stray_light:
            out += found[..., -1:, None] * more
        return np.where(out > 0, out, 1.0)


def find_surface(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera, window: int
) -> Surface | None:
    """Find changes of the distribution of the light between frames.

    Shapes: `pairs` (t, y, x).
    """
    changes = Changes.of(pairs, camera)
    if changes is None:
        return None
    room = math.sqrt(2 * changes.used.sum() / _PIXELS_PER_TERM)
    highest = min(HIGHEST_DEGREE, math.floor(room) - 2)
    if highest < _LOWEST_HIGHEST:
        return None
    found = _patterns(changes, window, highest)
    seamless = _even(changes, replace(found, fringes=NO_FRINGES))
    degree, rms = _smooth(seamless, window, highest, found.fringes)
    found = replace(found, degree=degree, rms=rms)
    found = replace(found, stray_light=find_stray_light(_even(changes, found), window))
    return found if found.measures else None


def _patterns(changes: Changes, window: int, highest: int) -> Surface:
    """Find amplifier boundaries and fringes, in turns, because each hides the other."""
    found = Surface(changes.light_e, 0, 0.0)
    for _ in range(_ROUNDS):
        seams = find_amplifier_boundaries(_even(changes, found), window, found.amplifier_boundaries)
        if len(found.fringes.waves) and seams == found.amplifier_boundaries:
            break
        found = replace(found, amplifier_boundaries=seams, fringes=NO_FRINGES)
        fringes = find_fringes(_even(changes, found), window, highest)
        found = replace(found, fringes=fringes)
        if not len(fringes.waves):
            break
    return found


def _even(changes: Changes, found: Surface) -> Changes:
    """Divide sums by the changes found in them."""
    if not found.measures:
        return changes
    return changes.divided(found.factors(changes.sums_e))


def _smooth(changes: Changes, window: int, highest: int, fringes: Fringes) -> tuple[int, float]:
    """Give the degree of the polynomial beside waves, and the rms of its changes; 0 without one."""
    grid = _Grid.of(changes, highest, fringes)
    squares, left = grid.squares()
    count = len(squares)
    if not count:
        return 0, 0.0
    of_degree = [squares[:, grid.degrees == d] for d in range(1, highest + 1)]
    excess = np.array([(s - 1).sum() / count for s in of_degree])
    beyond = np.cumsum(excess[::-1])[::-1]  # what polynomials of lower degree leave
    terms = np.cumsum([s.shape[1] for s in of_degree[::-1]])[::-1]
    least = changes.least(window) / changes.error
    seen = (beyond > least) & (beyond > _LEAST_SIGMAS * np.sqrt(2 * terms / count))
    if not seen[0] or beyond[0] < _LEAST_SMOOTH_RATIO * left * grid.basis.shape[0]:
        return 0, 0.0
    return int(np.flatnonzero(seen).max()) + 1, math.sqrt(float(beyond[0]) * changes.error)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Sums of frames in cells, and the basis functions in the same cells."""

    changes: FloatArray  # (pairs, cells) in standard deviations of shot noise
    basis: FloatArray  # (cells, terms) orthonormal: waves, then polynomials
    degrees: NDArray[np.int64]  # of the terms; -1 of waves

    @classmethod
    def of(cls, changes: Changes, highest: int, fringes: Fringes) -> _Grid:
        """Sum frames."""
        used, light = changes.used, changes.light_e
        y, x = np.nonzero(used)
        rows, columns = used.shape
        cell = (y * _CELLS // rows) * _CELLS + x * _CELLS // columns

        def total(values: NDArray[Any]) -> FloatArray:
            return np.bincount(cell, values, minlength=_CELLS**2).astype(np.float64)

        pixels = total(np.ones(cell.size))
        lit = pixels > 0
        held = total(light[used])[lit]
        place_y, place_x = (
            2 * total(k)[lit] / pixels[lit] / max(n - 1, 1) - 1
            for k, n in ((y, rows), (x, columns))
        )
        powers = np.add.outer(np.arange(highest + 1), np.arange(highest + 1))
        order = np.argsort(powers, axis=None, kind="stable")
        order = order[powers.ravel()[order] <= highest]
        terms = [legvander2d(place_y, place_x, [highest, highest])[:, order]]
        down, along, products = fringes.axes((rows, columns))
        for i, j in np.argwhere(products):
            terms.insert(
                0, total(light[used] * down[y, i] * along[x, j])[lit, None] / held[:, None]
            )
        basis, _ = np.linalg.qr(np.sqrt(held)[:, None] * np.hstack(terms))
        degrees = np.concatenate([np.full(int(products.sum()), -1), powers.ravel()[order]])
        out = np.empty((len(changes.sums_e), held.size))
        for k, two in enumerate(changes.sums_e):
            before, after = (total(part[used])[lit] / part[used].sum() for part in two)
            out[k] = (after - before) * held.sum() / np.sqrt(held * changes.noises[k])
        return cls(out, basis, degrees)

    def squares(self) -> tuple[FloatArray, float]:
        """Squared coefficients (pairs, terms) and residual, in variances of a cell.

        Where there is only noise, the mean of the residual over cells and pairs is 0.
        """
        out: list[FloatArray] = []
        whole = np.eye(self.basis.shape[1])
        left, freedom = 0.0, 0
        for change in self.changes:
            # what landed and is large would bend the first fit so that nothing stands out of it
            away = np.abs(change - np.median(change))
            kept = away <= _CLIP_SIGMAS * max(1.0, _SIGMA_PER_MAD * float(np.median(away)))
            if kept.sum() <= self.basis.shape[1]:
                kept[:] = True
            for _ in range(_PASSES):
                part, turned = self.basis, whole
                if not kept.all():  # beside a hole the noise of terms is known as well
                    part, turned = np.linalg.qr(self.basis[kept])
                found = part.T @ change[kept]
                fitted = self.basis @ np.linalg.solve(turned, found)
                rest = np.abs(change - fitted)
                inside = rest <= _CLIP_SIGMAS * max(1.0, _SIGMA_PER_MAD * float(np.median(rest)))
                if np.array_equal(inside, kept) or inside.sum() <= found.size:
                    break
                kept = inside
            squares = np.square(fitted - np.median(fitted))
            if squares.sum() ** 2 < _LEAST_CELL_SHARE * squares.size * np.square(squares).sum():
                continue  # dust that landed, which is nowhere else
            out.append(np.square(found))
            left += float(np.square(rest[kept]).sum())
            freedom += int(kept.sum()) - found.size
        return np.array(out).reshape(-1, self.basis.shape[1]), left / max(freedom, 1) - 1
