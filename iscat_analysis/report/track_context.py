"""Contents of the report page of a movie of moving particles."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from iscat_analysis.records import TRACKS, Analysis, TrackStatus, tally
from iscat_analysis.report.answer import (
    answers,
    is_uncalibrated,
    main_quantity,
    tracks_caution,
    tracks_of,
)
from iscat_analysis.report.event_figures import event_details
from iscat_analysis.report.films import films_shown
from iscat_analysis.report.headline import NOT_A_MASS, as_contrasts
from iscat_analysis.report.numbers import decimals_for, fixed
from iscat_analysis.report.tracks import track_lines, tracks_headline

_SHOWN = (
    "n_frames", "x_nm", "y_nm", "z_nm", "mass_kda", "sigma_mass_kda", "crb_mass_kda",
    "systematic_mass_kda", "optical_diameter_nm", "sigma_optical_diameter_nm", "d_um2_s",
    "sigma_d_um2_s", "crb_d_um2_s", "diameter_nm", "sigma_diameter_nm",
    "refractive_index", "sigma_refractive_index", "exponent", "p_confinement", "p_anomalous",
    "p_steady", "confinement_nm", "mass_scatter",
)  # fmt: skip
_ERROR_OF = {
    "mass_kda": "sigma_mass_kda",
    "d_um2_s": "sigma_d_um2_s",
    "optical_diameter_nm": "sigma_optical_diameter_nm",
    "diameter_nm": "sigma_diameter_nm",
    "refractive_index": "sigma_refractive_index",
}
_TWO = ("exponent", "p_confinement", "p_anomalous", "p_steady", "mass_scatter")


def tracks_context(
    analysis: Analysis, fits: pd.DataFrame, folder: Path | None = None
) -> dict[str, Any]:
    """Collect what the page shows of tracks instead of events."""
    tracks = tracks_of(analysis)
    numbered = tracks.rename(columns={"track": "event"})
    images = event_details(analysis, numbered)
    headlines = tracks_headline(analysis, fits)
    return {
        "n_events": len(tracks),
        "headline": [text for text in headlines if text != NOT_A_MASS],
        "flagged": bool(len(tracks)) and tracks_caution(tracks) is not None,
        "cautions": [text for text in headlines if text == NOT_A_MASS],
        "tiles": _tiles(analysis, fits),
        "totals": f"{tally(tracks).text('track')}.",
        "events": track_rows(analysis),
        "images": {str(row): list(packed) for row, packed in images.items()},
        "embedding_note": None,
        "films": list(films_shown(analysis, folder)),
        "track_lines": list(track_lines(analysis.summary)),
        "track_statuses": _statuses(tracks),
    }


def _tiles(analysis: Analysis, fits: pd.DataFrame) -> list[dict[str, str]]:
    """Give the large numbers at the top."""
    tracks = tracks_of(analysis)
    rows = tally(tracks)
    note = f"{rows.ok} ok, {rows.flagged} flagged; {len(fits)} fitted positions"
    return [
        {"label": "Tracks", "value": str(rows.number), "note": note},
        *(
            asdict(replace(answer, note="over tracks that are ok"))
            for answer in answers(analysis, fits, tracks)
        ),
    ]


def track_rows(analysis: Analysis) -> dict[str, Any]:
    """Write the table of tracks."""
    tracks = tracks_of(analysis)
    headings = {column.name: column.heading for column in TRACKS}
    names = {name: headings[name] for name in _SHOWN}
    if main_quantity(analysis).column == "contrast":
        tracks = as_contrasts(tracks) if len(tracks) else tracks
        for name in ("mass_kda", "sigma_mass_kda", "crb_mass_kda", "systematic_mass_kda"):
            tracks = tracks.assign(**{name: 1e3 * tracks[name]}) if name in tracks else tracks
            names[name] = names[name].replace("mass", "contrast").replace("kDa", "10⁻³")
    elif is_uncalibrated(analysis):
        names["mass_kda"] = "mass, model scale [kDa]"
    shown: list[tuple[str, list[str]]] = []
    for name, heading in names.items():
        if name not in tracks or not np.isfinite(values := tracks[name].to_numpy(float)).any():
            continue
        spread = tracks[_ERROR_OF[name]].to_numpy(float) if name in _ERROR_OF else values
        decimals = _decimals(spread, 2 if name in _ERROR_OF or name.startswith("sigma") else 3)
        if name in _TWO:
            decimals = 2
        if name in ("n_frames", "x_nm", "y_nm"):
            decimals = 0
        shown.append((heading, [fixed(value, decimals) for value in values]))
    lines = []
    for row in range(len(tracks)):
        status = TrackStatus(tracks["status"].iloc[row])
        flags = [f for f in str(tracks["flags"].iloc[row]).split(";") if f and f != status]
        kind = "status" if status is TrackStatus.OK else "status flagged"
        cells = "".join(f'<td class="num">{column[row]}' for _, column in shown)
        lines.append(
            f'<tr id="row-{row}"><td><button type="button" class="toggle" aria-expanded="false">'
            f'{tracks["track"].iloc[row]}</button><td class="num">'
            f"{tracks['first_frame'].iloc[row]}{cells}"
            f'<td class="{kind}" title="{escape(status.advice)}">'
            f"{escape('; '.join([status.value, *flags]))}"
        )
    return {
        "columns": ["track", "from frame", *(heading for heading, _ in shown), "status"],
        "body": Markup("\n".join(lines)),  # the only text, the flags, is escaped
    }


def _decimals(values: Any, digits: int) -> int:
    """Give the decimals that show so many digits of the median."""
    return decimals_for([float(np.nanmedian(np.abs(values)))], digits=digits)


def _statuses(tracks: pd.DataFrame) -> list[list[str]]:
    """Count statuses and flags of tracks, with their meanings."""
    counts = tracks["status"].value_counts()
    rows = [[s.value, str(counts[s.value]), s.advice] for s in TrackStatus if s.value in counts]
    crossed = sum("crosses" in flags.split(";") for flags in tracks["flags"])
    if crossed:
        rows.append(["crosses", str(crossed), "A remark that makes no verdict: it came near "
                     "another track, where numbers may be exchanged."])  # fmt: skip
    return rows
