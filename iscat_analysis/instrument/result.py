"""What a calibration of the optics hands on: values with errors, and what could not be known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import ndimage

from iscat_analysis._kernels.pupil import zernike
from iscat_analysis.config import (
    FIELD_TERMS,
    JUMPS,
    Config,
    OpticsCovariance,
    field_keys,
    toml_value,
)
from iscat_analysis.findings import Finding
from iscat_analysis.findings import optics as of
from iscat_analysis.instrument.measure import Measured
from iscat_analysis.instrument.particle_image import Build, Images, contrast_of
from iscat_analysis.optics.local import BEND, DRIFT
from iscat_analysis.optics.parameters import (
    FIELD,
    FOCUS_STEP,
    RISES,
    Settings,
    are_told,
    exists,
    is_term,
    with_settings,
)
from iscat_analysis.records import FloatArray
from iscat_analysis.text import brief, in_toml
from iscat_analysis.units import count


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a calibration."""

    measured: FloatArray
    model: FloatArray
    residual: FloatArray
    pixel_nm: float
    radius_nm: FloatArray
    radial: FloatArray
    radial_se: FloatArray
    radial_model: FloatArray
    wavefront_nm: FloatArray
    transmission: FloatArray
    na: float


def make_pictures(images: Images, build: Build, settings: Settings) -> Pictures:
    """Average the pictures and what the microscope makes of them.

    Data and model are moved by the same interpolation, so that it shows in neither residual.
    """
    shape, pixel = images[0].grid.shape, images[0].grid.pixel_nm
    sums, weight = np.zeros((2, *shape)), 0.0
    typical = float(np.median([abs(image.mass_kda) for image in images]))
    for image in images:
        place = (image.grid, image.x_nm, image.y_nm, image.z_nm, image.mass_kda)
        model, _ = build(image.seen_with(settings)).gradient(*place)
        contrast, variance = contrast_of(image)
        used = variance < 1e5
        contrast = np.where(used, contrast, model)
        model = model - float(np.average(model[used], weights=1 / variance[used]))
        back = -np.array(image.offset_nm) / pixel
        scale, level = image.mass_kda / typical, float(np.median(variance))
        for total, shown in zip(sums, (contrast, model), strict=True):
            total += scale * ndimage.shift(shown, back, order=3, mode="nearest") / level
        weight += scale**2 / level
    measured, fitted = sums / weight
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    rings = np.rint(np.hypot(y[:, None], x)).astype(int)
    inside = rings <= min(shape) // 2
    count = np.bincount(rings[inside])
    first = int(np.argmax(count > 0))

    def ring_mean(image: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(rings[inside], image[inside])[first:] / count[first:])

    axis = np.linspace(-1, 1, 129)  # points across the pupil's picture
    rho, phi = np.hypot(axis[:, None], axis), np.arctan2(axis[:, None], axis[None, :])
    disc = rho <= 1
    wavefront = np.zeros(rho.shape)
    for name, size in settings.items():
        if is_term(name) and size:
            wavefront += size * zernike(int(name[1:]), np.minimum(rho, 1.0), phi)[0]
    masked = rho * settings["na"] < settings["mask_na"]
    return Pictures(
        measured=measured,
        model=fitted,
        residual=(measured - fitted) * math.sqrt(weight),
        pixel_nm=pixel,
        radius_nm=pixel * np.arange(first, count.size, dtype=np.float64),
        radial=ring_mean(measured),
        radial_se=1 / np.sqrt(weight * count[first:]),
        radial_model=ring_mean(fitted),
        wavefront_nm=np.where(disc, wavefront, np.nan),
        transmission=np.where(disc, np.where(masked, settings["attenuation"], 1.0), np.nan),
        na=float(settings["na"]),
    )


COLUMNS = ("parameter", "value", "sigma", "crb", "configured", "state")
"""Columns of `OpticsCalibration.parameters`."""


@dataclass(frozen=True, eq=False)
class OpticsCalibration:
    """A microscope as a movie shows it."""

    config: Config
    parameters: pd.DataFrame
    names: tuple[str, ...]
    covariance: FloatArray
    measured: Measured
    pictures: Pictures
    images: int
    source: Mapping[str, str]
    notes: tuple[Finding, ...]

    __repr__ = brief

    @property
    def accepted(self) -> bool:
        """Whether the measured optics may be used."""
        return not self.measured.refusals

    def value(self, name: str) -> float:
        """Value of a continuous parameter, in its unit."""
        return float(self.measured.settings[name])

    def sigma(self, name: str) -> float:
        """Give the standard error of a parameter, NaN where it was not measured."""
        row = self.parameters.set_index("parameter").loc[name]
        return float(row["sigma"])

    def less_sure(self, error: FloatArray) -> OpticsCalibration:
        """Add an error of known size to the uncertainty.

        Shapes: `error` (n,).
        """
        covariance = self.covariance + np.outer(error, error)
        parameters = self.parameters.copy()
        sigmas = dict(zip(self.names, np.sqrt(np.diag(covariance)), strict=True))
        sigma = parameters["parameter"].map(sigmas)
        parameters["sigma"] = sigma.where(sigma.notna(), parameters["sigma"])
        config = self.config
        if self.accepted:
            config = _with_covariance(config, self.names, covariance)
        return replace(self, config=config, parameters=parameters, covariance=covariance)

    def names_of(self, state: str) -> list[str]:
        """Name the parameters of a state."""
        return list(self.parameters.loc[self.parameters["state"] == state, "parameter"])

    def headline(self, picture_of: str = "particle") -> str:
        """Say in one line what was found."""
        judged, before = self.measured.judgement, self.measured.configured
        jumps = zip(JUMPS, self.config.optics.focus_jumps, strict=False)
        labels = {
            "focus_nm": ("focus", "nm"),
            "na": ("NA", ""),
            "reference_phase_deg": ("phase", "deg"),
            FOCUS_STEP: ("steps of", "nm"),
            DRIFT: ("focus rising by", "nm in 1000 frames"),
            BEND: ("focus bent by", "nm 1000 frames from the middle"),
            **{name: ("focus jumping by", f"nm at frame {frame}") for name, (frame, _) in jumps},
            **{name: (name_in_words(name), name.rsplit("_", 1)[1]) for name in FIELD},
        }
        parts = [
            with_error(label, self.value(name), self.sigma(name), unit)
            for name, (label, unit) in labels.items()
            if name in self.names
        ]
        terms = [n for n in self.names if is_term(n)]
        if terms:
            rms = float(np.sqrt(sum(self.value(n) ** 2 for n in terms)))
            parts.append(f"aberrations {rms:.1f} nm rms")
        if self.value("mask_na"):
            parts.append(f"mask of NA {self.value('mask_na'):.3f}")
        parts.append(f"{self.measured.settings['polarization']} polarisation")
        return (
            f"{', '.join(parts)} from {count(self.images, picture_of)}; reduced chi2 of "
            f"{judged.pictures} {np.mean(judged.chi2_reduced):.3f} "
            f"({np.mean(before.chi2_reduced):.3g} as configured)"
        )

    def with_phase(self, phase_deg: float, note: Finding) -> OpticsCalibration:
        """Take the reference phase half a turn away, which explains the pictures as well."""
        name = "reference_phase_deg"
        parameters = self.parameters.copy()
        parameters.loc[parameters["parameter"] == name, "value"] = phase_deg
        measured = replace(self.measured, settings={**self.measured.settings, name: phase_deg})
        return replace(
            self,
            config=self.config.changed(optics={name: phase_deg}),
            parameters=parameters,
            measured=measured,
            notes=(note, *self.notes),
        )

    def to_toml(self) -> str:
        """Write what ``[optics] file`` reads."""
        optics = self.config.optics
        lines = ["# Optics measured by `iscat calibrate optics`", "", "[optics]"]
        keys = ("polarization", "polarization_deg", "analyzer", "na", "attenuation", "mask_na",
                "focus_nm", "reference_phase_deg")  # fmt: skip
        values = {key: getattr(optics, key) for key in keys}
        lines += [
            f"{key} = {v:.9g}" if type(v) is float else f"{key} = {toml_value(v)}"
            for key, v in values.items()
        ]
        terms = ", ".join(f"{n} = {v:.9g}" for n, v in optics.aberrations_nm.items())
        lines += [f"aberrations_nm = {{ {terms} }}"]
        uneven = {name: optics.field_term(name) for name in FIELD_TERMS if optics.field_term(name)}
        field = [*field_keys(uneven), *(["field_px"] if uneven else [])]
        lines += [f"{key} = {toml_value(getattr(optics, key))}" for key in field]
        lines += ["", "[uncertainty]"]
        names, covariance = _without(RISES, self.names, self.covariance)
        lines += [f"{name} = {self.sigma(name):.6g}" for name in names]
        quoted = ", ".join(f'"{name}"' for name in names)
        lines += ["", "[covariance]", f"names = [{quoted}]", "matrix = ["]
        lines += [f"  [{', '.join(f'{v:.9g}' for v in row)}]," for row in covariance]
        lines += ["]", "", "[provenance]"]
        lines += [f"{key} = {in_toml(text)}" for key, text in self.source.items()]
        if FOCUS_STEP in self.names:
            lines += [f"{FOCUS_STEP} = {self.value(FOCUS_STEP):.9g}"]
        return "\n".join([*lines, f"particles = {self.images}", ""])

    def to_dict(self) -> dict[str, Any]:
        """Give what ``optics.json`` holds."""
        found = self.measured
        twin, shown = found.twin, vars(self.pictures)
        return {
            "accepted": self.accepted,
            "refusals": list(found.refusals),
            "parameters": self.parameters.replace({np.nan: None}).to_dict("records"),
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "correlation": correlation(self.covariance).tolist(),
            "settings": dict(found.settings),
            "untold": self.names_of("prior"),
            "dropped": self.names_of("dropped"),
            "undecided": list(found.undecided),
            "twin": None if twin is None else {"settings": dict(twin.settings), "gap": twin.gap},
            "held_out": found.judgement.told,
            "held_out_as_configured": found.configured.told,
            "particles": self.images,
            "contaminated": found.contaminated,
            "source": dict(self.source),
            "pictures": {k: v.tolist() if hasattr(v, "tolist") else v for k, v in shown.items()},
            "notes": [note.text for note in self.notes],
        }


def make_result(
    config: Config,
    configured: Mapping[str, Any],
    measured: Measured,
    pictures: Pictures,
    source: Mapping[str, str],
    notes: Sequence[Finding] = (),
) -> OpticsCalibration:
    """Put a result together, with what else could not be known."""
    estimate = measured.estimate
    covariance, bound = estimate.covariance, estimate.bound
    told = are_told(np.sqrt(np.diag(covariance)), estimate.errors)
    rows = []
    for name, value in measured.settings.items():
        turns = name == "polarization_deg"
        if isinstance(value, str | bool) or (turns and not exists(name, measured.settings)):
            continue
        state = "given"
        sigma = crb = float("nan")
        if name in estimate.names:
            k = estimate.names.index(name)
            sigma, crb = float(np.sqrt(covariance[k, k])), float(np.sqrt(bound[k, k]))
            state = "dropped" if name in measured.dropped else "measured"
            if not told[k]:
                state = "prior"
        rows.append((name, float(value), sigma, crb, float(configured[name]), state))
    untold, dropped = ([row[0] for row in rows if row[-1] == s] for s in ("prior", "dropped"))
    if not measured.refusals:
        there = with_settings(config, measured.settings)
        config = _with_covariance(there, estimate.names, covariance)
    return OpticsCalibration(
        config=config,
        parameters=pd.DataFrame(rows, columns=list(COLUMNS)),
        names=estimate.names,
        covariance=covariance,
        measured=measured,
        pictures=pictures,
        images=len(estimate.images),
        source=source,
        notes=(*_notes(measured, untold, dropped), *notes),
    )


def _without(
    left_out: Sequence[str], names: tuple[str, ...], covariance: FloatArray
) -> tuple[tuple[str, ...], FloatArray]:
    kept = [k for k, name in enumerate(names) if name not in left_out]
    return tuple(names[k] for k in kept), covariance[np.ix_(kept, kept)]


def _with_covariance(config: Config, names: tuple[str, ...], covariance: FloatArray) -> Config:
    """Put the errors beside the values, from where fits take what is common to all events."""
    names, covariance = _without((FOCUS_STEP,), names, covariance)
    errors = OpticsCovariance(names=names, matrix=tuple(map(tuple, covariance.tolist())))
    return config.changed(optics={"covariance": errors})


def _notes(
    measured: Measured, untold: Sequence[str], dropped: Sequence[str]
) -> tuple[Finding, ...]:
    """Say in words what could not be known."""
    notes = [of.UNTOLD_OPTICS({"names": ", ".join(untold)})] if untold else []
    notes += [of.UNDECIDED_OPTICS({"name": name}) for name in measured.undecided]
    if dropped:
        pictures = measured.judgement.pictures
        notes.append(of.DROPPED_TERMS({"names": ", ".join(dropped), "pictures": pictures}))
    if measured.contaminated:
        notes.append(of.PICTURES_LEFT_OUT({"pictures": count(measured.contaminated, "picture")}))
    twin = measured.twin
    if twin is not None:
        focus, phase = (twin.settings[key] for key in ("focus_nm", "reference_phase_deg"))
        said = {"gap": abs(twin.gap), "lower": "lower" if twin.gap >= 0 else "higher"}
        notes.append(of.TWIN_OPTICS({"focus_nm": focus, "phase_deg": phase, **said}))
    return tuple(notes)


def correlation(covariance: FloatArray) -> FloatArray:
    """Give the correlation matrix of a covariance.

    Shapes: `covariance` (n, n), result (n, n).
    """
    sigma = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sigma, sigma)) if sigma.size else covariance


def name_in_words(name: str) -> str:
    """Say what a coefficient of the field is."""
    what, *_, last, _ = name.split("_")
    kind = {"tilt": "tilt", "curvature": "curvature"}.get(name.split("_")[1], "over the field")
    return f"{what} {kind} along {last}" if last in ("x", "y") else f"{what} {kind}"


def with_error(label: str, value: float, sigma: float, unit: str) -> str:
    """Write a value with as many digits as its error deserves."""
    digits = max(0, 1 - int(np.floor(np.log10(sigma)))) if sigma > 0 else 3
    return f"{label} {value:.{digits}f} ± {sigma:.{digits}f} {unit}".rstrip()
