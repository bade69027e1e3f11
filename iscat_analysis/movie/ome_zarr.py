"""Movies in Zarr folders: OME-Zarr, and single arrays of frames.

Format: OME-NGFF 0.4 and 0.5 (doi:10.1038/s41592-021-01326-w); zarr reads the arrays.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.descriptions import LENGTH_NM, TIME_S, Hints, inverse, merge, positive
from iscat_analysis.movie.mapped import WHAT_LIBRARIES_RAISE
from iscat_analysis.movie.microscopes import needed_package
from iscat_analysis.movie.stack import ArrayFrames
from iscat_analysis.reading import first_line, is_file
from iscat_analysis.records import StackMetadata

_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_zarr(folder: Path) -> bool:
    """Tell whether a folder is one of Zarr's."""
    return any(is_file(folder / mark) for mark in _MARKS)


def open_zarr(folder: Path, part: str) -> ArrayFrames:
    """Open a movie in a Zarr folder."""
    zarr = needed_package("zarr", "zarr", "Zarr", folder)
    from iscat_analysis.movie.zarr_folder import CheckedArray, CheckedStore

    name = f"{folder}{MARK}{part}" if part else str(folder)
    store = CheckedStore(folder)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files that are none of Zarr's
            node = zarr.open(store, mode="r", path=part.strip("/") or None)
            if hasattr(node, "dtype"):
                array, metadata = node, StackMetadata()
            else:
                array, metadata = _of_group(node, name)
        checked = CheckedArray(array, store, name)
    except DataError:
        raise
    except WHAT_LIBRARIES_RAISE as error:
        raise DataError(
            f"{name}: cannot be read as Zarr ({first_line(error)}); export it again"
        ) from None
    return ArrayFrames(checked, name, metadata)


def _of_group(group: Any, name: str) -> tuple[Any, StackMetadata]:
    """Choose the array of a group, and say what it tells of its scale."""
    attributes = dict(group.attrs)
    attributes = attributes.get("ome", attributes)
    if attributes.get("multiscales"):
        image = attributes["multiscales"][0]
        finest = image["datasets"][0]
        array = group[finest["path"]]
        axes = [axis if isinstance(axis, Mapping) else {"name": axis} for axis in image["axes"]]
        return array, _scale(axes, finest, array.shape, name)
    found = dict(_arrays(group))
    if len(found) != 1:
        held = ", ".join(f"/{path}" for path in list(found)[:5]) or "none"
        raise DataError(
            f"{name}: name the array of frames (t, y, x) behind {MARK}, as in "
            f'"{name}{MARK}/movie"; it holds: {held}'
        )
    return next(iter(found.values())), StackMetadata()


def _arrays(group: Any) -> Iterator[tuple[str, Any]]:
    for path, array in group.arrays():
        if len(array.shape) >= 3:
            yield path, array


def _scale(
    axes: list[Any], level: Mapping[str, Any], shape: tuple[int, ...], name: str
) -> StackMetadata:
    """Read pixel size and frame rate; refuse what is no movie."""
    names = [str(axis["name"]) for axis in axes]
    long = [axis for axis, size in zip(names, shape, strict=True) if size > 1]
    if names[-2:] != ["y", "x"] or names[0] != "t" or not set(long) <= {"t", "y", "x"}:
        sizes = ", ".join(f"{axis} {size}" for axis, size in zip(names, shape, strict=True))
        raise DataError(
            f"{name}: has the axes {sizes}; a movie has frames t, rows y and columns x, and "
            "whatever else once: export one channel and height"
        )
    changes = level.get("coordinateTransformations", ())
    scales = [change["scale"] for change in changes if change.get("type") == "scale"]
    scale = dict(zip(names, scales[0], strict=True)) if scales else {}
    units = {str(axis["name"]): str(axis.get("unit", "")).lower() for axis in axes}
    known = {
        axis: positive(scale.get(axis), unit)
        for axis, table in (("x", LENGTH_NM), ("y", LENGTH_NM), ("t", TIME_S))
        if (unit := table.get(units[axis])) is not None
    }
    rate = inverse(known.get("t"))
    return merge([Hints("ome-zarr", known.get("x"), known.get("y"), None, rate)], Path(name))
