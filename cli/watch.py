"""`iscat watch`: movies are analysed as they are saved, and one while it is being recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iscat_cli import INTERRUPTED
from iscat_cli.batch import INCOMPLETE, KdMassesOption, KdOption, StandardsOption, print_batch
from iscat_cli.console import Messages, failures, print_json, print_result, with_options
from iscat_cli.options import (
    CalibrationOption,
    ConfigOption,
    JsonOption,
    SchedulerFileOption,
    SchedulerOption,
    SetOption,
    WorkersOption,
    command,
    setup_of,
    with_workers,
)
from iscat_cli.tables import numbers

if TYPE_CHECKING:
    from iscat_analysis.config.overrides import Source

EXAMPLE = """Example: a folder that the microscope writes to.

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


@command
def watch(
    messages: Messages,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|MOVIE",
            help="Folder that movies are saved in, or one movie that is being recorded.",
        ),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the batch; default FOLDER/batch; an earlier one is brought up to date. "
            "Of one movie: default its name with .iscat.",
        ),
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    calibration: CalibrationOption = None,
    standards: StandardsOption = None,
    kd: KdOption = None,
    kd_masses: KdMassesOption = None,
    scheduler: SchedulerOption = "threads",
    scheduler_file: SchedulerFileOption = None,
    interval: Annotated[
        float, typer.Option(metavar="S", help="Seconds between two checks.")
    ] = 10.0,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Analyse movies as they are saved, and keep batch.html current, until Ctrl-C.

    What is still being written is waited for. A movie that fails is told once, and tried again when
    it changes. Results are those of iscat batch, which may go on with them.
    """
    with failures(messages):
        from iscat_analysis.movie import is_movie

        if is_movie(folder):
            given = {
                "--standards": standards,
                "--kd": kd,
                "--kd-masses": kd_masses,
                "--scheduler": None if scheduler == "threads" else scheduler,
                "--scheduler-file": scheduler_file,
            }
            _refuse_options_of_folders(folder, given)
            from iscat_analysis.calibration.line import with_line

            setup = with_line(setup_of(folder, config, messages), calibration)
            _watch_one(messages, folder, out, setup, settings, workers, interval, as_json=as_json)
            return
        from iscat_analysis.day.watch import FOLDER
        from iscat_analysis.day.watch import watch as run

        with messages.progress() as progress:
            found = run(
                folder,
                out=out,
                config=config,
                settings=with_workers(settings, workers),
                calibration=calibration,
                standards=standards,
                kd=None if kd is None else kd.value,
                kd_masses_kda=None if kd_masses is None else numbers("--kd-masses", kd_masses),
                scheduler=scheduler,
                scheduler_file=scheduler_file,
                interval_s=interval,
                progress=progress,
                notify=lambda line: messages.notify(with_options(line)),
                command=messages.command,
            )
        if found is None:
            if as_json:
                nothing = dict.fromkeys(("movies", "species", "kd", "analysed", "failed"), ())
                print_json("batch", {"out": str(out or folder / FOLDER), **nothing})
            else:
                print_result(f"no movie came into {folder}")
            return
        if as_json:
            print_json("batch", found.to_dict())
        else:
            print_batch(found)
        missing = set(found.movies["movie"][found.movies["state"] == "missing"])
        failed = [(name, why) for name, why in found.failed if name not in missing]
        for name, why in failed:
            messages.error(f"{name}: {why}")
        if missing:
            raise typer.Exit(INTERRUPTED)
        if failed:
            raise typer.Exit(INCOMPLETE)


def _refuse_options_of_folders(movie: Path, given: Mapping[str, object]) -> None:
    """Refuse options that one movie leaves without effect."""
    from iscat_analysis.errors import ConfigError

    for option, value in given.items():
        if value is not None:
            raise ConfigError(
                f"{option} is for a folder of movies, and {movie} is one movie: leave it out, or "
                "give the folder"
            )


def _watch_one(
    messages: Messages,
    movie: Path,
    out: Path | None,
    setup: Source | Sequence[Source] | None,
    settings: list[str] | None,
    workers: int | None,
    interval: float,
    *,
    as_json: bool,
) -> None:
    """Watch one movie that is being recorded."""
    from iscat_analysis.config import configure
    from iscat_analysis.day.watch import watch_movie
    from iscat_analysis.movie import path_beside

    folder = path_beside(movie, ".iscat") if out is None else out
    with messages.progress() as progress:
        found = watch_movie(
            movie,
            configure(setup, settings=with_workers(settings, workers)),
            out=folder,
            interval_s=interval,
            progress=progress,
            notify=lambda line: messages.notify(with_options(line)),
            command=messages.command,
        )
    rows = found.table.to_dict("records")
    if as_json:
        print_json("fit", {**found.summary, "events": rows, "out": str(folder)})
    else:
        print_result(f"{len(rows)} events; results in {folder}")
