"""What is said where: results on stdout, the rest on stderr, failures as exit statuses."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer
from rich.console import Console, RenderableType

if TYPE_CHECKING:
    from iscat_analysis.records import Progress

INTERRUPTED = 130
UNEXPECTED = 1
SECONDS_BETWEEN_LINES = 10.0
PLAIN_WIDTH = 200


class Messages:
    """Progress, notes and errors of one command, on stderr.

    Parameters
    ----------
    name : str
        The command, as each error line begins.
    quiet : bool
        Drop progress and notes; errors are always shown.
    """

    def __init__(self, name: str, *, quiet: bool = False) -> None:
        self.name = name
        self.quiet = quiet
        self._terminal = Console(stderr=True, highlight=False, markup=False, emoji=False)

    def error(self, text: str) -> None:
        """Say in one line what went wrong.

        Parameters
        ----------
        text : str
            What, and what to do.
        """
        self._line(f"{self.name}: error: {_one_line(text)}")

    def notify(self, text: str) -> None:
        """Say something in one line, unless quiet.

        Parameters
        ----------
        text : str
            What to say.
        """
        if not self.quiet:
            self._line(f"{self.name}: {_one_line(text)}")

    def _line(self, text: str) -> None:
        if self._terminal.is_terminal:
            self._terminal.print(text, soft_wrap=True)
        else:
            _write(sys.stderr, f"{text}\n")

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Show how far the work is: bars on a terminal, a line now and then elsewhere.

        Yields
        ------
        Progress
            To be handed to the library.
        """
        if self.quiet:
            yield _ignore
        elif self._terminal.is_terminal:
            from rich.progress import Progress as Bars
            from rich.progress import TaskID

            tasks: dict[str, TaskID] = {}
            with Bars(console=self._terminal, transient=True) as bars:

                def draw(stage: str, done: int, total: int) -> None:
                    if stage not in tasks:
                        tasks[stage] = bars.add_task(stage, total=total)
                    bars.update(tasks[stage], completed=done, total=total)

                yield draw
        else:
            yield _Lines(self)


class _Lines:
    """Progress as lines of text: the end of each stage, and a sign of life in between."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._lock = threading.Lock()
        self._last = time.monotonic()

    def __call__(self, stage: str, done: int, total: int) -> None:
        with self._lock:
            now = time.monotonic()
            if done < total and now - self._last < SECONDS_BETWEEN_LINES:
                return
            self._last = now
        self._messages.notify(f"{stage}: {done} of {total}")


def _ignore(stage: str, done: int, total: int) -> None:
    """Show no progress."""


@contextmanager
def failures(messages: Messages, *, debug: bool) -> Iterator[None]:
    """Turn whatever a command raises into one line and an exit status.

    Parameters
    ----------
    messages : Messages
        Where the line goes.
    debug : bool
        Show the traceback as well.

    Yields
    ------
    None

    Raises
    ------
    typer.Exit
        With the status.
    """

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        del file, line  # always stderr, never the source
        where = f" ({category.__name__}, {Path(filename).name}:{lineno})" if debug else ""
        messages.notify(f"warning: {message}{where}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        try:
            yield
        except typer.Exit:
            raise
        except KeyboardInterrupt as interruption:
            said = str(interruption)
            messages.error(f"interrupted: {said}" if said else "interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            if debug:
                _write(sys.stderr, traceback.format_exc())
            line, status = _verdict(error, debug=debug)
            messages.error(line)
            raise typer.Exit(status) from error


def _verdict(error: Exception, *, debug: bool) -> tuple[str, int]:
    from iscat_analysis.errors import IscatError

    if isinstance(error, IscatError):
        return str(error), error.exit_status
    said = f": {error}" if str(error) else ""
    hint = "" if debug else "; run again with --debug for the traceback"
    return f"unexpected {type(error).__name__}{said}{hint}", UNEXPECTED


def print_result(result: RenderableType) -> None:
    """Print a result on stdout: in colour on a terminal, as plain text elsewhere.

    Parameters
    ----------
    result : renderable
        Text, or anything rich can draw.
    """
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console = Console(
            highlight=False, markup=False, emoji=False, width=PLAIN_WIDTH, no_color=True
        )
    with console.capture() as captured:
        console.print(result, soft_wrap=isinstance(result, str))
    _write(sys.stdout, "".join(f"{line.rstrip()}\n" for line in captured.get().splitlines()))


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout; what is not a finite number becomes null.

    Parameters
    ----------
    value : mapping
        Of plain values, NumPy scalars and arrays, nested at will.
    """
    _write(sys.stdout, json.dumps(_plain(value), indent=2, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    import numpy as np

    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    return None if value != value else str(value)  # pandas' own missing values


def _write(stream: TextIO, text: str) -> None:
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        # The reader has left.  The work goes on, and later writes must not fail again.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _one_line(text: str) -> str:
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())
