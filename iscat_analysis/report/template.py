"""Page of `iscat calibrate optics --measured`: the picture, its noise, and events that agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.optics.measured import Template
from iscat_analysis.report.numbers import number, percent
from iscat_analysis.report.optics import draw_p_values
from iscat_analysis.report.page import render_page
from iscat_analysis.report.style import new_figure, publish


def template_page(title: str, found: Mapping[str, Any], template: Template, toml: str) -> str:
    """Make the page of a measured picture."""
    drawn, judged = publish(_figures(found, template)), found["held_out"]
    verdict = (
        "The template describes pictures that were held out."
        if found["accepted"]
        else f"Refused: {'; '.join(found['refusals'])}."
    )
    facts = [
        {
            "label": "Particles",
            "value": str(found["particles"]),
            "note": f"{found['contaminated']} more left out",
        },
        {"label": "Numbers determined", "value": number(found["determined"])},
        {
            "label": "Error of the peak",
            "value": percent(found["peak_se"]),
            "note": "common to all contrasts",
        },
        {
            "label": "Reduced χ²",
            "value": number(float(np.mean(judged["chi2_reduced"])), 4),
            "note": f"of {len(judged['p_values'])} pictures that were held out",
        },
    ]
    charts = [
        {
            "id": "template",
            "title": "Template",
            "caption": "Contrast of a faint particle, its largest magnitude 1, and its standard "
            "deviation.",
            "svg": drawn["template"],
            "wide": True,
        },
        {
            "id": "p-values",
            "title": "Pictures that were held out",
            "caption": "Their p-values; uniform where the template describes them.",
            "svg": drawn["p-values"],
        },
    ]
    sections: list[dict[str, Any]] = [
        {"id": "verdict", "title": "The picture", "lead": verdict, "facts": facts},
        {"id": "pictures", "title": "Pictures", "charts": charts},
        {
            "id": "meaning",
            "title": "What it is for",
            "notes": [
                "Mode mass alone: a picture at one height does not say how it changes with height.",
                "There is no quantum bound: a picture does not say what light made it. The "
                "Cramér–Rao bound is that of the template.",
                "Places are relative to the template's centre of energy, and masses need "
                "[calibration] with standards that were fitted with the same template.",
            ],
        },
        {
            "id": "configuration",
            "title": "Configuration",
            "lead": "optics.toml; name it as optics.file in the configuration of the measurement.",
            "code": toml,
        },
    ]
    return render_page(
        "document.html",
        {"title": title, "subtitle": "Picture of a particle, measured", "sections": sections},
    )


def _figures(found: Mapping[str, Any], template: Template) -> Iterator[tuple[str, Figure]]:
    """Draw what the page shows."""
    half = template.contrast.shape[0] * template.step_nm / 2000
    figure = new_figure(6.2, 2.9)
    axes = figure.subplots(1, 2)
    top = float(template.sigma.max())
    for ax, image, text, colours, low, high in (
        (axes[0], template.contrast, "contrast", "RdBu_r", -1.0, 1.0),
        (axes[1], template.sigma, "standard deviation", "cividis", 0.0, top),
    ):
        shown = ax.imshow(
            image, cmap=colours, vmin=low, vmax=high, extent=(-half, half, half, -half)
        )
        ax.set_title(text)
        ax.set_xlabel("x [µm]")
        figure.colorbar(shown, ax=ax, shrink=0.8)
    axes[0].set_ylabel("y [µm]")
    yield "template", figure
    yield "p-values", draw_p_values(found["held_out"]["p_values"])
