"""TIFF files put together byte by byte, for what tifffile does not write."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

SHORT, LONG, ASCII, RATIONAL, LONG8 = 3, 4, 2, 5, 16
_CODES = {SHORT: "H", LONG: "I", LONG8: "Q"}

Tags = Mapping[int, tuple[int, Sequence[int] | str]]


def movie(frames: int = 6, rows: int = 10, columns: int = 14, dtype: str = "u2") -> NDArray:
    """Make a movie in which every pixel of every frame differs from its neighbours."""
    numbers = np.arange(frames * rows * columns).reshape(frames, rows, columns)
    return (numbers * 37 % 251).astype(dtype)


def write_tiff(
    path: Path,
    pages: Sequence[bytes],
    shape: tuple[int, int],
    *,
    bits: int = 16,
    order: str = "<",
    big: bool = False,
    tags: Tags | None = None,
    page_tags: Mapping[int, Tags] | None = None,
    loop: bool = False,
    gap: int = 0,
) -> Path:
    """Write one uncompressed strip per page; `tags` add to or replace those of every page."""
    pointer = "Q" if big else "I"
    file = bytearray(b"II" if order == "<" else b"MM")
    if big:
        file += struct.pack(order + "HHHQ", 43, 8, 0, 16)
    else:
        file += struct.pack(order + "HI", 42, 8)
    first = len(file)
    for number, pixels in enumerate(pages):
        fields: dict[int, tuple[int, Sequence[int] | str]] = {
            256: (LONG, [shape[1]]),
            257: (LONG, [shape[0]]),
            258: (SHORT, [bits]),
            259: (SHORT, [1]),
            262: (SHORT, [1]),
            273: (LONG8 if big else LONG, [0]),
            277: (SHORT, [1]),
            278: (LONG, [shape[0]]),
            279: (LONG8 if big else LONG, [len(pixels)]),
        }
        fields |= dict(tags or {}) | dict((page_tags or {}).get(number, {}))
        width = 20 if big else 12
        start = len(file)
        head = struct.calcsize(order + ("Q" if big else "H"))
        end = start + head + width * len(fields) + struct.calcsize(order + pointer)
        extra = bytearray()
        entries = bytearray()
        inline = 8 if big else 4
        sizes = {}
        for code, (kind, value) in sorted(fields.items()):
            raw = _raw(order, kind, value)
            sizes[code] = (kind, value, raw)
        total_extra = sum(len(raw) for _, _, raw in sizes.values() if len(raw) > inline)
        data_at = end + total_extra + gap
        for code, (kind, value, raw) in sizes.items():
            if code == 273 and list(value) == [0]:
                raw = _raw(order, kind, [data_at])
            count = len(raw) if kind == ASCII else len(value) // (2 if kind == RATIONAL else 1)
            entries += struct.pack(order + ("HHQ" if big else "HHI"), code, kind, count)
            if len(raw) > inline:
                entries += struct.pack(order + pointer, end + len(extra))
                extra += raw
            else:
                entries += raw.ljust(inline, b"\0")
        following = data_at + len(pixels)
        if number == len(pages) - 1:
            following = first if loop else 0
        file += struct.pack(order + ("Q" if big else "H"), len(fields)) + entries
        file += struct.pack(order + pointer, following) + extra + bytes(gap) + pixels
    path.write_bytes(bytes(file))
    return path


def _raw(order: str, kind: int, value: Sequence[int] | str) -> bytes:
    if isinstance(value, str):
        return value.encode() + b"\0"
    if kind == RATIONAL:
        return struct.pack(f"{order}{len(value)}I", *value)
    return struct.pack(f"{order}{len(value)}{_CODES[kind]}", *value)


def pages_of(data: NDArray, order: str = "<") -> list[bytes]:
    """List the bytes of each frame in a byte order."""
    return [frame.astype(frame.dtype.newbyteorder(order)).tobytes() for frame in data]


def write_pages(
    path: Path,
    data: NDArray,
    *,
    tags: Tags | None = None,
    page_tags: Mapping[int, Tags] | None = None,
    loop: bool = False,
    gap: int = 0,
) -> Path:
    """Write a page for each frame; see `write_tiff`."""
    given = {"tags": tags, "page_tags": page_tags, "loop": loop, "gap": gap}
    return write_tiff(path, pages_of(data), data.shape[1:], **given)  # type: ignore[arg-type]


def write_micro_manager(
    path: Path,
    data: NDArray,
    frame_metadata: Sequence[Mapping[str, object]],
    description: str | None = None,
) -> Path:
    """Write what Micro-Manager writes: a JSON for each frame in the private tag 51123."""
    page_tags: dict[int, dict[int, tuple[int, Sequence[int] | str]]] = {
        number: {51123: (ASCII, json.dumps(fields))} for number, fields in enumerate(frame_metadata)
    }
    if description is not None:
        page_tags.setdefault(0, {})[270] = (ASCII, description)
    return write_pages(path, data, page_tags=page_tags)


def write_stk(
    path: Path,
    data: NDArray,
    *,
    times_ms: Sequence[int] | None = None,
    um_per_px: float | None = None,
    tags: Tags | None = None,
) -> Path:
    """Write what MetaMorph writes: one image, whose UIC2Tag counts the planes that follow it."""
    times = [divmod(t, 86_400_000) for t in times_ms or range(0, 5 * len(data), 5)]
    numbers = [n for day, ms in times for n in (0, 1, 2_459_000 + day, ms, 2_459_000 + day, ms)]
    fields: dict[int, tuple[int, Sequence[int] | str]] = {33629: (RATIONAL, numbers)}
    if um_per_px is not None:  # XCalibration, YCalibration, CalibrationUnits: places of the values
        place = 65536
        fields[33628] = (LONG, [4, place, 5, place, 6, place + 8])
    fields |= dict(tags or {})
    raw = data.astype(data.dtype.newbyteorder("<")).tobytes()
    write_tiff(path, [raw], data.shape[1:], tags={279: (LONG, [data[0].nbytes]), **fields})
    content = path.read_bytes()
    # MetaMorph counts planes and pairs, not the numbers that they take.
    for code, kind, counted, count in (
        (33629, RATIONAL, 3 * len(data), len(data)),
        (33628, LONG, 6, 3),
    ):
        content = content.replace(
            struct.pack("<HHI", code, kind, counted), struct.pack("<HHI", code, kind, count)
        )
    if um_per_px is not None:
        scale = struct.pack("<II", round(um_per_px * 1e6), 10**6)
        content = content.ljust(place, b"\0") + scale + struct.pack("<I", 3) + b"um\0"
    path.write_bytes(content)
    return path


OME = '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">{}</OME>'


def write_ome_set(
    folder: Path, counts: NDArray, *, lost: int = 0, elsewhere: str = ""
) -> list[Path]:
    """Write 7 frames of 6 x 5 pixels to three files, as Micro-Manager does beyond 4 GB."""
    parts = (range(3), range(3, 6), range(6, 7))
    paths = [folder / f"m_{k}.ome.tif" for k in range(len(parts))]
    blocks = "".join(
        f'<TiffData FirstT="{t}" FirstC="0" FirstZ="0" IFD="{i}" PlaneCount="1">'
        f'<UUID FileName="{elsewhere}{path.name}">urn:uuid:0</UUID></TiffData>'
        for part, path in zip(parts, paths, strict=True)
        for i, t in enumerate(part)
        if t < len(counts) - lost
    )
    pixels = (
        '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint16" SizeX="5" '
        'SizeY="6" SizeC="1" SizeZ="1" SizeT="7" PhysicalSizeX="0.0844" PhysicalSizeY="0.0844" '
        f'TimeIncrement="4" TimeIncrementUnit="ms">{blocks}</Pixels></Image>'
    )
    for part, path in zip(parts, paths, strict=True):
        with tifffile.TiffWriter(path) as tiff:
            for t in part:
                tiff.write(
                    counts[t], contiguous=False, metadata=None,
                    description=OME.format(pixels).encode() if t == part[0] else None,
                )  # fmt: skip
    return paths
