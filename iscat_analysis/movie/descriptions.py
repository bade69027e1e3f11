"""What movies say of themselves: which axis is time, the pixel size, and the timing.

The clock of the camera: its rate and dropped frames, from the times of all frames.

TIFF has descriptions of ImageJ, tifffile ('shaped'), Micro-Manager and MetaMorph; and OME-XML,
which says which image of a file is which frame, and names the objective.

Gain and Offset of a Detector are not read: the schema gives them no unit, and programs write there
what their slider shows. Schema: https://www.openmicroscopy.org/Schemas/OME/2016-06

Drivers of cameras, and programs that record with them, have names of their own: Andor Solis writes
a text of names and values, and so do readers of its SIF files; Basler and other cameras of the
GenICam standard have its names and microseconds; PyLabLib has seconds below ``cam/``; Hamamatsu's
and Photometrics' drivers are seen through Micro-Manager and Bio-Formats, behind the name that
somebody gave the camera. A gain in decibels, or as a factor of an amplifier, is not among them: it
is not known how many photoelectrons a count then is.

Programs that cannot write into the movie's file leave their settings beside it, under its name, as
names and values or as JSON: Andor Solis ``movie.txt``, PyLabLib ``movie_settings.dat``, Basler's
viewer ``movie.pfs``, Micro-Manager ``movie_metadata.txt``, and laboratories ``movie.json`` of
their own. Only known names are read.
"""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import WAVELENGTH_NM
from iscat_analysis.errors import DataError
from iscat_analysis.reading import is_file, json_of, read_text
from iscat_analysis.records import FloatArray, StackMetadata


def measure_clock(times_s: Mapping[int, float]) -> tuple[float | None, tuple[int, ...] | None]:
    """Tell the rate [Hz], and the intervals from the first frame to each where some are missing.

    Times t of a camera of rate f lie on a grid: |Σ exp(2πi f t)| is largest at its rate, whether
    frames are missing or not, and the phase there says where the grid lies.  A computer may
    receive a frame late, but that does not delay those that follow; a missing frame does.  So as
    many are missing before frame i as the least number by which frames from i on are behind.  Where
    the times are not on a grid, or not all known, the rate is the mean, and nothing is missing.
    """
    if len(times_s) < 2:
        return None, None
    number, times = (np.array(values) for values in zip(*sorted(times_s.items()), strict=True))
    times = times - times[0]
    if not (math.isfinite(times[-1]) and times[-1] > 0):
        return None, None
    mean = float((number[-1] - number[0]) / times[-1])
    if not np.array_equal(number, np.arange(times.size)) or np.diff(times).min() < 0:
        return mean, None
    middle = float(np.median(np.diff(times)))
    rate = _rate(times, 1 / middle) if middle > 0 else mean
    grid = np.mean(np.exp(2j * np.pi * rate * times))
    if abs(grid) < 0.5:  # 1 where all are on it, 0.5 at a jitter of 0.19 intervals
        return mean, None
    behind = np.rint(rate * times - np.angle(grid) / (2 * np.pi)).astype(np.int64) - number
    ticks = number + np.minimum.accumulate(behind[::-1])[::-1]
    ticks -= ticks[0]
    missing = bool(np.diff(ticks).min() > 0 and ticks[-1] > number[-1])
    return rate, tuple(ticks.tolist()) if missing else None


def _rate(times: FloatArray, rate: float) -> float:
    """Find the rate whose grid the times lie on, from a few of them to all.

    It is looked for near the one of the median interval, in steps of a tenth of the width of the
    maximum, 1/(time that passed).
    """
    size, reach = min(64, times.size), 0.2 * rate
    while True:
        block = times[:size]
        step = 0.1 / block[-1] if block[-1] > 0 else reach
        rates = rate + np.arange(-reach, reach + step / 2, step)
        on_grid = [abs(np.exp(2j * np.pi * each * block).mean()) for each in rates]
        rate, reach = float(rates[int(np.argmax(on_grid))]), 2 * step
        if size == times.size:
            return rate
        size = min(4 * size, times.size)


TIME_FROM_HEIGHTS = (
    "the images lie along Z (height) in the file, which names no axis of time; "
    "they are taken as frames, one after the other in time"
)
"""What a user should know of a movie whose file calls its frames heights."""


def _units(*sizes: tuple[str, float]) -> dict[str, float]:
    return {name: size for names, size in sizes for name in names.split()}


LENGTH_NM = _units(
    ("pm", 1e-3),
    ("å angstrom", 0.1),
    ("nm nanometer nanometers", 1.0),
    ("µm μm um micron microns micrometer micrometers", 1e3),
    ("mm", 1e6),
    ("cm", 1e7),
    ("inch in", 2.54e7),
    ("m", 1e9),
)
"""Nanometres in one unit of length, by its lower-case name (both Unicode micro signs)."""

TIME_S = _units(
    ("ns nsec nanosecond nanoseconds", 1e-9),
    ("µs μs us µsec μsec usec microsecond microseconds", 1e-6),
    ("ms msec millisecond milliseconds", 1e-3),
    ("s sec second seconds", 1.0),
    ("min minute minutes", 60.0),
    ("h hour hours", 3600.0),
)
"""Seconds in one unit of time, by its lower-case name (both Unicode micro signs)."""

_AXES = {"T": "time", "Z": "height", "C": "channel", "S": "sample", "P": "position"}
_IMAGEJ_AXES = {"channels": "C", "slices": "Z", "frames": "T"}
_MICRO_MANAGER_AXES = {"Frames": "T", "Slices": "Z", "Channels": "C", "Positions": "P"}
_SHAPED = re.compile(r'^\{\s*"shape"\s*:')
_ELECTRONS = {"e", "e-", "electron", "electrons", "photoelectron", "photoelectrons"}
_ESCAPED = re.compile(r"\\u([0-9a-fA-F]{4})")
_COUNTS = {"", "gray value", "gray values", "count", "counts", "adu", "dn"}
MOST_DIGITS = 20
"""Any count of more digits is beyond every file, and stays so when it is cut."""

_RESOLUTION_UNIT_NM = {2: LENGTH_NM["inch"], 3: LENGTH_NM["cm"]}

Resolution = tuple[float, float, int]
"""Pixels per unit along x and y, and TIFF's number of the unit."""


@dataclass(frozen=True)
class Hints:
    """What one kind of metadata says, the side of pixels along y, and notes as in `Frames`."""

    known: StackMetadata
    pixel_y_nm: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Described:
    """What a description says about the frames.

    `frames` counts from the image that has the description; `axis` is their axis.  With `one_image`
    a single image may stand for all, the pixels of the other frames following its own.
    """

    frames: int
    axis: str | None
    one_image: bool


def time_axis(sizes: Mapping[str, int], path: Path) -> str | None:
    """Name the axis along which the frames lie: the one that is longer than 1 beside y and x.

    T, Q and I are time.  So is Z where T is not named, as many camera programs write, and C beyond
    the seven channels of an ImageJ composite: tifffile calls the frames of ImageJ and OME stacks
    channels when it is not told otherwise.
    """
    long = {axis: size for axis, size in sizes.items() if size > 1}

    def shown(axes: Mapping[str, int]) -> str:
        names = {axis: f"{axis} ({_AXES[axis]})" if axis in _AXES else axis for axis in axes}
        return " and ".join(f"{names[axis]} of length {size}" for axis, size in axes.items())

    if len(long) > 1:
        raise DataError(
            f"{path}: needs one axis besides y and x but has {shown(long)}; "
            "export one of them at a time, each to its own file"
        )
    if not long:
        return None
    (axis,) = long
    if axis == "Z" and "T" in sizes:
        raise DataError(
            f"{path}: has {shown(long)} and {shown({'T': sizes['T']})}: a stack of heights, not a "
            "movie; if its images are frames, name their axis T and export the file again "
            "(in Fiji: Image > Properties)"
        )
    if axis not in "TZQI" and not (axis == "C" and long[axis] > 7):
        raise DataError(
            f"{path}: its only axis besides y and x is {shown(long)}, which is not time; "
            "declare it as frames (in Fiji: Image > Properties), or export one channel or position"
        )
    return axis


def described_frames(text: str, shape: tuple[int, ...], path: Path) -> Described | None:
    """Read how many frames an ImageJ or tifffile description announces."""
    if text.startswith("ImageJ="):
        fields = _imagej_fields(text)
        sizes = {axis: _count(fields[key]) for key, axis in _IMAGEJ_AXES.items() if key in fields}
        return Described(_count(fields.get("images", "1")), time_axis(sizes, path), one_image=True)
    described = _json_object(text) if _SHAPED.match(text) else {}
    lengths, axes = described.get("shape"), described.get("axes")
    if not isinstance(lengths, list) or not all(type(n) is int and n > 0 for n in lengths):
        return None
    if isinstance(axes, str) and len(axes) == len(lengths):
        sizes = {axis: n for axis, n in zip(axes, lengths, strict=True) if axis not in "YX"}
    else:
        # Without names, the first axis is time; a second one is refused under its number.
        leading = lengths[:-2] if lengths[-2:] == [*shape] else lengths[:-3]
        long = [n for n in leading if n > 1]
        sizes = {"T" if k == 0 else f"number {k + 1}": n for k, n in enumerate(long)}
    axis = time_axis(sizes, path)
    return Described(sizes[axis] if axis else 1, axis, bool(described.get("truncated")))


def imagej_hints(text: str, resolution: Resolution | None) -> Hints:
    """Read ImageJ's pixel size, frame interval and what a stored count is worth."""
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
    gain, offset = _imagej_counts(fields)
    known = StackMetadata(
        x_nm, frame_rate_hz=inverse(interval), gain_e_per_adu=gain, offset_adu=offset,
        displayed_hz=positive(fields.get("fps")), source="imagej",
    )  # fmt: skip
    return Hints(known, y_nm)


def _imagej_counts(fields: Mapping[str, str]) -> tuple[float | None, float | None]:
    """Read gain and offset of ImageJ's straight line, value = c0 + c1·stored.

    Where the value is in electrons, c1 is the gain.  Where it is in counts, the line tells only
    which stored count stands for none: ImageJ keeps signed numbers as unsigned ones plus 32768.
    Lines to other quantities, such as optical densities, tell nothing of the camera.
    """
    unit, slope = fields.get("vunit", "").lower(), positive(fields.get("c1"))
    if fields.get("cf") != "0" or slope is None or unit not in _ELECTRONS | _COUNTS:
        return None, None
    try:
        zero = -float(fields.get("c0", "")) / slope + 0.0  # no -0
    except ValueError:
        return None, None
    if not math.isfinite(zero):
        return None, None
    return slope if unit in _ELECTRONS else None, zero


def micro_manager_axes(summary: Mapping[str, Any]) -> dict[str, int]:
    """Planned lengths of Micro-Manager's axes that the summary of an acquisition names."""
    lengths = {axis: number_in(summary.get(key)) for key, axis in _MICRO_MANAGER_AXES.items()}
    return {axis: int(length) for axis, length in lengths.items() if length is not None}


def elapsed_ms(frame: object) -> float | None:
    """Read when Micro-Manager received a frame [ms]; None where its metadata are silent."""
    value = _mm_value(frame.get("ElapsedTime-ms")) if isinstance(frame, dict) else None
    return 0.0 if value in (0, 0.0) else positive(value)


def frame_index(frame: object) -> int | None:
    """Read the number that Micro-Manager gave a frame; None where its metadata are silent."""
    value = _mm_value(frame.get("FrameIndex")) if isinstance(frame, dict) else None
    return value if type(value) is int and 0 <= value < 2**62 else None


def chosen_rate(
    clock: tuple[float | None, tuple[int, ...] | None],
    frames: int,
    nominal: float | None,
    names: tuple[str, str],
) -> tuple[float | None, tuple[str, ...]]:
    """Choose between the rate [Hz] by an interval that was set and that by the times of frames.

    Where they agree, the interval is more exact; where they do not, it is not that of the frames.

    Returns the rate, and what a user should know of a disagreement.
    """
    own, ticks = clock
    intervals = (ticks[-1] if ticks else frames - 1) or 1
    # the first or the last frame of a short movie may have come half an interval late
    tolerance = max(0.01, 0.5 / intervals)
    if own is None or nominal is None or abs(own / nominal - 1) <= tolerance:
        return nominal or own, ()
    return own, (
        f"the frame rate is {own:.4g} Hz, by the times of the frames ({names[1]}) in the file, and "
        f"not {nominal:.4g} Hz, by its {names[0]}; if that is wrong, set camera.frame_rate_hz",
    )


def micro_manager_hints(
    first: object, times_ms: Sequence[float | None], summary: Mapping[str, Any]
) -> Hints:
    """Read Micro-Manager's metadata: those of the first frame, the times of all, the summary."""
    begin = first if isinstance(first, dict) else {}

    def find(name: str) -> float | None:
        return number_in(begin.get(name)) or number_in(summary.get(name))

    pixel = positive(find("PixelSizeUm"), 1e3)
    exposure = find("Exposure-ms")
    clock = measure_clock({k: t / 1e3 for k, t in enumerate(times_ms) if t is not None})
    interval = find("Interval_ms")
    if interval is not None and exposure is not None and interval < exposure:  # as fast as can be
        interval = None
    nominal = None if interval is None else positive(1e3 / interval)
    rate, notes = chosen_rate(clock, len(times_ms), nominal, ("Interval_ms", "ElapsedTime-ms"))
    told = told_by(begin)
    known = StackMetadata(
        pixel, exposure, rate or told.frame_rate_hz, clock[1], told.gain_e_per_adu,
        told.offset_adu, binning=told.binning, source="micromanager",
    )  # fmt: skip
    return Hints(known, pixel, notes)


def metamorph_hints(settings: object, planes: object) -> Hints:
    """Read pixel size and times of a MetaMorph stack: its UIC1Tag and UIC2Tag."""
    said = settings if isinstance(settings, dict) else {}
    times = planes if isinstance(planes, dict) else {}
    unit = LENGTH_NM.get(str(said.get("CalibrationUnits", "")).lower())
    x_nm, y_nm = (positive(said.get(f"{axis}Calibration"), unit) if unit else None for axis in "XY")
    days, ms = (np.asarray(times.get(name, ()), float) for name in ("DateCreated", "TimeCreated"))
    rate, ticks = measure_clock(dict(enumerate((86_400 * (days - days[:1]) + ms / 1e3).tolist())))
    return Hints(StackMetadata(x_nm, frame_rate_hz=rate, ticks=ticks, source="metamorph"), y_nm)


def plain_hints(resolution: Resolution | None) -> Hints:
    """Read the TIFF resolution tags, where they could mean a microscope's pixels."""
    if resolution is None or resolution[2] not in _RESOLUTION_UNIT_NM:
        return Hints(StackMetadata())
    x_nm, y_nm = (_RESOLUTION_UNIT_NM[resolution[2]] / per for per in resolution[:2])
    known = StackMetadata(x_nm, source="tiff") if _plausible(x_nm, y_nm) else StackMetadata()
    return Hints(known, y_nm)


def merge(hints: Sequence[Hints], path: Path) -> StackMetadata:
    """Take each value from the first kind of metadata that has it."""
    found: dict[str, Any] = {}
    sources = []
    for hint in hints:
        fresh = {key: value for key, value in hint.known.values.items() if key not in found}
        x, y = hint.known.pixel_size_nm, hint.pixel_y_nm
        if "pixel_size_nm" in fresh and x and y and abs(y / x - 1) > 1e-3:  # some have six digits
            raise DataError(
                f"{path}: its pixels measure {x:g} nm in x and {y:g} nm in y, but they must be "
                "square; correct the metadata, or resample the movie"
            )
        found |= fresh
        sources += [hint.known.source] if fresh.keys() - {"ticks"} else []
    return StackMetadata(**found, source="+".join(sources) or "none")


def _plausible(*sizes_nm: float | None) -> bool:
    """Tell sizes of a microscope's pixels from a printer's 72 or 300 dpi."""
    return all(size is not None and 5.0 <= size <= 5000.0 for size in sizes_nm)


def _imagej_fields(text: str) -> dict[str, str]:
    plain = _ESCAPED.sub(lambda found: chr(int(found[1], 16)), text)  # as in \\u00B5m
    pairs = (line.partition("=") for line in plain.splitlines())
    return {key.strip(): value.strip() for key, equals, value in pairs if equals}


def _count(value: str) -> int:
    return max(1, int(value[:MOST_DIGITS])) if value.isascii() and value.isdigit() else 1


def _json_object(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _mm_value(value: object) -> object:
    """Unwrap a value that Micro-Manager 2 wraps as a property of a device."""
    return value.get("PropVal") if isinstance(value, dict) else value


_OME_ROOT = re.compile(r"<(?:\w+:)?OME[\s>]")


@dataclass(frozen=True)
class OmeMovie:
    """What OME-XML says of a movie.

    `files` are named where there are several, "" for the one that has the text; `where` has the
    file and the image of each frame, shape (t, 2).
    """

    files: tuple[str, ...]
    where: NDArray[np.int64]
    hints: Hints


def is_ome(text: str) -> bool:
    """Whether a description is OME-XML."""
    return text.startswith("<") and _OME_ROOT.search(text) is not None


def read_ome(text: str, n_images: int, path: Path) -> OmeMovie:
    """Read the OME-XML of a file, or of a movie that lies in several files."""
    root, images, files = _read(text, path)
    if len(files) > 1 and len(images) > 1:
        raise DataError(
            f"{path}: is one part of an OME set of {len(images)} image series; export the one to "
            "analyse to its own file"
        )
    if len(images) > 1:
        where, axis = _places_of_series(images, n_images, path), "I"
    else:
        axis = time_axis(_sizes(images[0], path), path) or "T"
        where = _places(images[0], files, axis, n_images, path)
    missing = int((where < 0).any(axis=1).sum())
    if missing:
        raise DataError(
            f"{path}: its OME-XML does not say where {missing} of {len(where)} frames lie; "
            "the recording or the copy was interrupted: export it again"
        )
    if len(files) < 2 and not np.array_equal(np.sort(where[:, 1]), np.arange(n_images)):
        raise DataError(
            f"{path}: its OME-XML assigns {len(np.unique(where[:, 1]))} of the file's {n_images} "
            f"images to {len(where)} frames; export it again so that both agree"
        )
    return OmeMovie(files, where, _hints(root, images[0], axis))


def files_of_set(text: str, path: Path) -> tuple[str, ...]:
    """Name the files that OME-XML describes; "" is the one that has the text."""
    return _read(text, path)[2]


def _read(
    text: str, path: Path
) -> tuple[ElementTree.Element, list[ElementTree.Element], tuple[str, ...]]:
    """Give the root, the pixels of every image that is described, and the names of their files."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DataError(
            f"{path}: its OME-XML declares a document type, which could expand without limit; "
            "export it again without one"
        )
    if len(text) > 64_000_000:  # some hundred for each frame
        raise _damaged(path, f"it has {len(text)} characters")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _damaged(path, str(error)) from None
    for elsewhere in _children(root, "BinaryOnly"):
        name = elsewhere.get("MetadataFile") or "the first file of the set"
        raise DataError(
            f"{path}: is one part of an OME set of several files; open {name}, which describes it"
        )
    images = _children(root, "Image", "Pixels")
    if not images:
        raise _damaged(path, "it describes no image")
    blocks = (block for pixels in images for block in _children(pixels, "TiffData"))
    files = tuple(dict.fromkeys(map(_file_of, blocks)))
    if len(files) > 1 and any(Path(name).name != name for name in files):
        raise _damaged(path, "it names files in other folders")
    return root, images, files


def _places(
    pixels: ElementTree.Element, files: tuple[str, ...], axis: str, n_images: int, path: Path
) -> NDArray[np.int64]:
    """Give the file and the image of each frame, shape (t, 2); −1 where it is not said."""
    n_frames, alone = _sizes(pixels, path)[axis], len(files) < 2
    if alone and n_frames != n_images:
        raise DataError(
            f"{path}: its OME-XML describes {n_frames} frames but the file holds {n_images} "
            "images; the recording or the copy was interrupted, or the description is out of date: "
            "export it again"
        )
    if not alone:
        _refuse_too_many(n_frames, files, path)
    where = np.full((n_frames, 2), -1, dtype=np.int64)
    if not files:
        where[:] = [(0, image) for image in range(n_images)]
    assigned = 0
    for block in _children(pixels, "TiffData"):
        image, planes = (_integer(block, name, path) for name in ("IFD", "PlaneCount"))
        if planes is None:
            planes = n_frames if alone and image is None else 1
        frame = _integer(block, f"First{axis}", path) or 0
        if frame + planes > n_frames:
            raise _damaged(path, f"a TiffData block reaches frame {frame + planes} of {n_frames}")
        assigned += planes
        if assigned > n_frames:
            raise _damaged(path, f"its TiffData blocks are of more than {n_frames} frames")
        where[frame : frame + planes, 0] = files.index(_file_of(block))
        where[frame : frame + planes, 1] = np.arange(planes) + min(image or 0, 2**62)
    return where


def _refuse_too_many(frames: int, files: tuple[str, ...], path: Path) -> None:
    """Refuse more frames than there is room for in the files, before anything is made for them."""
    paths = [path.with_name(name) if name else path for name in files]
    missing = [file.name for file in paths if not is_file(file)]
    if missing:
        raise DataError(
            f"{path}: is one of {len(files)} files of a movie, of which {missing[0]} is not beside "
            "it; keep the files of a set together, under their own names"
        )
    held = sum(file.stat().st_size for file in paths)
    if (
        50 * frames > held
    ):  # bytes of the list of tags of an image: four of twelve, and what ends it
        raise DataError(
            f"{path}: its OME-XML describes {frames} frames, but its files beside it have {held} "
            "bytes in all, which cannot hold them; copy all files of the set again"
        )


def _places_of_series(
    series: list[ElementTree.Element], n_images: int, path: Path
) -> NDArray[np.int64]:
    """Take many series of one plane each as a movie: what writing frame by frame leaves behind."""
    single = all(set(_sizes(pixels, path).values()) == {1} for pixels in series)
    if not single or len(series) != n_images:
        raise DataError(
            f"{path}: holds {len(series)} image series; export the one to analyse to its own file"
        )
    where = np.array([(0, image) for image in range(n_images)])
    for frame, pixels in enumerate(series):
        for block in _children(pixels, "TiffData"):
            where[frame, 1] = min(_integer(block, "IFD", path) or 0, n_images)
    return where


def _file_of(block: ElementTree.Element) -> str:
    names = [u.get("FileName") or (u.text or "").strip() for u in _children(block, "UUID")]
    return names[0] if names else ""


def _children(parent: ElementTree.Element, *names: str) -> list[ElementTree.Element]:
    """Give the elements at the end of a path of names."""
    found = [parent]
    for name in names:
        found = [child for one in found for child in one if child.tag.rpartition("}")[2] == name]
    return found


def _integer(element: ElementTree.Element, name: str, path: Path) -> int | None:
    text = element.get(name)
    if text is None:
        return None
    try:
        value = int(text[:MOST_DIGITS])
    except ValueError:
        raise _damaged(path, f"{name} is {text[:20]!r}") from None
    if value < 0:
        raise _damaged(path, f"{name} is {value}")
    return value


def _sizes(pixels: ElementTree.Element, path: Path) -> dict[str, int]:
    sizes = {axis: _integer(pixels, f"Size{axis}", path) or 0 for axis in "TZC"}
    if 0 in sizes.values():
        raise _damaged(path, "SizeT, SizeZ or SizeC is missing or 0")
    return sizes


def _hints(root: ElementTree.Element, pixels: ElementTree.Element, axis: str) -> Hints:
    planes = _children(pixels, "Plane")
    exposures = (_quantity(plane, "ExposureTime", "s", TIME_S, 1e3) for plane in planes)
    increment = _quantity(pixels, "TimeIncrement", "s", TIME_S)
    times = _times_s(planes, f"The{axis}")
    clock = measure_clock(times)
    names = "TimeIncrement", "DeltaT"
    rate, notes = chosen_rate(clock, max(times, default=0) + 1, inverse(increment), names)
    told = told_by(_annotations(root))  # what other programs knew, and the schema has no place for
    exposure = next((value for value in exposures if value is not None), None)
    objective = _objective(root, pixels)
    na, magnification = (positive(objective.get(key)) for key in ("LensNA", "NominalMagnification"))
    known = StackMetadata(
        pixel_size_nm=_quantity(pixels, "PhysicalSizeX", "µm", LENGTH_NM),
        exposure_ms=exposure or told.exposure_ms,
        frame_rate_hz=rate or told.frame_rate_hz,
        ticks=clock[1],
        gain_e_per_adu=told.gain_e_per_adu,
        offset_adu=told.offset_adu,
        wavelength_nm=_wavelength_nm(pixels),
        na=na if na is not None and na < LARGEST_NA else None,
        magnification=magnification,
        binning=_binning(pixels) or told.binning,
        source="ome",
    )
    return Hints(known, _quantity(pixels, "PhysicalSizeY", "µm", LENGTH_NM), notes)


def _objective(root: ElementTree.Element, pixels: ElementTree.Element) -> Mapping[str, str]:
    """Describe the objective that the settings of an image name, or the only one there is."""
    found = [one.attrib for one in _children(root, "Instrument", "Objective")]
    image = next(image for image in _children(root, "Image") if pixels in list(image))
    for settings in _children(image, "ObjectiveSettings"):
        found = [one for one in found if one.get("ID") == settings.get("ID")]
    return found[0] if len(found) == 1 else {}


def _binning(pixels: ElementTree.Element) -> float | None:
    """Give how many pixels along a side the camera joined, as in ``Binning="2x2"``."""
    settings = _children(pixels, "Channel", "DetectorSettings")
    found = {(one.get("Binning") or "").partition("x")[0] for one in settings}
    return positive(found.pop()) if len(found) == 1 else None


def _wavelength_nm(pixels: ElementTree.Element) -> float | None:
    """Give the wavelength of the illumination, where all channels have the same."""
    channels = _children(pixels, "Channel")
    found = {_quantity(one, "ExcitationWavelength", "nm", LENGTH_NM) for one in channels}
    wavelength = found.pop() if len(found) == 1 else None
    low, high = WAVELENGTH_NM
    return wavelength if wavelength is not None and low <= wavelength <= high else None


def _annotations(root: ElementTree.Element) -> dict[str, str]:
    """Collect the pairs that programs add: of maps, and what Bio-Formats keeps of other files."""
    found: dict[str, str] = {}
    for notes in _children(root, "StructuredAnnotations"):
        for element in notes.iter():
            kind = element.tag.rpartition("}")[2]
            if kind == "M":
                found[element.get("K", "")] = (element.text or "").strip()
            elif kind == "OriginalMetadata":
                key, value = (
                    "".join(child.text or "" for child in _children(element, name)[:1]).strip()
                    for name in ("Key", "Value")
                )
                found[key] = value
    return found


def _times_s(planes: list[ElementTree.Element], name: str) -> dict[int, float]:
    """Give the times of the frames that carry one."""
    times = {}
    for plane in planes:
        try:
            frame, time = int(plane.get(name, "")), float(plane.get("DeltaT", ""))
        except ValueError:
            continue
        factor = _factor(plane, "DeltaT", "s", TIME_S)
        if factor is not None and math.isfinite(time):
            times[frame] = time * factor
    return times


def _quantity(
    element: ElementTree.Element, name: str, unit: str, units: dict[str, float], times: float = 1.0
) -> float | None:
    factor = _factor(element, name, unit, units)
    return None if factor is None else positive(element.get(name), times * factor)


def _factor(
    element: ElementTree.Element, name: str, unit: str, units: dict[str, float]
) -> float | None:
    """Read the unit of a quantity; `unit` where none is named."""
    return units.get(element.get(f"{name}Unit", unit).strip().lower())


def _damaged(path: Path, how: str) -> DataError:
    return DataError(f"{path}: its OME-XML is damaged ({how}); export it again")


LARGEST_NA = 2.0
"""Of any objective, solid immersion aside."""

_OWN = (
    "pixel_size_nm exposure_ms frame_rate_hz gain_e_per_adu offset_adu wavelength_nm na "
    "magnification sensor_pixel_um"
)
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
    **{name: (name, 1.0) for name in _OWN.split()},
}
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
    texts = (replace(_told_in(path), source=path.name) for path in _beside(movie))
    return merge([Hints(metadata), *map(Hints, texts)], movie)


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


def _told_in(path: Path) -> StackMetadata:
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
