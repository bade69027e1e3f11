"""The error budget of the masses of a movie, source by source."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.inference.repeats import EmpiricalSpread
from iscat_analysis.records import FloatArray, Status
from iscat_analysis.trust.systematic import Contribution

SCALE = "scale of the model", "measure standards (iscat calibrate mass)"
"""What nobody knows of masses without standards, and what tells it."""

SPHERES = "density of the spheres", "weigh some: a diameter does not need it"
"""The same of spheres, whose masses follow from their pictures with these."""

_LEAST_WIDTH = 0.25  # of σ: a width beneath it is not worth a line
_CLEAR_SIGMAS = 3.0  # standard errors by which noise is more than σ says


def budget_of(
    table: pd.DataFrame,
    found: Sequence[Contribution],
    achieved: Mapping[str, EmpiricalSpread],
    *,
    unknown: tuple[str, str] | None,
    scaled: bool,
) -> list[dict[str, Any]]:
    """List what the error of a mass is made of: medians over the rows that are ok.

    Sources that are common to all rows add up to ``systematic_mass_kda``.  What is `unknown` has a
    name and a remedy, and no size.
    """
    good = table["status"] == Status.OK.value
    rows = table[good] if good.any() else table
    mass = rows["mass_kda"].abs().to_numpy(float)
    if not np.isfinite(rows["sigma_mass_kda"].to_numpy(float)).any():
        return []
    noise = rows["sigma_mass_kda"].to_numpy(float)
    remedy = "more light, or more frames of each particle"
    budget = [
        _entry("photon noise", "measured", noise, mass, remedy, common=False),
        _entry(  # 1/SNR² of the mass is taken off, at an SNR that is off by 1
            "bias of faint particles, taken off", "measured", noise**3 / mass**2, mass, remedy,
            common=False,
        ),
    ]  # fmt: skip
    spread = achieved.get("mass_kda")
    if (
        spread is not None
        and not scaled
        and spread.significance > _CLEAR_SIGMAS
        and spread.over_crb > 1
    ):
        excess = noise * math.sqrt(spread.over_crb**2 - 1)
        remedy = 'steadier light or stage; fit.sigma = "measured" puts it into sigma'
        budget.append(
            _entry("noise beyond photons", "measured", excess, mass, remedy, common=False)
        )
    common = [
        _entry(
            source.name, source.kind, errors["mass_kda"][rows.index.to_numpy()], mass,
            source.remedy, dof=source.dof,
        )
        for source, errors in found
        if "mass_kda" in errors
    ]  # fmt: skip
    if unknown is not None:
        name, remedy = unknown
        common.append(
            {
                "name": name, "kind": "assumed", "common": True,
                "sigma_mass_kda": None, "sigma_rel": None, "dof": None,
                "remedy": remedy,
            }
        )  # fmt: skip
    return budget + sorted(common, key=lambda one: -(one["sigma_mass_kda"] or math.inf))


def _entry(
    name: str,
    kind: str,
    sigma: FloatArray,
    mass: FloatArray,
    remedy: str,
    *,
    common: bool = True,
    dof: float | None = None,
) -> dict[str, Any]:
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.abs(sigma) / mass
    return {
        "name": name,
        "kind": kind,
        "common": common,
        "sigma_mass_kda": _median(np.abs(sigma)),
        "sigma_rel": _median(relative),
        "dof": dof,
        "remedy": remedy,
    }


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def explained_kda(budget: Sequence[Mapping[str, Any]]) -> float:
    """Width of a species that the budget explains beyond σ: errors that differ between rows."""
    own = [one for one in budget if not one["common"] and one["name"] != "photon noise"]
    return math.sqrt(sum((one["sigma_mass_kda"] or 0.0) ** 2 for one in own))


def width_warning(across: Sequence[Mapping[str, Any]], *, calibrated: bool) -> str:
    """Say which species are wider than the budget explains."""
    wide = []
    for one in across:
        low, width = one["width_low"], one["width_kda"]
        if low is None or width is None or not math.isfinite(low) or not one["mass_kda"]:
            continue  # nothing is a share of no mass
        sigma = width / math.sqrt(max(one["spread_over_sigma"] ** 2 - 1, 1e-12))
        if low > max(one["explained_kda"], _LEAST_WIDTH * sigma):
            wide.append((one, width, low))
    if not wide:
        return ""
    one, width, low = max(wide, key=lambda each: each[1] / each[0]["mass_kda"])
    where = f"at {one['mass_kda']:.4g} kDa" if calibrated else "of contrast"
    share, least, known = (100 * v / one["mass_kda"] for v in (width, low, one["explained_kda"]))
    return (
        f"the species {where} is wider than the budget explains: {share:.2g} % beyond sigma (at "
        f"least {least:.2g} %), where the budget has {known:.2g} %: its particles differ, in "
        "height, focus over the field, shape or mass, or the light does; no error of a single row "
        "has that"
    )
