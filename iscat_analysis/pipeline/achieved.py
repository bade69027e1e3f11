"""The measured spread of an analysis: columns ``repeat_*``, and the pooled ratio to the bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from iscat_analysis.inference.achieved import Achieved, pooled
from iscat_analysis.records import FREE_PARAMETERS, FloatArray, Status
from iscat_analysis.search.empty import EmptySpread

_NOISE_SHOWS = frozenset({Status.OK.value, Status.POOR_FIT.value})
"""Verdicts with which the noise can still be read; excess noise itself makes fits poor."""


def measure_spread(
    mode: str, table: pd.DataFrame, repeats: Sequence[FloatArray], empty: EmptySpread | None
) -> dict[str, Achieved]:
    """Pool the repeats of all events that are ok or whose only fault is a poor fit.

    Parameters
    ----------
    mode : str
        Key of `FREE_PARAMETERS`.
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    repeats : sequence of ndarray
        Of each row, from `iscat_analysis.inference.repeats.repeats_of`.
    empty : EmptySpread or None
        The noise of whole windows, where it was looked at.

    Returns
    -------
    dict of str to Achieved
        By free parameter; empty where no event has repeats.
    """
    kept = [
        repeat
        for repeat, status, flags in zip(repeats, table["status"], table["flags"], strict=True)
        if {status, *str(flags).split(";")} - {""} <= _NOISE_SHOWS
    ]
    if not kept:
        return {}
    own = np.stack(kept)
    found: dict[str, Achieved] = {}
    for k, name in enumerate(FREE_PARAMETERS[mode]):
        one = pooled(
            own[:, :, [k, -1]],
            None if empty is None else empty.squares[:, k],
            None if empty is None else empty.counts,
        )
        if one is not None:
            found[name] = one
    return found


def with_repeats(mode: str, table: pd.DataFrame, repeats: Sequence[FloatArray]) -> pd.DataFrame:
    """Add the columns ``repeat_*``: the error of each event as parts of its own frames show it.

    Parameters
    ----------
    mode : str
        Key of `FREE_PARAMETERS`.
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    repeats : sequence of ndarray
        Of each row.

    Returns
    -------
    pandas.DataFrame
        A copy; NaN where the frames could not be compared.
    """
    columns = {}
    for k, name in enumerate(FREE_PARAMETERS[mode]):
        squares, counts = (np.array([r[0, i] for r in repeats], dtype=float) for i in (k, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            columns[f"repeat_{name}"] = table[f"crb_{name}"] * np.sqrt(squares / counts)
    return table.assign(**columns)


def with_measured_sigma(table: pd.DataFrame, found: Mapping[str, Achieved]) -> pd.DataFrame:
    """Scale σ by the measured spread over the bound, for ``fit.sigma = "measured"``.

    Parameters
    ----------
    table : pandas.DataFrame
        With columns ``sigma_*``.
    found : mapping of str to Achieved
        From `measure_spread`.

    Returns
    -------
    pandas.DataFrame
        A copy; σ never becomes smaller.
    """
    return table.assign(
        **{f"sigma_{name}": table[f"sigma_{name}"] * max(a.over_crb, 1.0)
           for name, a in found.items()}
    )  # fmt: skip
