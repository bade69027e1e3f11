"""A movie of particles that move: its models, its frames in memory, and the search of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from iscat_analysis.camera import Camera, LightModel, find_defects
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.records import BoolArray, CountSource, FloatArray, Progress
from iscat_analysis.tracking.frame_search import FrameCandidates, FrameFilter
from iscat_analysis.tracking.joint.exposures import Exposures
from iscat_analysis.tracking.joint.joint_fit import first_background
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations
from iscat_analysis.units import count

LEAST_FRAMES = 20
"""Frames in a movie at least: fewer leave the background to the particles."""

RING_SLOPE = 1.7
"""Distance of the outer rings of a particle over its height, tan 60°: within it, what is much
fainter than the particle may be what the model leaves over of them."""

_PAIRS = 100  # of successive frames, which tell how noisy a pixel is
_NOISY = 3.0  # times the variance of its light, and of the pixels around it
_BY_CHANCE = 1e-9  # of a pixel that is not
_AROUND = 7  # pixels, along each axis
_SAMPLED = 4  # blocks, of which one tells whether the others are searched
_BLOCK = 16  # frames that are read or searched at a time; what more of them need is slow to clear


def exposure_of(config: Config) -> tuple[float, float]:
    """Give the frame rate and the exposure."""
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if rate is None:
        return 1.0, 1.0
    return rate, 1 / rate if exposure is None else exposure / 1e3


def tracking_context(
    config: Config, field_px: tuple[int, int], frames: int, lines: LightModel | None = None
) -> AnalysisContext:
    """Make models and matched filter for single frames."""
    fit = config.fit.model_copy(update={"mode": config.track.free})
    tracked = config.model_copy(update={"fit": fit})
    return make_context(tracked, field_px, searches=frames, lines=lines)


def initial_background(config: Config, field: MovingField) -> BackgroundEstimate:
    """Give the background before there are tracks: the median of the frames."""
    ground = first_background(field, follow_power=config.background.power_normalization)
    if config.background.method == "fixed":
        ground = replace(ground, level=np.maximum(field.total_e / ground.power.sum(), 1e-3))
    return ground


def load_field(
    context: AnalysisContext,
    movie: CountSource,
    camera: Camera,
    span: tuple[int, int],
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> MovingField:
    """Read the frames; they stay integers where that takes less memory."""
    first, last = span
    frames, shape = last - first, (movie.shape[1], movie.shape[2])
    refuse_few_frames(movie.name, frames)
    exposures = _room_for((frames, *shape), movie.dtype, camera)
    counts = exposures.counts
    saturated, total, light = np.zeros(shape, dtype=bool), np.zeros(shape), np.empty(frames)

    def read_some(start: int) -> tuple[BoolArray, FloatArray]:
        raw = movie.read(start, min(start + _BLOCK, last))
        check(raw, start)
        part = counts[start - first : start - first + len(raw)]
        part[:] = raw if counts.dtype == np.uint16 else camera.to_electrons(raw)
        light[start - first :][: len(raw)] = part.mean(axis=(1, 2), dtype=np.float64)
        full = np.asarray(camera.saturated(raw).any(axis=0))
        return full, np.sum(part, axis=0, dtype=np.float64)

    starts = range(first, last, _BLOCK)
    for start, (full, added) in zip(starts, pool.map(read_some, starts), strict=True):
        saturated |= full
        total += added
        progress("background", min(start + _BLOCK, last) - first, frames)
    read = np.broadcast_to(camera.read_variance_e2(shape), shape)
    total, light = exposures.in_electrons(total, frames), exposures.in_electrons(light, 1)
    masked = saturated | find_defects(total, frames * read)
    masked |= _noisy(exposures, light, total / frames + read)
    nominal = abs(context.model.scale.amplitude(context.model.material.mass_kda))
    free_z = context.mode == "joint"
    return MovingField(
        exposures, read, ~masked, context.model, context.wide,
        pixel_nm=context.pixel_nm, roi_px=context.roi_px,
        z_range_nm=context.config.fit.z_range_nm if free_z else None,
        largest=100 * nominal, pool=pool, saturated=saturated,
    )  # fmt: skip


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
    field: MovingField,
    movie: CountSource,
    camera: Camera,
    first: int,
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
        divided = camera.to_electrons(movie.read(first + start, first + stop))
        return np.multiply(divided, lines.taken(signal[start:stop].astype(np.float64)))

    field.renew(block)


def _room_for(shape: tuple[int, int, int], stored: np.dtype[Any], camera: Camera) -> Exposures:
    """Allocate the frames, as stored integers where these are small and share one gain."""
    gain, offset = camera.gain_e_per_adu, camera.offset_adu
    if np.can_cast(stored, np.uint16) and isinstance(gain, float) and isinstance(offset, float):
        return Exposures(np.empty(shape, dtype=np.uint16), gain, offset)
    return Exposures(np.empty(shape, dtype=np.float32))


def _noisy(exposures: Exposures, light_e: FloatArray, variance_e2: FloatArray) -> BoolArray:
    """Tell which pixels have far more noise than their light, and than the pixels around them.

    Particles that move change the light from frame to frame as well, of many pixels together.
    """
    frames = len(light_e)
    firsts = np.arange(0, frames - 1, max(2, frames // _PAIRS))
    light = light_e / (light_e.mean() or 1.0)
    squares = np.zeros(variance_e2.shape)
    for t in firsts.tolist():
        if light[t] > 0 and light[t + 1] > 0:
            one, other = exposures.electrons(t), exposures.electrons(t + 1)
            squares += (one / light[t] - other / light[t + 1]) ** 2
    noise = squares / (2 * len(firsts) * np.maximum(variance_e2, 1.0))
    most = max(_NOISY, float(chdtri(len(firsts), _BY_CHANCE)) / len(firsts))
    noisy = noise > most
    if noisy.any():  # else nobody needs to know how noisy those around are
        around = median_filter(noise, size=_AROUND, mode="nearest")
        noisy &= noise > most * around
    return np.asarray(noisy)


def search_frames(
    context: AnalysisContext,
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    pool: ThreadPoolExecutor,
    frames: tuple[int, int] | None = None,
    *,
    enough: int = 0,
    cautious: bool = False,
) -> FrameCandidates:
    """Find candidates in the residual of the rows so far."""
    side = context.roi_px
    if context.mode == "joint":
        side += round(2 * RING_SLOPE * context.config.fit.z_range_nm[1] / field.pixel_nm)
    search = FrameFilter(
        context.templates, ground.level, field.read_e2, field.used,
        polarity=context.config.detection.sign, roi_px=side, cautious=cautious,
    )  # fmt: skip
    if frames is None:
        field.draw(ground, rows)
    starts = rows.starts(field.frames)
    pixel = field.pixel_nm
    places = np.column_stack([rows.theta[:, :2] / pixel, rows.snr])

    def block(first: int) -> FrameCandidates:
        last = min(first + _BLOCK, end)
        known = [places[starts[t] : starts[t + 1]] for t in range(first, last)]
        return search.find(
            field.residual(ground, rows, first, last), ground.power[first:last], first, known
        )

    begin, end = frames or (0, field.frames)
    blocks = list(range(begin, end, _BLOCK))
    sample = blocks[:: _SAMPLED if enough else 1]
    parts = dict(zip(sample, pool.map(block, sample), strict=True))
    if sum(len(part.frame) for part in parts.values()) > enough / _SAMPLED:
        others = [first for first in blocks if first not in parts]
        parts |= zip(others, pool.map(block, others), strict=True)
    found = [parts[first] for first in sorted(parts)]
    return FrameCandidates(
        *(
            np.concatenate([getattr(part, name) for part in found])
            for name in ("frame", "x_px", "y_px", "z_nm", "strength", "snr")
        )
    )
