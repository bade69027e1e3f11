"""Rates of landing and leaving from a table of events that has frames."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.calibration.mass.tables import Line
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import number_in, shown
from iscat_analysis.reading import read_text, toml_of
from iscat_analysis.records import BoolArray
from iscat_analysis.species.kinetics import (
    LandingRate,
    UnbindingRate,
    landing_rate,
    pair_events,
    unbinding_rate,
)
from iscat_analysis.species.tables import EventTable, event_table

RADIUS_PX = 1.5
"""Farthest that landing and leaving of one particle may lie apart [px]."""

_CHANCE = 0.1  # part of the pairs
_SEARCHED = 0.95  # share of field and time below which it is said


@dataclass(frozen=True)
class Kinetics:
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
    notes : tuple of str
        What the user should know, one sentence each.
    """

    landing: LandingRate
    unbinding: UnbindingRate | None
    frame_rate_hz: float
    frames: tuple[int, int]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain values.

        Returns
        -------
        dict
            Nested.
        """
        return asdict(self)


def fit_kinetics(
    events: str | Path | pd.DataFrame | EventTable,
    *,
    frame_rate_hz: float | None = None,
    frames: tuple[int, int] | None = None,
    radius_px: float = RADIUS_PX,
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
    table = events
    if not isinstance(table, EventTable):
        table = event_table(table, calibration=calibration)
    if frame_rate_hz is None and isinstance(events, (str, Path)):
        frame_rate_hz = configured_frame_rate(Path(events))
    if frame_rate_hz is None:
        raise ConfigError("`frame_rate_hz`: rates need the frames per second; give it")
    number_in("`frame_rate_hz`", frame_rate_hz, above=0.0)
    number_in("`radius_px`", radius_px, above=0.0)
    frame = table.frame
    if not np.isfinite(frame).all():
        raise DataError(f"{table.name}: has events without a frame, so that there is no rate")
    if frames is None:
        start, stop = int(frame.min()), int(frame.max()) + 1
    else:
        start, stop = _range_of(frames)
    inside = (frame >= start) & (frame < stop)
    if not inside.any():
        raise DataError(f"{table.name}: no event lies in the frames {start}:{stop}")
    lands = inside & (table.mass_kda > 0)
    landing = landing_rate(
        (frame[lands] - start + 0.5) / frame_rate_hz, (stop - start) / frame_rate_hz
    )
    notes = []
    searched = table.efficiency.searched if table.efficiency else 1.0
    if searched < 1:
        landing = replace(
            landing,
            per_second=landing.per_second / searched,
            per_second_low=landing.per_second_low / searched,
            per_second_high=landing.per_second_high / searched,
        )
    if searched < _SEARCHED:
        notes.append(
            f"{searched:.0%} of field and time were searched, and the rate of landing is for all "
            "of it"
        )
    unbinding = _unbinding(table, inside, stop, frame_rate_hz, radius_px)
    if landing.p_value < 0.01:
        notes.append(
            f"landings are not as an exponential depletion has them (p = {landing.p_value:.1g}): "
            "the rate in the beginning is that of a law that does not hold"
        )
    if unbinding is not None and unbinding.chance_pairs > _CHANCE * max(unbinding.pairs, 1):
        notes.append(
            f"{unbinding.chance_pairs} of {unbinding.pairs} pairs are as many as chance makes: the "
            "field is too crowded for `radius_px`, or particles stay"
        )
    return Kinetics(landing, unbinding, frame_rate_hz, (start, stop), tuple(notes))


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


def _range_of(frames: tuple[int, int]) -> tuple[int, int]:
    """Check a range of frames."""
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
    detected = np.ones(mass.size)
    if table.efficiency is not None:
        detected = table.efficiency(np.abs(mass))
    return unbinding_rate(
        (stay[known] - window) / rate_hz,
        (censor[known] - window) / rate_hz,
        detected[known],
        chance_pairs=chance,
    )
