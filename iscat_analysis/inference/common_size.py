"""One sphere in many frames: its diameter, and perhaps its refractive index, from all of them.

Every frame f has a place r_f = (x, y, z) of its own, and all frames have c in common: the mass m,
which stands for the diameter, or m and the index n.  With the score and the expected information of
each frame, the places are eliminated,

    I_f = F_cc − F_cr F_rr⁻¹ F_rc,      u_f = s_c − F_cr F_rr⁻¹ s_r,

and a scoring step is Δc = (Σ I_f)⁻¹ Σ u_f, Δr_f = F_rr⁻¹ (s_r − F_rc Δc).  The covariance of c is
(Σ I_f)⁻¹.  Places that are fitted follow the noise of their frame, so that c has a bias which more
frames do not reduce: to first order (D. R. Cox and E. J. Snell, J. R. Stat. Soc. B 30, 248, 1968)

    b = −½ (Σ I_f)⁻¹ Σ_f Σ_pixels w e tr(F_rr⁻¹ ∂²s/∂r²),      e = ∂s/∂c − F_cr F_rr⁻¹ ∂s/∂r,

with the information w of a pixel about its signal s.  Several diameters may have maxima of the
likelihood; frames at different heights exclude all but one sooner than a single frame does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.hessian import PAIRS
from iscat_analysis._kernels.scoring import LARGEST_GAIN_RATIO
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise_models import PixelTerms
from iscat_analysis.inference.sizes import (
    highest_maxima,
    scan_sizes,
    scanned_heights,
    scanned_masses,
    slopes_with_index,
)
from iscat_analysis.optics.sized import SizedModel

FloatArray = NDArray[np.float64]

FOLLOWED = 4
"""Maxima of a scan of diameters that are followed."""

GIVEN_UP = 30.0
"""Log-likelihood below the best maximum at which another is given up, when its next scoring step
could not reach more."""

TOLERANCE = 1e-3
"""Gain of log-likelihood, as a scoring step expects it, at which the fit ends."""

UNDETERMINED = 0.5
"""Error of n − n_s, over its size, from which the index is not told."""

_PASSES = 40
_GROWTH = 0.2  # largest relative change of the mass in a step, and of n − n_s
_HALVINGS = 12


@dataclass(frozen=True)
class CommonSize:
    """One maximum of the likelihood of all frames: of mass, index and every place."""

    mass_kda: float
    index: float
    places: FloatArray
    """x, y and z [nm] and perhaps the level in each frame, shape (frames, 3) or (frames, 4)."""

    log_likelihood: float
    log_weight: float
    """Logarithm of the posterior weight: likelihood times volume, flat in the diameter."""

    information: FloatArray
    """Of each frame about (m) or (m, n), shape (frames, k, k)."""

    prior: FloatArray
    """Information of the motion about the same, shape (k, k)."""

    bias: FloatArray
    """Of (m) or (m, n); the estimates still have it."""

    converged: bool

    def covariance(
        self, correlation: FloatArray | None = None, *, excess: float = 1.0
    ) -> FloatArray:
        """Covariance of (m) or (m, n).

        Frames that share a measured background share its noise: `correlation` (frames, frames).
        `excess` is the variance of the estimates from images over that of counting.
        """
        inverse = np.linalg.inv(self.information.sum(axis=0) + self.prior)
        if correlation is None:
            correlation = np.eye(len(self.information))
        sizes, axes = np.linalg.eigh(self.information)
        roots = axes * np.sqrt(np.maximum(sizes, 0.0))[:, None] @ np.swapaxes(axes, 1, 2)
        spread = np.einsum("fac,fg,gbc->ab", roots, correlation, roots)
        return np.asarray(inverse @ (excess * spread + self.prior) @ inverse)


def common_sizes(
    likelihoods: Sequence[Likelihood],
    model: SizedModel,
    places: FloatArray,
    z_range_nm: tuple[float, float],
) -> list[CommonSize]:
    """Fit one diameter to all frames of a particle: every maximum that is likely, the best first.

    Shapes: `places` (frames, 3), where each frame was fitted alone.
    """
    masses = scanned_masses(model, *model.mass_range_kda)
    heights = scanned_heights(model, *z_range_nm)
    best_height = np.empty((len(likelihoods), masses.size), dtype=np.int64)
    total = np.zeros(masses.size)
    for f, likelihood in enumerate(likelihoods):
        theta = np.array([*places[f], 0.0, 0.0])
        values = scan_sizes(likelihood, model, theta, masses, heights)
        best_height[f] = np.argmax(values, axis=1)
        total += values.max(axis=1)
    found: list[CommonSize] = []
    for (k,) in highest_maxima(total, FOLLOWED):
        start = np.column_stack([places[:, :2], heights[best_height[:, k]]])
        best = max((one.log_likelihood for one in found if one.converged), default=-math.inf)
        one = fit_common_size(
            likelihoods, model, start, z_range_nm, mass_kda=float(masses[k]), least=best - GIVEN_UP
        )
        if one is not None and not any(
            abs(one.mass_kda / other.mass_kda - 1) < 1e-3 for other in found
        ):
            found.append(one)
    return sorted(found, key=lambda one: (not one.converged, -one.log_likelihood))


def fit_common_size(
    likelihoods: Sequence[Likelihood],
    model: SizedModel,
    places: FloatArray,
    z_range_nm: tuple[float, float],
    *,
    mass_kda: float,
    index: float | None = None,
    motion: tuple[float, float] | None = None,
    least: float = -math.inf,
) -> CommonSize | None:
    """Fit mass and places of all frames, from a start; the index too where one is given.

    None where the start has no likelihood, as where light would be negative.

    `motion` is 1/d of the hydrodynamic diameter and its error [1/nm], a prior that is normal in D.
    A level that is given beside the places is fitted as they are.

    Shapes: `places` (frames, 3) or (frames, 4).
    """
    free_index = index is not None
    common = np.array([mass_kda, index] if index is not None else [mass_kda])
    rows = places.copy()
    rows[:, 2] = np.clip(rows[:, 2], *z_range_nm)
    here = _gathered(likelihoods, model, rows, common, z_range_nm, motion)
    if not math.isfinite(here.value):
        return None
    converged = False
    for _ in range(_PASSES):
        step, moves, gain = _scoring_step(here)
        if gain < TOLERANCE:
            converged = True
            break
        if here.value + LARGEST_GAIN_RATIO * gain < least:
            break
        largest = np.abs(step) / (
            _GROWTH * np.abs(common - [0.0, model.optics.n_sample][: step.size])
        )
        far = np.abs(moves) / (0.1 * model.optics.wavelength_nm)
        share = 1 / max(1.0, float(largest.max()), float(far.max()))
        for _ in range(_HALVINGS):
            trial, at = common + share * step, rows + share * moves
            at[:, 2] = np.clip(at[:, 2], *z_range_nm)
            there = _gathered(likelihoods, model, at, trial, z_range_nm, motion)
            if there.value >= here.value - 0.1 * TOLERANCE:
                break
            share /= 2
        else:
            break
        common, rows, here = trial, at, there
    return CommonSize(
        mass_kda=float(common[0]),
        index=float(common[1]) if free_index else model.sphere.index.real,
        places=rows,
        log_likelihood=here.value,
        log_weight=here.value + _log_volume(here),
        information=here.information,
        prior=here.known - here.information.sum(axis=0),
        bias=_bias(likelihoods, model, rows, common, here),
        converged=converged,
    )


class _Frames(NamedTuple):
    """Value, and scores and information of every frame with the places eliminated."""

    value: float
    pull: FloatArray  # of c, of all frames and the prior
    known: FloatArray  # the same of the information
    information: FloatArray  # of each frame
    place_score: FloatArray
    place_inverse: FloatArray
    mixed: FloatArray  # F_rc
    scale: float  # diameter over 3 m


def _model_of(model: SizedModel, common: FloatArray) -> SizedModel:
    """Give the model of an index, or the same."""
    return model if common.size == 1 else model.of_index(float(common[1]))


def _gathered(
    likelihoods: Sequence[Likelihood],
    model: SizedModel,
    places: FloatArray,
    common: FloatArray,
    z_range_nm: tuple[float, float],
    motion: tuple[float, float] | None,
) -> _Frames:
    """Compute value, scores and information of all frames."""
    (n, p), k = places.shape, common.size
    value, pull, scores = 0.0, np.zeros(k), np.zeros((n, p))
    information, inverse, mixed = np.zeros((n, k, k)), np.zeros((n, p, p)), np.zeros((n, p, k))
    mass = float(common[0])
    for f, likelihood in enumerate(likelihoods):
        terms, rows = _terms(likelihood, model, places[f], common)
        value += terms.value
        if not math.isfinite(value):
            break
        flat = rows.reshape(p + k, -1)
        score = flat @ terms.score.ravel()
        fisher = (flat * terms.information.ravel()) @ flat.T
        z, down = places[f, 2], score[2] < 0
        free = np.ones(p, dtype=bool)
        free[2] = not (z <= z_range_nm[0] if down else z >= z_range_nm[1])
        held = np.ix_(free, free)
        whole = np.zeros((p, p))
        whole[held] = np.linalg.inv(fisher[:p, :p][held])
        scores[f], inverse[f], mixed[f] = score[:p], whole, fisher[:p, p:]
        information[f] = fisher[p:, p:] - mixed[f].T @ whole @ mixed[f]
        pull += score[p:] - mixed[f].T @ whole @ score[:p]
    known = information.sum(axis=0)
    diameter = model.sphere.of_mass(mass).diameter_nm
    if motion is not None:
        off, slope = 1 / diameter - motion[0], -1 / (3 * mass * diameter)
        value -= 0.5 * (off / motion[1]) ** 2
        pull[0] -= off * slope / motion[1] ** 2
        known = known.copy()
        known[0, 0] += (slope / motion[1]) ** 2
    if not math.isfinite(value):
        value = -math.inf
    return _Frames(value, pull, known, information, scores, inverse, mixed, diameter / (3 * mass))


def _terms(
    likelihood: Likelihood, model: SizedModel, place: FloatArray, common: FloatArray
) -> tuple[PixelTerms, FloatArray]:
    """Terms of the likelihood of a frame, and the slopes of its expectation in places and c.

    Shapes: `place` (p,), `common` (k,), rows (p + k, ny, nx).
    """
    signal, rows = slopes(likelihood, model, place[:3], common)
    level = float(place[3]) if place.size > 3 else 0.0
    terms = likelihood.noise.terms(likelihood.data, signal, level)
    rows = rows * terms.by_signal
    if place.size > 3:
        rows = np.insert(rows, 3, terms.by_level, axis=0)
    return terms, rows


def slopes(
    likelihood: Likelihood, model: SizedModel, place: FloatArray, common: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signal of a frame, and its derivatives in (x, y, z, m) or (x, y, z, m, n)."""
    x, y, z = place.tolist()
    mass, *index = common.tolist()
    if not index:
        return model.amplitude_gradient(likelihood.grid, x, y, z, mass)
    return slopes_with_index(model, likelihood.grid, (x, y, z), mass, index[0])


def _scoring_step(here: _Frames) -> tuple[FloatArray, FloatArray, float]:
    """Give the steps of c and of the places, and the gain that they are expected to bring."""
    step = np.asarray(np.linalg.solve(here.known, here.pull), dtype=np.float64)
    left = here.place_score - here.mixed @ step
    moves: FloatArray = np.einsum("fij,fj->fi", here.place_inverse, left)
    alone = float(np.einsum("fi,fij,fj->", here.place_score, here.place_inverse, here.place_score))
    return step, moves, 0.5 * (float(step @ here.pull) + alone)


def _log_volume(here: _Frames) -> float:
    """Logarithm of the volume of the posterior, in places and diameter."""
    spread = np.linalg.inv(here.known)
    free = [inverse[np.ix_(kept, kept)] for inverse in here.place_inverse
            for kept in [np.diag(inverse) > 0]]  # fmt: skip
    volume = sum(float(np.linalg.slogdet(2 * math.pi * one)[1]) for one in free)
    volume += float(np.linalg.slogdet(2 * math.pi * spread)[1])
    return 0.5 * volume + math.log(here.scale)


def _bias(
    likelihoods: Sequence[Likelihood],
    model: SizedModel,
    places: FloatArray,
    common: FloatArray,
    here: _Frames,
) -> FloatArray:
    """Bias of c that places which follow the noise of their frame make."""
    total = np.zeros(common.size)
    mass = float(common[0])
    linear = _model_of(model, common).at(mass)
    for f, likelihood in enumerate(likelihoods):
        terms, rows = _terms(likelihood, model, places[f], common)
        bends = linear.derivative_rows(likelihood.grid, np.array([*places[f, :3], mass]))
        inverse, p = here.place_inverse[f], places.shape[1]
        traced = sum(
            (1 if i == j else 2) * inverse[i, j] * bends[:, 5 + pair]
            for pair, (i, j) in enumerate(PAIRS)
            if j < 3
        )
        along = rows[p:] - np.einsum("ic,i...->c...", inverse @ here.mixed[f], rows[:p])
        weight = terms.information * terms.by_signal
        total += np.tensordot(along, weight * traced, axes=2)
    return np.asarray(-0.5 * np.linalg.solve(here.known, total))
