"""The peaks of |contrast|: found in a kernel density, then fitted to the events."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import scipy
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from iscat_analysis.records import FloatArray

_PROMINENCE_SIGMAS = 3.0
_MOST_PEAKS = 10
_CORE_SIGMAS = 2.5  # half-width of the fitted core of a peak: its tails contain other events
_WINDOWS = 8
_LEAST_IN_PEAK = 5
_GRID = 4096
_KERNEL_REACH = 6.0  # standard deviations
_ROOT_2PI = math.sqrt(2 * math.pi)


@dataclass(frozen=True)
class ContrastPeak:
    """A peak of |contrast|."""

    contrast: float
    contrast_se: float
    width: float
    count: float


def find_contrast_peaks(
    size: FloatArray, errors: FloatArray, *, detail: float = 1.0
) -> list[ContrastPeak]:
    """Find the peaks of |contrast|.

    Modes of a kernel density that stand out by three standard errors, each then fitted to the
    events of its own window: a normal distribution on a flat background.

    Shapes: `size` (n,), `errors` (n,).
    """
    kept = size <= np.quantile(size, 0.995) * 1.5
    x, sigma = size[kept], errors[kept]
    low, high = np.quantile(x, [0.25, 0.75])
    spread = min(float(x.std()), float(high - low) / 1.349) or float(x.std())
    h = 0.4 * spread * x.size**-0.2
    if (sigma > 0).any():  # no peak is narrower
        h = min(h, 0.6 * float(np.median(sigma)))
    h /= detail
    grid, step = np.linspace(0.0, float(x.max()) + 4 * h, _GRID, retstep=True)
    edges = np.concatenate([grid - step / 2, [grid[-1] + step / 2]])
    counts = np.histogram(x, edges)[0]
    density = gaussian_filter1d(counts / step, h / step, mode="constant", truncate=_KERNEL_REACH)
    from scipy.signal import find_peaks  # takes as long to load as NumPy, pandas and this package

    found, about = find_peaks(density, prominence=0)
    # Var Σφ_h(x − x_i) = n·f/(2√π h) for Poisson events.
    noise = np.sqrt(density[found] / (2 * math.sqrt(math.pi) * h))
    stands = about["prominences"] > _PROMINENCE_SIGMAS * noise
    found = found[stands]
    valleys = [0.0]
    for left, right in pairwise(found):
        valleys.append(float(grid[left + int(np.argmin(density[left:right]))]))
    valleys.append(float(grid[-1]))
    peaks = []
    for number, place in enumerate(found):
        centre, top = float(grid[place]), float(density[place])
        half = _half_width(grid, density, int(place), 0.6065 * top)
        width = math.sqrt(max(half**2 - h**2, (0.3 * half) ** 2))
        limits = valleys[number], valleys[number + 1]
        peak = _settled_peak(x, sigma, limits, centre, width)
        if peak is not None:
            peaks.append(peak)
    peaks = sorted(peaks, key=lambda peak: -peak.count)[:_MOST_PEAKS]
    return sorted(peaks, key=lambda peak: peak.contrast)


def _settled_peak(
    x: FloatArray, sigma: FloatArray, limits: tuple[float, float], centre: float, width: float
) -> ContrastPeak | None:
    """Fit a peak, then again within the window of the fitted width, until it converges."""
    peak = None
    noise = float(np.sqrt(np.mean(sigma**2)))
    for _ in range(_WINDOWS):
        reach = _CORE_SIGMAS * math.hypot(width, noise)
        window = max(limits[0], centre - reach), min(limits[1], centre + reach)
        inside = (x > window[0]) & (x < window[1])
        if np.count_nonzero(inside) < _LEAST_IN_PEAK or not window[0] < centre < window[1]:
            return peak
        previous, peak = peak, fit_peak(x[inside], sigma[inside], window, centre, width)
        centre, width = peak.contrast, max(peak.width, 0.1 * math.hypot(width, noise))
        if previous is not None and abs(previous.contrast - centre) < 0.1 * peak.contrast_se:
            break
    return peak


def _half_width(grid: FloatArray, density: FloatArray, place: int, level: float) -> float:
    """Mean distance from the mode to where the density has fallen to `level`."""
    left = np.flatnonzero(density[:place] < level)
    right = np.flatnonzero(density[place:] < level)
    sides = []
    if left.size:
        sides.append(grid[place] - grid[left[-1]])
    if right.size:
        sides.append(grid[place + right[0]] - grid[place])
    return float(np.mean(sides)) if sides else float(grid[-1] - grid[0])


def fit_peak(
    x: FloatArray, sigma: FloatArray, window: tuple[float, float], centre: float, width: float
) -> ContrastPeak:
    """Fit a normal distribution, truncated to the window, on a flat background."""
    loss = partial(peak_loss, x, sigma, window, centre, width)
    bounds = [(-1.5, 1.5), (-2.5, 1.0), (-3.0, 6.0)]
    best = scipy.optimize.minimize(loss, [0.0, 0.0, 2.0], jac=True, method="TNC", bounds=bounds)
    theta = np.asarray(best.x)
    curvature = _hessian(lambda at: loss(at)[0], theta, bounds)
    free = np.array([lo + 1e-3 < t < hi - 1e-3 for t, (lo, hi) in zip(theta, bounds, strict=True)])
    free[0] = True
    spread = width * math.exp(theta[1])
    share = 1 / (1 + math.exp(-theta[2]))
    fallback = math.sqrt((spread**2 + float(np.mean(sigma**2))) / max(share * x.size, 1.0))
    try:
        inverse = np.linalg.inv(curvature[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        inverse = np.array([[-1.0]])
    se = width * math.sqrt(inverse[0, 0]) if inverse[0, 0] > 0 else fallback
    return ContrastPeak(float(centre + width * theta[0]), max(se, fallback), spread, share * x.size)


def peak_loss(
    x: FloatArray,
    sigma: FloatArray,
    window: tuple[float, float],
    centre: float,
    width: float,
    theta: FloatArray,
) -> tuple[float, FloatArray]:
    """Negative log-likelihood, and its gradient.

    θ is the mean, from the centre in widths; ln of the peak's own spread in widths; the log odds of
    the peak against the background.
    """
    low, high = window
    mean, own = centre + width * theta[0], width * math.exp(theta[1])
    share = 1 / (1 + math.exp(-theta[2]))
    flat = 1 / (high - low)
    total = np.sqrt(own**2 + sigma**2)
    at, a, b = (x - mean) / total, (low - mean) / total, (high - mean) / total
    at_a, at_b = (np.exp(-0.5 * k**2) / _ROOT_2PI for k in (a, b))
    inside = np.maximum(ndtr(b) - ndtr(a), 1e-12)
    peak = np.exp(-0.5 * at**2) / (_ROOT_2PI * total * inside)
    density = np.maximum(share * peak + (1 - share) * flat, 1e-300 * flat)
    weight = share * peak / density  # of the peak in each event
    by_mean = (at - (at_a - at_b) / inside) / total
    by_total = (at**2 - 1 - (a * at_a - b * at_b) / inside) / total
    gradient = [
        -width * float(weight @ by_mean),
        -(own**2) * float(weight @ (by_total / total)),
        -share * (1 - share) * float(np.sum((peak - flat) / density)),
    ]
    return -float(np.sum(np.log(density / flat))), np.array(gradient)


def _hessian(
    function: Callable[[FloatArray], float],
    theta: FloatArray,
    bounds: Sequence[tuple[float, float]],
) -> FloatArray:
    """Second differences, one-sided steps kept inside the bounds."""
    step = 1e-3
    at = np.array(
        [np.clip(t, lo + step, hi - step) for t, (lo, hi) in zip(theta, bounds, strict=True)]
    )
    unit = step * np.eye(theta.size)
    out = np.empty((theta.size, theta.size))
    for i in range(theta.size):
        for j in range(theta.size):
            out[i, j] = (
                function(at + unit[i] + unit[j])
                - function(at + unit[i] - unit[j])
                - function(at - unit[i] + unit[j])
                + function(at - unit[i] - unit[j])
            ) / (4 * step**2)
    return out
