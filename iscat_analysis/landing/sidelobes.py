"""Side lobes among the peaks of a landing movie.

A peak near a higher one waits until that one is fitted and subtracted.  If it is still there, it
must exceed the residual of the fits, which `iscat_analysis.search.residue` measures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis._kernels.sliding import near_earlier_peaks
from iscat_analysis.landing.neighbours import Step
from iscat_analysis.records import FloatArray
from iscat_analysis.search.residue import EXCEEDS, EXPLAINS, RINGS, is_hidden, size_on_ring
from iscat_analysis.search.sliding import STRIDES, MapArray, Peak
from iscat_analysis.search.templates import FAR_LOBE, LARGEST_IMAGE, NEAR, SIDELOBE

_RESIDUE_SHARE = 0.15  # of a fitted step, below which a peak on top of it is what its fit left over


@dataclass(frozen=True)
class SidelobeFilter:
    """Separates steps from side lobes of other steps."""

    first: int
    stride: int
    window: int
    roi_px: int

    def sift(
        self, peaks: Sequence[Peak], steps: Sequence[Step], snr: MapArray
    ) -> tuple[list[Peak], list[Peak]]:
        """Sort peaks into steps, peaks that wait, and side lobes.

        Shapes: `snr` (n, y, x).
        """
        fresh: list[Peak] = []
        doubtful: list[Peak] = []
        dated = np.array([step.at.frame for step in steps])
        places = np.array([(step.start.x_px, step.start.y_px) for step in steps]).reshape(-1, 2)
        for peak, waits in zip(peaks, self._waiting(peaks), strict=True):
            if waits:
                continue
            met = np.flatnonzero(np.abs(dated - peak.frame) <= (STRIDES + 1) * self.stride)
            there = places[met]
            away = np.hypot(there[:, 0] - peak.x_px, there[:, 1] - peak.y_px)
            order = np.argsort(away, kind="stable")
            order = order[: np.searchsorted(away[order], LARGEST_IMAGE * self.roi_px, "right")]
            near = [(steps[met[i]], away[i].item(), i) for i in order.tolist()]
            if any(self._is_residue(step, distance, peak) for step, distance, _ in near):
                continue
            size = self._left_over(peak, near, there, snr)
            if abs(peak.snr) > size:
                fresh.append(peak)
            elif not is_hidden(peak.snr, size):
                doubtful.append(peak)
        return fresh, doubtful

    def _waiting(self, peaks: Sequence[Peak]) -> list[bool]:
        """Tell which peaks may be side lobes of a higher one.

        A peak that waits makes others wait as well, or its own rings would be taken for particles.
        """
        table = np.array([(p.frame, p.x_px, p.y_px, abs(p.snr)) for p in peaks]).reshape(-1, 4)
        reach, side = STRIDES * self.stride, self.roi_px
        hidden: list[bool] = near_earlier_peaks(
            table,
            (reach, reach + self.stride),
            (NEAR * side, side, LARGEST_IMAGE * side),
            (SIDELOBE, FAR_LOBE),
        ).tolist()
        return hidden

    def _is_residue(self, step: Step, distance: float, peak: Peak) -> bool:
        """Whether a peak may be the residual of a fitted step, so many pixels away."""
        on_top = distance < self.roi_px / 6
        if on_top and abs(step.at.frame - peak.frame) > self.stride:
            return False
        share = _RESIDUE_SHARE if on_top else 0.0 if step.is_measured else RINGS
        return distance < 1.5 * self.roi_px and abs(peak.snr) < share * abs(step.start.snr)

    def _left_over(
        self, peak: Peak, near: Sequence[tuple[Step, float, int]], places: FloatArray, snr: MapArray
    ) -> float:
        """Signal-to-noise ratio that a peak must have not to be a residual of the fits.

        The nearest steps, each with its distance and its index among the places of all, are tried
        first; the search ends with one whose residual is higher than the peak.

        Shapes: `places` (n, 2), `snr` (n, y, x).
        """
        size = max(
            (self._inside(step, peak) for step, away, _ in near if away < self.roi_px / 2),
            default=0.0,
        )
        j = round((peak.frame - self.first) / self.stride) - 1
        for _, _, i in near:
            if is_hidden(peak.snr, size):
                break
            x, y = places[i].tolist()
            others = np.delete(places, i, axis=0)
            beside = size_on_ring(snr[j], (x, y), (peak.x_px, peak.y_px), others)
            size = max(size, EXCEEDS * beside)
        return size

    def _inside(self, step: Step, peak: Peak) -> float:
        """Residual inside the fitted region of a step, which a peak must exceed.

        A window with only some of the frames of the step shows only a part of the misfit.
        """
        part = max(1 - abs(step.at.frame - peak.frame) / self.window, 0.0)
        return part * math.sqrt(EXPLAINS * step.excess)
