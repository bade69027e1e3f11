"""Where a movie is: a file, or a part of one, as in ``day.h5::/run 3/movie``.

What stands behind the two colons is the path of a dataset in an HDF5 file or a Zarr folder, or
shape and type of the numbers of a file that says nothing of itself: ``movie.bin::128x128,uint16``,
with ``,header=344`` where so many bytes come first, and ``,order=columns`` where a frame is stored
column by column, as MATLAB does.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from iscat_analysis.errors import DataError
from iscat_analysis.reading import is_file, is_folder

MARK = "::"
_FOLDERS = (".zarr", ".iscat")  # endings of folders that say what they are
SETUP = "iscat.toml"
"""Name of the configuration of the movies in a folder."""

_SHAPE = re.compile(
    r"(?:(\d{1,12})x)?(\d{1,9})x(\d{1,9}),\s*([^\s,]+)"
    r"(?:,\s*header=(\d{1,12}))?(?:,\s*order=(rows|columns))?",
    flags=re.ASCII,
)


class Layout(NamedTuple):
    """How plain numbers lie in a file."""

    frames: int | None
    rows: int
    columns: int
    type_name: str
    header_bytes: int = 0
    by_columns: bool = False

    def __str__(self) -> str:
        shape = [n for n in (self.frames, self.rows, self.columns) if n is not None]
        header = f",header={self.header_bytes}" if self.header_bytes else ""
        order = ",order=columns" if self.by_columns else ""
        return f"{'x'.join(map(str, shape))},{self.type_name}{header}{order}"


def split_address(address: Path) -> tuple[Path, str]:
    """Split an address into file and dataset."""
    head, mark, part = str(address).partition(MARK)
    if mark and not (is_file(address) or is_folder(address)):
        return Path(head), part
    return address, ""


def layout(part: str) -> Layout | None:
    """Read shape, type and place of plain numbers."""
    match = _SHAPE.fullmatch(part.strip())
    if match is None:
        return None
    frames, rows, columns, name, header, order = match.groups()
    number = int(frames) if frames else None
    return Layout(number, int(rows), int(columns), name, int(header or 0), order == "columns")


def setup_beside(address: Path) -> Path:
    """Path of the configuration for the movies of a folder."""
    return split_address(address)[0].parent / SETUP


def path_beside(address: Path, suffix: str) -> Path:
    """Path of what is written about a movie, next to it."""
    path, part = split_address(address)
    if path.name in ("", ".."):  # the folder one is in, or the one above, has its name elsewhere
        try:
            path = path.resolve()
        except (RuntimeError, OSError):
            raise DataError(f"{path}: is a link that leads back to itself") from None
    if not path.name:
        raise DataError(f"{path}: is not a movie or a table; give the path of one")
    if not part or layout(part) is not None:
        whole = is_folder(path) and path.suffix.lower() not in _FOLDERS  # a dot of "3.5 nM"
        return path.with_name(path.name + suffix) if whole else path.with_suffix(suffix)
    return path.with_name(".".join([path.stem, *part.strip("/").split("/")]) + suffix)
