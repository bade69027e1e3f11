"""How fast particles land, and how long they stay.

Landings at times t_i in [0, T] come at the rate λ(t) = λ₀ exp(−kt): the drop, or the layer above
the surface, runs out of particles at the rate k.  With λ₀ at its best, the log-likelihood is

    ℓ(k) = n ln(k/(1 − exp(−kT))) − k Σ t_i + const,

concave in k.  A ratio of likelihoods tests k = 0, and the distance of Kolmogorov and Smirnov
between the times and the fitted law whether that law describes them; diffusion out of a drop at
rest, λ ∝ t^(−1/2), does not look exponential.

A landing is paired with a leaving at the same place, of the same mass, later; each is in one pair.
Of landing i that stays at least d₀, the window of the search, a leaving is seen with the chance q_i
if it leaves before the end, c_i after d₀:

    paired, after d_i + d₀:  q_i κ exp(−κ d_i);      not:  1 − q_i (1 − exp(−κ c_i)),

so that those that still stay at the end (censored) and those whose leaving was missed are accounted
for.  How many pairs are chance is told by leavings whose places are moved by half of the field.

Rates of landing and leaving from a table of events that has frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray
from scipy.special import chdtrc, exprel, kolmogorov

from iscat_analysis.calibration import Line
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding, Noted
from iscat_analysis.findings.tables import CHANCE_PAIRS, NO_DEPLETION_LAW, PARTLY_SEARCHED
from iscat_analysis.inference.checks import number_in, shown
from iscat_analysis.reading import read_text, toml_of
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.maximum import TWO_SIDED_95, interval
from iscat_analysis.species.tables import EventTable, event_table
from iscat_analysis.text import brief

IndexArray: TypeAlias = NDArray[np.int64]
"""Rows of a table."""


_LARGEST_RATE_TIME = 200.0  # of kT
_GRID = 400  # rates among which the maximum is looked for


@dataclass(frozen=True)
class LandingRate:
    """How fast particles land."""

    landings: int
    seconds: float
    per_second: float
    per_second_low: float
    per_second_high: float
    depletion_per_s: float
    depletion_low: float
    depletion_high: float
    depletion_p: float
    p_value: float


@dataclass(frozen=True)
class UnbindingRate:
    """How fast particles leave."""

    landings: int
    pairs: int
    chance_pairs: int
    per_second: float
    per_second_low: float
    per_second_high: float


def landing_rate(times_s: FloatArray, seconds: float) -> LandingRate:
    """Fit the rate of landings and its depletion.

    Shapes: `times_s` (n,).
    """
    n = times_s.size
    # fewer landings have no rate that depends on time
    if n < 10:
        return LandingRate(n, seconds, *([math.nan] * 8))
    share = np.sort(times_s) / seconds
    mean = float(share.mean())

    def height(x: float) -> float:
        return -n * (math.log(exprel(-x)) + x * mean)

    ends = -_LARGEST_RATE_TIME, _LARGEST_RATE_TIME
    best = float(scipy.optimize.brentq(lambda x: _middle(x) - mean, *ends, xtol=1e-10))
    top = height(best)
    ends = interval(lambda x: 2 * (top - height(x)), best, *ends, step=1.0)
    flat = 2 * (top - height(0.0))
    # Information on ln λ₀ and x = kT: n, −n g', and that of ∫λ.
    slope = -_middle(best)
    curvature = (_middle(best + 1e-4) - _middle(best - 1e-4)) / -2e-4
    error = math.sqrt((1 + slope**2 / curvature) / n)
    rate = n / seconds / exprel(-best)
    law = share * exprel(-best * share) / exprel(-best)
    steps = np.arange(n + 1) / n
    distance = float(max(np.max(steps[1:] - law), np.max(law - steps[:-1])))
    return LandingRate(
        landings=n,
        seconds=seconds,
        per_second=rate,
        per_second_low=rate * math.exp(-TWO_SIDED_95 * error),
        per_second_high=rate * math.exp(TWO_SIDED_95 * error),
        depletion_per_s=best / seconds,
        depletion_low=ends[0] / seconds,
        depletion_high=ends[1] / seconds,
        depletion_p=float(chdtrc(1, max(flat, 0.0))),
        p_value=float(kolmogorov(math.sqrt(n) * distance)),
    )


def pair_events(
    frame: FloatArray,
    place_px: FloatArray,
    mass_kda: FloatArray,
    sigma_kda: FloatArray,
    *,
    radius_px: float,
) -> tuple[IndexArray, IndexArray]:
    """Pair landings with the leavings of the same particles.

    Shapes: `frame` (n,), `place_px` (n, 2), `mass_kda, sigma_kda` (n,), `landing, leaving`
    (pairs,).
    """
    lands, leaves = np.flatnonzero(mass_kda > 0), np.flatnonzero(mass_kda < 0)
    if not lands.size or not leaves.size:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    tree = scipy.spatial.cKDTree(place_px[lands])
    taken: dict[int, int] = {}
    for leaving in leaves[np.argsort(frame[leaves], kind="stable")]:
        near = lands[tree.query_ball_point(place_px[leaving], radius_px)]
        error = np.hypot(sigma_kda[near], sigma_kda[leaving])
        # standard errors between the masses of a pair
        alike = np.abs(mass_kda[near] + mass_kda[leaving]) < 4.0 * error
        fit = [int(i) for i in near[alike & (frame[near] < frame[leaving])] if int(i) not in taken]
        if fit:
            taken[max(fit, key=lambda i: frame[i])] = int(leaving)
    order = sorted(taken)
    return np.array(order, np.int64), np.array([taken[i] for i in order], np.int64)


def unbinding_rate(
    stay_s: FloatArray, censor_s: FloatArray, detected: FloatArray, *, chance_pairs: int = 0
) -> UnbindingRate:
    """Fit the rate at which particles leave.

    Shapes: `stay_s` (n,), `censor_s` (n,), `detected` (n,).
    """
    paired = np.isfinite(stay_s)
    number, stayed = int(paired.sum()), float(stay_s[paired].sum())
    left, chance = censor_s[~paired], detected[~paired]
    longest = float(censor_s.max(initial=0.0))
    if not longest > 0:
        return UnbindingRate(stay_s.size, number, chance_pairs, math.nan, math.nan, math.nan)

    with np.errstate(divide="ignore"):  # none is missed, or none seen
        missed, seen = np.log1p(-chance), np.log(chance)

    def height(ln_rate: float) -> float:
        rate = math.exp(ln_rate)
        still = float(np.sum(np.logaddexp(missed, seen - rate * left)))
        return number * ln_rate - rate * stayed + still

    low, high = math.log(1e-6 / longest), math.log(1e6 / longest)
    best = low
    if number:
        grid = np.linspace(low, high, _GRID)
        near = int(np.argmax([height(x) for x in grid]))
        around = float(grid[max(near - 1, 0)]), float(grid[min(near + 1, grid.size - 1)])
        # of its logarithm
        search = {"bounds": around, "method": "bounded", "options": {"xatol": 1e-7}}
        best = float(scipy.optimize.minimize_scalar(lambda x: -height(x), **search).x)
    top = height(best)
    ends = interval(lambda x: 2 * (top - height(x)), best, low, high, step=1.0)
    rate, least, most = (math.exp(x) for x in (best, *ends))
    if not number:
        rate = least = 0.0
    return UnbindingRate(stay_s.size, number, chance_pairs, rate, least, most)


def _middle(x: float) -> float:
    """Mean of a time in [0, 1] whose density is as e^(−xt)."""
    return 0.5 - x / 12 if abs(x) < 1e-3 else 1 / x - 1 / math.expm1(x)


_WRONG = 0.01  # p-value of an exponential depletion
_CHANCE = 0.1  # part of the pairs


@dataclass(frozen=True)
class Kinetics(Noted):
    """Rates of one table; `fit_kinetics` makes it.

    Attributes
    ----------
    landing : LandingRate
        With its depletion.
    unbinding : UnbindingRate or None
        None where the table has no places, no leavings, or no landing that stays long enough.
    frame_rate_hz : float
        Which it is in [1/s].
    frames : tuple of int
        In which events were looked for, ``[start, stop)``.
    findings : tuple of Finding
        What the user should know.
    """

    landing: LandingRate
    unbinding: UnbindingRate | None
    frame_rate_hz: float
    frames: tuple[int, int]
    findings: tuple[Finding, ...]

    __repr__ = brief

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain values.

        Returns
        -------
        dict
            Nested.
        """
        rates = {
            "landing": vars(self.landing),
            "unbinding": self.unbinding and vars(self.unbinding),
        }
        times = {"frame_rate_hz": self.frame_rate_hz, "frames": self.frames}
        return {**rates, **times, "notes": self.notes}


def fit_kinetics(
    events: str | Path | pd.DataFrame | EventTable,
    *,
    frame_rate_hz: float | None = None,
    frames: tuple[int, int] | None = None,
    # farthest that landing and leaving of one particle may lie apart [px]
    radius_px: float = 1.5,
    calibration: Line | None = None,
) -> Kinetics:
    """Fit how fast particles land, how that is depleted, and how fast they leave.

    Parameters
    ----------
    events : str, Path, pandas.DataFrame or EventTable
        As for `find_species`, with ``frame``, signed masses (leavings are negative), and for the
        rate of leaving ``x_px`` and ``y_px``.
    frame_rate_hz : float, optional
        Frames per second; default what the configuration beside the table says.
    frames : (int, int), optional
        In which events were looked for, ``[start, stop)``; default from the first to the last
        event.
    radius_px : float
        Farthest that landing and leaving of one particle may lie apart [px].
    calibration : str, Path, Calibration or MassCalibration, optional
        A mass line, as ``iscat calibrate mass`` writes it: masses are those of the contrasts, in
        place of masses that the table has.

    Returns
    -------
    Kinetics
        Rates per second with 95 % intervals.

    Raises
    ------
    ConfigError
        No frame rate is known, or an option is impossible.
    DataError
        The table cannot be read or has no frames.

    Notes
    -----
    A leaving is seen as often as a landing of its mass (the table's efficiency), and stays shorter
    than the window of the search are left out of both counts.  The rate of landing is that over the
    share of field and time that was searched (``landing.searched_share`` of the summary).

    Examples
    --------
    >>> import iscat_analysis as ia, numpy as np, pandas as pd
    >>> random = np.random.default_rng(1)
    >>> frame = np.sort(random.integers(0, 6000, 400))  # 400 landings in a minute
    >>> table = pd.DataFrame({"mass_kda": 100.0, "sigma_mass_kda": 8.0, "frame": frame})
    >>> found = ia.fit_kinetics(table, frame_rate_hz=100, frames=(0, 6000))
    >>> found.landing.per_second_low < 400 / 60 < found.landing.per_second_high
    True
    """
    table = event_table(events, calibration=calibration, any_scale=True)
    if frame_rate_hz is None and isinstance(events, (str, Path)):
        frame_rate_hz = configured_frame_rate(Path(events))
    if frame_rate_hz is None:
        raise ConfigError("`frame_rate_hz`: rates need the frames per second; give it")
    number_in("`frame_rate_hz`", frame_rate_hz, above=0.0)
    number_in("`radius_px`", radius_px, above=0.0)
    if not np.isfinite(table.frame).all():
        raise DataError(f"{table.name}: has events without a frame, so that there is no rate")
    start, stop = _range_of(frames, table.frame)
    inside = (table.frame >= start) & (table.frame < stop)
    if not inside.any():
        raise DataError(f"{table.name}: no event lies in the frames {start}:{stop}")
    landing = _landing(table, inside, (start, stop), frame_rate_hz)
    unbinding = _unbinding(table, inside, stop, frame_rate_hz, radius_px)
    findings = tuple(_doubts(table, landing, unbinding))
    return Kinetics(landing, unbinding, frame_rate_hz, (start, stop), findings)


def _searched(table: EventTable) -> float:
    return table.efficiency.searched if table.efficiency else 1.0


def _landing(
    table: EventTable, inside: BoolArray, frames: tuple[int, int], rate_hz: float
) -> LandingRate:
    """Fit the rate of landing, of all of field and time."""
    start, stop = frames
    times = (table.frame[inside & (table.mass_kda > 0)] - start + 0.5) / rate_hz
    seen = landing_rate(times, (stop - start) / rate_hz)
    rates = ("per_second", "per_second_low", "per_second_high")
    return replace(seen, **{name: getattr(seen, name) / _searched(table) for name in rates})


def _doubts(
    table: EventTable, landing: LandingRate, unbinding: UnbindingRate | None
) -> Iterator[Finding]:
    """Doubt the rates."""
    # share of field and time below which it is said
    if (searched := _searched(table)) < 0.95:
        yield PARTLY_SEARCHED({"share": searched})
    if landing.p_value < _WRONG:
        yield NO_DEPLETION_LAW({"p_value": landing.p_value})
    if unbinding is not None and unbinding.chance_pairs > _CHANCE * max(unbinding.pairs, 1):
        yield CHANCE_PAIRS({"chance": unbinding.chance_pairs, "pairs": unbinding.pairs})


def configured_frame_rate(path: Path) -> float | None:
    """Read the frame rate off the configuration that lies beside a table."""
    folder = path if path.is_dir() else path.parent
    try:
        text = read_text(folder / "config.toml")
        (folder / "summary.json").stat()  # missing where config.toml is not that of a result
        found = toml_of(text)["camera"]["frame_rate_hz"]
        return float(found) if float(found) > 0 else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _range_of(frames: tuple[int, int] | None, of_events: FloatArray) -> tuple[int, int]:
    """Check a range of frames, by default from the first to the last event."""
    if frames is None:
        return int(of_events.min()), int(of_events.max()) + 1
    if not isinstance(frames, (tuple, list)) or len(frames) != 2:
        raise ConfigError(f"`frames` = {shown(frames)}: give the first and the one after the last")
    start, stop = (int(number_in("`frames`", frame, least=0, whole=True)) for frame in frames)
    if start >= stop:
        raise ConfigError(f"`frames` = {start}:{stop}: must be a first frame and a later one")
    return start, stop


def _unbinding(
    table: EventTable, inside: BoolArray, stop: int, rate_hz: float, radius_px: float
) -> UnbindingRate | None:
    place = np.column_stack([table.x_px, table.y_px])
    rows = np.flatnonzero(inside & np.isfinite(place).all(axis=1))
    frame, mass, sigma = table.frame[rows], table.mass_kda[rows], table.sigma_kda[rows]
    place = place[rows]
    if not (mass < 0).any() or not (mass > 0).any():
        return None
    landing, leaving = pair_events(frame, place, mass, sigma, radius_px=radius_px)
    moved = place.copy()
    low, span = place.min(axis=0), np.ptp(place, axis=0) + 1.0
    moved[mass < 0] = low + (place[mass < 0] - low + span / 2) % span
    chance = pair_events(frame, moved, mass, sigma, radius_px=radius_px)[0].size
    window = table.window_frames or 0
    stay = np.full(frame.size, math.nan)
    stay[landing] = frame[leaving] - frame[landing]
    censor = stop - frame
    known = (mass > 0) & (censor > window) & ~(stay <= window)
    if not known.any():
        return None
    detected = np.ones(mass.size) if table.efficiency is None else table.efficiency(np.abs(mass))
    stays, censored = ((times[known] - window) / rate_hz for times in (stay, censor))
    return unbinding_rate(stays, censored, detected[known], chance_pairs=chance)
