"""Contrast becomes mass: a line through standards, with errors in both coordinates.

The calibration is odd-symmetric, so that a particle that leaves weighs what it weighed when it
landed: a landing particle of mass m has the contrast c = s·m + o, a leaving one −c.  Where landing
darkens (s < 0) that is m = sign(−c)·(−|c| − o)/s, as Refeyn's programs have it.  A plain line
through both branches is wrong by 2|o/s| on one of them.

Peaks are fitted to events, not to bins: a normal distribution on a flat background, by maximum
likelihood inside the peak's own window.  The line through the peaks is that of York et al., Am. J.
Phys. 72, 367 (2004).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.signal import fftconvolve, find_peaks
from scipy.special import ndtr, ndtri

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import FloatArray

Landing = Literal["dark", "bright"]

STANDARD_ERROR = 0.01
"""Relative uncertainty of a standard's mass, where none is given: sequence, glycans, density."""

LEAST_EVENTS = 30
"""Fewer events make no histogram."""

_MISMATCH = 0.07  # of a standard's mass, beyond which the line does not go through the peaks
_OFFSET_SHARE = 0.35  # of the lightest peak's contrast that the offset may be
_PROMINENCE_SIGMAS = 3.0
_LANDING_SHARE = 0.4
_MOST_PEAKS = 10
_DETAILS = (1.0, 2.0, 4.0)
_CORE = 2.5  # standard deviations of a peak that are fitted: its tails are other things
_WINDOWS = 8
_LEAST_IN_PEAK = 5
_GRID = 4096
_ROOT_2PI = math.sqrt(2 * math.pi)


def mass_from_contrast(
    contrast: ArrayLike, gradient_per_kda: float, offset: float = 0.0
) -> FloatArray:
    """Convert signed peak contrasts to masses.

    Parameters
    ----------
    contrast : array_like
        Signed peak contrasts.
    gradient_per_kda : float
        Contrast per kDa of a landing particle, negative where landing darkens.
    offset : float
        Contrast of a landing particle of zero mass.

    Returns
    -------
    ndarray
        Masses, negative for a particle that leaves [kDa].

    Raises
    ------
    ConfigError
        The gradient is zero or not finite.
    """
    if gradient_per_kda == 0 or not math.isfinite(gradient_per_kda):
        raise ConfigError(f"gradient_per_kda = {gradient_per_kda:g} says nothing about mass")
    c = np.asarray(contrast, dtype=np.float64)
    direction = math.copysign(1.0, gradient_per_kda)
    masses: FloatArray = (
        np.sign(direction * c) * (direction * np.abs(c) - offset) / gradient_per_kda
    )
    return masses


@dataclass(frozen=True)
class Line:
    """A straight line y = slope·x + intercept.

    Attributes
    ----------
    slope, intercept : float
        Best estimate.
    covariance : ndarray, shape (2, 2)
        Of (slope, intercept), from the errors of the points alone.
    chi2 : float
        Weighted sum of squared distances.
    dof : int
        Points less two.
    """

    slope: float
    intercept: float
    covariance: FloatArray
    chi2: float
    dof: int


def york_line(x: ArrayLike, x_se: ArrayLike, y: ArrayLike, y_se: ArrayLike) -> Line:
    """Fit a line to points with independent errors in both coordinates.

    Parameters
    ----------
    x, x_se : array_like, shape (n,)
        First coordinates, n ≥ 2, and their standard errors, which may be zero.
    y, y_se : array_like, shape (n,)
        Second coordinates and their standard errors, positive.

    Returns
    -------
    Line
        The maximum-likelihood line (York et al., Am. J. Phys. 72, 367, 2004, eqs 13a–e).

    Raises
    ------
    ValueError
        There are fewer than two different x, or an error of y is not positive.
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
    return Line(slope, intercept, covariance, chi2, xs.size - 2)


@dataclass(frozen=True)
class Peak:
    """A peak of |contrast|.

    Attributes
    ----------
    contrast, contrast_se : float
        Mean of the fitted normal distribution, unsigned, and its standard error.
    width : float
        Its standard deviation.
    count : float
        Events in it, the background taken off.
    """

    contrast: float
    contrast_se: float
    width: float
    count: float


@dataclass(frozen=True, eq=False)
class MassCalibration:
    """The line between contrast and mass; `calibrate_mass` makes it.

    Attributes
    ----------
    gradient_per_kda : float
        s, signed peak contrast per kDa of a landing particle.
    offset : float
        o, contrast of a landing particle of zero mass.
    covariance : ndarray, shape (2, 2)
        Of (s, o), widened by χ²/dof where that exceeds one.
    chi2 : float
        Of the line, before widening.
    dof : int
        Standards less two.
    standards : pandas.DataFrame
        mass_kda, mass_se, contrast (signed), contrast_se, width, count, found_kda (the peak's mass
        by the line), residual_percent, low_kda and high_kda (95 % prediction interval of a mass
        that the line gives there).
    peaks : tuple of Peak
        Every peak that was found, matched or not.
    landing : str
        ``"dark"`` or ``"bright"``.
    events : int
        Landing events used.
    notes : tuple of str
        What the user should know, one sentence each.
    """

    gradient_per_kda: float
    offset: float
    covariance: FloatArray
    chi2: float
    dof: int
    standards: pd.DataFrame
    peaks: tuple[Peak, ...]
    landing: Landing
    events: int
    notes: tuple[str, ...] = ()

    def mass_kda(self, contrast: ArrayLike) -> FloatArray:
        """Convert signed peak contrasts to masses.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.

        Returns
        -------
        ndarray
            Masses, negative for a particle that leaves [kDa].
        """
        return mass_from_contrast(contrast, self.gradient_per_kda, self.offset)

    def sigma_kda(self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0) -> FloatArray:
        """Give the standard deviation of such a mass.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.
        sigma_contrast : array_like
            Their standard deviations; 0 leaves that of the line alone.

        Returns
        -------
        ndarray
            Standard deviations [kDa].
        """
        mass = np.abs(self.mass_kda(contrast))
        variance = (
            np.square(np.asarray(sigma_contrast, dtype=np.float64))
            + mass**2 * self.covariance[0, 0]
            + 2 * mass * self.covariance[0, 1]
            + self.covariance[1, 1]
        )
        return np.asarray(np.sqrt(variance) / abs(self.gradient_per_kda))

    def prediction_interval(
        self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0, *, level: float = 0.95
    ) -> tuple[FloatArray, FloatArray]:
        """Give the interval that holds the true mass with a given probability.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.
        sigma_contrast : array_like
            Their standard deviations.
        level : float
            Probability, in (0, 1).

        Returns
        -------
        low, high : ndarray
            Ends of the interval [kDa].

        Raises
        ------
        ValueError
            `level` is not a probability.
        """
        if not 0 < level < 1:
            raise ValueError(f"level = {level} must lie between 0 and 1")
        reach = float(ndtri((1 + level) / 2)) * self.sigma_kda(contrast, sigma_contrast)
        mass = self.mass_kda(contrast)
        return mass - reach, mass + reach

    def to_toml(self) -> str:
        """Write the section ``[calibration]`` to paste into a configuration.

        Returns
        -------
        str
            TOML text.
        """
        s_se, o_se = (math.sqrt(self.covariance[k, k]) for k in (0, 1))
        return (
            "[calibration]\n"
            f"gradient_per_kda = {self.gradient_per_kda:.6g}  # ± {s_se:.2g}\n"
            f"offset = {self.offset:.6g}  # ± {o_se:.2g}\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``calibration.json`` holds.

        Returns
        -------
        dict
            Nested plain values.
        """
        return {
            "gradient_per_kda": self.gradient_per_kda,
            "gradient_se": math.sqrt(self.covariance[0, 0]),
            "offset": self.offset,
            "offset_se": math.sqrt(self.covariance[1, 1]),
            "covariance": self.covariance.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "landing": self.landing,
            "events": self.events,
            "standards": self.standards.to_dict("records"),
            "peaks": [vars(peak) for peak in self.peaks],
            "notes": list(self.notes),
        }


def calibrate_mass(
    contrasts: ArrayLike,
    standards_kda: Sequence[float],
    *,
    standards_se_kda: Sequence[float] | None = None,
    sigmas: ArrayLike | None = None,
    landing: Landing = "dark",
    name: str = "the events",
) -> MassCalibration:
    """Calibrate contrast against the masses of standards.

    Parameters
    ----------
    contrasts : array_like, shape (n,)
        Signed peak contrasts of landing and leaving events; the landing ones are used.
    standards_kda : sequence of float
        Masses of the standards, two or more [kDa].
    standards_se_kda : sequence of float, optional
        Their standard errors [kDa]; default `STANDARD_ERROR` of each.
    sigmas : array_like, shape (n,), optional
        Standard deviation of each contrast, where known; then a peak's width is what exceeds them.
    landing : {"dark", "bright"}
        What a landing particle does to its place.
    name : str
        What messages call the events.

    Returns
    -------
    MassCalibration
        The line, its covariance and the peaks.

    Raises
    ------
    ConfigError
        The standards are not two or more different positive masses.
    DataError
        There are too few events, most have the sign of leaving, or no peaks match the standards.
    """
    masses, masses_se = _standards(standards_kda, standards_se_kda)
    signed = np.asarray(contrasts, dtype=np.float64)
    errors = np.zeros(signed.shape) if sigmas is None else np.asarray(sigmas, dtype=np.float64)
    finite = np.isfinite(signed) & np.isfinite(errors) & (signed != 0)
    signed, errors = signed[finite], errors[finite]
    direction = -1.0 if landing == "dark" else 1.0
    lands = direction * signed > 0
    if signed.size >= LEAST_EVENTS and lands.mean() < _LANDING_SHARE:
        other = "bright" if landing == "dark" else "dark"
        raise DataError(
            f"{name}: only {lands.sum()} of {signed.size} events are {landing}, which landing "
            f"should be: the contrast has the wrong sign; if your particles land {other}, say "
            f"--landing {other}"
        )
    size, size_errors = np.abs(signed[lands]), errors[lands]
    if size.size < LEAST_EVENTS:
        raise DataError(
            f"{name}: holds {size.size} landing events; a calibration needs {LEAST_EVENTS} or more"
        )
    for detail in _DETAILS:
        peaks = find_contrast_peaks(size, size_errors, detail=detail)
        try:
            chosen = _match(peaks, masses, name)
            line = york_line(
                masses,
                masses_se,
                [direction * p.contrast for p in chosen],
                [p.contrast_se for p in chosen],
            )
            _check_match(line, chosen, peaks, masses, name)
            break
        except DataError:
            if detail == _DETAILS[-1]:
                raise
    widen = max(1.0, line.chi2 / line.dof) if line.dof else 1.0
    notes = []
    if widen > 1:
        notes.append(
            f"the standards scatter about the line by more than their errors (χ²/dof = "
            f"{widen:.3g}); its uncertainty is widened by {math.sqrt(widen):.3g}"
        )
    if not line.dof:
        notes.append("two standards fix a line but cannot test it; a third would")
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
        notes=tuple(notes),
    )
    table = _table(result, chosen, masses, masses_se, direction)
    return MassCalibration(**{**vars(result), "standards": table})


def _standards(
    masses: Sequence[float], errors: Sequence[float] | None
) -> tuple[FloatArray, FloatArray]:
    values = np.asarray(masses, dtype=np.float64)
    shown = ",".join(f"{m:g}" for m in values)
    if values.size < 2 or not np.isfinite(values).all() or (values <= 0).any():
        raise ConfigError(
            f"--standards {shown}: needs two or more positive masses in kDa, as in 66,146,480"
        )
    if np.unique(values).size < values.size:
        raise ConfigError(f"--standards {shown}: names a mass twice")
    se = STANDARD_ERROR * values if errors is None else np.asarray(errors, dtype=np.float64)
    if se.shape != values.shape or not np.isfinite(se).all() or (se < 0).any():
        raise ConfigError(f"--standards {shown}: needs one error, not negative, for each mass")
    order = np.argsort(values)
    return values[order], se[order]


def find_contrast_peaks(size: FloatArray, errors: FloatArray, *, detail: float = 1.0) -> list[Peak]:
    """Find the peaks of |contrast|.

    Modes of a kernel density that stand out by three standard errors, each then fitted to the
    events of its own window: a normal distribution on a flat background.

    Parameters
    ----------
    size : ndarray, shape (n,)
        |contrast|, positive.
    errors : ndarray, shape (n,)
        Standard deviations of each; zero where unknown.
    detail : float
        Divides the kernel's width; more shows peaks that lie closer together.

    Returns
    -------
    list of Peak
        By rising contrast, at most ten: those with most events.
    """
    kept = size <= np.quantile(size, 0.995) * 1.5
    x, sigma = size[kept], errors[kept]
    low, high = np.quantile(x, [0.25, 0.75])
    spread = min(float(x.std()), float(high - low) / 1.349) or float(x.std())
    h = 0.4 * spread * x.size**-0.2
    if (sigma > 0).any():  # no peak is narrower
        h = min(h, 0.6 * float(np.median(sigma)))
    h /= detail
    grid = np.linspace(0.0, float(x.max()) + 4 * h, _GRID)
    edges = np.concatenate([grid - (grid[1] - grid[0]) / 2, [grid[-1] + (grid[1] - grid[0]) / 2]])
    counts = np.histogram(x, edges)[0]
    reach = np.arange(-_GRID // 2, _GRID // 2) * (grid[1] - grid[0])
    kernel = np.exp(-0.5 * (reach / h) ** 2) / (_ROOT_2PI * h)
    density = fftconvolve(counts, kernel)[_GRID // 2 : _GRID // 2 + _GRID]
    density = np.maximum(density, 0.0)
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
) -> Peak | None:
    """Fit a peak, then again within the window that its own width asks for, until it stays."""
    peak = None
    noise = float(np.sqrt(np.mean(sigma**2)))
    for _ in range(_WINDOWS):
        reach = _CORE * math.hypot(width, noise)
        window = max(limits[0], centre - reach), min(limits[1], centre + reach)
        inside = (x > window[0]) & (x < window[1])
        if np.count_nonzero(inside) < _LEAST_IN_PEAK or not window[0] < centre < window[1]:
            return peak
        previous, peak = peak, _fit_peak(x[inside], sigma[inside], window, centre, width)
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


def _fit_peak(
    x: FloatArray, sigma: FloatArray, window: tuple[float, float], centre: float, width: float
) -> Peak:
    """Fit a normal distribution, truncated to the window, on a flat background."""
    low, high = window

    def loss(theta: FloatArray) -> float:
        mean = centre + width * theta[0]
        total = np.sqrt((width * math.exp(theta[1])) ** 2 + sigma**2)
        share = 1 / (1 + math.exp(-theta[2]))
        inside = ndtr((high - mean) / total) - ndtr((low - mean) / total)
        peak = np.exp(-0.5 * ((x - mean) / total) ** 2) / (_ROOT_2PI * total)
        peak /= np.maximum(inside, 1e-12)
        density = share * peak + (1 - share) / (high - low)
        return -float(np.sum(np.log(np.maximum(density * (high - low), 1e-300))))

    bounds = [(-1.5, 1.5), (-2.5, 1.0), (-3.0, 6.0)]
    best = minimize(loss, [0.0, 0.0, 2.0], method="TNC", bounds=bounds)
    theta = np.asarray(best.x)
    curvature = _hessian(loss, theta, bounds)
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
    return Peak(float(centre + width * theta[0]), max(se, fallback), spread, share * x.size)


def _hessian(function: Any, theta: FloatArray, bounds: Sequence[tuple[float, float]]) -> FloatArray:
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
                function(at + unit[i] + unit[j]) - function(at + unit[i] - unit[j])
                - function(at - unit[i] + unit[j]) + function(at - unit[i] - unit[j])
            ) / (4 * step**2)  # fmt: skip
    return out


def _match(peaks: Sequence[Peak], masses: FloatArray, name: str) -> list[Peak]:
    """Choose the peaks that a line with a small offset puts nearest the standards."""
    if len(peaks) < masses.size:
        raise DataError(
            f"{name}: {_found(peaks)}, fewer than the {masses.size} standards "
            f"{_shown(masses)}; leave out those that are not in the sample"
        )
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
    return best


def _check_match(
    line: Line, chosen: Sequence[Peak], peaks: Sequence[Peak], masses: FloatArray, name: str
) -> None:
    contrast = np.array([peak.contrast for peak in chosen])
    slope, offset = abs(line.slope), math.copysign(1.0, line.slope) * line.intercept
    off = (contrast - offset) / slope / masses - 1
    worst = int(np.argmax(np.abs(off)))
    remedy = "correct --standards, or leave out what is not in the sample"
    if abs(off[worst]) > _MISMATCH:
        raise DataError(
            f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
            f"the nearest line misses {masses[worst]:g} kDa by {100 * abs(off[worst]):.0f} %; "
            f"{remedy}"
        )
    if abs(offset) > _OFFSET_SHARE * contrast[0]:
        raise DataError(
            f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
            f"zero mass would have the contrast {offset:.2g}; {remedy}"
        )


def _found(peaks: Sequence[Peak]) -> str:
    if not peaks:
        return "no peak of |contrast| stands out"
    places = ", ".join(f"{peak.contrast:.3g}" for peak in peaks)
    return f"|contrast| peaks at {places}"


def _shown(masses: FloatArray) -> str:
    return ", ".join(f"{mass:g}" for mass in masses) + " kDa"


def _table(
    line: MassCalibration,
    chosen: Sequence[Peak],
    masses: FloatArray,
    masses_se: FloatArray,
    direction: float,
) -> pd.DataFrame:
    contrast = direction * np.array([peak.contrast for peak in chosen])
    errors = np.array([peak.contrast_se for peak in chosen])
    mass = line.mass_kda(contrast)
    low, high = line.prediction_interval(contrast, errors)
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
