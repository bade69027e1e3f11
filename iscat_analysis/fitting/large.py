"""Particles of a field or a chunk that are no dipoles, and the spheres that describe them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import gaussian_filter

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Fitted
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.recognition import may_be_large, recognised
from iscat_analysis.records import FloatArray

AnyFitted = TypeVar("AnyFitted", bound=Fitted)

IN_VAIN = 8
"""Particles, the brightest first, after which no others are tried if none is a sphere."""

BRIGHT_SNR = 50.0
"""Signal-to-noise ratio below which a sphere differs too little from a dipole to be seen."""


def with_spheres(
    context: AnalysisContext, events: Sequence[AnyFitted], pool: ThreadPoolExecutor, *, level: bool
) -> list[AnyFitted]:
    """Fit spheres where dipoles fail.

    Where the microscope is wrong, all fits are poor and no sphere describes any.
    """

    def tried(event: AnyFitted) -> AnyFitted | None:
        models = context.spheres_of(event.likelihood.model)
        z_range = context.config.fit.z_range_nm
        found = recognised(event.likelihood, event.fit, models, z_range, level=level)
        return None if found is None else replace(event, likelihood=found[0], fit=found[1])

    out = [*events]
    doubtful = [
        index
        for index, event in enumerate(events)
        if not event.sphere
        and may_be_large(event.likelihood, event.fit)
        and context.spheres_of(event.likelihood.model)
    ]
    doubtful.sort(key=lambda index: -events[index].snr)
    for first in range(0, len(doubtful), IN_VAIN):
        batch = doubtful[first : first + IN_VAIN]
        found = list(pool.map(tried, [events[i] for i in batch]))
        for index, event in zip(batch, found, strict=True):
            if event is not None:
                out[index] = event
        if not any(found):
            break
    return out


def brightest_place(
    likelihood: Likelihood,
    explained: FloatArray,
    seen: Sequence[tuple[float, float]],
    apart_px: float,
) -> tuple[float, float] | None:
    """Find where the light of a field changes most, column and row, if a misfit could be seen.

    Energy is averaged over a spot of the size of the diffraction limit, so that a ring counts as
    one place.

    Shapes: `explained` (y, x).
    """
    grid, optics = likelihood.grid, likelihood.model.optics
    left = np.nan_to_num(likelihood.measured_signal() - explained)
    excess = np.where(likelihood.used, left**2 * likelihood.signal_information(explained) - 1, 0.0)
    spot_px = optics.wavelength_nm / optics.na / grid.pixel_nm
    energy = gaussian_filter(excess, spot_px) * (2 * math.pi * spot_px**2)
    rows, columns = np.indices(energy.shape)
    for x, y in seen:
        energy[np.hypot(rows - y, columns - x) < apart_px] = 0.0
    row, column = np.unravel_index(np.argmax(energy), energy.shape)
    if energy[row, column] < BRIGHT_SNR**2:
        return None
    return float(column), float(row)
