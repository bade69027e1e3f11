"""The picture of one particle, and what makes such pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from iscat_analysis.inference.noise_models import NoiseModel
from iscat_analysis.optics.field_map import DRIFT, WEIGHTS, Spot, changes_at
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.records import BoolArray, FloatArray

FOCUS_STEP = "focus_step_nm"
"""Rise of the focus from picture to picture of a scan [nm]; the one parameter that is not a key of
``[optics]``."""

FOCUS_DRIFT = DRIFT
"""Rise of the focus in 1000 frames of a movie [nm]."""

RISES = (FOCUS_STEP, FOCUS_DRIFT)
"""What moves the focus from one picture to another, and is no property of the microscope."""

FIELD = tuple(name for name in WEIGHTS if name != DRIFT and not name.startswith("reference_"))
"""What differs over the field, and shows in the shape of pictures: of the reference's amplitude,
which shows in their size alone, the pictures of particles of unknown mass say nothing."""

PRIVATE = 5
"""Unknowns of one sight, as `Likelihood` has them: x, y, z [nm], mass [kDa], logarithm of the
background level."""

ROAM_NM = 300.0
"""Farthest from the centre of a picture that its particle may be, along x and y."""


class Microscope(Protocol):
    """What the estimator asks of a forward model."""

    def image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> FloatArray:
        """Signal of one particle."""

    def gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> tuple[FloatArray, FloatArray]:
        """Signal, and its derivatives with respect to x, y, z and mass."""

    def joint_gradient(
        self,
        grid: PixelGrid,
        x_nm: float,
        y_nm: float,
        z_nm: float,
        mass_kda: float,
        names: Sequence[str],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal, and its derivatives with respect to the particle and the named optics."""


Settings = Mapping[str, Any]
"""Values of ``[optics]`` by key, each aberration under its own name (``z5``…)."""

Build = Callable[[Settings], Microscope]
"""Makes the microscope of some settings."""


@dataclass(frozen=True)
class ParticleImage:
    """The picture of one particle: counts of a region, and where the search begins."""

    grid: PixelGrid
    noise: NoiseModel
    data: FloatArray
    x_nm: float
    y_nm: float
    z_nm: float
    mass_kda: float = 0.0
    level: float = 0.0
    focus_steps: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)
    frames: tuple[float, float] = (0.0, 0.0)
    snr: float = 0.0
    neighbours: tuple[tuple[int, float], ...] = ()
    rings: FloatArray | float = 1.0
    baseline: float = 0.0
    owner: int = -1
    heights_nm: tuple[float, float] | None = None

    @property
    def private(self) -> FloatArray:
        """Start of the sight's own unknowns, shape (5,)."""
        return np.array([self.x_nm, self.y_nm, self.z_nm, self.mass_kda, self.level])

    @property
    def free(self) -> BoolArray:
        """Which of its own unknowns are, shape (5,)."""
        return np.array([True, True, self.heights_nm is not None, True, True])

    @property
    def spot(self) -> Spot:
        """Where in the field and when the picture was taken."""
        return Spot(*self.place, self.focus_steps)

    def slopes(self, name: str) -> Mapping[str, float]:
        """Give by how much a shared parameter changes those of this picture's optics."""
        if name == FOCUS_STEP:
            return {"focus_nm": self.focus_steps}
        return WEIGHTS[name](self.spot) if name in WEIGHTS else {name: 1.0}

    def among(self, contrast: FloatArray) -> ParticleImage:
        """Return the sight with the contrast of its neighbours in its expectation."""
        rings = 1 + contrast
        data = self.noise.multiplied(self.data, rings / self.rings)
        bare = self.noise.multiplied(data, 1 / rings)
        baseline = self.noise.reference_change(data, bare)
        return replace(self, data=data, rings=rings, baseline=baseline)

    def seen_with(self, settings: Settings) -> dict[str, Any]:
        """Return the optics of this picture, as keys of ``[optics]``."""
        own = {k: v for k, v in settings.items() if k not in WEIGHTS and k != FOCUS_STEP}
        own["focus_nm"] += self.focus_steps * settings.get(FOCUS_STEP, 0.0)
        for base, change in changes_at(settings, self.spot).items():
            own[base] = own.get(base, 0.0) + change
        return own

    def moved(self, private: FloatArray) -> ParticleImage:
        """Return the same pictures with another start."""
        x, y, z, mass, level = (float(v) for v in private)
        return replace(self, x_nm=x, y_nm=y, z_nm=z, mass_kda=mass, level=level)

    def placed(self, x_nm: float, y_nm: float) -> ParticleImage:
        """Return the same picture with another place, or the nearest where it may be."""
        (low, high), (left, right) = (
            (float(np.mean(axis)) - ROAM_NM, float(np.mean(axis)) + ROAM_NM)
            for axis in (self.grid.y_nm, self.grid.x_nm)
        )
        x, y = min(max(x_nm, left), right), min(max(y_nm, low), high)
        return replace(self, x_nm=x, y_nm=y)

    def raised(self, shift_nm: float) -> ParticleImage:
        """Return the same picture with another height, or the nearest that is possible."""
        low, high = self.heights_nm or (self.z_nm, self.z_nm)
        return replace(self, z_nm=min(max(self.z_nm + shift_nm, low), high))
