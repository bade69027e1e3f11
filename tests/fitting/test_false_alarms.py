"""False alarms where many are allowed: the threshold is exact, not only on the safe side."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.config import load_config
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.records import Windows
from iscat_analysis.study import Movie

pytestmark = pytest.mark.large

ALLOWED = 10.0
"""False alarms in a movie."""

SIGMAS = 3.0
LEVEL_E = 1e5
FIELD = (192, 192)
"""Of the movies with background frames: in a field in which ten find no room apart from each other,
some count as one."""

COMMON = [
    "camera.pixel_size_nm=84", "camera.gain_e_per_adu=4.0", "particle.mass_kda=146.0",
    "calibration.gradient_per_kda=-3.1e-5", "simulation.shape=[64, 64]", "simulation.count=0",
    f"simulation.photons_per_pixel={LEVEL_E}", "simulation.background=speckle",
    "posterior.enabled=false", "optics.calibrate=never", "compute.workers=1",
    f"detection.false_alarms_per_movie={ALLOWED}", "fit.roi_nm=1800",
]  # fmt: skip


def _landing(movies: int) -> list[int]:
    settings = ["simulation.frames=240", "background.window_frames=40"]
    config = load_config(None, [*COMMON, *settings, "simulation.power_noise=0.01"])
    return [
        len(ia.fit_movie(np.array(list(Movie(config, seed).frames())), config=config).table)
        for seed in range(2000, 2000 + movies)
    ]


def _fixed(movies: int) -> list[int]:
    settings = ["background.method=fixed", "background.frames=[0, 30]", "fit.frames=[30, 60]"]
    context = make_context(load_config(None, [*COMMON, *settings]), FIELD)
    nothing, none = np.zeros(FIELD, dtype=bool), np.zeros(FIELD)
    rng, found = np.random.default_rng(3), []
    with ThreadPoolExecutor(1) as pool:
        for _ in range(movies):
            before, after = rng.poisson(30 * LEVEL_E, (2, *FIELD)).astype(float)
            windows = Windows(
                before_e=before, after_e=after, n_before=30, n_after=30,
                power_ratio=float(after.sum() / before.sum()), read_variance_before_e2=none,
                read_variance_after_e2=none, masked=nothing, saturated=nothing,
                frames_before=(0, 30), frames_after=(30, 60), power=np.ones(60),
            )  # fmt: skip
            found.append(len(fit_field(context, windows, pool=pool)[0]))
    return found


def _assert_exact(found: list[int], allowed: float = ALLOWED) -> None:
    """Ask for the mean of a Poisson number, to 3 of its standard errors."""
    assert abs(np.mean(found) - allowed) < SIGMAS * math.sqrt(allowed / len(found))


@pytest.mark.parametrize("kind", ["landing", "fixed"])
def test_as_many_as_allowed_are_found(kind: str) -> None:
    found = _landing(60) if kind == "landing" else _fixed(60)
    _assert_exact(found)


def test_another_number_is_refused() -> None:
    """Control: 7.7 in place of 10 were found before peaks were known between their pixels."""
    found = np.random.default_rng(1).poisson(0.77 * ALLOWED, 60).tolist()
    with pytest.raises(AssertionError):
        _assert_exact(found)
