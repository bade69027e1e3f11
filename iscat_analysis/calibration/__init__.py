"""Contrast becomes mass: a line through standards, with errors in both coordinates.

The calibration is odd-symmetric, so that a particle has the same mass when it lands and when it
leaves: a landing particle of mass m has the contrast c = s·m + o, a leaving one −c.  If landing
darkens (s < 0), this is m = sign(−c)·(−|c| − o)/s, as in Refeyn's programs.  A straight line
through both branches is wrong by 2|o/s| for one of them.

Peaks are fitted to events, not to bins: a normal distribution on a flat background, by maximum
likelihood inside the peak's own window.  The line through the peaks is that of York et al., Am. J.
Phys. 72, 367 (2004).

`line` finds the peaks, assigns them to standards, fits the line, converts contrasts and stores the
optics of the measurement.
"""

from __future__ import annotations

from iscat_analysis.calibration.line import (
    LEAST_EVENTS,
    STANDARD_ERROR,
    ContrastPeak,
    Landing,
    Line,
    MassCalibration,
    as_given,
    calibrate_mass,
    contrast_over,
    find_contrast_peaks,
    line_sigma_kda,
    mass_from_contrast,
    standards_of,
    with_standards,
    york_line,
)
