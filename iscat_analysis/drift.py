"""Drift: how far the fixed pattern of a movie moves."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

from iscat_analysis.records import FloatArray


def measure_drift(reference_e: FloatArray, later_e: FloatArray) -> tuple[float, float]:
    """Shift of the fixed pattern between two mean images, by phase correlation.

    Parameters
    ----------
    reference_e, later_e : ndarray, shape (y, x)
        Mean images.

    Returns
    -------
    dy_px, dx_px : float
        How far the later pattern moved; NaN where there is no pattern to follow.

    Notes
    -----
    C. D. Kuglin and D. C. Hines, Proc. IEEE Conf. Cybernetics and Society, 163 (1975).  Below a
    pixel the phase of the cross-spectrum is fitted by a plane, weighted by its strength.
    """
    rows, columns = reference_e.shape
    taper = np.outer(np.hanning(rows), np.hanning(columns))
    one, two = (fft.rfft2(taper * (image / image.mean() - 1)) for image in (reference_e, later_e))
    cross = two * np.conj(one)
    magnitude = np.abs(cross)
    if not magnitude.max() > 0:
        return math.nan, math.nan
    surface = fft.irfft2(cross / np.maximum(magnitude, 1e-12 * magnitude.max()), s=taper.shape)
    at = np.unravel_index(int(np.argmax(surface)), surface.shape)
    y, x = (int((i + n // 2) % n - n // 2) for i, n in zip(at, taper.shape, strict=True))
    fy, fx = np.meshgrid(fft.fftfreq(rows), fft.rfftfreq(columns), indexing="ij")
    left = cross * np.exp(2j * np.pi * (fy * y + fx * x))
    weight = np.abs(left) * (np.hypot(fy, fx) < 0.25)
    angle = np.angle(left)
    a = np.array([[np.sum(weight * u * v) for v in (fy, fx)] for u in (fy, fx)])
    b = np.array([np.sum(weight * u * angle) for u in (fy, fx)])
    dy, dx = np.linalg.lstsq(a, -b / (2 * np.pi), rcond=None)[0]
    return float(y + dy), float(x + dx)
