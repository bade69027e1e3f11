"""Findings about the search for particles, about landings, events and rows of results."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

note, caution, _ = makers(Subject.CAMERA)

FRAMES_LEFT_OUT = caution(
    "frames-left-out",
    "{frames} {verb} dark, cut off, not finite or the same as the frame before (behind a shutter, "
    "dropped or stuck in the camera); left out, the other frames are used{lost}",
    page="howto/landing",
)
BRIGHTNESS_JUMPS = caution(
    "brightness-jumps",
    "the brightness jumps at {frames} by up to {percent:+.0f} %",
    "it is divided out, but look at the laser and at events in these frames",
)
PATTERN_FOLLOWED = note(
    "pattern-motion-corrected",
    "the fixed pattern moved by {x_px:+.3f} pixels in x and {y_px:+.3f} in y; corrected, to "
    "±{error_px:.1g} pixels",
)
PATTERN_NOT_FOLLOWED = caution(
    "pattern-not-followed",
    "no fixed pattern stands out of the noise in frames {frames}, so background.drift_correction "
    "has nothing to correct there",
)
PATTERN_MOVED = caution(
    "landing-pattern-moved",
    "the fixed pattern moved by {x_px:+.2f} pixels in x and {y_px:+.2f} in y; it is not corrected",
    "set background.drift_correction = true (shorter windows, background.window_frames, suffer "
    "less too)",
)
PARTLY_SEARCHED = caution(
    "partly-searched",
    "{share:.0%} of field and time were searched for particles with a signal-to-noise ratio of "
    "{snr:.0f}; what bright or ill-described particles left over hides the rest, most in frames "
    "{frames}",
    "numbers of particles and rates are corrected for it, but look at these frames",
    subject=Subject.ERRORS,
)
POWER_ALWAYS_FOLLOWED = note(
    "power-always-followed",
    "background.power_normalization = false has no effect on a landing movie: each frame is "
    "weighed by its own light",
)
HEIGHTS_LEARNED = note(
    "heights-learned", "{spread}, learned from {particles} particles", subject=Subject.OPTICS
)
HEIGHTS_NOT_LEARNED = caution(
    "heights-not-learned",
    "the heights cannot be learned from so few or so faint particles: they are taken as "
    "{height_nm:g} ± {sd_nm:g} nm",
    subject=Subject.OPTICS,
)
COMMON_HEIGHT_UNKNOWN = caution(
    "common-height-unknown",
    "a common height and the focus are one number, and the focus was learned from the same "
    "particles: only their spread, {sd_nm:.1f} nm, is known, and the mean of {mean_nm:.1f} nm is "
    "where the learned optics put it",
    subject=Subject.OPTICS,
)
INDEX_UNKNOWN = caution(
    "index-unknown",
    "the pictures of {number} of {spheres} do not tell diameter and index apart{best}; "
    "refractive_index is empty, and diameter_nm that of the configured index",
    subject=Subject.OPTICS,
)
MASSES_CHANGE = caution(
    "masses-change",
    "the mass of {events} changes within the frames by more than {sigmas:g} times its error, "
    "flagged poor_fit: they land, leave or move there",
    "let background.frames end before they land and fit.frames begin after",
    subject=Subject.ERRORS,
)
SPREAD_NOT_MEASURED = caution(
    "spread-not-measured",
    'fit.sigma = "measured" has no effect: the spread is not measured where the background is '
    "learnt with the tracks, and σ is that of the likelihood",
    subject=Subject.ERRORS,
)
