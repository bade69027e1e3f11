"""`iscat simulate`, `benchmark` and `challenge`: movies of known truth, and scores of fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from iscat_cli.console import Messages, listing, print_result, short, table
from iscat_cli.options import Count, Output, Seed, Setup, Written, command

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from iscat_analysis.findings import Finding
    from iscat_contest.estimators import Estimator

SUMMARY = "Make movies of withheld truth; score any program on them."


@command
def simulate(
    messages: Messages,
    *,
    config: list[Path],
    out: Path,
    seed: Seed = None,
    set_: list[str] | None = None,
    written: Written,
) -> None:
    """Write a shot-noise movie of particles whose position and mass are known.

    They land and leave ([[simulation.events]], simulation.count) or diffuse
    ([[simulation.movers]], blurred by the exposure, with the truth of every frame).

    Options
    -------
    --config C.toml
        Configuration with a [simulation] section.
    --out STACK.tif
        The movie to write; STACK.truth.csv is written beside it.
    --seed N
        Seed of the random numbers, instead of the configured one.
    --set section.key=value
        Change one key of the configuration, as in optics.na=1.42; may be repeated.

    Example: the same seed writes the same bytes.

        iscat simulate --config sample_configs/mass.toml --out movie.tif --seed 7
    """
    resolved = Setup(config, set_).load()

    from iscat_analysis.study import write_stack
    from iscat_analysis.units import count

    with messages.progress() as progress:
        truth = write_stack(
            resolved, out, seed=seed, overwrite=written.overwrite, progress=progress
        )
    number = len(truth)
    if "track" in truth:  # rows are frames where particles move
        number = int(truth["track"].isna().sum() + truth["track"].nunique())
    beside = out.with_suffix(".truth.csv")
    values = {"stack": str(out), "truth": str(beside), "events": truth.to_dict("records")}
    messages.show("simulate", values, [f"{count(number, 'particle')} in {out}, truth in {beside}"])


@dataclass(frozen=True)
class Estimators:
    """Which estimators take part, and where their scores are packed.

    Options
    -------
    --estimator NAME|PACKAGE:FUNCTION
        One that `iscat benchmark --list` names, or a function; may be repeated.
    --time-limit S
        Of each estimator [s].
    --archive OUT.zip
        Pack the output, ready for a repository.
    """

    estimator: list[str] | None = None
    time_limit: Annotated[float, typer.Option(min=1.0)] = 600.0
    archive: Path | None = None

    def found(self, messages: Messages) -> list[Estimator]:
        """Find the estimators, all of which can run here."""
        from iscat_analysis.errors import ConfigError
        from iscat_contest.estimators import BUILT_IN, TRUSTED, find_estimator

        estimators = [find_estimator(text) for text in self.estimator or ()]
        for one in estimators:
            if one.missing:
                raise ConfigError(f"estimator {one.name}: {one.missing}")
        if not {*estimators} <= {*BUILT_IN}:
            messages.note(f"estimators of others are {TRUSTED}")
        return estimators


@dataclass(frozen=True)
class Repeated:
    """How an experiment is repeated.

    Options
    -------
    --trials N
        Repetitions in each mode.
    --seed N
        Seed of the random numbers: the same seed gives the same result.
    --posterior/--no-posterior
        Sample a posterior for one in 20 repetitions.
    --workers N
        Threads.
    """

    trials: Annotated[int, typer.Option(min=20)] = 1000
    seed: Annotated[int, typer.Option(min=0)] = 1
    posterior: bool = True
    workers: Count = None


@dataclass(frozen=True)
class Own:
    """One's own simulation.

    Options
    -------
    --truth T.csv
        Its truth, one row a particle.
    --results R.csv
        Estimates of it, to be scored.
    """

    truth: Path | None = None
    results: Path | None = None


@command
def benchmark(
    messages: Messages,
    *,
    list_: bool = False,
    own: Own,
    repeated: Repeated,
    estimators: Estimators,
    setup: Setup,
    output: Output,
) -> None:
    """Measure spread, bias and coverage of the fits against CRB and QCRB.

    Draws synthetic shot noise, fits it in modes mass, localize and joint, of spheres in modes size
    and localize, and writes benchmark.json and benchmark.html to the output folder. With
    --estimator, others see the same counts; each runs in a process of its own.

    Options
    -------
    --config C.toml
        Configuration; [bounds] describes the experiment.
    --list
        Print the estimators that can be named.

    Example: a thousand repetitions of one experiment; then the estimators
    that can be named, and your own simulation compared with the bounds.

        iscat benchmark --config setup.toml --out benchmark --trials 1000

        iscat benchmark --list

        iscat benchmark --config setup.toml --truth true.csv --results results.csv
    """
    from iscat_analysis.errors import ConfigError

    if list_:
        print_result(_known_estimators())
        return
    if not setup.config:
        raise ConfigError("--config is missing: give the configuration of the experiment")
    resolved = setup.load()

    if own.truth is not None or own.results is not None:
        if own.truth is None or own.results is None:
            raise ConfigError("--truth and --results belong together: give both")
        from iscat_contest.scoring import score_own

        scores = score_own(own.truth, own.results, resolved, command=messages.command)
        _publish(messages, scores, estimators.archive, output)
        return
    if output.out is None:
        raise ConfigError("--out is missing: give the folder that is to be written")
    from iscat_analysis.report import BENCHMARK_NAMES
    from iscat_contest.benchmark import run_benchmark, write_benchmark
    from iscat_contest.scoring import write_archive

    others = estimators.found(messages)
    output.check(BENCHMARK_NAMES)
    how: Any = {"time_limit_s": estimators.time_limit, "command": messages.command}
    with messages.progress() as progress:
        study = run_benchmark(
            resolved, estimators=others, **vars(repeated), **how, progress=progress
        )
    write_benchmark(study, output.out, overwrite=output.overwrite)
    if estimators.archive is not None:
        write_archive(output.out, estimators.archive, title="Benchmark", overwrite=output.overwrite)
    lines = [benchmark_table(study), *([_ranking(study)] if others else [])]
    messages.show("benchmark", study, [*lines, f"report: {output.out / 'benchmark.html'}"])
    messages.report(*_left_out(study))


def _known_estimators() -> Table:
    from iscat_contest.estimators import known_estimators

    rows = ((one.name, one.about, one.missing) for one in known_estimators())
    return table("estimator", "what it is", "", rows=rows, left=(0, 1, 2))


def _left_out(study: Mapping[str, Any]) -> Iterator[Finding]:
    """Say where fits are part of no bias and no spread though they did not fail."""
    from iscat_analysis.findings.setup import AMBIGUOUS_FITS
    from iscat_analysis.report.benchmark import MODES

    alike = (
        ("ambiguous_z", "heights", "fit.z_range_nm"),
        ("ambiguous_size", "diameters", "fit.diameter_range_nm"),
    )
    for mode, (status, several, key) in product(MODES, alike):
        if mode in study and (ambiguous := study[mode]["flagged"][status]):
            values = {"mode": mode, "ambiguous": ambiguous, "trials": study[mode]["trials"]}
            yield AMBIGUOUS_FITS(values | {"status": status, "several": several, "key": key})


def benchmark_table(study: Mapping[str, Any]) -> Table:
    """Tabulate what benchmark.json holds: one row per mode and parameter."""
    from iscat_analysis.report.benchmark import MODES

    records = []
    for mode in MODES:
        entry = study.get(mode, {})
        for name, values in entry.items():
            if isinstance(values, Mapping) and "spread_over_crb" in values:
                records.append({**entry, **values, "mode": mode, "name": name})
    return listing(
        records,
        "mode | parameter | bias | spread | CRB | QCRB | spread/CRB | 95 % interval | "
        "coverage 68 % | failed",
        "{mode} | {name} | {bias:.3g} | {spread:.3g} | {crb:.3g} | {qcrb:.3g} | "
        "{spread_over_crb:.3g} | {spread_over_crb_ci95[0]:.3g}–{spread_over_crb_ci95[1]:.3g} | "
        "{coverage68:.3g} | {failed} of {trials}",
        left=(0, 1),
    )


@dataclass(frozen=True)
class Drawn:
    """What is drawn for a challenge.

    Options
    -------
    --preset
        easy: one particle in each stack; realistic: landing movies; hard: the same under an
        unknown microscope; dong2021: the set-ups of that paper.
    --stacks N
        Stacks, with --config.
    --seed N
        Same seed, same bytes; default 1.
    """

    preset: Literal["easy", "realistic", "hard", "dong2021"] | None = None
    stacks: Annotated[int, typer.Option(min=1, max=9999)] = 100
    seed: Seed = None


@command
def make(
    messages: Messages,
    *,
    out: Path,
    blind: bool = False,
    drawn: Drawn,
    setup: Setup,
    overwrite: bool = False,
) -> None:
    """Write movies and stacks with a manifest, and their truth in a file of its own.

    The manifest names every file and the truth by hash, so that results can be shown to be blind.

    Options
    -------
    --out DIR
        The challenge.
    --config C.toml
        In place of a preset: stacks of [bounds], and a movie of [simulation].
    --blind
        Draw a secret seed, and keep the truth beside the folder, DIR.truth.json.
    --overwrite
        Replace earlier output.

    Example: a hundred stacks of one particle each, and their truth.

        iscat challenge make --preset easy --out easy
    """
    from iscat_analysis.errors import ConfigError

    if (drawn.preset is None) == (not setup.config):
        raise ConfigError("give --preset or --config, one of them")
    if drawn.preset is not None and setup.set_:
        raise ConfigError("--set changes a configuration: give --config, and no --preset")
    from iscat_contest.challenge import make_challenge, parts_of_config, preset_parts, truth_beside

    if drawn.preset is not None:
        parts, name = preset_parts(drawn.preset), str(drawn.preset)
    else:
        parts = parts_of_config(setup.load(), drawn.stacks)
        name = "-".join(path.stem for path in setup.config or ())
    with messages.progress() as progress:
        manifest = make_challenge(
            parts,
            out,
            name=name,
            seed=drawn.seed,
            blind=blind,
            overwrite=overwrite,
            progress=progress,
        )
    files = sum(name.endswith(".tif") for name in manifest["files"])
    where = truth_beside(out).name if blind else "truth.json"
    print_result(f"{files} files in {out}, truth in {where}")
    print_result(f"SHA-256 of the truth: {manifest['truth_sha256']}")


@command
def score(
    messages: Messages,
    challenge: Path,
    results: list[Path] | None = None,
    *,
    truth: Path | None = None,
    estimators: Estimators,
    output: Output,
) -> None:
    """Score results against the truth and the bounds, and rank them.

    Rows are matched by file or event, in movies by place and frame. Estimators are given the
    counts of every particle, and a start within a pixel.

    Options
    -------
    DIR
        What `make` wrote.
    RESULTS.csv…
        Tables of PiSCAT, PhotoMol, Refeyn, Picasso, ThunderSTORM, or ours.
    --truth T.json
        The truth of a blind challenge.
    --out REPORT
        Folder for the page and challenge.json.

    Example: results of another program beside an estimator that is run here.

        iscat challenge score challenge results.csv --estimator gauss-ls --out scores
    """
    from iscat_analysis.errors import ConfigError

    if not results and not estimators.estimator:
        raise ConfigError("there is nothing to score: give results, or --estimator")
    from iscat_contest.challenge import read_challenge
    from iscat_contest.scoring import score_challenge

    others = estimators.found(messages)
    read = read_challenge(challenge, truth)
    how: Any = {"time_limit_s": estimators.time_limit, "command": messages.command}
    with messages.progress() as progress:
        scores = score_challenge(read, results or [], others, **how, progress=progress)
    _publish(messages, scores, estimators.archive, output)


def _publish(
    messages: Messages, scores: Mapping[str, Any], archive: Path | None, output: Output
) -> None:
    """Print scores, and write their page and archive."""
    from iscat_analysis.errors import ConfigError
    from iscat_contest.scoring import write_archive, write_scores

    lines: list[RenderableType] = [_scores_table(scores)]
    if output.out is not None:
        write_scores(scores, output.out, overwrite=output.overwrite)
        lines.append(f"report: {output.out / 'challenge.html'}")
    if archive is not None:
        if output.out is None:
            raise ConfigError("--archive packs the output folder: give --out")
        write_archive(output.out, archive, title=scores["title"], overwrite=output.overwrite)
    messages.show("challenge", scores, lines)
    for part, entries in scores["parts"].items():
        for who, entry in entries["estimators"].items():
            for name, found in entry.items():
                if isinstance(found, Mapping) and found.get("below_bound"):
                    messages.note(f"{part}, {who}, {name}: {found['verdict']}")
            for why, times in entry.get("failures", {}).items():
                messages.note(f"{part}, {who}: {times} of {entry['trials']} failed: {why}")


def _scores_table(scores: Mapping[str, Any]) -> Table:
    """Tabulate efficiency and what belongs to it, one row for each parameter of each estimator."""
    numbers = ("efficiency_crb", "bias", "rmse", "crb", "qcrb", "pull_std")
    records: list[dict[str, Any]] = []
    for part, entries in scores["parts"].items():
        for who, entry in entries["estimators"].items():
            place = {"part": part, "who": who, "trials": entry["trials"]}
            if entry["failed"] == entry["trials"]:
                nothing = {"efficiency_crb_ci95": (None, None), "name": "–", "answered": 0}
                records.append({**dict.fromkeys(numbers), **nothing, **place})
            for name, found in entry.items():
                if isinstance(found, Mapping) and "efficiency_crb" in found:
                    records.append({**found, **place, "name": name})
    return listing(
        records,
        "part | estimator | parameter | efficiency | 95 % | bias | rmse | CRB | QCRB | pull σ"
        " | answered",
        "{part} | {who} | {name} | {efficiency_crb:.3g} | {efficiency_crb_ci95[0]:.3g}–"
        "{efficiency_crb_ci95[1]:.3g} | {bias:.3g} | {rmse:.3g} | {crb:.3g} | {qcrb:.3g} | "
        "{pull_std:.3g} | {answered} of {trials}",
    )


def _ranking(study: Mapping[str, Any]) -> Table:
    """Tabulate the ranking of a benchmark."""
    rows = []
    for one in study["ranking"]:
        entry = study["estimators"][one["estimator"]]
        failed = sum(m["failed"] for m in entry.values() if isinstance(m, Mapping))
        below = "below the bound" if one["below_bound"] else short(one["kept"], 3)
        rows.append((one["estimator"], below, str(failed)))
    return table("estimator", "information kept", "failed", rows=rows)
