"""Keywords of functions of arrays, each declared once; the docstrings explain them."""

# Annotations are evaluated: the declarations in them are read when the program runs.

from typing import Annotated, TypedDict

from numpy.typing import ArrayLike

from iscat_analysis.config import Calibration

Array = Annotated["ArrayLike | None", "Optional."]
Frames = Annotated[int | None, "Optional."]
Line = Annotated["Calibration | None", "Optional."]
Mode = Annotated[str, "Which parameters are free.", "", "mass"]
Place = Annotated["ArrayLike", "From the centre [nm].", "", 0.0]


class LightOptions(TypedDict, total=False):
    """Light of the frames before and after, and pixels to leave out."""

    n_before: Frames
    n_after: Frames
    power_ratio: Array
    level: Annotated[bool | None, "Optional."]
    masked: Array


class ImageOptions(LightOptions, total=False):
    """Counts or contrast images of many regions."""

    contrast: Array
    sigma: Array
    saturated: Array


class ModelOptions(TypedDict, total=False):
    """Which parameters of a particle are free, and its scale."""

    mode: Mode
    z_range_nm: Annotated[tuple[float, float], "Heights [nm].", "", (0.0, 1000.0)]
    calibration: Line


class LikelihoodOptions(LightOptions, ModelOptions, total=False):
    """The likelihood of one region."""


class FitOptions(ImageOptions, ModelOptions, total=False):
    """Fits of many regions."""

    corners_px: Array
    workers: Annotated[int, "Number of threads.", "", 1]


class ParticleOptions(TypedDict, total=False):
    """A particle, and its scale."""

    z_nm: Array
    mass_kda: Array
    calibration: Line


class SquareOptions(ParticleOptions, total=False):
    """A square image of a particle."""

    pixels: Annotated[int, "Side of the image.", "", 33]
    x_nm: Place
    y_nm: Place


class QuantumOptions(ParticleOptions, total=False):
    """A measurement of a particle."""

    n_after: Annotated["ArrayLike", "Frames with the particle.", "", 1]
    mode: Mode
    focus_nm: Array


class BoundOptions(SquareOptions, QuantumOptions, total=False):
    """A measurement with a camera."""

    n_before: Annotated["ArrayLike", "Frames of background.", "", 0]
