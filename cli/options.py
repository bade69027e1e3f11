"""How options are declared: once, beside what they mean, and in groups that commands share.

A command is a function with a type and a default for each of its options, which its docstring
lists under ``Options`` as a user writes them.  A parameter whose type is a frozen dataclass stands
for all options of that group; the docstring of a command may describe one of them anew.  Names of
options that Python reserves end with ``_`` here.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ForwardRef,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer.models import ArgumentInfo, OptionInfo

from iscat_analysis.options import Option, options_of
from iscat_cli.console import Messages, failures, with_options

if TYPE_CHECKING:
    from iscat_analysis.config import Config

Mode = Literal["mass", "localize", "joint", "size", "track"]
Instrument = Literal["mass-photometer-445", "mass-photometer-525", "iscat", "cobri"]
Count = Annotated[int | None, typer.Option(min=1)]
Seed = Annotated[int | None, typer.Option(min=0)]


def complete_setting(incomplete: str) -> list[str]:
    """Offer to the shell every key of the configuration that begins so."""
    from iscat_analysis.config import SIMULATED, Config, known_keys

    names = (
        f"{section}.{key}="
        for section in Config.model_fields
        for key in known_keys([section])
        if key not in SIMULATED
    )
    return [name for name in names if name.startswith(incomplete)]


@dataclass(frozen=True)
class Setup:
    """The configuration of a command.

    Options
    -------
    --config C.toml
        Configuration; `iscat config` prints one. Of several, keys of later ones win.
    --set section.key=value
        Change one key of the configuration, as in optics.na=1.42; may be repeated.
    """

    config: list[Path] | None = None
    set_: Annotated[list[str] | None, typer.Option(autocompletion=complete_setting)] = None

    @property
    def changes(self) -> list[str]:
        """Changes of the configuration, in their order: later ones win."""
        return list(self.set_ or ())

    def load(self) -> Config:
        """Read the configuration."""
        from iscat_analysis.config import load_config

        return load_config(self.config, self.changes)


@dataclass(frozen=True)
class ModeSetup(Setup):
    """The configuration, and what is fitted.

    Options
    -------
    --mode MODE
        Free parameters: mass (x, y, mass), localize (x, y, z), joint (all four), size (x, y, z,
        diameter of a sphere), track (joint in every frame, linked).
    """

    mode: Mode | None = None

    @property
    def changes(self) -> list[str]:
        """Changes of the configuration."""
        return [*super().changes, *([f'fit.mode="{self.mode}"'] if self.mode else [])]


@dataclass(frozen=True)
class MovieSetup(Setup):
    """The configuration and the mass line of movies, and where they are analysed.

    Options
    -------
    --calibration LINE.toml
        Mass line, as `iscat calibrate mass` writes it, in place of any other: masses are those of
        the contrasts.
    --workers N
        Threads.
    --scheduler threads|tcp://HOST:PORT
        Where the work runs: in threads of this process, or on the workers of a Dask cluster.
    --scheduler-file F
        The file to which the scheduler of the cluster wrote its address.
    """

    calibration: Path | None = None
    workers: Count = None
    scheduler: str = "threads"
    scheduler_file: Path | None = None

    @property
    def changes(self) -> list[str]:
        """Changes of the configuration."""
        return [*super().changes, *([f"compute.workers={self.workers}"] if self.workers else [])]

    def of(self, movie: Path, messages: Messages) -> Config:
        """Read the configuration of a movie: those given, else ``iscat.toml`` beside it."""
        from iscat_analysis.calibration import with_line
        from iscat_analysis.config import load_config
        from iscat_analysis.findings.setup import CONFIGURATION_BESIDE
        from iscat_analysis.movie import setup_beside
        from iscat_analysis.reading import is_file

        source: Path | list[Path] | None = self.config
        beside = setup_beside(movie)
        if not source and is_file(beside):
            messages.report(CONFIGURATION_BESIDE({"path": str(beside)}))
            source = beside
        return load_config(with_line(source, self.calibration), self.changes)


@dataclass(frozen=True)
class Printed:
    """How results are printed.

    Options
    -------
    --json
        Print one JSON object instead of a table.
    """

    json: bool = False


@dataclass(frozen=True)
class Written(Printed):
    """How results are written and printed.

    Options
    -------
    --overwrite
        Replace earlier output.
    """

    overwrite: bool = False


@dataclass(frozen=True)
class Output(Written):
    """Where results go.

    Options
    -------
    --out DIR
        Output folder.
    """

    out: Path | None = None

    def beside(self, source: Path, ending: str) -> Path:
        """Give the output folder; without ``--out`` its name is the source's with an ending."""
        from iscat_analysis.movie import path_beside

        return path_beside(source, ending) if self.out is None else self.out

    def check(self, known: frozenset[str]) -> None:
        """Refuse a folder that may not be written, before the work begins."""
        if self.out is not None:
            from iscat_analysis.report.output import check_output

            check_output(self.out, self.overwrite, known=known)


@dataclass(frozen=True)
class Command:
    """A command of the umbrella."""

    name: str
    summary: str
    example: str
    run: Callable[..., None]


@dataclass(frozen=True)
class _Always:
    """What every command takes.

    Options
    -------
    --quiet
        No progress and no messages; errors are still shown.
    --debug
        Show the traceback of an error.
    """

    quiet: bool = False
    debug: bool = False


def command(work: Callable[..., None]) -> Command:
    """Make a command of a function, which may ask for `messages`, with the options of all."""
    about, helps, example = _read(work.__doc__)
    arguments = iter([name for name in helps if not name.startswith("--")])
    declared = inspect.signature(work, eval_str=True).parameters
    groups: dict[str, Any] = {
        name: each.annotation
        for name, each in declared.items()
        if is_dataclass(each.annotation) and name != "messages"
    }
    for group in (*groups.values(), _Always):
        for part in group.__mro__:
            helps = _read(part.__doc__)[1] | helps
    keywords: dict[str, Option] = {}
    offered = [_by_name("context", typer.Context)]
    for name, each in declared.items():
        if each.kind is inspect.Parameter.VAR_KEYWORD:  # a group of the library's
            keywords = options_of(get_args(each.annotation)[0])
        elif name in groups:
            offered += _members(each.annotation)
        elif name != "messages":
            offered.append(each)
    offered += [*_keywords(keywords), *_members(_Always)]

    @wraps(work)
    def run(context: typer.Context, *, quiet: bool, debug: bool, **given: Any) -> None:
        told = Messages(context.command_path, quiet, debug, given.get("json", False), context.obj)
        if len(configs := given.get("config") or ()) > 1:
            first, *later = map(str, configs)
            from iscat_analysis.findings.setup import CONFIGURATION_MERGED

            told.report(CONFIGURATION_MERGED({"first": first, "others": ", then ".join(later)}))
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        if "messages" in declared:
            given["messages"] = told
        with failures(told):
            for name in keywords.keys() & _READERS.keys():
                option = keywords[name]
                given[name] = _READERS[name](option.flag, given[name]) or option.default
            if "limit_kda" in given:
                given["limit_kda"], given["limit_sigma_kda"] = given["limit_kda"] or (None, None)
            work(**given)

    described = [_described(each, helps, arguments) for each in offered]
    named = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in described]
    vars(run)["__signature__"] = inspect.Signature(named)
    run.__annotations__ = {each.name: each.annotation for each in described}
    run.__doc__ = about
    return Command(work.__name__, about.partition("\n")[0], example, run)


def _by_name(
    name: str, annotation: Any, default: Any = inspect.Parameter.empty
) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)


def _keywords(known: dict[str, Option]) -> Iterator[inspect.Parameter]:
    """Give keywords of the library as options of a command."""
    for name, option in known.items():
        flag, _, metavar = option.written.partition(" ")
        if flag:
            about = typer.Option(flag, metavar=metavar or None, help=with_options(option.help))
            kind = Path | None if isinstance(option.kind, ForwardRef) else option.kind
            default = option.default
            if name in _READERS:
                kind, default = str | None, None
            yield _by_name(name, Annotated[kind, about], default)


def _members(group: type) -> Iterator[inspect.Parameter]:
    """Give the options of a group as parameters, those that it adds to others first."""
    types = get_type_hints(group, include_extras=True)
    for part in group.__mro__[:-1]:
        for name in inspect.get_annotations(part):
            yield _by_name(name, types[name], getattr(group, name))


def _read(text: str | None) -> tuple[str, dict[str, tuple[str, str]], str]:
    """Divide a docstring into what a command does, options by name, and the worked example.

    An option has its heading and its help; an argument is named by its heading.
    """
    whole, mark, example = inspect.cleandoc(text or "").partition("\nExample: ")
    about, _, listed = whole.partition("Options\n-------\n")
    helps: dict[str, tuple[str, str]] = {}
    name = ""
    for line in filter(None, listed.splitlines()):
        if not line.startswith(" "):
            named = re.match(r"--[a-z-]+", line)
            name = named[0] if named else line
            helps[name] = line, ""
        else:
            heading, known = helps[name]
            helps[name] = heading, f"{known} {line.strip()}".strip()
    return about.strip(), helps, mark.lstrip("\n") + example


def _described(
    parameter: inspect.Parameter, helps: dict[str, tuple[str, str]], arguments: Iterator[str]
) -> inspect.Parameter:
    """Add to a parameter how a user writes it, and what it means."""
    plain, *extras = [parameter.annotation]
    if get_origin(plain) is Annotated:
        plain, *extras = get_args(plain)
    if plain is typer.Context or any(extra.help for extra in extras):
        return parameter
    info: OptionInfo | ArgumentInfo = typer.Argument()
    if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
        info.metavar, info.help = helps[next(arguments)]
    else:
        heading, about = helps[f"--{parameter.name.rstrip('_').replace('_', '-')}"]
        names, _, metavar = heading.partition(" ")
        info = copy(extras[0]) if extras else typer.Option()
        info.param_decls, info.metavar, info.help = (names,), metavar or None, about
    return parameter.replace(annotation=Annotated[plain, info])


T = TypeVar("T")


def parsed(option: str, text: str | None, read: Callable[[str], T], form: str) -> T | None:
    """Read the text of an option, None where it is not given; messages say how it is written."""
    from iscat_analysis.errors import ConfigError

    try:
        return None if text is None else read(text)
    except ValueError:
        raise ConfigError(f"{option} {text}: {form}") from None


def two_numbers(text: str, between: str = ":") -> tuple[int, int]:
    """Read two whole numbers with a sign between them."""
    found = re.fullmatch(rf"\s*(\d{{1,18}})\s*{between}\s*(\d{{1,18}})\s*", text, flags=re.ASCII)
    if found is None:
        raise ValueError(text)
    return int(found[1]), int(found[2])


def frame_range(option: str, text: str | None) -> tuple[int, int] | None:
    """Read a half-open range of frames, ``"A:B"``."""

    def read(text: str) -> tuple[int, int]:
        first, last = two_numbers(text)
        if first >= last:
            raise ValueError(text)
        return first, last

    form = "write it as A:B, the first frame and the one after the last, as in"
    return parsed(option, text, read, f"{form} {option} 0:200")


def numbers(
    option: str,
    text: str | None,
    form: str = "masses in kDa as in {} 66,132",
    kind: Callable[[str], float] = float,
) -> Any:
    """Read ``66,132``."""
    form = f"write {form.format(option)}"
    return parsed(option, text, lambda text: [kind(part) for part in text.split(",")], form)


def pair(option: str, text: str | None) -> tuple[float, float | None] | None:
    """Read ``40:8`` or ``40``."""

    def read(text: str) -> tuple[float, float | None]:
        first, colon, second = text.partition(":")
        return float(first), float(second) if colon else None

    return parsed(option, text, read, f"write it as {option} 40 or {option} 40:8")


def monomer(option: str, text: str | None) -> float | Literal["auto"] | None:
    """Read the mass of a monomer, or ``auto``."""
    form = f"give the mass of the monomer in kDa, as in {option} 66, or auto"
    return "auto" if text == "auto" else parsed(option, text, float, form)


_READERS: dict[str, Callable[[str, str | None], Any]] = {
    "masses_kda": numbers,
    "start_kda": numbers,
    "steps": partial(numbers, form="whole numbers as in {} 1,2,4", kind=int),
    "ladder": monomer,
    "limit_kda": pair,
}
"""Keywords of the library whose type no command line knows, and how their values are read."""
