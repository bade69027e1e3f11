"""What the report page is told: headline numbers in words, and compact data for its scripts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePath
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.records import (
    EVENT_COLUMNS,
    FREE_PARAMETERS,
    Analysis,
    FloatArray,
    Status,
)
from iscat_analysis.report.pack import (
    event_images,
    field_image,
    posterior_densities,
    rounded,
    views_of_rows,
)
from iscat_analysis.report.tables import event_table, jsonable

POWER_POINTS = 1500
"""Points of the power curve; longer ones keep the extremes of each stretch."""

LABELS = {"x_nm": "x", "y_nm": "y", "z_nm": "z", "mass_kda": "mass"}
"""What the parameters are called in print."""

UNITS = {"x_nm": "nm", "y_nm": "nm", "z_nm": "nm", "mass_kda": "kDa"}
"""Their units."""

_MODES = {
    "mass": "position and mass, height fixed",
    "localize": "position in three dimensions, mass fixed",
    "joint": "position in three dimensions and mass",
    "track": "position and mass in every frame, linked into tracks",
}
_SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "Dark field"}


@dataclass(frozen=True)
class Precision:
    """How near the fits of one parameter came to its bounds, over the events that are ok.

    Attributes
    ----------
    name : str
        As in `PARAMETERS`.
    events : int
        Events with a usable σ and CRB.
    sigma, crb, qcrb : float
        Medians [nm or kDa]; NaN where there is none.
    over_crb : ndarray, shape (5,)
        5, 25, 50, 75 and 95 % quantiles of σ/CRB.
    quantum_over_crb : ndarray, shape (5,)
        The same of QCRB/CRB.
    information : float
        Median of (QCRB/CRB)², the share of the light's information that the measurement uses.
    """

    name: str
    events: int
    sigma: float
    crb: float
    qcrb: float
    over_crb: FloatArray
    quantum_over_crb: FloatArray
    information: float


def precision_of(table: pd.DataFrame, name: str) -> Precision:
    """Set the spread of one parameter beside its bounds.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    name : str
        As in `PARAMETERS`.

    Returns
    -------
    Precision
        Over the rows whose status is ok; NaN where nothing is known.
    """
    good = table[table["status"] == Status.OK.value]
    sigma, crb, qcrb = (good[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb"))
    usable = np.isfinite(sigma) & np.isfinite(crb) & (crb > 0)
    sigma, crb, qcrb = sigma[usable], crb[usable], qcrb[usable]
    return Precision(
        name,
        int(usable.sum()),
        _quantiles(sigma)[2],
        _quantiles(crb)[2],
        _quantiles(qcrb)[2],
        _quantiles(sigma / crb),
        _quantiles(qcrb / crb),
        float(_quantiles((qcrb / crb) ** 2)[2]),
    )


def _quantiles(values: FloatArray) -> FloatArray:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(5, np.nan)
    return np.asarray(np.quantile(finite, [0.05, 0.25, 0.5, 0.75, 0.95]), dtype=np.float64)


def number(value: float | None, digits: int = 3) -> str:
    """Write a number for people.

    Parameters
    ----------
    value : float or None
        The number.
    digits : int
        Significant digits.

    Returns
    -------
    str
        Plain notation with a true minus sign; a dash for NaN and None.
    """
    if value is None or not math.isfinite(value):
        return "—"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa}×10{raised}".replace("-", "−")
    decimals = 0 if value == 0 else max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def decimals_for(errors: Iterable[float | None], digits: int = 2) -> int:
    """Give the decimals with which a column of numbers lines up.

    Parameters
    ----------
    errors : iterable of float or None
        Errors of the numbers, or the numbers; what is zero or missing does not count.
    digits : int
        Digits of the smallest that are shown.

    Returns
    -------
    int
        0 to 8; 2 where there is nothing to go by.
    """
    known = [abs(e) for e in errors if e is not None and math.isfinite(e) and e != 0]
    return min(8, max(0, digits - 1 - math.floor(math.log10(min(known))))) if known else 2


def fixed(value: float | None, decimals: int) -> str:
    """Write a number with so many decimals.

    Parameters
    ----------
    value : float or None
        The number.
    decimals : int
        From `decimals_for`.

    Returns
    -------
    str
        With a true minus sign; a dash for NaN and None.
    """
    if value is None or not math.isfinite(value):
        return "—"
    return f"{value:.{decimals}f}".replace("-", "−")


def _percent(value: float) -> str:
    return "—" if not math.isfinite(value) else f"{number(100 * value, 2)} %"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def report_context(analysis: Analysis, figures: Mapping[str, int]) -> dict[str, Any]:
    """Gather everything ``report.html`` shows.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    figures : mapping of str to int
        Number of figure files of each kind beside the page: ``events`` and ``corners``.

    Returns
    -------
    dict
        The template's context.
    """
    table = event_table(analysis)
    free = FREE_PARAMETERS[analysis.mode]
    precision = [precision_of(table, name) for name in free]
    main = "mass_kda" if "mass_kda" in free else "z_nm"
    views = views_of_rows(table, analysis.views)
    images = event_images(views, analysis.scheme)
    posteriors, refused, sampled = posterior_densities(views, table)
    source = analysis.provenance.input_path
    name = PurePath(source.replace("\\", "/")).name or "Analysis"
    sections = [
        ("summary", "Summary"),
        ("distributions", "Distributions" if len(table) else "Field"),
        *([("precision", "Precision"), ("events", "Events")] if len(table) else []),
        ("posterior", "Posterior"),
        ("diagnostics", "Diagnostics"),
        ("configuration", "Configuration"),
        ("provenance", "Provenance"),
    ]
    has_posteriors = any(sampled)
    if not has_posteriors:
        sections.remove(("posterior", "Posterior"))
    n_images = len(images)
    return {
        "title": name,
        "kicker": "iscat-analysis",
        "subtitle": (
            f"{_SCHEMES.get(analysis.scheme, analysis.scheme)}, {analysis.mode} mode: "
            f"{_MODES[analysis.mode]}. Analysed {_when(analysis.provenance.started)}."
        ),
        "nav": sections,
        "footer": "iscat-analysis " + str(analysis.provenance.versions.get("iscat-analysis", "")),
        "n_events": len(table),
        "headline": _headline(table, precision, main, analysis.mode),
        "tiles": _tiles(table, precision, main),
        "ladder": _ladder(precision) if any(p.events for p in precision) else None,
        "precision_rows": [_precision_row(p) for p in precision],
        "main": main,
        "main_label": LABELS[main],
        "main_unit": UNITS[main],
        "warnings": list(analysis.warnings),
        "statuses": _statuses(table),
        "flags": _flags(table),
        "chi2": _histogram_spec(table["chi2_reduced"], "reduced χ²", rule=1.0),
        "p_values": _histogram_spec(table["p_value"], "p-value", domain=(0.0, 1.0)),
        "power": _power_spec(analysis),
        "noise": _noise_spec(analysis.summary.get("landing")),
        "landing": _landing_lines(analysis.summary),
        "embedded": n_images,
        "embedding_note": (
            f"To keep this page small it holds the images of the first {n_images} of "
            f"{len(table)} events; the numbers of all are in the table."
            if 0 < n_images < len(table)
            else None
        ),
        "has_posteriors": has_posteriors,
        "posterior_counts": {
            "sampled": sum(sampled),
            "refused": len(refused),
            "embedded": len(posteriors),
        },
        "refused": bool(refused),
        "refused_rows": [
            [{"text": str(r["event"]), "sort": r["event"]}, r["message"]] for r in refused
        ],
        "config": analysis.config_toml,
        "provenance": _provenance(analysis),
        "versions": [(k, str(v)) for k, v in analysis.provenance.versions.items()],
        "run_summary": _flatten(
            jsonable({k: v for k, v in analysis.summary.items() if k != "distribution"})
        ),
        "figure_counts": figures,
        "data": {
            "mode": analysis.mode,
            "scheme": analysis.scheme,
            "pixel_size_nm": analysis.pixel_size_nm,
            "free": list(free),
            "main": main,
            "labels": LABELS,
            "units": UNITS,
            "advice": {s.value: s.advice for s in Status},
            "columns": {
                name: rounded(table[name])
                if name not in ("status", "flags")
                else table[name].tolist()
                for name in EVENT_COLUMNS
            },
            "images": images,
            "posteriors": posteriors,
            "refused": {str(item["row"]): item["message"] for item in refused},
            "field": field_image(analysis),
        },
    }


def _headline(
    table: pd.DataFrame, precision: Sequence[Precision], main: str, mode: str
) -> list[str]:
    """Say in two or three sentences what was found."""
    n = len(table)
    if not n:
        return [
            "Nothing was found in this movie that stands out from its noise. If particles can be "
            "seen by eye, look at the field image and the laser power below, then at "
            "detection.polarity, detection.false_alarms_per_movie and the two frame ranges."
        ]
    rows = "fitted position" if mode == "track" else "event"
    good = table[table["status"] == Status.OK.value]
    lines = [
        f"{_count(n, rows)}, of which {len(good)} fitted without reservation."
        if n > 1
        else f"One {rows}, fitted with status “{table['status'].iloc[0]}”."
    ]
    values = good[main].to_numpy(float)
    values = values[np.isfinite(values)]
    if values.size > 1:
        _, low, middle, high, _ = _quantiles(np.abs(values))
        what = "mass" if main == "mass_kda" else "height"
        lines[0] += (
            f" Median {what} {number(middle)} {UNITS[main]}, middle half "
            f"{number(low)} to {number(high)} {UNITS[main]}."
        )
    close = next((p for p in precision if p.name == main and p.events), None)
    if close is not None:
        lines.append(
            f"The spread of {LABELS[main]} is {number(close.sigma)} {UNITS[main]}, "
            f"{number(close.over_crb[2])} times the Cramér–Rao bound"
            + (
                f"; the light itself would allow {number(close.qcrb)} {UNITS[main]}, "
                f"so {_percent(close.information)} of its information on {LABELS[main]} is used."
                if math.isfinite(close.information)
                else "."
            )
        )
    return lines


def _tiles(table: pd.DataFrame, precision: Sequence[Precision], main: str) -> list[dict[str, str]]:
    good = table[table["status"] == Status.OK.value]
    flagged = len(table) - len(good)
    tiles = [
        {
            "label": "Events" if table["event"].is_unique else "Fitted positions",
            "value": str(len(table)),
            "note": "none found" if table.empty else f"{len(good)} ok, {flagged} flagged",
        }
    ]
    if not table["event"].is_unique:
        tiles[0]["note"] = f"{table['event'].nunique()} tracks, " + tiles[0]["note"]
    values = good[main].to_numpy(float)
    values = values[np.isfinite(values)]
    leaving = int((values < 0).sum()) if main == "mass_kda" else 0
    _, low, middle, high, _ = _quantiles(np.abs(values))
    note = f"middle half {number(low)} to {number(high)}" if values.size > 1 else ""
    if leaving and values.size == 1:
        note = "leaving; magnitude"
    elif leaving:
        note = f"{values.size - leaving} landing, {leaving} leaving; magnitude"
    what = "mass" if main == "mass_kda" else "height"
    tiles.append(
        {
            "label": f"Median {what}" if values.size > 1 else what.capitalize(),
            "value": number(middle),
            "unit": UNITS[main] if values.size else "",
            "note": note,
        }
    )
    p = next(item for item in precision if item.name == main)
    tiles.append(
        {
            "label": f"Spread of {LABELS[main]} over its CRB",
            "value": number(p.over_crb[2]),
            "unit": "×" if p.events else "",
            "note": f"σ {number(p.sigma)}, CRB {number(p.crb)} {UNITS[main]}" if p.events else "",
        }
    )
    tiles.append(
        {
            "label": f"Information on {LABELS[main]} used",
            "value": _percent(p.information),
            "note": f"(QCRB / CRB)², QCRB {number(p.qcrb)} {UNITS[main]}" if p.events else "",
        }
    )
    return tiles


def _precision_row(p: Precision) -> list[Any]:
    unit = UNITS[p.name]
    return [
        {"text": f"{LABELS[p.name]} [{unit}]"},
        {"text": number(p.sigma), "sort": _sort(p.sigma)},
        {"text": number(p.crb), "sort": _sort(p.crb)},
        {"text": number(p.qcrb), "sort": _sort(p.qcrb)},
        {"text": number(p.over_crb[2]), "sort": _sort(p.over_crb[2])},
        {"text": _percent(p.information), "sort": _sort(p.information)},
        {"text": str(p.events), "sort": p.events},
    ]


def _sort(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _ladder(precision: Sequence[Precision]) -> dict[str, Any]:
    """Build the one picture: every parameter's σ and QCRB in multiples of its CRB."""
    shown = [p for p in precision if p.events]

    def interval(kind: str, color: str, label: str) -> dict[str, Any]:
        data = np.array([p.over_crb if kind == "sigma" else p.quantum_over_crb for p in shown])
        return {
            "kind": "interval",
            "name": label,
            "color": color,
            "at": list(range(len(shown))),
            "lo2": data[:, 0],
            "lo": data[:, 1],
            "mid": data[:, 2],
            "hi": data[:, 3],
            "hi2": data[:, 4],
            "tips": [
                f"{LABELS[p.name]}: {label}\nmedian {number(row[2])} × CRB\n"
                f"= {number(getattr(p, kind))} {UNITS[p.name]}"
                for p, row in zip(shown, data, strict=True)
            ],
        }

    return {
        "height": 96 + 46 * len(shown),
        "x": {"label": "multiples of the CRB (lower is better)", "scale": "log"},
        "y": {"label": "", "categories": [LABELS[p.name] for p in shown]},
        "series": [
            {"kind": "rule", "name": "CRB", "color": "crb", "axis": "x", "value": 1.0},
            interval("qcrb", "qcrb", "QCRB"),
            interval("sigma", "sigma", "achieved σ"),
        ],
    }


def _statuses(table: pd.DataFrame) -> list[list[Any]]:
    counts = table["status"].value_counts()
    return [
        [
            {"text": s.value, "class": "status" if s is Status.OK else "status flagged"},
            {"text": str(counts[s.value]), "sort": int(counts[s.value])},
            s.advice,
        ]
        for s in Status
        if s.value in counts
    ]


def _flags(table: pd.DataFrame) -> list[tuple[str, int]]:
    known = {s.value for s in Status}
    flags = [f for text in table["flags"] for f in str(text).split(";") if f and f not in known]
    return sorted(((f, flags.count(f)) for f in set(flags)), key=lambda item: -item[1])


def _histogram_spec(
    column: pd.Series,
    label: str,
    *,
    rule: float | None = None,
    domain: tuple[float, float] | None = None,
) -> dict[str, Any] | None:
    values = column.to_numpy(float)
    values = values[np.isfinite(values)]
    if values.size < 2:
        return None
    bins = int(np.clip(np.sqrt(values.size), 8, 40))
    counts, edges = np.histogram(values, bins=20 if domain else bins, range=domain)
    series: list[dict[str, Any]] = [
        {"kind": "bars", "name": "events", "color": "plain", "edges": edges, "counts": counts}
    ]
    if rule is not None:
        series.append({"kind": "rule", "name": "expected", "color": "ink", "axis": "x",
                       "value": rule})  # fmt: skip
    if domain is not None:
        series.append({"kind": "rule", "name": "expected", "color": "ink", "axis": "y",
                       "value": values.size / len(counts)})  # fmt: skip
    x: dict[str, Any] = {"label": label}
    if domain is not None:
        x["domain"] = domain
    return {
        "height": 250,
        "x": x,
        "y": {"label": "events", "zero": True, "whole": True},
        "series": series,
    }


def _power_spec(analysis: Analysis) -> dict[str, Any] | None:
    power = np.asarray(analysis.power, float)
    frames = np.asarray(analysis.power_frames, float)
    if power.size < 2 or not np.isfinite(power).any():
        return None
    if power.size > POWER_POINTS:
        stretches = np.array_split(np.arange(power.size), POWER_POINTS // 2)
        filled = np.where(np.isfinite(power), power, np.nanmedian(power))
        keep = sorted(
            {int(s[pick(filled[s])]) for s in stretches for pick in (np.argmin, np.argmax)}
        )
        power, frames = power[keep], frames[keep]
    return {
        "height": 230,
        "legend": False,
        "x": {"label": "frame"},
        "y": {"label": "laser power, relative"},
        "series": [
            {"kind": "line", "name": "power", "color": "ink", "thin": True,
             "x": frames, "y": np.round(power, 7)},
            {"kind": "rule", "color": "plain", "axis": "y", "value": 1.0},
        ],
    }  # fmt: skip


def _noise_spec(landing: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if not landing or len(landing["noise_frames"]) < 2:
        return None
    return {
        "x": {"label": "frames averaged", "scale": "log"},
        "y": {"label": "variance over shot noise"},
        "series": [
            {"kind": "rule", "name": "shot noise", "color": "ink", "axis": "y", "value": 1.0},
            {"kind": "points", "name": "measured", "color": "sigma",
             "x": landing["noise_frames"], "y": landing["noise_variance_over_shot"]},
        ],
    }  # fmt: skip


def _landing_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Say what a landing movie's windows, drift and added particles came to."""
    landing, injection = summary.get("landing"), summary.get("injection")
    if landing:
        yield (
            f"Windows of {landing['window_frames']} frames; "
            f"{_count(landing['frames_left_out'], 'frame')} left out."
        )
        if landing["drift_px"] is not None:
            y, x = landing["drift_px"]
            yield f"Drift of the fixed pattern: {x:+.3f} px in x, {y:+.3f} px in y.".replace(
                "-", "−"
            )
    if injection and injection["added"]:
        text = (
            f"Of {injection['added']} landings and leavings added to the movie, "
            f"{injection['recovered']} were found again."
        )
        if injection.get("bias_rel") is not None:
            bias, error = (100 * injection[key] for key in ("bias_rel", "bias_rel_se"))
            text += f" The masses of isolated ones are off by {bias:+.1f} ± {error:.1f} %."
        yield text.replace("-", "−")


def _provenance(analysis: Analysis) -> list[tuple[str, str]]:
    p = analysis.provenance
    return [
        ("Command", p.command),
        ("Input", p.input_path),
        ("SHA-256 of the input", p.input_sha256),
        ("Seed", "none" if p.seed is None else str(p.seed)),
        ("Started", p.started),
    ]


def _when(started: str) -> str:
    """Write an ISO time as people do; what is not one stays as it is."""
    try:
        moment = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = f" {moment.tzname()}" if moment.tzinfo else ""
    return f"{moment.day} {moment:%B %Y, %H:%M}{zone}"


def _flatten(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Lay a nested mapping out as dotted names and short values."""
    if isinstance(value, dict):
        return [
            pair
            for key, item in value.items()
            for pair in _flatten(item, f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, float):
        return [(name, number(value, 4))]
    if isinstance(value, list):
        return [(name, ", ".join(text for item in value for _, text in _flatten(item)))]
    return [(name, "—" if value is None else str(value))]
