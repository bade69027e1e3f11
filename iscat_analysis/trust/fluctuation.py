"""Contrast of particles that fluctuates slowly while they are there, and what is left in the mean.

Particles breathe, turn or move in the light, so that the contrast of event i in frame t is
a_i (1 + ε_t), with ε of variance s² and correlation exp(−t/τ), the same law for all particles of a
movie.  The cosine components of the frames of one side of a step are then independent to a good
approximation, with the variance

    v_ij = ℓ_j + λ_i s² S_j(τ),

λ_i the squared signal-to-noise ratio of one frame, S_j the variance of component j of an ε of unit
variance, and ℓ_j that of the noise, which is 1 if the noise is white and is measured where there is
no particle.  The squares of all components are χ², so that their likelihood is known
(P. Whittle, J. R. Stat. Soc. B 15, 125 (1953)), and nothing has to be assumed of how estimates from
blocks of different lengths go together.

Whether a movie fluctuates, and how, follows by Bayes' theorem from a grid of s and τ.  An event may
also change on its own, by a fluctuation that others do not have, which is why no single event
decides.  The mean over the n frames of an event has the relative variance s² V_n(τ).  Its mean over
the posterior, with that the movie does not fluctuate at all, is added to the variance of a mass: a
fluctuation that is half certain is in the error with half of its variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import logsumexp

from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.inference.split_frames import MODES, spectra_of
from iscat_analysis.records import FREE_PARAMETERS, BoolArray, FloatArray, Status

_PRIOR = 0.1  # probability that a movie fluctuates, before its frames are looked at
_ALONE = 0.05  # probability that an event changes on its own
_SEEN = 0.7  # probability from which it is told; one event alone gives no more than 0.69
_RELATIVE = np.geomspace(0.01, 0.3, 60)
_CORRELATIONS = np.geomspace(2.0, 600.0, 18)  # frames
_SLOWEST = 2.0  # correlation time over a window; what is slower is a course, not a fluctuation
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value, Status.CHANGING.value})


@dataclass(frozen=True)
class Fluctuation:
    """Relative fluctuation of the particles' contrasts.

    Attributes
    ----------
    probability : float
        Of that there is one.
    relative : float
        Standard deviation over the contrast, if there is one.
    relative_se : float
        Its standard error.
    frames : float
        Correlation time [frames].
    variance_kda2 : ndarray
        What it adds to the variance of every mass [kDa²].
    """

    probability: float
    relative: float
    relative_se: float
    frames: float
    variance_kda2: FloatArray

    @classmethod
    def of(
        cls,
        mode: str,
        table: pd.DataFrame,
        repeats: Sequence[FloatArray],
        achieved: Mapping[str, EmpiricalSpread],
        shared_place: BoolArray,
    ) -> Fluctuation | None:
        """Look for it in the frames of all events; None where the frames speak against it.

        A small step at the place of another particle shows the fluctuation of that one, too large
        for the mass of its own, and is left out.

        Shapes: `shared_place` (events,).
        """
        pooled = achieved.get("mass_kda")
        if mode != "mass" or pooled is None or pooled.single or len(pooled.empty) < 2:
            return None
        mass, crb = (table[name].to_numpy(float) for name in ("mass_kda", "crb_mass_kda"))
        before, after = (table[name].to_numpy(float) for name in ("n_before", "n_after"))
        there = np.where(mass > 0, after, before)
        one = crb**2 * before * after / (before + after)  # variance of a single frame
        marks = zip(table["status"], table["flags"].fillna(""), strict=True)
        good = np.array([{s, *str(f).split(";")} - {""} <= _JUDGED for s, f in marks], dtype=bool)
        good &= np.isfinite(mass**2 / one) & ~shared_place
        if not good.any():
            return None
        spectra = spectra_of(np.stack(repeats)[good])
        own = spectra[np.arange(len(spectra)), (mass[good] > 0).astype(int)]
        squares, counts = own[:, :, FREE_PARAMETERS[mode].index("mass_kda")], own[:, :, -1]
        window = float(np.median(there[good]))
        taus = _CORRELATIONS[max(_SLOWEST * window, _CORRELATIONS[0]) >= _CORRELATIONS]
        evidence = _Evidence.of(
            squares, counts, there[good], (mass**2 / one)[good], taus, pooled, window
        )
        if evidence.factor <= 1:
            return None
        posterior = evidence.posterior
        variance = _RELATIVE[:, None] ** 2
        numbers, which = np.unique(there.astype(np.int64), return_inverse=True)
        left = np.array([[_of_mean(n, tau) for tau in taus] for n in numbers.tolist()])
        added = mass**2 * (left @ np.sum(posterior * variance, axis=0))[which]
        given = posterior / posterior.sum()
        mean = float(np.sum(given * _RELATIVE[:, None]))
        step = mean * math.log(_RELATIVE[1] / _RELATIVE[0])
        error = math.sqrt(max(float(np.sum(given * variance)) - mean**2, 0.0) + step**2 / 12)
        tau = math.exp(float(np.sum(given * np.log(taus))))
        return cls(min(float(posterior.sum()), 1.0), mean, error, tau, np.nan_to_num(added))

    @property
    def is_seen(self) -> bool:
        """Whether it is probable enough to be told."""
        return self.probability > _SEEN

    @property
    def message(self) -> str:
        """Message for the user; empty where it is not seen."""
        if not self.is_seen:
            return ""
        return (
            f"contrasts fluctuate by {100 * self.relative:.2g} ± {100 * self.relative_se:.1g} % "
            f"while particles are there, over some {self.frames:.2g} frames: sigma_mass_kda has "
            "what is left of that in the mean of an event's frames, beyond the noise of the light"
        )

    @property
    def summary(self) -> Mapping[str, Any]:
        """What ``summary.json`` says."""
        return {
            "probability": self.probability, "relative": self.relative,
            "relative_se": self.relative_se, "frames": self.frames,
        }  # fmt: skip


@dataclass(frozen=True)
class _Evidence:
    """Likelihoods of s and τ over that of no fluctuation, from all events.

    Shapes: `log_ratio` (s, τ).
    """

    log_ratio: FloatArray

    @classmethod
    def of(
        cls,
        squares: FloatArray,
        counts: FloatArray,
        there: FloatArray,
        strength: FloatArray,
        taus: FloatArray,
        pooled: EmpiricalSpread,
        window: float,
    ) -> _Evidence:
        """Compare the spectra with the noise and with every fluctuation.

        Shapes: `squares, counts` (events, bins), `there, strength` (events,), `taus` (τ,).
        """
        total = np.zeros((_RELATIVE.size, taus.size))
        expected: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
        for square, count, n, snr2 in zip(squares, counts, there, strength, strict=True):
            held = count > 0
            if not held.any():
                continue
            key = max(int(count.sum()) + 1, int(n)), int(held.sum())
            if key not in expected:
                expected[key] = _expected(*key, taus, pooled, window)
            noise, shape = expected[key]
            signal = snr2 * _RELATIVE[:, None, None] ** 2 * shape / noise
            gain = square[held] / noise * signal / (1 + signal) - count[held] * np.log1p(signal)
            ratio = 0.5 * gain.sum(axis=2)
            alone = logsumexp(ratio) - math.log(ratio.size)
            own = math.log(_ALONE) + alone
            total += np.logaddexp(math.log1p(-_ALONE) + ratio, own)
            total -= np.logaddexp(math.log1p(-_ALONE), own)
        return cls(total)

    @property
    def factor(self) -> float:
        """Bayes factor of some fluctuation over none."""
        return math.exp(min(float(logsumexp(self.log_ratio)) - math.log(self.log_ratio.size), 500))

    @property
    def posterior(self) -> FloatArray:
        """Probability of every s and τ; what is missing to 1 is that of no fluctuation.

        Shapes: result (s, τ).
        """
        weight = self.log_ratio + math.log(_PRIOR / self.log_ratio.size)
        whole = np.logaddexp(logsumexp(weight), math.log1p(-_PRIOR))
        return np.asarray(np.exp(weight - whole))


def _expected(
    frames: int, bins: int, taus: FloatArray, pooled: EmpiricalSpread, window: float
) -> tuple[FloatArray, FloatArray]:
    """Mean square of the components in every bin: of noise, and of an ε of unit variance.

    Shapes: `taus` (τ,), result (bins,), (τ, bins).
    """
    modes = np.arange(1, min(frames, MODES[bins]))
    starts = np.array(MODES[:bins]) - 1
    held = np.diff(np.append(starts, modes.size))
    noise = _without(pooled, frames / (2 * modes), window)
    shape = np.stack([_components(modes, frames, tau) for tau in taus])
    return np.add.reduceat(noise, starts) / held, np.add.reduceat(shape, starts, axis=1) / held


def _components(modes: NDArray[np.int64], frames: int, tau: float) -> FloatArray:
    """Variance of cosine components of a process of unit variance and correlation exp(−t/τ).

    Two such cosines that are k frames apart have the product ((n − k) cos kθ − sin kθ / sin θ) / n,
    θ = πj/n, whose sum over all k with the weight exp(−k/τ) is geometric.

    Shapes: `modes` (j,), result (j,).
    """
    theta = np.pi * modes / frames
    z = np.exp(1j * theta - 1 / tau)
    last = z**frames
    plain = (z - last) / (1 - z)
    linear = (z - frames * last + (frames - 1) * last * z) / (1 - z) ** 2
    whole = (plain - linear / frames).real - plain.imag / (frames * np.sin(theta))
    return np.asarray(1 + 2 * whole)


def _without(pooled: EmpiricalSpread, lengths: FloatArray, window: float) -> FloatArray:
    """Mean square between blocks of so many frames where there is no particle.

    Shapes: `lengths` (n,), result (n,).
    """
    levels = np.square(pooled.empty[1:-1] or pooled.empty[:1])
    parts = window / 8 * 2.0 ** np.arange(levels.size)
    return np.asarray(np.interp(lengths, parts, levels))


def _of_mean(frames: int, tau: float) -> float:
    """Variance of a mean over frames, over that of one frame."""
    lags = np.arange(1, frames)
    return float(1 + 2 * np.sum((1 - lags / frames) * np.exp(-lags / tau))) / max(frames, 1)
