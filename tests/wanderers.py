"""Movies of particles that move on a membrane, through microscopes of `instruments`.

A frame is the average of the particle's pictures along its path.  In the space of wave vectors that
is the picture's spectrum times the mean of exp(−i q r) over the places of the path, whatever they
are: nothing is expanded, and nothing is taken from the package.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from instruments import Instrument, Pictures
from numpy.typing import NDArray
from scipy.fft import fft2, fftfreq, irfft2, next_fast_len, rfft2, rfftfreq
from scipy.ndimage import gaussian_filter

FloatArray = NDArray[np.float64]

PARTS = 16
"""Places in one exposure."""

MARGIN_PX = 8.0
"""How far out of the field particles go before they turn back."""

SPECIES = ((200.0, 0.15, 4), (200.0, 0.8, 3), (400.0, 0.15, 4), (400.0, 0.8, 3))
"""Mass [kDa], diffusion coefficient [µm²/s] and number."""

PIXEL_NM, GAIN_E_PER_ADU, FRAME_RATE_HZ = 84.0, 20.0, 331.0
"""Of the camera."""

SETTINGS: dict[str, Any] = {
    "camera.pixel_size_nm": PIXEL_NM,
    "camera.gain_e_per_adu": GAIN_E_PER_ADU,
    "camera.frame_rate_hz": FRAME_RATE_HZ,
    "calibration.gradient_per_kda": -3.1e-5,
    "particle.mass_kda": 300.0,
    "fit.mode": "track",
    "track.free": "mass",
    "optics.calibrate": "never",
    "compute.workers": 1,  # threads gain nothing where every core runs tests
}
"""What an analysis of these movies is told."""


@dataclass(frozen=True)
class Wanderers:
    """A movie and its truth.

    Attributes
    ----------
    counts : ndarray of uint16, shape (frames, y, x)
        What the camera gives.
    truth : DataFrame
        track, frame, x_nm, y_nm (averages over the exposure), inside (whether that is in the
        field), mass_kda, d_um2_s; one row for each particle and frame.
    """

    counts: NDArray[np.uint16]
    truth: pd.DataFrame


def wander(
    shape: tuple[int, int, int],
    *,
    seed: int,
    instrument: Instrument | None = None,
    species: tuple[tuple[float, float, int], ...] = SPECIES,
    level_e: float = 4e5,
    speckle: float = 0.15,
    power_noise: float = 0.01,
    frame_rate_hz: float = FRAME_RATE_HZ,
    pixel_nm: float = PIXEL_NM,
    gain_e_per_adu: float = GAIN_E_PER_ADU,
    drift_nm_per_frame: tuple[float, float] = (0.0, 0.0),
    stage_nm: FloatArray | None = None,
    led: Callable[[FloatArray], FloatArray] | None = None,
    shade: Callable[[int], FloatArray] | None = None,
) -> Wanderers:
    """Record particles that diffuse during the whole of every frame.

    Shapes: `shape` is (frames, rows, columns), `stage_nm` (frames, 2).

    The default instrument conserves energy, and `species` are as in `SPECIES`.  `speckle` and
    `power_noise` are the relative spread of the light from pixel to pixel and frame to frame.  What
    drifts out of the field on one side enters it on the other.  Particles and the pattern of the
    light move with the stage, and the truth holds what the camera sees.  `led` takes the places of
    every particle in every part of a frame (particles, frames, parts, 2) [nm] and gives others;
    `shade` takes the number of a frame and gives what multiplies its light (rows, columns).
    """
    rng = np.random.default_rng(seed)
    frames, rows, columns = shape
    stage = np.zeros((frames, 2)) if stage_nm is None else stage_nm
    walk, truth = _paths(rng, shape, species, frame_rate_hz, pixel_nm, led, stage)
    mass = np.array([row[0] for row in species for _ in range(row[2])])

    reach = max(rows, columns) + math.ceil(MARGIN_PX) + 1
    side = next_fast_len(2 * reach)
    offset = (np.arange(side) - side // 2) * pixel_nm
    farthest = 1.02 * math.sqrt(2) * side / 2 * pixel_nm
    pictures = Pictures(instrument or Instrument(emission="reciprocal"), farthest)
    above = pictures.contrast(offset[None, :], offset[:, None], 1e3)
    below = pictures.contrast(offset[None, :], offset[:, None], -1e3)
    linear, square = (above - below) / 2e3, (above + below) / 2e6
    spectra = [fft2(np.fft.ifftshift(part))[:, : side // 2 + 1] for part in (linear, square)]
    ky = 2 * np.pi * fftfreq(side)
    kx = 2 * np.pi * rfftfreq(side)

    rough = gaussian_filter(rng.standard_normal((rows, columns)), 3.0, mode="wrap")
    light = level_e * (1 + speckle * rough / rough.std())
    shift = (stage + np.outer(np.arange(frames), drift_nm_per_frame)) / pixel_nm
    drifts, pattern = bool(shift.any()), rfft2(light)
    amplitude = _calibrated(pictures, mass)
    weights = np.repeat(amplitude, PARTS) / PARTS
    squares = np.repeat(amplitude**2, PARTS) / PARTS
    counts = np.empty(shape, dtype=np.uint16)
    for t in range(frames):
        if drifts:
            turn = fftfreq(rows)[:, None] * shift[t, 1] + rfftfreq(columns) * shift[t, 0]
            light = irfft2(pattern * np.exp(-2j * np.pi * turn), s=(rows, columns))
        places = walk[:, t].reshape(-1, 2) / pixel_nm
        along = np.exp(-1j * np.outer(places[:, 0], kx))
        across = np.exp(-1j * np.outer(ky, places[:, 1]))
        spectrum = spectra[0] * ((across * weights) @ along)
        spectrum += spectra[1] * ((across * squares) @ along)
        contrast = irfft2(spectrum, s=(side, side))[:rows, :columns]
        expected = (1 + power_noise * rng.standard_normal()) * light * (1 + contrast)
        if shade is not None:
            expected = expected * shade(t)
        noisy = expected + np.sqrt(expected) * rng.standard_normal((rows, columns))
        counts[t] = np.floor(noisy / gain_e_per_adu + rng.random((rows, columns)))

    return Wanderers(counts, truth)


def _calibrated(pictures: Pictures, mass_kda: FloatArray) -> FloatArray:
    """Amplitudes, as masses, whose whole peak is in proportion to the mass, as in calibrations.

    The square of the scattered field takes 0.3 % off the contrast of 400 kDa.
    """
    near = np.linspace(-900.0, 900.0, 181)
    above, below = (pictures.contrast(near[None], near[:, None], m).ravel() for m in (1e3, -1e3))
    top = int(np.argmax(np.abs(above - below)))
    linear, square = (above - below)[top] / 2e3, (above + below)[top] / 2e6
    return np.asarray((np.sqrt(1 + 4 * mass_kda * square / linear) - 1) / (2 * square / linear))


def _paths(
    rng: np.random.Generator,
    shape: tuple[int, int, int],
    species: tuple[tuple[float, float, int], ...],
    frame_rate_hz: float,
    pixel_nm: float,
    led: Callable[[FloatArray], FloatArray] | None,
    stage_nm: FloatArray,
) -> tuple[FloatArray, pd.DataFrame]:
    """Places x, y of every particle in every part of a frame [nm], and the truth."""
    frames, rows, columns = shape
    mass, diffusion = (np.array([row[k] for row in species for _ in range(row[2])]) for k in (0, 1))
    low = -MARGIN_PX * pixel_nm
    field = np.array([columns - 1, rows - 1]) * pixel_nm
    size = field - 2 * low
    step = np.sqrt(2e6 * diffusion / (frame_rate_hz * PARTS))[:, None, None]
    walk = np.cumsum(step * rng.standard_normal((mass.size, frames * PARTS, 2)), axis=1)
    walk += rng.uniform(0, size, (mass.size, 1, 2))
    walk = low + size - np.abs(walk % (2 * size) - size)  # between walls that reflect
    walk = walk.reshape(mass.size, frames, PARTS, 2)
    walk = (walk if led is None else led(walk)) + stage_nm[:, None]
    mean = walk.mean(axis=2)
    inside = ((mean >= 0) & (mean <= field)).all(axis=2)
    track, frame = (k.ravel() for k in np.indices(inside.shape))
    truth = pd.DataFrame({
        "track": track, "frame": frame,
        "x_nm": mean[..., 0].ravel(), "y_nm": mean[..., 1].ravel(), "inside": inside.ravel(),
        "mass_kda": mass[track], "d_um2_s": diffusion[track],
    })  # fmt: skip
    return walk, truth
