"""The likelihood of a series of tables whose species share masses, shape and detector.

What the events between the ends of a window, half of the lightest species below and above all of
them, have in common:

- Species of mass Σ n_p m_p + b.  The offset b is an error of the mass scale, of `_OFFSET` of the
  lightest species (a prior, as all widths that follow).
- Peaks with an exponential tail t, of either sign (`_kernels.tailed_mixture`), and a variance that
  goes with the mass, from that of the lightest to that of the complex.
- A background whose density is learned: it is linear between the middles of the gaps between
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
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import erfcx, log_ndtr, ndtr

from iscat_analysis._kernels.tailed_mixture import tailed_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.maximum import Problem
from iscat_analysis.species.structure import LOGIT_REACH

_MASS_RANGE = 0.2  # of the masses that were given
_OFFSET = 0.05  # of the lightest mass
_WIDEST = 0.35  # of the lightest: standard deviation of a species
_LONGEST = 0.4  # of the lightest: a tail
_WIDTH_SPREAD = 0.5  # of the squared width: how the widths of species differ
# Of a peak's width: a tail; less, and a tail of one width is taken for a limit
_TAIL_SPREAD = 1.5
_SLOPE_SPREAD = 0.7  # of the logarithm of the background's density over the window
# Of the same between its middles, away from the line between their neighbours
_BEND_SPREAD = 0.15
_FIRST_BACKGROUND, _BACKGROUND = -6.0, 3.0  # logit of its share: of the series
_SHARE_SPREAD = 0.7  # of one table about that
_SOFT, _SOFTNESS = 0.6, 0.3  # of a peak's width: spread of the limit of detection
# Of the lightest mass: where the limit may lie about the lower end of the events
_LIMIT_SPREAD = 0.5
_EDGE_QUANTILE = 0.02  # quantile of the events where their edge is sought
_ABOVE_RISE = 3.0  # of a peak's width: how far above that edge the limit may lie
_NODES = 64
_NOISE_KINDS = 8  # of noise, in each table
_PEAK_REACH = 0.4  # of the lightest mass: events of a peak
_SIGMA_PER_MAD = 1.4826
_NARROW = 0.1  # of the squared width: what a start leaves beside the tail
_NO_TAIL = 1e-3  # of a peak's width
_DIFFERENCE = 1e-3  # of about a standard error: steps for second derivatives


@dataclass(frozen=True, eq=False)
class Window:
    """The events of one table inside the mass window, and its detector.

    Shapes: `x, noise` (n,), `size, kind_noise` (c,), `nodes, steps` (g,), `seen` (c, g).
    """

    x: FloatArray
    noise: FloatArray
    size: FloatArray
    kind_noise: FloatArray
    nodes: FloatArray
    steps: FloatArray
    seen: FloatArray
    learned: bool
    background: FloatArray
    node_background: FloatArray


@dataclass(frozen=True, eq=False)
class Shared:
    """Parameters that all tables share; `Series.shared` makes it."""

    mean: FloatArray
    variance: FloatArray
    tail: float
    shape: FloatArray
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
        self.ends = 0.5 * lightest, float(self.masses.max()) + 0.5 * lightest
        self.along = (self.masses - lightest) / max(float(np.ptp(self.masses)), 1e-9)
        everything = np.concatenate([self._within(table, table.x) for table in tables])
        noise = np.concatenate([self._within(table, table.variance) for table in tables])
        self.events = everything.size
        total = self._width(everything) ** 2 if self.events else (0.1 * lightest) ** 2
        typical = float(np.median(noise)) if self.events else 1.0
        self.noise = typical
        self.width = math.sqrt(max(total, typical))
        self.knots = self._middles()
        self.tables = [self._window(table) for table in tables]
        self.learned = any(table.learned for table in self.tables)
        own = max(self.width**2 - typical, 0.05 * self.width**2)
        widest = (_WIDEST * lightest) ** 2
        low = [*((1 - _MASS_RANGE) * masses), -0.3 * lightest, 0.0, 0.0, -_LONGEST * lightest]
        high = [*((1 + _MASS_RANGE) * masses), 0.3 * lightest, widest, widest, _LONGEST * lightest]
        start = [*masses, 0.0, min(own, widest / 2), min(own, widest / 2), 0.2 * self.width]
        scale = [*np.full(self.parts, self.width), self.width, *[self.width**2] * 2, self.width]
        bends = self.knots.size - 1
        low += [-LOGIT_REACH] * bends
        high += [LOGIT_REACH] * bends
        start += [0.0] * bends
        scale += [1.0] * bends
        if self.learned:
            edge = np.concatenate([t.x for t in self.tables if t.learned])
            rise = float(np.quantile(edge, _EDGE_QUANTILE)) if edge.size else self.ends[0]
            low += [self.ends[0] - 3 * self.width, 0.25 * self.width]
            high += [max(1.3 * lightest, rise + _ABOVE_RISE * self.width), 1.6 * self.width]
            start += [rise, _SOFT * self.width]
            scale += [self.width, self.width]
        self.shares = len(start)
        low += [-LOGIT_REACH] * self.number
        high += [LOGIT_REACH] * self.number
        start += [_FIRST_BACKGROUND] * self.number
        scale += [1.0] * self.number
        self.own = len(start)
        free = self.number * (self.kinds - 1)
        low += [-LOGIT_REACH] * free
        high += [LOGIT_REACH] * free
        start += [0.0] * free
        scale += [1.0] * free
        self.low, self.high, self.first, self.scale = map(np.array, (low, high, start, scale))
        self._priors()

    def _within(self, table: Events, values: FloatArray) -> FloatArray:
        return values[(table.x > self.ends[0]) & (table.x < self.ends[1])]

    def _width(self, x: FloatArray) -> float:
        """Width of the narrowest peak, from the median distance to it."""
        lightest = float(self.masses.min())
        found = []
        for mass in self.masses:
            near = x[np.abs(x - mass) < _PEAK_REACH * lightest]
            if near.size > 0.05 * x.size:
                found.append(_SIGMA_PER_MAD * float(np.median(np.abs(near - np.median(near)))))
        return min(max(min(found, default=0.12 * lightest), 0.02 * lightest), 0.3 * lightest)

    def _middles(self) -> FloatArray:
        """Give the ends of the window, and the middles of gaps between peaks that are apart."""
        order = np.sort(self.masses)
        gaps = [
            (below + above) / 2
            for below, above in pairwise(order)
            if above - below > 3 * self.width
        ]
        return np.array([self.ends[0], *gaps, self.ends[1]])

    def _hats(self, x: FloatArray) -> FloatArray:
        """Triangular basis functions of area 1 on the middles."""
        found = np.array([np.interp(x, self.knots, row) for row in np.eye(self.knots.size)])
        step = np.diff(self.knots)
        area = 0.5 * (np.append(step, 0.0) + np.append(0.0, step))
        return np.ascontiguousarray((found / area[:, None]).T)

    def _window(self, table: Events) -> Window:
        """Take a table's events within the window, in kinds of noise."""
        low, high = self.ends
        softest = (high - low) / _NODES
        known = table.efficiency
        sharp = known is not None and float(known.extra_sigma(table.sigma).max()) < softest
        if known is not None and sharp:
            low = min(max(low, known.threshold_kda), 0.5 * (low + high))
        inside = (table.x >= low) & (table.x < high)
        x, sigma = table.x[inside], table.sigma[inside]
        parts = (
            np.array_split(np.sort(sigma), _NOISE_KINDS if np.ptp(sigma) > 0 else 1)
            if x.size
            else []
        )
        size = np.array([float(part.size) for part in parts if part.size])
        each = np.array([float(part.mean()) for part in parts if part.size])
        points, steps = np.polynomial.legendre.leggauss(_NODES)
        nodes = low + (high - low) * (points + 1) / 2
        steps = steps * (high - low) / 2
        seen = np.tile(steps, (size.size, 1))
        if known is not None and not sharp:
            reach = np.maximum(known.extra_sigma(each), softest)[:, None]
            seen = steps * ndtr((nodes - known.threshold_kda) / reach)
        return Window(
            x, sigma**2, size, each**2, nodes, steps, seen, known is None,
            self._hats(x), self._hats(nodes),
        )  # fmt: skip

    def _priors(self) -> None:
        """Mean and width of the prior of combinations of parameters."""
        lightest = float(self.masses.min())
        rows: list[tuple[dict[int, float], float, float]] = []
        place = self.parts
        rows.append(({place: 1.0}, 0.0, _OFFSET * lightest))
        rows.append(({place + 1: -1.0, place + 2: 1.0}, 0.0, _WIDTH_SPREAD * self.width**2))
        rows.append(({place + 3: 1.0}, 0.0, _TAIL_SPREAD * self.width))
        last = self.shares - (2 if self.learned else 0) - 1
        rows.append(({last: 1.0}, 0.0, _SLOPE_SPREAD))
        for knot in range(1, self.knots.size - 1):
            at = place + 3 + knot  # the first knot's logarithm is 0 and no parameter
            below = {at - 1: -0.5} if knot > 1 else {}
            rows.append(({**below, at: 1.0, at + 1: -0.5}, 0.0, _BEND_SPREAD))
        if self.learned:
            at = self.shares - 2
            rows.append(({at: 1.0}, float(self.first[at]), _LIMIT_SPREAD * lightest))
            rows.append(({at + 1: 1.0}, _SOFT * self.width, _SOFTNESS * self.width))
        self.prior_design = np.zeros((len(rows), self.own))
        for row, (parts, _, width) in enumerate(rows):
            for at, value in parts.items():
                self.prior_design[row, at] = value / width
        self.prior_middle = np.array([middle / width for _, middle, width in rows])
        # Shares of background scatter about a level that they have in common.
        covariance = np.full((self.number, self.number), _BACKGROUND**2)
        covariance += _SHARE_SPREAD**2 * np.eye(self.number)
        apart = np.zeros((self.number, self.own))
        apart[:, self.shares :] = np.linalg.inv(np.linalg.cholesky(covariance))
        self.prior_design = np.vstack([self.prior_design, apart])
        level = np.full(self.number, _FIRST_BACKGROUND)
        self.prior_middle = np.append(self.prior_middle, apart[:, self.shares :] @ level)

    def shared(self, theta: FloatArray) -> Shared:
        """Convert parameters to masses, widths and the shape of the background."""
        place = self.parts
        mean = self.composition @ theta[:place] + theta[place]
        light, heavy, tail = theta[place + 1 : place + 4]
        variance = light + (heavy - light) * self.along
        logits = np.append(0.0, theta[place + 4 : place + 3 + self.knots.size])
        shape = np.exp(logits - logits.max())
        limit = (math.nan, math.nan)
        if self.learned:
            limit = float(theta[self.shares - 2]), float(theta[self.shares - 1])
        return Shared(mean, variance, float(tail), shape / shape.sum(), limit)

    def modes(self, theta: FloatArray) -> FloatArray:
        """Give the masses at which the peaks are highest, for the median noise of events.

        There the density of the peak is that of its normal part alone; of what a tail moves, means
        and their offset, it is what the events tell.

        Shapes: result (k,).
        """
        now = self.shared(theta)
        tail = abs(now.tail)
        found = now.mean.copy()
        for number, width in enumerate(np.sqrt(now.variance + self.noise)):
            shift = tail
            if tail > _NO_TAIL * width:
                level = math.sqrt(2 / math.pi) * tail / width

                def excess(away: float, width: float = width, level: float = level) -> float:
                    at = (width / tail - away / width) / math.sqrt(2)
                    return float(erfcx(at)) - level

                shift = float(scipy.optimize.brentq(excess, 0.0, tail))
            found[number] += math.copysign(shift, now.tail)
        return found

    def detected(self, theta: FloatArray) -> FloatArray:
        """Give the share of each species that the learned limit lets through; else 1.

        Shapes: result (k,).
        """
        now = self.shared(theta)
        if not self.learned:
            return np.ones(self.kinds)
        limit, spread = now.limit
        reach = np.sqrt(now.variance + self.noise + spread**2)
        return np.asarray(ndtr((now.mean + now.tail - limit) / reach))

    def logits(self, theta: FloatArray) -> FloatArray:
        """Give the logits of the species of each table, the first 0.

        Shapes: result (tables, k).
        """
        found = theta[self.own :].reshape(self.number, self.kinds - 1)
        return np.hstack([np.zeros((self.number, 1)), found])

    def weights(self, theta: FloatArray) -> FloatArray:
        """Shares of the species and of the background, among the particles that came.

        The background's logit counts from all species together.

        Shapes: result (tables, k + 1).
        """
        logits = self.logits(theta)
        species = np.exp(logits - np.logaddexp.reduce(logits, axis=1)[:, None])
        odds = np.exp(theta[self.shares : self.own])[:, None]
        return np.asarray(np.hstack([species, odds]) / (1 + odds))

    def _places(self, number: int) -> NDArray[np.intp]:
        """Tell where the parameters of one table are: common ones, its share, its logits."""
        logits = self.own + number * (self.kinds - 1) + np.arange(self.kinds - 1)
        return np.concatenate([np.arange(self.shares), [self.shares + number], logits])

    def _scores(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood of each table, and its slopes in the parameters of `_places`.

        Shapes: `theta` (p,), results (tables,), (tables, shares + k).
        """
        now, weights = self.shared(theta), self.weights(theta)
        values, slopes = np.zeros(self.number), np.zeros((self.number, self.shares + self.kinds))
        place = self.parts
        limit, spread = now.limit
        for number, table in enumerate(self.tables):
            seen, slope = table.seen, slopes[number]
            if table.learned:
                at_nodes = (table.nodes - limit) / spread
                seen = np.tile(table.steps * ndtr(at_nodes), (table.size.size, 1))
            values[number], by_weight, by_peak, by_shape, by_seen = tailed_score(
                table.x, table.noise, table.background, table.size, table.kind_noise,
                table.nodes, table.node_background, seen,
                weights[number], now.mean, now.variance, now.tail, now.shape,
            )  # fmt: skip
            slope[:place] = by_peak[0] @ self.composition
            slope[place] = by_peak[0].sum()
            slope[place + 1] = by_peak[1] @ (1 - self.along)
            slope[place + 2] = by_peak[1] @ self.along
            slope[place + 3] = by_peak[2].sum()
            bends = by_shape - by_shape.sum() * now.shape
            slope[place + 4 : place + 3 + self.knots.size] = bends[1:]
            species, back = by_weight[:-1].sum(), weights[number, -1]
            slope[self.shares] = by_weight[-1] * (1 - back) - species * back
            part = weights[number, :-1] / (1 - back)
            slope[self.shares + 1 :] = (by_weight[:-1] - species * part)[1:]
            if table.learned:
                at = (table.x - limit) / spread
                log_seen = log_ndtr(at)
                values[number] += float(log_seen.sum())
                rise = np.exp(-0.5 * at**2 - log_seen) / math.sqrt(2 * math.pi)
                bell = table.steps * np.exp(-0.5 * at_nodes**2) / math.sqrt(2 * math.pi)
                by_node = by_seen.sum(axis=0) * bell
                slope[self.shares - 2] = -(rise.sum() + by_node.sum()) / spread
                slope[self.shares - 1] = -(rise @ at + by_node @ at_nodes) / spread
        return values, slopes

    def likelihood(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood with its priors, and its slope.

        Shapes: `theta` (p,), slope (p,).
        """
        values, slopes = self._scores(theta)
        distance = self.prior_design @ theta[: self.own] - self.prior_middle
        slope = np.zeros(theta.shape)
        slope[: self.own] = -self.prior_design.T @ distance
        for number, found in enumerate(slopes):
            slope[self._places(number)] += found
        return float(values.sum()) - 0.5 * float(distance @ distance), slope

    def information(self, theta: FloatArray) -> FloatArray:
        """Minus the second derivatives of `likelihood`, by differences of its slopes.

        Tables share no share and no logit, so that one step in each table's serves all of them.

        Shapes: `theta` (p,), result (p, p).
        """
        here = self._scores(theta)[1]
        places = np.array([self._places(number) for number in range(self.number)])
        found = np.zeros((theta.size, theta.size))
        size = _DIFFERENCE * self.scale / math.sqrt(max(self.events, 1))
        for column in range(places.shape[1]):
            moved, at = theta.copy(), np.unique(places[:, column])
            step = np.where(theta[at] + size[at] > self.high[at], -size[at], size[at])
            moved[at] += step
            steps = moved[places[:, column]] - theta[places[:, column]]
            rise = (here - self._scores(moved)[1]) / steps[:, None]
            for number, row in enumerate(rise):
                found[places[number, column], places[number]] += row
        found = (found + found.T) / 2
        found[: self.own, : self.own] += self.prior_design.T @ self.prior_design
        return found

    def turned(self, theta: FloatArray, tail: float) -> FloatArray:
        """Give peaks as wide and in the same places with another tail, on a level background.

        Shapes: `theta` (at least own,), result the same.
        """
        found, at = theta.copy(), self.parts
        least = _NARROW * self.width**2
        found[at] += theta[at + 3] - tail
        found[at + 1 : at + 3] += theta[at + 3] ** 2 - tail**2
        found[at + 1 : at + 3] = np.maximum(found[at + 1 : at + 3], least)
        found[at + 3] = tail
        found[at + 4 : at + 3 + self.knots.size] = 0.0
        return found

    def problem(self) -> Problem:
        """Give what is maximised where every table's weights are free."""
        return Problem(self.likelihood, self.information, self.low, self.high, self.scale)
