"""Contrast becomes mass: a line through standards, with errors in both coordinates.

The calibration is odd-symmetric, so that a particle has the same mass when it lands and when it
leaves: a landing particle of mass m has the contrast c = s·m + o, a leaving one −c.  If landing
darkens (s < 0), this is m = sign(−c)·(−|c| − o)/s, as in Refeyn's programs.  A straight line
through both branches is wrong by 2|o/s| for one of them.

Peaks are fitted to events, not to bins: a normal distribution on a flat background, by maximum
likelihood inside the peak's own window.  The line through the peaks is that of York et al., Am. J.
Phys. 72, 367 (2004).

Contrast per mass depends on the optics with which it was measured.  A calibration that stores them
can be used for movies with other optics too, because the model converts it (`MassScale`).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.special import chdtrc, ndtr, ndtri

from iscat_analysis.config import (
    MOVING,
    Calibration,
    Config,
    Optics,
    OpticsCovariance,
    Source,
    StandardsCamera,
    load_config,
    parse_config,
    read_toml,
    toml_value,
)
from iscat_analysis.errors import ConfigError, DataError, SignError
from iscat_analysis.findings import Finding, Noted, existing
from iscat_analysis.findings.tables import STANDARDS_SCATTER, TWO_STANDARDS
from iscat_analysis.optics.forward import PEAK_SEARCH_RADIUS, forward_model
from iscat_analysis.reading import is_file, is_folder
from iscat_analysis.records import FloatArray, Status
from iscat_analysis.units import count

Landing = Literal["dark", "bright"]


def mass_from_contrast(
    contrast: ArrayLike, gradient_per_kda: float, offset: float = 0.0
) -> FloatArray:
    """Convert signed peak contrasts to masses."""
    if gradient_per_kda == 0 or not math.isfinite(gradient_per_kda):
        raise ConfigError(f"gradient_per_kda = {gradient_per_kda:g} says nothing about mass")
    c = np.asarray(contrast, dtype=np.float64)
    direction = math.copysign(1.0, gradient_per_kda)
    return np.asarray(np.sign(direction * c) * (direction * np.abs(c) - offset) / gradient_per_kda)


def line_sigma_kda(
    mass_kda: ArrayLike,
    gradient_per_kda: float,
    covariance: FloatArray,
    sigma_contrast: ArrayLike = 0.0,
) -> FloatArray:
    """Propagate the errors of the line, and of a contrast, into a mass.

    Shapes: `covariance` (2, 2).
    """
    mass = np.abs(np.asarray(mass_kda, dtype=np.float64))
    variance = (
        np.square(np.asarray(sigma_contrast, dtype=np.float64))
        + mass**2 * covariance[0, 0]
        + 2 * mass * covariance[0, 1]
        + covariance[1, 1]
    )
    return np.asarray(np.sqrt(variance) / abs(gradient_per_kda))


@dataclass(frozen=True)
class ContrastPeak:
    """A peak of |contrast|."""

    contrast: float
    contrast_se: float
    width: float
    count: float


@dataclass(frozen=True, eq=False)
class MassCalibration(Noted):
    """The line between contrast and mass; `calibrate_mass` makes it."""

    gradient_per_kda: float
    offset: float
    covariance: FloatArray
    chi2: float
    dof: int
    standards: pd.DataFrame
    peaks: tuple[ContrastPeak, ...]
    landing: Landing
    events: int
    findings: tuple[Finding, ...] = ()
    recorded: Standards | None = None

    def mass_kda(self, contrast: ArrayLike) -> FloatArray:
        """Convert signed peak contrasts to masses."""
        return mass_from_contrast(contrast, self.gradient_per_kda, self.offset)

    def sigma_kda(self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0) -> FloatArray:
        """Give the standard deviation of such a mass."""
        return line_sigma_kda(
            self.mass_kda(contrast), self.gradient_per_kda, self.covariance, sigma_contrast
        )

    def prediction_interval(
        self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Give the interval that holds the true mass with a probability of 95 %."""
        reach = float(ndtri(0.975)) * self.sigma_kda(contrast, sigma_contrast)
        mass = self.mass_kda(contrast)
        return mass - reach, mass + reach

    def to_toml(self) -> str:
        """Write the section ``[calibration]`` to paste into a configuration.

        The section contains the standard errors of the line and their correlation, from which an
        analysis computes the contribution of the calibration to the error of each mass.  It also
        contains the optics of the standards if they are known.
        """
        s_se, o_se = (math.sqrt(self.covariance[k, k]) for k in (0, 1))
        return (
            "[calibration]\n"
            f"gradient_per_kda = {self.gradient_per_kda:.6g}\n"
            f"offset = {self.offset:.6g}\n"
            f"gradient_se_per_kda = {s_se:.4g}  # {100 * abs(s_se / self.gradient_per_kda):.2g} %\n"
            f"offset_se = {o_se:.4g}\n"
            f"correlation = {self.covariance[0, 1] / (s_se * o_se):.5f}\n"
            f"dof = {self.dof}\n"
            f"{self.recorded.to_toml() if self.recorded else ''}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``calibration.json`` holds."""
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
            "recorded": None if self.recorded is None else self.recorded.to_dict(),
        }


_OF_A_MOVIE = {"file": None, "covariance": None, "calibrate": "auto", **MOVING}
"""Keys of [optics] that do not change the contrast of standards, and their neutral values."""


@dataclass(frozen=True)
class Standards:
    """Optics and camera with which the standards of a calibration were recorded and analysed."""

    optics: Optics
    covariance: OpticsCovariance | None
    height_nm: float
    camera: StandardsCamera

    def to_toml(self) -> str:
        """Write the end of the section ``[calibration]``, with its tables."""
        lines = [f"height_nm = {toml_value(self.height_nm)}"]
        for name, table in self.to_dict().items():
            if isinstance(table, dict) and table:
                lines += ["", f"[calibration.{name}]"]
                lines += [f"{key} = {toml_value(value)}" for key, value in table.items()]
        return "\n".join([*lines, ""])

    def to_dict(self) -> dict[str, Any]:
        """Give the entries of ``calibration.json``."""
        return {
            "optics": self.optics.model_dump(exclude={*_OF_A_MOVIE}, exclude_none=True),
            "covariance": None if self.covariance is None else self.covariance.model_dump(),
            "height_nm": self.height_nm,
            "camera": self.camera.model_dump(exclude_none=True),
        }


def standards_of(config: Config) -> Standards:
    """Give the record of standards that were analysed with a configuration."""
    camera = config.camera
    gain, offset = camera.gain_e_per_adu, camera.offset_adu
    return Standards(
        optics=config.optics.model_copy(update=_OF_A_MOVIE),
        covariance=None if (errors := config.optics.covariance) is None else errors.at_rest,
        height_nm=config.particle.nominal_height_nm,
        camera=StandardsCamera(
            pixel_size_nm=camera.pixel_size_nm,
            samples_per_pixel=camera.samples_per_pixel,
            fill_factor=camera.fill_factor,
            gain_e_per_adu=gain if isinstance(gain, float) else None,
            offset_adu=offset if isinstance(offset, float) else None,
        ),
    )


def with_standards(config: Config) -> Config:
    """Assume that a gradient without stored optics was measured with the configured optics."""
    line = config.calibration
    if line is None or line.optics is not None:
        return config
    found = standards_of(config)
    update = {
        "optics": found.optics,
        "covariance": found.covariance,
        "height_nm": found.height_nm,
        "optics_assumed": True,
    }
    return config.changed(calibration=update)


def as_given(config: Config) -> Config:
    """Undo `with_standards` if the optics are still those configured."""
    line = config.calibration
    if line is None or not line.optics_assumed or standards_of(config).optics != line.optics:
        return config
    update = dict.fromkeys(("optics", "covariance", "height_nm"), None) | {"optics_assumed": False}
    return config.changed(calibration=update)


def contrast_over(config: Config, standards: Standards) -> tuple[float, str]:
    """Give the contrast per mass over that of standards, and why it cannot be converted."""
    config = config.changed(calibration=None)
    reach_nm = PEAK_SEARCH_RADIUS * config.optics.wavelength_nm / config.optics.na
    rises = (
        forward_model(config, reach_nm).peak_contrast(config.particle.nominal_height_nm, 1e-3) > 0
    )
    line = Calibration(
        gradient_per_kda=1e-5 if rises else -1e-5,
        optics=standards.optics,
        height_nm=standards.height_nm,
    )
    scale = forward_model(config.model_copy(update={"calibration": line}), reach_nm).scale
    return scale.carried, scale.refusal


Line: TypeAlias = str | Path | Calibration | MassCalibration
"""A mass line: the file that ``iscat calibrate mass`` writes, its section, or what measured it."""

_SAME = 1e-3  # by which masses of two lines may differ that are one but for rounding


def mass_line(given: Line) -> Calibration:
    """Give the line of a file or a calibration."""
    if isinstance(given, Calibration):
        return given
    where = "`calibration`"
    if isinstance(given, MassCalibration):
        values = tomllib.loads(given.to_toml())
    elif isinstance(given, (str, Path)):
        path, where = Path(given), str(given)
        values = read_toml(path / "calibration.toml" if is_folder(path) else path)
    else:
        raise ConfigError(
            f"`calibration`: is {type(given).__name__}; give the path of a mass line, as iscat "
            "calibrate mass writes it, or what `calibrate_mass` returns"
        )
    own = {key: value for key, value in values.items() if key == "calibration"}
    line = parse_config(own, where=where).calibration
    if line is None:
        raise ConfigError(
            f"{where}: has no section [calibration]; give the mass line that iscat calibrate mass "
            "writes, calibration.toml"
        )
    return line


def with_line(
    config: Source | Sequence[Source] | None, calibration: Line | None
) -> Source | Sequence[Source] | None:
    """Add a line to what `configure` is given, in place of the lines that are in it."""
    if calibration is None:
        return config
    given: list[Any] = [*config] if isinstance(config, (list, tuple)) else [config]
    line = mass_line(calibration).model_dump(exclude_none=True)
    return [*filter(None, given), {"calibration": line}]


def made_with(table: pd.DataFrame) -> Config | None:
    """Read the configuration with which a table of ours was made; None where it is not known."""
    path = Path(table.attrs.get("file", ""))
    beside = path.with_name("config.toml") if path.name else path
    if path.stem != "fits" or not is_file(beside):
        return None
    try:
        return load_config(beside)
    except ConfigError:
        return None


def measured_contrasts(table: pd.DataFrame, source: object) -> pd.DataFrame:
    """Select the events whose contrasts are right, with the errors of these where they are known.

    Optics that a line does not fit make the masses wrong, not the contrasts.
    """
    if len(table) and table["contrast"].isna().all():
        raise DataError(
            f"{source}: has masses and no contrasts, which a calibration begins with; export the "
            "table with contrasts"
        )
    if "status" in table:
        table = table[table["status"].isin([Status.OK.value, Status.UNCALIBRATED_OPTICS.value])]
    if "sigma_mass_kda" in table and table["sigma_mass_kda"].notna().any():
        relative = table["sigma_mass_kda"] / table["mass_kda"].abs()
        table = table.assign(sigma_contrast=relative * table["contrast"].abs())
    if not table["contrast"].notna().any():
        raise DataError(
            f"{source}: holds no event with status ok and a contrast; a calibration needs landing "
            "events of the standards"
        )
    return table


def weighed(
    table: pd.DataFrame, line: Calibration, source: object
) -> tuple[pd.DataFrame, float | None]:
    """Give the events of a table the masses of a line, and how many times its own they are.

    Where the optics of both are known, the model converts the line from one to the other.
    """
    table = measured_contrasts(table, source)
    contrast = table["contrast"].to_numpy(float)
    ratio = _ratio(table, line, source)
    mass = mass_from_contrast(contrast / ratio, line.gradient_per_kda, line.offset)
    made = table.assign(mass_kda=mass)
    own = table["mass_kda"].to_numpy(float)
    if "sigma_contrast" in table:
        error = table["sigma_contrast"].to_numpy(float) / ratio
        made["sigma_mass_kda"] = error / abs(line.gradient_per_kda)
    made = made.drop(columns="systematic_mass_kda", errors="ignore")
    if line.gradient_se_per_kda or line.offset_se:
        shared = made.get("systematic_contrast", pd.Series(0.0, made.index)).fillna(0.0)
        made["systematic_mass_kda"] = line_sigma_kda(
            mass, line.gradient_per_kda, _covariance(line), shared.to_numpy(float) / ratio
        )
    made = made.drop(columns=["sigma_contrast", "systematic_contrast"], errors="ignore")
    if "status" in made:
        made["status"] = Status.OK.value
    known = np.isfinite(own) & np.isfinite(mass) & (own != 0)
    times = float(np.median(np.abs(mass[known] / own[known]))) if known.any() else 1.0
    return made, None if abs(times - 1) < _SAME else times


def _covariance(line: Calibration) -> FloatArray:
    both = line.correlation * line.gradient_se_per_kda * line.offset_se
    return np.array([[line.gradient_se_per_kda**2, both], [both, line.offset_se**2]])


def _ratio(table: pd.DataFrame, line: Calibration, source: object) -> float:
    """Contrast per mass of a table over that of the standards; 1 where optics are not known."""
    config = made_with(table)
    if config is None or line.optics is None:
        return 1.0
    height = config.particle.nominal_height_nm if line.height_nm is None else line.height_nm
    camera = line.camera or StandardsCamera()
    ratio, refusal = contrast_over(config, Standards(line.optics, line.covariance, height, camera))
    if refusal:
        raise DataError(
            f"{source}: `calibration` is of other optics, and the model does not convert it: "
            f"{refusal}; calibrate with standards in the optics of this table"
        )
    return ratio


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
    grid, step = np.linspace(0.0, float(x.max()) + 4 * h, 4096, retstep=True)
    counts = np.histogram(x, np.append(grid - step / 2, grid[-1] + step / 2))[0]
    density = gaussian_filter1d(counts / step, h / step, mode="constant", truncate=6.0)
    # takes as long to load as NumPy, pandas and this package
    from scipy.signal import find_peaks, peak_widths

    found, about = find_peaks(density, prominence=0)
    # Var Σφ_h(x − x_i) = n·f/(2√π h) for Poisson events.
    noise = np.sqrt(density[found] / (2 * math.sqrt(math.pi) * h))
    found = found[about["prominences"] > 3.0 * noise]
    lowest = [left + int(np.argmin(density[left:right])) for left, right in pairwise(found)]
    valleys = grid[[0, *lowest, -1]].tolist()
    # one standard deviation from a normal mode the density has fallen to exp(−1/2) of it
    whole = density[found], np.zeros_like(found), np.full_like(found, len(grid) - 1)
    halves = peak_widths(density, found, 1 - math.exp(-0.5), prominence_data=whole)[0] * step / 2
    peaks = []
    for centre, half, limits in zip(grid[found], halves, pairwise(valleys), strict=False):
        width = math.sqrt(max(half**2 - h**2, (0.3 * half) ** 2))
        peak = _settled_peak(x, sigma, limits, float(centre), width)
        if peak is not None:
            peaks.append(peak)
    peaks = sorted(peaks, key=lambda peak: -peak.count)[:10]
    return sorted(peaks, key=lambda peak: peak.contrast)


def _settled_peak(
    x: FloatArray, sigma: FloatArray, limits: tuple[float, float], centre: float, width: float
) -> ContrastPeak | None:
    """Fit a peak, then again within the window of the fitted width, until it converges."""
    peak = None
    noise = float(np.sqrt(np.mean(sigma**2)))
    for _ in range(8):
        reach = 2.5 * math.hypot(width, noise)  # the tails of a peak contain other events
        window = max(limits[0], centre - reach), min(limits[1], centre + reach)
        inside = (x > window[0]) & (x < window[1])
        if np.count_nonzero(inside) < 5 or not window[0] < centre < window[1]:
            return peak
        previous, peak = peak, fit_peak(x[inside], sigma[inside], window, centre, width)
        centre, width = peak.contrast, max(peak.width, 0.1 * math.hypot(width, noise))
        if previous is not None and abs(previous.contrast - centre) < 0.1 * peak.contrast_se:
            break
    return peak


def fit_peak(
    x: FloatArray, sigma: FloatArray, window: tuple[float, float], centre: float, width: float
) -> ContrastPeak:
    """Fit a normal distribution, truncated to the window, on a flat background."""
    loss = partial(peak_loss, x, sigma, window, centre, width)
    low, high = np.array([(-1.5, 1.5), (-2.5, 1.0), (-3.0, 6.0)]).T
    bounds = list(zip(low, high, strict=True))
    best = scipy.optimize.minimize(loss, [0.0, 0.0, 2.0], jac=True, method="TNC", bounds=bounds)
    theta, step = np.asarray(best.x), 1e-3
    free = (theta > low + step) & (theta < high - step)
    free[0] = True
    at = np.clip(theta, low + step, high - step)
    slopes = [[loss(at + side * unit)[1] for unit in step * np.eye(3)] for side in (-1, 1)]
    curvature = np.diff(slopes, axis=0)[0] / (2 * step)
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


OFFSET_SHARE = 0.35
"""Largest contrast at zero mass, over the contrast of the lightest peak."""


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
        # a peak may be by a fifth from where somebody says it is
        if nearest is None or off > 0.2 or nearest in chosen:
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
    offset = math.copysign(1.0, line.slope) * line.intercept
    off = _misses(chosen, masses, abs(line.slope), offset)
    worst = int(np.argmax(np.abs(off)))
    start = f"{name}: the standards {_shown(masses)} do not match the peaks ({_found(peaks)}): "
    # A line whose χ² is less probable than this does not fit its standards
    if line.dof and float(chdtrc(line.dof, line.chi2)) < 1e-4:
        raise DataError(
            f"{start}the nearest line misses {masses[worst]:g} kDa by "
            f"{100 * abs(off[worst]):.1f} %, with χ² = {line.chi2:.3g} for "
            f"{count(line.dof, 'degree')} of freedom; {_advice(peaks, masses)}"
        )
    if abs(offset) > OFFSET_SHARE * chosen[0].contrast:
        raise DataError(
            f"{start}zero mass would have the contrast {offset:.2g}, more than {OFFSET_SHARE:g} of "
            f"that of the lightest standard; {_advice(peaks, masses)}"
        )


def _misses(
    chosen: Sequence[ContrastPeak], masses: FloatArray, slope: float, offset: float
) -> FloatArray:
    """Give the relative distances of standards from where a line has their peaks."""
    contrast = np.array([peak.contrast for peak in chosen])
    return np.asarray((contrast - offset) / slope / masses - 1)


def _through(chosen: Sequence[ContrastPeak], masses: FloatArray) -> tuple[float, float]:
    """Give slope and offset of a line through peaks, each of the same relative error."""
    contrast = np.array([peak.contrast for peak in chosen])
    slope, offset = np.polyfit(masses, contrast, 1, w=1 / contrast).tolist()
    return slope, offset


def _nearest(peaks: Sequence[ContrastPeak], masses: FloatArray) -> tuple[list[ContrastPeak], float]:
    """Choose peaks for the standards, and give their total distance from the line."""
    most = max(peak.count for peak in peaks)

    def cost(chosen: tuple[ContrastPeak, ...]) -> float:
        slope, offset = _through(chosen, masses)
        if slope <= 0:
            return math.inf
        away = float(np.sum((_misses(chosen, masses, slope, offset) / 0.02) ** 2))
        away += (offset / (0.15 * chosen[0].contrast)) ** 2
        return away - 2 * sum(math.log(peak.count / most) for peak in chosen)

    best = min(combinations(peaks, int(masses.size)), key=cost)
    return list(best), cost(best)


def _advice(peaks: Sequence[ContrastPeak], masses: FloatArray) -> str:
    """Name the standards that fit the peaks and those that do not."""
    # of more standards than 8 there are too many subsets
    known = _fitting(peaks, masses) if masses.size <= 8 else None
    if known is None:
        return "name the standards that are in the sample"
    others = masses[~np.isin(masses, known)]
    verb = "does not" if others.size == 1 else "do not"
    return f"{_shown(known)} would fit, {_shown(others)} {verb}: leave out what is not there"


def _fitting(peaks: Sequence[ContrastPeak], masses: FloatArray) -> FloatArray | None:
    """Find the largest part of the standards, two at least, that lies on a line through peaks."""
    for size in range(min(int(masses.size) - 1, len(peaks)), 1, -1):
        fits: list[tuple[float, FloatArray]] = []
        for some in map(np.array, combinations(masses.tolist(), size)):
            chosen, cost = _nearest(peaks, some)
            slope, offset = _through(chosen, some)
            near = slope > 0 and np.abs(_misses(chosen, some, slope, offset)).max() < 0.05
            if near and abs(offset) < OFFSET_SHARE * chosen[0].contrast:
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

_CONTRAST_PER_KDA = (3e-7, 1.5e-3)
# Contrast per kDa of any microscope: 3e-5 in visible light, up to 30 times as much if a mask dims
# the reference; less for dense metals, and at long wavelengths if the reference is not dimmed.


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
    if signed.size >= LEAST_EVENTS and lands.mean() < 0.4:
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
    for detail in (1.0, 2.0, 4.0, 0.5):
        peaks = find_contrast_peaks(size, size_errors, detail=detail)
        try:
            chosen = (
                match(peaks, masses, name) if named is None else pick(peaks, named, masses, name)
            )
            contrast, errors = np.array([(p.contrast, p.contrast_se) for p in chosen]).T
            line = york_line(masses, masses_se, direction * contrast, errors)
            check_match(line, chosen, peaks, masses, name)
            break
        except DataError as refusal:
            refusals.append((len(peaks), refusal))
    else:  # the clearest view is the one that shows most peaks
        raise max(refusals, key=lambda each: each[0])[1]
    _refuse_unlikely(line.slope, float(size.max()), masses, name)
    widen = max(1.0, line.chi2 / line.dof) if line.dof else 1.0
    scatter = STANDARDS_SCATTER({"chi2_per_dof": widen, "widened": math.sqrt(widen)})
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
        findings=tuple(
            existing([scatter if widen > 1 else None, None if line.dof else TWO_STANDARDS()])
        ),
    )
    return replace(result, standards=_table(result, chosen, masses, masses_se))


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
    if masses.max() < 10.0:  # lighter than any standard that can be detected
        raise DataError(
            f"{problem}`standards_kda` = {shown} seem to be in MDa; give them in kDa, as 66,146,480"
        )
    raise DataError(
        f"{problem}contrasts, of up to {largest:.3g}, seem to be in per cent; divide them by 100"
    )


def _table(
    line: MassCalibration, chosen: Sequence[ContrastPeak], masses: FloatArray, masses_se: FloatArray
) -> pd.DataFrame:
    """List the standards, their peaks and what the line makes of these."""
    peaks = pd.DataFrame(map(vars, chosen))
    contrast = (-1 if line.landing == "dark" else 1) * peaks["contrast"].to_numpy()
    table = pd.DataFrame({"mass_kda": masses, "mass_se": masses_se, "contrast": contrast})
    table = table.join(peaks[["contrast_se", "width", "count"]])
    table["found_kda"] = line.mass_kda(contrast)
    table["residual_percent"] = 100 * (table["found_kda"] / masses - 1)
    intervals = line.prediction_interval(contrast, table["contrast_se"].to_numpy())
    table["low_kda"], table["high_kda"] = intervals
    return table
