"""`iscat benchmark`: what the fits achieve, beside what can be achieved."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iscat_cli.challenge import publish_scores, ranking_table
from iscat_cli.console import Messages, failures, print_json, print_result, short, table
from iscat_cli.options import (
    ArchiveOption,
    EstimatorOption,
    JsonOption,
    OverwriteOption,
    SetOption,
    TimeLimitOption,
    WorkersOption,
    command,
)

if TYPE_CHECKING:
    from rich.table import Table

EXAMPLE = """Example: a thousand repetitions of one experiment; then the estimators
that can be named, and your own simulation compared with the bounds.

    iscat benchmark --config setup.toml --out benchmark --trials 1000

    iscat benchmark --list

    iscat benchmark --config setup.toml --truth true.csv --results results.csv
"""


@command
def benchmark(
    messages: Messages,
    *,
    config: Annotated[
        list[Path] | None,
        typer.Option(metavar="C.toml", help="Configuration; [bounds] describes the experiment."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Output folder.")] = None,
    estimator: EstimatorOption = None,
    listed: Annotated[
        bool, typer.Option("--list", help="Print the estimators that can be named.")
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="T.csv", help="Truth of one's own simulation, one row a particle."),
    ] = None,
    results: Annotated[
        Path | None, typer.Option(metavar="R.csv", help="Estimates of it, to be scored.")
    ] = None,
    time_limit: TimeLimitOption = 600.0,
    archive: ArchiveOption = None,
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
) -> None:
    """Measure spread, bias and coverage of the fits against CRB and QCRB.

    Draws synthetic shot noise, fits it in modes mass, localize and joint, of spheres in modes size
    and localize, and writes benchmark.json, benchmark.html and figures to the output folder. With
    --estimator, others see the same counts; each runs in a process of its own.
    """
    with failures(messages):
        from iscat_analysis.errors import ConfigError

        if listed:
            print_result(estimators_table())
            return
        if not config:
            raise ConfigError("--config is missing: give the configuration of the experiment")
        from iscat_analysis.config import load_config

        resolved = load_config(config, settings or ())

        if truth is not None or results is not None:
            if truth is None or results is None:
                raise ConfigError("--truth and --results belong together: give both")
            from iscat_contest.scoring import score_own

            scores = score_own(truth, results, resolved, command=messages.command)
            publish_scores(scores, out, archive, messages, overwrite=overwrite, as_json=as_json)
            return
        if out is None:
            raise ConfigError("--out is missing: give the folder that is to be written")
        from iscat_contest.benchmark import check_benchmark_output, run_benchmark, write_benchmark
        from iscat_contest.estimators import find_estimator
        from iscat_contest.publish import write_archive

        others = [find_estimator(text) for text in estimator or ()]
        for one in others:
            if one.missing:
                raise ConfigError(f"estimator {one.name}: {one.missing}")
        check_benchmark_output(out, overwrite)
        with messages.progress() as progress:
            study = run_benchmark(
                resolved,
                trials=trials,
                seed=seed,
                workers=workers,
                posterior=posterior,
                estimators=others,
                time_limit_s=time_limit,
                command=messages.command,
                progress=progress,
            )
        write_benchmark(study, out, overwrite=overwrite)
        if archive is not None:
            write_archive(out, archive, title="Benchmark", overwrite=overwrite)
        if as_json:
            print_json("benchmark", study)
        else:
            print_result(benchmark_table(study))
            if others:
                print_result(ranking_table(study))
            print_result(f"report: {out / 'benchmark.html'}")
        for note in left_out(study):
            messages.notify(note)


def estimators_table() -> Table:
    """Tabulate the estimators that can be named."""
    from iscat_contest.estimators import known_estimators

    shown = table("estimator", "what it is", "")
    for column in shown.columns:
        column.justify = "left"
    for one in known_estimators():
        shown.add_row(one.name, one.about, one.missing)
    return shown


def left_out(study: Mapping[str, Any]) -> list[str]:
    """Say where fits are part of no bias and no spread though they did not fail."""
    from iscat_analysis.report.benchmark import MODES

    notes = []
    for mode, (status, several, key) in product(MODES, _AMBIGUOUS):
        if mode not in study or not (ambiguous := study[mode]["flagged"][status]):
            continue
        verb = "is" if ambiguous == 1 else "are"
        notes.append(
            f"mode {mode}: of {study[mode]['trials']} fits {ambiguous} {verb} {status} and "
            f"left out of bias and spread: several {several} describe the pixels about as well; "
            "more photons or frames (bounds.photons_per_pixel, bounds.n_after) or a narrower "
            f"{key} tell which"
        )
    return notes


_AMBIGUOUS = (
    ("ambiguous_z", "heights", "fit.z_range_nm"),
    ("ambiguous_size", "diameters", "fit.diameter_range_nm"),
)


def benchmark_table(study: Mapping[str, Any]) -> Table:
    """Tabulate what benchmark.json holds: one row per mode and parameter."""
    from iscat_analysis.report.benchmark import MODES

    headings = ("bias", "spread", "CRB", "QCRB", "spread/CRB", "95 % interval", "coverage 68 %")
    found = table("mode", "parameter", *headings, "failed")
    found.columns[1].justify = "left"
    for mode in MODES:
        entry = study.get(mode, {})
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
