"""A movie that is still being recorded: what is there is analysed, and at its end all of it.

The file is looked at again and again.  Each time it has grown by half, the frames that it holds are
analysed and the masses are told as a histogram, so that all of these together cost twice the last
one.  Once it rests, the whole movie is analysed as `iscat fit` does it, with the same result.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, IscatError
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.movie import Stack, open_stack
from iscat_analysis.movie.folders import files_of
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.records import Analysis, Progress, Status, silent
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
    overwrite: bool = False,
    interval_s: float = 10.0,
    stop: threading.Event | None = None,
    progress: Progress = silent,
    notify: Notify = lambda _: None,
    command: str = "",
) -> Analysis:
    """Analyse a movie while it is being recorded, and all of it once the file rests."""
    path = path_in("`movie`", movie)
    number_in("`interval_s`", interval_s, above=0.0)
    ended, seen = stop or threading.Event(), _Growing(path, config, notify)
    notify(f"looks at {path} every {interval_s:g} s, until it no longer grows")
    while not (seen.rests() or ended.is_set()):
        seen.analyse_what_is_there()
        ended.wait(interval_s)
    return fit_stack(
        path, config, out=out, overwrite=overwrite, progress=progress, notify=notify,
        command=command,
    )  # fmt: skip


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
        except OSError as error:
            self._say(f"{self._path}: cannot be read ({error.strerror}); waiting for it")
            return False
        self._looks = self._looks + 1 if found == self._state else 0
        self._state = found
        return bool(found) and self._looks >= RESTS

    def analyse_what_is_there(self) -> None:
        """Analyse the frames that are there, if they are many more than before."""
        try:
            with open_stack(self._path) as movie:
                frames = movie.shape[0]
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
