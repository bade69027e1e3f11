"""Injection and recovery: what the analysis finds of known particles added to the measured movie.

A particle of contrast C multiplies the expected counts of a pixel by 1 + C.  Where it darkens,
each photoelectron is kept with probability 1 + C, and thinned Poisson counts are Poisson counts;
where it brightens, photoelectrons of expectation C times the counts are added, whose variance is
too large by 2C of itself.  Both are drawn from the normal law with these two moments and rounded at
random, so that no rounding bias remains.  Every particle lands, and leaves again three windows
later.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.bounds import power_searched
from iscat_analysis.camera import Camera, LightModel, Mover, Trajectory
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import Prepared
from iscat_analysis.executors import Executor
from iscat_analysis.fitting.context import AnalysisContext, reported_steps
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run, notify_nobody
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.pipeline.finish import reported_rows
from iscat_analysis.records import FRAME_COLUMN, CountSource, FloatArray, Progress, Status, counted
from iscat_analysis.search.templates import LARGEST_IMAGE

FEWEST_WINDOWS_PRESENT = 3
"""Windows between landing and leaving."""

_SAME_PX = 2.0
_SAME_FRAMES = 4  # beside the stated interval of the frame


@dataclass(frozen=True)
class Injected:
    """One particle that is added to a movie."""

    frame: int
    leave: int
    x_px: float
    y_px: float
    mass_kda: float
    corner: tuple[int, int]
    contrast: FloatArray


class InjectedMovie:
    """A movie with particles added as it is read."""

    def __init__(
        self,
        movie: CountSource,
        camera: Camera,
        particles: list[Injected],
        seed: int,
        trajectory: Trajectory | None = None,
    ) -> None:
        self._trajectory = trajectory
        self._movie = movie
        self._camera = camera
        self._particles = particles
        self._seed = seed

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self._movie.shape

    @property
    def name(self) -> str:
        """What messages call it."""
        return self._movie.name

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""
        return self._movie.dtype

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` with the particles, shape (stop − start, y, x)."""
        counts = np.array(self._movie.read(start, stop))
        for number, particle in enumerate(self._particles):
            rows = slice(particle.corner[0], particle.corner[0] + particle.contrast.shape[0])
            columns = slice(particle.corner[1], particle.corner[1] + particle.contrast.shape[1])
            gain, offset = (
                v[rows, columns] if isinstance(v, np.ndarray) else v
                for v in (self._camera.gain_e_per_adu, self._camera.offset_adu)
            )
            move = self._mover(particle)
            for t in range(max(start, particle.frame), min(stop, particle.leave)):
                rng = np.random.default_rng(
                    np.random.SeedSequence(self._seed, spawn_key=(number, t))
                )
                here = counts[t - start, rows, columns]
                here[...] = _with_particle(here, move(t), gain, offset, rng)
        return counts

    def _mover(self, particle: Injected) -> Callable[[int], FloatArray]:
        """Make the function that gives the contrast of a particle in a frame."""
        way = self._trajectory
        if way is None:
            return lambda _: particle.contrast
        mover = Mover((particle.contrast.shape[0], particle.contrast.shape[1]))
        spectrum, start = mover.spectrum(particle.contrast), way.at(particle.frame)
        return lambda t: mover.image(
            spectrum * mover.transfer((way.at(t) - start)[None], np.ones(1))
        )


def _with_particle(
    counts: NDArray[Any],
    contrast: FloatArray,
    gain: float | FloatArray,
    offset: float | FloatArray,
    rng: np.random.Generator,
) -> NDArray[Any]:
    electrons = np.maximum((counts - offset) * gain, 0.0)
    size = np.abs(contrast) * electrons
    variance = np.where(contrast < 0, size * np.maximum(1 + contrast, 0.0), size)
    change = np.copysign(size, contrast) + np.sqrt(variance) * rng.standard_normal(size.shape)
    if not np.issubdtype(counts.dtype, np.integer):
        return np.asarray(counts + change / gain, dtype=counts.dtype)
    limits = np.iinfo(counts.dtype)
    steps = np.floor(change / gain + rng.random(size.shape))
    changed: NDArray[Any] = np.clip(counts + steps, limits.min, limits.max)
    return changed.astype(counts.dtype)


def injected(ready: Prepared, run: Run, found: DetectionResult) -> tuple[dict[str, Any], bool]:
    """Summarise how many injected particles are found, and how well they are measured."""
    if not run.inject or found.interrupted:
        return {}, False
    try:
        config = found.context.config
        if ready.stretches.breaks:  # a stretch tells what the others would
            fit = config.fit.model_copy(update={"frames": ready.stretches.main})
            config = config.model_copy(update={"fit": fit})
        recovered = inject_and_recover(
            ready.movie, config, ready.camera, found, run.inject,
            progress=run.progress, executor=run.executor,
        )  # fmt: skip
    except KeyboardInterrupt:
        return {}, True
    finally:
        run.clock.lap("injection")
    return {"injection": recovered}, False


def inject_and_recover(
    movie: CountSource,
    config: Config,
    camera: Camera,
    result: DetectionResult,
    count: int,
    *,
    progress: Progress,
    executor: Executor | None = None,
) -> dict[str, Any]:
    """Add known particles to a movie, analyse it again and compare."""
    from iscat_analysis.landing.find import analyse_landings

    frames = fitted_frames(movie, config)
    window = int(result.summary["window_frames"])
    fixed = config.background.model_copy(update={"window_frames": window})
    seed = config.compute.seed
    particles = draw_particles(
        result.context, (movie.shape[1], movie.shape[2]), frames, window, count, result.fits, seed
    )
    lines = result.context.lines if isinstance(result.context.lines, LightModel) else None
    again = analyse_landings(
        InjectedMovie(movie, camera, particles, seed, result.trajectory),
        config.model_copy(update={"background": fixed}),
        camera,
        warn=notify_nobody,  # the user has been told already
        progress=progress,
        lines=lines,
        executor=executor,
    )
    if again.interrupted:
        raise KeyboardInterrupt
    rows = reported_rows(again).table
    return recovery(
        particles,
        counted(rows),
        frames[1],
        result.context.roi_px / 2,
        window,
        sign=reported_steps(result.context),
        threshold=result.context.templates.threshold,
        searched=again.summary["searched_share"],
    )


def draw_particles(
    context: AnalysisContext,
    field_px: tuple[int, int],
    frames: tuple[int, int],
    window: int,
    count: int,
    table: pd.DataFrame,
    seed: int,
) -> list[Injected]:
    """Draw random places, times and masses, the masses from those that were found."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2**31,)))
    good = table["mass_kda"][table["status"] == Status.OK].abs().to_numpy(dtype=float)
    if not good.size:
        good = np.array([context.model.material.mass_kda])
    margin = min(context.roi_px / 2, (min(field_px) - 1) / 2)
    stay = FEWEST_WINDOWS_PRESENT * window
    first = frames[0] + window
    last = max(frames[1] - window - stay, first + 1)
    landings = np.sort(rng.integers(first, last, count))
    particles = []
    for landing in landings:
        x = float(rng.uniform(margin, field_px[1] - 1 - margin))
        y = float(rng.uniform(margin, field_px[0] - 1 - margin))
        mass = float(rng.choice(good))
        spans = []
        for centre, size in zip((y, x), field_px, strict=True):
            middle, half = round(centre), round(LARGEST_IMAGE * context.roi_px)
            spans.append((max(middle - half, 0), min(middle + half + 1, size)))
        grid = PixelGrid.region(spans[0], spans[1], context.pixel_nm)
        place = (x * context.pixel_nm, y * context.pixel_nm)
        image = context.wide_at(*place, int(landing)).image(
            grid, *place, context.config.particle.nominal_height_nm, mass
        )
        frame = int(landing)
        leave = min(frame + stay, frames[1])
        particles.append(Injected(frame, leave, x, y, mass, (spans[0][0], spans[1][0]), image))
    return particles


def recovery(
    particles: list[Injected],
    found: pd.DataFrame,
    last: int,
    separation_px: float,
    window: int,
    *,
    sign: int = 0,
    threshold: float | None = None,
    searched: float | None = None,
) -> dict[str, Any]:
    """Compare what was found with what was added."""
    steps = [(p.frame, 1, p) for p in particles]
    steps += [(p.leave, -1, p) for p in particles if p.leave < last]
    frame, x, y, mass, error = (
        found[name].to_numpy(dtype=float)
        for name in ("frame", "x_px", "y_px", "mass_kda", FRAME_COLUMN)
    )
    rows: list[tuple[int, bool, int, Any]] = []
    for when, side, p in steps:
        if side * sign < 0:
            continue
        close = np.hypot(x - p.x_px, y - p.y_px)
        near = (close < _SAME_PX) & (mass * side > 0)
        near &= np.abs(frame - when) <= error + _SAME_FRAMES
        best = int(np.argmin(np.where(near, close, np.inf))) if near.any() else -1
        others = (close < separation_px) & (np.abs(frame - when) < 2 * window)
        if best >= 0:
            others[best] = False
        alone = not others.any() and not any(
            math.hypot(q.x_px - p.x_px, q.y_px - p.y_px) < separation_px
            and abs(t - when) < 2 * window
            for t, s, q in steps
            if q is not p or s != side
        )
        rows.append((best, alone, when, p))
    chosen = [(best, when, p) for best, alone, when, p in rows if alone and best >= 0]
    isolated = sum(alone for _, alone, _, _ in rows)
    recovered = sum(best >= 0 for best, _, _, _ in rows)
    result: dict[str, Any] = {
        "stay_frames": min((p.leave - p.frame for p in particles), default=None),
        "added": len(rows),
        "recovered": recovered,
        "recall": recovered / len(rows) if rows else None,
        "isolated": isolated,
        "recall_isolated": len(chosen) / isolated if isolated else None,
    }
    bounds = found["crb_mass_kda"][found["status"] == Status.OK].to_numpy(dtype=float)
    if threshold is not None and rows and np.isfinite(bounds).any():
        sigma = float(np.nanmedian(bounds))
        powers = [power_searched(p.mass_kda / sigma, threshold) for *_, p in rows]
        result["predicted"] = (searched or 1.0) * float(np.mean(powers))
    if len(chosen) < 2:
        return result
    index = [best for best, _, _ in chosen]
    truth = np.array([p.mass_kda for _, _, p in chosen])
    late = np.abs(frame[index] - np.array([when for _, when, _ in chosen]))
    off = np.abs(mass[index]) - truth
    over_crb = off / found["crb_mass_kda"].to_numpy(dtype=float)[index]
    pulls = off / found["sigma_mass_kda"].to_numpy(dtype=float)[index]
    n = len(chosen)
    return result | {
        "bias_rel": float(np.mean(off / truth)),
        "bias_rel_se": float(np.std(off / truth, ddof=1) / math.sqrt(n)),
        "spread_over_crb": float(np.std(over_crb, ddof=1)),
        "spread_over_crb_se": float(np.std(over_crb, ddof=1) / math.sqrt(2 * (n - 1))),
        "pull_std": float(np.std(pulls, ddof=1)),
        "frame_within_1": float(np.mean(late <= 1)),
        "frame_in_interval": float(np.mean(late <= error[index])),
    }
