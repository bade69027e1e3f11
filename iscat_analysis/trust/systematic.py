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
from scipy.special import log_ndtr

from iscat_analysis.bounds import peak_gradient
from iscat_analysis.calibration import line_sigma_kda
from iscat_analysis.config import Config, OpticsCovariance
from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import WIDE_SPECIES
from iscat_analysis.inference.repeats import EmpiricalSpread
from iscat_analysis.optics.forward import (
    PEAK_SEARCH_RADIUS,
    ForwardModel,
    MassScale,
    PixelGrid,
    forward_model,
    signed_peak,
)
from iscat_analysis.optics.local import BASES, REFERENCE, WEIGHTS, centre_of, when
from iscat_analysis.optics.scatterers import material
from iscat_analysis.optics.waves import Template
from iscat_analysis.records import FREE_PARAMETERS, BoolArray, FloatArray, Status
from iscat_analysis.trust.response import (
    COMMON,
    Response,
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

_LEAST_SIGMAS = 0.5  # of σ, beyond which it is in the budget
_SAME = 1e-6  # change of the scale, which rounding leaves between equal optics
# What rounding leaves of a place, mass or contrast that the optics do not change [nm, kDa, and 1]
_NOTHING = {"x_nm": 1e-4, "y_nm": 1e-4, "z_nm": 1e-4, "mass_kda": 1e-9, "contrast": 1e-9}

Sigmas = Mapping[str, FloatArray]
"""Standard deviations for every event, by name in `COMMON`; none of what a source does not move."""

Errors = Callable[[Config, pd.DataFrame], Sigmas]

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


Contribution = tuple[Source, Sigmas]
"""A source with what it makes of every event, by name in `COMMON`."""


def contributions(
    config: Config,
    table: pd.DataFrame,
    summary: Mapping[str, Any] = MappingProxyType({}),
    *,
    mass_share: float = 0.0,
    scale: MassScale | None = None,
    held_kda: Mapping[str, FloatArray] = MappingProxyType({}),
    threshold_snr: float = 0.0,
) -> list[Contribution]:
    """Give what each source makes of the events of a movie, where it makes anything of them.

    The summary has sections on camera and optics; `threshold_snr` is that of the search.

    Shapes: `held_kda` (rows,) each: what heights or extensions that were held do to the masses.
    """
    camera, optics = (summary.get(name) or {} for name in ("camera", "optics"))
    line = config.calibration
    dof = None if line is None or line.dof is None else float(line.dof)
    sources = [
        Source("line of the standards", "measured", _of_the_line,
               "more standards, and more events of each", dof),
        Source("optics of the movie", "learned", _of_the_optics,
               "more or brighter particles, from which the optics are learned"),
        Source("optics of the standards", "learned", _of_the_standards,
               "more or brighter standards, or standards and sample at one focus"),
        Source("measured picture", "measured", _of_the_template,
               "more particles for the picture, or standards measured with it"),
        Source("optics that do not describe the pictures", "measured",
               partial(_of_what_is_left_over, mass_share),
               "find what the model lacks: focus, aperture, aberrations, pixel size"),
        Source("amplitude of the reference over the field", "measured", _of_the_reference,
               "configure it: optics.reference_tilt and optics.reference_curvature"),
        *(Source(label, "assumed", partial(assumed_error, key), remedy)
          for key, (label, remedy) in INPUTS.items()),
        *_of_the_camera(config, camera),
        *(Source(f"{name} of the particles", "measured", partial(_as_given, shift), _HELD[name])
          for name, shift in held_kda.items() if shift.any()),
    ]  # fmt: skip
    if scale is not None:
        sources += [
            Source("standards measured with unknown optics", "assumed",
                   partial(_of_the_missing_record, scale),
                   "calibrate with the folder of the standards' analysis"),
            Source("square of the scattered light", "measured", partial(_of_heavy_particles, scale),
                   "standards as heavy as the particles"),
        ]  # fmt: skip
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


_HELD = {
    "heights": 'fit them: particle.height_nm = "auto", or particle.height_sd_nm',
    "extension": "more or brighter particles; particle.wiggle_nm, uncertainty.wiggle_nm",
}
"""What shrinks the errors by heights or extensions that were held, although particles differ."""


def _as_given(shift_kda: FloatArray, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give errors of masses that are known already.

    Shapes: `shift_kda` (rows,).
    """
    del config, table
    return {"mass_kda": shift_kda}


def _masses(table: pd.DataFrame) -> FloatArray:
    """Magnitudes of the masses [kDa], shape (rows,)."""
    return np.asarray(np.abs(table["mass_kda"].to_numpy(float)))


def _predicts_pictures(config: Config) -> bool:
    """Whether an exact model makes pictures that interfere, of pixels of known size."""
    optics = config.optics
    exact = optics.convention == "exact" and optics.psf == "model"
    return exact and optics.interferes and config.camera.pixel_size_nm is not None


_FROM_LIGHT = ("measured", "assumed")
"""Where an error of the offset is from the law of the counts, that of their linearity is the same.
"""


def _of_the_camera(config: Config, camera: Mapping[str, Any]) -> Iterator[Source]:
    """Give what counts in the dark, and counts that are not in proportion to light, do to masses.

    Contrast is a change of counts over counts above the offset: offset too high by δ makes it too
    large by δ/counts.  The gain is in both, and leaves it as it is.
    """
    offset, law, light = (camera.get(key) for key in ("offset_adu", "law", "light_adu"))
    if not (config.fit.masses_free and config.optics.interferes):
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


def _as_a_share(share: float, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what contrasts that are all wrong by a share do to them and to masses.

    Masses of dipoles are wrong by that share too.  The contrast of a sphere is not in proportion to
    its mass, and its picture changes with it.
    """
    mass, contrast = _masses(table), table["contrast"].abs().to_numpy(float)
    result = {"contrast": share * contrast} if config.calibration is None else {}
    if not config.fits_sizes or not share:
        return {"mass_kda": share * mass, **result}
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    if not known.any():
        return {}
    respond = response_of(config, table, ())
    rows = zip(table["z_nm"][known], mass[known], has_own_index(table)[known], strict=True)
    out = np.full(mass.size, np.nan)
    out[known] = [abs(share * respond.to_contrast(z, kda, index=own)) * kda for z, kda, own in rows]
    return {"mass_kda": out, **result}


def _of_the_selection(threshold_snr: float, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give by how much masses of those that pass a threshold are too large on average.

    Of a Gaussian of which what is u standard deviations below its middle is cut off, the mean is
    φ(u)/Φ(u) standard deviations higher.
    """
    if not config.fit.masses_free:
        return {}
    sigma, snr = (table[name].to_numpy(float) for name in ("sigma_mass_kda", "snr"))
    over = np.maximum(snr - threshold_snr, 0.0)
    shift = np.exp(-0.5 * over**2 - log_ndtr(over)) / math.sqrt(2 * math.pi)
    shift = np.where(shift > 0.01, shift, 0.0)  # of σ, below which a threshold does nothing
    return {"mass_kda": shift * sigma} if np.any(shift > 0) else {}


def _of_the_missing_record(scale: MassScale, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what the carried scale is wrong by, if the standards had the optics of the movie."""
    line, share = config.calibration, abs(scale.carried - 1)
    if line is None or not line.optics_assumed or share < _SAME or not config.fit.masses_free:
        return {}
    return {"mass_kda": share * _masses(table)}


def misfit_error(table: pd.DataFrame, pixels: int) -> float:
    """Say how wrong masses may be, as a share, where the model leaves something over of pictures.

    What is left over beyond the noise grows as the square of the SNR; noise that is not what the
    camera's numbers predict is the same in faint and bright pictures.  Medians of both halves tell
    them apart.
    """
    judged = table["status"].isin([Status.OK.value, Status.POOR_FIT.value])
    rows = table[judged & np.isfinite(table["chi2_reduced"]) & np.isfinite(table["snr"])]
    if len(rows) < 8:  # that tell what is left over of them
        return 0.0
    rows = rows.sort_values("snr")
    power, excess = (rows["snr"] ** 2 / pixels).to_numpy(), rows["chi2_reduced"].to_numpy() - 1
    half = len(rows) // 2
    rise, over = float(np.median(power[half:])), float(np.median(excess[half:]))
    error = 1.2533 * math.sqrt(2 / pixels / half)  # standard error of a median over that of a mean
    faint = float(np.median(power[:half]))
    # ratio of squared SNR, over which noise and misfit can be told apart
    if rise > 2.0 * faint:
        rise, over = rise - faint, over - float(np.median(excess[:half]))
        error *= math.sqrt(2)
    if over < 5.0 * error:  # by which something is left over
        return 0.0
    share = math.sqrt(over / rise)
    return MASS_SHARE * share if share > REJECTED_SHARE else 0.0


def _of_what_is_left_over(mass_share: float, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what masses are wrong by where the optics were rejected, and no others learned."""
    del config
    return {"mass_kda": mass_share * table["mass_kda"].to_numpy(float)} if mass_share else {}


def _of_heavy_particles(scale: MassScale, config: Config, table: pd.DataFrame) -> Sigmas:
    """Give the error of heavy particles by a line of faint standards.

    It shifts all masses to one side, and is given if all rows together would show it.
    """
    if not config.fit.masses_free:
        return {}
    off, sigma = _off_the_line(scale, table)
    return {"mass_kda": off} if np.nansum((off / sigma) ** 2) > _LEAST_SIGMAS**2 else {}


def is_bent(scale: MassScale, table: pd.DataFrame) -> BoolArray:
    """Tell which masses a line of faint standards is clearly wrong about.

    Shapes: result (rows,).
    """
    off, sigma = _off_the_line(scale, table)
    share = off / np.maximum(_masses(table), 1e-300)
    return np.asarray(
        # beyond which the square is clear in a single row, however small its share
        (off > 5.0 * sigma)
        # of a mass; beneath, lines of standards that scatter by a per cent are as wrong
        | ((share > 0.02) & (off > _LEAST_SIGMAS * sigma)),
        dtype=np.bool_,
    )


def _off_the_line(scale: MassScale, table: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Give what the square of the scattered light adds to masses, and σ where rows are ok."""
    mass, sigma = (table[name].to_numpy(float) for name in ("mass_kda", "sigma_mass_kda"))
    good = (table["status"] == Status.OK.value).to_numpy()
    return np.abs(mass * scale.bend(mass)), np.where(good, sigma, np.nan)


def _of_the_reference(config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what masses are wrong by where those of the same particles differ over the field."""
    found = reference_map(config, table)
    if found is None:
        return {}
    mass, x, y = (table[name].to_numpy(float) for name in ("mass_kda", "x_px", "y_px"))
    return {"mass_kda": np.abs(mass * found.share(x, y))}


def _of_the_line(config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what the line between contrast and mass may be wrong by."""
    line = config.calibration
    if line is None or not (line.gradient_se_per_kda or line.offset_se):
        return {}
    mixed = line.correlation * line.gradient_se_per_kda * line.offset_se
    covariance = np.array([[line.gradient_se_per_kda**2, mixed], [mixed, line.offset_se**2]])
    mass = table["mass_kda"].to_numpy(dtype=float)
    return {"mass_kda": line_sigma_kda(mass, line.gradient_per_kda, covariance)}


def _of_the_optics(config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what the measured optics may be wrong by: D Σ Dᵀ of `bounds.shared`."""
    errors, pixel = config.optics.covariance, config.camera.pixel_size_nm
    if errors is None or not errors.names or pixel is None or not _predicts_pictures(config):
        return {}
    grid = PixelGrid.centred(config.roi_px, pixel)
    known = table[["z_nm", "mass_kda"]].notna().all(axis=1).to_numpy()
    model = forward_model(config, 1.05 * grid.diagonal_nm / 2)
    shifts = np.full((len(table), len(COMMON), len(errors.names)), np.nan)
    if known.any():
        shifts[known] = _shifts(config, model, table[known])
    covariance = np.array(errors.matrix)
    variance = np.einsum("eik,kl,eil->ei", shifts, covariance, shifts)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    reported = [*FREE_PARAMETERS[config.fit.mode], *["contrast"] * _is_about_contrast(config)]
    return {name: sigma[:, k] for k, name in enumerate(COMMON) if name in reported}


def _of_configured_optics(tested: Mapping[str, Any], config: Config, table: pd.DataFrame) -> Sigmas:
    """Give the error that configured optics may have, by the images on which they were tested."""
    errors = OpticsCovariance(names=tested["names"], matrix=tested["covariance"])
    field = config.optics.field_px or tested.get("field_px")
    return _of_the_optics(config.changed(optics={"covariance": errors, "field_px": field}), table)


def _is_about_contrast(config: Config) -> bool:
    """Whether contrasts are the result: masses are fitted, and no calibration makes them."""
    return config.fit.masses_free and config.calibration is None


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
    if config.fit.masses_free:  # a brighter reference dims the interference
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
    if config.fit.masses_free:
        shifts[:, 3] *= (amplitude * model.scale.slopes(amplitude))[:, None]
        if standards_share(config):
            line, scale = config.calibration, model.scale
            gradient = line.gradient_per_kda if line is not None else 1.0
            contrast = scale.linear * amplitude + scale.quadratic * amplitude**2
            shifts[:, 3] -= (contrast / gradient)[:, None] * respond.faint()
    return shifts


def _of_the_standards(config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what the learned optics of the standards may be wrong by, where they are others."""
    line, pixel = config.calibration, config.camera.pixel_size_nm
    if line is None or line.optics is None or line.covariance is None or pixel is None:
        return {}
    if line.optics.psf == "measured" or standards_share(config) or not config.fit.masses_free:
        return {}
    middle = line.covariance.of_the_middle
    relative = response_of(at_standards(config), table, middle.names).faint()
    variance = float(relative @ np.array(middle.matrix) @ relative)
    return {"mass_kda": _masses(table) * math.sqrt(max(variance, 0.0))}


def _of_the_template(config: Config, table: pd.DataFrame) -> Sigmas:
    """Give what the peak of a measured picture may be wrong by.

    All contrasts share its relative error.  The standards of a line that was measured with the
    same template have it too, and it cancels; places are relative to the picture's own centre.
    """
    optics = config.optics
    if optics.psf != "measured" or optics.template is None or config.calibration is not None:
        return {}
    relative, results = Template.read(Path(optics.template)).peak_se, ("mass_kda", "contrast")
    return {name: relative * table[name].abs().to_numpy(float) for name in results}


_STEP = 0.1  # of a standard deviation, for derivatives


INPUTS = {
    "wavelength_nm": ("wavelength", "measure the spectrum of the light"),
    "n_sample": ("refractive index of the sample", "measure the index of the buffer"),
    "n_glass": ("refractive index of the glass", "take the maker's value at this wavelength"),
    "index": ("refractive index of the spheres", "spheres that move, or of known diameter"),
    "height_nm": ("mean height of the particles", "standards that bind at the same height"),
    "magnification": ("magnification", "measure the pixel size with a graticule"),
}
"""Inputs of the model by their keys in [uncertainty], in the order of the budget: what each is, and
what shrinks its error.  Standards of the same set-up take all of them away."""


def assumed_error(key: str, config: Config, table: pd.DataFrame) -> Sigmas:
    """Error of the masses of a movie that the uncertainty of one input makes.

    If an input is off by δ, the pictures are those of the input plus δ, and the fit imitates the
    change with the amplitude of the particle: a relative shift D·δ.  What becomes of the mass
    depends on where its scale is from:

    * standards that were recorded, with the same value of the input: their amplitudes shifted too,
    and D_here − D_there remains, which is nothing where all is equal; * standards that were
    recorded with another value: both shifts, independent of each other; * a gradient from
    elsewhere: if it is of a set-up where the input was right, D; if it is the true contrast per kDa
    of this one, which the model turns amplitudes into with the wrong input, D − ∂ ln L/∂input, L
    the model's contrast per amplitude.  Nobody knows which: the larger counts.

    The mass of a sphere follows from its picture without standards, and what remains of it is D.

    Where optics were learned from pictures, with the wrong input, they are wrong as well: their
    shift is part of D, and of L where the gradient is taken at learned optics.
    """
    sigma = float(getattr(config.uncertainty, key))
    line = config.calibration
    if not sigma or table.empty:
        return {}
    if config.fits_sizes:
        return _of_spheres(key, config, table, sigma)
    suited = _predicts_pictures(config) and config.fit.masses_free
    if key == "index" or line is None or not suited:
        return {}
    there = at_standards(config)
    recorded = line.optics is not None and not line.optics_assumed
    if recorded and _alike(config, there):
        return {}
    mass = _masses(table)
    good = mass[(table["status"] == Status.OK.value).to_numpy()]
    standards = _Offset(key, sigma, there, response_of(there, table))
    here = _Offset(key, sigma, config, response_of(config, table))
    shift = here.shift(float(np.median(good)) if good.size else None)
    if not recorded:
        share = max(abs(shift), abs(shift - standards.peak_shift()))
    elif here.value == standards.value:
        share = abs(shift - standards.shift())
    else:
        share = math.hypot(shift, standards.shift())
    return {"mass_kda": share * mass}


def _of_spheres(key: str, config: Config, table: pd.DataFrame, sigma: float) -> Sigmas:
    """Error of the masses of spheres, which follow from their pictures without standards.

    An index that was fitted is not assumed, and takes its part of what other inputs have wrong.
    """
    mass = _masses(table)
    if not (config.optics.interferes and np.isfinite(mass).any()):
        return {}
    own, share = has_own_index(table), np.zeros(mass.size)
    offset = _Offset(key, sigma, config, response_of(config, table))
    for index in (False, True):
        rows = (own == index) & np.isfinite(mass)
        if rows.any() and not (index and key == "index"):
            share[rows] = abs(offset.shift(float(np.median(mass[rows])), index=index))
    return {"mass_kda": share * mass}


def _alike(here: Config, there: Config) -> bool:
    """Tell whether standards were measured like the particles, so that all shifts are equal."""
    same: dict[str, Any] = {"file": None, "calibrate": "auto"}
    return (
        here.optics.model_copy(update=same) == there.optics.model_copy(update=same)
        and here.particle.nominal_height_nm == there.particle.nominal_height_nm
        and here.camera.pixel_size_nm == there.camera.pixel_size_nm
        and here.fit.mode == "mass"
    )


@dataclass(frozen=True)
class _Offset:
    """One standard deviation by which an input of the model is off, and what estimates do."""

    key: str
    sigma: float
    config: Config
    respond: Response

    @property
    def value(self) -> float | None:
        """The input as it is configured."""
        if self.key == "height_nm":
            return self.config.particle.nominal_height_nm
        if self.key == "magnification":
            return self.config.camera.pixel_size_nm
        return float(getattr(self.config.optics, self.key))

    def shift(self, mass_kda: float | None = None, *, index: bool = False) -> float:
        """Relative shift of the amplitude of a particle of a mass, or of a faint one as standards.

        The `index` of a sphere may be free.
        """
        amplitude = self.respond.faint_amplitude
        if mass_kda is not None:
            scale = forward_model(self.config, self.respond.model.reach_nm).scale
            amplitude = float(scale.amplitudes(mass_kda))
        return self.respond.to_input(self._change(amplitude), amplitude, index=index).amplitude

    def peak_shift(self) -> float:
        """Relative error of the model's contrast per amplitude."""

        def peak(sign: float) -> float:
            moved = _moved(self.key, self.config, sign * _STEP * self.sigma)
            reach_nm = PEAK_SEARCH_RADIUS * moved.optics.wavelength_nm / moved.optics.na
            return signed_peak(forward_model(moved, reach_nm))

        shift, respond = 0.0, self.respond
        if self.key != "magnification":
            shift = (peak(1.0) - peak(-1.0)) / (2 * _STEP) / peak(0.0)
        if respond.names:
            faint, height = respond.faint_amplitude, respond.model.height_nm
            optics = respond.to_input(self._change(faint), faint).optics
            contrast, _, slopes = peak_gradient(respond.model, height, faint, respond.names)
            shift -= float(slopes @ optics) / contrast
        return shift

    def _change(self, amplitude: float) -> FloatArray:
        """Change of the picture, (ny, nx)."""
        model, grid = self.respond.model, self.respond.grid
        x, y, z, *_ = self.respond.theta(model.height_nm, amplitude)

        def picture(sign: float) -> FloatArray:
            step = sign * _STEP * self.sigma
            if self.key == "height_nm":
                return model.amplitude_image(grid, x, y, z + step, amplitude)
            if self.key == "magnification":
                larger = PixelGrid(
                    grid.x_nm * (1 + step), grid.y_nm * (1 + step), grid.pixel_nm * (1 + step)
                )
                return model.amplitude_image(larger, x, y, z, amplitude)
            moved = forward_model(_moved(self.key, self.config, step), model.reach_nm)
            return moved.amplitude_image(grid, x, y, z, amplitude)

        return (picture(1.0) - picture(-1.0)) / (2 * _STEP)


def _moved(key: str, config: Config, step: float) -> Config:
    """Move an input, and leave the stage where it is."""
    config = config.changed(calibration=None)
    if key == "index":
        index = np.sqrt(material(config.particle, config.optics.wavelength_nm).permittivity) + step
        permittivity = float((index**2).real), float((index**2).imag)
        return config.changed(particle={"permittivity": permittivity, "index": None})
    if key == "height_nm":
        height, optics = config.particle.nominal_height_nm + step, config.optics
        # the oil, which the nominal height and the focus set together, stays
        focus = optics.focus_nm + step * (1 - optics.n_immersion / optics.n_sample)
        return config.changed(particle=config.particle.held_at(height), optics={"focus_nm": focus})
    return config.changed(optics={key: float(getattr(config.optics, key)) + step})


SCALE = "scale of the model", "measure standards (iscat calibrate mass)"
"""What nobody knows of masses without standards, and what tells it."""

SPHERES = "density of the spheres", "weigh some: a diameter does not need it"
"""The same of spheres, whose masses follow from their pictures with these."""

_CLEAR_SIGMAS = 3.0  # standard errors by which noise is more than σ says


def budget_of(
    table: pd.DataFrame,
    found: Sequence[Contribution],
    achieved: Mapping[str, EmpiricalSpread],
    *,
    unknown: tuple[str, str] | None,
    scaled: bool,
) -> list[dict[str, Any]]:
    """List what the error of a mass is made of: medians over the rows that are ok.

    Sources that are common to all rows add up to ``systematic_mass_kda``.  What is `unknown` has a
    name and a remedy, and no size.
    """
    good = table["status"] == Status.OK.value
    rows = table[good] if good.any() else table
    mass, noise = _masses(rows), rows["sigma_mass_kda"].to_numpy(float)
    if not np.isfinite(noise).any():
        return []
    own = {"photon noise": noise}
    own["bias of faint particles, taken off"] = noise**3 / mass**2  # 1/SNR², at an SNR off by 1
    remedies = dict.fromkeys(own, "more light, or more frames of each particle")
    spread = achieved.get("mass_kda")
    exceeds = spread is not None and spread.significance > _CLEAR_SIGMAS and spread.over_crb > 1
    if spread is not None and exceeds and not scaled:
        own["noise beyond photons"] = noise * math.sqrt(spread.over_crb**2 - 1)
        remedies["noise beyond photons"] = (
            'steadier light or stage; fit.sigma = "measured" puts it into sigma'
        )
    budget = [
        _entry(name, "measured", remedies[name], sigma, mass, common=False)
        for name, sigma in own.items()
    ]
    kept = rows.index.to_numpy()
    common = [
        _entry(one.name, one.kind, one.remedy, errors["mass_kda"][kept], mass, dof=one.dof)
        for one, errors in found
        if "mass_kda" in errors
    ]
    if unknown is not None:
        common.append(_entry(unknown[0], "assumed", unknown[1], np.full(mass.size, np.nan), mass))
    return budget + sorted(common, key=lambda one: -(one["sigma_mass_kda"] or math.inf))


def _entry(
    name: str,
    kind: Kind,
    remedy: str,
    sigma: FloatArray,
    mass: FloatArray,
    *,
    common: bool = True,
    dof: float | None = None,
) -> dict[str, Any]:
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.abs(sigma) / mass
    return {
        "name": name,
        "kind": kind,
        "common": common,
        "sigma_mass_kda": _median(np.abs(sigma)),
        "sigma_rel": _median(relative),
        "dof": dof,
        "remedy": remedy,
    }


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def explained_kda(budget: Sequence[Mapping[str, Any]]) -> float:
    """Width of a species that the budget explains beyond σ: errors that differ between rows."""
    own = [one for one in budget if not one["common"] and one["name"] != "photon noise"]
    return math.sqrt(sum((one["sigma_mass_kda"] or 0.0) ** 2 for one in own))


def wide_species(across: Sequence[Mapping[str, Any]], *, calibrated: bool) -> Finding | None:
    """Say which species is widest beyond what the budget explains; None where it explains all."""
    wide = []
    for one in across:
        low, width = one["width_low"], one["width_kda"]
        if low is None or width is None or not math.isfinite(low) or not one["mass_kda"]:
            continue  # nothing is a share of no mass
        sigma = width / math.sqrt(max(one["spread_over_sigma"] ** 2 - 1, 1e-12))
        # of σ: a width beneath it is not worth a line
        if low > max(one["explained_kda"], 0.25 * sigma):
            wide.append(one)
    if not wide:
        return None
    one = max(wide, key=lambda each: each["width_kda"] / each["mass_kda"])
    names = {"percent": "width_kda", "least_percent": "width_low"}
    names |= {"explained_percent": "explained_kda"}
    shares = {name: 100 * one[key] / one["mass_kda"] for name, key in names.items()}
    where = f"at {one['mass_kda']:.4g} kDa" if calibrated else "of contrast"
    return WIDE_SPECIES(shares | {"where": where})
