"""Errors that are common to all events of a movie, beside the spread of each event.

Each source of such an error gives, for every event, a standard deviation of the parameters that it
moves; independent sources add in quadrature.  A new source is a function like `_of_the_line` and an
entry in `sources_of`.  These errors are columns of their own and are never mixed into σ: they do
not shrink when events are averaged.  What they come to, source by source, is the `budget`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import log_ndtr

from iscat_analysis.calibration import line_sigma_kda
from iscat_analysis.config import Config, OpticsCovariance
from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid, forward_model
from iscat_analysis.optics.local import BASES, REFERENCE, WEIGHTS, centre_of, when
from iscat_analysis.optics.measured import Template
from iscat_analysis.records import FREE_PARAMETERS, FloatArray, Status
from iscat_analysis.trust.assumed import INPUTS, assumed_error
from iscat_analysis.trust.response import (
    COMMON,
    amplitude_nodes,
    at_standards,
    has_own_index,
    height_weights,
    lagrange,
    response_of,
    standards_share,
)
from iscat_analysis.trust.uneven_reference import reference_map

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
_LEAST_SIGMAS = 0.5  # of σ, beyond which it is in the budget
_LEAST_SELECTED = 0.01  # of σ, below which a threshold does nothing
_SAME = 1e-6  # change of the scale, which rounding leaves between equal optics
# What rounding leaves of a place, mass or contrast that the optics do not change [nm, kDa, and 1]
_NOTHING = {"x_nm": 1e-4, "y_nm": 1e-4, "z_nm": 1e-4, "mass_kda": 1e-9, "contrast": 1e-9}

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
    moves: bool = True
    """Whether it can make anything wrong; else it is named in the budget alone."""


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
        Source("amplitude of the reference over the field", "measured", _of_the_reference,
               "configure it: optics.reference_tilt and optics.reference_curvature"),
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
    camera: Mapping[str, Any] | None = None,
    threshold_snr: float = 0.0,
    optics: Mapping[str, Any] = MappingProxyType({}),
) -> list[Contribution]:
    """Give what each source makes of the events of a movie, where it makes anything of them.

    `camera` and `optics` are sections of ``summary.json``, `threshold_snr` is that of the search.

    Shapes: `held_kda` (rows,) each: what heights or extensions that were held do to the masses.
    """
    sources = [*sources_of(config, mass_share, scale), *_of_the_camera(config, camera or {})]
    if threshold_snr:
        sources.append(
            Source("selection near the threshold", "measured",
                   partial(_of_the_selection, threshold_snr),
                   "more light, or more frames; species, which know what was missed")
        )  # fmt: skip
    if not optics.get("calibrated", True) and "covariance" in optics:
        sources.append(
            Source("optics as configured", "assumed", partial(_of_configured_optics, optics),
                   "more or brighter particles, on which the optics are tested and learned")
        )  # fmt: skip
    sources += [_of_held(name, shift) for name, shift in held_kda.items() if shift.any()]
    found = [(source, source.errors(config, table)) for source in sources]
    return [(source, errors) for source, errors in found if errors]


def total(found: Sequence[Contribution], rows: int) -> dict[str, FloatArray]:
    """Add independent contributions in quadrature.

    A source that moves nothing by its nature does not make the error known.

    Shapes: result (rows,) each.
    """
    squares: dict[str, FloatArray] = {}
    for source, errors in found:
        for name, sigma in errors.items() if source.moves else ():
            squares[name] = squares.get(name, np.zeros(rows)) + np.square(sigma)
    sums = {name: np.sqrt(squares[name]) for name in COMMON if name in squares}
    return {name: np.where(sigma > _NOTHING[name], sigma, 0.0) for name, sigma in sums.items()}


def _of_held(name: str, shift_kda: FloatArray) -> Source:
    """Make a source of heights or extensions that were held although particles differ in them."""
    remedy = {
        "heights": 'fit them: particle.height_nm = "auto", or particle.height_sd_nm',
        "extension": "more or brighter particles; particle.wiggle_nm, uncertainty.wiggle_nm",
    }[name]
    return Source(
        f"{name} of the particles", "measured", lambda *_: {"mass_kda": shift_kda}, remedy
    )


_FROM_LIGHT = ("measured", "assumed")
"""Where an error of the offset is from the law of the counts, that of their linearity is the same.
"""


def _of_the_camera(config: Config, camera: Mapping[str, Any]) -> Iterator[Source]:
    """Give what counts in the dark, and counts that are not in proportion to light, do to masses.

    Contrast is a change of counts over counts above the offset: offset too high by δ makes it too
    large by δ/counts.  The gain is in both, and leaves it as it is.
    """
    offset, law, light = (camera.get(key) for key in ("offset_adu", "law", "light_adu"))
    if not _fits_masses(config) or config.optics.scheme == "darkfield":
        return
    if offset is not None and light:
        known = offset["from"] in (*_FROM_LIGHT, "dark frames")
        sigma = offset["se"] if known else config.uncertainty.offset_adu
        kind: Kind = "measured" if known and offset["from"] != "assumed" else "assumed"
        yield Source("offset of the camera", kind, partial(_as_a_share, sigma / light),
                     "frames without light (iscat calibrate camera)")  # fmt: skip
    if law is not None and (offset is None or offset["from"] not in _FROM_LIGHT):
        yield Source("linearity of the camera, and light that does not interfere", "measured",
                     partial(_as_a_share, law["contrast_se"]),
                     "a calibration of the camera (iscat calibrate camera)")  # fmt: skip
    if camera.get("gain_e_per_adu") is not None:
        yield Source("gain of the camera", "measured", partial(_as_a_share, 0.0),
                     "nothing: it changes sigma, and no mass", moves=False)  # fmt: skip


def _as_a_share(share: float, config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what contrasts that are all wrong by a share do to them and to masses.

    Masses of dipoles are wrong by that share too.  The contrast of a sphere is not in proportion to
    its mass, and its picture changes with it.
    """
    sizes = table[["mass_kda", "contrast"]].abs()
    mass, contrast = (sizes[name].to_numpy(float) for name in sizes)
    result = {"contrast": share * contrast} if config.calibration is None else {}
    if not config.fits_sizes or not share:
        return {"mass_kda": share * mass, **result}
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    if not known.any():
        return {}
    respond = response_of(config, table, ())
    places = table.loc[known, ["z_nm", "mass_kda"]].to_numpy(float).tolist()
    out = np.full(mass.size, np.nan)
    out[known] = [
        abs(share * respond.to_contrast(z, kda, index=own)) * kda
        for (z, kda), own in zip(places, has_own_index(table)[known].tolist(), strict=True)
    ]
    return {"mass_kda": out, **result}


def _of_the_selection(
    threshold_snr: float, config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give by how much masses of those that pass a threshold are too large on average.

    Of a Gaussian of which what is u standard deviations below its middle is cut off, the mean is
    φ(u)/Φ(u) standard deviations higher.
    """
    if not _fits_masses(config):
        return {}
    sigma, snr = (table[name].to_numpy(float) for name in ("sigma_mass_kda", "snr"))
    over = np.maximum(snr - threshold_snr, 0.0)
    shift = np.exp(-0.5 * over**2 - log_ndtr(over)) / math.sqrt(2 * math.pi)
    shift = np.where(shift > _LEAST_SELECTED, shift, 0.0)
    return {"mass_kda": shift * sigma} if np.any(shift > 0) else {}


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
    """Give the error of heavy particles by a line of faint standards.

    It shifts all masses to one side, and is given if all rows together would show it.
    """
    if not _fits_masses(config):
        return {}
    off, sigma = _off_the_line(scale, table)
    return {"mass_kda": off} if np.nansum((off / sigma) ** 2) > _LEAST_SIGMAS**2 else {}


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


def _of_the_reference(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what masses are wrong by where those of the same particles differ over the field."""
    found = reference_map(config, table)
    if found is None:
        return {}
    mass, x, y = (table[name].to_numpy(float) for name in ("mass_kda", "x_px", "y_px"))
    return {"mass_kda": np.abs(mass * found.share(x, y))}


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


def _of_configured_optics(
    tested: Mapping[str, Any], config: Config, table: pd.DataFrame
) -> Mapping[str, FloatArray]:
    """Give the error that configured optics may have, by the images on which they were tested."""
    errors = OpticsCovariance(names=tested["names"], matrix=tested["covariance"])
    field = config.optics.field_px or tested.get("field_px")
    optics = config.optics.model_copy(update={"covariance": errors, "field_px": field})
    return _of_the_optics(config.model_copy(update={"optics": optics}), table)


def _is_about_contrast(config: Config) -> bool:
    """Whether contrasts are the result: masses are fitted, and no calibration makes them."""
    return "mass_kda" in FREE_PARAMETERS[config.fit.mode] and config.calibration is None


def _shifts(config: Config, model: ForwardModel, table: pd.DataFrame) -> FloatArray:
    """Shift of x, y, z, mass and contrast of every event per unit of the optics, (n, 5, k).

    A term of the field shifts an event as the parameters that it changes at the event's place, and
    a focus that moves as it does in its frame.
    """
    errors = config.optics.covariance
    names = errors.names if errors is not None else ()
    if not any(name in WEIGHTS for name in names):
        return _base_shifts(config, model, table, names)
    every = dict.fromkeys(base for name in names for base in BASES.get(name, (name,)))
    bases = tuple(base for base in every if base != REFERENCE)
    found = np.zeros((len(table), len(COMMON), len(bases) + 1))
    found[..., :-1] = _base_shifts(config, model, table, bases) if bases else 0.0
    if _fits_masses(config):  # a brighter reference dims the interference
        found[:, 3, -1] = -table["mass_kda"].to_numpy(float)
    bases = (*bases, REFERENCE)
    x, y, half = centre_of(config.optics, (1, 1))
    shifts = np.zeros((len(table), len(COMMON), len(names)))
    times = [when(config.optics, frame) for frame in table.get("frame", [None] * len(table))]
    places = zip(table["x_px"], table["y_px"], strict=True)
    for event, (shown, place) in enumerate(zip(times, places, strict=True)):
        spot = shown._replace(x=(place[0] - x) / half, y=(place[1] - y) / half)
        for k, name in enumerate(names):
            for base, weight in WEIGHTS[name](spot).items() if name in WEIGHTS else ((name, 1.0),):
                shifts[event, :, k] += weight * found[event, :, bases.index(base)]
    return shifts


def _base_shifts(
    config: Config, model: ForwardModel, table: pd.DataFrame, names: tuple[str, ...]
) -> FloatArray:
    """Shift of every event per unit of parameters that have a derivative, (n, 5, k).

    D changes smoothly with the amplitude and along z with the fringes: a few amplitudes at each of
    some heights serve all events.
    """
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
    middle = line.covariance.of_the_middle
    relative = response_of(at_standards(config), table, middle.names).faint()
    variance = float(relative @ np.array(middle.matrix) @ relative)
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
