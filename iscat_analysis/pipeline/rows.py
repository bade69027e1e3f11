"""The rows of ``fits.csv``: fits get their errors from all that is known of them together, at once.

A fit knows the error of its own likelihood.  What calibrations may be wrong by, what its frames
show elsewhere, and how the spread of all fits compares with the bound is known when all are there;
only then a row is made, and with ``fit.sigma = "measured"`` its σ is the measured one from the
beginning.
"""

from __future__ import annotations

from typing import Any

import pandas as pd

from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.records import FREE_PARAMETERS, FloatArray
from iscat_analysis.tracking.tracked_optics import mass_error
from iscat_analysis.trust.budget import budget_of
from iscat_analysis.trust.empirical_spread import measure_spread, measured_scale, repeat_columns
from iscat_analysis.trust.systematic import contributions, misfit_error, total


def reported_rows(
    found: DetectionResult,
) -> tuple[pd.DataFrame, dict[str, EmpiricalSpread], list[dict[str, Any]]]:
    """Make the rows of all events of a movie, and the budget of their masses."""
    fits, config, mode = found.fits, found.scene.config, found.scene.mode
    achieved = measure_spread(mode, fits, found.repeats, found.empty) if found.repeats else {}
    scale = measured_scale(achieved) if config.fit.sigma == "measured" else {}
    unfit = (
        mass_error(found.optics) if mode == "track" else misfit_error(fits, found.scene.roi_px**2)
    )
    shared = contributions(config, fits, unfit, found.scene.model.scale)
    columns: dict[str, pd.Series | FloatArray] = {}
    for name in fits:
        columns[name] = fits[name] * scale[name] if name in scale else fits[name]
        if name == "flags":
            errors = total(shared, len(fits))
            columns |= {f"systematic_{key}": sigma for key, sigma in errors.items()}
    if found.repeats:
        columns |= repeat_columns(mode, fits, found.repeats)
    table = pd.DataFrame(columns)
    budget = budget_of(
        table, shared, achieved,
        calibrated=config.calibration is not None, scaled=config.fit.sigma == "measured",
    ) if "mass_kda" in FREE_PARAMETERS[mode] else []  # fmt: skip
    return table, achieved, budget
