"""The camera: counts become photoelectrons, and counts that no camera produces are refused.

A camera of gain g [e/count], offset o [counts] and read noise σ_r [e] turns N photoelectrons into
c = o + (N + σ_r·n)/g counts, n standard normal.  `Camera` undoes it.

A sample of the pixels of a large field, by which its noise is judged.

Small squares, one at random in each part of the field, are put side by side as frames of a small
movie.  What is measured on it has the error of a movie of that size, which is small enough: the
squares scatter by more where the field is not alike everywhere, and that scatter is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile
from numpy.typing import DTypeLike, NDArray

from iscat_analysis.config import ASSUMED, CameraConfig
from iscat_analysis.errors import DataError
from iscat_analysis.movie import WHAT_LIBRARIES_RAISE, ChangedFrames, bytes_are_swapped
from iscat_analysis.reading import is_file
from iscat_analysis.records import BoolArray, CountSource, FloatArray, PlacedSource
from iscat_analysis.units import count

if TYPE_CHECKING:
    from iscat_analysis.camera.transfer import Law

_RATIO_TOLERANCE = 0.1  # of a mean of 1; a power that was not divided out is within it
_OVERFLOW_JUMP = 0.75  # of the largest number, from one frame to the next


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera; `camera_from_config` makes it."""

    gain_e_per_adu: float | FloatArray = 1.0
    offset_adu: float | FloatArray = 0.0
    read_noise_e: float | FloatArray = 0.0
    well_depth_e: float | None = None
    full_scale_adu: float | None = None
    law: Law | None = None  # that the movie's counts follow, where it was looked for

    def to_electrons(self, counts: NDArray[Any]) -> FloatArray:
        """Convert counts to photoelectrons.

        Shapes: `counts` (..., y, x), result (..., y, x).
        """
        electrons = np.array(counts, dtype=np.float64)
        electrons -= self.offset_adu
        electrons *= self.gain_e_per_adu
        return electrons

    def to_counts(self, electrons: NDArray[Any]) -> FloatArray:
        """Convert photoelectrons to counts, the inverse of `to_electrons`.

        Shapes: `electrons` (..., y, x), result (..., y, x).
        """
        counts = np.array(electrons, dtype=np.float64)
        counts /= self.gain_e_per_adu
        counts += self.offset_adu
        return counts

    def saturated(self, counts: NDArray[Any]) -> BoolArray:
        """Find the pixels that were too bright to be measured.

        Shapes: `counts` (..., y, x), result (..., y, x).
        """
        full: BoolArray = np.zeros(counts.shape, dtype=np.bool_)
        top = counts.max(initial=0)  # which tells what need not be asked of every pixel
        ceiling = converter_ceiling(counts)
        if not top < ceiling:
            full |= counts >= ceiling
        if self.full_scale_adu is not None and not top < self.full_scale_adu:
            full |= counts >= self.full_scale_adu
        if self.well_depth_e is not None:
            most = (float(top) - np.asarray(self.offset_adu)) * self.gain_e_per_adu
            if not np.all(most < self.well_depth_e):
                full |= self.to_electrons(counts) >= self.well_depth_e
        return full

    def steady(self, counts: NDArray[Any]) -> FloatArray | None:
        """Give photoelectrons of frames as if all had one power; None of the dark.

        Shapes: `counts` and result (t, ...).
        """
        electrons = self.to_electrons(counts)
        power = electrons.mean(axis=tuple(range(1, counts.ndim)))
        if power.min(initial=math.inf) <= 0:
            return None
        electrons /= (power / power.mean()).reshape(-1, *[1] * (counts.ndim - 1))
        return electrons

    def usable(self, counts: NDArray[Any], masked: BoolArray | None) -> BoolArray:
        """Find the pixels that no frame has saturated, and that are not masked.

        Shapes: `counts` (t, y, x), `masked` and result (y, x).
        """
        used = ~self.saturated(counts.max(axis=0))
        return used if masked is None else used & ~masked

    def without_light(self, movie: CountSource) -> NDArray[Any]:
        """Give the counts that a movie's pixels have in the dark.

        Shapes: result (y, x).
        """
        return np.broadcast_to(np.floor(self.offset_adu), movie.shape[1:]).astype(movie.dtype)

    def part(self, here: tuple[Any, ...]) -> Camera:
        """Give the camera of some pixels."""
        return self.mapped(lambda image: image[here])

    def mapped(self, cut: Callable[[FloatArray], FloatArray]) -> Camera:
        """Give the camera of pixels that are cut out of its maps."""
        gain, offset, read = (
            cut(value) if isinstance(value, np.ndarray) else value
            for value in (self.gain_e_per_adu, self.offset_adu, self.read_noise_e)
        )
        return replace(self, gain_e_per_adu=gain, offset_adu=offset, read_noise_e=read)

    def read_variance_e2(self, shape: tuple[int, int]) -> FloatArray:
        """Variance of the read noise of one frame.

        Shapes: result (y, x).
        """
        return np.broadcast_to(np.square(self.read_noise_e, dtype=np.float64), shape).copy()

    def dark_variance_e2(self, counts: NDArray[Any]) -> FloatArray:
        """Variance of what is no light in one frame: read noise, and at least that of rounding.

        Shapes: `counts` (t, y, x), result (y, x).
        """
        rounding = rounding_variance_adu2(counts) * np.square(self.gain_e_per_adu)
        # whole photoelectrons that are counted one by one are not rounded
        rounding = np.maximum(rounding - 1 / 12, 0.0)
        read = self.read_variance_e2((counts.shape[1], counts.shape[2]))
        return np.maximum(read, rounding)


def full_scale_of(dtype: DTypeLike) -> float | None:
    """Give the largest number that a type of integers has; None of floats."""
    stored = np.dtype(dtype)
    return float(np.iinfo(stored).max) if np.issubdtype(stored, np.integer) else None


def float_type(stored: np.dtype[Any]) -> np.dtype[Any]:
    """Type of what is computed from counts: single precision where these have 16 bits or fewer."""
    return np.dtype(np.float32 if stored.itemsize <= 2 else np.float64)


def rounding_variance_adu2(counts: NDArray[Any]) -> float:
    """Variance that rounding adds to counts: d²/12, d the largest step that all are multiples of.

    Twelve bits that are stored as sixteen have steps of 16 counts.
    """
    return count_step(counts) ** 2 / 12


def count_step(counts: NDArray[Any]) -> int:
    """Give the largest number that all counts are multiples of; 0 of no integers.

    Shapes: `counts` (t, y, x).
    """
    if not np.issubdtype(counts.dtype, np.integer) or not counts.size:
        return 0
    return int(np.gcd.reduce(counts[0], axis=None))


def padded_bits(counts: NDArray[Any]) -> int:
    """Tell how many low bits of all counts are empty, as where 12 bits are stored as 16; 0: none.

    Shapes: `counts` (t, y, x).
    """
    step = count_step(counts)
    empty = (step & -step).bit_length() - 1 if step > 0 else 0
    return empty if 1 < empty < 8 * counts.dtype.itemsize - 1 else 0


def camera_from_config(config: CameraConfig, shape_yx: tuple[int, int], dtype: DTypeLike) -> Camera:
    """Build the camera that a configuration describes, reading its maps."""
    config = config.assumed
    gain, offset, read = (_number_or_map(getattr(config, key), key, shape_yx) for key in ASSUMED)
    return Camera(gain, offset, read, config.well_depth_e, full_scale_of(dtype))


def _number_or_map(value: float | str, key: str, shape_yx: tuple[int, int]) -> float | FloatArray:
    if not isinstance(value, str):
        return value
    values = read_map(Path(value), f"camera.{key}", shape_yx)
    where = f"{value}: camera.{key}"
    if key == "gain_e_per_adu" and (bad := values <= 0).any():
        raise DataError(f"{where} must be positive, but is not {_first(bad)}; repair the map")
    if key == "read_noise_e" and (bad := values < 0).any():
        raise DataError(f"{where} must not be negative, but is {_first(bad)}; repair the map")
    return values


def read_map(path: Path, key: str, shape_yx: tuple[int, int]) -> FloatArray:
    """Read an image with one number per pixel.

    Shapes: result (y, x).
    """
    where = f"{path}: {key}"
    if not is_file(path):
        raise DataError(f"{where} names a file that does not exist; check the path")
    try:
        with tifffile.TiffFile(path) as tiff:
            shape = tuple(n for n in tiff.series[0].shape if n != 1)
            # decoded only where it has the right size: a small file may claim any
            image = np.squeeze(tiff.series[0].asarray()) if shape == tuple(shape_yx) else None
    except WHAT_LIBRARIES_RAISE as error:
        raise DataError(f"{where} needs a TIFF map, but it cannot be read ({error})") from None
    if image is None or image.shape != tuple(shape_yx):
        shown = " x ".join(str(n) for n in shape) or "one number"
        raise DataError(
            f"{where} is a map of {shown} pixels but the movie has {shape_yx[0]} x {shape_yx[1]}; "
            "crop the map as the movie was cropped"
        )
    if image.dtype.kind not in "uif":
        raise DataError(f"{where} holds {image.dtype} values; save the map as real numbers")
    with np.errstate(all="ignore"):
        values: FloatArray = image.astype(np.float64)
    bad = ~np.isfinite(values)
    if bad.any():
        raise DataError(f"{where} is not finite {_first(bad)}; repair the map")
    return values


def _first(bad: BoolArray) -> str:
    """Say how many pixels are bad, and where the first one is."""
    y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)
    number = count(int(np.count_nonzero(bad)), "pixel")
    return f"in {number}, the first at y = {y}, x = {x}"


def check_counts(
    counts: NDArray[Any], first_frame: int, name: str, *, camera: Camera | None = None
) -> None:
    """Refuse frames that no working camera produces.

    A few pixels below the offset may be dead, and later stages mask them; a camera never counts
    below zero, so there one pixel is proof that the frames are not raw.

    Shapes: `counts` (t, y, x).
    """
    camera = camera or Camera(full_scale_adu=full_scale_of(counts.dtype))
    lowest, highest = (extreme(axis=(1, 2)).tolist() for extreme in (counts.min, counts.max))
    # below the offset by six standard deviations of read noise and rounding: 1e-9 of dark pixels
    rounding = 1 / 12 if np.issubdtype(counts.dtype, np.integer) else 0.0
    sigma = np.sqrt(np.square(np.divide(camera.read_noise_e, camera.gain_e_per_adu)) + rounding)
    floor: float | FloatArray = camera.offset_adu - 6.0 * sigma
    ceiling = _ceiling_adu(camera)
    highest_floor, lowest_ceiling = float(np.max(floor)), float(np.min(ceiling))
    for number, (frame, low, high) in enumerate(zip(counts, lowest, highest, strict=True)):
        where = f"{name}: frame {first_frame + number}"
        if not (math.isfinite(low) and math.isfinite(high)):
            bad = ~np.isfinite(frame)
            advice = "; leave the frame out or export the movie again"
            if len(counts) > 1 and not np.isfinite(counts[:, bad]).any():
                advice = (
                    ", as in the frames beside it; crop the movie, or set these pixels to 0, which "
                    "leaves them out"
                )
            raise DataError(f"{where} is NaN or infinite {_first(bad)}{advice}")
        refuse_ratio(frame, where, camera)
        if low == high == 0:
            raise DataError(
                f"{where} is zero throughout; it was dropped by the camera: leave it out"
            )
        if low < highest_floor:
            _refuse_negative(frame, floor, where)
        full = low == high >= converter_ceiling(frame)
        beyond = low >= lowest_ceiling and bool(np.all(frame >= ceiling))
        if beyond and low < high and camera.well_depth_e is not None:  # full pixels are alike
            raise DataError(
                f"{where} has {low:g} to {high:g} counts, all beyond camera.well_depth_e = "
                f"{camera.well_depth_e:g} with camera.gain_e_per_adu = "
                f"{float(np.mean(camera.gain_e_per_adu)):.4g} and camera.offset_adu = "
                f"{float(np.mean(camera.offset_adu)):.4g}, but they differ, as those of full "
                "pixels would not: correct these numbers, or leave them out to have gain and "
                "offset measured"
            )
        if full or beyond:
            raise DataError(
                f"{where} is saturated throughout; lower the exposure or the laser power, "
                "or correct camera.well_depth_e"
            )


def _refuse_negative(frame: NDArray[Any], floor: float | FloatArray, where: str) -> None:
    below = np.asarray(frame < floor)
    if not (below & (frame < 0)).any() and below.mean() <= 0.01:  # more than a sensor has dead ones
        return
    raise DataError(
        f"{where} lies below the camera's offset by more than its read noise {_first(below)} "
        f"(lowest count {float(frame.min()):g}); give raw counts, or correct camera.offset_adu and "
        "camera.read_noise_e"
    )


def refuse_ratio(frame: NDArray[Any], where: str, camera: Camera) -> None:
    """Refuse a frame that was divided by another: values near 1, or near 0 as contrasts.

    Shapes: `frame` (y, x).
    """
    if not np.issubdtype(frame.dtype, np.floating):
        return
    mean, spread = float(frame.mean(dtype=np.float64)), float(frame.std(dtype=np.float64))
    gain = float(np.mean(camera.gain_e_per_adu))
    # no interferometric image has so few
    ratio = abs(mean - 1) < _RATIO_TOLERANCE and spread < 1 / 2 and mean * gain < 10.0
    small = abs(mean) < _RATIO_TOLERANCE and 0 < spread < _RATIO_TOLERANCE
    contrast = small and spread * gain < 1 and frame.min() < 0
    if ratio or contrast:
        raise DataError(
            f"{where} is ratiometric (floats around {int(ratio)}): its shot noise cannot be known "
            "any more; give the camera's raw counts, which are divided here"
        )


def refuse_overflow(counts: NDArray[Any], name: str) -> None:
    """Refuse a movie whose counts went beyond the largest number of their type and began at zero.

    So does one whose numbers were read with their bytes the other way round.

    A pixel there leaps over nearly the whole range of the type from one frame to the next, as no
    light does in some pixels of a frame and not in the others.  One that is saturated is at the
    very end of the range, where one that overflowed hardly ever is.

    Shapes: `counts` (t, y, x).
    """
    if len(counts) > 1 and bytes_are_swapped(counts[:8]):  # frames tell it
        raise DataError(
            f"{name}: the bytes of its numbers are the other way round: pixels leap over the range "
            f"of {counts.dtype} from one frame to the next, and do not with the bytes of each "
            "number exchanged; read or export them with the other byte order"
        )
    if not np.issubdtype(counts.dtype, np.unsignedinteger) or counts.dtype.itemsize > 2:
        return
    largest = int(np.iinfo(counts.dtype).max)
    if not counts.size or int(counts.max()) - int(counts.min()) < _OVERFLOW_JUMP * largest:
        return
    for before, after in pairwise(counts):
        high = np.maximum(before, after)
        leap = (high - np.minimum(before, after) > _OVERFLOW_JUMP * largest) & (high < largest)
        if 1e-4 < leap.mean() < 1 / 2 and not _is_shutter(before, after):  # more than blink
            y, x = np.unravel_index(int(np.argmax(leap)), leap.shape)
            raise DataError(
                f"{name}: counts have overflowed {8 * counts.dtype.itemsize} bits: pixels leap "
                f"between 0 and {largest} from one frame to the next, as from {before[y, x]} to "
                f"{after[y, x]} at y = {y}, x = {x}; record or export the movie without "
                "multiplying counts, with less light, or with more bits"
            )


def _is_shutter(before: NDArray[Any], after: NDArray[Any]) -> bool:
    """Whether a shutter opens or closes: even the brightest pixels of one frame are dark."""
    # above it too few pixels lie for light to be on
    low, high = sorted(float(np.quantile(frame, 0.99)) for frame in (before, after))
    return low < high / 2


def converter_ceiling(counts: NDArray[Any]) -> float:
    """Find the full scale of a converter that has fewer bits than the stored type."""
    if not np.issubdtype(counts.dtype, np.integer) or not counts.size:
        return math.inf
    top = int(counts.max())
    step = top & -top  # twelve bits may stand in the high bits of sixteen
    full = top // step if top > 0 else 0
    few = np.count_nonzero(counts == top) < 4  # which may be so by chance
    if full < 255 or full & (full + 1) or few:
        return math.inf
    if step > 1 and int(np.bitwise_or.reduce(counts, axis=None)) % step:
        return math.inf
    return float(top)


def _ceiling_adu(camera: Camera) -> float | FloatArray:
    """Count from which on a pixel is saturated."""
    ceiling: float | FloatArray = math.inf
    if camera.well_depth_e is not None:
        ceiling = camera.offset_adu + np.divide(camera.well_depth_e, camera.gain_e_per_adu)
    return ceiling if camera.full_scale_adu is None else np.minimum(ceiling, camera.full_scale_adu)


LARGEST_PX = 2**18
"""Pixels of a field, up to which all of them are looked at."""

_SIDE, _ALONG = 64, 4  # of a square, and squares along each axis: together 256 × 256 pixels


@dataclass(frozen=True)
class FieldSample:
    """Squares of a field of a shape, by their first rows and columns."""

    shape: tuple[int, int]
    corners: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, shape: tuple[int, int]) -> FieldSample | None:
        """Choose squares, always the same in fields of one shape; None where the field is small."""
        if math.prod(shape) <= LARGEST_PX or min(shape) < _SIDE * _ALONG:
            return None
        rng = np.random.default_rng(1)
        edges = [np.linspace(0, size, _ALONG + 1).astype(int) for size in shape]
        corners = [
            (int(rng.integers(top, bottom - _SIDE + 1)), int(rng.integers(left, right - _SIDE + 1)))
            for top, bottom in pairwise(edges[0])
            for left, right in pairwise(edges[1])
        ]
        return cls(shape, tuple(corners))

    def taken(self, images: NDArray[Any]) -> NDArray[Any]:
        """Cut the squares out of images and put them side by side.

        Shapes: `images` (…, y, x), result (…, 256, 256).
        """
        side = _SIDE * _ALONG
        out = np.empty((*images.shape[:-2], side, side), dtype=images.dtype)
        for number, (top, left) in enumerate(self.corners):
            y, x = (_SIDE * k for k in divmod(number, _ALONG))
            square = images[..., top : top + _SIDE, left : left + _SIDE]
            out[..., y : y + _SIDE, x : x + _SIDE] = square
        return out

    def camera(self, camera: Camera) -> Camera:
        """Give the camera of the squares."""
        return camera.mapped(self.taken)

    def summary(self, counts: NDArray[Any], camera: Camera) -> dict[str, Any]:
        """Give what ``summary.json`` says of it.

        That is the noise between neighbouring frames over that of the light, and its standard error
        by the scatter of the squares.

        Shapes: `counts` (t, 256, 256), `camera` that of the squares.
        """
        ratio, electrons = np.full(2, np.nan), camera.steady(counts)
        if electrons is not None:
            noise = np.square(np.diff(electrons, axis=0)).mean(axis=0) / 2
            light = electrons.mean(axis=0) + camera.read_variance_e2(noise.shape)
            each, expected = (
                image.reshape(_ALONG, _SIDE, _ALONG, _SIDE).mean(axis=(1, 3)).ravel()
                for image in (noise, light)
            )
            ratio = each / expected
        return {
            "pixels": _SIDE**2 * len(self.corners),
            "of": math.prod(self.shape),
            "side_px": _SIDE,
            "corners_px": [list(corner) for corner in self.corners],
            "seed": 1,
            "noise_ratio": float(ratio.mean()),
            "noise_ratio_se": float(ratio.std(ddof=1) / math.sqrt(ratio.size)),
        }


@dataclass(frozen=True, eq=False)
class CutFrames(ChangedFrames):
    """Frames of a movie, of which only some of the pixels are kept.

    Where frames lie in the file as they are, the others are not read.
    """

    size: tuple[int, int]
    cut: Callable[[NDArray[Any]], NDArray[Any]]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.source.shape[0], *self.size

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        movie = self.source
        placed = movie.in_place(start, stop) if isinstance(movie, PlacedSource) else None
        if placed is not None:
            placed.check()
            out = np.array(self.cut(placed.counts))
            placed.let_go()
            return out
        # some megabytes of whole frames are read at a time
        step = max(1, 2**24 // (math.prod(movie.shape[1:]) * movie.dtype.itemsize))
        out = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        for first in range(start, stop, step):
            end = min(first + step, stop)
            out[first - start : end - start] = self.cut(movie.read(first, end))
        return out


def sampled(movie: CountSource, camera: Camera) -> tuple[CountSource, Camera]:
    """Give a movie of a sample of the pixels and its camera; a small field as it is."""
    sample = FieldSample.of((movie.shape[1], movie.shape[2]))
    if sample is None:
        return movie, camera
    side = _SIDE * _ALONG
    return CutFrames(movie, (side, side), sample.taken), sample.camera(camera)


def whole_frames(shape: tuple[int, ...], most: int) -> int:
    """Say how many whole frames tell as much as so many of 256 × 256 pixels."""
    return min(most, max(16, 256**2 * most // math.prod(shape)))
