"""Movies that were given to the wrong mode."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.field_sample import sampled
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.changes import NO_CHANGES, Changes, find_changes, spot_of
from iscat_analysis.records import CountSource, FloatArray
from iscat_analysis.search.frames import summed

MOST_FRAMES = 2000
"""Of a movie that are looked at, from its first."""

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

_DIM = 0.5  # of the usual light, below which changes are damped

LARGEST_CHANCE = 0.03
"""A movie is said to be of the other kind where so many changes have a smaller chance than this."""


def look_at_changes(
    movie: CountSource, config: Config, camera: Camera, span: tuple[int, int]
) -> Changes:
    """Find changes in the first frames of a movie, at a sample of the pixels of a large field."""
    movie, camera = sampled(movie, camera)
    last = min(span[1], span[0] + MOST_FRAMES, movie.shape[0])
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
    half = _DIM * float(np.median(light_e[light_e > 0])) if (light_e > 0).any() else 1.0
    sharp = light_e / np.sqrt(np.maximum(light_e + read, 1.0))
    enough = half / math.sqrt(max(half + float(read.mean()), 1.0))
    return np.minimum(sharp / enough, 1.0).astype(np.float32)


def as_landing(changes: Changes, name: str) -> str:
    """Say that a movie in mode ``track`` shows landings; empty where it does not."""
    if _chance(changes.number, changes.staying, MOST_STAYING) > LARGEST_CHANCE:
        return ""
    return (
        f"{name}: its particles land or leave rather than move: of {changes.number} clear changes "
        f"{100 * changes.staying:.0f} % stay as they are; use "
        'fit.mode = "mass" without background.frames, whose windows follow landings'
    )


def as_moving(changes: Changes, name: str) -> str:
    """Say that a movie with sliding windows shows moving particles; empty where it does not."""
    clear = _chance(changes.number, changes.moving, MOST_MOVING) <= LARGEST_CHANCE
    if not (clear and changes.moving >= LEAST_MOVING):
        return ""
    return (
        f"{name}: its particles move rather than land: around {100 * changes.moving:.0f} % of "
        f"{changes.number} clear changes the picture is another one every {BLOCK} frames, as of "
        'what goes from place to place; use fit.mode = "track", which follows them'
    )


def _chance(number: int, share: float, most: float) -> float:
    """Chance that at least this share of the changes are such, if each is with chance `most`."""
    return float(bdtrc(round(number * share) - 1, number, most)) if number and share > 0 else 1.0


def changes_summary(changes: Changes) -> dict[str, Any]:
    """Summarise changes for ``summary.json``."""
    return {"number": changes.number, "staying": changes.staying, "moving": changes.moving}
