"""The spread that an estimate has where there is no particle: the noise at full length.

What a fit does to noise is linear in the counts, whether or not there is a particle.  The same
windows of frames, projected on the same derivatives of the model everywhere in the field where
nothing landed, give errors of estimates whose truth is known, nothing, at the full length of the
windows.  Disjoint parts of an event's own frames, which are shorter, cannot show these.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.records import BoolArray, FloatArray

CONTRASTS = ("whole", "parts", "eighths", "quarters", "halves")
"""What is compared: after with before; the parts on one side of the step; neighbours of n/8, n/4
and n/2 frames on one side."""

FEWEST_PLACES = 60
"""Places below which nothing is said."""

_LEAST_LEFT = 0.5  # share of a variance; less is left only next to fits, where nothing is measured


@dataclass(frozen=True)
class EmptySpread:
    """Sums of squared errors at places without a particle, over the expected variance."""

    squares: FloatArray
    counts: FloatArray
    shared: FloatArray
    distances: tuple[float, ...] | None = None

    def __add__(self, other: EmptySpread) -> EmptySpread:
        """Add those of other frames of the same field, or of other tiles of it."""
        if self.counts.shape != other.counts.shape:
            joined = EmptySpread.beside([self, other])
            return self if joined is None else joined
        squares, counts = self.squares + other.squares, self.counts + other.counts
        return EmptySpread(squares, counts, self.shared, self.distances)

    @classmethod
    def beside(cls, parts: Sequence[EmptySpread | None]) -> EmptySpread | None:
        """Join those of the same frames of fields beside each other; None where there is none."""
        known = [part for part in parts if part is not None]
        if not known:
            return None
        squares, counts = (
            np.concatenate([getattr(part, name) for part in known], axis=-1)
            for name in ("squares", "counts")
        )
        shared = np.mean([part.shared for part in known], axis=0)
        return cls(squares, counts, shared, known[0].distances)


class EmptyField:
    """The linear estimator at every place of a field."""

    def __init__(
        self,
        mean_e: FloatArray,
        read_e2: FloatArray,
        used: BoolArray,
        slopes: FloatArray,
        n_free: int,
        *,
        additive: bool,
        spacing_px: int,
        tile_px: int,
    ) -> None:
        rows, columns = mean_e.shape
        n, k, _ = slopes.shape
        half = k // 2
        self._shape = (rows, columns)
        # of rows a multiple of the spacing, so that those between the places need no transform
        self._size = (
            spacing_px * fft.next_fast_len(math.ceil((rows + half) / spacing_px)),
            fft.next_fast_len(columns + half, real=True),
        )
        self._n_free = n_free
        self._spacing, self._tile_px = spacing_px, tile_px
        self._mean = mean_e
        noise = np.maximum(mean_e, 0.0) + read_e2
        light = np.ones_like(mean_e) if additive else mean_e
        seen = used & (noise > 0)
        self._weight = np.where(seen, light / np.where(seen, noise, 1.0), 0.0)
        scale = np.sqrt(np.einsum("iyx,iyx->i", slopes, slopes))
        unit = slopes / scale[:, None, None]
        pairs = [(i, j) for i in range(n) for j in range(i, n)]
        # residuals are small numbers, of which single precision keeps a millionth
        self._spectra = [self._reversed(image).astype(np.complex64) for image in unit]
        inner = (slice(0, rows, spacing_px), slice(0, columns, spacing_px))
        self._places = inner
        products = (self._reversed(unit[i] * unit[j]) for i, j in pairs)  # one at a time in memory
        information = self._correlate(self._weight * light, products)
        fisher = np.empty((*information.shape[1:], n, n))
        for (i, j), value in zip(pairs, information, strict=True):
            fisher[..., i, j] = fisher[..., j, i] = value
        full = fisher[..., 0, 0] > 0.5 * np.median(fisher[..., 0, 0])
        eigenvalues = np.linalg.eigvalsh(np.where(full[..., None, None], fisher, np.eye(n)))
        full &= eigenvalues[..., -1] < 1e10 * eigenvalues[..., 0]
        self._known = full & (self._weight[inner] > 0)
        inverse = np.linalg.inv(np.where(full[..., None, None], fisher, np.eye(n)))
        self._inverse = np.ascontiguousarray(np.moveaxis(inverse[..., :n_free, :], (2, 3), (0, 1)))
        self._variance = np.moveaxis(np.diagonal(inverse, axis1=2, axis2=3), 2, 0)[:n_free]
        wide = math.ceil(columns / tile_px)
        row, column = np.indices(self._shape)
        self._tile = ((row // tile_px) * wide + column // tile_px)[inner]
        self.tiles = math.ceil(rows / tile_px) * wide
        self._unit = unit

    def errors(self, sum_e: FloatArray, power: float, known: FloatArray | None) -> FloatArray:
        """Contribution of a sum of frames to the errors at all places.

        Shapes: `sum_e` (y, x), `known` (y, x), result (n, rows, columns).
        """
        rest = sum_e / power - self._mean
        if known is not None:
            rest = rest - known
        score = self._correlate((self._weight * rest).astype(np.float32), self._spectra)
        errors: FloatArray = np.einsum("ijyx,jyx->iyx", self._inverse, score)
        return errors

    def left(self, particles: Sequence[tuple[float, float]]) -> FloatArray:
        """Share of the variance that is left around fitted particles after their subtraction.

        A fit follows the noise, also in pixels that matter to its neighbourhood.

        Notes
        -----
        With the information M(Δ) that places Δ apart have in common, F = M(0), and C = F⁻¹ M F⁻¹
        the covariance of what is estimated at both, the residuals of a fit hold F⁻¹ − C F Cᵀ of the
        variance F⁻¹, on a background that is even.

        Shapes: result (n, rows, columns).
        """
        inverse, middle, covariance = self._related
        followed = np.einsum("ilyx,lm,imyx->iyx", covariance, middle, covariance)
        followed /= np.diag(inverse)[:, None, None]
        side = followed.shape[1]
        taken = np.zeros((self._n_free, *self._shape))
        for x, y in particles:
            top, left = round(y) - side // 2, round(x) - side // 2
            low, high = max(top, 0), max(left, 0)
            near = taken[:, low : max(top + side, 0), high : max(left + side, 0)]
            there = followed[: self._n_free, low - top :, high - left :]
            near += there[:, : near.shape[1], : near.shape[2]]
        inner = (slice(None), *self._places)
        return np.maximum(1 - taken[inner], _LEAST_LEFT)

    def spread(
        self,
        before: list[FloatArray],
        after: list[FloatArray],
        powers: tuple[FloatArray, FloatArray],
        taken: BoolArray,
        left: FloatArray | None = None,
    ) -> EmptySpread:
        """Compare the parts of two windows.

        Shapes: `before, after` (n, rows, columns), `taken` (y, x), `left` (n, rows, columns).
        """
        kept = self._known & ~taken[self._places]
        squares = np.zeros((len(CONTRASTS), self._n_free, self.tiles))
        counts = np.zeros((len(CONTRASTS), self.tiles))
        nothing = EmptySpread(squares, counts, self.shared)
        if kept.sum() < FEWEST_PLACES:
            return nothing
        sides = [[part[:, kept] for part in parts] for parts in (before, after)]
        unit, tile = self._variance[:, kept], self._tile[kept]
        means = [_mean(power, parts) for power, parts in zip(powers, sides, strict=True)]
        noise = unit * sum(1 / power.sum() for power in powers)
        if left is not None:
            noise = noise * left[:, kept]
        whole = (means[1] - means[0]) / np.sqrt(noise)
        scale = SIGMA_PER_MAD * np.median(np.abs(whole), axis=1, keepdims=True)
        # beyond 4 robust standard deviations something else than noise is there
        quiet = np.all(np.abs(whole) < 4.0 * scale, axis=0)
        if quiet.sum() < FEWEST_PLACES:
            return nothing
        found = [(whole**2 / 0.998929, 1)]  # the variance of a normal law inside that
        parts_squares, degrees = np.zeros(unit.shape), 0
        for power, parts, mean in zip(powers, sides, means, strict=True):
            for light, part in zip(power, parts, strict=True):
                parts_squares += light * (part - mean) ** 2
            degrees += len(parts) - 1
        parts_squares /= unit
        found.append((parts_squares, degrees))
        for joined in (1, 2, 4):
            total, pairs = np.zeros(unit.shape), 0
            for power, parts in zip(powers, sides, strict=True):
                if len(parts) < 8:
                    continue
                for start in range(0, len(parts), 2 * joined):
                    ends = start, start + joined, start + 2 * joined
                    one, two = (slice(*pair) for pair in pairwise(ends))
                    apart = _mean(power[two], parts[two]) - _mean(power[one], parts[one])
                    total += apart**2 / (1 / power[one].sum() + 1 / power[two].sum())
                    pairs += 1
            found.append((total / unit, pairs))
        for k, (square, number) in enumerate(found):
            for i, row in enumerate(square):
                squares[k, i] = np.bincount(tile[quiet], row[quiet], minlength=self.tiles)
            counts[k] = number * np.bincount(tile[quiet], minlength=self.tiles)
        return EmptySpread(squares, counts, self.shared)

    @cached_property
    def shared(self) -> FloatArray:
        """Variance of a mean over all tiles, over what it were if no two had noise in common.

        Notes
        -----
        Squares of estimates with the correlation r have the correlation r².  Of the pairs of places
        that are (j, i) apart, (1 − |j|/T)(1 − |i|/T) lie in one tile of side T.
        """
        inverse, _, covariance = self._related
        same = np.einsum("iiyx->iyx", covariance) / np.diag(inverse)[:, None, None]
        half = same.shape[1] // 2
        start, step = half % self._spacing, self._spacing
        pairs = same[: self._n_free, start::step, start::step] ** 2
        within = np.maximum(1 - np.abs(np.arange(-half, half + 1)[start::step]) / self._tile_px, 0)
        held = np.einsum("iyx,y,x->i", pairs, within, within)
        return np.asarray(pairs.sum(axis=(1, 2)) / held)

    @cached_property
    def _related(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """F⁻¹, F, and the covariance of estimates at every distance between two places."""
        unit = self._unit
        size = (2 * unit.shape[-1] - 1,) * 2
        spectra = fft.rfft2(unit, size)
        common = fft.irfft2(spectra[:, None] * spectra.conj(), size)
        common = fft.fftshift(common, axes=(-2, -1))
        middle = common[..., common.shape[-2] // 2, common.shape[-1] // 2]
        inverse = np.linalg.inv(middle)
        return inverse, middle, np.einsum("ij,jkyx,kl->ilyx", inverse, common, inverse)

    @property
    def places(self) -> int:
        """Places at which there is a linear estimate."""
        return int(self._known.sum())

    def _reversed(self, image: FloatArray) -> NDArray[np.complexfloating]:
        """Spectrum that correlates with an image whose centre is at the place."""
        side, half = len(image), len(image) // 2
        padded = np.zeros(self._size)
        padded[:side, :side] = image[::-1, ::-1]
        return np.asarray(fft.rfft2(np.roll(padded, (-half, -half), axis=(0, 1))))

    def _correlate(
        self, image: NDArray[np.floating], spectra: Iterable[NDArray[np.complexfloating]]
    ) -> FloatArray:
        """Correlate at the places, in the precision of the image."""
        padded = np.zeros(self._size, dtype=image.dtype)
        padded[: self._shape[0], : self._shape[1]] = image
        spectrum = fft.rfft2(padded)
        step, (rows, columns) = self._spacing, self._size
        folded, size = (step, rows // step, -1), (rows // step, columns)
        kept = slice(math.ceil(self._shape[0] / step)), self._places[1]
        # every step-th row of what a spectrum stands for is the transform of its mean over aliases
        return np.stack(
            [fft.irfft2((spectrum * s).reshape(folded).mean(axis=0), s=size)[kept] for s in spectra]
        )


def _mean(power: FloatArray, parts: Sequence[FloatArray]) -> FloatArray:
    """Average parts, weighted with their light; one after the other, to save memory."""
    mean = np.zeros_like(parts[0])
    for share, part in zip(power / power.sum(), parts, strict=True):
        mean += share * part
    return mean
