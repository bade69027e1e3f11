"""Descriptions other than OME-XML: ImageJ, tifffile's own ('shaped'), Micro-Manager, plain TIFF."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from iscat_analysis.movie.axes import time_axis
from iscat_analysis.movie.hints import LENGTH_NM, TIME_S, Hints, inverse, positive

_IMAGEJ_AXES = {"channels": "C", "slices": "Z", "frames": "T"}
_SHAPED = re.compile(r'^\{\s*"shape"\s*:')
_MOST_DIGITS = 20  # any count of more digits is beyond every file, and stays so when cut
_INCH, _CENTIMETRE = 2, 3
_RESOLUTION_UNIT_NM = {_INCH: LENGTH_NM["inch"], _CENTIMETRE: LENGTH_NM["cm"]}
_PLAUSIBLE_PIXEL_NM = (5.0, 5000.0)  # outside: a printer's 72 or 300 dpi, not a microscope


@dataclass(frozen=True)
class Described:
    """How many frames a description announces.

    Attributes
    ----------
    frames : int
        From the image that carries the description onwards.
    one_directory : bool
        Whether the convention allows a single directory, the other frames' pixels following it.
    """

    frames: int
    one_directory: bool


def described_frames(text: str, rows: int, columns: int, path: Path) -> Described | None:
    """Read how many frames an ImageJ or tifffile description announces.

    Parameters
    ----------
    text : str
        The description.
    rows, columns : int
        Size of the image that carries it [px].
    path : Path
        What messages call the file.

    Returns
    -------
    Described or None
        None where the description is of neither kind.

    Raises
    ------
    DataError
        More than one axis besides y and x.
    """
    if text.startswith("ImageJ="):
        fields = _imagej_fields(text)
        time_axis({axis: _count(fields, key) for key, axis in _IMAGEJ_AXES.items()}, path)
        return Described(_count(fields, "images"), one_directory=True)
    if _SHAPED.match(text):
        return _shaped(text, rows, columns, path)
    return None


def imagej_hints(text: str, resolution: tuple[float, float, int] | None) -> Hints:
    """Read ImageJ's pixel size and frame interval.

    Parameters
    ----------
    text : str
        The description.
    resolution : (float, float, int) or None
        The TIFF resolution tags: pixels per ImageJ's own unit.

    Returns
    -------
    Hints
        None where ImageJ was not calibrated.
    """
    fields = _imagej_fields(text)
    x_nm = y_nm = None
    unit = LENGTH_NM.get(fields.get("unit", "").lower())
    if unit is not None and resolution is not None:
        y_unit = LENGTH_NM.get(fields.get("yunit", fields["unit"]).lower(), unit)
        x_nm, y_nm = positive(1 / resolution[0], unit), positive(1 / resolution[1], y_unit)
        if unit in _RESOLUTION_UNIT_NM.values() and not _plausible(x_nm, y_nm):
            x_nm = y_nm = None
    seconds = TIME_S.get(fields.get("tunit", "s").lower())
    interval = positive(fields.get("finterval"), seconds) if seconds else None
    rate = inverse(interval) or positive(fields.get("fps"))
    return Hints("imagej", x_nm, y_nm, frame_rate_hz=rate)


def micro_manager_axes(summary: Mapping[str, Any]) -> dict[str, int]:
    """Planned lengths of Micro-Manager's axes, from its summary.

    Parameters
    ----------
    summary : mapping
        Of the acquisition; may be empty.

    Returns
    -------
    dict of str to int
        Length of each axis; 1 where the summary is silent.
    """
    names = {"Frames": "T", "Slices": "Z", "Channels": "C", "Positions": "P"}
    return {axis: int(_mm_number(summary.get(name)) or 1) for name, axis in names.items()}


def micro_manager_hints(first: str, last: str, n_frames: int, summary: Mapping[str, Any]) -> Hints:
    """Read Micro-Manager's metadata.

    Parameters
    ----------
    first, last : str
        JSON of the first and of the last frame.
    n_frames : int
        In the movie.
    summary : mapping
        Of the acquisition; may be empty.

    Returns
    -------
    Hints
        A pixel size of 0 is Micro-Manager's word for unknown, and an interval of 0, or one
        shorter than the exposure, for "as fast as possible": then the time stamps decide.
    """
    begin, end = _json_object(first), _json_object(last)

    def find(name: str) -> float | None:
        return _mm_number(begin.get(name)) or _mm_number(summary.get(name))

    pixel = positive(find("PixelSizeUm"), 1e3)
    exposure = find("Exposure-ms")
    interval = find("Interval_ms")
    if interval is not None and exposure is not None and interval < exposure:
        interval = None
    if interval is None:
        stamps = [_mm_stamp(frame.get("ElapsedTime-ms")) for frame in (begin, end)]
        if stamps[0] is not None and stamps[1] is not None and n_frames > 1:
            interval = positive((stamps[1] - stamps[0]) / (n_frames - 1))
    rate = None if interval is None else positive(1e3 / interval)
    return Hints("micromanager", pixel, pixel, exposure_ms=exposure, frame_rate_hz=rate)


def plain_hints(resolution: tuple[float, float, int] | None) -> Hints:
    """Read the TIFF resolution tags, where they could mean a microscope's pixels.

    Parameters
    ----------
    resolution : (float, float, int) or None
        Pixels per unit along x and y, and the unit.

    Returns
    -------
    Hints
        With a pixel size only between 5 nm and 5 µm.
    """
    if resolution is None or resolution[2] not in _RESOLUTION_UNIT_NM:
        return Hints("tiff")
    unit = _RESOLUTION_UNIT_NM[resolution[2]]
    x_nm, y_nm = unit / resolution[0], unit / resolution[1]
    return Hints("tiff", x_nm, y_nm) if _plausible(x_nm, y_nm) else Hints("tiff")


def _plausible(*sizes_nm: float | None) -> bool:
    low, high = _PLAUSIBLE_PIXEL_NM
    return all(size is not None and low <= size <= high for size in sizes_nm)


def _imagej_fields(text: str) -> dict[str, str]:
    pairs = (line.partition("=") for line in text.splitlines())
    return {key.strip(): value.strip() for key, equals, value in pairs if equals}


def _count(fields: Mapping[str, str], key: str) -> int:
    value = fields.get(key, "1")
    if not (value.isascii() and value.isdigit()):
        return 1
    return max(1, int(value[:_MOST_DIGITS]))


def _shaped(text: str, rows: int, columns: int, path: Path) -> Described | None:
    fields = _json_object(text)
    shape, axes = fields.get("shape"), fields.get("axes")
    if not isinstance(shape, list) or not all(type(n) is int and n > 0 for n in shape):
        return None
    if isinstance(axes, str) and len(axes) == len(shape):
        sizes = {axis: n for axis, n in zip(axes, shape, strict=True) if axis not in "YX"}
        axis = time_axis(sizes, path)
        return Described(sizes[axis] if axis else 1, bool(fields.get("truncated")))
    leading = shape[:-2] if shape[-2:] == [rows, columns] else shape[:-3]
    long = [n for n in leading if n > 1]
    # Without names, the first axis is time; a second one is refused under its number.
    axis = time_axis({("T" if k == 0 else f"number {k + 1}"): n for k, n in enumerate(long)}, path)
    return Described(long[0] if axis else 1, bool(fields.get("truncated")))


def _json_object(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _mm_number(value: object) -> float | None:
    """Read a positive number, bare or wrapped as Micro-Manager 2 wraps device properties."""
    return positive(value.get("PropVal") if isinstance(value, dict) else value)


def _mm_stamp(value: object) -> float | None:
    """Read a time stamp, which unlike every other number may be 0."""
    if isinstance(value, dict):
        value = value.get("PropVal")
    if isinstance(value, (int, float)) and value == 0:
        return 0.0
    return positive(value)
