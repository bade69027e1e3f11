"""Particles whose images are wider than a point's: they wiggle, or have parts that are apart.

Three measurements estimate v, the variance of a particle's places along each axis:

- The width of its images.  It is weak, since a wider image is nearly a fainter one.
- Their elongation.  Parts that are apart elongate every image in its own direction, and v is at
  least half of the difference between the variances along the long and the short axis.
- Time.  Particles that wiggle from frame to frame have positions that scatter from frame to frame
  by more than the noise at places without a particle.  Motion within a frame does not show so.

The prior of √v is a half-normal law with the standard deviation `uncertainty.wiggle_nm`.
Elongation and time show a share of v: with probability one half none (a wiggle has no direction,
parts that are apart do not move), otherwise any share with equal probability.  With the width, this
gives the posterior of v.  A mass that was fitted with a point is too small by its derivative times
v.  Masses are not corrected, so that their error is this derivative times the root mean square of v
(GUM, F.2.4.5).

Optics that were learned from the same images imitate a part of the width.  With R the correlation
of v and the optics, the images show (1 − R²) v, and masses change by what they do when the optics
follow.  The noise of the width is taken as large as without learning, which is its upper limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy
from scipy.special import chdtrc, chdtri, ndtri

from iscat_analysis.config import Config
from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import LONG_IMAGES, UNEQUAL_HEIGHTS, WIDE_IMAGES
from iscat_analysis.inference.fit import POOR_FIT_P
from iscat_analysis.inference.heights import HeightSpread, has_prior, spread_of_heights
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.inference.repeats import EmpiricalSpread
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.records import BoolArray, FloatArray, Status, has_only
from iscat_analysis.trust.response import response_of

_SIGNIFICANT = 4.0  # standard errors of the mean variance beyond which all particles have it
_CHANCE = 1e-5  # probability that the image of a point is flagged
_OUTLIER_SIGMAS = 4.0  # standard errors beyond which an event is not one of many
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value})
_HIDDEN = 0.5  # probability that length, or time, shows nothing of a spread
_REACH_SIGMAS = 6.0  # of the √v over which the posterior is summed

LogLikelihood = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Extension:
    """Width of the images of all events, beyond that of the model.

    Attributes
    ----------
    variance_nm2, variance_se_nm2 : float
        Mean variance of places along each axis beyond that of the model, estimated from the widths
        of the images alone, and its error [nm²].
    mean_nm2, sd_nm2 : float
        Mean and standard deviation of its posterior [nm²].
    is_common : bool
        Whether all particles are extended.
    is_long : bool
        Whether their images are elongated, each in its own direction.
    long : ndarray of bool
        Rows whose own image is elongated.
    flagged : ndarray of bool
        Rows whose masses are too small because of it.
    mass_shift_kda : ndarray
        Amount by which every mass may be too small [kDa].
    paired : int
        Number of rows whose mass is that of two halves.
    """

    variance_nm2: float
    variance_se_nm2: float
    mean_nm2: float
    sd_nm2: float
    is_common: bool
    is_long: bool
    long: BoolArray
    flagged: BoolArray
    mass_shift_kda: FloatArray
    paired: int = 0

    @classmethod
    def of(
        cls,
        config: Config,
        table: pd.DataFrame,
        evidence: Evidence,
        in_time: Mapping[str, EmpiricalSpread],
    ) -> Extension | None:
        """Estimate the extension from all rows, beyond a known wiggle; None without evidence."""
        q, se = evidence.spread_nm2, evidence.sigma_spread_nm2
        known = np.isfinite(q) & np.isfinite(se) & np.isfinite(evidence.sigma_across_nm2)
        many = has_only(table, _JUDGED) & known
        if not many.any():
            return None
        left, per_mass = 1.0, None
        if config.optics.are_learned:
            respond = response_of(config, table)
            scale = forward_model(config, respond.model.reach_nm).scale
            usual = float(scale.amplitudes(float(table["mass_kda"].abs().median())))
            shifts = respond.to_width(usual)
            # of a width that learned optics do not imitate; less is rounding
            left, per_mass = max(shifts.left, 1e-3), abs(shifts.amplitude)
        mean, error = _mean(q[many], se[many])
        mean, error = mean / left, error / left
        length_nm2, sigmas, shows_length = _length(*(part[many] for part in evidence[7:10]))
        moved, moved_se = _wiggle(table[many], in_time, config.particle.wiggle_nm)
        found = ((mean, mean / error), (length_nm2, sigmas), (moved, moved / moved_se))
        clear = [variance for variance, beyond in found if beyond > _SIGNIFICANT]
        # events without which no spread is called common to all particles
        is_common = bool(clear and many.sum() >= 6)
        prior_sd = config.uncertainty.wiggle_nm
        if is_common:  # a narrow prior would pull a clear width towards zero
            # standard deviation of the prior over a √v that is clear
            prior_sd = max(prior_sd, 2.0 * math.sqrt(max(clear)))
        middle, sd = _posterior((mean, error), prior_sd, shows_length, _normal(moved, moved_se))
        slope = np.abs(np.nan_to_num(evidence.mass_per_spread))
        if per_mass is not None:
            slope = per_mass * table["mass_kda"].abs().to_numpy(float)
        shift = slope * math.hypot(middle, sd)
        flagged = known & (q > 0) & (np.nan_to_num(evidence.chi2_spread) > chdtri(3, _CHANCE))
        if is_common:
            # shift of a mass, in σ, from which on its row is flagged
            too_light = shift > 0.5 * table["sigma_mass_kda"].to_numpy(float)
            flagged = flagged | (known & too_light)
        across, along, error_across = evidence[7:10]
        squares = np.nan_to_num((across**2 + along**2) / error_across**2)
        is_long = is_common and sigmas > _SIGNIFICANT
        long = known & (squares > chdtri(2, _CHANCE))
        return cls(mean, error, middle, sd, is_common, is_long, long, flagged, shift)

    def without(self, rows: BoolArray) -> Extension:
        """Leave out rows that were fitted as two halves.

        Shapes: `rows` (n,).
        """
        return replace(
            self,
            flagged=self.flagged & ~rows,
            mass_shift_kda=np.where(rows, 0.0, self.mass_shift_kda),
            paired=int(rows.sum()),
        )

    @property
    def finding(self) -> Finding | None:
        """That images are wider than the model's; None where they are not."""
        if not self.is_common:
            return None
        kind = LONG_IMAGES if self.is_long else WIDE_IMAGES
        wide = math.sqrt(self.mean_nm2)
        paired = f"; {self.paired} rows have the mass of two halves" if self.paired else ""
        return kind({"width_nm": wide, "error_nm": self.sd_nm2 / (2 * wide), "paired": paired})

    @property
    def summary(self) -> Mapping[str, Any]:
        """The section of ``summary.json``."""
        return {
            "variance_nm2": self.variance_nm2,
            "variance_se_nm2": self.variance_se_nm2,
            "posterior_mean_nm2": self.mean_nm2,
            "posterior_sd_nm2": self.sd_nm2,
            "flagged": int(self.flagged.sum()),
            "paired": self.paired,
        }


def _posterior(
    width: tuple[float, float], prior_sd_nm: float, *shares: LogLikelihood
) -> tuple[float, float]:
    """Mean and standard deviation of v from the width and from measurements of a share [nm²]."""
    mean, error = width
    reach = math.sqrt(max(mean, 0.0) + _REACH_SIGMAS * error)
    root = np.linspace(0.0, min(reach, _REACH_SIGMAS * prior_sd_nm), 1000)
    v = root**2
    if v[-1] == 0:
        return 0.0, 0.0
    logarithm = _normal(mean, error)(v) - 0.5 * (root / prior_sd_nm) ** 2
    weight = np.exp(logarithm - logarithm.max())
    for share in shares:
        weight *= _of_a_share(share, v)
    middle = float(np.average(v, weights=weight))
    return middle, math.sqrt(float(np.average((v - middle) ** 2, weights=weight)))


def _of_a_share(log_likelihood: LogLikelihood, v: FloatArray) -> FloatArray:
    """Likelihood of v if a measurement shows nothing of it, or any share.

    Shapes: `v` (n,), which rises from 0; result (n,).
    """
    logarithm = log_likelihood(v)
    shown = np.exp(logarithm - logarithm.max())
    any_share = np.full(v.size, shown[0])
    any_share[1:] = scipy.integrate.cumulative_trapezoid(shown, v) / v[1:]
    return np.asarray(_HIDDEN * shown[0] + (1 - _HIDDEN) * any_share)


def _normal(mean: float, error: float) -> LogLikelihood:
    return lambda v: -0.5 * ((v - mean) / error) ** 2


def _mean(q: FloatArray, se: FloatArray) -> tuple[float, float]:
    """Weighted mean and its error, without those far from the median.

    Particles that differ by more than their errors have a scatter τ of their own, and the weight
    1/(σ² + τ²), so that the brightest ones weigh no more than others (R. C. Paule and J. Mandel,
    J. Res. NBS 87, 377, 1982).

    Shapes: `q, se` (n,).
    """
    away = np.abs(q - np.median(q))
    kept = away <= _OUTLIER_SIGMAS * np.hypot(1.48 * np.median(away), se)
    q, variance = q[kept], se[kept] ** 2

    def excess(scatter: float) -> float:
        mean = np.average(q, weights=1 / (variance + scatter))
        return float(np.sum((q - mean) ** 2 / (variance + scatter))) - (q.size - 1)

    scatter, most = 0.0, 3 * float(np.sum((q - q.mean()) ** 2))  # with more, the excess is negative
    if q.size > 1 and excess(0.0) > 0:
        scatter = float(scipy.optimize.brentq(excess, 0.0, most))
    weight = 1 / (variance + scatter)
    return float(np.average(q, weights=weight)), 1 / math.sqrt(float(weight.sum()))


def _length(
    across: FloatArray, along: FloatArray, sigma: FloatArray
) -> tuple[float, float, LogLikelihood]:
    """Measure how long images are, each in its own direction.

    A common elongation comes from the optics.  Particles that are far longer than most are left
    out.  Gives half of the difference between the variances along both axes [nm²], its significance
    in standard deviations of a normal law, and its log-likelihood: the sum of squares follows a
    noncentral χ² law, which is normal for many events.

    Shapes: `across, along, sigma` (n,).
    """
    parts = [part - _mean(part, sigma)[0] for part in (across, along)]
    each = (parts[0] ** 2 + parts[1] ** 2) / sigma**2
    kept = each <= np.median(each) * _OUTLIER_SIGMAS**2
    squares, dof = float(each[kept].sum()), 2 * max(int(kept.sum()) - 1, 0)
    precision = float((sigma[kept] ** -2.0).sum())  # [1/nm⁴]

    def log_likelihood(variance: FloatArray) -> FloatArray:
        if not dof:
            return np.zeros(variance.size)
        beyond = variance**2 * precision
        spread = 2 * dof + 4 * beyond
        return -0.5 * ((squares - dof - beyond) ** 2 / spread + np.log(spread))

    significance = -float(ndtri(chdtrc(dof, squares))) if dof else 0.0
    return math.sqrt(max(squares - dof, 0.0) / precision), significance, log_likelihood


def _wiggle(
    table: pd.DataFrame, in_time: Mapping[str, EmpiricalSpread], known_nm: float
) -> tuple[float, float]:
    """Variance of positions from frame to frame beyond the noise, and its error.

    Half of the frames that are compared hold no particle; its wiggle is twice the mean.  Where
    frames were not compared the error is infinite.
    """
    before, after = table["n_before"].to_numpy(float), table["n_after"].to_numpy(float)
    frames = before * after / np.maximum(before + after, 1.0)
    found = []
    for name in ("x_nm", "y_nm"):
        spread = in_time.get(name)
        if spread is None or spread.single or not spread.by_frames or not spread.empty:
            return 0.0, math.inf
        one = float(np.median(table[f"crb_{name}"].to_numpy(float) ** 2 * frames))
        excess = spread.by_frames[0] ** 2 - spread.empty[0] ** 2
        error = 2 * spread.by_frames[0] * spread.by_frames_se[0]
        found.append((2 * excess * one, 2 * error * one))
    (x, x_se), (y, y_se) = found
    return (x + y) / 2 - known_nm**2, math.hypot(x_se, y_se) / 2


@dataclass(frozen=True)
class Heights:
    """Heights that the light of all events shows, and the mass shifts that follow."""

    spread: HeightSpread
    held: bool
    mass_shift_kda: FloatArray  # of every row, where heights are held and are not equal
    learned_optics: bool

    @classmethod
    def of(cls, config: Config, table: pd.DataFrame, evidence: Evidence) -> Heights | None:
        """Estimate the heights from all rows; None where there are too few."""
        held = not has_prior(config)
        # a height that is held makes fits poor itself
        kinds = _JUDGED if held else frozenset({Status.OK.value})
        good = has_only(table, kinds)
        spread = spread_of_heights(evidence.z_nm[good], evidence.sigma_z_nm[good])
        if spread is None:
            return None
        shift = np.zeros(len(table))
        if held and spread.is_spread:
            off = math.hypot(spread.sd_nm, spread.mean_nm - config.particle.nominal_height_nm)
            shift = np.abs(np.nan_to_num(evidence.mass_per_z)) * off
        return cls(spread, held, shift, config.optics.are_learned)

    @property
    def are_wrong(self) -> bool:
        """Whether one height is held although the particles have different heights."""
        return self.held and self.spread.is_spread

    @property
    def finding(self) -> Finding | None:
        """That heights differ where one is held; None where heights and errors agree."""
        return UNEQUAL_HEIGHTS({"spread": str(self.spread)}) if self.are_wrong else None

    @property
    def summary(self) -> Mapping[str, Any]:
        """What ``summary.json`` says."""
        spread = self.spread
        return {
            "mean_nm": spread.mean_nm,
            "mean_se_nm": spread.mean_se_nm,
            "sd_nm": spread.sd_nm,
            "sd_ci95_nm": [spread.sd_low_nm, spread.sd_high_nm],
            "events": spread.events,
            "held": self.held,
            "mean_is_of_learned_optics": self.learned_optics,
        }


_REPLACED = {
    "mass_kda": "pair_mass_kda",
    "sigma_mass_kda": "sigma_pair_mass_kda",
    "crb_mass_kda": "sigma_pair_mass_kda",
    "chi2_reduced": "pair_chi2_reduced",
    "p_value": "pair_p_value",
}


def told_as_pairs(table: pd.DataFrame, extension: Extension) -> BoolArray:
    """Select the extended rows that get the mass of two halves.

    Two halves make elongated images, each in its own direction; wiggling makes images only wider. A
    row counts as two halves if its own image is clearly elongated, or if the images of the movie
    are and the error of the distance in this row is small beside the distance of the movie.  The
    distance that the row itself shows is no criterion: it would select rows that noise has made
    longer.
    """
    square_sigma = 2 * table["separation_nm"] * table["sigma_separation_nm"]
    of_movie = 8 * extension.mean_nm2 if extension.is_long else 0.0  # v is d²/8
    # of the square of the distance, beyond which its error is nearly normal
    two = (of_movie > 2.0 * square_sigma) | extension.long
    return np.asarray(two & table["pair_mass_kda"].notna() & extension.flagged)


def with_masses_of_pairs(table: pd.DataFrame, which: BoolArray) -> pd.DataFrame:
    """Replace masses, errors and goodness of fit; a fit that is good no longer is `poor_fit`."""
    out = table.copy()
    for name, by in _REPLACED.items():
        out.loc[which, name] = table.loc[which, by]
    for row in out.index[which & (table["pair_p_value"] >= POOR_FIT_P).to_numpy()]:
        known = str(out.at[row, "flags"] or "").split(";")
        flags = [flag for flag in known if flag not in ("", Status.POOR_FIT)]
        out.at[row, "flags"] = ";".join(flags)
        out.at[row, "status"] = flags[0] if flags else Status.OK.value
    return out
