"""What is known of the height of one particle before it is seen.

A particle on the coverslip is some nanometres above it, and no two are equally high.  Mass and
height are written in nearly the same light, the mass in its amplitude and the height in its phase:
a height that is held where it is not makes the mass wrong.  So the height is a nuisance with a
normal prior, p(z) ∝ exp[−(z − z₀)²/2s²].  The maximum of likelihood × prior takes the height from
the data where they tell it, and from the prior where they do not.  Its information is that of the
data and 1/s² of the prior; of its inverse are the errors, and the bound, which is that of van Trees
(H. L. Van Trees, *Detection, Estimation, and Modulation Theory* I (1968), section 2.4).

The prior is that of a nuisance and not cut off at z = 0: where it reaches below, the picture is
continued analytically, so that estimates stay regular and errors those of the information.

`spread_of_heights` finds mean and spread of the heights of many particles.  A movie tells the prior
of its heights itself (empirical Bayes: H. Robbins, Proc. 3rd Berkeley Symp. 1, 157, 1956). Each
event has its own estimate z_i with variance v_i, from its score with respect to z and its
information once all else is fitted.  With heights of mean μ and variance s² these are normal about
μ with variance s² + v_i, and the likelihood of μ and s² is a product over the events.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.records import FloatArray


@dataclass(frozen=True)
class HeightPrior:
    """Normal prior of one particle's height [nm]."""

    mean_nm: float
    sd_nm: float

    @property
    def information(self) -> float:
        """Information of the prior [1/nm²]."""
        return self.sd_nm**-2

    @property
    def range_nm(self) -> tuple[float, float]:
        """Heights that are searched [nm]."""
        away = 5.0 * self.sd_nm
        return self.mean_nm - away, self.mean_nm + away

    def log_density(self, heights_nm: FloatArray) -> FloatArray:
        """Logarithm of the density, from its maximum; of the shape of the heights."""
        density: FloatArray = -0.5 * ((heights_nm - self.mean_nm) / self.sd_nm) ** 2
        return density


def height_prior(config: Config, mass_kda: float) -> HeightPrior | None:
    """Give the prior of the height; None where the height is fixed or free."""
    if not has_prior(config):
        return None
    particle = config.particle
    return HeightPrior(particle.mean_height_nm(mass_kda), particle.height_prior_sd_nm)


def has_prior(config: Config) -> bool:
    """Tell whether heights are a nuisance with a normal prior."""
    return config.fit.mode == "mass" and config.particle.height_prior_sd_nm > 0


FEWEST = 6
"""Events without which nothing is said of the spread of heights."""


_FINEST_NM, _WIDEST_NM, _WIDTHS = 0.05, 300.0, 240  # spreads that are tried
_IN_95 = 3.84  # twice the fall of the log-likelihood at the ends of a 95 % interval


@dataclass(frozen=True)
class HeightSpread:
    """Mean and spread of the heights of many events [nm], with errors.

    Attributes
    ----------
    mean_nm, mean_se_nm : float
        Mean and its standard error.
    sd_nm, sd_low_nm, sd_high_nm : float
        Standard deviation beyond the errors of the estimates, and its 95 % interval.
    excess : float
        Twice the log of the likelihood of this spread over that of none.
    events : int
        How many tell it.
    """

    mean_nm: float
    mean_se_nm: float
    sd_nm: float
    sd_low_nm: float
    sd_high_nm: float
    excess: float
    events: int

    @property
    def is_spread(self) -> bool:
        """Whether heights differ by more than their errors."""
        # Twice the gain in log-likelihood by which a spread is told from none; by chance in
        # 1e-5
        return self.excess > 20.0

    def __str__(self) -> str:
        """Say it as a result."""
        return f"heights {self.mean_nm:.1f} ± {self.sd_nm:.1f} nm"


def spread_of_heights(z_nm: FloatArray, sigma_nm: FloatArray) -> HeightSpread | None:
    """Find mean and spread of the heights behind estimates by maximum likelihood; None of a few.

    Shapes: `z_nm` (n,), `sigma_nm` (n,).
    """
    known = np.isfinite(z_nm) & np.isfinite(sigma_nm) & (sigma_nm > 0)
    z, v = z_nm[known], sigma_nm[known] ** 2
    if z.size >= FEWEST:
        away = np.abs(z - np.median(z))
        # an event farther away is one of another optimum
        kept = away <= 4.0 * np.sqrt((SIGMA_PER_MAD * np.median(away)) ** 2 + v)
        z, v = z[kept], v[kept]
    if z.size < FEWEST:
        return None
    widths = np.concatenate([[0.0], np.geomspace(_FINEST_NM, _WIDEST_NM, _WIDTHS)])
    total = widths[:, None] ** 2 + v
    mean = (z / total).sum(axis=1) / (1 / total).sum(axis=1)
    value = -0.5 * (np.log(total) + (z - mean[:, None]) ** 2 / total).sum(axis=1)
    best = int(np.argmax(value))
    fallen = 2 * (value[best] - value)
    low = float(np.interp(_IN_95, fallen[best::-1], widths[best::-1]))
    high = float(np.interp(_IN_95, fallen[best:], widths[best:]))
    error = float((1 / total[best]).sum()) ** -0.5
    excess, width = 2 * float(value[best] - value[0]), float(widths[best])
    return HeightSpread(float(mean[best]), error, width, low, high, excess, int(z.size))
