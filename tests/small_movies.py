"""Small movies, and results that stand for those of every movie of a day."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.day import jobs

SMALL = [
    "simulation.frames=60",
    "simulation.shape=[64, 64]",
    "simulation.events=[{frame=30, x_px=31.2, y_px=30.8, mass_kda=900.0}]",
    "background.frames=[0, 30]",
    "fit.frames=[30, 60]",
    "posterior.enabled=false",
    "bounds.pixels=41",
]
"""Changes of a sample configuration that keep a job short without changing what it shows."""

LANDING = """
[optics]
na = 1.3
attenuation = 1.0
focus_nm = -300.0
[camera]
pixel_size_nm = 84.4
gain_e_per_adu = 4.0
[background]
window_frames = 20
[fit]
roi_nm = 1300.0
[posterior]
enabled = false
[compute]
workers = 1
[calibration]
gradient_per_kda = -3.1e-5
[simulation]
shape = [64, 64]
frames = 480
photons_per_pixel = 1e5
count = 6
species = [600.0]
"""
"""Configuration of a small landing movie, and how to simulate it."""

SETUP = {
    "optics.focus_nm": -300.0,
    "optics.calibrate": "never",
    "camera.pixel_size_nm": 84.4,
    "camera.gain_e_per_adu": 1.0,  # given, so that a result's configuration is that of its movie
    "camera.offset_adu": 0.0,
    "camera.read_noise_e": 0.0,
    "particle.mass_kda": 900.0,
    "background.frames": (0, 30),
    "fit.frames": (30, 60),
    "posterior.enabled": False,
    "calibration.gradient_per_kda": -3.1e-5,
    "simulation.shape": [64, 64],
    "simulation.frames": 60,
}


def simulate(path: Path, *, seed: int, masses: tuple[float, ...] = (900.0, 1500.0)) -> None:
    """Write a movie of particles 32 pixels apart."""
    side = int(np.ceil(np.sqrt(len(masses))))
    events = [
        {"frame": 30, "x_px": 20.3 + 32 * (k % side), "y_px": 20.8 + 32 * (k // side),
         "mass_kda": mass}
        for k, mass in enumerate(masses)
    ]  # fmt: skip
    shape = [8 + 32 * side] * 2
    changes = {"simulation.shape": shape, "simulation.events": events}
    ia.simulate_movie({**SETUP, **changes}, str(path), seed=seed)


def analysed(place: Path) -> Path:
    """Make a movie and its result in a folder."""
    simulate(place / "movie.tif", seed=1)
    ia.fit_stack(place / "movie.tif", ia.configure(SETUP), out=place / "movie.iscat")
    return place


def put_in_place_of_fits(made: Path, patch: pytest.MonkeyPatch) -> list[str]:
    """Let every fit of a day take the finished result; the list fills with the movies fitted."""
    done: list[str] = []

    def fit_stack(movie: Path, _: object, *, out: Path, **__: object) -> SimpleNamespace:
        done.append(movie.name)
        with ia.open_stack(movie) as stack:
            sha256 = stack.sha256()
        shutil.copytree(made / "movie.iscat", out, dirs_exist_ok=True)
        summary = json.loads((out / "summary.json").read_text())
        return SimpleNamespace(summary={**summary, "input": {"sha256": sha256}})

    patch.setattr(jobs, "fit_stack", fit_stack)
    return done
