"""The number of components: fits with one after another, until BIC stops improving.

A component that is as broad as the background belongs to it, and components whose sum has one
maximum are one species: a shoulder, as of a protein of which some lost a part, is no second
protein, and neither is what a skewed peak has beside a normal one.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from iscat_analysis._kernels.mixture import mixture_score, mixture_sums
from iscat_analysis.records import FloatArray
from iscat_analysis.species.background import broad
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import BACKGROUND, Mixture
from iscat_analysis.species.structure import polish
from iscat_analysis.species.widths import width_prior

_POLISHED = 2  # starts, the best after climbing
FIRST_SHARE = 0.05
"""Of the background, at a start."""

_BROAD = 4.0  # whole widths that the others would have
_REACH, _POINTS = 4.0, 81  # of a component: widths to both sides that are searched for maxima
_ZOOMS, _ZOOM_POINTS = 4, 41  # towards the highest point of a peak
_APART = 1e-3  # of a width: points that are nearer would have maxima of rounding between them


def fit_species(
    events: Events, max_species: int, *, least: int = 1, background: bool = False
) -> list[Mixture]:
    """Fit 1, 2, … components, on a background; stop after two numbers without a better BIC."""
    fits: list[Mixture] = []
    most = min(max_species, max(1, events.x.size // 5))
    for k in range(1, most + 1):
        starts = [_spread_start(events, k)]
        if background:
            starts[0] = starts[0].on_background(*broad(events), FIRST_SHARE)
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


def without_background(events: Events, fit: Mixture) -> Mixture:
    """Leave the background out where BIC does not like it."""
    own = slice(0, fit.narrow)
    bare = Mixture(fit.weight[own] / fit.weight[own].sum(), fit.mean[own], fit.variance[own])
    found = polish(events, bare)
    return found if found.bic(events.x.size) <= fit.bic(events.x.size) else fit


def ascend(events: Events, start: Mixture, steps: int = 40) -> Mixture:
    """EM steps without selection by the detector: a start for `structure.polish`."""
    weight, mean, variance = start.weight.copy(), start.mean.copy(), start.variance.copy()
    own, rest, noise = slice(0, start.narrow), slice(start.narrow, None), events.usual_variance
    rows, middle = width_prior(mean[own])
    precision, pull = rows.T @ rows, rows.T @ middle
    for _ in range(steps):
        sums = mixture_sums(events.x, events.variance, weight, mean, variance)[1]
        size, first, second, _, noisy = sums[own].T
        size = size + 1e-12
        before = variance[own]
        shift = before * first / size  # from the old mean, to avoid cancellation
        square = before * (before * second + noisy) / size - shift**2
        if not events.plain:  # of ln T, n events have the information 2 n
            pulled = pull + size * np.log(np.maximum(square, 0.0) + noise)
            square = np.exp(2 * np.linalg.solve(precision + np.diag(2 * size), pulled)) - noise
        mean[own] += shift
        variance[own] = np.maximum(square, 0.0)
        weight[own] = size / events.x.size
        if start.broad:
            weight[rest] = sums[rest, 0].sum() / (events.x.size * start.broad)
    return replace(start, weight=weight / weight.sum(), mean=mean, variance=variance)


def height(events: Events, start: Mixture) -> float:
    """Log-likelihood of a start, without selection by the detector."""
    return float(
        mixture_score(events.x, events.variance, start.weight, start.mean, start.variance)[0]
    )


def by_peaks(events: Events, fit: Mixture) -> Mixture:
    """Say which components are one species, and which are background."""
    own = slice(0, fit.narrow)
    weight, mean = fit.weight[own], fit.mean[own]
    whole = np.sqrt(fit.variance[own] + events.usual_variance)
    usual = [  # of widths that grow with the root of the mass, and of such that do not
        np.exp(np.average(np.log(whole / form), weights=weight)) * form
        for form in (np.sqrt(mean), np.ones(mean.shape))
    ]
    wide = whole > _BROAD * np.maximum(*usual)
    if wide.all():
        wide[:] = False
    kind = np.full(fit.narrow, BACKGROUND)
    kept = np.flatnonzero(~wide)
    valleys = _valleys(weight[kept], mean[kept], whole[kept])
    kind[kept] = np.unique(np.searchsorted(valleys, mean[kept]), return_inverse=True)[1]
    return replace(fit, kind=tuple(kind.tolist()))


def peaks(events: Events, fit: Mixture) -> FloatArray:
    """Mass at which the peak of each species is highest (s,)."""
    found, total = fit.means()[: fit.species].copy(), fit.variance + events.usual_variance
    for number in range(fit.species):
        own = np.flatnonzero(fit.kinds == number)
        if own.size > 1:
            found[number] = top_of(fit.weight[own], fit.mean[own], total[own])
    return found


def top_of(weight: FloatArray, mean: FloatArray, total: FloatArray) -> float:
    """Find where a sum of normal densities is highest.

    Shapes: `weight, mean, total` (k,).
    """
    low, high = float(mean.min()), float(mean.max())
    for _ in range(_ZOOMS):
        if high <= low:
            break
        grid = np.linspace(low, high, _ZOOM_POINTS)
        top = grid[int(np.argmax(_density(grid, weight, mean, total)))]
        step = grid[1] - grid[0]
        low, high = max(low, top - step), min(high, top + step)
    return (low + high) / 2


def _density(
    grid: FloatArray, weight: FloatArray, mean: FloatArray, total: FloatArray
) -> FloatArray:
    return np.asarray(
        (np.exp(-0.5 * (grid[:, None] - mean) ** 2 / total) / np.sqrt(total)) @ weight
    )


def _valleys(weight: FloatArray, mean: FloatArray, whole: FloatArray) -> FloatArray:
    """Give the minima between the maxima of a sum of components."""
    grid = np.sort((mean + np.outer(np.linspace(-_REACH, _REACH, _POINTS), whole)).ravel())
    grid = grid[np.diff(grid, prepend=-np.inf) > _APART * whole.min()]
    density = _density(grid, weight, mean, whole**2)
    high = np.flatnonzero((density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])) + 1
    return np.array([grid[i + int(np.argmin(density[i:j]))] for i, j in pairwise(high)])


def _spread_start(events: Events, k: int) -> Mixture:
    """Equal shares of the sorted events."""
    parts = np.array_split(np.sort(events.x), k)
    mean = np.array([part.mean() for part in parts])
    variance = np.array([max(part.var(), 1e-12) for part in parts])
    return Mixture(np.full(k, 1 / k), mean, variance)


def split_starts(events: Events, fit: Mixture) -> list[Mixture]:
    """Add a narrow species at the largest excess of events."""
    starts = []
    sigma = float(np.median(events.sigma))
    places = np.sort(events.x)
    every = np.arange(fit.narrow)
    whole = np.sqrt(fit.variance + sigma**2)
    widths = [sigma]
    if not events.plain:  # the errors may be unknown, and those of the peaks are not
        widths.append(float(whole[every].min()) / 2)
    for h in widths:
        near = np.searchsorted(places, places + h) - np.searchsorted(places, places - h)
        expected = np.zeros(places.size)
        for w, m, total in zip(fit.weight, fit.mean, whole, strict=True):
            expected += w * (ndtr((places + h - m) / total) - ndtr((places - h - m) / total))
        excess = (near - places.size * expected) / np.sqrt(places.size * expected + 1)
        place = float(places[int(np.argmax(excess))])
        starts.append(_with(fit, every, 1 / (2 * fit.narrow + 1), place, (h / 2) ** 2))
    return starts


def joined_starts(fit: Mixture) -> list[Mixture]:
    """Merge two neighbouring species."""
    starts = []
    for i in range(fit.narrow - 1):
        pair = slice(i, i + 2)
        size = fit.weight[pair].sum()
        mean = float(fit.weight[pair] @ fit.mean[pair]) / size
        square = fit.variance[pair] + (fit.mean[pair] - mean) ** 2
        rest = np.delete(np.arange(fit.narrow), pair)
        starts.append(_with(fit, rest, size, mean, float(fit.weight[pair] @ square) / size))
    return starts


def _with(
    fit: Mixture, kept: NDArray[np.intp], weight: float, mean: float, variance: float
) -> Mixture:
    """Give some of the free components of a mixture, and others, on the same background.

    Shapes: `kept` (k,).
    """
    rest = slice(fit.narrow, None)
    own = Mixture(
        np.append(fit.weight[kept], weight),
        np.append(fit.mean[kept], mean),
        np.append(fit.variance[kept], variance),
    )
    share = float(fit.weight[rest].sum())
    return own.on_background(fit.mean[rest], fit.variance[rest], share)
