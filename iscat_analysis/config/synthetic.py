"""Sections of simulations and bounds: a simulated movie, and the set-up of bounds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveInt

from iscat_analysis.config.values import (
    LARGEST_NM,
    Diameter,
    Finite,
    Height,
    NonNegative,
    Positive,
    Section,
    length,
)

_MOST_POSITIONS = 100_000_000
Side = Annotated[int, Field(ge=8, le=16_384)]
Probability = Annotated[float, Field(gt=0, lt=0.5)]


def _too_early(frame: int, leave: int | None) -> Iterator[str]:
    if leave is not None and leave <= frame:
        yield f"leave = {leave} must come after frame = {frame}"


class SimulatedEvent(Section):
    """One particle that lands, and may leave."""

    frame: NonNegativeInt
    """first frame with the particle"""
    leave: PositiveInt | None = None
    """first frame without it again"""
    x_px: Finite
    """column; integer = pixel centre; with drift, that of its first frame"""
    y_px: Finite
    """row, downwards"""
    z_nm: NonNegative | None = None
    """default particle.height_nm"""
    mass_kda: Positive | None = None
    """default particle.mass_kda"""

    def _refusals(self) -> Iterator[str]:
        return _too_early(self.frame, self.leave)


class SimulatedMover(Section):
    """Particles of one kind that diffuse."""

    count: Annotated[int, Field(ge=1, le=100_000)] = 1
    """in the field in the first frame; as many enter as leave later"""
    d_um2_s: NonNegative
    """diffusion coefficient along each axis, µm²/s"""
    mass_kda: Positive | None = None
    """default particle.mass_kda"""
    diameter_nm: Diameter | None = None
    """in place of mass_kda, of the material of [particle]"""
    space: Literal["membrane", "volume"] = "membrane"
    """ "membrane": z is fixed | "volume": above a wall at z = 0"""
    z_nm: Height | None = None
    """at first; default particle.height_nm, with a ceiling random below it"""
    ceiling_nm: Annotated[Positive, length(0.0, LARGEST_NM)] | None = None
    """volume: height of a second wall that reflects"""
    drift_um_s: tuple[Finite, Finite] = (0.0, 0.0)
    """velocity along x and y, µm/s"""
    confinement_nm: Annotated[Positive, length(1.0, LARGEST_NM)] | None = None
    """side of a square whose walls reflect, one for each particle"""
    frame: NonNegativeInt = 0
    """first frame with the particles"""
    leave: PositiveInt | None = None
    """first frame without them again"""
    x_px: Finite | None = None
    """column at first, of a single particle; absent: random"""
    y_px: Finite | None = None
    """row at first, downwards"""

    def _refusals(self) -> Iterator[str]:
        if self.mass_kda is not None and self.diameter_nm is not None:
            yield "give mass_kda or diameter_nm, not both"
        yield from _too_early(self.frame, self.leave)
        if (self.x_px is None) != (self.y_px is None):
            yield "give x_px and y_px, or neither"
        if self.x_px is not None and self.count != 1:
            yield (
                f"count = {self.count} particles cannot all begin at x_px, y_px: leave the "
                "position out, or give each particle its own block"
            )
        if self.ceiling_nm is not None and self.space == "membrane":
            yield 'ceiling_nm needs space = "volume"'
        if self.ceiling_nm is not None and (self.z_nm or 0.0) > self.ceiling_nm:
            yield f"z_nm = {self.z_nm:g} lies above ceiling_nm = {self.ceiling_nm:g}"


SIMULATED: dict[str, type[Section]] = {"events": SimulatedEvent, "movers": SimulatedMover}
"""Tables of [simulation] that may be there many times, each describing particles."""


class Simulation(Section):
    """A synthetic movie with known truth."""

    shape: tuple[Side, Side] = (128, 128)
    """rows, columns"""
    # Longest simulated movie; particles that move have positions in all of its frames
    frames: Annotated[int, Field(ge=2, le=10_000_000)] = 400
    """frames in the movie"""
    photons_per_pixel: Positive = 1e4
    """background photoelectrons per pixel and frame; dark field: scattered photons collected per
    frame from a particle of particle.mass_kda"""
    background: str = "flat"
    """ "flat" | "speckle" | path of a TIFF"""
    speckle_contrast: NonNegative = 0.1
    """standard deviation over mean"""
    power_noise: NonNegative = 0.0
    """relative laser-power noise, frame to frame"""
    drift_px_per_frame: tuple[Finite, Finite] = (0.0, 0.0)
    """of background and particles together, along x and y"""
    seed: NonNegativeInt = 1
    """same seed, same bytes"""
    events: tuple[SimulatedEvent, ...] = ()
    """each particle, placed by hand"""
    movers: tuple[SimulatedMover, ...] = ()
    """particles that diffuse, by kind"""
    count: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    """landings at random positions and times, instead of events; 0: a blank"""
    leavings: NonNegativeInt = 0
    """how many of the count leave before the movie ends"""
    species: tuple[Positive, ...] | None = None
    """masses [kDa] of the random particles, in equal shares"""

    def _refusals(self) -> Iterator[str]:
        if self.events and self.count is not None:
            yield "give events or count, not both"
        if self.leavings and (self.count is None or self.leavings > self.count):
            yield f"leavings = {self.leavings} needs a count at least as large"
        moving = sum(mover.count for mover in self.movers)
        if moving * self.frames > _MOST_POSITIONS:
            yield (
                f"{moving} movers in frames = {self.frames} have {moving * self.frames} positions, "
                f"more than {_MOST_POSITIONS}: simulate fewer, or a shorter movie"
            )
        rows, columns = self.shape
        particles: list[tuple[str, SimulatedEvent | SimulatedMover]] = [
            *((f"events[{k}]", one) for k, one in enumerate(self.events)),
            *((f"movers[{k}]", one) for k, one in enumerate(self.movers)),
        ]
        for name, one in particles:
            x, y = one.x_px or 0.0, one.y_px or 0.0
            if not (-0.5 <= y < rows - 0.5 and -0.5 <= x < columns - 0.5):
                yield (
                    f"{name} at x_px = {x}, y_px = {y} lies outside the field of {columns} x "
                    f"{rows} pixels"
                )
            if one.frame >= self.frames:
                yield (
                    f"{name} appears at frame {one.frame}, after the {self.frames} frames of the "
                    "movie"
                )


class BoundsConfig(Section):
    """`iscat bounds`: one particle on a square field of pixel centres (i − (n−1)/2)·pixel size."""

    pixels: Annotated[int, Field(ge=2, le=4096)] = 151
    """side of the field"""
    x_nm: Finite = 0.0
    """particle, from the centre of the field"""
    y_nm: Finite = 0.0
    """particle, from the centre of the field"""
    z_nm: NonNegative | None = None
    """default particle.height_nm"""
    photons_per_pixel: Positive = 1e4
    """background per frame; dark field: as in [simulation]"""
    n_before: NonNegativeInt = 200
    """0: known background"""
    n_after: PositiveInt = 200
    """frames with the particle"""
    false_alarm_probability: Probability = 1e-3
    """for the smallest detected mass: that noise is taken for a particle"""
    miss_probability: Probability = 0.05
    """for the smallest detected mass: that the particle is not found"""
