"""`iscat export`, `view` and `app`: results for other programs, and in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from iscat_cli.console import Messages, print_result
from iscat_cli.options import command


@command
def export(
    messages: Messages,
    folder: Path,
    *,
    to: Literal["trackpy", "napari", "photomol", "picasso"],
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Write the events or tracks of an analysis as other programs read them.

    Of landings, those whose status is ok. trackpy: columns y, x, frame, particle (of tracks), mass,
    signal, ep, z, places in pixels. napari: numpy.load gives what viewer.add_tracks, of landings
    viewer.add_points, takes. photomol: columns contrasts and masses_kDa, which iscat species reads
    back with errors. picasso: locs with frame, x, y, photons, lpx, lpy, and mass_kda beside them.

    Options
    -------
    DIR
        Output folder of iscat fit.
    --to
        trackpy: a CSV table; napari: an array (track, t, y, x), of landings (t, y, x); photomol: a
        CSV table like Refeyn's; picasso: HDF5 and YAML.
    --out FILE
        The file; default the folder's name with .trackpy.csv, .napari.npy, .photomol.csv or
        .picasso.hdf5.
    --overwrite
        Replace earlier output.

    Example: tracks for trackpy, and landings for PhotoMol.

        iscat export moving.iscat --to trackpy --out moving.csv

        iscat export standards.iscat --to photomol
    """
    from iscat_analysis.report.exchange import export_result

    written = export_result(folder, to, out=out, overwrite=overwrite)
    messages.note(*written.notes)
    print_result(f"{written.text} in {written.path}")


@command
def view(result: Path) -> None:
    """Open the page of a result in the browser.

    Prints where the page is; on a machine without a browser that is all, and the status is 1.

    Options
    -------
    DIR
        Output folder of fit, batch, calibrate, species, kd, bounds or benchmark; or a movie that
        has one beside it.

    Example: the report of a movie, in the browser.

        iscat view movie.iscat
    """
    import webbrowser

    from iscat_analysis.errors import DataError
    from iscat_analysis.report.output import page_of

    page = page_of(result)
    print_result(str(page))
    if not webbrowser.open(page.resolve().as_uri()):
        raise DataError(
            f"{page}: no browser could be opened here; copy the file to a machine with one, it "
            "needs no other file"
        )


@command
def app(
    messages: Messages,
    folder: Path = Path(),
    *,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
) -> None:
    """Open movies, analyse them and export figures in the browser, without programming.

    Listens on this machine alone, to whoever has the token in the address that it prints.

    Options
    -------
    FOLDER
        Folder of movies; default this one.
    --port N
        Port to listen at; default a free one from 5006.

    Example: the movies of a day.

        iscat app measurements/monday

    Ctrl-C ends it; a movie that is being analysed then is stopped, keeps what is
    finished, and can be gone on with.
    """
    from iscat_analysis.errors import ConfigError

    try:
        from iscat_app.server import serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("panel", "bokeh", "param"):
            raise
        raise ConfigError(
            "the window in the browser needs Panel; install it with: "
            'pip install "iscat-analysis[app]"'
        ) from None
    messages.note("Ctrl-C ends it")
    serve(folder, port=port, say=print_result, warn=messages.error, debug=messages.debug)
