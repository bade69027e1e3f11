"""Output folders with tables that nobody had to measure, for tests of what is made of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

import iscat_analysis as ia

GRADIENT = -3.1e-5
"""Contrast per kDa."""

SERIES_NM = (3.0, 10.0, 30.0)
"""Concentrations of a protein whose dimers have K_D = 10 nM."""


def result_of(folder: Path, masses: NDArray[np.float64], sigma_kda: float) -> Path:
    """Write a folder as an analysis would, with events of these masses that all are ok."""
    number = np.arange(masses.size)
    told = {
        "event": number, "frame": 10 * number, "x_px": number % 50, "y_px": number % 40,
        "mass_kda": masses, "sigma_mass_kda": sigma_kda, "contrast": GRADIENT * masses,
        "status": "ok", "snr": masses / sigma_kda,
    }  # fmt: skip
    table = pd.DataFrame(dict.fromkeys(ia.EVENT_COLUMNS, 0.0) | told)
    folder.mkdir()
    table.to_csv(folder / "fits.csv", index=False)
    table.to_parquet(folder / "fits.parquet")
    summary = {"events": masses.size, "mode": "mass", "mass_scale": "calibration"}
    summary |= {"input": {"path": "gone.tif", "sha256": ""}}
    summary |= {"versions": {}, "seed": None, "findings": []}
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (folder / "config.toml").write_text(ia.config_to_toml(ia.configure()), encoding="utf-8")
    return folder


def uncalibrated(folder: Path) -> Path:
    """Say of a result that its masses have no scale."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    text = json.dumps(summary | {"mass_scale": "absolute model"})
    (folder / "summary.json").write_text(text, encoding="utf-8")
    return folder


def standards_result(folder: Path, random: np.random.Generator) -> Path:
    """Write a result with peaks at 66, 132 and 264 kDa."""
    return result_of(folder, random.normal(np.repeat([66.0, 132.0, 264.0], 120), 7.0), 7.0)


def dimers_result(
    folder: Path, random: np.random.Generator, concentration_nm: float, kd_nm: float = 10.0
) -> Path:
    """Write a result with monomers of 66 kDa and their dimers, of which landings are counted."""
    free = 0.25 * kd_nm * (np.sqrt(1 + 8 * concentration_nm / kd_nm) - 1)
    dimers = free**2 / kd_nm
    landing = np.array([free, dimers * 2 ** (-1 / 6)])
    true = random.choice([66.0, 132.0], 600, p=landing / landing.sum())
    return result_of(folder, random.normal(true, 8.0), 8.0)
