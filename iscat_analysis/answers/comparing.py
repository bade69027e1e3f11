"""Comparison of many samples: which ones differ, in masses or fractions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pandas as pd

from iscat_analysis.answers.species import choice_of
from iscat_analysis.calibration.line import Line
from iscat_analysis.errors import DataError
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.records import FloatArray, Progress, silent
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.report.species import comparison_figure
from iscat_analysis.report.style import publish
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.schemas import jsonable, to_json
from iscat_analysis.species import LEAST_EVENTS, Comparison
from iscat_analysis.species.comparison import compare
from iscat_analysis.species.events import Events
from iscat_analysis.species.tables import EventTable, event_table, sentences
from iscat_analysis.text import in_table
from iscat_analysis.threads import processors, threads
from iscat_analysis.units import count

COMPARISON_FILES = frozenset({"comparison.csv", "comparison.json", "figures"})
"""Everything `compare_tables` may leave in its folder."""

Table: TypeAlias = str | Path | pd.DataFrame | EventTable
"""What may be compared."""

_MOST_WORKERS = 1024
_MOST_POOLED = 20_000  # events that choose the species
_DRAWN = 8  # samples in the figure's left panel
_BINS = 120
_REACH = 0.98  # quantile of the masses that is drawn
_MANY = 5  # comparisons that should be told of chance


def compare_samples(
    first: Table,
    other: Table,
    *,
    k: int | None = None,
    masses_kda: Sequence[float] | None = None,
    ladder: float | Literal["auto"] | None = None,
    steps: Sequence[int] = (),
    background: bool = True,
    sigma_kda: float | None = None,
    limit_kda: float | None = None,
    limit_sigma_kda: float | None = None,
    above_kda: float | None = None,
    calibration: Line | None = None,
) -> Comparison:
    """Test whether two samples are one, and measure by how much they differ.

    Parameters
    ----------
    first, other : str, Path, pandas.DataFrame or EventTable
        Two tables of events, as for `find_species`.
    k : int, optional
        So many species; by default as many as BIC likes.
    masses_kda : sequence of float, optional
        Species of about these masses [kDa].
    ladder : float or "auto", optional
        Oligomers of a monomer of about this mass [kDa], or of one to be found.
    steps : sequence of int
        Which oligomers; by default they are found.
    background : bool
        Whether something else may be there, broad and faint.
    sigma_kda, limit_kda, limit_sigma_kda, above_kda : float, optional
        What is known of errors and of what was missed, as for `find_species` [kDa].
    calibration : str, Path, Calibration or MassCalibration, optional
        A mass line, as for `find_species`.

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
    return compare_tables(
        [first, other], k=k, masses_kda=masses_kda, ladder=ladder, steps=steps,
        background=background, sigma_kda=sigma_kda, limit_kda=limit_kda,
        limit_sigma_kda=limit_sigma_kda, above_kda=above_kda, calibration=calibration,
    )[0]  # fmt: skip


def compare_tables(
    tables: Sequence[Table],
    *,
    k: int | None = None,
    masses_kda: Sequence[float] | None = None,
    ladder: float | Literal["auto"] | None = None,
    steps: Sequence[int] = (),
    background: bool = True,
    sigma_kda: float | None = None,
    limit_kda: float | None = None,
    limit_sigma_kda: float | None = None,
    above_kda: float | None = None,
    calibration: Line | None = None,
    workers: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> list[Comparison]:
    """Compare many samples with the first of them.

    Parameters
    ----------
    tables : sequence of str, Path, pandas.DataFrame or EventTable
        Two or more, the first is what the others are compared with.
    k : int, optional
        So many species; by default as many as BIC likes.
    masses_kda : sequence of float, optional
        Species of about these masses [kDa].
    ladder : float or "auto", optional
        Oligomers of a monomer of about this mass [kDa], or of one to be found.
    steps : sequence of int
        Which oligomers; by default they are found.
    background : bool
        Whether something else may be there, broad and faint.
    sigma_kda, limit_kda, limit_sigma_kda, above_kda : float, optional
        As for `find_species` [kDa].
    calibration : str, Path, Calibration or MassCalibration, optional
        A mass line, as ``iscat calibrate mass`` writes it: masses are those of the contrasts, in
        place of masses that a table has.
    workers : int, optional
        Threads; default as many as there are processors.
    out : str or Path, optional
        Folder for comparison.csv, comparison.json and a figure.
    overwrite : bool
        Replace an earlier result in `out`.
    progress : Progress
        Called with the stage and the steps done and in all.
    notify : callable, optional
        Given each note, a sentence.

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
    choice = choice_of(
        k, masses_kda, ladder, steps=steps, offset=False, hold=False, widths="free",
        background=background,
    )  # fmt: skip
    folder = None if out is None else path_in("`out`", out)
    if folder is not None:
        check_output(folder, overwrite, known=COMPARISON_FILES)
    if workers is not None:
        workers = int(number_in("`workers`", workers, least=1, most=_MOST_WORKERS, whole=True))
    if not isinstance(tables, (list, tuple)) or len(tables) < 2:
        raise DataError("a comparison needs two tables of events, or more")
    read: list[EventTable] = []
    for number, table in enumerate(tables):
        one = table
        if not isinstance(one, EventTable):
            one = event_table(
                one, name=f"table {number + 1}" if isinstance(one, pd.DataFrame) else None,
                sigma_kda=sigma_kda, limit_kda=limit_kda, limit_sigma_kda=limit_sigma_kda,
                above_kda=above_kda, calibration=calibration,
            )  # fmt: skip
        if one.mass_kda.size < LEAST_EVENTS:
            raise DataError(
                f"{one.name}: holds {count(one.mass_kda.size, 'event')}, too few to compare; "
                f"{LEAST_EVENTS} are needed"
            )
        read.append(one)
        progress("read", number + 1, len(tables))
    chosen = choice.choose(_pooled(read))
    done = 0

    def pair(other: EventTable) -> Comparison:
        nonlocal done
        found = compare(read[0].events, other.events, chosen.best)
        done += 1
        progress("compare", done, len(read) - 1)
        return found

    with threads(workers or processors()) as pool:
        found = list(pool.map(pair, read[1:]))
    notes = _notes(read, found)
    if notify is not None:
        for note in notes:
            notify(note)
    if folder is not None:
        contents = comparison_document(read[0].name, [t.name for t in read[1:]], found, notes)
        with atomic_folder(folder, overwrite, known=COMPARISON_FILES) as building:
            in_table(comparison_rows(contents)).to_csv(
                building / "comparison.csv", index=False, float_format=f"%.{CSV_DIGITS}g"
            )
            text = to_json("species_comparison", contents)
            (building / "comparison.json").write_text(text + "\n", "utf-8")
            (building / "figures").mkdir()
            figure = comparison_figure(jsonable(contents), _histograms(read))
            publish(figure, building / "figures")
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
    return pd.DataFrame(
        [
            {
                "source": one["source"],
                **{
                    f"p_{key}": one[key]["p_value"]
                    for key in ("same", "same_masses", "same_fractions")
                },
                **row,
            }
            for one in contents["comparisons"]
            for row in one["species"]
        ]
    )


def _pooled(tables: Sequence[EventTable]) -> Events:
    """Events of all tables, thinned evenly where they are many."""
    most = max(_MOST_POOLED // len(tables), LEAST_EVENTS)
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
    for table in tables[:_DRAWN]:
        counts: FloatArray = np.histogram(np.abs(table.mass_kda), edges)[0] / table.mass_kda.size
        drawn.append({"source": table.name, "edges": edges, "share": counts})
    return drawn


def _notes(tables: Sequence[EventTable], found: Sequence[Comparison]) -> list[str]:
    """List what the tests assume."""
    notes = sentences(note for table in tables for note in table.remarks)
    if any(table.scale_error is not None for table in tables):
        notes.append(
            "errors of shifts do not include that of the mass scale: samples with different "
            "calibrations may differ by it (systematic_mass_kda of the tables)"
        )
    if len(found) > _MANY:
        notes.append(
            f"{len(found)} comparisons: by chance alone some {0.05 * len(found):.2g} have p < "
            f"0.05; below {0.05 / len(found):.2g} a difference is significant among them all"
        )
    return notes
