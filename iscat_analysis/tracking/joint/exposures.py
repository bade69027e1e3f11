"""The frames of a movie in memory, as they are stored where that takes less of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.canvas import Counts
from iscat_analysis.records import FloatArray


@dataclass(frozen=True)
class Exposures:
    """Counts, and what they stand for."""

    counts: Counts
    gain: float = 1.0
    offset: float = 0.0

    def electrons(self, *where: slice | int) -> NDArray[np.float32]:
        """Give the photoelectrons of some frames."""
        out = np.asarray(np.subtract(self.counts[where], self.offset, dtype=np.float32))
        out *= np.float32(self.gain)
        return out

    def in_electrons(self, sums: Any, of: int) -> FloatArray:
        """Convert sums of counts."""
        return np.asarray(self.gain * (sums - of * self.offset))
