"""Motion of the stage, as the fixed pattern shows it before anything is searched."""

from __future__ import annotations

from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import NoiseSurvey
from iscat_analysis.search.frames import good_frames
from iscat_analysis.search.noise import measure_motion

# Share of the variance of averages that motion must add; noise alone adds 1e-3.
_LEAST_VARIANCE_SHARE = 0.03


def with_drift_correction(config: Config, *, moves: bool) -> Config:
    """Set in the configuration whether the motion of the fixed pattern is divided out."""
    background = config.background.model_copy(update={"drift_correction": moves})
    return config.model_copy(update={"background": background})


def motion_message(opening: NoiseSurvey) -> str:
    """Say that the fixed pattern of a landing movie moves; empty where it does not."""
    if opening.noise.shakes:
        return "the fixed pattern shakes"
    reader, length = opening.reader.sampled, opening.curve.frames[-1]
    last = reader.read(max(reader.first, reader.last - 2 * length), reader.last)
    last = last[good_frames(last, reader.camera)]
    share = max(
        measure_motion(counts, reader.camera, min(length, len(counts) // 2))
        for counts in (reader.opening(), last)
        if len(counts) >= 2
    )
    if not share > _LEAST_VARIANCE_SHARE:
        return ""
    return (
        f"the fixed pattern moves: averages of {length} frames differ by {1 + share:.3g} times "
        "what they would otherwise"
    )
