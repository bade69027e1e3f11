"""`iscat view`: open the page of a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import command

EXAMPLE = """Example: the report of a movie, in the browser.

    iscat view movie.iscat
"""


@command
def view(
    messages: Messages,
    result: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="Output folder of fit, batch, calibrate or benchmark; or a movie that has one "
            "beside it.",
        ),
    ],
) -> None:
    """Open the page of a result in the browser.

    Prints where the page is; on a machine without a browser that is all, and the status is 1.
    """
    with failures(messages):
        import webbrowser

        from iscat_analysis.errors import DataError
        from iscat_analysis.report.view import page_of

        page = page_of(result)
        print_result(str(page))
        if not webbrowser.open(page.resolve().as_uri()):
            raise DataError(
                f"{page}: no browser could be opened here; copy the file to a machine with one, "
                "it needs no other file"
            )
