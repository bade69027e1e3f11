"""The spread that was measured, over the Cramér–Rao bound: pooled over events and empty places.

Disjoint parts of the events' own frames show the noise up to half a window, and whatever a particle
itself adds.  Empty places show the noise of whole windows.  With A the mean square of normalised
differences between the parts of events, B the same at empty places and W that of whole windows
there, the squared spread of the estimates is W + A − B: the noise at full length, and what the
particles' own frames show beyond the others'.  Where every estimate is of a single frame, it has no
parts, and W stands alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from iscat_analysis.inference.split_frames import LENGTHS

FloatArray = NDArray[np.float64]

SIGNIFICANT = 3.0
"""Standard errors beyond which a spread differs from the bound; in 1 of 700 by chance."""

LEAST_EXCESS = 0.02
"""Relative excess below which nothing is said."""

# Growth of the excess from half a window to a whole one, above which it is a drift
_LEAST_DRIFT_GROWTH = 4.0
_MOST_HALF_WIDTH = 5.0  # half-width of an interval of ln ratio, beyond which nothing is known
_FEWEST_TILES = 6
_FEWEST_COUNTS = 200


@dataclass(frozen=True)
class EmpiricalSpread:
    """Measured spread of one parameter over its bound."""

    over_crb: float
    ci95: tuple[float, float]
    events: int
    whole: bool
    significance: float
    frames: tuple[float, ...]
    by_frames: tuple[float, ...]
    by_frames_se: tuple[float, ...]
    empty: tuple[float, ...]
    single: bool = False

    @property
    def fast2(self) -> float:
        """Squared spread of noise from frame to frame."""
        if self.single:
            return self.empty[0] ** 2
        return self.by_frames[0] ** 2 if self.by_frames else 1.0

    @property
    def slow2(self) -> float:
        """Squared spread of slow noise: of whole windows beyond that of their parts."""
        return self.empty[-1] ** 2 - self.empty[0] ** 2 if self.empty else 0.0

    @property
    def drifts(self) -> bool:
        """Whether slow noise grows with time like a drift, rather than like flicker.

        From half a window to a whole one flicker doubles, and a drift grows eightfold.  In single
        frames a drift grows with the squared distance from the background, flicker with its
        logarithm.
        """
        if self.single:
            near, far = (max(self.by_frames[k] ** 2 - self.fast2, 1e-3) for k in (0, -1))
            return far / near > self.frames[-1] / self.frames[0] > 1
        halves, whole = (self.empty[k] ** 2 for k in (-2, -1))
        return (whole - self.fast2) / max(halves - self.fast2, 1e-3) > _LEAST_DRIFT_GROWTH

    @property
    def exceeds(self) -> bool:
        """Whether the bound, and so σ, is too small."""
        return self.over_crb > 1 + LEAST_EXCESS and self.significance > SIGNIFICANT

    @property
    def falls_short(self) -> bool:
        """Whether the noise is smaller than the model expects."""
        return self.over_crb < 1 - LEAST_EXCESS and self.significance < -SIGNIFICANT


def pooled(
    own: FloatArray,
    empty: FloatArray | None,
    empty_counts: FloatArray | None,
    *,
    shared: float = 1.0,
    distances: tuple[float, ...] | None = None,
) -> EmpiricalSpread | None:
    """Pool the repeats of one parameter.

    Notes
    -----
    The interval is Student's, on the logarithm, its variance that between events and between tiles
    of the field with what these have in common, which noise of neighbours does not make too small;
    at least that of χ².

    Shapes: `own` (events, 1 + len(LENGTHS), `empty, empty_counts` (contrasts, tiles).
    """
    own = own[own[:, 0, 1] > 0]
    if not len(own):
        return None
    tiles = _Tiles.of(empty, empty_counts, shared)
    if distances is None:
        found = _of_windows(own, tiles)
    elif tiles is not None:
        found = _of_frames(tiles, distances)
    else:
        return None
    ratio2 = max(found.ratio2, 1e-6)
    error = math.sqrt(found.variance) / (2 * ratio2)  # of ln ratio
    ratio, degrees = math.sqrt(ratio2), max(found.degrees, 2)
    reach = min(float(stdtrit(degrees, 0.975)) * error, _MOST_HALF_WIDTH)
    # what Student's law makes of the error, in normal standard errors
    chance = float(stdtr(degrees, -abs(math.log(ratio)) / error))
    significance = math.copysign(-float(ndtri(max(chance, 1e-300))), math.log(ratio))
    return EmpiricalSpread(
        over_crb=ratio,
        ci95=(ratio * math.exp(-reach), ratio * math.exp(reach)),
        events=len(own),
        whole=tiles is not None,
        significance=significance,
        frames=found.frames,
        by_frames=tuple(math.sqrt(value) for value, _ in found.curve),
        by_frames_se=tuple(
            math.sqrt(spread) / (2 * math.sqrt(max(value, 1e-12))) for value, spread in found.curve
        ),
        empty=found.levels,
        single=distances is not None,
    )


@dataclass(frozen=True)
class _Found:
    """Squared ratio, its variance and degrees of freedom, and the same against frames."""

    ratio2: float
    variance: float
    degrees: float
    frames: tuple[float, ...]
    curve: tuple[tuple[float, float], ...]
    levels: tuple[float, ...]


@dataclass(frozen=True)
class _Tiles:
    """Contributions of each tile of the field, shape (contrasts, tiles)."""

    squares: FloatArray
    counts: FloatArray
    shared: float

    @classmethod
    def of(
        cls, squares: FloatArray | None, counts: FloatArray | None, shared: float
    ) -> _Tiles | None:
        """Select tiles with places without particles; None where they are too few."""
        if squares is None or counts is None:
            return None
        held = counts[0] > 0
        if held.sum() < _FEWEST_TILES or counts[0].sum() < _FEWEST_COUNTS:
            return None
        return cls(squares[:, held], counts[:, held], shared)

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.counts.shape[1])

    @property
    def mean(self) -> FloatArray:
        """Mean square of each contrast."""
        return np.asarray(self.squares.sum(axis=1) / np.maximum(self.counts.sum(axis=1), 1e-300))

    def influence(self, k: int) -> FloatArray:
        """Contribution of each tile to the error of a mean square."""
        n, s = self.counts[k], self.squares[k]
        return np.asarray((s - self.mean[k] * n) / n.sum())

    def variance(self, influence: FloatArray) -> float:
        """Variance of the sum over tiles."""
        return self.shared * float(np.sum(influence**2)) * self.number / (self.number - 1)


def _of_windows(own: FloatArray, tiles: _Tiles | None) -> _Found:
    """Ratios from parts of windows, at events and at places without a particle."""
    squares, counts = own[:, :, 0], own[:, :, 1]
    ratio2, variance = _mean_square(squares[:, 0], counts[:, 0], 2.0)
    degrees = max(len(own), counts[:, 0].sum() / 4)
    total = counts.sum(axis=0)[1:]
    kept = [k for k, number in enumerate(total) if number >= 2]
    curve = tuple(_mean_square(squares[:, k + 1], counts[:, k + 1], 2.0) for k in kept)
    levels: tuple[float, ...] = ()
    if tiles is not None:
        whole, parts, *others = tiles.mean
        # the difference of whole windows and their parts, tile by tile
        variance += tiles.variance(tiles.influence(0) - tiles.influence(1))
        ratio2 += whole - parts
        degrees = min(degrees, tiles.number - 1)
        levels = tuple(math.sqrt(m) for m in (parts, *others, whole))
    return _Found(ratio2, variance, degrees, tuple(LENGTHS[k] for k in kept), curve, levels)


def _of_frames(tiles: _Tiles, distances: tuple[float, ...]) -> _Found:
    """Ratios from single frames at places without a particle."""
    whole, successive, *at = tiles.mean
    curve = tuple((m, tiles.variance(tiles.influence(2 + k))) for k, m in enumerate(at))
    return _Found(
        whole, tiles.variance(tiles.influence(0)), tiles.number - 1, distances, curve,
        (math.sqrt(successive), math.sqrt(whole)),
    )  # fmt: skip


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
