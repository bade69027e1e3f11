"""`iscat init`: a configuration for a movie, with a question for what nobody else can answer."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iscat_cli.console import Messages, failures, print_json, print_result, table
from iscat_cli.options import InstrumentOption, JsonOption, OverwriteOption, command

if TYPE_CHECKING:
    from collections.abc import Callable

    from iscat_analysis.pipeline.setup import Question

EXAMPLE = """Example: no questions; what the file does not say is given here, or a default.

    iscat init movie.tif --yes --pixel-size-nm 84.4 --na 1.42

Then `iscat-fit movie.tif` finds iscat.toml beside the movie.
"""


class Sample(StrEnum):
    """Kinds of samples; the same names as `iscat_analysis.pipeline.setup.SAMPLES`."""

    PROTEIN = "protein"
    GOLD = "gold"
    SILICA = "silica"
    POLYSTYRENE = "polystyrene"


@command
def init(
    messages: Messages,
    movie: Annotated[Path, typer.Argument(metavar="MOVIE", help="The movie, as for iscat fit.")],
    *,
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", help="Ask no questions: use defaults for what is neither known nor given."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="iscat.toml", help="The file; default iscat.toml beside the movie."),
    ] = None,
    pixel_size_nm: Annotated[
        float | None,
        typer.Option("--pixel-size-nm", metavar="NM", help="Side of a pixel in the sample plane."),
    ] = None,
    wavelength_nm: Annotated[
        float | None,
        typer.Option("--wavelength-nm", metavar="NM", help="Wavelength of the light in vacuum."),
    ] = None,
    na: Annotated[
        float | None, typer.Option("--na", metavar="NA", help="Numerical aperture.")
    ] = None,
    sample: Annotated[
        Sample | None,
        typer.Option(
            "--sample", metavar="KIND", help="protein, gold, silica or polystyrene particles."
        ),
    ] = None,
    instrument: InstrumentOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Look at a movie, ask what only you can know, and write iscat.toml for it.

    Says what the file's metadata and the frames tell, asks for the rest (pixel size, wavelength,
    NA, kind of sample), writes every value with where it comes from and whether it will be learned,
    and shows what the search sees in some frames.  Without a terminal nothing is asked, as with
    --yes.
    """
    with failures(messages):
        from iscat_analysis.pipeline.setup import preview_lines, write_setup

        given = {
            "camera.pixel_size_nm": pixel_size_nm,
            "optics.wavelength_nm": wavelength_nm,
            "optics.na": na,
            "particle.kind": None if sample is None else sample.value,
        }
        found = write_setup(
            movie,
            answers={key: value for key, value in given.items() if value is not None},
            ask=None if yes or not sys.stdin.isatty() else _asker(),
            instrument=instrument,
            warn=messages.notify,
            out=out,
            overwrite=overwrite,
        )
        if as_json:
            print_json("init", found.to_dict())
            return
        shown = table("key", "value", "from")
        for each in found.values:
            shown.add_row(each.key, each.shown, each.origin)
        for note in found.notes:
            messages.notify(note)
        print_result(shown)
        for line in preview_lines(found):
            print_result(line)
        print_result(f"written: {found.out}")


def _asker() -> Callable[[Question], str]:
    """Ask on the terminal, on stderr, since stdout is for results."""

    def ask(question: Question) -> str:
        words = question.words
        if question.choices:
            words += f" ({', '.join(question.choices)})"
        try:
            return str(typer.prompt(words, default=question.default, type=str, err=True))
        except typer.Abort:
            raise KeyboardInterrupt from None

    return ask
