"""Dong et al. (2021), printed and exact: what `iscat bounds --preset dong2021` writes.

Everything arrives as tables; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from iscat_analysis.records import FloatArray
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.page import render_page
from iscat_analysis.report.paper_figures import (
    PANELS,
    QUANTITY_LABELS,
    WAYS,
    images_figure,
    panel_figure,
    table_figure,
)
from iscat_analysis.report.style import publish

PAPER_FILES = frozenset(
    {"comparison.html", "comparison.csv"}
    | {f"{stem}.{end}" for stem in [*(f"fig_{p}" for p in PANELS), "fig_2a", "table_1"]
       for end in ("png", "svg", "csv")}
)  # fmt: skip
"""What `write_paper` leaves in its folder."""


def write_paper(
    curves: pd.DataFrame,
    images: Mapping[tuple[str, float], FloatArray],
    table: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
    folder: Path,
    *,
    field_nm: float,
    overwrite: bool = False,
) -> Path:
    """Write every panel of D21, Table 1 and the page that compares them."""
    with atomic_folder(folder, overwrite, known=PAPER_FILES) as building:
        _images_table(images, field_nm).to_csv(
            building / "fig_2a.csv", index=False, float_format="%.5g", lineterminator="\n"
        )
        for panel in PANELS:
            curves[curves["panel"] == panel].to_csv(
                building / f"fig_{panel}.csv", index=False, float_format="%.9g", lineterminator="\n"
            )
        for name in ("table_1.csv", "comparison.csv"):
            table.to_csv(building / name, index=False, float_format="%.9g", lineterminator="\n")
        drawn = publish(_figures(curves, images, table, quantum, field_nm), building)
        page = render_page(
            "document.html",
            {
                "kicker": "iscat bounds",
                "title": "Dong et al. (2021), printed and exact",
                "subtitle": "Fundamental bounds on the precision of iSCAT, COBRI and dark-field "
                "microscopy, J. Phys. D 54, 394002: each number and each curve as its authors "
                "computed it, and as it comes out without the slips.",
                "sections": _sections(table, drawn),
                "nav": [
                    ("table-1", "Table 1"),
                    *((f"figure-{n}", f"Figure {n}") for n in (2, 3, 4)),
                ],
                "footer": "30 nm gold, 517.5 nm, NA 1.3, oil and glass 1.5, water 1.33; "
                "field of 4 × 4 µm.",
            },
        )
        (building / "comparison.html").write_text(page, encoding="utf-8")
    return folder


def _images_table(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> pd.DataFrame:
    parts = []
    for (scheme, z), image in images.items():
        axis = (np.arange(image.shape[0]) - (image.shape[0] - 1) / 2) * field_nm / image.shape[0]
        part = pd.DataFrame(image, columns=[f"x={x:.2f}" for x in axis])
        part.insert(0, "y_nm", axis)
        part.insert(0, "z_nm", z)
        part.insert(0, "scheme", scheme)
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def _figures(
    curves: pd.DataFrame,
    images: Mapping[tuple[str, float], FloatArray],
    table: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
    field_nm: float,
) -> Iterator[tuple[str, Figure]]:
    yield "table_1", table_figure(table)
    yield "fig_2a", images_figure(images, field_nm)
    for panel in PANELS:
        yield f"fig_{panel}", panel_figure(panel, curves[curves["panel"] == panel], quantum)


def _sections(table: pd.DataFrame, drawn: Mapping[str, Markup]) -> list[dict[str, Any]]:
    exact = table.set_index("quantity")["exact"]
    columns = [{"label": "Quantum bound of one photon"}] + [
        {"label": label, "numeric": True} for label in WAYS.values()
    ]
    rows = [
        [QUANTITY_LABELS[row["quantity"]], *(float(row[key]) for key in WAYS)]
        for _, row in table.iterrows()
    ]
    sections: list[dict[str, Any]] = [
        {
            "id": "table-1",
            "title": "Table 1",
            "lead": "Standard deviations for one collected scattered photon. The first two columns "
            "agree to the printed digits; the rest says what the formulas give when they are "
            "integrated exactly, and when the photons are counted as the camera counts them.",
            "facts": [
                {"label": "x", "value": f"{exact['x']:.1f}", "unit": "nm", "note": "printed: 71"},
                {"label": "y", "value": f"{exact['y']:.1f}", "unit": "nm", "note": "printed: 57"},
                {"label": "z, iSCAT", "value": f"{exact['z_iscat']:.1f}", "unit": "nm",
                 "note": "printed: 18"},
                {"label": "z, COBRI", "value": f"{exact['z_cobri']:.1f}", "unit": "nm",
                 "note": "printed: 114"},
            ],
            "charts": [
                {"id": "chart-1", "title": "Five ways to compute Table 1", "svg": drawn["table_1"],
                 "wide": True}
            ],
            "tables": [{"columns": columns, "rows": rows, "caption": "Table 1, five ways"}],
            "notes": list(_NOTES),
        }
    ]  # fmt: skip
    for panel, title in {
        "2a": "Fig. 2a: images",
        **{p: s.title for p, s in PANELS.items()},
    }.items():
        names = {"2a": "figure-2", "3": "figure-3", "4a": "figure-4"}
        title = title.replace("Fig. ", "Figure ")
        sections.append(
            {
                "id": names.get(panel, f"panel-{panel}"),
                "title": title,
                "lead": _LEADS.get(panel),
                "charts": [
                    {"id": f"chart-{panel}", "title": title.partition(": ")[2].capitalize(),
                     "svg": drawn[f"fig_{panel}"], "wide": True}
                ],
            }
        )  # fmt: skip
    return sections


_NOTES = (
    "x and y: the number of photons in dθ dφ is |A|² sinθ; D21 squares the whole integrand of the "
    "field, sinθ √cosθ A, and so weighs the rim of the pupil too much.",
    "z in COBRI: the program drops n_s from the axial phase. The printed 114 nm is no bound: D21's "
    "own imaging model reaches 105 nm on this field, with the stage held.",
    "z in iSCAT: the same weight makes 18.2 nm of 17.8 nm.",
)
_LEADS = {
    "2a": "Detected over incident intensity, focus at 1 µm. D21 does not print its five heights; "
    "these show the rings on both sides of the focus, and a quarter of iSCAT's fringe from 0.95 "
    "to 1 µm. Each row has its own grey scale.",
    "2b": "Particle at height z, focus 1 µm above the coverslip for every z. Left as the authors "
    "computed it, here and below: per scattered photon on the field at z = focus = 0, refocusing "
    "while they differentiate. Exact: the stage held, per collected photon. Solid curves are "
    "exact, dashed ones the authors'; dotted lines are quantum bounds. The lower panel shows how "
    "far the two are apart.",
    "3": "Particle at 5 nm. Mass with everything else known, and for iSCAT with z unknown as well: "
    "in focus the image cannot tell height from mass.",
    "4a": "A weaker reference turns an interferometer into a dark-field microscope. β is the "
    "amplitude of the reference that passes.",
}
