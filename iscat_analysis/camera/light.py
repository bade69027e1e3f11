"""Light whose distribution over the field changes: one linear model, measured in every frame.

A beam that wanders, fringes that pass or a lamp that warms up change the light of a pixel, and that
of its neighbours in the same way.  Over the mean frame such a change is a sum of components, each a
block of columns of one design matrix: a polynomial in x and y of low degree, a few plane waves, the
parts of a camera with several amplifiers, and light that is added to all pixels alike.  Least
squares measure them together in every frame, with an error far below the noise of one pixel; of
combinations that the field does not tell apart the smallest is taken.  `find_light` finds which
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

Which components the light of a movie has: asked of frames as far apart as windows.

Particles that land between them, and pixels that blink, stand out of a polynomial in a few cells of
a grid, which are left out.  A fixed pattern that moves, or shaking, changes the light at every
scale, down to that of a particle: then nothing is divided out.

* The gain of each amplifier changes by itself.  Halves, quadrants or stripes of the field then
  change from frame to frame as a whole: the sum over rows or columns has a step at the boundary,
  which smooth light does not have.
* Two reflections of a coherent source make one wave, whose phase drifts as they warm up.  In the
  spectrum of the changes it is one point, where particles, a moving pattern and noise are spread
  over many: it is a wave where it stands far out of the others at its distance from the middle, and
  out of those of its own row and column, in which lines that flicker lie.
* Where light of the room or the offset of the camera drifts, pixels change relative to their own
  light by one over it, dim ones most, and equally in all parts of the field.  Smooth changes do not
  affect that; a pattern that moves makes it differ from part to part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander, legvander2d
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import median
from scipy.special import chdtri

from iscat_analysis.camera.background import find_defects
from iscat_analysis.camera.counts import Camera, float_type
from iscat_analysis.camera.noise import measure_spectrum
from iscat_analysis.findings import Finding
from iscat_analysis.findings import camera as of
from iscat_analysis.medians import robust_sigma
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
            return (turns[:, :, None] * heights[:, None]).reshape(n, -1)

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
    return np.add.outer(degrees, degrees) <= degree


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
        return np.linalg.pinv(gram, rcond=1e-10, hermitian=True)

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
        return np.asarray(steady.astype(float_type(counts.dtype)))

    def taken(self, signal: FloatArray) -> FloatArray:
        """Give the change of the divisor that a signal makes.

        Shapes: `signal` (…, y, x), result (…, y, x).
        """
        return np.broadcast_to(self.factors(self.light_e * (1 + signal)), signal.shape)


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


_PIXELS_PER_TERM = 150  # fewer would take more of a particle's light than its neighbours'
_CELLS = 20  # along each axis of the grid on which changes are looked for
_FEWEST_LINES = 8  # of a part between seams
_SEAM_DEGREE, _WAVE_DEGREE = 6, 8  # of the smooth light over which seams and waves must stand out
_PARTS = 8  # along each axis, whose added light is compared


@dataclass(frozen=True, eq=False)
class Changes:
    """Sums of frames, before and after, in photoelectrons; unusable pixels are dark."""

    sums_e: FloatArray  # (pairs, 2, y, x)
    light_e: FloatArray  # (y, x)
    noises: FloatArray  # (pairs,) variance of a change of one photoelectron's light

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
        highest = np.max([part.max(axis=0) for two in pairs for part in two], axis=0)
        used = light > 0.1 * max(float(np.median(light)), 0.0)
        used &= ~camera.saturated(highest)
        if not used.any() or sums[..., used].sum(axis=-1).min() <= 0:
            return None
        read = float(camera.read_variance_e2(used.shape)[used].mean() / light[used].mean())
        noises = (1 + read) * (1 / frames).sum(axis=1)
        if not used.all():
            sums[..., ~used] = 0.0
        return cls(sums, np.where(used, light, 0.0), noises)

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
        return 0.02 * float(2 / (window * self.light_e[self.used].mean()))  # of a pixel's variance

    def without(self, model: LightModel) -> Changes:
        """Divide the sums by the changes of a model, as each of them shows it."""
        if not model.uneven:
            return self
        return replace(self, sums_e=self.sums_e / model.factors(self.sums_e))

    def relative(self, sums: FloatArray, light: FloatArray) -> FloatArray:
        """Give changes of the shares that parts of the field have, in standard deviations of noise.

        Shapes: `sums` (pairs, 2, parts), `light` (parts,), result (pairs, parts).
        """
        before, after = np.moveaxis(sums / sums.sum(axis=-1, keepdims=True), 1, 0)
        noise = np.sqrt(np.where(light > 0, light, 1.0) * self.noises[:, None])
        return np.where(light > 0, (after - before) * light.sum() / noise, 0.0)

    def binned(self, side: int) -> tuple[FloatArray, FloatArray]:
        """Give the changes of squares of pixels.

        Shapes: `changes` (pairs, y, x), `light_e` (y, x).
        """
        shape = tuple(n // side for n in self.light_e.shape)
        sums, light = (
            _summed(values[..., : shape[0] * side, : shape[1] * side], shape)
            for values in (self.sums_e, self.light_e)
        )
        return self.relative(sums, light).reshape(-1, *shape), light.reshape(shape)


def _summed(values: FloatArray, parts: tuple[int, ...]) -> FloatArray:
    """Sum over parts of the field, as many along each axis as is said.

    Shapes: `values` (…, y, x), result (…, parts).
    """
    for axis, most in zip((-2, -1), parts, strict=True):
        size = values.shape[axis]
        number = min(most, size)
        starts = -(-np.arange(number) * size // number)
        values = np.add.reduceat(values, starts, axis=axis)
    return values.reshape(*values.shape[:-2], -1)


def find_light(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], camera: Camera, window: int
) -> LightModel | None:
    """Find how the distribution of the light changes between frames.

    Seams and fringes are looked for in turns, because each hides the other.

    Shapes: `pairs` (t, y, x).
    """
    changes = Changes.of(pairs, camera)
    if changes is None:
        return None
    # over a field of 128 pixels a polynomial of degree 12 follows waves of 40
    room = math.sqrt(2 * changes.used.sum() / _PIXELS_PER_TERM)
    highest = min(12, math.floor(room) - 2)
    if highest < 3:  # without which smooth is not told from fine
        return None
    model = LightModel(changes.light_e)
    for _ in range(2):
        seams = _seams(changes.without(model), window, model.seams)
        if model.fringes and seams == model.seams:
            break
        model = replace(model, seams=seams, fringes=Fringes())
        model = replace(model, fringes=_fringes(changes.without(model), window, highest))
        if not model.fringes:
            break
    seamless = changes.without(replace(model, fringes=Fringes()))
    model = replace(model, smooth=_smooth(seamless, window, highest, model.fringes))
    model = replace(model, added=_added(changes.without(model), window))
    return model if model.uneven else None


def _explained(change: FloatArray, terms: FloatArray) -> tuple[float, FloatArray]:
    """Fit terms (pixels, k) to changes (pairs, pixels) of unit noise.

    Returns their mean square beyond noise, and the residual.
    """
    basis, _ = np.linalg.qr(terms)
    along = change @ basis
    return float((np.square(along) - 1).sum()) / len(change), change - along @ basis.T


# ---- seams -----------------------------------------------------------------------------------


def _seams(changes: Changes, window: int, known: Seams) -> Seams:
    """Find rows and columns at which the change of the light has a step."""
    least = changes.least(window) / changes.error
    return Seams(
        _steps_along(changes, 2, least, known.rows), _steps_along(changes, 1, least, known.columns)
    )


def _steps_along(
    changes: Changes, axis: int, least: float, known: tuple[int, ...]
) -> tuple[int, ...]:
    """Find the steps along an axis of (pairs, y, x), three at most."""
    light = changes.light_e.sum(axis=axis - 1)
    lit = np.flatnonzero(light > 0)
    light, count = light[lit], lit.size
    change = changes.relative(changes.sums_e.sum(axis=axis + 1)[..., lit], light)
    if count < 2 * _FEWEST_LINES + _SEAM_DEGREE:
        return known
    differences = change[:, 2:-1] + change[:, 3:] - change[:, 1:-2] - change[:, :-3]
    jumps = np.zeros(count)
    jumps[2:-1] = np.median(np.square(differences), axis=0)
    sharp = jumps > 10 * np.quantile(jumps, 0.9)  # as no smooth light changes
    root = np.sqrt(light)[:, None]
    smooth = root * legvander(np.linspace(-1, 1, count), _SEAM_DEGREE)
    steps = root * (np.arange(count)[:, None] >= np.arange(count))
    tried = np.searchsorted(lit, known).tolist()
    kept, unexplained = len(tried), np.inf
    by_chance = float(chdtri(len(change), 1e-12)) / len(change)
    while True:
        basis, _ = np.linalg.qr(np.hstack([smooth, steps[:, tried]]))
        rest = change - (change @ basis) @ basis.T
        left = float(np.median(np.square(rest).sum(axis=1))) - (count - basis.shape[1])
        if left < 0.5 * unexplained:  # seams must halve what smooth light leaves over
            kept, unexplained = len(tried), left
        if len(tried) == 3:
            break
        independent = steps - basis @ (basis.T @ steps)
        far = sharp.copy()
        for cut in (0, *tried, count):
            far[max(cut - _FEWEST_LINES + 1, 0) : cut + _FEWEST_LINES] = False
        size = np.where(far, np.linalg.norm(independent, axis=0), np.inf)
        gains = np.square(rest @ (independent / size))
        best = int(gains.sum(axis=0).argmax())
        # median of the square of a normal variable
        if np.median(gains[:, best]) / 0.4549364231195724 - 1 < max(by_chance, least):
            break
        tried.append(best)
    return tuple(sorted(int(lit[k]) for k in tried[:kept]))


# ---- fringes ---------------------------------------------------------------------------------


def _fringes(changes: Changes, window: int, highest: int) -> Fringes:
    """Find plane waves among changes of the light."""
    side = max(1, -(-max(changes.light_e.shape) // 160))
    change, light = changes.binned(side)
    if min(light.shape) < 24:
        return Fringes()
    degree = min(highest, _WAVE_DEGREE)
    limit = np.array([5 * robust_sigma(each[light > 0]) for each in change])[:, None, None]
    change = _without_smooth(np.clip(change, -limit, limit), degree)
    slowest = min(highest / 4, 2.5)  # waves over the field that are left to polynomials
    least = changes.least(window) / changes.error
    root = np.sqrt(light)

    def explained(fringes: Fringes) -> tuple[float, FloatArray]:
        rows, columns, products = fringes.axes(light.shape)
        down, along = np.nonzero(products)
        terms = root * rows.T[down][:, :, None] * columns.T[along][:, None]
        terms = _without_smooth(terms, degree).reshape(len(terms), -1)
        square, rest = _explained(change.reshape(len(change), -1), terms.T)
        return square, rest.reshape(change.shape)

    waves, square, rest = np.empty((0, 2)), 0.0, change
    while len(waves) < 6:  # a source with two interfering reflections has one, with three three
        peak = _peak(rest, slowest)
        if peak is None:
            break
        more = _refined(change, root, np.vstack([waves, peak]), degree)
        beyond, left = explained(Fringes(more))
        if beyond - square < least:
            break
        waves, square, rest = more, beyond, left
    waves = waves[np.hypot(*(waves * light.shape).T) > 2 * np.pi * slowest]
    if not len(waves):  # the others are the foot of what the polynomial follows
        return Fringes()
    room = changes.used.sum() / _PIXELS_PER_TERM
    degrees = [k for k in range(5) if not k or len(waves) * (k + 1) * (k + 2) <= room]
    found = np.array([explained(Fringes(waves, k))[0] for k in degrees])
    enough = int(np.flatnonzero(found > found.max() - least).min())
    return Fringes(waves / side, enough, math.sqrt(max(found[enough], 0.0) * changes.error))


def _refined(change: FloatArray, root: FloatArray, waves: FloatArray, degree: int) -> FloatArray:
    """Refine wave vectors by Gauss–Newton steps, over a smooth polynomial.

    A wave whose vector is wrong by d leaves the residual i d·r times itself.
    """
    y, x = (np.arange(n) - (n - 1) / 2 for n in root.shape)
    for _ in range(4):
        phase = waves[:, :1, None] * y[:, None] + waves[:, 1:, None] * x
        both = root * np.stack([np.cos(phase), np.sin(phase)])
        parts = np.concatenate([both, both * y[:, None], both * x])
        terms = _without_smooth(parts.reshape(-1, *root.shape), degree).reshape(-1, root.size)
        found, *_ = np.linalg.lstsq(terms.T, change.reshape(len(change), -1).T, rcond=None)
        ahead, behind = np.moveaxis(found.reshape(3, 2, len(waves), -1), 1, 0)
        height, slope = ahead[0] - 1j * behind[0], ahead[1:] - 1j * behind[1:]
        off = (slope * np.conj(1j * height)).real.sum(axis=-1)
        waves = waves + (off / np.square(np.abs(height)).sum(axis=-1)).T
    return waves


def _without_smooth(change: FloatArray, degree: int) -> FloatArray:
    """Subtract the polynomial of a degree from changes (pairs, y, x)."""
    rows, columns, products = Smooth(degree).axes((change.shape[1], change.shape[2]))
    rows, columns = (np.linalg.qr(functions)[0] for functions in (rows, columns))
    return change - rows @ (products * (rows.T @ change @ columns)) @ columns.T


def _peak(change: FloatArray, slowest: float) -> FloatArray | None:
    """Find the wave vector of the highest peak of the mean spectrum; None without one.

    Beyond noise it must have 100 times the power around it: of a pattern that moves, the largest
    of 1e4 points has half of that.
    """
    pairs, high, wide = change.shape
    windows = np.hanning(high)[:, None] * np.hanning(wide)
    tapered = change * (windows / math.sqrt(float(np.square(windows).mean())))
    power = np.square(np.abs(fft.rfft2(tapered))).mean(axis=0) / (high * wide)
    around = np.maximum(_around(power, wide), 1.0)
    waves = np.hypot(np.fft.fftfreq(high)[:, None] * high, np.fft.rfftfreq(wide) * wide)
    by_chance = float(chdtri(2 * pairs, 1e-10)) / (2 * pairs)
    most = np.maximum(by_chance, around + 100 * (around - 1))
    above = np.where(waves > slowest, power / most, 0.0)
    at = np.unravel_index(int(above.argmax()), above.shape)
    if above[at] <= 1:
        return None
    wave = 2 * np.pi * np.array([np.fft.fftfreq(high)[at[0]], np.fft.rfftfreq(wide)[at[1]]])
    step = np.pi / np.array([high, wide])
    for _ in range(4):  # each to half the step, from half a wave over the field
        trials = wave[:, None] + step[:, None] * np.arange(-2, 3)
        down, along = (
            np.exp(-1j * np.outer(trial, np.arange(n)))
            for trial, n in zip(trials, (high, wide), strict=True)
        )
        near = np.square(np.abs(down @ tapered @ along.T)).sum(axis=0)
        best = np.unravel_index(int(near.argmax()), near.shape)
        wave = np.array([trials[0, best[0]], trials[1, best[1]]])
        step = step / 2
    return wave


def _around(power: FloatArray, wide: int) -> FloatArray:
    """Give the median of a half spectrum (y, k) at the distance of each point, and of its lines."""
    high, _ = power.shape
    side = max(high, wide)
    distance = side * np.hypot(np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide))
    ring = np.rint(distance).astype(int)
    at_distance: FloatArray = median(power, ring, np.arange(ring.max() + 1))[ring]
    lines = np.maximum(np.median(power, axis=1, keepdims=True), np.median(power, axis=0))
    return np.maximum(at_distance, lines)


# ---- smooth ----------------------------------------------------------------------------------


def _smooth(changes: Changes, window: int, highest: int, fringes: Fringes) -> Smooth:
    """Find the degree of the polynomial beside waves, and the rms of its changes."""
    degrees, basis, cells = _in_cells(changes, highest, fringes)
    squares_of, left = _cell_squares(cells, basis)
    count = len(squares_of)
    if not count:
        return Smooth()
    of_degree = [squares_of[:, degrees == d] for d in range(1, highest + 1)]
    excess = np.array([(s - 1).sum() / count for s in of_degree])
    beyond = np.cumsum(excess[::-1])[::-1]  # what polynomials of lower degree leave
    terms = np.cumsum([s.shape[1] for s in of_degree[::-1]])[::-1]
    least = changes.least(window) / changes.error
    # a change repeats in time and place, so that eight standard errors are no chance
    clear = (beyond > least) & (beyond > 8 * np.sqrt(2 * terms / count))
    if not clear[0] or beyond[0] < 3 * left * basis.shape[0]:  # of what it leaves over in cells
        return Smooth()
    rms = math.sqrt(float(beyond[0]) * changes.error)
    return Smooth(int(np.flatnonzero(clear).max()) + 1, rms)


def _in_cells(
    changes: Changes, highest: int, fringes: Fringes
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Sum changes and the columns of the design in cells of a grid.

    Returns the degree of each column, −1 of waves; the columns (cells, terms), orthonormal; and the
    changes (pairs, cells) in standard deviations of shot noise.
    """
    used, light, grid = changes.used, changes.light_e, (_CELLS, _CELLS)
    pixels = _summed(used.astype(np.float64), grid)
    lit = pixels > 0
    inside = _summed(light, grid)[lit]
    place_y, place_x = (
        2 * _summed(np.where(used, k, 0.0), grid)[lit] / pixels[lit] / max(n - 1, 1) - 1
        for k, n in zip(np.indices(used.shape), used.shape, strict=True)
    )
    powers = np.add.outer(np.arange(highest + 1), np.arange(highest + 1)).ravel()
    order = np.argsort(powers, kind="stable")
    order = order[powers[order] <= highest]
    down, along, products = fringes.axes((used.shape[0], used.shape[1]))
    waves = [
        _summed(light * np.outer(down[:, i], along[:, j]), grid)[lit, None] / inside[:, None]
        for i, j in np.argwhere(products)
    ]
    smooth = legvander2d(place_y, place_x, [highest, highest])[:, order]
    basis, _ = np.linalg.qr(np.sqrt(inside)[:, None] * np.hstack([*waves, smooth]))
    degrees = np.concatenate([np.full(len(waves), -1), powers[order]])
    return degrees, basis, changes.relative(_summed(changes.sums_e, grid)[..., lit], inside)


def _cell_squares(cells: FloatArray, basis: FloatArray) -> tuple[FloatArray, float]:
    """Squared coefficients (pairs, terms) and residual, in variances of a cell.

    Where there is only noise, the mean of the residual over cells and pairs is 0.
    """
    out: list[FloatArray] = []
    whole = np.eye(basis.shape[1])
    left, freedom = 0.0, 0
    for change in cells:
        # what landed and is large would bend the first fit so that nothing stands out of it
        kept = _near(change - np.median(change))
        if kept.sum() <= basis.shape[1]:
            kept[:] = True
        for _ in range(4):
            part, turned = basis, whole
            if not kept.all():  # beside a hole the noise of terms is known as well
                part, turned = np.linalg.qr(basis[kept])
            found = part.T @ change[kept]
            fitted = basis @ np.linalg.solve(turned, found)
            rest = change - fitted
            inside = _near(rest)
            if np.array_equal(inside, kept) or inside.sum() <= found.size:
                break
            kept = inside
        size = np.square(fitted - np.median(fitted))
        if size.sum() ** 2 < 0.1 * size.size * np.square(size).sum():
            continue  # dust that landed, which is in less than a tenth of the cells
        out.append(np.square(found))
        left += float(np.square(rest[kept]).sum())
        freedom += int(kept.sum()) - found.size
    return np.array(out).reshape(-1, basis.shape[1]), left / max(freedom, 1) - 1


def _near(deviations: FloatArray) -> BoolArray:
    """Tell which deviations, in standard deviations of noise, are no outliers."""
    return np.abs(deviations) <= 4.0 * max(1.0, robust_sigma(deviations))


# ---- added light -----------------------------------------------------------------------------


def _added(changes: Changes, window: int) -> float:
    """Measure a change that is added to all pixels equally, over the mean light; 0 if none."""
    light, more = changes.light_e, lift(changes.light_e)

    def summed(values: FloatArray) -> FloatArray:
        return _summed(values, (_PARTS, _PARTS))

    inside, once, twice = summed(light), summed(light * more), summed(light * more**2)
    pattern = np.maximum(twice - np.square(once) / np.where(inside > 0, inside, 1.0), 0.0)
    if not (pattern > 0).any():
        return 0.0
    usual = np.median(pattern[pattern > 0])
    lit = (pattern > 0) & (pattern < 4 * usual)  # without dust and particles
    if lit.sum() < _PARTS**2 // 4:
        return 0.0
    mean, pattern = once[lit] / inside[lit], pattern[lit]
    noise = changes.noises.mean() / len(changes.noises)
    if pattern.sum() < 10 * changes.used.sum() * noise:  # a pattern of the mean frame's noise
        return 0.0
    levels, lifts = [], []
    for sums in changes.sums_e:  # one pair after the other, to save memory
        each = sums * (light.sum() / sums.sum(axis=(1, 2), keepdims=True)) - light
        levels.append(summed(each)[:, lit])
        lifts.append(summed(each * more)[:, lit])
    level, lifted = np.array(levels), np.array(lifts)
    even = level[:, 1] - level[:, 0]
    change = lifted[:, 1] - lifted[:, 0] - even * mean
    added = change.sum(axis=1, keepdims=True) / pattern.sum()
    spread = np.square(change - added * pattern) / np.maximum(pattern, 1e-3 * pattern.mean())
    error = spread.sum(axis=1) / (lit.sum() - 1) / pattern.sum()
    square = float(np.median(np.square(added)))
    if square > 0.25**2:  # of the mean light, more than which is not added between windows
        return 0.0
    if square * pattern.sum() / light.sum() < changes.least(window) + changes.error:
        return 0.0
    if np.median(np.square(added[:, 0]) / error) < 30:  # by the differences of the parts
        return 0.0
    here = lifted - level * mean
    return float(np.ptp(here.sum(axis=-1))) / float(pattern.sum())
