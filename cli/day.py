"""`iscat batch` and `iscat watch`: many movies, one picture; and movies while they are saved."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from iscat_cli import INTERRUPTED
from iscat_cli.answers import upper_end
from iscat_cli.console import Messages, listing, short
from iscat_cli.options import MovieSetup, Printed, command, numbers, parsed, two_numbers

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iscat_analysis.day import Batch

INCOMPLETE = 3
ROWS_SHOWN = 40


@dataclass(frozen=True)
class DaySetup(MovieSetup, Printed):
    """The configuration of a day's movies, its standards and its equilibria.

    Options
    -------
    --standards MASSES
        Masses of the standards in the calibrants [kDa], besides those of the table, as in
        66,146,480. 66:0.5 gives a mass its standard error; the default is 1 %.
    --kd
        Fit K_D to each condition with several concentrations, as iscat kd does.
    --kd-masses M | A,B
        Approximate mass of the monomer, or of A and B [kDa], from which the fit starts; default:
        the monomer is found.
    """

    standards: str | None = None
    kd: Literal["dimer", "ab"] | None = None
    kd_masses: str | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the library's functions."""
        names = ("config", "calibration", "standards", "kd", "scheduler", "scheduler_file")
        masses = numbers("--kd-masses", self.kd_masses)
        given = {name: getattr(self, name) for name in names}
        return given | {"settings": self.changes, "kd_masses_kda": masses}


@command
def batch(
    messages: Messages,
    samples: Path,
    *,
    out: Path,
    only: str | None = None,
    merge: bool = False,
    setup: DaySetup,
) -> None:
    """Analyse the movies of a day and set them side by side.

    Flats give the camera and calibrants the optics and the mass scale of all other movies. Writes
    batch.html, movies.csv, species.csv, shifts.csv and events.parquet to the folder, with
    the result of each movie in movies. What is finished and has not changed is left alone.

    Options
    -------
    SAMPLES
        A table of movies, CSV or TOML, or a folder of movies.
    --out DIR
        Folder of the batch; an earlier one is brought up to date.
    --only K/N
        Analyse part K of N of the movies, and the calibrations unless another part makes them; no
        page is made.
    --merge
        Analyse nothing; make the page of what is finished.

    Example: a table with one row per movie, the standards' masses in it.

        iscat batch samples.csv --config setup.toml --out day

    samples.csv: columns path, sample, condition, concentration_nm, replicate,
    role (sample, calibrant, blank, flat), standards; any other is kept, and one
    named as a key of the configuration, as background.frames, sets it.

    Job array: --only K/N in every job, then --merge once.  Dask cluster:
    --scheduler tcp://10.0.0.1:8786; its machines share the file system.

    Exit status: 0 done; 2 usage, table or configuration; 3 done, but some movies
    or calibrations failed, which are listed; 130 interrupted, and the same
    command goes on.
    """
    from iscat_analysis.errors import ConfigError

    if only is not None and merge:
        raise ConfigError(f"--only {only}: parts are analysed first, and merged when all are")
    form = "write it as K/N, as in --only 1/4 for the first of four"
    part = parsed("--only", only, _part, form)

    from iscat_analysis.day import batch as run

    how: Any = {"only": part, "merge": merge, "command": messages.command}
    with messages.telling() as told:
        found = run(samples, out=out, **setup.arguments, **how, **told)
    messages.show("batch", found.to_dict(), _lines(found, part))
    for name, why in found.failed:
        messages.error(f"{name}: {why}")
    if found.failed:
        raise typer.Exit(INCOMPLETE)


def _part(text: str) -> tuple[int, int]:
    part, parts = two_numbers(text, "/")
    if not 1 <= part <= parts:
        raise ValueError(text)
    return part, parts


def _lines(found: Batch, part: tuple[int, int] | None = None) -> Iterator[RenderableType]:
    """Print a line per movie, and what there is now; of one part, how many movies are done."""
    from iscat_analysis.day.compare import kd_name
    from iscat_analysis.units import count

    number = int((found.movies["state"] == "done").sum())
    done = f"{number} of {len(found.movies)} movies done, {len(found.analysed)} of them now"
    if part is not None:
        yield f"part {part[0]} of {part[1]}: {done}; results in {found.out}"
        return
    rows = found.movies.head(ROWS_SHOWN).to_dict("records")
    species = found.species[~found.species["outlier"].astype(bool)].groupby("movie")
    for row in rows:
        states = {"failed": row["why"], "missing": "not analysed yet"}
        texts = {"answer": row["answer"], "cautions": states.get(row["state"], row["cautions"])}
        row |= {name: text if isinstance(text, str) else "" for name, text in texts.items()}
        if row["movie"] in species.groups and "kDa" in row["answer"]:  # else contrasts are
            found_there = species.get_group(row["movie"]).to_dict("records")
            row["answer"] = "\n".join(map(_species, found_there))
    shown = listing(
        rows,
        "movie | sample | events | landings | species or median | cautions",
        "{movie} | {sample} | {events:.4g} | {landings:.4g} | {answer} | {cautions}",
        left=(0, 1, 4, 5),
    )
    for column in shown.columns[4:]:
        column.no_wrap = False
    yield shown
    for row in found.kd.to_dict("records"):
        if not row["why"]:
            p = "" if math.isnan(row["p_value"]) else f", p = {row['p_value']:.2g}"
            notes = f"; {row['remarks']}" if row["remarks"] else ""
            yield (
                f"{kd_name(row['condition'])} = {short(row['kd_nm'])} nM (95 %: "
                f"{short(row['kd_low'])} to {upper_end(row['kd_high'])}), "
                f"{count(row['movies'], 'movie')}{p}{notes}"
            )
    if len(found.movies) > ROWS_SHOWN:
        yield f"… and {len(found.movies) - ROWS_SHOWN} more in {found.out / 'movies.csv'}"
    yield f"{done}; results in {found.out}, open {found.page}"


def _species(row: Mapping[str, Any]) -> str:
    """Print a species of a movie: its mass with its interval, events and share."""
    mass, low, high = (short(row[f"mass{end}"], 3) for end in ("_kda", "_low", "_high"))
    share = f", {100 * row['share']:.0f} %" if row["share"] == row["share"] else ""
    return f"{mass} kDa ({low} to {high}): {row['count']:.0f}{share}"


@command
def watch(
    messages: Messages,
    folder: Path,
    *,
    out: Path | None = None,
    interval: float = 10.0,
    setup: DaySetup,
) -> None:
    """Analyse movies as they are saved, and keep batch.html current, until Ctrl-C.

    What is still being written is waited for. A movie that fails is told once, and tried again when
    it changes. Results are those of iscat batch, which may go on with them.

    Options
    -------
    FOLDER|MOVIE
        Folder that movies are saved in, or one movie that is being recorded.
    --out DIR
        Folder of the batch; default FOLDER/batch; an earlier one is brought up to date. Of one
        movie: default its name with .iscat.
    --interval S
        Seconds between two checks.

    Example: a folder that the microscope writes to.

        iscat watch movies --config setup.toml

    Movies that samples.csv or samples.toml in the folder names are what it says,
    as for iscat batch; it may grow as well. The others are samples.

    One movie that is still being recorded, a TIFF, HDF5 or Zarr that grows:

        iscat watch movie.tif --config setup.toml

    What is there is analysed as it grows, with a histogram of the masses; once it
    rests, the result is that of iscat fit, in movie.iscat or --out. Without
    --config it takes iscat.toml beside the movie, as iscat fit does.

    Exit status, after Ctrl-C: 0 everything is analysed; 3 some movies or
    calibrations failed, which are listed; 130 a movie was interrupted, and the
    same command goes on; 2 usage, table or configuration.
    """
    from iscat_analysis.movie import is_movie

    if is_movie(folder):
        _watch_one(messages, folder, out, setup, interval)
        return
    from iscat_analysis.day.watch import FOLDER
    from iscat_analysis.day.watch import watch as run

    how: Any = {"interval_s": interval, "command": messages.command}
    with messages.telling() as told:
        found = run(folder, out=out, **setup.arguments, **how, **told)
    if found is None:
        nothing = dict.fromkeys(("movies", "species", "kd", "analysed", "failed"), ())
        values = {"out": str(out or folder / FOLDER), **nothing}
        messages.show("batch", values, [f"no movie came into {folder}"])
        return
    messages.show("batch", found.to_dict(), _lines(found))
    missing = set(found.movies["movie"][found.movies["state"] == "missing"])
    failed = [(name, why) for name, why in found.failed if name not in missing]
    for name, why in failed:
        messages.error(f"{name}: {why}")
    if missing or failed:
        raise typer.Exit(INTERRUPTED if missing else INCOMPLETE)


def _watch_one(
    messages: Messages, movie: Path, out: Path | None, setup: DaySetup, interval: float
) -> None:
    """Watch one movie that is being recorded."""
    from iscat_analysis.day.watch import watch_movie
    from iscat_analysis.errors import ConfigError
    from iscat_analysis.movie import path_beside

    without_effect = {
        "--standards": setup.standards,
        "--kd": setup.kd,
        "--kd-masses": setup.kd_masses,
        "--scheduler": None if setup.scheduler == "threads" else setup.scheduler,
        "--scheduler-file": setup.scheduler_file,
    }
    for option, value in without_effect.items():
        if value is not None:
            raise ConfigError(
                f"{option} is for a folder of movies, and {movie} is one movie: leave it out, or "
                "give the folder"
            )
    folder = path_beside(movie, ".iscat") if out is None else out
    config, how = setup.of(movie, messages), {"command": messages.command}
    with messages.telling() as told:
        found = watch_movie(movie, config, out=folder, interval_s=interval, **how, **told)
    rows = found.table.to_dict("records")
    values = {**found.summary, "events": rows, "out": str(folder)}
    messages.show("fit", values, [f"{len(rows)} events; results in {folder}"])
