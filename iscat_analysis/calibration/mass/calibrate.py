"""From the contrasts of standards to the line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from iscat_analysis.calibration.mass.line import york_line
from iscat_analysis.calibration.mass.matching import check_match, match, pick
from iscat_analysis.calibration.mass.peaks import ContrastPeak, find_contrast_peaks
from iscat_analysis.calibration.mass.result import Landing, MassCalibration
from iscat_analysis.errors import ConfigError, DataError, SignError
from iscat_analysis.records import FloatArray

STANDARD_ERROR = 0.01
"""Relative uncertainty of a standard's mass if none is given: sequence, glycans, density."""

LEAST_EVENTS = 30
"""Fewest events for a histogram."""

_LANDING_SHARE = 0.4
_CONTRAST_PER_KDA = (3e-7, 1.5e-3)
# Contrast per kDa of any microscope: 3e-5 in visible light, up to 30 times as much if a mask dims
# the reference; less for dense metals, and at long wavelengths if the reference is not dimmed.
_LIGHTEST_KDA = 10.0  # lighter than any standard that can be detected
_KERNEL_WIDTHS = (1.0, 2.0, 4.0, 0.5)


def calibrate_mass(
    contrasts: ArrayLike,
    standards_kda: Sequence[float],
    *,
    standards_se_kda: Sequence[float] | None = None,
    peaks_at: Sequence[float] | None = None,
    sigmas: ArrayLike | None = None,
    landing: Landing = "dark",
    name: str = "the events",
) -> MassCalibration:
    """Calibrate contrast against the masses of standards.

    Which peak is whose is found, unless `peaks_at` says about which |contrast| each standard has.

    Shapes: `contrasts` (n,), `sigmas` (n,).
    """
    masses, masses_se = _standards(standards_kda, standards_se_kda)
    named = None if peaks_at is None else _places(peaks_at, standards_kda)
    signed = np.asarray(contrasts, dtype=np.float64)
    errors = np.zeros(signed.shape) if sigmas is None else np.asarray(sigmas, dtype=np.float64)
    finite = np.isfinite(signed) & np.isfinite(errors) & (signed != 0)
    signed, errors = signed[finite], errors[finite]
    direction = -1.0 if landing == "dark" else 1.0
    lands = direction * signed > 0
    if signed.size >= LEAST_EVENTS and lands.mean() < _LANDING_SHARE:
        other = "bright" if landing == "dark" else "dark"
        raise SignError(
            f"{name}: only {lands.sum()} of {signed.size} events are {landing}, which landing "
            f"should be: the contrast has the wrong sign; if your particles land {other}",
            f"say `landing` = {other}",
        )
    size, size_errors = np.abs(signed[lands]), errors[lands]
    if size.size < LEAST_EVENTS:
        raise DataError(
            f"{name}: holds {size.size} landing events; a calibration needs {LEAST_EVENTS} or more"
        )
    # The kernel's width follows the spread of the whole histogram.  It is too wide for few events
    # in narrow peaks far apart, which need finer kernels.  A dozen events in a peak exceed three
    # standard errors only with a kernel as wide as the peak, the coarser one.  Trying several
    # kernels hardly accepts more wrong standards (3 in 100 random ones, with twelve events each),
    # since a line through other peaks must meet the same limits.
    refusals: list[tuple[int, DataError]] = []
    for detail in _KERNEL_WIDTHS:
        peaks = find_contrast_peaks(size, size_errors, detail=detail)
        try:
            chosen = (
                match(peaks, masses, name) if named is None else pick(peaks, named, masses, name)
            )
            line = york_line(
                masses,
                masses_se,
                [direction * p.contrast for p in chosen],
                [p.contrast_se for p in chosen],
            )
            check_match(line, chosen, peaks, masses, name)
            break
        except DataError as refusal:
            refusals.append((len(peaks), refusal))
    else:  # the clearest view is the one that shows most peaks
        raise max(refusals, key=lambda each: each[0])[1]
    _refuse_unlikely(line.slope, float(size.max()), masses, name)
    widen = max(1.0, line.chi2 / line.dof) if line.dof else 1.0
    notes = []
    if widen > 1:
        notes.append(
            f"the standards scatter about the line by more than their errors (χ²/dof = "
            f"{widen:.3g}); its uncertainty is widened by {math.sqrt(widen):.3g}"
        )
    if not line.dof:
        notes.append("two standards fix a line but cannot test it; a third would")
    result = MassCalibration(
        gradient_per_kda=line.slope,
        offset=line.intercept,
        covariance=line.covariance * widen,
        chi2=line.chi2,
        dof=line.dof,
        standards=pd.DataFrame(),
        peaks=tuple(peaks),
        landing=landing,
        events=int(size.size),
        notes=tuple(notes),
    )
    return replace(result, standards=_table(result, chosen, masses, masses_se, direction))


def _standards(
    masses: Sequence[float], errors: Sequence[float] | None
) -> tuple[FloatArray, FloatArray]:
    values = np.asarray(masses, dtype=np.float64)
    shown = ",".join(f"{m:g}" for m in values)
    if values.size < 2 or not np.isfinite(values).all() or (values <= 0).any():
        raise ConfigError(
            f"`standards_kda` = {shown}: a line needs two or more positive masses in kDa, as in "
            "66,146,480"
        )
    if np.unique(values).size < values.size:
        raise ConfigError(f"`standards_kda` = {shown}: names a mass twice")
    se = STANDARD_ERROR * values if errors is None else np.asarray(errors, dtype=np.float64)
    if se.shape != values.shape or not np.isfinite(se).all() or (se < 0).any():
        raise ConfigError(
            f"`standards_kda` = {shown}: needs one error, not negative, for each mass"
        )
    order = np.argsort(values)
    return values[order], se[order]


def _places(contrasts: Sequence[float], masses: Sequence[float]) -> FloatArray:
    """Check where peaks are said to be, and put them into the order of the masses."""
    places = np.abs(np.asarray(contrasts, dtype=np.float64))
    if places.shape != np.shape(masses) or not np.isfinite(places).all() or not places.all():
        raise ConfigError("`peaks_at`: needs the |contrast| of one peak for each standard")
    return np.asarray(places[np.argsort(np.asarray(masses, dtype=np.float64))])


def _refuse_unlikely(slope: float, largest: float, masses: FloatArray, name: str) -> None:
    """Refuse a line that no microscope can have, which shows that a unit is wrong."""
    low, high = _CONTRAST_PER_KDA
    if low <= abs(slope) <= high:
        return
    shown = ",".join(f"{m:g}" for m in masses)
    problem = (
        f"{name}: the line through the standards has a contrast of {abs(slope):.2g} per kDa, where "
        f"microscopes have {low:g} to {high:g}: "
    )
    if abs(slope) < low:
        raise DataError(
            f"{problem}`standards_kda` = {shown} seem to be in Da; give them in kDa, as 66,146,480"
        )
    if masses.max() < _LIGHTEST_KDA:
        raise DataError(
            f"{problem}`standards_kda` = {shown} seem to be in MDa; give them in kDa, as 66,146,480"
        )
    raise DataError(
        f"{problem}contrasts, of up to {largest:.3g}, seem to be in per cent; divide them by 100"
    )


def _table(
    calibration: MassCalibration,
    chosen: Sequence[ContrastPeak],
    masses: FloatArray,
    masses_se: FloatArray,
    direction: float,
) -> pd.DataFrame:
    contrast = direction * np.array([peak.contrast for peak in chosen])
    errors = np.array([peak.contrast_se for peak in chosen])
    mass = calibration.mass_kda(contrast)
    low, high = calibration.prediction_interval(contrast, errors)
    return pd.DataFrame(
        {
            "mass_kda": masses,
            "mass_se": masses_se,
            "contrast": contrast,
            "contrast_se": errors,
            "width": [peak.width for peak in chosen],
            "count": [peak.count for peak in chosen],
            "found_kda": mass,
            "residual_percent": 100 * (mass / masses - 1),
            "low_kda": low,
            "high_kda": high,
        }
    )
