"""What the report page is told: headline numbers in words, and compact data for its scripts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import PurePath
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.records import (
    EVENT_COLUMNS,
    FREE_PARAMETERS,
    Analysis,
    Status,
)
from iscat_analysis.report.numbers import LABELS, UNITS, count, number, percent
from iscat_analysis.report.pack import (
    event_images,
    field_image,
    posterior_densities,
    rounded,
    views_of_rows,
)
from iscat_analysis.report.precision import (
    Precision,
    ladder,
    precision_of,
    precision_row,
    quantiles,
)
from iscat_analysis.report.tables import event_table
from iscat_analysis.schemas import jsonable

POWER_POINTS = 1500
"""Points of the power curve; longer ones keep the extremes of each stretch."""

_MODES = {
    "mass": "position and mass, height fixed",
    "localize": "position in three dimensions, mass fixed",
    "joint": "position in three dimensions and mass",
    "track": "position and mass in every frame, linked into tracks",
}
_SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "Dark field"}


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
        "ladder": ladder(precision) if any(p.events for p in precision) else None,
        "precision_rows": [precision_row(p) for p in precision],
        "main": main,
        "main_label": LABELS[main],
        "main_unit": UNITS[main],
        "warnings": list(analysis.warnings),
        "statuses": _statuses(table),
        "flags": _flags(table),
        "chi2": _histogram_spec(table["chi2_reduced"], "reduced χ²", rule=1.0),
        "p_values": _histogram_spec(table["p_value"], "p-value", domain=(0.0, 1.0)),
        "power": _power_spec(analysis),
        "noise": _noise_spec(analysis.summary.get("landing") or analysis.summary.get("background")),
        "measured": _measured_lines(analysis.summary),
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
        f"{count(n, rows)}, of which {len(good)} fitted without reservation."
        if n > 1
        else f"One {rows}, fitted with status “{table['status'].iloc[0]}”."
    ]
    values = good[main].to_numpy(float)
    values = values[np.isfinite(values)]
    if values.size > 1:
        _, low, middle, high, _ = quantiles(np.abs(values))
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
                f"so {percent(close.information)} of its information on {LABELS[main]} is used."
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
    _, low, middle, high, _ = quantiles(np.abs(values))
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
            "value": percent(p.information),
            "note": f"(QCRB / CRB)², QCRB {number(p.qcrb)} {UNITS[main]}" if p.events else "",
        }
    )
    return tiles


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


def _noise_spec(noise: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if not noise or len(noise["noise_frames"]) < 2:
        return None
    return {
        "x": {"label": "frames averaged", "scale": "log"},
        "y": {"label": "variance over shot noise"},
        "series": [
            {"kind": "rule", "name": "shot noise", "color": "ink", "axis": "y", "value": 1.0},
            {"kind": "points", "name": "measured", "color": "sigma",
             "x": noise["noise_frames"], "y": noise["noise_variance_over_shot"]},
        ],
    }  # fmt: skip


def _measured_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Say what windows, drift and added particles came to."""
    landing, injection = summary.get("landing"), summary.get("injection")
    background = summary.get("background")
    if background and background["drift_px"] is not None:
        (y, x), (y_se, x_se) = background["drift_px"], background["drift_error_px"]
        yield (
            f"Drift of the fixed pattern from the background to the frames after it: {x:+.4f} ± "
            f"{x_se:.4f} px in x, {y:+.4f} ± {y_se:.4f} px in y."
        ).replace("-", "−")
    if landing:
        yield (
            f"Windows of {landing['window_frames']} frames; "
            f"{count(landing['frames_left_out'], 'frame')} left out."
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
        if injection.get("stay_frames"):
            text += f" Every particle stayed at least {injection['stay_frames']} frames."
        if injection.get("bias_rel") is not None:
            bias, error = (100 * injection[key] for key in ("bias_rel", "bias_rel_se"))
            spread, doubt = (injection[key] for key in ("spread_over_crb", "spread_over_crb_se"))
            text += (
                f" The masses of isolated ones are off by {bias:+.1f} ± {error:.1f} %, and their "
                f"spread is {spread:.2f} ± {doubt:.2f} times the bound."
            )
        else:
            text += (
                " Too few are isolated to say how far their masses are off: add fewer to a movie "
                "as short as this one."
            )
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
