"""Noise that is not the light's: a fixed pattern that shakes, or counts that are too coarse.

In variance against mean, both look like a wrong gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray, FloatArray

MOST_EXPLAINED = 0.5
"""Share of the noise beyond the light's that the motion of the pattern must explain to be named."""


@dataclass(frozen=True)
class PatternJitter:
    """Motion of the fixed pattern from frame to frame."""

    share: float
    rms_px: float


def measure_pattern_jitter(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> PatternJitter | None:
    """Fit the difference of neighbouring frames with the gradient of their mean.

    A pattern B that moves by δ changes by −δ·∇B.  The difference of two frames is fitted with ∂_y B
    and ∂_x B, weighted by shot noise.  Of noise alone each of them explains 1 of χ².

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    seen = _Pattern.of(counts, camera, masked)
    if seen is None:
        return None
    light, used, information, variance = seen.light, seen.used, seen.information, seen.variance
    steps = np.diff(light, axis=0)[:, used]
    moved = seen.motion(steps)
    explained = float(np.einsum("ki,ij,kj->", moved, information, moved)) - moved.size
    beyond = float(np.sum(steps**2 / variance)) - steps.size
    if beyond <= 0:
        return None
    own = float(np.trace(np.linalg.inv(information))) / 2  # of the light's noise alone
    rms = np.sqrt(max(float(np.mean(moved**2)) - own, 0.0) / 2)
    return PatternJitter(explained / beyond, float(rms))


def without_pattern_jitter(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> NDArray[Any]:
    """Remove the motion of the fixed pattern from frames, to first order.

    Shapes: `counts` (t, y, x), `masked` (y, x), result (t, y, x).
    """
    seen = _Pattern.of(counts, camera, masked)
    if seen is None:
        return counts
    moved = seen.motion(seen.light[:, seen.used] - seen.mean[seen.used])
    change_e = np.einsum("ki,iyx->kyx", moved * seen.power[:, None], seen.slopes)
    return np.asarray(counts - change_e / camera.gain_e_per_adu)


@dataclass(frozen=True)
class _Pattern:
    """Frames of equal power, their mean, and the Fisher information on its motion."""

    light: FloatArray  # (t, y, x) [e]
    power: FloatArray  # (t,), that was divided out
    mean: FloatArray
    slopes: FloatArray  # (2, y, x)
    used: BoolArray
    variance: FloatArray  # of the difference of two frames, at the pixels used
    information: FloatArray  # (2, 2)

    @classmethod
    def of(cls, counts: NDArray[Any], camera: Camera, masked: BoolArray | None) -> _Pattern | None:
        light = np.stack([camera.to_electrons(frame) for frame in counts])
        used = light.min(axis=0) > 0
        if masked is not None:
            used &= ~masked
        if len(light) < 3 or not used.any():
            return None
        power = light[:, used].mean(axis=1)
        power /= power.mean()
        light /= power[:, None, None]
        mean = light.mean(axis=0)
        slopes = np.stack(np.gradient(mean))
        variance = 2 * (mean + camera.read_variance_e2(mean.shape))[used]
        there = slopes[:, used]
        information = np.einsum("ip,jp,p->ij", there, there, 1 / variance)
        if not np.linalg.cond(information) < 1 / np.finfo(float).eps:
            return None
        return cls(light, power, mean, slopes, used, variance, information)

    def motion(self, changes: FloatArray) -> FloatArray:
        """Fit the slopes to changes (k, p) in the used pixels: the motion along −y and −x."""
        there = self.slopes[:, self.used]
        seen = np.einsum("kp,ip,p->ki", changes, there, 1 / self.variance)
        return np.asarray(np.linalg.solve(self.information, seen.T).T)
