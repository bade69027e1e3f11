"""Camera, light and frames of a movie, and pictures that the model does not explain."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

note, caution, fault = makers(Subject.CAMERA)

# ---- numbers of the camera -------------------------------------------------------------------

CAMERA_NUMBERS = note("camera-numbers", "{text}")
GAIN_ASSUMED = caution(
    "gain-assumed",
    "the camera's gain cannot be learned from this movie, because {why}: camera.gain_e_per_adu = "
    "{gain:g} is assumed",
    "set it",
)
OFFSET_FROM_NOISE = caution(
    "offset-from-noise",
    "the camera's offset, {offset:.4g} ± {error:.2g} counts, is taken from how the noise grows "
    "with the light, and is less if the light is noisy by itself",
    "record a dark, from which it is measured",
)
READ_NOISE_LACKING = caution(
    "read-noise-lacking",
    "without light the noise is {percent:.2g} ± {percent_se:.1g} % of the light's variance beyond "
    "what camera.read_noise_e says: it lacks {lacking_e:.3g} e, in squares",
    "record a dark",
)
ROOM_LIGHT = fault(
    "room-light",
    "{percent:.2g} ± {percent_se:.1g} % of the light does not follow the laser's power but has its "
    "shot noise, as light of the room, which interferes with nothing; it makes {effect}; all rows "
    "are flagged nonlinear",
    "put it out{advice}",
)
COUNTS_BENT = fault(
    "counts-bent",
    "the counts are not in proportion to the light: {grows} with it as by {law}, which makes "
    "{effect}; all rows are flagged nonlinear",
    "switch it off or lower the exposure, or correct this movie with camera.response = "
    "response.csv, which is written with the result",
)
COUNTS_BENT_OR = fault(
    "counts-bent-or",
    "the counts are not in proportion to the light: {grows} with it as by {law}, and the movie "
    "does not tell this from {others}; the first makes {effect}; all rows are flagged nonlinear",
    "switch gamma off and lower the exposure; `iscat calibrate camera` with a dark tells them "
    "apart",
)
GAIN_OFF = caution(
    "gain-off",
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts",
    "{unless}set camera.gain_e_per_adu = {measured:.4g}",
)
NOISE_ROUNDED = caution(
    "noise-rounded",
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts, but the noise is smaller than a count ({noise_counts:.2g}) and rounding "
    "hides it: record or export the movie with more bits",
)
PATTERN_SHAKES = caution(
    "pattern-shakes",
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts; the gain is not the cause: the fixed pattern shakes by {rms_px:.2g} "
    "pixels from frame to frame, which explains {share:.0%} of what is too much: damp vibrations "
    "of the stage and the beam{follow}",
)
OFFSET_WRONG = fault(
    "offset-wrong",
    "{offset} is too {way} by {counts:.4g} ± {counts_se:.2g} counts, as {how}, and makes {effect}: "
    "{advice}",
)
OFFSET_OR_GAIN = caution(
    "offset-or-gain",
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what the camera's numbers predict, "
    "and this movie does not tell whether by the gain (then set camera.gain_e_per_adu = "
    "{measured:.4g}), {noisy}or by {offset}, which would make {effect}",
    "record a dark, and measure both with `iscat calibrate camera`",
)
GAIN_BESIDE_OFFSET = caution("gain-beside-offset", "with that offset, {text}")
FRAMES_FILTERED = fault(
    "frames-filtered",
    "frames next to each other differ by {shared:.2g} times the variance of those farther apart: "
    "they were averaged, interpolated or filtered in time, so that their noise does not tell the "
    "gain, landings are blurred and σ may be too small",
    "record or export raw frames",
)
NOISE_CORRELATED = caution(
    "noise-correlated",
    "{what}: the search accounts for it, so that false alarms are as configured; the fits assume "
    "independent pixels, so that their σ are wrong",
    subject=Subject.ERRORS,
)
WINDOWS_NOISY = caution(
    "windows-noisy",
    "averages of {window} frames differ by {ratio:.2g} times the variance of the light: by drift "
    "or the laser (set background.drift_correction = true), or by the rings of many bright "
    "particles",
    "lower background.window_frames, which helps against all",
    subject=Subject.ERRORS,
)

# ---- pixels and frames -----------------------------------------------------------------------

PIXELS_UNSTEADY = caution(
    "pixels-unsteady",
    "{pixels} ({where}) {have} noise that is not the light's, as where a pixel switches, an "
    "amplifier is noisy or a text is burnt in; not used",
)
TEXT_BURNT_IN = caution(
    "text-burnt-in",
    "a text is burnt into the frames ({boxes}), whose {pixels} pixels are left out; what lies "
    "beneath it is lost",
    "switch it off in the program that records",
)
PIXELS_DEFECT = caution("pixels-defect", "{pixels} {are} left out")
PIXELS_SATURATED = caution(
    "pixels-saturated",
    "{pixels} {are} saturated in some frame and left out",
    "lower the exposure or the laser power",
)
FRAMES_REPEATED = fault(
    "frames-repeated",
    "{frames} of {of} {repeat} the frame before (stuck in the camera), so that there is less light "
    "than it seems and σ is too small: record or export the movie without them",
)
REPEATS_LEFT_OUT = caution(
    "repeats-left-out",
    "{frames} of {of} {repeat} the frame before (stuck in the camera), and {are} left out",
)
FRAMES_DARK = caution(
    "frames-dark",
    "{frames} of {of} {are} dark or cut off (behind a shutter, or lost by the camera), and {are} "
    "left out",
)
FRAMES_PROCESSED = fault(
    "frames-processed", "the frames were {what}; all rows are flagged processed", "export {instead}"
)
MOVIE_BREAKS = caution(
    "movie-breaks",
    "{breaks}: frames before and after are not compared with each other, and {kept} are analysed",
)

# ---- light that changes ----------------------------------------------------------------------

LIGHT_SMOOTH = caution(
    "light-smooth",
    "the light changes slowly over the field, by {percent:.2g} % rms between frames that are "
    "compared, as where the beam wanders or fringes pass: each frame was divided by its own smooth "
    "light, a polynomial of degree {degree}",
)
LIGHT_FRINGES = caution(
    "light-fringes",
    "fringes with a period of {periods} pixels pass over the field, and change the light by "
    "{percent:.2g} % rms between frames that are compared: each frame was divided by its own; what "
    "reflects the laser beside the sample makes them: tilt it, or take a source that is less "
    "coherent",
)
LIGHT_SEAMS = caution(
    "light-seams",
    "parts of the field, which begin at {parts}, change as a whole, as where the camera reads them "
    "out by amplifiers of their own: each part of each frame was divided by its own light",
)
LIGHT_ADDED = caution(
    "light-added",
    "dim pixels change by more of their light than bright ones, as where something is added to all "
    "of them that changes by {percent:.2g} % of the mean light within the movie: light that does "
    "not come through the objective, the offset of a camera that warms up, or what focus does; "
    "each frame was divided by its own, but what is added all the time is not known, and masses "
    "may be wrong by as much",
)
LINES_FLICKER = caution(
    "lines-flicker",
    "whole {lines} flicker ({percents} of the noise variance): each of the {lines} of each frame "
    "was divided by its own light",
)
LIGHT_UNEVEN = fault(
    "light-uneven",
    "the light differs by {percent:.2g} % of its mean from pixel to pixel, {times:g} times its "
    'noise, where background.method = "known" has {level_e:g} in all of them: what differs is '
    "taken for particles, or makes their masses and places wrong",
    "give frames without particles as background.frames{or_method}",
)
PATTERN_FOLLOWED = note("pattern-followed", "{what}; its motion is followed and divided out")
PATTERN_MOVED = fault(
    "pattern-moved",
    "the fixed pattern moved by {x_px:+.2f} pixels in x and {y_px:+.2f} in y between the "
    "background and the frames after it; its edges look like particles: take background frames "
    "nearer to them (background.frames), or fewer frames (fit.frames)",
)

# ---- kind of movie ---------------------------------------------------------------------------

PARTICLES_LAND = fault(
    "particles-land",
    "its particles land or leave rather than move: of {changes} clear changes {percent:.0f} % stay "
    "as they are",
    'use fit.mode = "mass" without background.frames, whose windows follow landings',
    subject=Subject.ERRORS,
)
PARTICLES_MOVE = fault(
    "particles-move",
    "its particles move rather than land: around {percent:.0f} % of {changes} clear changes the "
    "picture is another one every {block} frames, as of what goes from place to place",
    'use fit.mode = "track", which follows them',
    subject=Subject.ERRORS,
)
BACKGROUND_WAY = note("background-way", "{text}")
TEMPLATE_BOUNDS = caution(
    "template-bounds",
    'optics.psf = "measured": bounds are those of the template, and there is no quantum bound: a '
    "measured picture does not give the field",
    subject=Subject.OPTICS,
)

# ---- what fits and masses show ---------------------------------------------------------------

MODEL_MISFITS = fault("model-misfits", "{cause}", subject=Subject.OPTICS)
LINE_AMBIGUOUS = caution(
    "line-ambiguous",
    "[calibration] does not tell the mass of {fits}, flagged at_bound: {why}",
    "measure it with lighter standards, or set calibration.offset = 0 if its error allows it",
    subject=Subject.SCALE,
)
SCALE_REFUSED = fault(
    "scale-refused",
    "the scale of masses does not hold here: it belongs to {whose}, and {refusal}; all rows are "
    "flagged {flag}, their contrasts are right",
    "measure standards as this movie is recorded (iscat calibrate mass)",
    subject=Subject.SCALE,
)
SCALE_CARRIED = caution(
    "scale-carried",
    "the scale of masses is carried over from {whose}: a particle has {carried:.4g} times the "
    "contrast that it has there{advice}",
    subject=Subject.SCALE,
)
CONTRAST_NONLINEAR = caution(
    "contrast-nonlinear",
    "{particles}, of up to {most_kda:.4g} kDa, {are} so heavy that contrast is not in proportion "
    "to the mass: it has the square of the scattered light, and the line of [calibration], where "
    "its standards are light, makes the heaviest {percent:.2g} % too {way}; systematic_mass_kda "
    "has that",
    "calibrate with standards as heavy as these",
    subject=Subject.SCALE,
)
PARTICLES_LARGE = caution(
    "particles-large",
    "{particles} of {of} {are} no dipole: fitted as spheres on the coverslip ({models}), flagged "
    "large, these have no mass and belong to no species{poor}",
    subject=Subject.OPTICS,
)
SIGN_TURNED = caution(
    "sign-turned",
    "{turned} of {particles} have a negative mass, as particles that leave: they {change} the "
    "image, and by {by} particles that land {other} it; if these particles land, correct that "
    "sign, or optics.focus_nm",
    subject=Subject.OPTICS,
)
LIGHT_OF_EVENTS_CHANGES = caution(
    "events-change",
    "the light of {slow} of {of} events, flagged changing, goes on changing before or after the "
    "step, not from one frame to the next: particles that settle slowly, move on, bleach or blink; "
    "their masses are those of the mean change (sum frames before the analysis if they settle "
    "within a few, or lower background.window_frames if they change later)",
    subject=Subject.ERRORS,
)
HEIGHT_FIXED = caution(
    "height-fixed",
    "the particles move by {across_nm:.2g} nm from frame to frame along x and y but by "
    '{along_nm:.2g} nm along z, as on a membrane: set track.free = "mass" and particle.height_nm = '
    '{height_nm:.3g}; with track.free = "joint" pictures are blurred along z as well, and masses '
    "come out too large",
    subject=Subject.OPTICS,
)
EXPOSURE_SMEARS = caution(
    "exposure-smears",
    "the particles go {smear_nm:.0f} nm (standard deviation) about their mean within an exposure, "
    "and {poor:.0%} of the fits are poor: along z that turns the phase by too much for one "
    "picture, and optics, gain and noise cannot be judged",
    "expose for less{than}",
    subject=Subject.ERRORS,
)
RESIDUES = caution(
    "residues",
    "{rows} rows are residues and no particles (status sidelobe), {where}: light that changes all "
    "over the field leaves them, as where one of two patterns of the illumination moves against "
    "the other",
    "find what moves, a window, a mirror or the coverslip, leave these frames out (fit.frames), or "
    "shorten background.window_frames",
    subject=Subject.ERRORS,
)
