"""What is advised of a camera that is not linear makes masses right, and never worse.

One landing movie is recorded again by cameras of other laws; the advice is taken from the line that
the program says, or the curve that it writes, and followed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from numpy.typing import NDArray

import iscat_analysis as ia

pytestmark = pytest.mark.large

SAMPLE = Path(__file__).resolve().parents[2] / "sample_configs" / "landing.toml"
CAMERA = {
    "camera.gain_e_per_adu": "auto",
    "camera.read_noise_e": "auto",
    "optics.calibrate": "never",
}
ROOM_E = 1e4

Counts = NDArray[Any]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Counts, pd.DataFrame]:
    path = tmp_path_factory.mktemp("camera") / "movie.tif"
    settings = {
        "simulation.shape": [96, 96], "simulation.frames": 500, "simulation.count": 10,
        "simulation.leavings": 2,
    }  # fmt: skip
    truth = ia.simulate_movie(SAMPLE, path, seed=11, settings=settings)
    return tifffile.imread(path).astype(float), truth


@pytest.fixture(scope="module")
def linear(recorded: tuple[Counts, pd.DataFrame]) -> float:
    """Give what a linear camera makes of the same light: its noise is common to all cameras."""
    counts, truth = recorded
    found, error = _over_true(_fit(counts), truth)
    assert abs(found - 1) < 3 * error
    return found


def _room(counts: Counts) -> Counts:
    return counts + np.random.default_rng(5).poisson(ROOM_E, counts.shape) / 4


LAWS: dict[str, tuple[Callable[[Counts], Counts], float]] = {
    "gamma": (lambda c: 60000 * (c / 45000) ** 0.85, 0.85),
    "saturation": (lambda c: 1e5 * -np.expm1(-c / 1e5), 0.25 / math.expm1(0.25)),
    "offset": (lambda c: c + 2000, 25000 / 27000),
    "other light": (_room, 1e5 / (1e5 + ROOM_E)),
}
"""What a camera, or the room, makes of counts; and the contrast that is left of the true one."""


def _fit(counts: Counts, offset: float | str = 0.0, **further: Any) -> ia.Result:
    settings = {**CAMERA, "camera.offset_adu": offset, **further}
    return ia.fit_movie(np.rint(counts).astype(np.uint16), config=SAMPLE, settings=settings)


def _over_true(result: ia.Result, truth: pd.DataFrame) -> tuple[float, float]:
    """Give the weighted mean of masses over the true ones, and its standard error."""
    ratios, errors = [], []
    for row in result.table.itertuples():
        away = np.hypot(truth["x_px"] - row.x_px, truth["y_px"] - row.y_px)
        when = truth["frame"] if row.mass_kda > 0 else truth["leave"]
        near = truth[(away < 2) & ((when - row.frame).abs() < 20)]
        if len(near) == 1:
            mass = float(near["mass_kda"].iloc[0])
            ratios.append(abs(row.mass_kda) / mass)
            errors.append(row.sigma_mass_kda / mass)
    weight = 1 / np.square(errors)
    assert len(ratios) > 8
    return float(np.average(ratios, weights=weight)), float(1 / math.sqrt(weight.sum()))


def _advised(result: ia.Result, folder: Path) -> dict[str, Any]:
    """Read the advice as a user would."""
    (line,) = [text for text in result.warnings if "masses" in text]
    if "camera.response = response.csv" in line:
        result.save(folder)
        return {"camera.response": str(folder / "response.csv")}
    numbers = re.findall(r"(camera\.\w+) = ([\d.]+\d)", line.split(": ", 1)[1].split("set ")[-1])
    return {key: float(value) for key, value in numbers}


@pytest.mark.parametrize(
    "kind",
    [
        "gamma",
        "saturation",
        pytest.param("offset", marks=pytest.mark.large),
        pytest.param("other light", marks=pytest.mark.large),
    ],
)
def test_followed_advice_makes_masses_right(
    kind: str, recorded: tuple[Counts, pd.DataFrame], linear: float, tmp_path: Path
) -> None:
    counts, truth = recorded
    law, contrast = LAWS[kind]
    seen = law(counts)
    wrong = _fit(seen)
    found = wrong.summary["camera"]["law"]
    assert found["kind"] == kind
    before, error = _over_true(wrong, truth)
    before /= linear
    assert abs(before / contrast - 1) < error  # a control: without advice masses are wrong
    assert abs(before - 1) > 5 * error
    assert set(wrong.table["status"]) == {"nonlinear"}
    advice = _advised(wrong, tmp_path / "result")
    right = _fit(seen, **{"offset": advice.pop("camera.offset_adu", 0.0)}, **advice)
    after = _over_true(right, truth)[0] / linear
    assert abs(after - 1) < abs(before - 1)
    own = error if kind == "other light" else 0.0  # which has noise of its own
    assert abs(after - 1) < 2 * math.hypot(own, found["contrast_se"] / found["contrast"])
    assert "nonlinear" not in set(right.table["status"])


def test_an_offset_that_is_left_open_is_learned(
    recorded: tuple[Counts, pd.DataFrame], linear: float
) -> None:
    counts, truth = recorded
    result = _fit(counts + 2000, "auto")
    after = _over_true(result, truth)[0] / linear
    offset = result.summary["camera"]["offset_adu"]
    assert offset["from"] == "measured"
    assert abs(offset["value"] - 2000) < 4 * offset["se"]
    assert abs(after - 1) < 2 * offset["se"] / 25000
    assert set(result.table["status"]) == {"ok"}
