"""Test of the configured optics by the sum of the scores of all images.

Each image has a score and an information of the optics, with its own parameters (place, mass,
level) eliminated.  The prior of the change of the optics is normal with covariance P, the square of
the usual error of each parameter.  For scores that sum to S with information I, the change has the
posterior mean CS with C = (P⁻¹ + I)⁻¹, and optics that are off are by the factor

    B = exp(½ SᵀCS) / √det(1 + PI)

likelier than those that are right (R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90, 773 (1995)).
One parameter may be off, or all: B is the mean over these, of which all are as likely before.
The remaining doubt about the optics is an error of all masses: the width C of what prior and images
leave, and the change CS, whose square counts with the probability B/(1 + B) that there is one.

Images that show something else, such as two particles at once, disagree with each other.  Scores
and information are divided by the ratio of the scatter of the scores to that expected from the
information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp

from iscat_analysis.instrument.joint_fit import asked_changes, excess
from iscat_analysis.instrument.measure import TWIN_GAP
from iscat_analysis.instrument.particle_image import Build, ParticleImage
from iscat_analysis.optics.local import BASES
from iscat_analysis.optics.parameters import FREE, Prior, Settings, free_names
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.trust.systematic import REJECTED_SHARE


@dataclass(frozen=True)
class ScoreTest:
    """Change of the optics that the sum of scores asks for, and the evidence for it.

    Shapes: `change` (n,), `covariance` (n, n).
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    """As configured."""

    change: FloatArray
    covariance: FloatArray
    log_bayes_factor: float
    """Of optics that are off, over the configured ones."""

    left_over: float
    """Part of the images that the change explains, over the images (root mean square), with the
    probability of a change as a factor of its square."""

    field_px: tuple[float, float, float] | None = None
    """Centre x, y and half the longer side of the field that its terms refer to."""

    @property
    def rejected(self) -> bool:
        """Whether other optics are clearly likelier, and different enough to change masses."""
        return self.log_bayes_factor > TWIN_GAP and self.left_over > REJECTED_SHARE

    @property
    def posterior(self) -> FloatArray:
        """Covariance of errors that the configured optics may have after the test, (n, n)."""
        off = float(expit(self.log_bayes_factor))
        return np.asarray(self.covariance + off * np.outer(self.change, self.change))


def score_test(
    images: Sequence[ParticleImage],
    build: Build,
    settings: Settings,
    prior: Prior,
    terms: Sequence[str] = (),
    mapper: Mapper = map,
) -> ScoreTest:
    """Test the optics by images that were each fitted with the configured optics.

    `terms` are coefficients of the field that are tested beside the optics.
    """
    names = (*free_names(tuple(FREE), settings, FREE["zernike"]), *terms)
    usual = prior.errors(names)
    size, count = len(names), len(images)
    score, information = np.zeros((count, size)), np.zeros((count, size, size))
    if count:
        bases = tuple(dict.fromkeys(base for name in names for base in BASES.get(name, (name,))))
        asked = asked_changes(images, build, settings, bases, mapper)
        slopes = np.array(
            [
                [[image.slopes(name).get(base, 0.0) for base in bases] for name in names]
                for image in images
            ]
        )
        score = np.einsum("nik,nk->ni", slopes, asked.score) * usual
        information = np.einsum("nik,nkl,njl->nij", slopes, asked.information, slopes)
        information *= np.outer(usual, usual)
    total, asks = information.sum(axis=0), score.sum(axis=0)
    change = np.linalg.solve(np.eye(size) + total, asks)
    # residual scores, which no common change of the optics explains
    disagreement = excess(total, score - information @ change, np.arange(count))
    widened = max(disagreement, 1.0)
    total, asks = total / widened, asks / widened
    spread = np.linalg.inv(np.eye(size) + total)
    change = spread @ asks
    gains, explains = np.transpose(
        [
            _alternative(total[np.ix_(free, free)], asks[free])
            for free in (*np.arange(size)[:, None], np.arange(size))
        ]
    )
    gain = float(logsumexp(gains)) - math.log(len(gains))
    power = math.fsum(image.snr**2 for image in images)
    explained = float(expit(gain)) * explains[np.argmax(gains)]
    left_over = math.sqrt(explained / power) if power else 0.0
    values = tuple(float(settings.get(name, 0.0)) for name in names)
    covariance = spread * np.outer(usual, usual)
    return ScoreTest(names, values, usual * change, covariance, gain, left_over)


def _alternative(information: FloatArray, asks: FloatArray) -> tuple[float, float]:
    """Give log B of other optics, and what their change explains of the images."""
    posterior = np.eye(asks.size) + information
    change = np.linalg.solve(posterior, asks)
    gain = 0.5 * float(asks @ change) - 0.5 * float(np.linalg.slogdet(posterior)[1])
    return gain, max(float(change @ information @ change), 0.0)
