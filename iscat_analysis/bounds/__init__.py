"""Bounds: what no unbiased estimator can beat, given the camera or given the light itself.

`quantum` holds what the collected light knows, `classical` what the camera can learn of it, and
`experiment` plans a measurement from a configuration.
"""

from __future__ import annotations

from iscat_analysis.bounds.classical import (
    EventBounds,
    Unidentifiable,
    bounds_from_matrices,
    event_bounds,
)
from iscat_analysis.bounds.experiment import (
    Experiment,
    bounds_report,
    information_fraction,
    plan,
    report_of,
    warnings_of,
)
from iscat_analysis.bounds.quantum import (
    incompatible_pairs,
    quantum_bounds,
    quantum_information,
    z_nm_phase_free,
)

__all__ = [
    "EventBounds",
    "Experiment",
    "Unidentifiable",
    "bounds_from_matrices",
    "bounds_report",
    "event_bounds",
    "incompatible_pairs",
    "information_fraction",
    "plan",
    "quantum_bounds",
    "quantum_information",
    "report_of",
    "warnings_of",
    "z_nm_phase_free",
]
