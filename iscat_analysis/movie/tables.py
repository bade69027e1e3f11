r"""Tables of text, as programs and spreadsheets save them: one reader for all.

The file itself tells encoding (UTF-8, UTF-16, Windows-1252), separator (comma, semicolon, tab, or
none where there is one column) and decimal mark.  A comma or a point is the decimal mark if a cell
proves it: two different marks, of which the last one is it; one that is repeated, which groups
thousands; or one without exactly three digits behind it.  Where no cell of the column proves it,
another column of the table does; otherwise a point is a decimal mark, and a comma is one unless
other cells of the column have none or its numbers are whole.

Tables of events: ours, those of other programs, and columns of one's own; one reader for all.

A calibration is odd-symmetric: contrast c and mass m obey c = s·m + sign(m)·o, so that a particle
that leaves weighs what it weighed when it landed; m = sign(−c)·(−|c| − o)/s.  A plain line through
both branches is wrong by 2|o/s| on one of them.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK, split_address
from iscat_analysis.movie.mapped import HDF5_SIGNATURE
from iscat_analysis.reading import (
    first_line,
    is_file,
    is_folder,
    open_regular,
    read_bytes,
    read_parquet,
)
from iscat_analysis.records import FloatArray

if TYPE_CHECKING:
    from iscat_analysis.movie.hdf5 import Hdf5Reader, StoredArray

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


def table_lines(lines: Iterable[str]) -> tuple[str, Iterable[str]]:
    """Tell what separates the cells of a table, and give its lines from the heading on.

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
    return between, chain(plain, rest)


def _read(
    lines: Iterable[str],
    path: Path,
    choose: Callable[[Sequence[str]], Mapping[str, int]],
    *,
    units: bool,
) -> Cells:
    between, told = table_lines(lines)
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


TABLE_COLUMNS = ("frame", "x_px", "y_px", "contrast", "mass_kda")
"""The columns of `read_events`, in order; those of `FURTHER_COLUMNS` follow, and of several movies
of one file ``movie``."""

TEXTS = ("status", "rejected_by_hand")
"""Columns of text."""

_WORDS = ("mass", "masses", "molecular_mass", "molecular_weight", "mw", "masse", "massen")
_KDA = {"kda": 1.0, "da": 1e-3, "mda": 1e3}
_PER_KDA = {f"{word}_{unit}": each for unit, each in _KDA.items() for word in _WORDS}
_OURS = (
    "event diameter_nm systematic_mass_kda systematic_contrast snr n_after p_value track status "
    "rejected_by_hand"
)
_NAMES: Mapping[str, Mapping[str, float]] = {
    "frame": dict.fromkeys(("frame_indices", "frame", "frames", "frame_index"), 1.0),
    "x_px": {"x_coords": 1.0, "x_px": 1.0},
    "y_px": {"y_coords": 1.0, "y_px": 1.0},
    "contrast": {"contrasts": 1.0, "contrast": 1.0, "kontrast": 1.0, "contrast_%": 0.01},
    "mass_kda": {
        **dict.fromkeys(("mass_kda", "masses_kda", "calibrated_values"), 1.0),
        **_PER_KDA,
        **dict.fromkeys(_WORDS, math.nan),  # a row of units must say
    },
    "sigma_mass_kda": {f"sigma_mass_{unit}": each for unit, each in _KDA.items()},
    **{name: {name: 1.0} for name in _OURS.split()},
}
"""What each column is called in the files, the first first, and what its values are times."""

_OF_TRACKPY = {"x", "y", "frame", "mass", "signal"}
_CALIBRATIONS = (
    ("mass_model/c_1kDa", "mass_model/o_0kDa"),
    ("calibration/gradient", "calibration/offset"),
)
"""Gradient and offset of a mass calibration."""
_GROUPS = ("", "analysis/events/events_fitted/")  # tables of their own, and inside .mpr movies
_MOVIES = "per_movie_events"


def read_events(path: Path) -> pd.DataFrame:
    """Read a table of events.

    Ours: an output folder, ``fits.csv`` or ``fits.parquet``.  Refeyn's, and tables that PhotoMol
    reads: HDF5 (``masses_kDa`` with ``mass_model``, or ``calibrated_values`` with ``calibration``;
    also inside ``.mpr`` movies) or text (``eventsFitted.csv``).  Of a file with several movies the
    events of all are read, or of the one that ``FILE::movie`` names.  Picasso's: HDF5 with
    ``locs``, if these have a column ``mass_kda``, as those of ``iscat export`` do.  Any other table
    of text whose first line names contrasts, or masses with their unit (``Mass [kDa]``,
    ``mass_da``).

    What was assumed is in ``attrs["notes"]``, the file that was read in ``attrs["file"]``.
    """
    path = Path(path)
    address, movie = split_address(path)
    file = _file_of(address)
    try:
        with open_regular(file) as opened:
            signature = opened.read(len(HDF5_SIGNATURE))
        if signature == HDF5_SIGNATURE:
            table = _from_hdf5(file, movie)
        elif movie:
            raise _of_one_movie(file, movie)
        elif signature.startswith(b"PAR1"):
            table = named(read_parquet(file), path)
        else:
            table = _from_text(file)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); give the path of one table of events"
        ) from None
    except ValueError as error:
        raise DataError(
            f"{path}: cannot be read as a table ({first_line(error)}); export it again"
        ) from None
    table.attrs["file"] = str(file)
    return table


def _of_one_movie(path: Path, movie: str) -> DataError:
    return DataError(f"{path}: holds the events of one movie; leave out {MARK}{movie}")


def _file_of(path: Path) -> Path:
    """Give the table in an output folder, or the file itself."""
    if not is_folder(path):
        return path
    inside = next(filter(is_file, (path / name for name in ("fits.parquet", "fits.csv"))), None)
    if inside is None:
        raise DataError(
            f"{path}: is a folder without fits.csv; give an output folder of iscat fit, or the "
            "path of one table of events"
        )
    return inside


def named(table: pd.DataFrame, source: object) -> pd.DataFrame:
    """Give the columns of a table in memory their names and units."""
    places, factors = _places([str(name) for name in table.columns], source)
    columns = {name: table.iloc[:, place].to_numpy() for name, place in places.items()}
    numbers = {}
    for name, values in columns.items():
        try:
            numbers[name] = values if name in TEXTS else np.asarray(values, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(
                f"{source}: holds in {name} what is no number ({first_line(error)}); correct the "
                "table"
            ) from None
    return _table(numbers, source, factors)


def _table(
    columns: Mapping[str, Any],
    source: object,
    factors: Mapping[str, float] = MappingProxyType({}),
    line: tuple[float, float] | None = None,
    notes: Iterable[str] = (),
) -> pd.DataFrame:
    """Put columns together; where none has masses, a line (gradient, offset) tells them."""
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        called = {name: next(iter(_NAMES[name])) for name in lengths}
        shown = ", ".join(f"{called[name]} {length}" for name, length in lengths.items())
        raise DataError(f"{source}: its columns differ in length ({shown}); export it again")
    nothing = np.full(next(iter(lengths.values())), np.nan)
    known = {**dict.fromkeys(TABLE_COLUMNS, nothing), **columns}
    for name, values in known.items():
        if name not in TEXTS:
            factor = factors.get(name, 1.0)
            if math.isnan(factor):
                raise DataError(
                    f"{source}: does not say the unit of its masses; name their column mass_kda, "
                    "or mass_da"
                )
            known[name] = factor * np.where(np.abs(values) < 1e300, values, np.nan)
    frame = known["frame"]
    if (bad := (frame < 0) | (frame > 2**53)).any():
        row = int(np.argmax(bad))
        raise DataError(
            f"{source}: the frame is {frame[row]:g} in row {row}, which is no frame number; export "
            "the table again"
        )
    if np.array_equal(frame, np.floor(frame)):
        known["frame"] = frame.astype(np.int64)
    if line is not None and np.isnan(known["mass_kda"]).all():
        contrast = known["contrast"]
        known["mass_kda"] = np.sign(-contrast) * (-np.abs(contrast) - line[1]) / line[0]
    table = pd.DataFrame({name: known[name] for name in _NAMES if name in known})
    table.attrs["notes"] = list(notes)
    return table


def _from_hdf5(path: Path, movie: str) -> pd.DataFrame:
    from iscat_analysis.movie.hdf5 import Hdf5Reader  # h5py takes long

    with closing(Hdf5Reader(path)) as reader, closing(reader.data):
        locs = reader.records("locs")
        if locs is not None and movie:
            raise _of_one_movie(path, movie)
        if locs is not None:
            return _table(_from_locs(locs, path), path)
        groups = _groups(reader, path, movie)
        tables = {name: _from_group(reader, group, path) for name, group in groups.items()}
    if len(tables) == 1:
        return next(iter(tables.values()))
    joined = pd.concat(
        [table.assign(movie=name) for name, table in tables.items()], ignore_index=True
    ).assign(frame=math.nan)
    joined.attrs["notes"] = [
        f"the events of {len(tables)} movies are taken together, without their frames, because "
        f"each movie counts from 0; {path.name}{MARK}{next(iter(tables))} is one of them"
    ]
    return joined


def _from_group(reader: Hdf5Reader, group: str, path: Path) -> pd.DataFrame:
    """Read the table of one movie."""
    columns: dict[str, FloatArray] = {}
    factors: dict[str, float] = {}
    names = {_plain(name): name for name in reader.names(group.rstrip("/"))}
    for column, kinds in _NAMES.items():
        known = {kind: each for kind, each in kinds.items() if each == each and kind in names}
        for kind in known if column not in TEXTS else ():
            values = _column(reader, f"{group}{names[kind]}", path)
            if values is not None and column not in columns:
                columns[column], factors[column] = values, kinds[kind]
    if "contrast" not in columns:
        raise DataError(f"{path}: contrasts is no column of numbers; export it again")
    return _table(columns, path, factors, _calibration(reader, group, path))


def _from_locs(locs: StoredArray, path: Path) -> dict[str, FloatArray]:
    """Take Picasso's localisations for events, if they have masses."""
    names = locs.dtype.names or ()
    if "mass_kda" not in names:
        raise DataError(
            f"{path}: holds localisations of Picasso's, which have photons and no mass; give "
            "fits.csv, or localisations with a column mass_kda, as iscat export writes them"
        )
    if "group" in names:
        raise DataError(
            f"{path}: holds localisations in groups, many of one particle, and not events; give "
            "tracks.csv, which has one mass for each track"
        )
    rows = locs.read(0, locs.shape[0])
    wanted = {name.removesuffix("_px"): name for name in (*TABLE_COLUMNS, "sigma_mass_kda", "snr")}
    return {wanted[name]: rows[name].astype(np.float64) for name in wanted if name in names}


def _groups(reader: Hdf5Reader, path: Path, movie: str) -> dict[str, str]:
    """Where in the file the table of each wanted movie lies."""
    movies = {name: f"{_MOVIES}/{name}/" for name in reader.names(_MOVIES)}
    groups = {**{group: group for group in _GROUPS}, **movies}
    found = {
        name: group for name, group in groups.items() if "contrasts" in reader.names(group[:-1])
    }
    if not found:
        raise DataError(
            f"{path}: is an HDF5 file without an event table (it lacks contrasts); "
            "export the fitted events"
        )
    if movie:
        name = movie.strip("/").removeprefix(f"{_MOVIES}/")
        if name not in found or name not in movies:
            held = ", ".join(each for each in found if each in movies) or "one table for all"
            raise DataError(f"{path}: holds no movie {name!r}; its movies are {held}")
        return {name: found[name]}
    whole = next((name for name in _GROUPS if name in found), None)
    return found if whole is None else {whole: found[whole]}


def _column(reader: Hdf5Reader, name: str, path: Path) -> FloatArray | None:
    found = reader.array(name)
    if found is None:
        return None
    long = [n for n in found.shape if n != 1]
    if len(long) > 1:
        raise DataError(
            f"{path}: {name} has the shape {found.shape}, not one value per event; export it again"
        )
    return found.read(0, found.shape[0]).astype(np.float64).reshape(-1)


def _calibration(reader: Hdf5Reader, group: str, path: Path) -> tuple[float, float] | None:
    """Read gradient [1/kDa] and offset of a table's mass calibration."""
    for prefix in dict.fromkeys((group, "")):
        for gradient_name, offset_name in _CALIBRATIONS:
            gradient = reader.number(prefix + gradient_name)
            offset = reader.number(prefix + offset_name)
            if gradient is None or offset is None:
                continue
            if not (math.isfinite(gradient) and math.isfinite(offset)) or gradient == 0:
                raise DataError(
                    f"{path}: its calibration ({gradient_name} = {gradient:g}, {offset_name} = "
                    f"{offset:g}) cannot be used; calibrate again and export the table again"
                )
            return gradient, offset
    return None


def _from_text(path: Path) -> pd.DataFrame:
    """Read a table of text; its units are those of its headings, or of a row below them."""
    factors: dict[str, float] = {}

    def choose(names: Sequence[str]) -> dict[str, int]:
        places, found = _places(names, path)
        factors.update(found)
        return places

    cells = read_cells(path, choose)
    unit = _KDA.get(cells.units.get("mass_kda", "").strip("[]() ").lower())
    if unit is not None:
        factors["mass_kda"] = unit
    whole = ["mass_kda"] if factors.get("mass_kda") == _KDA["da"] else []
    columns, notes = cells.numbers([name for name in cells.columns if name not in TEXTS], whole)
    texts = {
        name: np.array([cell.strip() for cell in cells.columns[name]], dtype=object)
        for name in TEXTS
        if name in cells.columns
    }
    return _table({**columns, **texts}, path, factors, notes=notes)


def unit_note(mass_kda: FloatArray) -> str | None:
    """Say where masses are so large or so small that their heading likely names another unit."""
    known = np.abs(mass_kda[np.isfinite(mass_kda)])
    middle = float(np.median(known)) if known.size else 0.0
    if middle > 2e4:
        how, units, names = "heavier", "Da", "mass_da"
    elif 0 < middle < 1.0:
        how, units, names = "lighter", "kDa or MDa", "mass_kda or mass_mda"
    else:
        return None
    return (
        f"half of the events are {how} than {middle:.3g} kDa: if the masses are in {units}, name "
        f"their column {names}"
    )


def _plain(heading: str) -> str:
    """Write a heading as a name: ``Mass [kDa]`` and ``Mass (kDa)`` are mass_kda."""
    return re.sub(r"[^\w%]+|_+", "_", heading.strip().lower()).strip("_")


def _places(names: Sequence[str], source: object) -> tuple[dict[str, int], dict[str, float]]:
    """Find the columns by their headings: the place of each, and what its values are times."""
    plain = [_plain(name) for name in names]
    if set(plain) >= _OF_TRACKPY and "mass_kda" not in plain:
        raise DataError(
            f"{source}: is a table of trackpy's, whose mass is a brightness; give fits.csv, or "
            "name a column of masses in kDa mass_kda"
        )
    places, factors = {}, {}
    for column, kinds in _NAMES.items():
        found = next((kind for kind in kinds if kind in plain), None)
        if found is not None:
            given = names[plain.index(found)]
            refuse_twice([given if each == found else "" for each in plain], [given], source)
            places[column], factors[column] = plain.index(found), kinds[found]
    if {"contrast", "mass_kda"} & set(places):
        return places, factors
    raise DataError(
        f"{source}: is no table of events: it lacks the columns contrasts and masses_kDa in its "
        f"first line, which names {', '.join(names[:8]) or 'nothing'}; give fits.csv, a table of "
        "Refeyn's (eventsFitted.csv or h5), or name a column mass_kda, Mass [kDa] or mass_da"
    )
