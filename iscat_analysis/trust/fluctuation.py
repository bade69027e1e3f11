"""Contrast of particles that fluctuates while they are there, and the error of its mean.

Particles breathe, turn or move in the light, so that the contrast of event i in frame t is
a_i (1 + ε_t), with ε of variance s² and correlation exp(−t/τ), the same law for all particles of a
movie.  The cosine components of the frames of one side of a step are then independent to a good
approximation, with the variance

    v_ij = ℓ_j + λ_i s² S_j(τ),

λ_i the squared signal-to-noise ratio of one frame, S_j the variance of component j of an ε of unit
variance, and ℓ_j that of the noise, which is 1 if the noise is white and is measured where there is
no particle.  The frames are more than those of a fit, so that slow fluctuations show.  The
squares of all components are χ², so that their likelihood is known (P. Whittle, J. R. Stat. Soc. B
15, 125 (1953)), and nothing has to be assumed of how estimates from blocks of different lengths go
together.

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

from iscat_analysis.inference.repeats import MODES, EmpiricalSpread, spectra_of
from iscat_analysis.records import FREE_PARAMETERS, BoolArray, FloatArray, Status, has_only

_PRIOR = 0.1  # probability that a movie fluctuates, before its frames are looked at
_ALONE = 0.05  # probability that an event changes on its own
_SEEN = 0.75  # probability for a message; one event alone gives 0.69
_RELATIVE = np.geomspace(0.01, 0.3, 60)
_CORRELATIONS = np.geomspace(2.0, 1000.0, 20)  # frames
_SLOWEST = 4.0  # correlation time over the frames that show it; slower is a course
_KNOWN = 16.0  # components that the noise of half a window counts for in that of longer ones
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value, Status.CHANGING.value})


@dataclass(frozen=True)
class Fluctuation:
    """Relative fluctuation of the particles' contrasts.

    Attributes
    ----------
    probability : float
        Probability that contrasts fluctuate.
    relative : float
        Standard deviation over the contrast, if there is one.
    relative_se : float
        Its standard error.
    frames : float
        Correlation time [frames].
    variance_kda2 : ndarray
        Its contribution to the variance of every mass [kDa²].
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
        """Estimate it from the frames of all events; None where steady contrasts are likelier.

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
        good = has_only(table, _JUDGED) & np.isfinite(mass**2 / one) & ~shared_place
        if not good.any():
            return None
        spectra = spectra_of(np.stack(repeats)[good])
        squares = spectra[..., FREE_PARAMETERS[mode].index("mass_kda")]
        counts = spectra[..., -1]
        frames = (counts.sum(axis=2) + 1).astype(np.int64)  # without, with a particle
        frames[:, 1] = np.maximum(frames[:, 1], there[good])  # of which not all are in bins
        longest = _SLOWEST * float(np.median(frames[:, 1]))
        taus = _CORRELATIONS[max(longest, _CORRELATIONS[0]) >= _CORRELATIONS]
        window = float(np.median(there[good]))
        noise = _Noise.of(pooled, window, squares[:, 0], counts[:, 0], frames[:, 0])
        evidence = _Evidence.of(
            squares[:, 1], counts[:, 1], frames[:, 1], (mass**2 / one)[good], taus, noise
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
        """Whether it is probable enough for a message."""
        return self.probability > _SEEN

    @property
    def message(self) -> str:
        """Message for the user; empty where it is not seen."""
        if not self.is_seen:
            return ""
        frames = float(f"{self.frames:.2g}")
        return (
            f"contrasts fluctuate by {100 * self.relative:.2g} ± {100 * self.relative_se:.1g} % "
            f"while particles are there, over some {frames:g} frames: masses have the error that "
            "remains in the mean over an event's frames, and sigma_mass_kda contains it"
        )

    @property
    def summary(self) -> Mapping[str, Any]:
        """The section of ``summary.json``."""
        return {
            "probability": self.probability,
            "relative": self.relative,
            "relative_se": self.relative_se,
            "frames": self.frames,
        }


@dataclass(frozen=True)
class _Noise:
    """Mean square of the components where there is no particle.

    Up to half a window it is that between blocks of frames at empty places.  Slower noise is that
    of the events' own places before they land or after they leave.
    """

    lengths: FloatArray
    levels: FloatArray
    slow: float = 1.0

    @classmethod
    def of(
        cls,
        pooled: EmpiricalSpread,
        window: float,
        squares: FloatArray,
        counts: FloatArray,
        frames: NDArray[np.int64],
    ) -> _Noise:
        """Measure it.

        Shapes: `squares, counts` (events, bins), `frames` (events,).
        """
        levels = np.square(pooled.empty[1:-1] or pooled.empty[:1])
        fast = cls(np.ldexp(window / 8, np.arange(levels.size)), levels)
        excess = number = _KNOWN
        for square, count, n in zip(squares, counts, frames.tolist(), strict=True):
            bins = int((count > 0).sum())
            if not bins:
                continue
            slow = n / (2 * np.array(MODES[:bins])) > window / 2
            expected = fast.in_bins(n, bins)
            excess += float(np.sum((square[:bins] / expected)[slow]))
            number += float(count[:bins][slow].sum())
        return cls(fast.lengths, levels, excess / number)

    def in_bins(self, frames: int, bins: int) -> FloatArray:
        """Give it for every bin of so many frames.

        Shapes: result (bins,).
        """
        modes, starts = _modes(frames, bins)
        lengths = frames / (2 * modes)
        level = np.interp(lengths, self.lengths, self.levels)
        level = np.where(lengths > 4 * self.lengths[0], level * self.slow, level)
        return np.asarray(np.add.reduceat(level, starts) / _held(modes, starts))


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
        frames: NDArray[np.int64],
        strength: FloatArray,
        taus: FloatArray,
        noise: _Noise,
    ) -> _Evidence:
        """Compare the spectra with the noise and with every fluctuation.

        Shapes: `squares, counts` (events, bins), `frames, strength` (events,), `taus` (τ,).
        """
        total = np.zeros((_RELATIVE.size, taus.size))
        expected: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
        for square, count, n, snr2 in zip(squares, counts, frames.tolist(), strength, strict=True):
            held = count > 0
            if not held.any():
                continue
            key = n, int(held.sum())
            if key not in expected:
                expected[key] = noise.in_bins(*key), _of_unit(*key, taus)
            level, shape = expected[key]
            signal = snr2 * _RELATIVE[:, None, None] ** 2 * shape / level
            gain = square[held] / level * signal / (1 + signal) - count[held] * np.log1p(signal)
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


def _modes(frames: int, bins: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the numbers of the components of so many frames, and where each bin of them begins.

    Shapes: results (modes,), (bins,).
    """
    return np.arange(1, min(frames, MODES[bins])), np.array(MODES[:bins]) - 1


def _held(modes: NDArray[np.int64], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the components of every bin."""
    return np.diff(np.append(starts, modes.size))


def _of_unit(frames: int, bins: int, taus: FloatArray) -> FloatArray:
    """Mean square of the components in every bin of an ε of unit variance.

    Shapes: `taus` (τ,), result (τ, bins).
    """
    modes, starts = _modes(frames, bins)
    shape = np.stack([_components(modes, frames, tau) for tau in taus])
    return np.asarray(np.add.reduceat(shape, starts, axis=1) / _held(modes, starts))


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


def _of_mean(frames: int, tau: float) -> float:
    """Variance of a mean over frames, over that of one frame."""
    lags = np.arange(1, frames)
    return float(1 + 2 * np.sum((1 - lags / frames) * np.exp(-lags / tau))) / max(frames, 1)
