"""What pictures do not tell: directions of the microscope that leave them as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis.instrument.learner.estimate import prior_range
from iscat_analysis.records import FloatArray

_TAKES_PART = 0.3  # component of a direction, in prior ranges, above which a parameter is named


@dataclass(frozen=True)
class Hidden:
    """A parameter that pictures do not determine within its plausible range."""

    name: str
    others: tuple[str, ...]
    direction: Mapping[str, float]

    @property
    def why(self) -> str:
        """Say it in a few words."""
        return "not told apart from " + ", ".join(self.others) if self.others else "not visible"


def find_hidden(information: FloatArray, names: Sequence[str]) -> Hidden | None:
    """Find the worst determined direction, if it is wider than what is plausible.

    Shapes: `information` (n, n).
    """
    if not names:
        return None
    scale = np.array([prior_range(name) for name in names])
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] >= 1:
        return None
    weights = np.abs(vectors[:, 0])
    name = names[int(np.argmax(weights))]
    others = tuple(n for n, w in zip(names, weights, strict=True) if w > _TAKES_PART and n != name)
    with np.errstate(divide="ignore"):
        width = float(1 / np.sqrt(max(values[0], 0.0)))
    moves = {
        n: float(v * s * width)
        for n, v, s in zip(names, vectors[:, 0], scale, strict=True)
        if n == name or n in others
    }
    return Hidden(name, others, moves)
