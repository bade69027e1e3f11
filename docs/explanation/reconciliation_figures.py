"""Draw the two figures of reconciliation.md; run it after a change of the model.

python docs/explanation/reconciliation_figures.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.bounds import quantum_bounds, quantum_information
from iscat_analysis.bounds.paper import paper_config, photons_of_authors, point
from iscat_analysis.optics.forward import forward_model

FIGURES = Path(__file__).resolve().parent / "figures"
INK, BLUE, ORANGE, GREY = "#1B1D21", "#0072B2", "#D55E00", "#8A8F96"
STYLE = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none",
    "svg.hashsalt": "iscat-analysis", "legend.frameon": False,
}  # fmt: skip


def cobri() -> Figure:
    """COBRI's classical bound on z below the printed quantum bound."""
    heights = np.arange(0.0, 1501.0, 15.0)
    held = [point(paper_config("cobri", z_nm=z, focus_nm=1000.0), None)["z"] for z in heights]
    photons = photons_of_authors("cobri")
    moved = [
        point(paper_config("cobri", "dong2021", z_nm=z, focus_nm=1000.0), photons)["z"]
        for z in heights
    ]
    figure = Figure(figsize=(6.4, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.fill_between([0, 1500], 92.027, 114.094, color=ORANGE, alpha=0.12, lw=0)
    axes.plot(heights, held, color=INK, lw=1.8, label="CRB, stage held")
    axes.plot(heights, moved, color=GREY, lw=1.2, dashes=(4, 2), label="CRB, refocusing (D21)")
    axes.axhline(114.094, color=ORANGE, lw=1.5, label="printed as quantum bound: 114 nm")
    axes.axhline(92.027, color=BLUE, lw=1.5, label="quantum bound: 92.0 nm")
    axes.set(xlim=(0, 1500), ylim=(80, 220), xlabel="height z [nm], focus at 1000 nm",
             ylabel="σ of z in COBRI, one photon [nm]")  # fmt: skip
    figure.legend(loc="outside upper left", fontsize=8, ncols=2)
    return figure


def camera_plane() -> Figure:
    """Quantum information of the camera plane over a growing field."""
    pitch, half, step = 90.0, 12_000.0, 1.0  # pitch < λ/(4 NA): the sums are exact integrals
    axis = np.arange(pitch / 2, half, pitch)
    x, y = np.meshgrid(axis, axis)
    ring = np.maximum(x, y)
    order = np.argsort(ring, axis=None)
    last = np.searchsorted(ring.ravel()[order], axis, side="right") - 1
    figure = Figure(figsize=(6.4, 3.5), layout="constrained")
    axes = figure.subplots()
    lines = (("iscat", 0, "x", INK), ("iscat", 1, "y", ORANGE), ("iscat", 2, "z, iSCAT", BLUE),
             ("cobri", 2, "z, COBRI", "#009E73"))  # fmt: skip
    for scheme, index, name, color in lines:
        z_nm = 5.0
        model = forward_model(paper_config(scheme, z_nm=z_nm), 1.5 * half)
        mass = model.material.mass_kda

        def field(dx: float, dy: float, dz: float) -> np.ndarray:
            return model.field(x - dx, y - dy, z_nm + dz, mass)  # noqa: B023  # used at once

        shift = step * np.eye(3)[index]
        slope = (field(*shift) - field(*-shift)) / (2 * step)
        light = (np.abs(field(0, 0, 0)) ** 2).sum(0).ravel()[order].cumsum()[last]
        told = (np.abs(slope) ** 2).sum(0).ravel()[order].cumsum()[last]
        exact, paper = (
            quantum_bounds(quantum_information(model, z_nm, measure=m))[0][index]
            for m in ("exact", "dong2021")
        )
        axes.plot(
            axis / 500, 1 / np.sqrt(4 * told / light) / exact, color=color, lw=1.6, label=name
        )
        axes.plot([24, 25], [paper / exact] * 2, color=color, lw=3, solid_capstyle="butt",
                  clip_on=False)  # fmt: skip
    axes.axhline(1, color=GREY, lw=1)
    axes.text(24.5, 1.258, "D21", ha="center", color=GREY, fontsize=8)
    axes.set(xlim=(0, 25), ylim=(0.9, 1.28), xlabel="side of the field [µm]",
             ylabel="bound from the camera-plane field\nover the exact quantum bound")  # fmt: skip
    figure.legend(loc="outside upper left", fontsize=8, ncols=4)
    return figure


def main() -> None:
    """Write both as SVG."""
    FIGURES.mkdir(exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, figure in (("cobri_bound", cobri()), ("camera_plane", camera_plane())):
            figure.savefig(FIGURES / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
