"""A laboratory's day: many movies, their calibrations, one picture.

`table` reads what there is, names the results and resolves the configurations, `calibrate` makes
the calibrations of the day, `jobs` does one job after another and leaves alone what is finished,
`gather` and `compare` make tables of all results, and `watch` follows a folder or a movie that
grows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd

from iscat_analysis.answers.output import Notify, tell
from iscat_analysis.calibration import with_line
from iscat_analysis.config import Config, configure
from iscat_analysis.day import compare, gather
from iscat_analysis.day.calibrate import Day, calibrate_day
from iscat_analysis.day.compare import Reaction
from iscat_analysis.day.gather import MOVIE_COLUMNS, Found
from iscat_analysis.day.jobs import Outcome, Runner, claim_folder, hash_of, write_whole
from iscat_analysis.day.table import (
    Movie,
    Standards,
    Table,
    configured,
    make_plan,
    part_of,
    read_standards,
    read_table,
)
from iscat_analysis.errors import ConfigError
from iscat_analysis.executors import open_executor
from iscat_analysis.files import whole_file
from iscat_analysis.inference.checks import path_in, shown
from iscat_analysis.movie import files_of
from iscat_analysis.options import DayOptions, takes
from iscat_analysis.progress import automatic, told
from iscat_analysis.records import Progress
from iscat_analysis.report.batch import BatchContents, Curve, batch_page, summary_line
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.text import brief, from_table, in_table
from iscat_analysis.units import count

__all__ = ["Batch", "Table", "batch", "read_table"]


@dataclass(frozen=True, eq=False)
class Batch:
    """What a batch found.

    Attributes
    ----------
    out : Path
        Its folder; ``batch.html`` is in it, unless only a part was analysed.
    movies : pandas.DataFrame
        One row per movie: ``movies.csv``; of a part, movie, state and why.
    species : pandas.DataFrame
        One row per species and movie: ``species.csv``; empty of a part.
    kd : pandas.DataFrame
        One row per condition: ``kd.csv``; empty of a part, and where it was not asked for.
    analysed : tuple of str
        Movies that were analysed now; the others were finished before.
    failed : tuple of (str, str)
        Movies and calibrations that could not be analysed, or are not yet, and conditions without
        the K_D that was asked for, each with its reason.
    """

    out: Path
    movies: pd.DataFrame
    species: pd.DataFrame
    kd: pd.DataFrame
    analysed: tuple[str, ...]
    failed: tuple[tuple[str, str], ...]

    __repr__ = brief

    @property
    def page(self) -> Path:
        """The page that shows everything."""
        return self.out / "batch.html"

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain values.

        Returns
        -------
        dict
            What ``iscat batch --json`` prints; ``iscat_analysis.schema("batch")`` describes it.
        """
        tables = {
            name: getattr(self, name).to_dict("records") for name in ("movies", "species", "kd")
        }
        return {
            "out": str(self.out),
            **({"page": str(self.page)} if self.page.is_file() else {}),
            **tables,
            "analysed": list(self.analysed),
            "failed": [{"name": name, "why": why} for name, why in self.failed],
        }


@takes(DayOptions)
@told
def batch(
    samples: str | Path | Table,
    *,
    out: str | Path,
    only: tuple[int, int] | None = None,
    merge: bool = False,
    retry: bool = True,
    progress: Progress = automatic,
    notify: Notify | None = None,
    command: str = "",
    **options: Unpack[DayOptions],
) -> Batch:
    """Analyse the movies of a day with its calibrations, and put them into one picture.

    Flats come first (camera), then calibrants (optics, line of the masses), then everything else
    with these.  What is finished and has not changed is left alone; what fails costs only itself.

    Parameters
    ----------
    samples : str, Path or Table
        A table, CSV or TOML, one row per movie; or a folder, whose movies are samples.  Columns:
        path (an address as for `open_stack`, relative to the table), sample, condition,
        concentration_nm, replicate, role (``sample``, ``calibrant``, ``blank`` or ``flat``) and
        standards, the masses in a calibrant; one named as a key of the configuration, as
        ``background.frames``, sets it for that movie, and any other is kept.
    out : str or Path
        Folder of the batch; it may hold an earlier one, which is brought up to date.
    only : (int, int), optional
        Analyse the K-th of N parts of the movies, and make no picture; several parts may be
        analysed at the same time, on machines that share the folder.
    merge : bool
        Make the picture of what is finished, or with `only` say what is, and analyse nothing.
    retry : bool
        Try again what failed, though nothing has changed.
    progress : Progress
        Called with the stage and the steps done and in all.
    notify : callable, optional
        Told in one line what was done.
    command : str
        The command line, for the reports.
    **options

    Returns
    -------
    Batch
        Tables, and what failed.

    Raises
    ------
    ConfigError
        The table or the configuration is wrong, row and column are named; or the scheduler does
        not answer, or a worker has other versions.
    DataError
        The folder holds something else.
    SchedulerError
        The scheduler went away; finished movies are kept, and the same call goes on.
    KeyboardInterrupt
        The user stopped it; finished movies are kept, and the same call goes on.
    """
    folder = path_in("`out`", out)
    if only is not None and (not isinstance(only, tuple) or len(only) != 2):
        raise ConfigError(f"`only` = {shown(only)}: give (K, N), the K-th of N parts")
    if only is not None and not 1 <= only[0] <= only[1]:
        raise ConfigError(
            f"`only` = {only[0]}/{only[1]}: write it as K/N, as in 1/4 for the first of four parts"
        )
    reaction, named, common = checked_options(options)
    calibration = options["calibration"]
    table = samples if isinstance(samples, Table) else read_table(path_in("`samples`", samples))
    plan = make_plan(table, common, named)
    if calibration is not None and plan.standards:
        raise ConfigError(
            "`calibration` is a mass line, and the standards of the calibrants give another; leave "
            "one of them out"
        )
    claim_folder(folder)
    command_text = command or f"iscat_analysis.batch({str(table.source)!r}, out={str(out)!r})"
    outcomes: dict[str, Outcome] = {}
    try:
        where = (options["scheduler"], options["scheduler_file"])
        with open_executor(*(() if merge else where)) as executor:
            tell(executor.warnings(plan.config.compute.memory_limit_mb), notify)
            runner = Runner(folder, executor, command_text, progress, notify, merge, retry)
            day = calibrate_day(plan, runner)
            wanted = part_of(plan.movies, only)
            queue = wanted
            if executor.distant:  # the longest first, so that none is left over at the end
                queue = tuple(sorted(wanted, key=lambda movie: -_bytes_of(movie.row.path)))
            progress("movies", 0, len(wanted))
            analysed = executor.each(lambda movie: _analyse(day, movie, runner), queue)
            with closing(analysed):
                for index, outcome in analysed:
                    name = queue[index].name
                    outcomes[name] = outcome
                    if outcome.ran:
                        which = f"{len(outcomes)} of {len(wanted)}: " if len(wanted) > 1 else ""
                        tell([f"{which}{name}: {_short(outcome)}"], notify)
                    progress("movies", len(outcomes), len(wanted))
        outcomes = {movie.name: outcomes[movie.name] for movie in wanted}
    except KeyboardInterrupt:
        done = sum(outcome.state == "done" for outcome in outcomes.values())
        raise KeyboardInterrupt(
            f"{done} of {len(plan.movies)} movies are finished; the same command goes on"
        ) from None
    flats = [flat.name for flat in plan.flats]
    outcomes = {**{name: day.outcomes[name] for name in flats}, **outcomes}
    failed = [(f"calibration of the {what}", why) for what, why in day.failed]
    failed += [
        (name, outcome.why or "not analysed yet")
        for name, outcome in outcomes.items()
        if outcome.state != "done"
    ]
    ran = tuple(name for name, each in outcomes.items() if each.ran and name not in flats)
    rows = [(name, each.state, each.why) for name, each in outcomes.items()]
    movies, nothing = pd.DataFrame(rows, columns=["movie", "state", "why"]), pd.DataFrame()
    part = Batch(folder, movies, nothing, nothing, ran, tuple(failed))
    return part if only is not None else _gathered(part, day, outcomes, reaction, runner)


def checked_options(options: DayOptions) -> tuple[Reaction | None, Standards, Config]:
    """Check options of a day: the reaction, the standards, and the configuration of all movies."""
    reaction = compare.reaction_of(options["kd"], options["kd_masses_kda"])
    try:
        named = read_standards(options["standards"] or ())
    except ValueError as error:
        raise ConfigError(f"`standards`: {error}") from None
    config = with_line(options["config"], options["calibration"])
    return reaction, named, configure(config, settings=options["settings"])


def _bytes_of(address: Path) -> int:
    """Give the size of a movie's files; 0 where they cannot be read, which is said later."""
    try:
        return sum(file.stat().st_size for file in files_of(address))
    except OSError:
        return 0


def _short(outcome: Outcome) -> str:
    if outcome.state != "done" or outcome.record is None:
        return f"failed: {outcome.why}"
    return count(outcome.record["events"], "event")


def _result(out: Path, movie: Movie) -> Path:
    return out / "movies" / f"{movie.name}.iscat"


def _analyse(day: Day, movie: Movie, runner: Runner) -> Outcome:
    """Analyse a movie with the calibrations of the day."""
    if movie.name in day.outcomes:  # a calibrant that could not be analysed without, either
        return day.outcomes[movie.name]
    try:
        config = configured(day.plan.config, day.settings, movie.row)
    except ConfigError as error:
        return Outcome("failed", f"{movie.row.path}: with the calibrations of the day: {error}")
    folder = _result(runner.out, movie)
    return runner.analyse(f"movies/{movie.name}", movie.row.path, config, folder)


def _gathered(
    part: Batch,
    day: Day,
    outcomes: Mapping[str, Outcome],
    reaction: Reaction | None,
    runner: Runner,
) -> Batch:
    """Make tables and page of all results, unless they are up to date."""
    out, plan = part.out, day.plan
    by_path = {movie.row.path: movie for movie in (*plan.flats, *plan.movies)}
    ordered = [by_path[row.path] for row in plan.table.rows]
    rows = [
        [m.name, repr(m.row), o.state, o.why, dict(o.record or {}).get("key")]
        for m in ordered
        for o in (outcomes[m.name],)
    ]
    key = hash_of(str(plan.table.source), repr(day.failed), rows, repr(reaction))
    with runner.records.held("page", runner.notify):
        if (
            part.analysed
            or not part.page.is_file()
            or runner.records.read("page").get("key") != key
        ):
            runner.records.drop("page")
            found: list[Found] = []
            for movie in ordered:
                found.append(gather.read_movie(movie, outcomes[movie.name], _result(out, movie)))
                runner.progress("gather", len(found), len(ordered))
            publish_day(day, found, reaction, part.failed, out)
            runner.records.write("page", {"key": key})
    text = dict.fromkeys(("movie", "sample", "condition", "replicate"), str)
    movies, species = (_read(out / f"{name}.csv", text) for name in ("movies", "species"))
    part = replace(part, movies=movies, species=species)
    if reaction is None:
        return part
    words = dict.fromkeys(("condition", "model", "masses_kda", "remarks", "why"), str)
    kd = _read(out / "kd.csv", words).fillna(dict.fromkeys(words, ""))
    absent = kd[kd["why"] != ""]
    without = zip(map(compare.kd_name, absent["condition"]), absent["why"], strict=True)
    return replace(part, kd=kd, failed=(*part.failed, *without))


def _read(path: Path, text: Mapping[str, type[str]]) -> pd.DataFrame:
    """Read a table as it was before it was written; a sample may be called NA."""
    return from_table(pd.read_csv(path, dtype=text, keep_default_na=False, na_values=[""]))


def publish_day(
    day: Day,
    found: Sequence[Found],
    reaction: Reaction | None,
    failed: Sequence[tuple[str, str]],
    out: Path,
) -> None:
    """Write the tables and the page of all movies; each file is written whole or not at all."""
    movies = gather.movie_table(day, found, out)
    species = compare.match_species(gather.species_table(found))[list(gather.SPECIES_COLUMNS)]
    shifted = compare.shifts(species[species["role"] != "calibrant"], reference_of(found))
    series = [] if reaction is None else compare.find_equilibria(found, reaction)
    tables = {"movies": movies, "species": species, "shifts": shifted}
    if reaction is not None:
        tables["kd"] = compare.kd_table(series, reaction)
    else:
        (out / "kd.csv").unlink(missing_ok=True)
    for name, table in tables.items():
        text = in_table(table).to_csv(
            index=False, float_format=f"%.{CSV_DIGITS}g", lineterminator="\n"
        )
        write_whole(out / f"{name}.csv", text)
    contents = _contents(day, found, tables, series, failed)
    page = batch_page(day.plan.table.title, summary_line(movies), contents)
    write_whole(out / "batch.html", page)
    own = movies[list(movies.columns[len(MOVIE_COLUMNS) :])]
    with whole_file(out / "events.parquet") as partial:
        gather.write_events(found, own, partial)


def _contents(
    day: Day,
    found: Sequence[Found],
    tables: Mapping[str, pd.DataFrame],
    series: Sequence[compare.Series],
    failed: Sequence[tuple[str, str]],
) -> BatchContents:
    """Gather what the page shows."""
    groups = {each.movie.name: _group(each) for each in found}
    movies, species = tables["movies"], tables["species"]
    timed = movies["seconds_searched"].notna() | movies["frames_searched"].isna()
    per_second = bool(timed.all())
    exposure = movies["seconds_searched" if per_second else "frames_searched"].to_numpy(float)
    exposure = exposure if per_second else exposure / 1000
    counted = zip(movies["landings"].astype(float), exposure, strict=True)
    rates = [gather.poisson_rate(landings, time) for landings, time in counted]
    shown = movies.assign(
        group=movies["movie"].map(groups),
        rate=[rate[0] for rate in rates],
        rate_from=[rate[1] for rate in rates],
        rate_to=[rate[2] for rate in rates],
        rate_unit="second" if per_second else "1000 frames",
    )
    shown.attrs["further"] = list(movies.columns[len(MOVIE_COLUMNS) :])
    scales = {each.summary["mass_scale"] for each in found if each.summary}
    return BatchContents(
        curves=[_curve(each, groups[each.movie.name]) for each in found],
        movies=shown,
        species=species.assign(group=species["movie"].map(groups)),
        shifts=tables["shifts"],
        equilibria=[
            (each.condition, each.binding.to_dict(), each.remarks)
            for each in series
            if each.binding is not None
        ],
        calibrations=_calibrations(day),
        failed=[
            *failed,
            *((compare.kd_name(each.condition), each.why) for each in series if each.why),
        ],
        mass_label="mass [kDa]" if scales <= {"calibration"} else "mass, model scale [kDa]",
    )


def _calibrations(day: Day) -> list[tuple[str, str, str]]:
    """Say what was calibrated by what, and where its page is."""
    camera = "calibration/camera/camera.html" if "camera.gain_e_per_adu" in day.settings else ""
    mass = "calibration/mass/calibration.html" if "calibration" in day.settings else ""
    return [
        ("camera", day.camera, camera),
        ("optics", day.optics, ""),
        ("mass scale", day.mass, mass),
    ]


def _group(each: Found) -> str:
    """Give the panel of a movie: its condition, or its role."""
    row = each.movie.row
    return row.condition or (row.role if row.role in ("calibrant", "blank") else "")


def _curve(each: Found, group: str) -> Curve:
    curves = each.distribution.get("curves", {})
    grid, density = (np.array(curves.get(key, ()), dtype=float) for key in ("mass_kda", "density"))
    return Curve(
        each.movie.name, each.movie.row.sample, group, np.abs(each.masses_kda), grid, density
    )


def reference_of(found: Sequence[Found]) -> str:
    """Name the sample that the others are compared with: the first of the table."""
    described = (
        each.movie.row.sample
        for each in found
        if each.movie.row.role == "sample" and each.distribution.get("species")
    )
    return next(described, "")
