"""Options that several commands share."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from iscat_cli.console import Messages


class Mode(StrEnum):
    """What is fitted; the same names as `iscat_analysis.config.Mode`."""

    MASS = "mass"
    LOCALIZE = "localize"
    JOINT = "joint"
    SIZE = "size"
    TRACK = "track"


def complete_setting(incomplete: str) -> list[str]:
    """Offer to the shell every key of the configuration that begins so."""
    from iscat_analysis.config import SIMULATED, Config

    found = []
    for section, field in Config.model_fields.items():
        # [calibration] may be absent: its annotation is a union with None
        models = [part for part in (field.annotation, *get_args(field.annotation)) if part]
        keys = next(m.model_fields for m in models if hasattr(m, "model_fields"))
        found += [f"{section}.{key}=" for key in keys if key not in SIMULATED]
    return [name for name in found if name.startswith(incomplete)]


class Instrument(StrEnum):
    """Named set-ups; the same names as `iscat_analysis.instruments`."""

    MASS_PHOTOMETER_445 = "mass-photometer-445"
    MASS_PHOTOMETER_525 = "mass-photometer-525"
    ISCAT = "iscat"
    COBRI = "cobri"


InstrumentOption = Annotated[
    Instrument | None,
    typer.Option(
        "--instrument",
        metavar="NAME",
        help="Optics, pixels and light of a published set-up in place of the defaults: "
        f"{', '.join(Instrument)}.",
    ),
]

ModeOption = Annotated[
    Mode | None,
    typer.Option(
        "--mode",
        metavar="MODE",
        help="Free parameters: mass (x, y, mass), localize (x, y, z), joint (all four), "
        "size (x, y, z, diameter of a sphere), "
        "track (joint in every frame, linked).",
    ),
]

ConfigOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--config",
        metavar="C.toml",
        help="Configuration; `iscat config` prints one. Of several, keys of later ones win.",
    ),
]

CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        metavar="LINE.toml",
        help="Mass line, as `iscat calibrate mass` writes it, in place of any other: masses are "
        "those of the contrasts.",
    ),
]

SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="section.key=value",
        help="Change one key of the configuration, as in optics.na=1.42; may be repeated.",
        autocompletion=complete_setting,
    ),
]

WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=1, metavar="N", help="Threads.")
]

SchedulerOption = Annotated[
    str,
    typer.Option(
        "--scheduler",
        metavar="threads|tcp://HOST:PORT",
        help=(
            "Where the work runs: in threads of this process, or on the workers of a Dask cluster."
        ),
    ),
]

SchedulerFileOption = Annotated[
    Path | None,
    typer.Option(
        "--scheduler-file",
        metavar="F",
        help="The file to which the scheduler of the cluster wrote its address.",
    ),
]

EstimatorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        metavar="NAME|PACKAGE:FUNCTION",
        help="One that `iscat benchmark --list` names, or a function; may be repeated.",
    ),
]

TimeLimitOption = Annotated[
    float, typer.Option("--time-limit", min=1.0, metavar="S", help="Of each estimator [s].")
]

ArchiveOption = Annotated[
    Path | None,
    typer.Option("--archive", metavar="OUT.zip", help="Pack the output, ready for a repository."),
]

OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace earlier output.")]

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object instead of a table.")
]

QuietOption = Annotated[
    bool, typer.Option("--quiet", help="No progress and no messages; errors are still shown.")
]

DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def command(work: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that is given `messages`, with the options of every command."""

    @wraps(work)
    def run(context: typer.Context, *, quiet: bool, debug: bool, **given: Any) -> None:
        told = Messages(context.command_path, quiet=quiet, debug=debug, command=context.obj)
        if len(configs := given.get("config") or ()) > 1:
            first, *later = map(str, configs)
            told.notify(f"the configuration is {first}, with the keys of {', then '.join(later)}")
        work(told, **given)

    _, *own = inspect.signature(work, eval_str=True).parameters.values()
    only_named = inspect.Parameter.KEYWORD_ONLY
    offered = (
        inspect.Parameter("context", inspect.Parameter.POSITIONAL_ONLY, annotation=typer.Context),
        *own,
        inspect.Parameter("quiet", only_named, default=False, annotation=QuietOption),
        inspect.Parameter("debug", only_named, default=False, annotation=DebugOption),
    )
    vars(run)["__signature__"] = inspect.Signature(offered)
    run.__annotations__ = {each.name: each.annotation for each in offered}
    return run


def setup_of(
    movie: Path, config: list[Path] | None, messages: Messages
) -> Path | list[Path] | None:
    """Give the configuration of a movie: those that are named, else ``iscat.toml`` beside it."""
    from iscat_analysis.movie import setup_beside
    from iscat_analysis.reading import is_file

    beside = setup_beside(movie)
    if config or not is_file(beside):
        return config
    messages.notify(f"the configuration is {beside}, which lies beside the movie")
    return beside


def frame_range(option: str, text: str) -> tuple[int, int]:
    """Read a half-open range of frames, ``"A:B"``; messages name the option."""
    from iscat_analysis.errors import ConfigError

    match = re.fullmatch(r"\s*(\d+)\s*:\s*(\d+)\s*", text, flags=re.ASCII)
    if match is None or int(match[1]) >= int(match[2]):
        raise ConfigError(
            f"{option} {text}: write it as A:B, the first frame and the one after the last, "
            f"as in {option} 0:200"
        )
    return int(match[1]), int(match[2])


def channel_of(text: str) -> tuple[int, int]:
    """Read how many channels take turns, and which one is meant, ``"N:K"``."""
    from iscat_analysis.errors import ConfigError

    match = re.fullmatch(r"\s*(\d{1,4})\s*:\s*(\d{1,4})\s*", text, flags=re.ASCII)
    if match is None:
        raise ConfigError(
            f"--channels {text}: write it as N:K, how many channels take turns and which one is "
            "analysed, from 0, as in --channels 2:0"
        )
    return int(match[1]), int(match[2])


def with_workers(settings: list[str] | None, workers: int | None) -> list[str]:
    """Add the number of threads to changes of the configuration, last, so that they win."""
    return [*(settings or ()), *([f"compute.workers={workers}"] if workers else [])]
