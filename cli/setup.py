"""`iscat init` and `iscat config`: a configuration for a movie, and a complete one to edit."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from iscat_cli.console import Messages, print_result, table
from iscat_cli.options import Instrument, Mode, Output, command

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iscat_analysis.pipeline.setup import Question, Setup

WIDTH, COMMENT = 80, 36  # columns of a narrow terminal, and where most comments begin

Sample = Literal["protein", "gold", "silica", "polystyrene"]


@dataclass(frozen=True)
class Answers:
    """What only a user knows of a movie.

    Options
    -------
    --pixel-size-nm NM
        Side of a pixel in the sample plane.
    --wavelength-nm NM
        Wavelength of the light in vacuum.
    --na NA
        Numerical aperture.
    --sample KIND
        protein, gold, silica or polystyrene particles.
    """

    pixel_size_nm: float | None = None
    wavelength_nm: float | None = None
    na: float | None = None
    sample: Sample | None = None

    @property
    def by_key(self) -> dict[str, float | str]:
        """Answers that are given, by key of the configuration."""
        given: dict[str, float | str | None]
        given = {"camera.pixel_size_nm": self.pixel_size_nm, "optics.na": self.na}
        given |= {"optics.wavelength_nm": self.wavelength_nm, "particle.kind": self.sample}
        return {key: value for key, value in given.items() if value is not None}


@command
def init(
    messages: Messages,
    movie: Path,
    *,
    yes: bool = False,
    instrument: Instrument | None = None,
    answers: Answers,
    output: Output,
) -> None:
    """Look at a movie, ask what only you can know, and write iscat.toml for it.

    Says what the file's metadata and the frames tell, asks for the rest (pixel size, wavelength,
    NA, kind of sample), writes every value with where it comes from and whether it will be learned,
    and shows what the search sees in some frames.  Without a terminal nothing is asked, as with
    --yes.

    Options
    -------
    MOVIE
        The movie, as for iscat fit.
    --yes
        Ask no questions: use defaults for what is neither known nor given.
    --instrument NAME
        Optics, pixels and light of a published set-up in place of the defaults:
        mass-photometer-445, mass-photometer-525, iscat, cobri.
    --out iscat.toml
        The file; default iscat.toml beside the movie.

    Example: no questions; what the file does not say is given here, or a default.

        iscat init movie.tif --yes --pixel-size-nm 84.4 --na 1.42

    Then `iscat-fit movie.tif` finds iscat.toml beside the movie.
    """
    from iscat_analysis.pipeline.setup import write_setup

    found = write_setup(
        movie,
        answers=answers.by_key,
        ask=None if yes or not sys.stdin.isatty() else _ask,
        instrument=instrument,
        note=messages.note,
        out=output.out,
        overwrite=output.overwrite,
    )
    if not messages.json:
        messages.note(*found.notes)
    messages.show("init", found.to_dict(), _lines(found))


def _lines(found: Setup) -> Iterator[RenderableType]:
    from iscat_analysis.pipeline.setup import preview_lines

    rows = ((each.key, each.shown, each.origin) for each in found.values)
    yield table("key", "value", "from", rows=rows)
    yield from preview_lines(found)
    yield f"written: {found.out}"


def _ask(question: Question) -> str:
    """Ask on the terminal, on stderr, since stdout is for results."""
    words = question.words
    if question.choices:
        words += f" ({', '.join(question.choices)})"
    try:
        return str(typer.prompt(words, default=question.default, type=str, err=True))
    except typer.Abort:
        raise KeyboardInterrupt from None


@command
def config(*, mode: Mode | None = None, instrument: Instrument | None = None) -> None:
    """Print a complete configuration, each key with what it means.

    A key without a value is unset; take the # away and fill it in.

    Options
    -------
    --mode MODE
        Free parameters: mass (x, y, mass), localize (x, y, z), joint (all four), size (x, y, z,
        diameter of a sphere), track (joint in every frame, linked).
    --instrument NAME
        Optics, pixels and light of a published set-up in place of the defaults:
        mass-photometer-445, mass-photometer-525, iscat, cobri.

    Example: a file to edit, and what it says checked without running anything.

        iscat config --mode joint --instrument mass-photometer-445 > setup.toml
        iscat bounds --config setup.toml --set camera.pixel_size_nm=84.4
    """
    from iscat_analysis.config import MODES, config_to_toml, configure, instruments

    changes = [f"fit.mode={mode}"] if mode else []
    if mode and MODES[mode].fits_sizes:  # of spheres alone
        changes.append("particle.model=mie")
    text = config_to_toml(configure(instrument=instrument, settings=changes))
    text = text.replace("\n[bounds]", f"\n{_one_of_each()}\n[bounds]", 1)
    begun = _INTRODUCTION
    if instrument:
        one = instruments[instrument]
        title = textwrap.wrap(f"{instrument}: {one.title} ({one.reference})", WIDTH - 2)
        begun += "".join(f"# {line}\n" for line in title)
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
