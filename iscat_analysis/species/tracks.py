"""Rows of one track, and selections of them.

One mass from many frames: a particle keeps its mass while it moves.

Each frame k gives an estimate m_k with the information J_k = 1/σ_k².  Its σ_k is that of its own
estimate, and follows it: J ∝ m^p makes w_k ∝ 1 + p (m_k − m)/m, and the weighted mean is too large
by the share

    E[m̂]/m − 1 = p (σ/m)² (1 − 1/n),

which does not become less with more frames.  With shot noise alone C = m h gives
J = B Σ h²/(1 + m h), so that p = −m Σ h³/Σ h² is some hundredths for a protein and the error below
10⁻⁴; where the scattered light outshines its noise p is 2, and 10 % errors of single frames make
2 %.  So information is taken at the common mass, J_k (m̂/m_k)^p: that is independent of what noise
did to frame k.

Frames that share a measured background share its noise where the particle is at the same place;
then their errors are correlated, and the mean is that of generalised least squares.

Masses that all tracks change together, as where the focus drifts.

A track of its own cannot tell whether it changed or the microscope did, and a short one not even
that it did; all of them can.  With the mean of each track taken off, the relative masses of all
frames are fitted by one parabola in time.

The refractive index of a particle whose light and whose size are both measured.

A small sphere of volume V scatters light in proportion to its polarisability (Bohren & Huffman,
Absorption and Scattering of Light by Small Particles, 1983, section 5.2)

    α = 3 V (n² − n_s²)/(n² + 2 n_s²) = 3 V L.

What light tells is α, here as a mass m of a known material: the contrast is that of V_m = m/ρ with
its L_m, or, with a calibration, that of a particle like the standards.  What motion tells is the
diameter d.  So L = L_m V_m/V_d, and

    n² = n_s² (1 + 2 L)/(1 − L),      dn/n = 3 dL/[2 (1 − L)(1 + 2 L)],
    (dL/L)² = (σ_m/m)² + (3 σ_d/d)²,

for the errors of the mass and of the diameter are independent: noise moves a fitted place as often
to either side.

Tracks: what the frames of one particle say together.

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pandas as pd
import scipy
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri, logit, ndtri

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import LARGEST, number_in, real_array
from iscat_analysis.records import (
    TRACK_COLUMNS,
    TRACKS,
    BoolArray,
    FloatArray,
    IntArray,
    Progress,
    Status,
    TrackStatus,
    silent,
    track_numbers,
)
from iscat_analysis.species.diffusion import (
    LEAST_POSITIONS,
    NM2_PER_UM2,
    Diffusion,
    Displacements,
    diffusion_of,
    gather,
    hydrodynamic_diameter,
)
from iscat_analysis.species.motion import exponent_of, steadiness_of, stretch_of, well_of
from iscat_analysis.threads import threads
from iscat_analysis.units import KILODALTON_KG, NM

NO_PLACE = (Status.NOT_CONVERGED, Status.SIDELOBE, Status.TOO_CLOSE)
"""Of rows that do not say how a particle moves."""


@dataclass(frozen=True)
class TrackRows:
    """Some rows of one track, sorted by frame; the columns of ``fits.csv``."""

    frame: FloatArray
    x_nm: FloatArray
    y_nm: FloatArray
    z_nm: FloatArray
    mass_kda: FloatArray
    contrast: FloatArray
    sigma_x_nm: FloatArray
    sigma_y_nm: FloatArray
    sigma_mass_kda: FloatArray
    crb_mass_kda: FloatArray
    status: NDArray[np.object_]

    def only(self, kept: BoolArray | IntArray) -> TrackRows:
        """Select some of the rows."""
        return TrackRows(*(getattr(self, column.name)[kept] for column in fields(self)))

    @property
    def rejected(self) -> bool:
        """Whether fewer than half of the rows are ok."""
        return bool(np.mean(self.status == Status.OK) < 1 / 2)

    def massive(self) -> TrackRows:
        """Select rows whose mass can be used: poor fits too if the model is rejected.

        The few that are ok would be a selection of the rows that are rejected like all others.
        """
        known = np.isfinite(self.sigma_mass_kda) & np.isfinite(self.crb_mass_kda)
        judged = self.status == Status.OK
        if self.rejected:
            judged |= self.status == Status.POOR_FIT
        return self.only(known & (self.mass_kda != 0) & judged)

    def enlarged(self, factor: float) -> TrackRows:
        """Multiply the errors by a factor."""
        names = ("sigma_x_nm", "sigma_y_nm", "sigma_mass_kda")
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def placed(self) -> TrackRows:
        """Select rows whose position can be used.

        A flag that fast motion itself causes must not exclude a row, or fast steps would be
        missing.
        """
        errors = np.fmax(self.sigma_x_nm, self.sigma_y_nm)
        # times the median error: such a place says nothing
        useful = errors <= 300.0 * of_known(np.median, errors)
        useful &= np.diff(self.frame, prepend=-1) > 0
        for status in NO_PLACE:
            useful &= self.status != status
        return self.only(useful)

    def timed(self, ticks: IntArray | None) -> TrackRows:
        """Replace frame numbers by the count of camera intervals, where frames are missing.

        Shapes: `ticks` (t,).
        """
        return self if ticks is None else replace(self, frame=1.0 * ticks[self.frame.astype(int)])

    def positions(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give frames, places and their errors, shapes (n,), (n, 2) and (n, 2) [nm]."""
        places, errors = (self.x_nm, self.y_nm), (self.sigma_x_nm, self.sigma_y_nm)
        return self.frame, np.stack(places, axis=1), np.stack(errors, axis=1)


def rows_by_track(fits: pd.DataFrame) -> dict[int, TrackRows]:
    """Divide a table by its tracks."""
    numbers = track_numbers(fits)
    known, track = fits[numbers.notna()], numbers.dropna().to_numpy(int)
    rows = TrackRows(
        *(
            known[part.name].to_numpy(object if part.name == "status" else float)
            for part in fields(TrackRows)
        )
    )
    order = np.lexsort((rows.frame, track))
    edges = np.flatnonzero(np.diff(track[order], prepend=-1, append=-1))
    return {int(track[order[a]]): rows.only(order[a:b]) for a, b in pairwise(edges)}


def nearest_nm(groups: Mapping[int, TrackRows]) -> dict[int, float]:
    """Smallest distance of each track to any other in the same frame [nm]."""
    own = np.repeat(np.arange(len(groups)), [len(rows.frame) for rows in groups.values()])
    every = [np.stack([rows.frame, rows.x_nm, rows.y_nm]) for rows in groups.values()]
    place = np.concatenate(every or [np.zeros((3, 0))], axis=1).T
    known = np.isfinite(place).all(axis=1)
    own, place = own[known], place[known]
    far = 3 * np.abs(place[:, 1:]).max(initial=1.0)  # apart are frames: nothing else is as far
    place[:, 0] *= far
    apart, other = scipy.spatial.cKDTree(place).query(place, k=3)  # itself, and two others
    of_track = np.append(own, -1)[other] == own[:, None]
    apart[of_track | (apart >= far)] = np.inf
    closest = np.full(len(groups), np.inf)
    np.fmin.at(closest, own, apart.min(axis=1))
    return dict(zip(groups, closest.tolist(), strict=True))


def of_known(statistic: Callable[[FloatArray], Any], values: FloatArray) -> float:
    """Apply a statistic to the values that are finite."""
    known = values[~np.isnan(values)]
    return float(statistic(known)) if known.size else np.nan


@dataclass(frozen=True)
class CommonMass:
    """The mass of a track, by the columns of ``tracks.csv``."""

    mass_kda: float
    sigma_mass_kda: float
    crb_mass_kda: float
    mass_scatter: float
    p_mass: float
    n_mass_frames: int

    @property
    def enlargement(self) -> float:
        """Factor by which frames scatter beyond their errors (Birge, Phys. Rev. 40, 207, 1932)."""
        return max(self.mass_scatter, 1.0) if self.n_mass_frames > 1 else 1.0


def combine_masses(
    mass_kda: FloatArray,
    sigma_kda: FloatArray,
    crb_kda: FloatArray,
    *,
    power: float = 0.0,
    correlation: FloatArray | None = None,
) -> CommonMass:
    """Combine the frames of one track.

    Shapes: `mass_kda` (n,), `sigma_kda, crb_kda` (n,), `correlation` (n, n).
    """
    decorrelated: Callable[[FloatArray], FloatArray] = np.asarray
    if correlation is not None:
        decorrelated = partial(scipy.linalg.cho_solve, scipy.linalg.cho_factor(correlation))

    def weights_at(common: float, errors: FloatArray) -> FloatArray:
        """Weights of generalised least squares, of errors as they are at the common mass."""
        errors = errors * np.abs(mass_kda / common) ** (power / 2)
        return np.asarray(decorrelated(1 / errors) / errors)

    mass = float(np.median(mass_kda))
    # rounds of mass and weights; each has an error (p σ/m)²/n of the one before
    for _ in range(8):
        weights, before = weights_at(mass, sigma_kda), mass
        mass = float(weights @ mass_kda / weights.sum())
        if abs(mass - before) <= 1e-9 * abs(mass):
            break
    off = (mass_kda - mass) / (sigma_kda * np.abs(mass_kda / mass) ** (power / 2))
    inside, free = float(off @ decorrelated(off)), mass_kda.size - 1
    return CommonMass(
        mass_kda=mass,
        sigma_mass_kda=float(weights.sum() ** -0.5),
        crb_mass_kda=float(weights_at(mass, crb_kda).sum() ** -0.5),
        mass_scatter=math.sqrt(inside / free) if free else math.nan,
        p_mass=float(chdtrc(free, inside)) if free else math.nan,
        n_mass_frames=mass_kda.size,
    )


def information_power(tracks: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Estimate how the information of a frame grows with its own estimate: p of J ∝ m^p.

    The line through ln J against ln m has one slope for all tracks and an intercept for each, so
    that differences between particles do not matter.
    """
    product = square = 0.0
    for mass, sigma in tracks:
        size, information = np.log(np.abs(mass)), -2 * np.log(sigma)
        size = size - size.mean()
        product += float(size @ (information - information.mean()))
        square += float(size @ size)
    return product / square if square > 0 else 0.0


_DEGREE = 2


def common_change(
    tracks: Sequence[tuple[FloatArray, FloatArray, FloatArray]], frames: tuple[int, int]
) -> float:
    """Range of the relative change of all masses with time; 0 where none is significant.

    Shapes: `tracks` (n,).
    """
    first, last = frames
    information, pull = [], []
    for frame, mass, sigma in tracks:
        if len(frame) <= _DEGREE + 1:
            continue
        mean = np.average(mass, weights=sigma**-2)
        weight = (mean / sigma) ** 2
        time = 2 * (frame - first) / max(last - 1 - first, 1) - 1
        slopes = legendre.legvander(time, _DEGREE)[:, 1:]
        slopes = slopes - np.average(slopes, axis=0, weights=weight)
        information.append((slopes.T * weight) @ slopes)
        pull.append(slopes.T @ (weight * (mass / mean - 1)))
    # tracks without which no change is common
    if len(pull) < 3:
        return 0.0
    pulls, known = np.array(pull), np.array(information)
    every, whole = pulls.sum(axis=0), known.sum(axis=0)
    # p-value below which a common change is reported, whichever two tracks are left out
    least = chdtri(_DEGREE, 1e-4)
    own = np.einsum("ni,nij,nj->n", pulls, np.linalg.pinv(known), pulls)
    # those that change most by themselves, of which two are left out in turn
    suspects = np.argsort(-own)[:12].tolist()
    for left_out in (*combinations(range(len(pulls)), 1), *combinations(suspects, 2)):
        rest = every - pulls[[*left_out]].sum(axis=0)
        if rest @ np.linalg.pinv(whole - known[[*left_out]].sum(axis=0)) @ rest < least:
            return 0.0
    found = np.linalg.pinv(whole) @ every
    change = legendre.legval(np.linspace(-1, 1, last - first), np.append(0.0, found))
    return float(np.ptp(change))


_LARGEST_INDEX = 10.0


def refractive_index(
    mass_kda: ArrayLike,
    diameter_nm: ArrayLike,
    *,
    sigma_mass_kda: ArrayLike = 0.0,
    sigma_diameter_nm: ArrayLike = 0.0,
    index: float = 1.46,
    density_kg_m3: float = 1350.0,
    n_medium: float = 1.33,
) -> tuple[FloatArray, FloatArray]:
    """Refractive index of spheres that scatter like a known mass and have a known diameter.

    Parameters
    ----------
    mass_kda : array_like
        Masses that the contrasts are, of the material below [kDa].
    diameter_nm : array_like
        Diameters, as of `hydrodynamic_diameter` [nm].
    sigma_mass_kda, sigma_diameter_nm : array_like
        Their standard errors [kDa, nm].
    index : float
        Refractive index of the material that the masses are of; default protein.
    density_kg_m3 : float
        Its density [kg/m³].
    n_medium : float
        Refractive index of the liquid.

    Returns
    -------
    index : ndarray
        NaN where no sphere of that diameter scatters as much, or the diameter is not finite.
    sigma : ndarray
        Its standard error, to first order.

    Raises
    ------
    ConfigError
        A refractive index or the density is not above zero, or the material scatters like the
        liquid.
    DataError
        A number is not real, or shapes do not go together.

    References
    ----------
    Bohren & Huffman, Absorption and Scattering of Light by Small Particles (1983), section 5.2.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> n, error = ia.refractive_index(150.0, 7.05, sigma_mass_kda=5.0, sigma_diameter_nm=0.2)
    >>> print(f"{n:.3f} ± {error:.3f}")
    1.460 ± 0.012
    """
    for name, value, most in (
        ("index", index, _LARGEST_INDEX),
        ("density_kg_m3", density_kg_m3, LARGEST),
        ("n_medium", n_medium, _LARGEST_INDEX),
    ):
        number_in(name, value, above=0.0, most=most)
    if index == n_medium:
        raise ConfigError(f"index = {index:g} is that of the medium: such particles are not seen")
    named = {
        "mass_kda": mass_kda,
        "diameter_nm": diameter_nm,
        "sigma_mass_kda": sigma_mass_kda,
        "sigma_diameter_nm": sigma_diameter_nm,
    }
    arrays = [real_array(name, value) for name, value in named.items()]
    for name, array in zip(named, arrays, strict=True):
        far = np.isfinite(array) & (np.abs(array) > LARGEST)  # D of 0 makes a diameter infinite
        wrong = array < 0 if name.startswith("sigma") else far
        if wrong.any():
            raise DataError(f"{name} = {array[wrong].flat[0]:g}: no particle has that; check it")
    try:
        mass, diameter, sigma_mass, sigma_diameter = np.broadcast_arrays(*arrays)
    except ValueError:
        raise DataError(f"{', '.join(named)}: have shapes that do not go together") from None
    contrast = (index**2 - n_medium**2) / (index**2 + 2 * n_medium**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        volume_nm3 = mass * (KILODALTON_KG / density_kg_m3 / NM**3)
        part = contrast * volume_nm3 / (np.pi / 6 * diameter**3)
        sized = (diameter > 0) & np.isfinite(diameter)
        usable = sized & np.isfinite(part) & (part < 1) & (part > -0.5)
        part = np.where(usable, part, np.nan)
        found = n_medium * np.sqrt((1 + 2 * part) / (1 - part))
        relative = np.hypot(sigma_mass / mass, 3 * sigma_diameter / diameter)
        sigma = found * 1.5 * np.abs(part) * relative / ((1 - part) * (1 + 2 * part))
    return np.asarray(found), np.asarray(sigma)


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

# Errors of images alone, which are enlarged where the fits of a track are rejected.
_OF_IMAGES = ("sigma_mass_kda", "sigma_optical_diameter_nm", "sigma_refractive_index")
_FREE = ("p_confinement", "p_anomalous", "p_steady")
_STEPS = 3.0  # standard deviations of a displacement within which it may end beyond the border


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
    ticks: IntArray | None = None
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
    found = []
    for track, rows in groups.items():
        good, mass = massive[track], None
        if len(good.frame):
            places = np.stack([good.x_nm, good.y_nm], axis=1)
            among = None if correlation is None else correlation(places)
            masses = good.mass_kda, good.sigma_mass_kda, good.crb_mass_kda
            mass = combine_masses(*masses, power=power, correlation=among)
        wider = mass.enlargement if rows.rejected and mass is not None else 1.0
        placed = rows.placed().timed(setup.ticks).enlarged(wider)
        found.append(_Track(track, rows, placed, mass, wider, exact.get(track, {})))
    motions = _motions(found, setup, seed, workers, progress)
    records = []
    for each in found:
        motion, tests = motions[each.number]
        record = each.record(motion, setup) | {"nearest_nm": nearest[each.number], **tests}
        status = _remarks(record, setup)
        record["status"] = str(status[0]) if status else str(TrackStatus.OK)
        crossed = ["crosses"] if record["nearest_nm"] < setup.near_nm else []
        record["flags"] = ";".join([*map(str, status), *crossed])
        records.append(record)
    return _table(records, fits)


def changes_together(fits: pd.DataFrame, frames: tuple[int, int]) -> float:
    """Relative change of mass that all tracks share."""
    massive = [rows.massive() for rows in rows_by_track(fits).values()]
    return common_change([(g.frame, g.mass_kda, g.sigma_mass_kda) for g in massive], frames)


@dataclass(frozen=True)
class _Track:
    """One track: its rows, those that say where it is, its mass, and that of all frames together.

    The errors of the mass are to be multiplied by `wider`; those of the places are already.
    """

    number: int
    rows: TrackRows
    placed: TrackRows
    mass: CommonMass | None
    wider: float
    exact: Mapping[str, float]

    def record(self, found: Diffusion | None, setup: TrackSetup) -> dict[str, Any]:
        """Make the row of the track, without the tests of its motion."""
        rows = self.rows
        record: dict[str, Any] = dict.fromkeys(TRACK_COLUMNS, np.nan)
        record |= {
            "track": self.number,
            "first_frame": int(rows.frame[0]),
            "last_frame": int(rows.frame[-1]),
            "n_frames": len(rows.frame),
            "n_mass_frames": 0,
            "rejected": rows.rejected,
            "n_d_frames": len(self.placed.frame),
            **{axis: of_known(np.mean, getattr(rows, axis)) for axis in ("x_nm", "y_nm", "z_nm")},
        }
        if self.mass is not None:
            record |= vars(self.mass)
        known = {name: value for name, value in self.exact.items() if np.isfinite(value)}
        known_share = known.pop("told", 1.0)
        record |= known
        record |= {name: self.wider * record[name] for name in record if name in _OF_IMAGES}
        scale = _scale_error(record, known_share)
        # of the information on the mass the background leaves little, and what its error adds to
        # that of D is seen
        record["short_way"] = known_share < 0.05 and scale > 0.04
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


def _diffusion(placed: TrackRows, setup: TrackSetup) -> tuple[Diffusion, Displacements] | None:
    """Fit D to displacements that begin so far inside that they cannot have left the field."""
    least = max(LEAST_POSITIONS, setup.min_frames)
    if setup.frame_rate_hz is None or len(placed.frame) < least:
        return None
    whole = gather(
        *placed.positions(), frame_rate_hz=setup.frame_rate_hz, exposure_ms=setup.exposure_ms
    )
    room, inside = _room(placed, setup)[:-1], whole.counted
    # at D, on which it depends which displacements tell it
    for _ in range(3):
        counted = whole if inside is whole.counted else replace(whole, counted=inside)
        reach = _STEPS * np.sqrt(2 * counted.best_nm2_s * whole.gaps_s)
        inside = np.flatnonzero(room > reach)
        if inside.size < least - 1:
            return None
        if np.array_equal(inside, counted.counted):
            break
    return diffusion_of(counted, COVERAGE), whole


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
    tracks: Sequence[_Track], setup: TrackSetup, seed: int, workers: int, progress: Progress
) -> dict[int, tuple[Diffusion | None, dict[str, float]]]:
    """D of all tracks and the tests of their motion; an interrupt leaves tests out."""

    def motion(track: _Track, tested: bool = True) -> tuple[Diffusion | None, dict[str, float]]:
        found = _diffusion(track.placed, setup)
        if found is None:
            return None, {}
        rng = np.random.default_rng([seed, track.number])
        return found[0], _tests(found[1], rng) if tested else {}

    motions = {}
    longest_first = sorted(tracks, key=lambda track: -len(track.placed.frame))
    with threads(workers) as pool, suppress(KeyboardInterrupt):
        for track, found in zip(longest_first, pool.map(motion, longest_first), strict=True):
            motions[track.number] = found
            progress("tracks", len(motions), len(tracks))
    left = [track for track in tracks if track.number not in motions]
    return motions | {track.number: motion(track, tested=False) for track in left}


def _tests(whole: Displacements, rng: np.random.Generator) -> dict[str, float]:
    """Test whether the motion is free; two of the tests use the first positions of long tracks."""
    # the first 300: the time of a test grows fast
    track = stretch_of(whole, slice(300))
    # few resamples first; three that are as surprising leave no doubt
    walls = well_of(track, 19, 3, rng)
    if walls.p_value <= 0.1:
        walls = well_of(track, 199, None, rng)
    power = exponent_of(track)
    return {
        "p_confinement": walls.p_value,
        "confinement_nm": walls.confinement_nm if walls.p_value <= SURPRISING else np.nan,
        "exponent": power.exponent,
        "sigma_exponent": power.sigma_exponent,
        "p_anomalous": power.p_value,
        "p_steady": steadiness_of(whole),
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
    # of all frames, in which a particle that hardly moves is seen at least
    if setup.frame_rate_hz is None or record["n_frames"] > 0.9 * frames:
        return False
    way_nm = math.sqrt(2 * NM2_PER_UM2 * abs(record["d_um2_s"]) * frames / setup.frame_rate_hz)
    return way_nm < setup.hidden_nm


def _ends(rows: TrackRows, setup: TrackSetup, d_um2_s: float) -> dict[str, str]:
    """Say whether the track begins and ends with the movie, at the border, or inside the field."""
    step_nm = 0.0
    if setup.frame_rate_hz is not None and np.isfinite(d_um2_s):
        step_nm = 3 * float(np.sqrt(2 * d_um2_s * NM2_PER_UM2 / setup.frame_rate_hz))
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
