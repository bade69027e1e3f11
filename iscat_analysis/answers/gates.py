"""What one reads off a histogram by hand: which events count, bars, a kernel density, gates.

A gate is a range of masses.  Its count has a Poisson interval (Garwood, Biometrika 28, 437, 1936)
and its fraction of all events a binomial one (Clopper and Pearson, Biometrika 26, 404, 1934).
Nothing is corrected for what was missed; `find_species` does that.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.checks import choice_in, number_in
from iscat_analysis.records import BoolArray, FloatArray, is_event
from iscat_analysis.species.describe import Branch, poisson_interval, round_width
from iscat_analysis.species.tables import EventTable, event_table

_REACH = 0.99  # quantile of the masses up to which is drawn
_POINTS = 400


@dataclass(frozen=True)
class Gate:
    """The events between two masses [kDa]; intervals are 95 %, of one event widths are NaN."""

    low_kda: float
    high_kda: float
    count: int
    count_low: float
    count_high: float
    mean_kda: float
    mean_se: float
    width_kda: float
    fraction: float
    fraction_low: float
    fraction_high: float


@dataclass(frozen=True, eq=False)
class MassHistogram:
    """Bars and kernel density; `edges` has one number more than `counts`.

    Shapes: `edges` (n + 1,), `counts` (n,), `mass_kda` and `density` (m,), in events per bar.
    """

    edges: FloatArray
    counts: FloatArray
    mass_kda: FloatArray
    density: FloatArray
    bin_kda: float
    bandwidth_kda: float


def counted_rows(
    table: pd.DataFrame,
    *,
    branch: Branch = "magnitude",
    ok_only: bool = True,
    rejected: Collection[int] = (),
) -> BoolArray:
    """Tell which rows of ``fits.csv`` count: of one branch, ok or flagged too, and not rejected."""
    choice_in("`branch`", branch, ("magnitude", "landing", "leaving"))
    mass = table["mass_kda"].to_numpy(float)
    counts = np.isfinite(mass) & is_event(table)
    if branch != "magnitude":
        counts &= (mass > 0) == (branch == "landing")
    if ok_only:
        counts &= (table["status"] == "ok").to_numpy(bool)
    if rejected:
        counts &= ~table["event"].isin(list(rejected)).to_numpy(bool)
    return np.asarray(counts)


def counted_events(folder: Path, rows: pd.DataFrame) -> EventTable:
    """Take rows of the table of a result as events of species.

    What was missed and what the calibration leaves open are of the whole result, as `find_species`
    takes them from its folder, whichever of its events count.
    """
    whole, counted = event_table(folder), event_table(rows, name=folder.name)
    kept = ("efficiency", "edge_kda", "scale_error", "window_frames")
    return replace(counted, **{name: getattr(whole, name) for name in kept})


def usual_bin(table: pd.DataFrame) -> float:
    """Choose the width of a bar [kDa] by the errors of the events: 1, 2 or 5 times a power of ten.

    As Scott's rule has it for three peaks no wider than these errors.
    """
    sigma = table["sigma_mass_kda"].to_numpy(float)
    mass = np.abs(table["mass_kda"].to_numpy(float))
    mass, sigma = mass[np.isfinite(mass)], sigma[np.isfinite(sigma)]
    if not mass.size:
        return 10.0
    spread = float(np.median(sigma)) if sigma.size else float(np.median(mass)) / 10
    wanted = 3.49 * spread * max(mass.size / 3, 1.0) ** (-1 / 3)
    # bars of a histogram whose width nobody chose
    wanted = max(wanted, float(np.quantile(mass, _REACH)) / 240, 1e-3)
    return round_width(wanted)


def mass_histogram(
    masses_kda: FloatArray, *, bin_kda: float, bandwidth_kda: float | None = None
) -> MassHistogram:
    """Count magnitudes of masses in bars, and smooth them with a normal kernel as wide.

    Shapes: `masses_kda` (n,).
    """
    mass = np.abs(np.asarray(masses_kda, dtype=np.float64))
    width = number_in("`bin_kda`", bin_kda, above=0.0)
    kernel = (
        width if bandwidth_kda is None else number_in("`bandwidth_kda`", bandwidth_kda, above=0.0)
    )
    reach = 1.1 * float(np.quantile(mass, _REACH)) if mass.size else width
    bars = math.ceil(reach / width) + 1
    # bars of a histogram at most
    if bars > 2000:
        raise ConfigError(
            f"`bin_kda` = {width:g} makes {bars} bars up to {reach:.4g} kDa: give a wider one"
        )
    edges: FloatArray = width * np.arange(bars + 1, dtype=np.float64)
    at = np.linspace(0.0, float(edges[-1]), _POINTS)
    z = (at[:, np.newaxis] - mass) / kernel
    density = np.exp(-0.5 * z**2).sum(axis=1) * width / (math.sqrt(2 * math.pi) * kernel)
    counts = np.histogram(mass, edges)[0].astype(np.float64)
    return MassHistogram(edges, counts, at, density, float(width), float(kernel))


def gate(masses_kda: FloatArray, low_kda: float, high_kda: float) -> Gate:
    """Count the events between two masses, of all that are given.

    Shapes: `masses_kda` (n,).
    """
    low, high = sorted((number_in("`low_kda`", low_kda), number_in("`high_kda`", high_kda)))
    mass = np.abs(np.asarray(masses_kda, dtype=np.float64))
    inside = mass[(mass >= low) & (mass < high)]
    k, n = inside.size, mass.size
    width = float(np.std(inside, ddof=1)) if k > 1 else math.nan
    least, most = poisson_interval(k)
    share = binomtest(k, n).proportion_ci() if n else (math.nan, math.nan)
    return Gate(
        low_kda=float(low),
        high_kda=float(high),
        count=k,
        count_low=float(least),
        count_high=float(most),
        mean_kda=float(inside.mean()) if k else math.nan,
        mean_se=width / math.sqrt(k) if k > 1 else math.nan,
        width_kda=width,
        fraction=k / n if n else math.nan,
        fraction_low=float(share[0]),
        fraction_high=float(share[1]),
    )


def gate_rows(gates: Collection[Gate]) -> list[dict[str, Any]]:
    """Lay gates out as rows of a table."""
    return [dict(vars(each)) for each in gates]
