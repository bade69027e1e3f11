"""Parameters of the optics that can be learned, and the errors of those that were."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from iscat_analysis.config.field import FIELD_TERMS, MOVES
from iscat_analysis.config.values import Finite, Section

ABERRATIONS = tuple(f"z{j}" for j in range(5, 38))
"""Zernike terms that can be set, by Noll's index."""

MEASURABLE = (
    "focus_nm",
    "na",
    "reference_phase_deg",
    "mask_na",
    "attenuation",
    "polarization_deg",
    *ABERRATIONS,
)
"""Parameters of the optics that can be learned from images, and that have a derivative."""


class OpticsCovariance(Section):
    """Errors of measured optics, section ``[covariance]`` of ``optics.toml``."""

    names: tuple[str, ...] = Field(description="keys of [optics], each aberration by its own name")
    matrix: tuple[tuple[Finite, ...], ...] = Field(description="covariance, in the order of names")

    @property
    def of_the_middle(self) -> OpticsCovariance:
        """Errors of the optics in the middle of the field, without those of its terms."""
        return self._without({*FIELD_TERMS, *MOVES})

    @property
    def at_rest(self) -> OpticsCovariance:
        """Errors of the microscope, without those of how its focus moved in a movie."""
        return self._without({*MOVES})

    def _without(self, left_out: set[str]) -> OpticsCovariance:
        kept = [k for k, name in enumerate(self.names) if name not in left_out]
        matrix = tuple(tuple(self.matrix[i][k] for k in kept) for i in kept)
        return OpticsCovariance(names=tuple(self.names[k] for k in kept), matrix=matrix)

    @model_validator(mode="after")
    def _symmetric(self) -> OpticsCovariance:
        size = len(self.names)
        known = (*MEASURABLE, *FIELD_TERMS, *MOVES)
        unknown = [name for name in self.names if name not in known]
        if unknown:
            raise ValueError(f"names has {unknown[0]}, which is none of {', '.join(known)}")
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise ValueError(f"matrix needs {size} rows of {size} numbers, one for each of names")
        for i, row in enumerate(self.matrix):
            for j in range(i):
                room = 1e-6 * math.sqrt(abs(row[i] * self.matrix[j][j]))
                if abs(row[j] - self.matrix[j][i]) > room:
                    raise ValueError(f"matrix is not symmetric in {self.names[i]}, {self.names[j]}")
            if row[i] < 0:
                raise ValueError(f"matrix gives {self.names[i]} a negative variance")
        return self
