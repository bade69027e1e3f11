"""Species of many movies that are the same, and whether they shift from sample to sample.

Movies of one sample differ by more than their counting errors: focus, temperature, the surface.
That scatter τ² is common to the samples and measured on their replicates (DerSimonian and Laird,
Control. Clin. Trials 7, 177, 1986), for each kind of species.  A sample's value is the mean of its
movies' weighted by 1/(se² + τ²).  The errors of a shift are widened by what the replicates still
scatter more than that, and judged by Student's t of their degrees of freedom where they scatter at
all (Hartung and Knapp, Stat. Med. 20, 3875, 2001).  Without replicates, τ cannot be known.

Equilibrium constants of a day: one for each condition that is a series of concentrations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from iscat_analysis.answers import binding as of
from iscat_analysis.day.gather import Found
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import existing
from iscat_analysis.records import FloatArray
from iscat_analysis.schemas.answers import DayKd
from iscat_analysis.species import LEAST_EVENTS
from iscat_analysis.species.equilibrium import Model
from iscat_analysis.species.maximum import TWO_SIDED_95
from iscat_analysis.species.tables import event_table

SHIFT_COLUMNS = (
    "kind", "kind_mass_kda", "sample", "condition", "reference", "quantity", "value", "se", "low",
    "high", "movies", "shift", "shift_se", "shift_low", "shift_high", "p_value", "p_holm",
    "scatter",
)  # fmt: skip
"""Columns of ``shifts.csv``: a species' mass [kDa] or share in a sample, the 95 % interval, its
difference from the reference sample with its interval, the chance of at least that difference where
there is none, alone and among all that are compared (Holm), and the scatter τ between replicates
that the errors hold; NaN where there are no replicates."""


def match_species(species: pd.DataFrame) -> pd.DataFrame:
    """Group species of one mass in different movies; a group is called a kind.

    The two nearest groups are merged repeatedly, as long as they are within a tenth or three
    standard errors and have no movie in common.
    """
    real = species[~species["outlier"]].sort_values(["mass_kda", "movie"])
    masses = real["mass_kda"].to_numpy(float)
    errors = np.nan_to_num(real["mass_se"].to_numpy(float))
    groups: list[_Group] = [
        _Group([i], {movie}, mass, se)
        for i, movie, mass, se in zip(real.index, real["movie"], masses, errors, strict=True)
    ]
    while len(groups) > 1:
        pairs = [(b.mass / a.mass, k) for k, (a, b) in enumerate(pairwise(groups)) if a.joins(b)]
        if not pairs:
            break
        _, k = min(pairs)
        groups[k : k + 2] = [groups[k].with_(groups[k + 1])]
    kind = pd.Series(0, index=species.index, dtype="int64")
    for number, group in enumerate(groups, 1):
        kind[group.rows] = number
    return species.assign(kind=kind)


@dataclass(frozen=True)
class _Group:
    """Species of different movies with one mass."""

    rows: list[int]
    movies: set[str]
    mass: float
    se: float

    def joins(self, other: _Group) -> bool:
        # relative distance, or standard errors, within which two masses are the same
        reach = max(0.1 * self.mass, 3.0 * math.hypot(self.se, other.se))
        return abs(other.mass - self.mass) <= reach and not self.movies & other.movies

    def with_(self, other: _Group) -> _Group:
        n, m = len(self.rows), len(other.rows)
        mass = (n * self.mass + m * other.mass) / (n + m)
        # A group is at most as wide as one of its members, so that it absorbs no neighbours.
        rows, movies = self.rows + other.rows, self.movies | other.movies
        return _Group(rows, movies, mass, min(self.se, other.se))


@dataclass(frozen=True)
class Means:
    """Means of samples; their errors include the scatter between movies."""

    value: FloatArray
    se: FloatArray
    movies: FloatArray
    scatter: float
    freedom: float


def sample_means(
    values: FloatArray, errors: FloatArray, sample: Sequence[int] | NDArray[np.int64]
) -> Means:
    """Average the movies of each sample.

    Shapes: `values, errors` (n,).
    """
    known = np.isfinite(values) & np.isfinite(errors) & (errors > 0)
    groups = np.asarray(sample)
    count = int(groups.max(initial=-1)) + 1
    y, s, g = values[known], errors[known], groups[known]
    number = np.bincount(g, minlength=count)
    freedom = int(y.size - np.count_nonzero(number))
    tau2 = 0.0
    if freedom > 0:
        w = 1 / s**2
        total = np.bincount(g, w, count)
        mean = np.bincount(g, w * y, count)[g] / total[g]
        excess = float(np.sum(w * (y - mean) ** 2)) - freedom
        filled = total > 0
        squares = np.bincount(g, w**2, count)
        spread = float(w.sum() - np.sum(squares[filled] / total[filled]))
        tau2 = max(0.0, excess / spread)
    w = 1 / (s**2 + tau2)
    total = np.bincount(g, w, count)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.bincount(g, w * y, count) / total
        variance = np.where(total > 0, 1 / total, math.nan)
    widening = 1.0
    if freedom > 0 and tau2 > 0:
        widening = max(1.0, float(np.sum(w * (y - mean[g]) ** 2)) / freedom)
    return Means(
        value=mean,
        se=np.sqrt(widening * variance),
        movies=number.astype(np.float64),
        scatter=math.sqrt(tau2) if freedom > 0 else math.nan,
        freedom=float(freedom) if tau2 > 0 else math.inf,
    )


def shifts(species: pd.DataFrame, reference: str) -> pd.DataFrame:
    """Compare every kind of species between the samples."""
    found: list[pd.DataFrame] = []
    width = (species["share_high"] - species["share_low"]) / (2 * TWO_SIDED_95)
    species = species.assign(share_se=width)
    for kind, rows in species[species["kind"] > 0].groupby("kind", sort=True):
        number, names = pd.factorize(rows["sample"])
        labels = {"kind": kind, "kind_mass_kda": float(rows["mass_kda"].mean()), "sample": names}
        labels["condition"] = rows.drop_duplicates("sample")["condition"].to_numpy()
        for quantity, error in (("mass_kda", "mass_se"), ("share", "share_se")):
            means = sample_means(
                rows[quantity].to_numpy(float), rows[error].to_numpy(float), number
            )
            values = {name: getattr(means, name) for name in ("value", "se", "movies", "scatter")}
            table = pd.DataFrame(labels | {"reference": reference, "quantity": quantity} | values)
            found.append(_compared(table, means, reference))
    if not found:
        return pd.DataFrame(columns=list(SHIFT_COLUMNS))
    joined = pd.concat(found, ignore_index=True)
    return joined.assign(p_holm=holm(joined["p_value"].to_numpy(float)))[list(SHIFT_COLUMNS)]


def _compared(table: pd.DataFrame, means: Means, reference: str) -> pd.DataFrame:
    finite = math.isfinite(means.freedom)
    reach = float(stdtrit(means.freedom, 0.975)) if finite else float(ndtri(0.975))
    table["low"], table["high"] = (means.value + sign * reach * means.se for sign in (-1, 1))
    at = table.index[(table["sample"] == reference) & table["value"].notna()]
    shift = error = np.full(len(table), math.nan)
    if len(at):
        others = (table["sample"] != reference).to_numpy()
        shift = np.where(others, means.value - means.value[at[0]], math.nan)
        error = np.where(others, np.hypot(means.se, means.se[at[0]]), math.nan)
    size = -np.abs(shift / error)
    tail = stdtr(means.freedom, size) if finite else ndtr(size)
    return table.assign(
        shift=shift,
        shift_se=error,
        shift_low=shift - reach * error,
        shift_high=shift + reach * error,
        p_value=np.minimum(1.0, 2 * tail),
    )


def holm(p_values: FloatArray) -> FloatArray:
    """Correct p-values for their number (Holm, Scand. J. Stat. 6, 65, 1979).

    Shapes: `p_values` (n,), result (n,).
    """
    corrected = np.full(p_values.shape, math.nan)
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known], kind="stable")]
    steps = p_values[order] * np.arange(order.size, 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(steps))
    return corrected


KD_COLUMNS = tuple(DayKd.model_fields)
"""Columns of ``kd.csv``: K_D with its 95 % interval [nM], the chance of such a gain by an inactive
part where there is none, the chance of at least such a distance from the equilibrium where it
holds, masses of the species, remarks, and why there is no K_D."""


@dataclass(frozen=True)
class Reaction:
    """The reaction whose K_D is fitted."""

    model: Model
    masses_kda: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Series:
    """The movies of one condition."""

    condition: str
    movies: int
    binding: of.Binding | None
    remarks: tuple[str, ...] = ()
    why: str = ""


def reaction_of(kd: Model | None, kd_masses_kda: Sequence[float] | None) -> Reaction | None:
    """Check the arguments of a K_D fit."""
    if kd is None:
        if kd_masses_kda is not None:
            raise ConfigError("`kd_masses_kda` is of K_D: give `kd`, dimer or ab, as well")
        return None
    of.check_reaction(kd, kd_masses_kda, names=("kd", "kd_masses_kda"))
    return Reaction(kd, None if kd_masses_kda is None else tuple(map(float, kd_masses_kda)))


def find_equilibria(found: Sequence[Found], reaction: Reaction) -> list[Series]:
    """Fit an equilibrium constant to each condition with samples of several concentrations."""
    columns = of.CONCENTRATIONS[reaction.model]
    conditions: dict[str, list[Found]] = {}
    for each in found:
        if each.movie.row.role == "sample" and each.summary and _totals(each, columns):
            conditions.setdefault(each.movie.row.condition, []).append(each)
    series = [
        _fit(condition, members, columns, reaction)
        for condition, members in conditions.items()
        if len({_totals(each, columns) for each in members}) > 1
    ]
    if series:
        return series
    wanted = " and ".join(columns)
    return [Series("", 0, None, why=f"no condition has analysed samples of several {wanted}")]


def kd_table(series: Sequence[Series], reaction: Reaction) -> pd.DataFrame:
    """Lay out ``kd.csv``."""
    rows = []
    for each in series:
        row = {
            "condition": each.condition,
            "model": reaction.model,
            "movies": each.movies,
            "remarks": "; ".join(each.remarks),
            "why": each.why,
        }
        if each.binding is not None:
            fit = each.binding.fit
            names = ("kd_nm", "kd_low", "kd_high", "inactive_p", "p_value")
            row |= {name: getattr(fit, name) for name in names}
            row["masses_kda"] = " ".join(f"{mass:.4g}" for mass in fit.masses_kda)
        rows.append(row)
    return pd.DataFrame(rows, columns=list(KD_COLUMNS))


def kd_name(condition: str) -> str:
    """Name an equilibrium constant."""
    return f"K_D of {condition}" if condition else "K_D"


def _totals(each: Found, columns: Sequence[str]) -> tuple[str, ...]:
    """Concentrations of a movie; empty where the table lacks one."""
    row = each.movie.row
    given = {"concentration_nm": row.concentration_nm, **row.further}
    values = tuple(str(given.get(name, "")).strip() for name in columns)
    return values if all(value not in ("", "None", "nan") for value in values) else ()


def _fit(
    condition: str, members: Sequence[Found], columns: Sequence[str], reaction: Reaction
) -> Series:
    """Fit all movies of a condition that have enough events."""
    tables = [event_table(each.folder, name=each.movie.name, any_scale=True) for each in members]
    kept, few = of.with_events(tables)
    remarks = tuple(finding.text for finding in existing([few]))
    used = [each for each, keep in zip(members, kept, strict=True) if keep]
    if not used:
        return Series(condition, 0, None, why=f"no movie has {LEAST_EVENTS} events")
    rows = [
        {"path": each.movie.name, **dict(zip(columns, _totals(each, columns), strict=True))}
        for each in used
    ]
    try:
        binding = of.fit_kd(
            pd.DataFrame(rows),
            model=reaction.model,
            masses_kda=reaction.masses_kda,
            tables=[table for table, keep in zip(tables, kept, strict=True) if keep],
        )
    except DataError as error:
        return Series(condition, len(used), None, remarks, str(error))
    return Series(condition, len(used), binding, (*remarks, *binding.notes))
