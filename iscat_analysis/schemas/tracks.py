"""Tracks, as ``iscat fit --mode track`` prints and writes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from iscat_analysis.records import TRACKS, TrackStatus
from iscat_analysis.schemas.base import Closed, Count, Document, Number, key, row_model

if TYPE_CHECKING:
    Track = Closed
else:
    Track = row_model("Track", "One row of tracks.csv.", TRACKS, TrackStatus)


class Motion(Document):
    """Medians and counts of the tracks of a movie; medians are over those that are ok."""

    frame_rate_hz: Number = key("Frames per second; null: there is no D")
    exposure_ms: Number = key("Time over which motion is averaged; null: all of it")
    status: dict[str, Count] = key("Tracks by status")
    flags: dict[str, Count] = key("Tracks by remark")
    medians: dict[str, Number] = key("Of n_frames, mass, D, diameter and refractive index")
    sigma_d_over_d_median: Number = key("Median of σ of D over D")
    begin_inside: Count = key("Tracks that begin inside the field after the first frame")
    end_inside: Count = key("Tracks that end inside the field before the last frame")
    cross_border: Count = key("Tracks that begin or end at the border of the field")
    crossed: Count = key("Tracks that came nearer than detection.min_separation_nm to another")
