"""The golden set-ups as configurations and as set-ups of the slow reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from reference import Setup

from iscat_analysis.config import Config, parse_config

GOLDEN = Path(__file__).resolve().parent / "data" / "golden"
CASES: list[dict[str, Any]] = json.loads((GOLDEN / "exact.json").read_text(encoding="utf-8"))
CURVES: dict[str, Any] = json.loads((GOLDEN / "dong2021_curves.json").read_text(encoding="utf-8"))
NAMES = [case["name"] for case in CASES]
PAPER = {
    "wavelength_nm": 517.5, "na": 1.3, "n_immersion": 1.5, "n_glass": 1.5, "n_sample": 1.33,
    "emission": "dong2021",
}  # fmt: skip
GOLD = {"kind": "gold", "permittivity": (-3.7328, 2.7725), "diameter_nm": 30.0}


def golden_config(case: dict[str, Any], mode: str = "joint") -> Config:
    """One golden case as `iscat bounds` would be given it; its light is that at pixel centres."""
    dark = case["attenuation"] == 0
    keys = ("wavelength_nm", "na", "n_immersion", "n_glass", "n_sample", "emission", "focus_nm")
    return parse_config(
        {
            "optics": {
                **{key: case[key] for key in keys},
                "scheme": "darkfield" if dark else case["scheme"],
                "attenuation": 1.0 if dark else case["attenuation"],
                "axial": case["axial"],
            },
            "camera": {"pixel_size_nm": case["fov_nm"] / case["pixels"], "samples_per_pixel": 1},
            "particle": {
                "kind": "gold",
                "permittivity": tuple(case["permittivity"]),
                "diameter_nm": 2 * case["radius_nm"],
                "height_nm": case["z_nm"],
            },
            "bounds": {
                "pixels": case["pixels"],
                "x_nm": case["x_nm"],
                "y_nm": case["y_nm"],
                "n_before": 0,
            },
            "fit": {"mode": mode},
        }
    )


def small_config(**sections: dict[str, Any]) -> Config:
    """D21's microscope with 30 nm gold, changed as asked; 41 × 41 points 50 nm apart."""
    values: dict[str, dict[str, Any]] = {
        "optics": {**PAPER, "focus_nm": 300.0},
        "camera": {"pixel_size_nm": 50.0, "samples_per_pixel": 1},
        "particle": {**GOLD, "height_nm": 100.0},
        "bounds": {"pixels": 41, "n_before": 0, "n_after": 1},
        "fit": {"mode": "joint"},
    }
    for section, keys in sections.items():
        values.setdefault(section, {}).update(keys)
    return parse_config(values)


def reference_setup(config: Config, z_nm: float | None = None) -> Setup:
    """Set up the slow reference as a configuration does the model; refocused at z where asked."""
    o, p = config.optics, config.particle
    height = z_nm if z_nm is not None and o.axial == "refocus" else p.height_nm
    assert p.permittivity is not None
    assert p.diameter_nm is not None
    return Setup(
        wavelength_nm=o.wavelength_nm, na=o.na, n_immersion=o.n_immersion, n_glass=o.n_glass,
        n_sample=o.n_sample, scheme="iscat" if o.scheme == "iscat" else "cobri",
        attenuation=o.attenuation, emission=o.emission, permittivity=complex(*p.permittivity),
        radius_nm=p.diameter_nm / 2,
        oil_minus_design_nm=height - o.focus_nm - height * o.n_immersion / o.n_sample,
        axial=o.axial,
    )  # fmt: skip
