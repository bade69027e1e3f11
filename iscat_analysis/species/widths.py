"""How wide peaks are: a weak prior on widths that grow with a power of the mass.

The logarithm of the whole width of a peak, T² = τ² + σ² with the usual error σ of the events, lies
about a line in the logarithm of the mass,

    ln T_k = a + p ln m_k + d_k,    p ~ N(1/2, 1/2),    d_k ~ N(0, `_DEVIATION`),

with any a: shot noise makes p one half where every particle has its own light, and 0 where all
share that of the background.  What the table tells of a and p is integrated out, so that the prior
is a quadratic form in the widths alone.  One peak by itself is free, two tell little of each other,
and in a table of several a spike of three events or a peak as wide as two is unlikely.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis.records import FloatArray

_POWER, _POWER_SPREAD = 0.5, 0.5
_DEVIATION = 0.25  # of ln T
_ANY = 100.0  # of a, in ln T: as good as flat


def width_prior(mass: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give R and c of the prior −|R ln T − c|²/2 of widths at about these masses.

    Shapes: `mass` (k,), results (k, k), (k,).
    """
    away = np.log(np.maximum(mass, 1e-9))
    away = away - away.mean()
    covariance = _DEVIATION**2 * np.eye(mass.size) + _ANY**2
    covariance += _POWER_SPREAD**2 * np.outer(away, away)
    rows = np.linalg.inv(np.linalg.cholesky(covariance))
    return rows, rows @ (_POWER * away)
