"""Movies of ``benchmarks/hazards.py``, in which something is wrong: right, or flagged in words."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from _hazard_rows import ROWS
from hazards import judge

pytestmark = pytest.mark.large

SEEDS = range(31, 81, 10)


@pytest.mark.parametrize(
    ("name", "strength"),
    [
        ("clean", 1.0),
        ("tether", 35.0),
        ("jitter", 15.0),  # which leaves steps beside the particles
        ("light that rises", 40.0),
        ("aggregates among proteins", 10000.0),  # whose rings are no flood of noise
    ],
)
def test_a_row_keeps_its_promise(name: str, strength: float) -> None:
    found = judge(name, ROWS[name], strength, SEEDS)
    assert found["kept"], found


def test_a_lie_is_found() -> None:
    """The control: masses are compared with 0.9 of the truth."""
    name = "clean, truth changed afterwards"
    assert not judge(name, ROWS[name], 0.9, SEEDS)["kept"]
