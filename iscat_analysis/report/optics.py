"""Page of `iscat calibrate optics`: the pictures, the pupil, and what could not be known.

Everything arrives as what ``optics.json`` holds; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from iscat_analysis.report.numbers import number
from iscat_analysis.report.page import OPTICS_FILE, render_document
from iscat_analysis.report.style import BLUE, VERMILLION, new_figure, publish

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


def optics_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a calibration of the optics."""
    drawn = publish(_figures(found))
    judged, before = found["held_out"], found["held_out_as_configured"]
    verdict = (
        "The measured optics describe pictures that were not fitted."
        if found["accepted"]
        else f"Refused: {'; '.join(found['refusals'])}."
    )
    sections: list[dict[str, Any]] = [
        {
            "id": "verdict",
            "title": "The microscope",
            "lead": verdict,
            "facts": [
                {"label": "Particles", "value": str(found["particles"])},
                {
                    "label": "Reduced χ²",
                    "value": number(float(np.mean(judged["chi2_reduced"])), 4),
                    "note": f"{number(float(np.mean(before['chi2_reduced'])), 4)} as configured",
                },
                {
                    "label": "p-values uniform",
                    "value": f"p = {number(judged['uniform_p'], 2)}",
                    "note": f"{len(judged['p_values'])} pictures that were not fitted",
                },
                {
                    "label": "Polarisation",
                    "value": found["settings"]["polarization"],
                    "note": "with analyser" if found["settings"]["analyzer"] else "no analyser",
                },
            ],
            "tables": [_table(found["parameters"])],
        },
        {
            "id": "pictures",
            "title": "Pictures",
            "charts": [
                {
                    "id": "average",
                    "title": "Average particle",
                    "caption": "Measured, by the microscope that was found, and their difference "
                    "in standard deviations of the average.",
                    "svg": drawn["average"],
                    "wide": True,
                },
                {
                    "id": "radial",
                    "title": "Radial profile",
                    "caption": "Average contrast on rings around the particle, with 95 % "
                    "intervals, and the microscope that was found.",
                    "svg": drawn["radial"],
                },
                {
                    "id": "pupil",
                    "title": "Pupil",
                    "caption": "Aberrations without the focus, and the amplitude that the mask "
                    "passes.",
                    "svg": drawn["pupil"],
                },
                {
                    "id": "p-values",
                    "title": "Pictures that were not fitted",
                    "caption": "Their p-values; uniform where the microscope describes them.",
                    "svg": drawn["p-values"],
                },
                {
                    "id": "correlation",
                    "title": "Correlation of the errors",
                    "caption": "1 and −1: only a combination of the two is known.",
                    "svg": drawn["correlation"],
                },
            ],
        },
    ]
    unknown = [f"{text[:1].upper()}{text[1:].rstrip('.')}." for text in found["notes"]]
    sections.append(
        {
            "id": "unknown",
            "title": "What could not be known",
            "notes": unknown or ["Everything that was asked for was determined."],
        }
    )
    return render_document(title, "Optics, learned from the movie", sections, toml, OPTICS_FILE)


def _figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw what the page shows."""
    pictures = found["pictures"]
    yield "average", _average(pictures)
    yield "radial", _radial(pictures)
    yield "pupil", _pupil(pictures)
    yield "p-values", draw_p_values(found["held_out"]["p_values"])
    yield "correlation", _correlation(found["names"], found["correlation"])


def _average(pictures: Mapping[str, Any]) -> Figure:
    measured, model, residual = (
        np.asarray(pictures[key], dtype=float) for key in ("measured", "model", "residual")
    )
    half = measured.shape[0] * pictures["pixel_nm"] / 2000
    top = float(np.abs(measured).max())
    figure = new_figure(9.0, 2.9)
    axes = figure.subplots(1, 3)
    for ax, image, title, limit in zip(
        axes, (measured, model, residual), ("measured", "model", "residual [σ]"),
        (top, top, max(3.0, float(np.abs(residual).max()))), strict=True,
    ):  # fmt: skip
        shown = ax.imshow(
            image, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=(-half, half, half, -half)
        )
        ax.set_title(title)
        ax.set_xlabel("x [µm]")
        figure.colorbar(shown, ax=ax, shrink=0.8)
    axes[0].set_ylabel("y [µm]")
    return figure


def _radial(pictures: Mapping[str, Any]) -> Figure:
    figure = new_figure(4.6, 3.0)
    ax = figure.subplots()
    radius, mean, se = (np.array(pictures[k]) for k in ("radius_nm", "radial", "radial_se"))
    ax.plot(radius, pictures["radial_model"], color=BLUE, label="model")
    ax.errorbar(radius, mean, 1.96 * se, fmt=".", color=VERMILLION, label="measured, 95 %")
    ax.set_xlabel("distance [nm]")
    ax.set_ylabel("contrast")
    ax.legend()
    return figure


def _pupil(pictures: Mapping[str, Any]) -> Figure:
    wavefront, passed = (
        np.asarray(pictures[key], dtype=float) for key in ("wavefront_nm", "transmission")
    )
    na = pictures["na"]
    limit = max(1.0, float(np.nanmax(np.abs(wavefront))))
    figure = new_figure(6.2, 2.9)
    axes = figure.subplots(1, 2)
    for ax, image, title, scale in (
        (axes[0], wavefront, "wavefront [nm]", ("RdBu_r", -limit, limit)),
        (axes[1], passed, "amplitude passed", ("cividis", 0.0, 1.0)),
    ):
        shown = ax.imshow(
            image, cmap=scale[0], vmin=scale[1], vmax=scale[2], extent=(-na, na, na, -na)
        )
        ax.set_title(title)
        ax.set_xlabel("NA along x")
        figure.colorbar(shown, ax=ax, shrink=0.8)
    axes[0].set_ylabel("NA along y")
    return figure


def draw_p_values(p_values: list[float]) -> Figure:
    """Draw the histogram of p-values."""
    figure = new_figure(4.6, 3.0)
    ax = figure.subplots()
    ax.hist(p_values, bins=10, range=(0.0, 1.0), color=VERMILLION)
    ax.set_xlabel("p-value")
    ax.set_ylabel("pictures")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _correlation(names: list[str], correlation: list[list[float]]) -> Figure:
    figure = new_figure(4.6, 3.8)
    ax = figure.subplots()
    matrix = np.asarray(correlation, dtype=float).reshape(len(names), len(names))
    shown = ax.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    labels = [_LABELS.get(name, (name, ""))[0].split(",")[0] for name in names]
    ax.set_xticks(range(len(names)), labels, rotation=60, ha="right")
    ax.set_yticks(range(len(names)), labels)
    figure.colorbar(shown, ax=ax, shrink=0.8)
    return figure


def _table(parameters: list[Mapping[str, Any]]) -> dict[str, Any]:
    columns = ("parameter", "value", "standard error", "CRB", "as configured", "unit", "state")
    rows = []
    for row in parameters:
        label, unit = _LABELS.get(row["parameter"], (row["parameter"], ""))
        sigma, crb = (number(row[k], 3) if row[k] is not None else "—" for k in ("sigma", "crb"))
        rows.append(
            [label, number(row["value"], 6), sigma, crb, number(row["configured"], 6), unit,
             _STATES[row["state"]]]
        )  # fmt: skip
    return {
        "caption": "Parameters of the optics",
        "columns": [
            {"label": c, "numeric": c not in ("parameter", "unit", "state")} for c in columns
        ],
        "rows": rows,
    }
