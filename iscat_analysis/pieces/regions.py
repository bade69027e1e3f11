"""Regions of interest: fits of many into one table, and the log-likelihood of one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from iscat_analysis import records
from iscat_analysis.bounds import event_bounds
from iscat_analysis.config import CameraConfig, Config, Optics, Particle, refuse_rod
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import number_in, real_array
from iscat_analysis.inference.fit import compile_kernels, fit_particle, without_particle
from iscat_analysis.inference.heights import has_prior, height_prior
from iscat_analysis.inference.likelihood import LARGEST_LEVEL, LEVEL, Likelihood
from iscat_analysis.optics.sized import SeatedModel, SizedModel
from iscat_analysis.options import only, takes
from iscat_analysis.pieces.counts import (
    Counts,
    FitOptions,
    ImageOptions,
    LightOptions,
    LikelihoodOptions,
    ModelOptions,
    config_of,
    gather,
)
from iscat_analysis.records import (
    FREE_PARAMETERS,
    PARAMETERS,
    Candidate,
    ComplexArray,
    FitResult,
    FloatArray,
    Status,
)
from iscat_analysis.search.templates import Templates, make_templates, signal_to_noise
from iscat_analysis.text import brief
from iscat_analysis.threads import threads

SATURATION_NM = 500.0
"""A fit is flagged if a saturated pixel is nearer than this."""

FALSE_ALARMS_PER_REGION = 0.01
"""Share of regions without a particle in which the highest peak of the noise is taken for one; the
others are ``not_detected``."""

EDGE_SHARE = 0.15
"""Share of the region's side at each edge where a particle is not looked for."""


@takes(FitOptions)
def fit_rois(
    before: ArrayLike | None = None,
    after: ArrayLike | None = None,
    optics: Optics | None = None,
    particle: Particle | None = None,
    camera: CameraConfig | None = None,
    **options: Unpack[FitOptions],
) -> pd.DataFrame:
    """Fit one particle in each of many regions, from counts or from contrast images.

    Give `before`, `after`, `n_before` and `n_after`; or `contrast` and `sigma`; or `contrast` and
    its light, as `before`, `n_before` and `n_after`; and always `optics`, `particle` and `camera`.

    Parameters
    ----------
    before : array_like, shape (n, y, x)
        Photoelectrons summed over the frames before [e].  With ``n_before=0`` the background is
        known, and this is its expectation for one frame: an array, an image (y, x) or a number.
    after : array_like, shape (n, y, x)
        Photoelectrons summed over the frames with the particle [e].
    optics : Optics
        The microscope.
    particle : Particle
        Its material, and the height or mass that a mode holds fixed.
    camera : Camera
        Pixel size, samples per pixel and read noise.
    n_before, n_after : int
        Frames in the sums; ``n_before=0`` where the background is known.
    power_ratio : array_like, optional
        Light after over light before, one number or one for each region, where it is known from a
        larger field; default the ratio of the frames, with `level` fitted.
    level : bool, optional
        Whether a common level of the light is fitted as a nuisance; default where the background
        is measured, interferes, and no `power_ratio` is given.  A level that contrasts have in
        common is one too.
    masked : array_like of bool, shape (n, y, x) or (y, x), optional
        Pixels to leave out.
    contrast : array_like, shape (n, y, x), optional
        Contrast images in place of counts: light over the light without the particle, minus 1.
    sigma : float or array_like, shape (n, y, x) or (y, x), optional
        Standard deviation of the noise of every pixel of `contrast`, which is taken as normal and
        independent from pixel to pixel.  `n_scattered` and ``qcrb_…`` are then unknown.
    saturated : array_like of bool, shape (n, y, x) or (y, x), optional
        Pixels to leave out as well; a fit near them is flagged.
    mode : {"mass", "localize", "joint", "size"}
        Which parameters are free: x, y and mass; x, y and z; all four; x, y, z and the diameter
        of a sphere.
    z_range_nm : (float, float)
        Heights that are searched where z is free [nm].
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.
    corners_px : array_like, shape (n, 2), optional
        Row and column of each region's first pixel in the full frame, added to the positions.
    workers : int
        Number of threads; it has no effect on the result.

    Returns
    -------
    pandas.DataFrame
        One row for each region, in their order, with the columns of ``fits.csv``.  `frame` is
        empty: sums do not say when.  A region in which no particle stands out from the noise is
        ``not_detected``; noise alone does in at most 1 of 100.  One without half of its pixels is
        ``not_converged`` and has no estimate.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An array has another shape, holds no real numbers, or is not finite in an unmasked pixel.

    Notes
    -----
    Likelihood, estimator, bounds and flags are those of `fit_movie` and `iscat-fit`, which also
    find the regions and take neighbours into account.

    Detection compares the likelihood with that of no particle.  Its threshold takes into account
    that the best place, and height where it is free, was searched in the whole region: Adler and
    Taylor, Random Fields and Geometry (2007), section 12.4.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics, camera = ia.Optics(na=1.42, focus_nm=-500), ia.Camera(pixel_size_nm=84.4)
    >>> protein, line = ia.Particle(mass_kda=480), ia.Calibration(gradient_per_kda=-3.1e-5)
    >>> light = 200 * 1e4 * (1 + ia.psf(optics, protein, camera, calibration=line))
    >>> counts = np.random.default_rng(1).poisson([np.full_like(light, 200 * 1e4), light])
    >>> table = ia.fit_rois(counts[:1], counts[1:], optics, protein, camera, calibration=line,
    ...                     n_before=200, n_after=200)
    >>> abs(table.mass_kda[0] - 480) < 4 * table.sigma_mass_kda[0]
    np.True_

    Contrast images, with the noise of a pixel of a difference of 200 frames from 200:

    >>> images = counts[1:] / counts[:1] - 1
    >>> table = ia.fit_rois(optics=optics, particle=protein, camera=camera, calibration=line,
    ...                     contrast=images, sigma=(2 / (200 * 1e4)) ** 0.5)
    >>> abs(table.mass_kda[0] - 480) < 4 * table.sigma_mass_kda[0]
    np.True_
    """
    setup = optics, particle, camera
    config = _round_particles("its direction has to be fitted too", options, *setup)
    counts = gather(config, before, after, **only(ImageOptions, options))
    count = len(counts.after)
    corners_px = options["corners_px"]
    corners = np.zeros((count, 2)) if corners_px is None else real_array("corners_px", corners_px)
    if corners.shape != (count, 2) or not np.all(np.isfinite(corners)):
        raise DataError(f"corners_px: has shape {corners.shape}; give {(count, 2)} finite numbers")
    n_threads = int(number_in("workers", options["workers"], least=1, whole=True))
    templates = templates_of(counts)
    compile_kernels(counts.model, heights=config.fit.heights_free or has_prior(config))
    with threads(n_threads) as pool:
        rows = list(pool.map(lambda i: _row(counts, templates, i, corners[i]), range(count)))
    table = records.make_rows(rows, {"event": range(count)})
    if config.fit.kind.fits_sizes:
        table = records.with_diameters(table, config.particle.density)
    refused = bool(counts.model.scale.refusal)
    return records.flagged(table, Status.UNCALIBRATED_OPTICS) if refused else table


def _round_particles(what: str, options: Any, *setup: Any) -> Config:
    """Put a set-up together; refuse the mode that is of tracks, and rods."""
    config = config_of(*setup, **only(ModelOptions, options))
    if config.fit.follows_tracks:
        raise ConfigError('mode = "track" links frames: give "joint", frame by frame')
    refuse_rod(config, what)
    return config


def templates_of(counts: Counts) -> Templates:
    """Make the matched filter of a region, with the threshold of its detection."""
    config, grid = counts.config, counts.grid
    alarms = {"false_alarms_per_movie": FALSE_ALARMS_PER_REGION}
    return make_templates(
        counts.model,
        config.detection.model_copy(update=alarms),
        pixel_nm=grid.pixel_nm,
        roi_nm=min(grid.shape) * grid.pixel_nm,
        z_range_nm=config.fit.z_range_nm if "z_nm" in FREE_PARAMETERS[config.fit.mode] else None,
        field_px=grid.shape,
    )


def line_of(
    likelihood: Likelihood,
    fit: FitResult,
    collected: float,
    flags: Iterable[Status],
    *,
    sign: int = 1,
    quantum: ComplexArray | None = None,
) -> dict[str, Any]:
    """Put a fit and its bounds into a row of the table, which has no number and no frames yet.

    Shapes: `quantum` (4, 4).
    """
    model, pixel_nm = likelihood.model, likelihood.grid.pixel_nm
    level = bool(fit.box.free[LEVEL])
    bounds = event_bounds(
        likelihood, fit.estimate, fit.free, collected, quantum=quantum, level=level
    )
    row: dict[str, Any] = {
        "x_px": fit.x_nm / pixel_nm,
        "y_px": fit.y_nm / pixel_nm,
        "x_nm": fit.x_nm,
        "y_nm": fit.y_nm,
        "z_nm": fit.z_nm,
        "mass_kda": sign * fit.mass_kda,
        "contrast": sign * fit.contrast if model.rho else np.nan,
        "n_scattered": collected,
        "snr": fit.snr,
        "chi2_reduced": fit.chi2_reduced,
        "p_value": fit.p_value,
        **_status_of(flags),
    }
    for k, name in enumerate(PARAMETERS):
        row[f"sigma_{name}"] = fit.sigma[k]
        row[f"crb_{name}"] = bounds.crb_joint[k]
        row[f"qcrb_{name}"] = bounds.qcrb[k]
    if isinstance(model, SeatedModel):
        return row | _without_mass(model, fit, row)
    if not isinstance(model, SizedModel):
        return row
    return row | sizes_of(model, fit) | _index_of(model, fit)


def _status_of(flags: Iterable[Status]) -> dict[str, str]:
    status, noticed = records.verdict(flags)
    return {"status": str(status), "flags": ";".join(str(flag) for flag in noticed)}


def _index_of(model: SizedModel, fit: FitResult) -> dict[str, float]:
    """Give the index where it was fitted, and bounds with it, which are the errors."""
    if not math.isfinite(fit.sigma_index):
        return {}
    return {f"crb_{name}": float(fit.sigma[k]) for k, name in enumerate(PARAMETERS)} | {
        "refractive_index": model.sphere.index.real,
        "sigma_refractive_index": fit.sigma_index,
    }


def _without_mass(model: SeatedModel, fit: FitResult, row: Mapping[str, Any]) -> dict[str, Any]:
    """Give the diameter of a sphere on the coverslip in the place of a mass."""
    diameter = model.sphere.of_mass(fit.mass_kda).diameter_nm
    slope = diameter / (3 * fit.mass_kda)
    kinds = ("sigma", "crb", "qcrb")
    sizes = {f"{kind}_diameter_nm": slope * row[f"{kind}_mass_kda"] for kind in kinds}
    if model.fits_index:  # whose error is from the expected information, index and all
        sizes["crb_diameter_nm"] = sizes["sigma_diameter_nm"]
        sizes["refractive_index"] = model.sphere.index.real
        sizes["sigma_refractive_index"] = fit.sigma_index
    return {
        "z_nm": model.centre_nm(fit.z_nm, fit.mass_kda),
        **dict.fromkeys(("mass_kda", *(f"{kind}_mass_kda" for kind in kinds)), math.nan),
        "model": model.name,
        "diameter_nm": diameter,
        **sizes,
        **sizes_of(model, fit),
    }


def sizes_of(model: SizedModel, fit: FitResult) -> dict[str, float]:
    """Give the probability of the diameter, and the next likely one with its odds, if any."""
    own = {"diameter_probability": fit.size_probability}
    others = [other for other in fit.alternatives if math.isfinite(other.log_likelihood_gap)]
    if not others or "mass_kda" not in fit.free:
        return own | {"other_diameter_nm": math.nan, "other_odds": math.nan}
    sphere = model.sphere.of_mass(others[0].mass_kda)
    return own | {
        "other_diameter_nm": sphere.diameter_nm,
        "other_odds": math.exp(-others[0].log_likelihood_gap),
    }


def _row(counts: Counts, templates: Templates, index: int, corner: FloatArray) -> dict[str, Any]:
    """Fit one region."""
    likelihood = counts.likelihood(index)
    config, model, pixel_nm = counts.config, counts.model, counts.grid.pixel_nm
    saturated = counts.saturated[index]
    frames = {"frame": None, "n_before": counts.n_before, "n_after": counts.n_after}
    # half of the pixels must be usable
    if likelihood.n_pixels < 0.5 * saturated.size:
        flags = [Status.NOT_CONVERGED, *([Status.SATURATED] if saturated.any() else [])]
        return frames | _status_of(flags)
    start = _start(likelihood, templates, level=counts.level)
    free = FREE_PARAMETERS[config.fit.mode]
    if "mass_kda" not in free:
        start = replace(start, mass_kda=model.material.mass_kda)
    if "z_nm" not in free:
        start = replace(start, z_nm=config.particle.mean_height_nm(start.mass_kda))
    prior = height_prior(config, start.mass_kda)
    if prior is not None:
        likelihood = replace(likelihood, prior=prior)
    fit = fit_particle(
        likelihood, start, config.fit.mode, config.fit.z_range_nm, level=counts.level
    )
    flags = list(fit.flags)
    if not fit.snr > templates.threshold:
        flags.append(Status.NOT_DETECTED)
    if saturated_near(saturated, fit.x_nm, fit.y_nm, pixel_nm):
        flags.append(Status.SATURATED)
    collected = counts.collected(index, fit.z_nm, fit.mass_kda)
    there = fit.shifted(corner[1] * pixel_nm, corner[0] * pixel_nm)
    return frames | line_of(likelihood, there, collected, flags)


def saturated_near(
    saturated: NDArray[np.bool_],
    x_nm: float,
    y_nm: float,
    pixel_nm: float,
    *,
    corner: tuple[int, int] = (0, 0),
) -> bool:
    """Tell whether a saturated pixel is near a fitted particle.

    Shapes: `saturated` (rows, columns).
    """
    rows, columns = np.nonzero(saturated)
    dx = (columns + corner[1]) * pixel_nm - x_nm
    dy = (rows + corner[0]) * pixel_nm - y_nm
    return bool(np.any(np.hypot(dx, dy) < SATURATION_NM))


def _start(likelihood: Likelihood, templates: Templates, *, level: bool) -> Candidate:
    """Where the matched filter is largest, away from the edges of the region.

    Where the level is not known, its mean over the region is no particle.
    """
    common: FloatArray | None = None
    if level:
        used, signal = likelihood.used, likelihood.measured_signal()
        weight = likelihood.signal_information()[used]
        common = np.full(signal.shape, np.average(signal[used], weights=weight))
    snr, strength = signal_to_noise(likelihood, templates, common)
    ranked = np.abs(snr) if templates.two_sided else snr
    rows, columns = likelihood.grid.shape
    inner = np.full(ranked.shape, -np.inf)
    top, left = (int(EDGE_SHARE * size) for size in (rows, columns))
    inside = (slice(None), slice(top, rows - top), slice(left, columns - left))
    inner[inside] = ranked[inside]
    k, row, column = (int(i) for i in np.unravel_index(np.argmax(inner), inner.shape))
    amplitude = float(strength[k, row, column])
    if templates.quadratic:
        amplitude = math.sqrt(max(amplitude, 0.0))
    return Candidate(
        x_px=float(column),
        y_px=float(row),
        z_nm=float(templates.z_nm[k]),
        mass_kda=float(likelihood.model.scale.mass(np.asarray(amplitude))),
        snr=float(snr[k, row, column]),
    )


MASS = PARAMETERS.index("mass_kda")


@dataclass(frozen=True)
class LogLikelihood:
    """A function of θ = the free parameters in nm and kDa; build it with `log_likelihood`.

    Calling it gives the log-likelihood relative to no particle, −∞ outside the support.

    Attributes
    ----------
    names : tuple of str
        Columns of θ: a subset of x_nm, y_nm, z_nm, mass_kda in this order, then log_level if it
        is fitted.
    lower, upper : ndarray, shape (k,)
        The support: the region's edges, the heights searched, the possible masses (0 to ∞, or any
        mass if particles of either sign are possible).
    detected_above : float
        Log-likelihood that noise alone exceeds in at most 1 of 100 regions without a particle, for
        some θ: `fit_rois` calls a region ``not_detected`` whose maximum is not higher.
    """

    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    detected_above: float
    _likelihood: Likelihood
    _fixed: FloatArray

    __repr__ = brief

    def __call__(self, theta: ArrayLike) -> FloatArray:
        """Log-likelihood.

        Parameters
        ----------
        theta : array_like, shape (n, k) or (k,)
            Points.

        Returns
        -------
        ndarray, shape (n,) or ()
            One value for each point.

        Raises
        ------
        DataError
            The shape is another, or the values are no real numbers.
        """
        points, inside = self._points(theta)
        out = np.full(len(points), -np.inf)
        out[inside] = self._likelihood.values(self._inner(points[inside]))
        return out.reshape(np.shape(theta)[:-1])

    def value_and_gradient(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood and its gradient.

        Parameters
        ----------
        theta : array_like, shape (n, k) or (k,)
            Points.

        Returns
        -------
        value : ndarray, shape (n,) or ()
            As a call gives it.
        gradient : ndarray, shape (n, k) or (k,)
            Derivatives [1/nm, 1/kDa, 1]; NaN outside the support.

        Raises
        ------
        DataError
            The shape is another, or the values are no real numbers.
        """
        points, inside = self._points(theta)
        value = np.full(len(points), -np.inf)
        gradient = np.full(points.shape, np.nan)
        scale = self._likelihood.model.scale
        index = self._index
        for i in np.flatnonzero(inside):
            inner = self._inner(points[i : i + 1])[0]
            value[i], score, _ = self._likelihood.score_fisher(inner)
            score[MASS] /= scale.slope(float(inner[MASS]))
            gradient[i] = score[index]
        shape = np.shape(theta)
        return value.reshape(shape[:-1]), gradient.reshape(shape)

    def gradient(self, theta: ArrayLike) -> FloatArray:
        """Gradient of the log-likelihood.

        Parameters
        ----------
        theta : array_like, shape (n, k) or (k,)
            Points.

        Returns
        -------
        ndarray, shape (n, k) or (k,)
            As `value_and_gradient` gives it.

        Raises
        ------
        DataError
            The shape is another, or the values are no real numbers.
        """
        return self.value_and_gradient(theta)[1]

    @property
    def _index(self) -> list[int]:
        return [LEVEL if n == "log_level" else PARAMETERS.index(n) for n in self.names]

    def _points(self, theta: ArrayLike) -> tuple[FloatArray, NDArray[np.bool_]]:
        points = real_array("theta", theta)
        k = len(self.names)
        if points.ndim not in (1, 2) or points.shape[-1] != k:
            raise DataError(
                f"theta: has shape {points.shape}; give (n, {k}) or ({k},) for "
                f"{', '.join(self.names)}"
            )
        points = points.reshape(-1, k)
        inside = np.all((points >= self.lower) & (points <= self.upper), axis=1)
        return points, inside & np.all(np.isfinite(points), axis=1)

    def _inner(self, points: FloatArray) -> FloatArray:
        """Turn points into parameters of the kernels: with amplitudes, and fixed parameters."""
        inner = np.tile(self._fixed, (len(points), 1))
        inner[:, self._index] = points
        if "mass_kda" in self.names:
            amplitude = self._likelihood.model.scale.amplitude
            inner[:, MASS] = [amplitude(float(mass)) for mass in inner[:, MASS]]
        return inner


@takes(LikelihoodOptions)
def log_likelihood(
    before: ArrayLike,
    after: ArrayLike,
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    **options: Unpack[LikelihoodOptions],
) -> LogLikelihood:
    """Give the log-likelihood of a region as a function of the particle in it.

    Parameters
    ----------
    before : array_like, shape (y, x)
        Photoelectrons summed over the frames before [e]; with ``n_before=0`` the known background
        of one frame, which may be a number.
    after : array_like, shape (y, x)
        Photoelectrons summed over the frames with the particle [e].
    optics : Optics
        The microscope.
    particle : Particle
        Its material, and the height or mass that a mode holds fixed.
    camera : Camera
        Pixel size, samples per pixel and read noise.
    n_before, n_after : int
        Frames in the sums; ``n_before=0`` where the background is known.
    power_ratio : float, optional
        Light after over light before; by default the ratio of the frames, with `level` free.
    level : bool, optional
        Whether the logarithm of a common level is a parameter too; default as in `fit_rois`.
    masked : array_like of bool, shape (y, x), optional
        Pixels to leave out.
    mode : {"mass", "localize", "joint", "size"}
        Which parameters are free.
    z_range_nm : (float, float)
        Heights that are possible where z is free [nm].
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.

    Returns
    -------
    LogLikelihood
        Call it with θ of shape (n, k) or (k,); x and y count from the centre of the region's first
        pixel.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An array has another shape, holds no real numbers, or is not finite in an unmasked pixel.

    Notes
    -----
    Given the sum of the counts before and after, those after are binomial, and the unknown
    background drops out; if the background is known, they are Poissonian.  `fit_rois` maximises
    the same function.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics, camera = ia.Optics(na=1.42, focus_nm=-500), ia.Camera(pixel_size_nm=84.4)
    >>> gold = ia.Particle(kind="gold", diameter_nm=20)
    >>> light = 1e6 * (1 + ia.psf(optics, gold, camera, pixels=21))
    >>> logl = ia.log_likelihood(1e4, light, optics, gold, camera, n_before=0, n_after=100)
    >>> logl.names
    ('x_nm', 'y_nm', 'mass_kda')
    >>> at = [844.0, 844.0, 48_700.0]
    >>> bool(logl(at) > logl([900.0, 844.0, 48_700.0])), logl.gradient(at).shape
    (True, (3,))
    """
    what = "the angles are no parameters of log_likelihood"
    config = _round_particles(what, options, optics, particle, camera)
    image, known = real_array("after", after), real_array("before", before)
    if image.ndim != 2:
        raise DataError(f"after: has shape {image.shape}; give one region as (y, x)")
    background = known if known.ndim < 2 else known[None]
    counts = gather(config, background, image[None], **only(LightOptions, options))
    model, grid, names = counts.model, counts.grid, config.fit.free
    half = grid.pixel_nm / 2
    z_low_nm, z_high_nm = config.fit.z_range_nm
    signed = "z_nm" not in names and model.rho > 0
    lower = [grid.x_nm[0] - half, grid.y_nm[0] - half, z_low_nm, -np.inf if signed else 0.0]
    upper = [grid.x_nm[-1] + half, grid.y_nm[-1] + half, z_high_nm, np.inf]
    free = [PARAMETERS.index(name) for name in names]
    if counts.level:
        names, free = (*names, "log_level"), [*free, LEVEL]
    amplitude = model.scale.amplitude(model.material.mass_kda)
    likelihood = counts.likelihood(0)
    fixed = np.array([0.0, 0.0, particle.nominal_height_nm, amplitude, 0.0])
    alone = np.array([False] * LEVEL + [counts.level])
    around = records.Box(alone, fixed - alone * LARGEST_LEVEL, fixed + alone * LARGEST_LEVEL)
    nothing = without_particle(likelihood, fixed, around)
    return LogLikelihood(
        names=names,
        lower=np.array([*lower, -LARGEST_LEVEL])[free],
        upper=np.array([*upper, LARGEST_LEVEL])[free],
        detected_above=nothing + templates_of(counts).threshold ** 2 / 2,
        _likelihood=likelihood,
        _fixed=fixed,
    )
