"""The frames of a movie from which its camera is learned: with light, and in the dark."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.records import CountSource

_MOST_FRAMES, _MOST_COUNTS = 1024, 2**23  # that are looked at: it takes a second
_LEAST_FRAMES = 8
_LEVEL_FRAMES = 24  # frames all over a movie, that tell how much light there is
_FIRST_FRAMES = 64  # frames among which some may be dark
_DARK_LIGHT_SHARE = 0.5  # of the usual counts, below which a frame may be without light
_DARK_SPREAD_SHARE = 0.01  # of the usual counts, by which dark frames may differ
# of what the counts of dark frames would show, if they were light: its error, and itself
_LIT_SHARE_ERROR, _LIT_SHARE = 0.1, 0.1
_DARK_NOISE_SHARE = 0.5  # of the noise that its counts would have if they were light


def sample(
    movie: CountSource, span: tuple[int, int], pixels: int
) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Read the first frames with light, without repeats, and those in the dark.

    Shapes: `lit` (t, y, x), `dark` (k, y, x).
    """
    total = movie.shape[0]
    looks = np.unique(np.linspace(span[0], span[1] - 1, _LEVEL_FRAMES).astype(int)).tolist()
    levels = [float(frame.mean()) for k in looks for frame in _finite(movie.read(k, k + 1))]
    first = min(_FIRST_FRAMES, total)
    looked = [(k, float(one.mean())) for k in range(first) for one in _finite(movie.read(k, k + 1))]
    if not levels or not looked:
        return movie.read(0, 0), None
    usual = float(np.quantile(levels, 0.75))
    means = np.array([mean for _, mean in looked])
    dim = (means < _DARK_LIGHT_SHARE * usual) & (means > 0)
    dim &= means - means.min() < _DARK_SPREAD_SHARE * usual  # and no shutter that is opening
    most = max(_LEAST_FRAMES, min(_MOST_FRAMES, _MOST_COUNTS // pixels))
    counts = _finite(movie.read(span[0], min(span[1], span[0] + most)))
    lit = counts.mean(axis=(1, 2)) > _DARK_LIGHT_SHARE * usual
    repeats = np.array([False, *(np.array_equal(a, b) for a, b in pairwise(counts))][: len(counts)])
    counts = counts[lit & ~repeats]
    if not dim.any() or dim.all() or len(counts) < _LEAST_FRAMES:
        return counts, None
    dark = np.concatenate(
        [movie.read(k, k + 1) for (k, _), d in zip(looked, dim, strict=True) if d]
    )
    return counts, dark if _is_dark(dark, counts) else None


def _finite(frames: NDArray[Any]) -> NDArray[Any]:
    """Drop frames with pixels that are not numbers; these are handled later.

    Shapes: `frames` and result (t, y, x).
    """
    whole: NDArray[Any] = frames[np.isfinite(frames).all(axis=(1, 2))]
    return whole


def _is_dark(dark: NDArray[Any], lit: NDArray[Any]) -> bool:
    """Tell whether frames have neither the pattern of light nor its noise.

    Shapes: `dark` (k, y, x), `lit` (t, y, x).
    """
    as_light = float(dark.mean()) / float(lit.mean())  # if all of it were light
    apart, pattern = (part.mean(axis=0) - part.mean() for part in (dark, lit))
    power = float(np.sum(pattern**2))
    share = float(np.sum(apart * pattern)) / power if power > 0 else 0.0
    rest = float(np.mean((apart - share * pattern) ** 2))
    error = math.sqrt(rest / power) if power > 0 else math.inf
    if error < _LIT_SHARE_ERROR * as_light:
        return abs(share) < _LIT_SHARE * as_light + 3 * error
    noise = noise_adu2(dark) if len(dark) > 1 else noise_adu2(np.moveaxis(dark, 2, 0))
    return noise < _DARK_NOISE_SHARE * as_light * noise_adu2(lit)


def noise_adu2(counts: NDArray[Any]) -> float:
    """Half the mean square of what successive frames differ by, without the laser's flicker."""
    steps = np.diff(counts[:_FIRST_FRAMES].astype(np.float64), axis=0)
    steps -= steps.mean(axis=(1, 2), keepdims=True)
    return float(np.mean(steps**2)) / 2
