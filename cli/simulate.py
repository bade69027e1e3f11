"""`iscat simulate`: a movie with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iscat_cli.console import Messages, failures, print_json, print_result
from iscat_cli.options import JsonOption, OverwriteOption, SetOption, command

EXAMPLE = """Example: the same seed writes the same bytes.

    iscat simulate --config sample_configs/mass.toml --out movie.tif --seed 7
"""


@command
def simulate(
    messages: Messages,
    *,
    config: Annotated[
        list[Path],
        typer.Option(metavar="C.toml", help="Configuration with a [simulation] section."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="STACK.tif", help="The movie to write; STACK.truth.csv is written beside it."
        ),
    ],
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, metavar="N", help="Seed of the random numbers, instead of the configured one."
        ),
    ] = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a shot-noise movie of particles whose position and mass are known.

    They land and leave ([[simulation.events]], simulation.count) or diffuse
    ([[simulation.movers]], blurred by the exposure, with the truth of every frame).
    """
    with failures(messages):
        from iscat_analysis.config import load_config

        resolved = load_config(config, settings or ())

        from iscat_analysis.study import write_stack

        with messages.progress() as progress:
            truth = write_stack(resolved, out, seed=seed, overwrite=overwrite, progress=progress)
        table = out.with_suffix(".truth.csv")
        if as_json:
            print_json(
                "simulate",
                {"stack": str(out), "truth": str(table), "events": truth.to_dict("records")},
            )
        else:
            from iscat_analysis.units import count

            number = len(truth)
            if "track" in truth:  # rows are frames where particles move
                number = int(truth["track"].isna().sum() + truth["track"].nunique())
            particles = count(number, "particle")
            print_result(f"{particles} in {out}, truth in {table}")
