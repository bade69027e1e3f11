"""Pixel size and timing as one kind of metadata gives them, checked for sanity and merged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from iscat_analysis.errors import DataError
from iscat_analysis.records import StackMetadata

_SQUARE_TOLERANCE = 1e-3  # relative; writers round resolutions to six digits or fewer

LENGTH_NM = {
    "pm": 1e-3,
    "å": 0.1,
    "angstrom": 0.1,
    "nm": 1.0,
    "nanometer": 1.0,
    "nanometers": 1.0,
    "µm": 1e3,
    "μm": 1e3,
    "um": 1e3,
    "\\u00b5m": 1e3,
    "micron": 1e3,
    "microns": 1e3,
    "micrometer": 1e3,
    "micrometers": 1e3,
    "mm": 1e6,
    "cm": 1e7,
    "inch": 2.54e7,
    "in": 2.54e7,
    "m": 1e9,
}
"""Nanometres in one unit of length, by its lower-case name (both Unicode micro signs)."""

TIME_S = {
    "ns": 1e-9,
    "µs": 1e-6,
    "μs": 1e-6,
    "us": 1e-6,
    "ms": 1e-3,
    "msec": 1e-3,
    "s": 1.0,
    "sec": 1.0,
    "min": 60.0,
    "h": 3600.0,
}
"""Seconds in one unit of time, by its lower-case name."""


@dataclass(frozen=True)
class Hints:
    """What one kind of metadata says; None where it is silent.

    Attributes
    ----------
    source : str
        As in `StackMetadata.source`.
    pixel_x_nm, pixel_y_nm : float or None
        Pixel size along each axis [nm].
    exposure_ms : float or None
        Exposure of one frame [ms].
    frame_rate_hz : float or None
        Frames per second [Hz].
    """

    source: str
    pixel_x_nm: float | None = None
    pixel_y_nm: float | None = None
    exposure_ms: float | None = None
    frame_rate_hz: float | None = None


def positive(value: object, factor: float = 1.0) -> float | None:
    """Read a number that must be finite and above zero to mean anything.

    Parameters
    ----------
    value : object
        A number, or text that holds one.
    factor : float
        Converts the unit.

    Returns
    -------
    float or None
        The product; None where there is no such number.
    """
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        return None
    try:
        number = float(value) * factor
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def inverse(value: float | None) -> float | None:
    """Turn an interval into a rate, or back.

    Parameters
    ----------
    value : float or None
        Positive.

    Returns
    -------
    float or None
        Its inverse; None stays None.
    """
    return None if value is None else positive(1 / value)


def merge(hints: Sequence[Hints], path: Path) -> StackMetadata:
    """Take each value from the first kind of metadata that gives it.

    Parameters
    ----------
    hints : sequence of Hints
        Most trusted first.
    path : Path
        What messages call the file.

    Returns
    -------
    StackMetadata
        `source` joins the kinds that contributed with ``"+"``.

    Raises
    ------
    DataError
        The pixels are not square.
    """
    pixel_size = exposure = rate = None
    sources = []
    for hint in hints:
        spoke = False
        if pixel_size is None and hint.pixel_x_nm is not None:
            pixel_size, spoke = _square(hint, path), True
        if exposure is None and hint.exposure_ms is not None:
            exposure, spoke = hint.exposure_ms, True
        if rate is None and hint.frame_rate_hz is not None:
            rate, spoke = hint.frame_rate_hz, True
        if spoke:
            sources.append(hint.source)
    return StackMetadata(pixel_size, exposure, rate, "+".join(sources) or "none")


def _square(hint: Hints, path: Path) -> float | None:
    x, y = hint.pixel_x_nm, hint.pixel_y_nm
    if x is not None and y is not None and abs(y / x - 1) > _SQUARE_TOLERANCE:
        raise DataError(
            f"{path}: its pixels measure {x:g} nm in x and {y:g} nm in y, but they must be "
            "square; correct the metadata, or resample the movie"
        )
    return x
