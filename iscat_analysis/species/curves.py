"""What is drawn: a histogram, a kernel density and the species as curves."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import gammaincinv, logsumexp, ndtr

from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture

HISTOGRAM_COLUMNS = ("low_kda", "high_kda", "count", "count_low", "count_high")
"""Columns of `Distribution.histogram`."""

CURVE_COLUMNS = ("mass_kda", "density", "density_se", "model", "model_corrected", "efficiency")
"""Columns of `Distribution.curves`."""

NOISES = np.linspace(0.05, 0.95, 10)
"""Quantiles that stand for the events' own noise."""

_POINTS = 300
_MOST_BINS = 240


def bandwidth_of(events: Events, species: int) -> float:
    """Apply Scott's rule to one peak no wider than the measurement error."""
    each = max(events.x.size / species, 1.0)
    return float(1.06 * np.median(events.sigma) * each**-0.2)


def poisson_interval(counts: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Give 95 % intervals of counts (Garwood, Biometrika 28, 437, 1936)."""
    n = np.asarray(counts)
    low = np.where(n > 0, gammaincinv(np.maximum(n, 1), 0.025), 0.0)
    return low, np.asarray(gammaincinv(n + 1, 0.975))


def round_width(wanted: float) -> float:
    """Give the width of a bar that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(wanted))
    return min((power, 2 * power, 5 * power, 10 * power), key=lambda w: abs(w / wanted - 1))


def histogram_of(events: Events) -> pd.DataFrame:
    """Count, with 95 % intervals."""
    edges = _edges(events)
    counts = np.histogram(events.x, edges)[0]
    columns = edges[:-1], edges[1:], counts, *poisson_interval(counts)
    return pd.DataFrame(dict(zip(HISTOGRAM_COLUMNS, columns, strict=True)))


def curves_of(events: Events, best: Mixture, bandwidth: float) -> pd.DataFrame:
    """Give densities per kDa: kernel with its Poisson error, model as seen and as it came."""
    mass = np.linspace(0.0, _reach(events), _POINTS)
    z = (mass[:, np.newaxis] - events.x) / bandwidth
    kernel = np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * bandwidth)
    pieces = [
        np.exp(logsumexp(best.log_terms(Events(mass, np.full(mass.shape, sigma), None)), axis=1))
        for sigma in np.quantile(events.sigma, NOISES)
    ]
    arrived = best.arrived(events) * np.mean(pieces, axis=0)
    return pd.DataFrame(
        {
            "mass_kda": mass,
            "density": kernel.sum(axis=1),
            "density_se": np.sqrt(np.sum(kernel**2, axis=1)),
            "model": arrived * _selected(events, mass),
            "model_corrected": arrived,
            "efficiency": events.efficiency(mass) if events.efficiency else np.ones(mass.shape),
        }
    )


def _reach(events: Events) -> float:
    """Upper end of the figure: a few very heavy events must not compress all others."""
    most = float(np.quantile(events.x, 0.98)) * 1.3
    return min(float(events.x.max()), most) + 3 * float(np.median(events.sigma))


def _edges(events: Events) -> FloatArray:
    """Edges of bins about as wide as the errors allow."""
    reach = _reach(events)
    wanted = max(
        2.0 * float(np.median(events.sigma)) * (events.x.size / 3) ** (-1 / 3) * 1.7,
        reach / _MOST_BINS,
    )
    width = round_width(wanted)
    return np.asarray(np.arange(math.ceil(reach / width) + 1) * width)


def _selected(events: Events, x: FloatArray) -> FloatArray:
    """Probability that an event of measured mass x was detected, averaged over its noise."""
    if events.efficiency is None:
        return np.ones(x.shape)
    extra = events.efficiency.extra_sigma(np.quantile(events.sigma, NOISES))
    at = x[:, np.newaxis] - np.maximum(events.efficiency.threshold_kda, 0.0)
    return np.asarray(ndtr(at / np.maximum(extra, 1e-9)).mean(axis=1))
