"""Events of any table: ours, those of Refeyn's programs and their like, or columns of one's own.

Light particles are missed, and what tells how many depends on the table.

- With ``snr``, ours: the matched filter's σ_d is the median of |m|/snr clearly above the threshold,
  which stands in ``summary.json`` beside the table, or else is where the snr of the table begins.
- Given a limit M₅₀ and a spread: u σ_d = M₅₀, and σ_d is the spread.
- Given a cut: events below it are left out, and the species are those of a distribution that is cut
  there, which is exact whatever was missed below.
- Otherwise a limit is learned: from the peaks of the table (`repeats`), or of all tables of a
  series together (`series`).  Comparisons take the lightest event of each table for a cut.

Tables without errors of their own have σ = `UNKNOWN_SIGMA_KDA` for every event, less than any
instrument's; the width of a species then holds its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
import pandas as pd
import scipy
from pydantic import BaseModel
from scipy.special import log_ndtr

from iscat_analysis.calibration import mass_line, weighed
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings import tables as of
from iscat_analysis.inference.checks import number_in, path_in
from iscat_analysis.movie.tables import named, read_events, unit_note
from iscat_analysis.options import EventOptions, only, takes
from iscat_analysis.reading import read_json, summary_in
from iscat_analysis.records import MODEL_SCALE, BoolArray, FloatArray, species_rows
from iscat_analysis.species.events import POSSIBLE_KDA, Efficiency, Events, possible
from iscat_analysis.units import count, listed

UNKNOWN_SIGMA_KDA = 1.0
"""Error of an event whose table has none [kDa]."""

_CUT_WIDTH = 1e-6  # of a cut: its width
# Of the lightest mass, and the heaviest over it, between which an event must lie
_LEAST_MASS_RATIO = 0.5
_FRAMES, _PIXELS, _RATIOS = (0.0, 2.0**40), (0.0, 1e6), (0.0, 1e9)
_RANGES = {
    "mass_kda": POSSIBLE_KDA, "sigma_mass_kda": POSSIBLE_KDA,
    "systematic_mass_kda": (0.0, POSSIBLE_KDA[1]), "contrast": _RATIOS,
    "systematic_contrast": _RATIOS, "snr": (1e-3, _RATIOS[1]), "frame": _FRAMES, "n_after": _FRAMES,
    "x_px": _PIXELS, "y_px": _PIXELS,
}  # fmt: skip
"""The columns of numbers that are used, and how large their magnitudes can be."""

_REJECTED = "rejected_by_hand"  # true of events that somebody left out
_NAMED = 3  # tables that a note names


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Write each sentence once, with the tables that it is about."""
    tables: dict[str, dict[tuple[str, str], None]] = {}
    for finding in findings:
        shared = finding.kind({**finding.values, "amount": ""}).text.strip()
        of_table = finding.where, str(finding.values.get("amount", ""))
        tables.setdefault(shared, {})[of_table] = None
    found = []
    for sentence, about in tables.items():
        if len(about) == 1:
            ((name, amount),) = about
            found.append(" ".join(filter(None, (f"{name}:", amount, sentence))))
            continue
        named = [f"{name} ({amount})" if amount else name for name, amount in about]
        found.append(f"{listed(named, _NAMED)}: {sentence}")
    return found


@dataclass(frozen=True, eq=False)
class EventTable:
    """Events that have a mass."""

    name: str
    mass_kda: FloatArray
    sigma_kda: FloatArray
    frame: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    efficiency: Efficiency | None = None
    window_frames: int | None = None
    scale_error: Callable[[FloatArray], FloatArray] | None = None
    findings: tuple[Finding, ...] = ()
    edge_kda: float | None = None
    """The lightest event, where nothing but it tells what was missed."""

    @property
    def events(self) -> Events:
        """Magnitudes of the masses, as fits take them."""
        return Events(np.abs(self.mass_kda), self.sigma_kda, self.efficiency)

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings for the user, with one where the lightest event stands for the limit."""
        if self.edge_kda is None:
            return self.findings
        below = {"amount": f"below {self.edge_kda:.3g} kDa"}
        return *self.findings, of.UNKNOWN_LIMIT(below, where=self.name)


def mass_in(name: str, value: float, what: str = "mass in kDa") -> float:
    """Check the mass of a particle, or an error of one."""
    least, most = POSSIBLE_KDA
    return number_in(name, value, least=least, above=0.0, most=most, what=what)


def refuse_far(tables: Sequence[EventTable], masses_kda: Sequence[float], argument: str) -> None:
    """Refuse masses of species without an event near them, such as masses in another unit."""
    seen = np.abs(np.concatenate([table.mass_kda for table in tables]))
    low, high = _LEAST_MASS_RATIO * min(masses_kda), max(masses_kda) / _LEAST_MASS_RATIO
    if not seen.size or ((seen >= low) & (seen <= high)).any():
        return
    middle = float(np.median(seen))
    raise DataError(
        f"{tables[0].name}: no event is near the masses that {argument} asks for: none lies "
        f"between {low:.6g} and {high:.6g} kDa, and their median is "
        f"{middle:.6g} kDa; give both in kDa, not in Da or MDa"
    )


@takes(EventOptions)
def event_table(
    events: str | Path | pd.DataFrame | EventTable,
    *,
    name: str | None = None,
    any_scale: bool = False,
    **options: Unpack[EventOptions],
) -> EventTable:
    """Take events from a file or a table in memory; a table of events stays as it is.

    With `calibration` their masses are those of its line, from their contrasts, whatever masses
    the table has.  Without it a result on the model's own scale has none, and is refused but for
    `any_scale`, where whoever asks calls them contrasts.
    """
    given = only(EventOptions, options)
    line, selection = given.pop("calibration"), given.pop("select")
    sigma_kda, limit_kda, limit_sigma_kda, above_kda = (
        None if value is None else mass_in(f"`{option}`", value) for option, value in given.items()
    )
    if limit_kda is not None and above_kda is not None:
        raise ConfigError(
            "`limit_kda` and `above_kda` are two ways to say what is missed; give one of them"
        )
    if limit_sigma_kda is not None and limit_kda is None:
        raise ConfigError("`limit_sigma_kda` is the spread of a limit; give `limit_kda` as well")
    if isinstance(events, EventTable):
        return events
    if not isinstance(events, (pd.DataFrame, str, Path)):
        raise ConfigError(
            f"`events`: is {type(events).__name__}; give the path of a table, or a pandas.DataFrame"
        )
    if isinstance(events, pd.DataFrame):
        called = name or "table"
        table = named(events, called)
    else:
        called = name or str(events)
        table = read_events(Path(events))
    file = table.attrs.get("file")
    summary = {} if file is None else summary_in(Path(file).parent)
    findings = [of.AS_READ({"text": note}) for note in table.attrs["notes"]]
    if line is not None:
        table, times = weighed(table, mass_line(line), called)
        findings += [] if times is None else [of.MASSES_REPLACED({"times": times})]
    elif table["mass_kda"].isna().all() and table["contrast"].notna().any():
        raise DataError(
            f"{called}: has contrasts and no masses; give `calibration`, a mass line as iscat "
            "calibrate mass writes it"
        )
    elif not any_scale and summary.get("mass_scale") == MODEL_SCALE:
        raise DataError(
            f"{called}: has contrasts and no masses, because it was analysed without a mass line "
            "and an uncalibrated absolute scale is not a mass; give `calibration`, a mass line as "
            "iscat calibrate mass writes it"
        )
    if "status" not in table and (doubt := unit_note(table["mass_kda"].to_numpy(float))):
        findings.append(of.AS_READ({"text": doubt}))
    chosen = None if selection is None else _chosen(table, path_in("`select`", selection), called)
    table = _checked(table)
    if chosen is not None:
        findings.append(of.SELECTED({"amount": count(int((~chosen).sum()), "event")}))
        table = table[chosen]
    found, efficiency = _usable(table, called, sigma_kda), None
    if above_kda is not None:
        kept = np.abs(found.mass_kda) > above_kda
        if not kept.any():
            raise DataError(f"{called}: no event lies above `above_kda` = {above_kda:g}")
        columns = ("mass_kda", "sigma_kda", "frame", "x_px", "y_px")
        found = replace(found, **{name: getattr(found, name)[kept] for name in columns})
        efficiency = _sharp(above_kda)
    elif limit_kda is not None:
        spread = limit_sigma_kda or float(np.median(found.sigma_kda))
        efficiency = Efficiency(limit_kda / spread, spread)
    elif "snr" in table:
        efficiency = _from_snr(table, summary)
    edge = None
    if efficiency is None:
        edge = float(np.abs(found.mass_kda).min())
        efficiency = _sharp(edge * (1 - 10 * _CUT_WIDTH))
    findings = [replace(finding, where=called) for finding in (*findings, *found.findings)]
    return replace(found, efficiency=efficiency, edge_kda=edge, findings=tuple(findings))


class _Particle(BaseModel):
    """A particle that somebody rejected on the result page."""

    event: int
    frame: int


class _Selection(BaseModel):
    """What the result page saves."""

    quantity: Literal["mass", "contrast", "diameter", "optical diameter"]
    gates: list[tuple[float, float]]
    rejected: list[_Particle]


_SELECTED = {
    "mass": ("mass_kda", 1.0),
    "contrast": ("contrast", 1e-3),
    "diameter": ("diameter_nm", 1.0),
    "optical diameter": ("optical_diameter_nm", 1.0),
}
"""Columns that gates are of, and their unit there."""


def _chosen(table: pd.DataFrame, file: Path, called: str) -> BoolArray:
    """Tell which rows a selection of the result page keeps."""
    try:
        selection = _Selection.model_validate(read_json(file))
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: is no selection of a result page ({error})") from None
    column, unit = _SELECTED[selection.quantity]
    numbers = {"event", "frame", column}
    if missing := numbers - set(table):
        raise DataError(
            f"{called}: has no {', '.join(sorted(missing))}, which {file} selects by; give the "
            "result whose page saved it"
        )
    values = table[column].abs().to_numpy(float)
    kept = np.ones(len(table), dtype=bool)
    if selection.gates:
        kept = np.any([(values >= a * unit) & (values <= b * unit) for a, b in selection.gates], 0)
    frames = dict(zip(table["event"], table["frame"], strict=True))
    for particle in selection.rejected:
        if frames.get(particle.event) != particle.frame:
            raise DataError(
                f"{file}: {called} has no event {particle.event} at frame {particle.frame}: the "
                "selection is of another result"
            )
    kept &= ~table["event"].isin([one.event for one in selection.rejected]).to_numpy(bool)
    return kept


def filter_efficiency(
    good: pd.DataFrame, threshold_snr: float, searched: float = 1.0
) -> Efficiency | None:
    """Estimate the detection efficiency of the matched filter from its events."""
    mass, snr = (good[name].to_numpy(dtype=float) for name in ("mass_kda", "snr"))
    known = np.isfinite(mass) & (mass != 0) & (snr > 0) & np.isfinite(snr)
    mass, snr = np.abs(mass[known]), snr[known]
    if not mass.size:
        return None
    each = mass / snr
    # Near the threshold those are seen whose estimate is too large; they would make σ_d too small.
    clear = mass > (threshold_snr + 3.0) * float(np.median(each))
    if np.count_nonzero(clear) >= 10:
        each = each[clear]
    elif "sigma_mass_kda" in good:
        sigma = good["sigma_mass_kda"].to_numpy(dtype=float)[known]
        return Efficiency(threshold_snr, _truncated(mass, snr, sigma, threshold_snr), searched)
    return Efficiency(threshold_snr, float(np.median(each)), searched)


def _truncated(mass: FloatArray, snr: FloatArray, sigma: FloatArray, threshold_snr: float) -> float:
    """Find σ_d where all events lie near the threshold.

    The filter's y = snr·σ_d is normal about the mass with the variance σ_d² − σ², and above u·σ_d:
    the σ_d that makes the events seen most likely.
    """
    known = np.isfinite(sigma) & (sigma > 0)
    mass, snr, sigma = mass[known], snr[known], sigma[known]
    middle = float(np.median(mass / snr)) if mass.size else math.nan

    def loss(scale: float) -> float:
        # of σ_d: noise of the filter's estimate beyond that of the fit
        extra = np.sqrt(np.maximum(scale**2 - sigma**2, (0.05 * scale) ** 2))
        off = (snr * scale - mass) / extra
        seen = log_ndtr((mass - threshold_snr * scale) / extra)
        return float(np.sum(0.5 * off**2 + np.log(extra / scale) + seen))

    if not mass.size:
        return middle
    found = scipy.optimize.minimize_scalar(
        loss, bounds=(0.8 * middle, 2.0 * middle), method="bounded"
    )
    return float(found.x)


def shared_error(good: pd.DataFrame) -> Callable[[FloatArray], FloatArray] | None:
    """Read the error that all events share, as a function of mass, off the events themselves.

    Without calibration the species are contrasts in units of the model, and share their error.
    """
    if "systematic_mass_kda" not in good or good.empty:
        return None
    size = good["mass_kda"].abs().to_numpy(dtype=float)
    error = good["systematic_mass_kda"].to_numpy(dtype=float)
    if "systematic_contrast" in good:
        relative = good["systematic_contrast"] / good["contrast"].abs()
        error = size * relative.to_numpy(dtype=float)
    order = np.argsort(size)
    return lambda masses: np.interp(masses, size[order], error[order])


def _checked(table: pd.DataFrame) -> pd.DataFrame:
    """Take the columns that are used; whatever is no possible number becomes NaN.

    All that is computed later, and every kernel, gets numbers of these ranges.
    """
    checked = table.copy()
    for column, (least, most) in _RANGES.items():
        if column in table:
            size = table[column].abs()
            checked[column] = table[column].where((size >= least) & (size <= most))
    if _REJECTED in table:
        checked[_REJECTED] = table[_REJECTED].astype(str).str.lower().eq("true").to_numpy()
    return checked


def _usable(table: pd.DataFrame, name: str, sigma_kda: float | None) -> EventTable:
    """Select rows with a mass and without a disqualifying flag."""
    good, findings = table, []
    if "status" in table:
        good, said = species_rows(table)
        findings += [of.AS_READ({"text": sentence}) for sentence in said]
        if good.empty:
            raise DataError(f"{name}: holds no event with status ok")
    if _REJECTED in good and (by_hand := int(good[_REJECTED].sum())):
        good = good[~good[_REJECTED]]
        findings.append(of.REJECTED_BY_HAND({"amount": count(by_hand, "event")}))
    mass, sigma, frame, x, y = (
        good[column].to_numpy(np.float64) if column in good else np.full(len(good), math.nan)
        for column in ("mass_kda", "sigma_mass_kda", "frame", "x_px", "y_px")
    )
    if sigma_kda is not None:
        sigma = np.full(mass.shape, sigma_kda)
    elif not np.isfinite(sigma[np.isfinite(mass)]).any():
        sigma = np.full(mass.shape, UNKNOWN_SIGMA_KDA)
        findings.append(of.NO_ERRORS())
    known = possible(mass, sigma)
    least, most = POSSIBLE_KDA
    if not known.any():
        raise DataError(
            f"{name}: holds no event with a mass and an error between {least:g} and "
            f"{most:g} kDa; fit the masses (mode mass or joint) or export the table with masses"
        )
    if missing := int(np.count_nonzero(~known)):
        advice = ""
        if good["contrast"][~known].notna().any():
            advice = "; `calibration` gives them the mass of their contrast"
        limits = {"least": least, "most": most}
        findings.append(of.NO_MASS({"amount": count(missing, "event"), "advice": advice, **limits}))
    rows = good[known]
    window = rows["n_after"].max() if "n_after" in rows else 0
    window_frames, told = int(np.nan_to_num(window)) or None, tuple(findings)
    mass, sigma, frame, x, y = (values[known] for values in (mass, sigma, frame, x, y))
    found = EventTable(name, mass, sigma, frame, x, y, scale_error=shared_error(rows))
    return replace(found, window_frames=window_frames, findings=told)


def _sharp(edge_kda: float) -> Efficiency:
    """Efficiency that is 1 above a mass and 0 below."""
    return Efficiency(1 / _CUT_WIDTH, edge_kda * _CUT_WIDTH)


def _from_snr(table: pd.DataFrame, summary: Mapping[str, Any]) -> Efficiency | None:
    """Estimate threshold and noise of the filter from a table of this program."""
    good = species_rows(table)[0] if "status" in table else table
    snr = good["snr"].to_numpy(dtype=float)
    # values that tell where the distribution begins
    few = np.sort(snr[np.isfinite(snr) & (snr > 0)])[:10]
    if not few.size:
        return None
    # The smallest value, less the mean distance of values near it.
    threshold, searched = float(few[0] - np.ptp(few) / max(few.size - 1, 1)), 1.0
    with suppress(ValueError, KeyError, TypeError):  # not ours: the table alone must do
        stored = float(summary["detection_threshold_snr"] or threshold)
        threshold = stored if 0 < stored < _RATIOS[1] else threshold
        share = float(summary["landing"]["searched_share"])
        searched = share if 0 < share <= 1 else 1.0
    return filter_efficiency(good, threshold, searched)
