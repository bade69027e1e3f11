"""The log-likelihood of one region, for any sampler or optimiser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.config import Calibration, CameraConfig, Optics, Particle, refuse_rod
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import real_array
from iscat_analysis.inference.fit import without_particle
from iscat_analysis.inference.likelihood import LARGEST_LEVEL, LEVEL, Likelihood
from iscat_analysis.pieces.counts import gather
from iscat_analysis.pieces.regions import templates_of
from iscat_analysis.pieces.setups import config_of
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, Box

FloatArray = NDArray[np.float64]

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


def log_likelihood(
    before: ArrayLike,
    after: ArrayLike,
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    *,
    n_after: int,
    n_before: int,
    mode: str = "mass",
    power_ratio: float | None = None,
    level: bool | None = None,
    z_range_nm: tuple[float, float] = (0.0, 1000.0),
    masked: ArrayLike | None = None,
    calibration: Calibration | None = None,
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
    n_after, n_before : int
        Frames in the sums; ``n_before=0`` where the background is known.
    mode : {"mass", "localize", "joint", "size"}
        Which parameters are free.
    power_ratio : float, optional
        Light after over light before; by default the ratio of the frames, with `level` free.
    level : bool, optional
        Whether the logarithm of a common level is a parameter too; default as in `fit_rois`.
    z_range_nm : (float, float)
        Heights that are possible where z is free [nm].
    masked : array_like of bool, shape (y, x), optional
        Pixels to leave out.
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
    config = config_of(
        optics, particle, camera, mode=mode, z_range_nm=z_range_nm, calibration=calibration
    )
    refuse_rod(config, "the angles are no parameters of log_likelihood")
    if mode == "track":
        raise ConfigError('mode = "track" links frames: give "joint", frame by frame')
    image, known = real_array("after", after), real_array("before", before)
    if image.ndim != 2:
        raise DataError(f"after: has shape {image.shape}; give one region as (y, x)")
    counts = gather(
        config, known if known.ndim < 2 else known[None], image[None],
        n_before=n_before, n_after=n_after, power_ratio=power_ratio, level=level, masked=masked,
    )  # fmt: skip
    model, grid = counts.model, counts.grid
    half = grid.pixel_nm / 2
    z_low_nm, z_high_nm = config.fit.z_range_nm
    signed = "z_nm" not in FREE_PARAMETERS[mode] and model.rho > 0
    lower = [grid.x_nm[0] - half, grid.y_nm[0] - half, z_low_nm, -np.inf if signed else 0.0]
    upper = [grid.x_nm[-1] + half, grid.y_nm[-1] + half, z_high_nm, np.inf]
    names = FREE_PARAMETERS[mode]
    free = [PARAMETERS.index(name) for name in names]
    if counts.level:
        names, free = (*names, "log_level"), [*free, LEVEL]
    amplitude = model.scale.amplitude(model.material.mass_kda)
    likelihood = counts.likelihood(0)
    fixed = np.array([0.0, 0.0, particle.nominal_height_nm, amplitude, 0.0])
    alone = np.array([False] * LEVEL + [counts.level])
    around = Box(alone, fixed - alone * LARGEST_LEVEL, fixed + alone * LARGEST_LEVEL)
    nothing = without_particle(likelihood, fixed, around)
    return LogLikelihood(
        names=names,
        lower=np.array([*lower, -LARGEST_LEVEL])[free],
        upper=np.array([*upper, LARGEST_LEVEL])[free],
        detected_above=nothing + templates_of(counts).threshold ** 2 / 2,
        _likelihood=likelihood,
        _fixed=fixed,
    )
