"""The search of `analyse` in the frames that one is looking at, before a movie is analysed.

The frames, windows, matched filter and threshold are those with which `analyse` begins, because
both prepare the movie by the same steps (`calibrated`); nothing is fitted.  The optics are the
configured ones: learning them takes fits of particles.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from iscat_analysis.config import Config
from iscat_analysis.diagnosis.calibrated import calibrated
from iscat_analysis.diagnosis.prepared import Prepared
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import printing
from iscat_analysis.fitting.background_mode import BackgroundMode
from iscat_analysis.inference.checks import number_in
from iscat_analysis.movie import Stack
from iscat_analysis.pipeline.preview_searches import (
    BeforeAfterSearch,
    LandingSearch,
    Look,
    MovingSearch,
    Search,
    positive_threshold,
)

_SEARCHES: Mapping[BackgroundMode, Callable[[Prepared], Search]] = {
    "fixed": BeforeAfterSearch,
    "sliding": LandingSearch,
    "tracks": MovingSearch,
}


class Preview:
    """The search for particles in the frames that one is looking at.

    A landing movie is searched for what lands or leaves between two windows, those just before a
    frame and those from it on; a movie with background frames for what is there in the frames from
    it on; a movie of moving particles in the frame itself.

    Parameters
    ----------
    movie : Stack
        From `open_stack`; it must stay open.
    config : Config
        As for `fit_movie`.

    Attributes
    ----------
    config : Config
        With what the movie's metadata and its frames say.
    notes : tuple of str
        What an analysis would warn of before its search, one line each.
    camera : LearnedCamera
        Its numbers, and where they come from.
    steady : Stack
        The frames with what is unsteady in their light divided out.
    prepared : Prepared
        All that an analysis knows of the movie before it learns the optics.

    Raises
    ------
    DataError
        The movie is too short, or its frames are impossible.
    ConfigError
        The configuration does not suit the movie.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> with ia.open_stack("movie.tif") as movie:  # doctest: +SKIP
    ...     look = ia.Preview(movie, ia.configure("C.toml")).look(200)
    ...     look.found(threshold=5.0)
    """

    def __init__(self, movie: Stack, config: Config) -> None:
        if not isinstance(movie, Stack) or not isinstance(config, Config):
            raise ConfigError(
                f"`movie` is {type(movie).__name__} and `config` {type(config).__name__}: give "
                "what open_stack and configure return"
            )
        notes: list[str] = []
        self.prepared = calibrated(movie, config, report=printing(notes.append))
        self.config = self.prepared.over_all_stretches().config
        self.notes = tuple(notes)
        self.camera, self.steady = self.prepared.known, self.prepared.steady
        dark = self.config.optics.scheme == "darkfield"  # each frame by itself
        self._search = _SEARCHES["fixed" if dark else self.prepared.background_mode](self.prepared)
        self._lock = threading.Lock()  # a viewer may ask from several threads

    @property
    def window(self) -> int:
        """Frames that `analyse` sums: as configured, or chosen from the noise."""
        return self._search.window

    @property
    def longest(self) -> int:
        """Frames that a window may have at most."""
        return self._search.longest

    @property
    def frames(self) -> tuple[int, int]:
        """Frames that `analyse` looks at, half-open."""
        return self._search.frames

    def threshold(self, window: int | None = None) -> float:
        """Give the threshold that is configured.

        Parameters
        ----------
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        float
            Signal-to-noise ratio.
        """
        return self._search.context(self._checked(window)).templates.threshold

    def false_alarms(self, threshold: float, window: int | None = None) -> float:
        """Say how many false alarms a threshold would bring.

        Parameters
        ----------
        threshold : float
            Signal-to-noise ratio.
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        float
            Expected in the whole movie: the ``detection.false_alarms_per_movie`` that has this
            threshold.
        """
        templates = self._search.context(self._checked(window)).templates
        above = templates.excursions.above
        share = above(positive_threshold(threshold)) / above(templates.threshold)
        return self.config.detection.false_alarms_per_movie * share

    def look(self, frame: int, window: int | None = None) -> Look:
        """Search the frames around one.

        Parameters
        ----------
        frame : int
            Number of the frame.
        window : int, optional
            Frames that are summed; default `window`.

        Returns
        -------
        Look
            Contrast, threshold, and what exceeds it.

        Raises
        ------
        DataError
            The frames cannot be read or are impossible.
        ConfigError
            The window is not one of 1 to `longest`.
        """
        number = int(number_in("`frame`", frame, whole=True))
        with self._lock:
            return self._search.look(number, self._checked(window))

    def _checked(self, window: int | None) -> int:
        if window is None:
            return self.window
        return int(number_in("window", window, least=1, most=self.longest, whole=True))
