"""The faintest particle that can be detected, from the Fisher information of an empty field.

By the lemma of Neyman and Pearson no test of “a particle or none at this place” beats the matched
filter, whose signal-to-noise ratio is amplitude × √J_aa, J being the Fisher information without a
particle: normal with variance 1, so that for false alarms p and misses q

    SNR = z(p) + z(q),        z(p) = Φ⁻¹(1 − p).

Where the place is searched, noise has as many chances as the field has places: the threshold u is
the height above which a smooth normal field has one maximum with probability p (R. J. Adler, *The
Geometry of Random Fields* (1981), chapter 6), with the roughness Λ of that field from the same
matrix.  And the particle's maximum may lie beside it: √(2Δℓ) over place and amplitude is
χ with three degrees of freedom about SNR.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import ndtr, ndtri

from iscat_analysis.bounds.experiment import Experiment, detector, expected_likelihood
from iscat_analysis.inference.random_field import Excursions, extent


@dataclass(frozen=True)
class DetectionLimit:
    """What can be detected; build it with `detection_limit`."""

    false_alarm: float
    miss: float
    threshold_known: float
    threshold_searched: float
    snr_known: float
    snr_searched: float
    mass_known_kda: float
    mass_searched_kda: float
    snr_per_amplitude: float


def power_searched(snr: float, threshold: float) -> float:
    """Probability to detect a particle whose place is fitted."""
    # the length of a normal vector in space whose mean lies snr from the origin
    far, near = threshold + snr, threshold - snr
    # no particle, to 1e-8
    if snr < 1e-4:
        rim = 2 * threshold * math.exp(-(threshold**2) / 2)
    else:
        rim = (math.exp(-(near**2) / 2) - math.exp(-(far**2) / 2)) / snr
    return float(ndtr(-near) + ndtr(-far)) + rim / math.sqrt(2 * math.pi)


def detection_limit(experiment: Experiment) -> DetectionLimit | None:
    """Compute the smallest detectable mass."""
    model, at = experiment.model, experiment.config.bounds
    if not model.rho:
        return None
    theta = experiment.theta.copy()
    # a faint particle has derivatives with the place
    theta[3] *= 1e-6
    light, frames = (at.photons_per_pixel,) * 2, (at.n_before, at.n_after)
    read = detector(experiment.config)[1]
    empty = expected_likelihood(model, experiment.grid, theta, light, frames, read_noise_e=read)
    fisher = empty.score_fisher(theta)[2]
    if not fisher[3, 3] > 0:
        return None
    slope = fisher[:2, 3] / (theta[3] * fisher[3, 3])
    rough = fisher[:2, :2] / (theta[3] ** 2 * fisher[3, 3]) - np.outer(slope, slope)
    area = extent(rough, (at.pixels * experiment.grid.pixel_nm) ** 2)
    false, miss = at.false_alarm_probability, at.miss_probability
    known = -float(ndtri(false))
    searched = Excursions(area).level(-math.log1p(-false), lowest=known)
    snr = known - float(ndtri(miss))
    snr_searched = float(
        scipy.optimize.brentq(
            lambda s: power_searched(s, searched) - (1 - miss), 0.0, searched + 40.0
        )
    )
    root = math.sqrt(float(fisher[3, 3]))
    sign = math.copysign(1.0, float(experiment.theta[3]))
    masses = model.scale.mass(sign * np.array([snr, snr_searched]) / root)
    return DetectionLimit(
        false, miss, known, searched, snr, snr_searched,
        max(float(masses[0]), 0.0), max(float(masses[1]), 0.0), root,
    )  # fmt: skip
