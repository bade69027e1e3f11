"""At which frame a step lies, and how surely.

The likelihood of the amplitude of every single frame, Gaussian with known noise, with one change
of mean: its posterior over the frames (flat prior, amplitudes profiled) gives the estimate and its
interval (D. V. Hinkley, Biometrika 57, 1, 1970).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.stepping import frame_scores, one_change, projector
from iscat_analysis.records import FloatArray
from iscat_analysis.search.sliding.frames import Patch
from iscat_analysis.search.sliding.rises import find_rise, line

CREDIBLE = 0.95
"""Posterior probability inside the interval of a step's frame."""

_CLEAR_FRAME_SNR2 = 4.0  # (per-frame SNR)² at which about one frame around a step is doubtful


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
    def turns(self) -> NDArray[np.int64]:
        """Frames at which equal parts of the new light appear."""
        return np.arange(self.first_turn, self.last_turn + 1)

    @classmethod
    def undated(cls, frame: int, half_width: int) -> StepFrame:
        """Take the date from the search, before single frames are tested."""
        return cls(frame, half_width, height=1.0, per_frame_snr=1.0, p_constant=1.0)


def _half(rise: int) -> int:
    return math.ceil(rise / 2) + 1 if rise else 0


def _gap(per_frame_snr: float) -> int:
    return round(_CLEAR_FRAME_SNR2 / max(per_frame_snr, 0.5) ** 2)


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
    jump, gain_in_log = np.empty((2, max(heights.size - 1, 0)))
    one_change(heights, weight, jump, gain_in_log)
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
    if rise is None:
        p = min(_p_constant(heights[side], weight[side]) for side in sides)
    else:
        turn, height = rise.centre, rise.height
        snr = abs(height) * math.sqrt(scale)
        # two that land one after the other are no line, and then neither are the frames between
        straight = heights - height * line(np.arange(heights.size), rise.frames, turn)
        p = min(_p_constant(straight, weight), rise.p_line)
        half_width = max(half_width, rise.frames // 2)
    p = 1 - (1 - p) ** 2
    frame = patch.first + turn
    if rise is None:
        return StepFrame(frame, half_width, height, snr, p, rise_profile=profile)
    return StepFrame(frame, half_width, height, snr, p, rise.frames, profile, rise.settling)


def frame_heights(patch: Patch, image: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Measure how much of an image every frame holds, whatever its light.

    Shapes: `image` (ny, nx), `heights` (t,), `weight` (t,).
    """
    weights, scale = _projector(patch, image)
    scores = np.empty((1, len(patch.counts)))
    every = np.ones(scores.size, dtype=np.bool_)
    frame_scores(patch.pixels, every, (weights * patch.gain).reshape(1, -1), scores)
    power = patch.power
    lit = power > 0
    zero = float(np.sum(weights * patch.gain * patch.offset))
    heights = (scores[0] - zero) / np.where(lit, power, 1.0) / scale
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


def _p_constant(heights: FloatArray, weight: FloatArray) -> float:
    """Chance that constant heights, of variance 1/weight, seem to change as much at some frame.

    Notes
    -----
    Tail of the likelihood ratio of one change of mean anywhere: B. James, K. L. James and
    D. Siegmund, Biometrika 74, 71 (1987), eq. (4).
    """
    scratch = np.empty((2, max(heights.size - 1, 0)))
    largest, lit = one_change(heights, weight, *scratch)
    if lit < 3:
        return 1.0
    b = math.sqrt(2 * largest)
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
    weights = np.empty(image.shape)
    read = np.atleast_2d(np.asarray(patch.read_noise_e, dtype=np.float64))
    mean, used, seen = (np.ascontiguousarray(part) for part in (patch.mean_e, patch.usable, image))
    return weights, projector(mean, read, used, seen, weights)
