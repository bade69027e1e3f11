"""Equilibrium constants over a series of concentrations.

Which peak of a series of tables is the monomer, where the user does not say.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, get_args

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks, peak_prominences

from iscat_analysis.answers.output import Notify, folder_for, tell
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding, existing
from iscat_analysis.findings import tables as said
from iscat_analysis.inference.checks import LARGEST, choice_in, number_in, path_in, truth_in
from iscat_analysis.movie import path_beside, split_address
from iscat_analysis.movie.tables import read_frame, refuse_twice
from iscat_analysis.options import BindingOptions, EventOptions, only, takes
from iscat_analysis.reading import is_file, is_folder, read_json
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.report.species import binding_page
from iscat_analysis.schemas import jsonable
from iscat_analysis.species import LEAST_EVENTS
from iscat_analysis.species.describe import LEAST_EFFICIENCY
from iscat_analysis.species.equilibrium import (
    EquilibriumFit,
    Model,
    fit_equilibrium,
    landing_logits,
)
from iscat_analysis.species.tables import EventTable, event_table, mass_in, refuse_far, sentences
from iscat_analysis.text import brief, from_table, in_table
from iscat_analysis.units import count

if TYPE_CHECKING:
    from iscat_analysis.report.plots import Panels

CONCENTRATIONS: dict[Model, tuple[str, ...]] = {
    "dimer": ("concentration_nm",),
    "ab": ("a_nm", "b_nm"),
}
"""Columns of the samples that hold concentrations [nM]."""

_OF_TABLES = ("complexes", "complexes_low", "complexes_high", "predicted", "pull", "background")
_WRONG = 0.01  # p-value below which the model is doubted
_FAR = 3.0  # standard errors of a table that is named
_POINTS = 200  # of the curve


@dataclass(frozen=True, eq=False)
class Binding:
    """An equilibrium constant and the tables it is from; `fit_kd` makes it.

    Attributes
    ----------
    model : str
        ``"dimer"`` or ``"ab"``.
    fit : EquilibriumFit
        K_D, its interval, and whether the model describes the tables.
    samples : pandas.DataFrame
        One row for each table: path, concentrations [nM], other columns, events; fraction of
        complexes among the particles that came with its 95 % interval, the same by the
        equilibrium, their distance in standard errors, and the share of background.
    curve : pandas.DataFrame
        Of monomers and dimers: concentration_nm, complexes; empty for two partners.
    notes : tuple of str
        What the user should know, one sentence each.
    """

    model: Model
    fit: EquilibriumFit
    samples: pd.DataFrame
    curve: pd.DataFrame
    notes: tuple[str, ...]

    __repr__ = brief

    def to_dict(self) -> dict[str, Any]:
        """Give the document ``kd``.

        Returns
        -------
        dict
            Nested plain values.
        """
        left_out = {*_OF_TABLES, "detected", "profile_ln_kd", "profile_deviance"}
        fit = {name: value for name, value in vars(self.fit).items() if name not in left_out}
        profile = {"ln_kd_nm": self.fit.profile_ln_kd, "deviance": self.fit.profile_deviance}
        return {
            "model": self.model,
            **fit,
            "samples": self.samples.to_dict("records"),
            "curve": self.curve.to_dict("list"),
            "profile": profile,
            "notes": list(self.notes),
        }

    def plot_kd(self, *, ax: Any = None) -> Panels:
        """Draw fractions of complexes with their intervals and the equilibrium, and the likelihood.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            Two, or one for the fractions alone; default a figure that shows itself in a notebook.

        Returns
        -------
        ndarray of matplotlib.axes.Axes
            What was drawn into.

        Raises
        ------
        ConfigError
            The number of axes is another one.
        """
        from iscat_analysis.report.plots import plot_kd  # Matplotlib takes long to import

        return plot_kd(jsonable(self.to_dict()), ax=ax)


@takes(BindingOptions)
def fit_kd(
    samples: str | Path | pd.DataFrame,
    *,
    model: Model,
    tables: Sequence[EventTable | pd.DataFrame] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    notify: Notify | None = None,
    **options: Unpack[BindingOptions],
) -> Binding:
    """Fit an equilibrium constant to the events of a series of concentrations.

    Parameters
    ----------
    samples : str, Path or pandas.DataFrame
        One row for each table of events: ``path``, and ``concentration_nm`` (monomers in all), or
        ``a_nm`` and ``b_nm`` (A and B in all) [nM]; further columns are kept.  Of a column
        ``role`` only rows with ``sample`` are used.  Paths are as for `find_species`, beside the
        file of the samples; a movie of any format stands for the output folder beside it.  Of the
        ``movies.csv`` of a batch those movies are used that the batch would use: analysed, with a
        concentration and events.
    model : {"dimer", "ab"}
        2 M ⇌ D, K_D = [M]²/[D]; or A + B ⇌ AB, K_D = [A][B]/[AB].
    tables : sequence of EventTable or pandas.DataFrame, optional
        The tables of all rows themselves, in place of ``path``.
    out : str or Path, optional
        Folder for kd.csv, kd.json and a page, kd.html.
    overwrite : bool
        Replace an earlier result in `out`.
    notify : callable, optional
        Given each note, a sentence.
    **options

    Returns
    -------
    Binding
        K_D with its profile-likelihood interval, fractions of each table, and a test of the model.

    Raises
    ------
    ConfigError
        Options are impossible.
    DataError
        Samples or tables cannot be read, hold too little, or hardly any of the lightest species is
        detected; or `out` may not be written.

    Examples
    --------
    >>> import iscat_analysis as ia, numpy as np, pandas as pd
    >>> random = np.random.default_rng(1)
    >>> tables = []
    >>> for dimers in (0.158, 0.308, 0.471):  # of landings at 3, 10 and 30 nM where K_D is 10 nM
    ...     true = np.where(random.random(1500) < dimers, 132.0, 66.0)
    ...     mass = random.normal(true, 8.0)
    ...     tables.append(pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": 8.0}))
    >>> samples = pd.DataFrame({"concentration_nm": [3.0, 10.0, 30.0]})
    >>> found = ia.fit_kd(samples, tables=tables, model="dimer", masses_kda=[66.0])
    >>> found.fit.kd_low < 10 < found.fit.kd_high
    True
    """
    _check(model, options)
    folder = folder_for(out, "kd.csv", "kd.json", "kd.html", overwrite=overwrite)
    name = "samples" if isinstance(samples, pd.DataFrame) else str(samples)
    rows, totals, found, findings = _series(samples, name, model, tables, options)
    masses, about = _masses(found, model, options["masses_kda"])
    events = [t.events if t.edge_kda is None else replace(t.events, efficiency=None) for t in found]
    how: Any = {"power": options["landing_power"], "inactive": options["inactive"]}
    fit = fit_equilibrium(events, totals, model=model, masses_kda=masses, **how)
    _refuse_undetected(name, fit)
    notes = [
        *(finding.text for finding in existing([*findings, about])),
        *sentences(finding for table in found for finding in table.findings),
        *(finding.text for finding in _doubts(found, fit, masses, inactive=options["inactive"])),
    ]
    curve = _curve(totals, fit, model)
    result = Binding(model, fit, _laid_out(rows, found, fit), curve, tuple(notes))
    tell(notes, notify)
    contents = {"source": name, **result.to_dict()}
    files = {"kd.csv": in_table(result.samples), "kd.json": ("kd", contents)}
    folder.write({**files, "kd.html": lambda: binding_page(jsonable(contents))})
    return result


def _check(model: Model, options: BindingOptions) -> None:
    """Refuse impossible options."""
    check_reaction(model, options["masses_kda"])
    power = options["landing_power"]
    if power is not None and not -1 <= number_in("`landing_power`", power) <= 1:
        raise ConfigError(f"`landing_power` = {power:g}: must lie between -1 and 1, as in -0.167")
    truth_in("`inactive`", options["inactive"])


def _refuse_undetected(name: str, fit: EquilibriumFit) -> None:
    """Refuse a series of which hardly any of the lightest species is detected."""
    lightest = int(np.argmin(fit.masses_kda))
    if fit.detected[lightest] < LEAST_EFFICIENCY:
        raise DataError(
            f"{name}: of the species of about {fit.masses_kda[lightest]:.3g} kDa only "
            f"{100 * fit.detected[lightest]:.2g} % are detected (half are at {fit.limit_kda:.3g} "
            "kDa), so that K_D is not determined; a lower threshold of detection would tell, or "
            "`limit_kda` if it is known"
        )


def _series(
    samples: str | Path | pd.DataFrame,
    name: str,
    model: Model,
    tables: Sequence[EventTable | pd.DataFrame] | None,
    options: BindingOptions,
) -> tuple[pd.DataFrame, FloatArray, list[EventTable], list[Finding]]:
    """Read rows, concentrations and events of a series, and say what is left out."""
    if isinstance(samples, pd.DataFrame):
        base, rows = None, samples
    else:
        base = path_in("`samples`", samples)
        rows = from_table(read_frame(base))
    rows, kept = _used(rows, name)
    findings: list[Finding] = []
    of_batch = tables is None and "report" in rows
    if of_batch:
        rows, findings = _analysed(rows, CONCENTRATIONS[model], name)
    totals = _totals(rows, model, name)
    rows[list(CONCENTRATIONS[model])] = totals
    sources: Sequence[EventTable | pd.DataFrame | Path]
    if tables is None:
        sources = _paths(rows, None if base is None else base.parent, name)
    elif isinstance(tables, (list, tuple)) and len(tables) == kept.size:
        sources = [table for table, keep in zip(tables, kept, strict=True) if keep]
    else:
        raise ConfigError(f"`tables`: give a list with one for each of {kept.size} rows")
    known = only(EventOptions, options)
    numbered = enumerate(sources, start=1)
    called = ((one, None if isinstance(one, Path) else f"table {n}") for n, one in numbered)
    found = [event_table(table, name=name, **known) for table, name in called]
    enough, few = with_events(found)
    if of_batch and any(enough):
        findings += existing([few])
        found = [table for table, keep in zip(found, enough, strict=True) if keep]
        rows, totals = rows[enough].reset_index(drop=True), totals[enough]
    for table in found:
        if table.mass_kda.size < LEAST_EVENTS:
            raise DataError(
                f"{table.name}: holds {count(table.mass_kda.size, 'event')}, too few; "
                f"{LEAST_EVENTS} are needed, or leave it out of {name}"
            )
    return rows, totals, found, findings


def _masses(
    tables: Sequence[EventTable], model: Model, given: Sequence[float] | None
) -> tuple[tuple[float, ...], Finding | None]:
    """Give the masses of the partners, or find the monomer and say which peak was taken for it."""
    if given is None:
        monomer, taken = monomer_of(tables)
        return (monomer,), taken
    masses = tuple(map(float, given))
    complex_kda = 2 * masses[0] if model == "dimer" else sum(masses)
    refuse_far(tables, [*masses, complex_kda], "`masses_kda`")
    return masses, None


def check_reaction(
    model: str,
    masses_kda: Sequence[float] | None,
    *,
    names: tuple[str, str] = ("model", "masses_kda"),
) -> None:
    """Check the reaction and the masses of its partners."""
    choice_in(f"`{names[0]}`", model, get_args(Model))
    parts = len(CONCENTRATIONS[model])  # type: ignore[index]
    if masses_kda is None:
        if parts > 1:
            raise ConfigError(f"`{names[1]}`: model ab needs the masses of A and B, as in 40,80")
        return
    listed = isinstance(masses_kda, (list, tuple)) or np.ndim(masses_kda) == 1
    if not listed or len(masses_kda) != parts:
        wanted = (
            "the mass of the monomer, as in 66" if parts == 1 else "those of A and B, as in 40,80"
        )
        raise ConfigError(f"`{names[1]}`: model {model} takes {wanted} [kDa]")
    for mass in masses_kda:
        mass_in(f"`{names[1]}`", mass)


def _used(rows: pd.DataFrame, name: str) -> tuple[pd.DataFrame, BoolArray]:
    """Select rows that are samples, and give their indices."""
    rows = rows.rename(columns=lambda column: str(column).strip())
    used = {column for columns in CONCENTRATIONS.values() for column in columns}
    refuse_twice(list(rows.columns), ["path", "role", "report", "movie", *sorted(used)], name)
    kept = np.ones(len(rows), bool)
    if "role" in rows:
        role = rows["role"].astype(object).fillna("sample").astype(str).str.strip()
        kept = role.eq("sample").to_numpy()
    if not kept.any():
        raise DataError(f"{name}: has no row of a sample")
    return rows[kept].reset_index(drop=True), kept


def with_events(tables: Sequence[EventTable]) -> tuple[list[bool], Finding | None]:
    """Tell which tables have enough events for an equilibrium."""
    enough = [table.mass_kda.size >= LEAST_EVENTS for table in tables]
    few = [table.name for table, keep in zip(tables, enough, strict=True) if not keep]
    why = {"why": f"with less than {LEAST_EVENTS} events", "names": ", ".join(few)}
    return enough, said.MOVIES_LEFT_OUT(why) if few else None


def _analysed(
    rows: pd.DataFrame, columns: Sequence[str], name: str
) -> tuple[pd.DataFrame, list[Finding]]:
    """Keep the movies of a batch that have a result and a concentration; say which have not."""
    has_result = rows["report"].astype(object).fillna("").ne("").to_numpy()
    given = rows.reindex(columns=list(columns)).notna().all(axis=1).to_numpy()
    if not set(columns) <= set(rows):
        given[:] = True  # that a column is missing is said of the whole table
    names = rows["movie"] if "movie" in rows else rows["path"] if "path" in rows else rows["report"]
    findings = [
        said.MOVIES_LEFT_OUT({"why": why, "names": ", ".join(names[gone].astype(str))})
        for why, gone in (
            ("not analysed", given & ~has_result),
            (f"without {' and '.join(columns)}", ~given),
        )
        if gone.any()
    ]
    if not (given & has_result).any():
        raise DataError(f"{name}: has no sample that is analysed and has a concentration")
    return rows[given & has_result].reset_index(drop=True), findings


def _totals(rows: pd.DataFrame, model: Model, name: str) -> FloatArray:
    columns = CONCENTRATIONS[model]
    missing = [column for column in columns if column not in rows]
    if missing:
        raise DataError(
            f"{name}: has no column {missing[0]}, which model {model} takes; it has "
            f"{', '.join(map(str, rows.columns))}"
        )
    try:
        totals = rows[list(columns)].to_numpy(dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{name}: a concentration is no number ({error})") from None
    possible = (totals == 0) | ((totals >= 1 / LARGEST) & (totals <= LARGEST))
    bad = ~possible.all(axis=1) | (totals.sum(axis=1) <= 0)
    if bad.any():
        raise DataError(
            f"{name}: row {int(np.argmax(bad)) + 1} has no concentration above 0 in "
            f"{' and '.join(columns)}; give it in nM, or leave the row out"
        )
    if model == "ab" and not (totals > 0).all(axis=1).any():
        raise DataError(f"{name}: no row has both partners; K_D needs tables of A with B")
    return np.asarray(totals)


def _paths(rows: pd.DataFrame, base: Path | None, name: str) -> list[Path]:
    if "path" not in rows:
        raise DataError(f"{name}: has no column path, which names a table of events in each row")
    # The movies.csv of a batch says where each result is.
    column = "report" if "report" in rows else "path"
    found = []
    for given in rows[column].astype(object).fillna("").astype(str):
        path = Path(given.strip())
        path = path.parent if column == "report" else path
        places = [path if base is None else base / path, path]
        results = filter(None, map(_result_of, places))
        files = (split_address(place)[0] for place in places)
        there = (
            p for p, file in zip(places, files, strict=True) if is_file(file) or is_folder(file)
        )
        found.append(next(results, None) or next(there, path))
    return found


def _result_of(movie: Path) -> Path | None:
    """Give the output folder beside a movie, which says what kind of file it is of; else None."""
    folder = path_beside(movie, ".iscat")
    try:
        source = read_json(folder / "summary.json")["input"]["path"]
    except (OSError, ValueError, LookupError, TypeError):
        return None
    files = (split_address(address)[0] for address in (Path(str(source)), movie))
    return folder if len({file.suffix.lower() for file in files}) == 1 else None


def _laid_out(
    rows: pd.DataFrame, tables: Sequence[EventTable], fit: EquilibriumFit
) -> pd.DataFrame:
    kept = rows if "path" in rows else rows.assign(path=[table.name for table in tables])
    events = [table.mass_kda.size for table in tables]
    return kept.assign(events=events, **{name: getattr(fit, name) for name in _OF_TABLES})


def _curve(totals: FloatArray, fit: EquilibriumFit, model: Model) -> pd.DataFrame:
    """Fraction of dimers among landings against the concentration."""
    if model != "dimer":
        return pd.DataFrame(columns=["concentration_nm", "complexes"])
    low, high = float(totals.min()) / 3, float(totals.max()) * 3
    grid = np.geomspace(low, high, _POINTS)[:, None]
    power, masses = fit.landing_power, fit.masses_kda
    logits = landing_logits(model, grid, fit.kd_nm, fit.inactive, masses, power)[:, 1]
    return pd.DataFrame({"concentration_nm": grid[:, 0], "complexes": 1 / (1 + np.exp(-logits))})


def _doubts(
    tables: Sequence[EventTable],
    fit: EquilibriumFit,
    masses_kda: Sequence[float],
    *,
    inactive: bool,
) -> Iterator[Finding]:
    """Doubt the constant."""
    for given, fitted in zip(masses_kda, fit.masses_kda.tolist(), strict=False):
        # of a mass that was given: farther away is another species
        if abs(fitted / given - 1) > 0.15:
            yield said.OTHER_SPECIES({"given_kda": given, "found_kda": fitted})
    if fit.p_value < _WRONG:
        far = [t.name for t, pull in zip(tables, fit.pull, strict=True) if abs(pull) > _FAR]
        named = f" (farthest: {', '.join(far[:3])})" if far else ""
        yield said.NO_EQUILIBRIUM({"p_value": fit.p_value, "farthest": named})
    if not inactive and fit.inactive_p < _WRONG:
        yield said.INACTIVE_PART({"p_value": fit.inactive_p})
    if not math.isfinite(fit.kd_high):
        yield said.NO_UPPER_END()
    if fit.kd_low == 0:
        yield said.NO_LOWER_END()
    if len(tables) < 2:
        yield said.SINGLE_TABLE()


_PEAK_POINTS = 2000
_SMOOTHING = 0.07  # of ln m: a third of what keeps peaks at m and 2 m apart


def monomer_of(tables: Sequence[EventTable]) -> tuple[float, Finding]:
    """Find the monomer in the events of all tables, and say what was taken.

    Every table counts alike.  Two peaks of the density of ln m, one at about twice the other, are
    monomers and dimers; of several such pairs the one with most events is taken.
    """
    # ln of masses in kDa
    points = np.linspace(0.0, 11.5, _PEAK_POINTS)
    step = points[1] - points[0]
    edges = np.append(points - step / 2, points[-1] + step / 2)
    logs = [np.log(np.abs(table.mass_kda)) for table in tables]
    shares = [np.histogram(one, edges)[0] / one.size for one in logs]
    density = gaussian_filter1d(np.mean(shares, axis=0), _SMOOTHING / step)
    events = sum(one.size for one in logs)
    # A peak of few events is noise: those under its kernel have the error of counts.
    noise = np.sqrt(density * step / (2 * math.sqrt(math.pi) * _SMOOTHING) / events)
    found = find_peaks(density)[0]
    prominent = peak_prominences(density, found)[0]
    # prominence of a peak over the height of the highest, and in standard errors
    clear = (prominent > 0.05 * density.max()) & (prominent > 4.0 * noise[found])
    masses, heights = np.exp(points[found[clear]]), density[found[clear]]
    pairs = [
        (heights[one] + heights[two], one, two)
        for one in range(masses.size)
        for two in range(one + 1, masses.size)
        # of ln m: the lighter peak is shifted where much of it is missed
        if abs(math.log(masses[two] / (2 * masses[one]))) < 0.16
    ]
    if not pairs:
        seen = ", ".join(f"{mass:.3g}" for mass in masses) or "none"
        raise DataError(
            f"{tables[0].name}: which peak of the series is the monomer cannot be told: none lies "
            f"at twice the mass of another (peaks at {seen} kDa); give `masses_kda`"
        )
    _, one, two = max(pairs)
    # The dimer's peak is whole where that of the monomer may be cut by what is missed.
    taken = {"monomer_kda": float(masses[one]), "dimer_kda": float(masses[two])}
    return float(masses[two]) / 2, said.MONOMER_TAKEN(taken)
