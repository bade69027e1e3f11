"""Movies of proteins that land and leave at chosen times and places, and their analysis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scenes import Stack

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config, load_config
from iscat_analysis.fitting.run import Run
from iscat_analysis.landing.find import analyse_landings
from iscat_analysis.study import Movie

PIXEL_NM = 84.0
CAMERA = Camera(gain_e_per_adu=4.0)
Found = tuple[Any, list[str]]
"""A result, and what the user was told."""

_NAMES = ("frame", "leave", "x_px", "y_px", "mass_kda")


def landing_config(
    side: int,
    frames: int,
    *settings: str,
    events: Iterable[Sequence[float | None] | Mapping[str, Any]] = (),
) -> Config:
    """Configure a movie and its analysis; events are (frame, leave, x [px], y [px], mass [kDa])."""
    base = [
        f"camera.pixel_size_nm={PIXEL_NM}", "camera.gain_e_per_adu=4.0", "particle.mass_kda=146.0",
        "calibration.gradient_per_kda=-3.1e-5", f"simulation.shape=[{side}, {side}]",
        f"simulation.frames={frames}", "simulation.photons_per_pixel=1e5",
        "simulation.background=speckle", "simulation.power_noise=0.01",
        "background.window_frames=40",
    ]  # fmt: skip
    config = load_config(None, [*base, *settings])
    named = [
        event if isinstance(event, Mapping) else dict(zip(_NAMES, event, strict=True))
        for event in events
    ]
    return simulating(config, events=named) if named else config


def simulating(config: Config, **changes: Any) -> Config:
    """Change what is simulated."""
    values = config.simulation.model_dump() | changes
    simulation = type(config.simulation).model_validate(values)
    return config.model_copy(update={"simulation": simulation})


def drawn(config: Config, seed: int = 1) -> np.ndarray:
    """Draw the counts of a movie, (t, y, x)."""
    return np.array(list(Movie(config, seed).frames(2)))


def analysed(movie: Any, config: Config, *, camera: Camera = CAMERA, **options: Any) -> Found:
    """Analyse counts, or a movie."""
    told: list[str] = []
    movie = Stack(movie) if isinstance(movie, np.ndarray) else movie
    return analyse_landings(movie, config, camera, Run(told.append, **options)), told
