"""Sentences of the report about the measured spread."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import bdtrc

from iscat_analysis.records import counted
from iscat_analysis.report.numbers import decimals_for, fixed, number

_POOR = 0.01  # p-value that a good fit has in 1 of 100
_CHANCE = 1e-4  # that so many fits are poor, below which the model is rejected


def rejection(table: pd.DataFrame) -> str:
    """Say that the model of the image is rejected, where it is.

    Notes
    -----
    What disturbs a particle that moves, as one outside of the field does, disturbs it in many
    frames, and says nothing of the microscope.  An error of the microscope is in every track: of
    tracks those with the smallest shares of poor fits, which have half of all fits, are judged.
    """
    table = counted(table)
    table = table[np.isfinite(table["p_value"].to_numpy(float))]
    poor = table["p_value"] < _POOR
    fits, misses = len(table), int(poor.sum())
    if "track" in table:
        tracks = poor.groupby(table["track"], dropna=False).agg(["size", "sum", "mean"])
        tracks = tracks.sort_values("mean")
        before = tracks["size"].cumsum() - tracks["size"]
        fits, misses = (int(n) for n in tracks.loc[before < fits / 2, ["size", "sum"]].sum())
    if not fits or float(bdtrc(misses - 1, fits, _POOR)) > _CHANCE:
        return ""
    return (
        f"The model is rejected: {poor.sum()} of {poor.size} fits have a p-value below {_POOR:g}, "
        f"where {number(_POOR * poor.size, 2)} would by chance. Errors of the model, such as a "
        "wrong focus, aperture or pixel size, are not in σ, and in the spread only as rings left "
        "over of other particles; they show in how far the species are wider than σ."
    )


def species_widths(summary: Mapping[str, Any]) -> list[str]:
    """Say how much wider than σ the species are."""
    lines = []
    calibrated = summary.get("mass_scale") == "calibration"
    for one in summary.get("across_particles") or ():
        values = [one[f"width_{key}"] for key in ("kda", "low", "high")]
        if not all(value is not None and math.isfinite(value) for value in values):
            continue
        unit, name = " kDa", f"at {number(one['mass_kda'])} kDa"
        if not calibrated:
            unit, name = " %", "of contrast"
            values = [100 * value / one["mass_kda"] for value in values]
        decimals = decimals_for([(values[2] - values[1]) / 2])
        width, low, high = (fixed(value, decimals) for value in values)
        explained = one.get("explained_kda")
        budget = ""
        if explained is not None:
            known = explained if calibrated else 100 * explained / one["mass_kda"]
            budget = f" The budget explains {fixed(known, decimals)}{unit} of that."
        lines.append(
            f"Across particles: beyond the σ of its {one['count']:.0f} events the species {name} "
            f"is {width}{unit} ({low} to {high}) wide, so that its events scatter by "
            f"{number(one['spread_over_sigma'])} times σ.{budget}"
        )
    return lines
