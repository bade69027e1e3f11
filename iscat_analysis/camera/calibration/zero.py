"""Where the light of a movie ends, beside where the camera's numbers say that it does.

A contrast is a change divided by the light above the offset: an offset that is too low by a share s
of the light makes contrasts, and masses, too small by s.  Two properties of the pixels know where
the light is zero, neither of which needs the gain: how strongly they follow the laser's power,
dm_p/dρ ∝ m_p − o, and their noise, v_p = (m_p − o)/g.  See the module's page.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from iscat_analysis.camera.calibration.laws import SIGMAS, TOLERANCE
from iscat_analysis.camera.calibration.transfer import Transfer, measure_transfer
from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray

_LEAST_FRAMES, _MOST_FRAMES = 16, 256
_MOST_COUNTS = 2**22  # of a movie's counts that are looked at: a tenth of a second


@dataclass(frozen=True)
class LightZero:
    """Where the light is zero."""

    share: float
    se: float
    electrons: float
    flickers: bool

    @property
    def off(self) -> bool:
        """Whether the offset is wrong by more than 1 % of the light, not by chance."""
        return abs(self.share) > TOLERANCE + SIGMAS * self.se

    def may_be(self, share: float) -> bool:
        """Tell whether another share may be no light."""
        return abs(self.share - share) < TOLERANCE + SIGMAS * self.se


def find_zero(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> LightZero | None:
    """Find where the light is zero.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    pixels = counts.shape[1] * counts.shape[2]
    most = min(_MOST_FRAMES, max(_LEAST_FRAMES, _MOST_COUNTS // pixels))
    found = measure_transfer(counts[:most], camera, masked=masked)
    return None if found is None else zero_of(found)


def zero_of(found: Transfer) -> LightZero | None:
    """Choose the zero with the smaller error, of flicker or of noise."""
    known = [
        LightZero(one.value / found.level, one.se / found.level, one.value, flickers)
        for one, flickers in ((found.flicker, True), (found.noise, False))
        if one is not None
    ]
    return min(known, key=lambda one: one.se, default=None)
