"""What an analysis says in a few words: the same on the page, on stdout, in a notebook and a batch.

Where species were found, they are the answer: of several there is no median.  Where events are too
few for species and are not alike, their range is.  Otherwise the median of the main quantity is,
over the rows whose status is ok.  Where more than a fifth of the rows is flagged, the rest is a
selection rather than a sample, and there is no answer.  Without a calibration the main quantity is
the contrast, because the model's absolute scale is not a mass.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc

from iscat_analysis.config import MODES, SCHEMES
from iscat_analysis.findings import Finding
from iscat_analysis.findings.results import MANY_FLAGGED, MODEL_REJECTED, NOT_A_MASS, NOTHING_FOUND
from iscat_analysis.reading import read_json, read_parquet
from iscat_analysis.records import (
    POOR_P,
    TRACK_COLUMNS,
    Analysis,
    FloatArray,
    Status,
    TrackStatus,
    counted,
    is_rejected,
    tally,
)
from iscat_analysis.report.numbers import (
    LABELS,
    Fact,
    Table,
    decimals_for,
    fixed,
    intervals,
    number,
    numeric,
    of,
    sentence,
    tabulate,
    with_error,
)
from iscat_analysis.units import count

TRACK_HEADINGS: Mapping[str, tuple[str, str, str]] = {
    "mass": ("mass_kda", "sigma_mass_kda", "kDa"),
    "D": ("d_um2_s", "sigma_d_um2_s", "µm²/s"),
    "optical diameter": ("optical_diameter_nm", "sigma_optical_diameter_nm", "nm"),
    "diameter": ("diameter_nm", "sigma_diameter_nm", "nm"),
    "index": ("refractive_index", "sigma_refractive_index", ""),
}
"""Columns of the short table of tracks, with their errors and units."""


# ---- What the rows are, and their main quantity --------------------------------------------------


@dataclass(frozen=True)
class RowKind:
    """What the rows of a table of results are: events, or tracks.

    Attributes
    ----------
    noun, judged : str
        Name of a row, and of the rows that must be a fair sample.
    status : type
        Verdicts on them.
    begins, heading : str
        Column of the first frame, and its heading.
    fits, unit : str
        What the rows of ``fits.csv`` are, at the beginning of a sentence and in a heading.
    short : str
        Verdict on rows that are too short to be judged; empty if there is none.
    """

    noun: str
    judged: str
    status: type[Status] | type[TrackStatus]
    begins: str
    heading: str
    fits: str
    unit: str
    short: str = ""


EVENTS_KIND = RowKind("event", "events", Status, "frame", "frame", "Events", "events")
TRACKS_KIND = RowKind(
    "track",
    "that are long enough",
    TrackStatus,
    "first_frame",
    "from frame",
    "Single frames",
    "frames",
    TrackStatus.FEW_FRAMES.value,
)


def row_kind(analysis: Analysis) -> RowKind:
    """Tell whether an analysis is of events or of tracks."""
    return EVENTS_KIND if analysis.tracks is None else TRACKS_KIND


def tracks_of(analysis: Analysis) -> pd.DataFrame:
    """Give the tracks of an analysis."""
    found = analysis.tracks
    return pd.DataFrame(columns=list(TRACK_COLUMNS)) if found is None else found


@dataclass(frozen=True)
class Quantity:
    """The main quantity of an analysis: a column, its name and unit.

    `power` is that of the mass to which a signal without a scale of masses is proportional.
    """

    column: str
    label: str
    unit: str = ""
    power: int = 0

    @property
    def axis(self) -> str:
        """Label of an axis."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def values(self, table: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
        """Give the quantity of every row, and its σ, on its scale if it has none of its own."""
        values = table[self.column].to_numpy(float)
        sigma = table.get(f"sigma_{self.column}")
        if sigma is not None:
            return values, sigma.to_numpy(float)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.abs(values / table["mass_kda"].to_numpy(float))
            return values, table["sigma_mass_kda"].to_numpy(float) * scale


HEIGHT = Quantity("z_nm", "height", "nm")
DIAMETER = Quantity("diameter_nm", "diameter", "nm")
MASS = Quantity("mass_kda", "mass", "kDa")
PHOTONS = Quantity("n_scattered", "number of scattered photons", power=2)
CONTRAST = Quantity("contrast", "contrast", power=1)
_OF_TRACKS = (
    Quantity("optical_diameter_nm", "optical diameter", "nm"),
    Quantity("d_um2_s", "D", "µm²/s"),
    Quantity("diameter_nm", "hydrodynamic diameter", "nm"),
    Quantity("refractive_index", "refractive index"),
)


def is_uncalibrated(analysis: Analysis) -> bool:
    """Tell whether masses were fitted on the model's own scale."""
    return _has_no_scale(analysis.mode, analysis.summary)


def main_quantity(analysis: Analysis) -> Quantity:
    """Choose the main quantity."""
    return _quantity(analysis.mode, analysis.scheme, analysis.summary)


def track_quantity(analysis: Analysis) -> Quantity:
    """Choose between contrast and mass of tracks, with the scale in the name of a mass."""
    main = main_quantity(analysis)
    if main is CONTRAST:
        return Quantity("contrast", "|contrast|", power=1)
    return MASS if main is MASS else Quantity("mass_kda", "mass, model scale", "kDa")


def _has_no_scale(mode: str, summary: Mapping[str, Any]) -> bool:
    known = summary.get("mass_scale") in ("calibration", "volume and density")
    return MODES[mode].masses_free and not known


def _quantity(mode: str, scheme: str, summary: Mapping[str, Any]) -> Quantity:
    """Choose the main quantity; without a calibration the model's absolute scale is not a mass."""
    kind = MODES[mode]
    if not kind.masses_free:
        return HEIGHT
    if kind.fits_sizes:
        return DIAMETER
    if not _has_no_scale(mode, summary):
        return MASS
    return CONTRAST if scheme not in SCHEMES or SCHEMES[scheme].interferes else PHOTONS


def main_parameter(analysis: Analysis) -> str:
    """Name the parameter whose precision is the headline's: the mass, or else the height."""
    return "mass_kda" if analysis.mode_kind.masses_free else "z_nm"


def label_of(analysis: Analysis, name: str) -> str:
    """Name a parameter in tables and figures."""
    return "mass, model scale" if name == "mass_kda" and is_uncalibrated(analysis) else LABELS[name]


def as_contrasts(table: pd.DataFrame) -> pd.DataFrame:
    """Convert masses to contrasts, for a scale that is proportional to the mass."""
    errors = table.columns.intersection([f"{kind}_mass_kda" for kind in ("sigma", "crb", "qcrb")])
    scaled = table[errors].mul((table["contrast"] / table["mass_kda"]).abs(), axis=0)
    if "systematic_contrast" in table:
        scaled["systematic_mass_kda"] = table["systematic_contrast"]
    return table.assign(**scaled, mass_kda=table["contrast"])


def as_diameters(table: pd.DataFrame) -> pd.DataFrame:
    """Put the diameters of spheres in the place of their masses."""
    kinds = ("sigma", "crb", "qcrb", "systematic")
    names = [name for kind in kinds if (name := f"{kind}_mass_kda") in table]
    sizes = {name: table[name.replace("mass_kda", "diameter_nm")] for name in names}
    return table.assign(**sizes, mass_kda=table["diameter_nm"])


# ---- Answers -------------------------------------------------------------------------------------


def answers(analysis: Analysis, table: pd.DataFrame) -> tuple[Fact, ...]:
    """Answer for the events of an analysis, or for its tracks; nothing where no answer is fair."""
    main = main_quantity(analysis)
    if analysis.tracks is None:
        return _of_events(main, analysis.summary, table)
    return _of_tracks(main, analysis.summary, analysis.tracks)


def answer_in(folder: Path) -> str:
    """Give the answer of a result folder; empty where there is none."""
    summary = read_json(folder / "summary.json")
    if summary.get("mode") not in MODES:  # of another version
        return ""
    main = _quantity(summary["mode"], summary.get("scheme", ""), summary)
    if (folder / "tracks.parquet").is_file():
        found = _of_tracks(main, summary, read_parquet(folder / "tracks.parquet"))
    else:
        found = _of_events(main, summary, read_parquet(folder / "fits.parquet"))
    return "; ".join(each.text for each in found)


def _of_events(main: Quantity, summary: Mapping[str, Any], table: pd.DataFrame) -> tuple[Fact, ...]:
    values = np.abs(_good(table)[main.column].to_numpy(float))
    values = values[np.isfinite(values)]
    if not values.size or caution(table) is not None:
        return ()
    if several := _species(main, summary, table):
        return (several,)
    low, middle, high = quartiles(values)
    if not (summary.get("distribution") or {}).get("species") and _differ(table):
        value = f"{number(values.min())} to {number(values.max())}"
        few = " and too few to tell species" if summary.get("distribution") else ""
        note = f"in events that are not alike{few}"
        return (Fact(main.label.capitalize(), value, main.unit, note),)
    if values.size == 1:
        return (Fact(main.label.capitalize(), number(middle), main.unit),)
    note = f"middle half {number(low)} to {number(high)} {main.unit}".rstrip()
    return (Fact(f"Median {main.label}", number(middle), main.unit, note),)


def _good(table: pd.DataFrame) -> pd.DataFrame:
    """Give the events, or tracks, whose status is ok."""
    return table[table["status"] == Status.OK.value]


def _differ(table: pd.DataFrame) -> bool:
    """Tell whether masses differ by more than their errors and what one species may be wide."""
    rows = _good(table)
    mass, sigma = rows["mass_kda"].abs().to_numpy(), rows["sigma_mass_kda"].to_numpy()
    width = 0.1 * np.median(mass)
    off = (mass - np.median(mass)) / np.hypot(sigma, width)
    return float(chdtrc(max(mass.size - 1, 1), float(np.nansum(off**2)))) < 1e-3


def species_of(analysis: Analysis) -> pd.DataFrame:
    """Tabulate the species of an analysis, the lightest first; empty where there is no fair answer.

    Columns: the quantity that tells species apart, as ``mass_kda``, ``contrast`` where masses have
    no scale, or ``diameter_nm`` of spheres; with ``sigma_`` and ``systematic_`` before that name
    its standard error, and the error that all events of the movie share; `width`, the standard
    deviation of the species beyond the errors of its events; `count` and `share`, each with the
    ends of its 95 % interval, as `share_low` and `share_high`; `landing` and `leaving`.
    """
    main, summary, table = main_quantity(analysis), analysis.summary, counted(analysis.table)
    if analysis.tracks is None:
        fair = caution(table) is None
    else:
        main, summary, table = DIAMETER, {"sizes": summary.get("sizes")}, analysis.tracks
        fair = caution(table, TRACKS_KIND) is None
    return _species_table(main, summary, table) if fair else _species_table(main, {}, table)


def _species_table(main: Quantity, summary: Mapping[str, Any], table: pd.DataFrame) -> pd.DataFrame:
    """Tabulate species, if any are described, on the scale of the main quantity."""
    populations = (summary.get("sizes") or {}).get("populations", ())
    described = (summary.get("distribution") or {}).get("species", ())
    found, stem, column = described, "mass", "mass_kda"
    if populations:
        main, found, stem, column = DIAMETER, populations, "diameter", "diameter_nm"
    known = [each for each in found if not (each["outlier"] or each.get("background"))]
    ends = ("se", "low", "high", "systematic")
    names = [column, *(f"{stem}_{end}" for end in ends), "count", "fraction", "landing", "leaving"]
    counts = ("count_low", "count_high", "fraction_low", "fraction_high")
    wide = ("width_kda", "width_low", "geometric_sd")
    rows = pd.DataFrame(known, columns=[*names, *counts, *wide], dtype=float)
    values, sigma, low, high, shared = (rows[name] for name in names[:5])
    sigma = sigma.fillna((high - low) / 3.92)
    width = rows["width_kda"].where(rows["width_low"] > 0, 0.0)
    width = width.where(rows["geometric_sd"].isna(), values * np.log(rows["geometric_sd"]))
    if main.power and len(rows):
        good = _good(table)
        per = (good[main.column] / good["mass_kda"] ** main.power).abs().to_numpy(float)
        shared, relative = shared * math.nan, main.power * sigma / values
        width = main.power * width / values
        values = quartiles(per)[1] * values**main.power
        sigma, width = relative * values, width * values
    if (common := _good(table).get(f"systematic_{main.column}")) is not None:
        relative = (common / _good(table)[main.column]).abs().to_numpy(float)
        shared = shared.fillna(quartiles(relative)[1] * values)
    if "landing" not in summary:
        rows[["landing", "leaving"]] = math.nan
    errors = {f"sigma_{main.column}": sigma, f"systematic_{main.column}": shared}
    shares = {f"share{end}": rows[f"fraction{end}"] for end in ("", "_low", "_high")}
    kept = ("count", "count_low", "count_high", "landing", "leaving")
    return pd.DataFrame(
        {main.column: values, **errors, "width": width, **shares}
        | {name: rows[name] for name in kept}
    ).sort_values(main.column, ignore_index=True)


def species_listing(analysis: Analysis) -> Table:
    """Write the species as people read them; columns of which nothing is known are left out."""
    found = species_of(analysis)
    column = str(found.columns[0])
    named = DIAMETER if column == DIAMETER.column else main_quantity(analysis)
    unit = f" [{named.unit}]" if named.unit else ""
    columns = [
        numeric(
            f"{named.label} ± σ{unit}", lambda row: with_error(row[column], row[f"sigma_{column}"])
        ),
        numeric(f"± common{unit}", of(f"systematic_{column}", number, 2)),
        numeric(f"{row_kind(analysis).noun}s", of("count", fixed, 0)),
        *intervals("share", "share", in_percent=True),
        numeric("landing", of("landing", fixed, 0)),
        numeric("leaving", of("leaving", fixed, 0)),
    ]
    records = found.to_dict("records")
    shown = [c for c in columns if any(c.cell(record) != "—" for record in records)]
    return tabulate(records, shown)


def _species(main: Quantity, summary: Mapping[str, Any], table: pd.DataFrame) -> Fact | None:
    """List the species, if there are several, on the scale of the main quantity."""
    found = _species_table(main, summary, table)
    if len(found) < 2:
        return None
    sizes = found.columns[0] == DIAMETER.column
    named = "Diameters" if sizes else f"Species of {main.label}"
    values = found[found.columns[0]].tolist()
    return Fact(named, " · ".join(map(number, values)), DIAMETER.unit if sizes else main.unit)


def _of_tracks(
    main: Quantity, summary: Mapping[str, Any], tracks: pd.DataFrame
) -> tuple[Fact, ...]:
    if tracks.empty or caution(tracks, TRACKS_KIND) is not None:
        return ()
    good = _good(tracks)
    several = _species(DIAMETER, {"sizes": summary.get("sizes")}, good)
    found = []
    for each in (main if main is CONTRAST else MASS, *_OF_TRACKS):
        values = good[each.column].dropna().abs() if each.column in good else pd.Series([])
        if each.column == "optical_diameter_nm" and several:
            found.append(several)
        elif values.empty or (several and each in (CONTRAST, MASS)):
            continue
        elif each in (CONTRAST, MASS) and _differ(good):
            ends, why = f"{number(values.min())} to {number(values.max())}", "in tracks not alike"
            found.append(Fact(each.label.capitalize(), ends, each.unit, why))
        else:
            found.append(Fact(f"Median {each.label}", number(values.median()), each.unit))
    return tuple(found)


def quartiles(values: FloatArray) -> tuple[float, float, float]:
    """Give the quartiles of what is finite."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return math.nan, math.nan, math.nan
    low, middle, high = np.quantile(finite, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


# ---- Precision -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Precision:
    """σ of one parameter and its bounds, over the rows that are ok; medians, NaN if unknown."""

    name: str
    events: int
    sigma: float
    crb: float
    qcrb: float
    holevo: float
    over_crb: float
    information: float
    systematic: float
    measured: float
    measured_ci95: tuple[float, float]
    whole: bool

    @property
    def is_measured(self) -> bool:
        """Whether the spread was measured."""
        return math.isfinite(self.measured)

    @property
    def best(self) -> tuple[str, float]:
        """Name and value of the bound of all measurements: Holevo's, where it is known."""
        return ("Holevo", self.holevo) if math.isfinite(self.holevo) else ("QCRB", self.qcrb)

    @property
    def shared(self) -> str:
        """The error that all events share, as text; empty where it is not known."""
        known = math.isfinite(self.systematic)
        return f", common to all events {number(self.systematic)}" if known else ""

    @property
    def measured_text(self) -> str:
        """The measured spread over the bound with its interval."""
        low, high = self.measured_ci95
        return f"{fixed(self.measured, 2)} ({fixed(low, 2)} to {fixed(high, 2)})"


def precision_of(analysis: Analysis, table: pd.DataFrame, name: str) -> Precision:
    """Set σ of one parameter beside its bounds."""
    good = _good(table)
    shared = good.get(f"systematic_{name}", pd.Series(dtype=float)).to_numpy(float)
    sigma, crb, qcrb = (good[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb"))
    usable = np.isfinite(sigma) & np.isfinite(crb) & (crb > 0)
    sigma, crb, qcrb = sigma[usable], crb[usable], qcrb[usable]
    medians = analysis.summary.get("precision", {}).get(name, {})
    known = {key: value for key, value in medians.items() if value is not None}
    in_all = "holevo_median" in known
    return Precision(
        name=name,
        events=sigma.size,
        sigma=quartiles(sigma)[1],
        crb=quartiles(crb)[1],
        qcrb=quartiles(qcrb)[1],
        holevo=known.get("holevo_median", math.nan),
        over_crb=quartiles(sigma / crb)[1],
        information=medians["information_fraction_median"]
        if in_all
        else quartiles((qcrb / crb) ** 2)[1],
        systematic=quartiles(shared)[1],
        measured=known.get("repeat_over_crb", math.nan),
        measured_ci95=tuple(known.get("repeat_over_crb_ci95", (math.nan, math.nan))),
        whole=known.get("repeat_whole", False),
    )


# ---- Sentences -----------------------------------------------------------------------------------


def caution(table: pd.DataFrame, kind: RowKind = EVENTS_KIND) -> Finding | None:
    """Find that too many events, or tracks, are flagged for an answer."""
    rows = tally(table[table["status"] != kind.short])
    if rows.flagged <= 0.2 * rows.number:  # else the others are a selection, and no sample
        return None
    commonest = kind.status(next(name for name in rows.status if name != Status.OK.value))
    which = f"{rows.flagged} of {rows.number} {kind.judged} are"
    return MANY_FLAGGED(
        {
            "rows": f"The only {kind.noun} is" if rows.number == 1 else which,
            "rest": ": the rest is no fair sample" if rows.ok else "",
            "reason": commonest.value,
            "advice": commonest.advice.rstrip("."),
        }
    )


def rejection(table: pd.DataFrame) -> Finding | None:
    """Find that the model of the image is rejected."""
    if not is_rejected(table):
        return None
    p_values = counted(table)["p_value"].dropna()
    return MODEL_REJECTED(
        {
            "poor": int((p_values < POOR_P).sum()),
            "fits": p_values.size,
            "level": POOR_P,
            "chance": number(POOR_P * p_values.size, 2),
        }
    )


def not_a_mass(analysis: Analysis) -> list[str]:
    """Say that masses are on the model's own scale, where they are."""
    return [sentence(NOT_A_MASS().text)] if is_uncalibrated(analysis) else []


def species_widths(summary: Mapping[str, Any]) -> list[str]:
    """Say how much wider than σ the species are."""
    lines = []
    calibrated = summary.get("mass_scale") == "calibration"
    for one in summary.get("across_particles") or ():
        values = [one[f"width_{key}"] for key in ("kda", "low", "high")]
        if not all(value is not None and math.isfinite(value) for value in values):
            continue
        scale, unit, name = 1.0, " kDa", f"at {number(one['mass_kda'])} kDa"
        if not calibrated:
            scale, unit, name = 100 / one["mass_kda"], " %", "of contrast"
        decimals = decimals_for([scale * (values[2] - values[1]) / 2])
        width, low, high = (fixed(scale * value, decimals) for value in values)
        budget = ""
        if (explained := one.get("explained_kda")) is not None:
            budget = f" The budget explains {fixed(scale * explained, decimals)}{unit} of that."
        lines.append(
            f"Across particles: beyond the σ of its {one['count']:.0f} events the species {name} "
            f"is {width}{unit} ({low} to {high}) wide, so that its events scatter by "
            f"{number(one['spread_over_sigma'])} times σ.{budget}"
        )
    return lines


def track_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Describe where tracks begin, end and meet."""
    motion = summary.get("motion")
    if not motion or not summary.get("tracks"):
        return
    if motion["cross_border"]:
        yield (
            f"{motion['cross_border']} of {count(summary['tracks'], 'track')} begin or end at the "
            "border of the field; a particle that leaves and comes back is another track."
        )
    if motion["end_inside"] + motion["begin_inside"]:
        yield (
            f"{motion['begin_inside']} begin and {motion['end_inside']} end inside the field: "
            "particles come from the liquid and go there, meet others, or are lost from sight."
        )


@dataclass(frozen=True)
class Spoken:
    """An analysis in a few lines, as a terminal and a notebook show it.

    Attributes
    ----------
    cautions : list of str
        Why there is no answer, or no mass.
    species : Table
        The species; no rows where there are none.
    facts : list of str
        The answer where there are no species.
    totals : str
        Events, or tracks, by status, and what can be done about the commonest flag.
    """

    cautions: list[str]
    species: Table
    facts: list[str]
    totals: str


def spoken(analysis: Analysis) -> Spoken:
    """Say in a few lines what was found, and what to do first."""
    kind, table = row_kind(analysis), analysis.table
    judged = table if analysis.tracks is None else analysis.tracks
    rows, flagged = tally(judged), caution(judged, kind)
    totals = f"{rows.text(kind.noun)}."
    if not rows.number:
        nothing = NOTHING_FOUND().remedy if kind is EVENTS_KIND or table.empty else ""
        return Spoken([], Table((), ()), [], f"{totals} {sentence(nothing)}" if nothing else totals)
    cautions = [sentence(flagged.text)] if flagged is not None else []
    remarks = Counter(
        name for row in counted(judged).itertuples() for name in {row.status, *_flags(row.flags)}
    )
    known = [(n, status) for status in kind.status if (n := remarks[status.value])]
    known = [each for each in known if each[1] != Status.OK]
    if known and flagged is None:
        number, first = max(known, key=lambda each: each[0])
        totals += f" {number} {first}: {sentence(first.advice)}"
    species = species_listing(analysis)
    facts = [] if species.rows else [fact.text for fact in answers(analysis, table)]
    return Spoken([*cautions, *not_a_mass(analysis)], species, facts, totals)


def _flags(flags: Any) -> list[str]:
    return flags.split(";") if isinstance(flags, str) else []
