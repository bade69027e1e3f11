"""Frames that are not as the camera gave them: interpolated, smoothed, sharpened or compressed.

The noise of raw counts is as strong at the finest patterns of the pixels, which no lens transmits,
as at coarser ones, and in every frame alike.  Bilinear interpolation by a fraction f of a pixel
multiplies the finest ones by (1 − 2f)², and f changes from frame to frame where a movie was
aligned.  Smoothing and lossy compression weaken them in all frames alike, sharpening strengthens
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import fft

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.drift import middle_of
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import FRAMES_PROCESSED
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource

_COARSE = (0.1, 0.3)  # cycles per pixel that they are compared with
_WEAK, _STRONG = 0.5, 2.0  # finest noise over that at coarser patterns

Kind = Literal["interpolated", "smoothed", "sharpened"]


@dataclass(frozen=True)
class Processing:
    """What was done to the frames, and the noise that tells it.

    `finest` is the noise at the finest patterns over that at coarser ones; `uneven` is by how much
    of itself the finest noise changes from frame to frame, beyond chance.
    """

    kind: Kind
    finest: float
    uneven: float

    @property
    def finding(self) -> Finding:
        """What the user should know."""
        what, instead = {
            "interpolated": (
                "interpolated, as where a movie is aligned by parts of a pixel: the noise of the "
                f"finest patterns changes by {100 * self.uneven:.0f} % from frame to frame, which "
                "no camera does",
                "the movie before it was aligned (its drift is measured and followed here), or "
                "shift it by whole pixels",
            ),
            "smoothed": (
                "smoothed, denoised or compressed with losses: the finest patterns have "
                f"{100 * self.finest:.0f} % of the noise of coarser ones, where a camera has as "
                "much",
                "the camera's own counts, uncompressed or compressed without losses",
            ),
            "sharpened": (
                f"sharpened: the finest patterns have {self.finest:.1f} times the noise of coarser "
                "ones, where a camera has as much",
                "the camera's own counts",
            ),
        }[self.kind]
        return FRAMES_PROCESSED({"what": what, "instead": instead, **self.summary})

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {"kind": self.kind, "finest": self.finest, "uneven": self.uneven}


def find_processing(
    movie: FrameSource, camera: Camera, span: tuple[int, int], *, moving: bool = False
) -> Processing | None:
    """Compare the noise of the finest patterns with that of coarser ones and between frames.

    Where particles move, coarser patterns are of them, and do not tell what was smoothed.
    """
    rows, columns = middle_of(movie.shape, 512)  # pixels along each side
    fine, coarse = _bands(rows.stop - rows.start, columns.stop - columns.start)
    found = []
    # pairs of frames all over the movie
    starts = np.unique(np.linspace(span[0], span[1] - 2, 48).astype(int))
    for start in starts.tolist() if span[1] - span[0] > 1 else ():
        spectrum = _spectrum(movie, camera, start, (rows, columns))
        if spectrum is not None:
            found.append((spectrum[fine].mean(), spectrum[coarse].mean()))
    if len(found) < 8:  # pairs that tell
        return None
    finest, coarser = np.array(found).T
    # |z|² of a complex normal number scatters by its mean; a normalised movie's noise changes at
    # all patterns alike, and what vibrates is coarse
    sizes = [np.count_nonzero(band) for band in (fine, coarse)]
    uneven = min(
        _uneven(finest, 1 / sizes[0]), _uneven(finest / coarser, 1 / sizes[0] + 1 / sizes[1])
    )
    ratio = float(np.quantile(finest / coarser, 0.9))  # of pairs between which little vibrates
    if uneven > 0.1:  # of itself
        return Processing("interpolated", ratio, uneven)
    if moving:
        return None
    if ratio < _WEAK:
        return Processing("smoothed", ratio, uneven)
    return Processing("sharpened", ratio, uneven) if ratio > _STRONG else None


def _uneven(values: FloatArray, chance: float) -> float:
    """Say by how much of their median values scatter beyond chance; 0 where that may be chance.

    Some that lie far off do not count, as of frames that are cut off.
    """
    middle = float(np.median(values))
    scatter = robust_sigma(values - middle) / middle
    excess = scatter**2 - chance
    # 2.33/√n: the relative error of a variance by the median deviation of n
    significant = excess > 6.0 * chance * 2.33 / math.sqrt(len(values))
    return math.sqrt(excess) if significant else 0.0


def _bands(rows: int, columns: int) -> tuple[BoolArray, BoolArray]:
    """Select the finest and the coarser patterns of a half spectrum, each with its opposite once.

    Whole rows and columns, which flicker by themselves, are in neither.
    """
    y, x = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None, :]
    radius = np.hypot(y, x)
    own = (y != 0) & (x > 0) & (x < 0.5)
    # only noise is beyond half a cycle per pixel: the corners of the spectrum
    return own & (radius > 0.5), own & (radius > _COARSE[0]) & (radius < _COARSE[1])


def _spectrum(
    movie: FrameSource, camera: Camera, start: int, region: tuple[slice, slice]
) -> FloatArray | None:
    """Give the power of the noise of two frames; None where they are dark, odd or the same."""
    counts = movie.read(start, start + 2)
    if np.array_equal(counts[0], counts[1]) or not np.isfinite(counts).all():
        return None
    before, after = camera.to_electrons(counts)[(slice(None), *region)]
    powers = float(before.mean()), float(after.mean())
    if min(powers) < 20.0:  # noise is far from normal
        return None
    before, after = before / powers[0], after / powers[1]
    light = before + after
    used = light > 0.1 * np.median(light)
    change = np.where(used, (after - before) / np.sqrt(np.where(used, light, 1.0)), 0.0)
    # shot noise over the light: alike in all frames, whatever the laser does
    change *= math.sqrt(2 / (1 / powers[0] + 1 / powers[1]))
    limit = 5.0 * robust_sigma(change[used])  # a change beyond is no noise
    waves = fft.rfft2(np.clip(change, -limit, limit))
    return np.asarray(np.square(waves.real) + np.square(waves.imag))
