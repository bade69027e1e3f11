"""Noise that is none of the light's: a fixed pattern that shakes, counts that are too coarse.

Both look like a wrong gain to whoever compares variance with mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.movie.camera import Camera
from iscat_analysis.records import BoolArray

MOST_EXPLAINED = 0.5
"""Share of the noise beyond the light's that the motion of the pattern must explain to be named."""


@dataclass(frozen=True)
class Shaking:
    """How much the fixed pattern moves from frame to frame.

    Attributes
    ----------
    share : float
        Of the variance beyond that of the light, what motion of the pattern explains.
    rms_px : float
        Standard deviation of its place along an axis, were frames independent [pixels].
    """

    share: float
    rms_px: float


def measure_shaking(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> Shaking | None:
    """Compare what differs between neighbouring frames with the gradient of their mean.

    A pattern B that moves by δ changes by −δ·∇B: the difference of two frames is fitted with ∂_y B
    and ∂_x B, weighted by shot noise.  Of noise alone each explains 1 of χ².

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Successive frames.
    camera : Camera
        Counts → photoelectrons.
    masked : ndarray of bool, shape (y, x), optional
        Pixels to leave out.

    Returns
    -------
    Shaking or None
        None where there is no noise beyond that of the light, or no pattern.
    """
    light = np.stack([camera.to_electrons(frame) for frame in counts])
    used = light.min(axis=0) > 0
    if masked is not None:
        used &= ~masked
    if len(light) < 3 or not used.any():
        return None
    power = light[:, used].mean(axis=1)
    light *= (power.mean() / power)[:, None, None]
    mean = light.mean(axis=0)
    slopes = np.stack([slope[used] for slope in np.gradient(mean)])
    variance = 2 * (mean + camera.read_variance_e2(mean.shape))[used]
    information = np.einsum("ip,jp,p->ij", slopes, slopes, 1 / variance)
    if not np.linalg.cond(information) < 1 / np.finfo(float).eps:
        return None
    steps = np.diff(light, axis=0)[:, used]
    seen = np.einsum("kp,ip,p->ki", steps, slopes, 1 / variance)
    moved = np.linalg.solve(information, seen.T).T
    explained = float(np.einsum("ki,ki->", seen, moved)) - moved.size
    beyond = float(np.sum(steps**2 / variance)) - steps.size
    if beyond <= 0:
        return None
    own = float(np.trace(np.linalg.inv(information))) / 2  # of the light's noise alone
    rms = np.sqrt(max(float(np.mean(moved**2)) - own, 0.0) / 2)
    return Shaking(explained / beyond, float(rms))
