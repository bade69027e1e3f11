"""Coupling of the rows of a track through the background of their pixels.

The background of each pixel is expressed in units of its standard deviation, which follows from the
N counts of all frames: an image v of such numbers changes the logarithm of the background by v/√N,
and a row with the slopes G = w B ∂C responds with G v/√N.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.background_response import Slopes
from iscat_analysis._kernels.track_background_operator import follow, own_shares, send
from iscat_analysis.records import FloatArray
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate


class Coupling:
    """Some rows and the pixels of their squares."""

    def __init__(
        self,
        field: MovingField,
        ground: BackgroundEstimate,
        slopes: Slopes,
        rows: NDArray[np.int64],
    ) -> None:
        self._slopes, self._rows = slopes, rows
        squares = slopes.squares[rows]
        top, left = squares[:, 0].min(), squares[:, 2].min()
        bottom, right = squares[:, 1].max(), squares[:, 3].max()
        self._squares = squares - np.array([top, top, left, left])
        cut = slice(top, bottom), slice(left, right)
        level = ground.level[cut]
        share = np.where(field.used[cut], level / (level + field.read_e2[cut]), 0.0)
        self._weight = share / np.maximum(field.total_e[cut], 1.0)
        self._sigma = np.sqrt(self._weight)
        self._room = slopes.values.shape[2]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self._weight.size

    def own(self) -> FloatArray:
        """Information that each row by itself loses to the background, G N⁻¹ Gᵀ.

        Shapes: result (n, free, free).
        """
        free = self._slopes.values.shape[1]
        out = np.zeros((len(self._rows), free, free))
        own_shares(
            self._slopes, self._rows, self._squares, self._weight, out, *np.empty((2, self._room))
        )
        return out

    def sent(self, by: FloatArray) -> FloatArray:
        """Change of the background that changes of rows make, N⁻½ Σ Gᵀ by.

        Shapes: `by` (n, b, free), result (b, pixels).
        """
        out = np.zeros((by.shape[1], *self._weight.shape))
        send(self._slopes, self._rows, self._squares, by, out, np.empty(self._room))
        return (out * self._sigma).reshape(len(out), -1)

    def followed(self, covariance: FloatArray, images: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Let rows respond to images; give the responses and the images that these make.

        Shapes: `covariance` (n, free, free), `images` (b, pixels), `felt` (n, b, free), `back` (b,
        pixels).
        """
        seen = np.multiply(images.reshape(-1, *self._weight.shape), self._sigma, order="C")
        felt = np.zeros((len(self._rows), len(images), covariance.shape[1]))
        out = np.zeros_like(seen)
        follow(
            self._slopes, self._rows, self._squares, covariance, seen, felt, out,
            np.empty(self._room), np.empty(covariance.shape[1]),
        )  # fmt: skip
        return felt, (out * self._sigma).reshape(images.shape)
