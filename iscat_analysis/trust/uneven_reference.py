"""Whether the reference is brighter in some places of the field, from the masses of a few species.

The amplitude of the reference changes the size of a picture and not its shape.  But particles of a
few species have few masses, wherever they land: with the right amplitudes their masses agree best.
How well they agree is the likelihood of each mass given all the others, a density of normal
kernels as wide as the errors of both.  A mass so is never compared with itself, and coefficients
that only follow noise do not raise the likelihood.  What is beyond chance is seen by exchanging the
places of the particles among each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from iscat_analysis.config import Config
from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import UNEVEN_REFERENCE
from iscat_analysis.records import FloatArray, Status

TERMS = ("reference_tilt_x", "reference_tilt_y", "reference_curvature")


MOST_MASSES = 150
"""Masses that are compared, those of the smallest relative error."""

GAIN = 14.0
"""Log-likelihood that the coefficients must gain."""


_LARGEST = 0.3  # of a coefficient
_STEP = 1e-3  # of numerical second derivatives


class ReferenceMap(NamedTuple):
    """Amplitude of the reference over the field, less 1 in the middle, as masses show it."""

    terms: FloatArray
    errors: FloatArray
    field_px: tuple[float, float, float]

    def share(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Give by what share the reference is brighter at places."""
        return np.asarray(_places(x_px, y_px, self.field_px) @ self.terms)

    @property
    def finding(self) -> Finding:
        """That it is so, and what to set."""
        ways = ("along x", "along y", "with the square of the distance")
        sizes = ", ".join(
            f"{100 * value:+.1f} ± {100 * error:.1f} % {way}"
            for value, error, way in zip(self.terms, self.errors, ways, strict=True)
        )
        x, y, curved = self.terms.tolist()
        field = ", ".join(f"{value:.1f}" for value in self.field_px)
        return UNEVEN_REFERENCE({"sizes": sizes, "x": x, "y": y, "curved": curved, "field": field})


def reference_map(config: Config, table: pd.DataFrame) -> ReferenceMap | None:
    """Find how the amplitude of the reference changes over the field, if masses ask for it."""
    optics = config.optics
    configured = any(optics.field_term(name) for name in TERMS)
    fitted = config.fit.masses_free and not config.fit.follows_tracks
    shown = {"x_px", "y_px", "mass_kda", "sigma_mass_kda", "status"} <= set(table.columns)
    if configured or not (optics.interferes and fitted and shown):
        return None
    good = table[(table["status"] == Status.OK.value) & (table["sigma_mass_kda"] > 0)]
    relative = (good["sigma_mass_kda"] / good["mass_kda"].abs()).sort_values()
    rows = good.loc[relative.index[:MOST_MASSES]]
    if len(rows) < 20:  # masses without which nothing is asked for
        return None
    mass, x, y = (rows[name].to_numpy(float) for name in ("mass_kda", "x_px", "y_px"))
    sigma = relative.to_numpy(float)[:MOST_MASSES]
    field_px = optics.field_px or _field_of(x, y)
    place = _places(x, y, field_px)
    terms, gain = _fitted(mass, sigma, place)
    # a coefficient at its limit, or kernels so wide that masses are not those of a few species
    far = np.abs(terms[:-1]).max() >= _LARGEST or math.exp(terms[-1]) > 2.0
    if gain < GAIN or far:
        return None
    rng = np.random.default_rng(len(rows))
    for _ in range(19):  # exchanges of places, with which masses agree clearly less, by 8.0
        if _fitted(mass, sigma, rng.permutation(place))[1] > gain - 8.0:
            return None
    information = -_curvature(mass, sigma, place, terms)
    if not np.all(np.linalg.eigvalsh(information) > 0):
        return None
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    return ReferenceMap(terms[:-1], np.asarray(errors, dtype=np.float64), field_px)


def _field_of(x_px: FloatArray, y_px: FloatArray) -> tuple[float, float, float]:
    """Centre and half side of what the particles cover."""
    low, high = (np.array([end(x_px), end(y_px)]) for end in (np.min, np.max))
    x, y = ((low + high) / 2).tolist()
    return x, y, max(float((high - low).max()) / 2, 1.0)


def _places(x_px: FloatArray, y_px: FloatArray, field_px: tuple[float, float, float]) -> FloatArray:
    """Give what multiplies the coefficients at places, shape (n, 3)."""
    x, y = (x_px - field_px[0]) / field_px[2], (y_px - field_px[1]) / field_px[2]
    return np.column_stack([x, y, x**2 + y**2])


def _fitted(mass: FloatArray, sigma: FloatArray, place: FloatArray) -> tuple[FloatArray, float]:
    """Give coefficients and the width of kernels, and what they gain over a width alone.

    Shapes: `mass, sigma` (n,), `place` (n, 3), result (4,).
    """

    def worse(terms: FloatArray) -> float:
        return -_agreement(mass, sigma, place, terms)

    # of a kernel, over the error of a mass
    low, high = (math.log(width) for width in (0.5, 30.0))
    bounds = [(-_LARGEST, _LARGEST)] * place.shape[1] + [(low, high)]
    widths = np.linspace(low, high, 12)
    alone = -min(worse(np.array([0.0, 0.0, 0.0, w])) for w in widths)
    starts = [np.array([0.0, 0.0, 0.0, math.log(width)]) for width in (8.0, 2.0)]
    fits = [
        scipy.optimize.minimize(worse, start, method="L-BFGS-B", bounds=bounds) for start in starts
    ]
    best = min(fits, key=lambda fit: float(fit.fun))
    return np.asarray(best.x), -float(best.fun) - alone


def _agreement(mass: FloatArray, sigma: FloatArray, place: FloatArray, terms: FloatArray) -> float:
    """Log-likelihood of every mass given all the others.

    Shapes: `terms` (4,), the last the logarithm of the width of kernels over σ.
    """
    brighter = 1 + place @ terms[:-1]
    logarithm = np.log(np.abs(mass) * np.maximum(brighter, 1e-3))
    variance = math.exp(2 * terms[-1]) * (sigma[:, None] ** 2 + sigma**2)
    apart = logarithm[:, None] - logarithm
    density = np.exp(-(apart**2) / (2 * variance)) / np.sqrt(2 * math.pi * variance)
    density *= (mass[:, None] * mass > 0) & ~np.eye(len(mass), dtype=bool)
    # density of masses anywhere, over the logarithm of the mass
    return float(np.log(density.sum(axis=1) / (len(mass) - 1) + 1e-3).sum())


def _curvature(
    mass: FloatArray, sigma: FloatArray, place: FloatArray, terms: FloatArray
) -> FloatArray:
    """Second derivatives of the agreement in the coefficients, shape (3, 3).

    Every pair of masses is counted twice, from either side: half of it is what they tell.  Kernels
    are at least as wide as the errors say.
    """
    terms = np.append(terms[:-1], max(terms[-1], 0.0))
    steps = _STEP * np.eye(len(terms))[:-1]

    def at(shift: FloatArray) -> float:
        return _agreement(mass, sigma, place, terms + shift)

    out = [[at(a + b) - at(a - b) - at(b - a) + at(-a - b) for b in steps] for a in steps]
    return np.array(out) / (8 * _STEP**2)
