"""Errors that are common to all events of a movie, beside the spread of each event.

Each source of such an error gives, for every event, a standard deviation of the parameters that it
moves; independent sources add in quadrature.  A new source is a function like `_of_the_line` and an
entry in `_SOURCES`.  These errors are columns of their own and are never mixed into σ: they do not
shrink when events are averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.calibration.mass import line_sigma_kda
from iscat_analysis.config import Config
from iscat_analysis.inference.response import optics_response, peak_response
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Status

_AMPLITUDES = 4  # at which the response to the optics is computed, for the span of all events
_HEIGHTS_PER_FRINGE = 10  # between them it is interpolated

Source = Callable[[Config, pd.DataFrame], Mapping[str, FloatArray]]
"""Gives, by parameter, the standard deviation for every event; none for what it does not move."""


def systematic(config: Config, table: pd.DataFrame) -> dict[str, FloatArray]:
    """Add up the errors that all events of a movie share.

    Parameters
    ----------
    config : Config
        Says what was calibrated, and how well.
    table : pandas.DataFrame
        Events, with the columns of ``fits.csv``.

    Returns
    -------
    dict of str to ndarray
        Parameter (`PARAMETERS`) → standard deviation of every event [nm or kDa]; only of those
        parameters for which an error is known.
    """
    squares: dict[str, FloatArray] = {}
    for source in _SOURCES:
        for name, sigma in source(config, table).items():
            squares[name] = squares.get(name, np.zeros(len(table))) + np.square(sigma)
    return {name: np.sqrt(squares[name]) for name in PARAMETERS if name in squares}


def with_systematic(config: Config, table: pd.DataFrame) -> pd.DataFrame:
    """Put the columns ``systematic_*`` after ``flags``.

    Parameters
    ----------
    config : Config
        Says what was calibrated, and how well.
    table : pandas.DataFrame
        Events, with the columns of ``fits.csv``.

    Returns
    -------
    pandas.DataFrame
        The same table where no such error is known.
    """
    found = systematic(config, table)
    if not found:
        return table
    changed = table.copy()
    place = list(table.columns).index("flags") + 1
    for name in reversed(found):
        changed.insert(place, f"systematic_{name}", found[name])
    return changed


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
    """Give what the measured optics may be wrong by: D Σ Dᵀ of `inference.response`."""
    errors, pixel = config.optics.covariance, config.camera.pixel_size_nm
    suited = config.optics.scheme != "darkfield" and config.optics.convention == "exact"
    if errors is None or not errors.names or pixel is None or not suited:
        return {}
    side = max(5, round(config.fit.roi_nm / pixel))
    grid = PixelGrid.centred(side, pixel)
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    model = forward_model(config, 1.05 * grid.diagonal_nm / 2)
    shifts = np.full((len(table), len(PARAMETERS), len(errors.names)), np.nan)
    if known.any():
        shifts[known] = _shifts(config, model, grid, table[known])
    covariance = np.array(errors.matrix)
    variance = np.einsum("eik,kl,eil->ei", shifts, covariance, shifts)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    free = FREE_PARAMETERS[config.fit.mode]
    return {name: sigma[:, k] for k, name in enumerate(PARAMETERS) if name in free}


def _shifts(
    config: Config, model: ForwardModel, grid: PixelGrid, table: pd.DataFrame
) -> FloatArray:
    """Shift of (x, y, z, mass) of every event per unit of each parameter of the optics, (n, 4, k).

    D changes smoothly with the amplitude and along z with the fringes: a few amplitudes at each of
    some heights serve all events.
    """
    errors = config.optics.covariance
    names = errors.names if errors is not None else ()
    free = [name in FREE_PARAMETERS[config.fit.mode] for name in PARAMETERS]
    before, after = (float(table[f"n_{when}"].median()) for when in ("before", "after"))
    amplitude = np.array([model.scale.amplitude(m) for m in table["mass_kda"].astype(float)])
    nodes = _amplitude_nodes(amplitude, (table["status"] == Status.OK.value).to_numpy())

    def at(z_nm: float, amplitudes: FloatArray) -> FloatArray:
        return optics_response(
            model, grid, z_nm, amplitudes, names, free=free,
            level=config.background.method == "sliding", odds=after / before if before else 0.0,
        )  # fmt: skip

    by_amplitude = _lagrange(nodes, np.clip(amplitude, nodes.min(), nodes.max()))
    heights, by_height = _height_weights(
        table["z_nm"].to_numpy(dtype=float), model.z_range_nm, model.fringe_nm
    )
    shifts = np.zeros((len(table), len(PARAMETERS), len(names)))
    for height, weight in zip(heights, by_height.T, strict=True):
        near = weight != 0
        found = np.einsum("en,nik->eik", by_amplitude[near], at(float(height), nodes))
        shifts[near] += weight[near, None, None] * found
    if free[3]:
        shifts[:, 3] = _mass_shifts(config, model, amplitude, shifts[:, 3], at)
    return shifts


def _mass_shifts(
    config: Config,
    model: ForwardModel,
    amplitude: FloatArray,
    relative: FloatArray,
    at: Callable[[float, FloatArray], FloatArray],
) -> FloatArray:
    """Turn relative shifts of the amplitude (n, k) into shifts of the mass [kDa].

    On the model's own scale the amplitude is the mass.  A calibration is about the peak contrast
    C = L a + Q a², which moves less, because L moves too.  Where the optics come from a file, the
    standards were fitted with the same: line and contrasts are off by the same factor, that of a
    faint particle, and only what bright ones have beyond it remains.
    """
    line, a = config.calibration, amplitude[:, None]
    if line is None:
        return np.asarray(a * relative)
    names = config.optics.covariance.names if config.optics.covariance is not None else ()
    linear, quadratic = model.scale.linear, model.scale.quadratic
    by_linear, by_quadratic = peak_response(model, names)
    contrast = linear * a + quadratic * a**2
    change = (linear * a + 2 * quadratic * a**2) * relative + by_linear * a + by_quadratic * a**2
    if config.optics.file is not None:
        faint = np.array([1e-6 / linear])
        change = change - contrast * (at(model.height_nm, faint)[0, 3] + by_linear / linear)
    return np.asarray(change / line.gradient_per_kda)


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
    return low + (high - low) / count * used, weights[:, used]


def _lagrange(nodes: FloatArray, points: FloatArray) -> FloatArray:
    """Weights of the polynomial through values at the nodes, shape (points, nodes)."""
    weights = np.ones((points.size, nodes.size))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            weights[:, k] *= (points - other) / (node - other)
    return weights


_SOURCES: tuple[Source, ...] = (_of_the_line, _of_the_optics)
