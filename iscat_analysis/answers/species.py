"""Answers from tables of events: which species there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd

from iscat_analysis.answers.kinetics import Kinetics
from iscat_analysis.answers.output import AnswerFolder, Notify, folder_for, tell
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import choice_in, number_in, shown, truth_in
from iscat_analysis.options import EventOptions, SpeciesOptions, only, takes
from iscat_analysis.report.species import species_page
from iscat_analysis.schemas import jsonable
from iscat_analysis.species import LEAST_EVENTS, Distribution, choices, describe
from iscat_analysis.species.tables import EventTable, event_table, mass_in, refuse_far, sentences
from iscat_analysis.units import count

_EVENTS_EACH = 5  # of a species


@takes(SpeciesOptions)
def find_species(
    events: str | Path | pd.DataFrame | EventTable,
    *,
    kinetics: Kinetics | None = None,
    draws: int = 100,
    seed: int = 1,
    out: str | Path | None = None,
    overwrite: bool = False,
    notify: Notify | None = None,
    **options: Unpack[SpeciesOptions],
) -> Distribution:
    """Find the species of a table of events, each event with its own error.

    Parameters
    ----------
    events : str, Path, pandas.DataFrame or EventTable
        An output folder, ``fits.csv``, a table of Refeyn's, or a table with a column ``mass_kda``.
        ``FILE::movie`` is one of several movies of a file, whose events are otherwise taken
        together.
    kinetics : Kinetics, optional
        Rates of the same table, from `fit_kinetics`, to be written beside the species.
    draws : int
        Simulated repetitions for the intervals; 0 for none.
    seed : int
        Of the repetitions.
    out : str or Path, optional
        Folder for species.csv, species.json and a page, species.html.
    overwrite : bool
        Replace an earlier result in `out`.
    notify : callable, optional
        Given each note, a sentence.
    **options

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
    choice, branch = choice_of(options), options["branch"]
    draws = int(number_in("`draws`", draws, least=0, most=1_000_000, whole=True))
    seed = int(number_in("`seed`", seed, least=0, whole=True))
    if kinetics is not None and not isinstance(kinetics, Kinetics):
        raise ConfigError(f"`kinetics` = {shown(kinetics)}: give what `fit_kinetics` returns")
    names = ("species.csv", "species.json", "species.html")
    folder = folder_for(out, *names, overwrite=overwrite, notify=notify)
    table = event_table(events, **only(EventOptions, options))
    _refuse_impossible(table, choice)
    of_table = ("efficiency", "scale_error", "window_frames")
    known: Any = {name: getattr(table, name) for name in of_table}
    known |= {"limit_known": table.edge_kda is None, "choice": choice, "branch": branch}
    found = describe(table.mass_kda, table.sigma_kda, seed=seed, draws=draws, **known)
    if found.events < LEAST_EVENTS:
        kind = "event" if branch == "magnitude" else f"{branch} event"
        raise DataError(
            f"{table.name}: holds {count(found.events, kind)}, too few for species; "
            f"{LEAST_EVENTS} are needed"
        )
    _write(folder, table, found, kinetics)
    return found


def _write(
    folder: AnswerFolder, table: EventTable, found: Distribution, kinetics: Kinetics | None
) -> None:
    """Tell the notes, and write species and rates."""
    rates = () if kinetics is None else kinetics.notes
    notes = [*sentences(table.remarks), *found.notes, *rates]
    tell(notes, folder.notify)
    contents = {"source": table.name, **found.to_dict(), "notes": notes}
    if kinetics is not None:
        contents["kinetics"] = kinetics.to_dict()
    files = {"species.csv": found.species, "species.json": ("species", contents)}
    folder.write({**files, "species.html": lambda: species_page(jsonable(contents))})


def _refuse_impossible(table: EventTable, choice: choices.Choice) -> None:
    """Refuse more species than events can tell, and masses without an event near them."""
    number, fewer = 0, ""
    if isinstance(choice, choices.Number):
        number, fewer = choice.k, "a smaller `k`"
    elif isinstance(choice, choices.Begun):
        number, fewer = len(choice.masses_kda), "fewer in `start_kda`"
    if table.mass_kda.size < _EVENTS_EACH * number:
        raise DataError(
            f"{table.name}: holds {count(table.mass_kda.size, 'event')}, too few for {number} "
            f"species, which need {_EVENTS_EACH} each; give {fewer}"
        )
    if isinstance(choice, (choices.Begun, choices.Given)):
        argument = "`masses_kda`" if isinstance(choice, choices.Given) else "`start_kda`"
        refuse_far([table], choice.masses_kda, argument)
    elif isinstance(choice, choices.Ladder) and choice.monomer_kda is not None:
        monomer = choice.monomer_kda
        rungs = [n * monomer for n in choice.steps or (1, choices.MOST_RUNGS)]
        refuse_far([table], rungs, f"`ladder` = {monomer:.4g}")


def choice_of(options: SpeciesOptions) -> choices.Choice:
    """Say which species to look for, and refuse what is impossible."""
    ways = ("k", "masses_kda", "start_kda", "ladder")
    named = [name for name in ways if options.get(name) is not None]
    if len(named) > 1:
        raise ConfigError(
            f"`{named[0]}` and `{named[1]}` are two descriptions of the species; give one of them"
        )
    k, ladder, steps = options["k"], options["ladder"], options["steps"]
    offset, hold, background = (
        truth_in(f"`{name}`", options[name]) for name in ("offset", "hold", "background")
    )
    widths = options["widths"]
    choice_in("`widths`", widths, ("common", "free"))
    choice_in("`branch`", options.get("branch", "magnitude"), ("magnitude", "landing", "leaving"))
    for name in ("masses_kda", "start_kda", "steps"):
        several = options[name]
        if several is not None and not isinstance(several, (list, tuple, np.ndarray)):
            raise ConfigError(f"`{name}` = {shown(several)}: give a list, as in [66, 132]")
    if ladder is None and (len(steps) or offset or hold):
        which = "steps" if len(steps) else "offset" if offset else "hold"
        raise ConfigError(f"`{which}` is of a ladder; give `ladder` as well")
    if k is not None:
        return choices.Number(int(number_in("`k`", k, least=1, most=1000, whole=True)))
    if (start_kda := options["start_kda"]) is not None:
        return choices.Begun(_masses("`start_kda`", start_kda))
    if (masses_kda := options["masses_kda"]) is not None:
        return choices.Given(_masses("`masses_kda`", masses_kda), widths, background)
    if ladder is None:
        return choices.Searched()
    rungs = [int(number_in("`steps`", n, least=1, most=1e6, whole=True)) for n in steps]
    if len(set(rungs)) < len(rungs):
        raise ConfigError("`steps`: must be different numbers of monomers, 1 or more, as in 1,2,4")
    if isinstance(ladder, str) and ladder == "auto":
        if hold or rungs:
            which = "hold" if hold else "steps"
            raise ConfigError(f"`{which}` needs a monomer whose mass is given, as in `ladder` = 66")
        return choices.Ladder(None, (), offset, widths=widths, background=background)
    monomer = mass_in("`ladder`", ladder, "mass of a monomer in kDa")
    return choices.Ladder(monomer, tuple(rungs), offset, hold, widths, background)


def _masses(name: str, given: Sequence[float]) -> tuple[float, ...]:
    """Check masses of species, each of which is named once."""
    masses = tuple(mass_in(name, mass) for mass in given)
    if not masses:
        raise ConfigError(f"{name}: is empty; give masses in kDa, as in 66,132")
    if len(set(masses)) < len(masses):
        raise ConfigError(f"{name}: names a mass twice; name each once")
    return masses
