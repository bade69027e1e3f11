"""The likelihood of a series of tables whose species share masses, shape and detector.

What the events between the ends of a window, half of the lightest species below and above all of
them, have in common:

- Species of mass Σ n_p m_p + b.  The offset b is an error of the mass scale, of `_OFFSET` of the
  lightest species (a prior, as all widths that follow).
- Peaks with an exponential tail t, of either sign (`_kernels.tailed_mixture`), and a variance that
  goes with the mass, from that of the lightest to that of the complex.
- A background whose density is learned: it is linear between the middles of the gaps between
  species, so that it bends nowhere under a peak, and is of the same shape in every table.  Its
  share is each table's own.
- Of tables that do not say what was missed, one chance of detection Φ((x − T)/r) of what was
  measured, T and r learned from their own rising edge.

Events beyond the window, as aggregates, say nothing of the species and are left out, which is
exact: the likelihood is that of events within it.  What is between a peak and the next is described
by three parameters, and that is why they are there: with normal peaks on a background of given
density, K_D of skewed peaks was 0.79 of the truth and no interval held it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from iminuit import Minuit
from scipy.special import log_ndtr, ndtr

from iscat_analysis._kernels.tailed_mixture import tailed_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.structure import LOGIT_REACH

_MASS_RANGE = 0.2  # of the masses that were given
_OFFSET = 0.05  # of the lightest mass
_WIDEST = 0.35  # of the lightest: standard deviation of a species
_LONGEST = 0.4  # of the lightest: a tail
_WIDTH_SPREAD = 0.5  # of the squared width: how the widths of species differ
_TAIL_SPREAD = 1.5  # of a peak's width: a tail; less, and a tail of one width is taken for a limit
_BACKGROUND_SPREAD = 1.5  # of the logarithm of the background's density from one middle to another
_FIRST_BACKGROUND, _BACKGROUND = -5.0, 2.0  # its logit
_SOFT, _SOFTNESS = 0.6, 0.3  # of a peak's width: spread of the limit of detection
# Of the lightest mass: where the limit may lie about the lower end of the events
_LIMIT_SPREAD = 0.5
_EDGE_QUANTILE = 0.02  # quantile of the events where their edge is sought
_NODES = 64
_NOISE_KINDS = 8  # of noise, in each table
_PEAK_REACH = 0.4  # of the lightest mass: events of a peak
_SIGMA_PER_MAD = 1.4826
_MINUIT_STRATEGY = 0  # strategy of Minuit without second derivatives, which take n²/2 values
_TOLERANCE = 0.01  # of Minuit: 1e-5 of the log-likelihood
_LEAST_INSET = 1e-3  # of its range that a start lies away from a limit, where Minuit sees no slope


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


class Series(ABC):
    """Tables of species that share masses and shape; their weights are told apart.

    The parameters are the masses, the offset, the variances of the lightest and of the heaviest
    species, the tail, the background's shape, the limit of detection and its spread where they are
    learned, and the shares of background; those that weights depend on follow.
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
        self.width = math.sqrt(max(total, typical))
        self.knots = self._middles()
        self.tables = [self._window(table) for table in tables]
        self.learned = any(table.learned for table in self.tables)
        own = max(self.width**2 - typical, 0.05 * self.width**2)
        widest = (_WIDEST * lightest) ** 2
        names = [f"mass {part}" for part in range(self.parts)]
        names += ["offset", "variance", "variance of the heaviest", "tail"]
        names += [f"background {place}" for place in range(1, self.knots.size)]
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
            names += ["limit", "spread of the limit"]
            edge = np.concatenate([t.x for t in self.tables if t.learned])
            rise = float(np.quantile(edge, _EDGE_QUANTILE)) if edge.size else self.ends[0]
            low += [self.ends[0] - 3 * self.width, 0.25 * self.width]
            high += [max(1.3 * lightest, rise + self.width), 1.6 * self.width]
            start += [rise, _SOFT * self.width]
            scale += [self.width, self.width]
        self.shares = len(names)
        names += [f"share {number}" for number in range(self.number)]
        low += [-LOGIT_REACH] * self.number
        high += [LOGIT_REACH] * self.number
        start += [_FIRST_BACKGROUND] * self.number
        scale += [1.0] * self.number
        self.own = len(names)
        self.names = names
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
        bends = self.knots.size - 1
        rows += [({place + 4 + bend: 1.0}, 0.0, _BACKGROUND_SPREAD) for bend in range(bends)]
        if self.learned:
            at = self.shares - 2
            rows.append(({at: 1.0}, float(self.first[at]), _LIMIT_SPREAD * lightest))
            rows.append(({at + 1: 1.0}, _SOFT * self.width, _SOFTNESS * self.width))
        rows += [
            ({self.shares + n: 1.0}, _FIRST_BACKGROUND, _BACKGROUND) for n in range(self.number)
        ]
        self.prior_design = np.zeros((len(rows), self.own))
        for row, (parts, _, width) in enumerate(rows):
            for at, value in parts.items():
                self.prior_design[row, at] = value / width
        self.prior_middle = np.array([middle / width for _, middle, width in rows])

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

    def weights(self, theta: FloatArray, logits: FloatArray) -> FloatArray:
        """Shares of the species and of the background, among the particles that came.

        The background's logit counts from all species together.

        Shapes: `logits` (tables, k), result (tables, k + 1).
        """
        species = np.exp(logits - np.logaddexp.reduce(logits, axis=1)[:, None])
        odds = np.exp(theta[self.shares : self.own])[:, None]
        return np.asarray(np.hstack([species, odds]) / (1 + odds))

    def value(self, theta: FloatArray, logits: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Log-likelihood with its priors, its gradient, and that in the logits of the species.

        Shapes: `theta` (at least `own`,), `logits` (tables, k), slopes (own,) and (tables, k).
        """
        now, weights = self.shared(theta), self.weights(theta, logits)
        distance = self.prior_design @ theta[: self.own] - self.prior_middle
        total = -0.5 * float(distance @ distance)
        slope = -self.prior_design.T @ distance
        by_logits = np.zeros(logits.shape)
        place = self.parts
        limit, spread = now.limit
        for number, table in enumerate(self.tables):
            seen = table.seen
            if table.learned:
                at_nodes = (table.nodes - limit) / spread
                seen = np.tile(table.steps * ndtr(at_nodes), (table.size.size, 1))
            found, by_weight, by_peak, by_shape, by_seen = tailed_score(
                table.x, table.noise, table.background, table.size, table.kind_noise,
                table.nodes, table.node_background, seen,
                weights[number], now.mean, now.variance, now.tail, now.shape,
            )  # fmt: skip
            total += found
            slope[:place] += by_peak[0] @ self.composition
            slope[place] += by_peak[0].sum()
            slope[place + 1] += by_peak[1] @ (1 - self.along)
            slope[place + 2] += by_peak[1] @ self.along
            slope[place + 3] += by_peak[2].sum()
            bends = by_shape - by_shape.sum() * now.shape
            slope[place + 4 : place + 3 + self.knots.size] += bends[1:]
            back = weights[number, -1]
            slope[self.shares + number] += by_weight[-1] * (1 - back)
            slope[self.shares + number] -= by_weight[:-1].sum() * back
            part = weights[number, :-1] / weights[number, :-1].sum()
            by_logits[number] = by_weight[:-1] - by_weight[:-1].sum() * part
            if table.learned:
                at = (table.x - limit) / spread
                log_seen = log_ndtr(at)
                total += float(log_seen.sum())
                rise = np.exp(-0.5 * at**2 - log_seen) / math.sqrt(2 * math.pi)
                bell = table.steps * np.exp(-0.5 * at_nodes**2) / math.sqrt(2 * math.pi)
                by_node = by_seen.sum(axis=0) * bell
                slope[self.shares - 2] -= (rise.sum() + by_node.sum()) / spread
                slope[self.shares - 1] -= (rise @ at + by_node @ at_nodes) / spread
        return total, slope, by_logits

    @abstractmethod
    def height(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood of all parameters, with its priors, and its slope."""

    def maximum(self, start: FloatArray) -> Minuit:
        """Maximise the height from a start."""
        last = lru_cache(maxsize=1)(lambda theta: self.height(np.frombuffer(theta)))
        inner = _LEAST_INSET * (self.high - self.low)
        search = Minuit(
            lambda theta: -last(theta.tobytes())[0],
            np.clip(start, self.low + inner, self.high - inner),
            grad=lambda theta: -last(theta.tobytes())[1],
            name=self.names,
        )
        search.errordef, search.strategy, search.tol = (
            Minuit.LIKELIHOOD,
            _MINUIT_STRATEGY,
            _TOLERANCE,
        )
        search.limits = list(zip(self.low, self.high, strict=True))
        search.errors = self.scale / math.sqrt(max(self.events, 1))
        return search.migrad()


class Free(Series):
    """A series whose weights are free in every table."""

    def __init__(
        self, tables: Sequence[Events], composition: FloatArray, masses: FloatArray
    ) -> None:
        super().__init__(tables, composition, masses)
        free = self.number * (self.kinds - 1)
        self.names += [f"logit {place}" for place in range(free)]
        self.low = np.append(self.low, np.full(free, -LOGIT_REACH))
        self.high = np.append(self.high, np.full(free, LOGIT_REACH))
        self.scale = np.append(self.scale, np.ones(free))
        self.first = np.append(self.first, np.zeros(free))

    def logits(self, theta: FloatArray) -> FloatArray:
        """Give the logits of the species, the first 0."""
        found = theta[self.own :].reshape(self.number, self.kinds - 1)
        return np.hstack([np.zeros((self.number, 1)), found])

    def height(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood and its slope."""
        total, slope, by_logits = self.value(theta, self.logits(theta))
        return total, np.append(slope, by_logits[:, 1:])

    def information(self, theta: FloatArray) -> FloatArray:
        """Minus the second derivatives of the height.

        Shapes: `theta` (p,), result (p, p).
        """
        rows = []
        for place, step in enumerate(0.1 * self.scale / math.sqrt(max(self.events, 1))):
            above, below = theta.copy(), theta.copy()
            above[place] = min(theta[place] + step, self.high[place])
            below[place] = max(theta[place] - step, self.low[place])
            rise = self.height(above)[1] - self.height(below)[1]
            rows.append(-rise / (above[place] - below[place]))
        found = np.array(rows)
        return np.asarray((found + found.T) / 2)
