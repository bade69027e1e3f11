"""The likelihood of a series of tables whose species share masses, shape and detector.

What the events between the ends of a window, half of the lightest species below and above all of
them, have in common:

- Species of mass Σ n_p m_p + b.  The offset b is an error of the mass scale, of `_OFFSET` of the
  lightest species (a prior, as all widths that follow).
- Peaks with an exponential tail t, of either sign, as a few normal components (`_segments`), and
  widths of their own under the usual prior: a complex may well be twice as wide as a monomer.
- A background whose density is learned: broad normal components at the middles of the gaps between
  species, so that it bends nowhere under a peak, and of the same shape in every table.  That shape
  is smooth: its logarithm is nearly a line.  Shares scatter about a level that the series has.
- Of tables that do not say what was missed, one chance of detection Φ((x − T)/r) of what was
  measured, T and r learned from their own rising edge.

Events beyond the window, as aggregates, say nothing of the species and are left out, which is
exact: the likelihood is that of events within it.  What is between a peak and the next is described
by three parameters, and that is why they are there: with normal peaks on a background of given
density, K_D of skewed peaks was 0.79 of the truth and no interval held it.

A share is no less than 0, and what noise makes of it is taken from the species that is rare: from
dimers where concentrations are low and from monomers where they are high, which is a larger K_D.
With a share for each table by itself, and a shape that could pile up beside a peak, clean series
had 2 % of background and a K_D of 1.04; series of which 7 % are background had 5 %, and 0.92.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_ndtr, ndtr, softmax

from iscat_analysis._kernels.mixture import mixture_score
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.records import FloatArray
from iscat_analysis.species.choices import top_of
from iscat_analysis.species.events import Events
from iscat_analysis.species.maximum import Problem
from iscat_analysis.species.structure import LOGIT_REACH, WIDTH_STEP, width_prior

_MASS_RANGE = 0.2  # of the masses that were given
_OFFSET = 0.05  # of the lightest mass
_CUTS = (0.0, 0.5, 1.2, 2.3, np.inf)  # of an exponential of mean 1: its parts are nearly normal
_FIRST_BACKGROUND = -6.0  # logit of its share: of the series
_SOFT, _SOFTNESS = 0.6, 0.3  # of a peak's width: spread of the limit of detection
_NODES = 64
_TINY = 1e-290


def _segments() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cut an exponential of mean 1 into parts; shares, means and variances of these (4,)."""
    a, b = np.array(_CUTS[:-1]), np.array(_CUTS[1:])
    left, right = np.exp(-a), np.exp(-b)
    finite = np.where(np.isfinite(b), b, 0.0)
    share = left - right
    mean = ((a + 1) * left - (finite + 1) * right) / share
    square = ((a**2 + 2 * a + 2) * left - (finite**2 + 2 * finite + 2) * right) / share
    return share, mean, square - mean**2


SHARES, MEANS, VARIANCES = _segments()
"""Parts of a tail of mean 1."""


def _cut(table: Events, softest: float) -> float:
    """Give the limit of a table that is cut there, sharper than nodes are apart; else 0."""
    known = table.efficiency
    if known is None or float(known.extra_sigma(table.sigma).max(initial=0.0)) >= softest:
        return 0.0
    return known.threshold_kda


@dataclass(frozen=True, eq=False)
class Window:
    """The events of one table inside the mass window, and its detector.

    Shapes: `x, noise` (n,), `seen` (g,).
    """

    x: FloatArray
    noise: FloatArray
    seen: FloatArray
    learned: bool


@dataclass(frozen=True, eq=False)
class Shared:
    """Peaks and detector that all tables share; `Series.shared` makes it."""

    mean: FloatArray
    variance: FloatArray
    tail: float
    limit: tuple[float, float]


class Series:
    """Tables of species that share masses and shape, and have weights of their own.

    The parameters are the masses, the offset, the variances of the lightest and of the heaviest
    species, the tail, the background's shape, the limit of detection and its spread where they are
    learned; each table's share of background; each table's logits of the species but the first.
    """

    def __init__(
        self, tables: Sequence[Events], composition: FloatArray, masses: FloatArray
    ) -> None:
        self.composition, self.number = composition, len(tables)
        self.kinds, self.parts = composition.shape
        self.masses = composition @ masses
        lightest = float(self.masses.min())
        high = float(self.masses.max()) + 0.5 * lightest
        softest = (high - 0.5 * lightest) / _NODES
        cuts = [_cut(table, softest) for table in tables]
        low = max(0.5 * lightest, *cuts)  # all that is seen is used, and exactly, above a cut
        self.ends = min(low, 0.25 * lightest + 0.5 * high), high
        everything = np.concatenate([self._within(table, table.x) for table in tables])
        noise = np.concatenate([self._within(table, table.variance) for table in tables])
        self.events = everything.size
        total = self._width(everything) ** 2 if self.events else (0.1 * lightest) ** 2
        self.noise, self.mean_noise = 1.0, 1.0
        if self.events:
            self.noise, self.mean_noise = float(np.median(noise)), float(noise.mean())
        self.width = math.sqrt(max(total, self.noise))
        self.noise = min(self.noise, self.width**2)
        self.knots = self._middles()
        points, steps = np.polynomial.legendre.leggauss(_NODES)
        half = (self.ends[1] - self.ends[0]) / 2
        self.nodes, self.steps = self.ends[0] + half * (points + 1), half * steps
        self.tables = [self._window(table) for table in tables]
        self.learned = any(table.learned for table in self.tables)
        self.back_mean, self.back_variance, self.back_share = self._background()
        parts: list[tuple[float, float, float, float]] = [
            ((1 - _MASS_RANGE) * mass, (1 + _MASS_RANGE) * mass, mass, self.width)
            for mass in masses.tolist()
        ]
        parts.append((-0.3 * lightest, 0.3 * lightest, 0.0, self.width))
        narrowest, log_width = math.log(self.noise) / 2, math.log(self.width)
        for mass in self.masses:
            # of the lightest mass, times the root of the mass over its: standard deviation of a
            # species
            widest = max(0.35 * math.sqrt(lightest * mass), 2 * math.sqrt(self.noise))
            parts.append((narrowest, math.log(widest), log_width, WIDTH_STEP))
        # of a peak's width: a tail, at most and at first
        parts.append((-2.0, 2.0, 0.2, 1.0))
        self.tail = len(parts) - 1
        parts += [(-LOGIT_REACH, LOGIT_REACH, 0.0, 1.0)] * (self.knots.size - 1)
        if self.learned:
            edge = np.concatenate([t.x for t in self.tables if t.learned])
            # quantile of the events where their edge is sought
            rise = float(np.quantile(edge, 0.02)) if edge.size else self.ends[0]
            # of a peak's width: how far above that edge the limit may lie
            highest = max(1.3 * lightest, rise + 3.0 * self.width)
            parts.append((self.ends[0] - 3 * self.width, highest, rise, self.width))
            parts.append((0.25 * self.width, 1.6 * self.width, _SOFT * self.width, self.width))
        self.shares = len(parts)
        parts += [(-LOGIT_REACH, LOGIT_REACH, _FIRST_BACKGROUND, 1.0)] * self.number
        self.own = len(parts)
        parts += [(-LOGIT_REACH, LOGIT_REACH, 0.0, 1.0)] * (self.number * (self.kinds - 1))
        self.low, self.high, self.first, self.scale = np.array(parts).T
        self._priors()

    def _within(self, table: Events, values: FloatArray) -> FloatArray:
        return values[(table.x > self.ends[0]) & (table.x < self.ends[1])]

    def _width(self, x: FloatArray) -> float:
        """Width of the narrowest peak, from the median distance to it."""
        lightest = float(self.masses.min())
        found = []
        for mass in self.masses:
            # of the lightest mass: events of a peak
            near = x[np.abs(x - mass) < 0.4 * lightest]
            if near.size > 0.05 * x.size:
                found.append(SIGMA_PER_MAD * float(np.median(np.abs(near - np.median(near)))))
        return min(max(min(found, default=0.12 * lightest), 0.02 * lightest), 0.3 * lightest)

    def _middles(self) -> FloatArray:
        """Give the ends of the window, and the middles of gaps between peaks that are apart."""
        order = np.sort(self.masses)
        apart = np.diff(order) > 3 * self.width
        gaps = ((order[:-1] + order[1:]) / 2)[apart]
        return np.array([self.ends[0], *gaps, self.ends[1]])

    def _background(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give means, variances and weights of the parts of the background, for each middle.

        Beyond the ends there is one more part, which goes with that at the end.

        Shapes: results (b,), (b,), (b, middles).
        """
        step = np.diff(self.knots)
        mean = np.concatenate([[self.knots[0] - step[0]], self.knots, [self.knots[-1] + step[-1]]])
        gaps = np.concatenate([[step[0]], step, [step[-1]]])
        # width of a part over the distance to its neighbours
        width = 0.5 * (np.append(gaps[0], gaps) + np.append(gaps, gaps[-1])) / 2
        low, high = self.ends
        inside = ndtr((high - mean) / width) - ndtr((low - mean) / width)
        middles = np.eye(self.knots.size)
        share = np.vstack([middles[:1], middles, middles[-1:]])
        share[[0, -1]] *= inside[[0, -1], None]
        share[1:-1] *= inside[1:-1, None]
        # As much of a part as lies within the window, of one that varies as the density would.
        return mean, width**2, share / (share.sum(axis=0) * inside[:, None])

    def _window(self, table: Events) -> Window:
        """Take a table's events within the window."""
        low, high = self.ends
        inside = (table.x >= low) & (table.x < high)
        seen, known = self.steps, table.efficiency
        softest = (high - low) / _NODES
        if known is not None and not _cut(table, softest):
            reach = np.maximum(known.extra_sigma(np.sqrt([self.mean_noise])), softest)
            seen = seen * ndtr((self.nodes - known.threshold_kda) / reach)
        return Window(table.x[inside], table.variance[inside], seen, known is None)

    def _priors(self) -> None:
        """Mean and width of the prior of combinations of parameters."""
        one, place, lightest = np.eye(self.own), self.parts, float(self.masses.min())
        bends = slice(self.tail + 1, self.tail + self.knots.size)
        shape = np.vstack([np.zeros(self.own), one[bends]])  # the first knot's logarithm is 0
        # of a peak's width: a tail; less, and a tail of one width is taken for a limit
        rows = [one[place] / (_OFFSET * lightest), one[self.tail] / 1.5]
        # of the logarithm of the background's density over the window
        rows += [shape[-1] / 0.7]
        # of the same between its middles, away from the line between their neighbours
        rows += list((shape[1:-1] - (shape[:-2] + shape[2:]) / 2) / 0.15)
        middle = [0.0] * len(rows)
        if self.learned:
            # of the lightest mass: where the limit may lie about the lower end of the events
            at, spread = self.shares - 2, 0.5 * lightest
            rows += [one[at] / spread, one[at + 1] / (_SOFTNESS * self.width)]
            middle += [float(self.first[at]) / spread, _SOFT / _SOFTNESS]
        widths, usual = width_prior(self.masses)
        # Shares of background scatter about a level that they have in common.
        # logit of the background's share: of the series, and of one table about that
        covariance = np.full((self.number, self.number), 3.0**2)
        covariance += 0.7**2 * np.eye(self.number)
        apart = np.linalg.inv(np.linalg.cholesky(covariance))
        self.prior_design = np.vstack(
            [*rows, widths @ one[place + 1 : self.tail], apart @ one[self.shares :]]
        )
        self.prior_middle = np.concatenate(
            [middle, usual, apart @ np.full(self.number, _FIRST_BACKGROUND)]
        )

    def shared(self, theta: FloatArray) -> Shared:
        """Convert parameters to masses, widths and the limit of detection."""
        place, limit = self.parts, (math.nan, math.nan)
        if self.learned:
            limit = float(theta[self.shares - 2]), float(theta[self.shares - 1])
        mean = self.composition @ theta[:place] + theta[place]
        variance = np.exp(2 * theta[place + 1 : self.tail]) - self.noise
        return Shared(mean, variance, float(theta[self.tail]), limit)

    def _parts(self, common: NDArray[Any]) -> NDArray[Any]:
        """Give ln of the share, μ and τ² of the parts of every species and of the background.

        Complex parameters give the slopes with the values (complex steps: Squire & Trapp, SIAM
        Rev. 40, 110, 1998).

        Shapes: `common` (…, shares), what tables share, result (…, 3, parts).
        """
        place, tail = self.parts, common[..., self.tail, None]
        mean = common[..., :place] @ self.composition.T + common[..., place, None]
        width = np.exp(common[..., place + 1 : self.tail])
        reach = (tail * width)[..., None]
        means, variances = mean[..., None] + reach * MEANS, reach**2 * VARIANCES
        variances = variances + (width**2)[..., None] - self.noise
        nothing = np.zeros_like(tail)
        bends = common[..., self.tail + 1 : self.tail + self.knots.size]
        shape = np.exp(np.concatenate([nothing, bends], axis=-1))
        back = (shape @ self.back_share.T) / shape.sum(axis=-1, keepdims=True)
        level = np.broadcast_to(nothing, back.shape)
        columns = (
            (np.log(SHARES) + 0 * reach, np.log(back)),
            (means, self.back_mean + level),
            (variances, self.back_variance + level),
        )
        front = (*common.shape[:-1], -1)
        rows = [np.concatenate([own.reshape(front), rest], axis=-1) for own, rest in columns]
        return np.stack(rows, axis=-2)

    def modes(self, theta: FloatArray) -> FloatArray:
        """Give the masses at which the peaks are highest, for the median noise of events.

        Of what a tail moves, means and their offset, it is what the events tell.

        Shapes: result (k,).
        """
        size = self.kinds * SHARES.size
        parts = self._parts(theta[: self.shares])[1:, :size].reshape(2, self.kinds, -1)
        return np.array([top_of(SHARES, m, v + self.noise) for m, v in zip(*parts, strict=True)])

    def detected(self, theta: FloatArray) -> FloatArray:
        """Give the share of each species that the learned limit lets through; else 1.

        Shapes: result (k,).
        """
        if not self.learned:
            return np.ones(self.kinds)
        now = self.shared(theta)
        limit, spread = now.limit
        total = now.variance + self.noise
        at = (now.mean + now.tail * np.sqrt(total) - limit) / np.sqrt(total + spread**2)
        return np.asarray(ndtr(at))

    def logits(self, theta: FloatArray) -> FloatArray:
        """Give the logits of the species of each table, the first 0.

        Shapes: result (tables, k).
        """
        found = theta[self.own :].reshape(self.number, self.kinds - 1)
        return np.hstack([np.zeros((self.number, 1)), found])

    def background(self, theta: FloatArray) -> FloatArray:
        """Share of the background of each table among what came, (tables,)."""
        return np.asarray(expit(theta[self.shares : self.own]))

    def _scores(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood of each table; its slopes in what tables share, its share and its logits.

        Shapes: `theta` (p,), results (tables,), (tables, shares + k).
        """
        common, logits, share = theta[: self.shares], self.logits(theta), self.background(theta)
        step = 1e-30  # whose square is nothing beside 1
        rises = self._parts(common + 1j * step * np.eye(common.size)).imag / step
        log_part, mean, variance = self._parts(common)
        kinds, first = softmax(logits, axis=1), SHARES.size * np.arange(self.kinds + 1)
        of_kind = np.hstack([kinds * (1 - share)[:, None], share[:, None]])
        weight = np.repeat(of_kind, np.diff(first, append=mean.size), axis=1) * np.exp(log_part)
        values = np.zeros(self.number)
        by_part = np.zeros((self.number, 3, mean.size))
        for number, table in enumerate(self.tables):
            if table.x.size:
                values[number], by_part[number] = mixture_score(
                    table.x, table.noise, (weight[number], mean, variance)
                )
        # The chance that a particle of a part is seen within the window, (tables, parts).
        limit, spread = self.shared(theta).limit
        seen = np.array([table.seen for table in self.tables])
        at_nodes = (self.nodes - limit) / spread
        if self.learned:
            seen[[table.learned for table in self.tables]] = self.steps * ndtr(at_nodes)
        total = variance + self.mean_noise
        away = self.nodes[:, None] - mean
        density = np.exp(-0.5 * away**2 / total) / np.sqrt(2 * math.pi * total)
        rise = away / total * density
        bend = 0.5 * (away**2 / total - 1) / total * density
        chance = seen @ density
        size = np.array([table.x.size for table in self.tables])
        norm = np.maximum((chance * weight).sum(axis=1), _TINY)
        values -= size * np.log(norm)
        over = (size / norm)[:, None]
        by_part -= (over * weight)[:, None] * np.stack([chance, seen @ rise, seen @ bend], axis=1)
        by_kind = np.add.reduceat(by_part[:, 0], first, axis=1)
        of_species, of_back = by_kind[:, :-1].sum(axis=1), by_kind[:, -1]
        slopes = np.hstack(
            [
                np.einsum("tcq,pcq->tp", by_part, rises),
                (of_back * (1 - share) - of_species * share)[:, None],
                (by_kind[:, :-1] - of_species[:, None] * kinds)[:, 1:],
            ]
        )
        if self.learned:
            bell = self.steps * np.exp(-0.5 * at_nodes**2) / math.sqrt(2 * math.pi)
            by_node = over * (weight @ density.T) * bell
            for number, table in enumerate(self.tables):
                if not table.learned:
                    continue
                at = (table.x - limit) / spread
                log_seen = log_ndtr(at)
                values[number] += float(log_seen.sum())
                tilt = np.exp(-0.5 * at**2 - log_seen) / math.sqrt(2 * math.pi)
                nodes = by_node[number]
                slopes[number, self.shares - 2] = (nodes.sum() - tilt.sum()) / spread
                slopes[number, self.shares - 1] = (nodes @ at_nodes - tilt @ at) / spread
        return values, slopes

    def likelihood(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood with its priors, and its slope.

        Shapes: `theta` (p,), slope (p,).
        """
        values, slopes = self._scores(theta)
        distance = self.prior_design @ theta[: self.own] - self.prior_middle
        common, share, logits = np.split(slopes, [self.shares, self.shares + 1], axis=1)
        slope = np.concatenate([common.sum(axis=0), share.ravel(), logits.ravel()])
        slope[: self.own] -= self.prior_design.T @ distance
        return float(values.sum()) - 0.5 * float(distance @ distance), slope

    def turned(self, theta: FloatArray, tail: float) -> FloatArray:
        """Give peaks as wide and in the same places with another tail, on a level background.

        Shapes: `theta` (at least own,), result the same.
        """
        found, at = theta.copy(), self.parts
        before, light = theta[self.tail], int(np.argmin(self.masses))
        widths = slice(at + 1, self.tail)
        found[widths] += np.log((1 + before**2) / (1 + tail**2)) / 2
        found[at] += before * math.exp(theta[at + 1 + light])
        found[at] -= tail * math.exp(found[at + 1 + light])
        found[self.tail] = tail
        found[self.tail + 1 : self.tail + self.knots.size] = 0.0
        return found

    def problem(self) -> Problem:
        """Give what is maximised where every table's weights are free."""
        return Problem(self.likelihood, self.low, self.high, self.scale, self.events)
