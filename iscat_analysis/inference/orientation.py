"""A rod whose direction is unknown: its likelihood in place, mass, level and both angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.rods import ANGLES, Rod
from iscat_analysis.optics.waves import with_light_of
from iscat_analysis.records import FloatArray


def rod_in(model: ForwardModel) -> Rod | None:
    """Give the rod whose pictures a model makes; None where it is none."""
    scatterer = model.aperture.scatterer
    return scatterer if isinstance(scatterer, Rod) else None


def turned(model: ForwardModel, rod: Rod) -> ForwardModel:
    """Give the model of another rod in the same microscope."""
    opening = replace(model.aperture, scatterer=rod)
    wave = with_light_of(model.wave, opening, model.factor, model.oil_nm)
    return replace(model, aperture=opening, wave=wave)


def score_fisher(
    likelihood: Likelihood, theta: FloatArray, rod: Rod
) -> tuple[float, FloatArray, FloatArray]:
    """Log-likelihood, its gradient and the expected information in (x, y, z, a, level, φ, θ).

    Shapes: `theta` (7,), `score` (7,), `fisher` (7, 7).
    """
    model = turned(likelihood.model, rod.turned(float(theta[5]), float(theta[6])))
    x, y, z, amplitude = (float(value) for value in theta[:4])
    signal, own, angles = model.amplitude_joint_gradient(
        likelihood.grid, x, y, z, amplitude, ANGLES
    )
    return likelihood.score_of(signal, np.concatenate([own, angles]), float(theta[LEVEL]))
