"""The table of a day: one row per movie, as CSV, as TOML, or the movies of a folder.

What is wrong is said by row and column, before any movie is opened, and all of it at once.

Names of results and configurations of movies, made from the table of a batch.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from iscat_analysis.calibration import STANDARD_ERROR
from iscat_analysis.config import Config, configure
from iscat_analysis.errors import ConfigError
from iscat_analysis.movie import (
    MARK,
    SUFFIXES,
    find_movies,
    holds_single_frames,
    is_movie_folder,
    members_of,
    path_beside,
    split_address,
)
from iscat_analysis.movie.tables import read_table_text, table_lines
from iscat_analysis.reading import is_file, is_folder, read_text, toml_of
from iscat_analysis.text import printable

ROLES = ("sample", "calibrant", "blank", "flat")
"""What a movie is for."""

COLUMNS = ("path", "sample", "condition", "concentration_nm", "replicate", "role", "standards")
"""The columns that have a meaning; others are kept, or set keys of the configuration."""

TABLES = ("samples.csv", "samples.toml")
"""The table of a folder that is watched."""

_LISTED_PROBLEMS = 5  # complaints in one line


Records = list[tuple[str, dict[str, Any]]]
Standards = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Row:
    """One movie of the table."""

    where: str
    path: Path
    given: str
    sample: str
    condition: str
    replicate: str
    concentration_nm: float
    role: str
    standards: Standards = ()
    settings: Mapping[str, Any] | tuple[str, ...] = ()
    further: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """All rows, and the folder that their paths are relative to."""

    source: Path
    root: Path
    rows: tuple[Row, ...]
    absent: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Name of the file without its suffix, or of the folder."""
        return self.root.name if self.source.is_dir() else self.source.stem


def read_table(source: Path) -> Table:
    """Read the table of a day."""
    if is_folder(source):
        if holds_single_frames(source):
            raise ConfigError(
                f"{source}: is one movie, with a frame in each file; analyse it by `iscat fit`, or "
                "give the folder that it is in"
            )
        found = find_movies(source)
        if not found:
            raise ConfigError(
                f"{source}: holds no movie ({', '.join(SUFFIXES)}); give the folder that does, or "
                "a table of movies"
            )
        return _checked(source, source, _named(found), written=True)
    return _read_file(source)


def read_growing(folder: Path, movies: Sequence[Path]) -> Table:
    """Read the table of a folder that is still being filled."""
    tables = [folder / name for name in TABLES if (folder / name).is_file()]
    if len(tables) > 1:
        raise ConfigError(f"{folder}: holds {' and '.join(TABLES)}; leave one table of the movies")
    root = folder.resolve()
    listed = _read_file(tables[0], partial=True) if tables else Table(folder, root, ())
    known = {file for row in listed.rows for file in members_of(row.path)}
    others = [path for path in movies if known.isdisjoint(members_of(path.resolve()))]
    more = _checked(folder, folder, _named(others), written=True, partial=True)
    return Table(folder, root, (*listed.rows, *more.rows), listed.absent)


def _named(movies: Sequence[Path]) -> Records:
    return [(path.name, {"path": path.name}) for path in movies]


def _read_file(source: Path, *, partial: bool = False) -> Table:
    text = _text(source)
    toml = source.suffix.lower() == ".toml"
    records = _from_toml(source, text) if toml else _from_csv(source, text)
    if not records and not partial:
        raise ConfigError(f"{source}: it lists no movie")
    return _checked(source, source.parent, records, written=not toml, partial=partial)


def _checked(
    source: Path, folder: Path, records: Records, *, written: bool, partial: bool = False
) -> Table:
    """Make a table of what was read; a partial one leaves out the movies that are not there."""
    root = folder.resolve()
    rows, problems, absent = [], [], []
    for where, values in records:
        given = str(values.get("path", ""))
        if partial and given and not _is_there(_address(given, root)):
            absent.append(given)
            continue
        row, wrong = _row(where, values, root, written=written)
        problems += [f"{where}, {complaint}" for complaint in wrong]
        if row is not None:
            rows.append(row)
    first: dict[tuple[tuple[Path, ...], str], str] = {}
    for row in rows:
        movie = (members_of(row.path), split_address(row.path)[1].strip("/"))
        if movie in first:
            problems.append(
                f"{row.where}, path: {row.given} is the movie of {first[movie]} already; leave "
                "one of the rows out"
            )
        first.setdefault(movie, row.where)
    if problems:
        left = len(problems) - _LISTED_PROBLEMS
        more = f"; and {left} more" if left > 0 else ""
        raise ConfigError(f"{source}: {'; '.join(problems[:_LISTED_PROBLEMS])}{more}")
    return Table(source, root, tuple(rows), tuple(absent))


def _address(given: str, root: Path) -> Path:
    try:
        file, part = split_address(root / Path(given).expanduser())
        file.resolve()
    except (OSError, RuntimeError, ValueError) as error:  # no such user, a NUL, links in a circle
        raise ConfigError(f"path = {given[:80]!r} is no name of a file ({error})") from None
    return Path(f"{file.resolve()}{MARK}{part}") if part else file.resolve()


def _is_there(address: Path) -> bool:
    path, _ = split_address(address)
    return is_file(path) or (is_folder(path) and is_movie_folder(path))


def read_standards(text: str | Sequence[float]) -> Standards:
    """Read the masses of standards."""
    if not isinstance(text, (str, list, tuple)):
        raise ValueError(f"{text!r} is no list of masses; write it as 66,146,480")
    parts = text.replace(";", " ").replace(",", " ").split() if isinstance(text, str) else text
    found = []
    for part in parts:
        value, colon, error = str(part).partition(":")
        try:
            mass = float(value)
            se = float(error) if colon else STANDARD_ERROR * mass
        except ValueError:
            mass = se = math.nan
        if not (0 < mass < math.inf and 0 <= se < math.inf):
            raise ValueError(f"{part!r} is not a mass in kDa; write it as 66,146,480")
        found.append((mass, se))
    return tuple(found)


def _text(source: Path) -> str:
    try:
        return read_text(source) if source.suffix.lower() == ".toml" else read_table_text(source)
    except FileNotFoundError:
        raise ConfigError(
            f"{source}: there is no such table or folder; give a CSV or TOML file with one movie "
            "a row, or a folder of movies"
        ) from None
    except OSError as error:
        raise ConfigError(f"{source}: cannot be read ({error.strerror})") from None
    except UnicodeError:
        raise ConfigError(
            f"{source}: is not a text file: give a table of movies, saved as CSV in UTF-8"
        ) from None


def _from_csv(source: Path, text: str) -> Records:
    delimiter, _ = table_lines(text.splitlines())
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    names: list[str] = []
    records: Records = []
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if not any(stripped) or stripped[0].startswith(("#", "sep=")):
                continue
            where = f"line {reader.line_num}"
            if not names:
                names = _names(source, stripped)
                continue
            if len(stripped) > len(names):
                raise ConfigError(
                    f"{source}: {where} has {len(stripped)} cells, but the heading names "
                    f"{len(names)} columns: put a cell that holds {delimiter!r} into quotes"
                )
            records.append((where, dict(zip(names, stripped, strict=False))))
    except csv.Error as error:
        raise ConfigError(f"{source}: line {reader.line_num} is not CSV ({error})") from None
    return records


def _names(source: Path, cells: list[str]) -> list[str]:
    """Read the heading: known columns in any case, the others as they are."""
    names = [cell.lower() if cell.lower() in COLUMNS else cell for cell in cells]
    _check_names(source, names, "the heading")
    twice = [name for name in names if name and names.count(name) > 1]
    if twice:
        raise ConfigError(f"{source}: the heading names the column {twice[0]} twice")
    return names


def _check_names(source: Path, names: Sequence[str], where: str) -> None:
    """Refuse a table without paths, and a column whose name is a misspelled key."""
    for name in names:
        # likeness of a column's name to one that has a meaning
        near = difflib.get_close_matches(name.lower(), COLUMNS, n=1, cutoff=0.85)
        if near and name not in COLUMNS and near[0] not in names:
            raise ConfigError(
                f"{source}: {where} has the column {name}: did you mean {near[0]}? If not, give it "
                "another name"
            )
    if "path" not in names:
        raise ConfigError(
            f"{source}: {where} lacks the column path, the movie's file; columns are "
            f"{', '.join(COLUMNS)}, and any other"
        )


def _from_toml(source: Path, text: str) -> Records:
    try:
        values = toml_of(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: is not valid TOML: {error}") from None
    other = [name for name in values if name != "movies"]
    movies = values.get("movies", [])
    if other or not isinstance(movies, list) or not all(isinstance(m, dict) for m in movies):
        what = f"has {other[0]!r}" if other else "is not a list of movies"
        raise ConfigError(
            f"{source}: {what}: a table of movies holds [[movies]] and nothing else; a "
            "configuration is given as `config`"
        )
    records: Records = []
    for number, movie in enumerate(movies, 1):
        _check_names(source, list(movie), f"[[movies]] number {number}")
        records.append((f"[[movies]] number {number}", movie))
    return records


def _row(
    where: str, values: Mapping[str, Any], root: Path, *, written: bool
) -> tuple[Row | None, list[str]]:
    """Check one row, of text where it is `written`; the complaints begin with the column."""
    wrong: list[str] = []
    known = {name: values.get(name, "") for name in COLUMNS}
    given = str(known["path"])
    if not given:
        return None, ["path: is empty"]
    path = _address(given, root)
    if not _is_there(path):
        what = (
            "is a folder, and one movie is wanted" if is_folder(path) else "there is no such file"
        )
        wrong.append(f"path: {given}: {what}; paths are relative to {root}")
    role = str(known["role"]).lower() or "sample"
    if role not in ROLES:
        near = difflib.get_close_matches(role, ROLES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        wrong.append(f"role: {known['role']!r} is none of {', '.join(ROLES)}{hint}")
    concentration = math.nan
    if known["concentration_nm"] != "":
        try:
            concentration = float(known["concentration_nm"])
        except (TypeError, ValueError):
            concentration = -1.0
        if not 0 <= concentration < math.inf:
            wrong.append(
                f"concentration_nm: {known['concentration_nm']!r} is not a concentration in "
                "nmol/l; write a number with a decimal point, or leave it empty"
            )
    standards: Standards = ()
    try:
        masses = known["standards"]
        standards = read_standards([masses] if isinstance(masses, (int, float)) else masses)
    except (TypeError, ValueError) as error:
        wrong.append(f"standards: {error}")
    if standards and role != "calibrant":
        wrong.append(f"standards: are of a calibrant, but the movie's role is {role}")
    settings, further = _divided(values, written)
    row = Row(
        where=where,
        path=path,
        given=printable(given),
        sample=printable(str(known["sample"]) or path_beside(path, "").name),
        condition=str(known["condition"]),
        replicate=str(known["replicate"]),
        concentration_nm=concentration,
        role=role,
        standards=standards,
        settings=settings,
        further=further,
    )
    return (None if wrong else row), wrong


def _divided(
    values: Mapping[str, Any], written: bool
) -> tuple[Mapping[str, Any] | tuple[str, ...], dict[str, Any]]:
    """Tell keys of the configuration from columns that are only kept."""
    settings: dict[str, Any] = {}
    further: dict[str, Any] = {}
    for name, value in values.items():
        section, dot, _ = name.partition(".")
        if section in Config.model_fields and (dot or isinstance(value, dict)):
            settings[name] = value
        elif name and name not in COLUMNS:
            further[name] = value
    if written:
        return tuple(f"{name}={value}" for name, value in settings.items() if value), further
    return settings, further


@dataclass(frozen=True)
class Movie:
    """One movie and where its results go."""

    name: str
    row: Row


@dataclass(frozen=True)
class Plan:
    """The movies of a batch, their configurations and the names of their results."""

    table: Table
    config: Config
    flats: tuple[Movie, ...]
    calibrants: tuple[Movie, ...]
    movies: tuple[Movie, ...]
    standards: Standards


def make_plan(table: Table, config: Config, standards: Standards = ()) -> Plan:
    """Plan a batch."""
    for row in table.rows:
        try:
            configured(config, {}, row)
        except ConfigError as error:
            raise ConfigError(f"{table.source}: {row.where}: {error}") from None
    movies = sorted(
        (Movie(name, row) for name, row in zip(_result_names(table), table.rows, strict=True)),
        key=lambda movie: movie.name,
    )
    calibrants = tuple(m for m in movies if m.row.role == "calibrant")
    if standards and not calibrants:
        raise ConfigError(
            f"{table.source}: standards are given, but no movie has the role calibrant; give the "
            "movie of the standards that role"
        )
    known = dict(standard for movie in calibrants for standard in movie.row.standards)
    return Plan(
        table=table,
        config=config,
        flats=tuple(m for m in movies if m.row.role == "flat"),
        calibrants=calibrants,
        movies=tuple(m for m in movies if m.row.role != "flat"),
        standards=tuple(sorted({**known, **dict(standards)}.items())),
    )


def configured(config: Config, day: Mapping[str, Any], row: Row) -> Config:
    """Give the configuration of one movie: the day's calibrations, then what its row says."""
    calibrated = configure(config, settings=day) if day else config
    return configure(calibrated, settings=row.settings) if row.settings else calibrated


def part_of(movies: tuple[Movie, ...], only: tuple[int, int] | None) -> tuple[Movie, ...]:
    """Give one of several equal parts of the movies."""
    return movies if only is None else movies[only[0] - 1 :: only[1]]


def _result_names(table: Table) -> list[str]:
    """Name each result after its movie, with as many folders as it takes to tell it from others."""
    files = [split_address(row.path)[0] for row in table.rows]
    stems = [path_beside(row.path, "") for row in table.rows]
    same = Counter(stems)
    ends = [
        f"{stem.name}-{file.suffix[1:]}" if same[stem] > 1 else stem.name
        for stem, file in zip(stems, files, strict=True)
    ]
    folders = [
        len(file.relative_to(table.root).parts) - 1 if file.is_relative_to(table.root) else 0
        for file in files
    ]
    while True:
        names = [
            "/".join([*file.parent.parts[len(file.parent.parts) - n :], end])
            for file, end, n in zip(files, ends, folders, strict=True)
        ]
        many = Counter(names)
        if len(many) == len(names):
            break
        folders = [n + (many[name] > 1) for n, name in zip(folders, names, strict=True)]
    texts = Counter(printable(name) for name in names)
    if twice := [text for text, times in texts.items() if times > 1]:
        raise ConfigError(
            f"{table.source}: two movies would be called {twice[0]}, because bytes of a file name "
            "that are no text are written so; rename one"
        )
    return [printable(name) for name in names]
