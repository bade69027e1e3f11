"""Whether particles land and stay, or move; and movies that were given to the wrong mode.

What becomes of changes in a movie: whether particles land and stay, or move.

Averages A_j of successive blocks of frames change where something happens.  A change is seen as
S_j = A_{j+1} − A_{j−1}, with the block in which it happens between.  Where a particle lands or
leaves, the blocks before agree with each other, and so do those after: A_{j+2} − A_{j+1} and
A_{j−1} − A_{j−2} are noise.  Where one moves they seldom are.

A particle that stays where it is, even one that lands for a moment or blinks, has one picture:
around it five blocks, less their mean, are multiples of that picture, whatever it does in time.
One that moves has another picture in every block.  How many pictures there are is the number of
singular values of the matrix of blocks × pixels that exceed those of noise.  A second picture may
be another particle that lands or leaves beside the first, or a pattern that drifts steadily; a
third needs two such coincidences, or motion.

Movies that were given to the wrong mode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from iscat_analysis.camera import Camera, sampled
from iscat_analysis.config import Config
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import PARTICLES_LAND, PARTICLES_MOVE
from iscat_analysis.medians import SIGMA_PER_MAD, middle
from iscat_analysis.records import CountSource, FloatArray
from iscat_analysis.search.bright import smoothed, spot_response
from iscat_analysis.search.frames import summed
from iscat_analysis.search.peaks import maxima

_REACH_SIGMAS = 4.5  # standard deviations of a spot, within which a picture is looked at
_AROUND = 2  # blocks on either side that are looked at
_LEAST_BLOCKS = 5


@dataclass(frozen=True)
class Changes:
    """Statistics of clear changes in a movie."""

    number: int
    staying: float
    moving: float


NO_CHANGES = Changes(0, float("nan"), float("nan"))
"""Of a movie that shows none, or is too short."""


def find_changes(blocks: NDArray[np.floating], spot_px: float) -> Changes:
    """Find changes from block to block, and test whether they stay.

    Shapes: `blocks` (k, y, x).
    """
    if len(blocks) < _LEAST_BLOCKS:
        return NO_CHANGES
    smooth = np.empty(blocks.shape, dtype=np.float32)
    narrow, wide = (spot_response(blocks.shape[1:], width * spot_px) for width in (1, 4))
    between = narrow - wide
    for image, out in zip(blocks, smooth, strict=True):
        out[:] = smoothed(image - 1, between)  # whose noise single precision holds
    noise = SIGMA_PER_MAD * _median_deviation(smooth[:-1], smooth[1:])
    size = smooth[3:-1] - smooth[1:-3]
    np.abs(size, out=size)
    apart = round(2 * _REACH_SIGMAS * spot_px)
    # at twelve standard deviations of noise the ratios below have errors of a tenth
    peaks = maxima(size, max(12.0 * noise, 0.0), (_AROUND, apart, apart))
    peaks = peaks[_of_spots(blocks, peaks, spot_px)]
    if not len(peaks):
        return NO_CHANGES
    block, *position = peaks.T
    one, two, _, four, five = (smooth[block + n, *position] for n in range(_LEAST_BLOCKS))
    change = size[block, *position]
    neighbouring = np.maximum(np.abs(two - one), np.abs(five - four)) / change
    # four standard deviations, or a part of a change that stays: rings of others make less
    quiet = np.maximum(4.0 * noise / change, 0.15)
    pictures = _pictures(smooth, peaks, _REACH_SIGMAS * spot_px, noise)
    staying = (neighbouring < quiet) & (pictures == 1)
    return Changes(len(peaks), float(staying.mean()), float((pictures > 2).mean()))


def _pictures(
    smooth: NDArray[np.float32], peaks: NDArray[np.int64], reach_px: float, noise: float
) -> NDArray[np.int64]:
    """Count the pictures around each change; `noise` is that of a difference of two blocks."""
    row, column = np.ogrid[: smooth.shape[1], : smooth.shape[2]]
    count = np.empty(len(peaks), dtype=np.int64)
    for number, (t, y, x) in enumerate(peaks.tolist()):
        part = tuple(slice(max(c - int(reach_px), 0), c + int(reach_px) + 1) for c in (y, x))
        near = (row[part[0]] - y) ** 2 + (column[:, part[1]] - x) ** 2 <= reach_px**2
        seen = smooth[(slice(t, t + _LEAST_BLOCKS), *part)][:, near].astype(np.float64)
        strength = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
        change = np.linalg.norm(seen[_AROUND + 1] - seen[_AROUND - 1])
        # of noise the second singular value is 1.2, the third 0.9, 1.3 in a fiftieth
        least = max(0.1 * change, 1.5 * noise * math.sqrt(seen.shape[1] / 2))
        count[number] = max(int((strength > least).sum()), 1)
    return count


def _of_spots(
    blocks: NDArray[np.floating], peaks: NDArray[np.int64], spot_px: float
) -> NDArray[np.bool_]:
    """Tell changes in which neighbouring pixels take part from single pixels that blink."""
    least = least_beside(spot_px)
    real = np.ones(len(peaks), dtype=np.bool_)
    _, rows, columns = blocks.shape
    for number, (t, y, x) in enumerate(peaks.tolist()):
        if 0 < y < rows - 1 and 0 < x < columns - 1:
            part = slice(y - 1, y + 2), slice(x - 1, x + 2)
            change = blocks[t + 3][part] - blocks[t + 1][part]
            neighbouring = (change[0, 1] + change[2, 1] + change[1, 0] + change[1, 2]) / 4
            real[number] = neighbouring * np.sign(change[1, 1]) > least * abs(change[1, 1])
    return real


def _median_deviation(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Median absolute deviation of other − one, on a subsample of pixels."""
    every = 1 + one.size // 500_000  # of so many values a median has an error of a few thousandths
    some = other.ravel()[::every] - one.ravel()[::every]
    deviation = some - middle(some.copy())
    return float(middle(np.abs(deviation, out=deviation)))


def least_beside(spot_px: float) -> float:
    """Give the smallest share of a change that the pixels next to its centre have."""
    return 0.5 * math.exp(-0.5 / spot_px**2)  # half of what the picture has there


def spot_of(wavelength_nm: float, na: float, pixel_nm: float) -> float:
    """Give the standard deviation of a particle's picture."""
    return max(0.21 * wavelength_nm / na / pixel_nm, 0.5)  # in wavelengths over NA


BLOCK = 20
"""Frames that are averaged: particles on a membrane, 0.15 µm²/s at 331 Hz, go 190 nm in them."""

MOST_STAYING, MOST_MOVING = 0.1, 0.05
"""Shares of changes that may stay with one picture where particles move (0.07 for 0.001 µm²/s, 0.03
and less from 0.005 µm²/s on), and around which there may be three pictures where they land (0.002,
more where they crowd)."""

LEAST_MOVING = 0.4
"""Share around which there are three pictures where particles move: 0.6 for 0.02 µm²/s, 0.9 and
more from 0.1 to 1 µm²/s.  Where landings crowd, one and a leaving to 70 pixels in 400 frames, it
is 0.14, and 0.36 at most."""


LARGEST_CHANCE = 0.03
"""A movie is said to be of the other kind where so many changes have a smaller chance than this."""


def look_at_changes(
    movie: CountSource, config: Config, camera: Camera, span: tuple[int, int]
) -> Changes:
    """Find changes in the first frames of a movie, at a sample of the pixels of a large field."""
    movie, camera = sampled(movie, camera)
    last = min(span[1], span[0] + 2000, movie.shape[0])
    starts = range(span[0], last - BLOCK + 1, BLOCK)
    # noise is a thousand times what single precision rounds away
    images = np.empty((len(starts), *movie.shape[1:]), dtype=np.float32)
    level, power, lit = np.zeros(movie.shape[1:]), 0.0, 0
    saturated = np.zeros(movie.shape[1:], dtype=np.bool_)
    for first in starts:
        counts, highest = summed(movie.read(first, first + BLOCK))
        saturated |= camera.saturated(highest)
        light = camera.to_electrons(counts / BLOCK)
        if light.mean() > 0:
            power += light.mean()
            light /= light.mean()
            level += light
            images[lit] = light
            lit += 1
    if not lit:
        return NO_CHANGES
    images, level = images[:lit], level / lit
    usable = (level > 0.1 * np.median(level)) & ~saturated
    images /= np.where(usable, level, 1.0).astype(np.float32)
    images -= 1
    images *= _damping(np.where(usable, level, 0.0) * power / lit, camera)
    images += 1
    pixel = config.camera.pixel_size_nm or config.optics.wavelength_nm / config.optics.na
    return find_changes(images, spot_of(config.optics.wavelength_nm, config.optics.na, pixel))


def _damping(light_e: FloatArray, camera: Camera) -> NDArray[np.float32]:
    """Give what keeps the noise of dim pixels, as around a round beam, to that of half the light.

    Shapes: `light_e`, result (y, x).
    """
    read = camera.read_variance_e2((light_e.shape[0], light_e.shape[1]))
    # of the usual light
    half = 0.5 * float(np.median(light_e[light_e > 0])) if (light_e > 0).any() else 1.0
    sharp = light_e / np.sqrt(np.maximum(light_e + read, 1.0))
    enough = half / math.sqrt(max(half + float(read.mean()), 1.0))
    return np.minimum(sharp / enough, 1.0).astype(np.float32)


def as_landing(changes: Changes, name: str) -> Finding | None:
    """Find whether a movie in mode ``track`` shows landings."""
    if _chance(changes.number, changes.staying, MOST_STAYING) > LARGEST_CHANCE:
        return None
    values = {"changes": changes.number, "percent": 100 * changes.staying}
    return PARTICLES_LAND(values, where=name)


def as_moving(changes: Changes, name: str) -> Finding | None:
    """Find whether a movie with sliding windows shows moving particles."""
    clear = _chance(changes.number, changes.moving, MOST_MOVING) <= LARGEST_CHANCE
    if not (clear and changes.moving >= LEAST_MOVING):
        return None
    values = {"changes": changes.number, "percent": 100 * changes.moving, "block": BLOCK}
    return PARTICLES_MOVE(values, where=name)


def _chance(number: int, share: float, most: float) -> float:
    """Chance that at least this share of the changes are such, if each is with chance `most`."""
    return float(bdtrc(round(number * share) - 1, number, most)) if number and share > 0 else 1.0
