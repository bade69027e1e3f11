"""Data between steps of the analysis: frozen dataclasses, axes (t, y, x), units in the names."""

from __future__ import annotations

from iscat_analysis.records.analysis import (
    Analysis,
    Clip,
    EventView,
    Film,
    Provenance,
    Trace,
)
from iscat_analysis.records.arrays import (
    BoolArray,
    FloatArray,
    Mapper,
    Progress,
    silent,
)
from iscat_analysis.records.columns import (
    BUDGET_COLUMNS,
    DIPOLE,
    EVENT_COLUMNS,
    EVENTS,
    FRAME_COLUMN,
    FREE_PARAMETERS,
    NO_MODEL,
    PARAMETERS,
    REPEAT_COLUMNS,
    TRACK_COLUMNS,
    TRACKS,
    Column,
    free_parameters,
    track_numbers,
)
from iscat_analysis.records.fits import (
    Alternative,
    Box,
    Candidate,
    FitResult,
    PosteriorResult,
)
from iscat_analysis.records.frames import (
    CountSource,
    FrameSource,
    InPlace,
    PlacedSource,
    StackMetadata,
    Windows,
)
from iscat_analysis.records.rows import flagged, has_only, make_rows, with_diameters
from iscat_analysis.records.verdicts import SEVERITY, Status, TrackStatus, verdict

__all__ = [
    "BUDGET_COLUMNS",
    "DIPOLE",
    "EVENTS",
    "EVENT_COLUMNS",
    "FRAME_COLUMN",
    "FREE_PARAMETERS",
    "NO_MODEL",
    "PARAMETERS",
    "REPEAT_COLUMNS",
    "SEVERITY",
    "TRACKS",
    "TRACK_COLUMNS",
    "Alternative",
    "Analysis",
    "BoolArray",
    "Box",
    "Candidate",
    "Clip",
    "Column",
    "CountSource",
    "EventView",
    "Film",
    "FitResult",
    "FloatArray",
    "FrameSource",
    "InPlace",
    "Mapper",
    "PlacedSource",
    "PosteriorResult",
    "Progress",
    "Provenance",
    "StackMetadata",
    "Status",
    "Trace",
    "TrackStatus",
    "Windows",
    "flagged",
    "free_parameters",
    "has_only",
    "make_rows",
    "silent",
    "track_numbers",
    "verdict",
    "with_diameters",
]
