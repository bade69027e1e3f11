"""OME-XML: which image of the file is which frame, the pixel size, the timing and the objective.

Gain and Offset of a Detector are not read: the schema gives them no unit, and programs write there
what their slider shows.  Schema: https://www.openmicroscopy.org/Schemas/OME/2016-06
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import WAVELENGTH_NM
from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import (
    LENGTH_NM,
    MOST_DIGITS,
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
    sizes = {axis: _integer(pixels, f"Size{axis}", path) or 0 for axis in _AXES}
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
