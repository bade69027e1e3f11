"""What particles that move are known by: where they are in each frame, over which light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Rows:
    """Particles in frames, in the order of the frames.

    Attributes
    ----------
    frame : ndarray of int, shape (n,)
        Frame, not decreasing.
    track : ndarray of int, shape (n,)
        Whose it is; -1 where that is not known yet.
    theta : ndarray, shape (n, 5)
        x, y, z [nm], amplitude, 0.
    group : ndarray of int, shape (n,)
        Number of the blur.
    """

    frame: IntArray
    track: IntArray
    theta: FloatArray
    group: IntArray

    @classmethod
    def of(
        cls, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray | None = None
    ) -> Rows:
        """Put rows into the order of their frames."""
        order = np.lexsort((track, frame))
        blur = np.zeros(len(frame), dtype=np.int64) if group is None else group
        return cls(frame[order], track[order], np.ascontiguousarray(theta[order]), blur[order])

    def joined(self, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray) -> Rows:
        """Add rows."""
        return Rows.of(
            np.concatenate([self.frame, frame]),
            np.concatenate([self.track, track]),
            np.concatenate([self.theta, theta]),
            np.concatenate([self.group, group]),
        )

    def starts(self, frames: int) -> IntArray:
        """First row of each frame, and the number of rows."""
        first: IntArray = np.searchsorted(self.frame, np.arange(frames + 1)).astype(np.int64)
        return first

    def only(self, kept: BoolArray) -> Rows:
        """Take some of the rows."""
        return Rows(self.frame[kept], self.track[kept], self.theta[kept], self.group[kept])


@dataclass(frozen=True)
class Ground:
    """The light without the particles.

    Attributes
    ----------
    level : ndarray, shape (y, x)
        Photoelectrons in a frame of power 1 [e].
    power : ndarray, shape (t,)
        Power of each frame, 1 on average.
    """

    level: FloatArray
    power: FloatArray


@dataclass(frozen=True)
class Judged:
    """What the likelihood says of each row.

    Attributes
    ----------
    fisher : ndarray, shape (n, 4, 4)
        Expected information in (x, y, z, a).
    observed : ndarray, shape (n, 4, 4)
        Observed information of the free parameters, NaN elsewhere.
    bias : ndarray, shape (n, 4)
        Bias of order 1/N of θ, 0 where not free.
    score : ndarray, shape (n, 4)
        Gradient of the log-likelihood at θ.
    gain : ndarray, shape (n,)
        Log-likelihood over that without the particle.
    chi2 : ndarray, shape (n,)
        Pearson's.
    pixels : ndarray, shape (n,)
        How many.
    worst : ndarray, shape (n,)
        Largest residual [standard deviations].
    level : ndarray, shape (n,)
        Mean light of the square [e].
    """

    fisher: FloatArray
    observed: FloatArray
    bias: FloatArray
    score: FloatArray
    gain: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    worst: FloatArray
    level: FloatArray

    @classmethod
    def of(
        cls,
        fisher: FloatArray,
        turned: FloatArray,
        ways: FloatArray,
        bias: FloatArray,
        score: FloatArray,
        numbers: FloatArray,
        *,
        free: BoolArray,
    ) -> Judged:
        """Make it of what `iscat_analysis._kernels.judging.judge_frames` fills.

        Parameters
        ----------
        fisher, turned, ways, bias, score, numbers : ndarray
            As there.
        free : ndarray of bool, shape (4,)
            Free parameters.

        Returns
        -------
        Judged
            With the observed information and the bias where second derivatives were taken.
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
        return cls(fisher, observed, np.nan_to_num(shift), score, *numbers.T)
