"""The microscope, from pictures of particles that it made.

`starts` finds a microscope that resembles the average picture; `estimate` maximises the joint
likelihood over the microscope and every particle; `measure` decides what the pictures can tell and
whether the result describes pictures that were not fitted; `result` hands it on; `forecast` says
before a movie is recorded what it would tell.
"""

from __future__ import annotations

from iscat_analysis.instrument.learner.estimate import (
    Asked,
    Estimate,
    asked_changes,
    maximise,
    optics_limits,
    prior_range,
)
from iscat_analysis.instrument.learner.forecast import OpticsForecast, forecast_optics
from iscat_analysis.instrument.learner.measure import (
    FAINTEST,
    HELD_OUT_P,
    LEAST_SIGHTS,
    MOST_SIGHTS,
    Judgement,
    Measured,
    Twin,
    fitted_sights,
    held_out_sights,
    judge,
    measure_microscope,
)
from iscat_analysis.instrument.learner.neighbours import Neighbours
from iscat_analysis.instrument.learner.particle_images import (
    FIELD,
    FOCUS_DRIFT,
    FOCUS_STEP,
    PRIVATE,
    Build,
    ParticleImage,
    Settings,
)
from iscat_analysis.instrument.learner.pictures import Pictures, make_pictures
from iscat_analysis.instrument.learner.result import OpticsCalibration, make_result
from iscat_analysis.instrument.learner.settings import (
    FREE,
    build_microscope,
    free_groups,
    free_names,
    heights_free,
    is_term,
    settings_of,
    with_settings,
)

__all__ = [
    "FAINTEST",
    "FIELD",
    "FOCUS_DRIFT",
    "FOCUS_STEP",
    "FREE",
    "HELD_OUT_P",
    "LEAST_SIGHTS",
    "MOST_SIGHTS",
    "PRIVATE",
    "Asked",
    "Build",
    "Estimate",
    "Judgement",
    "Measured",
    "Neighbours",
    "OpticsCalibration",
    "OpticsForecast",
    "ParticleImage",
    "Pictures",
    "Settings",
    "Twin",
    "asked_changes",
    "build_microscope",
    "fitted_sights",
    "forecast_optics",
    "free_groups",
    "free_names",
    "heights_free",
    "held_out_sights",
    "is_term",
    "judge",
    "make_pictures",
    "make_result",
    "maximise",
    "measure_microscope",
    "optics_limits",
    "prior_range",
    "settings_of",
    "with_settings",
]
