"""Refractive indices of spheres, and what is said where pictures do not tell them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event
from iscat_analysis.inference.free_index import fit_index
from iscat_analysis.records import verdict
from iscat_analysis.units import count

Told = tuple[float, float]
"""q of d^q (n − n_s), which a picture tells best, and its relative standard error."""


def with_index(context: AnalysisContext, event: Event) -> tuple[Event, Told | None]:
    """Fit the index of a sphere as well, if wanted; give what the picture tells if that is less."""
    config = context.config.fit
    if not config.index:
        return event, None
    own = fit_index(event.likelihood, event.fit, config.z_range_nm)
    flags = verdict([*own.fit.flags, *(set(event.flags) - set(event.fit.flags))])[1]
    told = None if own.is_told else (own.power, own.sigma)
    return replace(event, likelihood=own.likelihood, fit=own.fit, flags=flags), told


def untold_message(untold: Sequence[Told], missing: int, total: int, n_sample: float) -> str:
    """Say what pictures tell that do not tell diameter and index apart; empty if all do."""
    if not missing:
        return ""
    known = [told for told in untold if math.isfinite(told[1])]
    said = ""
    if known:
        power, sigma = np.median(known, axis=0).tolist()
        said = f": they tell d^{power:.2g} (n − {n_sample:g}) to {100 * sigma:.2g} %"
    return (
        f"the pictures of {missing} of {count(total, 'sphere')} do not tell diameter and index "
        f"apart{said}; refractive_index is empty, and diameter_nm that of the configured index"
    )
