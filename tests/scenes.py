"""Small microscopes, fields and movies that tests share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import hessian
from iscat_analysis.camera import start_power
from iscat_analysis.config import Config, config_to_toml, parse_config
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.records import Windows
from iscat_analysis.study import Movie, write_stack

Array = NDArray[np.float64]

PIXEL_NM = 84.4

_BASE: dict[str, dict[str, Any]] = {
    "optics": {"focus_nm": -300.0},
    "camera": {"pixel_size_nm": PIXEL_NM},
    "particle": {"mass_kda": 1000.0},
    "background": {"frames": [0, 200]},
    "fit": {"frames": [200, 400]},
    "posterior": {"enabled": False},
    "calibration": {"gradient_per_kda": -3.1e-5},
    "simulation": {"shape": [48, 48], "frames": 400},
}


def make_config(*, calibrated: bool = True, **sections: Mapping[str, Any]) -> Config:
    """Build a mass photometer, changed section by section."""
    values = {name: dict(section) for name, section in _BASE.items()}
    if not calibrated:
        del values["calibration"]
    for name, changes in sections.items():
        values.setdefault(name, {}).update(changes)
    if values["optics"].get("scheme") == "darkfield":
        photons = values["simulation"].get("photons_per_pixel", 1e4)
        values["particle"].setdefault("photons_per_frame", photons)
    return parse_config(values)


def gold(**optics: Any) -> dict[str, dict[str, Any]]:
    """Sections for 60 nm gold, whose contrast is far from weak."""
    return {"particle": {"kind": "gold", "mass_kda": None, "diameter_nm": 60.0}, "optics": optics}


class Stack:
    """A movie in memory."""

    def __init__(self, counts: NDArray[Any]) -> None:
        self.counts = counts
        self.shape = counts.shape
        self.dtype = counts.dtype
        self.name = "movie"

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames [start, stop)."""
        return self.counts[start:stop]


@dataclass(frozen=True)
class Light:
    """Expected photoelectrons before and after landing, and how many frames each holds."""

    before: Array
    after: Array
    landing: int
    power: Array

    @classmethod
    def of(cls, movie: Movie, landing: int) -> Light:
        """Add up the frames of a movie."""
        frames = list(movie.expected_frames())
        return cls(
            np.sum(frames[:landing], axis=0), np.sum(frames[landing:], axis=0), landing, movie.power
        )

    def draw(
        self, rng: np.random.Generator, *, read_noise_e: float = 0.0, gain: float = 1.0
    ) -> Windows:
        """Draw the sums, which are Poisson as the frames are; ρ is measured as the job does.

        A wrong `gain` is one that was told to the job: what it takes for photoelectrons is `gain`
        times as many.
        """
        sizes = (self.landing, self.power.size - self.landing)
        sums = []
        for light, frames in zip((self.before, self.after), sizes, strict=True):
            noise = read_noise_e * np.sqrt(frames) * rng.standard_normal(light.shape)
            sums.append(gain * (rng.poisson(light) + noise))
        nothing = np.zeros(self.before.shape, dtype=bool)
        variances = [np.full(nothing.shape, n * (gain * read_noise_e) ** 2) for n in sizes]
        return start_power(
            Windows(
                before_e=sums[0],
                after_e=sums[1],
                n_before=sizes[0],
                n_after=sizes[1],
                power_ratio=sizes[1] / sizes[0],
                read_variance_before_e2=variances[0],
                read_variance_after_e2=variances[1],
                masked=nothing,
                saturated=nothing,
                frames_before=(0, self.landing),
                frames_after=(self.landing, self.power.size),
                power=self.power,
            )
        )


def blank(windows: Windows, rng: np.random.Generator) -> Windows:
    """Draw both sums anew from a flat background without particles."""
    level = float(windows.before_e.mean())
    shape = windows.before_e.shape
    return replace(
        windows,
        before_e=rng.poisson(level, shape).astype(float),
        after_e=rng.poisson(windows.power_ratio * level, shape).astype(float),
    )


OPTICS_TRUTH = {"focus_nm": -420.0, "reference_phase_deg": 10.0}
"""Optics of `write_bright_landings`, which its configuration does not know."""


def write_bright_landings(movie: Path, setup: Path) -> None:
    """Sixteen particles land 3.7 µm apart, each at a frame of its own."""
    events = [
        {"frame": 40 + 5 * i, "x_px": 22.3 + 44 * (i % 4), "y_px": 21.6 + 44 * (i // 4),
         "mass_kda": 4500.0}
        for i in range(16)
    ]  # fmt: skip
    nominal = {
        "optics": {"wavelength_nm": 525.0, "na": 1.42, "attenuation": 0.1, "focus_nm": -300.0},
        "camera": {"pixel_size_nm": PIXEL_NM},
        "particle": {"kind": "protein", "height_nm": 5.0},
    }
    simulation = {
        "shape": [176, 176], "frames": 160, "photons_per_pixel": 2e4, "seed": 4,
        "background": "speckle", "events": events,
    }  # fmt: skip
    true = {**nominal, "optics": nominal["optics"] | OPTICS_TRUTH, "simulation": simulation}
    write_stack(parse_config(true), movie)
    setup.write_text(config_to_toml(parse_config(nominal)), encoding="utf-8")


def observed_information(likelihood: Likelihood, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Negative Hessian of a log-likelihood at θ, shape (5, 5)."""
    level, rows = float(np.exp(theta[LEVEL])), likelihood.derivatives(theta)
    out = hessian.observed_information(likelihood.measured, level, rows)
    out[2, 2] += likelihood.height_prior[1]
    return out
