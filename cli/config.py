"""`iscat config`: a complete configuration to start from."""

from __future__ import annotations

import textwrap

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import DebugOption, InstrumentOption, Mode, ModeOption

WIDTH, COMMENT = 80, 36  # columns of a narrow terminal, and where most comments begin

EXAMPLE = """Example: a file to edit, and what it says checked without running anything.

    iscat config --mode joint --instrument mass-photometer-445 > setup.toml
    iscat bounds --config setup.toml --set camera.pixel_size_nm=84.4
"""


def config(
    context: typer.Context,
    *,
    mode: ModeOption = None,
    instrument: InstrumentOption = None,
    debug: DebugOption = False,
) -> None:
    """Print a complete configuration, each key with what it means.

    A key without a value is unset; take the # away and fill it in.
    """
    with failures(Messages(context.command_path, debug=debug)):
        from iscat_analysis.config import config_to_toml, configure, instruments

        changes = [f"fit.mode={mode.value}"] if mode else []
        if mode is Mode.SIZE:  # which fits spheres alone
            changes.append("particle.model=mie")
        text = config_to_toml(configure(instrument=instrument, settings=changes))
        text = text.replace("\n[bounds]", f"\n{_one_of_each()}\n[bounds]", 1)
        begun = _INTRODUCTION
        if instrument:
            one = instruments[instrument]
            said = textwrap.wrap(f"{instrument.value}: {one.title} ({one.reference})", WIDTH - 2)
            begun += "".join(f"# {line}\n" for line in said)
        print_result("\n".join(_folded(line) for line in f"{begun}\n{text}".splitlines()))


_INTRODUCTION = """\
# Lengths are nm, masses kDa, counts photoelectrons; ranges are [start, stop).
# A line that begins with # is unset.  Paths are relative to this file.
"""


def _folded(line: str) -> str:
    """Let a comment that would leave a narrow terminal go on in the next line."""
    _, mark, comment = line.partition(" # ")
    if not mark or len(line) <= WIDTH:
        return line
    column = len(line) - len(comment)
    first = textwrap.wrap(comment, WIDTH - column)[0]
    column = min(column, COMMENT)
    rest = textwrap.wrap(comment.removeprefix(first).strip(), WIDTH - column)
    return "\n".join(
        [f"{line.removesuffix(comment)}{first}", *(f"{'# ':>{column}}{more}" for more in rest)]
    )


def _one_of_each() -> str:
    """Write the keys of simulated particles, which the defaults have none of."""
    from iscat_analysis.config import SIMULATED

    purposes = {
        "events": "one such block for each particle, in place of count",
        "movers": "one such block for each kind of particle that diffuses",
    }
    blocks = []
    for name, model in SIMULATED.items():
        lines = [f"# [[simulation.{name}]]  {purposes[name]}"]
        for key, field in model.model_fields.items():
            lines.append(f"{f'# {key} =':<36} # {field.description}")
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)
