"""Contents of the report page of one analysis."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import PurePath
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from iscat_analysis.records import (
    EVENTS,
    FREE_PARAMETERS,
    PARAMETERS,
    Analysis,
    EventView,
    Status,
    free_parameters,
    tally,
)
from iscat_analysis.report.answer import answers, caution, is_uncalibrated, main_quantity
from iscat_analysis.report.budget import COLUMNS as BUDGET_HEADINGS
from iscat_analysis.report.budget import budget_rows
from iscat_analysis.report.event_figures import event_details
from iscat_analysis.report.headline import headline, label_of, precision_of, precision_rows
from iscat_analysis.report.numbers import LABELS, UNITS, decimals_for, fixed, number, percent
from iscat_analysis.report.spread import species_widths
from iscat_analysis.units import count

_MODES = {
    "mass": "position and mass, height fixed",
    "localize": "position in three dimensions, mass fixed",
    "joint": "position in three dimensions and mass",
    "size": "position in three dimensions and diameter of a sphere",
    "track": "position and mass in every frame, linked into tracks",
}
_SIGNS = {
    "mass_kda": "Negative masses are particles that leave.",
    "contrast": "Dark particles that land, and bright ones that leave, have negative contrast.",
}
_SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "Dark field"}


def report_context(analysis: Analysis, table: pd.DataFrame) -> dict[str, Any]:
    """Collect everything that ``report.html`` shows except figures."""
    source = analysis.provenance.input_path
    tracked = analysis.tracks is not None  # then `tracks_context` says what is said of events
    images = {} if tracked else event_details(analysis, table)
    sampled = [view for view in analysis.views if view.posterior is not None]
    started = _when(analysis.provenance.started)
    said = headline(analysis, table)
    precision = [
        precision_of(analysis, table, name) for name in free_parameters(analysis.mode, table)
    ]
    return {
        "title": PurePath(source.replace("\\", "/")).name or "Analysis",
        "subtitle": f"{_SCHEMES[analysis.scheme]}, mode {analysis.mode}: {_MODES[analysis.mode]}. "
        f"{started}".rstrip(),
        "footer": "iscat-analysis "
        f"{analysis.provenance.versions.get('iscat-analysis', '')}, {started}".rstrip(", "),
        "n_events": len(table),
        "cautions": [text for text in said if text.startswith("Not calibrated")],
        "headline": [text for text in said if not text.startswith("Not calibrated")],
        "flagged": caution(table) is not None,
        "tiles": _tiles(analysis, table),
        "totals": f"{tally(table).text()}.",
        "has_common": any(math.isfinite(p.systematic) for p in precision),
        "has_measured": any(p.is_measured for p in precision),
        "single_frames": analysis.mode == "track",
        "budget_rows": budget_rows(analysis),
        "budget_columns": BUDGET_HEADINGS,
        "spread_lines": species_widths(analysis.summary),
        "has_holevo": any(math.isfinite(p.holevo) for p in precision),
        "precision_rows": precision_rows(analysis, precision),
        "warnings": analysis.warnings,
        "main_label": main_quantity(analysis).label.capitalize(),
        "signs": _SIGNS.get(main_quantity(analysis).column),
        "events": {} if tracked else event_rows(analysis, table),
        "has_traces": any(detail.trace for detail in images.values()),
        "images": {str(row): list(packed) for row, packed in images.items()},
        "embedding_note": f"To keep this page small it holds the images of the first {len(images)} "
        f"of {len(table)} rows."
        if 0 < len(images) < len(table)
        else None,
        "posterior_rows": list(_posterior_rows(sampled, table)),
        "refused_rows": [
            [str(view.event), view.posterior.message]
            for view in sampled
            if view.posterior is not None and not view.posterior.converged
        ],
        "statuses": _statuses(table),
        "measured": list(measured_lines(analysis.summary)),
        "config": analysis.config_toml,
        "provenance": [
            ("Command", analysis.provenance.command),
            ("Input", source),
            ("SHA-256 of the input", analysis.provenance.input_sha256),
            ("Seed", "none" if analysis.provenance.seed is None else analysis.provenance.seed),
            ("Started", analysis.provenance.started),
            *((name, str(version)) for name, version in analysis.provenance.versions.items()),
        ],
    }


def _tiles(analysis: Analysis, table: pd.DataFrame) -> list[dict[str, str]]:
    """Make the large numbers at the top: counts and precision."""
    rows, found = tally(table), answers(analysis, table)
    tiles = [
        {
            "label": "Events",
            "value": str(rows.number),
            "note": f"{rows.ok} ok, {rows.flagged} flagged",
        }
    ]
    if not found:
        return tiles
    tiles += [asdict(answer) for answer in found]
    heights = analysis.summary.get("heights")
    if heights is not None and not heights["held"]:
        tiles.append(
            {
                "label": "Heights",
                "value": f"{fixed(heights['mean_nm'], 1)} ± {fixed(heights['sd_nm'], 1)}",
                "unit": "nm",
                "note": f"mean, to ± {fixed(heights['mean_se_nm'], 1)}, and standard deviation",
            }
        )
    name = "mass_kda" if "mass_kda" in FREE_PARAMETERS[analysis.mode] else "z_nm"
    if (p := precision_of(analysis, table, name)).events:
        label, unit = LABELS[name], UNITS[name]
        said = (
            f"σ {number(p.sigma)}{p.shared}, CRB {number(p.crb)} {unit}",
            f", QCRB {number(p.qcrb)} {unit}",
        )
        best = "QCRB"
        if math.isfinite(p.holevo):
            best, said = "Holevo", (said[0], f", Holevo {number(p.holevo)} {unit}")
        if is_uncalibrated(analysis):
            label, said = "contrast", ("median of the events' own ratios", "")
        over = {
            "label": f"σ of {label} over its CRB",
            "value": number(p.over_crb),
            "unit": "×",
            "note": said[0],
        }
        if p.is_measured:
            low, high = p.measured_ci95
            over = {
                "label": f"Measured spread of {label} over its CRB",
                "value": fixed(p.measured, 2),
                "unit": "×",
                "note": f"95 % {fixed(low, 2)} to {fixed(high, 2)}; {said[0]}",
            }
        tiles += [
            over,
            {
                "label": f"Information on {label} used",
                "value": percent(p.information),
                "note": f"({best} / CRB)²{said[1]}",
            },
        ]
    return tiles


def _headings(analysis: Analysis) -> Iterator[tuple[str, str]]:
    """Name the columns of the table of events: place, each fitted quantity with its errors, fit."""
    headed = [column for column in EVENTS if column.heading]
    fitted = [name for name in ("z_nm", "mass_kda") if name in FREE_PARAMETERS[analysis.mode]]
    own = [column for column in headed if column.name.endswith(PARAMETERS)]
    rest = [column for column in headed if column not in own]
    last = rest.index(next(column for column in rest if column.name == "contrast")) + 1
    yield from ((column.name, column.heading) for column in rest[:last])
    for name in fitted:
        yield name, f"{label_of(analysis, name)} [{UNITS[name]}]"
        errors = [column for column in own if column.name.endswith(f"_{name}")]
        for column in sorted(errors, key=lambda column: "crb_" in column.name):
            yield column.name, f"{column.heading} [{column.unit}]"
    yield from ((column.name, column.heading) for column in rest[last:])


def event_rows(analysis: Analysis, table: pd.DataFrame) -> dict[str, Any]:
    """Write the table of events, one column of one kind with the same decimals throughout."""
    shown = {}
    for name, heading in _headings(analysis):
        if name in table and np.isfinite(values := table[name].to_numpy(float)).any():
            scaled = 1e3 * values if name == "contrast" else values
            decimals = 2 if name in ("chi2_reduced", "p_value") else _decimals(scaled)
            shown[heading] = [fixed(value, decimals) for value in scaled]
    lines = []
    for row, cells in enumerate(zip(*shown.values(), strict=True) if shown else [()] * len(table)):
        status = Status(table["status"].iloc[row])
        flags = [f for f in str(table["flags"].iloc[row]).split(";") if f and f != status]
        kind = "status" if status is Status.OK else "status flagged"
        numbers = "".join(f'<td class="num">{cell}' for cell in cells)
        lines.append(
            f'<tr id="row-{row}"><td><button type="button" class="toggle" aria-expanded="false">'
            f'{table["event"].iloc[row]}</button><td class="num">{table["frame"].iloc[row]}'
            f'{numbers}<td class="{kind}" title="{escape(status.advice)}">'
            f"{escape('; '.join([status.value, *flags]))}"
        )
    return {
        "columns": ["event", "frame", *shown, "status"],
        "body": Markup("\n".join(lines)),  # the only text, the flags, is escaped
    }


def _decimals(values: np.ndarray[Any, Any]) -> int:
    """Give the decimals that show three digits of the column's median."""
    return decimals_for([float(np.nanmedian(np.abs(values)))], digits=3)


def _posterior_rows(views: Sequence[EventView], table: pd.DataFrame) -> Iterator[list[str]]:
    for view in views:
        if view.posterior is None or not view.posterior.converged:
            continue
        row = table[table["event"] == view.event].iloc[0]
        bound = view.posterior.van_trees
        low, median, high = np.quantile(view.posterior.samples, [0.15865, 0.5, 0.84135], (0, 1))
        for k, name in enumerate(view.posterior.names):
            decimals = decimals_for([(high[k] - low[k]) / 2])
            yield [
                str(view.event),
                f"{name.split('_')[0]} [{UNITS[name]}]",
                fixed(median[k], decimals),
                f"{fixed(low[k], decimals)} to {fixed(high[k], decimals)}",
                f"{fixed(row[name], decimals)} ± {number(row[f'sigma_{name}'], 2)}",
                number(view.posterior.r_hat[k], 4),
                number(view.posterior.ess_bulk[k]),
                number(float(np.std(view.posterior.samples[..., k])), 3),
                "–" if bound is None else number(bound[k], 3),
            ]


def _statuses(table: pd.DataFrame) -> list[list[str]]:
    """Count the verdicts and the other flags, with what each means."""
    counts = tally(table).status | tally(table).left_out
    rows = [[s.value, str(counts[s.value]), s.advice] for s in Status if s.value in counts]
    flags = table["flags"].str.split(";").explode()
    others = flags[~flags.isin([*Status, ""])].value_counts()
    return rows + [
        [str(flag), str(n), "A remark that makes no verdict."] for flag, n in others.items()
    ]


def measured_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Describe windows, drift and injected particles in sentences."""
    landing, injection = summary.get("landing"), summary.get("injection")
    for name, lines in (("row", "rows"), ("column", "columns")):
        share = summary.get("lines", {}).get(f"{name}_share")
        if share:
            yield (
                f"Whole {lines} flickered ({percent(share)} of the noise variance); each {name} of "
                "each frame was divided by its own light."
            )
    smooth = summary.get("lines", {}).get("smooth_rms")
    if smooth:
        yield (
            f"The light changed slowly over the field ({percent(smooth)} rms between frames that "
            "are compared); each frame was divided by a polynomial of degree "
            f"{summary['lines']['smooth_degree']}."
        )
    fringes = summary.get("lines", {}).get("fringe_periods_px")
    if fringes:
        periods = " and ".join(fixed(period, 1) for period in fringes)
        yield (
            f"Fringes with a period of {periods} pixels passed over the field "
            f"({percent(summary['lines']['fringe_rms'])} rms between frames that are compared); "
            "each frame was divided by its own."
        )
    seams = [
        f"{name} {cut}"
        for name in ("row", "column")
        for cut in summary.get("lines", {}).get(f"seam_{name}s", ())
    ]
    if seams:
        yield (
            f"Parts of the field, which begin at {' and '.join(seams)}, changed as a whole; each "
            "part of each frame was divided by its own light."
        )
    haze = summary.get("lines", {}).get("haze")
    if haze:
        yield (
            f"What is added to all pixels alike changed by {percent(haze)} of the mean light; each "
            "frame was divided by what that makes of it."
        )
    background = summary.get("background")
    if background and background["drift_px"] is not None:
        (y, x), (y_se, x_se) = background["drift_px"], background["drift_error_px"]
        yield (
            "Drift of the fixed pattern from the background to the frames after it: "
            f"{fixed(x, 4)} ± {fixed(x_se, 4)} px in x, {fixed(y, 4)} ± {fixed(y_se, 4)} px in y."
        )
    if landing:
        yield (
            f"Windows of {count(landing['window_frames'], 'frame')}; "
            f"{count(landing['frames_left_out'], 'frame')} left out."
        )
        if landing.get("searched_share") is not None:
            yield (
                f"{percent(landing['searched_share'])} of field and time were searched for "
                f"particles with a signal-to-noise ratio of {number(landing['searched_snr'])}."
            )
        if landing["drift_px"] is not None:
            y, x = landing["drift_px"]
            yield f"Drift of the fixed pattern: {fixed(x, 3)} px in x, {fixed(y, 3)} px in y."
    if injection and injection["added"]:
        text = (
            f"Of {injection['added']} landings and leavings added to the movie, "
            f"{injection['recovered']} were found again."
        )
        if injection.get("predicted") is not None:
            share, best = (100 * injection[key] for key in ("recall", "predicted"))
            text += (
                f" That is {fixed(share, 0)} %; where each is alone, the Fisher information "
                f"predicts {fixed(best, 0)} %."
            )
        if injection.get("stay_frames"):
            text += f" Every particle stayed at least {injection['stay_frames']} frames."
        if injection.get("bias_rel") is not None:
            bias, error = (100 * injection[key] for key in ("bias_rel", "bias_rel_se"))
            spread, doubt = (injection[key] for key in ("spread_over_crb", "spread_over_crb_se"))
            text += (
                f" The masses of isolated ones are off by {fixed(bias, 1)} ± {fixed(error, 1)} %, "
                f"and their spread is {fixed(spread, 2)} ± {fixed(doubt, 2)} times the bound."
            )
        else:
            text += (
                " Too few are isolated to say how far their masses are off: add fewer to a movie "
                "as short as this one."
            )
        yield text


def _when(started: str) -> str:
    """Format an ISO time; other text stays as it is."""
    try:
        moment = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = f" {moment.tzname()}" if moment.tzinfo else ""
    return f"{moment.day} {moment:%B %Y, %H:%M}{zone}"
