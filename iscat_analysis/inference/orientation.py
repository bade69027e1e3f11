"""A rod whose direction is unknown: the maxima of its likelihood in place, mass and both angles.

A rod and the same rod turned by 180° are one.  Every other direction has its own picture; but where
the light is faint, rods that are mirror images of one another look alike, so that the fit begins in
directions all over the half sphere and keeps every maximum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate

from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.slow_scoring import maximize_slowly
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.rods import ANGLES, Rod
from iscat_analysis.optics.waves import with_light_of
from iscat_analysis.records import BoolArray, FloatArray

AMPLITUDE, AZIMUTH, TILT = 3, 5, 6

_RINGS = ((25.0, 4), (60.0, 6), (90.0, 4))  # tilts, and azimuths of each, where fits begin
_ASIDE_DEG = 20.0  # their first azimuth; across the polarisation, the tilt has no slope
_SAME_DEG = 3.0  # between two directions that are one maximum, found twice
_SAME_VALUE = 0.1  # of their log-likelihoods
_STEP_DEG = 20.0  # largest step of an angle
_TOLERANCE, _PASSES = 2e-4, 60
_LARGEST, _LEAST_SHARE = 100.0, 1e-3  # amplitude over that of the nominal mass
_EDGE_SHARE = 0.15  # of the region's side at each edge, where no fit begins


@dataclass(frozen=True)
class Direction:
    """One maximum of the likelihood, with θ = (x, y, z, a, level, azimuth, tilt)."""

    theta: FloatArray
    sigma: FloatArray
    log_likelihood: float
    converged: bool


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
    model = turned(likelihood.model, rod.turned(float(theta[AZIMUTH]), float(theta[TILT])))
    x, y, z, amplitude = (float(value) for value in theta[:4])
    signal, own, angles = model.amplitude_joint_gradient(
        likelihood.grid, x, y, z, amplitude, ANGLES
    )
    return likelihood.score_of_signal(signal, np.concatenate([own, angles]), float(theta[LEVEL]))


def find_directions(
    likelihood: Likelihood, z_nm: float, rod: Rod, *, level: bool
) -> list[Direction]:
    """Fit x, y, mass and both angles at a height; every maximum, the best first."""
    free = np.array([True, True, False, True, level, True, True])
    reach = likelihood.model.optics.wavelength_nm / 2
    largest = _LARGEST * likelihood.model.nominal_amplitude
    farthest = np.array([reach / 2, reach / 2, 1.0, math.inf, 1.0, _STEP_DEG, _STEP_DEG])
    aside = likelihood.model.optics.polarization_deg + _ASIDE_DEG
    starts = (_start(likelihood, z_nm, rod.turned(aside + a, t)) for a, t in _everywhere())
    found = []
    for start in starts:
        box = np.array([reach, reach, 0.0, math.inf, 1.0, math.inf, math.inf])
        lower, upper = start - box, start + box
        lower[AMPLITUDE], upper[AMPLITUDE] = 0.0, largest
        theta, value, _, converged, fisher = maximize_slowly(
            lambda theta: score_fisher(likelihood, theta, rod), np.minimum(start, upper), free,
            lower, upper, farthest, tolerance=_TOLERANCE, passes=_PASSES, least=-math.inf,
        )  # fmt: skip
        found.append(Direction(_upwards(theta), _sigma(fisher, free), value, converged))
    best = max(found, key=lambda each: each.log_likelihood)
    maxima = [each for each in found if each.converged or each is best]
    return _distinct(sorted(maxima, key=lambda each: -each.log_likelihood))


def judge(likelihood: Likelihood, direction: Direction, rod: Rod) -> tuple[float, float]:
    """Give the reduced χ² and the p-value of one maximum.

    The two angles are not among the parameters that were fitted, so that p is a little too large.
    """
    theta = direction.theta
    model = turned(likelihood.model, rod.turned(float(theta[AZIMUTH]), float(theta[TILT])))
    free = np.isfinite(direction.sigma[:5])
    return goodness_of_fit(replace(likelihood, model=model), theta[:5], free)


def axis_of(theta: FloatArray) -> FloatArray:
    """Give the unit vector along the rod."""
    azimuth, tilt = np.radians(theta[[AZIMUTH, TILT]])
    flat = math.sin(tilt)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.cos(tilt)])


def _everywhere() -> list[tuple[float, float]]:
    """Azimuths and tilts all over the half sphere; lying rods have half of the azimuths."""
    return [
        (k * (360.0 if tilt < 90 else 180.0) / count, tilt)
        for tilt, count in _RINGS
        for k in range(count)
    ]


def _start(likelihood: Likelihood, z_nm: float, rod: Rod) -> FloatArray:
    """Give θ where the picture of a direction correlates best with what the counts show."""
    model, grid = turned(likelihood.model, rod), likelihood.grid
    odd = PixelGrid.centred(min(grid.shape) // 2 * 2 - 1, grid.pixel_nm)
    picture = model.amplitude_image(odd, 0.0, 0.0, z_nm, model.nominal_amplitude)
    matched = correlate(np.nan_to_num(likelihood.measured_signal()), picture, mode="constant")
    margin = [int(_EDGE_SHARE * size) for size in grid.shape]
    inside = tuple(slice(m, size - m) for m, size in zip(margin, grid.shape, strict=True))
    row, column = np.unravel_index(np.argmax(matched[inside]), matched[inside].shape)
    share = max(float(matched[inside][row, column] / np.sum(picture**2)), _LEAST_SHARE)
    amplitude = model.nominal_amplitude * (share if model.rho else math.sqrt(share))
    x, y = grid.x_nm[margin[1] + column], grid.y_nm[margin[0] + row]
    return np.array([x, y, z_nm, amplitude, 0.0, rod.azimuth_deg, rod.tilt_deg])


def _sigma(fisher: FloatArray, free: BoolArray) -> FloatArray:
    """Give standard deviations, NaN where not free or not told; shape (7,)."""
    sigma = np.full(7, math.nan)
    known = free & (np.diag(fisher) > 0)
    if known.any():
        scale = 1 / np.sqrt(np.diag(fisher)[known])
        inverse = np.linalg.pinv(fisher[np.ix_(known, known)] * np.outer(scale, scale))
        sigma[known] = scale * np.sqrt(np.diag(inverse))
    return sigma


def _upwards(theta: FloatArray) -> FloatArray:
    """Turn the rod so that its tilt is 0 to 90°, and its azimuth 0 to 360° (lying: 180°)."""
    out, axis = theta.copy(), axis_of(theta)
    if axis[2] < 0:
        axis = -axis
    out[AZIMUTH] = math.degrees(math.atan2(axis[1], axis[0])) % 360
    out[TILT] = math.degrees(math.acos(min(axis[2], 1.0)))
    return out


def _distinct(found: list[Direction]) -> list[Direction]:
    """Leave out maxima that were found before."""
    kept: list[Direction] = []
    for one in found:
        if not any(_same(one, other) for other in kept):
            kept.append(one)
    return kept


def _same(one: Direction, other: Direction) -> bool:
    cosine = min(abs(float(axis_of(one.theta) @ axis_of(other.theta))), 1.0)
    gap = abs(one.log_likelihood - other.log_likelihood)
    return math.degrees(math.acos(cosine)) < _SAME_DEG and gap < _SAME_VALUE
