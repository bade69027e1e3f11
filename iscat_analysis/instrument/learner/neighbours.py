"""Pictures of particles among the rings of the others that bound at the same time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis.instrument.learner.estimate import maximise
from iscat_analysis.instrument.learner.particle_images import (
    Build,
    Microscope,
    ParticleImage,
    Settings,
)
from iscat_analysis.instrument.learner.starts import with_masses
from iscat_analysis.records import FloatArray, Mapper

_PASSES = 6


@dataclass(frozen=True)
class Neighbours:
    """Particles with the rings that they make in one microscope."""

    particles: tuple[ParticleImage, ...]
    wide: Microscope

    @classmethod
    def fitted(
        cls,
        others: Sequence[ParticleImage],
        build: Build,
        build_wide: Build,
        settings: Settings,
        mapper: Mapper = map,
    ) -> Neighbours:
        """Fit them, and once more among each other's rings."""

        def own(sights: Sequence[ParticleImage]) -> tuple[ParticleImage, ...]:
            return maximise(sights, build, settings, (), passes=_PASSES, mapper=mapper).sights

        first = cls(own(with_masses(others, build, settings)), build_wide(settings))
        return cls(own(first.around(first.particles, mapper)), first.wide)

    def around(
        self, sights: Sequence[ParticleImage], mapper: Mapper = map
    ) -> tuple[ParticleImage, ...]:
        """Put their rings into what is expected of pictures.

        Every particle is drawn into all pictures at once: its field at its height takes longest.
        """
        reached: list[list[tuple[int, float]]] = [[] for _ in self.particles]
        for index, sight in enumerate(sights):
            for number, share in sight.neighbours:
                reached[number].append((index, share))

        def drawn(number: int) -> list[tuple[int, FloatArray]]:
            other = self.particles[number]
            place = (other.x_nm, other.y_nm, other.z_nm, other.mass_kda)
            return [
                (index, share * self.wide.image(sights[index].grid, *place))
                for index, share in reached[number]
            ]

        rings = [np.zeros(sight.grid.shape) for sight in sights]
        for images in mapper(drawn, range(len(self.particles))):
            for index, image in images:
                rings[index] += image
        return tuple(sight.among(ring) for sight, ring in zip(sights, rings, strict=True))
