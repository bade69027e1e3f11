"""How many photoelectrons?  Counts, light, noise and the beam."""

from __future__ import annotations

from iscat_analysis.camera.background import (
    Check,
    add_frames,
    find_defects,
    find_unsteady,
    measure_windows,
    refine_power,
    smooth_background,
    start_power,
    text_finding,
    text_summary,
    unsteady_finding,
    without_text,
)
from iscat_analysis.camera.calibration import CameraCalibration, Estimate, measure_camera
from iscat_analysis.camera.counts import (
    LARGEST_PX,
    Camera,
    CutFrames,
    FieldSample,
    camera_from_config,
    check_counts,
    read_map,
    refuse_overflow,
    refuse_ratio,
    sampled,
    whole_frames,
)
from iscat_analysis.camera.drift import (
    Mover,
    Pattern,
    Trajectory,
    derivatives,
    filling,
    follow_pattern,
    measure_drift,
    middle_of,
    pattern_of,
    still_light,
    trusted,
)
from iscat_analysis.camera.learned import (
    ASSUMPTION,
    MEASURED,
    METADATA,
    LearnedCamera,
    resolve_metadata,
    with_camera,
)
from iscat_analysis.camera.light import (
    LightModel,
    PartOfLight,
    SteadyFrames,
    find_light,
    with_lines,
)
from iscat_analysis.camera.noise import (
    GainDiagnosis,
    NoiseSpectrum,
    Processing,
    diagnose_gain,
    find_processing,
    measure_spectrum,
    shared_light,
    without_pattern_jitter,
)
from iscat_analysis.camera.transfer import SIGMAS, TOLERANCE, Law, LightZero, find_zero
