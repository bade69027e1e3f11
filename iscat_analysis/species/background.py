"""What is none of the species: events of any mass, evenly over its logarithm.

The density is as 1/m between the lightest and the heaviest event, made of normal distributions an
octave apart and about half an octave wide.  It varies slowly over any peak, so that it takes none
of its tails, and has one parameter, its share.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events

_OCTAVE = math.log(2.0)
_OVERLAP = 0.65  # of the distance between neighbours: with it their sum has no bumps
_BELOW_LIMIT = 0.3  # of the limit of detection, where nothing is seen of it


def broad(events: Events) -> tuple[FloatArray, FloatArray]:
    """Give means and variances of the parts of the background, which share its weight evenly.

    Shapes: results (j,), (j,).
    """
    low, high = float(events.x.min()), float(events.x.max())
    if events.efficiency is not None:
        low = min(max(low, _BELOW_LIMIT * events.efficiency.threshold_kda), high)
    octaves = math.log(high / low) / _OCTAVE
    if octaves < 1:
        mean = np.array([(low + high) / 2])
        return mean, (_OVERLAP * _OCTAVE * mean) ** 2
    number = math.ceil(octaves)
    step = math.log(high / low) / number
    mean = low * np.exp(step * (np.arange(number) + 0.5))
    return mean, (_OVERLAP * step * mean) ** 2
