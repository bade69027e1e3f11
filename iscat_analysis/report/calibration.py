"""Pages of `iscat calibrate`: camera, mass standards, optics, and the measured picture.

Everything arrives as what the JSON files hold; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
    configuration,
    notes_section,
    render_document,
)
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    INK,
    VERMILLION,
    Style,
    around,
    floats,
    one_panel,
    picture,
    publish,
    row_of_panels,
    whiskers,
    whole_numbers,
)
from iscat_analysis.units import count

_PASTED = "To paste into the configuration of the measurement."
_SOURCES = {
    "dark": "from the dark",
    "given": "as given",
    "flicker": "from the laser's flicker",
    "line": "o − σ_r²/g: where the variance would vanish",
}
_CAPTIONS = {
    "transfer": (
        "Photon transfer",
        "Variance of a pixel against its mean, in bins of pixels; the slope is one over the gain.",
    ),
    "averaging": (
        "Noise against averaging",
        "Contrast noise between two successive averages of n frames. Shot noise falls as one over "
        "the root of n; drift and particles do not.",
    ),
    "standards": (
        "The line through the standards",
        "Contrast of landing without its sign; the band holds 95 % of the line.",
    ),
    "peaks": (
        "The peaks",
        "|Contrast| of the landing events, and the peaks fitted to the events themselves.",
    ),
    "average": (
        "Average particle",
        "Measured, by the microscope that was found, and their difference in standard deviations "
        "of the average.",
    ),
    "radial": (
        "Radial profile",
        "Average contrast on rings around the particle, with 95 % intervals, and the microscope "
        "that was found.",
    ),
    "pupil": ("Pupil", "Aberrations without the focus, and the amplitude that the mask passes."),
    "p-values": (
        "Pictures that were not fitted",
        "Their p-values; uniform where the microscope describes them.",
    ),
    "correlation": (
        "Correlation of the errors",
        "1 and −1: only a combination of the two is known.",
    ),
    "template": (
        "Template",
        "Contrast of a faint particle, its largest magnitude 1, and its standard deviation.",
    ),
    "held-out": (
        "Pictures that were held out",
        "Their p-values; uniform where the template describes them.",
    ),
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


def _charts(figures: Iterator[tuple[str, Figure]]) -> list[Chart]:
    """Put figures on the page, those wide whose images stand side by side."""
    return [
        Chart(name, _CAPTIONS[name][0], svg, _CAPTIONS[name][1], name in ("average", "template"))
        for name, svg in publish(figures).items()
    ]


# ---- Camera --------------------------------------------------------------------------------------


def camera_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a camera calibration."""
    facts, charts = _camera_facts(found), _charts(_camera_figures(found))
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


def _camera_figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    curve, noise = found["photon_transfer"], found["noise"]
    if curve.get("mean_adu"):
        figure, axes = one_panel(6.2, 3.4)
        axes.plot(curve["mean_adu"], floats(curve["fit_adu2"]), color=INK, label="fit")
        variance, reach = floats(curve["variance_adu2"]), 1.96 * floats(curve["variance_se"])
        style: Style = {"ms": 3, "color": VERMILLION, "label": "pixels, 95 %"}
        whiskers(axes, curve["mean_adu"], variance, around(variance, reach), style=style)
        axes.set(xlabel="mean [counts]", ylabel="variance [counts²]")
        axes.legend()
        yield "transfer", figure
    if noise.get("n_frames"):
        figure, axes = one_panel(6.2, 3.4)
        axes.plot(noise["n_frames"], floats(noise["shot_noise"]), color=INK, label="shot noise")
        dots: Style = {"color": VERMILLION, "ms": 4, "label": "measured"}
        axes.plot(noise["n_frames"], noise["contrast_noise"], "o", **dots)
        axes.set(xscale="log", yscale="log", xlabel="frames averaged", ylabel="contrast noise")
        axes.legend()
        yield "averaging", figure


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
    charts, tables = _charts(_mass_figures(found)), [_standards_table(standards)]
    line = Section("line", "Contrast against mass", lead, facts, charts, tables)
    notes = notes_section("notes", "Notes", found["notes"])
    sections = [line, *notes, configuration(toml, _PASTED)]
    return render_document(title, "Mass calibration from standards", sections)


def _mass_figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    standards, histogram = found["standards"], found["histogram"]
    sign = -1.0 if found["landing"] == "dark" else 1.0
    masses, contrasts, errors = (
        np.array([s[name] for s in standards]) for name in ("mass_kda", "contrast", "contrast_se")
    )
    contrasts, reach = np.abs(contrasts), 1.96 * errors
    grid = np.linspace(0, 1.1 * masses.max(), 61)
    (vs, cov), (_, vo) = found["covariance"]
    line = sign * (found["gradient_per_kda"] * grid + found["offset"])
    band = 1.96 * np.sqrt(np.maximum(grid**2 * vs + 2 * grid * cov + vo, 0.0))
    figure, axes = one_panel(6.2, 3.4)
    axes.plot(grid, line, color=INK, label="line, 95 %")
    axes.fill_between(grid, line - band, line + band, color=GREY, alpha=0.35, lw=0)
    style: Style = {"color": VERMILLION, "label": "standards, 95 %"}
    whiskers(axes, masses, contrasts, around(contrasts, reach), style=style)
    axes.set(xlabel="mass [kDa]", ylabel="|contrast|")
    axes.legend()
    yield "standards", figure
    figure, axes = one_panel(6.2, 3.4)
    axes.stairs(histogram["counts"], histogram["edges"], fill=True, color=GREY, label="events")
    for k, contrast in enumerate(contrasts):
        axes.axvline(contrast, color=VERMILLION, ls="--", label=None if k else "standards")
    whole_numbers(axes, "|contrast|")
    axes.legend()
    yield "peaks", figure


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
        Section("pictures", "Pictures", charts=_charts(_optics_figures(found))),
        *notes_section("unknown", "What could not be known", unknown),
        configuration(toml, OPTICS_FILE),
    ]
    return render_document(title, "Optics, learned from the movie", sections)


def _verdict(found: Mapping[str, Any], accepted: str) -> str:
    return accepted if found["accepted"] else f"Refused: {'; '.join(found['refusals'])}."


def _optics_figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw what the page shows."""
    pictures = found["pictures"]
    measured, model, residual, wavefront, passed = (
        np.asarray(pictures[key], dtype=float)
        for key in ("measured", "model", "residual", "wavefront_nm", "transmission")
    )
    half, top = measured.shape[0] * pictures["pixel_nm"] / 2000, float(np.abs(measured).max())
    figure, panels = row_of_panels(3, 3.0, 2.9)
    picture(panels[0], measured, half, (-top, top), "measured")
    picture(panels[1], model, half, (-top, top), "model")
    far = max(3.0, float(np.abs(residual).max()))
    picture(panels[2], residual, half, (-far, far), "residual [σ]")
    _name_axes(panels, "x [µm]", "y [µm]")
    yield "average", figure
    yield "radial", _radial(pictures)
    figure, panels = row_of_panels(2, 3.1, 2.9)
    far, na = max(1.0, float(np.nanmax(np.abs(wavefront)))), pictures["na"]
    picture(panels[0], wavefront, na, (-far, far), "wavefront [nm]")
    picture(panels[1], passed, na, (0.0, 1.0), "amplitude passed", style={"cmap": "cividis"})
    _name_axes(panels, "NA along x", "NA along y")
    yield "pupil", figure
    yield "p-values", _p_values(found["held_out"]["p_values"])
    yield "correlation", _correlation(found["names"], found["correlation"])


def _name_axes(panels: Sequence[Axes], x: str, y: str) -> None:
    for axes in panels:
        axes.set_xlabel(x)
    panels[0].set_ylabel(y)


def _radial(pictures: Mapping[str, Any]) -> Figure:
    figure, axes = one_panel(4.6, 3.0)
    radius, mean, se = (np.array(pictures[k]) for k in ("radius_nm", "radial", "radial_se"))
    axes.plot(radius, pictures["radial_model"], color=BLUE, label="model")
    style: Style = {"fmt": ".", "color": VERMILLION, "label": "measured, 95 %"}
    whiskers(axes, radius, mean, around(mean, 1.96 * se), style=style)
    axes.set(xlabel="distance [nm]", ylabel="contrast")
    axes.legend()
    return figure


def _p_values(p_values: list[float]) -> Figure:
    figure, axes = one_panel(4.6, 3.0)
    axes.hist(p_values, bins=10, range=(0.0, 1.0), color=VERMILLION)
    whole_numbers(axes, "p-value", "pictures")
    return figure


def _correlation(names: list[str], correlation: list[list[float]]) -> Figure:
    figure, axes = one_panel(4.6, 3.8)
    matrix = np.asarray(correlation, dtype=float).reshape(len(names), len(names))
    shown = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    labels = [_LABELS.get(name, (name, ""))[0].split(",")[0] for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=60, ha="right")
    axes.set_yticks(range(len(names)), labels)
    figure.colorbar(shown, ax=axes, shrink=0.8)
    return figure


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
        Section("pictures", "Pictures", charts=_charts(_template_figures(found, template))),
        Section("meaning", "What it is for", notes=meaning),
        configuration(toml, OPTICS_FILE),
    ]
    return render_document(title, "Picture of a particle, measured", sections)


def _template_figures(found: Mapping[str, Any], template: Template) -> Iterator[tuple[str, Figure]]:
    half = template.contrast.shape[0] * template.step_nm / 2000
    figure, panels = row_of_panels(2, 3.1, 2.9)
    picture(panels[0], template.contrast, half, (-1.0, 1.0), "contrast")
    ends, grown = (0.0, float(template.sigma.max())), {"cmap": "cividis"}
    picture(panels[1], template.sigma, half, ends, "standard deviation", style=grown)
    _name_axes(panels, "x [µm]", "y [µm]")
    yield "template", figure
    yield "held-out", _p_values(found["held_out"]["p_values"])
