"""What the frames of one event say of its error: the estimate on disjoint parts of them.

Near the estimate a fit answers linearly to the counts of every frame, so that one step of scoring
from the full fit refits any part of the frames, and the errors of the parts add up to that of the
whole.  A part is set beside others on the same side of the step: a particle that is there all the
time, and whatever the model gets wrong about it, drops out, and what is left is noise.

Parts of n frames each see the noise at that length and at shorter ones.  The longest that fits is
half a window; noise that is slower shows in the estimate and not between its parts.  It is seen
where there is no particle, see `iscat_analysis.search.empty`.

Contrast that fluctuates while the particle is there shows on one side of the step only.  The cosine
transform of the frames of one side has components that are independent and of unit variance if the
noise is white; the first, the mean, is left out.

The spread that was measured, over the Cramér–Rao bound: pooled over events and empty places.

Disjoint parts of the events' own frames show the noise up to half a window, and whatever a particle
itself adds.  Empty places show the noise of whole windows.  With A the mean square of normalised
differences between the parts of events, B the same at empty places and W that of whole windows
there, the squared spread of the estimates is W + A − B: the noise at full length, and what the
particles' own frames show beyond the others'.  Where every estimate is of a single frame, it has no
parts, and W stands alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.special import ndtri, stdtr, stdtrit

from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.maximiser import covariance_of
from iscat_analysis.records import BoolArray, FloatArray, IntArray

PARTS = 8
"""Contiguous parts of the frames on either side of a step, between which ``repeat_*`` is taken."""

LENGTHS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500, 700, 1000)
"""Frames averaged, for the spread as a function of them."""


MODES = (1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80, 112, 160, 320, 640, 1280, 2560)
"""Edges of the bins of cosine components; number j has j half periods on one side of a step."""

BLOCK_ROWS = 1 + len(LENGTHS)
"""Rows of a record that compare parts; those of the spectra before and after follow."""


@dataclass(frozen=True)
class Response:
    """Change of the estimates per additional photoelectron in a pixel."""

    before: FloatArray
    after: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class Series:
    """Contributions of single frames of one window to the error of the estimates."""

    values: FloatArray
    power: FloatArray
    shot: FloatArray
    read: FloatArray


def response_of(
    likelihood: Likelihood, theta: FloatArray, free: BoolArray, before_e: FloatArray, ratio: float
) -> Response | None:
    """Linearise an estimate in its counts.

    Notes
    -----
    θ̂ − θ = F⁻¹ Σ ∂η (counts − expected), to first order: the score is linear in the counts.

    Shapes: `theta` (5,), `free` (5,), `before_e` (ny, nx).
    """
    signal, first = likelihood.model.signal(likelihood.grid, theta[:4])
    level = float(theta[LEVEL])
    used = likelihood.used
    data = np.where(used, likelihood.data, 0.0)
    before, after = likelihood.noise.count_response(data, signal, math.exp(level), before_e)
    if not likelihood.model.rho > 0:  # the signal is no share of the background
        before = -ratio * after
    terms = likelihood.noise.terms(data, signal, level)
    index = np.flatnonzero(free)
    slope = np.where(used, np.concatenate([first, terms.by_level[None]])[index], 0.0)
    fisher = np.einsum("iyx,jyx,yx->ij", slope, slope, terms.information)
    inverse = covariance_of(fisher, np.ones(index.size, dtype=bool))
    particle = np.flatnonzero(index < LEVEL)
    variance = np.diag(inverse)[particle]
    if not np.all(np.isfinite(variance) & (variance > 0)):
        return None
    weights = np.einsum("ij,jyx->iyx", inverse[particle], slope)
    return Response(weights * before, weights * after, variance)


def series_of(
    counts: NDArray[np.generic],
    weights: FloatArray,
    power: FloatArray,
    *,
    gain: float | FloatArray,
    offset: float | FloatArray,
    mean_e: FloatArray,
    read_variance_e2: FloatArray,
) -> Series:
    """Multiply the counts of every frame with a response.

    Shapes: `counts` (t, ny, nx), `weights` (n, ny, nx), `power` (t,), `gain, offset` (ny, nx),
    `mean_e` (ny, nx), `read_variance_e2` (ny, nx).
    """
    lit, number = power > 0, len(weights)
    seen = weights * gain
    pixels = counts[lit].reshape(-1, seen[0].size).astype(np.float64)
    values = seen.reshape(number, -1) @ pixels.T
    values -= np.sum(seen * offset, axis=(1, 2))[:, None]
    squared = weights.reshape(number, -1) ** 2
    shot, read = (squared @ e.ravel() for e in (np.maximum(mean_e, 0.0), read_variance_e2))
    return Series(values, power[lit], shot, read)


def repeats_of(windows: tuple[Series, ...], longer: tuple[Series, ...] | None = None) -> FloatArray:
    """Compare the estimates from the parts of all windows of one event, and add their spectra.

    The last window is the one after the step.  Spectra are those of `longer` windows if there are
    any, since a slow fluctuation shows in them alone.

    Shapes: result (BLOCK_ROWS + 2 (len(MODES) - 1), n + 1).
    """
    out = np.zeros((BLOCK_ROWS, len(windows[0].values) + 1))
    spectra = np.zeros((2, len(MODES) - 1, out.shape[1]))
    for side, series in zip((1, 0), reversed(longer or windows), strict=False):
        spectra[side] = _spectrum(series)
    for series in windows:
        frames = series.power.size
        edges = np.linspace(0, frames, min(PARTS, frames) + 1).round().astype(np.int64)
        if edges.size > 2:
            means, variances = _means(series, edges)
            weight = 1 / variances
            usual = np.sum(means * weight, axis=1) / weight.sum(axis=1)
            out[0, :-1] += np.sum(weight * (means - usual[:, None]) ** 2, axis=1)
            out[0, -1] += edges.size - 2
        for row, length in zip(out[1:], LENGTHS, strict=True):
            pairs = frames // (2 * length)
            if pairs:
                means, variances = _means(series, length * np.arange(2 * pairs + 1))
                squares = (means[:, 1::2] - means[:, ::2]) ** 2
                row[:-1] += np.sum(squares / (variances[:, 1::2] + variances[:, ::2]), axis=1)
                row[-1] += pairs
    return np.concatenate([out, *spectra])


def _means(series: Series, edges: IntArray) -> tuple[FloatArray, FloatArray]:
    """Means of contiguous frames per unit of power, and their variances, shape (n, parts) each."""
    sums = np.add.reduceat(series.values[:, : edges[-1]], edges[:-1], axis=1)
    light = np.add.reduceat(series.power[: edges[-1]], edges[:-1])
    noise = np.outer(series.shot, light) + np.outer(series.read, np.diff(edges))
    return sums / light, noise / light**2


def spectra_of(repeats: FloatArray) -> FloatArray:
    """Take the spectra before and after out of the records of events.

    Shapes: `repeats` (events, rows, n + 1), result (events, 2, len(MODES) - 1, n + 1).
    """
    events, _, columns = repeats.shape
    return repeats[:, BLOCK_ROWS:].reshape(events, 2, len(MODES) - 1, columns)


def _spectrum(series: Series) -> FloatArray:
    """Sum the squared cosine components over bins; the last column counts them.

    Shapes: result (len(MODES) - 1, n + 1).
    """
    out = np.zeros((len(MODES) - 1, len(series.values) + 1))
    power = series.power
    if power.size < 2:
        return out
    light = series.shot[:, None] * power + series.read[:, None]
    weight = power**2 / light
    value = series.values / power
    mean = np.sum(weight * value, axis=1) / np.sum(weight, axis=1)
    squares = dct((value - mean[:, None]) * np.sqrt(weight), axis=1, norm="ortho") ** 2
    edges = [mode for mode in MODES[:-1] if mode < power.size]
    last = min(MODES[-1], power.size)
    out[: len(edges), :-1] = np.add.reduceat(squares[:, :last], edges, axis=1).T
    out[: len(edges), -1] = np.diff([*edges, last])
    return out


SIGNIFICANT = 3.0
"""Standard errors beyond which a spread differs from the bound; in 1 of 700 by chance."""

LEAST_EXCESS = 0.02
"""Relative excess below which nothing is said."""


@dataclass(frozen=True)
class EmpiricalSpread:
    """Measured spread of one parameter over its bound."""

    over_crb: float
    ci95: tuple[float, float]
    events: int
    whole: bool
    significance: float
    frames: tuple[float, ...]
    by_frames: tuple[float, ...]
    by_frames_se: tuple[float, ...]
    empty: tuple[float, ...]
    single: bool = False

    @property
    def fast2(self) -> float:
        """Squared spread of noise from frame to frame."""
        if self.single:
            return self.empty[0] ** 2
        return self.by_frames[0] ** 2 if self.by_frames else 1.0

    @property
    def slow2(self) -> float:
        """Squared spread of slow noise: of whole windows beyond that of their parts."""
        return self.empty[-1] ** 2 - self.empty[0] ** 2 if self.empty else 0.0

    @property
    def drifts(self) -> bool:
        """Whether slow noise grows with time like a drift, rather than like flicker.

        From half a window to a whole one flicker doubles, and a drift grows eightfold.  In single
        frames a drift grows with the squared distance from the background, flicker with its
        logarithm.
        """
        if self.single:
            near, far = (max(self.by_frames[k] ** 2 - self.fast2, 1e-3) for k in (0, -1))
            return far / near > self.frames[-1] / self.frames[0] > 1
        halves, whole = (self.empty[k] ** 2 for k in (-2, -1))
        # a drift grows by more from half a window to a whole one
        return (whole - self.fast2) / max(halves - self.fast2, 1e-3) > 4.0

    @property
    def exceeds(self) -> bool:
        """Whether the bound, and so σ, is too small."""
        return self.over_crb > 1 + LEAST_EXCESS and self.significance > SIGNIFICANT

    @property
    def falls_short(self) -> bool:
        """Whether the noise is smaller than the model expects."""
        return self.over_crb < 1 - LEAST_EXCESS and self.significance < -SIGNIFICANT


def pooled(
    own: FloatArray,
    empty: FloatArray | None,
    empty_counts: FloatArray | None,
    *,
    shared: float = 1.0,
    distances: tuple[float, ...] | None = None,
) -> EmpiricalSpread | None:
    """Pool the repeats of one parameter.

    Notes
    -----
    The interval is Student's, on the logarithm, its variance that between events and between tiles
    of the field with what these have in common, which noise of neighbours does not make too small;
    at least that of χ².

    Shapes: `own` (events, 1 + len(LENGTHS), `empty, empty_counts` (contrasts, tiles).
    """
    own, tiles = own[own[:, 0, 1] > 0], _Tiles.of(empty, empty_counts, shared)
    if not len(own) or (distances is not None and tiles is None):
        return None
    found = _of_windows(own, tiles)
    if distances is not None and tiles is not None:
        found = _of_frames(tiles, distances)
    ratio2 = max(found.ratio2, 1e-6)
    error = math.sqrt(found.variance) / (2 * ratio2)  # of ln ratio
    ratio, degrees = math.sqrt(ratio2), max(found.degrees, 2)
    # half-width of an interval of ln ratio, beyond which nothing is known
    reach = min(float(stdtrit(degrees, 0.975)) * error, 5.0)
    # what Student's law makes of the error, in normal standard errors
    chance = float(stdtr(degrees, -abs(math.log(ratio)) / error))
    significance = math.copysign(-float(ndtri(max(chance, 1e-300))), math.log(ratio))
    return EmpiricalSpread(
        over_crb=ratio,
        ci95=(ratio * math.exp(-reach), ratio * math.exp(reach)),
        events=len(own),
        whole=tiles is not None,
        significance=significance,
        frames=found.frames,
        by_frames=tuple(math.sqrt(value) for value, _ in found.curve),
        by_frames_se=tuple(
            math.sqrt(variance / max(value, 1e-12)) / 2 for value, variance in found.curve
        ),
        empty=found.levels,
        single=distances is not None,
    )


class _Found(NamedTuple):
    """Squared ratio, its variance and degrees of freedom, and the same against frames."""

    ratio2: float
    variance: float
    degrees: float
    frames: tuple[float, ...]
    curve: tuple[tuple[float, float], ...]
    levels: tuple[float, ...]


@dataclass(frozen=True)
class _Tiles:
    """Contributions of each tile of the field, shape (contrasts, tiles)."""

    squares: FloatArray
    counts: FloatArray
    shared: float

    @classmethod
    def of(
        cls, squares: FloatArray | None, counts: FloatArray | None, shared: float
    ) -> _Tiles | None:
        """Select tiles with places without particles; None where they are too few."""
        if squares is None or counts is None:
            return None
        held = counts[0] > 0
        if held.sum() < 6 or counts[0].sum() < 200:
            return None
        return cls(squares[:, held], counts[:, held], shared)

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.counts.shape[1])

    @property
    def mean(self) -> FloatArray:
        """Mean square of each contrast."""
        return np.asarray(self.squares.sum(axis=1) / np.maximum(self.counts.sum(axis=1), 1e-300))

    def influence(self, k: int) -> FloatArray:
        """Contribution of each tile to the error of a mean square."""
        n, s = self.counts[k], self.squares[k]
        return np.asarray((s - self.mean[k] * n) / n.sum())

    def variance(self, influence: FloatArray) -> float:
        """Variance of the sum over tiles."""
        return self.shared * float(np.sum(influence**2)) * self.number / (self.number - 1)


def _of_windows(own: FloatArray, tiles: _Tiles | None) -> _Found:
    """Ratios from parts of windows, at events and at places without a particle."""
    squares, counts = own[:, :, 0], own[:, :, 1]
    ratio2, variance = _mean_square(squares[:, 0], counts[:, 0])
    degrees = max(len(own), counts[:, 0].sum() / 4)
    total = counts.sum(axis=0)[1:]
    kept = [k for k, number in enumerate(total) if number >= 2]
    curve = tuple(_mean_square(squares[:, k + 1], counts[:, k + 1]) for k in kept)
    levels: tuple[float, ...] = ()
    if tiles is not None:
        whole, parts, *others = tiles.mean
        # the difference of whole windows and their parts, tile by tile
        variance += tiles.variance(tiles.influence(0) - tiles.influence(1))
        ratio2 += whole - parts
        degrees = min(degrees, tiles.number - 1)
        levels = tuple(math.sqrt(m) for m in (parts, *others, whole))
    return _Found(ratio2, variance, degrees, tuple(LENGTHS[k] for k in kept), curve, levels)


def _of_frames(tiles: _Tiles, distances: tuple[float, ...]) -> _Found:
    """Ratios from single frames at places without a particle."""
    whole, successive, *at = tiles.mean
    curve = tuple((m, tiles.variance(tiles.influence(2 + k))) for k, m in enumerate(at))
    return _Found(
        whole, tiles.variance(tiles.influence(0)), tiles.number - 1, distances, curve,
        (math.sqrt(successive), math.sqrt(whole)),
    )  # fmt: skip


def _mean_square(squares: FloatArray, counts: FloatArray) -> tuple[float, float]:
    """Mean square, and its variance: that between events, and at least that of χ²."""
    total = float(counts.sum())
    mean = float(squares.sum()) / total
    chi2 = 2 * mean**2 / total
    events = len(squares)
    if events < 2:
        return mean, chi2
    between = float(np.sum((squares - mean * counts) ** 2)) / total**2 * events / (events - 1)
    return mean, max(chi2, between)
