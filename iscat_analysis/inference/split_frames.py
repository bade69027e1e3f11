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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from iscat_analysis._kernels.noise import FLOOR
from iscat_analysis._kernels.stepping import frame_scores, spreads
from iscat_analysis.inference.likelihood import LEVEL, Likelihood

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

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
    likelihood: Likelihood,
    theta: FloatArray,
    free: BoolArray,
    before_e: FloatArray,
    power_ratio: float,
) -> Response | None:
    """Linearise an estimate in its counts.

    Notes
    -----
    θ̂ − θ = F⁻¹ Σ ∂η (counts − expected), to first order: the score is linear in the counts.

    Shapes: `theta` (5,), `free` (5,), `before_e` (ny, nx).
    """
    x, y, z, amplitude, _ = (float(value) for value in theta)
    signal, first = likelihood.model.amplitude_gradient(likelihood.grid, x, y, z, amplitude)
    level = float(np.exp(theta[LEVEL]))
    used = likelihood.used
    data = np.where(used, likelihood.data, 0.0)
    ratio = None if likelihood.model.rho > 0 else power_ratio
    by_signal, by_level, weight, before, after = likelihood.noise.count_response(
        data, signal, level, before_e, ratio
    )
    slope = np.concatenate([first * by_signal, by_level[None]])
    index = np.flatnonzero(free)
    slope = np.where(used, slope[index], 0.0)
    fisher = np.einsum("iyx,jyx,yx->ij", slope, slope, weight)
    unit = 1 / np.sqrt(np.maximum(np.diag(fisher), FLOOR))
    try:
        inverse = np.linalg.inv(fisher * np.outer(unit, unit)) * np.outer(unit, unit)
    except np.linalg.LinAlgError:
        return None
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
    lit = power > 0
    flat = weights.reshape(len(weights), -1)
    seen = weights * gain
    values = np.empty((len(weights), np.count_nonzero(lit)))
    frame_scores(counts.reshape(len(counts), mean_e.size), lit, seen.reshape(flat.shape), values)
    values -= np.sum(seen * offset, axis=(1, 2))[:, None]
    squared = flat**2
    return Series(
        values,
        power[lit],
        squared @ np.maximum(mean_e, 0.0).ravel(),
        squared @ read_variance_e2.ravel(),
    )


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
        spreads(
            series.values, series.power, series.shot, series.read, edges,
            np.array(LENGTHS, dtype=np.int64), out,
        )  # fmt: skip
    return np.concatenate([out, *spectra])


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
    light = series.shot[:, None] * power + series.read[:, None] * np.ones(power.size)
    weight = power**2 / light
    value = series.values / power
    mean = np.sum(weight * value, axis=1) / np.sum(weight, axis=1)
    squares = dct((value - mean[:, None]) * np.sqrt(weight), axis=1, norm="ortho") ** 2
    edges = [mode for mode in MODES[:-1] if mode < power.size]
    last = min(MODES[-1], power.size)
    out[: len(edges), :-1] = np.add.reduceat(squares[:, :last], edges, axis=1).T
    out[: len(edges), -1] = np.diff([*edges, last])
    return out
