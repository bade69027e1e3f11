"""Particles that diffuse while a movie is made: their paths, and where each frame saw them.

A picture is the average along the path during the exposure.  The path has parts, 32 or more in an
exposure e, each with the mean of its continuous path: during τ a free particle goes √(2Dτ) far, and
its mean lies halfway with the variance Dτ/6 of a bridge, so that the mean over the exposure is
exact however many parts there are.

Drawing the particle at every part would take long.  The parts are taken in groups of at least
eight, and each group is drawn as 2d points (d = 2 or 3) that have its mean and its covariance; what
remains is of third order in how far a group spreads, r, times the finest wave of the picture, k:
k = 2π NA/λ sideways and 4π n_s/λ in height, where light goes there and back.  There are as many
groups as keep k r below `FINE`, which leaves less than a thousandth of the sharp picture's peak: at
331 Hz and NA 1.42 a particle of 0.15 µm²/s is drawn 8 times for a frame, one of 0.8 µm²/s 32 times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config, SimulatedMover
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.scatterers import material
from iscat_analysis.records import FloatArray
from iscat_analysis.units import sphere_mass_kda

LEAST_PARTS = 32
"""Parts of a path in one exposure."""

PARTS_OF_GROUP = 8
"""Parts of a group at least, so that its covariance is its own."""


FINE = 0.2
"""Largest spread of a group in the picture's finest wave [rad]."""

_ROUNDING = 1e-9  # share by which an exposure may exceed the interval, a line be no line
_UM2 = 1e6  # nm²


@dataclass(frozen=True, eq=False)
class MovingParticle:
    """One particle and where it was; places are in the sample, which may drift itself."""

    first: int
    mass_kda: float
    d_um2_s: float
    points_nm: FloatArray
    mean_nm: FloatArray
    middle_nm: FloatArray
    turn: NDArray[np.int64]

    @property
    def still(self) -> bool:
        """Whether it does not move at all."""
        return bool((self.points_nm == self.mean_nm[0]).all())


def place_movers(
    config: Config, margin_px: float, generator: Callable[[int], np.random.Generator]
) -> tuple[MovingParticle, ...]:
    """Draw the paths of all particles that move."""
    if not config.simulation.movers:
        return ()
    clock = _clock(config)
    particles: list[MovingParticle] = []
    for kind in config.simulation.movers:
        rows, columns = config.simulation.shape
        around = (rows + 2 * margin_px) * (columns + 2 * margin_px)
        roams = kind.x_px is None and kind.confinement_nm is None
        total = kind.count if kind.x_px is not None else round(kind.count * around / rows / columns)
        for number in range(total):
            rng = generator(len(particles))
            start = _start(config, kind, margin_px, rng, inside=number < kind.count)
            particles.append(_move(config, kind, clock, start, margin_px if roams else None, rng))
    return tuple(particles)


def track_rows(
    movers: Sequence[MovingParticle],
    shape: tuple[int, int],
    pixel_nm: float,
    drift_px: FloatArray,
    contrasts: Mapping[tuple[float, float], float],
) -> Iterator[tuple[object, ...]]:
    """Tell the truth of particles that move, in every frame in which they are in the field.

    Shapes: `drift_px` (frames, 2).
    """
    rows, columns = shape
    track = -1
    for p in movers:
        turn = None
        level = bool(np.ptp(p.mean_nm[:, 2]) == 0)
        frames = p.first + np.arange(len(p.mean_nm))
        drift = drift_px[frames, ::-1]
        places = p.mean_nm[:, :2] / pixel_nm + drift
        seen = np.all((places >= -0.5) & (places < np.array([columns, rows]) - 0.5), axis=1)
        for i in np.flatnonzero(seen):
            track += p.turn[i] != turn
            turn = p.turn[i]
            (x, y), z = places[i], float(p.mean_nm[i, 2])
            middle = p.middle_nm[i, :2] + drift[i] * pixel_nm
            yield (
                int(frames[i]), int(frames[i]) + 1, x, y, x * pixel_nm, y * pixel_nm, z, p.mass_kda,
                contrasts.get((z, p.mass_kda)) if level else None, int(track), p.d_um2_s,
                *middle, p.middle_nm[i, 2],
            )  # fmt: skip


def _clock(config: Config) -> tuple[float, float]:
    """Give the interval between frames, and the exposure [s]."""
    camera = config.camera
    if camera.frame_rate_hz is None:
        raise ConfigError(
            "camera.frame_rate_hz is needed for simulation.movers: add it, as in "
            "camera.frame_rate_hz = 331.0"
        )
    interval = 1 / camera.frame_rate_hz
    exposure = interval if camera.exposure_ms is None else camera.exposure_ms / 1e3
    if exposure > interval * (1 + _ROUNDING):
        raise ConfigError(
            f"camera.exposure_ms = {camera.exposure_ms:g} is longer than the {1e3 * interval:g} ms "
            f"from frame to frame at camera.frame_rate_hz = {camera.frame_rate_hz:g}: correct one "
            "of them"
        )
    return interval, min(exposure, interval)


def _start(
    config: Config,
    kind: SimulatedMover,
    margin_px: float,
    rng: np.random.Generator,
    *,
    inside: bool,
) -> FloatArray:
    """Place a particle in the field, or around it [nm]."""
    pixel = config.camera.pixel_nm
    rows, columns = config.simulation.shape
    z = config.particle.nominal_height_nm if kind.z_nm is None else kind.z_nm
    if kind.z_nm is None and kind.ceiling_nm is not None:
        z = rng.uniform(0, kind.ceiling_nm)
    if kind.x_px is not None and kind.y_px is not None:
        return np.array([kind.x_px * pixel, kind.y_px * pixel, z])
    margin = 0.0 if inside else margin_px
    while True:
        x = rng.uniform(-0.5 - margin, columns - 0.5 + margin)
        y = rng.uniform(-0.5 - margin, rows - 0.5 + margin)
        if inside or not (-0.5 <= x < columns - 0.5 and -0.5 <= y < rows - 0.5):
            return np.array([x * pixel, y * pixel, z])


def _move(
    config: Config,
    kind: SimulatedMover,
    clock: tuple[float, float],
    start: FloatArray,
    roaming_px: float | None,
    rng: np.random.Generator,
) -> MovingParticle:
    """Draw one path; `roaming_px` is the margin beyond which another particle takes its place."""
    last = config.simulation.frames
    frames = (last if kind.leave is None else min(kind.leave, last)) - kind.frame
    axes = 3 if kind.space == "volume" else 2
    d, velocity = kind.d_um2_s * _UM2, np.array([*kind.drift_um_s, 0.0]) * 1e3
    moves = d > 0 or bool(velocity.any())
    interval_s, exposure_s = clock
    groups = _groups(config, kind, exposure_s)
    parts = max(LEAST_PARTS, PARTS_OF_GROUP * groups) if moves else 1
    part_s, dark_s = exposure_s / parts, interval_s - exposure_s
    path = np.zeros((frames, parts, 3))
    ends = np.zeros((frames, parts, 3))
    if moves:
        ways = rng.standard_normal((frames, parts, axes)) * math.sqrt(2 * d * part_s)
        gone = ways.copy()
        gone[1:, 0] += rng.standard_normal((frames, axes))[1:] * math.sqrt(2 * d * dark_s)
        ends[..., :axes] = np.cumsum(gone.reshape(-1, axes), axis=0).reshape(gone.shape)
        bridge = rng.standard_normal((frames, parts, axes)) * math.sqrt(d * part_s / 6)
        path[..., :axes] = ends[..., :axes] - ways / 2 + bridge
        elapsed = np.arange(frames)[:, None] * interval_s + part_s * np.arange(1, parts + 1)
        ends += elapsed[..., None] * velocity
        path += (elapsed - part_s / 2)[..., None] * velocity
    turn = np.zeros(frames, dtype=np.int64)
    for way in (path, ends):
        way += start
    corner = rng.uniform(size=2) if kind.x_px is None else np.full(2, 0.5)
    if kind.confinement_nm is not None:
        low = start[:2] - corner * kind.confinement_nm
        for way in (path, ends):
            way[..., :2] = low + _folded(way[..., :2] - low, kind.confinement_nm)
    if axes == 3:
        for way in (path, ends):
            way[..., 2] = _folded(way[..., 2], kind.ceiling_nm)
    points = _points(path, groups, axes, d * part_s / 3)
    if axes == 3:
        points[..., 2] = _folded(points[..., 2], kind.ceiling_nm)
    mean = path.mean(axis=1)
    middle = ends[:, parts // 2 - 1] if parts > 1 else ends[:, 0]
    if roaming_px is not None:
        turn, shift = _turned(config, mean, roaming_px)
        points, mean, middle = points + shift[:, None], mean + shift, middle + shift
    nominal = material(config.particle, config.optics.wavelength_nm)
    mass = nominal.mass_kda if kind.mass_kda is None else kind.mass_kda
    if kind.diameter_nm is not None:
        mass = sphere_mass_kda(kind.diameter_nm, nominal.density_kg_m3)
    return MovingParticle(kind.frame, mass, kind.d_um2_s, points, mean, middle, turn)


def _folded(values: FloatArray, side: float | None) -> FloatArray:
    """Reflect at 0 and, unless that is open, at `side`."""
    if side is None:
        return np.asarray(np.abs(values))
    return np.asarray(side - np.abs(np.mod(values, 2 * side) - side))


def _turned(
    config: Config, mean: FloatArray, margin_px: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Let what leaves the surroundings of the field on one side enter on the other."""
    pixel = config.camera.pixel_nm
    rows, columns = config.simulation.shape
    size = (np.array([columns, rows]) + 2 * margin_px) * pixel
    low = -(0.5 + margin_px) * pixel
    sheets = np.floor((mean[:, :2] - low) / size)
    crossed = np.any(np.diff(sheets, axis=0) != 0, axis=1)
    shift = np.zeros_like(mean)
    shift[:, :2] = -sheets * size
    return np.concatenate([[0], np.cumsum(crossed)]).astype(np.int64), shift


def _groups(config: Config, kind: SimulatedMover, e: float) -> int:
    """Count the groups of parts that are drawn apart; see the module."""
    optics = config.optics
    speed = 1e3 * math.hypot(*kind.drift_um_s)
    spread = math.sqrt(kind.d_um2_s * _UM2 * e / 3 + (speed * e) ** 2 / 12)
    wave = 2 * math.pi * optics.na / optics.wavelength_nm
    if kind.space == "volume":
        wave = 4 * math.pi * optics.n_sample / optics.wavelength_nm
    groups = 1
    # groups at most, of particles that cross the picture in one exposure
    while groups < 1024 and wave * spread / math.sqrt(groups) > FINE:
        groups *= 2
    return groups


def _points(path: FloatArray, groups: int, axes: int, within: float) -> FloatArray:
    """Give points with the mean and the covariance of each group: ± √axes times a root of it.

    `within` is the variance inside a part, along each axis.
    """
    frames, parts, _ = path.shape
    if parts == 1:
        return path.copy()
    grouped = path.reshape(frames, groups, parts // groups, 3)
    mean = grouped.mean(axis=2)
    off = (grouped - mean[:, :, None])[..., :axes]
    covariance = np.einsum("fgpa,fgpb->fgab", off, off) / off.shape[2]
    covariance += within * np.eye(axes)
    # A path that is a straight line has no covariance across it.
    whole = np.trace(covariance, axis1=-2, axis2=-1)[..., None, None]
    root = np.linalg.cholesky(covariance + _ROUNDING * np.maximum(whole, 1e-12) * np.eye(axes))
    offsets = np.zeros((frames, groups, axes, 3))
    offsets[..., :axes] = math.sqrt(axes) * np.swapaxes(root, -1, -2)
    both = np.concatenate([offsets, -offsets], axis=2) + mean[:, :, None]
    return np.asarray(both.reshape(frames, -1, 3))
