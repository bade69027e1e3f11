"""What the stages hand to one another: frozen dataclasses, axes (t, y, x), units in the names."""

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
    EVENT_COLUMNS,
    FRAME_COLUMN,
    FREE_PARAMETERS,
    PARAMETERS,
    REPEAT_COLUMNS,
    TRACK_COLUMNS,
    flagged,
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
from iscat_analysis.records.verdicts import SEVERITY, Status, TrackStatus, verdict

__all__ = [
    "BUDGET_COLUMNS",
    "EVENT_COLUMNS",
    "FRAME_COLUMN",
    "FREE_PARAMETERS",
    "PARAMETERS",
    "REPEAT_COLUMNS",
    "SEVERITY",
    "TRACK_COLUMNS",
    "Alternative",
    "Analysis",
    "BoolArray",
    "Box",
    "Candidate",
    "Clip",
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
    "silent",
    "track_numbers",
    "verdict",
]
