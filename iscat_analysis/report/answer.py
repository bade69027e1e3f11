"""What a table of events or tracks says in one line: for the page, stdout, a notebook and a batch.

Where species were found, they are the answer: of several there is no median.  Where events are too
few for species and are not alike, their range is.  Otherwise the median of the main quantity is,
over the rows whose status is ok.  Where more than a fifth of the rows is
flagged, the rest is a selection rather than a sample, and there is no answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc

from iscat_analysis.reading import read_json, read_parquet
from iscat_analysis.records import (
    FREE_PARAMETERS,
    TRACK_COLUMNS,
    Analysis,
    FloatArray,
    Status,
    TrackStatus,
    tally,
)
from iscat_analysis.report.numbers import number

MOST_FLAGGED = 0.2
"""Share of flagged rows above which no answer is given."""

_BETWEEN = " · "  # species
_WIDTH = 0.1  # of a species, over its mass
_UNLIKE = 1e-3  # p-value below which events are of more than one species


@dataclass(frozen=True)
class Quantity:
    """The main quantity of an analysis: a column, its name and unit."""

    column: str
    label: str
    unit: str


@dataclass(frozen=True)
class Answer:
    """One number, or those of all species, with its name and unit."""

    label: str
    value: str
    unit: str
    note: str = ""

    @property
    def text(self) -> str:
        """Everything in a line."""
        value = f"{self.label} {self.value} {self.unit}".rstrip()
        return f"{value}, {self.note}" if self.note else value


def is_uncalibrated(analysis: Analysis) -> bool:
    """Tell whether masses were fitted on the model's own scale."""
    return _has_no_scale(analysis.mode, analysis.summary)


def main_quantity(analysis: Analysis) -> Quantity:
    """Choose the main quantity."""
    return _quantity(analysis.mode, analysis.scheme, analysis.summary)


def _has_no_scale(mode: str, summary: Mapping[str, Any]) -> bool:
    known = summary.get("mass_scale") in ("calibration", "volume and density")
    return "mass_kda" in FREE_PARAMETERS[mode] and not known


def _quantity(mode: str, scheme: str, summary: Mapping[str, Any]) -> Quantity:
    """Choose the main quantity; without a calibration the model's absolute scale is not a mass."""
    if "mass_kda" not in FREE_PARAMETERS[mode]:
        return Quantity("z_nm", "height", "nm")
    if mode == "size":
        return Quantity("diameter_nm", "diameter", "nm")
    if not _has_no_scale(mode, summary):
        return Quantity("mass_kda", "mass", "kDa")
    if scheme == "darkfield":
        return Quantity("n_scattered", "number of scattered photons", "")
    return Quantity("contrast", "contrast", "")


def answers(
    analysis: Analysis, table: pd.DataFrame, tracks: pd.DataFrame | None = None
) -> tuple[Answer, ...]:
    """Answer for the events of an analysis, or for its tracks; nothing where no answer is fair."""
    main = main_quantity(analysis)
    if tracks is None:
        return _of_events(main, analysis.summary, table)
    return _of_tracks(main, analysis.summary, tracks)


def answer_in(folder: Path) -> str:
    """Give the answer of a result folder; empty where there is none."""
    summary = read_json(folder / "summary.json")
    if summary.get("mode") not in FREE_PARAMETERS:  # of another version
        return ""
    main = _quantity(summary["mode"], summary.get("scheme", ""), summary)
    if (folder / "tracks.parquet").is_file():
        found = _of_tracks(main, summary, read_parquet(folder / "tracks.parquet"))
    else:
        found = _of_events(main, summary, read_parquet(folder / "fits.parquet"))
    return "; ".join(each.text for each in found)


def _of_events(
    main: Quantity, summary: Mapping[str, Any], table: pd.DataFrame
) -> tuple[Answer, ...]:
    values = sizes(main, table)
    if not values.size or caution(table) is not None:
        return ()
    if several := _species(main, summary, table):
        return (several,)
    low, middle, high = quantiles(values)
    if (summary.get("distribution") or {}).get("species") == [] and _differ(table):
        value = f"{number(values.min())} to {number(values.max())}"
        note = "in events that are not alike and too few to tell species"
        return (Answer(main.label.capitalize(), value, main.unit, note),)
    if values.size == 1:
        return (Answer(main.label.capitalize(), number(middle), main.unit),)
    note = f"middle half {number(low)} to {number(high)} {main.unit}".rstrip()
    return (Answer(f"Median {main.label}", number(middle), main.unit, note),)


def _differ(table: pd.DataFrame) -> bool:
    """Tell whether masses differ by more than their errors and what one species may be wide."""
    rows = table[table["status"] == Status.OK.value]
    mass, sigma = rows["mass_kda"].abs().to_numpy(), rows["sigma_mass_kda"].to_numpy()
    off = (mass - np.median(mass)) / np.hypot(sigma, _WIDTH * np.median(mass))
    return float(chdtrc(max(mass.size - 1, 1), float(np.nansum(off**2)))) < _UNLIKE


def _species(main: Quantity, summary: Mapping[str, Any], table: pd.DataFrame) -> Answer | None:
    """List the species, if there are several, on the scale of the main quantity."""
    populations = (summary.get("sizes") or {}).get("populations", ())
    described = (summary.get("distribution") or {}).get("species", ())
    found, column = (populations, "diameter_nm") if populations else (described, "mass_kda")
    known = [each for each in found if not (each["outlier"] or each.get("background"))]
    values = np.array([each[column] for each in known], dtype=float)
    if len(values) < 2:
        return None
    if main.column in ("contrast", "n_scattered"):  # what is proportional to the mass or its square
        rows, power = table[table["status"] == Status.OK.value], 1 + (main.column == "n_scattered")
        per = (rows[main.column] / rows["mass_kda"] ** power).abs().to_numpy(float)
        values = quantiles(per)[1] * values**power
    named = "Diameters" if populations else f"Species of {main.label}"
    unit = "nm" if populations else main.unit
    return Answer(named, _BETWEEN.join(map(number, values.tolist())), unit)


def _of_tracks(
    main: Quantity, summary: Mapping[str, Any], tracks: pd.DataFrame
) -> tuple[Answer, ...]:
    if tracks.empty or tracks_caution(tracks) is not None:
        return ()
    good = tracks[tracks["status"] == TrackStatus.OK.value]
    size = main if main.column == "contrast" else Quantity("mass_kda", "mass", "kDa")
    named = (
        size,
        Quantity("optical_diameter_nm", "optical diameter", "nm"),
        Quantity("d_um2_s", "D", "µm²/s"),
        Quantity("diameter_nm", "hydrodynamic diameter", "nm"),
        Quantity("refractive_index", "refractive index", ""),
    )
    several = _species(Quantity("diameter_nm", "", "nm"), {"sizes": summary.get("sizes")}, good)
    found = []
    for each in named:
        value = float(good[each.column].median()) if each.column in good else math.nan
        if each.column == "optical_diameter_nm" and several:
            found.append(several)
        elif math.isfinite(value) and not (several and each is size):
            found.append(Answer(f"Median {each.label}", number(value), each.unit))
    return tuple(found)


def caution(table: pd.DataFrame) -> str | None:
    """Say that too many events are flagged for an answer."""
    rows = tally(table)
    if rows.flagged <= MOST_FLAGGED * rows.number:
        return None
    commonest = Status(next(name for name in rows.status if name != Status.OK.value))
    which = f"{rows.flagged} of {rows.number} events are"
    if rows.number == 1:
        which = "The only event is"
    rest = ": the rest is no fair sample" if rows.ok else ""
    return (
        f"{which} flagged, so no median is given{rest}. The commonest reason is "
        f"{commonest.value}. {commonest.advice}"
    )


def tracks_caution(tracks: pd.DataFrame) -> str | None:
    """Say that too many tracks are flagged for a median."""
    rows = tally(tracks[tracks["status"] != TrackStatus.FEW_FRAMES.value])  # these have no D
    if rows.flagged <= MOST_FLAGGED * rows.number:
        return None
    commonest = TrackStatus(next(name for name in rows.status if name != TrackStatus.OK.value))
    return (
        f"{rows.flagged} of {rows.number} that are long enough are flagged, so no median is given"
        f"{': the rest is no fair sample' if rows.ok else ''}. The commonest "
        f"reason is {commonest.value}. {commonest.advice}"
    )


def sizes(main: Quantity, table: pd.DataFrame) -> FloatArray:
    """Give the magnitudes of the main quantity over the rows that are ok.

    Shapes: result (n,).
    """
    good = table["status"] == Status.OK.value
    values = np.abs(table[main.column][good].to_numpy(float))
    return np.asarray(values[np.isfinite(values)])


def quantiles(values: FloatArray) -> tuple[float, float, float]:
    """Give the quartiles of what is finite."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return math.nan, math.nan, math.nan
    low, middle, high = np.quantile(finite, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def tracks_of(analysis: Analysis) -> pd.DataFrame:
    """Give the tracks of an analysis."""
    found = analysis.tracks
    return pd.DataFrame(columns=list(TRACK_COLUMNS)) if found is None else found
