"""Inputs that nobody measured: what their uncertainties make of a mass.

If an input is off by δ, the pictures are those of the input plus δ, and the fit imitates the change
with the amplitude of the particle: a relative shift D·δ.  What becomes of the mass depends on where
its scale is from:

* standards that were recorded, with the same value of the input: their amplitudes shifted too, and
  D_here − D_there remains, which is nothing where all is equal;
* standards that were recorded with another value: both shifts, independent of each other;
* a gradient from elsewhere: if it is of a set-up where the input was right, D; if it is the true
  contrast per kDa of this one, which the model turns amplitudes into with the wrong input,
  D − ∂ ln L/∂input, L the model's contrast per amplitude.  Nobody knows which: the larger counts.

The mass of a sphere follows from its picture without standards, and what remains of it is D.

Where optics were learned from pictures, with the wrong input, they are wrong as well: their shift
is part of D, and of L where the gradient is taken at learned optics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.bounds import peak_gradient
from iscat_analysis.config import Config
from iscat_analysis.optics.forward import PEAK_SEARCH_RADIUS, PixelGrid, forward_model, signed_peak
from iscat_analysis.optics.scatterers import material
from iscat_analysis.records import FREE_PARAMETERS, FloatArray, Status
from iscat_analysis.trust.response import Response, at_standards, has_own_index, response_of

_STEP = 0.1  # of a standard deviation, for derivatives


@dataclass(frozen=True)
class Input:
    """An input of the model, by its key in [uncertainty]."""

    key: str
    label: str
    remedy: str


INPUTS = (
    Input("wavelength_nm", "wavelength", "measure the spectrum of the light"),
    Input("n_sample", "refractive index of the sample", "measure the index of the buffer"),
    Input("n_glass", "refractive index of the glass", "take the maker's value at this wavelength"),
    Input("index", "refractive index of the spheres", "spheres that move, or of known diameter"),
    Input("height_nm", "mean height of the particles", "standards that bind at the same height"),
    Input("magnification", "magnification", "measure the pixel size with a graticule"),
)
"""In the order of the budget.  Standards of the same set-up take all of them away."""


def assumed_error(key: str, config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Error of the masses of a movie that the uncertainty of one input makes."""
    sigma = float(getattr(config.uncertainty, key))
    line, optics = config.calibration, config.optics
    if config.fits_sizes and sigma and not table.empty:
        return _of_spheres(key, config, table, sigma)
    suited = optics.scheme != "darkfield" and optics.convention == "exact"
    suited = suited and optics.psf == "model" and config.camera.pixel_size_nm is not None
    fitted = "mass_kda" in FREE_PARAMETERS[config.fit.mode]
    if not sigma or key == "index" or line is None or not (suited and fitted) or table.empty:
        return {}
    there = at_standards(config)
    recorded = line.optics is not None and not line.optics_assumed
    if recorded and _alike(config, there):
        return {}
    mass = table["mass_kda"].to_numpy(float)
    good = mass[(table["status"] == Status.OK.value).to_numpy()]
    typical = float(np.median(np.abs(good))) if good.size else None
    here = _shift(key, config, table, sigma, typical)
    if not recorded:
        share = max(abs(here), abs(here - _peak_shift(key, there, table, sigma)))
    elif _value(key, config) == _value(key, there):
        share = abs(here - _shift(key, there, table, sigma))
    else:
        share = math.hypot(here, _shift(key, there, table, sigma))
    return {"mass_kda": share * np.abs(mass)}


def _of_spheres(
    key: str, config: Config, table: pd.DataFrame, sigma: float
) -> Mapping[str, FloatArray]:
    """Error of the masses of spheres, which follow from their pictures without standards.

    An index that was fitted is not assumed, and takes its part of what other inputs have wrong.
    """
    mass = np.abs(table["mass_kda"].to_numpy(float))
    if config.optics.scheme == "darkfield" or not np.isfinite(mass).any():
        return {}
    own = has_own_index(table)
    share = np.zeros(mass.size)
    for index in (False, True):
        rows = (own == index) & np.isfinite(mass)
        if rows.any() and not (index and key == "index"):
            typical = float(np.median(mass[rows]))
            share[rows] = abs(_shift(key, config, table, sigma, typical, index=index))
    return {"mass_kda": share * mass}


def _alike(here: Config, there: Config) -> bool:
    """Tell whether standards were measured like the particles, so that all shifts are equal."""
    return (
        here.optics.model_copy(update={"file": None, "calibrate": "auto"})
        == there.optics.model_copy(update={"file": None, "calibrate": "auto"})
        and here.particle.nominal_height_nm == there.particle.nominal_height_nm
        and here.camera.pixel_size_nm == there.camera.pixel_size_nm
        and here.fit.mode == "mass"
    )


def _value(key: str, config: Config) -> float | None:
    values = {
        "height_nm": config.particle.nominal_height_nm,
        "magnification": config.camera.pixel_size_nm,
    }
    return values[key] if key in values else float(getattr(config.optics, key))


def _shift(
    key: str,
    config: Config,
    table: pd.DataFrame,
    sigma: float,
    mass_kda: float | None = None,
    *,
    index: bool = False,
) -> float:
    """Relative shift of the amplitude for one standard deviation of an input.

    Of a particle of a mass; without one, of a faint particle, as standards are.  The `index` of a
    sphere may be free.
    """
    respond = response_of(config, table)
    amplitude = respond.faint_amplitude
    if mass_kda is not None:
        scale = forward_model(config, respond.model.reach_nm).scale
        amplitude = float(scale.amplitudes(mass_kda))
    change = _change(key, config, respond, amplitude, sigma)
    return respond.to_input(change, amplitude, index=index).amplitude


def _change(
    key: str, config: Config, respond: Response, amplitude: float, sigma: float
) -> FloatArray:
    """Change of the picture for one standard deviation of an input, (ny, nx)."""
    x, y, z, *_ = respond.theta(respond.model.height_nm, amplitude)
    grid = respond.grid

    def picture(sign: float) -> FloatArray:
        step = sign * _STEP * sigma
        if key == "height_nm":
            return respond.model.amplitude_image(grid, x, y, z + step, amplitude)
        if key == "magnification":
            larger = PixelGrid(
                grid.x_nm * (1 + step), grid.y_nm * (1 + step), grid.pixel_nm * (1 + step)
            )
            return respond.model.amplitude_image(larger, x, y, z, amplitude)
        model = forward_model(_moved(key, config, step), respond.model.reach_nm)
        return model.amplitude_image(grid, x, y, z, amplitude)

    return (picture(1.0) - picture(-1.0)) / (2 * _STEP)


def _peak_shift(key: str, config: Config, table: pd.DataFrame, sigma: float) -> float:
    """Relative error of the model's contrast per amplitude for one standard deviation."""

    def peak(sign: float) -> float:
        moved = _moved(key, config, sign * _STEP * sigma)
        reach_nm = PEAK_SEARCH_RADIUS * moved.optics.wavelength_nm / moved.optics.na
        return signed_peak(forward_model(moved, reach_nm))

    shift = 0.0
    if key != "magnification":
        shift = (peak(1.0) - peak(-1.0)) / (2 * _STEP) / peak(0.0)
    respond = response_of(config, table)
    if respond.names:
        faint = respond.faint_amplitude
        change = _change(key, config, respond, faint, sigma)
        optics = respond.to_input(change, faint).optics
        height = respond.model.height_nm
        contrast, _, slopes = peak_gradient(respond.model, height, faint, respond.names)
        shift -= float(slopes @ optics) / contrast
    return shift


def _moved(key: str, config: Config, step: float) -> Config:
    """Move an input, and leave the stage where it is."""
    update: dict[str, Any] = {"calibration": None}
    if key == "index":
        index = np.sqrt(material(config.particle, config.optics.wavelength_nm).permittivity) + step
        permittivity = float((index**2).real), float((index**2).imag)
        particle = config.particle.model_copy(update={"permittivity": permittivity, "index": None})
        update |= {"particle": particle}
    elif key == "height_nm":
        height, optics = config.particle.nominal_height_nm + step, config.optics
        # the oil, which the nominal height and the focus set together, stays
        focus = optics.focus_nm + step * (1 - optics.n_immersion / optics.n_sample)
        update |= {
            "particle": config.particle.held_at(height),
            "optics": optics.model_copy(update={"focus_nm": focus}),
        }
    else:
        value = float(getattr(config.optics, key)) + step
        update |= {"optics": config.optics.model_copy(update={key: value})}
    return config.model_copy(update=update)
