"""Landing movies of particles that are not equally high: heights are learned, and masses right."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from iscat_analysis.config import configure, load_config
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.study import write_stack

pytestmark = pytest.mark.large

MASS_KDA, COUNT, HIGHEST_NM = 205.0, 16, 20.0
SAMPLE = Path(__file__).resolve().parents[2] / "sample_configs" / "landing.toml"


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    """Write a movie of particles from 0 to 20 nm above the glass."""
    rng = np.random.default_rng(12)
    side, rows = 96, []
    for k, frame in enumerate(rng.permutation(np.linspace(50, 350, COUNT).round().astype(int))):
        x, y = (18 + 20 * (k % 4) + rng.uniform(-2, 2), 18 + 20 * (k // 4) + rng.uniform(-2, 2))
        rows.append((int(frame), x, y, rng.uniform(0, HIGHEST_NM)))
    events = ", ".join(
        f"{{frame={f}, x_px={x:.3f}, y_px={y:.3f}, z_nm={z:.3f}, mass_kda={MASS_KDA}}}"
        for f, x, y, z in rows
    )
    settings = [
        f"simulation.shape=[{side}, {side}]", "simulation.frames=400", "particle.height_nm=5",
        f"simulation.events=[{events}]",
    ]  # fmt: skip
    values = tomllib.loads(SAMPLE.read_text())
    for name in ("count", "leavings", "species"):  # events are listed in place of them
        del values["simulation"][name]
    path = tmp_path_factory.mktemp("heights") / "movie.tif"
    truth = write_stack(configure(values, settings=settings), path, seed=3)
    return path, truth


def analysed(movie: tuple[Path, pd.DataFrame], *more: str) -> tuple:
    path, truth = movie
    config = load_config(SAMPLE, ["particle.height_nm=5", *more])
    analysis = fit_stack(path, config, out=path.parent / f"out{len(more)}", overwrite=True)
    table = analysis.table
    nearest = [
        int(np.argmin(np.hypot(truth["x_px"] - row.x_px, truth["y_px"] - row.y_px)))
        for row in table.itertuples()
    ]
    return analysis, table.assign(true_z_nm=truth["z_nm"].to_numpy()[nearest])


def test_heights_are_learned_and_masses_are_right(movie) -> None:
    analysis, table = analysed(movie, 'particle.height_nm="auto"')
    good = table[table["status"] == "ok"]
    assert len(good) >= COUNT - 1
    pulls = (good["mass_kda"] - MASS_KDA) / good["sigma_mass_kda"]
    assert abs(pulls.mean()) < 4 / len(good) ** 0.5
    assert abs(pulls.std() - 1) < 4 / (2 * len(good)) ** 0.5
    lifted = (good["z_nm"] - good["true_z_nm"]) / good["sigma_z_nm"]
    assert abs(lifted.std() - 1) < 4 / (2 * len(good)) ** 0.5
    heights = analysis.summary["heights"]
    true = table["true_z_nm"]
    assert not heights["held"]
    assert not analysis.summary["optics"]["calibrated"]  # a common height is no other focus
    assert abs(heights["mean_nm"] - true.mean()) < 1.0
    assert heights["sd_ci95_nm"][0] < true.std() < heights["sd_ci95_nm"][1]


def test_one_height_for_all_is_told_and_in_the_budget(movie) -> None:
    """The control: held at 5 nm, the optics are learned in place of the heights."""
    analysis, table = analysed(movie)
    assert analysis.summary["optics"]["calibrated"]
    assert analysis.summary["heights"]["held"]
    assert any("not equally high" in text for text in analysis.warnings)
    good = table[table["status"] == "ok"]
    combined = np.hypot(good["sigma_mass_kda"], good["systematic_mass_kda"])
    assert ((good["mass_kda"] - MASS_KDA).abs() < 4 * combined).all()
