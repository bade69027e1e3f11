"""Data between steps of the analysis: frozen dataclasses, axes (t, y, x), units in the names."""

from __future__ import annotations

from iscat_analysis.config import PARAMETERS
from iscat_analysis.records.analysis import Analysis, Clip, EventView, Film, Provenance, Trace
from iscat_analysis.records.columns import (
    BUDGET_COLUMNS,
    DIPOLE,
    EVENT_COLUMNS,
    EVENTS,
    FRAME_COLUMN,
    FREE_PARAMETERS,
    NO_MODEL,
    REPEAT_COLUMNS,
    TRACK_COLUMNS,
    TRACKS,
    Column,
    free_parameters,
    track_numbers,
)
from iscat_analysis.records.rows import (
    POOR_P,
    counted,
    flagged,
    has_flag,
    has_only,
    is_event,
    is_rejected,
    make_rows,
    species_rows,
    tally,
    with_diameters,
)
from iscat_analysis.records.steps import (
    NO_EVENT,
    SEVERITY,
    Alternative,
    BoolArray,
    Box,
    Candidate,
    CountSource,
    FitResult,
    FloatArray,
    FrameSource,
    InPlace,
    IntArray,
    Mapper,
    PlacedSource,
    PosteriorResult,
    Progress,
    StackMetadata,
    Status,
    TrackStatus,
    Windows,
    silent,
    verdict,
)
