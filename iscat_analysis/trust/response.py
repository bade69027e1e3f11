"""Response of the estimates to optics that differ from the assumed ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from iscat_analysis.bounds import joint_information, peak_gradient
from iscat_analysis.bounds.experiment import expected_likelihood
from iscat_analysis.config import ABERRATIONS, Config, Optics, OpticsCovariance
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.maximiser import eliminated, imitation
from iscat_analysis.inference.models import SphereOfIndex
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model, peak_per_amplitude
from iscat_analysis.optics.parameters import prior_of
from iscat_analysis.optics.sized import SizedModel
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, BoolArray, FloatArray

COMMON = (*PARAMETERS, "contrast")
"""What such errors are told of; of the contrast where it is the result, without a calibration."""

_AMPLITUDES = 4  # at which the response to the optics is computed, for the span of all events


class Shifts(NamedTuple):
    """Shifts of a fit whose image differs from the model.

    Attributes
    ----------
    amplitude : float
        Shift of ln a.
    optics : ndarray
        Shifts of the learned optics, (k,).
    left : float
        Share of the information about the difference that learned optics do not imitate.
    """

    amplitude: float
    optics: FloatArray
    left: float


@dataclass(frozen=True)
class Response:
    """Derivatives of the estimates of a particle with respect to the optics."""

    model: ForwardModel  # with masses that are amplitudes
    grid: PixelGrid
    names: tuple[str, ...]
    free: tuple[bool, ...]
    level: bool
    frames: tuple[int, int]
    contrast: bool
    prior: FloatArray  # (k,), standard deviations of the parameters before images were seen
    posterior: FloatArray  # (k, k), covariance of learned parameters, 0 of known ones

    def expected(self, theta: FloatArray) -> Likelihood:
        """Likelihood of the expected counts of a particle.

        Shapes: `theta` (5,).
        """
        return expected_likelihood(self.model, self.grid, theta, (1.0, 1.0), self.frames)

    def theta(self, z_nm: float, amplitude: float) -> FloatArray:
        """Parameters of a particle at the centre of the region, (5,)."""
        x, y = float(np.mean(self.grid.x_nm)), float(np.mean(self.grid.y_nm))
        return np.array([x, y, z_nm, amplitude, 0.0])

    def at(self, z_nm: float, amplitudes: FloatArray) -> FloatArray:
        """D of (x, y, z [nm], ln a, ln contrast) per unit of each parameter, (amplitudes, 5, k).

        The contrast is left at 0 where it is not the result.
        """
        count, kept = len(self.names), self._kept
        chosen = np.concatenate([np.arange(count), count + kept])
        out = np.zeros((len(amplitudes), len(COMMON), count))
        for index, amplitude in enumerate(amplitudes):
            theta = self.theta(z_nm, float(amplitude))
            whole = joint_information(self.expected(theta), theta, self.names)
            moved = np.zeros((theta.size, count))
            moved[kept] = imitation(whole[np.ix_(chosen, chosen)], count)
            out[index, :3] = moved[:3]
            out[index, 3] = moved[3] / amplitude
            if self.contrast:
                contrast, own, shared = peak_gradient(self.model, z_nm, amplitude, self.names)
                out[index, 4] = (own @ moved[:4] + shared) / contrast
        return out

    def faint(self) -> FloatArray:
        """Relative shift of the amplitude of a faint particle at the model's height, (k,)."""
        moved: FloatArray = self.at(self.model.height_nm, np.array([self.faint_amplitude]))[0, 3]
        return moved

    def to_contrast(self, z_nm: float, amplitude: float, *, index: bool = False) -> float:
        """Relative shift of the amplitude per share by which a picture is stronger.

        With the index of the sphere free, that takes its part of the difference.
        """
        signal, _ = self.model.signal(self.grid, self.theta(z_nm, amplitude)[:4])
        return self.to_input(signal, amplitude, z_nm=z_nm, index=index).amplitude

    @property
    def faint_amplitude(self) -> float:
        """Amplitude of a particle whose scattered light alone is negligible."""
        return 1e-6 / peak_per_amplitude(self.model)

    def to_input(
        self,
        derivative: FloatArray,
        amplitude: float,
        *,
        z_nm: float | None = None,
        index: bool = False,
    ) -> Shifts:
        """Shift of ln a and of the optics where images differ by a derivative from the model.

        Parameters of the optics that were learned from such images imitate the difference as far
        as images and prior let them, and the particle the rest, with the index of a sphere if it
        is free.

        Shapes: `derivative` (ny, nx).
        """
        theta = self.theta(self.model.height_nm if z_nm is None else z_nm, amplitude)
        others = [derivative]
        if index and isinstance(self.model, SizedModel):
            values = (*theta[:4], self.model.sphere.index.real)
            others.append(SphereOfIndex(self.model).signal(self.grid, values)[1][-1])
        whole = joint_information(self.expected(theta), theta, self.names, others)
        count, all_others = 1 + len(self.names), len(others) + len(self.names)
        shared = np.delete(np.arange(all_others), np.arange(1, len(others)))
        chosen = np.concatenate([shared, np.arange(1, len(others)), all_others + self._kept])
        whole = whole[np.ix_(chosen, chosen)]
        information = eliminated(whole, count)
        optics = self._learned(information[1:, 1:], information[1:, 0])
        moved = imitation(whole, count)
        row = len(others) - 1 + int(np.flatnonzero(self._kept == PARAMETERS.index("mass_kda"))[0])
        left = 1 - float(information[0, 1:] @ optics) / float(information[0, 0])
        return Shifts(float(moved[row, 1:] @ optics - moved[row, 0]) / amplitude, optics, left)

    def _learned(self, information: FloatArray, wrong: FloatArray) -> FloatArray:
        """Change of learned optics where images of particles are wrong in the same way.

        With N the information of one image about the optics, i what it has in common with the
        difference, and P the prior's covariance, images of m particles change the optics by
        (m N + P⁻¹)⁻¹ m i.  The errors C that the optics were learned with tell how many there
        were: det(1 + m P N) = det P / det C.

        Shapes: `information` (k, k), `wrong` (k,), result (k,).
        """
        both = np.outer(self.prior, self.prior)
        left = np.clip(np.linalg.eigvalsh(self.posterior / both), 1e-12, 1.0)
        gained = -float(np.log(left).sum())
        values, vectors = np.linalg.eigh(information * both)
        values = np.maximum(values, 0.0)
        if gained <= 0 or not values.any():
            return np.zeros(wrong.size)

        def beyond(log_number: float) -> float:
            return float(np.log1p(np.exp(log_number) * values).sum()) - gained

        least, most = np.log(gained / values.sum()), gained - np.log(values.max())
        number = np.exp(scipy.optimize.brentq(beyond, least, most))
        asked = vectors.T @ (self.prior * wrong)
        return np.asarray(self.prior * (vectors @ (number * asked / (1 + number * values))))

    def to_width(self, amplitude: float) -> Shifts:
        """Shifts per variance of the places of a particle along each axis [1/nm²]."""
        theta = self.theta(self.model.height_nm, amplitude)
        rows = self.expected(theta).derivatives(theta)
        # rows of ∂xx and ∂yy
        return self.to_input((rows[:, 5] + rows[:, 7]) / 2, amplitude)

    @property
    def _kept(self) -> NDArray[np.intp]:
        return np.flatnonzero([*self.free, self.level])


def response_of(
    config: Config,
    table: pd.DataFrame,
    names: Sequence[str] | None = None,
    *,
    contrast: bool = False,
) -> Response:
    """Give the response of the particles of a movie, of as many frames as its events have.

    It is to errors of the named parameters, or of those of the middle of the field that were
    learned.
    """
    pixel = config.camera.pixel_size_nm
    if pixel is None:
        raise ConfigError("camera.pixel_size_nm is needed")
    grid = PixelGrid.centred(config.roi_px, pixel)
    bare = config.changed(calibration=None)
    errors = config.optics.covariance or OpticsCovariance(names=(), matrix=())
    learned = errors.of_the_middle
    names = learned.names if names is None else tuple(names)
    matrix = learned.matrix if names == learned.names else np.zeros((len(names), len(names)))
    return Response(
        forward_model(bare, 1.05 * grid.diagonal_nm / 2),
        grid,
        names,
        tuple(name in FREE_PARAMETERS[config.fit.mode] for name in PARAMETERS),
        level=config.background.slides,
        frames=(int(table["n_before"].median()), int(table["n_after"].median())),
        contrast=contrast,
        prior=prior_of(config).errors(names),
        posterior=np.array(matrix).reshape(len(names), len(names)),
    )


def has_own_index(table: pd.DataFrame) -> BoolArray:
    """Tell of which rows the index of the sphere was fitted."""
    if "refractive_index" not in table:
        return np.zeros(len(table), dtype=np.bool_)
    return np.asarray(table["refractive_index"].notna(), dtype=np.bool_)


def at_standards(config: Config) -> Config:
    """Give the configuration with which the standards of the calibration were seen.

    Their heights were known, their masses fitted.
    """
    line = config.calibration
    if line is None or line.optics is None:
        return config
    height = config.particle.nominal_height_nm if line.height_nm is None else line.height_nm
    pixel = None if line.camera is None else line.camera.pixel_size_nm
    return config.changed(
        optics=line.optics.model_copy(update={"covariance": line.covariance}),
        particle=config.particle.held_at(height),
        camera={} if pixel is None else {"pixel_size_nm": pixel},
        fit={"mode": "mass"},
    )


def standards_share(config: Config) -> bool:
    """Tell whether the optics of the standards are those of the movie, errors included.

    Line and contrasts are then off by the same factor, that of a faint particle, and only what
    others have beyond it remains.
    """
    line, optics = config.calibration, config.optics
    if line is None:
        return False
    if line.optics is None:
        return True
    names = optics.covariance.of_the_middle.names if optics.covariance is not None else ()
    here, there = _settings_of(optics, names), _settings_of(line.optics, names)
    return line.covariance == optics.covariance and np.allclose(here, there, rtol=1e-9, atol=0)


def _settings_of(optics: Optics, names: Sequence[str]) -> FloatArray:
    """Give measurable parameters of optics.

    Shapes: result (len(names),).
    """
    terms = optics.aberrations_nm
    return np.array(
        [terms.get(name, 0.0) if name in ABERRATIONS else getattr(optics, name) for name in names]
    )


def amplitude_nodes(amplitude: FloatArray, good: BoolArray) -> FloatArray:
    """Amplitudes for which the response is computed; they span those of the good fits."""
    spanned = amplitude[good] if good.any() else amplitude
    low, high = float(spanned.min()), float(spanned.max())
    middle, half = (low + high) / 2, (high - low) / 2
    if half <= 1e-9 * abs(middle):
        return np.array([middle or 1e-9])
    angles = np.pi * (np.arange(_AMPLITUDES) + 0.5) / _AMPLITUDES
    nodes = middle + half * np.cos(angles)
    return np.where(np.abs(nodes) > 1e-6 * half, nodes, 1e-6 * half)


def height_weights(
    z_nm: FloatArray, span: tuple[float, float], fringe_nm: float
) -> tuple[FloatArray, FloatArray]:
    """Heights and the weights (events, heights) of a cubic through the four nearest of them."""
    if not np.ptp(z_nm):
        return z_nm[:1], np.ones((z_nm.size, 1))
    low, high = span
    count = max(int(np.ceil((high - low) * 10 / fringe_nm)), 3)  # between them it is interpolated
    place = (np.clip(z_nm, low, high) - low) / (high - low) * count
    first = np.clip(np.floor(place).astype(int) - 1, 0, count - 3)
    weights = np.zeros((z_nm.size, count + 1))
    cubic = lagrange(np.arange(4.0), place - first)
    np.put_along_axis(weights, first[:, None] + np.arange(4), cubic, axis=1)
    used = np.flatnonzero(np.any(weights != 0, axis=0))
    heights = np.asarray(low + (high - low) / count * used, dtype=np.float64)
    return heights, weights[:, used]


def lagrange(nodes: FloatArray, points: FloatArray) -> FloatArray:
    """Weights of the polynomial through values at the nodes, shape (points, nodes)."""
    return np.asarray(scipy.interpolate.KroghInterpolator(nodes, np.eye(nodes.size))(points))
