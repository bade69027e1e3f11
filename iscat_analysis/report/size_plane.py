"""Diameter from the motion of each sphere against the light that it scatters.

Spheres of one material lie on a line of constant refractive index, a straight one while they are
small beside the wavelength.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.config import parse_config
from iscat_analysis.optics.materials import material
from iscat_analysis.optics.spheres import Sphere, scattering_length_nm, sphere_of
from iscat_analysis.records import Analysis, BoolArray, FloatArray, TrackStatus
from iscat_analysis.report.answer import tracks_of
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, new_figure
from iscat_analysis.units import sphere_mass_kda

INDICES = (1.36, 1.40, 1.46, 1.52, 1.60)
"""Refractive indices whose lines are drawn, of spheres that do not absorb."""

_NODES = 200  # of a line
_STEP = 1e-3  # of a diameter, for the slope along which its error is carried


def has_plane(analysis: Analysis) -> bool:
    """Tell whether a track has both diameters."""
    return "optical_diameter_nm" in tracks_of(analysis) and bool(_usable(analysis).any())


def size_plane(analysis: Analysis) -> Figure:
    """Draw the hydrodynamic diameters, and what their light says, with lines of constant index."""
    config = parse_config(tomllib.loads(analysis.config_toml))
    matter = material(config.particle, config.optics.wavelength_nm)
    sphere = sphere_of(config.particle, matter.permittivity, matter.mass_kda)
    if sphere is None:
        raise ValueError("only spheres have optical diameters")
    tracks = tracks_of(analysis)[_usable(analysis)]
    moved, error, optical, sigma = (
        tracks[name].to_numpy(float)
        for name in ("diameter_nm", "sigma_diameter_nm", "optical_diameter_nm",
                     "sigma_optical_diameter_nm")
    )  # fmt: skip

    def lengths(diameters_nm: FloatArray, one: Sphere) -> FloatArray:
        """Scattering lengths of spheres of one material."""
        masses = [sphere_mass_kda(d, one.density_kg_m3) for d in diameters_nm.tolist()]
        return np.array([scattering_length_nm(one.of_mass(m), config.optics) for m in masses])

    length = lengths(optical, sphere)
    slope = (lengths(optical * (1 + _STEP), sphere) - length) / (_STEP * optical)
    figure = new_figure(5.2, 4.2)
    axes = figure.subplots()
    ends = 0.7 * min(moved.min(), optical.min()), 1.3 * max(moved.max(), optical.max())
    diameters = np.linspace(*ends, _NODES)
    own = "shell" if sphere.shell_nm else f"{sphere.index.real:.2f}"
    drawn = [(f"{n:.2f}", replace(sphere, index=complex(n), shell_nm=0.0)) for n in INDICES]
    absorbs = abs(sphere.index.imag) >= _STEP
    for label, one in [] if absorbs else [*drawn, (own, sphere)]:
        line = lengths(diameters, one)
        color, width = (BLUE, 1.4) if one is sphere else (GREY, 0.7)
        axes.plot(diameters, line, color=color, lw=width)
        axes.annotate(
            label, (diameters[-1], line[-1]), color=color, fontsize="small", va="center",
            xytext=(3, 0), textcoords="offset points",
        )  # fmt: skip
    good = (tracks["status"] == str(TrackStatus.OK)).to_numpy()
    for rows, color, name in ((good, INK, "ok"), (~good, PURPLE, "flagged")):
        if rows.any():
            axes.errorbar(
                moved[rows], length[rows], xerr=error[rows], yerr=np.abs(slope * sigma)[rows],
                ls="none", marker="o", ms=3, elinewidth=0.7, color=color, label=name,
            )  # fmt: skip
    if not good.all():
        axes.legend(loc="upper left")
    axes.set(xlabel="hydrodynamic diameter [nm]", ylabel="scattering length [nm]", xlim=ends,
             ylim=(0, None))  # fmt: skip
    return figure


def _usable(analysis: Analysis) -> BoolArray:
    """Tell which tracks have both diameters; shape (tracks,)."""
    tracks = tracks_of(analysis)
    return np.asarray(tracks[["diameter_nm", "optical_diameter_nm"]].notna().all(axis=1))
