"""The interface of a movie, and sums of its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.records.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class StackMetadata:
    """Metadata of a movie file; None where the file has no value.

    Attributes
    ----------
    pixel_size_nm : float or None
        In the sample plane [nm].
    exposure_ms : float or None
        Exposure of one frame [ms].
    frame_rate_hz : float or None
        Frames per second [Hz]; the camera's own, where frames are missing.
    ticks : tuple of int or None
        Number of camera intervals from the first frame to each frame, shape (t,), if frames are
        missing; None if none is missing or this is not known.
    gain_e_per_adu : float or None
        Photoelectrons per count, from the camera's driver.
    offset_adu : float or None
        Counts in the dark, from the camera's driver.
    wavelength_nm : float or None
        Of the illumination, in vacuum [nm].
    na : float or None
        Numerical aperture of the objective.
    magnification : float or None
        Of the objective, as engraved.
    binning : float or None
        Pixels of the sensor along a side of one of the movie.
    displayed_hz : float or None
        Frames per second at which ImageJ shows the movie [Hz]; the camera may have been faster.
    source : str
        Source of the metadata: ``"ome"``, ``"imagej"``, ``"micromanager"``, ``"tiff"``, the name
        of a file beside it, ``"none"``…
    """

    pixel_size_nm: float | None = None
    exposure_ms: float | None = None
    frame_rate_hz: float | None = None
    ticks: tuple[int, ...] | None = None
    gain_e_per_adu: float | None = None
    offset_adu: float | None = None
    wavelength_nm: float | None = None
    na: float | None = None
    magnification: float | None = None
    binning: float | None = None
    displayed_hz: float | None = None
    source: str = "none"


class FrameSource(Protocol):
    """A movie that is read a few frames at a time."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def name(self) -> str:
        """Name in messages."""

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` as stored, shape (stop − start, y, x) [counts]."""


@dataclass(frozen=True)
class InPlace:
    """Memory-mapped frames of a file, which are read-only.

    Attributes
    ----------
    counts : ndarray, shape (t, y, x)
        The stored counts; they may be used as long as `check` does not raise.
    check : callable
        Raises DataError if the file has become shorter: reading beyond its end kills the process.
    let_go : callable
        Releases the memory of all frames; they are read from the file again when they are used.
    """

    counts: NDArray[Any]
    check: Callable[[], None]
    let_go: Callable[[], None]


class CountSource(FrameSource, Protocol):
    """A movie and the type of its numbers."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""


@runtime_checkable
class PlacedSource(Protocol):
    """A movie whose frames can be memory-mapped."""

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Frames ``[start, stop)`` without a copy; None where they have to be read."""


@dataclass(frozen=True)
class Windows:
    """Photoelectrons summed before and after the particles bound.

    The raw counts are summed, never rescaled frames, so that both sums stay Poisson; laser power
    enters through `power_ratio` alone (physics.md, section 4).

    Attributes
    ----------
    before_e, after_e : ndarray, shape (y, x)
        Summed photoelectrons [e].  With a known background `before_e` is its expectation for
        `n_before` = 1 frame.
    n_before, n_after : int
        Frames in each sum; `n_before` = 0 where the background is known.
    power_ratio : float
        ρ, total power after over total power before.
    read_variance_before_e2, read_variance_after_e2 : ndarray, shape (y, x)
        Read-noise variance of each sum [e²].
    masked : ndarray of bool, shape (y, x)
        Pixels that must not be used: dead, hot or saturated.
    saturated : ndarray of bool, shape (y, x)
        The saturated ones among them.
    frames_before, frames_after : (int, int)
        The half-open frame ranges.
    power : ndarray, shape (t,)
        Power of every frame in both ranges over the mean power before; before first.
    """

    before_e: FloatArray
    after_e: FloatArray
    n_before: int
    n_after: int
    power_ratio: float
    read_variance_before_e2: FloatArray
    read_variance_after_e2: FloatArray
    masked: BoolArray
    saturated: BoolArray
    frames_before: tuple[int, int]
    frames_after: tuple[int, int]
    power: FloatArray

    @property
    def left_out(self) -> tuple[int, int]:
        """Numbers of dead, hot or noisy pixels, and of saturated ones."""
        defects = self.masked & ~self.saturated
        return int(defects.sum()), int(self.saturated.sum())

    def cut(self, region: tuple[slice, slice]) -> Windows:
        """Give the sums of some pixels."""
        return replace(
            self,
            before_e=self.before_e[region],
            after_e=self.after_e[region],
            read_variance_before_e2=self.read_variance_before_e2[region],
            read_variance_after_e2=self.read_variance_after_e2[region],
            masked=self.masked[region],
            saturated=self.saturated[region],
        )
