"""Particles of a simulated movie that stand still: where and when they land, and how heavy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from iscat_analysis.config import Config, Particle
from iscat_analysis.optics.materials import material


@dataclass(frozen=True)
class SimulatedParticle:
    """One simulated particle: where, when, how heavy; its place is that in the frame it lands."""

    frame: int
    leave: int | None
    x_px: float
    y_px: float
    z_nm: float
    mass_kda: float


def place_particles(config: Config, rng: np.random.Generator) -> tuple[SimulatedParticle, ...]:
    """Place the particles that stand still: those that are listed, or so many anywhere."""
    simulation, particle = config.simulation, config.particle
    pixel_nm = float(config.camera.pixel_size_nm or math.nan)
    nominal = material(particle, config.optics.wavelength_nm).mass_kda
    if simulation.count is None:
        return tuple(
            SimulatedParticle(
                e.frame, e.leave, e.x_px, e.y_px,
                _height_nm(particle, e.mass_kda or nominal, rng) if e.z_nm is None else e.z_nm,
                nominal if e.mass_kda is None else e.mass_kda,
            )
            for e in sorted(simulation.events, key=lambda e: e.frame)
        )  # fmt: skip
    margin = min(config.fit.roi_nm / 2 / pixel_nm, (min(simulation.shape) - 1) / 2)
    rows, columns = simulation.shape
    count = simulation.count
    x = rng.uniform(margin, columns - 1 - margin, count)
    y = rng.uniform(margin, rows - 1 - margin, count)
    first = config.background.recorded
    start = first[1] if first is not None else simulation.frames // 20
    landing = np.sort(rng.integers(start, max(simulation.frames - start // 2, start + 1), count))
    species = np.array(simulation.species or (nominal,))
    mass = rng.permutation(species[np.arange(count) % species.size])
    leavers = set(rng.choice(count, simulation.leavings, replace=False).tolist())
    particles = []
    for i in range(count):
        latest = simulation.frames - 1
        leaves = i in leavers and landing[i] + 1 <= latest
        leave = int(rng.integers(landing[i] + 1, latest + 1)) if leaves else None
        particles.append(
            SimulatedParticle(
                int(landing[i]), leave, float(x[i]), float(y[i]),
                _height_nm(particle, float(mass[i]), rng), float(mass[i]),
            )
        )  # fmt: skip
    return tuple(particles)


def _height_nm(particle: Particle, mass_kda: float, rng: np.random.Generator) -> float:
    """Give a particle's height: as expected, or drawn around that until it is above the glass."""
    mean, sd = particle.mean_height_nm(mass_kda), particle.height_sd_nm
    if not sd:
        return mean
    height = -1.0
    while height < 0:
        height = float(rng.normal(mean, sd))
    return height
