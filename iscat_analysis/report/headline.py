"""What an analysis says in a few words: the same on the page, on stdout and in a notebook.

Every number here is taken over the rows whose status is ok.  Without a calibration the headline is
the contrast, because the model's absolute scale is not a mass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.records import FREE_PARAMETERS, Analysis, Status, counted, tally
from iscat_analysis.report.answer import answers, caution, is_uncalibrated, quantiles
from iscat_analysis.report.numbers import LABELS, UNITS, fixed, number, percent
from iscat_analysis.report.spread import rejection, species_widths
from iscat_analysis.units import count

NOT_A_MASS = (
    "Not calibrated: mass_kda is on the model's own absolute scale, and an uncalibrated absolute "
    "scale is not a mass. What was measured are contrasts; `iscat calibrate mass` makes masses of "
    "them."
)
"""What is said of masses without ``[calibration]``."""


@dataclass(frozen=True)
class Precision:
    """σ of one parameter and its bounds, over the rows that are ok."""

    name: str
    events: int
    sigma: float
    crb: float
    qcrb: float
    holevo: float
    over_crb: float
    information: float
    systematic: float = math.nan
    measured: float = math.nan
    measured_ci95: tuple[float, float] = (math.nan, math.nan)
    whole: bool = False

    @property
    def is_measured(self) -> bool:
        """Whether the spread was measured."""
        return math.isfinite(self.measured)

    @property
    def measured_text(self) -> str:
        """The measured spread over the bound with its interval."""
        low, high = self.measured_ci95
        return f"{fixed(self.measured, 2)} ({fixed(low, 2)} to {fixed(high, 2)})"

    @property
    def shared(self) -> str:
        """The error that all events share, as text; empty where it is not known."""
        known = math.isfinite(self.systematic)
        return f", common to all events {number(self.systematic)}" if known else ""


def as_contrasts(table: pd.DataFrame) -> pd.DataFrame:
    """Convert masses to contrasts, for a scale that is proportional to the mass."""
    per_kda = (table["contrast"] / table["mass_kda"]).abs()
    columns = [name for kind in ("sigma", "crb", "qcrb") if (name := f"{kind}_mass_kda") in table]
    scaled = {name: table[name] * per_kda for name in columns}
    if "systematic_contrast" in table:
        scaled["systematic_mass_kda"] = table["systematic_contrast"]
    return table.assign(**scaled, mass_kda=table["contrast"])


def as_diameters(table: pd.DataFrame) -> pd.DataFrame:
    """Put the diameters of spheres in the place of their masses."""
    names = [
        name
        for kind in ("sigma", "crb", "qcrb", "systematic")
        if (name := f"{kind}_mass_kda") in table
    ]
    sizes = {name: table[name.replace("mass_kda", "diameter_nm")] for name in names}
    return table.assign(**sizes, mass_kda=table["diameter_nm"])


def label_of(analysis: Analysis, name: str) -> str:
    """Name a parameter in tables and figures."""
    return "mass, model scale" if name == "mass_kda" and is_uncalibrated(analysis) else LABELS[name]


def precision_of(analysis: Analysis, table: pd.DataFrame, name: str) -> Precision:
    """Set σ of one parameter beside its bounds."""
    good = table[table["status"] == Status.OK.value]
    sigma, crb, qcrb = (good[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb"))
    usable = np.isfinite(sigma) & np.isfinite(crb) & (crb > 0)
    sigma, crb, qcrb = sigma[usable], crb[usable], qcrb[usable]
    medians = analysis.summary.get("precision", {}).get(name, {})
    holevo = medians.get("holevo_median")
    information = quantiles((qcrb / crb) ** 2)[1]
    return Precision(
        name,
        int(usable.sum()),
        quantiles(sigma)[1],
        quantiles(crb)[1],
        quantiles(qcrb)[1],
        math.nan if holevo is None else holevo,
        quantiles(sigma / crb)[1],
        information if holevo is None else medians["information_fraction_median"],
        _shared(good, name)[1],
        *_measured(medians),
    )


def _measured(medians: Mapping[str, Any]) -> tuple[float, tuple[float, float], bool]:
    """Read the measured spread, its interval and its reach off a summary."""
    if medians.get("repeat_over_crb") is None:
        return math.nan, (math.nan, math.nan), False
    low, high = medians["repeat_over_crb_ci95"]
    return medians["repeat_over_crb"], (low, high), medians["repeat_whole"]


def _shared(good: pd.DataFrame, name: str) -> tuple[float, float, float]:
    """Quartiles of the error that all events share."""
    column = f"systematic_{name}"
    return quantiles(good[column].to_numpy(float) if column in good else np.empty(0))


def headline(analysis: Analysis, table: pd.DataFrame) -> list[str]:
    """Summarise the result in two or three sentences."""
    table = counted(table)
    if table.empty:
        return [
            "Nothing was found in this movie that stands out from its noise. If particles can be "
            "seen by eye, look at the field image and the laser power below, then at "
            "detection.polarity, detection.false_alarms_per_movie and the two frame ranges."
        ]
    warned = [NOT_A_MASS] if is_uncalibrated(analysis) else []
    if (flagged := caution(table)) is not None:
        return [flagged, *spread_lines(analysis, table), *warned]
    rows = tally(table)
    text = f"{count(rows.number, 'event')}, {rows.ok if rows.flagged else 'all'} of them ok."
    if rows.number == 1:
        text = "One event, and it is ok."
    text += "".join(f" {answer.text}." for answer in answers(analysis, table) if rows.number > 1)
    spread = _spread(analysis, table)
    return [text, *spread, *spread_lines(analysis, table), *warned]


def _spread(analysis: Analysis, table: pd.DataFrame) -> list[str]:
    """Compare σ of the mass, or else of the height, with the bounds."""
    free = FREE_PARAMETERS[analysis.mode]
    name = "mass_kda" if "mass_kda" in free else "z_nm"
    p = precision_of(analysis, table, name)
    if not p.events:
        return []
    of_it, sigma = LABELS[name], f"{number(p.sigma)} {UNITS[name]}"
    shared = f"{number(p.systematic)} {UNITS[name]}" if math.isfinite(p.systematic) else ""
    if is_uncalibrated(analysis):
        good = table[table["status"] == Status.OK.value]
        size = good["mass_kda"].abs()
        of_it = "contrast"
        sigma = f"{percent(quantiles((good['sigma_mass_kda'] / size).to_numpy(float))[1])} of it"
        if "systematic_contrast" in good:
            relative = (good["systematic_contrast"] / good["contrast"].abs()).to_numpy(float)
            shared = f"{percent(quantiles(relative)[1])} of it"
    text = f"σ of the {of_it}, from the curvature of the likelihood, is {sigma}"
    text += f", {number(p.over_crb)} times the Cramér–Rao bound"
    if shared:
        text += f"; the error common to all events is {shared}"
    if math.isfinite(p.information):
        of = "can be had of the light" if math.isfinite(p.holevo) else "is in the light"
        text += f"; {percent(p.information)} of the information that {of} is used"
    return [f"{text}."]


def spread_lines(analysis: Analysis, table: pd.DataFrame) -> list[str]:
    """Describe the measured spread, and whether the model is rejected."""
    free = FREE_PARAMETERS[analysis.mode]
    rejected = rejection(table)
    message = analysis.summary.get("repeats", {}).get("message", "")
    lines = []
    if message:
        lines.append(
            f"{message if message.startswith('σ') else message[:1].upper() + message[1:]}."
        )
    else:
        name = "mass_kda" if "mass_kda" in free else "z_nm"
        p = precision_of(analysis, table, name)
        if p.is_measured:
            where = "between parts of each event's frames; slower noise does not show there"
            if p.whole:
                where = (
                    "between parts of each event's frames and, at full length, where there is no "
                    "particle"
                )
            if analysis.mode == "track":
                where = "of single frames where there is no particle"
            of_it = "contrast" if is_uncalibrated(analysis) else LABELS[name]
            lines.append(
                f"The measured spread of the {of_it}, {where}, is {p.measured_text} times the "
                "Cramér–Rao bound."
            )
    if rejected:
        lines += [rejected, *species_widths(analysis.summary)]
    return lines


def precision_rows(analysis: Analysis, precision: Sequence[Precision]) -> list[list[str]]:
    """Write the table of precisions."""
    common = any(math.isfinite(p.systematic) for p in precision)
    holevo = any(math.isfinite(p.holevo) for p in precision)
    measured = any(p.is_measured for p in precision)
    return [
        [
            f"{label_of(analysis, p.name)} [{UNITS[p.name]}]",
            number(p.sigma),
            *([number(p.systematic)] if common else []),
            number(p.crb),
            *([number(p.holevo)] if holevo else []),
            *(number(value) for value in (p.qcrb, p.over_crb)),
            *([p.measured_text if p.is_measured else "—"] if measured else []),
            percent(p.information),
            str(p.events),
        ]
        for p in precision
    ]
