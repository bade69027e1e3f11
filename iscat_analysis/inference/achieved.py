"""The spread that was measured, over the Cramér–Rao bound: pooled over events and empty places.

Disjoint parts of the events' own frames show the noise up to half a window, and whatever a particle
itself adds.  Empty places show the noise of whole windows.  With A the mean square of normalised
differences between the parts of events, B the same at empty places and W that of whole windows
there, the squared spread of the estimates is W + A − B: the noise at full length, and what the
particles' own frames show beyond the others'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from iscat_analysis.inference.repeats import LENGTHS

FloatArray = NDArray[np.float64]

SIGNIFICANT = 3.0
"""Standard errors beyond which a spread differs from the bound; in 1 of 700 by chance."""

LEAST_EXCESS = 0.02
"""Relative excess below which nothing is said."""

_WIDEST = 5.0  # half-width of an interval of ln ratio, beyond which nothing is known
_FEWEST_TILES = 6
_FEWEST_COUNTS = 200


@dataclass(frozen=True)
class Achieved:
    """Measured spread of one parameter over its bound.

    Attributes
    ----------
    over_crb : float
        The ratio.
    ci95 : (float, float)
        Its 95 % interval.
    events : int
        Events whose frames were compared.
    whole : bool
        Whether the noise was seen at the full length of the windows, at empty places; otherwise at
        an eighth to a half of it.
    significance : float
        ln of the ratio in its standard errors.
    frames : tuple of int
        Frames averaged.
    by_frames : tuple of float
        Spread of such averages over their bound, within the events' own frames.
    by_frames_se : tuple of float
        Its standard errors.
    empty : tuple of float
        The same at empty places: parts, eighths, quarters and halves of a window, the whole; empty
        where there are none.
    """

    over_crb: float
    ci95: tuple[float, float]
    events: int
    whole: bool
    significance: float
    frames: tuple[int, ...]
    by_frames: tuple[float, ...]
    by_frames_se: tuple[float, ...]
    empty: tuple[float, ...]

    @property
    def exceeds(self) -> bool:
        """Whether the bound, and so σ, understates the error."""
        return self.over_crb > 1 + LEAST_EXCESS and self.significance > SIGNIFICANT

    @property
    def falls_short(self) -> bool:
        """Whether the noise is less than the model expects."""
        return self.over_crb < 1 - LEAST_EXCESS and self.significance < -SIGNIFICANT


def pooled(
    own: FloatArray, empty: FloatArray | None, empty_counts: FloatArray | None
) -> Achieved | None:
    """Pool the repeats of one parameter.

    Parameters
    ----------
    own : ndarray, shape (events, 1 + len(LENGTHS), 2)
        Squares over expected variance, and how many; from `repeats_of`.
    empty, empty_counts : ndarray, shape (contrasts, tiles), optional
        Of `EmptySpread`, this parameter's.

    Returns
    -------
    Achieved or None
        None without events.

    Notes
    -----
    The interval is Student's, on the logarithm, its variance that between events and between tiles
    of the field, which noise that is common to neighbours does not make too small; at least that of
    χ².
    """
    squares, counts = own[:, :, 0], own[:, :, 1]
    used = counts[:, 0] > 0
    squares, counts = squares[used], counts[used]
    if not len(squares):
        return None
    between, variance = _mean_square(squares[:, 0], counts[:, 0], 2.0)
    degrees = max(len(squares), counts[:, 0].sum() / 4)
    total = counts.sum(axis=0)[1:]
    kept = [k for k, number in enumerate(total) if number >= 2]
    curve = [_mean_square(squares[:, k + 1], counts[:, k + 1], 2.0) for k in kept]
    ratio2, whole = between, False
    levels: tuple[float, ...] = ()
    if empty is not None and empty_counts is not None:
        held = empty_counts[0] > 0
        if held.sum() >= _FEWEST_TILES and empty_counts[0].sum() >= _FEWEST_COUNTS:
            whole = True
            n, s = empty_counts[:, held], empty[:, held]
            mean = s.sum(axis=1) / np.maximum(n.sum(axis=1), 1e-300)
            # the difference of whole windows and their parts, tile by tile
            influence = [(s[k] - mean[k] * n[k]) / n[k].sum() for k in (0, 1)]
            difference = influence[0] - influence[1]
            tiles = int(held.sum())
            slow = float(np.sum(difference**2)) * tiles / (tiles - 1)
            ratio2 = between + mean[0] - mean[1]
            variance += slow
            degrees = min(degrees, tiles - 1)
            levels = tuple(float(math.sqrt(m)) for m in (*mean[1:], mean[0]))
    ratio2 = max(ratio2, 1e-6)
    error = math.sqrt(variance) / (2 * ratio2)  # of ln ratio
    ratio = math.sqrt(ratio2)
    reach = min(float(stdtrit(max(degrees, 2), 0.975)) * error, _WIDEST)
    # what Student's law makes of the error, in normal standard errors
    chance = float(stdtr(max(degrees, 2), -abs(math.log(ratio)) / error))
    significance = math.copysign(-float(ndtri(max(chance, 1e-300))), math.log(ratio))
    return Achieved(
        over_crb=ratio,
        ci95=(ratio * math.exp(-reach), ratio * math.exp(reach)),
        events=len(squares),
        whole=whole,
        significance=significance,
        frames=tuple(LENGTHS[k] for k in kept),
        by_frames=tuple(math.sqrt(value) for value, _ in curve),
        by_frames_se=tuple(
            math.sqrt(spread) / (2 * math.sqrt(max(value, 1e-12))) for value, spread in curve
        ),
        empty=levels,
    )


def _mean_square(squares: FloatArray, counts: FloatArray, excess: float) -> tuple[float, float]:
    """Mean square, and its variance: that between events, and at least that of χ²."""
    total = float(counts.sum())
    mean = float(squares.sum()) / total
    chi2 = excess * mean**2 / total
    events = len(squares)
    if events < 2:
        return mean, chi2
    between = float(np.sum((squares - mean * counts) ** 2)) / total**2 * events / (events - 1)
    return mean, max(chi2, between)
