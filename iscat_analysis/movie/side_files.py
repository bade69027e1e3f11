"""What drivers of cameras and texts beside a movie say of its recording.

What drivers of cameras, and programs that record with them, call the numbers of a recording.

Andor Solis writes a text of names and values, and so do readers of its SIF files; Basler and other
cameras of the GenICam standard have its names and microseconds; PyLabLib has seconds below
``cam/``; Hamamatsu's and Photometrics' drivers are seen through Micro-Manager and Bio-Formats,
behind the name that somebody gave the camera.  A gain in decibels, or as a factor of an amplifier,
is not among them: it is not known how many photoelectrons a count then is.

What a text beside a movie says of its recording: names and values, or JSON.

Programs that cannot write into the movie's file leave their settings under its name: Andor Solis
``movie.txt``, PyLabLib ``movie_settings.dat``, Basler's viewer ``movie.pfs``, Micro-Manager
``movie_metadata.txt``, and laboratories ``movie.json`` of their own.  Of all that is in them only
the names of `driver_names` are read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from iscat_analysis.config import WAVELENGTH_NM
from iscat_analysis.reading import is_file, json_of, read_text
from iscat_analysis.records import StackMetadata

LARGEST_NA = 2.0
"""Of any objective, solid immersion aside."""

_EVERYWHERE = {
    "actual gain e/adu": ("gain_e_per_adu", 1.0),  # Photometrics
    "conversion factor coeff": ("gain_e_per_adu", 1.0),  # Hamamatsu
    "conversion factor offset": ("offset_adu", 1.0),
    "actualinterval-ms": ("interval_s", 1e-3),  # Andor
    "exposure time (secs)": ("exposure_ms", 1e3),
    "exposure time (s)": ("exposure_ms", 1e3),
    "kinetic cycle time (secs)": ("interval_s", 1.0),
    "cycle time (s)": ("interval_s", 1.0),
    "horizontal binning": ("binning", 1.0),
    "binninghorizontal": ("binning", 1.0),  # GenICam
    "binning": ("binning", 1.0),
    "resultingframerate": ("frame_rate_hz", 1.0),
    "resultingframerateabs": ("frame_rate_hz", 1.0),
    "sensorpixelwidth": ("sensor_pixel_um", 1.0),
    "numerical_aperture": ("na", 1.0),
    "exposure-ms": ("exposure_ms", 1.0),
    "interval_ms": ("interval_s", 1e-3),
    "pixelsizeum": ("pixel_size_nm", 1e3),
    **{
        name: (name, 1.0)
        for name in (
            "pixel_size_nm", "exposure_ms", "frame_rate_hz", "gain_e_per_adu", "offset_adu",
            "wavelength_nm", "na", "magnification", "sensor_pixel_um",
        )
    },
}  # fmt: skip
"""Lower-case names that mean the same wherever they stand: the quantity, and its unit in theirs."""

_SIF = {"exposuretime": ("exposure_ms", 1e3), "stackcycletime": ("interval_s", 1.0)}
_GENICAM = {
    "exposuretime": ("exposure_ms", 1e-3),
    "exposuretimeabs": ("exposure_ms", 1e-3),
    "acquisitionframerate": ("frame_rate_hz", 1.0),
}
_PYLABLIB = {"exposure": ("exposure_ms", 1e3), "frame_period": ("interval_s", 1.0)}
_OFF = {"0", "false", "off"}


def told_by(properties: Mapping[str, object]) -> StackMetadata:
    """Read the names that are known.

    A name that two devices have tells nothing: it is not known which of them recorded.
    """
    values = {str(key).strip(" :\t").lower(): value for key, value in properties.items()}
    values |= _timings(values)
    found: dict[str, float] = {}
    for name, (quantity, factor) in _names(values).items():
        number = _only({k: v for k, v in values.items() if _is_called(k, name)}, name)
        if number is not None:
            found.setdefault(quantity, number * factor)
    interval, sensor_um = found.pop("interval_s", None), found.pop("sensor_pixel_um", None)
    if interval is not None:
        found.setdefault("frame_rate_hz", 1 / interval)
    if sensor_um is not None and "magnification" in found:
        pixel_nm = 1e3 * sensor_um * found.get("binning", 1.0) / found["magnification"]
        found.setdefault("pixel_size_nm", pixel_nm)
    if "gain_e_per_adu" not in found:  # half of a conversion is none
        found.pop("offset_adu", None)
    if not WAVELENGTH_NM[0] <= found.get("wavelength_nm", WAVELENGTH_NM[0]) <= WAVELENGTH_NM[1]:
        del found["wavelength_nm"]
    if found.get("na", 0.0) >= LARGEST_NA:
        del found["na"]
    return replace(StackMetadata(), **found)  # type: ignore[arg-type]


def _timings(values: Mapping[str, object]) -> dict[str, object]:
    """Take PyLabLib's pair of exposure and period apart."""
    pair = re.fullmatch(r"\(([^,]+),([^,]+)\)", str(values.get("cam/frame_timings", "")))
    return {} if pair is None else {"cam/exposure": pair[1], "cam/frame_period": pair[2]}


def _names(values: Mapping[str, object]) -> dict[str, tuple[str, float]]:
    """Add what means something else in each dialect."""
    if any(_is_called(key, "stackcycletime") for key in values):
        return _EVERYWHERE | _SIF
    if any(key.startswith("cam/") for key in values):
        return _EVERYWHERE | _PYLABLIB
    names = _EVERYWHERE | _GENICAM
    enabled = (v for k, v in values.items() if _is_called(k, "acquisitionframerateenable"))
    if any(str(value).strip().lower() in _OFF for value in enabled):
        del names["acquisitionframerate"]
    return names


def _is_called(key: str, name: str) -> bool:
    """Tell whether a key is a name, or one behind a device (``Cam-``) or a section (``cam/``)."""
    return key == name or key.endswith((f"-{name}", f"/{name}"))


def _only(values: Mapping[str, object], name: str) -> float | None:
    """Give the number of the one device that has a name, in all frames alike."""
    devices = {key.removesuffix(name).rpartition("/")[2] for key in values}
    numbers = {number for value in values.values() if (number := number_in(value)) is not None}
    return numbers.pop() if len(devices) == len(numbers) == 1 else None


def number_in(value: object) -> float | None:
    """Read a number above zero, as of ``2``, ``"2x2"`` or ``{"PropVal": "2"}``."""
    if isinstance(value, dict):
        value = value.get("PropVal")
    return positive(value.lower().partition("x")[0] if isinstance(value, str) else value)


def positive(value: object, factor: float = 1.0) -> float | None:
    """Read a number; None unless it is finite and positive."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        return None
    try:
        number = float(value) * factor
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def inverse(value: float | None) -> float | None:
    """Convert an interval to a rate, or back."""
    return None if value is None else positive(1 / value)


_ENDS = (".json", ".txt", ".dat", ".pfs", "_settings.dat", "_metadata.txt")
_LINE = re.compile(r"\s*([^\t:=#]+?|cam/[^\t]+?)\s*[\t:=]\s*(\S.*?)\s*")
_MOST_NAMES = 20_000  # of all frames of a long movie


def with_side_files(metadata: StackMetadata, movie: Path) -> StackMetadata:
    """Fill what a movie does not say of itself from the texts beside it."""
    for path in _beside(movie):
        told = _read(path)
        fresh = {
            name: value for name, value in told.values.items() if getattr(metadata, name) is None
        }
        if fresh:
            sources = [metadata.source] if metadata.source != "none" else []
            metadata = replace(metadata, **fresh, source="+".join([*sources, path.name]))
    return metadata


def _beside(movie: Path) -> Iterator[Path]:
    """Name the texts that belong to a movie, as far as they are there."""
    stems = dict.fromkeys((movie.stem, movie.name.partition(".ome.")[0], movie.name))
    names = [f"{stem}{end}" for stem in stems for end in _ENDS]
    if movie.stem == "frames":  # as PyLabLib calls a movie that has a folder of its own
        names.append("settings.dat")
    if is_file(movie / "metadata.txt"):  # of a folder of frames, as Micro-Manager writes it
        yield movie / "metadata.txt"
    for name in dict.fromkeys(names):
        path = movie.with_name(name)
        if name != movie.name and is_file(path):
            yield path


def _read(path: Path) -> StackMetadata:
    """Read what one text tells; nothing of one that cannot be read."""
    try:
        text = read_text(path, errors="replace")
        if text.lstrip()[:1] in ("{", "["):
            return told_by(dict(_flat(json_of(text))))
    except (OSError, ValueError):
        return StackMetadata()
    lines = (line for line in text.splitlines() if len(line) <= 400)
    pairs = (match.groups() for line in lines if (match := _LINE.fullmatch(line)))
    return told_by({key: value for (key, value), _ in zip(pairs, range(_MOST_NAMES), strict=False)})


def _flat(value: object) -> Iterator[tuple[str, object]]:
    """Name the values of a nest of brackets, as ``camera/ExposureTime``."""
    pending: list[tuple[str, object]] = [("", value)]
    for _ in range(_MOST_NAMES):
        if not pending:
            return
        key, part = pending.pop()
        if isinstance(part, dict) and "PropVal" not in part:
            pending += [(f"{key}/{name}" if key else str(name), one) for name, one in part.items()]
        elif not isinstance(part, list):
            yield key, part
