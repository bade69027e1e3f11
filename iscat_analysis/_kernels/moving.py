"""Fits of particles that move over an unknown, constant background: each particle in each frame.

The counts of pixel p in frame t are Poisson with w_t B_p (1 + C_tp), C the sum of the particles'
signals, and read noise as in `iscat_analysis._kernels.noise`, whose fit this is.  A *row* is one
particle in one frame, θ = (x, y, z, a, 0); rows are in the order of their frames, and those of
frame t are starts[t] to starts[t + 1].  Within a frame they are fitted one after the other, each
with the others in its background, so that the result does not depend on the distribution of frames
over threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.background_response import Slopes, keep_slopes
from iscat_analysis._kernels.canvas import (
    Canvas,
    Counts,
    Field,
    Light,
    Pictures,
    cut,
    draw_gradient,
    square_of,
    stage,
)
from iscat_analysis._kernels.image import Pixels
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lines import copy_line
from iscat_analysis._kernels.place_score import place_score
from iscat_analysis._kernels.scoring import CONVERGED, STALLED, scoring_step

FloatArray = NDArray[np.float64]
AnyFloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


DIVERGED = 4
"""How a fit ended, in addition to the outcomes in `scoring`: plain scoring steps failed."""


class Search(NamedTuple):
    """Free parameters and settings of the fits."""

    free: BoolArray
    reach: FloatArray
    lower: FloatArray
    upper: FloatArray
    max_step: FloatArray
    tolerance: float
    passes: int


class Room(NamedTuple):
    """Work space of the kernels of rows, which allocate no memory."""

    pixels: AnyFloatArray
    line: NDArray[np.float32]
    profile: FloatArray
    free: IntArray
    small: FloatArray
    ways: FloatArray
    work: FloatArray


@kernel(_nrt=False)
def fit_frames(
    light: Light,
    field: Field,
    near: Pictures,
    search: Search,
    starts: IntArray,
    last: int,
    sweeps: int,
    theta: FloatArray,
    group: IntArray,
    canvas: Canvas,
    slopes: Slopes,
    outcome: IntArray,
    information: FloatArray,
    gain: FloatArray,
    expected: FloatArray,
    background: NDArray[np.float32],
    sums: NDArray[np.float32],
    place: IntArray,
    room: Room,
) -> bool:
    """Fit the rows of frames up to last − 1, each `sweeps` times, with plain scoring steps.

    If plain steps fail for a row, the kernel returns its position, its constants and a start inside
    its box.  The caller puts its maximum into `theta`, `outcome` and `gain`, and calls again.

    Shapes: `starts` (t + 1,), `theta` (rows, 5), `group` (rows,), `outcome` (rows,), `information`
    (rows, 4, 4), `gain` (rows,), `expected` (t,), `background` (y, x), `sums` (y, x), `place`
    (7,).
    """
    rows, columns = light.background.shape
    area = field.side**2
    fisher, step, score, start = room.small[:5], room.small[5], room.small[6], room.small[10]
    index = room.free
    while place[0] < last:
        t = place[0]
        total = canvas.total[t]
        if sweeps and place[4] == 0:
            expected[t] = _read_ahead(
                light.counts[t]
            )  # stored, or the compiler would drop the loop
        while place[1] < sweeps:
            for r in range(place[2], starts[t + 1]):
                p, helped = theta[r], place[4] > 0
                r0, r1, c0, c1 = place[3], place[4], place[5], place[6]
                if not helped:
                    r0, r1, c0, c1 = square_of(field, canvas.rings[r], field.side, rows, columns)
                if r1 <= r0:
                    outcome[r], gain[r] = STALLED, 0.0
                    continue
                ny, nx = r1 - r0, c1 - c0
                pixels = cut(field.pixels, r0, r1, c0, c1)
                both = room.pixels[5 * area : 5 * area + 10 * ny * nx].reshape(2, ny, 5, nx)
                draw_gradient(near, group[r], p, pixels, room.profile, both[0])
                data = room.pixels[: 4 * ny * nx].reshape(4, ny, nx)
                signal = room.pixels[4 * area : 4 * area + ny * nx].reshape(ny, nx)
                if not helped:
                    stage(light, t, total, both[0], r0, c0, data)
                    for i in range(ny):
                        for j in range(nx):
                            signal[i, j] = both[0, i, 0, j]
                    copy_line(p, start)
                value, last_one = place_score(data, both[0], near.lens, score, fisher), 0
                if helped:
                    place[4] = 0
                    for i in range(5):
                        step[i] = 0.0
                else:
                    outcome[r], last_one, gain[r] = _climb(
                        near, group[r], pixels, data, search, p, both, value, room
                    )
                    if outcome[r] == DIVERGED:
                        place[2], place[3], place[4], place[5], place[6] = r, r0, r1, c0, c1
                        return False
                here = both[last_one]
                _add_signal(here, step, signal, total[r0:r1, c0:c1])
                copy_line(p, canvas.squares[r])
                for i in range(4):
                    for j in range(4):
                        information[r, i, j] = fisher[i, j]
                if slopes.values.size:
                    for k in range(index.size):
                        slopes.moves[r, k] = p[index[k]] - start[index[k]]
                    keep_slopes(data[2], here, index, slopes, r, (r0, r1, c0, c1), room.line)
            place[1] += 1
            place[2] = starts[t]
        expected[t] = _add_signals(total, background, light.power[t], sums)
        place[0], place[1], place[2] = t + 1, 0, starts[t + 1]
    return True


@kernel(fastmath=FAST, _nrt=False)
def _read_ahead(frame: Counts) -> float:
    """Read a whole frame in order, so that it is in the cache when its squares are fitted."""
    total = np.float32(0.0)
    for i in range(frame.shape[0]):
        for j in range(frame.shape[1]):
            total += np.float32(frame[i, j])
    return float(total)


@kernel(_nrt=False)
def _climb(
    near: Pictures, group: int, pixels: Pixels, data: AnyFloatArray, search: Search, p: FloatArray,
    both: AnyFloatArray, value: float, room: Room,
) -> tuple[int, int, float]:  # fmt: skip
    """Fit one row from p, at which both[0] is drawn and its value, score and information known.

    Full steps of Fisher scoring are taken as long as they stay inside the box and increase the
    likelihood, so that every image is drawn once.  Otherwise the fit is `DIVERGED`.

    Returns how the fit ended, which of `both` holds the image before the last step (which is so
    small that the gradient gives the image after it), and the log-likelihood over that without the
    particle.
    """
    fisher, step, score, trial = room.small[:5], room.small[5], room.small[6], room.small[7]
    lower, upper = room.small[8], room.small[9]
    for i in range(5):
        lower[i] = max(search.lower[i], p[i] - search.reach[i])
        upper[i] = min(search.upper[i], p[i] + search.reach[i])
    at = 0
    for _ in range(search.passes):
        gain = _step(search, p, lower, upper, score, fisher, step, trial)
        if gain == np.inf:
            break
        if gain < search.tolerance:
            copy_line(trial, p)
            return CONVERGED, at, value + gain
        draw_gradient(near, group, trial, pixels, room.profile, both[1 - at])
        there = place_score(data, both[1 - at], near.lens, score, fisher)
        if not there > value:
            break
        copy_line(trial, p)
        value, at = there, 1 - at
    for i in range(5):
        if search.free[i]:
            p[i] = min(max(p[i], lower[i]), upper[i])
    return DIVERGED, at, value


@kernel(_nrt=False)
def _step(
    search: Search, p: FloatArray, lower: FloatArray, upper: FloatArray, score: FloatArray,
    fisher: FloatArray, step: FloatArray, trial: FloatArray,
) -> float:  # fmt: skip
    """Fill the step of Fisher scoring and its end point; return the expected gain.

    The gain is infinite if the step cannot be taken: too long, out of the box, or undetermined.
    """
    if not scoring_step(score, fisher, search.free, 0.0, step):
        return np.inf
    gain = 0.0
    for i in range(5):
        trial[i] = p[i] + step[i]
        if search.free[i] and not (
            lower[i] <= trial[i] <= upper[i] and abs(step[i]) <= search.max_step[i]
        ):
            return np.inf
        gain += 0.5 * score[i] * step[i]
    return gain


@kernel(fastmath=FAST, _nrt=False)
def _add_signal(
    here: AnyFloatArray, step: FloatArray, before: AnyFloatArray, out: NDArray[np.float32]
) -> None:
    """Add the signal after a small step to `out`, minus what it was before."""
    dx, dy = here.dtype.type(step[0]), here.dtype.type(step[1])
    dz, da = here.dtype.type(step[2]), here.dtype.type(step[3])
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            sideways = dx * here[i, 1, j] + dy * here[i, 2, j]
            moved = here[i, 0, j] + sideways + dz * here[i, 3, j] + da * here[i, 4, j]
            out[i, j] += np.float32(moved - before[i, j])


@kernel(fastmath=FAST, _nrt=False)
def _add_signals(
    total: NDArray[np.float32],
    background: NDArray[np.float32],
    power: float,
    sums: NDArray[np.float32],
) -> float:
    """Add w C of a frame to `sums`; return Σ B C.  Both are small: single precision is enough."""
    amount, w = np.float32(0.0), np.float32(power)
    for i in range(sums.shape[0]):
        signal, light, out = total[i], background[i], sums[i]
        for j in range(signal.size):
            out[j] += w * signal[j]
            amount += light[j] * signal[j]
    return float(amount)
