"""Steps whose light goes on changing, because the particle is there already or lands slowly.

The light of a particle that settles, bleaches or breathes changes repeatedly at its place, and each
change is found as a step.  A second particle at exactly the same place is rare, and cannot be told
from that.  A particle that moves by a few nanometres, or wiggles, leaves a faint step beside it,
within the distance that the microscope resolves.

If particles take several frames to land, noise hides the rise of a faint one.  The duration of the
rise is therefore estimated from all steps of a chunk of the movie, and all are fitted with it.  If
their durations differ, a faint particle may still be fitted as a step, and its mass is too small;
the rises of bright particles show whether this may happen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import scipy
from scipy.special import logsumexp

from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import FLUCTUATING_CONTRAST, SLOW_LANDINGS
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.inference.repeats import MODES, EmpiricalSpread, spectra_of
from iscat_analysis.records import BoolArray, FloatArray, IntArray, Status, has_only

SAME_NM = 150.0
"""Distance within which two steps are at one place."""

_FEWEST, _SHARE = 3, 0.2  # rises, and their share of the steps in which they would be seen
_NO_STEP = (Status.SIDELOBE.value, Status.NOT_CONVERGED.value)


def at_a_shared_place(
    table: pd.DataFrame, resolution_nm: float = 0.0, relative: float = 0.0
) -> BoolArray:
    """Flag steps that may be changes of the light of a particle that is there already.

    These are steps much smaller than that particle, at its place or, smaller still, beside it.  A
    resolution is λ/NA; contrasts fluctuate by a relative standard deviation.

    Shapes: result (rows,).
    """
    # mass of a particle over that of a step, from which on the step may be a change of its light;
    # and the change of a mean over a window, in standard deviations of the fluctuation of a frame,
    # that hardly ever is exceeded: four of a difference of two
    least_here = 1 / max(1 / 3.0, 4 * math.sqrt(2) * relative)
    flagged = np.zeros(len(table), dtype=bool)
    steps = _Steps.of(table)
    for i, j in steps.pairs(max(SAME_NM, 0.61 * resolution_nm)):  # λ/NA within which that is
        mass, frame, window = steps.mass, steps.frame, steps.window
        near = abs(frame[i] - frame[j]) < max(window[i], window[j])
        there = frame[j] > frame[i] if mass[i] > 0 else frame[j] < frame[i]
        both = mass[i] + mass[j]
        gone = mass[i] * mass[j] < 0 and abs(both) < 4 * np.hypot(steps.error[i], steps.error[j])
        same = math.dist(steps.place[i], steps.place[j]) < SAME_NM
        # mass of a particle over that of a step beside it, from which on it may have moved: 20 nm
        # change an image by a fifth
        least = least_here if same else 5.0
        if (there or near) and not gone and abs(mass[i]) > least * abs(mass[j]):
            flagged[steps.row[j]] = True
    return flagged


def in_parts(table: pd.DataFrame, rise_frames: FloatArray) -> BoolArray:
    """Flag steps of the same sign, mass and place within one window: parts of one landing.

    Shapes: `rise_frames` (rows,), which stay out of the windows; result (rows,).
    """
    flagged = np.zeros(len(table), dtype=bool)
    steps = _Steps.of(table)
    window = steps.window + np.nan_to_num(rise_frames)[steps.row]
    for i, j in steps.pairs(SAME_NM):
        ratio = steps.mass[i] / steps.mass[j]
        near = abs(steps.frame[i] - steps.frame[j]) < max(window[i], window[j])
        # ratio of masses up to which two steps close in time may be two halves of one landing
        if near and 0 < ratio <= 3.0:
            flagged[steps.row[[i, j]]] = True
    return flagged


@dataclass(frozen=True)
class _Steps:
    """The rows of a table that are steps.

    Shapes: `row, mass, error, frame, window` (n,), `place` (n, 2).
    """

    row: IntArray
    place: FloatArray
    mass: FloatArray
    error: FloatArray
    frame: FloatArray
    window: FloatArray

    @classmethod
    def of(cls, table: pd.DataFrame) -> _Steps:
        real = ~table["status"].isin(_NO_STEP) & table["mass_kda"].notna()
        row = np.flatnonzero(real.to_numpy())
        names = "mass_kda", "sigma_mass_kda", "frame"
        mass, error, frame = (table[name].to_numpy(float)[row] for name in names)
        window = np.maximum(table["n_before"], table["n_after"]).to_numpy(float)[row]
        return cls(row, table[["x_nm", "y_nm"]].to_numpy(float)[row], mass, error, frame, window)

    def pairs(self, farthest_nm: float) -> Iterator[tuple[int, int]]:
        """Give those that are near each other, the larger mass first."""
        if self.row.size > 1:
            for i, j in scipy.spatial.cKDTree(self.place).query_pairs(farthest_nm):
                yield (i, j) if abs(self.mass[i]) >= abs(self.mass[j]) else (j, i)


def may_rise(
    table: pd.DataFrame, evidence: Evidence, shared_place: BoolArray
) -> tuple[BoolArray, float]:
    """Flag steps that may rise slowly without showing it, and give the duration of rises.

    Steps at the place of a particle that is there are no landings, and are left out.  If many
    rises continue after the end of their lines, all steps may.  A line over r frames and the
    nearest step differ by r/12 times the squared signal-to-noise ratio of one frame, half of which
    is the gain in log-likelihood.

    Shapes: `shared_place` (rows,), result (rows,).
    """
    nothing = np.zeros(len(table), dtype=bool), 0.0
    rise = np.where(shared_place, 0.0, np.nan_to_num(evidence.rise_frames))
    rising = rise > 0
    if rising.sum() < _FEWEST:
        return nothing
    frames = float(np.median(rise[rising]))
    mass, crb = (table[name].to_numpy(float) for name in ("mass_kda", "crb_mass_kda"))
    before, after = (table[name].to_numpy(float) for name in ("n_before", "n_after"))
    one2 = (mass / crb) ** 2 * (before + after) / (before * after)
    gain = np.nan_to_num(one2) * frames / 24
    # expected gain in log-likelihood of a rise over a step, from which on rises are mostly seen
    seen = (gain > 10.0) & ~shared_place
    if (rising & seen).sum() < max(_FEWEST, _SHARE * seen.sum()):
        return nothing
    goes_on = table["flags"].fillna("").astype(str).str.contains(Status.CHANGING.value).to_numpy()
    # share of rising steps that go on rising, beyond which all may; by chance it is 0.002
    many = (goes_on & rising).sum() >= max(_FEWEST, 0.1 * rising.sum())
    alike = rising if many else nothing[0]
    # gain from which on a step that is no rise does not rise; one that is missed makes the mass,
    # and this gain with it, too small
    return (~rising & (gain < 30.0)) | alike, frames


def slow_landings(frames: float, unseen: int, rising: int, rows: int) -> Finding | None:
    """Say that particles take several frames to land; None where they do not."""
    if not frames:
        return None
    also = ""
    if unseen:
        also = f"; {unseen} steps may rise unseen: their masses may be too small, flagged changing"
    return SLOW_LANDINGS(
        {"rising": rising, "rows": rows, "frames": math.ceil(frames), "unseen": also}
    )


_PRIOR = 0.1  # probability that a movie fluctuates, before its frames are looked at
_ALONE = 0.05  # probability that an event changes on its own
_RELATIVE = np.geomspace(0.01, 0.3, 60)
_CORRELATIONS = np.geomspace(2.0, 1000.0, 20)  # frames
_JUDGED = frozenset({Status.OK.value, Status.POOR_FIT.value, Status.CHANGING.value})


@dataclass(frozen=True)
class Fluctuation:
    """Relative fluctuation of the particles' contrasts.

    Particles breathe, turn or move in the light, so that the contrast of event i in frame t is a_i
    (1 + ε_t), with ε of variance s² and correlation exp(−t/τ), the same law for all particles of a
    movie.  The cosine components of the frames of one side of a step are then independent to a good
    approximation, with the variance

        v_ij = ℓ_j + λ_i s² S_j(τ),

    λ_i the squared signal-to-noise ratio of one frame, S_j the variance of component j of an ε of
    unit variance, and ℓ_j that of the noise, which is 1 if the noise is white and is measured where
    there is no particle.  The frames are more than those of a fit, so that slow fluctuations show.
    The squares of all components are χ², so that their likelihood is known (P. Whittle, J. R. Stat.
    Soc. B 15, 125 (1953)), and nothing has to be assumed of how estimates from blocks of different
    lengths go together.

    Whether a movie fluctuates, and how, follows by Bayes' theorem from a grid of s and τ.  An event
    may also change on its own, by a fluctuation that others do not have, which is why no single
    event decides.  The mean over the n frames of an event has the relative variance s² V_n(τ).  Its
    mean over the posterior, with that the movie does not fluctuate at all, is added to the variance
    of a mass: a fluctuation that is half certain is in the error with half of its variance.

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
        squares, counts = spectra[..., -2], spectra[..., -1]  # the mass is the last parameter
        frames = (counts.sum(axis=2) + 1).astype(np.int64)  # without, with a particle
        frames[:, 1] = np.maximum(frames[:, 1], there[good])  # of which not all are in bins
        # correlation time over the frames that show it; slower is a course
        longest = 4.0 * float(np.median(frames[:, 1]))
        taus = _CORRELATIONS[max(longest, _CORRELATIONS[0]) >= _CORRELATIONS]
        window = float(np.median(there[good]))
        noise = _noise(pooled, window, squares[:, 0], counts[:, 0], frames[:, 0])
        of_after = squares[:, 1], counts[:, 1], frames[:, 1], (mass**2 / one)[good]
        weight = _log_ratio(*of_after, taus, noise)
        if logsumexp(weight) <= math.log(weight.size):  # some fluctuation is no likelier than none
            return None
        weight += math.log(_PRIOR / weight.size)
        posterior = np.exp(weight - np.logaddexp(logsumexp(weight), math.log1p(-_PRIOR)))
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
        return self.probability > 0.75  # probability for a message; one event alone gives 0.69

    @property
    def finding(self) -> Finding | None:
        """That contrasts fluctuate; None where it is not seen."""
        if not self.is_seen:
            return None
        values = {"percent": 100 * self.relative, "error_percent": 100 * self.relative_se}
        return FLUCTUATING_CONTRAST(values | {"frames": float(f"{self.frames:.2g}")})

    @property
    def summary(self) -> Mapping[str, Any]:
        """The section of ``summary.json``."""
        return {name: value for name, value in vars(self).items() if name != "variance_kda2"}


InBins = Callable[[int, int], FloatArray]
"""From a number of frames and of bins of their components to a mean square in each, (bins,)."""


def _noise(
    pooled: EmpiricalSpread, width: float, squares: FloatArray, counts: FloatArray, frames: IntArray
) -> InBins:
    """Measure the mean square of the components where there is no particle.

    Up to half a window, of `width` frames, it is that between blocks of frames at empty places.
    Slower noise is that of the events' own places before they land or after they leave.

    Shapes: `squares, counts` (events, bins), `frames` (events,).
    """
    levels = np.square(pooled.empty[1:-1] or pooled.empty[:1])
    measured = np.ldexp(width / 8, np.arange(levels.size))

    def in_bins(frames: int, bins: int, slow: float = 1.0) -> FloatArray:
        lengths = frames / (2 * _modes(frames, bins))
        level = np.interp(lengths, measured, levels)
        return _binned(np.where(lengths > 4 * measured[0], level * slow, level), bins)

    # components that the noise of half a window counts for in that of longer ones
    excess = number = 16.0
    for square, count, n in zip(squares, counts, frames.tolist(), strict=True):
        bins = int((count > 0).sum())
        if bins:
            slow = n / (2 * np.array(MODES[:bins])) > width / 2
            excess += float(np.sum((square[:bins] / in_bins(n, bins))[slow]))
            number += float(count[:bins][slow].sum())
    return partial(in_bins, slow=excess / number)


def _log_ratio(
    squares: FloatArray,
    counts: FloatArray,
    frames: IntArray,
    strength: FloatArray,
    taus: FloatArray,
    noise: InBins,
) -> FloatArray:
    """Logarithms of the likelihoods of s and τ over that of no fluctuation, from all events.

    Shapes: `squares, counts` (events, bins), `frames, strength` (events,), `taus` (τ,), result
    (s, τ).
    """
    total = np.zeros((_RELATIVE.size, taus.size))
    expected: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
    for square, count, n, snr2 in zip(squares, counts, frames.tolist(), strength, strict=True):
        held = count > 0
        if not held.any():
            continue
        key = n, int(held.sum())
        if key not in expected:
            of_unit = np.stack([_components(_modes(*key), n, tau) for tau in taus])
            expected[key] = noise(*key), _binned(of_unit, key[1])
        level, shape = expected[key]
        signal = snr2 * _RELATIVE[:, None, None] ** 2 * shape / level
        gain = square[held] / level * signal / (1 + signal) - count[held] * np.log1p(signal)
        ratio = 0.5 * gain.sum(axis=2)
        own = math.log(_ALONE) + logsumexp(ratio) - math.log(ratio.size)
        total += np.logaddexp(math.log1p(-_ALONE) + ratio, own)
        total -= np.logaddexp(math.log1p(-_ALONE), own)
    return total


def _modes(frames: int, bins: int) -> IntArray:
    """Give the numbers of the components of so many frames that are in bins."""
    return np.arange(1, min(frames, MODES[bins]))


def _binned(values: FloatArray, bins: int) -> FloatArray:
    """Average over the components of every bin.

    Shapes: `values` (…, modes), result (…, bins).
    """
    starts = np.array(MODES[:bins]) - 1
    sizes = np.diff(np.append(starts, values.shape[-1]))
    return np.asarray(np.add.reduceat(values, starts, axis=-1) / sizes)


def _components(modes: IntArray, frames: int, tau: float) -> FloatArray:
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
