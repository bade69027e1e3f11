"""`iscat export`: tracks for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import DebugOption, OverwriteOption, QuietOption

EXAMPLE = """Example: a table that trackpy.imsd and the rest of trackpy take.

    iscat export moving.iscat --to trackpy --out moving.csv
"""


class Program(StrEnum):
    """Whose layout it is."""

    TRACKPY = "trackpy"
    NAPARI = "napari"


def export(
    context: typer.Context,
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Output folder of iscat fit --mode track.")
    ],
    *,
    to: Annotated[
        Program,
        typer.Option("--to", help="trackpy: a CSV table; napari: an array (track, t, y, x)."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The file; default the folder's name with .trackpy.csv or .napari.npy.",
            show_default=False,
        ),
    ] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> None:
    """Write the tracks of an analysis as trackpy or napari read them.

    trackpy: columns y, x, frame, particle, mass, signal, ep, z, places in pixels. napari:
    numpy.load gives what viewer.add_tracks takes.
    """
    messages = Messages(context.command_path, quiet=quiet)
    with failures(messages, debug=debug):
        from iscat_analysis.report.exchange import export_tracks
        from iscat_analysis.report.numbers import count

        path, tracks = export_tracks(folder, to.value, out=out, overwrite=overwrite)
        print_result(f"{count(tracks, 'track')} in {path}")
