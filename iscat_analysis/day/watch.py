"""A movie that is still being recorded: what is there is analysed, and at its end all of it.

The file is looked at again and again.  Each time it has grown by half, the frames that it holds are
analysed and the masses are told as a histogram, so that all of these together cost twice the last
one.  Once it rests, the whole movie is analysed as `iscat fit` does it, with the same result; if
the file has grown meanwhile, because the camera had only paused, once more.

A folder that is being filled: movies are analysed as they appear, and the page is kept current.

The folder is looked at again and again, because disks of a network tell of no changes.  A movie is
taken once two looks find it the same and it can be read to its end.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd

from iscat_analysis.answers.output import Notify, tell
from iscat_analysis.calibration import mass_line
from iscat_analysis.config import Config
from iscat_analysis.day import Batch, batch, checked_options
from iscat_analysis.day.jobs import Records, claim_folder
from iscat_analysis.day.table import TABLES, Table, read_growing
from iscat_analysis.errors import ConfigError, DataError, IscatError, SchedulerError
from iscat_analysis.files import states_of
from iscat_analysis.fitting.run import is_resumable
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.movie import Stack, files_of, find_movies, is_open_to_write, open_stack
from iscat_analysis.options import DayOptions, takes
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.progress import automatic, told
from iscat_analysis.reading import is_folder
from iscat_analysis.records import Analysis, Progress, Status, silent
from iscat_analysis.report.output import check_output
from iscat_analysis.units import count

RESTS = 3
"""Looks without a change after which a movie is complete."""


_BINS = 24  # of the histogram
_BARS = " ▁▂▃▄▅▆▇█"


def watch_movie(
    movie: Path,
    config: Config,
    *,
    out: Path,
    interval_s: float = 10.0,
    progress: Progress = silent,
    notify: Notify = lambda _: None,
    command: str = "",
) -> Analysis:
    """Analyse a movie while it is being recorded, and all of it once the file rests."""
    path = path_in("`movie`", movie)
    number_in("`interval_s`", interval_s, above=0.0)
    check_output(out, is_resumable(out))  # now, and not when the recording is over
    say, ours = _Once(notify), False
    seen = _Growing(path, config, notify)
    say(f"looks at {path} every {interval_s:g} s, until it no longer grows")
    while True:
        while not seen.rests():
            seen.analyse_what_is_there()
            time.sleep(interval_s)
        rested = f"has not changed for {RESTS * interval_s:g} s; all of it is analysed"
        say(f"{path.name}: {rested}", again=True)
        try:
            found = fit_stack(
                path, config, out=out, overwrite=ours, progress=progress, notify=notify,
                command=command,
            )  # fmt: skip
        except DataError:  # as of a file that was written to while it was read
            if seen.rests():
                raise
        else:
            if seen.rests():
                return found
            ours = True
        say(f"{path.name}: was written to meanwhile, and is watched again", again=True)


class _Once:
    """Says each thing once, to whoever listens."""

    def __init__(self, notify: Notify | None) -> None:
        self._notify, self._known = notify, set[str]()

    def __call__(self, text: str, *, again: bool = False) -> None:
        """Say a thing, unless it was said before."""
        if again or text not in self._known:
            self._known.add(text)
            tell([text], self._notify)


class _Growing:
    """A movie that grows."""

    def __init__(self, path: Path, config: Config, notify: Notify | None) -> None:
        self._path, self._config, self._say = path, config, _Once(notify)
        self._files, self._analysed = _MovieFiles(path), 0

    def rests(self) -> bool:
        """Look at the files, and tell whether they have not changed for some looks."""
        self._files.look()
        if self._files.state is None:
            self._say(f"{self._path}: cannot be read; waiting for it")
            return False
        if self._files.checks < RESTS:
            return False
        if written := is_open_to_write(self._path):
            self._say(
                f"{self._path.name}: rests, but a program has it open to write and is waited for; "
                "if that program is gone, press Ctrl-C: `iscat fit` analyses what it wrote"
            )
        return not written

    def analyse_what_is_there(self) -> None:
        """Analyse the frames that are there, if they are many more than before."""
        try:
            with open_stack(self._path) as movie:
                frames = movie.shape[0]
                if frames < self._analysed:  # the recording was begun again
                    self._analysed = 0
                # of the first analysis, and over those of the last from which another is worth it
                if frames < max(80, 1.5 * self._analysed):
                    return
                # as an array, because a file that grows has no hash
                seen = Stack(movie.path, movie, files=(), metadata=movie.metadata)
                table = analyse(seen, self._config).table
        except ConfigError:
            raise
        except IscatError as error:
            self._say(f"not yet: {error}")
            return
        self._analysed = frames
        self._say(f"{count(frames, 'frame')}: {histogram(table)}", again=True)


def histogram(table: pd.DataFrame) -> str:
    """Draw the masses of events that are ok in one line."""
    masses = table["mass_kda"][table["status"] == Status.OK].abs().to_numpy(dtype=float)
    masses = masses[np.isfinite(masses)]
    events = count(len(table), "event")
    if not masses.size:
        return events
    highest = float(np.quantile(masses, 0.99)) * 1.05
    counts, _ = np.histogram(masses, _BINS, (0.0, highest))
    levels = np.ceil(counts / counts.max() * (len(_BARS) - 1)).astype(int)
    return f"{events}, 0 {''.join(_BARS[level] for level in levels)} {highest:.0f} kDa"


MOST_CHECKS = 6
"""Looks without a change after which a movie that cannot be read, or is gone, is taken as it is."""

FOLDER = "batch"
"""Of the results, in the folder that is watched."""


State = tuple[tuple[int, ...], ...]
Ready = tuple[Table, tuple[State | None, ...]]


@takes(DayOptions)
@told
def watch(
    folder: str | Path,
    *,
    out: str | Path | None = None,
    interval_s: float = 10.0,
    stop: threading.Event | None = None,
    progress: Progress = automatic,
    notify: Notify | None = None,
    command: str = "",
    **options: Unpack[DayOptions],
) -> Batch | None:
    """Analyse the movies of a folder as they are saved, until it is interrupted.

    Every movie is analysed as `batch` does it, and the page shows what there is.  A movie that is
    still being written is waited for; one that fails is told once, and tried again when it changes.

    Parameters
    ----------
    folder : str or Path
        Where movies are saved.  A table in it, ``samples.csv`` or ``samples.toml``, says what they
        are, as for `batch`, and may grow as well; movies that it does not name are samples.
    out : str or Path, optional
        Folder of the batch; default ``batch`` in `folder`.
    interval_s : float
        Time between two looks at the folder [s].
    stop : threading.Event, optional
        Ends the watching when it is set, once the movie in work is finished.
    progress : Progress
        Called with the stage and the steps done and in all.
    notify : callable, optional
        Told in one line what was done.
    command : str
        The command line, for the reports.
    **options

    Returns
    -------
    Batch or None
        As `batch` gives it, of everything that is finished, after Ctrl-C or `stop`; None where no
        movie came.

    Raises
    ------
    ConfigError
        The folder is none, or the configuration or the table of the beginning is wrong.
    DataError
        The folder of the batch holds something else.
    """
    watched = path_in("`folder`", folder)
    if not is_folder(watched):
        raise ConfigError(f"{watched}: there is no such folder; give the one movies are saved in")
    number_in("`interval_s`", interval_s, above=0.0)
    results = watched / FOLDER if out is None else path_in("`out`", out)
    if results.resolve() == watched.resolve():
        raise ConfigError(f"{results}: is where the movies are; choose another `out`")
    _, _, common = checked_options(options)
    calibration = options["calibration"]
    resolved: DayOptions = {
        **options,
        "config": common,
        "settings": None,
        "calibration": None if calibration is None else mass_line(calibration),
    }
    say = _Once(notify)
    analyse = partial(
        batch,
        out=results,
        **resolved,
        retry=False,
        progress=_of_one_movie(progress),
        notify=notify,
        command=command or f"iscat_analysis.watch({str(folder)!r})",
    )
    run, seen = _Run(analyse, options["standards"], say), WatchedFolder(watched, results, say)
    ended = stop or threading.Event()
    done: Ready | None = None
    try:
        seen.check()
        claim_folder(results)
        Records(results).forget_failed()
        say(f"looks at {watched} every {interval_s:g} s; Ctrl-C ends it")
        while not ended.wait(interval_s):
            found = seen.check()
            if found is not None and found != done:
                try:
                    run.bring_up_to_date(found[0], ended)
                    done = found
                except (OSError, ConfigError, SchedulerError) as error:
                    say(f"{error}; waiting until it is mended")
    except KeyboardInterrupt:
        say("ending; the page is being completed")
    return run.last_page(progress)


def _of_one_movie(progress: Progress) -> Progress:
    """Leave out the stages that count movies, of which there is one at a time."""

    def counted(stage: str, done: int, total: int) -> None:
        if stage not in ("movies", "gather"):
            progress(stage, done, total)

    return counted


@dataclass
class _MovieFiles:
    """Files of a movie when last checked, the number of equal checks, and if it is readable."""

    address: Path
    state: State | None = ()
    checks: int = 0
    readable: bool = False

    def look(self) -> bool:
        """Check them again; tell whether they changed, and were there before and are now."""
        before, self.state = self.state, _state(self.address)
        changed = self.state != before
        self.checks = 0 if changed else self.checks + 1
        self.readable &= not changed
        return changed and bool(before and self.state)

    @property
    def settled(self) -> bool:
        """Whether the movie is complete, or no longer waited for."""
        return self.checks >= MOST_CHECKS or (self.checks > 0 and self.readable)


class WatchedFolder:
    """A folder that is checked for new movies."""

    def __init__(self, folder: Path, out: Path, notify: Notify | None) -> None:
        self._folder, self._out, self._say = folder, out, _Once(notify)
        self._files: dict[Path, _MovieFiles] = {}
        self._taken: set[Path] = set()
        self._begun = False

    def check(self) -> Ready | None:
        """Give the movies that are complete, and their states.

        None where there is none, or where one that was given before is being changed.
        """
        tables = [self._files_of(self._folder / name, table=True) for name in TABLES]
        if self._begun and not all(each.state is None or each.checks for each in tables):
            return None
        inside = self._folder / self._out.name
        own = [inside] if inside.resolve() == self._out.resolve() else []
        try:
            table = read_growing(self._folder, find_movies(self._folder, but=own))
        except OSError as error:
            self._say(f"{self._folder}: cannot be read ({error.strerror}); waiting for it")
            return None
        except ConfigError as error:
            if not self._begun:
                raise
            self._say(f"{error}; waiting until it is mended")
            return None
        self._begun = True
        for given in table.absent:
            self._say(f"{given}: is in the table, and waited for")
        known = dict.fromkeys([*self._taken, *(row.path for row in table.rows)])
        files = {path: self._files_of(path) for path in known}
        ready = tuple(row for row in table.rows if files[row.path].settled)
        if not ready or not all(files[path].settled for path in self._taken):
            return None
        self._taken = {row.path for row in ready}
        states = tuple(files[row.path].state for row in ready)
        return replace(table, rows=ready, absent=()), states

    def _files_of(self, path: Path, *, table: bool = False) -> _MovieFiles:
        found = self._files.setdefault(path, _MovieFiles(path))
        if found.look() and not table:
            self._say(f"{path.name}: is being written, and waited for")
        if found.checks == 1 and found.state is not None and not table:
            found.readable = _opens(path)
        return found


def _state(address: Path) -> State | None:
    """Give what changes of a movie's files when they are written to; None where there are none."""
    try:
        found = states_of(files_of(address))
    except OSError:
        return None
    return found if found and all(found) else None


def _opens(address: Path) -> bool:
    """Tell whether a movie can be read to its end, which one that is recorded does not have."""
    try:
        with open_stack(address):
            return not is_open_to_write(address)
    except (IscatError, OSError):
        return False


class _Run:
    """Keeps a batch up to date, movie by movie, and makes its page from time to time."""

    def __init__(
        self, analyse: Callable[..., Batch], standards: str | Sequence[float] | None, say: _Once
    ) -> None:
        self._analyse, self._standards, self._say = analyse, standards, say
        self._table: Table | None = None
        self._reported: set[tuple[str, str]] = set()
        self._analysed: list[str] = []

    def bring_up_to_date(self, table: Table, stop: threading.Event) -> None:
        """Analyse movies that are new or have changed."""
        self._table = table
        number = sum(row.role != "flat" for row in table.rows)
        self._batch(table, only=(number + 1, number + 1))  # without a movie: the calibrations
        states = self._batch(table, only=(1, 1), merge=True).movies["state"]
        waiting = [k for k, state in enumerate(states, 1) if state == "missing"]
        if not waiting:  # the table has changed, or a movie is gone
            self._page(table)
        due = -math.inf
        for k in waiting:
            if stop.is_set():
                return
            part = self._batch(table, only=(k, number))
            self._reported.update(pair for pair in part.failed if pair[0] in part.analysed)
            self._analysed += part.analysed
            if k == waiting[-1] or time.monotonic() > due:
                page, due = self._page(table)
        if waiting:
            counts = Counter(page.movies["state"])
            summary = ", ".join(f"{counts[name]} {name}" for name in sorted(counts))
            self._say(f"{summary}; the page is {page.page}", again=True)

    def last_page(self, progress: Progress) -> Batch | None:
        """Make the page of everything that is finished."""
        if self._table is None:
            return None
        progress("report", 0, 1)
        found = self._batch(self._table, merge=True, progress=silent)
        progress("report", 1, 1)
        return replace(found, analysed=tuple(dict.fromkeys(self._analysed)))

    def _page(self, table: Table) -> tuple[Batch, float]:
        """Make the page, and say when the next one is due."""
        begun = time.monotonic()
        found = self._batch(table, merge=True)
        missing = set(found.movies["movie"][found.movies["state"] == "missing"])
        for name, why in found.failed:
            if name not in missing and (name, why) not in self._reported:
                self._reported.add((name, why))
                self._say(f"{name}: failed: {why}")
        ended = time.monotonic()
        # share of the time that pages between two movies may take
        return found, ended + (ended - begun) / 0.1

    def _batch(self, table: Table, **options: Any) -> Batch:
        roles = {row.role for row in table.rows}
        standards = self._standards if "calibrant" in roles else None
        return self._analyse(table, standards=standards, **options)
