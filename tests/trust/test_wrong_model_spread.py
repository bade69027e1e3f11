"""What is said of the spread where the microscope that was told is not the one that measured."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.config import Config, load_config
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse
from iscat_analysis.report import render_report
from iscat_analysis.study import Movie

FRAMES, SIDE, COUNT, WINDOW = 400, 160, 24, 50
SETTINGS = [
    "camera.pixel_size_nm=84.0", "camera.gain_e_per_adu=4.0", "camera.well_depth_e=1e6",
    "optics.focus_nm=-300.0", 'optics.calibrate="never"', "particle.mass_kda=480",
    "calibration.gradient_per_kda=-3.1e-5", "posterior.enabled=false",
    "detection.false_alarms_per_movie=1e-3", f"simulation.shape=[{SIDE},{SIDE}]",
    f"simulation.frames={FRAMES}", "simulation.photons_per_pixel=2e5",
    f"background.window_frames={WINDOW}", "fit.spheres=[]",
]  # fmt: skip


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Movie of particles of one mass, each alone in its windows."""
    random = np.random.default_rng(3)
    places: list[tuple[int, float, float]] = []
    while len(places) < COUNT:
        x, y = random.uniform(14, SIDE - 14, 2)
        frame = int(random.integers(WINDOW + 5, FRAMES - WINDOW - 5))
        if all(np.hypot(x - a, y - b) > 28 or abs(frame - t) > 115 for t, a, b in places):
            places.append((frame, float(x), float(y)))
    values = load_config(None, SETTINGS).model_dump()
    values["simulation"] |= {
        "background": "flat",
        "events": [
            {"frame": t, "x_px": x, "y_px": y, "mass_kda": 480.0, "z_nm": 5.0} for t, x, y in places
        ],
    }
    movie = Movie(Config.model_validate(values), 1)
    drawn = [random.poisson(light) / 4.0 for light in movie.expected_frames()]
    return np.rint(np.stack(drawn)).astype(np.uint16)


@pytest.mark.parametrize(
    "told",
    [
        "",
        *(
            pytest.param(wrong, marks=pytest.mark.large)
            for wrong in (
                "optics.na=1.30", "optics.focus_nm=-450.0", "optics.focus_nm=-150.0",
                "camera.pixel_size_nm=87.4",
            )
        ),
        "camera.pixel_size_nm=80.6",
    ],
)  # fmt: skip
def test_no_spread_is_claimed_without_the_rejection(told: str, counts: np.ndarray) -> None:
    """The rejection and the width of the species stand where the spread stands."""
    config = load_config(None, [*SETTINGS, *([told] if told else [])])
    analysis = analyse(open_stack(counts, name="movie"), config)
    page = render_report(analysis)
    assert ("The model is rejected" in page) == bool(told)
    assert "Across particles" in page
