"""Pixels that are left out: under a text that was burnt in, and with noise that is not light's.

Text that was burnt into the frames, as a time that goes on: found, and left out.

Ink is one count, again and again, far from what the light of its pixel is: light scatters, and what
a pixel saturates at is the end of its own scatter.  A time changes in frames that were not looked
at, so that the rectangle around its ink is left out.

Pixels whose noise is not that of light: found by their neighbours, and left out.

A pixel that switches between two levels, a column with a noisy amplifier and a time that is burnt
into a corner look like particles that come and go.  In frames next to each other a pixel's counts
scatter as its light has it, and so do averages of frames far apart; a pixel is unsteady where they
scatter more than those of the pixels around it, and those beside it do not follow: a particle's
picture covers several.  One that never changes is no light either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, find_objects, label, median_filter
from scipy.special import chdtri

from iscat_analysis.camera.counts import Camera
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import PIXELS_UNSTEADY, TEXT_BURNT_IN
from iscat_analysis.medians import SIGMA_PER_MAD, robust_sigma
from iscat_analysis.movie import Stack
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.units import count, listed

_FRAMES, _TOGETHER, _COUNTS = 128, 8, 2**24  # that are looked at, in groups all over the movie
_FEWEST = 16
_AGAIN = 0.02  # of the frames that have the same count, at least and at most
_LEAST_PIXELS = 8  # of a text
_MARGIN = 1  # pixel around a text, for letters that are smooth


def text_finding(text: BoolArray, name: str) -> Finding:
    """Tell where text is burnt in.

    Shapes: `text` (y, x).
    """
    boxes = " and ".join(
        f"rows {a.start}:{a.stop}, columns {b.start}:{b.stop}" for a, b in boxes_of(text)
    )
    return TEXT_BURNT_IN({"boxes": boxes, "pixels": int(text.sum())}, where=name)


def text_summary(text: BoolArray) -> list[dict[str, list[int]]]:
    """Give what ``summary.json`` says of a text.

    Shapes: `text` (y, x).
    """
    return [{"rows": [a.start, a.stop], "columns": [b.start, b.stop]} for a, b in boxes_of(text)]


def boxes_of(text: BoolArray) -> list[tuple[slice, slice]]:
    """Give the rectangles of a text.

    Shapes: `text` (y, x).
    """
    return [(box[0], box[1]) for box in find_objects(label(text)[0])]


def without_text(movie: Stack, text: BoolArray, camera: Camera) -> Stack:
    """Leave the pixels of a text out, as dead ones.

    Shapes: `text` (y, x).
    """
    return movie.without(text, camera.without_light(movie)[text])


def find_text(movie: Stack, span: tuple[int, int]) -> BoolArray | None:
    """Find pixels into which a text is burnt that changes from frame to frame.

    Shapes: result (y, x).
    """
    counts = _sample(movie, span)
    if len(counts) < _FEWEST or not np.issubdtype(counts.dtype, np.integer):
        return None
    lowest, highest = counts.min(axis=0).astype(np.int64), counts.max(axis=0).astype(np.int64)
    width = highest - lowest
    doubtful = width > 2.5 * max(float(np.median(width)), 1.0)  # as ink does
    if not doubtful.sum() >= _LEAST_PIXELS:
        return None
    series = np.sort(counts[:, doubtful].astype(np.int64), axis=0)
    ink, share = _commonest(series)
    light = np.where(series == ink, np.nan, series)
    light[:, share == 1] = 0.0  # nothing but ink, or dead
    scatter = SIGMA_PER_MAD * np.nanmedian(np.abs(light - np.nanmedian(light, axis=0)), axis=0)
    # standard deviations between ink and light, in which nothing lies
    apart = np.nanmin(np.abs(light - ink), axis=0) > 5.0 * np.maximum(scatter, 1.0)
    inked = apart & (share >= max(_AGAIN, 3 / len(counts))) & (share <= 1 - _AGAIN)
    letters = np.zeros(doubtful.shape, dtype=np.bool_)
    letters[doubtful] = inked
    inks = np.unique(ink[inked])
    if letters.sum() < _LEAST_PIXELS or inks.size > letters.sum() / 2:  # of many, none is one
        return None
    # some letters stay, and others change in a few frames
    letters |= (doubtful | (width == 0)) & np.isin(counts, inks).any(axis=0)
    text = np.zeros_like(letters)
    # pixels between letters
    for box in find_objects(label(binary_dilation(letters, iterations=4))[0]):
        inside = np.nonzero(letters[box])
        if inside[0].size >= _LEAST_PIXELS:
            corners = zip(box, inside, strict=True)
            spans = [(part.start + int(k.min()), part.start + int(k.max())) for part, k in corners]
            text[tuple(slice(max(a - _MARGIN, 0), b + _MARGIN + 1) for a, b in spans)] = True
    return text if 0 < text.mean() < 0.25 else None  # of the field


def _sample(movie: Stack, span: tuple[int, int]) -> NDArray[Any]:
    """Read groups of frames all over a range.

    Shapes: result (t, y, x).
    """
    frames = span[1] - span[0]
    most = max(_FEWEST, min(_FRAMES, _COUNTS // math.prod(movie.shape[1:])))
    if frames <= most:
        return movie.read(*span)
    groups = max(2, most // _TOGETHER)
    starts = np.linspace(span[0], span[1] - _TOGETHER, groups).astype(int)
    return np.concatenate([movie.read(start, start + _TOGETHER) for start in starts.tolist()])


def _commonest(series: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Give the commonest count of every pixel, and its share of the frames.

    Shapes: `series` (t, n), sorted; `ink, share` (n,).
    """
    frames, pixels = series.shape
    new = np.vstack([np.ones((1, pixels), dtype=np.bool_), np.diff(series, axis=0) != 0])
    begins = np.where(new, np.arange(frames)[:, None], 0)
    length = np.arange(frames)[:, None] - np.maximum.accumulate(begins, axis=0) + 1
    last = length.argmax(axis=0)
    columns = np.arange(pixels)
    return series[last, columns], length[last, columns] / frames


_AROUND = 5  # pixels along each side, whose median tells how counts scatter there
_LINE_SHARE = 0.5  # of the pixels of a line that is named as such


def unsteady_finding(pixels: BoolArray, name: str) -> Finding:
    """Tell which pixels are unsteady.

    Shapes: `pixels` (y, x).
    """
    number = int(pixels.sum())
    lines = (
        (word, np.flatnonzero(pixels.mean(axis=axis) > _LINE_SHARE))
        for axis, word in ((1, "row"), (0, "column"))
    )
    where = [f"{word} {listed(found, 4)}" for word, found in lines if found.size]
    if not where:
        y, x = np.nonzero(pixels)
        where = [listed([f"({a}, {b})" for a, b in zip(x, y, strict=True)], 3)]
    have = "has" if number == 1 else "have"
    values = {"pixels": count(number, "pixel"), "where": " and ".join(where), "have": have}
    return PIXELS_UNSTEADY(values, where=name)


def find_unsteady(
    blocks: Sequence[NDArray[Any]], camera: Camera, least_beside: float
) -> BoolArray | None:
    """Find pixels that flicker, switch, or repeat their values.

    Shapes: `blocks` (t, y, x), result (y, x).
    """
    frames = np.array([len(block) for block in blocks])
    freedom = int((frames - 1).sum()), len(blocks) - 1
    if freedom[0] < 20 or freedom[1] < 4:  # frames that tell
        return None
    shape = blocks[0].shape[1:]
    highest = np.max([block.max(axis=0) for block in blocks], axis=0)
    still = np.all([(block == block[0]).all(axis=0) for block in blocks], axis=0)
    summed = sum(block.sum(axis=0, dtype=np.float64) for block in blocks)
    light = camera.to_electrons(np.asarray(summed / frames.sum()))
    lit = light > max(20.0, 0.1 * float(np.median(light)))  # below it noise is far from normal
    lit &= ~camera.saturated(highest)
    level = float(light[lit].mean()) if lit.any() else 0.0
    if lit.mean() < 0.5:
        return None
    variance = np.where(lit, light + camera.read_variance_e2(light.shape), np.inf)
    fast, slow = _Scatter(shape), _Scatter(shape)
    found = lit & still
    for block in blocks:
        electrons = camera.to_electrons(block)
        power = electrons[:, lit].mean(axis=1) / level
        if power.min() <= 0:
            return None
        steady = electrons / power[:, None, None]
        mean = steady.mean(axis=0)
        for frame in steady:
            fast.add(frame - mean)
        slow.add((mean - light) * np.sqrt(len(block)))
    for scatter, number in ((fast, freedom[0]), (slow, freedom[1])):
        ratio = np.where(lit, scatter.squares / variance / number, 0.0)
        usual = float(np.median(ratio[lit]))
        if scatter is slow and usual > 3.0:  # by the light or the stage, and in what pattern
            continue
        limit = chdtri(number, 1e-9) / number  # by chance
        more = ratio > usual * limit
        more &= scatter.products.max(axis=0) < least_beside * scatter.squares
        more &= _largest_neighbour(ratio) - usual < least_beside * (ratio - usual)
        if more.any():  # by those around as well, which takes longest
            more &= ratio > median_filter(ratio, _AROUND, mode="nearest") * limit
            found |= more
        if scatter is fast:
            found |= _noisy_lines(ratio, lit, usual, least_beside)
    found &= lit
    return found if 0 < found.mean() < 0.1 else None  # more, and the pixels are not odd


def _largest_neighbour(values: FloatArray) -> FloatArray:
    """Larger one of the two neighbours, along the axis where it is smaller."""
    along_y, along_x = (np.maximum(*both) for both in _neighbours(values))
    return np.minimum(along_y, along_x)


def _neighbours(values: FloatArray) -> tuple[tuple[FloatArray, ...], ...]:
    """Both neighbours of every pixel along y, and along x; at an edge twice the inner one."""
    padded = np.pad(values, 1, mode="reflect")
    along_y = padded[:-2, 1:-1], padded[2:, 1:-1]
    return along_y, (padded[1:-1, :-2], padded[1:-1, 2:])


class _Scatter:
    """Mean square deviations of pixels, and their products with neighbouring pixels."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.squares = np.zeros(shape)
        self.products = np.zeros((2, *shape))

    def add(self, image: FloatArray) -> None:
        """Add one image."""
        self.squares += image**2
        for products, (one, other) in zip(self.products, _neighbours(image), strict=True):
            products += image * (one + other) / 2


def _noisy_lines(ratio: FloatArray, lit: BoolArray, usual: float, least_beside: float) -> BoolArray:
    """Find rows and columns in which most pixels scatter more than in the neighbouring lines."""
    noisy = np.zeros(ratio.shape, dtype=np.bool_)
    for axis in (0, 1):
        lines = np.flatnonzero(lit.mean(axis=axis) > _LINE_SHARE)
        if lines.size < _AROUND:
            continue
        seen = np.where(lit, ratio, np.nan).take(lines, axis=1 - axis)
        excess = np.nanmedian(seen, axis=axis) - usual
        spread = robust_sigma(excess - np.median(excess))
        padded = np.pad(excess, 1, mode="reflect")
        neighbours = np.maximum(padded[:-2], padded[2:])
        # of the usual scatter, and in robust standard deviations of all lines
        off = excess > max(0.15 * usual, 8.0 * spread)
        odd = lines[off & (neighbours < least_beside * excess)]
        noisy[(slice(None), odd) if axis == 0 else odd] = True
    return noisy
