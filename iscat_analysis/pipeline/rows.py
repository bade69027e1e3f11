"""The rows of ``fits.csv``, made when all events are known.

A fit knows the error of its own likelihood.  Calibration errors, the spread of an event's own
frames and the ratio of the measured spread to the bound follow from all events together.  With
``fit.sigma = "measured"`` the σ in a row is already the measured one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.records import (
    FREE_PARAMETERS,
    BoolArray,
    FloatArray,
    Status,
    flagged,
    make_rows,
    with_diameters,
)
from iscat_analysis.trust.budget import SCALE, SPHERES, budget_of
from iscat_analysis.trust.changing_light import at_a_shared_place, in_parts, may_rise, rise_message
from iscat_analysis.trust.empirical_spread import measure_spread, measured_scale, repeat_columns
from iscat_analysis.trust.extension import Extension
from iscat_analysis.trust.fluctuation import Fluctuation
from iscat_analysis.trust.heights import Heights
from iscat_analysis.trust.pairs import told_as_pairs, with_masses_of_pairs
from iscat_analysis.trust.systematic import contributions, misfit_error, total


@dataclass(frozen=True)
class ReportedRows:
    """The rows of all events of a movie, and what all events together say."""

    table: pd.DataFrame
    achieved: Mapping[str, EmpiricalSpread]
    budget: list[dict[str, Any]]
    heights: Heights | None = None
    extension: Extension | None = None
    fluctuation: Fluctuation | None = None
    changing_light: str = ""


def reported_rows(
    found: DetectionResult,
    *,
    optics: Mapping[str, Any] = MappingProxyType({}),
    camera: Mapping[str, Any] | None = None,
) -> ReportedRows:
    """Make the rows of all events of a movie, `optics` and `camera` as the summary has them."""
    fits, config, mode = found.fits, found.context.config, found.context.mode
    learned = bool(optics.get("calibrated"))
    achieved = measure_spread(mode, fits, found.repeats, found.empty) if found.repeats else {}
    evidence, heights, extension = None, None, None
    if found.evidence is not None and len(found.evidence):
        evidence = Evidence(*found.evidence.T)
        heights = Heights.of(config, fits, evidence, learned_optics=learned)
        if heights is None or not heights.are_wrong:  # which would look like widths
            extension = Extension.of(config, fits, evidence, achieved, learned_optics=learned)
    if extension is not None and config.fit.pairs:
        paired = told_as_pairs(fits, extension)
        fits, extension = with_masses_of_pairs(fits, paired), extension.without(paired)
    shifts = {
        name: finding.mass_shift_kda
        for name, finding in (("heights", heights), ("extension", extension))
        if finding is not None
    }
    if extension is not None:
        fits = flagged(fits, Status.EXTENDED, extension.flagged)
    changing_light = ""
    shared_place = np.zeros(len(fits), dtype=bool)
    resolution_nm = config.optics.wavelength_nm / config.optics.na
    if found.heading == "landing":
        shared_place = at_a_shared_place(fits, resolution_nm)
        fits = flagged(fits, Status.CHANGING, shared_place)
        if evidence is not None:
            parts = in_parts(fits, evidence.rise_frames)
            fits = flagged(fits, Status.CHANGING, parts)
            fits, changing_light = _with_changing(fits, evidence, shared_place)
            shared_place |= parts
    scale = measured_scale(achieved) if config.fit.sigma == "measured" else {}
    fluctuation = None
    if not scale:  # which has all that the frames show
        fluctuation = Fluctuation.of(mode, found.fits, found.repeats, achieved, shared_place)
    if fluctuation is not None:
        if found.heading == "landing" and fluctuation.is_seen:
            wide = at_a_shared_place(fits, resolution_nm, fluctuation.relative)
            fits = flagged(fits, Status.CHANGING, wide)
        sigma = np.sqrt(fits["sigma_mass_kda"] ** 2 + fluctuation.variance_kda2)
        fits = fits.assign(sigma_mass_kda=sigma)
    columns: dict[str, pd.Series | FloatArray] = {
        name: fits[name] * factor for name, factor in scale.items()
    }
    if mode == "track":
        from iscat_analysis.tracking.tracked_optics import mass_error

        unfit = mass_error(optics)
    if mode != "track" or not optics:  # the optics were not tested
        unfit = misfit_error(fits, found.context.roi_px**2)
    threshold = 0.0 if mode == "track" else found.context.templates.threshold
    doubt = None if learned else optics.get("doubt")
    shared = contributions(
        config, fits, unfit, found.context.model.scale, shifts, camera, threshold, doubt
    )
    columns |= {f"systematic_{name}": error for name, error in total(shared, len(fits)).items()}
    if found.repeats:
        columns |= repeat_columns(mode, fits, found.repeats)
    table = make_rows(fits, columns)
    if mode == "mass":  # what is no dipole has no mass, and no error of one
        kinds = table.columns.intersection(["repeat_mass_kda", "systematic_mass_kda"])
        table[kinds] = table[kinds].where(table["mass_kda"].notna(), np.nan, axis=0)
    if config.fits_sizes:
        table = with_diameters(table, config.particle.density)
    unknown = SPHERES if config.fits_sizes else SCALE if config.calibration is None else None
    budget = (
        budget_of(table, shared, achieved, unknown=unknown, scaled=config.fit.sigma == "measured")
        if "mass_kda" in FREE_PARAMETERS[mode]
        else []
    )
    return ReportedRows(table, achieved, budget, heights, extension, fluctuation, changing_light)


def _with_changing(
    fits: pd.DataFrame, evidence: Evidence, shared_place: BoolArray
) -> tuple[pd.DataFrame, str]:
    """Flag steps whose light may still be changing, and describe that in a message."""
    unseen, frames = may_rise(fits, evidence, shared_place)
    rising = int((~shared_place & (np.nan_to_num(evidence.rise_frames) > 0)).sum())
    text = rise_message(frames, int(unseen.sum()), rising, len(fits))
    return flagged(fits, Status.CHANGING, unseen), text
