"""The part of field and time that was searched, for each signal-to-noise ratio.

A particle near a bright step must exceed the residual of the fit there.  It also waits as long as a
much higher peak of the same frames is neither fitted nor subtracted.  The level that a peak needs
at a place and boundary is the larger of these and the threshold of the search.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.landing.neighbours import Step
from iscat_analysis.records import FloatArray
from iscat_analysis.search.residue import EXCEEDS, EXPLAINS, size_on_ring
from iscat_analysis.search.sliding import STRIDES, Chunk, MapArray, Peak
from iscat_analysis.search.sliding.tiles import EVERYWHERE, Box
from iscat_analysis.search.templates import FAR_LOBE, LARGEST_IMAGE, SIDELOBE

LEVELS = np.geomspace(1.0, 64.0, 25)
"""Signal-to-noise ratios, in thresholds, at which the share of the places is kept."""

LEAST_SHARE = 0.95
"""Share of field and time below which it is said in words."""

_RING_STEP_PX = 4.0
_WHOLE = 0.999  # share from which a boundary counts as searched


@dataclass(frozen=True)
class Searched:
    """At each boundary, the share of the field in which particles of each level are found.

    Shapes: `frames` (n,), `shares` (n, levels).
    """

    frames: NDArray[np.int64]
    shares: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Searched]) -> Searched:
        """Put chunks together."""
        if not parts:
            return cls(np.empty(0, dtype=np.int64), np.empty((0, LEVELS.size)))
        return cls(
            np.concatenate([part.frames for part in parts]),
            np.concatenate([part.shares for part in parts]),
        )

    def summary(self, snr: float, threshold: float, stride: int) -> dict[str, Any]:
        """Say what part was searched for particles of a signal-to-noise ratio."""
        level = max(snr / threshold, 1.0)
        share = np.array([np.interp(level, LEVELS, each) for each in self.shares])
        spans = []
        for value, run in groupby(
            zip(self.frames.tolist(), share.round(3).tolist(), strict=True), lambda each: each[1]
        ):
            held = [frame for frame, _ in run]
            if value < _WHOLE:
                half = stride // 2
                spans.append([max(held[0] - half, 0), held[-1] - half + stride, value])
        return {
            "searched_share": float(share.mean()) if share.size else None,
            "searched_snr": level * threshold,
            "partly_searched": spans,
        }


def searched_shares(
    chunk: Chunk,
    core: tuple[int, int],
    steps: Sequence[Step],
    peaks: Sequence[Peak],
    maps: tuple[MapArray, FloatArray],
    *,
    window: int,
    roi_px: int,
    threshold: float,
    own: Box = EVERYWHERE,
) -> Searched:
    """Give the shares at the boundaries of a core, from the last search and what was found."""
    snr, effective = maps
    stride = int(chunk.edges[1] - chunk.edges[0])
    frames = chunk.first + chunk.edges[1:-1]
    lit = effective > 0  # frames, and pixels, that were left out are told by themselves
    inside = np.flatnonzero((frames >= core[0]) & (frames < core[1]) & lit)
    high = [peak for peak in peaks if SIDELOBE * abs(peak.snr) > threshold]
    bright = [step for step in steps if step.is_measured]
    shares = np.ones((inside.size, LEVELS.size))
    for row, j in enumerate(inside.tolist()):
        reach = (STRIDES + 1) * stride
        now = int(frames[j])
        near = [step for step in bright if abs(step.at.frame - now) <= reach]
        waits = [peak for peak in high if abs(peak.frame - now) <= reach]
        if not near and not waits:
            continue
        asked = np.full(chunk.shape, threshold)
        for peak in waits:
            _raise_near_unsubtracted(asked, peak, roi_px)
        for step in near:
            part = max(1 - abs(step.at.frame - now) / window, 0.0)
            left = part * math.sqrt(EXPLAINS * step.excess)
            _raise_near_fitted(asked, step, snr[j], left, roi_px)
        sizes = np.sort(asked[own][chunk.usable[own]]) / threshold
        shares[row] = np.searchsorted(sizes, LEVELS * (1 + 1e-9)) / sizes.size
    return Searched(frames[inside].astype(np.int64), shares)


def _raise_near_unsubtracted(asked: FloatArray, peak: Peak, roi_px: int) -> None:
    """Raise the needed level around a peak that was not subtracted."""
    for half, share in ((LARGEST_IMAGE * roi_px, FAR_LOBE), (roi_px, SIDELOBE)):
        box = tuple(
            slice(max(math.ceil(c - half), 0), max(math.floor(c + half) + 1, 0))
            for c in (peak.y_px, peak.x_px)
        )
        np.maximum(asked[box], share * abs(peak.snr), out=asked[box])


def _raise_near_fitted(
    asked: FloatArray, step: Step, snr: NDArray[Any], inside: float, roi_px: int
) -> None:
    """Raise the needed level around a bright step, by the residual of its fit."""
    centre = step.start.x_px, step.start.y_px
    y, x = (np.arange(n) - c for n, c in zip(asked.shape, centre[::-1], strict=True))
    away = np.hypot(y[:, None], x[None, :])
    radii = np.arange(_RING_STEP_PX, LARGEST_IMAGE * roi_px + _RING_STEP_PX, _RING_STEP_PX)
    rings = [EXCEEDS * size_on_ring(snr, centre, (centre[0] + r, centre[1])) for r in radii]
    left = np.interp(away, radii, rings, right=0.0)
    np.maximum(left, np.where(away < roi_px / 2, inside, 0.0), out=left)
    np.maximum(asked, left, out=asked)


def searched_warning(name: str, summary: dict[str, Any]) -> str:
    """Say that a part of the movie was not searched; empty where nearly all was."""
    share = summary["searched_share"]
    if share is None or share >= LEAST_SHARE:
        return ""
    spans = sorted(summary["partly_searched"], key=lambda span: span[2])[:3]
    worst = ", ".join(f"{start}:{stop} ({part:.0%})" for start, stop, part in sorted(spans))
    return (
        f"{name}: {share:.0%} of field and time were searched for particles with a signal-to-noise "
        f"ratio of {summary['searched_snr']:.0f}; what bright or ill-described particles left over "
        f"hides the rest, most in frames {worst}; numbers of particles and rates are corrected "
        "for it, but look at these frames"
    )
