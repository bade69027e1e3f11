"""Rows of the tables: how they are made, judged and counted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import bdtrc

from iscat_analysis.records.columns import EVENTS
from iscat_analysis.records.steps import NO_EVENT, SEVERITY, BoolArray, Status, TrackStatus
from iscat_analysis.units import count, sphere_diameter_nm

POOR_P = 0.01
"""A p-value that one good fit in 100 has."""


def make_rows(
    lines: pd.DataFrame | Mapping[str, Any] | Iterable[Mapping[str, Any]],
    columns: Mapping[str, Any] = MappingProxyType({}),
) -> pd.DataFrame:
    """Make a table of rows, with the order and the types of the registry of columns.

    Values that a row lacks stay empty, whole numbers included.  The table has an optional column if
    a row has it, and the number of the event once it is given.  `columns` are added to the rows.
    """
    whole = isinstance(lines, (pd.DataFrame, Mapping))
    table = pd.DataFrame(lines if whole else list(lines)).reset_index(drop=True)
    table = table.assign(**dict(columns))
    unknown = set(table) - {column.name for column in EVENTS}
    if unknown:
        raise ValueError(f"no column of fits.csv: {', '.join(sorted(unknown))}; see `EVENTS`")
    kept = [
        column
        for column in EVENTS
        if column.name in table or not (column.optional or column.name == "event")
    ]
    types = {column.name: column.dtype for column in kept}
    table = table.reindex(columns=list(types))
    empty = table.columns[table.isna().any()]
    return table.astype(types | {name: "Int64" for name in empty if types[name] == "int64"})


def with_diameters(table: pd.DataFrame, density_kg_m3: float) -> pd.DataFrame:
    """Add the diameters of spheres, and their errors and bounds, to rows with their masses."""
    mass = table["mass_kda"].to_numpy(dtype=float)
    diameter = sphere_diameter_nm(1.0, density_kg_m3) * np.cbrt(np.abs(mass))
    slope = diameter / (3 * np.abs(mass))
    columns = {"diameter_nm": diameter} | {
        f"{kind}_diameter_nm": slope * table[f"{kind}_mass_kda"]
        for kind in ("sigma", "crb", "qcrb", "systematic")
        if f"{kind}_mass_kda" in table
    }
    return make_rows(table, columns)


def is_event(table: pd.DataFrame) -> BoolArray:
    """Tell which rows are events, and so are counted: not the side lobes of others, nor noise.

    Shapes: result (rows,).
    """
    return np.asarray(~table["status"].isin([*map(str, NO_EVENT)]), dtype=bool)


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Leave out rows that are no events."""
    return table[is_event(table)]


class Tally(NamedTuple):
    """Numbers of events, or tracks, by status, the commonest first, and of rows that are none."""

    number: int
    status: dict[str, int]
    left_out: dict[str, int]

    @property
    def ok(self) -> int:
        """How many are ok."""
        return self.status.get(Status.OK.value, 0)

    @property
    def flagged(self) -> int:
        """How many are not."""
        return self.number - self.ok

    def text(self, noun: str = "event") -> str:
        """Say all of it."""
        by_status = ", ".join(f"{n} {status}" for status, n in self.status.items())
        text = count(self.number, noun) + (f": {by_status}" if by_status else "")
        if self.left_out:
            rows = ", ".join(f"{n} {status}" for status, n in self.left_out.items())
            text += f"; further rows, which are no {noun}s: {rows}"
        return text


def tally(table: pd.DataFrame) -> Tally:
    """Count the events, or tracks, of a table: every total comes from here."""
    events = is_event(table)
    status = table["status"].astype(str)
    by_status, left_out = (
        {str(name): int(n) for name, n in status[part].value_counts().items()}
        for part in (events, ~events)
    )
    return Tally(int(events.sum()), by_status, left_out)


def is_rejected(table: pd.DataFrame) -> bool:
    """Tell whether more fits are poor than a right model of the image leaves to chance.

    Notes
    -----
    What disturbs a particle that moves, as one outside of the field does, disturbs it in many
    frames, and says nothing of the microscope.  An error of the microscope is in every track: of
    tracks those with the smallest shares of poor fits, which have half of all fits, are judged.
    """
    table = counted(table)
    table = table[np.isfinite(table["p_value"].to_numpy(float))]
    poor = table["p_value"] < POOR_P
    fits, misses = len(table), int(poor.sum())
    if "track" in table:
        tracks = poor.groupby(table["track"], dropna=False).agg(["size", "sum", "mean"])
        tracks = tracks.sort_values("mean")
        before = tracks["size"].cumsum() - tracks["size"]
        fits, misses = (int(n) for n in tracks.loc[before < fits / 2, ["size", "sum"]].sum())
    # The chance that so many fits are poor, below which the model is rejected
    return bool(fits) and float(bdtrc(misses - 1, fits, POOR_P)) <= 1e-4


def species_rows(table: pd.DataFrame) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Select the rows that species are found among, and say so where they are not the ok ones.

    Where the model is rejected a poor fit is no other kind of row: the bright particles are poor,
    all the same.
    """
    judged = {Status.OK.value}
    if "p_value" in table and is_rejected(table):
        judged.add(Status.POOR_FIT.value)
    used = table[table["status"].isin(judged)]
    if (used["status"] == Status.OK.value).all():
        return used, ()
    return used, ("poor fits are counted too, because the model is rejected",)


def has_only(table: pd.DataFrame, known: frozenset[str]) -> BoolArray:
    """Tell which rows have no status and no flag but these.

    Shapes: result (rows,).
    """
    marks = zip(table["status"], table["flags"].fillna(""), strict=True)
    return np.array(
        [{status, *str(flags).split(";")} - {""} <= known for status, flags in marks], dtype=bool
    )


def has_flag(table: pd.DataFrame, flag: Status | TrackStatus) -> BoolArray:
    """Tell which rows have a flag, whatever others they have.

    Shapes: result (rows,).
    """
    return np.array([flag.value in str(one).split(";") for one in table["flags"]], dtype=bool)


def flagged(
    table: pd.DataFrame, flag: Status | TrackStatus, which: BoolArray | None = None
) -> pd.DataFrame:
    """Add a flag to rows of events or tracks, to all or to some; the status is the worst one.

    Shapes: `which` (rows,).
    """
    order = [*map(str, SEVERITY if isinstance(flag, Status) else TrackStatus)]
    chosen = np.ones(len(table), dtype=bool) if which is None else which
    statuses, flags = table["status"].astype(object), table["flags"].astype(object)
    for row in np.flatnonzero(chosen).tolist():
        known = {str(flag), *filter(None, str(flags.iat[row] or "").split(";"))}
        found = sorted(known, key=lambda name: order.index(name) if name in order else len(order))
        statuses.iat[row], flags.iat[row] = found[0], ";".join(found)
    return table.assign(status=statuses, flags=flags)
