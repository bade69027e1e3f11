"""A folder of TIFF files with one frame each, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.tiff import TIFF_SUFFIXES, is_single_image, open_frame_file
from iscat_analysis.reading import open_regular
from iscat_analysis.units import listed

_DIGITS = re.compile(r"(\d+)", flags=re.ASCII)


def frames_in(folder: Path) -> tuple[Path, ...]:
    """List the TIFF files of a folder in natural order: frame2 before frame10."""
    try:
        inside = [path for path in folder.iterdir() if path.suffix.lower() in TIFF_SUFFIXES]
    except OSError:
        return ()
    shown = (path for path in inside if not path.name.startswith(".") and path.is_file())
    return tuple(sorted(shown, key=lambda path: (_numbers(path), path.name)))


def holds_single_frames(folder: Path, *, named: bool = False) -> bool:
    """Tell whether a folder is a movie of TIFF files with one image each.

    Unless somebody names it as a movie, it must have ten files, whose numbers alone differ.
    """
    files = frames_in(folder)
    if len(files) < (2 if named else 10):
        return False
    alike = named or len({*map(_pattern, files)}) == 1
    return alike and is_single_image(files[0]) and is_single_image(files[-1])


class FrameFiles:
    """The frames of a folder; a file is open only while it is read."""

    def __init__(self, folder: Path) -> None:
        self.files = frames_in(folder)
        _refuse_mixture(self.files, folder)
        _refuse_gaps(self.files, folder)
        with open_frame_file(self.files[0]) as first:
            self._expected = first.shape, first.dtype
            self.metadata, self.notes = first.metadata, first.notes
            self._stored, place = first.stored, first.place
        self.shape = (len(self.files), *self._expected[0][1:])
        self.dtype = self._expected[1]
        self._size = self.shape[1] * self.shape[2] * self.dtype.itemsize
        if place is None:
            self._places = [self._place(file) for file in self.files]
        else:  # headers that repeat are read once
            around = _around(self.files[0], place, self._size)
            self._places = [
                place if _around(file, place, self._size) == around else self._place(file)
                for file in self.files
            ]

    def _place(self, file: Path) -> int | None:
        """Read the header of a file that is not like the first one."""
        with open_frame_file(file) as frames:
            if frames.shape[0] > 1:
                raise DataError(
                    f"{file}: holds {frames.shape[0]} frames, but the other files of its folder "
                    "hold one each; leave only the frames of one movie there"
                )
            if (frames.shape, frames.dtype) != self._expected or frames.stored != self._stored:
                raise DataError(
                    f"{file}: has other pixels than {self.files[0].name}; leave only the frames "
                    "of one movie in the folder"
                )
            return frames.place

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        for number in range(start, stop):
            file, place = self.files[number], self._places[number]
            if place is None:  # compressed
                with open_frame_file(file) as frames:
                    block[number - start] = frames.read(0, 1)[0]
                continue
            try:
                with open_regular(file) as opened:
                    opened.seek(place)
                    raw = opened.read(self._size)
            except OSError as error:
                raise DataError(f"{file}: can no longer be read ({error.strerror})") from None
            if len(raw) < self._size:
                raise DataError(f"{file}: became shorter while it was open; start again")
            block[number - start] = np.frombuffer(raw, self._stored).reshape(self.shape[1:])
        return block

    def close(self) -> None:
        """Do nothing: no file is open."""


def _around(path: Path, place: int, size: int) -> tuple[bytes, bytes, int]:
    """Give what a file holds before and behind its pixels, and its length."""
    try:
        with open_regular(path) as file:
            before = file.read(place)
            end = file.seek(0, 2)
            file.seek(place + size)
            return before, file.read(), end
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None


def _parts(path: Path) -> list[str]:
    return _DIGITS.split(path.name)


def _numbers(path: Path) -> list[tuple[int, int | str]]:
    """Give what a name is sorted by: texts by their letters, numbers by their size."""
    return [(1, int(part)) if k % 2 else (0, part) for k, part in enumerate(_parts(path))]


def _pattern(path: Path) -> str:
    return "#".join(_parts(path)[::2])


def _refuse_mixture(files: Sequence[Path], folder: Path) -> None:
    """Refuse names of several kinds: one of them may be a background, a mean or another channel."""
    kinds = list(dict.fromkeys(map(_pattern, files)))
    if len(kinds) > 1:
        raise DataError(
            f"{folder}: holds TIFF files with different kinds of names "
            f"({', '.join(kinds[:3])}); leave only the frames of one movie there"
        )


def _refuse_gaps(files: Sequence[Path], folder: Path) -> None:
    """Refuse numbers of which some are missing, and two that count different things."""
    columns = zip(*([int(part) for part in _parts(file)[1::2]] for file in files), strict=True)
    varying = [np.array(column) for column in columns if len(set(column)) > 1]
    if len(varying) > 1 and np.prod([len(np.unique(column)) for column in varying]) == len(files):
        counts = " x ".join(str(len(np.unique(column))) for column in varying)
        raise DataError(
            f"{folder}: the names of its {len(files)} files count {counts} frames by several "
            "numbers, as of channels, heights or positions; leave only the frames of one there"
        )
    if len(varying) != 1:
        return
    steps = np.diff(varying[0])
    step = int(steps.min())
    if step > 0 and not (steps % step).any() and np.median(steps) == step:
        every = np.arange(varying[0][0], varying[0][-1] + 1, step)
        missing = np.setdiff1d(every, varying[0])
        if 0 < missing.size < len(files):
            raise DataError(
                f"{folder}: of the numbers in the names of its files {missing.size} are missing "
                f"({listed(missing, 3)}); copy the folder again or, if these frames were left out "
                "on purpose, number the files anew"
            )
