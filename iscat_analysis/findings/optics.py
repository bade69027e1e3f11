"""What is found of the optics, of particles that fits take for points, and of the errors."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

_, caution, _ = makers(Subject.OPTICS)

UNEQUAL_HEIGHTS = caution(
    "unequal-heights",
    "the particles are not equally high: {spread} where one height is held; their masses are wrong "
    "by what systematic_mass_kda says, and the fits of many are poor",
    'particle.height_nm = "auto" learns mean and spread and fits every height',
    "explanation/errorbar",
)

_WIDER = (
    "images are wider than a point's by a variance of ({width_nm:.1f} ± {error_nm:.1f} nm)² along "
    "each axis"
)
_TOO_SMALL = (
    "; masses are too small, and rows are flagged extended where by more than half of σ{paired}"
)

LONG_IMAGES = caution(
    "long-images",
    f"{_WIDER} and elongated, each in its own direction: particles have separate parts{_TOO_SMALL}",
    "fit.pairs = true gives the mass of two halves to rows with enough light",
)

WIDE_IMAGES = caution(
    "wide-images",
    f"{_WIDER}: particles wiggle or have separate parts, or wavelength, NA, focus or pixel size "
    "are not those configured, or the illumination is a cone, or pixels were averaged"
    f"{_TOO_SMALL}",
    "check the optics first; then set particle.wiggle_nm to it (adding squares) if all particles "
    "wiggle alike, or fit.pairs = true if they may be two halves",
)

FLUCTUATING_CONTRAST = caution(
    "fluctuating-contrast",
    "contrasts fluctuate by {percent:.2g} ± {error_percent:.1g} % while particles are there, over "
    "some {frames:g} frames: masses have the error that remains in the mean over an event's "
    "frames, and sigma_mass_kda contains it",
    subject=Subject.ERRORS,
)

SLOW_LANDINGS = caution(
    "slow-landings",
    "the light of {rising} of {rows} steps rises over some {frames} frames, which are left out of "
    "their fits{unseen}",
    subject=Subject.ERRORS,
)

UNEVEN_REFERENCE = caution(
    "uneven-reference",
    "masses of the same particles differ over the field, as with a reference whose amplitude "
    "changes from the middle to the edge by {sizes}; this is in systematic_mass_kda",
    "if it is so, set optics.reference_tilt = [{x:+.4f}, {y:+.4f}], optics.reference_curvature = "
    "{curved:+.4f} and optics.field_px = [{field}]",
)

UNDERSTATED_SIGMA = caution(
    "understated-sigma",
    "σ is too small: the measured spread is {ratios} times the Cramér–Rao bound; {cause}",
    'fit.sigma = "measured" scales σ by it',
    subject=Subject.ERRORS,
)

SCALED_SIGMA = caution(
    "scaled-sigma",
    "σ is scaled by the measured spread, {ratios} times the Cramér–Rao bound; {cause}",
    subject=Subject.ERRORS,
)

LESS_NOISE = caution(
    "less-noise",
    "the measured spread is {ratios} times the Cramér–Rao bound: there is less noise than the "
    "camera's numbers say",
    "look at camera.gain_e_per_adu and camera.read_noise_e",
    subject=Subject.ERRORS,
)

WIDE_SPECIES = caution(
    "wide-species",
    "the species {where} is wider than the budget explains: {percent:.2g} % beyond sigma (at least "
    "{least_percent:.2g} %), where the budget has {explained_percent:.2g} %: its particles differ, "
    "in height, focus over the field, shape or mass, or the light does; no error of a single row "
    "has that",
    subject=Subject.ERRORS,
)

OPTICS_LEARNED = caution(
    "optics-learned",
    "optics learned from the movie, instead of the configured ones: {headline}",
    page="howto/microscope",
)

OPTICS_AS_CONFIGURED = caution(
    "optics-as-configured",
    "{verdict}: {reason}; the analysis goes on as configured",
    page="howto/microscope",
)

OPTICS_NOT_LEARNED = caution(
    "optics-not-learned",
    "the optics are not learned {reason}; the analysis goes on as configured",
    page="howto/microscope",
)

WRONG_SIGN = caution(
    "wrong-sign-of-contrast",
    "at optics.focus_nm = {focus_nm:g} particles {shown}, where calibration.gradient_per_kda = "
    "{gradient_per_kda:g} has them {expected}",
    page="howto/focus",
)

TURNED_PHASE = caution(
    "turned-phase",
    "the phase is half a turn from the one that was found, with which particles {found} the image: "
    "by calibration.gradient_per_kda they {expected} it; if the sign of the gradient is wrong, so "
    "is the sign of every mass",
)

ODD_APERTURE = caution(
    "odd-aperture",
    "the numerical aperture differs by {difference:+.3f} from the configured one; pixels of about "
    "{pixel_nm:.1f} nm instead of {configured_nm:g} nm would explain the pictures as well",
    "check camera.pixel_size_nm",
)

UNTOLD_OPTICS = caution(
    "untold-optics",
    "the pictures tell little or nothing of {names}: what is configured and its usual error "
    "([uncertainty] optics) count, which is part of the error of all masses",
)

UNDECIDED_OPTICS = caution(
    "undecided-optics",
    "the pictures do not tell {name} = true from false; it stays as configured (particles of "
    "higher contrast would tell)",
)

DROPPED_TERMS = caution("dropped-terms", "{names} did not improve {pictures} and are 0")

PICTURES_LEFT_OUT = caution(
    "contaminated-pictures", "{pictures} left out, because something else happened there"
)

TWIN_OPTICS = caution(
    "twin-optics",
    "a twin with focus {focus_nm:.1f} nm, reference phase {phase_deg:.1f} deg and the even "
    "aberrations reversed makes the same pictures (log-likelihood {gap:.1f} {lower}); the "
    "configured side of focus was taken. A scan of the focus, particles at several heights or an "
    "NA above the sample's index would tell them apart",
)
