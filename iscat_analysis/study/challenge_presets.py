"""Challenges that are ready: what their movies hold, and what their participants are told."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from iscat_analysis.bounds.paper import COBRI_ATTENUATION, OPTICS, PARTICLE
from iscat_analysis.config import Config, parse_config
from iscat_analysis.errors import ConfigError

VERSION = 1
"""Raised whenever a preset's bytes change; results of different versions are not compared."""

TOLD = ("optics", "camera", "particle", "calibration", "background", "detection", "fit")
"""Sections of the configuration that participants get."""


@dataclass(frozen=True)
class Part:
    """One kind of file in a challenge.

    ``stacks`` hold one particle each, within a pixel of their middle; ``movie`` is one landing
    movie.  `config` is how they are made, `told` what participants get.
    """

    name: str
    kind: Literal["stacks", "movie"]
    config: Config
    told: Config
    count: int = 1
    z_nm: tuple[float, float] | None = None
    mass_factor: tuple[float, float] = (1.0, 1.0)
    about: str = ""


Values = dict[str, dict[str, Any]]

_PLAIN: Values = {
    "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": -300.0, "scheme": "iscat"},
    "camera": {
        "pixel_size_nm": 84.4, "frame_rate_hz": 200.0, "exposure_ms": 5.0, "gain_e_per_adu": 1.0,
        "offset_adu": 0.0, "read_noise_e": 0.0,
    },
    "particle": {"kind": "protein", "mass_kda": 1500.0, "height_nm": 5.0},
    "calibration": {"gradient_per_kda": -3.1e-5},
    "fit": {"mode": "mass", "roi_nm": 2700.0, "z_range_nm": [0.0, 500.0]},
    "bounds": {"photons_per_pixel": 1e4, "n_before": 10, "n_after": 10, "pixels": 33},
}  # fmt: skip

_LANDING: Values = {
    "particle": {"mass_kda": 300.0},
    "bounds": {"n_before": 100, "n_after": 100},
    "background": {"method": "sliding"},
    "simulation": {
        "shape": [96, 96], "frames": 800, "photons_per_pixel": 1e4, "background": "speckle",
        "power_noise": 0.002, "count": 12, "species": [150.0, 300.0, 600.0],
    },
}  # fmt: skip

_HAZARDS: Values = {
    "optics": {"focus_nm": -330.0, "aberrations_nm": {"z5": 8.0, "z11": -10.0}},
    "particle": {"height_sd_nm": 4.0, "height_nm": 12.0},
    "simulation": {
        "drift_px_per_frame": [0.001, -0.0005],
        "species": [90.0, 180.0, 360.0],
        "leavings": 3,
        "power_noise": 0.005,
    },
}
"""What is true of the hard preset, and not told."""

_GLASS_NOISE: Values = {
    "camera": {"gain_e_per_adu": 0.45, "offset_adu": 100.0, "read_noise_e": 2.0}
}

_PROTEIN: dict[str, Any] = {"kind": "protein", "mass_kda": 6e4}
"""So heavy that the paper's scattering amplitude gives a thousand photons in ten frames."""

ABOUT = {
    "easy": "one protein on the glass in each stack, a known microscope, shot noise alone",
    "realistic": "landing movies of three species over a speckled background, a known microscope",
    "hard": "landing movies under a microscope that is not what it is said to be, with drift",
    "dong2021": "the set-ups of Dong et al. (2021): gold and protein; iSCAT, COBRI, dark field",
}


def preset_parts(name: str) -> list[Part]:
    """Give the parts of a preset."""
    if name == "easy":
        config = _config(_PLAIN)
        return [Part("easy", "stacks", config, config, 100, mass_factor=(0.5, 2.0))]
    if name == "realistic":
        config = _config(_PLAIN, _LANDING)
        return [Part(f"realistic_{k}", "movie", config, config) for k in (1, 2)]
    if name == "hard":
        told = _config(_PLAIN, _LANDING, _GLASS_NOISE)
        true = _config(_PLAIN, _LANDING, _GLASS_NOISE, _HAZARDS)
        return [Part(f"hard_{k}", "movie", true, told) for k in (1, 2)]
    if name == "dong2021":
        return [_of_the_paper(scheme, kind) for kind in ("gold", "protein") for scheme in _SCHEMES]
    raise ConfigError(f"preset {name!r}: there are {', '.join(ABOUT)}")


_SCHEMES: Mapping[str, tuple[float, float]] = {
    "iscat": (1.0, 3e4),
    "cobri": (COBRI_ATTENUATION, 3e4),
    "darkfield": (1.0, 3e3),
}
"""Attenuation, and photons per pixel and frame; in dark field those collected per frame."""


def _of_the_paper(scheme: str, kind: str) -> Part:
    attenuation, photons = _SCHEMES[scheme]
    config = _config(
        _PLAIN,
        {
            "optics": {**OPTICS, "scheme": scheme, "attenuation": attenuation, "focus_nm": 300.0},
            "camera": {"pixel_size_nm": 60.0, "samples_per_pixel": 1},
            "fit": {"mode": "joint", "z_range_nm": [0.0, 250.0]},
            "bounds": {"photons_per_pixel": photons, "n_before": 0, "pixels": 45},
        },
        drop=("particle", "calibration"),
        particle=PARTICLE if kind == "gold" else _PROTEIN,
    )
    about = f"{kind}, {scheme}"
    return Part(f"{kind}_{scheme}", "stacks", config, config, 40, (90.0, 110.0), (0.9, 1.1), about)


def parts_of_config(config: Config, count: int) -> list[Part]:
    """Make a challenge of a configuration: stacks of ``[bounds]``, a movie of ``[simulation]``."""
    mode = config.fit.mode if config.fit.mode != "track" else "joint"
    config = config.model_copy(update={"fit": config.fit.model_copy(update={"mode": mode})})
    parts = [Part("stack", "stacks", config, config, count, mass_factor=(0.5, 2.0))]
    if config.simulation.events or config.simulation.count:
        parts.append(Part("movie", "movie", config, config))
    return parts


def _config(*layers: Values, drop: tuple[str, ...] = (), particle: Any = None) -> Config:
    merged: Values = {}
    for layer in layers:
        for section, keys in copy.deepcopy(layer).items():
            merged[section] = {**merged.get(section, {}), **keys}
    for section in drop:
        del merged[section]
    if particle is not None:
        merged["particle"] = {"height_nm": 100.0, **particle}
    if merged["optics"]["scheme"] == "darkfield":
        merged["particle"]["photons_per_frame"] = merged["bounds"]["photons_per_pixel"]
    return parse_config(merged)
