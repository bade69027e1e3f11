"""Fits of rods of any direction in regions of interest.

A rod whose direction is unknown: the maxima of its likelihood in place, mass and both angles.

A rod and the same rod turned by 180° are one.  Every other direction has its own picture; but where
the light is faint, rods that are mirror images of one another look alike, so that the fit begins in
directions all over the half sphere and keeps every maximum.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.ndimage import correlate

from iscat_analysis.config import CameraConfig, Optics, Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import POOR_FIT_P, ModelFit, fit_model, goodness_of_fit
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.models import TurningRod
from iscat_analysis.inference.sizes import AMBIGUITY_ODDS
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.optics.scatterers import Rod, rod_of
from iscat_analysis.options import takes
from iscat_analysis.pieces.counts import LightOptions, config_of, gather
from iscat_analysis.pieces.regions import EDGE_SHARE
from iscat_analysis.records import Box, FloatArray, Status, verdict

AMPLITUDE, AZIMUTH, TILT = 3, 4, 5
_OTHER = ("azimuth_deg", "tilt_deg", "mass_kda")
_NAMES = {"x_nm": 0, "y_nm": 1, "mass_kda": AMPLITUDE, "azimuth_deg": AZIMUTH, "tilt_deg": TILT}


@takes(LightOptions)
def fit_rods(
    before: ArrayLike,
    after: ArrayLike,
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    **options: Unpack[LightOptions],
) -> pd.DataFrame:
    """Fit place, mass and direction of one rod in each of many regions.

    Parameters
    ----------
    before : array_like, shape (n, y, x)
        Photoelectrons summed over the frames before [e]; see `fit_rois`.
    after : array_like, shape (n, y, x)
        Photoelectrons summed over the frames with the rod [e].
    optics : Optics
        The microscope.
    particle : Particle
        A particle with ``model="rod"``: its material, aspect ratio and height are held, its angles
        are not used.
    camera : Camera
        Pixel size, samples per pixel and read noise.
    n_before, n_after : int
        Frames in the sums; ``n_before=0`` where the background is known.
    power_ratio : array_like, optional
        Light after over light before, as in `fit_rois`.
    level : bool, optional
        Whether a common level of the light is fitted as a nuisance, as in `fit_rois`.
    masked : array_like of bool, shape (n, y, x) or (y, x), optional
        Pixels to leave out.

    Returns
    -------
    pandas.DataFrame
        One row for each region.  `x_nm`, `y_nm`, `mass_kda`, `azimuth_deg` (from x towards y) and
        `tilt_deg` (from the optical axis, 0 to 90) with `sigma_…`, which are the Cramér–Rao bounds;
        `maxima`, the number of directions with a maximum of their own; `other_azimuth_deg`,
        `other_tilt_deg`, `other_mass_kda` and `other_odds` of the next best, its likelihood over
        that of the best; `chi2_reduced` and `p_value`; and `status`, which is ``"ok"``,
        ``"not_converged"``, ``"poor_fit"`` or ``"ambiguous_direction"``: another direction is
        likely with odds above 1 : 1000, or the direction is known to no better than 5 degrees.

    Raises
    ------
    ConfigError
        The particle is no rod, or an argument is missing or impossible.
    DataError
        An array has another shape, holds no real numbers, or is not finite in an unmasked pixel.

    Notes
    -----
    The likelihood is that of `fit_rois` in mode ``"mass"``.  The azimuth of an upright rod is not
    determined: its σ is then large.  So is the tilt of a rod across linear polarisation, which sees
    nothing of the rod's length.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics, camera = ia.Optics(na=1.42, focus_nm=-300), ia.Camera(pixel_size_nm=90)
    >>> rod = ia.Particle(kind="gold", diameter_nm=15, model="rod", aspect_ratio=3,
    ...                   azimuth_deg=30, tilt_deg=60)
    >>> light = 1e6 * (1 + ia.psf(optics, rod, camera, pixels=15)[None])
    >>> counts = np.random.default_rng(1).poisson([np.full_like(light, 1e6), light])
    >>> table = ia.fit_rods(*counts, optics, rod, camera, n_before=100, n_after=100)
    >>> abs(table.azimuth_deg[0] - 30) < 4 * table.sigma_azimuth_deg[0]
    np.True_
    """
    counts = gather(config_of(optics, particle, camera, mode="mass"), before, after, **options)
    model = counts.model
    rod = rod_of(particle, model.material.permittivity, optics.n_sample)
    if rod is None:
        raise ConfigError(
            f'particle.model = "{particle.model}": fit_rods fits rods; give '
            'Particle(model="rod", aspect_ratio=…), or use fit_rois'
        )
    rows = []
    for index in range(len(counts.after)):
        likelihood = counts.likelihood(index)
        found = find_directions(likelihood, particle.nominal_height_nm, rod, level=counts.level)
        rows.append(_row(likelihood, found, rod))
    return pd.DataFrame(rows)


def _row(likelihood: Likelihood, found: list[ModelFit], rod: Rod) -> dict[str, Any]:
    """Put the maxima of one region into a row."""
    best, *others = found
    chi2, p_value = judge(likelihood, best, rod)
    odds, other = 0.0, np.full(len(best.theta), math.nan)
    if others:
        odds, other = math.exp(others[0].log_likelihood - best.log_likelihood), others[0].theta
    across = best.sigma[AZIMUTH] * math.sin(math.radians(best.theta[TILT]))
    # an error of the direction above 5° is no longer normal
    unsure = odds > 1 / AMBIGUITY_ODDS or not max(best.sigma[TILT], across) < 5.0
    possible = (
        (not best.converged, Status.NOT_CONVERGED),
        (p_value < POOR_FIT_P, Status.POOR_FIT),
        (unsure, Status.AMBIGUOUS_DIRECTION),
    )
    return {
        **{name: float(best.theta[k]) for name, k in _NAMES.items()},
        **{f"sigma_{name}": float(best.sigma[k]) for name, k in _NAMES.items()},
        "maxima": len(found),
        **{f"other_{name}": float(other[_NAMES[name]]) for name in _OTHER},
        "other_odds": odds if others else math.nan,
        "chi2_reduced": chi2,
        "p_value": p_value,
        "status": str(verdict([flag for true, flag in possible if true])[0]),
    }


_RINGS = ((25.0, 4), (60.0, 6), (90.0, 4))  # tilts, and azimuths of each, where fits begin
_LARGEST, _LEAST_SHARE = 100.0, 1e-3  # amplitude over that of the nominal mass


def find_directions(
    likelihood: Likelihood, z_nm: float, rod: Rod, *, level: bool
) -> list[ModelFit]:
    """Fit x, y, mass and both angles at a height: every maximum, the best first.

    θ = (x, y, z, a, azimuth, tilt, level).
    """
    rods = TurningRod(likelihood.model, rod)
    of_rods = likelihood.under(rods)
    free = np.array([True, True, False, True, True, True, level])
    reach = likelihood.model.optics.wavelength_nm / 2
    largest = _LARGEST * likelihood.model.nominal_amplitude
    # across the polarisation, the tilt has no slope: begin 20° aside
    aside = likelihood.model.optics.polarization_deg + 20.0
    box = np.array([reach, reach, 0.0, math.inf, math.inf, math.inf, 1.0])
    found = []
    # all over the half sphere; lying rods have half of the azimuths
    steps = [(tilt, (360.0 if tilt < 90 else 180.0) / count, count) for tilt, count in _RINGS]
    for azimuth, tilt in [(k * step, tilt) for tilt, step, count in steps for k in range(count)]:
        start = _start(likelihood, z_nm, rods, aside + azimuth, tilt)
        lower, upper = start - box, start + box
        lower[AMPLITUDE], upper[AMPLITUDE] = 0.0, largest
        end = fit_model(of_rods, np.minimum(start, upper), Box(free, lower, upper))
        found.append(replace(end, theta=_upwards(end.theta)))
    best = max(found, key=lambda each: each.log_likelihood)
    maxima = [each for each in found if each.converged or each is best]
    return _distinct(sorted(maxima, key=lambda each: -each.log_likelihood))


def judge(likelihood: Likelihood, direction: ModelFit, rod: Rod) -> tuple[float, float]:
    """Give the reduced χ² and the p-value of one maximum.

    The two angles are not among the parameters that were fitted, so that p is a little too large.
    """
    *_, azimuth, tilt, _ = direction.theta.tolist()
    model = TurningRod(likelihood.model, rod).turned(azimuth, tilt)
    angles = [AZIMUTH, TILT]
    free = np.isfinite(np.delete(direction.sigma, angles))
    theta = np.delete(direction.theta, angles)
    return goodness_of_fit(replace(likelihood, model=model), theta, free)


def axis_of(theta: FloatArray) -> FloatArray:
    """Give the unit vector along the rod."""
    azimuth, tilt = np.radians(theta[[AZIMUTH, TILT]])
    flat = math.sin(tilt)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.cos(tilt)])


def _start(
    likelihood: Likelihood, z_nm: float, rods: TurningRod, azimuth_deg: float, tilt_deg: float
) -> FloatArray:
    """Give θ where the picture of a direction correlates best with what the counts show."""
    model, grid = rods.turned(azimuth_deg, tilt_deg), likelihood.grid
    odd = PixelGrid.centred(min(grid.shape) // 2 * 2 - 1, grid.pixel_nm)
    picture = model.amplitude_image(odd, 0.0, 0.0, z_nm, model.nominal_amplitude)
    matched = correlate(np.nan_to_num(likelihood.measured_signal()), picture, mode="constant")
    margin = [int(EDGE_SHARE * size) for size in grid.shape]
    inside = tuple(slice(m, size - m) for m, size in zip(margin, grid.shape, strict=True))
    row, column = np.unravel_index(np.argmax(matched[inside]), matched[inside].shape)
    share = max(float(matched[inside][row, column] / np.sum(picture**2)), _LEAST_SHARE)
    amplitude = model.nominal_amplitude * (share if model.rho else math.sqrt(share))
    x, y = grid.x_nm[margin[1] + column], grid.y_nm[margin[0] + row]
    return np.array([x, y, z_nm, amplitude, azimuth_deg, tilt_deg, 0.0])


def _upwards(theta: FloatArray) -> FloatArray:
    """Turn the rod so that its tilt is 0 to 90°, and its azimuth 0 to 360° (lying: 180°)."""
    out, axis = theta.copy(), axis_of(theta)
    if axis[2] < 0:
        axis = -axis
    out[AZIMUTH] = math.degrees(math.atan2(axis[1], axis[0])) % 360
    out[TILT] = math.degrees(math.acos(min(axis[2], 1.0)))
    return out


def _distinct(found: list[ModelFit]) -> list[ModelFit]:
    """Leave out maxima that were found before."""
    kept: list[ModelFit] = []
    for one in found:
        if not any(_same(one, other) for other in kept):
            kept.append(one)
    return kept


def _same(one: ModelFit, other: ModelFit) -> bool:
    cosine = min(abs(float(axis_of(one.theta) @ axis_of(other.theta))), 1.0)
    gap = abs(one.log_likelihood - other.log_likelihood)
    return math.degrees(math.acos(cosine)) < 3.0 and gap < 0.1
