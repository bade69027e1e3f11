"""Masses of a few species tell that the reference is not the same over the field."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from iscat_analysis.config import Config, load_config
from iscat_analysis.trust.systematic import contributions, total
from iscat_analysis.trust.uneven_reference import TERMS, reference_map

SIDE_PX = 200.0
SPECIES_KDA = (146.0, 480.0)
RELATIVE = 0.01
SIGMAS = 4.0


def _config(*settings: str) -> Config:
    return load_config(None, ["camera.pixel_size_nm=84", "background.method=sliding", *settings])


def _table(
    terms: tuple[float, float, float], seed: int, *, count: int = 60, broad: bool = False
) -> pd.DataFrame:
    """Rows whose masses a brighter reference makes smaller."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, SIDE_PX, (2, count))
    u, v = (2 * place / SIDE_PX - 1 for place in (x, y))
    mass = rng.uniform(*SPECIES_KDA, count) if broad else rng.choice(SPECIES_KDA, count)
    brighter = 1 + terms[0] * u + terms[1] * v + terms[2] * (u**2 + v**2)
    sigma = RELATIVE * mass
    fitted = mass / brighter + sigma * rng.standard_normal(count)
    return pd.DataFrame(
        {"x_px": x, "y_px": y, "mass_kda": fitted, "sigma_mass_kda": sigma, "status": "ok",
         "z_nm": 5.0, "contrast": -3e-5 * fitted, "n_before": 40, "n_after": 40}
    )  # fmt: skip


@pytest.mark.parametrize("terms", [(0.03, 0.0, 0.0), (-0.04, 0.06, 0.03)])
def test_a_reference_that_changes_is_found(terms: tuple[float, float, float]) -> None:
    config, table = _config("optics.field_px=[100, 100, 100]"), _table(terms, 5)
    found = reference_map(config, table)
    assert found is not None
    assert np.all(np.abs(found.terms - terms) < SIGMAS * found.errors)
    assert np.all(found.errors < 0.01)
    left = np.abs(found.share(table["x_px"], table["y_px"])) * table["mass_kda"]
    shared = total(contributions(config, table), len(table))["mass_kda"]
    assert np.all(shared > 0.9 * left)  # it is among the errors that rows have in common
    assert "set optics.reference_tilt" in found.finding.text


@pytest.mark.parametrize("broad", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_an_even_reference_is_left_alone(seed: int, broad: bool) -> None:
    assert reference_map(_config(), _table((0.0, 0.0, 0.0), seed, broad=broad)) is None


def test_one_that_is_configured_is_not_asked_for() -> None:
    assert reference_map(_config(f"optics.{TERMS[2]}=0.01"), _table((0.05, 0.0, 0.0), 5)) is None
