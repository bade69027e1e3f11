"""What is said where: results on stdout, the rest on stderr, failures as exit statuses."""

from __future__ import annotations

import errno
import math
import os
import re
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

import typer
from rich.console import Console, RenderableType
from rich.text import Text

from iscat_analysis.options import BindingOptions, SpeciesOptions, Told, options_of
from iscat_cli import INTERRUPTED

if TYPE_CHECKING:
    from rich.table import Table

    from iscat_analysis.findings import Finding
    from iscat_analysis.records import Progress
    from iscat_analysis.report.numbers import Table as Made

UNEXPECTED = 1


class _Console(Console):
    """Prints names of files and samples as text, whatever a terminal would make of them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Prepare a text, of which every cell of a table is one, to be printed."""
        from iscat_analysis.text import in_terminal

        return super().render_str(in_terminal(text), **options)


@dataclass
class Messages:
    """Progress, notes and errors of one command, on stderr.

    `quiet` drops progress and notes; errors are always shown, and begin with `name`.  `debug` adds
    tracebacks, and `json` prints results as one JSON object.  `command` is the whole command line.
    """

    name: str
    quiet: bool = False
    debug: bool = False
    json: bool = False
    command: str = ""
    writing: bool = False

    def __post_init__(self) -> None:
        self._terminal = _Console(stderr=True)

    def error(self, text: str) -> None:
        """Say in one line what went wrong, and what to do."""
        self._line(f"{self.name}: error: {_one_line(text)}")

    def note(self, *texts: str) -> None:
        """Print notes, one line each, unless quiet; they name options as users write them."""
        for text in () if self.quiet else texts:
            self._line(f"{self.name}: {_one_line(with_options(text))}")

    def report(self, *findings: Finding | None) -> None:
        """Print findings; what is None was not found."""
        self.note(*(finding.text for finding in findings if finding is not None))

    def wrote(self, folder: Path, page: str = "") -> None:
        """Say which folder was written, and what to look at in it."""
        self.note(f"wrote {folder}" + (f"; look at {folder / page}" if page else ""))

    def show(
        self, document: str, values: Mapping[str, Any], lines: Iterable[RenderableType]
    ) -> None:
        """Print a result on stdout, as lines and tables or as one JSON object.

        `document` names the `iscat_analysis.schema` of `values`.
        """
        if self.json:
            from iscat_analysis.schemas import to_json

            _write(sys.stdout, to_json(document, values) + "\n")
        else:
            for line in lines:
                print_result(line)

    def answer(
        self,
        document: str,
        values: Mapping[str, Any],
        lines: Iterable[RenderableType],
        folder: Path | None,
        page: str,
        *,
        notes: Iterable[str] = (),
    ) -> None:
        """Print a result, what there is to say of it, and the folder where it was written."""
        self.show(document, values if folder is None else {**values, "out": str(folder)}, lines)
        self.note(*notes)
        if folder is not None:
            self.wrote(folder, page)

    def _line(self, text: str) -> None:
        if self._terminal.is_terminal:
            self._terminal.print(text, soft_wrap=True)
        else:
            _write(sys.stderr, f"{text}\n")

    @contextmanager
    def telling(self) -> Iterator[Told]:
        """Give the arguments by which work tells how far it is, and what there is to say."""
        with self.progress() as progress:
            yield {"progress": progress, "notify": self.note}

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Show how far the work is: bars on a terminal, a line now and then elsewhere."""
        from iscat_analysis.progress import Lines, bars

        bar = self._terminal.is_terminal and not self.quiet
        with bars(self._terminal) if bar else Lines(self.note) as shown:

            def watched(stage: str, done: int, total: int) -> None:
                self.writing = stage == "report" and done < total
                shown(stage, done, total)

            yield watched


@contextmanager
def failures(messages: Messages) -> Iterator[None]:
    """Turn whatever a command raises into one line and an exit status."""

    def show(message: Any, category: type, filename: str, lineno: int, *_: Any, **__: Any) -> None:
        where = f" ({category.__name__}, {Path(filename).name}:{lineno})"
        messages.note(f"warning: {message}{where if messages.debug else ''}")

    with warnings.catch_warnings(), interrupts(messages) as watched:
        warnings.showwarning = show
        try:
            yield
        except typer.Exit:
            raise
        except KeyboardInterrupt as interruption:
            text = str(interruption)
            messages.error(f"interrupted: {text}" if text else "interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            if watched is not None and watched.answer_lost():  # the compiler made this of it
                messages.error("interrupted")
                raise typer.Exit(INTERRUPTED) from None
            if messages.debug:
                _write(sys.stderr, traceback.format_exc())
            line, status = _verdict(error, debug=messages.debug)
            messages.error(with_options(line))
            raise typer.Exit(status) from error


_SAME = (
    "config dark draws free inject kd landing maps model offset optimize out overwrite scan "
    "scheduler standards target truth"
)
_OPTIONS = {
    **{name: name for name in _SAME.split()},
    **{
        name: option.flag.removeprefix("--").partition("/")[0]
        for group in (BindingOptions, SpeciesOptions)
        for name, option in options_of(group).items()
        if option.flag
    },
    "settings": "set",
    "focus_step_nm": "focus-step",
    "frame_rate_hz": "frame-rate",
    "interval_s": "interval",
    "limit_sigma_kda": "limit",
    "kd_masses_kda": "kd-masses",
    "offset_adu": "offset",
    "peaks_at": "peaks",
    "pixel_size_nm": "pixel-size-nm",
    "scheduler_file": "scheduler-file",
    "standards_kda": "standards",
}
"""Argument of the library → option of a command."""

_KEYS_WITH_OPTIONS = (
    (r"\bbackground\.frames = \[(\w+), (\w+)\]", r"--background \1:\2"),
    (r"\bfit\.frames = \[(\w+), (\w+)\]", r"--frames \1:\2"),
    (r'\bfit\.mode = "(\w+)"', r"--mode \1"),
    (r"\bas in ([a-z]+\.[a-z_]+) = ([\w.]+)", r"as in --set \1=\2"),
)
"""How keys of the configuration are given on the command line."""


def with_options(text: str) -> str:
    """Name options where the library names its arguments, which it writes in backquotes."""

    def option(match: re.Match[str]) -> str:
        return f"--{_OPTIONS[match[1]]}{' ' if match[2] else ''}"

    text = re.sub(rf"`({'|'.join(_OPTIONS)})`( = )?", option, text)
    for pattern, replacement in _KEYS_WITH_OPTIONS:
        text = re.sub(pattern, replacement, text)
    return text


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says where a file cannot grow; a write does not tell which file it was."""


def _verdict(error: Exception, *, debug: bool) -> tuple[str, int]:
    from iscat_analysis.errors import IscatError

    if isinstance(error, IscatError):
        return str(error), error.exit_status
    cause = error.__cause__ or error.__context__
    if isinstance(error, SystemError) and isinstance(cause, KeyboardInterrupt):
        return "interrupted", INTERRUPTED  # that met compiled code
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: cannot be read or written ({error.strerror})", UNEXPECTED
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return f"a file cannot be written ({error.strerror})", UNEXPECTED
    text = f": {error}" if str(error) else ""
    hint = "" if debug else "; run again with --debug for the traceback"
    return f"unexpected {type(error).__name__}{text}{hint}", UNEXPECTED


def print_result(result: RenderableType) -> None:
    """Print a result on stdout: in colour on a terminal, as plain text elsewhere."""
    console = _Console()
    if not console.is_terminal:
        console = _Console(width=200, no_color=True)
    with _failing_once(sys.stdout), console.capture() as captured:
        console.print(result, soft_wrap=isinstance(result, str))
    _write(sys.stdout, "".join(f"{line.rstrip()}\n" for line in captured.get().splitlines()))


def table(*headings: str, rows: Iterable[Iterable[str]] = (), left: Container[int] = (0,)) -> Table:
    """Make a table with a frame on a terminal, and plain elsewhere.

    Columns whose numbers are in `left` are aligned to the left.
    """
    from rich import box
    from rich.table import Table

    made = Table(box=box.SIMPLE_HEAD if Console().is_terminal else None, pad_edge=False)
    for number, heading in enumerate(headings):
        made.add_column(heading, justify="left" if number in left else "right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def listing(
    records: Iterable[Mapping[str, Any]], heading: str, row: str, *, left: Container[int] = (0,)
) -> Table:
    """Make a table of records: a heading for each column between bars, and as `cells` a format."""
    from iscat_analysis.units import cells

    return table(*heading.split(" | "), rows=cells(records, row), left=left)


def listed(made: Made) -> Table:
    """Print a table of the reports."""
    right = [number for number, column in enumerate(made.columns) if not column.numeric]
    return table(*(column.label for column in made.columns), rows=made.rows, left=right)


def grouped(number: float) -> str:
    """Write a whole number with its digits in groups of three."""
    return f"{number:,.0f}".replace(",", " ")


def short(value: float | None, digits: int = 4) -> str:
    """Write a number to a few significant digits, and a dash for one that is not known."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def _write(stream: TextIO | None, text: str) -> None:
    if stream is None:  # closed before the command began
        return
    with _failing_once(stream):
        stream.write(text)
        stream.flush()


def silence(stream: TextIO) -> None:
    """Let a stream that cannot be written swallow what comes later, the last flush included."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


@contextmanager
def _failing_once(stream: TextIO) -> Iterator[None]:
    """Silence a stream that cannot be written.

    A reader who has left is no failure, and there is nowhere to say that stderr fails.
    """
    try:
        yield
    except OSError as error:
        silence(stream)
        if isinstance(error, BrokenPipeError) or stream is sys.stderr:
            return
        from iscat_analysis.errors import DataError

        raise DataError(f"the results cannot be printed ({error.strerror})") from None


def _one_line(text: str) -> str:
    from iscat_analysis.text import in_terminal

    return in_terminal("; ".join(line.strip() for line in text.splitlines() if line.strip()))


GRACE_S = 1.5
"""After a signal to end, the time that is left for tidying up."""

WRITING_GRACE_S = 30.0
"""The same while results are being written, which a second signal cuts short."""


class Interrupts:
    """Interrupts the main thread when a signal asks the command to end, and sees that it ends.

    Python raises `KeyboardInterrupt` between two of its own instructions, so a long call into
    compiled code delays it, and so do threads that must finish first.  The signals are therefore
    blocked, and a thread waits for them, as POSIX provides for programs of many threads
    (``sigwait``).  It interrupts the main thread by SIGUSR1.  Where the command does not end in
    time, it unblocks SIGINT, whose action is the system's: the process ends, with 130 in a shell.
    """

    def __init__(self, messages: Messages, numbers: set[signal.Signals]) -> None:
        self._messages = messages
        self._numbers = numbers
        self._received = signal.SIGINT
        self._ended = threading.Event()
        self._main = threading.get_ident()
        self._swallowed = False
        self.lost = False
        self.thread = threading.Thread(target=self._watch, daemon=True, name="signals")

    def stop(self) -> None:
        """Wait for signals no longer: the command has ended."""
        self._ended.set()
        signal.pthread_kill(self.thread.ident or 0, signal.SIGUSR1)
        self.thread.join()

    def handle(self, _number: int, _frame: FrameType | None) -> None:
        """Raise the interrupt, in the main thread."""
        if self._received == signal.SIGINT:
            raise KeyboardInterrupt
        raise KeyboardInterrupt(f"{self._received.name} was received")

    def note_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Have an interrupt raised again that was raised where Python can only print it.

        A callback of compiled code is such a place: the compiler's look into its cache, for one.
        The interrupt would be lost, or end as an error of whoever made the call.
        """
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            self._swallowed = self.lost = True
        else:
            sys.__unraisablehook__(unraisable)

    def answer_lost(self) -> bool:
        """Tell whether an interrupt was lost; the caller answers it, and it is not raised again."""
        self._swallowed = False
        return self.lost

    def _watch(self) -> None:
        number = signal.Signals(signal.sigwait(self._numbers | {signal.SIGUSR1}))
        if number == signal.SIGUSR1:  # from `stop`
            return
        self._received = number
        signal.pthread_kill(self._main, signal.SIGUSR1)
        if self._ends_in_time():
            signal.sigwait({signal.SIGUSR1})
            return
        _discard_unfinished()
        self._messages.error(f"interrupted: {number.name} was received")
        last = signal.SIGINT if signal.SIGINT in self._numbers else number
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {last})
        signal.raise_signal(last)

    def _ends_in_time(self) -> bool:
        """Tell whether the command ends within the time that it has."""
        begun = time.monotonic()
        while not self._ended.wait(0.05):  # between two looks at what has become of an interrupt
            if self._swallowed:
                self._swallowed = False
                signal.pthread_kill(self._main, signal.SIGUSR1)
            passed = time.monotonic() - begun
            again = signal.sigpending() & self._numbers
            if passed > GRACE_S and (
                again or not self._messages.writing or passed > GRACE_S + WRITING_GRACE_S
            ):
                return False
        return True


@contextmanager
def interrupts(messages: Messages) -> Iterator[Interrupts | None]:
    """Answer a signal to end in time, until the block ends.

    SIGTERM and SIGHUP are answered as Ctrl-C is; what is ignored, as SIGHUP under nohup, stays so.
    In a process that has threads already, which do not block the signals, nothing is changed.
    """
    if os.name == "nt" or threading.active_count() > 1:
        yield None
        return
    numbers = {
        number
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
    }
    handlers = {number: signal.getsignal(number) for number in (*numbers, signal.SIGUSR1)}
    hook = sys.unraisablehook
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, handlers)
    watched = Interrupts(messages, numbers)
    for number in numbers:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGUSR1, watched.handle)
    sys.unraisablehook = watched.note_unraisable
    watched.thread.start()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
    try:
        yield watched
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
        watched.stop()
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _discard_unfinished() -> None:
    """Remove half-written files, which there are only where the library was imported."""
    files = sys.modules.get("iscat_analysis.files")
    if files is not None:
        files.discard_unfinished()
