"""The number of species: fits with one after another, until BIC stops improving."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture, ascend, height
from iscat_analysis.species.structure import polish

_POLISHED = 2  # starts, the best after climbing


def fit_species(events: Events, max_species: int, *, least: int = 1) -> list[Mixture]:
    """Fit 1, 2, … species; stop after two numbers without a better BIC."""
    fits: list[Mixture] = []
    most = min(max_species, max(1, events.x.size // 5))
    for k in range(1, most + 1):
        starts = [_spread_start(events, k)]
        if fits:
            starts += split_starts(events, fits[-1])
        climbed = sorted(
            (ascend(events, start) for start in starts), key=lambda start: height(events, start)
        )
        tried = [polish(events, start) for start in climbed[-_POLISHED:]]
        fits.append(max(tried, key=lambda fit: fit.log_likelihood))
        bic = [fit.bic(events.x.size) for fit in fits]
        if k >= least and len(fits) - 1 - int(np.argmin(bic)) >= 2:
            break
    return fits


def _spread_start(events: Events, k: int) -> Mixture:
    """Equal shares of the sorted events."""
    parts = np.array_split(np.sort(events.x), k)
    mean = np.array([part.mean() for part in parts])
    variance = np.array([max(part.var(), 1e-12) for part in parts])
    return Mixture(np.full(k, 1 / k), mean, variance)


def split_starts(events: Events, fit: Mixture) -> list[Mixture]:
    """Add a narrow species at the largest excess of events, or split the widest species."""
    starts = []
    sigma = float(np.median(events.sigma))
    places = np.sort(events.x)
    k = fit.weight.size
    for h in (sigma, 4 * sigma):
        near = np.searchsorted(places, places + h) - np.searchsorted(places, places - h)
        expected = np.zeros(places.size)
        for w, m, v in zip(fit.weight, fit.mean, fit.variance, strict=True):
            total = math.sqrt(v + sigma**2)
            expected += w * (ndtr((places + h - m) / total) - ndtr((places - h - m) / total))
        excess = (near - places.size * expected) / np.sqrt(places.size * expected + 1)
        place = float(places[int(np.argmax(excess))])
        starts.append(
            Mixture(
                np.append(fit.weight * (1 - 1 / (2 * k + 2)), 1 / (2 * k + 2)),
                np.append(fit.mean, place),
                np.append(fit.variance, (h / 2) ** 2),
            )
        )
    widest = int(np.argmax(fit.weight * np.sqrt(fit.variance + sigma**2)))
    half = 0.7 * math.sqrt(fit.variance[widest] + sigma**2)
    weight, mean, variance = fit.weight.copy(), fit.mean.copy(), fit.variance.copy()
    weight[widest] /= 2
    mean[widest] -= half
    variance[widest] /= 4
    starts.append(
        Mixture(
            np.append(weight, weight[widest]),
            np.append(mean, fit.mean[widest] + half),
            np.append(variance, variance[widest]),
        )
    )
    return starts


def joined_starts(fit: Mixture) -> list[Mixture]:
    """Merge two neighbouring species."""
    starts = []
    k = fit.weight.size
    for i in range(k - 1):
        pair = slice(i, i + 2)
        weight = fit.weight[pair] / fit.weight[pair].sum()
        mean = float(weight @ fit.mean[pair])
        variance = float(weight @ (fit.variance[pair] + (fit.mean[pair] - mean) ** 2))
        rest = np.r_[0:i, i + 2 : k]
        starts.append(
            Mixture(
                np.append(fit.weight[rest], fit.weight[pair].sum()),
                np.append(fit.mean[rest], mean),
                np.append(fit.variance[rest], variance),
            )
        )
    return starts
