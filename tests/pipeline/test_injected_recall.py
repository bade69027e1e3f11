"""Particles near the threshold are found as often as the Fisher information says."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.bounds import power_searched
from iscat_analysis.fitting.run import Run
from iscat_analysis.pipeline import analyse
from iscat_analysis.pipeline import landings as injection

ADDED = 20
SIGMAS = 4.0


def test_recall_near_the_threshold_is_the_predicted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {
        "simulation.count": 6, "simulation.leavings": 0, "simulation.frames": 400,
        "simulation.shape": [128, 128], "simulation.background": "flat",
        "simulation.power_noise": 0.0, "background.window_frames": 40,
        "optics.calibrate": "never", "posterior.enabled": False,
    }  # fmt: skip
    config = ia.configure("sample_configs/landing.toml", settings=settings)
    ia.simulate_movie(config, tmp_path / "movie.tif", seed=3)
    real, threshold = injection.draw_particles, []

    def faint(result: Any, *arguments: Any) -> Any:
        table = result.fits
        sigma = float(table["crb_mass_kda"][table["status"] == "ok"].median())
        threshold.append(result.context.templates.threshold)
        mass = 0.95 * sigma * threshold[0]
        one = pd.DataFrame({"mass_kda": [mass], "status": ["ok"]})
        return real(replace(result, fits=one), *arguments)

    monkeypatch.setattr(injection, "draw_particles", faint)
    with ia.open_stack(tmp_path / "movie.tif") as movie:
        found = analyse(movie, config, Run(inject=ADDED)).summary["injection"]
    expected = found["predicted"]
    error = math.sqrt(expected * (1 - expected) / found["added"])
    assert 0.3 < expected < 0.7  # on the slope of the curve
    assert abs(found["recall"] - expected) < SIGMAS * error
    # a scale of masses wrong by 1.5 would be noticed
    wrong = power_searched(1.5 * 0.95 * threshold[0], threshold[0])
    assert abs(found["recall"] - wrong) > SIGMAS * error
