"""Parameters of a particle, and the columns of tables."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

PARAMETERS = ("x_nm", "y_nm", "z_nm", "mass_kda")
"""The particle's parameters, in the order every matrix and vector uses."""

FREE_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "mass": ("x_nm", "y_nm", "mass_kda"),
    "localize": ("x_nm", "y_nm", "z_nm"),
    "joint": PARAMETERS,
    "track": PARAMETERS,
}
"""What each mode fits."""


def free_parameters(mode: str, fits: pd.DataFrame) -> tuple[str, ...]:
    """Tell what was fitted: in mode ``track`` the height only where ``track.free`` asks for it."""
    names = FREE_PARAMETERS[mode]
    fitted = tuple(name for name in names if fits[f"sigma_{name}"].notna().any())
    return fitted if mode == "track" and fitted else names


EVENT_COLUMNS = (
    "event", "frame", "n_before", "n_after", "x_px", "y_px", "x_nm", "y_nm", "z_nm", "mass_kda",
    "contrast", "sigma_x_nm", "sigma_y_nm", "sigma_z_nm", "sigma_mass_kda",
    "crb_x_nm", "crb_y_nm", "crb_z_nm", "crb_mass_kda",
    "qcrb_x_nm", "qcrb_y_nm", "qcrb_z_nm", "qcrb_mass_kda",
    "n_scattered", "snr", "chi2_reduced", "p_value", "status", "flags",
)  # fmt: skip
"""The columns of ``fits.csv``, in order."""

FRAME_COLUMN = "frame_ci95"
"""Column of ``fits.csv`` after `EVENT_COLUMNS`, of landing movies: half-width of the 95 % interval
of ``frame`` [frames]."""

REPEAT_COLUMNS = ("repeat_x_nm", "repeat_y_nm", "repeat_z_nm", "repeat_mass_kda")
"""Columns of ``fits.csv``: standard errors of an event as disjoint parts of its own frames show
them; of a single frame, as the empty places of that frame do."""

TRACK_COLUMNS = (
    "track", "first_frame", "last_frame", "n_frames", "mass_kda", "sigma_mass_kda", "crb_mass_kda",
    "d_um2_s", "sigma_d_um2_s", "crb_d_um2_s", "diameter_nm", "sigma_diameter_nm",
    "refractive_index", "confinement_nm", "status", "flags",
    "d_low_um2_s", "d_high_um2_s", "d_disagreement", "p_confinement", "exponent", "sigma_exponent",
    "p_anomalous", "p_steady", "sigma_refractive_index", "contrast", "mass_scatter", "p_mass",
    "n_mass_frames", "n_d_frames", "x_nm", "y_nm", "z_nm", "nearest_nm", "begins", "ends",
)  # fmt: skip
"""The columns of ``tracks.csv``, in order."""


BUDGET_COLUMNS = ("name", "kind", "common", "sigma_mass_kda", "sigma_rel", "dof", "remedy")
"""What is said of each source of the error of a mass."""


def flagged(table: pd.DataFrame, flag: str) -> pd.DataFrame:
    """Add a flag to all rows of a table of events or tracks; it is the status of those ok."""
    before = table["flags"].fillna("").astype(str)
    flags = before.where(before == "", before + ";") + flag
    return table.assign(status=table["status"].mask(table["status"] == "ok", flag), flags=flags)


def track_numbers(fits: pd.DataFrame) -> pd.Series[int]:
    """Give the track of every row."""
    return fits["track"] if "track" in fits else fits["event"]
