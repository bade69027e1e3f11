"""Tables of results, of any program: whose columns they have, in which units, and of which event.

Known are the names of PiSCAT, PhotoMol and Refeyn, Picasso, ThunderSTORM, trackpy and ours.  Units
that do not fit the truth by a plain factor are refused, with the factor: a position in pixels is
never scored as nanometres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from iscat_analysis.errors import DataError
from iscat_analysis.movie import read_frame, refuse_twice
from iscat_analysis.reading import is_folder
from iscat_analysis.records import FloatArray
from iscat_analysis.units import count

_ERRORS = "uncertainty_xy [nm], uncertainty [nm]"

NAMES: Mapping[str, str] = {
    "x_nm": "x_nm, x [nm], x_px*, x [px]*, x_coords*, fit_x-center*, x*",
    "y_nm": "y_nm, y [nm], y_px*, y [px]*, y_coords*, fit_y-center*, y*",
    "z_nm": "z_nm, z [nm]",
    "mass_kda": "mass_kda, masses_kda, calibrated_values",
    "amplitude": "amplitude, contrast, contrasts, fit_amplitude, center_int, center_intensity, "
    "photons, intensity [photon], signal, mass",
    "sigma_x_nm": f"sigma_x_nm, {_ERRORS}, lpx*, fit_errors_x-center*, ep*",
    "sigma_y_nm": f"sigma_y_nm, {_ERRORS}, lpy*, fit_errors_y-center*, ep*",
    "sigma_z_nm": "sigma_z_nm, uncertainty_z [nm]",
    "sigma_mass_kda": "sigma_mass_kda",
    "frame": "frame, frame_indices, frames, frame number",
    "score": "snr, score, net_gradient",
}
"""What each column is called, in pixels with a star; the first that is there is taken."""

FILES = ("file", "stack", "movie", "path", "filename", "image")
EVENTS = ("event", "id", "index", "stack", "region")

THUNDERSTORM = "x [nm]"
"""This program counts positions from the corner of the first pixel, and frames from 1."""

NEAR_NM = 250.0
NEAR_FRAMES = 10
"""How far a result lies from the event that it is of, at most."""

_FIT = 0.15  # of a median ratio to a factor

_ADVICE = {
    "pixels": ", or call them x_px and y_px",
    "nm, though called pixels": ", or call them x_nm and y_nm",
}


def _lengths(pixel_nm: float) -> dict[str, float]:
    """Name units that positions may be in, and what they are times to be nanometres."""
    return {"pixels": pixel_nm, "nm, though called pixels": 1 / pixel_nm, "µm": 1000.0}


@dataclass(frozen=True, eq=False)
class Results:
    """One table of results, in nm, kDa and zero-based frames; `notes` say what was assumed."""

    name: str
    table: pd.DataFrame
    notes: tuple[str, ...] = field(default=())


def read_results(path: Path, pixel_nm: float, *, rows: bool = False) -> Results:
    """Read a table of results: a CSV, or a folder of this program.

    With `rows`, what a row is of may be said by its place in the table.
    """
    source = path / "fits.csv" if is_folder(path) else path
    raw = _read(source)
    names = {str(name).strip().strip('"').lower(): name for name in raw.columns}
    known: dict[str, pd.Series] = {}
    notes = []
    for column, choices in NAMES.items():
        found = next((c for c in choices.split(", ") if c.rstrip("*") in names), None)
        if found is None:
            continue
        name, in_pixels = found.rstrip("*"), found.endswith("*")
        values = pd.to_numeric(raw[names[name]], errors="coerce")
        known[column] = values * pixel_nm if in_pixels else values
        if name != column:
            notes.append(f"{name} → {column}" + (" × pixel size" if in_pixels else ""))
    if THUNDERSTORM in names:
        for axis in ("x_nm", "y_nm"):
            known[axis] = known[axis] - pixel_nm / 2
        if "frame" in known:
            known["frame"] = known["frame"] - 1
        notes.append("positions from the corner of the first pixel, frames from 1 (ThunderSTORM)")
    table = pd.DataFrame(known, index=raw.index)
    if not {"x_nm", "y_nm", "z_nm", "mass_kda", "amplitude"} & set(table):
        raise DataError(
            f"{source}: has none of the columns x_nm, y_nm, z_nm, mass_kda or their names in other "
            f"programs; its first line names {', '.join(map(str, raw.columns[:8]))}"
        )
    file = next((names[n] for n in FILES if n in names and _is_text(raw[names[n]])), None)
    if file is not None:
        table["file"] = raw[file].map(lambda name: stem(str(name)))
    event = next((names[n] for n in EVENTS if n in names and not _is_text(raw[names[n]])), None)
    if event is not None:
        table["event"] = pd.to_numeric(raw[event], errors="coerce")
    if not rows and not {"file", "event", "frame"} & set(table):
        raise DataError(
            f"{source}: has neither a column that says of which stack a row is (file, or event) "
            "nor a frame, so that its rows belong to nothing; add one"
        )
    if "status" in names and "flags" in names:  # of this program, which says what it rejects
        lost = raw[names["status"]].astype(str).isin(["not_converged", "at_bound", "ambiguous_z"])
        if lost.any():
            notes.append(f"{count(int(lost.sum()), 'row')} without a usable estimate left out")
        table = table[~lost]
    return Results(stem(path.name), table.reset_index(drop=True), tuple(notes))


def match_stacks(results: Results, events: pd.DataFrame, pixel_nm: float) -> pd.DataFrame:
    """Put results into the rows of the events of stacks, by file or number."""
    table = results.table
    stems = events["file"].map(stem)
    if "file" in table:
        rows, key = table["file"], stems
    elif "event" in table:
        rows, key = table["event"], events["event"]
    else:
        raise DataError(
            f"{results.name}: has frames and no file or event, and stacks hold one particle each; "
            "add a column file"
        )
    ours = table[rows.isin(set(key))]
    twice = rows[ours.index][rows[ours.index].duplicated()]
    if len(twice):
        raise DataError(
            f"{results.name}: has {twice.iloc[0]} twice, and each stack holds one particle; keep "
            "one row of each"
        )
    placed = ours.set_index(rows[ours.index]).reindex(key).reset_index(drop=True)
    refuse_other_units(results.name, placed, events, pixel_nm)
    return placed


def match_movie(
    results: Results, events: pd.DataFrame, movie: str, movies: int, pixel_nm: float
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Put results into the rows of a movie's events; the rest of them are false alarms."""
    table = results.table
    if "file" in table:
        table = table[table["file"] == stem(movie)]
    elif results.name != stem(movie) and movies > 1:
        table = table.iloc[:0]
    if len(table) and "frame" not in table:
        raise DataError(
            f"{results.name}: has no column frame, so that nobody knows when its particles of "
            f"{movie} landed; add it"
        )
    if not len(table) or not {"x_nm", "y_nm"} <= set(table):
        return table.iloc[:0].reindex(range(len(events))), table.iloc[:0]
    same = table.duplicated(["frame", "x_nm", "y_nm"])
    if same.any():
        row = int(table.index[same.to_numpy()][0])
        raise DataError(
            f"{results.name}: row {row} repeats an event of {movie} that is there already; keep "
            "one row of each"
        )
    table = table.reset_index(drop=True)
    pairs = _assigned(table, events)
    for unit, factor in _lengths(pixel_nm).items():
        scaled = table.assign(x_nm=table["x_nm"] * factor, y_nm=table["y_nm"] * factor)
        better = len(_assigned(scaled, events))
        if better >= 3 and better > 2 * len(pairs):
            raise DataError(_other_unit(results.name, "positions", unit, factor))
    matched = [row for row, _ in pairs]
    placed = table.loc[matched].set_axis([event for _, event in pairs])
    placed = placed.reindex(range(len(events)))
    refuse_other_units(results.name, placed, events, pixel_nm)
    rest = table.drop(index=matched)
    return placed, rest[~_leavings(rest, events)]


def _leavings(table: pd.DataFrame, events: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell which results are of particles that leave: true, and no landings that are scored."""
    left = events[events["leave"].notna()] if "leave" in events else events.iloc[:0]
    apart, late = _apart(table, left.assign(frame=left.get("leave", left["frame"])))
    return np.asarray(np.any((apart <= 1) & (late <= 1), axis=1))


def _assigned(table: pd.DataFrame, events: pd.DataFrame) -> list[tuple[int, int]]:
    """Pair results and events, the nearest first, none farther than `NEAR_NM`, `NEAR_FRAMES`."""
    apart, late = _apart(table, events)
    far = ~((apart <= 1) & (late <= 1))
    rows, columns = linear_sum_assignment(np.where(far, 1e6, apart + late))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if not far[r, c]]


def _apart(table: pd.DataFrame, events: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Distances of results and events in place and time, over `NEAR_NM` and `NEAR_FRAMES`."""
    x, y, t = (
        np.subtract.outer(table[name].to_numpy(float), events[name].to_numpy(float))
        for name in ("x_nm", "y_nm", "frame")
    )
    return np.hypot(x, y) / NEAR_NM, np.abs(t) / NEAR_FRAMES


def refuse_other_units(
    name: str, placed: pd.DataFrame, events: pd.DataFrame, pixel_nm: float
) -> None:
    """Refuse values that are the truth times a factor of units."""
    lengths = _lengths(pixel_nm)
    for column, what, factors in (
        ("x_nm", "positions", lengths),
        ("y_nm", "positions", lengths),
        ("mass_kda", "masses", {"Da": 0.001, "MDa": 1000.0}),
    ):
        if column not in placed or column not in events:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = placed[column].abs().to_numpy(float) / events[column].to_numpy(float)
        known = ratios[np.isfinite(ratios) & (ratios > 0)]
        ratio = float(np.median(known)) if known.size else 1.0
        for unit, factor in factors.items():
            if abs(ratio * factor - 1) < _FIT and abs(ratio - 1) > _FIT:
                raise DataError(_other_unit(name, what, unit, factor))


def _other_unit(name: str, what: str, unit: str, factor: float) -> str:
    return (
        f"{name}: its {what} are in {unit}: times {factor:.4g} they fit the truth; convert them"
        f"{_ADVICE.get(unit, '')}"
    )


def _read(path: Path) -> pd.DataFrame:
    table = read_frame(path)
    if table.empty:
        raise DataError(f"{path}: has no rows; a table needs a line of names and its rows")
    known = {name.rstrip("*") for names in NAMES.values() for name in names.split(", ")}
    refuse_twice([str(name).lower() for name in table.columns], known, path)
    return table


def _is_text(column: pd.Series) -> bool:
    return not pd.api.types.is_numeric_dtype(column)


def stem(name: str) -> str:
    """Name a file without its folder and what follows the dot."""
    return name.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1].partition(".")[0]
