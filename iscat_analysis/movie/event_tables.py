"""Event tables of other programs: Refeyn's, which PhotoMol reads too, and Picasso's.

Of Refeyn's, what their fits found, and the calibration they used.

A calibration is odd-symmetric: contrast c and mass m obey c = s·m + sign(m)·o, so that a particle
that leaves weighs what it weighed when it landed; m = sign(−c)·(−|c| − o)/s.  A plain line through
both branches is wrong by 2|o/s| on one of them.
"""

from __future__ import annotations

import csv
import math
import os
from array import array
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from iscat_analysis.errors import DataError
from iscat_analysis.movie.mapped import HDF5_SIGNATURE
from iscat_analysis.movie.text_tables import decimal_mark, refuse_twice, separator
from iscat_analysis.reading import first_line, is_folder, open_regular
from iscat_analysis.records import FloatArray

if TYPE_CHECKING:
    from iscat_analysis.movie.hdf5 import Hdf5Reader, StoredArray

TABLE_COLUMNS = ("frame", "x_px", "y_px", "contrast", "mass_kda")
"""The columns of `read_events`, in order."""

FURTHER_COLUMNS = ("sigma_mass_kda", "snr")
"""Columns after them, of tables that ``iscat export`` wrote."""

_NAMES: Mapping[str, tuple[str, ...]] = {
    "frame": ("frame_indices",),
    "x_px": ("x_coords",),
    "y_px": ("y_coords",),
    "contrast": ("contrasts",),
    "mass_kda": ("masses_kDa", "calibrated_values"),
    "sigma_mass_kda": ("sigma_mass_kda",),
    "snr": ("snr",),
}
"""What each column is called in the files, newest last."""

_LOCS: Mapping[str, str] = {
    "frame": "frame", "x_px": "x", "y_px": "y", "contrast": "contrast", "mass_kda": "mass_kda",
    "sigma_mass_kda": "sigma_mass_kda", "snr": "snr",
}  # fmt: skip
"""The same in Picasso's ``locs``; its own program knows the first three."""

_CALIBRATIONS = (
    ("mass_model/c_1kDa", "mass_model/o_0kDa", "mass_model/contrasts", "mass_model/masses"),
    (
        "calibration/gradient",
        "calibration/offset",
        "calibration/contrasts",
        "calibration/calibrated_values",
    ),
)
_GROUPS = ("", "analysis/events/events_fitted/")  # tables of their own, and inside .mpr movies
_MOVIES = "per_movie_events"
_MISSING = 1e300  # the largest double stands for "none"
_LARGEST_CSV = 500_000_000
_LARGEST_FRAME = 2**53


@dataclass(frozen=True)
class StoredCalibration:
    """The calibration that a table carries."""

    gradient_per_kda: float
    offset: float
    standard_masses_kda: tuple[float, ...] = ()
    standard_contrasts: tuple[float, ...] = ()

    def mass_kda(self, contrast: FloatArray) -> FloatArray:
        """Convert contrasts to masses."""
        masses: FloatArray = (
            np.sign(-contrast) * (-np.abs(contrast) - self.offset) / self.gradient_per_kda
        )
        return masses


def read_events(path: Path) -> pd.DataFrame:
    """Read an event table of another program.

    Refeyn's, and tables that PhotoMol reads: HDF5 (``masses_kDa`` with ``mass_model``, or
    ``calibrated_values`` with ``calibration``; also inside ``.mpr`` movies) or CSV
    (``eventsFitted.csv``; ``contrasts`` or ``masses_kDa`` are enough).  Picasso's: HDF5 with
    ``locs``, if these have a column ``mass_kda``, as those of ``iscat export`` do.
    """
    path = Path(path)
    try:
        with open_regular(path) as file:
            signature = file.read(len(HDF5_SIGNATURE))
            size = file.seek(0, os.SEEK_END)
    except OSError as error:
        what = "is a folder" if is_folder(path) else f"cannot be read ({error.strerror})"
        raise DataError(f"{path}: {what}; give the path of one event table") from None
    if signature == HDF5_SIGNATURE:
        columns, calibration = _from_hdf5(path)
    else:
        columns, calibration = _from_csv(path, size), None
    return _table(columns, calibration, path)


def stored_calibration(table: pd.DataFrame) -> StoredCalibration | None:
    """Return the calibration that came with a table."""
    fields = table.attrs.get("calibration")
    if fields is None:
        return None
    return StoredCalibration(
        fields["gradient_per_kda"],
        fields["offset"],
        tuple(fields["standard_masses_kda"]),
        tuple(fields["standard_contrasts"]),
    )


def _table(
    columns: Mapping[str, FloatArray], calibration: StoredCalibration | None, path: Path
) -> pd.DataFrame:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"{_NAMES[name][0]} {length}" for name, length in lengths.items())
        raise DataError(f"{path}: its columns differ in length ({shown}); export it again")
    nothing = np.full(next(iter(lengths.values())), np.nan)
    frame = columns.get("frame", nothing)
    bad = ~((np.abs(frame) < _LARGEST_FRAME) & (frame >= 0) & (frame == np.floor(frame)))
    if bad.any() and "frame" in columns:
        row = int(np.argmax(bad))
        raise DataError(
            f"{path}: frame_indices is {frame[row]:g} in row {row}, which is no frame number; "
            "export the table again"
        )
    cleaned = {
        name: np.where(np.abs(values) < _MISSING, values, np.nan)
        for name, values in columns.items()
    }
    mass = cleaned.get("mass_kda")
    if mass is None or np.isnan(mass).all():
        contrast = cleaned.get("contrast", nothing)
        mass = np.full(contrast.shape, np.nan)
        if calibration is not None:
            mass = calibration.mass_kda(contrast)
    known = {**dict.fromkeys(TABLE_COLUMNS, nothing), **cleaned, "mass_kda": mass}
    if "frame" in columns:
        known["frame"] = frame.astype(np.int64)
    table = pd.DataFrame({name: known[name] for name in _NAMES if name in known})
    table.attrs["calibration"] = None
    if calibration is not None:
        table.attrs["calibration"] = {
            "gradient_per_kda": calibration.gradient_per_kda,
            "offset": calibration.offset,
            "standard_masses_kda": list(calibration.standard_masses_kda),
            "standard_contrasts": list(calibration.standard_contrasts),
        }
    return table


def _from_hdf5(path: Path) -> tuple[dict[str, FloatArray], StoredCalibration | None]:
    from iscat_analysis.movie.hdf5 import Hdf5Reader  # h5py takes long

    with closing(Hdf5Reader(path)) as reader:
        try:
            locs = reader.records("locs")
            if locs is not None:
                return _from_locs(locs, path), None
            group = _group(reader, path)
            columns = {}
            for column, names in _NAMES.items():
                values = [_column(reader, f"{group}{name}", path) for name in names]
                found = next((value for value in values if value is not None), None)
                if found is not None:
                    columns[column] = found
            if "contrast" not in columns:
                raise DataError(f"{path}: contrasts is no column of numbers; export it again")
            return columns, _calibration(reader, group, path)
        finally:
            reader.data.close()


def _from_locs(locs: StoredArray, path: Path) -> dict[str, FloatArray]:
    """Take Picasso's localisations for events, if they have masses."""
    if "mass_kda" not in (locs.dtype.names or ()):
        raise DataError(
            f"{path}: holds localisations of Picasso's, which have photons and no mass; give "
            "fits.csv, or localisations with a column mass_kda, as iscat export writes them"
        )
    if "group" in (locs.dtype.names or ()):
        raise DataError(
            f"{path}: holds localisations in groups, many of one particle, and not events; give "
            "tracks.csv, which has one mass for each track"
        )
    rows = locs.read(0, locs.shape[0])
    return {
        column: rows[name].astype(np.float64)
        for column, name in _LOCS.items()
        if name in (locs.dtype.names or ())
    }


def _group(reader: Hdf5Reader, path: Path) -> str:
    """Where in the file the table lies."""
    movies = reader.names(_MOVIES)
    groups = [*_GROUPS, *(f"{_MOVIES}/{name}/" for name in movies[:2])]
    found = [group for group in groups if "contrasts" in reader.names(group.rstrip("/"))]
    if not found:
        raise DataError(
            f"{path}: is an HDF5 file without an event table (it lacks contrasts); "
            "export the fitted events"
        )
    if found[0].startswith(_MOVIES) and len(movies) > 1:
        raise DataError(
            f"{path}: holds the events of {len(movies)} movies, whose frames cannot be told "
            "apart; export the events of each movie to a file of its own"
        )
    return found[0]


def _column(reader: Hdf5Reader, name: str, path: Path) -> FloatArray | None:
    found = reader.array(name)
    if found is None:
        return None
    long = [n for n in found.shape if n != 1]
    if len(long) > 1:
        raise DataError(
            f"{path}: {name} has the shape {found.shape}, not one value per event; export it again"
        )
    values: FloatArray = found.read(0, found.shape[0]).astype(np.float64).reshape(-1)
    return values


def _calibration(reader: Hdf5Reader, group: str, path: Path) -> StoredCalibration | None:
    for prefix in dict.fromkeys((group, "")):
        for gradient_name, offset_name, *standards in _CALIBRATIONS:
            gradient = reader.number(prefix + gradient_name)
            offset = reader.number(prefix + offset_name)
            if gradient is None or offset is None:
                continue
            if not (math.isfinite(gradient) and math.isfinite(offset)) or gradient == 0:
                raise DataError(
                    f"{path}: its calibration ({gradient_name} = {gradient:g}, {offset_name} = "
                    f"{offset:g}) cannot be used; calibrate again and export the table again"
                )
            known = [_column(reader, prefix + name, path) for name in standards]
            contrasts, masses = (
                () if values is None else tuple(map(float, values)) for values in known
            )
            return StoredCalibration(gradient, offset, masses, contrasts)
    return None


def _from_csv(path: Path, size: int) -> dict[str, FloatArray]:
    """Read columns that commas part, or semicolons or tabs, between which a comma is a point."""
    if size > _LARGEST_CSV:
        raise DataError(f"{path}: is {size} bytes long, which no event table is; check the path")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = (line for line in file if not line.startswith("#"))
            first = next(lines, "")
            between = separator(first)
            rows = csv.reader(lines, delimiter=between)
            header = [name.strip() for name in next(csv.reader([first], delimiter=between), [])]
            places = _places(header, path)
            columns = {column: array("d") for column in places}
            for number, row in enumerate(rows):
                if not any(row):
                    continue
                if len(row) != len(header):
                    raise DataError(
                        f"{path}: row {number} has {len(row)} values where the first line names "
                        f"{len(header)}; the copy was interrupted, or the table was edited: "
                        "export it again"
                    )
                for column, place in places.items():
                    value = row[place].strip()
                    value = value.replace(decimal_mark(between), ".")
                    columns[column].append(float(value) if value else math.nan)
    except UnicodeDecodeError:
        raise DataError(f"{path}: is neither an HDF5 file nor a text file in UTF-8") from None
    except (ValueError, MemoryError, csv.Error) as error:
        raise DataError(
            f"{path}: cannot be read as a table ({first_line(error)}); export it again"
        ) from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    return {column: np.array(values) for column, values in columns.items()}


def _places(header: list[str], path: Path) -> dict[str, int]:
    places = {}
    for column, names in _NAMES.items():
        refuse_twice(header, names, path)
        found = next((name for name in names if name in header), None)
        if found is not None:
            places[column] = header.index(found)
    if not {"contrast", "mass_kda"} & set(places):
        raise DataError(
            f"{path}: lacks the columns contrasts and masses_kDa in its first line, and needs one "
            "of them; it is not a table of fitted events (eventsFitted.csv), export it again"
        )
    return places
