"""A movie that is still being recorded: what is there is analysed, and at its end all of it.

The file is looked at again and again.  Each time it has grown by half, the frames that it holds are
analysed and the masses are told as a histogram, so that all of these together cost twice the last
one.  Once it rests, the whole movie is analysed as `iscat fit` does it, with the same result; if
the file has grown meanwhile, because the camera had only paused, once more.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError, IscatError
from iscat_analysis.fitting.checkpoint import is_resumable
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.movie import Stack, open_stack
from iscat_analysis.movie.folders import files_of, is_open_to_write
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.records import Analysis, Progress, Status, silent
from iscat_analysis.report.output import check_output
from iscat_analysis.units import count

RESTS = 3
"""Looks without a change after which a movie is complete."""

GROWTH = 1.5
"""Frames over those of the last analysis, from which it is worth another."""

_FEWEST_FRAMES = 80  # of the first analysis
_BINS = 24  # of the histogram
_BARS = " ▁▂▃▄▅▆▇█"

Notify = Callable[[str], None]


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
    seen, ours = _Growing(path, config, notify), False
    notify(f"looks at {path} every {interval_s:g} s, until it no longer grows")
    while True:
        while not seen.rests():
            seen.analyse_what_is_there()
            time.sleep(interval_s)
        notify(f"{path.name}: has not changed for {RESTS * interval_s:g} s; all of it is analysed")
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
        notify(f"{path.name}: was written to meanwhile, and is watched again")


class _Growing:
    """A movie that grows."""

    def __init__(self, path: Path, config: Config, notify: Notify) -> None:
        self._path, self._config, self._notify = path, config, notify
        self._state: object = None
        self._looks, self._analysed = 0, 0
        self._said: set[str] = set()

    def rests(self) -> bool:
        """Look at the files, and tell whether they have not changed for some looks."""
        try:
            found = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files_of(self._path)]
            self._looks = self._looks + 1 if found == self._state else 0
            rests = bool(found) and self._looks >= RESTS
            written = rests and is_open_to_write(self._path)
        except OSError as error:
            self._say(f"{self._path}: cannot be read ({error.strerror}); waiting for it")
            return False
        self._state = found
        if written:
            self._say(
                f"{self._path.name}: rests, but a program has it open to write and is waited for; "
                "if that program is gone, press Ctrl-C: `iscat fit` analyses what it wrote"
            )
        return rests and not written

    def analyse_what_is_there(self) -> None:
        """Analyse the frames that are there, if they are many more than before."""
        try:
            with open_stack(self._path) as movie:
                frames = movie.shape[0]
                if frames < self._analysed:  # the recording was begun again
                    self._analysed = 0
                if frames < max(_FEWEST_FRAMES, GROWTH * self._analysed):
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
        self._notify(f"{count(frames, 'frame')}: {histogram(table)}")

    def _say(self, text: str) -> None:
        """Say a thing once."""
        if text not in self._said:
            self._said.add(text)
            self._notify(text)


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
