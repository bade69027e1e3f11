"""Findings about planned experiments, and about what a model does not describe."""

from __future__ import annotations

from iscat_analysis.findings.registry import Severity, define

SATURATED_PLAN = define(
    "saturated-plan",
    Severity.FAULT,
    "the brightest pixel expects {peak_e:.3g} e per frame, above camera.well_depth_e = "
    "{well_depth_e:.3g}",
    "lower bounds.photons_per_pixel",
    "howto/planning",
)

COARSE_SAMPLING = define(
    "coarse-sampling",
    Severity.CAUTION,
    "pixels of {pixel_nm:g} nm sampled at their centres count more light than was collected",
    'set camera.samples_per_pixel = "auto"',
    "howto/planning",
)

FAINT_PICTURES = define(
    "faint-pictures",
    Severity.CAUTION,
    "one picture has a signal-to-noise ratio of {snr:.2g}, and iscat calibrate optics uses those "
    "above {least:g}",
    "take heavier particles, more frames, or more light",
    "howto/planning",
)

PICTURES_LEFT_OUT = define(
    "pictures-left-out",
    Severity.NOTE,
    "of {events} pictures iscat calibrate optics uses the {used} brightest",
    "",
    "howto/planning",
)
