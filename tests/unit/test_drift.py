"""Registration of a moving pattern."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.drift import measure_drift


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.15), (2.4, 1.1)])
def test_drift_of_a_pattern(shift: tuple[float, float]) -> None:
    n = 64
    rng = np.random.default_rng(3)
    f = np.fft.fftfreq(n)
    envelope = np.exp(-((f[:, None] ** 2 + f**2) / (2 * 0.08**2)))
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * envelope
    moved = spectrum * np.exp(-2j * np.pi * (f[:, None] * shift[0] + f * shift[1]))
    one, two = (np.fft.ifft2(s).real for s in (spectrum, moved))
    scale = 0.1 / one.std()
    found = measure_drift(1 + scale * one, 1 + scale * two)
    assert found == pytest.approx(shift, rel=0.05, abs=0.03)  # the taper costs a few per cent
