"""The light before anything is searched: what of it flickers or changes over the field."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.movie import Stack
from iscat_analysis.movie.camera import Camera
from iscat_analysis.movie.lighting import find_surface
from iscat_analysis.movie.lines import Lines, find_lines
from iscat_analysis.pipeline.noise import SPECTRUM_FRAMES
from iscat_analysis.pipeline.ways import way_of
from iscat_analysis.records import BoolArray
from iscat_analysis.search.sliding import longest_window, measure_frames
from iscat_analysis.threads import one_thread_algebra

PAIRS = 12
"""Places in a movie at which the light of some frames is compared with that of later ones."""

_TOGETHER = 8  # frames that are summed there
_SINGLE_PAIRS = 24  # places where particles are followed
_SAMPLE_BYTES = 32_000_000  # of counts that are read for it


def judge_lines(movie: Stack, config: Config, camera: Camera) -> Lines | None:
    """Look for rows, columns and a smooth part of the light that may be divided out.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        Lines are looked for in its background frames, or in the first that are analysed; smooth
        changes in all of them.  Nothing is where ``background.power_normalization`` is false, the
        background is dark or known, or the fixed pattern is followed as it moves: it changes the
        light of the lines far more than flicker, as nanoparticles that move in a volume do, which
        are there in every frame.
    camera : Camera
        Counts → photoelectrons.

    Returns
    -------
    Lines or None
        None where there is nothing to correct.
    """
    background = config.background
    way = way_of(config)
    if (
        not background.power_normalization
        or background.method == "known"
        or (background.method == "sliding" and background.drift_correction)
        or config.optics.scheme == "darkfield"
        or (way == "tracks" and config.track.free == "joint")
    ):
        return None
    first, last = background.recorded or config.fit.frames or (0, movie.shape[0])
    counts = movie.read(first, max(first, min(last, movie.shape[0], first + SPECTRUM_FRAMES)))
    if not len(counts):
        return None
    pairs, window = _pairs(movie, config, camera)
    with one_thread_algebra():
        surface = find_surface(pairs, camera, window)
    return find_lines(counts[_good(counts, camera)], camera, surface)


def _good(counts: NDArray[Any], camera: Camera) -> BoolArray:
    """Leave out frames without light, and those that repeat the one before."""
    light, repeats = measure_frames(counts, camera)
    return np.isfinite(light) & ~repeats


def _pairs(
    movie: Stack, config: Config, camera: Camera
) -> tuple[list[tuple[NDArray[Any], NDArray[Any]]], int]:
    """Read frames that are as far apart as windows that are compared, and how many those have.

    Where the background has frames of its own, particles are in the others alone: both are looked
    at by themselves.  Frames in which particles move are compared one by one, half the movie apart:
    what they have in common is their background.
    """
    total, way, places = movie.shape[0], way_of(config), PAIRS
    given = config.background.recorded, config.fit.frames
    together = _TOGETHER
    if way != "fixed":
        first, last = given[1] or (0, total)
        spans = [(first, min(last, total))]
        window = config.background.window_frames or longest_window(last - first)
        if way == "tracks":
            window, together, places = (spans[0][1] - first) // 2, 1, _SINGLE_PAIRS
    else:
        before = given[0] or (0, 0)
        first, last = given[1] or (before[1], total)
        spans = [(before[0], min(before[1], total)), (first, min(last, total))]
        window = max(stop - start for start, stop in spans)
    frame_bytes = math.prod(movie.shape[1:]) * np.dtype(movie.dtype).itemsize
    together = min(together, _SAMPLE_BYTES // (2 * places * frame_bytes) or 1)
    pairs = []
    for start, stop in spans:
        gap = min(window, (stop - start) // 2)
        number = min(together, gap)
        if number < 1:
            continue
        starts = np.linspace(start, stop - gap - number, places // len(spans)).astype(int)
        for place in np.unique(starts).tolist():
            two = [movie.read(k, k + number) for k in (place, place + gap)]
            good = [part[_good(part, camera)] for part in two]
            if all(map(len, good)):
                pairs.append((good[0], good[1]))
    return pairs, window
