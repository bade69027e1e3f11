"""Contrast becomes mass: a line through standards, with errors in both coordinates.

The calibration is odd-symmetric, so that a particle that leaves weighs what it weighed when it
landed: a landing particle of mass m has the contrast c = s·m + o, a leaving one −c.  Where landing
darkens (s < 0) that is m = sign(−c)·(−|c| − o)/s, as Refeyn's programs have it.  A plain line
through both branches is wrong by 2|o/s| on one of them.

Peaks are fitted to events, not to bins: a normal distribution on a flat background, by maximum
likelihood inside the peak's own window.  The line through the peaks is that of York et al., Am. J.
Phys. 72, 367 (2004).

`calibrate` is the whole of it: `peaks` finds them, `matching` says which belongs to which standard,
`line` fits, and `result` converts.  `standards` keeps with what optics all that was measured.
"""

from __future__ import annotations

from iscat_analysis.calibration.mass.calibrate import LEAST_EVENTS, STANDARD_ERROR, calibrate_mass
from iscat_analysis.calibration.mass.line import Line, york_line
from iscat_analysis.calibration.mass.peaks import ContrastPeak, find_contrast_peaks
from iscat_analysis.calibration.mass.result import (
    Landing,
    MassCalibration,
    line_sigma_kda,
    mass_from_contrast,
)
from iscat_analysis.calibration.mass.standards import (
    Standards,
    as_given,
    contrast_over,
    standards_of,
    with_standards,
)

__all__ = [
    "LEAST_EVENTS",
    "STANDARD_ERROR",
    "ContrastPeak",
    "Landing",
    "Line",
    "MassCalibration",
    "Standards",
    "as_given",
    "calibrate_mass",
    "contrast_over",
    "find_contrast_peaks",
    "line_sigma_kda",
    "mass_from_contrast",
    "standards_of",
    "with_standards",
    "york_line",
]
