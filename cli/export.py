"""`iscat export`: events and tracks for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import OverwriteOption, command

EXAMPLE = """Example: tracks for trackpy, and landings for PhotoMol.

    iscat export moving.iscat --to trackpy --out moving.csv

    iscat export standards.iscat --to photomol
"""


class Program(StrEnum):
    """Whose layout it is."""

    TRACKPY = "trackpy"
    NAPARI = "napari"
    PHOTOMOL = "photomol"
    PICASSO = "picasso"


@command
def export(
    messages: Messages,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of iscat fit.")],
    *,
    to: Annotated[
        Program,
        typer.Option(
            "--to",
            help="trackpy: a CSV table; napari: an array (track, t, y, x), of landings (t, y, x); "
            "photomol: a CSV table like Refeyn's; picasso: HDF5 and YAML.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The file; default the folder's name with .trackpy.csv, .napari.npy, "
            ".photomol.csv or .picasso.hdf5.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write the events or tracks of an analysis as other programs read them.

    Of landings, those whose status is ok. trackpy: columns y, x, frame, particle (of tracks), mass,
    signal, ep, z, places in pixels. napari: numpy.load gives what viewer.add_tracks, of landings
    viewer.add_points, takes. photomol: columns contrasts and masses_kDa, which iscat species reads
    back with errors. picasso: locs with frame, x, y, photons, lpx, lpy, and mass_kda beside them.
    """
    with failures(messages):
        from iscat_analysis.report.exchange import export_result

        written = export_result(folder, to.value, out=out, overwrite=overwrite)
        for note in written.notes:
            messages.notify(note)
        print_result(f"{written.text} in {written.path}")
