"""How near the fits came to their bounds, in one table and one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.records import FloatArray, Status
from iscat_analysis.report.numbers import LABELS, UNITS, number, percent


@dataclass(frozen=True)
class Precision:
    """How near the fits of one parameter came to its bounds, over the events that are ok.

    Attributes
    ----------
    name : str
        As in `PARAMETERS`.
    events : int
        Events with a usable σ and CRB.
    sigma, crb, qcrb : float
        Medians [nm or kDa]; NaN where there is none.
    over_crb : ndarray, shape (5,)
        5, 25, 50, 75 and 95 % quantiles of σ/CRB.
    quantum_over_crb : ndarray, shape (5,)
        The same of QCRB/CRB.
    information : float
        Median of (QCRB/CRB)², the share of the light's information that the measurement uses.
    """

    name: str
    events: int
    sigma: float
    crb: float
    qcrb: float
    over_crb: FloatArray
    quantum_over_crb: FloatArray
    information: float


def precision_of(table: pd.DataFrame, name: str) -> Precision:
    """Set the spread of one parameter beside its bounds.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    name : str
        As in `PARAMETERS`.

    Returns
    -------
    Precision
        Over the rows whose status is ok; NaN where nothing is known.
    """
    good = table[table["status"] == Status.OK.value]
    sigma, crb, qcrb = (good[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb"))
    usable = np.isfinite(sigma) & np.isfinite(crb) & (crb > 0)
    sigma, crb, qcrb = sigma[usable], crb[usable], qcrb[usable]
    return Precision(
        name,
        int(usable.sum()),
        quantiles(sigma)[2],
        quantiles(crb)[2],
        quantiles(qcrb)[2],
        quantiles(sigma / crb),
        quantiles(qcrb / crb),
        float(quantiles((qcrb / crb) ** 2)[2]),
    )


def quantiles(values: FloatArray) -> FloatArray:
    """Give the 5, 25, 50, 75 and 95 % quantiles of what is finite.

    Parameters
    ----------
    values : ndarray
        Any shape.

    Returns
    -------
    ndarray, shape (5,)
        NaN where nothing is finite.
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(5, np.nan)
    return np.asarray(np.quantile(finite, [0.05, 0.25, 0.5, 0.75, 0.95]), dtype=np.float64)


def precision_row(p: Precision) -> list[Any]:
    """Give the cells of one row of the table of precisions.

    Parameters
    ----------
    p : Precision
        Of one parameter.

    Returns
    -------
    list
        Cells as the page's tables take them.
    """
    unit = UNITS[p.name]
    return [
        {"text": f"{LABELS[p.name]} [{unit}]"},
        {"text": number(p.sigma), "sort": _sort(p.sigma)},
        {"text": number(p.crb), "sort": _sort(p.crb)},
        {"text": number(p.qcrb), "sort": _sort(p.qcrb)},
        {"text": number(p.over_crb[2]), "sort": _sort(p.over_crb[2])},
        {"text": percent(p.information), "sort": _sort(p.information)},
        {"text": str(p.events), "sort": p.events},
    ]


def _sort(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def ladder(precision: Sequence[Precision]) -> dict[str, Any]:
    """Build the one picture: every parameter's σ and QCRB in multiples of its CRB.

    Parameters
    ----------
    precision : sequence of Precision
        One of each free parameter.

    Returns
    -------
    dict
        The chart, as the page's script takes it.
    """
    shown = [p for p in precision if p.events]

    def interval(kind: str, color: str, label: str) -> dict[str, Any]:
        data = np.array([p.over_crb if kind == "sigma" else p.quantum_over_crb for p in shown])
        return {
            "kind": "interval",
            "name": label,
            "color": color,
            "at": list(range(len(shown))),
            "lo2": data[:, 0],
            "lo": data[:, 1],
            "mid": data[:, 2],
            "hi": data[:, 3],
            "hi2": data[:, 4],
            "tips": [
                f"{LABELS[p.name]}: {label}\nmedian {number(row[2])} × CRB\n"
                f"= {number(getattr(p, kind))} {UNITS[p.name]}"
                for p, row in zip(shown, data, strict=True)
            ],
        }

    return {
        "height": 96 + 46 * len(shown),
        "x": {"label": "multiples of the CRB (lower is better)", "scale": "log"},
        "y": {"label": "", "categories": [LABELS[p.name] for p in shown]},
        "series": [
            {"kind": "rule", "name": "CRB", "color": "crb", "axis": "x", "value": 1.0},
            interval("qcrb", "qcrb", "QCRB"),
            interval("sigma", "sigma", "achieved σ"),
        ],
    }
