"""Histograms and gates: what is counted, and how sure the counts are."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.answers.gates import counted_rows, gate, mass_histogram
from iscat_analysis.report.style import figure_bytes, histogram_figure


@pytest.fixture
def table() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "event": [0, 1, 2, 3, 4],
            "mass_kda": [66.0, -146.0, 480.0, np.nan, 70.0],
            "sigma_mass_kda": 8.0,
            "status": ["ok", "ok", "poor_fit", "ok", "sidelobe"],
        }
    )


@pytest.mark.parametrize(
    ("options", "counted"),
    [
        ({}, [0, 1]),
        ({"ok_only": False}, [0, 1, 2]),
        ({"branch": "landing"}, [0]),
        ({"branch": "leaving"}, [1]),
        ({"rejected": {0}}, [1]),
    ],
)
def test_rows_that_count(table: pd.DataFrame, options: dict, counted: list[int]) -> None:
    assert table["event"][counted_rows(table, **options)].tolist() == counted


def test_an_unknown_branch_is_refused(table: pd.DataFrame) -> None:
    with pytest.raises(ia.ConfigError, match="landing"):
        counted_rows(table, branch="landings")


def test_a_gate_counts_and_describes_what_is_inside() -> None:
    mass = np.array([60.0, 66.0, 72.0, 66.0, 146.0, 150.0, 480.0, 100.0])
    found = gate(mass, 100.0, 50.0)  # either end first; the upper one does not belong to it
    assert (found.low, found.high, found.count) == (50.0, 100.0, 4)
    assert found.mean == pytest.approx(66.0)
    assert found.width == pytest.approx(np.std([60, 66, 72, 66], ddof=1))
    assert found.mean_se == pytest.approx(found.width / 2)
    assert found.fraction == 0.5


def test_intervals_are_those_of_the_tables() -> None:
    """Garwood 1936 and Clopper and Pearson 1934, as their authors tabulate them."""
    none, some = gate(np.full(10, 5.0), 10.0, 20.0), gate(np.r_[[15.0] * 3, [5.0] * 7], 10.0, 20.0)
    assert (none.count_low, none.count_high) == (0.0, pytest.approx(3.689, abs=1e-3))
    assert (some.count_low, some.count_high) == pytest.approx((0.619, 8.767), abs=1e-3)
    assert (none.fraction_low, none.fraction_high) == (0.0, pytest.approx(0.3085, abs=1e-4))
    assert (some.fraction_low, some.fraction_high) == pytest.approx((0.0667, 0.6525), abs=1e-4)
    assert gate(np.full(4, 15.0), 10.0, 20.0).fraction_high == 1.0
    assert np.isnan(gate(np.empty(0), 0.0, 1.0).fraction)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(5)
    trials, held = 400, {"count": 0, "fraction": 0, "half as wide": 0}
    for _ in range(trials):
        number = random.poisson(40)
        found = gate(np.where(random.random(number) < 0.3, 15.0, 5.0), 10.0, 20.0)
        held["count"] += found.count_low <= 12.0 <= found.count_high
        held["fraction"] += found.fraction_low <= 0.3 <= found.fraction_high
        middle, half = found.count, (found.count_high - found.count_low) / 4
        held["half as wide"] += abs(middle - 12.0) <= half
    se = np.sqrt(0.05 * 0.95 / trials)
    assert held["count"] / trials > 0.95 - 3 * se  # both are conservative
    assert held["fraction"] / trials > 0.95 - 3 * se
    assert held["half as wide"] / trials < 0.95 - 3 * se  # the control: it would be seen


def test_bars_and_density_hold_all_events() -> None:
    random = np.random.default_rng(2)
    mass = random.normal(np.repeat([66.0, 146.0], 300), 8.0)
    seen = mass_histogram(mass, bar=5.0)
    assert seen.counts.sum() == pytest.approx(mass.size, abs=6)  # a few lie beyond the axis
    assert np.sum(seen.density) * np.diff(seen.at)[0] / 5.0 == pytest.approx(600, rel=0.02)
    top = seen.edges[np.argmax(seen.counts)]
    assert min(abs(top - 66), abs(top - 146)) < 10


def test_too_many_bars_are_refused() -> None:
    with pytest.raises(ia.ConfigError, match="wider"):
        mass_histogram(np.array([1.0, 500.0]), bar=0.01)


@pytest.mark.parametrize(
    ("kind", "begins"), [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")]
)
def test_figures_are_files_of_their_kind(kind: str, begins: bytes) -> None:
    mass = np.array([60.0, 66.0, 72.0])
    seen = mass_histogram(mass, bar=5.0)
    curve = np.array([0.0, 100.0]), np.array([0.0, 1.0])
    figure = histogram_figure([("a", seen)], gates=[gate(mass, 50, 80)], curve=curve)
    assert figure_bytes(figure, kind).startswith(begins)
