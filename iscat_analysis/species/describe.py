"""From masses and their errors to species, curves and verdicts.

What is drawn: a histogram, a kernel density and the species as curves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import gammaincinv, logsumexp, ndtr

from iscat_analysis.findings import Finding, Noted, Value, existing
from iscat_analysis.findings import tables as of
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.choices import Choice, Chosen, Ladder, LadderFit, Searched, peaks
from iscat_analysis.species.events import Efficiency, Events, possible
from iscat_analysis.species.maximum import ENDS_95, TWO_SIDED_95
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.repeats import Possible, Repeat, bootstrap, ratio_of_doubt, with_edges
from iscat_analysis.text import brief
from iscat_analysis.units import count

Branch = Literal["magnitude", "landing", "leaving"]

LEAST_SPECIES = 3
"""Fewer events apart from all others are outliers and no species."""

LEAST_EFFICIENCY = 0.05
"""Of a species that is detected less often it is not determined how many particles came, nor, where
it is free, what they weigh."""

MOST_DOUBT = 3.0
"""Where nobody knows what is detected, and the share of a species among those that came is not
known to this factor for what may have been missed of it, it is not determined."""

LEAST_EVENTS = 10
"""Fewer are listed, not described."""

SPECIES_COLUMNS = (
    "mass_kda", "mass_se", "mass_low", "mass_high", "mass_systematic", "mean_kda",
    "width_kda", "width_low", "width_high",
    "fraction", "fraction_low", "fraction_high", "count", "count_low", "count_high",
    "landing", "leaving", "efficiency", "stay_frames",
    "count_corrected", "corrected_low", "corrected_high", "outlier",
)  # fmt: skip
"""Columns of the table of species: `mass_kda` is where the peak is highest, `mean_kda` the mean of
what makes it, `mass_se` is the statistical standard error, `mass_systematic` the error of the mass
scale, 0 where none is known, and the interval of the mass holds both.
`efficiency` is of particles that stay as long as the window; of those that stay `stay_frames` every
other one is found (NaN where the window is not known, or where it is too short for that).
Intervals are 95 %, `fraction` and `count_corrected` are of the
particles that came, the other counts of those that were seen; `outlier` marks what is no species:
fewer events than `LEAST_SPECIES`, or the background, which has a row without a mass, and a column
`background`, where there is one.  A species of less `efficiency` than `LEAST_EFFICIENCY`, or of
more than `MOST_DOUBT` of it, is not determined: the mass is where its events lie, without error or
interval, and what came of it is NaN, as is its fraction; those of the others are among the
others."""

_UNBIASED: Literal["weibull"] = "weibull"  # of few draws other quantiles lie too far inside
_MOST_RELATIVE_WIDTH = 0.4  # width over mass
_DIGITS = 6  # of the curves in summary.json


@dataclass(frozen=True, eq=False)
class Distribution(Noted):
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
    findings : tuple of Finding
        What the user should know.
    ladder : LadderFit or None
        The monomer, where species are a ladder.
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
    findings: tuple[Finding, ...] = ()
    ladder: LadderFit | None = None

    __repr__ = brief

    def to_dict(self) -> dict[str, Any]:
        """Give what ``summary.json`` holds under ``distribution``.

        Returns
        -------
        dict
            Nested plain values, curves by column.
        """
        found = plain_of(self, by_column=("histogram", "curves"))
        if self.ladder is None:
            del found["ladder"]
        found["curves"] = {
            name: [float(f"{value:.{_DIGITS}g}") for value in column]
            for name, column in found["curves"].items()
        }
        return found


def plain_of(result: Any, by_column: Sequence[str] = ()) -> dict[str, Any]:
    """Give the fields of a result as plain values: tables by row or column, findings as notes."""
    found: dict[str, Any] = {}
    for name, value in vars(result).items():
        if isinstance(value, pd.DataFrame):
            found[name] = value.to_dict("list" if name in by_column else "records")
        elif name == "findings":
            found["notes"] = [finding.text for finding in value]
        else:
            found[name] = asdict(value) if is_dataclass(value) else value  # type: ignore[arg-type]
    return found


def describe(
    masses: ArrayLike,
    sigmas: ArrayLike,
    *,
    efficiency: Efficiency | None = None,
    seed: int,
    branch: Branch = "magnitude",
    draws: int = 100,
    scale_error: Callable[[FloatArray], FloatArray] | None = None,
    window_frames: int | None = None,
    choice: Choice | None = None,
    limit_known: bool = True,
) -> Distribution:
    """Describe a set of masses as a mixture of species.

    Without `limit_known` nobody knows what is detected, and `efficiency` says nothing: intervals
    hold that doubt (`repeats`).

    Notes
    -----
    Intervals are the 2.5 and 97.5 % quantiles of the bootstrap, which draws the number of events
    from its own Poisson distribution.  The error of the mass scale is added in quadrature to the
    distance of these quantiles from the estimate.

    Shapes: `masses` (n,), `sigmas` (n,).
    """
    mass, sigma = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (masses, sigmas))
    if mass.shape != sigma.shape:
        raise ValueError(f"{mass.size} masses but {sigma.size} sigmas")
    usable = possible(mass, sigma)
    if branch != "magnitude":
        usable &= (mass > 0) == (branch == "landing")
    findings: list[Finding] = []
    if branch == "magnitude" and not usable.all():
        left_out = count(int(np.count_nonzero(~usable)), "event")
        findings.append(of.NO_ERROR_OR_MASS({"amount": left_out}))
    events = Events(np.abs(mass[usable]), sigma[usable], efficiency if limit_known else None)
    result = Distribution(
        species=pd.DataFrame(columns=list(SPECIES_COLUMNS)),
        selection=pd.DataFrame(columns=["species", "log_likelihood", "bic", "delta_bic"]),
        support=math.nan,
        histogram=histogram_of(events),
        curves=pd.DataFrame(columns=list(CURVE_COLUMNS)),
        bandwidth_kda=bandwidth_of(events, 1),
        events=int(events.x.size),
        branch=branch,
        draws=draws,
        seed=seed,
    )
    if events.x.size < LEAST_EVENTS:
        few: dict[str, Value] = {"amount": count(events.x.size, "event"), "needed": LEAST_EVENTS}
        return replace(result, findings=(*findings, of.TOO_FEW_EVENTS(few)))

    choice = choice or Searched()
    found = choice.choose(events)
    limits = [Possible(1.0, events, found.best, found.structure)]
    if not limit_known:
        found, limits = with_edges(events, found, choice, LEAST_SPECIES - 0.5)
    events, best = limits[0].events, limits[0].mixture
    repeats, support = bootstrap(limits, found, draws=draws, least=LEAST_EVENTS, seed=seed)
    scale_error = scale_error or np.zeros_like
    doubtful = ratio_of_doubt(limits) > MOST_DOUBT
    found = replace(found, best=best)
    species = _table(events, found, repeats, mass[usable] > 0, scale_error, window_frames, doubtful)
    ladder = _ladder(choice, found, repeats, scale_error) if isinstance(choice, Ladder) else None
    bandwidth = bandwidth_of(events, max(best.species, 1))
    findings += [*_skews(best, species), *_remarks(species, doubtful)]
    findings += existing([_brief(species, window_frames)])
    if ladder is not None and ladder.p_value < 0.01:
        monomer = {"monomer_kda": ladder.monomer_kda, "p_value": ladder.p_value}
        findings.append(of.NO_LADDER(monomer))
    return replace(
        result,
        species=species,
        selection=selection_of(found, events.x.size),
        support=support,
        curves=curves_of(events, best, bandwidth),
        bandwidth_kda=bandwidth,
        findings=tuple(findings),
        ladder=ladder,
    )


def _table(
    events: Events,
    found: Chosen,
    repeats: Sequence[Repeat],
    lands: BoolArray,
    scale_error: Callable[[FloatArray], FloatArray],
    window_frames: int | None,
    doubtful: BoolArray,
) -> pd.DataFrame:
    """Lay out the species, with intervals from the repetitions and from the mass scale."""
    best = found.best
    known = best.species
    share = best.shares(events)
    k = share.shape[1]
    is_species = np.arange(k) < known
    seen = share.sum(axis=0)
    outlier = ~is_species | (seen < LEAST_SPECIES - 0.5)
    efficiency = best.detected(events)
    undetermined = efficiency < LEAST_EFFICIENCY
    undetermined[:known] |= doubtful
    some = is_species & ~undetermined
    some &= ~outlier | outlier[some].all()
    mass, masses = peaks(events, best), [r.mass for r in repeats]
    scale, searched = scale_error(mass), events.efficiency.searched if events.efficiency else 1.0
    columns = {
        "mass_kda": mass,
        "mass_se": _error(masses, known),
        "mass_systematic": scale,
        "mean_kda": best.means()[:known],
        "width_kda": best.widths(),
        "fraction": _fractions(best.came, some),
        "count": seen,
        "landing": share[lands].sum(axis=0),
        "leaving": share[~lands].sum(axis=0),
        "efficiency": searched * efficiency,
        "stay_frames": _residence(events, mass, window_frames),
        "count_corrected": best.came * best.arrived(events) / searched,
        "outlier": outlier,
    }
    for name, (low, high) in {
        "mass": widened(interval_of(masses, known), mass, scale),
        "width": interval_of([r.mixture.widths() for r in repeats], k),
        "fraction": interval_of([_fractions(r.mixture.came, some) for r in repeats], k),
        "count": interval_of([r.count for r in repeats], k),
        "corrected": interval_of([r.corrected / searched for r in repeats], k),
    }.items():
        columns |= {f"{name}_low": low, f"{name}_high": high}
    table = pd.DataFrame(  # a background has no mass: what only species have is shorter
        {name: pd.Series(columns[name]) for name in SPECIES_COLUMNS}
    )
    corrected = ["count_corrected", "corrected_low", "corrected_high"]
    unknown = [] if found.held else ["mass_se", "mass_low", "mass_high"]
    table.loc[undetermined & is_species, [*corrected, "stay_frames", *unknown]] = math.nan
    if best.background:
        table["background"] = ~is_species
        widths = ["width_kda", "width_low", "width_high", "efficiency"]
        table.loc[~is_species, [*corrected, *widths]] = math.nan
    if found.steps:
        table.insert(0, "n", [*found.steps, *[0] * (k - known)])
    return table


def interval_of(values: Sequence[FloatArray], species: int) -> tuple[FloatArray, FloatArray]:
    """Give the 95 % interval of a number of each species, NaN without repetitions.

    Shapes: `values` (repetitions, species), result (species,).
    """
    if not values:
        nothing = np.full(species, math.nan)
        return nothing, nothing
    low, high = np.quantile(np.array(values), ENDS_95, axis=0, method=_UNBIASED)
    return low, high


def _error(values: Sequence[FloatArray], species: int) -> FloatArray:
    """Give the standard deviation of a number of each species, NaN without two repetitions."""
    if len(values) < 2:
        return np.full(species, math.nan)
    return np.asarray(np.std(values, axis=0, ddof=1))


def selection_of(found: Chosen, events: int) -> pd.DataFrame:
    """Lay out the numbers of species that were tried."""
    bic = [fit.bic(events) for fit in found.tried]
    return pd.DataFrame(
        {
            "species": [fit.species for fit in found.tried],
            "log_likelihood": [fit.log_likelihood for fit in found.tried],
            "bic": bic,
            "delta_bic": np.subtract(bic, min(bic)),
        }
    )


def _fractions(weight: FloatArray, some: BoolArray) -> FloatArray:
    """Shares among the species; a background, outliers and what is hardly seen have none."""
    return np.where(some, weight / max(float(weight[some].sum()), 1e-300), math.nan)


def _ladder(
    choice: Ladder,
    found: Chosen,
    repeats: Sequence[Repeat],
    scale_error: Callable[[FloatArray], FloatArray],
) -> LadderFit:
    """Describe the mass of the monomer."""
    values = np.array(choice.values(found))
    drawn = [np.array(choice.values(found, r.mixture)) for r in repeats]
    scale = np.append(scale_error(values[:1]), 0.0)
    low, high = widened(interval_of(drawn, 2), values, scale)
    columns = np.column_stack([values, _error(drawn, 2), low, high]).ravel().tolist()
    ends = ("kda", "se", "low", "high")
    names = [f"{part}_{end}" for part in ("monomer", "offset") for end in ends]
    numbers = dict(zip(names, columns, strict=True))
    return LadderFit(steps=found.steps, held=choice.held, p_value=found.p_value, **numbers)


def _residence(events: Events, mass: FloatArray, window_frames: int | None) -> FloatArray:
    """Frames that a particle of each species must stay for a detection probability of one half."""
    if window_frames is None or events.efficiency is None:
        return np.full(mass.shape, math.nan)
    with np.errstate(divide="ignore"):  # one of no mass is never found
        frames = np.ceil(window_frames * events.efficiency.threshold_kda / mass)
    return np.where(frames <= window_frames, np.maximum(frames, 1.0), math.nan)


def widened(
    ends: tuple[FloatArray, FloatArray], best: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Widen 95 % intervals about estimates by the error of the scale that all share."""
    away = [np.maximum(reach, 0.0) for reach in (best - ends[0], ends[1] - best)]
    low, high = (np.hypot(reach, TWO_SIDED_95 * scale) - reach for reach in away)
    return ends[0] - low, ends[1] + high


def _skews(best: Mixture, species: pd.DataFrame) -> Iterator[Finding]:
    """Name the peaks that more than one component describes."""
    for number in range(best.species):
        own = np.flatnonzero(best.kinds == number)
        mass, mean = species["mass_kda"][number], species["mean_kda"][number]
        if own.size > 1 and not species["outlier"][number]:
            beside = best.mean[own[np.argmax(np.abs(best.mean[own] - mass))]]
            # share of the mass from which on a mean that differs from it is told
            means = "" if abs(mean / mass - 1) < 0.02 else f", and its mean is {mean:.4g} kDa"
            masses = {"mass_kda": float(mass), "beside_kda": float(beside)}
            yield of.SKEWED_PEAK(masses | {"mean": means})


def _remarks(species: pd.DataFrame, doubtful: BoolArray) -> Iterator[Finding]:
    """Doubt single species."""
    species = species[: doubtful.size]
    doubted = pd.Series(doubtful, index=species.index)
    undetectable = (species["efficiency"] < LEAST_EFFICIENCY) & ~doubted
    half = (species["efficiency"] < 0.5) & ~undetectable & ~doubted
    broad = species["width_kda"] > _MOST_RELATIVE_WIDTH * species["mass_kda"]
    limits: dict[str, Value] = {
        "factor": MOST_DOUBT, "percent": 100 * LEAST_EFFICIENCY, "needed": LEAST_SPECIES,
    }  # fmt: skip
    for which, kind in (
        (doubted, of.UNDETERMINED_SHARE),
        (undetectable, of.UNDETECTABLE),
        (half, of.HALF_DETECTED),
        (species["outlier"], of.OUTLIERS),
        (broad, of.BROAD_SPECIES),
    ):
        if which.any():
            masses = ", ".join(f"{mass:.3g}" for mass in species["mass_kda"][which])
            yield kind(limits | {"masses": masses})


def _brief(species: pd.DataFrame, window_frames: int | None) -> Finding | None:
    """Say how long a particle must stay for its efficiency to be that of the table."""
    known = species[np.isfinite(species["stay_frames"].to_numpy(dtype=float)) & ~species["outlier"]]
    if window_frames is None or known.empty:
        return None
    residence = ", ".join(
        f"{row.mass_kda:.3g} kDa from {count(round(row.stay_frames), 'frame')}"
        for row in known.itertuples()
    )
    return of.BRIEF_VISITORS({"frames": count(window_frames, "frame"), "residence": residence})


CURVE_COLUMNS = ("mass_kda", "density", "density_se", "model", "model_corrected", "efficiency")
"""Columns of `Distribution.curves`."""

_NOISES = np.linspace(0.05, 0.95, 10)  # quantiles that stand for the errors of all events

POINTS = 300
"""Of a curve."""


def bandwidth_of(events: Events, species: int) -> float:
    """Apply Scott's rule to one peak no wider than the measurement error."""
    each = max(events.x.size / species, 1.0)
    return float(1.06 * np.median(events.sigma) * each**-0.2) if events.x.size else math.nan


def poisson_interval(counts: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Give 95 % intervals of counts (Garwood, Biometrika 28, 437, 1936)."""
    n = np.asarray(counts)
    low = np.where(n > 0, gammaincinv(np.where(n > 0, n, 1), ENDS_95[0]), 0.0)
    return low, np.asarray(gammaincinv(n + 1, ENDS_95[1]))


def round_width(wanted: float) -> float:
    """Give the width of a bar that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(wanted))
    return min((power, 2 * power, 5 * power, 10 * power), key=lambda w: abs(w / wanted - 1))


def histogram_of(events: Events) -> pd.DataFrame:
    """Count, with 95 % intervals."""
    edges = _edges(events) if events.x.size else np.zeros(1)
    counts = np.histogram(events.x, edges)[0]
    columns = {"low_kda": edges[:-1], "high_kda": edges[1:], "count": counts}
    columns["count_low"], columns["count_high"] = poisson_interval(counts)
    return pd.DataFrame(columns)


def mean_density(events: Events, best: Mixture, x: FloatArray) -> FloatArray:
    """Give the density of a mixture, averaged over the errors of events.

    Shapes: `x` (m,), result (m,).
    """
    parts = [
        np.exp(logsumexp(best.log_terms(Events(x, np.full(x.shape, sigma), None)), axis=1))
        for sigma in np.quantile(events.sigma, _NOISES)
    ]
    return np.asarray(np.mean(parts, axis=0))


def curves_of(events: Events, best: Mixture, bandwidth: float) -> pd.DataFrame:
    """Give densities per kDa: kernel with its Poisson error, model as seen and as it came."""
    mass = np.linspace(0.0, _reach(events), POINTS)
    z = (mass[:, np.newaxis] - events.x) / bandwidth
    kernel = np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * bandwidth)
    arrived, seen = best.arrived(events) * mean_density(events, best, mass), np.ones(mass.shape)
    efficiency = seen
    if (limit := events.efficiency) is not None:  # of a measured mass, averaged over its noise
        extra = np.maximum(limit.extra_sigma(np.quantile(events.sigma, _NOISES)), 1e-9)
        at = mass[:, np.newaxis] - np.maximum(limit.threshold_kda, 0.0)
        seen, efficiency = ndtr(at / extra).mean(axis=1), limit(mass)
    return pd.DataFrame(
        {
            "mass_kda": mass,
            "density": kernel.sum(axis=1),
            "density_se": np.sqrt(np.sum(kernel**2, axis=1)),
            "model": arrived * seen,
            "model_corrected": arrived,
            "efficiency": efficiency,
        }
    )


def _reach(events: Events) -> float:
    """Upper end of the figure: a few very heavy events must not compress all others."""
    most = float(np.quantile(events.x, 0.98)) * 1.3
    return min(float(events.x.max()), most) + 3 * float(np.median(events.sigma))


def _edges(events: Events) -> FloatArray:
    """Edges of bins about as wide as the errors allow."""
    reach = _reach(events)
    # bins of a figure at most
    wanted = max(
        2.0 * float(np.median(events.sigma)) * (events.x.size / 3) ** (-1 / 3) * 1.7, reach / 240
    )
    width = round_width(wanted)
    return np.asarray(np.arange(math.ceil(reach / width) + 1) * width)
