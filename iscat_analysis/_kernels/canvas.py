"""The sum of the signals of all particles of a frame, drawn row by row; see `moving`.

The number of a row in `group` chooses one of several images, sharp or blurred.  Each has a table
for the fit, which covers the fitted square, and one for drawing, which reaches farther.  A `Canvas`
keeps the sum of all rows of a frame from one fit to the next: if a row moves by less than
`Field.slack`, only its fitted square is drawn again, and its rings stay where they were.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels import FAST, AnyFloatArray, BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.image import signal_gradient, signal_image
from iscat_analysis._kernels.lens import LATTICE, ROUND, STAMP, LatticeLens, Lens, Pixels, StampLens
from iscat_analysis._kernels.loops import copy_line, whole
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import span
from iscat_analysis._kernels.stamp import stamp_gradient

Counts = NDArray[np.uint16] | NDArray[np.float32]
"""Types of counts; kernels are compiled for the type of the movie."""


class Pictures(NamedTuple):
    """Images of one microscope, one for each blur."""

    heights: FloatArray
    first_nm: float
    step_nm: float
    kappa: float
    lens: Lens
    windows: FloatArray
    nodes: AnyFloatArray


class Light(NamedTuple):
    """A movie, its camera and its background."""

    counts: Counts
    gain: float
    offset: float
    power: FloatArray
    background: FloatArray
    read: FloatArray


class Field(NamedTuple):
    """The pixels, and how far each particle is drawn and fitted."""

    pixels: Pixels
    pixel_nm: float
    side: int
    drawn: int
    slack: FloatArray
    alike: bool


class Rows(NamedTuple):
    """Particles in frames: where each frame begins (t + 1,), their θ (n, 5) and blurs (n,)."""

    starts: IntArray
    theta: FloatArray
    group: IntArray


class Brush(NamedTuple):
    """Images, and work space to draw one of them: its profile, and its pixels."""

    pictures: Pictures
    profile: FloatArray
    image: AnyFloatArray


class Canvas(NamedTuple):
    """The sum of the signals of all rows in every frame."""

    total: NDArray[np.float32]
    rings: FloatArray
    squares: FloatArray
    drawn: BoolArray


@kernel(_nrt=False)
def table_of(pictures: Pictures, group: int) -> AxialTable:
    """Table of one blur."""
    k = min(group, pictures.heights.shape[0] - 1)
    return AxialTable(pictures.heights[k], pictures.first_nm, pictures.step_nm, pictures.kappa)


@kernel(_nrt=False)
def lens_of(pictures: Pictures, group: int) -> Lens:
    """Lens of one blur."""
    window = pictures.windows[min(group, pictures.windows.shape[0] - 1)]
    lens: Lens = _with_window(pictures.lens, window)
    return lens


@kernel(_nrt=False)
def _with_window(lens: Lens, window: FloatArray) -> Lens:
    """Give a lens another window; a round one has none."""
    if len(lens) == ROUND:
        return lens
    if len(lens) == LATTICE:
        return LatticeLens(lens.inv_step, lens.rho, lens.half, lens.components, window)
    return StampLens(lens.inv_step, lens.half, window, lens.fine)


@kernel(_nrt=False)
def box_of(centre_nm: float, pixel_nm: float, side: int, size: int) -> tuple[int, int]:
    """Half-open range of pixels around a place, cut off at the edge of the field."""
    first = whole(np.rint(centre_nm / pixel_nm - (side - 1) / 2), -side, size)
    return max(first, 0), min(first + side, size)


@kernel(_nrt=False)
def square_of(
    field: Field, theta: FloatArray, side: int, rows: int, columns: int
) -> tuple[int, int, int, int]:
    """Half-open ranges of rows and of columns around a particle; all 0 where none is left."""
    r0, r1 = box_of(theta[1], field.pixel_nm, side, rows)
    c0, c1 = box_of(theta[0], field.pixel_nm, side, columns)
    if r1 <= r0 or c1 <= c0:
        return 0, 0, 0, 0
    return r0, r1, c0, c1


@kernel(_nrt=False)
def cut(pixels: Pixels, r0: int, r1: int, c0: int, c1: int) -> Pixels:
    """Pixels of a part of the field."""
    return Pixels(pixels.x[c0:c1], pixels.y[r0:r1], pixels.offsets, pixels.weights)


@kernel(_nrt=False)
def draw(
    pictures: Pictures, group: int, theta: FloatArray, pixels: Pixels, profile: FloatArray,
    out: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` with the signal (ny, nx) of one row, or with its gradient as well (ny, 5, nx).

    At one height (ny, BENDS, nx) asks for second derivatives too.
    """
    table, lens = table_of(pictures, group), lens_of(pictures, group)
    _draw(table, lens, pictures.nodes, theta, pixels, profile, out)


@kernel(_nrt=False)
def _draw(
    table: AxialTable, lens: Lens, nodes: AnyFloatArray, theta: FloatArray, pixels: Pixels,
    profile: FloatArray, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Do the same as `draw`; the types of the lens and of `out` choose the compiled branches."""
    if len(lens) == STAMP:
        if out.ndim == 2:
            signal_image(nodes, lens, pixels, theta, out)
        else:
            stamp_gradient(nodes, lens, pixels, theta, out)
        return
    start, stop = span(lens, pixels, theta, table.heights.shape[3])
    profile_at(table, theta[2], start, stop, profile)
    if out.ndim == 2:
        signal_image(profile, lens, pixels, theta, out)
    else:
        signal_gradient(profile, lens, pixels, theta, out)


@kernel(_nrt=False)
def _add_row(
    brush: Brush, field: Field, group: int, theta: FloatArray, sign: float,
    square: tuple[int, int, int, int], total: NDArray[np.float32],
) -> None:  # fmt: skip
    """Add the signal of one row, times a sign, to a square of a frame."""
    r0, r1, c0, c1 = square
    if r1 <= r0 or c1 <= c0:
        return
    there = total[r0:r1, c0:c1]
    image = brush.image[: there.size].reshape(there.shape)
    pixels = cut(field.pixels, r0, r1, c0, c1)
    draw(brush.pictures, group, theta, pixels, brush.profile, image)
    add(there, sign, image)


@kernel(fastmath=FAST, _nrt=False)
def add(there: NDArray[np.float32], sign: float, image: FloatArray) -> None:
    """Add an image, times a sign, to the square of a frame where it belongs."""
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            there[i, j] += np.float32(sign * image[i, j])


@njit(inline="always")
def _electrons(light: Light, counts: int | float) -> float:
    """Photoelectrons of a pixel's counts."""
    return light.gain * (np.float64(counts) - light.offset)


@kernel(fastmath=FAST, _nrt=False)
def stage(
    light: Light, t: int, total: NDArray[np.float32], own: AnyFloatArray, r0: int, c0: int,
    data: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill the constants of a square's likelihood, with the other particles in its background.

    `own` (ny, 5, nx) begins with the particle's own signal.
    """
    w, last, one = light.power[t], c0 + data.shape[2], data.dtype.type(1.0)
    for i in range(data.shape[1]):  # with more arrays at once the compiler uses no vectors
        r = r0 + i
        seen, base, level, noise = data[0, i], data[1, i], data[2, i], data[3, i]
        background, others, mine = light.background[r, c0:last], total[r, c0:last], own[i, 0]
        for j in range(level.size):
            level[j] = w * background[j]
        for j in range(level.size):
            base[j] = level[j] * (one + others[j] - mine[j])
        read, counts = light.read[r, c0:last], light.counts[t, r, c0:last]
        for j in range(level.size):
            noise[j] = read[j]
        for j in range(level.size):
            seen[j] = noise[j] + (_electrons(light, counts[j]) if level[j] > 0.0 else 0.0)


@kernel(_nrt=False)
def draw_frames(
    field: Field, near: Brush, far: Brush, particles: Rows, first: int, last: int, canvas: Canvas
) -> None:
    """Update frames first…last − 1 of the canvas to the current rows."""
    for t in range(first, last):
        _draw_frame(field, near, far, particles, t, canvas)


@kernel(_nrt=False)
def _draw_frame(
    field: Field, near: Brush, far: Brush, particles: Rows, t: int, canvas: Canvas
) -> None:
    """Update a frame of the canvas to the current rows.

    If rows have moved too far from their rings, these rings are drawn again: those of these rows
    only, or those of all rows if this is faster.
    """
    starts, theta, group = particles
    total = canvas.total[t]
    rows, columns = total.shape
    first, last = starts[t], starts[t + 1]
    pictures = 0
    for r in range(first, last):
        if _is_aside(field, theta[r], canvas.rings[r]):
            pictures += 2
        elif _is_other_size(field, theta[r], canvas.rings[r]):
            pictures += 1
    anew = not canvas.drawn[t] or 2 * pictures > last - first
    if anew:
        total[:] = 0.0
        canvas.drawn[t] = True
    for r in range(first, last):
        rings, square, now, k = canvas.rings[r], canvas.squares[r], theta[r], group[r]
        inner = square_of(field, rings, field.side, rows, columns)
        aside = _is_aside(field, now, rings)
        if aside and not anew:
            _add_row(near, field, k, square, -1.0, inner, total)
            _add_rings(far, field, k, rings, -1.0, total)
        if aside or anew:
            copy_line(now, rings)
            copy_line(now, square)
            if field.alike:
                outer = square_of(field, now, field.drawn, rows, columns)
                _add_row(far, field, k, now, 1.0, outer, total)
                continue
            inner = square_of(field, now, field.side, rows, columns)
            _add_row(near, field, k, now, 1.0, inner, total)
            _add_rings(far, field, k, now, 1.0, total)
            continue
        if _is_other_size(field, now, rings):
            # b P + b² Q minus a P + a² Q is (b - a)/(b + a) times the signal of a + b
            share = (now[3] - rings[3]) / (now[3] + rings[3])
            rings[3] += now[3]
            _add_rings(far, field, k, rings, share, total)
            rings[3] = now[3]
        if _differ(now, square):
            _add_row(near, field, k, square, -1.0, inner, total)
            _add_row(near, field, k, now, 1.0, inner, total)
            copy_line(now, square)


@kernel(_nrt=False)
def _is_aside(field: Field, theta: FloatArray, rings: FloatArray) -> bool:
    """Tell whether a row is too far from its rings, or the reverse of them."""
    aside = False
    for k in range(3):
        aside |= abs(theta[k] - rings[k]) > field.slack[k]
    return bool(aside or (theta[3] != rings[3] and theta[3] == -rings[3]))


@kernel(_nrt=False)
def _differ(one: FloatArray, other: FloatArray) -> bool:
    """Tell whether any number of a row differs from another's."""
    count = 0
    for i in range(one.size):
        count += one[i] != other[i]
    return count > 0


@kernel(_nrt=False)
def _is_other_size(field: Field, theta: FloatArray, rings: FloatArray) -> bool:
    """Tell whether the amplitude of a row is too far from that of its rings."""
    return bool(abs(theta[3] - rings[3]) > field.slack[3] * abs(rings[3]))


@kernel(_nrt=False)
def _add_rings(
    brush: Brush, field: Field, group: int, theta: FloatArray, sign: float,
    total: NDArray[np.float32],
) -> None:  # fmt: skip
    """Add the signal of one row, times a sign, to the pixels around its fitted square."""
    rows, columns = total.shape
    top, bottom, left, right = square_of(field, theta, field.side, rows, columns)
    r0, r1, c0, c1 = square_of(field, theta, field.drawn, rows, columns)
    if bottom <= top:
        top = bottom = r1
    beside = (r0, top, c0, c1), (bottom, r1, c0, c1), (top, bottom, c0, left)
    for part in (*beside, (top, bottom, right, c1)):
        _add_row(brush, field, group, theta, sign, part, total)


@kernel(fastmath=FAST, _nrt=False)
def subtract_expected(
    light: Light, signal: NDArray[np.float32], first: int, out: NDArray[np.float32]
) -> None:
    """Subtract the expected light from frames.

    Shapes: `signal` (n, y, x), `out` (n, y, x).
    """
    for t in range(out.shape[0]):
        w = light.power[first + t]
        for i in range(out.shape[1]):
            counts, background = light.counts[first + t, i], light.background[i]
            rows, left = signal[t, i], out[t, i]
            for j in range(left.size):
                level = w * background[j]
                over = _electrons(light, counts[j]) - level * (1.0 + rows[j])
                left[j] = over if background[j] > 0.0 else 0.0


@kernel()
def add_squares(
    light: Light, total: NDArray[np.float32], frame: IntArray, corner: IntArray, owner: IntArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Put squares of frames on top of each other.

    Shapes: `total` (t, y, x), `frame` (n,), `corner` (n, 2), `owner` (n,), `out` (m, 3, side,
    side).
    """
    rows, columns = light.background.shape
    side = out.shape[2]
    for k in range(frame.size):
        t, top, left = frame[k], corner[k, 0], corner[k, 1]
        mine = out[owner[k]]
        for i in range(max(top, 0), min(top + side, rows)):
            for j in range(max(left, 0), min(left + side, columns)):
                level = light.power[t] * light.background[i, j]
                if level > 0.0:
                    electrons = _electrons(light, light.counts[t, i, j])
                    mine[0, i - top, j - left] += electrons - level * (1.0 + total[t, i, j])
                    mine[1, i - top, j - left] += level
                    mine[2, i - top, j - left] += light.read[i, j]
