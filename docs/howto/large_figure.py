"""Draw the figure of large.md: contrast against diameter, of spheres and of dipoles.

python docs/howto/large_figure.py

Vesicles need scattnlay: pip install "iscat-analysis[shell]".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import iscat_analysis as ia

HERE = Path(__file__).resolve().parent
STYLE = {"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "large"}
FOCI_NM = (-300, 0, 300)
CAMERA = ia.Camera(pixel_size_nm=90)
VESICLE = {"kind": "custom", "density_kg_m3": 1010}
KINDS: tuple[tuple[str, tuple[int, int], dict[str, Any], dict[str, Any]], ...] = (
    ("gold", (10, 150), {"kind": "gold"}, {"kind": "gold"}),
    ("silica", (20, 300), {"kind": "silica"}, {"kind": "silica"}),
    (
        "vesicles, 5 nm shell",
        (60, 200),
        VESICLE | {"index": 1.335, "shell_nm": 5, "shell_index": 1.46},
        VESICLE,
    ),
)
"""What is drawn: its name, its diameters [nm], and its keys as a sphere and as a dipole."""


def contrast(keys: dict[str, Any], diameter_nm: float, focus_nm: float) -> float:
    """Give the contrast in the middle of the picture of a particle that stands on the glass."""
    optics = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=focus_nm)
    particle = ia.Particle(**keys, diameter_nm=diameter_nm, height_nm="contact")
    return float(ia.psf(optics, particle, CAMERA, pixels=1)[0, 0])


def shell_as_dipole(keys: dict[str, Any], diameter_nm: float) -> dict[str, Any]:
    """Give a homogeneous sphere as much polarisability as core and shell have together."""
    core, shell = keys["index"] ** 2, keys["shell_index"] ** 2
    inner = (1 - 2 * keys["shell_nm"] / diameter_nm) ** 3
    ratio = inner * (core - shell) / (core + 2 * shell)
    permittivity = shell * (1 + 2 * ratio) / (1 - ratio)
    return VESICLE | {"permittivity": (permittivity, 0.0)}


def draw() -> Figure:
    """Draw one panel for each kind of particle."""
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    for axes, (name, (low, high), sphere, dipole) in zip(figure.subplots(1, 3), KINDS, strict=True):
        diameters = np.linspace(low, high, 50)
        model = "shell" if "shell_nm" in sphere else "mie"
        axes.axhline(0, color="0.8", linewidth=0.8)
        largest = 0.0
        for focus, color in zip(FOCI_NM, ("C0", "C1", "C2"), strict=True):
            whole, point = [], []
            for d in diameters.tolist():
                as_dipole = shell_as_dipole(sphere, d) if model == "shell" else dipole
                whole.append(contrast(sphere | {"model": model}, d, focus))
                point.append(contrast(as_dipole, d, focus))
            axes.plot(diameters, whole, color=color, label=f"focus {focus} nm".replace("-", "−"))
            axes.plot(diameters, point, "--", color=color, linewidth=0.8)
            largest = max(largest, float(np.abs(whole).max()))
        axes.set(title=name, xlabel="diameter [nm]")
        axes.set_ylim(-0.7 * largest, 1.2 * largest)
        if name == "gold":  # whose contrast grows by a thousand
            axes.set_yscale("symlog", linthresh=0.05)
            axes.set_ylim(-1, 200)
    figure.axes[0].set_ylabel("contrast")
    figure.axes[0].legend(frameon=False, fontsize=7, loc="lower right")
    return figure


if __name__ == "__main__":
    with mpl.rc_context(STYLE):
        draw().savefig(HERE / "figures" / "large.svg", metadata={"Date": None})
