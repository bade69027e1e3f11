"""Constants that turn the profile of a particle into its signal: three kinds, each with its type.

A kernel tests the length of its lens.  Numba knows this length from the type and does not compile
the branches of other kinds.  A movie has one kind of image, and the branches of the others would
take half of the time of a first run.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TypeAlias

from iscat_analysis._kernels import FloatArray, kernel


class RoundLens(NamedTuple):
    """Lens of a round pupil, whose fields are radial profiles."""

    inv_step: float
    rho: float
    cos_psi: float
    sin_psi: float
    co: float
    cross: float
    ring: float


class LatticeLens(NamedTuple):
    """Lens of any pupil, whose fields are on a lattice.

    The first component interferes with the reference; the light of the others is added to it.
    """

    inv_step: float
    rho: float
    half: int
    components: int
    window: FloatArray


class StampLens(NamedTuple):
    """Lens of any pupil at one height, whose image was sampled."""

    inv_step: float
    half: int
    window: FloatArray
    fine: int


class Pixels(NamedTuple):
    """A grid of pixels and the samples inside each."""

    x: FloatArray
    y: FloatArray
    offsets: FloatArray
    weights: FloatArray


Lens: TypeAlias = RoundLens | LatticeLens | StampLens

ROUND: Final = 7
"""Number of fields of a round lens."""

LATTICE: Final = 5
"""Number of fields of the lens of a lattice."""

STAMP: Final = 4
"""Number of fields of the lens of a sampled image."""


@kernel()
def named_lens(fields: tuple[Any, ...]) -> Lens:
    """Make a lens from its fields.

    Python passes a plain tuple to a kernel in half of the time of a named tuple.
    """
    if len(fields) == ROUND:
        return RoundLens(*fields)
    if len(fields) == LATTICE:
        return LatticeLens(*fields)
    return StampLens(*fields)
