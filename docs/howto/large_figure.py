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
OPTICS = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=0)
CAMERA = ia.Camera(pixel_size_nm=90)
VESICLE = {"kind": "custom", "density_kg_m3": 1010}
KINDS: tuple[tuple[str, tuple[int, int], dict[str, Any], dict[str, Any]], ...] = (
    ("gold", (10, 150), {"kind": "gold"}, {"kind": "gold"}),
    ("silica", (20, 300), {"kind": "silica"}, {"kind": "silica"}),
    (
        "vesicles, shell of 5 nm",
        (60, 200),
        VESICLE | {"index": 1.335, "shell_nm": 5, "shell_index": 1.46},
        VESICLE,
    ),
)
"""What is drawn: its name, its diameters [nm], and its keys as a sphere and as a dipole."""


def contrast(keys: dict[str, Any], diameter_nm: float) -> float:
    """Give the contrast in the middle of the picture of a particle that stands on the glass."""
    particle = ia.Particle(**keys, diameter_nm=diameter_nm, height_nm="contact")
    return float(ia.psf(OPTICS, particle, CAMERA, pixels=1)[0, 0])


def shell_as_dipole(keys: dict[str, Any], diameter_nm: float) -> dict[str, Any]:
    """Give a homogeneous sphere as much polarisability as core and shell have together."""
    core, shell = keys["index"] ** 2, keys["shell_index"] ** 2
    inner = (1 - 2 * keys["shell_nm"] / diameter_nm) ** 3
    ratio = inner * (core - shell) / (core + 2 * shell)
    permittivity = shell * (1 + 2 * ratio) / (1 - ratio)
    return VESICLE | {"permittivity": (permittivity, 0.0)}


def draw() -> Figure:
    """Draw one panel for each kind of particle."""
    figure = Figure(figsize=(6.6, 2.6), layout="constrained")
    for axes, (name, (low, high), sphere, dipole) in zip(figure.subplots(1, 3), KINDS, strict=True):
        diameters = np.linspace(low, high, 60)
        model = "shell" if "shell_nm" in sphere else "mie"
        whole = [contrast(sphere | {"model": model}, float(d)) for d in diameters]
        point = [
            contrast(shell_as_dipole(sphere, float(d)) if model == "shell" else dipole, float(d))
            for d in diameters
        ]
        axes.axhline(0, color="0.8", linewidth=0.8)
        axes.plot(diameters, whole, label="sphere")
        axes.plot(diameters, point, "--", label="dipole of the same volume")
        axes.set(title=name, xlabel="diameter [nm]")
        top = 1.3 * np.abs(whole).max()
        axes.set_ylim(-top, top)
    figure.axes[0].set_ylabel("contrast")
    figure.axes[1].legend(frameon=False, fontsize=7, loc="upper left")
    return figure


if __name__ == "__main__":
    with mpl.rc_context(STYLE):
        draw().savefig(HERE / "figures" / "large.svg", metadata={"Date": None})
