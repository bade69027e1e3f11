"""Fringes that pass over the field: plane waves of light, and how long and how steep they are.

Where fringes are curved, or stronger in the middle of the field than at its border, the height of a
wave is a complex polynomial.  Two reflections of a coherent source make one wave, whose phase
drifts as they warm up.  In the spectrum of the changes of the light it is one point, where
particles, a pattern that moves and noise are spread over many: it is a wave where it stands far out
of the others at its distance from the middle, and out of those of its own row and column, in which
lines that flicker lie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from scipy import fft
from scipy.special import chdtri

from iscat_analysis.camera.light_changes import Changes
from iscat_analysis.records import BoolArray, FloatArray

_MOST_WAVES = 6  # waves: a source with two interfering reflections has one, with three three
_MOST_SQUARES = 160  # squares along an axis, at most, of which a spectrum is made
# Times what is around it, beyond noise, that a wave has in the spectrum: of a
_LEAST_POWER_RATIO = 100.0
# pattern that moves, the largest of 1e4 points has half of that
_BY_CHANCE = 1e-10  # that a point is as far above noise: a field has some 1e4
_CLIP_SIGMAS = 5.0  # robust standard deviations of the changes of a pixel
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
        np.clip(change, -_CLIP_SIGMAS * spread, _CLIP_SIGMAS * spread), smooth_degree
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
