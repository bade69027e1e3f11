"""Headers of TIFF images that repeat another's but for the place of the pixels.

Cameras write thousands of them, one before each frame, and to read each tag of each takes a tenth
of a millisecond.  What repeats, byte for byte, was read and judged before.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass

import tifffile

_STRIP_OFFSETS = 273
_ELSEWHERE = {282: 5, 283: 5, 305: 2, 306: 2}
"""Resolutions, program and time, with their types: they lie outside the list of tags, and those of
the first image count."""

_PLACES = {3: "H", 4: "I", 16: "Q"}  # types of number that may say where pixels are


@dataclass(frozen=True, slots=True)
class Repetition:
    """Header of an image, against which others are compared; `repetition_of` makes it."""

    tiff: tifffile.TiffFormat
    tags: bytes
    free: tuple[tuple[int, int], ...]
    place: tuple[str, int]
    size: int

    def find(self, data: mmap.mmap, offset: int) -> tuple[int, int] | None:
        """Compare an image."""
        end = offset + len(self.tags)
        here = bytearray(data[offset : end + self.tiff.offsetsize])
        if offset <= 0 or len(here) < len(self.tags) + self.tiff.offsetsize:
            return None
        (start,) = struct.unpack_from(self.place[0], here, self.place[1])
        (following,) = struct.unpack_from(self.tiff.offsetformat, here, len(self.tags))
        for first, last in self.free:
            here[first:last] = bytes(last - first)
        if here[: len(self.tags)] != self.tags or not 0 < start <= len(data) - self.size:
            return None
        return int(start), int(following)


def repetition_of(
    tiff: tifffile.TiffFormat, data: mmap.mmap, offset: int, size: int
) -> Repetition | None:
    """Make a pattern of the header of an image."""
    (count,) = struct.unpack_from(tiff.tagnoformat, data, offset)
    length = tiff.tagnosize + count * tiff.tagsize
    tags = bytearray(data[offset : offset + length])
    place: tuple[str, int] | None = None
    free = []
    for first in range(tiff.tagnosize, length, tiff.tagsize):
        code, kind = struct.unpack_from(f"{tiff.byteorder}HH", tags, first)
        number = struct.unpack_from(tiff.offsetformat, tags, first + 4)[0]
        last = first + tiff.tagsize
        value = last - tiff.offsetsize
        if code == _STRIP_OFFSETS and number == 1 and kind in _PLACES and place is None:
            place = f"{tiff.byteorder}{_PLACES[kind]}", value
        elif _ELSEWHERE.get(code) != kind:
            continue
        free.append((value, last))
        tags[value:last] = bytes(last - value)
    return None if place is None else Repetition(tiff, bytes(tags), tuple(free), place, size)
