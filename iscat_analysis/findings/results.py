"""What a table of results tells beside its numbers: whether they are masses, and a fair sample."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

_, caution, _ = makers(Subject.ERRORS)

NOT_A_MASS = caution(
    "not-a-mass",
    "Not calibrated: mass_kda is on the model's own absolute scale, and an uncalibrated absolute "
    "scale is not a mass. What was measured are contrasts",
    "`iscat calibrate mass` makes masses of them",
    "howto/calibration",
    subject=Subject.SCALE,
)

MANY_FLAGGED = caution(
    "many-flagged", "{rows} flagged{rest}. The commonest reason is {reason}. {advice}"
)

MODEL_REJECTED = caution(
    "model-rejected",
    "The model is rejected: {poor} of {fits} fits have a p-value below {level:g}, where {chance} "
    "would by chance. Errors of the model, such as a wrong focus, aperture or pixel size, are not "
    "in σ, and in the spread only as rings left over of other particles; they show in how far the "
    "species are wider than σ",
    subject=Subject.OPTICS,
)

NOTHING_FOUND = caution(
    "nothing-found",
    "Nothing was found in this movie that stands out from its noise",
    "if particles can be seen by eye, look at the field image and the light of the frames below, "
    "then at detection.polarity, detection.false_alarms_per_movie and the two frame ranges",
)

NO_TRACK = caution(
    "no-track",
    "{positions}, and no particle was followed for track.min_frames",
    "look at the field image, at track.max_step_nm, which is the farthest a particle goes between "
    "frames, and at detection.false_alarms_per_movie",
)

INTERRUPTED = caution(
    "interrupted",
    "the analysis was interrupted: these are the particles of the part that was finished",
    "run it again, which goes on where it ended",
    subject=Subject.CAMERA,
)
