"""`iscat challenge`: movies whose truth is withheld, and the scores of what others made of them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iscat_cli.console import Messages, failures, print_json, print_result, short, table
from iscat_cli.options import (
    ArchiveOption,
    EstimatorOption,
    JsonOption,
    OverwriteOption,
    SetOption,
    TimeLimitOption,
    command,
)

if TYPE_CHECKING:
    from rich.table import Table

SUMMARY = "Make movies of withheld truth; score any program on them."

MAKE_EXAMPLE = """Example: a hundred stacks of one particle each, and their truth.

    iscat challenge make --preset easy --out easy
"""

SCORE_EXAMPLE = """Example: results of another program beside an estimator that is run here.

    iscat challenge score challenge results.csv --estimator gauss-ls --out scores
"""


class Preset(StrEnum):
    """Challenges that are ready."""

    EASY = "easy"
    REALISTIC = "realistic"
    HARD = "hard"
    DONG2021 = "dong2021"


@command
def make(
    messages: Messages,
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="The challenge.")],
    preset: Annotated[
        Preset | None,
        typer.Option(
            "--preset",
            help="easy: one particle in each stack; realistic: landing movies; hard: the same "
            "under an unknown microscope; dong2021: the set-ups of that paper.",
        ),
    ] = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="C.toml",
            help="In place of a preset: stacks of [bounds], and a movie of [simulation].",
        ),
    ] = None,
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="Draw a secret seed, and keep the truth beside the folder, DIR.truth.json.",
        ),
    ] = False,
    stacks: Annotated[
        int, typer.Option(min=1, max=9999, metavar="N", help="Stacks, with --config.")
    ] = 100,
    seed: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Same seed, same bytes; default 1.")
    ] = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write movies and stacks with a manifest, and their truth in a file of its own.

    The manifest names every file and the truth by hash, so that results can be shown to be blind.
    """
    with failures(messages):
        from iscat_analysis.errors import ConfigError

        if (preset is None) == (not config):
            raise ConfigError("give --preset or --config, one of them")
        if preset is not None and settings:
            raise ConfigError("--set changes a configuration: give --config, and no --preset")
        from iscat_contest.challenge import (
            make_challenge,
            parts_of_config,
            preset_parts,
            truth_beside,
        )

        if config:
            from iscat_analysis.config import load_config

            parts = parts_of_config(load_config(config, settings or ()), stacks)
            name = "-".join(path.stem for path in config)
        else:
            name = str(preset)
            parts = preset_parts(name)
        with messages.progress() as progress:
            manifest = make_challenge(
                parts, out, name=name, seed=seed, blind=blind, overwrite=overwrite,
                progress=progress,
            )  # fmt: skip
        files = sum(name.endswith(".tif") for name in manifest["files"])
        where = truth_beside(out).name if blind else "truth.json"
        print_result(f"{files} files in {out}, truth in {where}")
        print_result(f"SHA-256 of the truth: {manifest['truth_sha256']}")


@command
def score(
    messages: Messages,
    challenge: Annotated[Path, typer.Argument(metavar="DIR", help="What `make` wrote.")],
    results: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RESULTS.csv…",
            help="Tables of PiSCAT, PhotoMol, Refeyn, Picasso, ThunderSTORM, or ours.",
        ),
    ] = None,
    *,
    estimator: EstimatorOption = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="T.json", help="The truth of a blind challenge.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="REPORT", help="Folder for the page and challenge.json.")
    ] = None,
    archive: ArchiveOption = None,
    time_limit: TimeLimitOption = 600.0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Score results against the truth and the bounds, and rank them.

    Rows are matched by file or event, in movies by place and frame. Estimators are given the
    counts of every particle, and a start within a pixel.
    """
    with failures(messages):
        from iscat_analysis.errors import ConfigError

        if not results and not estimator:
            raise ConfigError("there is nothing to score: give results, or --estimator")
        from iscat_contest.challenge import read_challenge
        from iscat_contest.estimators import find_estimator
        from iscat_contest.scoring import score_challenge

        others = [find_estimator(text) for text in estimator or ()]
        for one in others:
            if one.missing:
                raise ConfigError(f"estimator {one.name}: {one.missing}")
        read = read_challenge(challenge, truth)
        with messages.progress() as progress:
            scores = score_challenge(
                read, results or [], others, time_limit_s=time_limit, command=messages.command,
                progress=progress,
            )  # fmt: skip
        publish_scores(scores, out, archive, messages, overwrite=overwrite, as_json=as_json)


def publish_scores(
    scores: Mapping[str, Any],
    out: Path | None,
    archive: Path | None,
    messages: Messages,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Print scores, and write their page and archive."""
    from iscat_analysis.errors import ConfigError
    from iscat_contest.publish import write_archive, write_scores

    if archive is not None and out is None:
        raise ConfigError("--archive packs the output folder: give --out")
    if out is not None:
        write_scores(scores, out, overwrite=overwrite)
        if archive is not None:
            write_archive(out, archive, title=scores["title"], overwrite=overwrite)
    if as_json:
        print_json("challenge", scores)
    else:
        print_result(scores_table(scores))
        if out is not None:
            print_result(f"report: {out / 'challenge.html'}")
    for part, entries in scores["parts"].items():
        for who, entry in entries["estimators"].items():
            for name, found in entry.items():
                if isinstance(found, Mapping) and found.get("below_bound"):
                    messages.notify(f"{part}, {who}, {name}: {found['verdict']}")
            for why, times in entry.get("failures", {}).items():
                messages.notify(f"{part}, {who}: {times} of {entry['trials']} failed: {why}")


def scores_table(scores: Mapping[str, Any]) -> Table:
    """Tabulate efficiency and what belongs to it, one row for each parameter of each estimator."""
    headings = ("efficiency", "95 %", "bias", "rmse", "CRB", "QCRB", "pull σ", "answered")
    shown = table("part", "estimator", "parameter", *headings)
    for part, entries in scores["parts"].items():
        for who, entry in entries["estimators"].items():
            if entry["failed"] == entry["trials"]:
                nothing = ["–"] * (len(headings) - 1)
                shown.add_row(part, who, "–", *nothing, f"0 of {entry['trials']}")
            for name, found in entry.items():
                if not isinstance(found, Mapping) or "efficiency_crb" not in found:
                    continue
                low, high = (short(end, 3) for end in found["efficiency_crb_ci95"])
                shown.add_row(
                    part, who, name, short(found["efficiency_crb"], 3), f"{low}–{high}",
                    *(short(found[k], 3) for k in ("bias", "rmse", "crb", "qcrb", "pull_std")),
                    f"{found['answered']} of {entry['trials']}",
                )  # fmt: skip
    return shown


def ranking_table(study: Mapping[str, Any]) -> Table:
    """Tabulate the ranking of a benchmark."""
    shown = table("estimator", "information kept", "failed")
    for one in study["ranking"]:
        entry = study["estimators"][one["estimator"]]
        failed = sum(m["failed"] for m in entry.values() if isinstance(m, Mapping))
        below = "below the bound" if one["below_bound"] else short(one["kept"], 3)
        shown.add_row(one["estimator"], below, str(failed))
    return shown
