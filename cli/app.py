"""The two programs: `iscat`, the umbrella, and `iscat-fit`, its main job."""

from __future__ import annotations

import difflib
import io
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from iscat_cli import INTERRUPTED, answers, bounds, calibrate, day, fit, setup, study
from iscat_cli.console import UNEXPECTED, Messages, silence
from iscat_cli.options import Command

_MOVIES = (setup.init, fit.fit, day.batch, day.watch, study.simulate)
_ANSWERS = (bounds.bounds, study.benchmark, answers.species, answers.kd)
_RESULTS = (fit.figures, fit.export, fit.view, fit.app)
COMMANDS = (*_MOVIES, *_ANSWERS, *_RESULTS, setup.config)
GROUPS = (
    ("calibrate", calibrate.SUMMARY, (calibrate.camera, calibrate.optics, calibrate.mass)),
    ("challenge", study.SUMMARY, (study.make, study.score)),
)
"""Commands with commands of their own: their name, what they are for, and these."""

STRICT = "--strict"
"""The option whose value may be left out."""


def run(program: str, arguments: Sequence[str]) -> int:
    """Run one of the two programs."""
    given = list(arguments)
    groups = [[name] for name, _, _ in GROUPS]
    if program == "iscat" and given in ([], *groups):
        given.append("--help")
    return _run(_command_of(program), program, given)


@cache
def _command_of(program: str) -> Any:
    """Make the command of a program, once for all runs of a process."""
    if program == "iscat":
        return typer.main.get_command(_umbrella())
    alone = replace(fit.fit, example=fit.fit.example.replace("iscat fit", "iscat-fit"))
    return typer.main.get_command(_of([alone]))


def _umbrella() -> typer.Typer:
    app = _of(COMMANDS)
    app.callback()(_iscat)
    for name, summary, commands in GROUPS:
        app.add_typer(_of(commands), name=name, help=summary)
    return app


def _of(commands: Sequence[Command]) -> typer.Typer:
    """Make a program of commands."""
    app = typer.Typer(
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    for each in commands:
        app.command(cls=Parsed, epilog=_as_written(each.example), short_help=each.summary)(each.run)
    return app


class Parsed(TyperCommand):
    """A command that refuses an option that is given twice and means one thing."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the options, after a look at how often each is given."""
        args = [f"{STRICT}=" if text == STRICT else text for text in args]
        if not ctx.resilient_parsing:  # of completion, which has half a command
            given, _, order = self.make_parser(ctx).parse_args(args=list(args))
            single = (o for o in order if not getattr(o, "multiple", True) and o.nargs == 1)
            keys = (text.partition("=")[0].strip() for text in given.get("set_") or ())
            names = [*(option.opts[0] for option in single), *(f"--set {key}" for key in keys)]
            for name in names:
                if names.count(name) > 1:
                    ctx.fail(f"{name} is given twice and means one thing; leave one out")
        return super().parse_args(ctx, args)


def _as_written(text: str) -> str:
    """Keep help's own line breaks: a paragraph that begins with a backspace is not filled."""
    return "\n\n".join(f"\b\n{paragraph}" for paragraph in text.strip("\n").split("\n\n"))


def _nearest(text: str) -> str:
    """Add the likeliest choice to a complaint that lists them all."""
    found = re.search(r"'([^']*)' is not one of (.+)$", text)
    choices = re.findall(r"'([^']*)'", found[2]) if found else []
    near = difflib.get_close_matches(found[1], choices, n=1) if found else []
    return f"{text}; did you mean '{near[0]}'?" if near else text


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"iscat-analysis {version('iscat-analysis')}")
        raise typer.Exit


_VERSION: Any = typer.Option(
    "--version", callback=_print_version, is_eager=True, help="Print the version."
)


def _iscat(*, show_version: Annotated[bool, _VERSION] = False) -> None:
    """Position and mass of single particles from interferometric scattering movies."""


def _run(command: Any, program: str, arguments: list[str]) -> int:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    messages = Messages(program)
    try:
        status = command.main(
            args=arguments,
            prog_name=program,
            standalone_mode=False,
            obj=shlex.join([program, *arguments]),
        )
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        name = context.command_path if context is not None else program
        text = error.format_message().replace("Value error, ", "").rstrip(".")
        Messages(name).error(f"{_nearest(text)}; see {name} --help")
        return error.exit_code
    except (typer.Abort, KeyboardInterrupt):
        messages.error("interrupted")
        return INTERRUPTED
    except OSError as error:  # of help, version and completion: commands see to their own
        silence(sys.stdout)
        messages.error(f"this cannot be printed ({error.strerror})")
        return UNEXPECTED
    except SystemExit as end:  # how typer answers a reader who has left, which is no failure
        if isinstance(end.__context__, BrokenPipeError):
            return 0
        raise
    return int(status or 0)
