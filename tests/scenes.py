"""Small microscopes, fields and movies that tests share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config, parse_config
from iscat_analysis.records import Windows
from iscat_analysis.simulate import Movie

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
    return parse_config(values)


def gold(**optics: Any) -> dict[str, dict[str, Any]]:
    """Sections for 60 nm gold, whose contrast is far from weak."""
    return {
        "particle": {"kind": "gold", "mass_kda": None, "diameter_nm": 60.0},
        "optics": optics,
    }


class Stack:
    """A movie in memory."""

    def __init__(self, counts: NDArray[Any]) -> None:
        self.counts = counts
        self.shape = counts.shape
        self.name = "movie"

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames [start, stop)."""
        return self.counts[start:stop]


def draw_windows(
    movie: Movie,
    rng: np.random.Generator,
    *,
    landing: int,
    read_noise_e: float = 0.0,
    power_ratio: float | None = None,
) -> Windows:
    """Draw the sums before and after landing: sums of Poisson counts are Poisson themselves."""
    expected = list(movie.expected_frames())
    before, after = sum(expected[:landing]), sum(expected[landing:])
    n_before, n_after = landing, len(expected) - landing
    counts = [rng.poisson(light).astype(float) for light in (before, after)]
    variances = [np.full(before.shape, n * read_noise_e**2) for n in (n_before, n_after)]
    for k in range(2):
        counts[k] += np.sqrt(variances[k]) * rng.standard_normal(before.shape)
    nothing = np.zeros(before.shape, dtype=bool)
    if power_ratio is None:
        power_ratio = float(movie.power[landing:].sum() / movie.power[:landing].sum())
    return Windows(
        before_e=counts[0],
        after_e=counts[1],
        n_before=n_before,
        n_after=n_after,
        power_ratio=power_ratio,
        read_variance_before_e2=variances[0],
        read_variance_after_e2=variances[1],
        masked=nothing,
        saturated=nothing,
        frames_before=(0, landing),
        frames_after=(landing, landing + n_after),
        power=movie.power,
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
