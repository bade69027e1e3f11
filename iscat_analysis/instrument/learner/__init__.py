"""The microscope, from pictures of particles that it made.

`starts` finds a microscope that resembles the average picture; `estimate` maximises the joint
likelihood over the microscope and every particle; `measure` decides what the pictures can tell and
whether the result describes pictures that were not fitted; `result` hands it on; `forecast` says
before a movie is recorded what it would tell.
"""

from __future__ import annotations

from iscat_analysis.instrument.learner.estimate import (
    Estimate,
    first_step,
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
    judge,
    measure_microscope,
)
from iscat_analysis.instrument.learner.neighbours import Neighbours
from iscat_analysis.instrument.learner.particle_images import (
    FOCUS_DRIFT,
    FOCUS_STEP,
    PRIVATE,
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
    "FOCUS_DRIFT",
    "FOCUS_STEP",
    "FREE",
    "HELD_OUT_P",
    "LEAST_SIGHTS",
    "MOST_SIGHTS",
    "PRIVATE",
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
    "build_microscope",
    "first_step",
    "forecast_optics",
    "free_groups",
    "free_names",
    "heights_free",
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
