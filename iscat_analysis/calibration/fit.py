"""A straight line through points with errors in both coordinates.

The peaks of |contrast|: found in a kernel density, then fitted to the events.

Assign peaks to standards, or say why no assignment fits.

From the contrasts of standards to the line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.special import chdtrc, ndtr

from iscat_analysis.calibration.line import ContrastPeak, Landing, MassCalibration
from iscat_analysis.errors import ConfigError, DataError, SignError
from iscat_analysis.findings.tables import STANDARDS_SCATTER, TWO_STANDARDS
from iscat_analysis.records import FloatArray
from iscat_analysis.units import count


@dataclass(frozen=True)
class StraightLine:
    """A straight line y = slope·x + intercept."""

    slope: float
    intercept: float
    covariance: FloatArray
    chi2: float
    dof: int


def york_line(x: ArrayLike, x_se: ArrayLike, y: ArrayLike, y_se: ArrayLike) -> StraightLine:
    """Fit a line to points with independent errors in both coordinates.

    Shapes: `x, x_se` (n,), `y, y_se` (n,).
    """
    xs, sx, ys, sy = (np.asarray(v, dtype=np.float64) for v in (x, x_se, y, y_se))
    if np.unique(xs).size < 2 or (sy <= 0).any():
        raise ValueError("a line needs two different x, and positive errors of y")
    vx, vy = sx**2, sy**2
    slope = float(np.polyfit(xs, ys, 1, w=1 / sy)[0])
    for _ in range(200):
        weight = 1 / (vy + slope**2 * vx)
        x_mean = float(np.sum(weight * xs) / weight.sum())
        y_mean = float(np.sum(weight * ys) / weight.sum())
        u, v = xs - x_mean, ys - y_mean
        beta = weight * (u * vy + slope * v * vx)
        new = float(np.sum(weight * beta * v) / np.sum(weight * beta * u))
        done = abs(new - slope) <= 1e-14 * abs(new)
        slope = new
        if done:
            break
    adjusted = x_mean + beta
    centre = float(np.sum(weight * adjusted) / weight.sum())
    var_slope = float(1 / np.sum(weight * (adjusted - centre) ** 2))
    var_intercept = float(1 / weight.sum()) + centre**2 * var_slope
    covariance = np.array([[var_slope, -centre * var_slope], [-centre * var_slope, var_intercept]])
    intercept = y_mean - slope * x_mean
    chi2 = float(np.sum(weight * (ys - slope * xs - intercept) ** 2))
    return StraightLine(slope, intercept, covariance, chi2, xs.size - 2)


_PROMINENCE_SIGMAS = 3.0
_MOST_PEAKS = 10
_CORE_SIGMAS = 2.5  # half-width of the fitted core of a peak: its tails contain other events
_WINDOWS = 8
_LEAST_IN_PEAK = 5
_GRID = 4096
_KERNEL_REACH = 6.0  # standard deviations
_ROOT_2PI = math.sqrt(2 * math.pi)


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


LEAST_PROBABILITY = 1e-4
"""A line whose χ² is less probable than this does not fit its standards."""

OFFSET_SHARE = 0.35
"""Largest contrast at zero mass, over the contrast of the lightest peak."""

_FITTING_DISTANCE = 0.05  # largest relative distance of a standard that a message says to fit
_NAMED_DISTANCE = 0.2  # largest relative distance of a peak from where somebody says it is
_MOST_STANDARDS = 8  # with more, no subsets are tried for a message


def match(peaks: Sequence[ContrastPeak], masses: FloatArray, name: str) -> list[ContrastPeak]:
    """Choose the peaks that are nearest to the standards on a line with a small offset.

    Shapes: `masses` (n,).
    """
    if len(peaks) < masses.size:
        raise DataError(
            f"{name}: {_found(peaks)}, fewer than the {masses.size} standards {_shown(masses)}; "
            f"{_advice(peaks, masses)}"
        )
    return _nearest(peaks, masses)[0]


def pick(
    peaks: Sequence[ContrastPeak], contrasts: FloatArray, masses: FloatArray, name: str
) -> list[ContrastPeak]:
    """Choose the peaks that somebody has named, by about where they are.

    Shapes: `contrasts, masses` (n,).
    """
    chosen: list[ContrastPeak] = []
    for contrast, mass in zip(contrasts, masses, strict=True):
        nearest = min(peaks, key=lambda peak: abs(peak.contrast - contrast), default=None)
        off = math.inf if nearest is None else abs(nearest.contrast / contrast - 1)
        if nearest is None or off > _NAMED_DISTANCE or nearest in chosen:
            raise DataError(
                f"{name}: the standard of {mass:g} kDa has no peak of its own near |contrast| = "
                f"{contrast:.3g} ({_found(peaks)}); name other peaks"
            )
        chosen.append(nearest)
    return chosen


def check_match(
    line: StraightLine,
    chosen: Sequence[ContrastPeak],
    peaks: Sequence[ContrastPeak],
    masses: FloatArray,
    name: str,
) -> None:
    """Refuse a line whose χ² is too large, or whose offset is too far from zero.

    Shapes: `masses` (n,).
    """
    contrast = np.array([peak.contrast for peak in chosen])
    slope, offset = abs(line.slope), math.copysign(1.0, line.slope) * line.intercept
    off = (contrast - offset) / slope / masses - 1
    worst = int(np.argmax(np.abs(off)))
    start = f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
    if line.dof and float(chdtrc(line.dof, line.chi2)) < LEAST_PROBABILITY:
        raise DataError(
            f"{start}the nearest line misses {masses[worst]:g} kDa by "
            f"{100 * abs(off[worst]):.1f} %, with χ² = {line.chi2:.3g} for "
            f"{count(line.dof, 'degree')} of freedom; {_advice(peaks, masses)}"
        )
    if abs(offset) > OFFSET_SHARE * contrast[0]:
        raise DataError(
            f"{start}zero mass would have the contrast {offset:.2g}, more than {OFFSET_SHARE:g} of "
            f"that of the lightest standard; {_advice(peaks, masses)}"
        )


def _nearest(peaks: Sequence[ContrastPeak], masses: FloatArray) -> tuple[list[ContrastPeak], float]:
    """Choose peaks for the standards, and give their total distance from the line."""
    most = max(peak.count for peak in peaks)
    best, least = list(peaks[: masses.size]), math.inf
    for chosen in combinations(peaks, int(masses.size)):
        contrast = np.array([peak.contrast for peak in chosen])
        slope, offset = np.polyfit(masses, contrast, 1, w=1 / contrast)
        if slope <= 0:
            continue
        off = (contrast - offset) / slope / masses - 1
        cost = float(np.sum((off / 0.02) ** 2)) + (offset / (0.15 * contrast[0])) ** 2
        cost -= 2 * sum(math.log(peak.count / most) for peak in chosen)
        if cost < least:
            best, least = list(chosen), cost
    return best, least


def _advice(peaks: Sequence[ContrastPeak], masses: FloatArray) -> str:
    """Name the standards that fit the peaks and those that do not."""
    known = _fitting(peaks, masses) if masses.size <= _MOST_STANDARDS else None
    if known is None:
        return "name the standards that are in the sample"
    others = masses[~np.isin(masses, known)]
    verb = "does not" if others.size == 1 else "do not"
    return f"{_shown(known)} would fit, {_shown(others)} {verb}: leave out what is not there"


def _fitting(peaks: Sequence[ContrastPeak], masses: FloatArray) -> FloatArray | None:
    """Find the largest part of the standards, two at least, that lies on a line through peaks."""
    for size in range(min(int(masses.size) - 1, len(peaks)), 1, -1):
        fits: list[tuple[float, FloatArray]] = []
        for part in combinations(masses.tolist(), size):
            some = np.array(part)
            chosen, cost = _nearest(peaks, some)
            contrast = np.array([peak.contrast for peak in chosen])
            slope, offset = np.polyfit(some, contrast, 1, w=1 / contrast)
            off = np.abs((contrast - offset) / slope / some - 1).max() if slope > 0 else math.inf
            if off < _FITTING_DISTANCE and abs(offset) < OFFSET_SHARE * contrast[0]:
                fits.append((cost, some))
        if fits:
            return min(fits, key=lambda fit: fit[0])[1]
    return None


def _found(peaks: Sequence[ContrastPeak]) -> str:
    if not peaks:
        return "no peak of |contrast| stands out"
    places = ", ".join(f"{peak.contrast:.3g}" for peak in peaks)
    return f"|contrast| peaks at {places}"


def _shown(masses: FloatArray) -> str:
    return ", ".join(f"{mass:g}" for mass in masses) + " kDa"


STANDARD_ERROR = 0.01
"""Relative uncertainty of a standard's mass if none is given: sequence, glycans, density."""

LEAST_EVENTS = 30
"""Fewest events for a histogram."""

_LANDING_SHARE = 0.4
_CONTRAST_PER_KDA = (3e-7, 1.5e-3)
# Contrast per kDa of any microscope: 3e-5 in visible light, up to 30 times as much if a mask dims
# the reference; less for dense metals, and at long wavelengths if the reference is not dimmed.
_LIGHTEST_KDA = 10.0  # lighter than any standard that can be detected
_KERNEL_WIDTHS = (1.0, 2.0, 4.0, 0.5)


def calibrate_mass(
    contrasts: ArrayLike,
    standards_kda: Sequence[float],
    *,
    standards_se_kda: Sequence[float] | None = None,
    peaks_at: Sequence[float] | None = None,
    sigmas: ArrayLike | None = None,
    landing: Landing = "dark",
    name: str = "the events",
) -> MassCalibration:
    """Calibrate contrast against the masses of standards.

    Which peak is whose is found, unless `peaks_at` says about which |contrast| each standard has.

    Shapes: `contrasts` (n,), `sigmas` (n,).
    """
    masses, masses_se = _standards(standards_kda, standards_se_kda)
    named = None if peaks_at is None else _places(peaks_at, standards_kda)
    signed = np.asarray(contrasts, dtype=np.float64)
    errors = np.zeros(signed.shape) if sigmas is None else np.asarray(sigmas, dtype=np.float64)
    finite = np.isfinite(signed) & np.isfinite(errors) & (signed != 0)
    signed, errors = signed[finite], errors[finite]
    direction = -1.0 if landing == "dark" else 1.0
    lands = direction * signed > 0
    if signed.size >= LEAST_EVENTS and lands.mean() < _LANDING_SHARE:
        other = "bright" if landing == "dark" else "dark"
        raise SignError(
            f"{name}: only {lands.sum()} of {signed.size} events are {landing}, which landing "
            f"should be: the contrast has the wrong sign; if your particles land {other}",
            f"say `landing` = {other}",
        )
    size, size_errors = np.abs(signed[lands]), errors[lands]
    if size.size < LEAST_EVENTS:
        raise DataError(
            f"{name}: holds {size.size} landing events; a calibration needs {LEAST_EVENTS} or more"
        )
    # The kernel's width follows the spread of the whole histogram.  It is too wide for few events
    # in narrow peaks far apart, which need finer kernels.  A dozen events in a peak exceed three
    # standard errors only with a kernel as wide as the peak, the coarser one.  Trying several
    # kernels hardly accepts more wrong standards (3 in 100 random ones, with twelve events each),
    # since a line through other peaks must meet the same limits.
    refusals: list[tuple[int, DataError]] = []
    for detail in _KERNEL_WIDTHS:
        peaks = find_contrast_peaks(size, size_errors, detail=detail)
        try:
            chosen = (
                match(peaks, masses, name) if named is None else pick(peaks, named, masses, name)
            )
            line = york_line(
                masses,
                masses_se,
                [direction * p.contrast for p in chosen],
                [p.contrast_se for p in chosen],
            )
            check_match(line, chosen, peaks, masses, name)
            break
        except DataError as refusal:
            refusals.append((len(peaks), refusal))
    else:  # the clearest view is the one that shows most peaks
        raise max(refusals, key=lambda each: each[0])[1]
    _refuse_unlikely(line.slope, float(size.max()), masses, name)
    widen = max(1.0, line.chi2 / line.dof) if line.dof else 1.0
    findings = []
    if widen > 1:
        findings.append(STANDARDS_SCATTER({"chi2_per_dof": widen, "widened": math.sqrt(widen)}))
    if not line.dof:
        findings.append(TWO_STANDARDS())
    result = MassCalibration(
        gradient_per_kda=line.slope,
        offset=line.intercept,
        covariance=line.covariance * widen,
        chi2=line.chi2,
        dof=line.dof,
        standards=pd.DataFrame(),
        peaks=tuple(peaks),
        landing=landing,
        events=int(size.size),
        findings=tuple(findings),
    )
    return replace(result, standards=_table(result, chosen, masses, masses_se, direction))


def _standards(
    masses: Sequence[float], errors: Sequence[float] | None
) -> tuple[FloatArray, FloatArray]:
    values = np.asarray(masses, dtype=np.float64)
    shown = ",".join(f"{m:g}" for m in values)
    if values.size < 2 or not np.isfinite(values).all() or (values <= 0).any():
        raise ConfigError(
            f"`standards_kda` = {shown}: a line needs two or more positive masses in kDa, as in "
            "66,146,480"
        )
    if np.unique(values).size < values.size:
        raise ConfigError(f"`standards_kda` = {shown}: names a mass twice")
    se = STANDARD_ERROR * values if errors is None else np.asarray(errors, dtype=np.float64)
    if se.shape != values.shape or not np.isfinite(se).all() or (se < 0).any():
        raise ConfigError(
            f"`standards_kda` = {shown}: needs one error, not negative, for each mass"
        )
    order = np.argsort(values)
    return values[order], se[order]


def _places(contrasts: Sequence[float], masses: Sequence[float]) -> FloatArray:
    """Check where peaks are said to be, and put them into the order of the masses."""
    places = np.abs(np.asarray(contrasts, dtype=np.float64))
    if places.shape != np.shape(masses) or not np.isfinite(places).all() or not places.all():
        raise ConfigError("`peaks_at`: needs the |contrast| of one peak for each standard")
    return np.asarray(places[np.argsort(np.asarray(masses, dtype=np.float64))])


def _refuse_unlikely(slope: float, largest: float, masses: FloatArray, name: str) -> None:
    """Refuse a line that no microscope can have, which shows that a unit is wrong."""
    low, high = _CONTRAST_PER_KDA
    if low <= abs(slope) <= high:
        return
    shown = ",".join(f"{m:g}" for m in masses)
    problem = (
        f"{name}: the line through the standards has a contrast of {abs(slope):.2g} per kDa, where "
        f"microscopes have {low:g} to {high:g}: "
    )
    if abs(slope) < low:
        raise DataError(
            f"{problem}`standards_kda` = {shown} seem to be in Da; give them in kDa, as 66,146,480"
        )
    if masses.max() < _LIGHTEST_KDA:
        raise DataError(
            f"{problem}`standards_kda` = {shown} seem to be in MDa; give them in kDa, as 66,146,480"
        )
    raise DataError(
        f"{problem}contrasts, of up to {largest:.3g}, seem to be in per cent; divide them by 100"
    )


def _table(
    calibration: MassCalibration,
    chosen: Sequence[ContrastPeak],
    masses: FloatArray,
    masses_se: FloatArray,
    direction: float,
) -> pd.DataFrame:
    contrast = direction * np.array([peak.contrast for peak in chosen])
    errors = np.array([peak.contrast_se for peak in chosen])
    mass = calibration.mass_kda(contrast)
    low, high = calibration.prediction_interval(contrast, errors)
    return pd.DataFrame(
        {
            "mass_kda": masses,
            "mass_se": masses_se,
            "contrast": contrast,
            "contrast_se": errors,
            "width": [peak.width for peak in chosen],
            "count": [peak.count for peak in chosen],
            "found_kda": mass,
            "residual_percent": 100 * (mass / masses - 1),
            "low_kda": low,
            "high_kda": high,
        }
    )
