"""`iscat app`: the whole job in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import command

EXAMPLE = """Example: the movies of a day.

    iscat app measurements/monday

Ctrl-C ends it; a movie that is being analysed then is stopped, keeps what is
finished, and can be gone on with.
"""


@command
def app(
    messages: Messages,
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Folder of movies; default this one.")
    ] = Path(),
    *,
    port: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, max=65535, help="Port to listen at; default a free one from 5006."
        ),
    ] = None,
) -> None:
    """Open movies, analyse them and export figures in the browser, without programming.

    Listens on this machine alone, to whoever has the token in the address that it prints.
    """
    with failures(messages):
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
        messages.notify("Ctrl-C ends it")
        serve(folder, port=port, say=print_result, warn=messages.error, debug=messages.debug)
