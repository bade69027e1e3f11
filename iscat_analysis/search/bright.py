"""Bright steps of any shape: where the contrast changes by more than noise, whatever it looks like.

No picture of a particle is needed.  At every boundary between blocks the squared contrast over its
variance, less one, is averaged over a spot of the size of the diffraction limit; noise averages to zero
there and a step does not.  It takes a step some three times brighter than a matched filter needs,
and it finds it with a microscope of which nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from iscat_analysis.records import BoolArray, FloatArray, Mapper
from iscat_analysis.search.sliding import STRIDES, Chunk, locate_step

THRESHOLD = 7.0
"""Excess of the smoothed energy over its noise; the noise of a movie of 10⁸ pixels stays below."""

ALONE_NM = 4500.0
"""Nothing else may happen nearer than this to a step while its frames are summed."""

LEAST_FRAMES = 8
"""Frames on either side without which a step is left out."""

CONSTANT_P = 1e-3
"""A step whose height changes before or after it, with less than this chance, is left out."""

_SPOT = 1.0  # standard deviation of the spot over λ/NA
_SHADOW_NM = 1500.0  # a weaker maximum nearer than this to a stronger one is part of it
_CORE_NM = 900.0  # radius that dates a step


@dataclass(frozen=True)
class BrightStep:
    """One bright step, summed before and after.

    Attributes
    ----------
    frame : int
        First frame of the new state.
    x_px, y_px : float
        Centre of its energy, to about a pixel.
    snr : float
        Root of the χ² that its picture has in excess of noise.
    rows, columns : (int, int)
        Its region of the field, half-open.
    before_e, after_e : ndarray, shape (ny, nx)
        Summed photoelectrons [e].
    n_before, n_after : int
        Frames in each sum.
    power_ratio : float
        Power after over power before.
    usable : ndarray of bool, shape (ny, nx)
        Pixels that are neither defective nor saturated.
    """

    frame: int
    x_px: float
    y_px: float
    snr: float
    rows: tuple[int, int]
    columns: tuple[int, int]
    before_e: FloatArray
    after_e: FloatArray
    n_before: int
    n_after: int
    power_ratio: float
    usable: BoolArray


@dataclass(frozen=True)
class _Spot:
    """A maximum of the energy."""

    frame: int
    row: int
    column: int
    excess: float


def find_bright_steps(
    chunk: Chunk,
    window: int,
    *,
    pixel_nm: float,
    resolution_nm: float,
    roi_px: int,
    most: int,
    mapper: Mapper = map,
) -> tuple[BrightStep, ...]:
    """Bright steps that stand alone, brightest first.

    Parameters
    ----------
    chunk : Chunk
        The frames, with `STRIDES` blocks to a window.
    window : int
        Frames before a step, and after it, at most.
    pixel_nm : float
        Pixel side [nm].
    resolution_nm : float
        λ/NA, roughly [nm].
    roi_px : int
        Side of the region that is cut out.
    most : int
        Steps that are returned at most.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    tuple of BrightStep
        Each with nothing else of its brightness within `ALONE_NM` in the frames summed.
    """
    spots = _spots(chunk, _SPOT * resolution_nm / pixel_nm, _SHADOW_NM / pixel_nm, mapper)
    found = []
    for spot in spots:
        step = _cut(chunk, spot, spots, window, pixel_nm, roi_px)
        if step is not None:
            found.append(step)
        if len(found) == most:
            break
    return tuple(sorted(found, key=lambda step: -step.snr))


def _spots(chunk: Chunk, spot_px: float, shadow_px: float, mapper: Mapper) -> list[_Spot]:
    """Maxima of the energy in time and space, brightest first."""
    count = chunk.edges.size - 2
    power = np.add.reduceat(chunk.power, chunk.edges[:-1])
    frames = np.diff(chunk.edges)
    read = chunk.camera.read_variance_e2(chunk.shape)
    used = chunk.usable
    coverage = np.maximum(gaussian_filter(used.astype(float), spot_px), 1e-3)
    noise = math.sqrt(2 / (4 * math.pi * spot_px**2))

    def one(j: int) -> FloatArray:
        low, middle, high = max(j + 1 - STRIDES, 0), j + 1, min(j + 1 + STRIDES, count + 1)
        ratio = power[middle:high].sum() / max(power[low:middle].sum(), 1e-300)
        before = chunk.blocks_e[low:middle].sum(axis=0)
        after = chunk.blocks_e[middle:high].sum(axis=0)
        if not 0 < ratio < 1e6:
            return np.zeros(chunk.shape, dtype=np.float32)
        lit = used & (before > 0) & (after > 0)
        change = after - ratio * before
        change -= before * (change[lit].sum() / before[lit].sum())
        variance = after + ratio**2 * before
        variance += read * (frames[middle:high].sum() + ratio**2 * frames[low:middle].sum())
        excess = np.where(lit, change**2 / np.where(lit, variance, 1.0) - 1, 0.0)
        return (gaussian_filter(excess, spot_px) / coverage / noise).astype(np.float32)

    energy = np.stack(list(mapper(one, range(count))))
    peaks = (energy > THRESHOLD) & (energy == maximum_filter(energy, size=(3, 5, 5)))
    places = np.argwhere(peaks)
    order = np.argsort(-energy[peaks], kind="stable")
    kept: list[_Spot] = []
    taken: list[tuple[int, int, int]] = []
    for k, i, j in places[order]:
        shadowed = any(
            abs(k - kk) < 2 * STRIDES and math.hypot(i - ii, j - jj) < shadow_px
            for kk, ii, jj in taken
        )
        if not shadowed:
            taken.append((int(k), int(i), int(j)))
            frame = chunk.first + int(chunk.edges[k + 1])
            kept.append(_Spot(frame, int(i), int(j), float(energy[k, i, j])))
    return kept


def _cut(
    chunk: Chunk,
    spot: _Spot,
    spots: Sequence[_Spot],
    window: int,
    pixel_nm: float,
    roi_px: int,
) -> BrightStep | None:
    """Date a step and sum the frames around it in which nothing else happens; None if too few."""
    low, high = max(chunk.first, spot.frame - window), min(chunk.stop, spot.frame + window)
    stride = max(1, window // STRIDES)
    for other in spots:
        if other is spot or _distance(other, spot) * pixel_nm > ALONE_NM:
            continue
        if other.frame <= spot.frame:
            low = max(low, other.frame + stride)
        if other.frame >= spot.frame:
            high = min(high, other.frame - stride)
    row, column = spot.row, spot.column
    step: BrightStep | None = None
    frame = spot.frame
    for gap in (0, None, None):  # roughly, then dated with its own picture and centred
        rows, columns = _region(row, roi_px), _region(column, roi_px)
        if min(rows[0], columns[0]) < 0 or rows[1] > chunk.shape[0] or columns[1] > chunk.shape[1]:
            return None
        patch = chunk.patch(low, high, rows, columns)
        if gap is None and step is not None:
            dated = locate_step(patch, _core(step, pixel_nm), (low + 1, high))
            if dated.p_constant < CONSTANT_P:
                return None
            frame, gap = dated.frame, dated.gap
        if min(frame - (gap or 0) - low, high - frame - (gap or 0)) < LEAST_FRAMES:
            return None
        before, n_before, power_before = patch.window(low, frame - (gap or 0))
        after, n_after, power_after = patch.window(frame + (gap or 0), high)
        if min(n_before, n_after) < LEAST_FRAMES:
            return None
        step = BrightStep(
            frame=frame, x_px=column, y_px=row, snr=0.0, rows=rows, columns=columns,
            before_e=before, after_e=after, n_before=n_before, n_after=n_after,
            power_ratio=power_after / power_before, usable=patch.usable,
        )  # fmt: skip
        y_px, x_px = _centre(step, pixel_nm)
        step = replace(step, x_px=x_px, y_px=y_px)
        row, column = round(y_px), round(x_px)
    if step is None:
        return None
    contrast, variance = measured_contrast(step)
    excess = float(np.sum(contrast**2 / variance) - contrast.size)
    return replace(step, snr=math.sqrt(max(excess, 0.0)))


def _distance(one: _Spot, other: _Spot) -> float:
    return math.hypot(one.row - other.row, one.column - other.column)


def _region(centre: int, side: int) -> tuple[int, int]:
    first = centre - side // 2
    return first, first + side


def measured_contrast(step: BrightStep) -> tuple[FloatArray, FloatArray]:
    """Contrast of a step, its common level taken off, and the variance of shot noise.

    Parameters
    ----------
    step : BrightStep
        The step.

    Returns
    -------
    contrast, variance : ndarray, shape (ny, nx)
        Where a pixel is not usable, 0 and a variance of 10⁶.
    """
    used = step.usable & (step.before_e > 0) & (step.after_e > 0)
    before, after = np.where(used, step.before_e, 1.0), np.where(used, step.after_e, 1.0)
    ratio = float(after[used].sum() / before[used].sum())
    contrast = np.where(used, after / (ratio * before) - 1, 0.0)
    return contrast, np.where(used, 1 / before + 1 / after, 1e6)


def _core(step: BrightStep, pixel_nm: float) -> FloatArray:
    """Give the smoothed contrast of a step around its centre, as the template that dates it."""
    contrast, _ = measured_contrast(step)
    distance = _radius_px(step, step.y_px, step.x_px) * pixel_nm
    return np.asarray(gaussian_filter(contrast, 0.7) * (distance < _CORE_NM))


def _centre(step: BrightStep, pixel_nm: float) -> tuple[float, float]:
    """Centre of the energy, in a shrinking neighbourhood; y and x in pixels of the field."""
    contrast, variance = measured_contrast(step)
    energy = np.maximum(gaussian_filter(contrast**2 / variance - 1, 0.7), 0.0)
    y = np.arange(*step.rows)[:, None] + 0.0 * energy
    x = np.arange(*step.columns)[None, :] + 0.0 * energy
    at = (float(step.y_px), float(step.x_px))
    for reach_nm in (900.0, 700.0, 600.0, 500.0):
        weight = energy * (_radius_px(step, *at) * pixel_nm < reach_nm)
        total = float(weight.sum())
        if total <= 0:
            break
        at = float((weight * y).sum()) / total, float((weight * x).sum()) / total
    return at


def _radius_px(step: BrightStep, y_px: float, x_px: float) -> FloatArray:
    y, x = np.arange(*step.rows)[:, None] - y_px, np.arange(*step.columns)[None, :] - x_px
    return np.asarray(np.hypot(y, x))
