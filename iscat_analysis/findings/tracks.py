"""Particles that move: their frames, the optics that their pictures tell, and their motion."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

_, caution, fault = makers(Subject.ERRORS)

# ---- times ---------------------------------------------------------------------------------------

FRAME_RATE_UNKNOWN = caution(
    "frame-rate-unknown",
    "camera.frame_rate_hz is not known, so that there is no diffusion coefficient: add it, as in "
    "camera.frame_rate_hz = 331.0; {others}",
    subject=Subject.CAMERA,
)
EXPOSURE_UNKNOWN = caution(
    "exposure-unknown",
    "camera.exposure_ms is not known and taken as the {interval_ms:.3g} ms from frame to frame, "
    "over which motion is averaged: add it if it is shorter",
    subject=Subject.CAMERA,
)
EXPOSURE_IN_SECONDS = caution(
    "exposure-in-seconds",
    "camera.exposure_ms = {exposure_ms:g} is no more than a thousandth of the {interval_ms:.4g} ms "
    "from frame to frame: if it is in seconds, write {written_ms:g}, since motion during the "
    "exposure blurs pictures and changes D",
    subject=Subject.CAMERA,
)
SHORT_FOR_D = caution(
    "short-for-d",
    "{frames} frames tell no diffusion coefficient better than to {percent:.0f} %{none_at_all}",
    "record more, at least {least}",
)

# ---- frames and blocks ---------------------------------------------------------------------------

TRACKED_FRAMES_LEFT_OUT = caution(
    "tracked-frames-left-out",
    "frame{s} {frames} {are} dark, cut off or {repeat} the one before (behind a shutter, dropped "
    "or stuck in the camera); left out, and steps over them count as several frames{many}",
    subject=Subject.CAMERA,
)
BLOCKS_FOLLOW_DRIFT = caution(
    "blocks-follow-drift",
    "the fixed pattern moves, by {x_px:+.3f} pixels in x and {y_px:+.3f} in y in all; {blocks} "
    "blocks of {frames} frames have backgrounds of their own{rest}",
    subject=Subject.CAMERA,
)
NO_PARTICLE_MOVES = caution(
    "no-particle-moves",
    "no particle was found: with {light_e:.3g} e per pixel and frame, a particle of "
    "particle.mass_kda = {mass_kda:.4g} has a signal-to-noise ratio of {snr:.2g} in a frame, and "
    "the threshold is {threshold:.2g}",
    "if there are particles, record with more light, or longer exposures",
)
HEIGHTS_SEEM_FIXED = fault(
    "heights-seem-fixed",
    'the particles seem to stay at one height, as on a membrane: set track.free = "mass"; with '
    "heights that are free {free} of {free_of} fits are rejected, and with all held at "
    "particle.height_nm = {height_nm:g} it is {fixed} of {fixed_of} in the same frames",
    subject=Subject.OPTICS,
)

# ---- optics --------------------------------------------------------------------------------------

TRACKS_NOT_DESCRIBED = fault("tracks-not-described", "{why}", subject=Subject.OPTICS)
TRACKS_HALF_DESCRIBED = fault(
    "tracks-half-described",
    "{verdict}; others are used that describe them better, but: {why}",
    subject=Subject.OPTICS,
)

# ---- motion --------------------------------------------------------------------------------------

MASSES_CHANGE_TOGETHER = caution(
    "masses-change-together",
    "the masses of all tracks change together, by {percent:.2g} % in these frames, as where the "
    "focus drifts: tracks whose masses it changes by more than their errors are flagged "
    "mass_varies",
    "hold the focus, or analyse fewer frames (fit.frames)",
    subject=Subject.CAMERA,
)
TRACKS_CROSS = caution(
    "tracks-cross",
    "tracks {tracks} come nearer than {limit_nm:g} nm to another (to {nearest_nm:.0f} nm), where "
    "masses are shared and numbers may be exchanged: they are flagged crosses",
    "record fewer particles to avoid it",
)
STEPS_TOO_LONG = caution(
    "steps-too-long",
    "particles move {step_nm:.0f} nm from frame to frame along each axis, so that {percent:.2g} % "
    "of steps are longer than track.max_step_nm = {reach_nm:g}: they cut tracks and make D too "
    "small",
    "set it to {enough_nm:.0f}",
)
ALL_MOVE_TOGETHER = caution(
    "all-move-together",
    "all particles move together, by {step_nm:.2g} nm from frame to frame along each axis beside "
    "what each does by itself, as where the stage or the beam vibrates: D is too large{by}, and "
    "tracks may seem not to diffuse freely",
    "damp it",
)
ALL_JUMP = caution(
    "all-jump",
    "all {particles} particles jump from frame {before} to {frame}, as far as in {steps} frames: "
    "some {missing} frames seem to be missing there, and D of tracks that go on is too large",
    "analyse the movie in two parts (fit.frames = [0, {frame}], and from {frame} on)",
)
FRAMES_SEEM_DROPPED = caution(
    "frames-seem-dropped",
    "of {pairs} pairs of frames about {share:.0%} show all particles go as far as in two frames: "
    "the camera seems to have dropped frames, and D is too large by about as much",
    "compare the times of the frames, and write fewer pixels or slower",
    subject=Subject.CAMERA,
)
