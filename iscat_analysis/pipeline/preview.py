"""What one looks at before a movie is analysed: the search of `analyse`, and a ratiometric film.

The frames, windows, matched filter and threshold are those with which `analyse` begins, because
both prepare the movie by the same steps (`calibrated`); nothing is fitted.  The optics are the
configured ones: learning them takes fits of particles.

Frames of the film are read when they are needed, and the two sums follow a player from frame to
frame, so that a movie of any length is played with the memory of two images.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import printing
from iscat_analysis.inference.checks import number_in
from iscat_analysis.movie import Stack
from iscat_analysis.pipeline.kinds import Look, kind_of, positive_threshold
from iscat_analysis.records import FloatArray


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
    window : int
        Frames that `analyse` sums: as configured, or chosen from the noise.
    longest : int
        Frames that a window may have at most.
    frames : (int, int)
        Frames that `analyse` looks at, half-open.

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
        self._search = search = kind_of(self.config).search(self.prepared)
        self.window, self.longest, self.frames = search.window, search.longest, search.frames
        self._lock = threading.Lock()  # a viewer may ask from several threads

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


_SAMPLED = 5  # frames from which limits of the contrast are taken, at most
_READ_BYTES = 2**29  # of frames that are looked at before a movie is shown, for either purpose


def film_limits(
    image: Callable[[int], NDArray[Any]], frames: tuple[int, int], most: int = _SAMPLED
) -> tuple[float, float]:
    """Give the limits between which most of the pixels of a few frames of a film lie."""
    looked = np.unique(np.linspace(frames[0], frames[1] - 1, most).astype(int))
    seen = np.concatenate([np.ravel(image(int(t))) for t in looked]).astype(np.float64)
    seen = seen[np.isfinite(seen)]
    low, high = np.quantile(seen, (0.001, 0.999)) if seen.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


class RatioFilm:
    """The ratiometric film of a movie, in which particles appear as they land.

    Each frame is divided by its mean first, so that a flickering laser does not show.  Counts are
    above `offset_adu`: with the wrong one every contrast is wrong by the same factor.
    """

    def __init__(self, movie: Stack, *, window: int = 1, offset_adu: float = 0.0) -> None:
        self.movie = movie
        self.offset_adu = float(offset_adu)
        self._window = 0
        self._summed = -1, 0.0  # the frame that sums are around, and the offset of their counts
        shape = movie.shape[1:]
        self._before, self._after = np.zeros(shape), np.zeros(shape)
        self.window = window

    @property
    def window(self) -> int:
        """Frames in each of the two means."""
        return self._window

    @window.setter
    def window(self, frames: int) -> None:
        """Take means of so many frames from now on."""
        frames = int(number_in("`window`", frames, least=1, most=self.longest, whole=True))
        if frames != self._window:
            self._window, self._summed = frames, (-1, 0.0)

    @property
    def longest(self) -> int:
        """Frames that a window may have at most."""
        return self.movie.shape[0] // 2

    @property
    def frames(self) -> tuple[int, int]:
        """Frames that have a whole window before and after them, half-open."""
        return self._window, self.movie.shape[0] - self._window + 1

    def raw(self, frame: int) -> FloatArray:
        """Give the counts of a frame.

        Shapes: result (y, x).
        """
        frame = min(max(frame, 0), self.movie.shape[0] - 1)
        return np.asarray(self.movie.read(frame, frame + 1)[0], dtype=np.float64)

    def contrast(self, frame: int) -> FloatArray:
        """Give the mean from a frame on over the mean before it, minus 1.

        Shapes: result (y, x).
        """
        first, stop = self.frames
        self._sum_around(min(max(frame, first), stop - 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._after / self._before - 1.0

    def light(self, most: int = 400) -> pd.DataFrame:
        """Give light and noise of frames all over the movie, at most so many, fewer of large ones.

        Columns: frame, light [counts above the offset, mean of the pixels], noise (standard
        deviation of the contrast of this frame to the next, of one frame).
        """
        last, most = self.movie.shape[0] - 2, self._affordable(2, most)
        rows = []
        for frame in np.unique(np.linspace(0, last, min(most, last + 1)).astype(int)):
            pair = self.movie.read(int(frame), int(frame) + 2).astype(np.float64) - self.offset_adu
            light = pair.mean(axis=(1, 2))
            with np.errstate(divide="ignore", invalid="ignore"):
                change = (pair[1] / light[1]) / (pair[0] / light[0])
            change = change[np.isfinite(change)]
            noise = float(np.std(change)) / math.sqrt(2) if change.size else math.nan
            rows.append((int(frame), float(light[0]), noise))
        return pd.DataFrame(rows, columns=["frame", "light", "noise"])

    def limits(self, *, ratio: bool) -> tuple[float, float]:
        """Give the limits between which most of the pixels of a few frames lie.

        Those of the contrast are as far above 0 as below.
        """
        if not ratio:
            return film_limits(self.raw, (0, self.movie.shape[0]))
        looks = self._affordable(2 * self._window, _SAMPLED)
        low, high = film_limits(self.contrast, self.frames, looks)
        most = max(abs(low), abs(high)) or 1.0
        return -most, most

    def _affordable(self, frames: int, most: int) -> int:
        """Say how many looks at so many frames may be taken."""
        frame_bytes = math.prod(self.movie.shape[1:]) * self.movie.dtype.itemsize
        return min(most, max(1, _READ_BYTES // (frames * frame_bytes)))

    def _frame(self, number: int) -> FloatArray:
        counts: FloatArray = self.movie.read(number, number + 1)[0].astype(np.float64)
        counts -= self.offset_adu
        light = float(counts.mean())
        if not light > 0:
            raise ConfigError(
                f"{self.movie.name}: frame {number} is no brighter than camera.offset_adu = "
                f"{self.offset_adu:g}: correct the offset"
            )
        counts /= light
        return counts

    def _sum_around(self, frame: int) -> None:
        """Sum the frames before one and from it on, from the last sums where these are near."""
        window, (last, offset) = self._window, self._summed
        self._summed = -1, 0.0  # an error leaves no sums
        if last < 0 or offset != self.offset_adu or abs(frame - last) > window // 2:
            self._before[:], self._after[:] = 0.0, 0.0
            for number in range(window):
                self._before += self._frame(frame - window + number)
                self._after += self._frame(frame + number)
        else:
            sign = 1.0 if frame > last else -1.0
            for number in range(min(last, frame), max(last, frame)):
                passing = self._frame(number)
                self._before += sign * (passing - self._frame(number - window))
                self._after += sign * (self._frame(number + window) - passing)
        self._summed = frame, self.offset_adu
