"""What is special about this movie?  Its light, noise, kind, and what went wrong."""

from __future__ import annotations

from iscat_analysis.diagnosis.calibrated import (
    LIGHT_STEPS,
    SCAN_STEPS,
    Prepared,
    Step,
    calibrated,
    within,
)
from iscat_analysis.diagnosis.causes import (
    fixed_height_warning,
    landing_rate_warning,
    large_warning,
    line_warning,
    misfit_warning,
    nonlinearity_warning,
    pattern_jitter_warning,
    pixel_warnings,
    repeats_warning,
    residue_warning,
    scale_warning,
    sign_warning,
    smear_warning,
    uneven_warning,
)
from iscat_analysis.diagnosis.frames import light_and_repeats, without_cut_off
from iscat_analysis.diagnosis.light import DRIFT_PX, drift_warning, examine_background
from iscat_analysis.diagnosis.noise import (
    SPECTRUM_FRAMES,
    Noise,
    NoiseSurvey,
    judge_background,
    judge_beside,
    judge_counts,
    judge_window,
    survey_over,
)
from iscat_analysis.diagnosis.recognise import (
    BLOCK,
    Changes,
    as_landing,
    as_moving,
    least_beside,
    look_at_changes,
)
from iscat_analysis.diagnosis.stretches import Stretches, find_stretches
