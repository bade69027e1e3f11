"""Rows of moving particles, and the background under them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis._kernels.background_response import Slopes
from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Localizations:
    """Particles in frames, sorted by frame."""

    frame: IntArray
    track: IntArray
    theta: FloatArray
    group: IntArray
    fisher: FloatArray
    snr: FloatArray

    @classmethod
    def of(
        cls, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray | None = None
    ) -> Localizations:
        """Sort rows that are not fitted yet by frame."""
        n = len(frame)
        blur = np.zeros(n, dtype=np.int64) if group is None else group
        unknown = np.full((n, 4, 4), np.nan), np.full(n, np.nan)
        return cls(frame, track, theta, blur, *unknown).in_order()

    @classmethod
    def together(cls, parts: Sequence[Localizations]) -> Localizations:
        """Concatenate several sets of rows."""
        every = ([getattr(rows, part.name) for rows in parts] for part in fields(cls))
        return cls(*map(np.concatenate, every))

    def in_order(self) -> Localizations:
        """Sort rows by frame and track."""
        return self.only(np.lexsort((self.track, self.frame)))

    def joined(
        self, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray
    ) -> Localizations:
        """Append rows that are not fitted yet."""
        return Localizations.together(
            [self, Localizations.of(frame, track, theta, group)]
        ).in_order()

    def fitted(self, theta: FloatArray, fisher: FloatArray, gain: FloatArray) -> Localizations:
        """Set estimates, informations and gains in log-likelihood."""
        return replace(self, theta=theta, fisher=fisher, snr=np.sqrt(2 * np.maximum(gain, 0.0)))

    def recalling(self, old: Localizations) -> Localizations:
        """Copy the fits of rows that are the same in others."""
        many = int(max(self.track.max(initial=0), old.track.max(initial=0))) + 1
        keys, sought = old.frame * many + old.track, self.frame * many + self.track
        where = np.minimum(np.searchsorted(keys, sought), len(keys) - 1)
        same = (keys[where] == sought) & (old.theta[where] == self.theta).all(axis=1)
        fisher, snr = self.fisher.copy(), self.snr.copy()
        fisher[same], snr[same] = old.fisher[where[same]], old.snr[where[same]]
        return replace(self, fisher=fisher, snr=snr)

    def starts(self, frames: int) -> IntArray:
        """Index of the first row of each frame, and the number of rows."""
        first: IntArray = np.searchsorted(self.frame, np.arange(frames + 1)).astype(np.int64)
        return first

    def only(self, kept: BoolArray | IntArray) -> Localizations:
        """Select some rows."""
        return Localizations(*(getattr(self, part.name)[kept] for part in fields(self)))

    def pairs_within(self, limit_nm: float) -> IntArray:
        """Find pairs of rows of one frame within a distance.

        Shapes: result (pairs, 2).
        """
        apart = (2 * limit_nm + 1) * self.frame  # no two frames lie within the limit of each other
        places = np.column_stack([self.theta[:, :2], apart])
        tree = scipy.spatial.cKDTree(places, balanced_tree=False, compact_nodes=False)
        return np.asarray(tree.query_pairs(limit_nm, output_type="ndarray"), dtype=np.int64)


@dataclass(frozen=True)
class BackgroundEstimate:
    """The background, and the laser power of each frame."""

    level: FloatArray
    power: FloatArray


@dataclass(frozen=True)
class Judged:
    """What the likelihood says of each row."""

    fisher: FloatArray
    observed: FloatArray
    bias: FloatArray
    gain: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    worst: FloatArray
    level: FloatArray
    growth: FloatArray
    slopes: Slopes

    @classmethod
    def of(
        cls,
        fisher: FloatArray,
        turned: FloatArray,
        ways: FloatArray,
        bias: FloatArray,
        numbers: FloatArray,
        slopes: Slopes,
        *,
        free: BoolArray,
    ) -> Judged:
        """Make it of the arrays that `iscat_analysis._kernels.track_precision.judge_frames` fills.

        Shapes: `free` (4,).
        """
        n, index = len(fisher), np.flatnonzero(free)
        part = np.ix_(np.arange(n), index, np.arange(index.size))
        observed = np.full((n, 4, 4), np.nan)
        inverse = np.full((n, index.size, index.size), np.nan)
        good = np.isfinite(turned[part]).all(axis=(1, 2))
        if good.any():
            v, ov = ways[part][good], turned[part][good]
            inverse[good] = v @ np.swapaxes(v, 1, 2)
            o = ov @ np.linalg.inv(v)
            observed[np.ix_(good, index, index)] = (o + np.swapaxes(o, 1, 2)) / 2
        shift = np.zeros((n, 4))
        shift[:, index] = np.einsum("nij,nj->ni", inverse, bias[:, index])
        gain, chi2, pixels, worst, level, growth = numbers.T
        return cls(
            fisher, observed, np.nan_to_num(shift), gain, chi2, pixels, worst, level, growth, slopes
        )
