"""Pages of `iscat calibrate`: photon transfer and noise curves, standards and their line.

Everything arrives as what the JSON files hold; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from iscat_analysis.report.numbers import decimals_for, fixed, number
from iscat_analysis.report.page import render_page

_SOURCES = {
    "dark": "from the dark",
    "given": "as given",
    "flicker": "from the laser's flicker",
    "line": "o − σ_r²/g: where the variance would vanish",
}


def camera_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a camera calibration.

    Parameters
    ----------
    title : str
        The recordings.
    found : mapping
        What ``camera.json`` holds.
    toml : str
        The section to paste.

    Returns
    -------
    str
        HTML.
    """
    charts = []
    if found["photon_transfer"].get("mean_adu"):
        charts.append(_transfer_chart(found["photon_transfer"]))
    if found["noise"].get("n_frames"):
        charts.append(_noise_chart(found["noise"]))
    sections: list[dict[str, Any]] = [
        {
            "id": "camera",
            "title": "Camera",
            "lead": _sentence(found["verdict"]),
            "facts": _camera_facts(found),
            "charts": charts,
        }
    ]
    if found["notes"]:
        sections.append(
            {"id": "notes", "title": "Notes", "notes": [_sentence(n) for n in found["notes"]]}
        )
    sections.append(_paste(toml))
    return render_page(
        "document.html",
        {"title": title, "subtitle": "Camera calibration by photon transfer", "sections": sections},
    )


def mass_page(title: str, found: Mapping[str, Any], toml: str) -> str:
    """Make the page of a mass calibration.

    Parameters
    ----------
    title : str
        The events.
    found : mapping
        What ``calibration.json`` holds.
    toml : str
        The section to paste.

    Returns
    -------
    str
        HTML.
    """
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
                    "note": f"{found['dof']} degree{'' if found['dof'] == 1 else 's'} of freedom",
                },
                {
                    "label": "Largest residual",
                    "value": number(max(abs(s["residual_percent"]) for s in standards), 2),
                    "unit": "%",
                },
            ],
            "charts": [_line_chart(found), _peaks_chart(found)],
            "tables": [_standards_table(standards)],
        }
    ]
    if found["notes"]:
        sections.append(
            {"id": "notes", "title": "Notes", "notes": [_sentence(n) for n in found["notes"]]}
        )
    sections.append(_paste(toml))
    return render_page(
        "document.html",
        {"title": title, "subtitle": "Mass calibration from standards", "sections": sections},
    )


def _paste(toml: str) -> dict[str, Any]:
    return {
        "id": "configuration",
        "title": "Configuration",
        "lead": "To paste into the configuration of the measurement.",
        "code": toml,
    }


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
        note = f"95 %: {fixed(low, decimals)} to {fixed(high, decimals)}"
        if key == "offset_adu":
            source = _SOURCES[found["offset_from"]]
            note = source if low == high else f"{note}; {source}"
        value = fixed(estimate["value"], decimals)
        facts.append({"label": label, "value": value, "unit": unit, "note": note})
    masked = found["masked_pixels"]
    facts.append(
        {
            "label": "Pixels left out",
            "value": str(sum(masked.values())),
            "unit": "",
            "note": ", ".join(f"{count} {name}" for name, count in masked.items()),
        }
    )
    return facts


def _transfer_chart(curve: Mapping[str, Any]) -> dict[str, Any]:
    reach = [1.96 * se for se in curve["variance_se"]]
    return {
        "id": "transfer",
        "title": "Photon transfer",
        "caption": "Variance of a pixel against its mean, in bins of pixels; the slope is one over "
        "the gain.",
        "spec": {
            "height": 320,
            "x": {"label": "mean [counts]"},
            "y": {"label": "variance [counts²]"},
            "series": [
                {"kind": "line", "name": "fit", "color": "crb",
                 "x": curve["mean_adu"], "y": curve["fit_adu2"]},
                {"kind": "interval", "name": "pixels, 95 %", "color": "sigma", "along": "y",
                 "at": curve["mean_adu"], "mid": curve["variance_adu2"],
                 "lo": [v - r for v, r in zip(curve["variance_adu2"], reach, strict=True)],
                 "hi": [v + r for v, r in zip(curve["variance_adu2"], reach, strict=True)]},
            ],
        },
    }  # fmt: skip


def _noise_chart(noise: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": "averaging",
        "title": "Noise against averaging",
        "caption": "Contrast noise between two successive averages of n frames. Shot noise falls "
        "as one over the root of n; drift and particles do not.",
        "spec": {
            "height": 320,
            "x": {"label": "frames averaged", "scale": "log"},
            "y": {"label": "contrast noise", "scale": "log"},
            "series": [
                {"kind": "line", "name": "shot noise", "color": "crb",
                 "x": noise["n_frames"], "y": noise["shot_noise"]},
                {"kind": "points", "name": "measured", "color": "sigma",
                 "x": noise["n_frames"], "y": noise["contrast_noise"]},
            ],
        },
    }  # fmt: skip


def _line_chart(found: Mapping[str, Any]) -> dict[str, Any]:
    standards = found["standards"]
    masses = [s["mass_kda"] for s in standards]
    top = 1.1 * max(masses)
    sign = -1.0 if found["landing"] == "dark" else 1.0
    grid = [top * k / 60 for k in range(61)]
    (vs, cov), (_, vo) = found["covariance"]
    line = [found["gradient_per_kda"] * m + found["offset"] for m in grid]
    reach = [1.96 * max(m * m * vs + 2 * m * cov + vo, 0.0) ** 0.5 for m in grid]
    edge = {"kind": "line", "color": "crb", "dash": True}
    return {
        "id": "standards",
        "title": "The line through the standards",
        "caption": "Contrast of landing, with its sign taken off; dashed: 95 % of the line.",
        "spec": {
            "height": 320,
            "x": {"label": "mass [kDa]", "zero": True},
            "y": {"label": "|contrast|", "zero": True},
            "series": [
                {"kind": "line", "name": "line", "color": "crb", "x": grid,
                 "y": [sign * c for c in line]},
                {**edge, "x": grid, "y": [sign * c - r for c, r in zip(line, reach, strict=True)]},
                {**edge, "x": grid, "y": [sign * c + r for c, r in zip(line, reach, strict=True)]},
                {"kind": "interval", "name": "standards, 95 %", "color": "sigma", "along": "y",
                 "at": masses, "mid": [abs(s["contrast"]) for s in standards],
                 "lo": [abs(s["contrast"]) - 1.96 * s["contrast_se"] for s in standards],
                 "hi": [abs(s["contrast"]) + 1.96 * s["contrast_se"] for s in standards]},
            ],
        },
    }  # fmt: skip


def _peaks_chart(found: Mapping[str, Any]) -> dict[str, Any]:
    histogram = found["histogram"]
    return {
        "id": "peaks",
        "title": "The peaks",
        "caption": "|Contrast| of the landing events, and the peaks fitted to the events "
        "themselves.",
        "spec": {
            "height": 320,
            "x": {"label": "|contrast|"},
            "y": {"label": "events", "zero": True, "whole": True},
            "series": [
                {"kind": "bars", "name": "events", "color": "plain",
                 "edges": histogram["edges"], "counts": histogram["counts"]},
                *({"kind": "rule", "name": "standards" if not k else None, "color": "sigma",
                   "axis": "x", "value": abs(s["contrast"])}
                  for k, s in enumerate(found["standards"])),
            ],
        },
    }  # fmt: skip


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
            [{"text": fixed(scale * s[key], d), "sort": s[key]} for key, _, scale, d in columns]
            + [f"{fixed(s['low_kda'], reach)} to {fixed(s['high_kda'], reach)}"]
            for s in standards
        ],
    }
