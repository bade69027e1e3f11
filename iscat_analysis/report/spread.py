"""Sentences of the report about the measured spread."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd

from iscat_analysis.records import POOR_P, counted, is_rejected
from iscat_analysis.report.numbers import decimals_for, fixed, number


def rejection(table: pd.DataFrame) -> str:
    """Say that the model of the image is rejected, where it is."""
    if not is_rejected(table):
        return ""
    p_values = counted(table)["p_value"].dropna()
    poor = int((p_values < POOR_P).sum())
    return (
        f"The model is rejected: {poor} of {p_values.size} fits have a p-value below {POOR_P:g}, "
        f"where {number(POOR_P * p_values.size, 2)} would by chance. Errors of the model, such as "
        "a wrong focus, aperture or pixel size, are not in σ, and in the spread only as rings left "
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
