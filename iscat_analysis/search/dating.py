"""At which frame a step lies, how surely, and whether its light rises over some frames.

The likelihood of the amplitude of every single frame, Gaussian with known noise, with one change
of mean: its posterior over the frames (flat prior, amplitudes profiled) gives the estimate and its
interval (D. V. Hinkley, Biometrika 57, 1, 1970).

A rise, as of a particle that settles, is a line from one level to the other between two frames; it
is set against a step.  The frames of the line are left out of fits, whatever the course in them;
but light that settles exponentially goes on rising after any line, and an exponential that
describes the frames better than the line tells so.

Particles of one kind rise alike, and the noise of a faint one may hide its rise or feign one.  The
duration is therefore estimated from all steps together, and a step has another one only if its own
likelihood is clearly larger with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erfc, logsumexp

from iscat_analysis._kernels.sliding import best_line
from iscat_analysis.records import FloatArray, IntArray
from iscat_analysis.search.frames import Patch

_LEAST_GAIN = 6.0  # log-likelihood by which another course is better than the expected one
_ALONE = 0.1  # probability that a step has a course of its own
_RISE_FRAMES = (3, 5, 8, 12, 18, 27, 40, 60, 90)  # tried first, then others near the best


@dataclass(frozen=True)
class Rise:
    """Frames over which the light of a step rises.

    Attributes
    ----------
    frames, centre : int
        How many, and the one in their middle, counted from the first that was looked at.
    height : float
        Of the frames after over those before.
    p_line : float
        Chance that a line seems so much worse than an exponential.
    settling : tuple of float
        Log-likelihoods of exponentials over that of the line.
    """

    frames: int
    centre: int
    height: float
    p_line: float
    settling: tuple[float, ...]


def find_rise(
    heights: FloatArray, weight: FloatArray, turn: int, step: float, expected: int = 0
) -> tuple[Rise, tuple[float, ...]]:
    """Find a rise around the best step, whose log-likelihood is given; of 0 frames if it is one.

    A course other than the expected one, which is a step if no frames of a rise are expected, must
    be clearly better.  The gains of all lines over the step are given as well, for `common_rise`.

    Shapes: `heights` (t,), `weight` (t,).
    """
    lit = np.flatnonzero(weight > 0)
    w = weight[lit]
    y = heights[lit] - np.average(heights[lit], weights=w)

    def tried(rise: int, reach: int, every: int = 1, about: int = turn) -> tuple[float, int, int]:
        if 2 * rise >= heights.size:
            return 0.0, rise, turn
        first, last = about - reach, min(about + reach + 1, heights.size - rise // 2)
        first += max(math.ceil((rise // 2 + 1 - first) / every), 0) * every
        gain, centre = best_line(lit, w, y, rise, (first, last, every), 0.0)
        return gain, rise, centre or turn

    def judged(course: tuple[float, int, int]) -> float:
        return course[0] + _LEAST_GAIN * (course[1] == expected)

    lines = [tried(rise, rise // 2, max(rise // 8, 1)) for rise in _RISE_FRAMES]
    profile = tuple(gain - step for gain, *_ in lines)
    usual = [tried(expected, expected)] if expected else []
    best = max([(step, 0, turn), *lines, *usual], key=judged)
    _, rise, centre = best
    if rise not in (0, expected):
        finer = range(round(0.7 * rise), round(1.4 * rise) + 1, max(rise // 12, 1))
        near = [tried(max(other, 2), max(rise // 5, 2), about=centre) for other in finer]
        best = max([best, *near])
    gain, rise, centre = best
    if not rise:
        return Rise(0, turn, 0.0, 1.0, ()), profile
    begins = centre - rise / 2 + rise * np.linspace(-0.25, 0.25, 11)
    shares = (0.15, 0.25, 0.35, 0.5, 0.7)  # of the frames of the line, that the light decays in
    since = np.maximum(lit + 0.5 - begins[:, None], 0.0)
    curves = [-np.expm1(-since / (rise * share)) for share in shares]  # of new light
    settling = tuple(float(_gains(curve, w, y).max()) - gain for curve in curves)
    p_line = float(erfc(np.sqrt(max(*settling, 0.0))))  # of χ² with one degree of freedom
    height = _gain_beyond(heights, weight, centre, rise // 2 + 1)
    return Rise(rise, centre, height, p_line, settling), profile


def common_rise(profiles: Sequence[tuple[float, ...]]) -> int:
    """Give the frames over which the light of most steps rises; 0 if they are steps."""
    best = _common(profiles)
    return _RISE_FRAMES[best - 1] if best else 0


def go_on_rising(settling: Sequence[tuple[float, ...]]) -> bool:
    """Tell whether most rises are exponentials, of which each may be too faint to show it."""
    return _common(settling) > 0


def _common(profiles: Sequence[tuple[float, ...]]) -> int:
    """Give the number of the course that most steps have; 0 for the one that gains refer to.

    The likelihood of a step has its own course with a small probability, whatever the others do.
    """
    each = np.array([(0.0, *profile) for profile in profiles if profile])
    if not each.size:
        return 0
    own = math.log(_ALONE / each.shape[1]) + logsumexp(each, axis=1, keepdims=True)
    total = np.logaddexp(math.log1p(-_ALONE) + each, own).sum(axis=0)
    best = int(np.argmax(total))
    return best if total[best] > total[0] + _LEAST_GAIN else 0


def line(frames: IntArray, rise: int, centre: int) -> FloatArray:
    """Share of the new light in frames during a linear rise."""
    return np.asarray(np.clip((frames + 0.5 - centre) / rise + 0.5, 0.0, 1.0))


def _gains(traces: FloatArray, weight: FloatArray, heights: FloatArray) -> FloatArray:
    """Log-likelihood of each time course with a free height, over that of a constant.

    Shapes: `traces` (n, t), `weight` (t,), `heights` (t,) less their mean, result (n,).
    """
    traces = traces - (traces @ weight / weight.sum())[:, None]
    along, known = traces @ (weight * heights), (traces**2) @ weight
    return np.where(along > 0, 0.5 * along**2 / np.maximum(known, 1e-300), 0.0)


def _gain_beyond(heights: FloatArray, weight: FloatArray, turn: int, gap: int) -> float:
    """Difference of the means after and before a gap.

    Shapes: `heights` (t,), `weight` (t,).
    """
    sides = (slice(0, max(turn - gap, 0)), slice(turn + gap, None))
    light = [float(weight[side].sum()) for side in sides]
    if min(light) <= 0:
        return 0.0
    first, last = (float(weight[side] @ heights[side]) for side in sides)
    return last / light[1] - first / light[0]


CREDIBLE = 0.95
"""Posterior probability inside the interval of a step's frame."""


@dataclass(frozen=True)
class StepFrame:
    """The frame of a step."""

    frame: int
    half_width: int
    height: float
    per_frame_snr: float
    p_constant: float
    rise: int = 0
    rise_profile: tuple[float, ...] = ()
    settling: tuple[float, ...] = ()

    @property
    def gap(self) -> int:
        """Frames on either side of the step that may belong to the other state, or to neither.

        They stay out of the fit: where the frame was chosen by their noise, that noise would
        count as signal, and while the light rises the contrast is not yet that of the particle.
        """
        return max(_gap(self.per_frame_snr), _half(self.rise))

    def kept_out(self, window: int) -> int:
        """Frames on either side that are left out of a fit with windows of so many frames."""
        doubtful = min(_gap(self.per_frame_snr), window // 5)
        return max(doubtful, min(_half(self.rise), window // 2))

    @property
    def first_turn(self) -> int:
        """First frame that may have light of the new state."""
        return self.frame - self.rise // 2

    @property
    def last_turn(self) -> int:
        """First frame with all the light of the new state."""
        return self.frame + self.rise // 2

    @property
    def turns(self) -> IntArray:
        """Frames at which equal parts of the new light appear."""
        return np.arange(self.first_turn, self.last_turn + 1)

    @classmethod
    def undated(cls, frame: int, half_width: int) -> StepFrame:
        """Take the date from the search, before single frames are tested."""
        return cls(frame, half_width, height=1.0, per_frame_snr=1.0, p_constant=1.0)


def _half(rise: int) -> int:
    return math.ceil(rise / 2) + 1 if rise else 0


def _gap(per_frame_snr: float) -> int:
    # (per-frame SNR)² at which about one frame around a step is doubtful
    return round(4.0 / max(per_frame_snr, 0.5) ** 2)


def locate_step(
    patch: Patch,
    image: FloatArray,
    search: tuple[int, int],
    *,
    known: FloatArray | None = None,
    expected_rise: int = 0,
) -> StepFrame:
    """Find the frame of a step by the likelihood of the frames around it.

    Shapes: `image` (ny, nx), `known` (t,).
    """
    heights, weight, scale = frame_heights(patch, image)
    if known is not None:
        heights = heights - known
    jump, gain_in_log = _changes(heights, weight)
    frames = np.arange(patch.first + 1, patch.first + heights.size)
    inside = (frames >= search[0]) & (frames < search[1]) & np.isfinite(gain_in_log)
    if not inside.any():
        middle = int(np.clip((search[0] + search[1]) // 2, frames[0], frames[-1]))
        return StepFrame(middle, search[1] - search[0], 0.0, 0.0, 1.0)
    log = np.where(inside, gain_in_log * (jump > 0), -np.inf)
    best = int(np.argmax(log))
    posterior = np.exp(log - log[best])
    posterior /= posterior.sum()
    distance = np.abs(frames - frames[best])
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(posterior[order])
    half_width = int(distance[order][np.searchsorted(held, CREDIBLE * (1 - 1e-12))])
    height = float(jump[best])
    snr = abs(height) * math.sqrt(scale)
    turn, gap = best + 1, _gap(snr)
    rise, profile = find_rise(heights, weight, turn, float(log[best]), expected_rise)
    sides = slice(0, max(turn - gap, 0)), slice(min(turn + gap, heights.size), heights.size)
    for side in sides:
        weight[side] /= _noise_ratio(patch, image, side)
    if not rise.frames:
        p = min(_p_constant(heights[side], weight[side]) for side in sides)
    else:
        turn, height = rise.centre, rise.height
        snr = abs(height) * math.sqrt(scale)
        # two that land one after the other are no line, and then neither are the frames between
        straight = heights - height * line(np.arange(heights.size), rise.frames, turn)
        p = min(_p_constant(straight, weight), rise.p_line)
        half_width = max(half_width, rise.frames // 2)
    p, course = 1 - (1 - p) ** 2, (rise.frames, profile, rise.settling)
    return StepFrame(patch.first + turn, half_width, height, snr, p, *course)


def frame_heights(patch: Patch, image: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Measure how much of an image every frame holds, whatever its light.

    Shapes: `image` (ny, nx), `heights` (t,), `weight` (t,).
    """
    weights, scale = _projector(patch, image)
    scores = patch.pixels @ (weights * patch.gain).ravel()
    power = patch.power
    lit = power > 0
    zero = float(np.sum(weights * patch.gain * patch.offset))
    heights = (scores - zero) / np.where(lit, power, 1.0) / scale
    return heights, np.where(lit, power, 0.0) * scale, scale


def _noise_ratio(patch: Patch, image: FloatArray, frames: slice) -> float:
    """Variance of the heights of some frames over that in the mean light: a particle adds light.

    Shapes: `image` (ny, nx).
    """
    total, number, power = patch.window(patch.first + frames.start, patch.first + frames.stop)
    if not number:
        return 1.0
    weights, _ = _projector(patch, image)
    read = np.square(patch.read_noise_e)
    here, usual = (float(np.sum(weights**2 * (e + read))) for e in (total / power, patch.mean_e))
    return here / usual


def _changes(heights: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean after minus mean before each possible change, and the gain in likelihood; NaN if none.

    Shapes: `heights, weight` (t,), results (t − 1,).
    """
    light, total = np.cumsum(weight), np.cumsum(weight * heights)
    before, first = light[:-1], total[:-1]
    after, last = light[-1:] - before, total[-1:] - first
    known = (before > 0) & (np.cumsum(weight[::-1])[-2::-1] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        jump = np.where(known, last / after - first / before, 0.0)
        return jump, np.where(known, 0.5 * before * after / light[-1:] * jump**2, np.nan)


def _p_constant(heights: FloatArray, weight: FloatArray) -> float:
    """Chance that constant heights, of variance 1/weight, seem to change as much at some frame.

    Notes
    -----
    Tail of the likelihood ratio of one change of mean anywhere: B. James, K. L. James and
    D. Siegmund, Biometrika 74, 71 (1987), eq. (4).
    """
    lit = int(np.count_nonzero(weight > 0))
    if lit < 3:
        return 1.0
    b = math.sqrt(2 * float(np.nanmax(_changes(heights, weight)[1])))
    density = math.exp(-0.5 * b * b) / math.sqrt(2 * math.pi)
    widest = 2 * math.log(lit - 1)  # ln of the odds of the last split over the first
    tail = density * ((b - 1 / b) * widest + 4 / b) if b > 1 else 1.0
    return min(tail, 1.0)


def crosstalk(patch: Patch, image: FloatArray, others: Sequence[FloatArray]) -> list[float]:
    """Heights that other particles' contrasts add to a frame, in units of `image`.

    Shapes: `image` (ny, nx).
    """
    if not others:
        return []
    weights, scale = _projector(patch, image)
    light = weights * patch.mean_e
    return [float(np.sum(light * other)) / scale for other in others]


def _projector(patch: Patch, image: FloatArray) -> tuple[FloatArray, float]:
    """Weights that measure the amplitude of an image and ignore a common level, and their scale."""
    mean = np.where(patch.usable, patch.mean_e, 1.0)
    share = patch.usable * mean / (mean + np.square(patch.read_noise_e))
    light = mean * share
    weights = share * (image - np.sum(light * image) / max(float(np.sum(light)), 1e-300))
    return weights, max(float(np.sum(weights * mean * image)), 1e-300)
