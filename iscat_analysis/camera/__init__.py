"""How many photoelectrons?  Counts, light, noise and the beam."""

from __future__ import annotations

from iscat_analysis.camera.background import (
    Check,
    add_frames,
    find_defects,
    measure_windows,
    refine_power,
    smooth_background,
    start_power,
)
from iscat_analysis.camera.calibration import measure_camera
from iscat_analysis.camera.counts import (
    Camera,
    camera_from_config,
    check_counts,
    read_map,
    refuse_overflow,
    refuse_ratio,
)
from iscat_analysis.camera.drift import (
    ComplexArray,
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
from iscat_analysis.camera.field_sample import (
    LARGEST_PX,
    CutFrames,
    FieldSample,
    sampled,
    whole_frames,
)
from iscat_analysis.camera.gain import (
    GainDiagnosis,
    diagnose_gain,
    shared_light,
    without_pattern_jitter,
)
from iscat_analysis.camera.laws import Law, Response
from iscat_analysis.camera.learned import (
    ASSUMPTION,
    MEASURED,
    METADATA,
    LearnedCamera,
    resolve_metadata,
    with_camera,
)
from iscat_analysis.camera.light import LightModel, PartOfLight, SteadyFrames, with_lines
from iscat_analysis.camera.light_search import find_light
from iscat_analysis.camera.pixels import (
    find_unsteady,
    text_finding,
    text_summary,
    unsteady_finding,
    without_text,
)
from iscat_analysis.camera.processed import Processing, find_processing
from iscat_analysis.camera.regression import CameraCalibration, Estimate
from iscat_analysis.camera.spectrum import NoiseSpectrum, measure_spectrum
from iscat_analysis.camera.transfer import SIGMAS, TOLERANCE, LightZero, find_zero
