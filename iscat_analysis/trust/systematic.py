"""Errors that are common to all events of a movie, beside the spread of each event.

Each source of such an error gives, for every event, a standard deviation of the parameters that it
moves; independent sources add in quadrature.  A new source is a function like `_of_the_line` and an
entry in `sources_of`.  These errors are columns of their own and are never mixed into σ: they do
not shrink when events are averaged.  What they come to, source by source, is the `budget`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.calibration.mass import line_sigma_kda
from iscat_analysis.config import Config
from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid, forward_model
from iscat_analysis.optics.measured import Template
from iscat_analysis.records import FREE_PARAMETERS, FloatArray, Status
from iscat_analysis.trust.assumed import INPUTS, assumed_error
from iscat_analysis.trust.response import (
    COMMON,
    amplitude_nodes,
    at_standards,
    height_weights,
    lagrange,
    response_of,
    standards_share,
)

REJECTED_SHARE = 0.04
"""Of the particle's picture, what the model leaves over beyond the noise (root mean square): optics
that leave over less are wrong by less than masses are."""

MASS_SHARE = 0.4
"""Error of masses over what optics that are wrong leave over of the pictures: root mean square of
eleven such microscopes, 0 to 0.97."""

_FEWEST_PICTURES = 8  # that tell what is left over of them
_SPREAD = 2.0  # ratio of squared SNR, over which noise and misfit can be told apart
_MISFIT_SIGMAS = 5.0  # by which something is left over
_MEDIAN_SE = 1.2533  # standard error of a median over that of a mean
# Of a mass; beneath, lines of standards that scatter by a per cent are as wrong
_LEAST_NONLINEAR_SHARE = 0.02
_NONLINEAR_SIGMAS = 5.0  # beyond which the square is clear in a single row, however small its share
_LEAST_SIGMAS = 0.5  # of σ, beyond which it is told of every row
_SAME = 1e-6  # change of the scale, which rounding leaves between equal optics
_NOTHING = 1e-9  # nm or kDa: what rounding leaves of a place that the optics do not move

Errors = Callable[[Config, pd.DataFrame], Mapping[str, FloatArray]]
"""Gives, by name in `COMMON`, the standard deviation for every event; none for what it does not
move."""

Kind = Literal["measured", "learned", "assumed"]


@dataclass(frozen=True)
class Source:
    """One reason why all masses of a movie may be wrong together, and what would shrink it."""

    name: str
    kind: Kind
    errors: Errors
    remedy: str
    dof: float | None = None


def sources_of(
    config: Config, mass_share: float = 0.0, scale: MassScale | None = None
) -> tuple[Source, ...]:
    """Name the sources of errors that the events of a movie share."""
    line = config.calibration
    left_over = partial(_of_what_is_left_over, mass_share)
    sources = (
        Source("line of the standards", "measured", _of_the_line,
               "more standards, and more events of each",
               None if line is None or line.dof is None else float(line.dof)),
        Source("optics of the movie", "learned", _of_the_optics,
               "more or brighter particles, from which the optics are learned"),
        Source("optics of the standards", "learned", _of_the_standards,
               "more or brighter standards, or standards and sample at one focus"),
        Source("measured picture", "measured", _of_the_template,
               "more particles for the picture, or standards measured with it"),
        Source("optics that do not describe the pictures", "measured", left_over,
               "find what the model lacks: focus, aperture, aberrations, pixel size"),
        *(Source(each.label, "assumed", partial(assumed_error, each.key), each.remedy)
          for each in INPUTS),
    )  # fmt: skip
    if scale is None:
        return sources
    return (
        *sources,
        Source("standards measured with unknown optics", "assumed",
               partial(_of_the_missing_record, scale),
               "calibrate with the folder of the standards' analysis"),
        Source("square of the scattered light", "measured", partial(_of_heavy_particles, scale),
               "standards as heavy as the particles"),
    )  # fmt: skip


Contribution = tuple[Source, Mapping[str, FloatArray]]
"""A source with what it makes of every event, by name in `COMMON`."""


def contributions(
    config: Config,
    table: pd.DataFrame,
    mass_share: float = 0.0,
    scale: MassScale | None = None,
    held_kda: Mapping[str, FloatArray] = MappingProxyType({}),
) -> list[Contribution]:
    """Give what each source makes of the events of a movie, where it makes anything of them.

    Shapes: `held_kda` (rows,) each: what heights or extensions that were held do to the masses.
    """
    sources = [*sources_of(config, mass_share, scale)]
    sources += [_of_held(name, shift) for name, shift in held_kda.items() if shift.any()]
    found = [(source, source.errors(config, table)) for source in sources]
    return [(source, errors) for source, errors in found if errors]


def total(found: Sequence[Contribution], rows: int) -> dict[str, FloatArray]:
    """Add independent contributions in quadrature.

    Shapes: result (rows,) each.
    """
    squares: dict[str, FloatArray] = {}
    for _, errors in found:
        for name, sigma in errors.items():
            squares[name] = squares.get(name, np.zeros(rows)) + np.square(sigma)
    sums = {name: np.sqrt(squares[name]) for name in COMMON if name in squares}
    return {name: np.where(sigma > _NOTHING, sigma, 0.0) for name, sigma in sums.items()}


def _of_held(name: str, shift_kda: FloatArray) -> Source:
    """Make a source of heights or extensions that were held although particles differ in them."""
    remedy = {
        "heights": 'fit them: particle.height_nm = "auto", or particle.height_sd_nm',
        "extension": "say how far particles wiggle: particle.wiggle_nm",
    }[name]
    return Source(
        f"{name} of the particles", "measured", lambda *_: {"mass_kda": shift_kda}, remedy
    )


def _of_the_missing_record(
    scale: MassScale, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give what the carried scale is wrong by, if the standards had the optics of the movie."""
    line, share = config.calibration, abs(scale.carried - 1)
    if line is None or not line.optics_assumed or share < _SAME or not _fits_masses(config):
        return {}
    return {"mass_kda": share * np.abs(table["mass_kda"].to_numpy(float))}


def _fits_masses(config: Config) -> bool:
    return "mass_kda" in FREE_PARAMETERS[config.fit.mode]


def misfit_error(table: pd.DataFrame, pixels: int) -> float:
    """Say how wrong masses may be, as a share, where the model leaves something over of pictures.

    What is left over beyond the noise grows as the square of the SNR; noise that is not what the
    camera's numbers predict is the same in faint and bright pictures.  Medians of both halves tell
    them apart.
    """
    judged = table["status"].isin([Status.OK.value, Status.POOR_FIT.value])
    rows = table[judged & np.isfinite(table["chi2_reduced"]) & np.isfinite(table["snr"])]
    if len(rows) < _FEWEST_PICTURES:
        return 0.0
    rows = rows.sort_values("snr")
    power, excess = (rows["snr"] ** 2 / pixels).to_numpy(), rows["chi2_reduced"].to_numpy() - 1
    half = len(rows) // 2
    rise, over = float(np.median(power[half:])), float(np.median(excess[half:]))
    error = _MEDIAN_SE * math.sqrt(2 / pixels / half)
    faint = float(np.median(power[:half]))
    if rise > _SPREAD * faint:
        rise, over = rise - faint, over - float(np.median(excess[:half]))
        error *= math.sqrt(2)
    if over < _MISFIT_SIGMAS * error:
        return 0.0
    share = math.sqrt(over / rise)
    return MASS_SHARE * share if share > REJECTED_SHARE else 0.0


def _of_what_is_left_over(
    mass_share: float, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give what masses are wrong by where the optics were rejected, and no others learned."""
    del config
    return {"mass_kda": mass_share * table["mass_kda"].to_numpy(float)} if mass_share else {}


def _of_heavy_particles(
    scale: MassScale, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give what a line of faint standards makes of particles that are not, where it matters."""
    if not _fits_masses(config):
        return {}
    off, sigma = _off_the_line(scale, table)
    return {"mass_kda": off} if (off > _LEAST_SIGMAS * sigma).any() else {}


def is_bent(scale: MassScale, table: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell which masses a line of faint standards is clearly wrong about.

    Shapes: result (rows,).
    """
    off, sigma = _off_the_line(scale, table)
    share = off / np.maximum(np.abs(table["mass_kda"].to_numpy(float)), 1e-300)
    return np.asarray(
        (off > _NONLINEAR_SIGMAS * sigma)
        | ((share > _LEAST_NONLINEAR_SHARE) & (off > _LEAST_SIGMAS * sigma)),
        dtype=np.bool_,
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
    grid = PixelGrid.centred(config.fit.roi_px(pixel), pixel)
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    model = forward_model(config, 1.05 * grid.diagonal_nm / 2)
    shifts = np.full((len(table), len(COMMON), len(errors.names)), np.nan)
    if known.any():
        shifts[known] = _shifts(config, model, table[known])
    covariance = np.array(errors.matrix)
    variance = np.einsum("eik,kl,eil->ei", shifts, covariance, shifts)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    reported = [
        *FREE_PARAMETERS[config.fit.mode],
        *(["contrast"] if _is_about_contrast(config) else []),
    ]
    return {name: sigma[:, k] for k, name in enumerate(COMMON) if name in reported}


def _is_about_contrast(config: Config) -> bool:
    """Whether contrasts are the result: masses are fitted, and no calibration makes them."""
    return "mass_kda" in FREE_PARAMETERS[config.fit.mode] and config.calibration is None


def _shifts(config: Config, model: ForwardModel, table: pd.DataFrame) -> FloatArray:
    """Shift of x, y, z, mass and contrast of every event per unit of the optics, (n, 5, k).

    D changes smoothly with the amplitude and along z with the fringes: a few amplitudes at each of
    some heights serve all events.
    """
    errors = config.optics.covariance
    names = errors.names if errors is not None else ()
    amplitude = model.scale.amplitudes(table["mass_kda"].to_numpy(float))
    nodes = amplitude_nodes(amplitude, (table["status"] == Status.OK.value).to_numpy())
    respond = response_of(config, table, names, contrast=_is_about_contrast(config))
    by_amplitude = lagrange(nodes, np.clip(amplitude, nodes.min(), nodes.max()))
    heights, by_height = height_weights(
        table["z_nm"].to_numpy(dtype=float), model.z_range_nm, model.fringe_nm
    )
    shifts = np.zeros((len(table), len(COMMON), len(names)))
    for height, weight in zip(heights, by_height.T, strict=True):
        near = weight != 0
        found = np.einsum("en,nik->eik", by_amplitude[near], respond.at(float(height), nodes))
        shifts[near] += weight[near, None, None] * found
    shifts[:, 4] *= table["contrast"].to_numpy(dtype=float)[:, None]
    if _fits_masses(config):
        shifts[:, 3] *= (amplitude * model.scale.slopes(amplitude))[:, None]
        if standards_share(config):
            line, scale = config.calibration, model.scale
            gradient = line.gradient_per_kda if line is not None else 1.0
            contrast = scale.linear * amplitude + scale.quadratic * amplitude**2
            shifts[:, 3] -= (contrast / gradient)[:, None] * respond.faint()
    return shifts


def _of_the_standards(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what the learned optics of the standards may be wrong by, where they are others."""
    line, pixel = config.calibration, config.camera.pixel_size_nm
    if line is None or line.optics is None or line.covariance is None or pixel is None:
        return {}
    if line.optics.psf == "measured" or standards_share(config):
        return {}
    if not _fits_masses(config):
        return {}
    relative = response_of(at_standards(config), table, line.covariance.names).faint()
    variance = float(relative @ np.array(line.covariance.matrix) @ relative)
    return {"mass_kda": np.abs(table["mass_kda"].to_numpy(float)) * math.sqrt(max(variance, 0.0))}


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
