"""Equilibrium constants of a day: one for each condition that is a series of concentrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from iscat_analysis.answers.binding import (
    CONCENTRATIONS,
    Binding,
    check_reaction,
    fit_kd,
    with_events,
)
from iscat_analysis.day.gather import Found
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.species import LEAST_EVENTS
from iscat_analysis.species.mass_action import Model
from iscat_analysis.species.tables import event_table

KD_COLUMNS = (
    "condition", "model", "movies", "kd_nm", "kd_low", "kd_high", "inactive_p", "p_value",
    "masses_kda", "remarks", "why",
)  # fmt: skip
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
    binding: Binding | None
    remarks: tuple[str, ...] = ()
    why: str = ""


def reaction_of(kd: Model | None, kd_masses_kda: Sequence[float] | None) -> Reaction | None:
    """Check the arguments of a K_D fit."""
    if kd is None:
        if kd_masses_kda is not None:
            raise ConfigError("`kd_masses_kda` is of K_D: give `kd`, dimer or ab, as well")
        return None
    check_reaction(kd, kd_masses_kda, names=("kd", "kd_masses_kda"))
    return Reaction(kd, None if kd_masses_kda is None else tuple(map(float, kd_masses_kda)))


def find_equilibria(found: Sequence[Found], reaction: Reaction) -> list[Series]:
    """Fit an equilibrium constant to each condition with samples of several concentrations."""
    columns = CONCENTRATIONS[reaction.model]
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
    tables = [event_table(each.folder, name=each.movie.name) for each in members]
    kept, remarks = with_events(tables)
    used = [each for each, keep in zip(members, kept, strict=True) if keep]
    if not used:
        return Series(condition, 0, None, why=f"no movie has {LEAST_EVENTS} events")
    rows = [
        {"path": each.movie.name, **dict(zip(columns, _totals(each, columns), strict=True))}
        for each in used
    ]
    try:
        binding = fit_kd(
            pd.DataFrame(rows),
            model=reaction.model,
            masses_kda=reaction.masses_kda,
            tables=[table for table, keep in zip(tables, kept, strict=True) if keep],
        )
    except DataError as error:
        return Series(condition, len(used), None, remarks, str(error))
    return Series(condition, len(used), binding, (*remarks, *binding.notes))
