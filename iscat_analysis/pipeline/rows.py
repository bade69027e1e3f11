"""The rows of ``fits.csv``: fits get their errors from all that is known of them together, at once.

A fit knows the error of its own likelihood.  What calibrations may be wrong by, what its frames
show elsewhere, and how the spread of all fits compares with the bound is known when all are there;
only then a row is made, and with ``fit.sigma = "measured"`` its σ is the measured one from the
beginning.
"""

from __future__ import annotations

import pandas as pd

from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.records import FloatArray
from iscat_analysis.tracking.tracked_optics import mass_error
from iscat_analysis.trust.empirical_spread import measure_spread, measured_scale, repeat_columns
from iscat_analysis.trust.heights import Heights
from iscat_analysis.trust.systematic import systematic


def reported_rows(
    found: DetectionResult, heights: Heights | None
) -> tuple[pd.DataFrame, dict[str, EmpiricalSpread]]:
    """Make the rows of all events of a movie."""
    fits, config, mode = found.fits, found.scene.config, found.scene.mode
    achieved = measure_spread(mode, fits, found.repeats, found.empty) if found.repeats else {}
    scale = measured_scale(achieved) if config.fit.sigma == "measured" else {}
    columns: dict[str, pd.Series | FloatArray] = {}
    for name in fits:
        columns[name] = fits[name] * scale[name] if name in scale else fits[name]
        if name == "flags":
            shared = systematic(
                config, fits, mass_error(found.optics), found.scene.model.scale,
                None if heights is None else heights.mass_shift_kda,
            )  # fmt: skip
            columns |= {f"systematic_{key}": sigma for key, sigma in shared.items()}
    if found.repeats:
        columns |= repeat_columns(mode, fits, found.repeats)
    return pd.DataFrame(columns), achieved
