"""Answers from tables of events: which species there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from iscat_analysis.answers.kinetics import Kinetics
from iscat_analysis.calibration.line import Line
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import choice_in, number_in, path_in, shown, truth_in
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.report.species import species_figure
from iscat_analysis.report.style import drawn, publish
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.schemas import jsonable, to_json
from iscat_analysis.species import LEAST_EVENTS, Distribution, describe
from iscat_analysis.species.choices import (
    MOST_RUNGS,
    Begun,
    Choice,
    Given,
    Ladder,
    Number,
    Searched,
    Widths,
)
from iscat_analysis.species.describe import Branch
from iscat_analysis.species.tables import EventTable, event_table, mass_in, refuse_far, sentences
from iscat_analysis.units import count

SPECIES_FILES = frozenset({"species.csv", "species.json", "figures"})
"""Everything `find_species` may leave in its folder."""

_EVENTS_EACH = 5  # of a species
_MOST_SPECIES = 1000
_MOST_DRAWS = 1_000_000


def find_species(
    events: str | Path | pd.DataFrame | EventTable,
    *,
    k: int | None = None,
    masses_kda: Sequence[float] | None = None,
    start_kda: Sequence[float] | None = None,
    ladder: float | Literal["auto"] | None = None,
    steps: Sequence[int] = (),
    offset: bool = False,
    hold: bool = False,
    widths: Widths = "free",
    background: bool = True,
    branch: Branch = "magnitude",
    sigma_kda: float | None = None,
    limit_kda: float | None = None,
    limit_sigma_kda: float | None = None,
    above_kda: float | None = None,
    calibration: Line | None = None,
    kinetics: Kinetics | None = None,
    draws: int = 100,
    seed: int = 1,
    out: str | Path | None = None,
    overwrite: bool = False,
    notify: Callable[[str], None] | None = None,
) -> Distribution:
    """Find the species of a table of events, each event with its own error.

    Parameters
    ----------
    events : str, Path, pandas.DataFrame or EventTable
        An output folder, ``fits.csv``, a table of Refeyn's, or a table with a column ``mass_kda``.
        ``FILE::movie`` is one of several movies of a file, whose events are otherwise taken
        together.
    k : int, optional
        So many species; by default as many as the Bayesian information criterion likes.
    masses_kda : sequence of float, optional
        Species of these masses, held [kDa].
    start_kda : sequence of float, optional
        Species of free masses, as many as there are numbers; the fit begins at these and takes the
        nearest maximum of the likelihood [kDa].
    ladder : float or "auto", optional
        Oligomers of a monomer of about this mass [kDa], which is fitted, or of one to be found.
    steps : sequence of int
        Which oligomers, as in (1, 2, 4); by default they are found.
    offset : bool
        Fit an offset common to all oligomers.
    hold : bool
        Hold the monomer at the mass given.
    widths : {"free", "common"}
        Of given masses and ladders: a width for each, which grow with the mass about as in other
        tables, or one for all.
    background : bool
        Of given masses and ladders: whether something else may be there, broad and faint.
    branch : {"magnitude", "landing", "leaving"}
        Which events: |mass| of all, or one side.
    sigma_kda, limit_kda, limit_sigma_kda, above_kda : float, optional
        What is known of errors and of what was missed, as for `event_table` [kDa].
    calibration : str, Path, Calibration or MassCalibration, optional
        A mass line, as ``iscat calibrate mass`` writes it: masses are those of the contrasts, in
        place of masses that the table has.
    kinetics : Kinetics, optional
        Rates of the same table, from `fit_kinetics`, to be written beside the species.
    draws : int
        Simulated repetitions for the intervals; 0 for none.
    seed : int
        Of the repetitions.
    out : str or Path, optional
        Folder for species.csv, species.json and a figure.
    overwrite : bool
        Replace an earlier result in `out`.
    notify : callable, optional
        Given each note, a sentence.

    Returns
    -------
    Distribution
        Species with intervals; `ladder` where it is one.

    Raises
    ------
    ConfigError
        Options are impossible, or exclude each other.
    DataError
        The table cannot be read or holds too few events, or `out` may not be written.

    Examples
    --------
    >>> import iscat_analysis as ia, numpy as np, pandas as pd
    >>> random = np.random.default_rng(1)
    >>> mass = random.normal(np.repeat([66.0, 132.0], [300, 100]), 8.0)
    >>> table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": 8.0})
    >>> found = ia.find_species(table, ladder=60.0, draws=0)
    >>> round(found.ladder.monomer_kda), found.ladder.steps
    (66, (1, 2))
    """
    choice = choice_of(
        k, masses_kda, ladder, steps=steps, offset=offset, hold=hold, widths=widths,
        background=background, start_kda=start_kda,
    )  # fmt: skip
    draws = int(number_in("`draws`", draws, least=0, most=_MOST_DRAWS, whole=True))
    seed = int(number_in("`seed`", seed, least=0, whole=True))
    if kinetics is not None and not isinstance(kinetics, Kinetics):
        raise ConfigError(f"`kinetics` = {shown(kinetics)}: give what `fit_kinetics` returns")
    choice_in("`branch`", branch, ("magnitude", "landing", "leaving"))
    folder = None if out is None else path_in("`out`", out)
    if folder is not None:
        check_output(folder, overwrite, known=SPECIES_FILES)
    table = events
    if not isinstance(table, EventTable):
        table = event_table(
            table, sigma_kda=sigma_kda, limit_kda=limit_kda, limit_sigma_kda=limit_sigma_kda,
            above_kda=above_kda, calibration=calibration,
        )  # fmt: skip
    wanted, fewer = k or 0, "a smaller `k`"
    if isinstance(choice, Begun):
        wanted, fewer = len(choice.masses_kda), "fewer in `start_kda`"
    if table.mass_kda.size < _EVENTS_EACH * wanted:
        raise DataError(
            f"{table.name}: holds {count(table.mass_kda.size, 'event')}, too few for {wanted} "
            f"species, which need {_EVENTS_EACH} each; give {fewer}"
        )
    if isinstance(choice, (Begun, Given)):
        argument = "`masses_kda`" if isinstance(choice, Given) else "`start_kda`"
        refuse_far([table], choice.masses_kda, argument)
    elif isinstance(choice, Ladder) and choice.monomer_kda is not None:
        rungs = choice.steps or (1, MOST_RUNGS)
        monomer = choice.monomer_kda
        refuse_far([table], [n * monomer for n in rungs], f"`ladder` = {monomer:.4g}")
    found = describe(
        table.mass_kda,
        table.sigma_kda,
        efficiency=table.efficiency,
        seed=seed,
        branch=branch,
        draws=draws,
        scale_error=table.scale_error,
        window_frames=table.window_frames,
        choice=choice,
        limit_known=table.edge_kda is None,
    )
    if found.events < LEAST_EVENTS:
        kind = "event" if branch == "magnitude" else f"{branch} event"
        raise DataError(
            f"{table.name}: holds {count(found.events, kind)}, too few for species; "
            f"{LEAST_EVENTS} are needed"
        )
    notes = (*sentences(table.remarks), *found.notes, *(() if kinetics is None else kinetics.notes))
    if notify is not None:
        for note in notes:
            notify(note)
    if folder is not None:
        contents = {"source": table.name, **found.to_dict(), "notes": list(notes)}
        if kinetics is not None:
            contents["kinetics"] = kinetics.to_dict()
        _write(folder, found.species, contents, overwrite=overwrite)
    return found


def choice_of(
    k: int | None,
    masses_kda: Sequence[float] | None,
    ladder: float | Literal["auto"] | None,
    *,
    steps: Sequence[int],
    offset: bool,
    hold: bool,
    widths: Widths,
    background: bool,
    start_kda: Sequence[float] | None = None,
) -> Choice:
    """Say which species to look for, and refuse what is impossible."""
    named = [
        name
        for name, value in (
            ("k", k),
            ("masses_kda", masses_kda),
            ("start_kda", start_kda),
            ("ladder", ladder),
        )
        if value is not None
    ]
    if len(named) > 1:
        raise ConfigError(
            f"`{named[0]}` and `{named[1]}` are two descriptions of the species; give one of them"
        )
    for name, value in (("offset", offset), ("hold", hold), ("background", background)):
        truth_in(f"`{name}`", value)
    choice_in("`widths`", widths, ("common", "free"))
    for name, several in (("masses_kda", masses_kda), ("start_kda", start_kda), ("steps", steps)):
        if several is not None and not isinstance(several, (list, tuple, np.ndarray)):
            raise ConfigError(f"`{name}` = {shown(several)}: give a list, as in [66, 132]")
    if ladder is None and (len(steps) or offset or hold):
        which = "steps" if len(steps) else "offset" if offset else "hold"
        raise ConfigError(f"`{which}` is of a ladder; give `ladder` as well")
    if k is not None:
        return Number(int(number_in("`k`", k, least=1, most=_MOST_SPECIES, whole=True)))
    if start_kda is not None:
        return Begun(_masses("`start_kda`", start_kda))
    if masses_kda is not None:
        return Given(_masses("`masses_kda`", masses_kda), widths, background)
    if ladder is None:
        return Searched()
    rungs = [int(number_in("`steps`", n, least=1, most=1e6, whole=True)) for n in steps]
    if len(set(rungs)) < len(rungs):
        raise ConfigError("`steps`: must be different numbers of monomers, 1 or more, as in 1,2,4")
    if isinstance(ladder, str) and ladder == "auto":
        if hold or rungs:
            which = "hold" if hold else "steps"
            raise ConfigError(f"`{which}` needs a monomer whose mass is given, as in `ladder` = 66")
        return Ladder(None, (), offset, widths=widths, background=background)
    monomer = mass_in("`ladder`", ladder, "mass of a monomer in kDa")
    return Ladder(monomer, tuple(rungs), offset, hold, widths, background)


def _masses(name: str, given: Sequence[float]) -> tuple[float, ...]:
    """Check masses of species, each of which is named once."""
    masses = tuple(mass_in(name, mass) for mass in given)
    if not masses:
        raise ConfigError(f"{name}: is empty; give masses in kDa, as in 66,132")
    if len(set(masses)) < len(masses):
        raise ConfigError(f"{name}: names a mass twice; name each once")
    return masses


def _write(
    folder: Path, species: pd.DataFrame, contents: dict[str, Any], *, overwrite: bool
) -> None:
    """Put table, document and figure into a folder."""
    with atomic_folder(folder, overwrite, known=SPECIES_FILES) as building:
        species.to_csv(building / "species.csv", index=False, float_format=f"%.{CSV_DIGITS}g")
        (building / "species.json").write_text(to_json("species", contents) + "\n", "utf-8")
        (building / "figures").mkdir()
        sketch = ("species", partial(species_figure, jsonable(contents)))
        publish(drawn([sketch]), building / "figures")
