"""`iscat watch`: movies are analysed as they are saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iscat_cli import INTERRUPTED
from iscat_cli.batch import (
    INCOMPLETE,
    KdMassesOption,
    KdOption,
    StandardsOption,
    print_batch,
)
from iscat_cli.console import Messages, failures, print_json, print_result, with_options
from iscat_cli.options import (
    ConfigOption,
    DebugOption,
    JsonOption,
    QuietOption,
    SchedulerFileOption,
    SchedulerOption,
    SetOption,
    WorkersOption,
    with_workers,
)
from iscat_cli.tables import numbers

EXAMPLE = """Example: a folder that the microscope writes to.

    iscat watch movies --config setup.toml

Movies that samples.csv or samples.toml in the folder names are what it says,
as for iscat batch; it may grow as well. The others are samples.

Exit status, after Ctrl-C: 0 everything is analysed; 3 some movies or
calibrations failed, which are listed; 130 a movie was interrupted, and the
same command goes on; 2 usage, table or configuration.
"""


def watch(
    context: typer.Context,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder that movies are saved in.")
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the batch; default FOLDER/batch; an earlier one is brought up to date.",
        ),
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    standards: StandardsOption = None,
    kd: KdOption = None,
    kd_masses: KdMassesOption = None,
    scheduler: SchedulerOption = "threads",
    scheduler_file: SchedulerFileOption = None,
    interval: Annotated[
        float, typer.Option(metavar="S", help="Seconds between two checks of the folder.")
    ] = 10.0,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> None:
    """Analyse movies as they are saved, and keep batch.html current, until Ctrl-C.

    What is still being written is waited for. A movie that fails is told once, and tried again when
    it changes. Results are those of iscat batch, which may go on with them.
    """
    messages = Messages(context.command_path, quiet=quiet)
    with failures(messages, debug=debug):
        from iscat_analysis.day.watch import FOLDER
        from iscat_analysis.day.watch import watch as run

        with messages.progress() as progress:
            found = run(
                folder,
                out=out,
                config=config,
                settings=with_workers(settings, workers),
                standards=standards,
                kd=None if kd is None else kd.value,
                kd_masses_kda=None if kd_masses is None else numbers("--kd-masses", kd_masses),
                scheduler=scheduler,
                scheduler_file=scheduler_file,
                interval_s=interval,
                progress=progress,
                notify=lambda line: messages.notify(with_options(line)),
                command=context.obj,
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
