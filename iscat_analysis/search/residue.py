"""What the model leaves over of a bright particle, and how large a particle beside it must be.

A model that is not quite right leaves rings around every bright particle, which the matched filter
takes for more.  How large they are is measured on the particle itself:

- around it, at the distance of the candidate: a second particle fills a small part of that ring, a
  misfit rises as high on much of it;
- in its fitted region: a second particle explains most of the χ² in excess, a peak of a misfit a
  small share.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis._kernels.stepping import ring_heights

EXCEEDS = 1.5
"""Times the height of its ring that a particle must have."""

EXPLAINS = 0.5
"""Share of the χ² in excess that a particle inside the fitted region must explain."""

DOMINANT_RATIO = 3.0
"""Times the signal-to-noise ratio of an event from which on another one near it dwarfs it."""

LISTED = 0.7
"""Share of what a particle must have from which a candidate is listed, as a side lobe."""

RINGS = 0.04
"""Share of a particle's signal-to-noise ratio that the model may leave over around it, where that
is not measured."""

_EXCESS_SIGMAS = 3.0  # of χ²'s own scatter, below which an excess may be noise
_RING_PX = 2.0  # on either side of the candidate's distance
_SECTOR_PX = 4.0  # of the ring, along it
_RING_QUANTILE = 0.8  # share of the ring that is lower than what counts as its height
_PATCH_PX = 5.0  # around the candidate, which is its own


@dataclass(frozen=True)
class Described:
    """How well a fit describes its region: what it explains, and its misfit."""

    snr: float
    excess: float

    @classmethod
    def of(cls, snr: float, chi2_reduced: float, n_pixels: int) -> Described:
        """Make it of a fit."""
        return cls(snr, _significant((chi2_reduced - 1) * n_pixels, n_pixels))

    def is_dwarfed(self, others: Iterable[Described]) -> bool:
        """Whether it explains less than it leaves over, beside a particle that is far brighter.

        A model that is wrong leaves the same share of every particle, which the brighter one shows:
        so much of the excess is the particle's own.
        """
        brightest = max(others, key=lambda other: other.snr, default=self)
        own = brightest.excess * (self.snr / brightest.snr) ** 2 if brightest.snr else 0.0
        return brightest.snr > DOMINANT_RATIO * self.snr and self.snr**2 < EXPLAINS * (
            self.excess - own
        )


def is_hidden(snr: float, size: float) -> bool:
    """Whether a candidate is too low to be listed, even as a side lobe."""
    return abs(snr) <= LISTED * size


def chi2_excess(residuals: NDArray[Any]) -> float:
    """Measure the misfit of a fit."""
    n = int(np.count_nonzero(np.isfinite(residuals)))
    return _significant(float(np.nansum(residuals**2)) - n, n)


def _significant(excess: float, n_pixels: int) -> float:
    """Excess of χ², 0 where it may be noise."""
    return excess if excess > _EXCESS_SIGMAS * math.sqrt(2 * n_pixels) else 0.0


def size_on_ring(
    snr: NDArray[Any],
    centre: tuple[float, float],
    place: tuple[float, float],
    others: ArrayLike = (),
) -> float:
    """Give how high the map rises at a candidate's distance from a particle, beside its own peak.

    The highest peak there may be another particle that is not known yet, and a fifth of what is
    then left of the ring may be higher, for more: a misfit rises all around.

    Shapes: `snr` (y, x), `others` (n, 2), their x and y.
    """
    (x0, y0), (xc, yc) = centre, place
    distance = max(math.hypot(xc - x0, yc - y0), _RING_PX)
    reach = 2 * (distance + _RING_PX)  # farther away, others share no pixels with the ring
    known = np.asarray(others, dtype=np.float64).reshape(-1, 2)
    near = known[np.hypot(known[:, 0] - x0, known[:, 1] - y0) < reach]
    highest = np.empty(max(8, round(2 * math.pi * distance / _SECTOR_PX)))
    ring_heights(
        snr, (float(x0), float(y0)), (float(xc), float(yc)), _RING_PX, _PATCH_PX, near, highest
    )
    seen = np.sort(highest[highest >= 0])
    if not seen.size:
        return 0.0
    return float(np.interp(_RING_QUANTILE * (seen.size - 1), np.arange(seen.size), seen))
