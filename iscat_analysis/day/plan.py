"""Names of results and configurations of movies, made from the table of a batch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from iscat_analysis.config import Config, configure
from iscat_analysis.day.table import Row, Table
from iscat_analysis.errors import ConfigError
from iscat_analysis.movie.addresses import path_beside, split_address
from iscat_analysis.text import printable


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
    standards: tuple[tuple[float, float], ...]


def make_plan(
    table: Table, config: Config, standards: tuple[tuple[float, float], ...] = ()
) -> Plan:
    """Plan a batch."""
    for row in table.rows:
        try:
            configured(config, {}, row)
        except ConfigError as error:
            raise ConfigError(f"{table.source}: {row.where}: {error}") from None
    movies = sorted(
        (Movie(name, row) for name, row in zip(_names(table), table.rows, strict=True)),
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


def _names(table: Table) -> list[str]:
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
