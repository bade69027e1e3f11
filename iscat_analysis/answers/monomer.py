"""Which peak of a series of tables is the monomer, where the user does not say."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks, peak_prominences

from iscat_analysis.errors import DataError
from iscat_analysis.species.tables import EventTable

_POSSIBLE_PEAKS = (0.0, 11.5)  # ln of masses in kDa
_PEAK_POINTS = 2000
_SMOOTHING = 0.07  # of ln m: a third of what keeps peaks at m and 2 m apart
_LEAST_PEAK = 0.05  # prominence of a peak, over the height of the highest
_CLEAR_PEAK = 4.0  # the same in standard errors
_NEAR_TWICE = 0.16  # of ln m: the lighter peak is shifted where much of it is missed


def monomer_of(tables: Sequence[EventTable]) -> tuple[float, str]:
    """Find the monomer in the events of all tables, and say what was taken.

    Every table counts alike.  Two peaks of the density of ln m, one at about twice the other, are
    monomers and dimers; of several such pairs the one with most events is taken.
    """
    points = np.linspace(*_POSSIBLE_PEAKS, _PEAK_POINTS)
    step = points[1] - points[0]
    edges = np.append(points - step / 2, points[-1] + step / 2)
    logs = [np.log(np.abs(table.mass_kda)) for table in tables]
    shares = [np.histogram(one, edges)[0] / one.size for one in logs]
    density = gaussian_filter1d(np.mean(shares, axis=0), _SMOOTHING / step)
    events = sum(one.size for one in logs)
    # A peak of few events is noise: those under its kernel have the error of counts.
    noise = np.sqrt(density * step / (2 * math.sqrt(math.pi) * _SMOOTHING) / events)
    found = find_peaks(density)[0]
    prominent = peak_prominences(density, found)[0]
    clear = (prominent > _LEAST_PEAK * density.max()) & (prominent > _CLEAR_PEAK * noise[found])
    masses, heights = np.exp(points[found[clear]]), density[found[clear]]
    pairs = [
        (heights[one] + heights[two], one, two)
        for one in range(masses.size)
        for two in range(one + 1, masses.size)
        if abs(math.log(masses[two] / (2 * masses[one]))) < _NEAR_TWICE
    ]
    if not pairs:
        seen = ", ".join(f"{mass:.3g}" for mass in masses) or "none"
        raise DataError(
            f"{tables[0].name}: which peak of the series is the monomer cannot be told: none lies "
            f"at twice the mass of another (peaks at {seen} kDa); give `masses_kda`"
        )
    _, one, two = max(pairs)
    # The dimer's peak is whole where that of the monomer may be cut by what is missed.
    monomer = float(masses[two]) / 2
    return monomer, (
        f"the monomer was taken for the peak at {masses[one]:.3g} kDa, its dimer for that at "
        f"{masses[two]:.3g} kDa; `masses_kda` names another"
    )
