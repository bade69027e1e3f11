"""Motion that all particles of a movie share, although none moves because of another.

A vibrating stage or beam moves all of them by the same.  Where a frame is missing, all of them go
as far as in two frames.  Both make D too large, and no single track shows it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.records import BoolArray, FloatArray, Status
from iscat_analysis.species.tracks import NO_PLACE

FEWEST_PARTICLES = 3
"""Particles in a pair of frames, at least."""

LEAST_COMMON_SHARE = 0.05
"""Of the square of a particle's step, what is common to all, from which on it is said."""

MANY_FRAMES_MISSING = 8
"""Frames missing at once, which are not the run of two or three where single ones are dropped."""

_SOUND = 0.5  # of a track's rows that are ok: others may be two halves of something else
_LEAST_STEPS = 20  # of a track, which tell how far it goes
_LEAST_PAIRS = 30  # of frames
_SIGNIFICANT = 5.0  # standard errors
_UNLIKELY = 8.0  # of log-likelihood: one good movie in e⁸ at most
_OTHERS = 7.0  # the same, of all particles but the one that went farthest, which may be another
_GAPS = (2, 3, 5, 8, 13, 20, 30, 50, 80)
_LONGEST = 4.0  # standard deviations of a step that counts
_CLIPPED = 4.0  # |step|²/2v: no single particle, which may be lost, decides over all
_SHARES = np.linspace(0.005, 0.5, 100)

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class _Steps:
    """Steps from a frame to the next, in the order of the frames."""

    frame: IntArray
    """Number of the pair of frames, from 0."""
    numbers: IntArray
    """Of each pair, that of its second frame in the movie."""
    step: FloatArray
    """Along x and y [nm], shape (n, 2)."""
    variance: FloatArray
    """Of the steps of this track along each axis [nm²]."""

    def total(self, values: FloatArray) -> FloatArray:
        """Add up what belongs to each pair of frames."""
        sums = np.bincount(self.frame, weights=values, minlength=len(self.numbers))
        return sums.astype(np.float64)


def warnings_of(
    fits: pd.DataFrame, frame_rate_hz: float | None, ticks: IntArray | None = None
) -> Iterator[str]:
    """Warn of motion that all particles share; `ticks` (t,) tells which frames are missing."""
    steps = _steps_of(fits, ticks)
    if steps is None:
        return
    shaken = _shared_steps(steps, frame_rate_hz)
    if shaken:
        yield shaken
    jumps, dropped = _jumps(steps), _dropped(steps)
    many = [text for missing, text in jumps if missing >= MANY_FRAMES_MISSING]
    if many:
        yield from many
    elif dropped and not shaken:
        yield dropped
    else:
        yield from (text for _, text in jumps)


def _steps_of(fits: pd.DataFrame, ticks: IntArray | None) -> _Steps | None:
    """Gather the steps of all tracks; None where too few particles are seen at once."""
    sound = fits["status"].eq(Status.OK).groupby(fits["track"]).transform("mean") > _SOUND
    good = fits.loc[sound & ~fits["status"].isin(NO_PLACE), ["track", "frame", "x_nm", "y_nm"]]
    good = good.sort_values(["track", "frame"])
    step = good.diff()
    next_ = ((step["track"] == 0) & (step["frame"] == 1)).to_numpy()
    if ticks is not None:
        next_ = next_ & (np.diff(ticks[good["frame"].to_numpy(int)], prepend=-1) == 1)
    xy = step.loc[next_, ["x_nm", "y_nm"]].to_numpy(float)
    track, frame = (good.loc[next_, name].to_numpy(dtype=np.int64) for name in ("track", "frame"))
    variance = np.full(len(track), np.nan)
    for k in np.unique(track):
        mine = track == k
        if mine.sum() >= _LEAST_STEPS:
            variance[mine] = np.median((xy[mine] ** 2).sum(axis=1)) / (2 * math.log(2))
    used = variance > 0
    numbers, count = np.unique(frame[used], return_counts=True)
    numbers = numbers[count >= FEWEST_PARTICLES]
    used &= np.isin(frame, numbers)
    if len(numbers) < _LEAST_PAIRS:
        return None
    order = np.flatnonzero(used)[np.argsort(frame[used], kind="stable")]
    pair = np.searchsorted(numbers, frame[order]).astype(np.int64)
    return _Steps(pair, numbers.astype(np.int64), xy[order], variance[order])


def _shared_steps(steps: _Steps, frame_rate_hz: float | None) -> str:
    """Say that all particles move by the same from frame to frame; empty where they do not.

    The variance of the common step is the mean product of the steps of two different particles.
    """
    length = np.hypot(*steps.step.T) / np.sqrt(steps.variance)
    cut = steps.step * np.minimum(1, _LONGEST / np.maximum(length, _LONGEST))[:, None]
    weight = 1 / steps.variance
    both = [steps.total(weight * cut[:, k]) ** 2 for k in (0, 1)]
    own = steps.total(weight**2 * (cut**2).sum(axis=1))
    pairs = steps.total(weight) ** 2 - steps.total(weight**2)
    product = both[0] + both[1] - own
    mean, error = product.mean(), product.std() / math.sqrt(len(product))
    common = float(product.sum() / (2 * pairs.sum()))  # variance along each axis
    if mean < _SIGNIFICANT * error or common < LEAST_COMMON_SHARE * float(
        np.median(steps.variance)
    ):
        return ""
    by = ""
    if frame_rate_hz is not None:
        by = f", by up to {1e-6 * common * frame_rate_hz / 2:.2g} um2/s"
    return (
        f"all particles move together, by {math.sqrt(common):.2g} nm from frame to frame along "
        f"each axis beside what each does by itself, as where the stage or the beam vibrates: D is "
        f"too large{by}, and tracks may seem not to diffuse freely; damp it"
    )


def _normalized_squares(steps: _Steps) -> tuple[FloatArray, FloatArray]:
    """Give |step|²/2v of each step, 1 on average, and the number of steps of each frame pair."""
    square = (steps.step**2).sum(axis=1) / (2 * steps.variance)
    return square, steps.total(np.ones(len(steps.frame)))


def _jumps(steps: _Steps) -> list[tuple[int, str]]:
    """Find frames between which all particles go so far that frames must be missing."""
    surprise, particles = _normalized_squares(steps)
    total = steps.total(surprise)
    largest = np.zeros(len(total))
    np.maximum.at(largest, steps.frame, surprise)
    most, others = np.zeros(len(total)), np.zeros(len(total))
    missing = np.zeros(len(total), dtype=np.int64)
    for gap in _GAPS:
        gain = total * (1 - 1 / gap) - particles * math.log(gap)
        missing[gain > most] = gap - 1
        most = np.maximum(most, gain)
        rest = (total - largest) * (1 - 1 / gap) - (particles - 1) * math.log(gap)
        others = np.maximum(others, rest)
    found: BoolArray = (most > _UNLIKELY + math.log(len(total))) & (others > _OTHERS)
    out = []
    for k in np.flatnonzero(found)[:3].tolist():
        number = int(steps.numbers[k])
        text = (
            f"all {int(particles[k])} particles jump from frame {number - 1} to {number}, as far "
            f"as in {missing[k] + 1} frames: some {missing[k]} frames seem to be missing there, "
            "and D of tracks that go on is too large; analyse the movie in two parts "
            f"(fit.frames = [0, {number}], and from {number} on)"
        )
        out.append((int(missing[k]), text))
    return out


def _dropped(steps: _Steps) -> str:
    """Say that many single frames are missing; empty where they are not."""
    surprise, particles = _normalized_squares(steps)
    clipped = np.minimum(surprise, _CLIPPED)
    # mean of exp(½ min(e, c)) over e of mean 1: what the clipped odds must be divided by
    norm = 2 - math.exp(-_CLIPPED / 2)
    gain = steps.total(clipped) / 2 - particles * math.log(norm)
    odds = np.exp(np.minimum(gain, 50.0))
    likely = np.log1p(_SHARES[:, None] * (odds - 1)).sum(axis=1)
    best = int(np.argmax(likely))
    if likely[best] < _UNLIKELY:
        return ""
    return (
        f"of {len(particles)} pairs of frames about {_SHARES[best]:.0%} show all particles go as "
        "far as in two frames: the camera seems to have dropped frames, and D is too large by "
        "about as much; compare the times of the frames, and write fewer pixels or slower"
    )
