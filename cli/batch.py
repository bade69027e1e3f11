"""`iscat batch`: many movies, one picture."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iscat_cli.console import Messages, failures, print_json, print_result, short, table
from iscat_cli.kd import Reaction, upper_end
from iscat_cli.options import (
    CalibrationOption,
    ConfigOption,
    JsonOption,
    SchedulerFileOption,
    SchedulerOption,
    SetOption,
    WorkersOption,
    command,
    with_workers,
)
from iscat_cli.tables import numbers

if TYPE_CHECKING:
    from iscat_analysis.day import Batch

INCOMPLETE = 3
ROWS_SHOWN = 40

StandardsOption = Annotated[
    str | None,
    typer.Option(
        "--standards",
        metavar="MASSES",
        help=(
            "Masses of the standards in the calibrants [kDa], besides those of the table, as "
            "in 66,146,480. 66:0.5 gives a mass its standard error; the default is 1 %."
        ),
    ),
]

KdOption = Annotated[
    Reaction | None,
    typer.Option(
        "--kd", help="Fit K_D to each condition with several concentrations, as iscat kd does."
    ),
]

KdMassesOption = Annotated[
    str | None,
    typer.Option(
        "--kd-masses",
        metavar="M | A,B",
        help=(
            "Approximate mass of the monomer, or of A and B [kDa], from which the fit starts;"
            " default: the monomer is found."
        ),
    ),
]

EXAMPLE = """Example: a table with one row per movie, the standards' masses in it.

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


@command
def batch(
    messages: Messages,
    samples: Annotated[
        Path,
        typer.Argument(
            metavar="SAMPLES", help="A table of movies, CSV or TOML, or a folder of movies."
        ),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of the batch; an earlier one is brought up to date."
        ),
    ],
    config: ConfigOption = None,
    settings: SetOption = None,
    calibration: CalibrationOption = None,
    standards: StandardsOption = None,
    kd: KdOption = None,
    kd_masses: KdMassesOption = None,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="K/N",
            help=(
                "Analyse part K of N of the movies, and the calibrations unless another part "
                "makes them; no page is made."
            ),
        ),
    ] = None,
    merge: Annotated[
        bool, typer.Option("--merge", help="Analyse nothing; make the page of what is finished.")
    ] = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "threads",
    scheduler_file: SchedulerFileOption = None,
    as_json: JsonOption = False,
) -> None:
    """Analyse the movies of a day and set them side by side.

    Flats give the camera and calibrants the optics and the mass scale of all other movies. Writes
    batch.html, movies.csv, species.csv, shifts.csv, events.parquet and figures to the folder, with
    the result of each movie in movies. What is finished and has not changed is left alone.
    """
    with failures(messages):
        part = _part(only, merge=merge)

        from iscat_analysis.day import batch as run

        with messages.progress() as progress:
            found = run(
                samples,
                out=out,
                config=config,
                settings=with_workers(settings, workers),
                calibration=calibration,
                standards=standards,
                kd=None if kd is None else kd.value,
                kd_masses_kda=None if kd_masses is None else numbers("--kd-masses", kd_masses),
                only=part,
                merge=merge,
                scheduler=scheduler,
                scheduler_file=scheduler_file,
                progress=progress,
                notify=messages.notify,
                command=messages.command,
            )
        if as_json:
            print_json("batch", found.to_dict())
        elif part is None:
            print_batch(found)
        else:
            done = int((found.movies["state"] == "done").sum())
            print_result(
                f"part {part[0]} of {part[1]}: {done} of {len(found.movies)} movies done, "
                f"{len(found.analysed)} of them now; results in {found.out}"
            )
        for name, why in found.failed:
            messages.error(f"{name}: {why}")
        if found.failed:
            raise typer.Exit(INCOMPLETE)


def _part(text: str | None, *, merge: bool) -> tuple[int, int] | None:
    """Read ``K/N``."""
    from iscat_analysis.errors import ConfigError

    if text is None:
        return None
    if merge:
        raise ConfigError(f"--only {text}: parts are analysed first, and merged when all are")
    match = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text, flags=re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ConfigError(f"--only {text}: write it as K/N, as in --only 1/4 for the first of four")
    return int(match[1]), int(match[2])


def print_batch(found: Batch) -> None:
    """Print a line per movie, and what there is now."""
    from iscat_analysis.day.compare import kd_name
    from iscat_analysis.units import count

    done = int((found.movies["state"] == "done").sum())
    shown = table("movie")
    shown.add_column("sample", no_wrap=True)
    for heading in ("events", "landings"):
        shown.add_column(heading, justify="right", no_wrap=True)
    shown.add_column("answer")
    shown.add_column("cautions")
    for row in found.movies.head(ROWS_SHOWN).to_dict("records"):
        cautions = row["why"] if row["state"] == "failed" else row["cautions"]
        cautions = "not analysed yet" if row["state"] == "missing" else cautions
        shown.add_row(
            str(row["movie"]),
            str(row["sample"]),
            *(short(row[name]) for name in ("events", "landings")),
            *(text if isinstance(text, str) else "" for text in (row["answer"], cautions)),
        )
    print_result(shown)
    for row in found.kd.to_dict("records"):
        if not row["why"]:
            p = "" if math.isnan(row["p_value"]) else f", p = {row['p_value']:.2g}"
            notes = f"; {row['remarks']}" if row["remarks"] else ""
            print_result(
                f"{kd_name(row['condition'])} = {short(row['kd_nm'])} nM (95 %: "
                f"{short(row['kd_low'])} to {upper_end(row['kd_high'])}), "
                f"{count(row['movies'], 'movie')}{p}{notes}"
            )
    if len(found.movies) > ROWS_SHOWN:
        print_result(f"… and {len(found.movies) - ROWS_SHOWN} more in {found.out / 'movies.csv'}")
    print_result(
        f"{done} of {len(found.movies)} movies done, {len(found.analysed)} of them now; "
        f"results in {found.out}, open {found.page}"
    )
