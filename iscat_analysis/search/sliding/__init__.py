"""Landing movies: sums that slide over the frames, where they jump, and at which frame.

`frames` sums the movie once, in blocks of w/4 frames; `noise` says how long a window w is worth
having; `search` sets the w frames after every boundary between blocks against the w before it;
`dating` finds the frame of a step.
"""

from __future__ import annotations

from iscat_analysis.search.sliding.dating import (
    CREDIBLE,
    StepFrame,
    crosstalk,
    frame_heights,
    locate_step,
)
from iscat_analysis.search.sliding.frames import (
    DARK,
    Chunk,
    Patch,
    cut_off,
    good_frames,
    make_chunk,
    make_tile_chunk,
    measure_frames,
    row_of_sums,
    summed,
    sums_of,
    well_lit,
)
from iscat_analysis.search.sliding.noise import (
    LONGEST_WINDOW,
    MOVIE_SHARE,
    SHORTEST_MOVIE,
    SHORTEST_WINDOW,
    SHOT_LIMITED,
    NoiseCurve,
    choose_window,
    longest_window,
    measure_motion,
    measure_noise,
)
from iscat_analysis.search.sliding.rises import common_rise, go_on_rising
from iscat_analysis.search.sliding.search import (
    CORRELATION,
    STRIDES,
    Filter,
    MapArray,
    Peak,
    boundaries,
    find_steps,
    make_filter,
    sliding_maps,
    stride_of,
)
from iscat_analysis.search.sliding.tiles import FieldSums, Tile

__all__ = [
    "CORRELATION",
    "CREDIBLE",
    "DARK",
    "LONGEST_WINDOW",
    "MOVIE_SHARE",
    "SHORTEST_MOVIE",
    "SHORTEST_WINDOW",
    "SHOT_LIMITED",
    "STRIDES",
    "Chunk",
    "FieldSums",
    "Filter",
    "MapArray",
    "NoiseCurve",
    "Patch",
    "Peak",
    "StepFrame",
    "Tile",
    "boundaries",
    "choose_window",
    "common_rise",
    "crosstalk",
    "cut_off",
    "find_steps",
    "frame_heights",
    "go_on_rising",
    "good_frames",
    "locate_step",
    "longest_window",
    "make_chunk",
    "make_filter",
    "make_tile_chunk",
    "measure_frames",
    "measure_motion",
    "measure_noise",
    "row_of_sums",
    "sliding_maps",
    "stride_of",
    "summed",
    "sums_of",
    "well_lit",
]
