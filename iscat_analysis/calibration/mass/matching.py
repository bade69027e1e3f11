"""Assign peaks to standards, or say why no assignment fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.calibration.mass.line import Line
from iscat_analysis.calibration.mass.peaks import ContrastPeak
from iscat_analysis.errors import DataError
from iscat_analysis.records import FloatArray
from iscat_analysis.units import count

LEAST_PROBABILITY = 1e-4
"""A line whose χ² is less probable than this does not fit its standards."""

OFFSET_SHARE = 0.35
"""Largest contrast at zero mass, over the contrast of the lightest peak."""

_FITTING_DISTANCE = 0.05  # largest relative distance of a standard that a message says to fit
_NAMED_DISTANCE = 0.2  # largest relative distance of a peak from where somebody says it is
_MOST_STANDARDS = 8  # with more, no subsets are tried for a message


def match(peaks: Sequence[ContrastPeak], masses: FloatArray, name: str) -> list[ContrastPeak]:
    """Choose the peaks that are nearest to the standards on a line with a small offset.

    Shapes: `masses` (n,).
    """
    if len(peaks) < masses.size:
        raise DataError(
            f"{name}: {_found(peaks)}, fewer than the {masses.size} standards {_shown(masses)}; "
            f"{_advice(peaks, masses)}"
        )
    return _nearest(peaks, masses)[0]


def pick(
    peaks: Sequence[ContrastPeak], contrasts: FloatArray, masses: FloatArray, name: str
) -> list[ContrastPeak]:
    """Choose the peaks that somebody has named, by about where they are.

    Shapes: `contrasts, masses` (n,).
    """
    chosen: list[ContrastPeak] = []
    for contrast, mass in zip(contrasts, masses, strict=True):
        nearest = min(peaks, key=lambda peak: abs(peak.contrast - contrast), default=None)
        off = math.inf if nearest is None else abs(nearest.contrast / contrast - 1)
        if nearest is None or off > _NAMED_DISTANCE or nearest in chosen:
            raise DataError(
                f"{name}: the standard of {mass:g} kDa has no peak of its own near |contrast| = "
                f"{contrast:.3g} ({_found(peaks)}); name other peaks"
            )
        chosen.append(nearest)
    return chosen


def check_match(
    line: Line,
    chosen: Sequence[ContrastPeak],
    peaks: Sequence[ContrastPeak],
    masses: FloatArray,
    name: str,
) -> None:
    """Refuse a line whose χ² is too large, or whose offset is too far from zero.

    Shapes: `masses` (n,).
    """
    contrast = np.array([peak.contrast for peak in chosen])
    slope, offset = abs(line.slope), math.copysign(1.0, line.slope) * line.intercept
    off = (contrast - offset) / slope / masses - 1
    worst = int(np.argmax(np.abs(off)))
    start = f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
    if line.dof and float(chdtrc(line.dof, line.chi2)) < LEAST_PROBABILITY:
        raise DataError(
            f"{start}the nearest line misses {masses[worst]:g} kDa by "
            f"{100 * abs(off[worst]):.1f} %, with χ² = {line.chi2:.3g} for "
            f"{count(line.dof, 'degree')} of freedom; {_advice(peaks, masses)}"
        )
    if abs(offset) > OFFSET_SHARE * contrast[0]:
        raise DataError(
            f"{start}zero mass would have the contrast {offset:.2g}, more than {OFFSET_SHARE:g} of "
            f"that of the lightest standard; {_advice(peaks, masses)}"
        )


def _nearest(peaks: Sequence[ContrastPeak], masses: FloatArray) -> tuple[list[ContrastPeak], float]:
    """Choose peaks for the standards, and give their total distance from the line."""
    most = max(peak.count for peak in peaks)
    best, least = list(peaks[: masses.size]), math.inf
    for chosen in combinations(peaks, int(masses.size)):
        contrast = np.array([peak.contrast for peak in chosen])
        slope, offset = np.polyfit(masses, contrast, 1, w=1 / contrast)
        if slope <= 0:
            continue
        off = (contrast - offset) / slope / masses - 1
        cost = float(np.sum((off / 0.02) ** 2)) + (offset / (0.15 * contrast[0])) ** 2
        cost -= 2 * sum(math.log(peak.count / most) for peak in chosen)
        if cost < least:
            best, least = list(chosen), cost
    return best, least


def _advice(peaks: Sequence[ContrastPeak], masses: FloatArray) -> str:
    """Name the standards that fit the peaks and those that do not."""
    known = _fitting(peaks, masses) if masses.size <= _MOST_STANDARDS else None
    if known is None:
        return "name the standards that are in the sample"
    others = masses[~np.isin(masses, known)]
    verb = "does not" if others.size == 1 else "do not"
    return f"{_shown(known)} would fit, {_shown(others)} {verb}: leave out what is not there"


def _fitting(peaks: Sequence[ContrastPeak], masses: FloatArray) -> FloatArray | None:
    """Find the largest part of the standards, two at least, that lies on a line through peaks."""
    for size in range(min(int(masses.size) - 1, len(peaks)), 1, -1):
        fits: list[tuple[float, FloatArray]] = []
        for part in combinations(masses.tolist(), size):
            some = np.array(part)
            chosen, cost = _nearest(peaks, some)
            contrast = np.array([peak.contrast for peak in chosen])
            slope, offset = np.polyfit(some, contrast, 1, w=1 / contrast)
            off = np.abs((contrast - offset) / slope / some - 1).max() if slope > 0 else math.inf
            if off < _FITTING_DISTANCE and abs(offset) < OFFSET_SHARE * contrast[0]:
                fits.append((cost, some))
        if fits:
            return min(fits, key=lambda fit: fit[0])[1]
    return None


def _found(peaks: Sequence[ContrastPeak]) -> str:
    if not peaks:
        return "no peak of |contrast| stands out"
    places = ", ".join(f"{peak.contrast:.3g}" for peak in peaks)
    return f"|contrast| peaks at {places}"


def _shown(masses: FloatArray) -> str:
    return ", ".join(f"{mass:g}" for mass in masses) + " kDa"
