"""The configuration: where it is from, and what a study of it leaves out."""

from __future__ import annotations

from iscat_analysis.findings.registry import Severity, define

CONFIGURATION_MERGED = define(
    "configuration-merged",
    Severity.NOTE,
    "the configuration is {first}, with the keys of {others}",
    page="reference/configuration",
)
CONFIGURATION_BESIDE = define(
    "configuration-beside",
    Severity.NOTE,
    "the configuration is {path}, which lies beside the movie",
    page="howto/tiff",
)
LIGHT_HELD = define(
    "light-held",
    Severity.NOTE,
    "the light on the particle is held: bounds.photons_per_pixel follows {axis}",
)
OFFSET_LEFT_OUT = define(
    "offset-left-out",
    Severity.CAUTION,
    "calibration.offset is left out, because it belongs to the configured optics: σ of the mass is "
    "that of a mass proportional to the field",
)
AMBIGUOUS_FITS = define(
    "ambiguous-fits",
    Severity.CAUTION,
    "mode {mode}: {ambiguous} of {trials} fits have the status {status} and are left out of bias "
    "and spread: several {several} describe the pixels about as well",
    "use more photons or frames (bounds.photons_per_pixel, bounds.n_after), or a narrower {key}",
)
