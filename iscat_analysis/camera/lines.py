"""Rows and columns that flicker, and light that changes smoothly: measured and divided out.

Where a shutter rolls, every row sees the laser at its own moment, and where columns have their own
amplifiers each may drift: all pixels of a line share a factor f that no other frame has.  It is
measured by the light of the line over that of the same line in the mean frame, both over the whole
frame's, with an error of 1/√(C N) for C pixels of N photoelectrons.

A particle of contrast c is part of that light.  In a single frame it is far below the noise, so
that a median is moved by it as a mean is, and is noisier; but what it does to a mean is known: it
lowers its line by the line's mean contrast, of a diffraction-limited spot 2λ/(π NA C a) of its
height, with pixels of side a, as much as 2 % where C = 128.  `Lines.left` says what the correction
leaves of a signal, and searches and fits expect that.

Light that changes smoothly over the field is measured by a polynomial, of which the same holds; see
`iscat_analysis.camera.lighting`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.background import find_defects
from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.light import Surface
from iscat_analysis.camera.spectrum import measure_spectrum
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import LINES_FLICKER
from iscat_analysis.movie import Stack
from iscat_analysis.records import CountSource, FloatArray, StackMetadata

_LEAST_LIT = 0.25  # of a line's pixels that must be usable


@dataclass(frozen=True, eq=False)
class Lines:
    """Flicker of rows and columns and smooth changes of the light; made by `find_lines`."""

    light_e: FloatArray
    shares: tuple[float, float]
    surface: Surface | None = None

    def findings(self, name: str) -> Iterator[Finding]:
        """Give what the user should know."""
        if self.surface is not None:
            yield from self.surface.findings(name)
        if any(self.shares):
            flicker = [(n, s) for n, s in zip(("rows", "columns"), self.shares, strict=True) if s]
            lines = " and ".join(n for n, _ in flicker)
            percents = " and ".join(f"{100 * share:.2g} %" for _, share in flicker)
            yield LINES_FLICKER({"lines": lines, "percents": percents}, where=name)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        surface = self.surface or Surface(self.light_e, 0, 0.0)
        return {
            "row_share": float(self.shares[0]),
            "column_share": float(self.shares[1]),
            "smooth_degree": surface.degree,
            "smooth_rms": surface.rms,
            "fringe_periods_px": surface.fringes.periods_px.tolist(),
            "fringe_rms": surface.fringes.rms,
            "seam_rows": list(surface.amplifier_boundaries[0]),
            "seam_columns": list(surface.amplifier_boundaries[1]),
            "haze": surface.stray_light,
        }

    def factors(self, electrons: FloatArray) -> FloatArray:
        """Measure the smooth change of the light, and the light of lines over that of the frame.

        Shapes: `electrons` (…, y, x), result (…, y, x).
        """
        used = self.light_e > 0
        seen = np.where(used, electrons, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            frame = seen.sum(axis=(-2, -1), keepdims=True) / self.light_e.sum()
            out = np.ones((*electrons.shape[:-2], 1, 1))
            if self.surface is not None:
                out = self.surface.factors(electrons)
                seen = seen / out
            for axis, share in zip((-1, -2), self.shares, strict=True):
                if not share:
                    continue
                line = self.light_e.sum(axis=axis, keepdims=True)
                factor = seen.sum(axis=axis, keepdims=True) / line / frame
                lit = (used.mean(axis=axis, keepdims=True) > _LEAST_LIT) & (frame > 0)
                out = out * np.where(lit & (factor > 0), factor, 1.0)
        return out

    def divided(self, counts: NDArray[Any], camera: Camera) -> NDArray[Any]:
        """Divide frames by their unsteady light.

        Shapes: `counts` (t, y, x), result (t, y, x).
        """
        offset = np.asarray(camera.offset_adu)
        steady = counts - offset
        steady /= self.factors(steady * camera.gain_e_per_adu)
        steady += offset
        full = camera.saturated(counts)
        if full.any():
            limit = camera.full_scale_adu
            steady[full] = counts[full] if limit is None else limit
        out: NDArray[Any] = steady.astype(_divided_type(counts.dtype))
        return out

    def taken(self, signal: FloatArray) -> FloatArray:
        """Give the change of the divisor that a signal makes.

        Shapes: `signal` (…, y, x), result (…, y, x).
        """
        return np.broadcast_to(self.factors(self.light_e * (1 + signal)), signal.shape)

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what is left of a signal after the division.

        Shapes: `signal` (y, x), result (y, x).
        """
        return (1 + signal) / self.taken(signal) - 1

    def part(self, here: tuple[slice, slice]) -> PartOfLines:
        """Give what is done to signals in some pixels of the field."""
        return PartOfLines(self, here)


@dataclass(frozen=True, eq=False)
class PartOfLines:
    """What the division by unsteady light of the whole field does to signals in a part of it."""

    whole: Lines
    here: tuple[slice, slice]

    def taken(self, signal: FloatArray) -> FloatArray:
        """Give the change of the divisor that a signal makes.

        Shapes: `signal` (y, x), result (y, x).
        """
        field = np.zeros(self.whole.light_e.shape)
        field[self.here] = signal
        return self.whole.taken(field)[self.here]

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what is left of a signal after the division.

        Shapes: `signal` (y, x), result (y, x).
        """
        return (1 + signal) / self.taken(signal) - 1


def _divided_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    return np.dtype(np.float32 if dtype.itemsize <= 2 else np.float64)


class SteadyFrames:
    """Frames of a movie, each line divided by its own light."""

    notes: tuple[str, ...] = ()
    metadata = StackMetadata()

    def __init__(self, movie: CountSource, lines: Lines, camera: Camera) -> None:
        self._movie, self._lines, self._camera = movie, lines, camera
        self.shape = movie.shape
        self.name = movie.name
        self.dtype = _divided_type(movie.dtype)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        return self._lines.divided(self._movie.read(start, stop), self._camera)

    def close(self) -> None:
        """Leave the movie open; it belongs to the caller."""


def find_lines(
    counts: NDArray[Any], camera: Camera, surface: Surface | None = None
) -> Lines | None:
    """Find rows and columns that flicker.

    Shapes: `counts` (t, y, x).
    """
    mean = camera.to_electrons(counts.mean(axis=0))
    shape = (counts.shape[1], counts.shape[2])
    off = find_defects(len(counts) * mean, len(counts) * camera.read_variance_e2(shape))
    off |= camera.saturated(counts.max(axis=0))
    seen = np.maximum(mean, 0.0) if surface is None else surface.light_e
    lines = Lines(np.where(off, 0.0, seen), (0.0, 0.0))
    even = counts
    if surface is not None:  # both parts of what is divided out are relative to the same light
        lines = replace(lines, surface=replace(surface, light_e=lines.light_e))
        even = lines.divided(counts, camera)
    spectrum = measure_spectrum(even, camera)
    if spectrum is not None and any(spectrum.shared):
        return replace(lines, shares=spectrum.shared)
    return None if surface is None else lines


def steady(movie: Stack, lines: Lines | None, camera: Camera) -> Stack:
    """Divide the unsteady light of a movie out."""
    return movie if lines is None else movie.seen_as(SteadyFrames(movie, lines, camera))
