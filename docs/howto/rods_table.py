"""Print the table of large.md: how wrong the mass of a rod is if it is taken for a sphere.

python docs/howto/rods_table.py
"""

from __future__ import annotations

import numpy as np

import iscat_analysis as ia

CAMERA = ia.Camera(pixel_size_nm=90, gain_e_per_adu=1, offset_adu=0, read_noise_e=0)
RATIOS = (2.0, 3.0, 5.0)
DIRECTIONS = ((0, 0), (45, 0), (45, 45), (45, 90), (90, 0), (90, 45), (90, 90))
LIGHT_E = 1e12  # the error is that of the model, not of noise


def error(kind: str, polarization: str, aspect_ratio: float, tilt: float, azimuth: float) -> float:
    """Give the relative error of the mass that a sphere has."""
    optics = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=-300, polarization=polarization)
    keys = {"kind": kind, "mass_kda": 500}
    rod = ia.Particle(
        **keys, model="rod", aspect_ratio=aspect_ratio, tilt_deg=tilt, azimuth_deg=azimuth
    )
    light = LIGHT_E * (1 + ia.psf(optics, rod, CAMERA, pixels=21)[None])
    table = ia.fit_rois(
        np.full_like(light, LIGHT_E), light, optics, ia.Particle(**keys), CAMERA,
        n_before=100, n_after=100, power_ratio=1.0,
    )  # fmt: skip
    return float(table["mass_kda"][0] / rod.nominal_mass_kda - 1)


if __name__ == "__main__":
    for tilt, azimuth in DIRECTIONS:
        cells = [
            f"{100 * error(kind, polarization, ratio, tilt, azimuth):+.1f} %"
            for kind in ("protein", "gold")
            for polarization in ("linear", "circular")
            for ratio in RATIOS
        ]
        print(f"| {tilt}° | {azimuth}° | {' | '.join(cells)} |")
