"""Fits of rods of any direction in regions of interest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from iscat_analysis.config import CameraConfig, Optics, Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import POOR_FIT_P
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.orientation import (
    AMPLITUDE,
    AZIMUTH,
    TILT,
    Direction,
    find_directions,
    judge,
)
from iscat_analysis.optics.rods import Rod, rod_of
from iscat_analysis.pieces.counts import gather
from iscat_analysis.pieces.setups import config_of
from iscat_analysis.records import Status, verdict

AMBIGUITY_ODDS = 1e-3
"""Likelihood of another direction, over that of the best, above which the row is flagged."""

WIDE_DEG = 5.0
"""Error of the direction above which it is flagged as well: it is no longer normal."""

_NAMES = {"x_nm": 0, "y_nm": 1, "mass_kda": AMPLITUDE, "azimuth_deg": AZIMUTH, "tilt_deg": TILT}


def fit_rods(
    before: ArrayLike,
    after: ArrayLike,
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    *,
    n_after: int,
    n_before: int,
    power_ratio: ArrayLike | None = None,
    level: bool | None = None,
    masked: ArrayLike | None = None,
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
    n_after, n_before : int
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
    config = config_of(optics, particle, camera, mode="mass")
    counts = gather(
        config, before, after, n_before=n_before, n_after=n_after, power_ratio=power_ratio,
        level=level, masked=masked,
    )  # fmt: skip
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


def _row(likelihood: Likelihood, found: list[Direction], rod: Rod) -> dict[str, Any]:
    """Put the maxima of one region into a row."""
    best, *others = found
    chi2, p_value = judge(likelihood, best, rod)
    odds, other = math.nan, np.full(len(best.theta), math.nan)
    if others:
        odds = math.exp(others[0].log_likelihood - best.log_likelihood)
        other = others[0].theta
    flags = []
    if not best.converged:
        flags.append(Status.NOT_CONVERGED)
    if p_value < POOR_FIT_P:
        flags.append(Status.POOR_FIT)
    wide = max(best.sigma[TILT], best.sigma[AZIMUTH] * math.sin(math.radians(best.theta[TILT])))
    if odds > AMBIGUITY_ODDS or not wide < WIDE_DEG:
        flags.append(Status.AMBIGUOUS_DIRECTION)
    values = {name: float(best.theta[k]) for name, k in _NAMES.items()}
    sigmas = {f"sigma_{name}": float(best.sigma[k]) for name, k in _NAMES.items()}
    return {
        **values,
        **sigmas,
        "maxima": len(found),
        "other_azimuth_deg": float(other[AZIMUTH]),
        "other_tilt_deg": float(other[TILT]),
        "other_mass_kda": float(other[AMPLITUDE]),
        "other_odds": odds,
        "chi2_reduced": chi2,
        "p_value": p_value,
        "status": str(verdict(flags)[0]),
    }
