"""Sentences about the tracks of a movie: for the page, stdout and notebooks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from iscat_analysis.records import Analysis, TrackStatus, tally
from iscat_analysis.report.answer import answers, is_uncalibrated, tracks_caution, tracks_of
from iscat_analysis.report.headline import NOT_A_MASS, headline, spread_lines
from iscat_analysis.units import count


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
    rows = tally(tracks)
    text = (
        f"{count(rows.number, 'track')} of {count(len(fits), 'fitted position')}, "
        f"{rows.ok if rows.flagged else 'all'} of them ok."
    )
    if (flagged := tracks_caution(tracks)) is not None:
        return [f"{text} {flagged}", *spread_lines(analysis, fits), *warned]
    if found := answers(analysis, fits, tracks):
        said = [answer.text[:1].lower() + answer.text[1:] for answer in found]
        text += f" Over tracks: {', '.join(said)}."
    return [text, *spread_lines(analysis, fits), *warned]


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
