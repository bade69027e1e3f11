"""Which frames are followed, in blocks of which length, and how they come into memory.

Frames that the camera dropped or repeated are left out: a repeated one shows particles that stand
still, and counts its light twice; one without light shows nothing.  The others keep their numbers,
so that a particle's step over missing frames is one of several.

The background of a block of T frames is known to its counting noise, of every pixel the variance
1/(B T) of its relative light.  Where the stage drifts, the light is that of no frame: the pattern's
shift s(t) leaves in a frame the relative change ∇B·(s(t) − s̄)/B, on average over the block the
variance ∇Bᵀ V(T) ∇B/B², V the covariance of s within a block.  Of these two the second is

    C(T) = T Σ_ij K_ij V_ij(T),   K_ij = ⟨∂_i B ∂_j B/B⟩ over the pixels,

times the first.  A steady velocity v has V = v² T²/12, so that both are equal, C = 1, where
T³ = 12/(K v²); blocks are longer by a factor of 1.7, `MOST_DRIFT_OVER_COUNTING`.

In the noise curve of landing movies, the variance between neighbouring averages of n frames over
that of the light, the same drift is 1 + K v² n³/2.  But the curve is no measure of it here: where
particles cover the field all the time, averages differ by the particles in them.  The shift is that
of all pixels together, and particles hardly pull at it.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from iscat_analysis.camera import (
    Camera,
    Check,
    LightModel,
    Trajectory,
    find_defects,
    follow_pattern,
    trusted,
)
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import light_and_repeats
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.tracks import BLOCKS_FOLLOW_DRIFT, TRACKED_FRAMES_LEFT_OUT
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.movie import SelectedFrames, Stack
from iscat_analysis.records import BoolArray, CountSource, FloatArray, IntArray, Progress, Windows
from iscat_analysis.search.frames import DARK, well_lit
from iscat_analysis.species.diffusion import gather
from iscat_analysis.tracking.field import Exposures, MovingField
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations
from iscat_analysis.units import count, listed

BYTES = 16
"""Of memory for each pixel and frame of a block: counts, picture, slopes of the particles."""

SHORTEST = 25
"""Frames of a block at least, where drift makes it short: in fewer, particles hardly leave where
they are, and are taken for background."""

MOST_DRIFT_OVER_COUNTING = 5.0
"""Drift over counting noise, C, that a block may have.  A particle pays more for counting noise
than a pixel does: it stays at a place for many frames and makes the same error in all of them,
while the errors that a steady drift makes before and after the middle of a block cancel."""

_READ = 64  # frames read at a time


@dataclass(frozen=True)
class Recording:
    """A movie that is followed, its camera, a check of frames that are read, and threads."""

    movie: CountSource
    camera: Camera
    check: Check
    pool: ThreadPoolExecutor
    progress: Progress


@dataclass(frozen=True)
class Plan:
    """How a movie is divided."""

    spans: tuple[tuple[int, int], ...]
    moved_px: tuple[float, float] | None = None
    drift_over_counting: float | None = None
    drifts: bool = False

    @property
    def frames(self) -> int:
        """Frames of the longest block."""
        return max(last - first for first, last in self.spans)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of them, under ``"blocks"``."""
        return {
            "number": len(self.spans),
            "frames": self.frames,
            "drift_px": None if self.moved_px is None else list(self.moved_px),
            "drift_over_counting": self.drift_over_counting,
        }

    def finding(self, name: str) -> Finding | None:
        """Find why there are several blocks; None where that needs no message."""
        if not self.drifts or self.moved_px is None or self.drift_over_counting is None:
            return None
        rest = ""
        if self.drift_over_counting > MOST_DRIFT_OVER_COUNTING:
            rest = (
                f", which still change by {self.drift_over_counting:.2g} times their counting "
                "noise: masses scatter more than their errors say; let the stage settle, or record "
                "faster"
            )
        values = {"y_px": self.moved_px[0], "x_px": self.moved_px[1]}
        blocks = {"blocks": len(self.spans), "frames": self.frames}
        return BLOCKS_FOLLOW_DRIFT(values | blocks | {"rest": rest}, where=name)


def plan_blocks(recording: Recording, config: Config, span: tuple[int, int]) -> Plan:
    """Divide a movie into blocks of frames that have a background each."""
    movie, (first, last) = recording.movie, span
    frames, pixels = last - first, movie.shape[1] * movie.shape[2]
    memory_mb, given = config.compute.memory_limit_mb, config.track.block_frames
    room = int(memory_mb * 1e6) // (BYTES * pixels)
    longest = max(room, LEAST_FRAMES) if given == "auto" else given
    count = max(1, min(math.ceil(frames / longest), frames // LEAST_FRAMES))
    needed = math.ceil(frames / count)
    if needed > room and frames >= LEAST_FRAMES:
        advice = "raise it" if given == "auto" else "raise it, or lower track.block_frames"
        raise DataError(
            f"{movie.name}: a block of {needed} frames takes {BYTES * needed * pixels / 1e6:.0f} "
            f"MB of memory, more than compute.memory_limit_mb = {memory_mb}: {advice}"
        )
    motion = None
    # a pattern is followed in fields of 32 pixels and more
    if given == "auto" and frames >= 2 * SHORTEST and min(movie.shape[1:]) >= 32:
        motion, stiffness = follow_light(recording, config, span)
    if motion is None:
        return Plan(_spans(first, last, count))
    shift = motion.at(np.arange(first, last, dtype=float))
    moved = (float(shift[-1, 0] - shift[0, 0]), float(shift[-1, 1] - shift[0, 1]))
    unrest = float(np.sum(stiffness * jitter_covariance(motion.shift_px)))

    def cost_of(count: int) -> float:
        whole = drift_over_counting(shift, stiffness, _spans(0, frames, count))
        return max(whole - unrest * frames / count, 0.0)

    most = max(count, frames // SHORTEST)
    short = (n for n in range(count, most) if cost_of(n) <= MOST_DRIFT_OVER_COUNTING)
    blocks = next(short, most)
    return Plan(_spans(first, last, blocks), moved, cost_of(blocks), blocks > count)


def drift_over_counting(
    shift_px: FloatArray, stiffness: FloatArray, spans: tuple[tuple[int, int], ...]
) -> float:
    """Compare what drift makes of backgrounds with their counting noise.

    Shapes: `shift_px` (t, 2), `stiffness` (2, 2).
    """
    total = sum(
        (b - a) ** 2 * float(np.sum(stiffness * np.cov(shift_px[a:b].T, bias=True)))
        for a, b in spans
    )
    return total / sum(b - a for a, b in spans)


def follow_light(
    recording: Recording, config: Config, span: tuple[int, int]
) -> tuple[Trajectory | None, FloatArray]:
    """Measure how the fixed pattern moves through a movie, and its stiffness per squared pixel.

    Shapes: `stiffness` (2, 2).
    """
    movie, camera, (first, last) = recording.movie, recording.camera, span
    shape = (movie.shape[1], movie.shape[2])
    # the sums between which the pattern is followed take a quarter of the memory
    most = int(0.25 * config.compute.memory_limit_mb * 1e6 / (8 * math.prod(shape)))
    # at most 64 sums, of 20 frames or more: the more frames, the less particles in them pull
    count = max(2, min(64, most, (last - first) // 20))
    spans = _spans(first, last, count)
    sums, full = np.zeros((count, *shape)), np.zeros((count, *shape), dtype=bool)

    def add_up(part: int) -> None:
        for start in range(*spans[part], _READ):
            raw = movie.read(start, min(start + _READ, spans[part][1]))
            recording.check(raw, start)
            full[part] |= camera.saturated(raw).any(axis=0)
            sums[part] += len(raw) * camera.to_electrons(raw.mean(axis=0))

    list(recording.pool.map(add_up, range(count)))
    read = np.broadcast_to(camera.read_variance_e2(shape), shape)
    usable = ~(full.any(axis=0) | find_defects(sums.sum(axis=0), (last - first) * read))
    light = sums[:, usable].mean(axis=1) if usable.any() else np.zeros(count)
    lengths = np.array([high - low for low, high in spans])
    if not light.sum() > 0:
        return None, np.zeros((2, 2))
    power = light * lengths.sum() / light.sum()
    middle = np.array([(low + high - 1) / 2 for low, high in spans])
    motion = follow_pattern(sums, power, middle, usable, read, mapper=recording.pool.map)
    inside = trusted(usable)
    if motion is None or not inside.any() or not np.isfinite(motion.shift_px).all():
        return None, np.zeros((2, 2))
    return motion, _stiffness(sums / lengths[:, None, None], read, inside, lengths)


def _stiffness(
    means_e: FloatArray, read_e2: FloatArray, used: NDArray[np.bool_], frames: IntArray
) -> FloatArray:
    """Mean of ∂_i B ∂_j B/(B + read noise) over pixels and averages, without that of noise."""
    total = np.zeros((2, 2))
    for mean, n in zip(means_e, frames, strict=True):
        slopes = np.reshape(np.gradient(mean), (2, -1))
        weight = (used / np.maximum(mean + read_e2, 1.0)).ravel()
        total += (slopes * weight) @ slopes.T / used.sum()
        total -= np.eye(2) / (2 * n)  # half the difference of two pixels has half their variance
    return total / len(means_e)


def jitter_covariance(shift_px: FloatArray) -> FloatArray:
    """Covariance (2, 2) of errors of single shifts, such as bright particles make.

    It is that of second differences over 6, in which a steady drift does not show.
    """
    second_difference = np.diff(shift_px, n=2, axis=0)
    return second_difference.T @ second_difference / (6 * max(len(second_difference), 1))


def _spans(first: int, last: int, count: int) -> tuple[tuple[int, int], ...]:
    """Divide a range of frames into parts of equal length."""
    edges = [first + (last - first) * k // count for k in range(count + 1)]
    return tuple(pairwise(edges))


MANY = 0.05
"""Share of the frames that may be left out without a word on what that means."""


@dataclass(frozen=True)
class FrameSubset:
    """The frames of a movie that are analysed."""

    movie: Stack
    span: tuple[int, int]
    numbers: IntArray | None = None
    finding: Finding | None = None

    def put_back(self, found: DetectionResult) -> DetectionResult:
        """Give frames their numbers in the movie."""
        if self.numbers is None or found.followed is None:
            return found
        numbers, followed = self.numbers, found.followed
        windows = _renumbered(followed.windows, numbers)
        after = windows.power[windows.n_before :]
        power = np.tile(np.where(after > 0, after, np.nan), 2)
        return replace(
            found,
            fits=found.fits.assign(frame=numbers[found.fits["frame"].to_numpy(dtype=np.int64)]),
            compared=replace(Compared.of(windows), power=power),
            followed=replace(
                followed,
                windows=windows,
                parts=tuple(_renumbered(part, numbers) for part in followed.parts),
            ),
        )


def keep_frames(
    movie: Stack, camera: Camera, span: tuple[int, int], *, additive: bool = False
) -> FrameSubset:
    """Leave out frames that repeat others or have no light."""
    light_e, repeats = light_and_repeats(movie, camera, span)
    dark = np.isneginf(light_e) if additive else ~well_lit(light_e, DARK)
    good = ~(dark | repeats)
    if good.all() or not good.any():
        return FrameSubset(movie, span)
    numbers = span[0] + np.flatnonzero(good)
    seen = movie.seen_as(SelectedFrames(movie, numbers))
    missing, share = span[0] + np.flatnonzero(~good), float(np.mean(repeats & ~dark))
    values = {"s": "", "are": "is", "repeat": "repeats", "frames": listed(missing, 4), "many": ""}
    if len(missing) > 1:
        values |= {"s": "s", "are": "are", "repeat": "repeat"}
    if share > MANY:
        values["many"] = (
            f"; {share:.0%} of the frames: if the file holds each of the camera's several times, D "
            "is too small by as much; export it with each once, at the camera's own rate"
        )
    finding = TRACKED_FRAMES_LEFT_OUT(values, where=movie.name)
    return FrameSubset(seen, (0, len(numbers)), numbers, finding)


def _renumbered(windows: Windows, numbers: IntArray) -> Windows:
    """Give a range of kept frames its numbers in the movie; frames left out get no light."""
    first, last = windows.frames_after
    kept = numbers[first:last]
    span = int(kept[0]), int(kept[-1]) + 1
    before, after = np.split(windows.power, 2)
    power: FloatArray = np.zeros(span[1] - span[0])
    power[kept - span[0]] = after
    both = np.concatenate([before, power])
    return replace(windows, frames_before=span, frames_after=span, power=both)


LEAST_FRAMES = 20
"""Frames in a movie at least: fewer leave the background to the particles."""


_BLOCK = 16  # frames that are read or searched at a time; what more of them need is slow to clear


def exposure_of(config: Config) -> float:
    """Give the exposure [s], or where the frame rate is not known 1."""
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if rate is None:
        return 1.0
    return 1 / rate if exposure is None else exposure / 1e3


def diffusion_of_positions(
    config: Config, frames: IntArray | FloatArray, places_nm: FloatArray, sigma_nm: FloatArray
) -> tuple[float, float]:
    """D of a track and its standard error [µm²/s], or where the frame rate is not known per frame.

    Shapes: `frames` (n,), `places_nm` and `sigma_nm` (n, 2).
    """
    rate, exposure_ms = config.camera.frame_rate_hz or 1.0, 1e3 * exposure_of(config)
    track = gather(frames, places_nm, sigma_nm, frame_rate_hz=rate, exposure_ms=exposure_ms)
    return track.estimate()


def tracking_context(
    config: Config, field_px: tuple[int, int], frames: int, lines: LightModel | None = None
) -> AnalysisContext:
    """Make models and matched filter for single frames."""
    tracked = config.changed(fit={"mode": config.track.free})
    return make_context(tracked, field_px, searches=frames, lines=lines)


def load_field(
    context: AnalysisContext, recording: Recording, span: tuple[int, int]
) -> MovingField:
    """Read the frames; they stay integers where that takes less memory."""
    movie, camera, (first, last) = recording.movie, recording.camera, span
    frames, shape = last - first, (movie.shape[1], movie.shape[2])
    refuse_few_frames(movie.name, frames)
    gain, offset = camera.gain_e_per_adu, camera.offset_adu
    small = np.can_cast(movie.dtype, np.uint16)
    if small and isinstance(gain, float) and isinstance(offset, float):
        exposures = Exposures(np.empty((frames, *shape), dtype=np.uint16), gain, offset)
    else:
        exposures = Exposures(np.empty((frames, *shape), dtype=np.float32))
    counts = exposures.counts

    def read_some(start: int) -> BoolArray:
        raw = movie.read(start, min(start + _BLOCK, last))
        recording.check(raw, start)
        stored = raw if counts.dtype == np.uint16 else camera.to_electrons(raw)
        counts[start - first : start - first + len(raw)] = stored
        return np.asarray(camera.saturated(raw).any(axis=0))

    starts, saturated = range(first, last, _BLOCK), np.zeros(shape, dtype=bool)
    for start, full in zip(starts, recording.pool.map(read_some, starts), strict=True):
        saturated |= full
        recording.progress("background", min(start + _BLOCK, last) - first, frames)
    read = np.broadcast_to(camera.read_variance_e2(shape), shape)
    total = exposures.in_electrons(counts.sum(axis=0, dtype=np.float64), frames)
    light = exposures.in_electrons(counts.mean(axis=(1, 2), dtype=np.float64), 1)
    masked = saturated | find_defects(total, frames * read)
    masked |= _noisy(exposures, light, total / frames + read)
    return MovingField(
        exposures,
        read,
        ~masked,
        context.model,
        context.wide,
        pixel_nm=context.pixel_nm,
        roi_px=context.roi_px,
        z_range_nm=context.config.fit.z_range_nm if context.config.fit.heights_free else None,
        pool=recording.pool,
        saturated=saturated,
    )


def refuse_few_frames(name: str, frames: int) -> None:
    """Refuse a movie whose background cannot be learnt."""
    if frames < LEAST_FRAMES:
        raise DataError(
            f"{name}: has {count(frames, 'frame')}, too few to tell particles that "
            f"move from what they move over; {LEAST_FRAMES} are needed, or background.frames "
            "without particles"
        )


def restore_particle_light(
    context: AnalysisContext,
    recording: Recording,
    first: int,
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
) -> None:
    """Undo what dividing frames by their unsteady light took from the particles.

    A particle adds to the light of its rows and columns, and of whatever else a frame was divided
    by.  Where its signal is known, that light is known without it.
    """
    lines = context.lines
    if lines is None or not len(rows.frame):
        return
    signal = field.draw(ground, rows, coarse=False)

    def block(start: int, stop: int) -> FloatArray:
        raw = recording.movie.read(first + start, first + stop)
        divided = recording.camera.to_electrons(raw)
        return np.multiply(divided, lines.taken(signal[start:stop].astype(np.float64)))

    field.renew(block)


def _noisy(exposures: Exposures, light_e: FloatArray, variance_e2: FloatArray) -> BoolArray:
    """Tell which pixels have far more noise than their light, and than the pixels around them.

    Particles that move change the light from frame to frame as well, of many pixels together.
    """
    frames = len(light_e)
    # 100 pairs of successive frames tell how noisy a pixel is
    firsts = np.arange(0, frames - 1, max(2, frames // 100))
    light = light_e / (light_e.mean() or 1.0)
    squares = np.zeros(variance_e2.shape)
    for t in firsts.tolist():
        if light[t] > 0 and light[t + 1] > 0:
            one, other = exposures.electrons(t), exposures.electrons(t + 1)
            squares += (one / light[t] - other / light[t + 1]) ** 2
    noise = squares / (2 * len(firsts) * np.maximum(variance_e2, 1.0))
    # 3.0 times the variance of the light, and more than chance makes once in 1e9 pixels
    most = max(3.0, float(chdtri(len(firsts), 1e-9)) / len(firsts))
    noisy = noise > most
    if noisy.any():  # else nobody needs to know how noisy those around are
        around = median_filter(noise, size=7, mode="nearest")  # pixels, along each axis
        noisy &= noise > most * around
    return np.asarray(noisy)
