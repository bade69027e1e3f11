"""Invented fits of particles that move, as mode ``track`` gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.species import TrackSetup

RATE_HZ, EXPOSURE_MS = 331.0, 2.5
PIXEL_NM, FIELD_PX = 84.0, 128
SETUP = TrackSetup(
    frame_rate_hz=RATE_HZ, exposure_ms=EXPOSURE_MS, frames=(0, 200),
    field_nm=((FIELD_PX - 1) * PIXEL_NM,) * 2, near_nm=500.0,
)  # fmt: skip
PARTS = 24  # of a frame's interval


def walk(
    rng: np.random.Generator, frames: int, d_um2_s: float, *, side_nm: float | None = None,
    start_nm: Sequence[float] = (5000.0, 5000.0),
) -> np.ndarray:  # fmt: skip
    """Average a path over each exposure; `side_nm` puts it between walls, shape (frames, 2)."""
    step = np.sqrt(2 * d_um2_s * 1e6 / RATE_HZ / PARTS)
    path = np.cumsum(rng.normal(0, step, (frames * PARTS, 2)), axis=0)
    if side_nm is not None:
        path = side_nm - np.abs(np.mod(path + side_nm / 2, 2 * side_nm) - side_nm)
    lit = round(PARTS * EXPOSURE_MS * RATE_HZ / 1e3)
    return np.asarray(path.reshape(frames, PARTS, 2)[:, :lit].mean(axis=1) + start_nm)


def fits_of(
    paths: Sequence[np.ndarray], rng: np.random.Generator, *, mass_kda: Sequence[float] = (400.0,),
    sigma_nm: float = 8.0, sigma_kda: float = 15.0, first: Sequence[int] = (0,), z_nm: float = 5.0,
) -> pd.DataFrame:  # fmt: skip
    """Fit paths with normal errors of known size, one row per particle and frame."""
    tables = []
    for track, path in enumerate(paths):
        n = len(path)
        mass = mass_kda[track % len(mass_kda)]
        places = path + rng.normal(0, sigma_nm, path.shape)
        values: dict[str, object] = dict.fromkeys(EVENT_COLUMNS, np.nan)
        fitted = mass + rng.normal(0, sigma_kda, n)
        values |= {
            "event": np.full(n, track),
            "frame": first[track % len(first)] + np.arange(n),
            "n_before": 100, "n_after": 1,
            "x_px": places[:, 0] / PIXEL_NM, "y_px": places[:, 1] / PIXEL_NM,
            "x_nm": places[:, 0], "y_nm": places[:, 1], "z_nm": z_nm,
            "mass_kda": fitted, "contrast": -3.1e-5 * fitted,
            "sigma_x_nm": sigma_nm, "sigma_y_nm": sigma_nm, "sigma_mass_kda": sigma_kda,
            "crb_x_nm": sigma_nm, "crb_y_nm": sigma_nm, "crb_mass_kda": sigma_kda,
            "chi2_reduced": rng.normal(1, 0.05, n), "p_value": rng.uniform(size=n), "snr": 20.0,
            "status": "ok", "flags": "",
        }  # fmt: skip
        tables.append(pd.DataFrame(values, columns=list(EVENT_COLUMNS)))
    return pd.concat(tables, ignore_index=True)


def setup(**changes: object) -> TrackSetup:
    """Change what is known of the movie."""
    return replace(SETUP, **changes)  # type: ignore[arg-type]
