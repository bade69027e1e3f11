"""Pages of `iscat calibrate`: photon transfer and noise curves, standards and their line.

Everything arrives as what the JSON files hold; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from iscat_analysis.records import FloatArray
from iscat_analysis.report.numbers import decimals_for, fixed, number
from iscat_analysis.report.page import render_document
from iscat_analysis.report.style import GREY, INK, VERMILLION, new_figure, publish
from iscat_analysis.units import count

_SOURCES = {
    "dark": "from the dark",
    "given": "as given",
    "flicker": "from the laser's flicker",
    "line": "o − σ_r²/g: where the variance would vanish",
}


def camera_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a camera calibration."""
    sections: list[dict[str, Any]] = [
        {
            "id": "camera",
            "title": "Camera",
            "lead": _sentence(found["verdict"]),
            "facts": _camera_facts(found),
            "charts": _charts(_camera_figures(found)),
        }
    ]
    return _page(title, "Camera calibration by photon transfer", sections, found["notes"], toml)


def mass_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a mass calibration."""
    standards = found["standards"]
    sections: list[dict[str, Any]] = [
        {
            "id": "line",
            "title": "Contrast against mass",
            "lead": (
                f"{len(standards)} standards among {found['events']} landing events, which are "
                f"{found['landing']}. A particle that leaves has the opposite contrast and weighs "
                "the same."
            ),
            "facts": [
                {
                    "label": "Gradient",
                    "value": number(found["gradient_per_kda"], 3),
                    "unit": "per kDa",
                    "note": f"± {number(found['gradient_se'], 2)}",
                },
                {
                    "label": "Offset",
                    "value": number(found["offset"], 3),
                    "note": f"± {number(found['offset_se'], 2)}",
                },
                {
                    "label": "χ² of the line",
                    "value": number(found["chi2"], 3),
                    "note": f"{count(found['dof'], 'degree')} of freedom",
                },
                {
                    "label": "Largest residual",
                    "value": number(max(abs(s["residual_percent"]) for s in standards), 2),
                    "unit": "%",
                },
            ],
            "charts": _charts(_mass_figures(found)),
            "tables": [_standards_table(standards)],
        }
    ]
    return _page(title, "Mass calibration from standards", sections, found["notes"], toml)


def _page(
    title: str, subtitle: str, sections: list[dict[str, Any]], notes: Sequence[str], toml: str
) -> str:
    """Make a page of sections, then notes, then what is pasted into the configuration."""
    if notes:
        said = [_sentence(note) for note in notes]
        sections = [*sections, {"id": "notes", "title": "Notes", "notes": said}]
    lead = "To paste into the configuration of the measurement."
    return render_document(title, subtitle, sections, toml, lead)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _camera_facts(found: Mapping[str, Any]) -> list[dict[str, str]]:
    facts = []
    for key, label, unit in (
        ("gain_e_per_adu", "Gain", "e per count"),
        ("offset_adu", "Offset", "counts"),
        ("read_noise_e", "Read noise", "e"),
    ):
        estimate = found[key]
        if estimate is None:
            below = found["read_noise_below_e"]
            if key == "read_noise_e" and below is not None:
                facts.append(
                    {"label": label, "value": f"< {number(below)}", "unit": unit, "note": "95 %"}
                )
            else:
                facts.append({"label": label, "value": "—", "unit": "", "note": "not identifiable"})
            continue
        low, high = estimate["ci95"]
        decimals = decimals_for([(high - low) / 2])
        note = f"95 %: {fixed(low, decimals)} to {fixed(high, decimals)}" if low < high else ""
        if key == "offset_adu":
            note = "; ".join(filter(None, (note, _SOURCES[found["offset_from"]])))
        value = fixed(estimate["value"], decimals)
        facts.append({"label": label, "value": value, "unit": unit, "note": note})
    masked = found["masked_pixels"]
    facts.append(
        {
            "label": "Pixels left out",
            "value": str(sum(masked.values())),
            "unit": "",
            "note": ", ".join(f"{n} {reason}" for reason, n in masked.items()),
        }
    )
    return facts


def _camera_figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    curve, noise = found["photon_transfer"], found["noise"]
    if curve.get("mean_adu"):
        figure = new_figure(6.2, 3.4)
        axes = figure.add_subplot()
        axes.plot(curve["mean_adu"], _floats(curve["fit_adu2"]), color=INK, label="fit")
        axes.errorbar(
            curve["mean_adu"], curve["variance_adu2"], 1.96 * _floats(curve["variance_se"]),
            fmt="o", color=VERMILLION, ms=3, lw=1, label="pixels, 95 %",
        )  # fmt: skip
        axes.set(xlabel="mean [counts]", ylabel="variance [counts²]")
        axes.legend()
        yield "transfer", figure
    if noise.get("n_frames"):
        figure = new_figure(6.2, 3.4)
        axes = figure.add_subplot()
        axes.plot(noise["n_frames"], _floats(noise["shot_noise"]), color=INK, label="shot noise")
        axes.plot(noise["n_frames"], noise["contrast_noise"], "o", color=VERMILLION, ms=4,
                  label="measured")  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="frames averaged", ylabel="contrast noise")
        axes.legend()
        yield "averaging", figure


def _mass_figures(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    standards, histogram = found["standards"], found["histogram"]
    sign = -1.0 if found["landing"] == "dark" else 1.0
    masses = [s["mass_kda"] for s in standards]
    contrasts = [abs(s["contrast"]) for s in standards]
    grid = np.linspace(0, 1.1 * max(masses), 61)
    (vs, cov), (_, vo) = found["covariance"]
    line = sign * (found["gradient_per_kda"] * grid + found["offset"])
    reach = 1.96 * np.sqrt(np.maximum(grid**2 * vs + 2 * grid * cov + vo, 0.0))
    figure = new_figure(6.2, 3.4)
    axes = figure.add_subplot()
    axes.plot(grid, line, color=INK, label="line, 95 %")
    axes.fill_between(grid, line - reach, line + reach, color=GREY, alpha=0.35, lw=0)
    errors = [1.96 * s["contrast_se"] for s in standards]
    axes.errorbar(
        masses, contrasts, errors, fmt="o", color=VERMILLION, ms=4, label="standards, 95 %"
    )
    axes.set(xlabel="mass [kDa]", ylabel="|contrast|")
    axes.legend()
    yield "standards", figure
    figure = new_figure(6.2, 3.4)
    axes = figure.add_subplot()
    axes.stairs(histogram["counts"], histogram["edges"], fill=True, color=GREY, label="events")
    for k, contrast in enumerate(contrasts):
        axes.axvline(contrast, color=VERMILLION, ls="--", label=None if k else "standards")
    axes.set(xlabel="|contrast|", ylabel="events")
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.legend()
    yield "peaks", figure


def _floats(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


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
}


def _charts(figures: Iterator[tuple[str, Figure]]) -> list[dict[str, Any]]:
    return [
        {"id": name, "title": _CAPTIONS[name][0], "caption": _CAPTIONS[name][1], "svg": svg}
        for name, svg in publish(figures).items()
    ]


def _standards_table(standards: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Set every standard beside the line; contrasts in thousandths, so that they line up."""
    errors = decimals_for(1e3 * s["contrast_se"] for s in standards)
    reach = decimals_for((s["high_kda"] - s["low_kda"]) / 2 for s in standards)
    columns = (
        ("mass_kda", "mass [kDa]", 1.0, decimals_for([s["mass_se"] for s in standards])),
        ("mass_se", "its error [kDa]", 1.0, decimals_for([s["mass_se"] for s in standards])),
        ("contrast", "contrast [10⁻³]", 1e3, errors),
        ("contrast_se", "its error", 1e3, errors),
        ("width", "width", 1e3, errors),
        ("count", "events", 1.0, 0),
        ("found_kda", "by the line [kDa]", 1.0, reach),
        ("residual_percent", "residual [%]", 1.0, 2),
    )
    return {
        "caption": "Standards, and what the line makes of their peaks, "
        "with 95 % prediction intervals",
        "columns": [{"label": label, "numeric": True} for _, label, _, _ in columns]
        + [{"label": "95 % [kDa]", "numeric": True}],
        "rows": [
            [fixed(scale * s[key], d) for key, _, scale, d in columns]
            + [f"{fixed(s['low_kda'], reach)} to {fixed(s['high_kda'], reach)}"]
            for s in standards
        ],
    }
