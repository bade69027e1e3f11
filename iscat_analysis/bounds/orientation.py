"""Bounds for a rod whose direction is unknown."""

from __future__ import annotations

import numpy as np

from iscat_analysis.bounds.classical import EventBounds, bounds_from_matrices
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.orientation import score_fisher
from iscat_analysis.optics.rods import ANGLES, Rod
from iscat_analysis.records import PARAMETERS, FloatArray

ROD_PARAMETERS = (*PARAMETERS, *ANGLES)
"""Names of what may be unknown of a rod: its place, its mass, and its angles."""


def rod_bounds(
    likelihood: Likelihood,
    theta: FloatArray,
    rod: Rod,
    free: tuple[str, ...],
    *,
    level: bool = False,
) -> EventBounds:
    """Classical bounds of one rod, in the order of `ROD_PARAMETERS`; the quantum ones are NaN.

    Shapes: `theta` (5,).
    """
    every = np.array([*theta, rod.azimuth_deg, rod.tilt_deg])
    fisher = score_fisher(likelihood, every, rod)[2]
    if level and fisher[LEVEL, LEVEL] > 0:  # what is left once the level is fitted
        fisher = fisher - np.outer(fisher[:, LEVEL], fisher[LEVEL]) / fisher[LEVEL, LEVEL]
    kept = np.delete(np.arange(len(every)), LEVEL)
    fisher = fisher[np.ix_(kept, kept)]
    return bounds_from_matrices(fisher, np.zeros_like(fisher), free, ROD_PARAMETERS)
