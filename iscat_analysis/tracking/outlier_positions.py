"""Rows that leap aside for a frame or two and come back.

In single frames the best place of a particle may be beside it: on its ring, or where another was
while the background was still wrong.  Such a row says that the particle was not where the
background of all other frames has it, so that the mass of one that hardly moves hangs on this row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from iscat_analysis.tracking.joint.localizations import Localizations
from iscat_analysis.tracking.linking import mean_square

_AROUND = 5  # rows of a track, to whose median each is compared
_LEAP = 5.0  # root mean squares of the distance from there; further are 1 in 10¹¹ of normal ones


def without_outliers(rows: Localizations) -> Localizations:
    """Put rows that leap aside among those before and after them."""
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        if len(mine) < _AROUND:
            continue
        places = theta[mine, :2]
        usual = median_filter(places, size=(_AROUND, 1), mode="nearest")
        aside = ((places - usual) ** 2).sum(axis=1)
        leaps = aside > _LEAP**2 * mean_square(places - usual)
        theta[mine[leaps], :2] = usual[leaps]
        theta[mine[leaps], 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)
