"""Errors that are common to all events of a movie, beside the spread of each event.

Each source of such an error gives, for every event, a standard deviation of the parameters that it
moves; independent sources add in quadrature.  A new source is a function like `_of_the_line` and an
entry in `_SOURCES`.  These errors are columns of their own and are never mixed into σ: they do not
shrink when events are averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.bounds import imitation, joint_information, mass_drift, peak_gradient
from iscat_analysis.calibration.mass import line_sigma_kda
from iscat_analysis.config import Config
from iscat_analysis.inference.noise import asimov_conditional, asimov_poisson
from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid, forward_model
from iscat_analysis.optics.measured import Template
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Status

_AMPLITUDES = 4  # at which the response to the optics is computed, for the span of all events
_BENT = 0.02  # of a mass; beneath, lines of standards that scatter by a per cent are as wrong
_BENT_SIGMAS = 5.0  # beyond which the square is clear in a single row, however small its share
_TOLD = 0.5  # of σ, beyond which it is told of every row
_NOTHING = 1e-9  # nm or kDa: what rounding leaves of a place that the optics do not move
_HEIGHTS_PER_FRINGE = 10  # between them it is interpolated

Source = Callable[[Config, pd.DataFrame], Mapping[str, FloatArray]]
"""Gives, by name in `_COMMON`, the standard deviation for every event; none for what it does not
move."""

_COMMON = (*PARAMETERS, "contrast")
"""What such errors are told of; of the contrast where it is the result, without a calibration."""


def systematic(
    config: Config,
    table: pd.DataFrame,
    mass_share: float = 0.0,
    scale: MassScale | None = None,
    of_nuisances_kda: Sequence[FloatArray] = (),
) -> dict[str, FloatArray]:
    """Add up the errors that all events of a movie share."""
    squares: dict[str, FloatArray] = {}
    sources: tuple[Source, ...] = (*_SOURCES, partial(_of_what_is_left_over, mass_share))
    if scale is not None:
        sources += (partial(_of_heavy_particles, scale),)
    sources += tuple(partial(_of_a_nuisance, shift) for shift in of_nuisances_kda if shift.any())
    for source in sources:
        for name, sigma in source(config, table).items():
            squares[name] = squares.get(name, np.zeros(len(table))) + np.square(sigma)
    sums = {name: np.sqrt(squares[name]) for name in _COMMON if name in squares}
    return {name: np.where(sigma > _NOTHING, sigma, 0.0) for name, sigma in sums.items()}


def _of_what_is_left_over(
    mass_share: float, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give what masses are wrong by where the optics were rejected, and no others learned."""
    del config
    return {"mass_kda": mass_share * table["mass_kda"].to_numpy(float)} if mass_share else {}


def _of_a_nuisance(shift_kda: FloatArray, *_: object) -> Mapping[str, FloatArray]:
    """Give what a height or a width that was held does to masses."""
    return {"mass_kda": shift_kda}


def _of_heavy_particles(
    scale: MassScale, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give what a line of faint standards makes of particles that are not, where it matters."""
    if "mass_kda" not in FREE_PARAMETERS[config.fit.mode]:
        return {}
    off, sigma = _off_the_line(scale, table)
    return {"mass_kda": off} if (off > _TOLD * sigma).any() else {}


def is_bent(scale: MassScale, table: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell which masses a line of faint standards is clearly wrong about.

    Shapes: result (rows,).
    """
    off, sigma = _off_the_line(scale, table)
    share = off / np.maximum(np.abs(table["mass_kda"].to_numpy(float)), 1e-300)
    return np.asarray(
        (off > _BENT_SIGMAS * sigma) | ((share > _BENT) & (off > _TOLD * sigma)), dtype=np.bool_
    )


def _off_the_line(scale: MassScale, table: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Give what the square of the scattered light adds to masses, and σ where rows are ok."""
    mass, sigma = (table[name].to_numpy(float) for name in ("mass_kda", "sigma_mass_kda"))
    good = (table["status"] == Status.OK.value).to_numpy()
    return np.abs(mass * scale.bend(mass)), np.where(good, sigma, np.nan)


def _of_the_line(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what the line between contrast and mass may be wrong by."""
    line = config.calibration
    if line is None or not (line.gradient_se_per_kda or line.offset_se):
        return {}
    mixed = line.correlation * line.gradient_se_per_kda * line.offset_se
    covariance = np.array([[line.gradient_se_per_kda**2, mixed], [mixed, line.offset_se**2]])
    mass = table["mass_kda"].to_numpy(dtype=float)
    return {"mass_kda": line_sigma_kda(mass, line.gradient_per_kda, covariance)}


def _of_the_optics(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what the measured optics may be wrong by: D Σ Dᵀ of `bounds.shared`."""
    errors, pixel = config.optics.covariance, config.camera.pixel_size_nm
    suited = config.optics.scheme != "darkfield" and config.optics.convention == "exact"
    suited = suited and config.optics.psf == "model"
    if errors is None or not errors.names or pixel is None or not suited:
        return {}
    side = config.fit.roi_px(pixel)
    grid = PixelGrid.centred(side, pixel)
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    model = forward_model(config, 1.05 * grid.diagonal_nm / 2)
    shifts = np.full((len(table), len(_COMMON), len(errors.names)), np.nan)
    if known.any():
        shifts[known] = _shifts(config, model, grid, table[known])
    covariance = np.array(errors.matrix)
    variance = np.einsum("eik,kl,eil->ei", shifts, covariance, shifts)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    told = [
        *FREE_PARAMETERS[config.fit.mode],
        *(["contrast"] if _is_about_contrast(config) else []),
    ]
    return {name: sigma[:, k] for k, name in enumerate(_COMMON) if name in told}


def _is_about_contrast(config: Config) -> bool:
    """Whether contrasts are the result: masses are fitted, and no calibration makes them."""
    return "mass_kda" in FREE_PARAMETERS[config.fit.mode] and config.calibration is None


def _shifts(
    config: Config, model: ForwardModel, grid: PixelGrid, table: pd.DataFrame
) -> FloatArray:
    """Shift of x, y, z, mass and contrast of every event per unit of the optics, (n, 5, k).

    D changes smoothly with the amplitude and along z with the fringes: a few amplitudes at each of
    some heights serve all events.
    """
    errors = config.optics.covariance
    names = errors.names if errors is not None else ()
    free = [name in FREE_PARAMETERS[config.fit.mode] for name in PARAMETERS]
    amplitude = model.scale.amplitudes(table["mass_kda"].to_numpy(float))
    nodes = _amplitude_nodes(amplitude, (table["status"] == Status.OK.value).to_numpy())
    respond = _Response(
        replace(model, scale=MassScale()), grid, names, tuple(free),
        level=config.background.method == "sliding",
        frames=(int(table["n_before"].median()), int(table["n_after"].median())),
        contrast=_is_about_contrast(config),
    )  # fmt: skip
    by_amplitude = _lagrange(nodes, np.clip(amplitude, nodes.min(), nodes.max()))
    heights, by_height = _height_weights(
        table["z_nm"].to_numpy(dtype=float), model.z_range_nm, model.fringe_nm
    )
    shifts = np.zeros((len(table), len(_COMMON), len(names)))
    for height, weight in zip(heights, by_height.T, strict=True):
        near = weight != 0
        found = np.einsum("en,nik->eik", by_amplitude[near], respond.at(float(height), nodes))
        shifts[near] += weight[near, None, None] * found
    shifts[:, 4] *= table["contrast"].to_numpy(dtype=float)[:, None]
    if free[3]:
        shifts[:, 3] *= amplitude[:, None]
        if model.scale.calibration is not None:
            peak = np.array([mass_drift(model, a, names) / a for a in nodes])
            drift = amplitude[:, None] * (by_amplitude @ peak)
            shifts[:, 3] = _calibrated(config, model, respond, amplitude, shifts[:, 3], drift)
    return shifts


@dataclass(frozen=True)
class _Response:
    """How the estimates of a particle at the centre of a region move with the optics."""

    model: ForwardModel  # with masses that are amplitudes
    grid: PixelGrid
    names: tuple[str, ...]
    free: tuple[bool, ...]
    level: bool
    frames: tuple[int, int]
    contrast: bool

    def at(self, z_nm: float, amplitudes: FloatArray) -> FloatArray:
        """D of (x, y, z [nm], ln a, ln contrast) per unit of each parameter, (amplitudes, 5, k).

        The contrast is left at 0 where it is not the result.
        """
        count, (before, after) = len(self.names), self.frames
        kept = np.flatnonzero([*self.free, self.level])
        chosen = np.concatenate([np.arange(count), count + kept])
        out = np.zeros((len(amplitudes), len(_COMMON), count))
        for index, amplitude in enumerate(amplitudes):
            theta = np.array([*self._centre, z_nm, amplitude, 0.0])
            expected = (
                asimov_conditional(self.model, self.grid, theta, 1.0, before, after)
                if before
                else asimov_poisson(self.model, self.grid, theta, 1.0, 1.0)
            )
            whole = joint_information(expected, theta, self.names)
            moved = np.zeros((theta.size, count))
            moved[kept] = imitation(whole[np.ix_(chosen, chosen)], count)
            out[index, :3] = moved[:3]
            out[index, 3] = moved[3] / amplitude
            if self.contrast:
                contrast, own, shared = peak_gradient(self.model, z_nm, amplitude, self.names)
                out[index, 4] = (own @ moved[:4] + shared) / contrast
        return out

    @property
    def _centre(self) -> tuple[float, float]:
        return float(np.mean(self.grid.x_nm)), float(np.mean(self.grid.y_nm))


def _calibrated(
    config: Config,
    model: ForwardModel,
    respond: _Response,
    amplitude: FloatArray,
    moves: FloatArray,
    drift: FloatArray,
) -> FloatArray:
    """Turn shifts of the amplitude (n, k) into those of a mass that a line ties to the contrast.

    The peak contrast C = L a + Q a² moves less than the amplitude, because L moves too: `drift`.
    Where the optics come from a file, the standards were fitted with the same: line and contrasts
    are off by the same factor, that of a faint particle, and only what bright ones have beyond it
    remains.
    """
    scale, names = model.scale, respond.names
    gradient = float(scale.slope(0.0))
    slope = scale.slopes(amplitude)
    shifts = slope[:, None] * moves + drift
    if config.optics.file is not None:
        faint = 1e-6 * np.abs(amplitude).max()
        relative = respond.at(model.height_nm, np.array([faint]))[0, 3]
        relative = relative + mass_drift(model, faint, names) / (faint * gradient)
        contrast = scale.linear * amplitude + scale.quadratic * amplitude**2
        shifts -= (contrast * gradient / scale.linear)[:, None] * relative
    return np.asarray(shifts)


def _amplitude_nodes(amplitude: FloatArray, good: NDArray[np.bool_]) -> FloatArray:
    """Amplitudes for which the response is computed; they span those of the good fits."""
    spanned = amplitude[good] if good.any() else amplitude
    low, high = float(spanned.min()), float(spanned.max())
    middle, half = (low + high) / 2, (high - low) / 2
    if half <= 1e-9 * abs(middle):
        return np.array([middle or 1e-9])
    angles = np.pi * (np.arange(_AMPLITUDES) + 0.5) / _AMPLITUDES
    nodes = middle + half * np.cos(angles)
    return np.where(np.abs(nodes) > 1e-6 * half, nodes, 1e-6 * half)


def _height_weights(
    z_nm: FloatArray, span: tuple[float, float], fringe_nm: float
) -> tuple[FloatArray, FloatArray]:
    """Heights and the weights (events, heights) of a cubic through the four nearest of them."""
    if not np.ptp(z_nm):
        return z_nm[:1], np.ones((z_nm.size, 1))
    low, high = span
    count = max(int(np.ceil((high - low) * _HEIGHTS_PER_FRINGE / fringe_nm)), 3)
    place = (np.clip(z_nm, low, high) - low) / (high - low) * count
    first = np.clip(np.floor(place).astype(int) - 1, 0, count - 3)
    weights = np.zeros((z_nm.size, count + 1))
    cubic = _lagrange(np.arange(4.0), place - first)
    np.put_along_axis(weights, first[:, None] + np.arange(4), cubic, axis=1)
    used = np.flatnonzero(np.any(weights != 0, axis=0))
    heights = np.asarray(low + (high - low) / count * used, dtype=np.float64)
    return heights, weights[:, used]


def _lagrange(nodes: FloatArray, points: FloatArray) -> FloatArray:
    """Weights of the polynomial through values at the nodes, shape (points, nodes)."""
    weights = np.ones((points.size, nodes.size))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            weights[:, k] *= (points - other) / (node - other)
    return weights


def _of_the_template(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what the peak of a measured picture may be wrong by.

    All contrasts share its relative error.  The standards of a line that was measured with the
    same template have it too, and it cancels; places are relative to the picture's own centre.
    """
    optics = config.optics
    if optics.psf != "measured" or optics.template is None or config.calibration is not None:
        return {}
    mass = table["mass_kda"].to_numpy(dtype=float)
    contrast = table["contrast"].to_numpy(dtype=float)
    relative = Template.read(Path(optics.template)).peak_se
    return {"mass_kda": np.abs(mass) * relative, "contrast": np.abs(contrast) * relative}


_SOURCES: tuple[Source, ...] = (_of_the_line, _of_the_optics, _of_the_template)
