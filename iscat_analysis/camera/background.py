"""The image without particles: counts summed before and after landing, and the laser power.

Raw photoelectrons are summed, never rescaled frames, so the sums stay Poisson and the conditional
likelihood stays exact; the power enters only through ρ, total power after over before.

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
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    find_objects,
    label,
    maximum_filter,
    median_filter,
    minimum_filter,
    uniform_filter,
)
from scipy.special import chdtri

from iscat_analysis.camera.counts import Camera
from iscat_analysis.config import BackgroundConfig
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import PIXELS_UNSTEADY, TEXT_BURNT_IN
from iscat_analysis.medians import SIGMA_PER_MAD, robust_sigma
from iscat_analysis.movie import Stack
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress, Windows, silent
from iscat_analysis.units import count, listed

DEAD, HOT = 0.2, 5.0
"""A pixel below or above these multiples of the median of its neighbours is left out."""

DEFECT_SIGMAS = 6.0
"""Unless noise alone could have put it there: dark backgrounds scatter by more than their mean."""

_NEIGHBOURS = 5  # pixels along each side, whose median tells what a pixel should hold
_BLOCK_BYTES = 16 * 2**20
_NEIGHBOURHOOD = 7  # pixels, on which a faint background is averaged for the weights
_MEAN = BackgroundConfig(method="fixed")
_LEAST_TOTAL_E = 1e6  # fewer background photoelectrons leave the power uncertain by over 0.1 %

Check = Callable[[NDArray[Any], int], None]


def _unchecked(counts: NDArray[Any], first: int) -> None:
    """Accept any counts."""


def measure_windows(
    stack: FrameSource,
    camera: Camera,
    before: tuple[int, int] | None,
    after: tuple[int, int],
    background: BackgroundConfig = _MEAN,
    *,
    check: Check = _unchecked,
    progress: Progress = silent,
) -> Windows:
    """Sum the frames before and after landing, as the section of the background says."""
    _check_ranges(stack, before, after, overlap=background.learnt_with_tracks)
    n_before, n_after = (span[1] - span[0] if span else 0 for span in (before, after))
    shape = stack.shape[1:]
    saturated = np.zeros(shape, dtype=np.bool_)
    totals: list[float] = []

    def summed(span: tuple[int, int]) -> FloatArray:
        sum_e = np.zeros(shape)
        for start, stop in blocks(stack.shape, span):
            counts = stack.read(start, stop)
            check(counts, start)
            saturated[...] |= camera.saturated(counts).any(axis=0)
            electrons = camera.to_electrons(counts)
            sum_e += electrons.sum(axis=0)
            totals.extend(electrons.sum(axis=(1, 2)))
            progress("background", len(totals), n_before + n_after)
        return sum_e

    before_e = np.full(shape, background.level_e or 0.0) if before is None else summed(before)
    if before is not None and not (background.is_counted or background.is_known):
        power = np.array(totals)
        even = not background.power_normalization or power.min() <= 0
        before_e = n_before * _median(stack, camera, before, 1 + 0 * power if even else power)
    after_e = summed(after)
    power, variance = np.array(totals), camera.read_variance_e2(shape)
    level = power[: n_before or None].mean()
    windows = Windows(
        before_e=before_e,
        after_e=after_e,
        n_before=n_before,
        n_after=n_after,
        power_ratio=n_after / max(n_before, 1),
        read_variance_before_e2=n_before * variance,
        read_variance_after_e2=n_after * variance,
        masked=saturated | find_defects(before_e, n_before * variance),
        saturated=saturated,
        frames_before=before or (0, 0),
        frames_after=after,
        power=power / level if level > 0 else np.ones(power.size),
    )
    return start_power(windows) if background.power_normalization else windows


def add_frames(windows: Windows, camera: Camera, counts: NDArray[Any], first: int) -> Windows:
    """Replace the frames after landing.

    Shapes: `counts` (t, y, x).
    """
    n = len(counts)
    electrons = camera.to_electrons(counts)
    saturated: BoolArray = np.any(camera.saturated(counts), axis=0)
    variance = camera.read_variance_e2((counts.shape[1], counts.shape[2]))
    return replace(
        windows,
        after_e=electrons.sum(axis=0),
        n_after=n,
        power_ratio=n / max(windows.n_before, 1),
        read_variance_after_e2=n * variance,
        masked=(windows.masked & ~windows.saturated) | saturated,
        saturated=saturated,
        frames_after=(first, first + n),
    )


def start_power(windows: Windows) -> Windows:
    """Estimate ρ from pixels that no particle has changed noticeably."""
    used = ~windows.masked
    after, before = windows.after_e[used], windows.before_e[used]
    if before.sum() < _LEAST_TOTAL_E or after.sum() <= 0:
        return windows
    counted = windows.n_before > 0
    kept = np.ones(after.shape, dtype=np.bool_)
    ratio = after.sum() / before.sum()
    for _ in range(20):
        variance = ratio * before * (1 + counted * ratio) + windows.read_variance_after_e2[used]
        off = np.abs(after - ratio * before) / np.sqrt(np.maximum(variance, 1.0))
        kept_now = off < 3.0 * max(1.0, robust_sigma(off[kept]))  # robust standard deviations
        if np.array_equal(kept_now, kept) or kept_now.sum() < 0.1 * kept.size:
            break
        kept = kept_now
        ratio = after[kept].sum() / before[kept].sum()
    return replace(windows, power_ratio=float(ratio)) if math.isfinite(ratio) else windows


def refine_power(windows: Windows, explained: FloatArray, *, additive: bool) -> Windows:
    """Estimate ρ again, over the fitted particles.

    Shapes: `explained` (y, x).
    """
    used = ~windows.masked
    if additive:
        # a tenth of the light or more is a particle
        used &= explained < 0.1 * windows.power_ratio * windows.before_e
    if windows.before_e[used].sum() < _LEAST_TOTAL_E:
        return windows
    after, before = windows.after_e[used], windows.before_e[used]
    if additive:
        ratio = (after.sum() - explained[used].sum()) / before.sum()
    else:
        ratio = after.sum() / (before * (1 + explained[used])).sum()
    return replace(windows, power_ratio=float(ratio))


def smooth_background(
    before_e: FloatArray, variance_e2: FloatArray, masked: BoolArray
) -> FloatArray:
    """Smooth a background whose counts per pixel are too few.

    With weights from a pixel's own fluctuating background, pixels that happened to be dark before
    get too much weight, and seem to have brightened.

    Notes
    -----
    The adaptive filter of J. S. Lee, IEEE Trans. Pattern Anal. 2, 165 (1980).

    Shapes: `before_e` (y, x), `variance_e2` (y, x), `masked` (y, x), result (y, x).
    """
    used = (~masked).astype(np.float64)
    share = np.maximum(uniform_filter(used, _NEIGHBOURHOOD, mode="nearest"), 1e-3)
    mean = uniform_filter(before_e * used, _NEIGHBOURHOOD, mode="nearest") / share
    apart = (before_e - mean) * used
    spread = uniform_filter(apart**2, _NEIGHBOURHOOD, mode="nearest") / share
    noise = np.maximum(mean, 0.0) + variance_e2
    structure = np.clip(1 - 2 * noise / np.maximum(spread, 1e-300), 0.0, 1.0)
    return np.asarray(np.maximum(mean + structure * apart, 0.0))


def _check_ranges(
    stack: FrameSource, before: tuple[int, int] | None, after: tuple[int, int], *, overlap: bool
) -> None:
    frames = stack.shape[0]
    for name, key, span in (
        ("background", "background.frames", before),
        ("fitted", "fit.frames", after),
    ):
        if span is not None and span[1] > frames:
            raise DataError(
                f"{stack.name}: has {count(frames, 'frame')}, but the {name} range asks for "
                f"{span[0]}:{span[1]}; change {key}"
            )
    if after[1] <= after[0]:
        raise DataError(
            f"{stack.name}: no frame is left after the background; they end "
            f"at {frames}; set background.frames or fit.frames"
        )
    if not overlap and before is not None and before[0] < after[1] and after[0] < before[1]:
        raise DataError(
            f"{stack.name}: background frames {before[0]}:{before[1]} overlap the fitted frames "
            f"{after[0]}:{after[1]}; change background.frames or fit.frames"
        )


def blocks(
    shape: tuple[int, int, int], span: tuple[int, int], most_bytes: int = _BLOCK_BYTES
) -> list[tuple[int, int]]:
    """Divide a range of frames into such as fit into memory, in doubles."""
    size = max(1, most_bytes // (8 * shape[1] * shape[2]))
    return [(a, min(a + size, span[1])) for a in range(span[0], span[1], size)]


def _median(
    stack: FrameSource, camera: Camera, span: tuple[int, int], power: FloatArray
) -> FloatArray:
    """Per-pixel median over the frames, a band of rows at a time, each frame over its power."""
    _, rows, columns = stack.shape
    band = max(1, _BLOCK_BYTES // (8 * power.size * columns))
    level = (power / power.mean())[:, None, None]
    out = np.empty((rows, columns))
    for top in range(0, rows, band):
        electrons = [
            camera.to_electrons(stack.read(start, stop))[:, top : top + band]
            for start, stop in blocks(stack.shape, span)
        ]
        out[top : top + band] = np.median(np.concatenate(electrons) / level, axis=0)
    return out


def find_defects(before_e: FloatArray, read_variance_e2: FloatArray) -> BoolArray:
    """Find dead and hot pixels: far from the median of their neighbours, beyond noise.

    Shapes: `before_e` (y, x), `read_variance_e2` (y, x), result (y, x).
    """
    local = _usual(before_e)
    off = (before_e < DEAD * local) | (before_e > HOT * local)
    # Anscombe's transform makes the noise 1 at every level, a few counts included.
    steady, expected = (
        2 * np.sqrt(np.maximum(counts + 0.375 + read_variance_e2, 0.0))
        for counts in (before_e, local)
    )
    return np.asarray(off & (np.abs(steady - expected) > DEFECT_SIGMAS))


def unlike_neighbours(light: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Find pixels that are far darker, and such that are far brighter, than their neighbours.

    Shapes: `light` (y, x), results (y, x).
    """
    local = _usual(light)
    return (light < DEAD * local) & (local > 0), (light > HOT * local) & (local > 0)


def _usual(light: FloatArray) -> FloatArray:
    """Median of the neighbours of pixels that may be far from it; the others as they are.

    A median lies between the lowest and the highest of its neighbours, which are found sooner.
    """
    lowest, highest = (
        np.maximum(extreme(light, size=_NEIGHBOURS, mode="nearest"), 0.0)
        for extreme in (minimum_filter, maximum_filter)
    )
    doubtful = (light < DEAD * highest) | (light > HOT * lowest)
    padded = np.pad(light, _NEIGHBOURS // 2, mode="edge")
    around = sliding_window_view(padded, (_NEIGHBOURS, _NEIGHBOURS))[doubtful]
    usual = light.copy()
    usual[doubtful] = np.maximum(np.median(around.reshape(-1, _NEIGHBOURS**2), axis=1), 0.0)
    return usual


_FRAMES, _TOGETHER, _COUNTS = 128, 8, 2**24  # that are looked at, in groups all over the movie
_FEWEST = 16
_AGAIN = 0.02  # of the frames that have the same count, at least and at most
_LEAST_PIXELS = 8  # of a text


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
            # and one around them, for letters that are smooth
            text[tuple(slice(max(a - 1, 0), b + 2) for a, b in spans)] = True
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
    fast, slow = np.zeros((2, 3, *shape))
    found = lit & still
    for block in blocks:
        electrons = camera.to_electrons(block)
        power = electrons[:, lit].mean(axis=1) / level
        if power.min() <= 0:
            return None
        steady = electrons / power[:, None, None]
        mean = steady.mean(axis=0)
        for frame in steady:
            fast += _products(frame - mean)
        slow += _products((mean - light) * np.sqrt(len(block)))
    for scatter, number in ((fast, freedom[0]), (slow, freedom[1])):
        ratio = np.where(lit, scatter[0] / variance / number, 0.0)
        usual = float(np.median(ratio[lit]))
        if scatter is slow and usual > 3.0:  # by the light or the stage, and in what pattern
            continue
        limit = chdtri(number, 1e-9) / number  # by chance
        more = ratio > usual * limit
        more &= scatter[1:].max(axis=0) < least_beside * scatter[0]
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
    return (padded[:-2, 1:-1], padded[2:, 1:-1]), (padded[1:-1, :-2], padded[1:-1, 2:])


def _products(image: FloatArray) -> FloatArray:
    """Squares of an image, and its products with what is beside it along y and along x.

    Shapes: `image` (y, x), result (3, y, x).
    """
    beside = (image * (one + other) / 2 for one, other in _neighbours(image))
    return np.stack([image**2, *beside])


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
