"""Camera, light and frames of a movie, and pictures that the model does not explain."""

from __future__ import annotations

from iscat_analysis.findings.registry import Severity, define

# ---- numbers of the camera -------------------------------------------------------------------

CAMERA_NUMBERS = define("camera-numbers", Severity.NOTE, "{text}")
GAIN_ASSUMED = define(
    "gain-assumed",
    Severity.CAUTION,
    "the camera's gain cannot be learned from this movie, because {why}: camera.gain_e_per_adu = "
    "{gain:g} is assumed",
    "set it",
)
OFFSET_FROM_NOISE = define(
    "offset-from-noise",
    Severity.CAUTION,
    "the camera's offset, {offset:.4g} ± {error:.2g} counts, is taken from how the noise grows "
    "with the light, and is less if the light is noisy by itself",
    "record a dark, from which it is measured",
)
READ_NOISE_LACKING = define(
    "read-noise-lacking",
    Severity.CAUTION,
    "without light the noise is {percent:.2g} ± {percent_se:.1g} % of the light's variance beyond "
    "what camera.read_noise_e says: it lacks {lacking_e:.3g} e, in squares",
    "record a dark",
)
ROOM_LIGHT = define(
    "room-light",
    Severity.FAULT,
    "{percent:.2g} ± {percent_se:.1g} % of the light does not follow the laser's power but has its "
    "shot noise, as light of the room, which interferes with nothing; it makes {effect}; all rows "
    "are flagged nonlinear",
    "put it out{advice}",
)
COUNTS_BENT = define(
    "counts-bent",
    Severity.FAULT,
    "the counts are not in proportion to the light: {grows} with it as by {law}, which makes "
    "{effect}; all rows are flagged nonlinear",
    "switch it off or lower the exposure, or correct this movie with camera.response = "
    "response.csv, which is written with the result",
)
COUNTS_BENT_OR = define(
    "counts-bent-or",
    Severity.FAULT,
    "the counts are not in proportion to the light: {grows} with it as by {law}, and the movie "
    "does not tell this from {others}; the first makes {effect}; all rows are flagged nonlinear",
    "switch gamma off and lower the exposure; `iscat calibrate camera` with a dark tells them "
    "apart",
)
GAIN_OFF = define(
    "gain-off",
    Severity.CAUTION,
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts",
    "{unless}set camera.gain_e_per_adu = {measured:.4g}",
)
NOISE_ROUNDED = define(
    "noise-rounded",
    Severity.CAUTION,
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts, but the noise is smaller than a count ({noise_counts:.2g}) and rounding "
    "hides it: record or export the movie with more bits",
)
PATTERN_SHAKES = define(
    "pattern-shakes",
    Severity.CAUTION,
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what camera.gain_e_per_adu = "
    "{gain:.4g} predicts; the gain is not the cause: the fixed pattern shakes by {rms_px:.2g} "
    "pixels from frame to frame, which explains {share:.0%} of what is too much: damp vibrations "
    "of the stage and the beam{follow}",
)
OFFSET_WRONG = define(
    "offset-wrong",
    Severity.FAULT,
    "{offset} is too {way} by {counts:.4g} ± {counts_se:.2g} counts, as {how}, and makes {effect}: "
    "{advice}",
)
OFFSET_OR_GAIN = define(
    "offset-or-gain",
    Severity.CAUTION,
    "the noise variance is {ratio:.3g} ± {ratio_se:.1g} times what the camera's numbers predict, "
    "and this movie does not tell whether by the gain (then set camera.gain_e_per_adu = "
    "{measured:.4g}), {noisy}or by {offset}, which would make {effect}",
    "record a dark, and measure both with `iscat calibrate camera`",
)
GAIN_BESIDE_OFFSET = define("gain-beside-offset", Severity.CAUTION, "with that offset, {text}")
FRAMES_FILTERED = define(
    "frames-filtered",
    Severity.FAULT,
    "frames next to each other differ by {shared:.2g} times the variance of those farther apart: "
    "they were averaged, interpolated or filtered in time, so that their noise does not tell the "
    "gain, landings are blurred and σ may be too small",
    "record or export raw frames",
)
NOISE_CORRELATED = define(
    "noise-correlated",
    Severity.CAUTION,
    "{what}: the search accounts for it, so that false alarms are as configured; the fits assume "
    "independent pixels, so that their σ are wrong",
)
WINDOWS_NOISY = define(
    "windows-noisy",
    Severity.CAUTION,
    "averages of {window} frames differ by {ratio:.2g} times the variance of the light: by drift "
    "or the laser (set background.drift_correction = true), or by the rings of many bright "
    "particles",
    "lower background.window_frames, which helps against all",
)

# ---- pixels and frames -----------------------------------------------------------------------

PIXELS_UNSTEADY = define(
    "pixels-unsteady",
    Severity.CAUTION,
    "{pixels} ({where}) {have} noise that is not the light's, as where a pixel switches, an "
    "amplifier is noisy or a text is burnt in; not used",
)
TEXT_BURNT_IN = define(
    "text-burnt-in",
    Severity.CAUTION,
    "a text is burnt into the frames ({boxes}), whose {pixels} pixels are left out; what lies "
    "beneath it is lost",
    "switch it off in the program that records",
)
PIXELS_DEFECT = define("pixels-defect", Severity.CAUTION, "{pixels} {are} left out")
PIXELS_SATURATED = define(
    "pixels-saturated",
    Severity.CAUTION,
    "{pixels} {are} saturated in some frame and left out",
    "lower the exposure or the laser power",
)
FRAMES_REPEATED = define(
    "frames-repeated",
    Severity.FAULT,
    "{frames} of {of} {repeat} the frame before (stuck in the camera), so that there is less light "
    "than it seems and σ is too small: record or export the movie without them",
)
REPEATS_LEFT_OUT = define(
    "repeats-left-out",
    Severity.CAUTION,
    "{frames} of {of} {repeat} the frame before (stuck in the camera), and {are} left out",
)
FRAMES_DARK = define(
    "frames-dark",
    Severity.CAUTION,
    "{frames} of {of} {are} dark or cut off (behind a shutter, or lost by the camera), and {are} "
    "left out",
)
FRAMES_PROCESSED = define(
    "frames-processed",
    Severity.FAULT,
    "the frames were {what}; all rows are flagged processed",
    "export {instead}",
)
MOVIE_BREAKS = define(
    "movie-breaks",
    Severity.CAUTION,
    "{breaks}: frames before and after are not compared with each other, and {kept} are analysed",
)

# ---- light that changes ----------------------------------------------------------------------

LIGHT_SMOOTH = define(
    "light-smooth",
    Severity.CAUTION,
    "the light changes slowly over the field, by {percent:.2g} % rms between frames that are "
    "compared, as where the beam wanders or fringes pass: each frame was divided by its own smooth "
    "light, a polynomial of degree {degree}",
)
LIGHT_FRINGES = define(
    "light-fringes",
    Severity.CAUTION,
    "fringes with a period of {periods} pixels pass over the field, and change the light by "
    "{percent:.2g} % rms between frames that are compared: each frame was divided by its own; what "
    "reflects the laser beside the sample makes them: tilt it, or take a source that is less "
    "coherent",
)
LIGHT_SEAMS = define(
    "light-seams",
    Severity.CAUTION,
    "parts of the field, which begin at {parts}, change as a whole, as where the camera reads them "
    "out by amplifiers of their own: each part of each frame was divided by its own light",
)
LIGHT_ADDED = define(
    "light-added",
    Severity.CAUTION,
    "dim pixels change by more of their light than bright ones, as where something is added to all "
    "of them that changes by {percent:.2g} % of the mean light within the movie: light that does "
    "not come through the objective, the offset of a camera that warms up, or what focus does; "
    "each frame was divided by its own, but what is added all the time is not known, and masses "
    "may be wrong by as much",
)
LINES_FLICKER = define(
    "lines-flicker",
    Severity.CAUTION,
    "whole {lines} flicker ({percents} of the noise variance): each of the {lines} of each frame "
    "was divided by its own light",
)
LIGHT_UNEVEN = define(
    "light-uneven",
    Severity.FAULT,
    "the light differs by {percent:.2g} % of its mean from pixel to pixel, {times:g} times its "
    'noise, where background.method = "known" has {level_e:g} in all of them: what differs is '
    "taken for particles, or makes their masses and places wrong",
    "give frames without particles as background.frames{or_method}",
)
PATTERN_FOLLOWED = define(
    "pattern-followed", Severity.NOTE, "{what}; its motion is followed and divided out"
)
PATTERN_MOVED = define(
    "pattern-moved",
    Severity.FAULT,
    "the fixed pattern moved by {x_px:+.2f} pixels in x and {y_px:+.2f} in y between the "
    "background and the frames after it; its edges look like particles: take background frames "
    "nearer to them (background.frames), or fewer frames (fit.frames)",
)

# ---- kind of movie ---------------------------------------------------------------------------

PARTICLES_LAND = define(
    "particles-land",
    Severity.FAULT,
    "its particles land or leave rather than move: of {changes} clear changes {percent:.0f} % stay "
    "as they are",
    'use fit.mode = "mass" without background.frames, whose windows follow landings',
)
PARTICLES_MOVE = define(
    "particles-move",
    Severity.FAULT,
    "its particles move rather than land: around {percent:.0f} % of {changes} clear changes the "
    "picture is another one every {block} frames, as of what goes from place to place",
    'use fit.mode = "track", which follows them',
)
BACKGROUND_WAY = define("background-way", Severity.NOTE, "{text}")
TEMPLATE_BOUNDS = define(
    "template-bounds",
    Severity.CAUTION,
    'optics.psf = "measured": bounds are those of the template, and there is no quantum bound: a '
    "measured picture does not give the field",
)

# ---- what fits and masses show ---------------------------------------------------------------

MODEL_MISFITS = define("model-misfits", Severity.FAULT, "{cause}")
LINE_AMBIGUOUS = define(
    "line-ambiguous",
    Severity.CAUTION,
    "[calibration] does not tell the mass of {fits}, flagged at_bound: {why}",
    "measure it with lighter standards, or set calibration.offset = 0 if its error allows it",
)
SCALE_REFUSED = define(
    "scale-refused",
    Severity.FAULT,
    "the scale of masses does not hold here: it belongs to {whose}, and {refusal}; all rows are "
    "flagged {flag}, their contrasts are right",
    "measure standards as this movie is recorded (iscat calibrate mass)",
)
SCALE_CARRIED = define(
    "scale-carried",
    Severity.CAUTION,
    "the scale of masses is carried over from {whose}: a particle has {carried:.4g} times the "
    "contrast that it has there{advice}",
)
CONTRAST_NONLINEAR = define(
    "contrast-nonlinear",
    Severity.CAUTION,
    "{particles}, of up to {most_kda:.4g} kDa, {are} so heavy that contrast is not in proportion "
    "to the mass: it has the square of the scattered light, and the line of [calibration], where "
    "its standards are light, makes the heaviest {percent:.2g} % too {way}; systematic_mass_kda "
    "has that",
    "calibrate with standards as heavy as these",
)
PARTICLES_LARGE = define(
    "particles-large",
    Severity.CAUTION,
    "{particles} of {of} {are} no dipole: fitted as spheres on the coverslip ({models}), flagged "
    "large, these have no mass and belong to no species{poor}",
)
SIGN_TURNED = define(
    "sign-turned",
    Severity.CAUTION,
    "{turned} of {particles} have a negative mass, as particles that leave: they {change} the "
    "image, and by {by} particles that land {other} it; if these particles land, correct that "
    "sign, or optics.focus_nm",
)
LIGHT_OF_EVENTS_CHANGES = define(
    "events-change",
    Severity.CAUTION,
    "the light of {slow} of {of} events, flagged changing, goes on changing before or after the "
    "step, not from one frame to the next: particles that settle slowly, move on, bleach or blink; "
    "their masses are those of the mean change (sum frames before the analysis if they settle "
    "within a few, or lower background.window_frames if they change later)",
)
HEIGHT_FIXED = define(
    "height-fixed",
    Severity.CAUTION,
    "the particles move by {across_nm:.2g} nm from frame to frame along x and y but by "
    '{along_nm:.2g} nm along z, as on a membrane: set track.free = "mass" and particle.height_nm = '
    '{height_nm:.3g}; with track.free = "joint" pictures are blurred along z as well, and masses '
    "come out too large",
)
EXPOSURE_SMEARS = define(
    "exposure-smears",
    Severity.CAUTION,
    "the particles go {smear_nm:.0f} nm (standard deviation) about their mean within an exposure, "
    "and {poor:.0%} of the fits are poor: along z that turns the phase by too much for one "
    "picture, and optics, gain and noise cannot be judged",
    "expose for less{than}",
)
RESIDUES = define(
    "residues",
    Severity.CAUTION,
    "{rows} rows are residues and no particles (status sidelobe), {where}: light that changes all "
    "over the field leaves them, as where one of two patterns of the illumination moves against "
    "the other",
    "find what moves, a window, a mirror or the coverslip, leave these frames out (fit.frames), or "
    "shorten background.window_frames",
)
