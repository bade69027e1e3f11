"""What a track tells of its diffusion: displacements, their errors and their blur.

The camera shows a particle's place averaged over the exposure e, with an error ε_k of its own in
each frame.  Free diffusion gives the displacement d_k over a gap of g_k frames of length Δ

    Var d_k = 2D (g_k Δ − e/3) + σ_k² + σ_{k+1}²,      Cov(d_k, d_{k+1}) = D e/3 − σ_{k+1}²,

and nothing between others (Berglund, Phys. Rev. E 82, 011917, 2010, equations 6 and 12, for gaps
of one frame and equal errors).  So Σ(D) = E + D·A with three bands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis._kernels.diffusion import displacement_likelihood
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import array_of, real_array
from iscat_analysis.records import FloatArray

LEAST_POSITIONS = 4
"""A shorter track says too little: of its displacements, at least one must have two neighbours."""

_RATES_HZ = (1e-6, 1e9)
_LENGTHS_NM = (1e-6, 1e9)  # the smallest error and the largest place
_MOST_RATIO = 1e5  # of the errors of a track; their squares must not drown in one another
_MOST_FRAMES = 2**53  # beyond, not every frame has a number of its own
_OF_TIMES = ("gaps_s", "linked", "error", "rate")  # and of errors alone, of `Displacements`
_ROUNDING = 1e-9  # an exposure that is the whole interval may exceed it by this share


class Likelihood(NamedTuple):
    """Log-likelihood of a diffusion coefficient D [nm²/s]."""

    value: float
    slope: float
    curvature: float
    information: float
    log_determinant: float
    log_determinant_slope: float


@dataclass(frozen=True, eq=False)
class Displacements:
    """A track, checked; build it with `gather`."""

    positions_nm: FloatArray
    variance_nm2: FloatArray
    frames: NDArray[np.int64]
    interval_s: float
    exposure_s: float
    counted: NDArray[np.int64]

    @cached_property
    def gaps_s(self) -> FloatArray:
        """Time that each displacement takes, shape (m,) [s]."""
        return np.asarray(np.diff(self.frames)[self.counted] * self.interval_s)

    @cached_property
    def steps_nm(self) -> FloatArray:
        """Displacements, shape (c, m)."""
        return np.ascontiguousarray(np.diff(self.positions_nm, axis=1)[:, self.counted])

    @cached_property
    def linked(self) -> NDArray[np.bool_]:
        """Whether a displacement begins where the one before ended, shape (m − 1,)."""
        return np.asarray(np.diff(self.counted) == 1)

    @cached_property
    def error(self) -> tuple[FloatArray, FloatArray]:
        """E: its diagonal, shape (c, m), and the band beside it, (c, m − 1) [nm²]."""
        variance, k = self.variance_nm2, self.counted
        band = np.where(self.linked, -variance[:, k[1:]], 0.0)
        return variance[:, k] + variance[:, k + 1], np.ascontiguousarray(band)

    @cached_property
    def rate(self) -> tuple[FloatArray, FloatArray]:
        """A: its diagonal, shape (m,), and the band beside it, (m − 1,) [s]."""
        blur = self.exposure_s / 3
        return 2 * (self.gaps_s - blur), np.where(self.linked, blur, 0.0)

    def moved(self, positions_nm: FloatArray) -> Displacements:
        """Replace the positions; frames and errors stay.

        Shapes: `positions_nm` (c, n).
        """
        track = replace(self, positions_nm=positions_nm)
        vars(track).update({name: getattr(self, name) for name in _OF_TIMES})
        return track

    def likelihood(self, d_nm2_s: float) -> Likelihood:
        """Log-likelihood of free diffusion."""
        return Likelihood(*displacement_likelihood(self.steps_nm, *self.error, *self.rate, d_nm2_s))


def gather(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None,
    counted: ArrayLike | None = None,
) -> Displacements:
    """Check the arrays of a track, and make its displacements.

    Shapes: `frames` (n,), `positions_nm` (n,) or (n, c).
    """
    rate = real_array("frame_rate_hz", frame_rate_hz)
    if rate.ndim or not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        raise ConfigError(
            f"frame_rate_hz = {frame_rate_hz!r}: give one number of frames per second between "
            f"{_RATES_HZ[0]:g} and {_RATES_HZ[1]:g}"
        )
    interval = 1 / float(rate)
    exposure = interval
    if exposure_ms is not None:
        given = real_array("exposure_ms", exposure_ms)
        if given.ndim or not (np.isfinite(given) and given >= 0):
            raise ConfigError(f"exposure_ms = {exposure_ms!r}: give one number of at least 0")
        exposure = float(given) / 1e3
        if exposure > interval * (1 + _ROUNDING):
            raise ConfigError(
                f"exposure_ms = {exposure_ms:g} is longer than the {1e3 * interval:g} ms from "
                f"frame to frame at frame_rate_hz = {frame_rate_hz:g}: correct one of them"
            )
    when = real_array("frames", frames)
    if when.ndim != 1 or when.size < LEAST_POSITIONS:
        raise DataError(
            f"frames: has shape {when.shape}; give the frame number of each of at least "
            f"{LEAST_POSITIONS} positions"
        )
    whole = np.isfinite(when).all() and (np.abs(when) < _MOST_FRAMES).all()
    whole = whole and (when == np.round(when)).all()
    if not whole or not (np.diff(when) > 0).all():
        raise DataError(
            "frames: give whole numbers that increase, each frame once; frames without a position "
            "are left out"
        )
    places = real_array("positions_nm", positions_nm)
    places = places[:, np.newaxis] if places.ndim == 1 else places
    if places.ndim != 2 or places.shape[0] != when.size or not places.shape[1]:
        raise DataError(
            f"positions_nm: has shape {np.shape(positions_nm)}; give ({when.size},) or "
            f"({when.size}, axes), one row for each of frames"
        )
    errors = real_array("sigma_nm", sigma_nm)
    columns = errors[:, np.newaxis] if errors.shape == when.shape else errors
    if columns.shape not in ((), (when.size, 1), places.shape):
        raise DataError(
            f"sigma_nm: has shape {errors.shape}; give one number, ({when.size},) or "
            f"{places.shape} as positions_nm has"
        )
    for name, array in (("positions_nm", places), ("sigma_nm", columns)):
        if not np.isfinite(array).all():
            raise DataError(f"{name}: is not finite everywhere; leave such frames out")
    least, most = _LENGTHS_NM
    if np.abs(places).max() > most:
        raise DataError(f"positions_nm = {places.flat[np.abs(places).argmax()]:g}: give nanometres")
    wrong = (columns < least) | (columns > most)
    if wrong.any():
        raise DataError(
            f"sigma_nm = {columns[wrong].flat[0]:g}: give the standard error of each position in "
            f"nanometres, at least {least:g}"
        )
    if columns.max() > _MOST_RATIO * columns.min():
        raise DataError(
            f"sigma_nm: goes from {columns.min():g} to {columns.max():g} nm; leave out positions "
            "that say nothing beside the others"
        )
    variance = np.broadcast_to(columns**2, places.shape).T
    every = np.ones(when.size - 1, dtype=bool)
    going = every if counted is None else array_of("counted", counted)
    if going.shape != (when.size - 1,) or going.dtype != bool:
        raise DataError(
            f"counted: has shape {going.shape} of {going.dtype}; give ({when.size - 1},) of bool, "
            "one for each displacement"
        )
    if going.sum() < LEAST_POSITIONS - 1:
        raise DataError(
            f"counted: leaves {going.sum()} displacements of {LEAST_POSITIONS - 1} that are needed"
        )
    return Displacements(
        positions_nm=np.ascontiguousarray(places.T),
        variance_nm2=np.ascontiguousarray(variance),
        frames=when.astype(np.int64),
        interval_s=interval,
        exposure_s=min(exposure, interval),
        counted=np.flatnonzero(going),
    )
