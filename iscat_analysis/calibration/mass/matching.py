"""Which peak belongs to which standard, and whether any do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from iscat_analysis.calibration.mass.line import Line
from iscat_analysis.calibration.mass.peaks import Peak
from iscat_analysis.errors import DataError
from iscat_analysis.records import FloatArray

_MISMATCH = 0.07  # of a standard's mass, beyond which the line does not go through the peaks
_OFFSET_SHARE = 0.35  # of the lightest peak's contrast that the offset may be


def match(peaks: Sequence[Peak], masses: FloatArray, name: str) -> list[Peak]:
    """Choose the peaks that a line with a small offset puts nearest the standards.

    Parameters
    ----------
    peaks : sequence of Peak
        By rising contrast.
    masses : ndarray, shape (n,)
        Of the standards, rising [kDa].
    name : str
        What messages call the events.

    Returns
    -------
    list of Peak
        One per standard.

    Raises
    ------
    DataError
        There are fewer peaks than standards.
    """
    if len(peaks) < masses.size:
        raise DataError(
            f"{name}: {_found(peaks)}, fewer than the {masses.size} standards "
            f"{_shown(masses)}; leave out those that are not in the sample"
        )
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
    return best


def check_match(
    line: Line, chosen: Sequence[Peak], peaks: Sequence[Peak], masses: FloatArray, name: str
) -> None:
    """Refuse a line that misses its standards, or does not begin near zero.

    Parameters
    ----------
    line : Line
        Signed contrast against mass.
    chosen : sequence of Peak
        One per standard.
    peaks : sequence of Peak
        All that were found.
    masses : ndarray, shape (n,)
        Of the standards [kDa].
    name : str
        What messages call the events.

    Raises
    ------
    DataError
        It does.
    """
    contrast = np.array([peak.contrast for peak in chosen])
    slope, offset = abs(line.slope), math.copysign(1.0, line.slope) * line.intercept
    off = (contrast - offset) / slope / masses - 1
    worst = int(np.argmax(np.abs(off)))
    remedy = "correct --standards, or leave out what is not in the sample"
    if abs(off[worst]) > _MISMATCH:
        raise DataError(
            f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
            f"the nearest line misses {masses[worst]:g} kDa by {100 * abs(off[worst]):.0f} %; "
            f"{remedy}"
        )
    if abs(offset) > _OFFSET_SHARE * contrast[0]:
        raise DataError(
            f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
            f"zero mass would have the contrast {offset:.2g}; {remedy}"
        )


def _found(peaks: Sequence[Peak]) -> str:
    if not peaks:
        return "no peak of |contrast| stands out"
    places = ", ".join(f"{peak.contrast:.3g}" for peak in peaks)
    return f"|contrast| peaks at {places}"


def _shown(masses: FloatArray) -> str:
    return ", ".join(f"{mass:g}" for mass in masses) + " kDa"
