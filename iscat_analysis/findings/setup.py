"""The configuration: where it is from, and what its study or a planned experiment leaves out."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

note, caution, fault = makers(Subject.CAMERA)

CONFIGURATION_MERGED = note(
    "configuration-merged",
    "the configuration is {first}, with the keys of {others}",
    page="reference/configuration",
)
CONFIGURATION_BESIDE = note(
    "configuration-beside",
    "the configuration is {path}, which lies beside the movie",
    page="howto/tiff",
)
LIGHT_HELD = note(
    "light-held", "the light on the particle is held: bounds.photons_per_pixel follows {axis}"
)
OFFSET_LEFT_OUT = caution(
    "offset-left-out",
    "calibration.offset is left out, because it belongs to the configured optics: σ of the mass is "
    "that of a mass proportional to the field",
    subject=Subject.SCALE,
)
AMBIGUOUS_FITS = caution(
    "ambiguous-fits",
    "mode {mode}: {ambiguous} of {trials} fits have the status {status} and are left out of bias "
    "and spread: several {several} describe the pixels about as well",
    "use more photons or frames (bounds.photons_per_pixel, bounds.n_after), or a narrower {key}",
    subject=Subject.OPTICS,
)

SATURATED_PLAN = fault(
    "saturated-plan",
    "the brightest pixel expects {peak_e:.3g} e per frame, above camera.well_depth_e = "
    "{well_depth_e:.3g}",
    "lower bounds.photons_per_pixel",
    "howto/planning",
)

COARSE_SAMPLING = caution(
    "coarse-sampling",
    "pixels of {pixel_nm:g} nm sampled at their centres count more light than was collected",
    'set camera.samples_per_pixel = "auto"',
    "howto/planning",
    subject=Subject.OPTICS,
)

FAINT_PICTURES = caution(
    "faint-pictures",
    "one picture has a signal-to-noise ratio of {snr:.2g}, and iscat calibrate optics uses those "
    "above {least:g}",
    "take heavier particles, more frames, or more light",
    "howto/planning",
    subject=Subject.OPTICS,
)

PICTURES_LEFT_OUT = note(
    "pictures-left-out",
    "of {events} pictures iscat calibrate optics uses the {used} brightest",
    "",
    "howto/planning",
    subject=Subject.OPTICS,
)
