"""Movies of a speckled field with noise that the model knows, and with other."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]

PIXEL_NM = 84.0
SIDE = 96
LEVEL_E = 1e6
GAIN = 30.0
WRONG_GAIN = 1.3
"""What the analysis is told of the gain, over what it is, where that is the fault."""

EXCESS = 1.5
PINK = 1e-4
DRIFT_PX = 1e-4
_GRAIN_PX = 1.5


def speckled_counts(
    signals: Iterable[Array],
    frames: int,
    kind: str,
    rng: np.random.Generator,
    *,
    pink: float = PINK,
    drift_px: float = DRIFT_PX,
) -> NDArray[np.uint16]:
    """Draw a movie with 0.5 % of power noise, and noise of a kind.

    `signals` are what particles make of the light, frame by frame.  The kinds are ``"clean"``,
    ``"gain"``, which differs in what the analysis is told, ``"excess"``, ``"flicker"``, and
    ``"drift"`` of the speckle, in a direction of chance.
    """
    speckle = gaussian_filter(rng.standard_normal((SIDE, SIDE)), _GRAIN_PX, mode="wrap")
    spectrum = np.fft.rfft2((speckle - speckle.mean()) / speckle.std())
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)
    angle = rng.uniform(0, 2 * np.pi)
    turn = -2j * np.pi * drift_px * (np.cos(angle) * fx + np.sin(angle) * fy)
    flicker = pink_noise(frames, rng, pink) if kind == "flicker" else None
    out = np.empty((frames, SIDE, SIDE), dtype=np.uint16)
    for t, signal in enumerate(signals):
        moved = spectrum * np.exp(turn * t) if kind == "drift" else spectrum
        light = LEVEL_E * np.maximum(1 + 0.1 * np.fft.irfft2(moved, s=(SIDE, SIDE)), 0.05)
        light = light * signal * (1 + 0.005 * rng.standard_normal())
        if flicker is not None:
            light = light * (1 + flicker[t])
        excess = EXCESS if kind == "excess" else 1.0
        counts = light + np.sqrt(excess * light) * rng.standard_normal(light.shape)
        out[t] = np.rint(np.clip(counts / GAIN, 0, 65535))
    return out


def pink_noise(frames: int, rng: np.random.Generator, pink: float) -> Array:
    """Noise of every pixel whose one-sided spectral density is pink²/f per frame."""
    spectrum = np.fft.rfft(rng.standard_normal((2 * frames, SIDE, SIDE)), axis=0)
    noise = np.fft.irfft(spectrum * np.sqrt(_pink_spectrum(frames))[:, None, None], axis=0)[:frames]
    return np.asarray(pink / np.sqrt(2) * noise)


def pink_covariance(frames: int, pink: float) -> Array:
    """Covariance of the frames of `pink_noise`, shape (frames, frames)."""
    lag = np.arange(frames)
    along = pink**2 / 2 * np.fft.irfft(_pink_spectrum(frames))
    return np.asarray(along[np.abs(lag[:, None] - lag)])


def _pink_spectrum(frames: int) -> Array:
    f = np.fft.rfftfreq(2 * frames)
    return np.concatenate([[0.0], 1 / f[1:]])
