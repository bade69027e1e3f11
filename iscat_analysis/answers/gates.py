"""What one reads off a histogram by hand: which events count, bars, a kernel density, gates.

A gate is a range of masses, or of what a movie has in place of masses.  Its count has a Poisson
interval (Garwood, Biometrika 28, 437, 1936), its fraction of all events a binomial one (Clopper
and Pearson, Biometrika 26, 404, 1934).
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
from scipy.stats import binomtest, norm

from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.checks import choice_in, number_in
from iscat_analysis.records import BoolArray, FloatArray, is_event
from iscat_analysis.species.describe import Branch, poisson_interval
from iscat_analysis.species.tables import EventTable, event_table

_REACH = 0.99  # quantile of the masses up to which is drawn
_POINTS = 400


@dataclass(frozen=True)
class Gate:
    """The events between two values; intervals are 95 %, of one event widths are NaN."""

    low: float
    high: float
    count: int
    count_low: float
    count_high: float
    mean: float
    mean_se: float
    width: float
    fraction: float
    fraction_low: float
    fraction_high: float


@dataclass(frozen=True, eq=False)
class MassHistogram:
    """Bars and kernel density; `edges` has one number more than `counts`.

    Shapes: `edges` (n + 1,), `counts` (n,), `at` and `density` (m,), in events per bar.
    """

    edges: FloatArray
    counts: FloatArray
    at: FloatArray
    density: FloatArray
    bar: float


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
    whole, counted = event_table(folder, any_scale=True), event_table(rows, name=folder.name)
    kept = ("efficiency", "edge_kda", "scale_error", "window_frames")
    return replace(counted, **{name: getattr(whole, name) for name in kept})


def mass_histogram(values: FloatArray, *, bar: float, kernel: float | None = None) -> MassHistogram:
    """Count masses, or what stands for them, in bars, and smooth them with a normal kernel as wide.

    Shapes: `values` (n,).
    """
    width = number_in("width of a bar", bar, above=0.0)
    wide = width if kernel is None else number_in("width of the kernel", kernel, above=0.0)
    reach = 1.1 * float(np.quantile(values, _REACH)) if values.size else width
    first = min(math.floor(float(values.min(initial=0.0)) / width), 0)
    bars = math.ceil(reach / width) + 1 - first
    if bars > 2000:  # bars of a histogram at most
        raise ConfigError(f"{width:g} makes {bars} bars up to {reach:.4g}: give a wider one")
    edges: FloatArray = width * np.arange(first, first + bars + 1, dtype=np.float64)
    at = np.linspace(float(edges[0]), float(edges[-1]), _POINTS)
    density = norm.pdf(at[:, np.newaxis], values, wide).sum(axis=1) * width
    counts = np.histogram(values, edges)[0].astype(np.float64)
    return MassHistogram(edges, counts, at, density, float(width))


def gate(values: FloatArray, low: float, high: float) -> Gate:
    """Count the events between two values, of all that are given.

    Shapes: `values` (n,).
    """
    low, high = sorted((number_in("`low`", low), number_in("`high`", high)))
    inside = values[(values >= low) & (values < high)]
    k, n = inside.size, values.size
    width = float(np.std(inside, ddof=1)) if k > 1 else math.nan
    least, most = poisson_interval(k)
    share = binomtest(k, n).proportion_ci() if n else (math.nan, math.nan)
    return Gate(
        low=float(low),
        high=float(high),
        count=k,
        count_low=float(least),
        count_high=float(most),
        mean=float(inside.mean()) if k else math.nan,
        mean_se=width / math.sqrt(k) if k > 1 else math.nan,
        width=width,
        fraction=k / n if n else math.nan,
        fraction_low=float(share[0]),
        fraction_high=float(share[1]),
    )


def gate_rows(gates: Collection[Gate]) -> list[dict[str, Any]]:
    """Lay gates out as rows of a table."""
    return [vars(each) for each in gates]
