"""A stored result, and the images of its events, made again from the movie."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from iscat_analysis.config import Config, load_config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import path_in
from iscat_analysis.movie import Stack, open_stack, split_address
from iscat_analysis.pipeline.kinds import Redraw, kind_of
from iscat_analysis.reading import read_json, read_parquet
from iscat_analysis.records import EventView, tally
from iscat_analysis.report.answer import answer_in
from iscat_analysis.report.figures import draw_view, event_facts


def open_result(folder: str | Path, *, movie: str | Path | None = None) -> StoredResult:
    """Open the output folder of `fit_movie` or ``iscat fit``.

    Parameters
    ----------
    folder : str or Path
        The folder.
    movie : str or Path, optional
        The movie that was analysed, for the images of its events; default where the folder says,
        or beside the folder.

    Returns
    -------
    StoredResult
        Its tables and configuration; it opens the movie when images are asked for.

    Raises
    ------
    DataError
        The folder holds no result.
    ConfigError
        Its configuration is not one of this version.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> with ia.open_result("movie.iscat") as result:  # doctest: +SKIP
    ...     figure = result.view(0)
    """
    return StoredResult(
        path_in("`folder`", folder), None if movie is None else path_in("`movie`", movie)
    )


class StoredResult:
    """A result that was written before; `open_result` makes it.

    Parameters
    ----------
    folder : Path
        The output folder.
    movie : Path, optional
        The movie that was analysed.

    Attributes
    ----------
    folder : Path
        The output folder.
    table : pandas.DataFrame
        ``fits.csv``.
    tracks : pandas.DataFrame or None
        ``tracks.csv``, in mode ``track``.
    summary : mapping
        ``summary.json``.
    config : Config
        ``config.toml``, the resolved configuration.

    Raises
    ------
    DataError
        The folder holds no result.
    """

    def __init__(self, folder: Path, movie: Path | None = None) -> None:
        self.folder = folder
        self._movie = movie
        try:
            self.table: pd.DataFrame = read_parquet(folder / "fits.parquet")
            self.summary: Mapping[str, Any] = read_json(folder / "summary.json")
            tracks = folder / "tracks.parquet"
            self.tracks: pd.DataFrame | None = read_parquet(tracks) if tracks.is_file() else None
        except FileNotFoundError as error:
            missing = Path(error.filename).name if error.filename else "such file"
            raise DataError(
                f"{folder}: is no result of iscat fit (there is no {missing} in it)"
            ) from None
        except (OSError, ValueError) as error:
            raise DataError(f"{folder}: cannot be read as a result ({error})") from None
        self.config: Config = load_config(folder / "config.toml")

    def __repr__(self) -> str:
        said = [tally(self.table).text(), answer_in(self.folder)]
        if self.tracks is not None:
            said[0] = tally(self.tracks).text("track")
        text = "; ".join(filter(None, said))
        return f"<StoredResult {self.folder.name}, mode {self.mode}: {text}>"

    def __enter__(self) -> StoredResult:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.table)

    @property
    def mode(self) -> str:
        """What was free: ``"mass"``, ``"localize"``, ``"joint"`` or ``"track"``."""
        return str(self.summary["mode"])

    @property
    def movie_path(self) -> Path:
        """The movie: as it was given, where the result says, or beside the folder.

        Raises
        ------
        DataError
            It is at none of these places.
        """
        recorded = Path(self.summary["input"]["path"])
        given = [] if self._movie is None else [self._movie]
        for path in given or [recorded, self.folder.parent / recorded.name]:
            if split_address(path)[0].exists():
                return path
        raise DataError(
            f"{self.folder}: its movie is neither {given[0] if given else recorded} nor beside it; "
            "give the place of the movie"
        )

    @cached_property
    def _opened(self) -> tuple[Stack, Redraw]:
        movie = open_stack(self.movie_path)
        try:
            expected = self.summary["input"]["sha256"]
            if movie.sha256() != expected:
                raise DataError(
                    f"{movie.path}: is not the movie of {self.folder.name} (its SHA-256 differs "
                    f"from {expected[:12]}…); give the one that was analysed"
                )
            ready = calibrated(movie, self.config).over_all_stretches()
            return movie, kind_of(ready.config).stored(ready, self)
        except BaseException:
            movie.close()
            raise

    def images(self, row: int) -> EventView:
        """Give the images of a row of the table, made of the movie as they were for its fit.

        Parameters
        ----------
        row : int
            Position in the table; of a result without tracks that is the event's number.

        Returns
        -------
        EventView
            `contrast`, `model` and `residual`, each of shape (y, x).

        Raises
        ------
        DataError
            The movie is not there, or is another one; or the row has no place.
        ConfigError
            There is no such row.
        """
        if not 0 <= row < len(self):
            rows = f"rows 0 to {len(self) - 1}" if len(self) else "none, nothing was found"
            raise ConfigError(f"row = {row}: {self.folder.name} has {rows}")
        if not self.table[["x_px", "y_px", "mass_kda"]].iloc[row].notna().all():
            raise DataError(f"{self.folder.name}: row {row} has no place, so there is no image")
        return self._opened[1](row)

    def view(self, row: int) -> Figure:
        """Draw data, model and residual of a row of the table.

        Parameters
        ----------
        row : int
            As for `images`.

        Returns
        -------
        matplotlib.figure.Figure
            Three panels, and of a landing movie the contrast against frame below.

        Raises
        ------
        DataError, ConfigError
            As for `images`.
        """
        pixel_nm = float(self.config.camera.pixel_size_nm or 0.0)
        return draw_view(self.images(row), self.config.optics.scheme, pixel_nm)

    def facts(self, row: int) -> list[tuple[str, str]]:
        """Say in words what was found of a row of the table.

        Parameters
        ----------
        row : int
            As for `images`.

        Returns
        -------
        list of (str, str)
            What is told, and its value with error, bound and unit.
        """
        return event_facts(self.table.iloc[row])

    def close(self) -> None:
        """Release the movie, where it was opened; it is opened again when it is needed."""
        opened = self.__dict__.pop("_opened", None)
        if opened is not None:
            opened[0].close()
