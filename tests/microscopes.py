"""The experiments that the statistical tests repeat.

Each has enough light and a focus at which every free parameter is well determined; what is tested
is then the estimator, not the microscope.
"""

from __future__ import annotations

from typing import Any

from iscat_analysis.config import Config, parse_config
from iscat_analysis.study import Setting, make_setting

ROI_NM = 2700.0
PHOTONS = 3000.0

ATTENUATION = {"iscat": 1.0, "cobri": 0.1, "darkfield": 1.0}


def configuration(scheme: str = "iscat", **sections: dict[str, Any] | None) -> Config:
    """Protein of 1 MDa under an oil objective; sections override key by key, None drops one."""
    base: dict[str, dict[str, Any]] = {
        "optics": {
            "wavelength_nm": 525.0,
            "na": 1.42,
            "scheme": scheme,
            "attenuation": ATTENUATION[scheme],
            "focus_nm": -500.0,
        },
        "camera": {"pixel_size_nm": 84.4},
        "particle": {"kind": "protein", "mass_kda": 1000.0, "height_nm": 5.0},
        "fit": {"roi_nm": ROI_NM, "z_range_nm": [0.0, 1000.0]},
        # off the centre, so that no symmetry of the pixels helps
        "bounds": {"n_before": 200, "n_after": 200, "x_nm": 17.0, "y_nm": -29.0},
    }
    if scheme == "iscat":
        base["calibration"] = {"gradient_per_kda": -3.1e-5}
    for name, keys in sections.items():
        if keys is None:
            base.pop(name, None)
        else:
            base[name] = {**base.get(name, {}), **keys}
    return parse_config(base)


def setting(
    scheme: str = "iscat",
    mode: str = "joint",
    photons: float = PHOTONS,
    z_nm: float | None = None,
    **sections: dict[str, Any] | None,
) -> Setting:
    """One experiment with a number of collected scattered photons."""
    return make_setting(configuration(scheme, **sections), mode, collected=photons, z_nm=z_nm)
