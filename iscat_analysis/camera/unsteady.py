"""Pixels whose noise is not that of light: found by their neighbours, and left out.

A pixel that switches between two levels, a column with a noisy amplifier and a time that is burnt
into a corner look like particles that come and go.  In frames next to each other a pixel's counts
scatter as its light has it, and so do averages of frames far apart; a pixel is unsteady where they
scatter more than those of the pixels around it, and those beside it do not follow: a particle's
picture covers several.  One that never changes is no light either.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from iscat_analysis._kernels.unsteady import add_image, add_scatter, block_extremes, block_powers
from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.units import count, listed

_CHANCE = 1e-9  # that noise alone makes a pixel unsteady
_AROUND = 5  # pixels along each side, whose median tells how counts scatter there
# Times shot noise, by which most pixels change slowly where it is not the pixels
_SLOW_CHANGE_RATIO = 3.0
_LEAST_LINE_EXCESS = 0.15  # of the usual scatter, by which that of a noisy line is larger at least
_LINE_SIGMAS = 8.0  # robust standard deviations of all lines
_SIGMA_PER_MAD = 1.4826  # standard deviation of a normal law over its median deviation
_FEWEST_FRAMES = 20  # frames that tell
_LEAST_E = 20.0  # of light, below which noise is far from normal
_LINE_SHARE = 0.5  # of the pixels of a line that is named as such
_MOST_PIXEL_SHARE = 0.1  # of the pixels: where more are, it is not the pixels that are odd


def unsteady_message(pixels: BoolArray) -> str:
    """Say which pixels are unsteady.

    Shapes: `pixels` (y, x).
    """
    number = int(pixels.sum())
    where = [
        f"{name} {listed(np.flatnonzero(pixels.mean(axis=axis) > _LINE_SHARE), 4)}"
        for axis, name in ((1, "row"), (0, "column"))
        if (pixels.mean(axis=axis) > _LINE_SHARE).any()
    ]
    if not where:
        y, x = np.nonzero(pixels)
        where = [listed([f"({a}, {b})" for a, b in zip(x, y, strict=True)], 3)]
    verb = "has" if number == 1 else "have"
    return (
        f"{count(number, 'pixel')} ({' and '.join(where)}) {verb} noise that is not the light's, "
        "as where a pixel switches, an amplifier is noisy or a text is burnt in; not used"
    )


def find_unsteady(
    blocks: Sequence[NDArray[Any]], camera: Camera, least_beside: float
) -> BoolArray | None:
    """Find pixels that flicker, switch, or repeat their values.

    Shapes: `blocks` (t, y, x), result (y, x).
    """
    frames = np.array([len(block) for block in blocks])
    freedom = int((frames - 1).sum()), len(blocks) - 1
    if freedom[0] < _FEWEST_FRAMES or freedom[1] < 4:
        return None
    shape = blocks[0].shape[1:]
    summed = np.zeros(shape)
    highest, still = blocks[0][0].copy(), np.ones(shape, dtype=np.bool_)
    for block in blocks:
        block_extremes(block, summed, highest, still)
    light = camera.to_electrons(summed / frames.sum())
    lit = light > max(_LEAST_E, 0.1 * float(np.median(light)))
    lit &= ~camera.saturated(highest)
    level = float(light[lit].mean()) if lit.any() else 0.0
    if lit.mean() < 0.5:
        return None
    variance = np.where(lit, light + camera.read_variance_e2(light.shape), np.inf)
    gain, offset = (
        np.ascontiguousarray(np.broadcast_to(np.asarray(value, dtype=np.float64), shape))
        for value in (camera.gain_e_per_adu, camera.offset_adu)
    )
    fast, slow = _Scatter(shape), _Scatter(shape)
    found = lit & still
    mean, change = np.empty(shape), np.empty(shape)
    for block in blocks:
        power = block_powers(block, gain, offset, lit) / level
        if power.min() <= 0:
            return None
        add_scatter(block, gain, offset, power, mean, change, fast.squares, fast.products)
        slow.add((mean - light) * np.sqrt(len(block)))
    for scatter, number in ((fast, freedom[0]), (slow, freedom[1])):
        ratio = np.where(lit, scatter.squares / variance / number, 0.0)
        usual = float(np.median(ratio[lit]))
        if (
            scatter is slow and usual > _SLOW_CHANGE_RATIO
        ):  # by the light or the stage, and in what pattern
            continue
        limit = chdtri(number, _CHANCE) / number
        more = ratio > usual * limit
        more &= scatter.neighbour_products < least_beside * scatter.squares
        more &= _largest_neighbour(ratio) - usual < least_beside * (ratio - usual)
        if more.any():  # by those around as well, which takes longest
            more &= ratio > median_filter(ratio, _AROUND, mode="nearest") * limit
            found |= more
        if scatter is fast:
            found |= _noisy_lines(ratio, lit, usual, least_beside)
    found &= lit
    return found if 0 < found.mean() < _MOST_PIXEL_SHARE else None


def _largest_neighbour(values: FloatArray) -> FloatArray:
    """Larger one of the two neighbours, along the axis where it is smaller."""
    padded = np.pad(values, 1, mode="reflect")
    along_y = np.maximum(padded[:-2, 1:-1], padded[2:, 1:-1])
    along_x = np.maximum(padded[1:-1, :-2], padded[1:-1, 2:])
    return np.minimum(along_y, along_x)


class _Scatter:
    """Mean square deviations of pixels, and their products with neighbouring pixels."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.squares = np.zeros(shape)
        self.products = np.zeros((2, *shape))

    def add(self, image: FloatArray) -> None:
        """Add one image."""
        add_image(image, self.squares, self.products)

    @property
    def neighbour_products(self) -> FloatArray:
        """Products with the neighbours along y or x, whichever are larger."""
        largest: FloatArray = self.products.max(axis=0)
        return largest


def _noisy_lines(ratio: FloatArray, lit: BoolArray, usual: float, least_beside: float) -> BoolArray:
    """Find rows and columns in which most pixels scatter more than in the neighbouring lines."""
    noisy = np.zeros(ratio.shape, dtype=np.bool_)
    for axis in (0, 1):
        lines = np.flatnonzero(lit.mean(axis=axis) > _LINE_SHARE)
        if lines.size < _AROUND:
            continue
        seen = np.where(lit, ratio, np.nan).take(lines, axis=1 - axis)
        excess = np.nanmedian(seen, axis=axis) - usual
        spread = _SIGMA_PER_MAD * float(np.median(np.abs(excess - np.median(excess))))
        padded = np.pad(excess, 1, mode="reflect")
        neighbours = np.maximum(padded[:-2], padded[2:])
        off = excess > max(_LEAST_LINE_EXCESS * usual, _LINE_SIGMAS * spread)
        odd = lines[off & (neighbours < least_beside * excess)]
        noisy[(slice(None), odd) if axis == 0 else odd] = True
    return noisy
