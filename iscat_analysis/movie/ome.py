"""OME-XML: which image of the file is which frame, the pixel size, the timing and the objective.

Gain and Offset of a Detector are not read: the schema gives them no unit, and programs write there
what their slider shows.  Schema: https://www.openmicroscopy.org/Schemas/OME/2016-06
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import WAVELENGTH_NM
from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import (
    LENGTH_NM,
    TIME_S,
    Hints,
    chosen_rate,
    measure_clock,
    time_axis,
)
from iscat_analysis.movie.side_files import LARGEST_NA, inverse, positive, told_by
from iscat_analysis.reading import is_file
from iscat_analysis.records import StackMetadata

_OME_ROOT = re.compile(r"<(?:\w+:)?OME[\s>]")
_AXES = ("T", "Z", "C")
_LEAST_IMAGE_BYTES = 50  # of the list of tags of an image: four of twelve bytes, and what ends it
_MOST_DIGITS = 20  # a number of more is beyond every file, and stays so when cut
_LONGEST = 64_000_000  # characters, some hundred for each frame


@dataclass(frozen=True)
class OmeMovie:
    """What OME-XML says of a movie."""

    order: NDArray[np.int64]
    hints: Hints


@dataclass(frozen=True)
class OmeSet:
    """What OME-XML says of a movie in several files."""

    files: tuple[str, ...]
    where: NDArray[np.int64]
    hints: Hints


def is_ome(text: str) -> bool:
    """Whether a description is OME-XML."""
    return text.startswith("<") and _OME_ROOT.search(text) is not None


def read_ome(text: str, n_images: int, path: Path) -> OmeMovie:
    """Read the OME-XML of a file."""
    root = _parse(text, path)
    images = _images(root, path)
    first = images[0]
    if len(images) == 1:
        order, axis = _order(first, n_images, path)
    else:
        order, axis = _order_of_series(images, n_images, path)
    if not np.array_equal(np.sort(order), np.arange(n_images)):
        raise DataError(
            f"{path}: its OME-XML assigns {len(np.unique(order))} of the file's {n_images} images "
            f"to {len(order)} frames; export it again so that both agree"
        )
    return OmeMovie(order, _hints(root, first, axis))


def read_ome_set(text: str, path: Path) -> OmeSet | None:
    """Read the OME-XML of a movie that lies in several files."""
    root = _parse(text, path)
    images = _images(root, path)
    files = _files(images)
    if len(files) < 2:
        return None
    if len(images) > 1:
        raise DataError(
            f"{path}: is one part of an OME set of {len(images)} image series; export the one to "
            "analyse to its own file"
        )
    if any(not name or Path(name).name != name for name in files):
        raise _damaged(path, "it names files in other folders")
    pixels = images[0]
    sizes = _sizes(pixels, path)
    axis = time_axis(sizes, path) or "T"
    _refuse_too_many(sizes[axis], files, path)
    number = {name: k for k, name in enumerate(files)}
    where = np.full((sizes[axis], 2), -1, dtype=np.int64)
    assigned = 0
    for block in _children(pixels, "TiffData"):
        frame = _integer(block, f"First{axis}", path) or 0
        image = _integer(block, "IFD", path) or 0
        planes = _integer(block, "PlaneCount", path)
        planes = 1 if planes is None else planes
        if frame + planes > len(where):
            raise _damaged(path, f"a TiffData block reaches frame {frame + planes} of {len(where)}")
        assigned += planes
        if assigned > len(where):
            raise _damaged(path, f"its TiffData blocks are of more than {len(where)} frames")
        where[frame : frame + planes, 0] = number[_file_of(block)]
        where[frame : frame + planes, 1] = np.arange(image, image + planes)
    missing = int((where < 0).any(axis=1).sum())
    if missing:
        raise DataError(
            f"{path}: its OME-XML does not say where {missing} of {len(where)} frames lie; "
            "the recording or the copy was interrupted: export it again"
        )
    return OmeSet(tuple(files), where, _hints(root, pixels, axis))


def _refuse_too_many(frames: int, files: list[str], path: Path) -> None:
    """Refuse more frames than there is room for in the files, before anything is made for them."""
    paths = [path.with_name(name) if name else path for name in files]
    missing = [file.name for file in paths if not is_file(file)]
    if missing:
        raise DataError(
            f"{path}: is one of {len(files)} files of a movie, of which {missing[0]} is not beside "
            "it; keep the files of a set together, under their own names"
        )
    held = sum(file.stat().st_size for file in paths)
    if frames * _LEAST_IMAGE_BYTES > held:
        raise DataError(
            f"{path}: its OME-XML describes {frames} frames, but its files beside it have {held} "
            "bytes in all, which cannot hold them; copy all files of the set again"
        )


def files_of_set(text: str, path: Path) -> tuple[str, ...]:
    """Name the files that OME-XML describes."""
    files = _files(_images(_parse(text, path), path))
    if any(Path(name).name != name for name in files):
        raise _damaged(path, "it names files in other folders")
    return tuple(files)


def _images(root: ElementTree.Element, path: Path) -> list[ElementTree.Element]:
    """Give the pixels of every image that is described."""
    elsewhere = next(_children(root, "BinaryOnly"), None)
    if elsewhere is not None:
        name = elsewhere.get("MetadataFile") or "the first file of the set"
        raise DataError(
            f"{path}: is one part of an OME set of several files; open {name}, which describes it"
        )
    images = [pixels for image in _children(root, "Image") for pixels in _children(image, "Pixels")]
    if not images:
        raise _damaged(path, "it describes no image")
    return images


def _files(images: list[ElementTree.Element]) -> list[str]:
    """Name the files that hold the planes of images; one without a name is the file itself."""
    found = {_file_of(block): None for pixels in images for block in _children(pixels, "TiffData")}
    return list(found)


def _file_of(block: ElementTree.Element) -> str:
    uuid = next(_children(block, "UUID"), None)
    return "" if uuid is None else uuid.get("FileName") or (uuid.text or "").strip()


def _parse(text: str, path: Path) -> ElementTree.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DataError(
            f"{path}: its OME-XML declares a document type, which could expand without limit; "
            "export it again without one"
        )
    if len(text) > _LONGEST:
        raise _damaged(path, f"it has {len(text)} characters")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _damaged(path, str(error)) from None


def _children(parent: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    return (child for child in parent if child.tag.rpartition("}")[2] == name)


def _integer(element: ElementTree.Element, name: str, path: Path) -> int | None:
    text = element.get(name)
    if text is None:
        return None
    try:
        value = int(text[:_MOST_DIGITS])
    except ValueError:
        raise _damaged(path, f"{name} is {text[:20]!r}") from None
    if value < 0:
        raise _damaged(path, f"{name} is {value}")
    return value


def _sizes(pixels: ElementTree.Element, path: Path) -> dict[str, int]:
    sizes = {axis: _integer(pixels, f"Size{axis}", path) or 0 for axis in _AXES}
    if 0 in sizes.values():
        raise _damaged(path, "SizeT, SizeZ or SizeC is missing or 0")
    return sizes


def _order(pixels: ElementTree.Element, n_images: int, path: Path) -> tuple[NDArray[np.int64], str]:
    """Assign the images of a file to the frames of its only series."""
    sizes = _sizes(pixels, path)
    axis = time_axis(sizes, path) or "T"
    n_frames = sizes[axis]
    if n_frames != n_images:
        raise DataError(
            f"{path}: its OME-XML describes {n_frames} frames but the file holds {n_images} "
            "images; the recording or the copy was interrupted, or the description is out of date: "
            "export it again"
        )
    blocks = list(_children(pixels, "TiffData"))
    if not blocks:
        return np.arange(n_frames, dtype=np.int64), axis
    order = np.full(n_frames, -1, dtype=np.int64)
    assigned = 0
    for block in blocks:
        image = _integer(block, "IFD", path)
        planes = _integer(block, "PlaneCount", path)
        if planes is None:
            planes = n_frames if image is None else 1
        frame = _integer(block, f"First{axis}", path) or 0
        image = image or 0
        if frame + planes > n_frames or image + planes > n_images:
            raise _damaged(path, f"a TiffData block reaches frame {frame + planes} of {n_frames}")
        assigned += planes
        if assigned > n_frames:
            raise _damaged(path, f"its TiffData blocks are of more than {n_frames} frames")
        order[frame : frame + planes] = np.arange(image, image + planes)
    return order, axis


def _order_of_series(
    series: list[ElementTree.Element], n_images: int, path: Path
) -> tuple[NDArray[np.int64], str]:
    """Take many series of one plane each as a movie: what writing frame by frame leaves behind."""
    single = all(set(_sizes(pixels, path).values()) == {1} for pixels in series)
    if not single or len(series) != n_images:
        raise DataError(
            f"{path}: holds {len(series)} image series; export the one to analyse to its own file"
        )
    order = np.arange(n_images, dtype=np.int64)
    for frame, pixels in enumerate(series):
        for block in _children(pixels, "TiffData"):
            order[frame] = min(_integer(block, "IFD", path) or 0, n_images)
    return order, "I"


def _hints(root: ElementTree.Element, pixels: ElementTree.Element, axis: str) -> Hints:
    planes = list(_children(pixels, "Plane"))
    exposures = (
        positive(plane.get("ExposureTime"), 1e3 * factor)
        for plane in planes
        if (factor := _factor(plane, "ExposureTimeUnit", "s", TIME_S)) is not None
    )
    increment_unit = _factor(pixels, "TimeIncrementUnit", "s", TIME_S)
    increment = positive(pixels.get("TimeIncrement"), increment_unit) if increment_unit else None
    times = _times_s(planes, f"The{axis}")
    clock = measure_clock(times)
    names = "TimeIncrement", "DeltaT"
    rate, notes = chosen_rate(clock, max(times, default=0) + 1, inverse(increment), names)
    told = told_by(_annotations(root))  # what other programs knew, and the schema has no place for
    exposure = next((value for value in exposures if value is not None), None)
    objective = _objective(root, pixels)
    na = None if objective is None else positive(objective.get("LensNA"))
    magnification = None if objective is None else positive(objective.get("NominalMagnification"))
    known = StackMetadata(
        pixel_size_nm=_length(pixels, "PhysicalSizeX"),
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
    return Hints(known, _length(pixels, "PhysicalSizeY"), notes)


def _objective(
    root: ElementTree.Element, pixels: ElementTree.Element
) -> ElementTree.Element | None:
    """Give the objective of an image: the one that its settings name, or the only one there is."""
    found = [
        objective
        for instrument in _children(root, "Instrument")
        for objective in _children(instrument, "Objective")
    ]
    image = next(image for image in _children(root, "Image") if pixels in list(image))
    settings = next(_children(image, "ObjectiveSettings"), None)
    if settings is not None:
        found = [objective for objective in found if objective.get("ID") == settings.get("ID")]
    return found[0] if len(found) == 1 else None


def _binning(pixels: ElementTree.Element) -> float | None:
    """Give how many pixels along a side the camera joined, as in ``Binning="2x2"``."""
    found = {
        (settings.get("Binning") or "").partition("x")[0]
        for channel in _children(pixels, "Channel")
        for settings in _children(channel, "DetectorSettings")
    }
    return positive(found.pop()) if len(found) == 1 else None


def _wavelength_nm(pixels: ElementTree.Element) -> float | None:
    """Give the wavelength of the illumination, where all channels have the same."""
    channels = _children(pixels, "Channel")
    found = {_length(channel, "ExcitationWavelength", "nm") for channel in channels}
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
                    next((child.text or "" for child in _children(element, name)), "").strip()
                    for name in ("Key", "Value")
                )
                found[key] = value
    return found


def _times_s(planes: list[ElementTree.Element], name: str) -> dict[int, float]:
    """Give the times of the frames that carry one."""
    times = {}
    for plane in planes:
        factor = _factor(plane, "DeltaTUnit", "s", TIME_S)
        try:
            frame, time = int(plane.get(name, "")), float(plane.get("DeltaT", ""))
        except ValueError:
            continue
        if factor is not None and math.isfinite(time):
            times[frame] = time * factor
    return times


def _length(element: ElementTree.Element, name: str, unit: str = "µm") -> float | None:
    factor = _factor(element, f"{name}Unit", unit, LENGTH_NM)
    return None if factor is None else positive(element.get(name), factor)


def _factor(
    element: ElementTree.Element, name: str, default: str, units: dict[str, float]
) -> float | None:
    return units.get(element.get(name, default).strip().lower())


def _damaged(path: Path, how: str) -> DataError:
    return DataError(f"{path}: its OME-XML is damaged ({how}); export it again")
