"""Whether particles whose fits with free heights are rejected stay at one height.

Of particles on a membrane the height tells nothing that their masses do not, and a background that
is learnt with them may take rings for particles at other heights, until no row is described.  Then
some of the frames are followed once more with all heights held where the configuration has them.
That is a special case of heights that are free: where it describes what these do not, they were
lost, and not the optics wrong.  Particles that move along z turn their phase by half within 100 nm,
and no single height describes them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, CountSource, Status, silent
from iscat_analysis.tracking.moving import find_rows_and_background
from iscat_analysis.tracking.moving_field import tracking_context
from iscat_analysis.tracking.moving_table import moving_table

MOST_REJECTED = 0.5
"""Share of the rows with free heights beyond which these are doubted."""

FEW_REJECTED = 0.25
"""Share of the rows at one height up to which it describes them: of membranes a hundredth is."""

_LOOKED_AT = 200  # frames
_ENOUGH = 30  # rows that tell
_REJECTED = "|".join([Status.NOT_CONVERGED, Status.AT_BOUND, Status.POOR_FIT])


def held_height_warning(
    config: Config,
    movie: CountSource,
    camera: Camera,
    span: tuple[int, int],
    fits: pd.DataFrame,
    *,
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
) -> str:
    """Say that particles seem to stay at one height, where fits with free heights fail."""
    if config.track.free != "joint" or not len(fits):
        return ""
    first, last = span[0], min(span[1], span[0] + _LOOKED_AT)
    free = _rejected(fits[(fits["frame"] >= first) & (fits["frame"] < last)])
    if free.size == 0 or free.mean() <= MOST_REJECTED:
        return ""
    track = config.track.model_copy(update={"free": "mass"})
    config, (_, tall, wide) = config.model_copy(update={"track": track}), movie.shape
    context = tracking_context(config, (tall, wide), last - first)
    try:
        moving = find_rows_and_background(
            context, movie, camera, (first, last), check=check, pool=pool, progress=silent
        )
    except DataError:  # nothing can be followed at one height
        return ""
    held = _rejected(moving_table(context, moving, first)[moving.field.holds(moving.rows.theta)])
    if held.size < _ENOUGH or 2 * held.size < free.size or held.mean() > FEW_REJECTED:
        return ""
    return (
        f"{movie.name}: the particles seem to stay at one height, as on a membrane: set "
        f'track.free = "mass"; with heights that are free {free.sum()} of {free.size} fits are '
        f"rejected, and with all held at particle.height_nm = {context.model.height_nm:g} it is "
        f"{held.sum()} of {held.size} in the same frames"
    )


def _rejected(rows: pd.DataFrame) -> BoolArray:
    """Tell which rows the model does not describe."""
    return np.asarray(rows["flags"].fillna("").str.contains(_REJECTED), dtype=np.bool_)
