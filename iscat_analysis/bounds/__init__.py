"""Bounds: what no unbiased estimator can beat, given the camera or given the light itself.

`quantum` holds what the collected light knows, `holevo` what one measurement can take of it for
several parameters at once, `classical` what the camera can learn of it, and `experiment` plans a
measurement from a configuration; `shared` says what an uncertain microscope leaves in every
particle; `planning` varies one thing and turns the question round, `pupil` searches the
measurement that comes nearest to the light's own bound, and `paper` reproduces Dong et al. (2021).
"""

from __future__ import annotations

from iscat_analysis.bounds import paper
from iscat_analysis.bounds.classical import EventBounds, bounds_from_matrices, event_bounds
from iscat_analysis.bounds.detection import DetectionLimit, detection_limit, power_searched
from iscat_analysis.bounds.experiment import (
    Experiment,
    bounds_report,
    findings_of,
    information_fraction,
    plan,
)
from iscat_analysis.bounds.holevo import holevo_bound, holevo_over_quantum, natural_bound, tradeoff
from iscat_analysis.bounds.paper import reproduce
from iscat_analysis.bounds.planning import (
    AXES,
    budget,
    changed,
    effort,
    optimize,
    parse_names,
    parse_scan,
    parse_target,
    scan,
)
from iscat_analysis.bounds.pupil import PupilOptimum, optimize_pupil
from iscat_analysis.bounds.quantum import (
    incompatible_pairs,
    quantum_bounds,
    quantum_information,
    z_nm_phase_free,
)
from iscat_analysis.bounds.shared import (
    displacement,
    joint_information,
    mass_drift,
    peak_gradient,
    shared_sigma,
)
