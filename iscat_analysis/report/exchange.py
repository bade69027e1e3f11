"""Events and tracks in the layouts of other programs: trackpy, napari, PhotoMol, Picasso."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
import pandas as pd

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.files import whole_file
from iscat_analysis.inference.checks import truth_in
from iscat_analysis.movie import refuse_twice
from iscat_analysis.reading import first_line, is_file, open_regular, summary_in
from iscat_analysis.records import (
    EVENT_COLUMNS,
    MODEL_SCALE,
    FloatArray,
    Status,
    is_event,
    track_numbers,
)
from iscat_analysis.report.tables import write_csv
from iscat_analysis.units import count

Layout = Literal["trackpy", "napari", "photomol", "picasso"]

SUFFIXES = {"trackpy": ".csv", "napari": ".npy", "photomol": ".csv", "picasso": ".hdf5"}
"""Files that `export_result` writes; Picasso's has a second one, ``.yaml``, beside it."""


@dataclass(frozen=True)
class Exported:
    """What was written for another program."""

    path: Path
    text: str
    notes: tuple[str, ...] = ()


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
    return _trackpy(_tracked(fits))


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
    return _napari(_tracked(fits))


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


def to_photomol(fits: pd.DataFrame, *, masses: bool = True) -> pd.DataFrame:
    """Put landings and leavings into the layout of Refeyn's event tables, which PhotoMol reads.

    Parameters
    ----------
    fits : pandas.DataFrame
        One row per event: `Result.table`, or ``fits.csv``.
    masses : bool
        Whether the masses are masses; without calibration they are not, and PhotoMol can calibrate
        the contrasts.

    Returns
    -------
    pandas.DataFrame
        Events whose status is ok: ``frame_indices``, ``x_coords, y_coords`` [px], ``contrasts`` and
        ``masses_kDa``, negative for a particle that leaves; and ``sigma_mass_kda`` [kDa] and
        ``snr``, which those programs do not know and ``iscat species`` reads.
    """
    return _photomol(_events(fits), truth_in("`masses`", masses))


def _photomol(rows: pd.DataFrame, masses: bool) -> pd.DataFrame:
    names = {"frame": "frame_indices", "x_px": "x_coords", "y_px": "y_coords"}
    names["contrast"] = "contrasts"
    if masses:
        names |= {"mass_kda": "masses_kDa", "sigma_mass_kda": "sigma_mass_kda"}
    table = _renamed(rows, {**names, "snr": "snr"})
    return table.astype({"frame_indices": "int64"})


def to_picasso(fits: pd.DataFrame, *, tracked: bool = False) -> pd.DataFrame:
    """Put events, or the fits of mode ``track``, into the layout of Picasso's localisations.

    Parameters
    ----------
    fits : pandas.DataFrame
        One row per event, or per particle and frame: `Result.table`, or ``fits.csv``.
    tracked : bool
        Whether it is of mode ``track``.

    Returns
    -------
    pandas.DataFrame
        ``frame, x, y`` [px], ``photons`` (scattered photons that were collected), ``lpx, lpy``
        (standard errors of x and y [px]); where the height was fitted ``z, lpz`` [nm]; of tracks
        ``group``, the track.  Then what Picasso does not know: ``contrast, snr``, and where it was
        fitted ``mass_kda, sigma_mass_kda``.  ``sx, sy, bg, ellipticity, net_gradient`` have no
        counterpart: a picture with rings has no width of a Gaussian, and its background is divided
        out.  Events are those whose status is ok.
    """
    return _picasso((_tracked if truth_in("`tracked`", tracked) else _events)(fits))


def _picasso(rows: pd.DataFrame) -> pd.DataFrame:
    rows = rows[rows[["sigma_x_nm", "sigma_y_nm"]].notna().all(axis=1)]
    pixel = _pixel_nm(rows)
    rows = rows.assign(lpx=rows["sigma_x_nm"] / pixel, lpy=rows["sigma_y_nm"] / pixel)
    names = {"frame": "frame", "x_px": "x", "y_px": "y", "n_scattered": "photons"}
    names |= {"lpx": "lpx", "lpy": "lpy"}
    if rows["sigma_z_nm"].notna().any():
        names |= {"z_nm": "z", "sigma_z_nm": "lpz"}
    if "particle" in rows:
        names["particle"] = "group"
    names |= {"contrast": "contrast", "snr": "snr"}
    if rows["sigma_mass_kda"].notna().any():
        names |= {"mass_kda": "mass_kda", "sigma_mass_kda": "sigma_mass_kda"}
    whole = {"frame": np.uint32, "group": np.int32}
    return _renamed(rows, names).astype({n: whole.get(n, np.float32) for n in names.values()})


def export_result(
    folder: Path, layout: Layout, *, out: Path | None = None, overwrite: bool = False
) -> Exported:
    """Write the events or tracks of an output folder as another program reads them."""
    if layout not in get_args(Layout):
        raise ConfigError(f"layout = {layout!r}: choose one of {', '.join(get_args(Layout))}")
    path = folder.with_name(f"{folder.stem}.{layout}{SUFFIXES[layout]}") if out is None else out
    if not is_file(folder / "fits.csv"):
        raise DataError(f"{folder}: holds no fits.csv; give an output folder of iscat fit")
    yaml_path = path.with_suffix(".yaml")
    of_picasso = layout == "picasso"
    for taken in (path, yaml_path) if of_picasso else (path,):
        if taken.exists() and not overwrite:
            raise DataError(f"{taken}: exists already; give another name, or pass `overwrite`")
    if of_picasso and path == yaml_path:
        raise DataError(f"{path}: is the name of Picasso's metadata; let `out` end in .hdf5")
    chosen, noun = (_tracked, "track") if is_file(folder / "tracks.csv") else (_events, "event")
    if noun == "track" and layout == "photomol":
        raise DataError(
            f"{folder}: holds tracks, and PhotoMol reads landings and leavings; tracks.csv has the "
            "mass of every track"
        )
    try:
        with open_regular(folder / "fits.csv") as source:
            fits = pd.read_csv(source, keep_default_na=False, na_values=[""])
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = chosen(fits)
        if of_picasso:
            locs, info = _picasso(rows), _metadata(folder, fits)
            with whole_file(yaml_path) as partial_yaml, whole_file(path) as partial:
                lines = [f"{key}: {json.dumps(value)}\n" for key, value in info.items()]
                partial_yaml.write_text("".join(lines), encoding="utf-8")  # of which JSON is a part
                with h5py.File(partial, "w") as file:
                    file.create_dataset("locs", data=locs.to_records(index=False))
                    file.create_dataset("metadata", data=json.dumps([info]))
        elif layout == "napari":
            with whole_file(path) as partial, partial.open("wb") as array:
                np.save(array, _napari(rows))
        else:
            is_trackpy = layout == "trackpy"
            table = _trackpy(rows) if is_trackpy else _photomol(rows, _calibrated(folder))
            with whole_file(path) as partial:
                write_csv(table, partial)
    except OSError as error:
        named = path if error.filename is None else error.filename
        raise DataError(f"{named}: cannot be read or written ({error.strerror})") from None
    except (KeyError, ValueError) as error:  # a table that is none of ours
        raise DataError(f"{folder / 'fits.csv'}: is not a table of fits ({error})") from None
    if noun == "track":
        return Exported(path, count(int(rows["particle"].nunique()), noun))
    notes = []
    if left := len(fits) - len(rows):
        notes.append(f"{count(left, 'event')} whose status is not ok, or without a place, left out")
    if layout == "photomol" and not _calibrated(folder):
        fixed = summary_in(folder).get("mode") == "localize"
        why = "mode localize fits no mass" if fixed else "without [calibration] there are no masses"
        notes.append(f"contrasts alone, for {why}")
    return Exported(path, count(len(rows), noun), tuple(notes))


def _metadata(folder: Path, fits: pd.DataFrame) -> dict[str, Any]:
    """Metadata of the movie that Picasso needs."""
    shape = summary_in(folder).get("input", {}).get("shape")
    if not shape:
        raise DataError(
            f"{folder / 'summary.json'}: does not say how large the movie is, as newer results do; "
            "analyse it again"
        )
    frames, rows, columns = shape
    return {
        "Generated by": f"iscat-analysis {version('iscat-analysis')}",
        "Width": columns,
        "Height": rows,
        "Frames": frames,
        "Pixelsize": round(_pixel_nm(fits), 6),
    }


def _calibrated(folder: Path) -> bool:
    """Whether masses are calibrated; true for a table of unknown origin."""
    summary = summary_in(folder)
    return summary.get("mode") != "localize" and summary.get("mass_scale") != MODEL_SCALE


def _napari(rows: pd.DataFrame) -> FloatArray:
    """Give places, each frame of a track once if they are linked."""
    names = ["frame", "y_px", "x_px"]
    if "particle" in rows:
        names, rows = ["particle", *names], rows.drop_duplicates(["particle", "frame"])
    return np.ascontiguousarray(rows[names], dtype=np.float64)


def _trackpy(rows: pd.DataFrame) -> pd.DataFrame:
    """Give positions in trackpy's columns; ``particle`` where they are linked."""
    error = np.sqrt((rows["sigma_x_nm"] ** 2 + rows["sigma_y_nm"] ** 2) / 2) / _pixel_nm(rows)
    linked = {"particle": "particle"} if "particle" in rows else {}
    names = {"y_px": "y", "x_px": "x", "frame": "frame", **linked, "mass_kda": "mass"}
    names |= {"signal": "signal", "ep": "ep", "z_nm": "z"}
    table = _renamed(rows.assign(signal=rows["contrast"].abs(), ep=error), names)
    return table.astype({"frame": "int64"})


def _renamed(rows: pd.DataFrame, names: Mapping[str, str]) -> pd.DataFrame:
    """Give these columns, under other names and numbered from 0."""
    return rows[list(names)].rename(columns=dict(names)).reset_index(drop=True)


def _pixel_nm(rows: pd.DataFrame) -> float:
    """Give the side of a pixel [nm]."""
    known = rows[rows["x_px"] != 0]
    return float((known["x_nm"] / known["x_px"]).median()) if len(known) else 1.0


def _events(fits: pd.DataFrame) -> pd.DataFrame:
    """Give the events that are fit to be used, by frame."""
    fits = _checked(fits)
    good = (fits["status"] == Status.OK) & fits["x_px"].notna() & fits["contrast"].notna()
    return _with_frames(fits[good]).sort_values("frame", kind="stable")


def _checked(fits: pd.DataFrame) -> pd.DataFrame:
    """Refuse what is not a table of fits, and convert its columns to numbers."""
    if not isinstance(fits, pd.DataFrame):
        raise DataError(f"`fits`: is {type(fits).__name__}; give `Result.table`")
    missing = [name for name in EVENT_COLUMNS if name not in fits]
    if missing:
        raise DataError(
            f"`fits`: has no column {', '.join(missing[:3])}; give `Result.table`, or fits.csv "
            "with all of its columns"
        )
    names = [*(name for name in EVENT_COLUMNS if name not in ("status", "flags")), "track"]
    refuse_twice(list(fits.columns), [*names, "status", "particle"], "`fits`")
    checked = fits.copy() if fits.index.is_unique else fits.reset_index(drop=True)
    checked["status"] = checked["status"].astype(str)
    for name in set(names) & set(fits.columns):
        try:
            values = fits[name].to_numpy(dtype=np.float64, na_value=np.nan)
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(
                f"`fits`: holds in {name} what is no number ({first_line(error)}); give "
                "`Result.table`"
            ) from None
        whole = (values >= 0) & (values < 2**32) & (values == np.floor(values))
        if name in ("frame", "track", "event") and not (whole | np.isnan(values)).all():
            raise DataError(
                f"`fits`: holds {values[~whole][0]:g} in {name}, which counts from 0; give "
                "`Result.table`"
            )
        if fits[name].dtype.kind not in "iuf":
            checked[name] = values
    return checked


def _with_frames(rows: pd.DataFrame) -> pd.DataFrame:
    """Refuse rows without a frame, as those of regions that are in no movie."""
    if rows["frame"].isna().any():
        raise DataError(
            "`fits`: has rows without a frame, which the other program needs; number them in the "
            "column frame"
        )
    return rows


def _tracked(fits: pd.DataFrame) -> pd.DataFrame:
    """Rows that belong to a track and have a place, by track and frame."""
    fits = _checked(fits)
    numbers = track_numbers(fits)
    known = numbers.notna() & fits["x_px"].notna() & is_event(fits)
    rows = _with_frames(fits[known]).assign(particle=numbers[known].astype("int64"))
    return rows.sort_values(["particle", "frame"], kind="stable")
