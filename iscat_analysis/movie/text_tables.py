r"""Tables of text, as programs and spreadsheets save them: one reader for all.

The file itself tells encoding (UTF-8, UTF-16, Windows-1252), separator (comma, semicolon, tab, or
none where there is one column) and decimal mark.  A comma or a point is the decimal mark if a cell
proves it: two different marks, of which the last one is it; one that is repeated, which groups
thousands; or one without exactly three digits behind it.  Where no cell of the column proves it,
another column of the table does; otherwise a point is a decimal mark, and a comma is one unless
other cells of the column have none or its numbers are whole.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.errors import DataError
from iscat_analysis.reading import first_line, is_folder, open_regular, read_bytes
from iscat_analysis.records import FloatArray

_HEAD = 65536  # bytes that tell the encoding
_LOOKED_AT = 50  # lines that tell the separator
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_CONTROL = re.compile("[\x00-\x08\x0e-\x1b\ufeff]")
_NOTHING = " - – — na n/a #n/a nan none null #num! #div/0! #value! 1.#qnan 1.#ind -1.#ind"
_EMPTY = frozenset(_NOTHING.split(" "))
"""What programs write where there is no number, or nothing at all."""
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}(?:[.,]\d{3})+")  # 1,234 or 1.234.567
_BETWEEN_DIGITS = re.compile(r"(?<=\d)[\s'\u2019](?=\d{3}(?!\d))")  # of 1 234 or 1'234


@dataclass(frozen=True, eq=False)
class Cells:
    """The columns of a table that are wanted, as text."""

    source: object
    names: tuple[str, ...]
    columns: Mapping[str, list[str]]
    between: str
    units: Mapping[str, str]
    """What a row of units says of each column, if there is such a row."""

    def numbers(
        self, wanted: Collection[str], whole: Collection[str] = ()
    ) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
        """Read columns as numbers, and say what was assumed of their decimal marks.

        Parameters
        ----------
        wanted : collection of str
            The columns.
        whole : collection of str
            Columns of large whole numbers, in which a mark before three digits groups thousands.
        """
        plain, rest = {}, {}
        for name in wanted:
            try:
                plain[name] = np.array([float(cell) for cell in self.columns[name]])
            except ValueError:
                rest[name] = self._bare(name)
        marks = {name: _proven_mark(cells) for name, cells in rest.items()}
        known = [mark for mark in marks.values() if mark is not None]
        if not known and rest:
            known = [mark for name in plain if (mark := _proven_mark(self._bare(name)))]
        of_table = known[0] if known else None
        for name in plain if of_table == "," else [*(set(plain) & set(whole))]:
            if _all_grouped(bare := self._bare(name)):  # so that 1.020 is no small number
                rest[name], marks[name] = bare, ","
        notes = []
        for name, cells in rest.items():
            mark = marks[name] or of_table
            if mark is None:
                mark = _likely_mark(cells, whole=name in whole)
                if mark == "," and self.between != ";":
                    one = next(cell for cell in cells if "," in cell)
                    notes.append(f"{one} is read with a decimal comma, as {one.replace(',', '.')}")
            plain[name] = np.array([self._number(name, *each, mark) for each in enumerate(cells)])
        return {name: plain[name] for name in wanted}, tuple(dict.fromkeys(notes))

    def _bare(self, name: str) -> list[str]:
        """Take spaces and apostrophes between thousands away, and a typographer's minus."""
        return [
            _BETWEEN_DIGITS.sub("", cell.strip()).replace("\u2212", "-")
            for cell in self.columns[name]
        ]

    def _number(self, name: str, row: int, cell: str, mark: str) -> float:
        if cell.lower() in _EMPTY:
            return math.nan
        text, groups = cell, "." if mark == "," else ","
        if groups in text and _GROUPED.fullmatch(text.partition(mark)[0]):
            text = text.replace(groups, "")
        try:
            return float(text.replace(mark, "."))
        except ValueError:
            raise DataError(
                f"{self.source}: holds {cell[:80]!r} in {name} in row {row}, which is no number; "
                "correct it or leave the cell empty"
            ) from None


def read_cells(
    path: Path, choose: Callable[[Sequence[str]], Mapping[str, int]], *, units: bool = True
) -> Cells:
    """Read a table of text.

    Parameters
    ----------
    path : Path
        The file.
    choose : callable
        Gives the name and the place of each wanted column, from the headings.
    units : bool
        Whether a row of units may stand below the headings.
    """
    try:
        with open_regular(path, 2_000_000_000) as file:
            head = file.read(_HEAD)
            file.seek(0)
            with io.TextIOWrapper(file, encoding_of(head), newline="") as lines:
                return _read(lines, path, choose, units=units)
    except UnicodeError:
        raise DataError(
            f"{path}: is neither an HDF5 file nor a text file in UTF-8 or UTF-16; export it as CSV"
        ) from None
    except (MemoryError, csv.Error) as error:
        raise DataError(
            f"{path}: cannot be read as a table ({first_line(error)}); export it again"
        ) from None
    except OSError as error:
        what = "is a folder" if is_folder(path) else f"cannot be read ({error.strerror})"
        raise DataError(f"{path}: {what}; give the path of a table") from None


def read_frame(path: Path) -> pd.DataFrame:
    """Read a table of which nothing is known: columns of numbers where all cells are some."""
    cells = read_cells(path, _all_named, units=False)
    if not cells.columns:
        raise DataError(f"{path}: is no CSV file with a first line of names")
    found: dict[str, Any] = {}
    for place, column in cells.columns.items():
        try:
            numbers = cells.numbers((place,))[0][place]
            whole = np.array_equal(numbers, np.floor(numbers)) and "." not in "".join(column)
            found[place] = numbers.astype(np.int64) if whole else numbers
        except DataError:
            found[place] = [cell.strip() or None for cell in column]
    frame = pd.DataFrame(found)
    return frame.set_axis([cells.names[int(place)] for place in frame.columns], axis=1)


def _all_named(names: Sequence[str]) -> dict[str, int]:
    return {str(place): place for place, name in enumerate(names) if name}


def read_table_text(path: Path) -> str:
    """Read a short table of text, whatever its encoding."""
    content = read_bytes(path)
    return content.decode(encoding_of(content[:_HEAD])).replace("\r\n", "\n").replace("\r", "\n")


def encoding_of(head: bytes) -> str:
    """Find the encoding of a text by its first bytes; a `UnicodeError` where they are no text."""
    name = _encoding_of(head)
    if _CONTROL.search(head.decode(name, "ignore").removeprefix("\ufeff")):
        raise UnicodeError
    return name


def _encoding_of(head: bytes) -> str:
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    even, odd = head[::2].count(0), head[1::2].count(0)
    if max(even, odd) > 0.2 * len(head) and min(even, odd) == 0:  # of half of the bytes
        return "utf-16-be" if even else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def separator(lines: Sequence[str]) -> str:
    r"""Find what separates the cells of a table: it makes as many in each line as in the first.

    Examples
    --------
    >>> separator(["path;buffer, pH;concentration_nm", "a.tif;PBS, 7.4;10"])
    ';'
    """

    def agreement(between: str) -> tuple[int, int]:
        try:
            widths = [len(row) for row in csv.reader(lines[:_LOOKED_AT], delimiter=between)]
        except csv.Error:  # which whoever reads the rows says
            return 0, 0
        return sum(width == widths[0] for width in widths), widths[0]

    found = [between for between in ",;\t" if lines and between in lines[0]]
    return max(found, key=agreement) if found else "\x1f"  # which no table has


def refuse_twice(names: Sequence[object], used: Collection[str], table: object) -> None:
    """Refuse two columns of one name, of which only one can be meant."""
    for name in used:
        if list(names).count(name) > 1:
            raise DataError(
                f"{table}: has two columns of the name {name}, and only one can be meant; rename "
                "the other"
            )


def table_lines(lines: Iterable[str]) -> tuple[list[str], str, Iterable[str]]:
    """Divide a table: its first lines, what separates their cells, and all lines from the heading.

    Empty lines and comments, which begin with ``#``, are left out; Excel's first line ``sep=;``
    says what separates.  The heading is the last comment where the first line is one of numbers.
    """
    told = (line for line in lines if line.strip())
    head = list(islice(told, _LOOKED_AT))
    said = re.fullmatch(r'"?sep=(.)"?\s*', head[0], re.IGNORECASE) if head else None
    head = head[1:] if said else head
    plain = [line for line in head if line.lstrip()[0] != "#"]
    between = said[1] if said else separator(plain)
    first = next((n for n, line in enumerate(head) if line in plain[:1]), 0)
    if plain and first and all(map(_is_number, next(csv.reader(plain[:1], delimiter=between)))):
        plain.insert(0, head[first - 1].lstrip()[1:].lstrip())
    rest = (line for line in told if line.lstrip()[0] != "#")
    return plain, between, chain(plain, rest)


def _read(
    lines: Iterable[str],
    path: Path,
    choose: Callable[[Sequence[str]], Mapping[str, int]],
    *,
    units: bool,
) -> Cells:
    _, between, told = table_lines(lines)
    rows = csv.reader(told, delimiter=between)
    names = [name.strip() for name in next(rows, [])]
    places = choose(names)
    columns: dict[str, list[str]] = {column: [] for column in places}
    wanted = [(columns[column], place) for column, place in places.items()]
    for number, row in enumerate(rows):
        if len(row) != len(names) or not any(row):
            if not any(cell.strip() for cell in row):
                continue
            more = any(cell.strip() for cell in row[len(names) :])
            if more or len(row) < len(names):
                why = "the copy was interrupted, or the table was edited: export it again"
                if more and between == ",":
                    why = "where numbers have decimal commas, save it with semicolons in between"
                raise DataError(
                    f"{path}: row {number} has {len(row)} values where the first line names "
                    f"{len(names)}; {why}"
                )
        for cells, place in wanted:
            cells.append(row[place])
    told_units: dict[str, str] = {}
    if units and _is_of_units([cells[:2] for cells in columns.values() if len(cells) > 1]):
        told_units = {column: cells.pop(0).strip() for column, cells in columns.items()}
    return Cells(path, tuple(names), columns, between, told_units)


def _is_of_units(first: Sequence[Sequence[str]]) -> bool:
    """Tell whether the first of two rows holds units of the second: text, and no number at all."""
    some = any(unit.strip().lower() not in _EMPTY and _is_number(value) for unit, value in first)
    return some and not any(_is_number(unit) for unit, _ in first)


def _is_number(cell: str) -> bool:
    text = cell.strip().replace(",", ".")
    try:
        return not math.isnan(float(text))
    except ValueError:
        return _GROUPED.fullmatch(text) is not None


def _proven_mark(cells: Iterable[str]) -> str | None:
    for cell in cells:
        marks = [sign for sign in cell if sign in ".,"]
        if not marks or cell.lower() in _EMPTY:
            continue
        if len(set(marks)) == 2:
            return marks[-1]
        if len(marks) > 1:
            return "." if marks[0] == "," else ","
        if not _GROUPED.fullmatch(cell):
            return marks[0]
    return None


def _all_grouped(cells: Sequence[str]) -> bool:
    marked = [cell for cell in cells if "." in cell]
    return bool(marked) and all(_GROUPED.fullmatch(cell) for cell in marked)


def _likely_mark(cells: Sequence[str], *, whole: bool) -> str:
    """Choose the decimal mark where each number with a mark has three digits behind it."""
    known = [cell for cell in cells if cell.lower() not in _EMPTY]
    commas = [cell for cell in known if "," in cell]
    return "," if commas and len(commas) == len(known) and not whole else "."
