"""What a run of the main job tells and keeps beside its result: words, progress, times, parts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from iscat_analysis.inference.noise import compile_kernels
from iscat_analysis.pipeline.compilation import Compilation
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.places import Place
from iscat_analysis.records import Analysis, Progress

Notify = Callable[[str], None]


def unheard(text: str) -> None:
    """Tell nobody.

    Parameters
    ----------
    text : str
        What would have been told.
    """


class Clock:
    """Seconds since the last lap, by name."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Book the time since the last lap under a name."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes
    ----------
    notify : callable
        Told what the user should know of the run, one line at a time.
    progress : Progress
        Told how far each stage is.
    compilation : Compilation
        Of the kernels.
    partial : Path or None
        Folder that keeps finished parts of a movie; None keeps nothing.
    place : Place
        Where the chunks of a landing movie are analysed.
    inject : int
        Known particles to add to a landing movie in a second run.
    begin_report : callable
        Given what was found before its species are known.
    clock : Clock
        Seconds per stage.
    warnings : list of str
        What the user should know of the movie and its result, as it was told.
    """

    notify: Notify
    progress: Progress
    compilation: Compilation
    partial: Path | None
    place: Place
    inject: int
    begin_report: Callable[[Analysis], None]
    clock: Clock = field(default_factory=Clock)
    warnings: list[str] = field(default_factory=list)

    def tell(self, text: str) -> None:
        """Tell the user something that belongs to the result, and keep it."""
        self.warnings.append(text)
        self.notify(text)

    def warm_up(self, scene: Scene) -> None:
        """Load the compiled kernels of fits, or compile them."""
        compile_kernels(scene.model, self.compilation.needs)
