"""How the rows of a track feel one another through the light of its pixels.

The light of every pixel is measured in its own standard deviation, known from the N counts of all
frames: an image v of such numbers changes the logarithm of the light by v/√N, and a row with the
slopes G = w B ∂C sees G v/√N of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.following import Slopes
from iscat_analysis._kernels.sharing import follow, own_shares, send
from iscat_analysis.inference.moving import MovingField
from iscat_analysis.inference.rows import Ground
from iscat_analysis.records import FloatArray


class Coupling:
    """Some rows and the pixels of their squares.

    Parameters
    ----------
    field : MovingField
        The movie.
    ground : Ground
        Background.
    slopes : Slopes
        Of all rows, as judged; the field has fitted nothing since.
    rows : ndarray of int, shape (n,)
        Numbers of those that belong together.
    """

    def __init__(
        self, field: MovingField, ground: Ground, slopes: Slopes, rows: NDArray[np.int64]
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
        """How many."""
        return self._weight.size

    def own(self) -> FloatArray:
        """Give what the light takes from each row by itself, G N⁻¹ Gᵀ.

        Returns
        -------
        ndarray, shape (n, free, free)
            Information.
        """
        free = self._slopes.values.shape[1]
        out = np.zeros((len(self._rows), free, free))
        own_shares(
            self._slopes, self._rows, self._squares, self._weight, out,
            *np.empty((2, self._room)),
        )  # fmt: skip
        return out

    def sent(self, by: FloatArray) -> FloatArray:
        """Give what the light would take up of changes of the rows, N⁻½ Σ Gᵀ by.

        Parameters
        ----------
        by : ndarray, shape (n, b, free)
            Several sets of changes.

        Returns
        -------
        ndarray, shape (b, pixels)
            Images.
        """
        out = np.zeros((by.shape[1], *self._weight.shape))
        send(self._slopes, self._rows, self._squares, by, out, np.empty(self._room))
        return (out * self._sigma).reshape(len(out), -1)

    def followed(self, covariance: FloatArray, images: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Let rows follow images, and give what they feel and what they send back.

        Parameters
        ----------
        covariance : ndarray, shape (n, free, free)
            Of each row, by which it follows: its inverse information.
        images : ndarray, shape (b, pixels)
            Changes of the light.

        Returns
        -------
        felt : ndarray, shape (n, b, free)
            G N⁻½ v.
        back : ndarray, shape (b, pixels)
            N⁻½ Σ Gᵀ covariance G N⁻½ v.
        """
        seen = np.multiply(images.reshape(-1, *self._weight.shape), self._sigma, order="C")
        felt = np.zeros((len(self._rows), len(images), covariance.shape[1]))
        out = np.zeros_like(seen)
        follow(
            self._slopes, self._rows, self._squares, covariance, seen, felt, out,
            np.empty(self._room), np.empty(covariance.shape[1]),
        )  # fmt: skip
        return felt, (out * self._sigma).reshape(images.shape)
