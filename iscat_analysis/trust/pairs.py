"""Particles of two halves get the mass of two halves, where their light shows that they are two.

Two halves make elongated images, each in its own direction; wiggling makes images only wider.
A row counts as two halves if its own image is clearly elongated, or if the images of the movie are
and the error of the distance in this row is small beside the distance of the movie.  The distance
that the row itself shows is no criterion: it would select rows that noise has made longer.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from iscat_analysis.inference.fit import POOR_FIT_P
from iscat_analysis.records import BoolArray, Status
from iscat_analysis.trust.extension import Extension

_SURE_SIGMAS = 2.0  # of the square of the distance, beyond which its error is nearly normal
_REPLACED = {
    "mass_kda": "pair_mass_kda",
    "sigma_mass_kda": "sigma_pair_mass_kda",
    "crb_mass_kda": "sigma_pair_mass_kda",
    "chi2_reduced": "pair_chi2_reduced",
    "p_value": "pair_p_value",
}


def told_as_pairs(table: pd.DataFrame, extension: Extension) -> BoolArray:
    """Select the extended rows that get the mass of two halves."""
    square_sigma = 2 * table["separation_nm"] * table["sigma_separation_nm"]
    of_movie = 8 * extension.mean_nm2 if extension.is_long else 0.0  # v is d²/8
    two = (of_movie > _SURE_SIGMAS * square_sigma) | extension.long
    return np.asarray(two & table["pair_mass_kda"].notna() & extension.flagged)


def with_masses_of_pairs(table: pd.DataFrame, which: BoolArray) -> pd.DataFrame:
    """Replace masses, errors and goodness of fit; a fit that is good no longer is `poor_fit`."""
    out = table.copy()
    for name, by in _REPLACED.items():
        out.loc[which, name] = table.loc[which, by]
    for row in out.index[which & (table["pair_p_value"] >= POOR_FIT_P).to_numpy()]:
        known = str(out.at[row, "flags"] or "").split(";")
        flags = [flag for flag in known if flag not in ("", Status.POOR_FIT)]
        out.at[row, "flags"] = ";".join(flags)
        out.at[row, "status"] = flags[0] if flags else Status.OK.value
    return out
