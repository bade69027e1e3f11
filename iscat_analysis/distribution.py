"""What species there are: a mixture fitted to the events themselves, each with its own error.

An event of measured mass x_i and standard deviation σ_i comes from species k with

    x_i ~ N(μ_k, τ_k² + σ_i²),

so the width τ_k is what exceeds the measurement error: extreme deconvolution in one dimension
(Bovy, Hogg & Roweis, Ann. Appl. Stat. 5, 1657, 2011).  Nothing is binned.

Light particles are missed.  The matched filter accepts a particle of mass m if its estimate
y ~ N(m, σ_d²) exceeds u·σ_d, and the fit's x uses the same light at least as well, so that y is x
with further noise: given x, selection no longer depends on m.  The likelihood of the events seen is

    Π_i [Σ_k w_k N(x_i; μ_k, τ_k² + σ_i²)] / Z_i,    Z_i = Σ_k w_k Φ((μ_k − u σ_d)/√(τ_k² + s_i²)),

s_i = max(σ_d, σ_i), and the weights w_k are those of the particles that came, seen or not.

The number of species has the least BIC; a parametric bootstrap gives the intervals and says how
often it would choose that number again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.special import log_ndtr, logsumexp, ndtr
from scipy.stats import chi2 as chi2_distribution

from iscat_analysis._kernels.mixture import mixture_em, mixture_score
from iscat_analysis.records import FloatArray

Branch = Literal["magnitude", "landing", "leaving"]

LEAST_SPECIES = 3
"""Fewer events apart from all others are outliers and no species."""

LEAST_EVENTS = 10
"""Fewer are listed, not described."""

SPECIES_COLUMNS = (
    "mass_kda", "mass_se", "mass_low", "mass_high", "width_kda", "width_low", "width_high",
    "fraction", "fraction_low", "fraction_high", "count", "count_low", "count_high",
    "landing", "leaving", "efficiency", "count_corrected", "corrected_low", "corrected_high",
)  # fmt: skip
"""Columns of the table of species: intervals are 95 %, `fraction` and `count_corrected` are of the
particles that came, the other counts of those that were seen."""

_SIZE_FLOOR = 1e-3  # of a component's share of the events
_EM_STEPS = 40
_POLISHED = 2  # starts, the best after EM
_BOOTSTRAP_TRIES = 50
_SUPPORT_DRAWS = 20
_RIVAL_EVALUATIONS = 150
_BROAD = 0.4  # width over mass
_CURVE_POINTS = 300
_DIGITS = 6  # of the curves in summary.json
_MOST_BINS = 240


@dataclass(frozen=True)
class Efficiency:
    """The chance that a particle is detected.

    Attributes
    ----------
    threshold_snr : float
        u, the matched filter's threshold [standard deviations].
    sigma_kda : float
        σ_d, standard deviation of its estimate of mass [kDa].
    """

    threshold_snr: float
    sigma_kda: float

    def __post_init__(self) -> None:
        if not (self.sigma_kda > 0 and math.isfinite(self.sigma_kda + self.threshold_snr)):
            raise ValueError(
                f"an efficiency needs a finite threshold and a positive sigma_kda, not "
                f"{self.threshold_snr:g} and {self.sigma_kda:g}"
            )

    @property
    def threshold_kda(self) -> float:
        """Mass that is detected every other time [kDa]."""
        return self.threshold_snr * self.sigma_kda

    def __call__(self, mass_kda: ArrayLike) -> FloatArray:
        """Probability of detection.

        Parameters
        ----------
        mass_kda : array_like
            |mass| [kDa].

        Returns
        -------
        ndarray
            Φ(m/σ_d − u).
        """
        mass = np.asarray(mass_kda, dtype=np.float64)
        return np.asarray(ndtr(mass / self.sigma_kda - self.threshold_snr))


@dataclass(frozen=True, eq=False)
class Distribution:
    """Species, curves and verdicts of one set of events; `describe` makes it.

    Attributes
    ----------
    species : pandas.DataFrame
        One row per species by rising mass, columns `SPECIES_COLUMNS`; empty for too few events.
    selection : pandas.DataFrame
        species, log_likelihood, bic, delta_bic of every number of species tried.
    support : float
        Share of simulated repetitions in which BIC chose the same number; NaN without bootstrap.
    histogram : pandas.DataFrame
        low_kda, high_kda, count, count_low, count_high (95 % Poisson).
    curves : pandas.DataFrame
        mass_kda and per kDa: density (kernel), density_se (Poisson), model, model_corrected (of the
        particles that came), efficiency.
    bandwidth_kda : float
        Of the kernel density [kDa].
    events : int
        Events used.
    branch : str
        ``"magnitude"``, ``"landing"`` or ``"leaving"``.
    draws, seed : int
        Of the bootstrap.
    notes : tuple of str
        What the user should know, one sentence each.
    """

    species: pd.DataFrame
    selection: pd.DataFrame
    support: float
    histogram: pd.DataFrame
    curves: pd.DataFrame
    bandwidth_kda: float
    events: int
    branch: Branch
    draws: int
    seed: int
    notes: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Give what ``summary.json`` holds under ``distribution``.

        Returns
        -------
        dict
            Nested plain values, curves by column.
        """
        return {
            "branch": self.branch,
            "events": self.events,
            "species": self.species.to_dict("records"),
            "selection": self.selection.to_dict("records"),
            "support": self.support,
            "histogram": self.histogram.to_dict("list"),
            "curves": {
                name: [float(f"{value:.{_DIGITS}g}") for value in column]
                for name, column in self.curves.items()
            },
            "bandwidth_kda": self.bandwidth_kda,
            "draws": self.draws,
            "seed": self.seed,
            "notes": list(self.notes),
        }


def describe(
    masses: ArrayLike,
    sigmas: ArrayLike,
    *,
    efficiency: Efficiency | None = None,
    max_species: int = 6,
    seed: int,
    branch: Branch = "magnitude",
    draws: int = 100,
) -> Distribution:
    """Describe a set of masses as a mixture of species.

    Parameters
    ----------
    masses : array_like, shape (n,)
        Masses, negative for particles that leave [kDa]; NaN is left out.
    sigmas : array_like, shape (n,)
        Standard deviation of each, positive [kDa].
    efficiency : Efficiency, optional
        Corrects for what was missed; without it nothing was.
    max_species : int
        Largest number to try.
    seed : int
        Of the bootstrap.
    branch : {"magnitude", "landing", "leaving"}
        Which events: |mass| of all, or one side.
    draws : int
        Simulated repetitions for the intervals; 0 for none.

    Returns
    -------
    Distribution
        With an empty table of species where there are fewer than `LEAST_EVENTS` events.

    Raises
    ------
    ValueError
        The arrays differ in shape, or an option is impossible.

    Notes
    -----
    Intervals are the 2.5 and 97.5 % quantiles of the bootstrap, which draws the number of events
    from its own Poisson distribution.
    """
    mass, sigma = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (masses, sigmas))
    if mass.shape != sigma.shape:
        raise ValueError(f"{mass.size} masses but {sigma.size} sigmas")
    if max_species < 1 or draws < 0 or branch not in ("magnitude", "landing", "leaving"):
        raise ValueError(
            f"max_species = {max_species} and draws = {draws} must be positive, and branch = "
            f"{branch!r} one of magnitude, landing, leaving"
        )
    usable = np.isfinite(mass) & np.isfinite(sigma) & (sigma > 0)
    if branch != "magnitude":
        usable &= (mass > 0) == (branch == "landing")
    notes = []
    if branch == "magnitude" and np.count_nonzero(~usable):
        notes.append(f"{np.count_nonzero(~usable)} events without a mass and an error are left out")
    mass, sigma = mass[usable], sigma[usable]
    x, lands = np.abs(mass), mass > 0
    events = _Events(x, sigma, efficiency)
    if x.size < LEAST_EVENTS:
        notes.append(f"{x.size} events are too few for species; {LEAST_EVENTS} are needed")
        return _undescribed(events, branch, draws, seed, notes)

    fits = _fits(events, max_species)
    bic = [fit.bic(x.size) for fit in fits]
    best = fits[int(np.argmin(bic))]
    selection = pd.DataFrame(
        {
            "species": [fit.weight.size for fit in fits],
            "log_likelihood": [fit.log_likelihood for fit in fits],
            "bic": bic,
            "delta_bic": np.subtract(bic, min(bic)),
        }
    )
    repeats, support = _bootstrap(events, best, draws, seed)
    species = _species(events, best, repeats, lands)
    faint = species["efficiency"] < 0.5
    if faint.any():
        notes.append(
            "fewer than half of the particles of "
            + ", ".join(f"{m:.3g}" for m in species["mass_kda"][faint])
            + " kDa are detected: their mass and number rest on the detection model"
        )
    apart = species["count"] < LEAST_SPECIES - 0.5
    if apart.any():
        notes.append(
            "what lies at "
            + ", ".join(f"{m:.3g}" for m in species["mass_kda"][apart])
            + f" kDa is fewer than {LEAST_SPECIES} events: outliers, and no species"
        )
    broad = species["width_kda"] > _BROAD * species["mass_kda"]
    if broad.any():
        notes.append(
            "the species at "
            + ", ".join(f"{m:.3g}" for m in species["mass_kda"][broad])
            + " kDa is as broad as a background: read it as what the other species leave over"
        )
    bandwidth = _bandwidth(events, best)
    return Distribution(
        species=species,
        selection=selection,
        support=support,
        histogram=_histogram(events),
        curves=_curves(events, best, bandwidth),
        bandwidth_kda=bandwidth,
        events=int(x.size),
        branch=branch,
        draws=draws,
        seed=seed,
        notes=tuple(notes),
    )


# ---- the model -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Events:
    x: FloatArray
    sigma: FloatArray
    efficiency: Efficiency | None

    @property
    def filter_sigma(self) -> FloatArray:
        """s_i, standard deviation of the estimate that decides on detection."""
        least = self.efficiency.sigma_kda if self.efficiency else 0.0
        return np.maximum(self.sigma, least)


@dataclass(frozen=True, eq=False)
class _Mixture:
    weight: FloatArray  # of the particles that came
    mean: FloatArray
    variance: FloatArray  # τ²
    log_likelihood: float = -math.inf

    def bic(self, n: int) -> float:
        return -2 * self.log_likelihood + (3 * self.weight.size - 1) * math.log(n)

    def sorted(self) -> _Mixture:
        order = np.argsort(self.mean)
        return _Mixture(
            self.weight[order], self.mean[order], self.variance[order], self.log_likelihood
        )


def _log_seen(events: _Events, mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Log probability that a particle of each species is detected, per event's noise (n, k)."""
    if events.efficiency is None:
        return np.zeros((1, mean.size))
    s = events.filter_sigma
    if np.all(s == s[0]):
        s = s[:1]
    reach = np.sqrt(variance + s[:, np.newaxis] ** 2)
    return np.asarray(log_ndtr((mean - events.efficiency.threshold_kda) / reach))


def _log_terms(events: _Events, mixture: _Mixture) -> FloatArray:
    """Logarithm of w_k N(x_i; μ_k, τ_k² + σ_i²), shape (n, k)."""
    total = mixture.variance + events.sigma[:, np.newaxis] ** 2
    distance = events.x[:, np.newaxis] - mixture.mean
    with np.errstate(divide="ignore"):
        weight = np.log(mixture.weight)
    return np.asarray(weight - 0.5 * (distance**2 / total + np.log(2 * math.pi * total)))


def _em(events: _Events, start: _Mixture, steps: int) -> _Mixture:
    """Climb towards the maximum as if nothing were missed; only a start for `_polish`."""
    weight, mean, variance = start.weight.copy(), start.mean.copy(), start.variance.copy()
    mixture_em(events.x, events.sigma**2, weight, mean, variance, steps)
    return _Mixture(weight, mean, variance)


def _polish(events: _Events, start: _Mixture, evaluations: int = 400) -> _Mixture:
    """Maximise the likelihood of the events seen, with its gradient, under τ² ≥ 0."""
    k = start.weight.size
    scale = max(float(np.median(events.sigma)), 1e-9)
    noise = events.sigma**2
    s2 = events.filter_sigma[:, np.newaxis] ** 2
    if np.all(s2 == s2[0]):
        s2 = s2[:1]
    n = events.x.size

    def unpack(theta: FloatArray) -> _Mixture:
        logits = np.concatenate([[0.0], theta[: k - 1]])
        weight = np.exp(logits - logits.max())
        weight /= weight.sum()
        return _Mixture(weight, theta[k - 1 : 2 * k - 1] * scale, theta[2 * k - 1 :] * scale**2)

    def loss(theta: FloatArray) -> tuple[float, FloatArray]:
        mixture = unpack(theta)
        value, (counts, by_mean, by_variance) = mixture_score(
            events.x, noise, mixture.weight, mixture.mean, mixture.variance
        )
        by_weight = counts - n * mixture.weight
        if events.efficiency is not None:
            reach = np.sqrt(mixture.variance + s2)
            at = (mixture.mean - events.efficiency.threshold_kda) / reach
            log_seen = log_ndtr(at)
            with np.errstate(divide="ignore"):
                part = np.log(mixture.weight) + log_seen
            top = part.max(axis=1, keepdims=True)
            seen_share = np.exp(part - top)
            norm = seen_share.sum(axis=1, keepdims=True)
            seen_share /= norm
            norm = np.log(norm) + top
            slope = np.exp(-0.5 * at**2 - 0.5 * math.log(2 * math.pi) - log_seen)
            times = n if len(norm) == 1 else 1
            value -= times * float(norm.sum())
            by_weight = counts - times * seen_share.sum(axis=0)
            by_mean -= times * np.sum(seen_share * slope / reach, axis=0)
            by_variance += times * 0.5 * np.sum(seen_share * slope * at / reach**2, axis=0)
        gradient = np.concatenate([by_weight[1:], by_mean * scale, by_variance * scale**2])
        return -value / n, -gradient / n

    weight = np.maximum(start.weight, _SIZE_FLOOR)
    logits = np.log(weight / weight[0])[1:]
    top = float(events.x.max())
    theta = np.concatenate([logits, start.mean / scale, start.variance / scale**2])
    bounds = (
        [(-12.0, 12.0)] * (k - 1)
        + [(0.0, 1.05 * top / scale)] * k
        + [(0.0, (top / scale) ** 2)] * k
    )
    theta = np.clip(theta, [b[0] for b in bounds], [b[1] for b in bounds])
    # TNC and not L-BFGS-B, whose calls of a threaded BLAS take longer than all the rest.
    found = minimize(
        loss, theta, jac=True, method="TNC", bounds=bounds,
        options={"maxfun": evaluations, "ftol": 1e-9, "gtol": 1e-6},
    )  # fmt: skip
    return replace(unpack(np.asarray(found.x)), log_likelihood=-float(found.fun) * n)


def _height(events: _Events) -> Callable[[_Mixture], float]:
    """How good a start is, as if nothing were missed."""
    noise = events.sigma**2

    def height(start: _Mixture) -> float:
        score = mixture_score(events.x, noise, start.weight, start.mean, start.variance)
        return float(score[0])

    return height


def _fits(events: _Events, max_species: int) -> list[_Mixture]:
    """Fit 1, 2, … species; stop after two numbers that BIC likes no better."""
    fits: list[_Mixture] = []
    most = min(max_species, max(1, events.x.size // 5))
    for k in range(1, most + 1):
        starts = [_spread_start(events, k)]
        if fits:
            starts += _split_starts(events, fits[-1])
        climbed = sorted((_em(events, start, _EM_STEPS) for start in starts), key=_height(events))
        tried = [_polish(events, start) for start in climbed[-_POLISHED:]]
        fits.append(max(tried, key=lambda fit: fit.log_likelihood))
        bic = [fit.bic(events.x.size) for fit in fits]
        if len(fits) - 1 - int(np.argmin(bic)) >= 2:
            break
    return fits


def _spread_start(events: _Events, k: int) -> _Mixture:
    """Equal shares of the sorted events."""
    parts = np.array_split(np.sort(events.x), k)
    mean = np.array([part.mean() for part in parts])
    variance = np.array([max(part.var(), 1e-12) for part in parts])
    return _Mixture(np.full(k, 1 / k), mean, variance)


def _split_starts(events: _Events, fit: _Mixture) -> list[_Mixture]:
    """Add a narrow species where events crowd most above the model, or split the widest."""
    starts = []
    sigma = float(np.median(events.sigma))
    places = np.sort(events.x)
    k = fit.weight.size
    for h in (sigma, 4 * sigma):
        near = np.searchsorted(places, places + h) - np.searchsorted(places, places - h)
        expected = np.zeros(places.size)
        for w, m, v in zip(fit.weight, fit.mean, fit.variance, strict=True):
            total = math.sqrt(v + sigma**2)
            expected += w * (ndtr((places + h - m) / total) - ndtr((places - h - m) / total))
        excess = (near - places.size * expected) / np.sqrt(places.size * expected + 1)
        place = float(places[int(np.argmax(excess))])
        starts.append(
            _Mixture(
                np.append(fit.weight * (1 - 1 / (2 * k + 2)), 1 / (2 * k + 2)),
                np.append(fit.mean, place),
                np.append(fit.variance, (h / 2) ** 2),
            )
        )
    widest = int(np.argmax(fit.weight * np.sqrt(fit.variance + sigma**2)))
    half = 0.7 * math.sqrt(fit.variance[widest] + sigma**2)
    starts.append(
        _Mixture(
            np.append(fit.weight, fit.weight[widest] / 2) - np.append(
                np.where(np.arange(k) == widest, fit.weight / 2, 0), 0
            ),
            np.append(np.where(np.arange(k) == widest, fit.mean - half, fit.mean),
                      fit.mean[widest] + half),
            np.append(np.where(np.arange(k) == widest, fit.variance / 4, fit.variance),
                      fit.variance[widest] / 4),
        )
    )  # fmt: skip
    return starts


# ---- the bootstrap and what it says --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Repeat:
    mixture: _Mixture
    count: FloatArray
    corrected: FloatArray


def _counts(events: _Events, mixture: _Mixture) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Events of each species that were seen, that came, and the chance to see one."""
    terms = _log_terms(events, mixture)
    seen = np.exp(terms - logsumexp(terms, axis=1, keepdims=True)).sum(axis=0)
    chance = np.exp(_log_seen(events, mixture.mean, mixture.variance))
    total = float(np.sum(np.broadcast_to(1 / (chance @ mixture.weight), events.x.shape)))
    return seen, mixture.weight * total, chance.mean(axis=0)


def _draw(events: _Events, mixture: _Mixture, rng: np.random.Generator) -> _Events:
    """Events as the mixture would give them, detected as the real ones were."""
    wanted = max(LEAST_EVENTS, int(rng.poisson(events.x.size)))
    xs: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    have = 0
    for _ in range(_BOOTSTRAP_TRIES):
        size = 2 * wanted
        species = rng.choice(mixture.weight.size, size, p=mixture.weight)
        sigma = rng.choice(events.sigma, size)
        true = rng.normal(mixture.mean[species], np.sqrt(mixture.variance[species]))
        x = rng.normal(true, sigma)
        if events.efficiency is not None:
            extra = np.sqrt(np.maximum(events.efficiency.sigma_kda**2 - sigma**2, 0.0))
            kept = rng.normal(x, extra) > events.efficiency.threshold_kda
            x, sigma = x[kept], sigma[kept]
        xs.append(np.abs(x))
        sigmas.append(sigma)
        have += x.size
        if have >= wanted:
            break
    return _Events(np.concatenate(xs)[:wanted], np.concatenate(sigmas)[:wanted], events.efficiency)


def _bootstrap(
    events: _Events, best: _Mixture, draws: int, seed: int
) -> tuple[list[_Repeat], float]:
    """Fit simulated repetitions; in some of them let BIC choose between neighbouring numbers."""
    rng = np.random.default_rng(seed)
    order = best.sorted()
    repeats, agreed, asked = [], 0, 0
    for number in range(draws):
        drawn = _draw(events, order, rng)
        fit = _polish(drawn, order)  # from the estimate, so that species keep their places
        seen, came, _ = _counts(drawn, fit)
        repeats.append(_Repeat(fit, seen, came))
        if number < _SUPPORT_DRAWS:
            more, fewer = _neighbours(drawn, fit.sorted())
            rivals = [
                _polish(drawn, max(starts, key=_height(drawn)), _RIVAL_EVALUATIONS)
                for starts in (more, fewer)
                if starts
            ]
            n = drawn.x.size
            asked += 1
            agreed += all(fit.bic(n) <= rival.bic(n) for rival in rivals)
    return repeats, agreed / asked if asked else math.nan


def _neighbours(events: _Events, fit: _Mixture) -> tuple[list[_Mixture], list[_Mixture]]:
    """Give starts with one species more, and with one less: two neighbours joined."""
    more = [_em(events, start, _EM_STEPS) for start in _split_starts(events, fit)]
    starts = []
    k = fit.weight.size
    for i in range(k - 1):
        pair = slice(i, i + 2)
        weight = fit.weight[pair] / fit.weight[pair].sum()
        mean = float(weight @ fit.mean[pair])
        variance = float(weight @ (fit.variance[pair] + (fit.mean[pair] - mean) ** 2))
        rest = np.r_[0:i, i + 2 : k]
        starts.append(
            _Mixture(
                np.append(fit.weight[rest], fit.weight[pair].sum()),
                np.append(fit.mean[rest], mean),
                np.append(fit.variance[rest], variance),
            )
        )
    return more, starts


def _species(
    events: _Events, best: _Mixture, repeats: list[_Repeat], lands: np.ndarray[Any, Any]
) -> pd.DataFrame:
    mixture = best.sorted()
    seen, came, chance = _counts(events, mixture)
    terms = _log_terms(events, mixture)
    share = np.exp(terms - logsumexp(terms, axis=1, keepdims=True))

    def interval(values: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        if not values:
            nothing = np.full(mixture.weight.size, math.nan)
            return nothing, nothing
        low, high = np.quantile(np.array(values), [0.025, 0.975], axis=0)
        return low, high

    mass_low, mass_high = interval([r.mixture.mean for r in repeats])
    width_low, width_high = interval([np.sqrt(r.mixture.variance) for r in repeats])
    part_low, part_high = interval([r.mixture.weight for r in repeats])
    count_low, count_high = interval([r.count for r in repeats])
    came_low, came_high = interval([r.corrected for r in repeats])
    means = np.array([r.mixture.mean for r in repeats])
    return pd.DataFrame(
        {
            "mass_kda": mixture.mean,
            "mass_se": means.std(axis=0, ddof=1) if len(repeats) > 1 else math.nan,
            "mass_low": mass_low,
            "mass_high": mass_high,
            "width_kda": np.sqrt(mixture.variance),
            "width_low": width_low,
            "width_high": width_high,
            "fraction": mixture.weight,
            "fraction_low": part_low,
            "fraction_high": part_high,
            "count": seen,
            "count_low": count_low,
            "count_high": count_high,
            "landing": share[lands].sum(axis=0),
            "leaving": share[~lands].sum(axis=0),
            "efficiency": chance,
            "count_corrected": came,
            "corrected_low": came_low,
            "corrected_high": came_high,
        },
        columns=list(SPECIES_COLUMNS),
    )


# ---- what is drawn -------------------------------------------------------------------------------


def _bandwidth(events: _Events, best: _Mixture | None) -> float:
    """Scott's rule for one peak no wider than the measurement error."""
    each = max(events.x.size / (best.weight.size if best else 1), 1.0)
    return float(1.06 * np.median(events.sigma) * each**-0.2)


def _reach(events: _Events) -> float:
    """Where the drawing ends: a few giants must not squeeze everything else."""
    most = float(np.quantile(events.x, 0.98)) * 1.3
    return min(float(events.x.max()), most) + 3 * float(np.median(events.sigma))


def _histogram(events: _Events) -> pd.DataFrame:
    """Count, with 95 % Poisson intervals (Garwood, Biometrika 28, 437, 1936)."""
    reach = _reach(events)
    wanted = max(
        2.0 * float(np.median(events.sigma)) * (events.x.size / 3) ** (-1 / 3) * 1.7,
        reach / _MOST_BINS,
    )
    width = _round_width(wanted)
    edges = np.arange(math.ceil(reach / width) + 1) * width
    counts = np.histogram(events.x, edges)[0]
    low = np.where(counts > 0, chi2_distribution.ppf(0.025, 2 * np.maximum(counts, 1)) / 2, 0.0)
    return pd.DataFrame(
        {
            "low_kda": edges[:-1],
            "high_kda": edges[1:],
            "count": counts,
            "count_low": low,
            "count_high": chi2_distribution.ppf(0.975, 2 * counts + 2) / 2,
        }
    )


def _round_width(width: float) -> float:
    """Round to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(width))
    return float(min((power, 2 * power, 5 * power, 10 * power), key=lambda w: abs(w / width - 1)))


def _curves(events: _Events, best: _Mixture, bandwidth: float) -> pd.DataFrame:
    """Densities per kDa: kernel with its Poisson error, model as seen and as it came."""
    mass = np.linspace(0.0, _reach(events), _CURVE_POINTS)
    z = (mass[:, np.newaxis] - events.x) / bandwidth
    kernel = np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * bandwidth)
    with np.errstate(divide="ignore"):
        weight = np.log(best.weight)
    norm = np.exp(logsumexp(weight + _log_seen(events, best.mean, best.variance), axis=1))
    came = float(np.sum(np.broadcast_to(1 / norm, events.x.shape)))
    pieces = []
    for sigma in np.quantile(events.sigma, np.linspace(0.05, 0.95, 10)):
        single = _Events(mass, np.full(mass.shape, sigma), None)
        pieces.append(np.exp(logsumexp(_log_terms(single, best), axis=1)))
    arrived = came * np.mean(pieces, axis=0)
    seen = arrived
    efficiency = np.ones(mass.shape)
    if events.efficiency is not None:
        efficiency = events.efficiency(mass)
        seen = arrived * _selected(events, mass)
    return pd.DataFrame(
        {
            "mass_kda": mass,
            "density": kernel.sum(axis=1),
            "density_se": np.sqrt(np.sum(kernel**2, axis=1)),
            "model": seen,
            "model_corrected": arrived,
            "efficiency": efficiency,
        }
    )


def _selected(events: _Events, x: FloatArray) -> FloatArray:
    """Probability that an event measured at x was detected, over the events' own noise."""
    if events.efficiency is None:
        return np.ones(x.shape)
    sigma = np.quantile(events.sigma, np.linspace(0.05, 0.95, 10))
    extra = np.sqrt(np.maximum(events.efficiency.sigma_kda**2 - sigma**2, 0.0))
    at = x[:, np.newaxis] - np.maximum(events.efficiency.threshold_kda, 0.0)
    return np.asarray(ndtr(at / np.maximum(extra, 1e-9)).mean(axis=1))


def _undescribed(
    events: _Events, branch: Branch, draws: int, seed: int, notes: list[str]
) -> Distribution:
    """Events, but too few to say what they are."""
    histogram = pd.DataFrame(columns=["low_kda", "high_kda", "count", "count_low", "count_high"])
    curves = pd.DataFrame(
        columns=["mass_kda", "density", "density_se", "model", "model_corrected", "efficiency"]
    )
    return Distribution(
        species=pd.DataFrame(columns=list(SPECIES_COLUMNS)),
        selection=pd.DataFrame(columns=["species", "log_likelihood", "bic", "delta_bic"]),
        support=math.nan,
        histogram=_histogram(events) if events.x.size else histogram,
        curves=curves,
        bandwidth_kda=_bandwidth(events, None) if events.x.size else math.nan,
        events=int(events.x.size),
        branch=branch,
        draws=draws,
        seed=seed,
        notes=tuple(notes),
    )
