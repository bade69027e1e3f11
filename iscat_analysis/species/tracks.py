"""Tracks: what the frames of one particle say together.

`describe_tracks` takes the fits, one row per particle and frame, and gives one row per track: the
mass that its frames have in common (`common_mass`), D from its positions with their own errors and
blur (`diffusion`), tests of whether it diffuses freely (`motion`), and of particles in a volume the
size and the refractive index that follow (`refraction`).

D is that along x and y.  Height is left out, at the price of errors √(3/2) times as large: walls
reflect there, which takes 8/(3√(2π)) √(2DΔt)/h of it in a chamber of height h (a tenth of that of
30 nm gold at 1 kHz in 2 µm), a wall slows a particle along z twice as much as beside it, and a fit
that takes a neighbouring fringe makes a step that no particle made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import logit, ndtri

from iscat_analysis.records import (
    TRACK_COLUMNS,
    TRACKS,
    FloatArray,
    Progress,
    TrackStatus,
    silent,
    track_numbers,
)
from iscat_analysis.species.common_change import common_change
from iscat_analysis.species.common_mass import CommonMass, combine_masses, information_power
from iscat_analysis.species.diffusion import (
    Diffusion,
    estimate_diffusion,
    fit_diffusion,
    hydrodynamic_diameter,
)
from iscat_analysis.species.displacements import LEAST_POSITIONS
from iscat_analysis.species.motion import anomalous_test, confinement_test, steadiness_test
from iscat_analysis.species.refraction import refractive_index
from iscat_analysis.species.track_rows import TrackRows, nearest_nm, of_known, rows_by_track
from iscat_analysis.threads import threads

TESTED_POSITIONS = 300
"""Positions of a track whose motion is tested, from its first: the time of a test grows fast."""

SURPRISING = 0.005
"""A p-value this small is remarked on: of free tracks one or two in a hundred, with three tests."""

COVERAGE = 0.95
"""Of the interval of D."""

SLOWED = 0.05
"""Share by which a wall slows a particle before its size is remarked on."""

SLOWED_BY_WALL = 9 / 32
"""That share is this times diameter over height (H. Faxén, Ann. Phys. 373, 89, 1922)."""

SURE_SIZE = 0.999
"""Posterior probability of an optical diameter below which it is flagged as ambiguous, and of
another particle from which it is flagged as that."""

_FIRST_LOOK, _FULL_LOOK = 19, 199  # resamples: few unless they leave doubt
_MOST_DOUBTFUL_SHARE = 0.1
_ENOUGH = 3  # of the first that are as surprising leave none
_LEAST_KNOWN_SHARE = 0.05  # of the information on a mass is left by the background
_LEAST_SEEN_SHARE = 0.9  # of all frames, in which a particle that hardly moves is seen at least
# Relative error of a mass beyond which the error of D that it makes is reported.
_LARGEST_SCALE_ERROR = 0.02
# Errors of images alone, which are enlarged where the fits of a track are rejected.
_OF_IMAGES = ("sigma_mass_kda", "sigma_optical_diameter_nm", "sigma_refractive_index")
_FREE = ("p_confinement", "p_anomalous", "p_steady")
_STEPS = 3.0  # standard deviations of a displacement within which it may end beyond the border
_DISPLACEMENT_PASSES = 3  # at D, on which it depends which displacements tell it
_NM2_PER_UM2 = 1e6  # nm²


@dataclass(frozen=True)
class TrackSetup:
    """What all tracks of a movie share: times, optics, and the errors of the background."""

    frame_rate_hz: float | None
    exposure_ms: float | None
    frames: tuple[int, int]
    field_nm: tuple[float, float]
    near_nm: float
    min_frames: int = 10
    volume: bool = False
    viscosity_mpa_s: float = 0.89
    temperature_c: float = 25.0
    index: float | None = 1.46
    density_kg_m3: float = 1350.0
    n_medium: float = 1.33
    change: float = 0.0
    hidden_nm: float = 0.0
    ticks: NDArray[np.int64] | None = None
    """Intervals of the camera from the movie's first frame to each, where frames are missing."""


Correlation = Callable[[FloatArray], FloatArray]
"""From places (n, 2) [nm] to the correlation (n, n) of the masses fitted there."""


def describe_tracks(
    fits: pd.DataFrame,
    setup: TrackSetup,
    *,
    correlation: Correlation | None = None,
    masses: pd.DataFrame | None = None,
    seed: int = 1,
    workers: int = 1,
    progress: Progress = silent,
) -> pd.DataFrame:
    """Make the table of tracks."""
    groups = rows_by_track(fits)
    massive = {track: rows.massive() for track, rows in groups.items()}
    power = information_power(
        [(good.mass_kda, good.sigma_mass_kda) for good in massive.values() if len(good.frame) > 1]
    )
    nearest = nearest_nm(groups)
    exact = {} if masses is None else masses.to_dict("index")
    common = {
        track: _mass(good, power, correlation) for track, good in massive.items() if len(good.frame)
    }
    wider = {
        track: common[track].enlargement if rows.rejected and track in common else 1.0
        for track, rows in groups.items()
    }
    places = {
        track: rows.placed().timed(setup.ticks).enlarged(wider[track])
        for track, rows in groups.items()
    }
    motions = _motions(places, setup, seed, workers, progress)
    records = []
    for track, rows in groups.items():
        motion, tests = motions[track]
        record = _record(
            track, rows, common.get(track), places[track], motion, setup, exact.get(track, {}),
            wider[track],
        )  # fmt: skip
        record |= {"nearest_nm": nearest.get(track, np.inf), **tests}
        records.append(record)
        status = _remarks(record, setup)
        record["status"] = str(status[0]) if status else str(TrackStatus.OK)
        crossed = ["crosses"] if record["nearest_nm"] < setup.near_nm else []
        record["flags"] = ";".join([*map(str, status), *crossed])
    return _table(records, fits)


def changes_together(fits: pd.DataFrame, frames: tuple[int, int]) -> float:
    """Relative change of mass that all tracks share."""
    massive = [rows.massive() for rows in rows_by_track(fits).values()]
    return common_change([(g.frame, g.mass_kda, g.sigma_mass_kda) for g in massive], frames)


def _record(
    track: int,
    rows: TrackRows,
    mass: CommonMass | None,
    placed: TrackRows,
    found: Diffusion | None,
    setup: TrackSetup,
    exact: Mapping[str, float],
    wider: float,
) -> dict[str, Any]:
    """Make the row of one track, without the tests of its motion.

    The errors of the mass are multiplied by `wider`; those of the places are already.
    """
    record: dict[str, Any] = dict.fromkeys(TRACK_COLUMNS, np.nan)
    record |= {
        "track": track,
        "first_frame": int(rows.frame[0]),
        "last_frame": int(rows.frame[-1]),
        "n_frames": len(rows.frame),
        "n_mass_frames": 0 if mass is None else mass.frames,
        "rejected": rows.rejected,
        "n_d_frames": len(placed.frame),
        "x_nm": of_known(np.mean, rows.x_nm),
        "y_nm": of_known(np.mean, rows.y_nm),
        "z_nm": of_known(np.mean, rows.z_nm),
    }
    if mass is not None:
        record |= {
            "mass_kda": mass.mass_kda,
            "sigma_mass_kda": mass.sigma_mass_kda,
            "crb_mass_kda": mass.crb_mass_kda,
            "mass_scatter": mass.scatter,
            "p_mass": mass.p_value,
        }
    known_share = exact.get("told", 1.0)
    record |= {
        name: value for name, value in exact.items() if name != "told" and np.isfinite(value)
    }
    record |= {name: wider * record[name] for name in record if name in _OF_IMAGES}
    scale = _scale_error(record, known_share)
    record["short_way"] = known_share < _LEAST_KNOWN_SHARE and scale > 2 * _LARGEST_SCALE_ERROR
    massive = rows.only(rows.mass_kda != 0)  # a fit may end at nothing, and so is its contrast
    each = of_known(np.median, massive.contrast / massive.mass_kda)
    record["contrast"] = record["mass_kda"] * each
    if setup.frame_rate_hz is not None:
        record["n_d_frames"] = 0 if found is None else found.n_positions
    if found is not None:
        record |= {
            "d_um2_s": found.d_um2_s,
            "sigma_d_um2_s": math.hypot(found.sigma_d_um2_s, scale * found.d_um2_s),
            "crb_d_um2_s": found.crb_d_um2_s,
            "d_low_um2_s": _wider(found, 0, scale),
            "d_high_um2_s": _wider(found, 1, scale),
            "d_disagreement": found.disagreement,
        }
        if setup.volume and found.interval_um2_s[0] > 0:
            record |= _size(record, setup)
    return record | _ends(rows, setup, record["d_um2_s"])


def _scale_error(record: Mapping[str, Any], known_share: float) -> float:
    """Relative error of D by a background that was learnt with the track.

    What the frames of a particle that hardly moves have beyond their mean, which the background
    takes, is its mass times its displacements: where the mass is too large by a share, all these
    are too small by it, and D, as their square, by twice as much.
    """
    relative = record["sigma_mass_kda"] / (abs(record["mass_kda"]) or math.nan)
    return 2 * relative * math.sqrt(1 - known_share) if np.isfinite(relative) else 0.0


def _wider(found: Diffusion, end: int, scale: float) -> float:
    """End of the interval of D, with the error of its scale."""
    value, best = found.interval_um2_s[end], found.d_um2_s
    if value <= 0 or best <= 0:
        return value
    reach = math.hypot(math.log(value / best), scale * float(ndtri((1 + COVERAGE) / 2)))
    return best * math.exp(reach if end else -reach)


def _mass(good: TrackRows, power: float, correlation: Correlation | None) -> CommonMass:
    among = None
    if correlation is not None:
        among = correlation(np.stack([good.x_nm, good.y_nm], axis=1))
    masses = good.mass_kda, good.sigma_mass_kda, good.crb_mass_kda
    return combine_masses(*masses, power=power, correlation=among)


def _diffusion(placed: TrackRows, setup: TrackSetup) -> Diffusion | None:
    """Fit D to displacements that begin so far inside that they cannot have left the field."""
    least = max(LEAST_POSITIONS, setup.min_frames)
    if setup.frame_rate_hz is None or len(placed.frame) < least:
        return None
    room = _room(placed, setup)[:-1]
    gaps_s = np.diff(placed.frame) / setup.frame_rate_hz
    times: Any = {"frame_rate_hz": setup.frame_rate_hz, "exposure_ms": setup.exposure_ms}
    inside, positions = np.ones(room.size, dtype=bool), placed.positions()
    for _ in range(_DISPLACEMENT_PASSES):
        counted = inside
        d_um2_s, _ = estimate_diffusion(*positions, **times, counted=counted)
        inside = room > _STEPS * np.sqrt(2 * d_um2_s * _NM2_PER_UM2 * gaps_s)
        if inside.sum() < least - 1:
            return None
        if np.array_equal(inside, counted):
            break
    return fit_diffusion(*positions, **times, counted=counted, level=COVERAGE)


def _room(rows: TrackRows, setup: TrackSetup) -> FloatArray:
    """Distance of every position from the border of the field [nm]."""
    (height, width), x, y = setup.field_nm, rows.x_nm, rows.y_nm
    return np.asarray(np.minimum.reduce([x, y, width - x, height - y]))


def _size(record: Mapping[str, Any], setup: TrackSetup) -> dict[str, float]:
    """Diameter and refractive index of a particle that moves freely in the liquid.

    A sphere whose middle is nearer to the coverslip than its radius does not float: what moves so
    slowly there is bound to a membrane, or to the glass.
    """
    diameter, sigma = hydrodynamic_diameter(
        record["d_um2_s"],
        record["sigma_d_um2_s"],
        viscosity_mpa_s=setup.viscosity_mpa_s,
        temperature_c=setup.temperature_c,
    )
    if diameter / 2 > record["z_nm"]:
        return {}
    size = {"diameter_nm": float(diameter), "sigma_diameter_nm": float(sigma)}
    if setup.index is not None and np.isfinite(record["mass_kda"]):
        index, error = refractive_index(
            abs(record["mass_kda"]),
            diameter,
            sigma_mass_kda=record["sigma_mass_kda"],
            sigma_diameter_nm=sigma,
            index=setup.index,
            density_kg_m3=setup.density_kg_m3,
            n_medium=setup.n_medium,
        )
        size |= {"refractive_index": float(index), "sigma_refractive_index": float(error)}
    return size


def _motions(
    places: Mapping[int, TrackRows], setup: TrackSetup, seed: int, workers: int, progress: Progress
) -> dict[int, tuple[Diffusion | None, dict[str, float]]]:
    """D of all tracks and the tests of their motion; an interrupt leaves tests out."""

    def motion(track: int) -> tuple[Diffusion | None, dict[str, float]]:
        found = _diffusion(places[track], setup)
        if found is None:
            return None, {}
        return found, _tests(places[track], setup, np.random.default_rng([seed, track]))

    motions = {}
    longest_first = sorted(places, key=lambda track: -len(places[track].frame))
    with threads(workers) as pool, suppress(KeyboardInterrupt):
        for track, found in zip(longest_first, pool.map(motion, longest_first), strict=True):
            motions[track] = found
            progress("tracks", len(motions), len(places))
    for track in places.keys() - motions.keys():
        motions[track] = _diffusion(places[track], setup), {}
    return motions


def _tests(placed: TrackRows, setup: TrackSetup, rng: np.random.Generator) -> dict[str, float]:
    """Test whether the motion is free; two of the tests use the first positions of long tracks."""
    whole = placed.positions()
    track = tuple(part[:TESTED_POSITIONS] for part in whole)
    times: Any = {"frame_rate_hz": setup.frame_rate_hz, "exposure_ms": setup.exposure_ms}
    walls = confinement_test(*track, **times, resamples=_FIRST_LOOK, enough=_ENOUGH, rng=rng)
    if walls.p_value <= _MOST_DOUBTFUL_SHARE:
        walls = confinement_test(*track, **times, resamples=_FULL_LOOK, rng=rng)
    power = anomalous_test(*track, **times)
    return {
        "p_confinement": walls.p_value,
        "confinement_nm": walls.confinement_nm if walls.p_value <= SURPRISING else np.nan,
        "exponent": power.exponent,
        "sigma_exponent": power.sigma_exponent,
        "p_anomalous": power.p_value,
        "p_steady": steadiness_test(*whole, **times),
    }


def _remarks(record: Mapping[str, Any], setup: TrackSetup) -> list[TrackStatus]:
    """List the flags of a track, the worst first."""
    seen = {
        TrackStatus.FEW_FRAMES: record["n_d_frames"] < max(LEAST_POSITIONS, setup.min_frames),
        TrackStatus.POOR_FITS: record["rejected"],
        TrackStatus.AMBIGUOUS_SIZE: record.get("optical_probability", 1.0) < SURE_SIZE,
        TrackStatus.OTHER_PARTICLE: record.get("log_odds_particle", 0.0) < -float(logit(SURE_SIZE)),
        TrackStatus.MASS_VARIES: record["p_mass"] < SURPRISING / 10
        or setup.change * abs(record["mass_kda"]) > record["sigma_mass_kda"],
        TrackStatus.PARTLY_SEEN: _is_partly_seen(record, setup),
        TrackStatus.SHORT_WAY: record["short_way"],
        TrackStatus.NOT_FREE: min(record[name] for name in _FREE) <= SURPRISING,
        TrackStatus.STANDS_STILL: record["d_low_um2_s"] == 0,
        TrackStatus.NEAR_WALL: SLOWED_BY_WALL * record["diameter_nm"] > SLOWED * record["z_nm"],
    }
    return [status for status in TrackStatus if seen.get(status, False)]


def _is_partly_seen(record: Mapping[str, Any], setup: TrackSetup) -> bool:
    """Whether a particle that hardly moves is detected in only a part of the movie."""
    frames = setup.frames[1] - setup.frames[0]
    if setup.frame_rate_hz is None or record["n_frames"] > _LEAST_SEEN_SHARE * frames:
        return False
    way_nm = math.sqrt(2 * _NM2_PER_UM2 * abs(record["d_um2_s"]) * frames / setup.frame_rate_hz)
    return way_nm < setup.hidden_nm


def _ends(rows: TrackRows, setup: TrackSetup, d_um2_s: float) -> dict[str, str]:
    """Say whether the track begins and ends with the movie, at the border, or inside the field."""
    step_nm = 0.0
    if setup.frame_rate_hz is not None and np.isfinite(d_um2_s):
        step_nm = 3 * float(np.sqrt(2 * d_um2_s * _NM2_PER_UM2 / setup.frame_rate_hz))
    border, room = setup.near_nm + step_nm, _room(rows, setup)
    ends = {}
    for which, at, frame in (("begins", 0, setup.frames[0]), ("ends", -1, setup.frames[1] - 1)):
        where = "border" if room[at] < border else "inside"
        ends[which] = "movie" if rows.frame[at] == frame else where
    return ends


def _table(records: Iterable[Mapping[str, Any]], fits: pd.DataFrame) -> pd.DataFrame:
    """Put records into columns with the right types."""
    table = pd.DataFrame(list(records))
    kept = [column for column in TRACKS if not column.optional or column.name in table]
    table = table.reindex(columns=[column.name for column in kept])
    table = table.astype({column.name: column.dtype for column in kept})
    table["nearest_nm"] = table["nearest_nm"].where(np.isfinite(table["nearest_nm"]))
    if "systematic_mass_kda" in fits:
        shared = fits.groupby(track_numbers(fits))["systematic_mass_kda"].median()
        table["systematic_mass_kda"] = table["track"].map(shared).astype("float64")
    return table
