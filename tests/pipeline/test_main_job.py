"""The main job over hundreds of particles: honest σ, no bias, all found, none invented.

Fields are drawn as sums before and after landing, and go through detection, power estimation and
fitting together, as `iscat-fit` does them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scenes import Light, make_config
from scipy.optimize import linear_sum_assignment

from iscat_analysis.config import Config
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.fitting.results import table_of
from iscat_analysis.records import FREE_PARAMETERS
from iscat_analysis.study import Movie

pytestmark = pytest.mark.large

STANDARD_ERRORS = 4.0
PLACES, DRAWS, PARTICLES = 5, 8, 8  # 320 particles
BOUND_REACHED = 0.05  # the project's promise: σ within 5 % of the CRB


def _config(mode: str, place: int) -> Config:
    """Eight particles of different mass: 128 x 128 pixels, 200 + 200 frames, 1e4 e, speckle."""
    rng = np.random.default_rng([place, len(mode)])
    joint = mode == "joint"
    columns, rows = (g.ravel() for g in np.meshgrid([21, 64, 106], [21, 64, 106]))
    places = rng.permutation(9)[:PARTICLES]
    events = [
        {
            "frame": 200,
            "x_px": columns[k] + rng.uniform(-3, 3),
            "y_px": rows[k] + rng.uniform(-3, 3),
            "z_nm": rng.uniform(10.0, 400.0) if joint else 5.0,
            "mass_kda": mass,
        }
        for k, mass in zip(places, rng.uniform(400, 2000, PARTICLES), strict=True)
    ]
    return make_config(
        optics={"focus_nm": -500.0 if joint else -300.0},
        fit={"mode": mode, "z_range_nm": [0.0, 500.0]},
        simulation={
            "shape": [128, 128],
            "background": "speckle",
            "power_noise": 0.01,
            "events": events,
        },
    )


@cache
def _fields(mode: str, gain: float, places: int) -> tuple[pd.DataFrame, int, int]:
    """Truth and estimates side by side; how many particles were missed and invented."""
    matched, missed, invented = [], 0, 0
    with ThreadPoolExecutor(2) as pool:
        for place in range(places):
            config = _config(mode, place)
            context = make_context(config, config.simulation.shape)
            movie = Movie(config, seed=place)
            light = Light.of(movie, 200)
            for draw in range(DRAWS):
                rng = np.random.default_rng([place, draw, 77])
                events, _ = fit_field(context, light.draw(rng, gain=gain), pool=pool)
                found = table_of(context, events)
                apart = np.hypot(
                    *(found[c].to_numpy()[:, None] - movie.truth[c].to_numpy() for c in
                      ("x_px", "y_px"))
                )  # fmt: skip
                pairs = [(i, k) for i, k in zip(*linear_sum_assignment(apart), strict=True)
                         if apart[i, k] < 2]  # fmt: skip
                missed += len(movie.truth) - len(pairs)
                invented += len(found) - len(pairs)
                mine, true = (list(t) for t in zip(*pairs, strict=True))
                truth = movie.truth.iloc[true].add_prefix("true_").reset_index(drop=True)
                matched.append(pd.concat([found.iloc[mine].reset_index(drop=True), truth], axis=1))
    return pd.concat(matched, ignore_index=True), missed, invented


def _pulls(table: pd.DataFrame, mode: str) -> pd.DataFrame:
    return pd.DataFrame(
        {n: (table[n] - table[f"true_{n}"]) / table[f"sigma_{n}"] for n in FREE_PARAMETERS[mode]}
    )


def _assert_standard(pulls: pd.DataFrame) -> None:
    """Mean 0 and standard deviation 1: of each parameter, and of all together, which sees more."""
    for values in (*(pulls[name].to_numpy() for name in pulls), pulls.to_numpy().ravel()):
        assert abs(values.mean()) * np.sqrt(values.size) < STANDARD_ERRORS
        assert abs(values.std() - 1) * np.sqrt(2 * values.size) < STANDARD_ERRORS


@pytest.mark.parametrize("mode", ["mass", "joint"])
def test_pulls_are_standard(mode: str) -> None:
    table, missed, invented = _fields(mode, 1.0, PLACES)
    assert len(table) + missed == PLACES * DRAWS * PARTICLES
    assert missed == 0
    # 0.1 false alarms are allowed per field: 4 in 40, and Poisson exceeds 12 once in 3000 runs.
    assert invented <= 12
    _assert_standard(_pulls(table, mode))


def test_a_wrong_gain_is_noticed() -> None:
    """Control: with photoelectrons counted 1.3 times over, σ is too small and the test fails."""
    table, _, _ = _fields("mass", 1.3, PLACES)
    with pytest.raises(AssertionError):
        _assert_standard(_pulls(table, "mass"))


@pytest.mark.parametrize("mode", ["mass", "joint"])
def test_sigma_is_the_bound(mode: str) -> None:
    table, _, _ = _fields(mode, 1.0, PLACES)
    for name in FREE_PARAMETERS[mode]:
        ratio = table[f"sigma_{name}"] / table[f"crb_{name}"]
        assert (ratio - 1).abs().max() < BOUND_REACHED, name
        assert (table[f"qcrb_{name}"] < table[f"crb_{name}"]).all()


@pytest.mark.parametrize("mode", ["mass", "joint"])
def test_good_data_are_called_good(mode: str) -> None:
    """POOR_FIT is one good fit in 1000; its p-value is uniform."""
    table, _, _ = _fields(mode, 1.0, PLACES)
    assert (table["status"] != "ok").sum() <= 4
    p = table["p_value"].to_numpy()
    for edge in (0.1, 0.5, 0.9):
        share = np.mean(p < edge)
        error = np.sqrt(edge * (1 - edge) / len(p))
        assert abs(share - edge) < STANDARD_ERRORS * error
