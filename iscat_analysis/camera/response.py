"""A camera whose counts are not linear in light, and the curve that linearises them.

The curve is a CSV file of two rising columns, ``counts`` and ``photoelectrons``.  Each frame is
converted before anything else, so that all later stages see a camera of gain 1 and offset 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import DTypeLike, NDArray

from iscat_analysis.camera.calibration.laws import Law
from iscat_analysis.camera.calibration.transfer import Transfer
from iscat_analysis.camera.counts import Camera, converter_ceiling
from iscat_analysis.config import CameraConfig
from iscat_analysis.errors import DataError
from iscat_analysis.movie import Stack
from iscat_analysis.records import CountSource, FloatArray, StackMetadata

COLUMNS = ("counts", "photoelectrons")
"""Of a response curve."""

_POINTS = 1025
_HIGHEST = 0.98  # of the counts at which a camera saturates, up to which the curve goes


@dataclass(frozen=True, eq=False)
class Response:
    """Photoelectrons against counts, linear between points; beyond the last one a pixel is full.

    Shapes: `counts` (n,), `photoelectrons` (n,).
    """

    counts: FloatArray
    photoelectrons: FloatArray

    def of(self, counts: NDArray[Any]) -> FloatArray:
        """Convert counts; below the first point with the slope there, because of noise."""
        seen = np.asarray(counts, dtype=np.float64)
        out: FloatArray = np.interp(seen, self.counts, self.photoelectrons)
        below = np.minimum(seen - self.counts[0], 0.0)
        slope = (self.photoelectrons[1] - self.photoelectrons[0]) / (
            self.counts[1] - self.counts[0]
        )
        out += below * slope
        return out

    @property
    def full(self) -> float:
        """Photoelectrons from which a pixel is full."""
        return float(self.photoelectrons[-1])

    @property
    def table(self) -> pd.DataFrame:
        """The curve as it is written."""
        return pd.DataFrame(dict(zip(COLUMNS, (self.counts, self.photoelectrons), strict=True)))


class LinearFrames:
    """Frames of a movie as photoelectrons."""

    notes: tuple[str, ...] = ()
    metadata = StackMetadata()

    def __init__(self, movie: CountSource, response: Response) -> None:
        self._movie, self._response = movie, response
        self.shape, self.name = movie.shape, movie.name
        self.dtype = np.dtype(np.float32 if movie.dtype.itemsize <= 2 else np.float64)
        whole = np.issubdtype(movie.dtype, np.unsignedinteger) and movie.dtype.itemsize <= 2
        self._known: NDArray[Any] | None = None
        if whole:
            every = np.arange(np.iinfo(movie.dtype).max + 1)
            self._known = response.of(every).astype(self.dtype)
            self._known[-1] = response.full

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        counts = self._movie.read(start, stop)
        if self._known is None:
            out: NDArray[Any] = self._response.of(counts).astype(self.dtype)
        else:
            out = self._known[counts]
        ceiling = converter_ceiling(counts)
        if math.isfinite(ceiling):
            out[counts >= ceiling] = self._response.full
        return out

    def close(self) -> None:
        """Leave the movie open; it belongs to the caller."""


def linear(movie: Stack, config: CameraConfig) -> Stack:
    """Linearise a movie with its response curve."""
    if config.response is None:
        return movie
    return movie.seen_as(LinearFrames(movie, read_response(Path(config.response))))


def full_scale(config: CameraConfig, dtype: DTypeLike) -> float | None:
    """Largest number that a pixel can have: the end of the curve, or of the stored type."""
    if config.response is not None:
        return read_response(Path(config.response)).full
    stored = np.dtype(dtype)
    return float(np.iinfo(stored).max) if np.issubdtype(stored, np.integer) else None


def read_response(path: Path) -> Response:
    """Read a response curve."""
    where = f"{path}: camera.response"
    try:
        table = pd.read_csv(path, comment="#")
    except FileNotFoundError:
        raise DataError(f"{where} names a file that does not exist; check the path") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{where} cannot be read as CSV ({error})") from None
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        raise DataError(
            f"{where} needs the columns {' and '.join(COLUMNS)}, but has no {missing[0]}"
        )
    try:
        counts, electrons = (table[name].to_numpy(float) for name in COLUMNS)
    except ValueError:
        raise DataError(f"{where} holds text; give numbers") from None
    rising = all(
        np.isfinite(values).all() and (np.diff(values) > 0).all() for values in (counts, electrons)
    )
    if len(counts) < 2 or not rising:
        raise DataError(f"{where} needs two rows or more, in which both columns rise")
    return Response(counts, electrons)


def response_of(law: Law, found: Transfer, camera: Camera, top: float) -> Response:
    """Make the curve of a law that the pixels of a movie follow, up to the highest count.

    Notes
    -----
    The law has light up to a factor; the variance has it whole: N = κ²m²/v, with κ = d ln m/d ln N.
    """
    gain, offset = (float(np.mean(v)) for v in (camera.gain_e_per_adu, camera.offset_adu))
    level = found.level / gain  # in counts above the offset
    zero = offset + law.offset * level
    mean, variance = found.light / gain - law.offset * level, found.variance / gain**2
    weight = np.square(found.variance / found.variance_se)
    end = top
    if law.kind == "gamma":

        def light(above: FloatArray) -> FloatArray:
            return np.power(above / level, 1 / law.value)

        contrast = np.full(mean.shape, law.value)
    else:
        full = (1 - law.offset) * level / -math.expm1(-law.value)
        end = min(top, zero + _HIGHEST * full)

        def light(above: FloatArray) -> FloatArray:
            return np.asarray(-np.log1p(-above / full))

        n = light(np.minimum(mean, _HIGHEST * full))
        contrast = n / np.expm1(n)
    scale = float(np.average(np.square(contrast * mean) / variance / light(mean), weights=weight))
    counts = np.linspace(zero, end, _POINTS)
    return Response(counts, scale * light(counts - zero))
