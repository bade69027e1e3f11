"""Light whose distribution over the field changes: one linear model, measured in every frame.

A beam that wanders, fringes that pass or a lamp that warms up change the light of a pixel, and that
of its neighbours in the same way.  Over the mean frame such a change is a sum of components, each a
block of columns of one design matrix: a polynomial in x and y of low degree, a few plane waves, the
parts of a camera with several amplifiers, and light that is added to all pixels alike.  Least
squares measure them together in every frame, with an error far below the noise of one pixel; of
combinations that the field does not tell apart the smallest is taken.  `light_search` finds which
components a movie has.

Where a shutter rolls, every row sees the laser at its own moment, and where columns have their own
amplifiers each may drift: all pixels of a line share a factor f that no other frame has.  It is
measured by the light of the line over that of the same line in the mean frame, both over the whole
frame's, with an error of 1/√(C N) for C pixels of N photoelectrons.

A particle of contrast c is part of that light.  In a single frame it is far below the noise, so
that a median is moved by it as a mean is, and is noisier; but what it does to a mean is known: it
lowers its line by the line's mean contrast, of a diffraction-limited spot 2λ/(π NA C a) of its
height, with pixels of side a, as much as 2 % where C = 128.  `LightModel.left` says what the
correction leaves of a signal, and searches and fits expect that.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from iscat_analysis.camera.background import find_defects
from iscat_analysis.camera.counts import Camera, float_type
from iscat_analysis.camera.spectrum import measure_spectrum
from iscat_analysis.findings import Finding
from iscat_analysis.findings import camera as of
from iscat_analysis.movie import ChangedFrames
from iscat_analysis.records import BoolArray, FloatArray

Axes = tuple[FloatArray, FloatArray, BoolArray]
"""Functions of rows (y, k) and of columns (x, m), and which of their products are fitted (k, m)."""


@dataclass(frozen=True)
class Smooth:
    """A polynomial of a degree, and the rms of its changes."""

    degree: int = 0
    rms: float = 0.0

    def __bool__(self) -> bool:
        return self.degree > 0

    def axes(self, shape: tuple[int, int]) -> Axes:
        """Give products of Legendre polynomials up to the degree."""
        rows, columns = (_polynomials(n, self.degree) for n in shape)
        return rows, columns, _up_to(self.degree)

    def finding(self, name: str) -> Finding:
        """Tell that the light changes slowly over the field."""
        return of.LIGHT_SMOOTH({"percent": 100 * self.rms, "degree": self.degree}, where=name)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {"smooth_degree": self.degree, "smooth_rms": self.rms}


@dataclass(frozen=True, eq=False)
class Fringes:
    """Plane waves whose amplitudes and phases change.

    Where fringes are curved, or stronger in the middle of the field than at its border, the height
    of a wave is a complex polynomial of some degree.
    """

    waves: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    degree: int = 0
    rms: float = 0.0

    def __bool__(self) -> bool:
        return len(self.waves) > 0

    @property
    def periods_px(self) -> FloatArray:
        """Periods, shape (n,) [pixels]."""
        return np.asarray(2 * np.pi / np.hypot(*self.waves.T))

    def axes(self, shape: tuple[int, int]) -> Axes:
        """Give what waves are made of, wherever their crests are."""

        def functions(axis: int) -> FloatArray:
            n = shape[axis]
            phase = np.outer(np.arange(n) - (n - 1) / 2, self.waves[:, axis])
            turns = np.hstack([np.cos(phase), np.sin(phase)])
            heights = _polynomials(n, self.degree)
            return np.asarray((turns[:, :, None] * heights[:, None]).reshape(n, -1))

        same = np.tile(np.eye(len(self.waves)), (2, 2))
        return functions(0), functions(1), np.kron(same, _up_to(self.degree)) > 0

    def finding(self, name: str) -> Finding:
        """Tell which fringes pass."""
        periods = " and ".join(f"{period:.3g}" for period in self.periods_px)
        return of.LIGHT_FRINGES({"periods": periods, "percent": 100 * self.rms}, where=name)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {"fringe_periods_px": self.periods_px.tolist(), "fringe_rms": self.rms}


@dataclass(frozen=True)
class Seams:
    """Rows and columns at which a part begins that the camera reads out by itself."""

    rows: tuple[int, ...] = ()
    columns: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.rows or self.columns)

    def axes(self, shape: tuple[int, int]) -> Axes:
        """Give indicator functions of the parts."""
        rows, columns = (
            np.equal.outer(np.searchsorted(at, np.arange(n), side="right"), np.arange(len(at) + 1))
            for n, at in zip(shape, (self.rows, self.columns), strict=True)
        )
        if not self:
            rows, columns = rows[:, :0], columns[:, :0]
        products = np.ones((rows.shape[1], columns.shape[1]), dtype=np.bool_)
        return rows.astype(np.float64), columns.astype(np.float64), products

    def finding(self, name: str) -> Finding:
        """Tell where parts of the field begin."""
        parts = " and ".join(
            f"{axis} {', '.join(map(str, at))}"
            for axis, at in (("row", self.rows), ("column", self.columns))
            if at
        )
        return of.LIGHT_SEAMS({"parts": parts}, where=name)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {"seam_rows": list(self.rows), "seam_columns": list(self.columns)}


Component = Smooth | Fringes | Seams
"""A change of the light; false where there is none."""


def _polynomials(n: int, degree: int) -> FloatArray:
    """Legendre polynomials up to a degree at n places along an axis, shape (n, degree + 1)."""
    return np.asarray(legvander(np.linspace(-1, 1, n), degree), dtype=np.float64)


def _up_to(degree: int) -> BoolArray:
    """Which products of polynomials have at most a degree, shape (degree + 1, degree + 1)."""
    degrees = np.arange(degree + 1)
    return np.asarray(np.add.outer(degrees, degrees) <= degree)


def lift(light_e: FloatArray) -> FloatArray:
    """Relative change of pixels to which the same number is added.

    Shapes: `light_e` (y, x), result (y, x).
    """
    used = light_e > 0
    return np.where(used, light_e[used].mean() / np.where(used, light_e, 1.0), 0.0)


@dataclass(frozen=True, eq=False)
class LightModel:
    """How the light of frames differs from the mean light; made by `find_light`."""

    light_e: FloatArray
    smooth: Smooth = Smooth()
    fringes: Fringes = field(default_factory=Fringes)
    seams: Seams = Seams()
    added: float = 0.0
    """Range of what is added to all pixels alike within the movie, over the mean light."""
    shares: tuple[float, float] = (0.0, 0.0)
    """Of the noise variance, that whole rows and whole columns have in common."""

    @property
    def components(self) -> tuple[Component, ...]:
        """Blocks of products in the design matrix."""
        return self.smooth, self.fringes, self.seams

    @property
    def uneven(self) -> bool:
        """Whether the distribution of the light changes; lines aside, which flicker."""
        return any(self.components) or self.added > 0

    def findings(self, name: str) -> list[Finding]:
        """Give what the user should know, one finding for each component."""
        found = [part.finding(name) for part in self.components if part]
        if self.added:
            found.append(of.LIGHT_ADDED({"percent": 100 * self.added}, where=name))
        if any(self.shares):
            flicker = [(n, s) for n, s in zip(("rows", "columns"), self.shares, strict=True) if s]
            lines = " and ".join(n for n, _ in flicker)
            percents = " and ".join(f"{100 * share:.2g} %" for _, share in flicker)
            found.append(of.LINES_FLICKER({"lines": lines, "percents": percents}, where=name))
        return found

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        row, column = map(float, self.shares)
        parts = {key: value for part in self.components for key, value in part.summary.items()}
        return {"row_share": row, "column_share": column, **parts, "haze": self.added}

    @cached_property
    def _axes(self) -> Axes:
        """Functions of rows and columns of all components, and the products that are fitted."""
        from scipy.linalg import block_diag  # 30 ms to load, for light that changes

        shape = (self.light_e.shape[0], self.light_e.shape[1])
        rows, columns, products = zip(*(part.axes(shape) for part in self.components), strict=True)
        return np.hstack(rows), np.hstack(columns), block_diag(*products) > 0

    @cached_property
    def _inverse(self) -> FloatArray:
        """Pseudoinverse that turns overlaps with the columns of the design into coefficients."""
        rows, columns, products = self._axes
        light = self.light_e
        terms = ((rows[:, [i]], columns[:, [j]]) for i, j in np.argwhere(products))
        gram = np.array([((rows * r).T @ light @ (columns * c))[products] for r, c in terms])
        if self.added:
            more = lift(light)
            mixed = (rows.T @ (light * more) @ columns)[products]
            gram = np.block([[gram, mixed[:, None]], [mixed, np.sum(light * more**2)]])
        # directions of which the field tells less than that share of the best one are left out
        return np.asarray(np.linalg.pinv(gram, rcond=1e-10, hermitian=True))

    def _distribution(self, seen: FloatArray) -> FloatArray:
        """Fit all components to the light of frames (…, y, x), over the mean light."""
        total = seen.sum(axis=(-2, -1), keepdims=True)
        lit = total > 0
        scaled = seen * (self.light_e.sum() / np.where(lit, total, 1.0))
        change = np.where(lit, scaled - self.light_e, 0.0)
        rows, columns, products = self._axes
        overlaps = (rows.T @ change @ columns)[..., products]
        more = lift(self.light_e) if self.added else None
        if more is not None:
            last = np.sum(change * more, axis=(-2, -1))[..., None]
            overlaps = np.concatenate([overlaps, last], axis=-1)
        found = overlaps @ self._inverse
        terms = np.zeros((*change.shape[:-2], *products.shape))
        terms[..., products] = found if more is None else found[..., :-1]
        out = 1 + rows @ terms @ columns.T
        if more is not None:
            out += found[..., -1:, None] * more
        return np.where(out > 0, out, 1.0)

    def factors(self, electrons: FloatArray) -> FloatArray:
        """Measure the light of frames over the mean light, and that of lines over the frame's.

        Shapes: `electrons` (…, y, x), result (…, y, x).
        """
        used = self.light_e > 0
        seen = np.where(used, electrons, 0.0)
        frame = seen.sum(axis=(-2, -1), keepdims=True) / self.light_e.sum()
        out = self._distribution(seen) if self.uneven else np.ones((*electrons.shape[:-2], 1, 1))
        seen = seen / out
        for axis, share in zip((-1, -2), self.shares, strict=True):
            if share:
                line = self.light_e.sum(axis=axis, keepdims=True) * frame
                lit = (used.mean(axis=axis, keepdims=True) > 0.25) & (frame > 0)
                factor = seen.sum(axis=axis, keepdims=True) / np.where(lit, line, 1.0)
                out = out * np.where(lit & (factor > 0), factor, 1.0)
        return out

    def divided(self, counts: NDArray[Any], camera: Camera) -> NDArray[Any]:
        """Divide frames by their unsteady light.

        Shapes: `counts` (t, y, x), result (t, y, x).
        """
        offset = np.asarray(camera.offset_adu)
        steady = counts - offset
        steady /= self.factors(steady * camera.gain_e_per_adu)
        steady += offset
        full = camera.saturated(counts)
        if full.any():
            limit = camera.full_scale_adu
            steady[full] = counts[full] if limit is None else limit
        out: NDArray[Any] = steady.astype(float_type(counts.dtype))
        return out

    def taken(self, signal: FloatArray) -> FloatArray:
        """Give the change of the divisor that a signal makes.

        Shapes: `signal` (…, y, x), result (…, y, x).
        """
        return np.broadcast_to(self.factors(self.light_e * (1 + signal)), signal.shape)

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what is left of a signal after the division.

        Shapes: `signal` (y, x), result (y, x).
        """
        return (1 + signal) / self.taken(signal) - 1

    def part(self, here: tuple[slice, slice]) -> PartOfLight:
        """Give what is done to signals in some pixels of the field."""
        return PartOfLight(self, here)


@dataclass(frozen=True, eq=False)
class PartOfLight:
    """What the division by unsteady light of the whole field does to signals in a part of it."""

    whole: LightModel
    here: tuple[slice, slice]

    def taken(self, signal: FloatArray) -> FloatArray:
        """Give the change of the divisor that a signal makes.

        Shapes: `signal` (y, x), result (y, x).
        """
        whole = np.zeros(self.whole.light_e.shape)
        whole[self.here] = signal
        return self.whole.taken(whole)[self.here]

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what is left of a signal after the division."""
        return (1 + signal) / self.taken(signal) - 1


@dataclass(frozen=True, eq=False)
class SteadyFrames(ChangedFrames):
    """Frames of a movie, each divided by its own unsteady light."""

    light: LightModel
    camera: Camera

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the divided counts."""
        return float_type(self.source.dtype)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        return self.light.divided(self.source.read(start, stop), self.camera)


def with_lines(
    counts: NDArray[Any], camera: Camera, known: LightModel | None = None
) -> LightModel | None:
    """Find rows and columns that flicker, beside what is known to be uneven.

    Shapes: `counts` (t, y, x).
    """
    mean = camera.to_electrons(counts.mean(axis=0))
    shape = (counts.shape[1], counts.shape[2])
    off = find_defects(len(counts) * mean, len(counts) * camera.read_variance_e2(shape))
    off |= camera.saturated(counts.max(axis=0))
    model = known or LightModel(np.maximum(mean, 0.0))
    model = replace(model, light_e=np.where(off, 0.0, model.light_e))
    even = counts if known is None else model.divided(counts, camera)
    spectrum = measure_spectrum(even, camera)
    if spectrum is not None and any(spectrum.shared):
        return replace(model, shares=spectrum.shared)
    return None if known is None else model
