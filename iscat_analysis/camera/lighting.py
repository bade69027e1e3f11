"""Light whose distribution over the field changes: found, and measured in every frame.

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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander, legvander2d
from numpy.typing import NDArray

from iscat_analysis.camera.amplifier_boundaries import (
    AmplifierBoundaries,
    find_amplifier_boundaries,
    parts_of,
)
from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.fringes import NO_FRINGES, Fringes, find_fringes
from iscat_analysis.camera.light_changes import Changes
from iscat_analysis.camera.stray_light import find_stray_light, lift
from iscat_analysis.records import BoolArray, FloatArray

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

    @property
    def messages(self) -> list[str]:
        """Messages for the user, one line each."""
        lines = []
        if self.degree:
            lines.append(
                f"the light changes slowly over the field, by {100 * self.rms:.2g} % rms between "
                "frames that are compared, as where the beam wanders or fringes pass: each frame "
                f"was divided by its own smooth light, a polynomial of degree {self.degree}"
            )
        if len(self.fringes.waves):
            periods = " and ".join(f"{period:.3g}" for period in self.fringes.periods_px)
            lines.append(
                f"fringes with a period of {periods} pixels pass over the field, and change the "
                f"light by {100 * self.fringes.rms:.2g} % rms between frames that are compared: "
                "each frame was divided by its own; what reflects the laser beside the sample "
                "makes them: tilt it, or take a source that is less coherent"
            )
        if any(self.amplifier_boundaries):
            parts = " and ".join(
                f"{name} {', '.join(map(str, cuts))}"
                for name, cuts in zip(("row", "column"), self.amplifier_boundaries, strict=True)
                if cuts
            )
            lines.append(
                f"parts of the field, which begin at {parts}, change as a whole, as where the "
                "camera reads them out by amplifiers of their own: each part of each frame was "
                "divided by its own light"
            )
        if self.stray_light:
            lines.append(
                "dim pixels change by more of their light than bright ones, as where something is "
                f"added to all of them that changes by {100 * self.stray_light:.2g} % of the mean "
                "light within the movie: light that does not come through the objective, the "
                "offset of a camera that warms up, or what focus does; each frame was divided by "
                "its own, but what is added all the time is not known, and masses may be wrong by "
                "as much"
            )
        return lines

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
