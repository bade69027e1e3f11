"""Positions of a track that are far from its others for a frame or two: they are replaced.

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
_OUTLIER_RMS = 5.0  # rms of the distance from there; of normal errors 1 in 10¹¹ is larger


def without_outliers(rows: Localizations) -> Localizations:
    """Replace outlying positions of each track by the median of those before and after."""
    theta = rows.theta.copy()
    for k in np.unique(rows.track):
        mine = np.flatnonzero(rows.track == k)
        if len(mine) < _AROUND:
            continue
        positions = theta[mine, :2]
        usual = median_filter(positions, size=(_AROUND, 1), mode="nearest")
        distance_squared = ((positions - usual) ** 2).sum(axis=1)
        outliers = distance_squared > _OUTLIER_RMS**2 * mean_square(positions - usual)
        theta[mine[outliers], :2] = usual[outliers]
        theta[mine[outliers], 3] = np.median(theta[mine, 3])
    return replace(rows, theta=theta)
