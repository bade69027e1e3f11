"""Sentences about the tracks of a movie: for the page, stdout and notebooks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from iscat_analysis.records import TRACK_COLUMNS, Analysis, TrackStatus
from iscat_analysis.report.headline import (
    MOST_FLAGGED,
    NOT_A_MASS,
    headline,
    is_uncalibrated,
    main_quantity,
    spread_lines,
)
from iscat_analysis.report.numbers import number
from iscat_analysis.units import count


def tracks_of(analysis: Analysis) -> pd.DataFrame:
    """Give the tracks of an analysis."""
    found = analysis.tracks
    return pd.DataFrame(columns=list(TRACK_COLUMNS)) if found is None else found


def tracks_headline(analysis: Analysis, fits: pd.DataFrame) -> list[str]:
    """Summarise the tracks in two or three sentences."""
    tracks = tracks_of(analysis)
    warned = [NOT_A_MASS] if is_uncalibrated(analysis) else []
    if fits.empty:
        return headline(analysis, fits)
    if tracks.empty:
        return [
            f"{count(len(fits), 'fitted position')}, and no particle was followed for "
            "track.min_frames: look at the field image, at track.max_step_nm, which is the "
            "farthest a particle goes between frames, and at detection.false_alarms_per_movie."
        ]
    good = tracks[tracks["status"] == TrackStatus.OK]
    text = (
        f"{count(len(tracks), 'track')} of {count(len(fits), 'fitted position')}, "
        f"{len(good) if len(good) < len(tracks) else 'all'} of them ok."
    )
    if (flagged := tracks_caution(tracks)) is not None:
        return [f"{text} {flagged}", *spread_lines(analysis, fits), *warned]
    labelled = [f"{label} {value}" for label, value in medians(analysis)]
    if labelled:
        text += f" Medians over tracks: {', '.join(labelled)}."
    return [text, *spread_lines(analysis, fits), *warned]


def tracks_caution(tracks: pd.DataFrame) -> str | None:
    """Say that too many tracks are flagged for a median."""
    judged = tracks["status"][tracks["status"] != TrackStatus.FEW_FRAMES]  # these have no D
    flagged = judged[judged != TrackStatus.OK]
    if len(flagged) <= MOST_FLAGGED * len(judged):
        return None
    commonest = TrackStatus(Counter(flagged).most_common(1)[0][0])
    return (
        f"{len(flagged)} of {len(judged)} that are long enough are flagged, so no median is given"
        f"{': the rest is no fair sample' if len(flagged) < len(judged) else ''}. The commonest "
        f"reason is {commonest}. {commonest.advice}"
    )


def medians(analysis: Analysis) -> list[tuple[str, str]]:
    """Give the medians over the tracks that are ok, as text with units."""
    tracks = tracks_of(analysis)
    good = tracks[tracks["status"] == TrackStatus.OK]
    main = main_quantity(analysis)
    size = "contrast" if main.column == "contrast" else "mass_kda"
    named = (
        (size, "contrast" if size == "contrast" else "mass", "" if size == "contrast" else "kDa"),
        ("optical_diameter_nm", "optical diameter", "nm"),
        ("d_um2_s", "D", "µm²/s"),
        ("diameter_nm", "hydrodynamic diameter", "nm"),
        ("refractive_index", "refractive index", ""),
    )
    found = [(label, good[name].median(), unit) for name, label, unit in named if name in good]
    return [
        (label, f"{number(value)} {unit}".rstrip()) for label, value, unit in found
        if math.isfinite(value)
    ]  # fmt: skip


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
    lost = motion["end_inside"] + motion["begin_inside"]
    if lost:
        yield (
            f"{motion['begin_inside']} begin and {motion['end_inside']} end inside the field: "
            "particles come from the liquid and go there, meet others, or are lost from sight."
        )


TRACK_HEADINGS: Mapping[str, tuple[str, str, str]] = {
    "mass": ("mass_kda", "sigma_mass_kda", "kDa"),
    "D": ("d_um2_s", "sigma_d_um2_s", "µm²/s"),
    "optical diameter": ("optical_diameter_nm", "sigma_optical_diameter_nm", "nm"),
    "diameter": ("diameter_nm", "sigma_diameter_nm", "nm"),
    "index": ("refractive_index", "sigma_refractive_index", ""),
}
"""Columns of the short table, with their errors and units."""


def advice(tracks: pd.DataFrame) -> Iterator[str]:
    """Explain the flags of tracks."""
    flag_counts = Counter(flag for flags in tracks["flags"] for flag in str(flags).split(";"))
    for status in TrackStatus:
        if flag_counts[status.value]:
            yield f"{count(flag_counts[status.value], 'track')} {status}: {status.advice}"
