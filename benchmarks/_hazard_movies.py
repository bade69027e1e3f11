"""Landing movies in which something is wrong: particles, light, camera or file.

A movie is made of expected light, then photoelectrons, then counts, then what a program did to the
counts.  Every particle has one or several pictures and, for each frame, a weight for each of them:
a particle that wiggles has a picture for each of its places, one that lands slowly has one picture
with a weight that rises.  Pictures come from the quadrature of ``tests/instruments.py``, which
shares nothing with the package.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, shift

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from instruments import Instrument, Landings, Pictures, draw_landings
from uneven_movies import Optics, half_fields, in_a_cone

Array = NDArray[np.float64]

SHAPE, COUNT, APART_PX = (500, 96, 96), 16, 12.0
LARGE, MANY, LARGE_APART_PX = (700, 160, 160), 36, 14.0  # of which optics can be learned
PIXEL_NM, GAIN, LEVEL_E = 84.0, 4.0, 1e5
NOMINAL = Instrument(emission="reciprocal")

_REACH_NM = 1.5 * PIXEL_NM * max(LARGE[1:])


@cache
def nominal() -> Pictures:
    """Prepare the pictures of the expected microscope."""
    return Pictures(NOMINAL, _REACH_NM)


@dataclass(frozen=True)
class Place:
    """A particle that is to be drawn."""

    x_px: float
    y_px: float
    mass_kda: float
    field_px: tuple[int, int]

    def away(self, x_nm: float = 0.0, y_nm: float = 0.0) -> tuple[Array, Array]:
        """Camera minus particle coordinates, the particle moved by so much."""
        rows, columns = self.field_px
        x = np.arange(columns) * PIXEL_NM - self.x_px * PIXEL_NM - x_nm
        y = np.arange(rows) * PIXEL_NM - self.y_px * PIXEL_NM - y_nm
        return x[None, :], y[:, None]


Draw = Callable[[Place, np.random.Generator], Array]
"""Gives the pictures of a particle, (pictures, y, x)."""

Course = Callable[[int, np.random.Generator], Array]
"""Gives the weights of the pictures from the frame of the landing on, (frames, pictures)."""

Record = Callable[[Array], Array]
"""Gives counts for photoelectrons."""


@dataclass(frozen=True)
class Case:
    """One movie, how it is analysed, and what is in it.

    Attributes
    ----------
    others : Landings, optional
        What lands as well, and is not compared.
    """

    counts: Any
    truth: Landings
    settings: Mapping[str, Any] = field(default_factory=dict)
    others: Landings | None = None


def landings(
    seed: int, masses: tuple[float, ...] = (92.0, 205.0, 430.0), *, large: bool = False
) -> Landings:
    """Draw particles of the small field, or of the large one."""
    if large:
        return draw_landings(LARGE, MANY, seed=seed, masses=masses, apart_px=LARGE_APART_PX)
    return draw_landings(SHAPE, COUNT, seed=seed, masses=masses, apart_px=APART_PX)


def alike() -> Draw:
    """Draw particles as they should be."""
    pictures = nominal()
    return lambda place, _: pictures.contrast(*place.away(), place.mass_kda)[None]


def of_optics(optics: Optics, illumination_na: float = 0.0) -> Draw:
    """Draw every particle through the microscope of its place."""
    middle = nominal()

    def draw(place: Place, rng: np.random.Generator) -> Array:
        del rng
        x, y = half_fields(place.field_px, np.array(place.x_px), np.array(place.y_px))
        local, reference = optics(NOMINAL, float(x), float(y))
        picture = middle if local == NOMINAL else Pictures(local, _REACH_NM)
        mass = place.mass_kda * middle.per_kda / picture.per_kda / reference
        return in_a_cone(picture, local, *place.away(), mass, illumination_na)[None]

    return draw


def of_foci(*foci_nm: float) -> Draw:
    """Draw a particle at several foci."""
    every = [Pictures(replace(NOMINAL, focus_nm=focus), _REACH_NM) for focus in foci_nm]
    per_kda = nominal().per_kda

    def draw(place: Place, rng: np.random.Generator) -> Array:
        del rng
        return np.array(
            [p.contrast(*place.away(), place.mass_kda * per_kda / p.per_kda) for p in every]
        )

    return draw


def of_heights(low_nm: float, high_nm: float) -> Draw:
    """Draw particles that are anywhere between two heights."""
    pictures = nominal()

    def draw(place: Place, rng: np.random.Generator) -> Array:
        at = pictures.at_height(rng.uniform(low_nm, high_nm))
        return at.contrast(*place.away(), place.mass_kda)[None]

    return draw


def of_halves(apart_nm: float) -> Draw:
    """Draw particles of two halves, which lie in any direction."""
    pictures = nominal()

    def draw(place: Place, rng: np.random.Generator) -> Array:
        angle = rng.uniform(0, 2 * np.pi)
        x, y = apart_nm / 2 * np.cos(angle), apart_nm / 2 * np.sin(angle)
        halves = [place.away(x, y), place.away(-x, -y)]
        return sum(pictures.contrast(*at, place.mass_kda / 2) for at in halves)[None]

    return draw


def of_places(offsets_nm: Array) -> Draw:
    """Draw a particle at each of some places around its own.

    Shapes: `offsets_nm` (places, 2).
    """
    pictures = nominal()
    return lambda place, _: np.array(
        [pictures.contrast(*place.away(*at), place.mass_kda) for at in offsets_nm.tolist()]
    )


def box(rms_nm: float, side: int = 5) -> Array:
    """Give places in a square box, whose deviation along each axis is given."""
    along = np.linspace(-1, 1, side)
    along *= rms_nm / along.std()
    return np.array(np.meshgrid(along, along)).reshape(2, -1).T


def vesicle(place: Place, diameter_nm: float, rng: np.random.Generator) -> Array:
    """Draw a shell of many dipoles that touches the glass."""
    pictures, count = nominal(), 24
    z = np.linspace(-1 + 1 / count, 1 - 1 / count, count)
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count) + rng.uniform(0, 2 * np.pi)
    x, y = np.sqrt(1 - z**2) * np.array([np.cos(turn), np.sin(turn)]) * diameter_nm / 2
    height = (z + 1) * diameter_nm / 2
    return sum(
        pictures.at_height(h).contrast(*place.away(a, b), place.mass_kda / count)
        for h, a, b in zip(height.tolist(), x.tolist(), y.tolist(), strict=True)
    )


def at_once(frames: int, rng: np.random.Generator) -> Array:
    """Land from one frame to the next, and stay."""
    del rng
    return np.ones((frames, 1))


def rising(over: float) -> Course:
    """Rise along a line over so many frames."""
    return lambda frames, _: np.minimum((np.arange(frames) + 1) / max(over, 1.0), 1.0)[:, None]


def breathing(relative: float, correlation: float = 20.0) -> Course:
    """Let contrasts fluctuate with a memory of so many frames."""

    def course(frames: int, rng: np.random.Generator) -> Array:
        kept = np.exp(-1 / correlation)
        noise = rng.standard_normal(frames)
        out = np.empty(frames)
        out[0] = noise[0]
        for t in range(1, frames):
            out[t] = kept * out[t - 1] + np.sqrt(1 - kept**2) * noise[t]
        return (1 + relative * out)[:, None]

    return course


def anywhere(places: int, samples: int) -> Course:
    """Be at so many places, each drawn at random, in every frame."""

    def course(frames: int, rng: np.random.Generator) -> Array:
        return rng.multinomial(samples, np.full(places, 1 / places), frames) / samples

    return course


def camera(gain: float = GAIN) -> Record:
    """Count as a camera should."""
    return lambda electrons: electrons / gain


def speckle(rng: np.random.Generator, relative: float, shape: tuple[int, int]) -> Array:
    """Draw a pattern of mean 1."""
    rough = gaussian_filter(rng.standard_normal(shape), 3.0, mode="wrap")
    return 1 + relative * rough / rough.std()


def film(
    truth: Landings,
    draw: Draw,
    seed: int,
    *,
    shape: tuple[int, int, int] = SHAPE,
    course: Course = at_once,
    by_frame: Callable[[int], Array] | None = None,
    record: Record | None = None,
    pattern: float = 0.05,
    second: float = 0.0,
    moved_px: float = 0.0,
    drift_px: float = 0.0,
    power_noise: float = 0.01,
    others: Landings | None = None,
    draw_others: Draw | None = None,
) -> Array:
    """Record a movie as numbers that are not yet rounded.

    Parameters
    ----------
    by_frame : callable, optional
        In place of `course`: the weights of pictures in a frame of the movie.
    pattern, second : float
        Deviations of two patterns of light, the second of which moves.
    moved_px, drift_px : float
        How far the second pattern moves, and all, within the movie.
    """
    rng = np.random.default_rng(seed)
    frames, rows, columns = shape
    particles = [(truth, draw)]
    if others is not None and draw_others is not None:
        particles.append((others, draw_others))
    seen = []
    for which, how in particles:
        for t, x, y, mass in zip(
            which.frame.tolist(), which.x_px, which.y_px, which.mass_kda, strict=True
        ):
            pictures = how(Place(float(x), float(y), float(mass), (rows, columns)), rng)
            if by_frame is not None:
                weights = np.array([by_frame(n) for n in range(t, frames)])
            else:
                weights = course(frames - t, rng)
            seen.append((t, pictures, weights))
    margin = 8
    wide = (rows + 2 * margin, columns + 2 * margin)
    inner = (slice(margin, -margin), slice(margin, -margin))
    still, mobile = speckle(rng, pattern, wide), speckle(rng, second, wide)
    counts = np.empty(shape)
    for t in range(frames):
        part = t / frames
        light = still * (shift(mobile, (0.0, moved_px * part), mode="nearest") if moved_px else 1)
        light = LEVEL_E * light[inner]
        for first, pictures, weights in seen:
            if t >= first:
                light = light * (1 + np.einsum("j,jyx->yx", weights[t - first], pictures))
        if drift_px:
            light = shift(light, (drift_px * part / 2, drift_px * part), mode="nearest")
        light = light * (1 + power_noise * rng.standard_normal())
        electrons = light + np.sqrt(light) * rng.standard_normal((rows, columns))
        counts[t] = (record or camera())(electrons)
    return counts


def stored(counts: Array, bits: int = 16) -> NDArray[Any]:
    """Round counts to what a file has."""
    kind = np.uint8 if bits == 8 else np.uint16
    return np.clip(np.rint(counts), 0, 2**bits - 1).astype(kind)


def aligned(counts: Array, drift_px: float) -> Array:
    """Undo a drift by bilinear interpolation."""
    frames, rows, columns = counts.shape
    out = np.empty(counts.shape)
    for t in range(frames):
        part = drift_px * t / frames
        out[t] = shift(counts[t], (-part / 2, -part), order=1, mode="nearest")
    edge = int(np.ceil(drift_px)) + 1
    return out[:, : rows - edge, : columns - edge]
