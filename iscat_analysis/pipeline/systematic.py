"""Errors that are common to all events of a movie, beside the spread of each event.

Each source of such an error gives, for every event, a standard deviation of the parameters that it
moves; independent sources add in quadrature.  A new source is a function like `_of_the_line` and an
entry in `_SOURCES`.  These errors are columns of their own and are never mixed into σ: they do not
shrink when events are averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from iscat_analysis.calibration.mass import line_sigma_kda
from iscat_analysis.config import Config
from iscat_analysis.records import PARAMETERS, FloatArray

Source = Callable[[Config, pd.DataFrame], Mapping[str, FloatArray]]
"""Gives, by parameter, the standard deviation for every event; none for what it does not move."""


def systematic(config: Config, table: pd.DataFrame) -> dict[str, FloatArray]:
    """Add up the errors that all events of a movie share.

    Parameters
    ----------
    config : Config
        Says what was calibrated, and how well.
    table : pandas.DataFrame
        Events, with the columns of ``fits.csv``.

    Returns
    -------
    dict of str to ndarray
        Parameter (`PARAMETERS`) → standard deviation of every event [nm or kDa]; only of those
        parameters for which an error is known.
    """
    squares: dict[str, FloatArray] = {}
    for source in _SOURCES:
        for name, sigma in source(config, table).items():
            squares[name] = squares.get(name, np.zeros(len(table))) + np.square(sigma)
    return {name: np.sqrt(squares[name]) for name in PARAMETERS if name in squares}


def with_systematic(config: Config, table: pd.DataFrame) -> pd.DataFrame:
    """Put the columns ``systematic_*`` after ``flags``.

    Parameters
    ----------
    config : Config
        Says what was calibrated, and how well.
    table : pandas.DataFrame
        Events, with the columns of ``fits.csv``.

    Returns
    -------
    pandas.DataFrame
        The same table where no such error is known.
    """
    found = systematic(config, table)
    if not found:
        return table
    changed = table.copy()
    place = list(table.columns).index("flags") + 1
    for name in reversed(found):
        changed.insert(place, f"systematic_{name}", found[name])
    return changed


def _of_the_line(config: Config, table: pd.DataFrame) -> Mapping[str, FloatArray]:
    """Give what the line between contrast and mass may be wrong by."""
    line = config.calibration
    if line is None or not (line.gradient_se_per_kda or line.offset_se):
        return {}
    mixed = line.correlation * line.gradient_se_per_kda * line.offset_se
    covariance = np.array([[line.gradient_se_per_kda**2, mixed], [mixed, line.offset_se**2]])
    mass = table["mass_kda"].to_numpy(dtype=float)
    return {"mass_kda": line_sigma_kda(mass, line.gradient_per_kda, covariance)}


_SOURCES: tuple[Source, ...] = (_of_the_line,)
