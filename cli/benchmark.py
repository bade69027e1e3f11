"""`iscat benchmark`: what the fits achieve, beside what can be achieved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iscat_cli.console import Messages, failures, print_json, print_result, short, table
from iscat_cli.options import (
    DebugOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    SetOption,
    WorkersOption,
)

if TYPE_CHECKING:
    from rich.table import Table

EXAMPLE = """Example: a thousand repetitions of one experiment.

    iscat benchmark --config setup.toml --out benchmark --trials 1000
"""

MODES = ("mass", "localize", "joint")


def benchmark(
    context: typer.Context,
    *,
    config: Annotated[
        Path,
        typer.Option(metavar="C.toml", help="Configuration; [bounds] describes the experiment."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder.")],
    trials: Annotated[
        int, typer.Option(min=20, metavar="N", help="Repetitions in each mode.")
    ] = 1000,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="N",
            help="Seed of the random numbers: the same seed gives the same result.",
        ),
    ] = 1,
    settings: SetOption = None,
    posterior: Annotated[
        bool,
        typer.Option(
            "--posterior/--no-posterior", help="Sample a posterior for one in 20 repetitions."
        ),
    ] = True,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> None:
    """Measure spread, bias and coverage of the fits against CRB and QCRB.

    Draws synthetic shot noise, fits it in modes mass, localize and joint, and writes
    benchmark.json, benchmark.html and figures to the output folder.
    """
    messages = Messages(context.command_path, quiet=quiet)
    with failures(messages, debug=debug):
        from iscat_analysis.config import load_config

        resolved = load_config(config, settings or ())

        from iscat_analysis.study import (
            check_benchmark_output,
            run_benchmark,
            write_benchmark,
        )

        check_benchmark_output(out, overwrite)
        with messages.progress() as progress:
            study = run_benchmark(
                resolved,
                trials=trials,
                seed=seed,
                workers=workers,
                posterior=posterior,
                command=context.obj,
                progress=progress,
            )
        write_benchmark(study, out, overwrite=overwrite)
        if as_json:
            print_json("benchmark", study)
        else:
            print_result(benchmark_table(study))
            print_result(f"report: {out / 'benchmark.html'}")
        for note in left_out(study):
            messages.notify(note)


def left_out(study: Mapping[str, Any]) -> list[str]:
    """Say where fits are part of no bias and no spread though they did not fail."""
    from iscat_analysis.records import Status

    notes = []
    for mode in MODES:
        entry = study[mode]
        ambiguous, trials = entry["flagged"][Status.AMBIGUOUS_Z], entry["trials"]
        if ambiguous:
            verb = "is" if ambiguous == 1 else "are"
            notes.append(
                f"mode {mode}: of {trials} fits {ambiguous} {verb} {Status.AMBIGUOUS_Z} and "
                "left out of bias and spread: several heights describe the pixels about as well; "
                "more photons or frames (bounds.photons_per_pixel, bounds.n_after) or a narrower "
                "fit.z_range_nm tell which"
            )
    return notes


def benchmark_table(study: Mapping[str, Any]) -> Table:
    """Tabulate what benchmark.json holds: one row per mode and parameter."""
    headings = ("bias", "spread", "CRB", "QCRB", "spread/CRB", "95 % interval", "coverage 68 %")
    found = table("mode", "parameter", *headings, "failed")
    found.columns[1].justify = "left"
    for mode in MODES:
        entry = study[mode]
        for name, values in entry.items():
            if not isinstance(values, Mapping) or "spread_over_crb" not in values:
                continue
            low, high = (short(end, 3) for end in values["spread_over_crb_ci95"])
            found.add_row(
                mode,
                name,
                *(short(values[key], 3) for key in ("bias", "spread", "crb", "qcrb")),
                short(values["spread_over_crb"], 3),
                "–" if "–" in (low, high) else f"{low}–{high}",
                short(values["coverage68"], 3),
                f"{entry['failed']} of {entry['trials']}",
            )
    return found
