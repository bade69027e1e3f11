"""Pages of `iscat calibrate`: camera, mass standards, optics, and the measured picture.

Everything arrives as what the JSON files hold; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from iscat_analysis.optics.waves import Template
from iscat_analysis.report.numbers import (
    Fact,
    Table,
    decimals_for,
    fixed,
    intervals,
    number,
    numeric,
    of,
    percent,
    sentence,
    tabulate,
    with_interval,
    worded,
)
from iscat_analysis.report.page import (
    OPTICS_FILE,
    Chart,
    Section,
    around,
    configuration,
    curves,
    heatmap,
    marks,
    notes_section,
    pictures,
    render_document,
    with_ends,
)
from iscat_analysis.units import count

_PASTED = "To paste into the configuration of the measurement."
_SOURCES = {
    "dark": "from the dark",
    "given": "as given",
    "flicker": "from the laser's flicker",
    "line": "o − σ_r²/g: where the variance would vanish",
}
_LABELS = {
    "focus_nm": ("focus", "nm"),
    "na": ("numerical aperture", ""),
    "reference_phase_deg": ("reference phase", "deg"),
    "mask_na": ("edge of the mask", "NA"),
    "attenuation": ("amplitude that the mask passes", ""),
    "polarization_deg": ("direction of polarisation", "deg"),
    "focus_step_nm": ("rise of the focus per picture", "nm"),
    "focus_drift_nm": ("rise of the focus in 1000 frames", "nm"),
    "focus_bend_nm": ("bend of the focus in 1000 frames", "nm"),
    **{f"focus_jump_{k}_nm": (f"jump of the focus, number {k}", "nm") for k in range(1, 5)},
    "focus_tilt_x_nm": ("rise of the focus to the edge of the field, x", "nm"),
    "focus_tilt_y_nm": ("rise of the focus to the edge of the field, y", "nm"),
    "focus_curvature_nm": ("curvature of the focus at the edge", "nm"),
    "coma_field_nm": ("coma at the edge of the field", "nm"),
    "astigmatism_field_x_nm": ("astigmatism at the edge of the field, x", "nm"),
    "astigmatism_field_y_nm": ("astigmatism at the edge of the field, y", "nm"),
    "phase_tilt_x_deg": ("reference phase to the edge of the field, x", "deg"),
    "phase_tilt_y_deg": ("reference phase to the edge of the field, y", "deg"),
    "phase_curvature_deg": ("curvature of the reference phase at the edge", "deg"),
    "z5": ("Z5 astigmatism, 45°", "nm"),
    "z6": ("Z6 astigmatism, 0°", "nm"),
    "z7": ("Z7 coma, y", "nm"),
    "z8": ("Z8 coma, x", "nm"),
    "z9": ("Z9 trefoil, y", "nm"),
    "z10": ("Z10 trefoil, x", "nm"),
    "z11": ("Z11 spherical", "nm"),
    "z22": ("Z22 spherical, second", "nm"),
}
_STATES = {
    "measured": "measured",
    "prior": "hardly told, as usual",
    "dropped": "improves nothing, 0",
    "given": "not asked for",
}


# ---- Camera --------------------------------------------------------------------------------------


def camera_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a camera calibration."""
    facts, charts = _camera_facts(found), list(_camera_charts(found))
    camera = Section("camera", "Camera", sentence(found["verdict"]), facts, charts)
    notes = notes_section("notes", "Notes", found["notes"])
    sections = [camera, *notes, configuration(toml, _PASTED)]
    return render_document(title, "Camera calibration by photon transfer", sections)


def _camera_facts(found: Mapping[str, Any]) -> list[Fact]:
    facts = []
    for key, label, unit in (
        ("gain_e_per_adu", "Gain", "e per count"),
        ("offset_adu", "Offset", "counts"),
        ("read_noise_e", "Read noise", "e"),
    ):
        estimate, below = found[key], found.get(key.replace("noise", "noise_below"))
        if estimate is None and below is None:
            facts.append(Fact(label, "—", note="not identifiable"))
            continue
        if estimate is None:
            facts.append(Fact(label, f"< {number(below)}", unit, "95 %"))
            continue
        low, high = estimate["ci95"]
        value, ends = with_interval(estimate["value"], low, high)
        source = _SOURCES[found["offset_from"]] if key == "offset_adu" else ""
        note = "; ".join(filter(None, (f"95 %: {ends}" if low < high else "", source)))
        facts.append(Fact(label, value, unit, note))
    masked = found["masked_pixels"]
    reasons = ", ".join(f"{n} {reason}" for reason, n in masked.items())
    return [*facts, Fact("Pixels left out", str(sum(masked.values())), note=reasons)]


def _camera_charts(found: Mapping[str, Any]) -> Iterator[Chart]:
    curve, noise = found["photon_transfer"], found["noise"]
    if curve.get("mean_adu"):
        at, variance = curve["mean_adu"], curve["variance_adu2"]
        ends = around(variance, 1.96 * np.asarray(curve["variance_se"], float))
        points = marks("point", "pixels, 95 %", at, variance, ends)
        yield curves("transfer", [points, marks("line", "fit", at, curve["fit_adu2"])])
    if noise.get("n_frames"):
        at, shot = noise["n_frames"], noise["shot_noise"]
        points = marks("point", "measured", at, noise["contrast_noise"])
        yield curves("averaging", [points, marks("line", "shot noise", at, shot)])


# ---- Standards -----------------------------------------------------------------------------------


def mass_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a mass calibration."""
    standards = found["standards"]
    lead = (
        f"{len(standards)} standards among {found['events']} landing events, which are "
        f"{found['landing']}. A particle that leaves has the opposite contrast and weighs the same."
    )
    gradient, offset = number(found["gradient_per_kda"]), number(found["offset"])
    largest = max(abs(s["residual_percent"]) for s in standards)
    freedom = f"{count(found['dof'], 'degree')} of freedom"
    facts = [
        Fact("Gradient", gradient, "per kDa", f"± {number(found['gradient_se'], 2)}"),
        Fact("Offset", offset, note=f"± {number(found['offset_se'], 2)}"),
        Fact("χ² of the line", number(found["chi2"]), note=freedom),
        Fact("Largest residual", number(largest, 2), "%"),
    ]
    charts, tables = list(_mass_charts(found)), [_standards_table(standards)]
    line = Section("line", "Contrast against mass", lead, facts, charts, tables)
    notes = notes_section("notes", "Notes", found["notes"])
    sections = [line, *notes, configuration(toml, _PASTED)]
    return render_document(title, "Mass calibration from standards", sections)


def _mass_charts(found: Mapping[str, Any]) -> Iterator[Chart]:
    standards, histogram = found["standards"], found["histogram"]
    sign = -1.0 if found["landing"] == "dark" else 1.0
    masses, contrasts, errors = (
        np.array([s[name] for s in standards]) for name in ("mass_kda", "contrast", "contrast_se")
    )
    contrasts = np.abs(contrasts)
    grid = np.linspace(0, 1.1 * masses.max(), 61)
    (vs, cov), (_, vo) = found["covariance"]
    line = sign * (found["gradient_per_kda"] * grid + found["offset"])
    band = 1.96 * np.sqrt(np.maximum(grid**2 * vs + 2 * grid * cov + vo, 0.0))
    known = around(contrasts, 1.96 * errors)
    points = marks("point", "standards, 95 %", masses, contrasts, known)
    reach = marks("band", "line, 95 %", grid, ends=around(line, band))
    yield curves("standards", [points, reach, marks("line", "line, 95 %", grid, line)])
    bars = marks("bar", "events", histogram["edges"], histogram["counts"])
    yield curves("peaks", [bars, marks("rule", "standards", contrasts)])


def _standards_table(standards: list[Mapping[str, Any]]) -> Table:
    """Set every standard beside the line; contrasts in thousandths, so that they line up."""
    errors = decimals_for(s["contrast_se"] for s in standards) - 3
    known = decimals_for([s["mass_se"] for s in standards])

    def thousandths(value: float) -> str:
        return fixed(1e3 * value, max(errors, 0))

    columns = (
        numeric("mass [kDa]", of("mass_kda", fixed, known)),
        numeric("its error [kDa]", of("mass_se", fixed, known)),
        numeric("contrast [10⁻³]", of("contrast", thousandths)),
        numeric("its error", of("contrast_se", thousandths)),
        numeric("width", of("width", thousandths)),
        numeric("events", of("count", fixed, 0)),
        *intervals("by the line [kDa]", "found_kda", ("low_kda", "high_kda")),
        numeric("residual [%]", of("residual_percent", fixed, 2)),
    )
    caption = "Standards, and what the line makes of their peaks, with 95 % prediction intervals"
    return tabulate(standards, columns, caption)


# ---- Optics --------------------------------------------------------------------------------------


def optics_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a calibration of the optics."""
    judged, settings = found["held_out"], found["settings"]
    chi2, before = (
        number(float(np.mean(found[name]["chi2_reduced"])), 4)
        for name in ("held_out", "held_out_as_configured")
    )
    number_of = f"{len(judged['p_values'])} pictures that were not fitted"
    analyser = "with analyser" if settings["analyzer"] else "no analyser"
    facts = [
        Fact("Particles", str(found["particles"])),
        Fact("Reduced χ²", chi2, note=f"{before} as configured"),
        Fact("p-values uniform", f"p = {number(judged['uniform_p'], 2)}", note=number_of),
        Fact("Polarisation", settings["polarization"], note=analyser),
    ]
    verdict = _verdict(found, "The measured optics describe pictures that were not fitted.")
    tables = [_parameters(found["parameters"])]
    unknown = found["notes"] or ["Everything that was asked for was determined"]
    sections = [
        Section("verdict", "The microscope", verdict, facts, tables=tables),
        Section("pictures", "Pictures", charts=list(_optics_charts(found))),
        *notes_section("unknown", "What could not be known", unknown),
        configuration(toml, OPTICS_FILE),
    ]
    return render_document(title, "Optics, learned from the movie", sections)


def _verdict(found: Mapping[str, Any], accepted: str) -> str:
    return accepted if found["accepted"] else f"Refused: {'; '.join(found['refusals'])}."


def _optics_charts(found: Mapping[str, Any]) -> Iterator[Chart]:
    shown = found["pictures"]
    measured, model, residual, wavefront, passed = (
        np.asarray(shown[key], dtype=float)
        for key in ("measured", "model", "residual", "wavefront_nm", "transmission")
    )
    top, far = float(np.abs(measured).max()), max(3.0, float(np.abs(residual).max()))
    half = measured.shape[0] * shown["pixel_nm"] / 2000
    images = [
        (with_ends("measured", -top, top), measured, (-top, top)),
        ("model", model, (-top, top)),
        (with_ends("residual [σ]", -far, far), residual, (-far, far)),
    ]
    yield pictures("average", images, half)
    radius, ends = shown["radius_nm"], around(shown["radial"], 1.96 * np.array(shown["radial_se"]))
    points = marks("point", "measured, 95 %", radius, shown["radial"], ends)
    yield curves("radial", [points, marks("line", "model", radius, shown["radial_model"])])
    yield _p_values("p-values", found["held_out"]["p_values"])
    far = max(1.0, float(np.nanmax(np.abs(wavefront))))
    images = [
        (with_ends("wavefront [nm]", -far, far), wavefront, (-far, far)),
        (with_ends("amplitude", 0.0, 1.0), passed, (0.0, 1.0)),
    ]
    yield pictures("pupil", images, shown["na"])
    names = [_LABELS.get(name, (name, ""))[0].split(",")[0] for name in found["names"]]
    known = np.asarray(found["correlation"], dtype=float).reshape(len(names), len(names))
    cells = [
        {"panel": "", "row": one, "column": other, "value": value, "text": ""}
        for one, line in zip(names, known.tolist(), strict=True)
        for other, value in zip(names, line, strict=True)
    ]
    if cells:
        yield heatmap("correlation", cells)


def _p_values(name: str, values: list[float]) -> Chart:
    counts, edges = np.histogram(values, bins=10, range=(0.0, 1.0))
    return curves(name, [marks("bar", "pictures", edges, counts)])


def _parameters(parameters: list[Mapping[str, Any]]) -> Table:
    columns = (
        worded("parameter", of("parameter", lambda name: _LABELS.get(name, (name, ""))[0])),
        numeric("value", of("value", number, 6)),
        numeric("standard error", of("sigma")),
        numeric("CRB", of("crb")),
        numeric("as configured", of("configured", number, 6)),
        worded("unit", of("parameter", lambda name: _LABELS.get(name, ("", ""))[1])),
        worded("state", of("state", _STATES.get)),
    )
    return tabulate(parameters, columns, "Parameters of the optics")


# ---- The measured picture ------------------------------------------------------------------------


def template_page(title: str, found: Mapping[str, Any], template: Template, toml: str) -> str:
    """Make the page of a measured picture."""
    judged = found["held_out"]
    chi2 = number(float(np.mean(judged["chi2_reduced"])), 4)
    number_of = f"of {len(judged['p_values'])} pictures that were held out"
    facts = [
        Fact("Particles", str(found["particles"]), note=f"{found['contaminated']} more left out"),
        Fact("Numbers determined", number(found["determined"])),
        Fact("Error of the peak", percent(found["peak_se"]), note="common to all contrasts"),
        Fact("Reduced χ²", chi2, note=number_of),
    ]
    meaning = [
        "Mode mass alone: a picture at one height does not say how it changes with height.",
        "There is no quantum bound: a picture does not say what light made it. The Cramér–Rao "
        "bound is that of the template.",
        "Places are relative to the template's centre of energy, and masses need [calibration] "
        "with standards that were fitted with the same template.",
    ]
    verdict = _verdict(found, "The template describes pictures that were held out.")
    sections = [
        Section("verdict", "The picture", verdict, facts),
        Section("pictures", "Pictures", charts=list(_template_charts(found, template))),
        Section("meaning", "What it is for", notes=meaning),
        configuration(toml, OPTICS_FILE),
    ]
    return render_document(title, "Picture of a particle, measured", sections)


def _template_charts(found: Mapping[str, Any], template: Template) -> Iterator[Chart]:
    top = float(template.sigma.max())
    images = [
        (with_ends("contrast", -1.0, 1.0), template.contrast, (-1.0, 1.0)),
        (with_ends("standard deviation", 0.0, top), template.sigma, (0.0, top)),
    ]
    yield pictures("template", images, template.contrast.shape[0] * template.step_nm / 2000)
    yield _p_values("held-out", found["held_out"]["p_values"])
