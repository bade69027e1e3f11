"""Light whose distribution over the field changes slowly: found, and measured in every frame.

A beam that wanders, fringes that pass or a lamp that warms up change the light of a pixel, and that
of its neighbours in the same way.  Over the mean frame such a change is a polynomial in x and y of
low degree, which least squares measure in every frame with an error far below the noise of one
pixel.  A particle is part of what is measured: `iscat_analysis.movie.lines.Lines.left` says what
that takes of it.

Whether there is such a change is asked of frames as far apart as the windows that are compared.
Particles that land between them, and pixels that blink, stand out of the polynomial in a few cells
of a grid, which are left out.  A fixed pattern that moves, or shaking, changes the light at every
scale, down to that of a particle: then nothing is divided out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander, legvander2d
from numpy.typing import NDArray

from iscat_analysis.movie.camera import Camera
from iscat_analysis.records import BoolArray, FloatArray

HIGHEST_DEGREE = 12
"""Of a polynomial that is divided out: over a field of 128 pixels it follows waves of 40."""

_PIXELS_PER_TERM = 150  # fewer would take more of a particle's light than its neighbours'
_CELLS = 20  # along each axis of the grid on which changes are looked for
_PASSES = 4
_CLIP = 4.0  # robust standard deviations beyond which a cell shows something else
_SIGNIFICANT = 8.0  # standard errors beyond which a change is one: it repeats in time and place
_MATTERS = 0.02  # of the noise variance of a pixel between two windows, below which none is
_SMOOTH = 3.0  # times what a smooth change leaves over in a cell, that it must make there
_LOWEST_HIGHEST = 3  # degree without which smooth is not told from fine
_LEAST_LIGHT = 0.1  # of the median pixel's
_NORMAL = 1.4826  # standard deviation of a normal law over its median deviation


@dataclass(frozen=True, eq=False)
class Surface:
    """Measures the smooth part of frames over their mean one; `find_surface` makes it.

    Attributes
    ----------
    light_e : ndarray, shape (y, x)
        Mean photoelectrons of a frame [e]; 0 in pixels that are not used.
    degree : int
        Of the polynomial in x and y.
    rms : float
        Of the change between frames that are compared, over the field and the movie.
    """

    light_e: FloatArray
    degree: int
    rms: float = math.nan

    @property
    def message(self) -> str:
        """One line for the user."""
        return (
            f"the light changes slowly over the field, by {100 * self.rms:.2g} % rms between "
            "frames that are compared, as where the beam wanders or fringes pass: each frame was "
            f"divided by its own smooth light, a polynomial of degree {self.degree}"
        )

    @cached_property
    def _axes(self) -> tuple[FloatArray, FloatArray]:
        """Legendre polynomials of the rows (y, k) and columns (x, k)."""
        rows, columns = (
            legvander(np.linspace(-1, 1, n), self.degree).astype(np.float64)
            for n in self.light_e.shape
        )
        return rows, columns

    @cached_property
    def _kept(self) -> NDArray[np.intp]:
        degrees = np.add.outer(np.arange(self.degree + 1), np.arange(self.degree + 1))
        return np.flatnonzero(degrees <= self.degree)

    @cached_property
    def _inverse(self) -> FloatArray:
        """Turns overlaps with the polynomials into coefficients."""
        squares = [np.einsum("ni,nj->nij", a, a).reshape(len(a), -1) for a in self._axes]
        k = self.degree + 1
        gram = (squares[0].T @ self.light_e @ squares[1]).reshape(k, k, k, k)
        gram = gram.transpose(0, 2, 1, 3).reshape(k * k, k * k)
        return np.asarray(np.linalg.inv(gram[np.ix_(self._kept, self._kept)]))

    def factors(self, electrons: FloatArray) -> FloatArray:
        """Measure the smooth change of frames.

        Parameters
        ----------
        electrons : ndarray, shape (…, y, x)
            Frames [e].

        Returns
        -------
        ndarray, shape (…, y, x)
            Factor, whose mean over the light is 1; 1 where a frame has none.
        """
        used = self.light_e > 0
        seen = np.where(used, electrons, 0.0)
        total = seen.sum(axis=(-2, -1), keepdims=True)
        lit = total > 0
        seen *= self.light_e.sum() / np.where(lit, total, 1.0)
        rows, columns = self._axes
        overlap = rows.T @ np.where(lit, seen - self.light_e, 0.0) @ columns
        flat = overlap.reshape(*overlap.shape[:-2], -1)
        terms = np.zeros_like(flat)
        terms[..., self._kept] = flat[..., self._kept] @ self._inverse
        out = 1 + rows @ terms.reshape(overlap.shape) @ columns.T
        return np.where(out > 0, out, 1.0)


def find_surface(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera, window: int
) -> Surface | None:
    """Look for smooth changes of the light between frames.

    Parameters
    ----------
    pairs : sequence of (ndarray, ndarray), shape (t, y, x)
        Successive good frames, and others as much later as the windows that are compared [counts].
    camera : Camera
        Counts → photoelectrons.
    window : int
        Frames that are averaged before and after.

    Returns
    -------
    Surface or None
        None where the light changes by less than matters, or at every scale.
    """
    grid = _Grid.of(pairs, camera)
    if grid is None:
        return None
    squares, left = grid.squares()
    count = len(squares)
    error = grid.noises.mean() / grid.light_e.sum()  # of one term's mean square contrast
    highest = int(grid.degrees.max())
    of_degree = [squares[:, grid.degrees == d] for d in range(1, highest + 1)]
    excess = np.array([(s - 1).sum() / count for s in of_degree])
    beyond = np.cumsum(excess[::-1])[::-1]  # what polynomials of lower degree leave
    terms = np.cumsum([s.shape[1] for s in of_degree[::-1]])[::-1]
    least = _MATTERS * grid.pixel_variance(window) / error
    seen = (beyond > least) & (beyond > _SIGNIFICANT * np.sqrt(2 * terms / count))
    if not seen[0] or beyond[0] < _SMOOTH * left * grid.light_e.size:
        return None
    degree = int(np.flatnonzero(seen).max()) + 1
    return Surface(grid.mean_e, degree, math.sqrt(float(beyond[0]) * error))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Frames summed in cells, and polynomials over them."""

    changes: FloatArray  # (pairs, cells) in standard deviations of shot noise
    noises: FloatArray  # (pairs,) variance of a contrast, times the light of its pixels
    light_e: FloatArray  # of a frame, in each cell
    basis: FloatArray  # (cells, terms) orthonormal
    degrees: NDArray[np.int64]
    mean_e: FloatArray  # of a frame, in each pixel; 0 where it is not used

    @classmethod
    def of(cls, pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera) -> _Grid | None:
        """Sum frames; None where there are too few frames, pixels or photoelectrons."""
        if not pairs:
            return None
        sums = np.array([[camera.to_electrons(k).sum(axis=0) for k in two] for two in pairs])
        frames = np.array([[len(k) for k in two] for two in pairs])
        light = sums.sum(axis=(0, 1)) / frames.sum()
        used = usable_pixels(pairs, light, camera)
        room = math.sqrt(2 * used.sum() / _PIXELS_PER_TERM)
        highest = min(HIGHEST_DEGREE, math.floor(room) - 2)
        if highest < _LOWEST_HIGHEST or sums[..., used].sum(axis=-1).min() <= 0:
            return None
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
        polynomials = legvander2d(place_y, place_x, [highest, highest])[:, order]
        basis, _ = np.linalg.qr(np.sqrt(held)[:, None] * polynomials)
        read = float(camera.read_variance_e2(used.shape)[used].mean() / light[used].mean())
        noises = (1 + read) * (1 / frames).sum(axis=1)
        changes = np.empty((len(pairs), held.size))
        for k, two in enumerate(sums):
            before, after = (total(part[used])[lit] / part[used].sum() for part in two)
            changes[k] = (after - before) * held.sum() / np.sqrt(held * noises[k])
        mean = np.where(used, light, 0.0)
        return cls(changes, noises, held, basis, powers.ravel()[order], mean)

    def pixel_variance(self, window: int) -> float:
        """Variance of the contrast of one pixel between two windows."""
        return float(2 / (window * self.mean_e[self.mean_e > 0].mean()))

    def squares(self) -> tuple[FloatArray, float]:
        """Squared coefficients (pairs, terms) in their variances, and what they leave of a cell's.

        Where nothing but noise is left, the mean of that over cells and pairs is 0.
        """
        out = np.empty((len(self.changes), self.basis.shape[1]))
        left, freedom = 0.0, 0
        for k, change in enumerate(self.changes):
            kept = np.ones(change.size, dtype=np.bool_)
            for _ in range(_PASSES):
                part = self.basis[kept]
                found = np.linalg.solve(part.T @ part, part.T @ change[kept])
                rest = np.abs(change - self.basis @ found)
                inside = rest <= _CLIP * max(1.0, _NORMAL * float(np.median(rest)))
                if np.array_equal(inside, kept) or inside.sum() <= found.size:
                    break
                kept = inside
            out[k] = np.square(found)
            left += float(np.square(rest[kept]).sum())
            freedom += int(kept.sum()) - found.size
        return out, left / freedom - 1


def usable_pixels(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], light_e: FloatArray, camera: Camera
) -> BoolArray:
    """Tell which pixels say something of the light.

    Parameters
    ----------
    pairs : sequence of (ndarray, ndarray), shape (t, y, x)
        Frames [counts].
    light_e : ndarray, shape (y, x)
        Their mean [e].
    camera : Camera
        Counts → photoelectrons.

    Returns
    -------
    ndarray of bool, shape (y, x)
        Those that are lit, and saturated in none.
    """
    highest = np.max([part.max(axis=0) for two in pairs for part in two], axis=0)
    lit: BoolArray = light_e > _LEAST_LIGHT * max(float(np.median(light_e)), 0.0)
    return lit & ~camera.saturated(highest)
