"""Tracks in the layouts of other programs: a table for trackpy, an array for napari."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import FloatArray, Status, track_numbers
from iscat_analysis.report.tables import CSV_DIGITS

Layout = Literal["trackpy", "napari"]

SUFFIXES = {"trackpy": ".csv", "napari": ".npy"}
"""Files that `export_tracks` writes."""


def to_trackpy(fits: pd.DataFrame) -> pd.DataFrame:
    """Put the fits of mode ``track`` into the layout that trackpy links and analyses.

    Parameters
    ----------
    fits : pandas.DataFrame
        One row per particle and frame: `Result.table`, or ``fits.csv``.

    Returns
    -------
    pandas.DataFrame
        Columns ``y, x`` [px], ``frame``, ``particle`` (the track), ``mass`` [kDa; trackpy calls the
        brightness so], ``signal`` (magnitude of the contrast), ``ep`` (standard error of a place
        along one axis [px]), ``z`` [nm], by particle and frame.  ``trackpy.imsd(table, mpp, fps)``
        takes it as it is, with mpp the side of a pixel in µm.
    """
    rows = _tracked(fits)
    pixel = (rows["x_nm"] / rows["x_px"]).median() if len(rows) else 1.0
    error = np.sqrt((rows["sigma_x_nm"] ** 2 + rows["sigma_y_nm"] ** 2) / 2) / pixel
    return pd.DataFrame(
        {
            "y": rows["y_px"], "x": rows["x_px"], "frame": rows["frame"].astype("int64"),
            "particle": rows["particle"], "mass": rows["mass_kda"],
            "signal": rows["contrast"].abs(), "ep": error, "z": rows["z_nm"],
        }
    ).reset_index(drop=True)  # fmt: skip


def to_napari(fits: pd.DataFrame) -> FloatArray:
    """Put the fits of mode ``track`` into the array of a napari tracks layer.

    Parameters
    ----------
    fits : pandas.DataFrame
        One row per particle and frame: `Result.table`, or ``fits.csv``.

    Returns
    -------
    ndarray, shape (n, 4)
        Track, frame, y and x [px], sorted by track and frame, each frame of a track once:
        ``viewer.add_tracks(…)`` over the movie takes it as it is.
    """
    rows = tracked_rows(fits)
    return np.ascontiguousarray(rows[["particle", "frame", "y_px", "x_px"]].to_numpy(float))


def tracked_rows(fits: pd.DataFrame) -> pd.DataFrame:
    """Give the rows that are the places of `to_napari`, with all of their columns.

    Parameters
    ----------
    fits : pandas.DataFrame
        One row per particle and frame: `Result.table`, or ``fits.csv``.

    Returns
    -------
    pandas.DataFrame
        Those that belong to a track and have a place, sorted by track and frame, each frame of a
        track once; a column ``particle`` is the track.
    """
    return _tracked(fits).drop_duplicates(["particle", "frame"])


def _tracked(fits: pd.DataFrame) -> pd.DataFrame:
    """Rows that belong to a track and have a place, by track and frame."""
    numbers = track_numbers(fits)
    known = numbers.notna() & fits["x_px"].notna() & (fits["status"] != Status.SIDELOBE)
    rows = fits[known].assign(particle=numbers[known].astype("int64"))
    return rows.sort_values(["particle", "frame"], kind="stable")


def export_tracks(
    folder: Path, layout: Layout, *, out: Path | None = None, overwrite: bool = False
) -> tuple[Path, int]:
    """Write the tracks of an output folder as another program reads them.

    Parameters
    ----------
    folder : Path
        Output of mode ``track``.
    layout : str
        ``"trackpy"``: a CSV table; ``"napari"``: an array in NumPy's format.
    out : Path, optional
        The file; default ``tracks_trackpy.csv`` or ``tracks_napari.npy`` beside the folder, after
        its name.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    path : Path
        The file.
    tracks : int
        How many tracks are in it.

    Raises
    ------
    ConfigError
        There is no such layout.
    DataError
        The folder holds no tracks, or the file exists or cannot be written.
    """
    if layout not in get_args(Layout):
        raise ConfigError(f"layout = {layout!r}: choose one of {', '.join(get_args(Layout))}")
    path = folder.with_name(f"{folder.stem}.{layout}{SUFFIXES[layout]}") if out is None else out
    if not (folder / "tracks.csv").exists():
        raise DataError(f'{folder}: holds no tracks.csv, which fit.mode = "track" writes')
    if path.exists() and not overwrite:
        raise DataError(f"{path}: exists already; give another name, or pass `overwrite`")
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        fits = pd.read_csv(folder / "fits.csv", keep_default_na=False, na_values=[""])
        path.parent.mkdir(parents=True, exist_ok=True)
        if layout == "trackpy":
            table = to_trackpy(fits)
            table.to_csv(partial, index=False, float_format=f"%.{CSV_DIGITS}g")
            tracks = table["particle"].nunique()
        else:
            array = to_napari(fits)
            with partial.open("wb") as file:
                np.save(file, array)
            tracks = np.unique(array[:, 0]).size
        partial.replace(path)
    except OSError as error:
        named = path if error.filename is None else error.filename
        raise DataError(f"{named}: cannot be read or written ({error.strerror})") from None
    except (KeyError, ValueError) as error:  # a table that is none of ours
        raise DataError(f"{folder / 'fits.csv'}: is not a table of fits ({error})") from None
    finally:
        partial.unlink(missing_ok=True)
    return path, int(tracks)
