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
"""

from __future__ import annotations

from dataclasses import dataclass

from iscat_analysis.config import Config
from iscat_analysis.records import FloatArray

REACH = 5.0
"""Standard deviations of the prior within which the height is searched."""


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
        away = REACH * self.sd_nm
        return self.mean_nm - away, self.mean_nm + away

    def log_density(self, heights_nm: FloatArray) -> FloatArray:
        """Logarithm of the density, from its maximum; of the shape of the heights."""
        density: FloatArray = -0.5 * ((heights_nm - self.mean_nm) / self.sd_nm) ** 2
        return density


def height_prior(config: Config, mass_kda: float) -> HeightPrior | None:
    """Give the prior of the height; None where the height is fixed or free."""
    particle = config.particle
    if not has_prior(config):
        return None
    return HeightPrior(particle.mean_height_nm(mass_kda), particle.height_prior_sd_nm)


def has_prior(config: Config) -> bool:
    """Tell whether heights are a nuisance with a normal prior."""
    return config.fit.mode == "mass" and config.particle.height_prior_sd_nm > 0
