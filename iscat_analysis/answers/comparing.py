"""Comparison of many samples: which ones differ, in masses or fractions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias, Unpack

import numpy as np
import pandas as pd

from iscat_analysis.answers.output import Notify, folder_for, tell
from iscat_analysis.answers.species import choice_of
from iscat_analysis.errors import DataError
from iscat_analysis.findings.tables import MANY_COMPARISONS, SCALE_NOT_IN_SHIFTS
from iscat_analysis.inference.checks import number_in
from iscat_analysis.options import (
    CommonSpecies,
    EventOptions,
    SpeciesOptions,
    defaults,
    only,
    takes,
)
from iscat_analysis.records import FloatArray, Progress, silent
from iscat_analysis.report.species import comparison_page
from iscat_analysis.schemas import jsonable
from iscat_analysis.species import LEAST_EVENTS, Comparison
from iscat_analysis.species.comparison import compare
from iscat_analysis.species.events import Events
from iscat_analysis.species.tables import EventTable, event_table, sentences
from iscat_analysis.text import in_table
from iscat_analysis.threads import processors, threads
from iscat_analysis.units import count

Table: TypeAlias = str | Path | pd.DataFrame | EventTable
"""What may be compared."""

_BINS = 120
_REACH = 0.98  # quantile of the masses that is drawn
_CHANCE = 0.05  # p-value that is called significant
_MANY = 5  # comparisons that should be told of chance


@takes(CommonSpecies)
def compare_samples(first: Table, other: Table, **options: Unpack[CommonSpecies]) -> Comparison:
    """Test whether two samples are one, and measure by how much they differ.

    Parameters
    ----------
    first, other : str, Path, pandas.DataFrame or EventTable
        Two tables of events, as for `find_species`.
    **options

    Returns
    -------
    Comparison
        p-values, and per species the shift [kDa, %] and the difference of fractions, the second
        sample's less the first's, with 95 % intervals.  Which species there are is found in both
        together; masses and widths are free then.

    Raises
    ------
    ConfigError
        Options are impossible, or exclude each other.
    DataError
        A table cannot be read or holds too few events.

    Examples
    --------
    >>> import iscat_analysis as ia, numpy as np, pandas as pd
    >>> random = np.random.default_rng(1)
    >>> def sample(mass, number):
    ...     return pd.DataFrame({"mass_kda": random.normal(mass, 8, number), "sigma_mass_kda": 8.0})
    >>> found = ia.compare_samples(sample(100, 400), sample(110, 300), k=1)
    >>> bool(found.same_masses.p_value < 1e-6), bool(8 < found.species["shift_kda"][0] < 12)
    (True, True)
    """
    return compare_tables([first, other], **options)[0]


@takes(CommonSpecies)
def compare_tables(
    tables: Sequence[Table],
    *,
    workers: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Notify | None = None,
    **options: Unpack[CommonSpecies],
) -> list[Comparison]:
    """Compare many samples with the first of them.

    Parameters
    ----------
    tables : sequence of str, Path, pandas.DataFrame or EventTable
        Two or more, the first is what the others are compared with.
    workers : int, optional
        Threads; default as many as there are processors.
    out : str or Path, optional
        Folder for comparison.csv, comparison.json and a page, comparison.html.
    overwrite : bool
        Replace an earlier result in `out`.
    progress : Progress
        Called with the stage and the steps done and in all.
    notify : callable, optional
        Given each note, a sentence.
    **options

    Returns
    -------
    list of Comparison
        One for each table but the first.

    Raises
    ------
    ConfigError
        Options are impossible, or exclude each other.
    DataError
        A table cannot be read or holds too few events, or `out` may not be written.

    Notes
    -----
    The species are chosen once, on events of all tables, at most `_MOST_POOLED` evenly from each.
    """
    choice = choice_of(defaults(SpeciesOptions) | options)
    names = ("comparison.csv", "comparison.json", "comparison.html")
    folder = folder_for(out, *names, overwrite=overwrite)
    if workers is not None:
        workers = int(number_in("`workers`", workers, least=1, most=1024, whole=True))
    if not isinstance(tables, (list, tuple)) or len(tables) < 2:
        raise DataError("a comparison needs two tables of events, or more")
    read: list[EventTable] = []
    for number, table in enumerate(tables):
        name = f"table {number + 1}" if isinstance(table, pd.DataFrame) else None
        one = event_table(table, name=name, **only(EventOptions, options))
        if one.mass_kda.size < LEAST_EVENTS:
            raise DataError(
                f"{one.name}: holds {count(one.mass_kda.size, 'event')}, too few to compare; "
                f"{LEAST_EVENTS} are needed"
            )
        read.append(one)
        progress("read", number + 1, len(tables))
    chosen = choice.choose(_pooled(read))
    found = []
    with threads(workers or processors()) as pool:
        for pair in pool.map(lambda t: compare(read[0].events, t.events, chosen.best), read[1:]):
            found.append(pair)
            progress("compare", len(found), len(read) - 1)
    notes = _notes(read, found)
    tell(notes, notify)
    contents = comparison_document(read[0].name, [t.name for t in read[1:]], found, notes)
    files = {
        "comparison.csv": in_table(comparison_rows(contents)),
        "comparison.json": ("species_comparison", contents),
        "comparison.html": lambda: comparison_page(jsonable(contents), _histograms(read)),
    }
    folder.write(files)
    return found


def comparison_document(
    first: str, others: Sequence[str], found: Sequence[Comparison], notes: Sequence[str]
) -> dict[str, Any]:
    """Lay out comparisons as the document ``species_comparison``."""
    pairs = zip(others, found, strict=True)
    return {
        "source": first,
        "comparisons": [{"source": name, **one.to_dict()} for name, one in pairs],
        "notes": list(notes),
    }


def comparison_rows(contents: dict[str, Any]) -> pd.DataFrame:
    """Lay out a document ``species_comparison`` as a table."""
    rows = []
    for one in contents["comparisons"]:
        tests = ("same", "same_masses", "same_fractions")
        head = {"source": one["source"], **{f"p_{key}": one[key]["p_value"] for key in tests}}
        rows += [head | row for row in one["species"]]
    return pd.DataFrame(rows)


def _pooled(tables: Sequence[EventTable]) -> Events:
    """Events of all tables, thinned evenly where they are many."""
    # events that choose the species
    most = max(20_000 // len(tables), LEAST_EVENTS)
    taken = [
        (np.abs(table.mass_kda[::step]), table.sigma_kda[::step])
        for table in tables
        for step in [-(-table.mass_kda.size // most)]
    ]
    mass, sigma = (np.concatenate(parts) for parts in zip(*taken, strict=True))
    known = tables[0].edge_kda is None
    return Events(mass, sigma, tables[0].efficiency if known else None)


def _histograms(tables: Sequence[EventTable]) -> list[dict[str, Any]]:
    """Share of the events of each sample per bin, with common bins."""
    mass = np.concatenate([np.abs(table.mass_kda) for table in tables])
    edges = np.linspace(0, 1.2 * float(np.quantile(mass, _REACH)), _BINS + 1)
    drawn = []
    # samples in the figure's left panel
    for table in tables[:8]:
        counts: FloatArray = np.histogram(np.abs(table.mass_kda), edges)[0] / table.mass_kda.size
        drawn.append({"source": table.name, "edges": edges, "share": counts})
    return drawn


def _notes(tables: Sequence[EventTable], found: Sequence[Comparison]) -> list[str]:
    """List what the tests assume."""
    notes = sentences(finding for table in tables for finding in table.remarks)
    if any(table.scale_error is not None for table in tables):
        notes.append(SCALE_NOT_IN_SHIFTS().text)
    if (number := len(found)) > _MANY:
        chance = {"by_chance": _CHANCE * number, "significant": _CHANCE / number}
        notes.append(MANY_COMPARISONS({"number": number, **chance}).text)
    return notes
