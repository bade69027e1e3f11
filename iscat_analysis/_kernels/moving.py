"""Fits of particles that move over an unknown, constant background: each particle in each frame.

The counts of pixel p in frame t are Poisson with w_t B_p (1 + C_tp), C the sum of the particles'
signals, and read noise as in `iscat_analysis._kernels.noise`, whose fit this is.  A *row* is one
particle in one frame, θ = (x, y, z, a, 0); rows are in the order of their frames, and those of
frame t are starts[t] to starts[t + 1].  Within a frame they are fitted one after the other, each
with the others in its background, so that the result does not depend on the distribution of frames
over threads.

`place_score` gives score, information and likelihood of a particle in one pass over its square, as
`image_score` of `iscat_analysis._kernels.scoring` does for a POISSON image at level
1, without the parameters that a fit of a frame does not need: the level and, for an image at one
height, z.  All three share the expected counts and one division per pixel.  For n counts, of which
b are expected without the particle and δ more with it, and w = δ/(2b + δ), the log-likelihood
n ln(1 + δ/b) − δ is computed as

    (n − b) 2 artanh w + w² (2 b w (1/3 + w²/5 + …) − 2 b − δ),

with artanh from its series.  No term is much larger than the result, so that single precision is
enough, which is twice as fast.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import FAST, AnyFloatArray, BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.background_response import Slopes, keep_slopes
from iscat_analysis._kernels.canvas import (
    Canvas,
    Counts,
    Field,
    Light,
    Pictures,
    Rows,
    cut,
    draw,
    square_of,
    stage,
)
from iscat_analysis._kernels.lens import STAMP, Lens, Pixels
from iscat_analysis._kernels.loops import copy_line
from iscat_analysis._kernels.noise import FLOOR, POISSON, SERIES, twice_artanh
from iscat_analysis._kernels.scoring import CONVERGED, STALLED, image_score, scoring_step

LEAST = 1e-15
"""Smallest expected count, like `FLOOR` of `noise`; its square is above 0 in single precision."""


@kernel(_nrt=False)
def place_score(
    data: AnyFloatArray, here: AnyFloatArray, lens: Lens, score: FloatArray, fisher: FloatArray
) -> float:
    """Fill score and Fisher matrix of (x, y, z, a), and give the log-likelihood.

    Shapes: `data` (4, ny, nx), `here` (ny, 5, nx), `score` (5,), `fisher` (5, 5).
    """
    if len(lens) != STAMP:
        value: float = image_score((np.int64(POISSON), data), 1.0, here, (score, fisher))
        score[4] = 0.0
        for i in range(5):
            fisher[i, 4] = fisher[4, i] = 0.0
        return value
    value, beyond = _flat_score(data, here, score, fisher)
    if beyond:
        value = _bright_value(data, here)
    return value


@kernel(_nrt=False)
def _bright_value(data: AnyFloatArray, here: AnyFloatArray) -> float:
    """Log-likelihood in double precision, by the logarithm itself where its series fails."""
    total = 0.0
    for i in range(data.shape[1]):
        c0, c1, c2, c3, s = data[0, i], data[1, i], data[2, i], data[3, i], here[i, 0]
        for j in range(s.size):
            base, change = max(float(c1[j]) + c3[j], FLOOR), float(c2[j]) * s[j]
            if abs(change) < SERIES * base:
                total += c0[j] * twice_artanh(change / (2.0 * base + change)) - change
            else:
                total += c0[j] * np.log(max(base + change, FLOOR) / base) - change
    return total


@kernel(fastmath=FAST, _nrt=False)
def _flat_score(
    data: AnyFloatArray, here: AnyFloatArray, score: FloatArray, fisher: FloatArray
) -> tuple[float, float]:
    """Do it without z; also count the pixels in which the series of the logarithm fails."""
    zero, one, two = data.dtype.type(0.0), data.dtype.type(1.0), data.dtype.type(2.0)
    least, series = data.dtype.type(LEAST), data.dtype.type(SERIES)
    t3, t5, t7 = one / data.dtype.type(3.0), one / data.dtype.type(5.0), one / data.dtype.type(7.0)
    t9, t11 = one / data.dtype.type(9.0), one / data.dtype.type(11.0)
    b0 = b1 = b3 = f00 = f01 = f03 = f11 = f13 = f33 = value = beyond = zero
    for i in range(data.shape[1]):
        c0, c1, c2, c3 = data[0, i], data[1, i], data[2, i], data[3, i]
        s, gx, gy, ga = here[i, 0], here[i, 1], here[i, 2], here[i, 4]
        for j in range(s.size):
            base, change = max(c1[j] + c3[j], least), c2[j] * s[j]
            rate, middle = max(base + change, least), two * base + change
            per = one / (rate * middle)  # one division for both quotients, since it is slow
            beyond += one if abs(change) >= series * base else zero
            w = change * (rate * per)
            w2 = w * w
            tail = w * (t3 + w2 * (t5 + w2 * (t7 + w2 * (t9 + w2 * t11))))
            value += two * (c0[j] - base) * (w + w2 * tail) + w2 * (two * base * tail - middle)
            bend = c2[j] * (middle * per)
            pull = (c0[j] - rate) * bend
            bend *= c2[j]
            b0 += pull * gx[j]
            b1 += pull * gy[j]
            b3 += pull * ga[j]
            hx, hy, ha = bend * gx[j], bend * gy[j], bend * ga[j]
            f00 += hx * gx[j]
            f01 += hx * gy[j]
            f03 += hx * ga[j]
            f11 += hy * gy[j]
            f13 += hy * ga[j]
            f33 += ha * ga[j]
    score[:] = 0.0
    fisher[:] = 0.0
    score[0], score[1], score[3] = b0, b1, b3
    fisher[0, 0], fisher[1, 1], fisher[3, 3] = f00, f11, f33
    fisher[0, 1] = fisher[1, 0] = f01
    fisher[0, 3] = fisher[3, 0] = f03
    fisher[1, 3] = fisher[3, 1] = f13
    return float(value), float(beyond)


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


class Fits(NamedTuple):
    """How the fits of rows ended (n,), their information (n, 4, 4) and gain in likelihood (n,)."""

    outcome: IntArray
    information: FloatArray
    gain: FloatArray


class Room(NamedTuple):
    """Work space of the kernels of rows, which allocate no memory."""

    pixels: AnyFloatArray
    line: NDArray[np.float32]
    profile: FloatArray
    free: IntArray
    small: FloatArray
    ways: FloatArray
    work: FloatArray


class Scene(NamedTuple):
    """What the kernels of rows are given of the frames, of all particles in them, and to work."""

    light: Light
    field: Field
    near: Pictures
    canvas: Canvas
    slopes: Slopes
    room: Room


class Totals(NamedTuple):
    """Background (y, x), Σ B C of each frame (t,), and Σ w C over frames (y, x)."""

    background: NDArray[np.float32]
    expected: FloatArray
    sums: NDArray[np.float32]


@kernel(_nrt=False)
def fit_frames(
    scene: Scene, search: Search, particles: Rows, frames: tuple[int, int], fits: Fits,
    totals: Totals, place: IntArray,
) -> bool:  # fmt: skip
    """Fit the rows of frames up to the first number − 1, each as often as the second one says.

    If plain scoring steps fail for a row, the kernel returns its position, its constants and a
    start inside its box, in `place` (7,).  The caller puts its maximum into `particles` and `fits`,
    and calls again.
    """
    light, field, near, canvas, slopes, room = scene
    background, expected, sums = totals
    last, sweeps = frames
    starts, theta, group = particles
    outcome, information, gain = fits
    rows, columns = light.background.shape
    area = field.side**2
    fisher, step, score, start = room.small[:5], room.small[5], room.small[6], room.small[10]
    index = room.free
    while place[0] < last:
        t = place[0]
        total = canvas.total[t]
        if sweeps and place[4] == 0:
            expected[t] = _read_ahead(light.counts[t])  # stored, or the loop would be dropped
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
                draw(near, group[r], p, pixels, room.profile, both[0])
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
        draw(near, group, trial, pixels, room.profile, both[1 - at])
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


_ROUNDING = 1e-9  # share of the reach by which rounding may change a distance


@kernel()
def link_surely(
    places: FloatArray, starts: IntArray, first: int, reach: float, memory: int, track: IntArray,
    taken: BoolArray, waiting: IntArray, state: IntArray, doubtful: IntArray,
) -> int:  # fmt: skip
    """Link positions from frame to frame until there is a choice.

    A particle waits at its last position until it is linked, at most `memory` frames beyond the
    next one.  If it has one new position within reach, and this position no other particle, the two
    are linked.  A position without a particle within reach begins a track.

    Shapes: `places` (n, axes), `starts` (t + 1,), `track` (n,), `taken` (n,), `waiting` (n,),
    `state` (4,), `doubtful` (n,).
    """
    onward, backward = np.empty(len(places), dtype=np.int64), np.empty(len(places), dtype=np.int64)
    only = np.empty(len(places), dtype=np.int64)
    for t in range(first, starts.size - 1):
        begin, end = starts[t], starts[t + 1]
        oldest, count = starts[max(t - 1 - memory, 0)], 0
        for k in range(state[0]):
            i = waiting[k]
            if i >= oldest and not taken[i]:
                waiting[count] = i
                count += 1
        onward[:count], backward[begin:end] = 0, 0
        for k in range(count):
            for j in range(begin, end):
                if _within(places, waiting[k], j, reach * (1 + _ROUNDING)):
                    onward[k] += 1
                    backward[j] += 1
                    only[j] = k
        for j in range(begin, end):
            if backward[j] == 0:
                track[j] = state[1]
                state[1] += 1
            elif backward[j] == 1 and onward[only[j]] == 1:
                i = waiting[only[j]]
                if _within(places, i, j, reach * (1 - _ROUNDING)):
                    track[j], taken[i] = track[i], True
                    backward[j] = 0
        left = 0
        for k in range(count):
            if onward[k] > 0 and not taken[waiting[k]]:
                doubtful[left] = waiting[k]
                left += 1
        state[2] = left
        for j in range(begin, end):
            waiting[count] = j
            count += 1
            if backward[j] > 0:
                doubtful[left] = j
                left += 1
        state[0], state[3] = count, left - state[2]
        if left > 0:
            return t
    return starts.size - 1


@kernel()
def _within(places: FloatArray, i: int, j: int, reach: float) -> bool:
    square = 0.0
    for k in range(places.shape[1]):
        square += (places[i, k] - places[j, k]) ** 2
    return square <= reach**2
