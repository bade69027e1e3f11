"""Landing movies: particles land and leave, windows slide, and known particles can be added.

Injection tells what the analysis finds of known particles.  A particle of contrast C multiplies the
expected counts of a pixel by 1 + C.  Where it darkens, each photoelectron is kept with probability
1 + C, and thinned Poisson counts are Poisson counts; where it brightens, photoelectrons of
expectation C times the counts are added, whose variance is too large by 2C of itself.  Both are
drawn from the normal law with these two moments and rounded at random, so that no rounding bias
remains.  Every particle lands, and leaves again three windows later.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis import records
from iscat_analysis._kernels.sliding import contrast_map
from iscat_analysis.bounds import power_searched
from iscat_analysis.camera import LARGEST_PX, Camera, CutFrames, LightModel, Mover, Trajectory
from iscat_analysis.diagnosis import Prepared, survey_over, within
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext, make_context, reported_steps
from iscat_analysis.fitting.events import Fitted
from iscat_analysis.fitting.pattern import SPAN, corrected
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.fitting.results import DetectionResult, view_of
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.landing.chunks import view_moved
from iscat_analysis.landing.find import analyse_landings, find_landings
from iscat_analysis.landing.maps import SidelobeFilter
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.landing.tasks import StepEvent, TaskBuilder, patch_of, trace_of
from iscat_analysis.movie import ChangedFrames
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.pipeline.finish import reported_rows
from iscat_analysis.pipeline.kinds import Kind, Look, candidate_table
from iscat_analysis.records import FloatArray, Status
from iscat_analysis.search import sliding
from iscat_analysis.search.chunks import HALO, Reader, halo_px, reader_of
from iscat_analysis.search.dating import StepFrame
from iscat_analysis.search.frames import Tile
from iscat_analysis.search.sliding import STRIDES, stride_of
from iscat_analysis.search.templates import LARGEST_IMAGE
from iscat_analysis.threads import threads

if TYPE_CHECKING:
    from iscat_analysis.pipeline.stored import StoredResult


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


@dataclass(frozen=True, eq=False)
class InjectedMovie(ChangedFrames):
    """A movie with particles added as it is read."""

    camera: Camera
    particles: list[Injected]
    seed: int
    trajectory: Trajectory | None = None

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` with the particles, shape (stop − start, y, x)."""
        counts = np.array(self.source.read(start, stop))
        for number, particle in enumerate(self.particles):
            (y, x), (ny, nx) = particle.corner, particle.contrast.shape
            box = slice(y, y + ny), slice(x, x + nx)
            camera, contrast_at = self.camera.part(box), self._mover(particle)
            for t in range(max(start, particle.frame), min(stop, particle.leave)):
                seed = np.random.SeedSequence(self.seed, spawn_key=(number, t))
                here, rng = counts[t - start][box], np.random.default_rng(seed)
                here[...] = _with_particle(here, contrast_at(t), camera, rng)
        return counts

    def _mover(self, particle: Injected) -> Callable[[int], FloatArray]:
        """Make the function that gives the contrast of a particle in a frame."""
        way = self.trajectory
        if way is None:
            return lambda _: particle.contrast
        mover = Mover((particle.contrast.shape[0], particle.contrast.shape[1]))
        spectrum, start = mover.spectrum(particle.contrast), way.at(particle.frame)
        return lambda t: mover.image(
            spectrum * mover.transfer((way.at(t) - start)[None], np.ones(1))
        )


def _with_particle(
    counts: NDArray[Any], contrast: FloatArray, camera: Camera, rng: np.random.Generator
) -> NDArray[Any]:
    gain = camera.gain_e_per_adu
    size = np.abs(contrast) * np.maximum(camera.to_electrons(counts), 0.0)
    variance = np.where(contrast < 0, size * np.maximum(1 + contrast, 0.0), size)
    change = np.copysign(size, contrast) + np.sqrt(variance) * rng.standard_normal(size.shape)
    if not np.issubdtype(counts.dtype, np.integer):
        return np.asarray(counts + change / gain, dtype=counts.dtype)
    limits = np.iinfo(counts.dtype)
    steps = np.floor(change / gain + rng.random(size.shape))
    changed: NDArray[Any] = np.clip(counts + steps, limits.min, limits.max)
    return changed.astype(counts.dtype)


def inject_and_recover(ready: Prepared, run: Run, result: DetectionResult) -> dict[str, Any]:
    """Add known particles to a movie, analyse it again and compare."""
    config, movie, camera = result.context.config, ready.movie, ready.camera
    if ready.stretches.breaks:  # a stretch tells what the others would
        config = within(config, ready.stretches.main)
    frames = fitted_frames(movie, config)
    window = int(result.summary["window_frames"])
    particles = draw_particles(result, movie.shape[1:], frames, window, run.inject)
    lines = result.context.lines if isinstance(result.context.lines, LightModel) else None
    again = analyse_landings(
        InjectedMovie(movie, camera, particles, config.compute.seed, result.trajectory),
        config.changed(background={"window_frames": window}),
        camera,
        Run(progress=run.progress, executor=run.executor),  # the user has been told already
        lines=lines,
    )
    if again.interrupted:
        raise KeyboardInterrupt
    rows = records.counted(reported_rows(again)[0])
    searched = again.summary["searched_share"] or 1.0
    return _recovery(particles, rows, result.context, frames[1], window, searched)


def draw_particles(
    result: DetectionResult,
    field_px: tuple[int, int],
    frames: tuple[int, int],
    window: int,
    count: int,
) -> list[Injected]:
    """Draw random places, times and masses, the masses from those that were found."""
    context, table = result.context, result.fits
    seed, height_nm = context.config.compute.seed, context.config.particle.nominal_height_nm
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2**31,)))
    good = table["mass_kda"][table["status"] == Status.OK].abs().to_numpy(dtype=float)
    if not good.size:
        good = np.array([context.model.material.mass_kda])
    margin = min(context.roi_px / 2, (min(field_px) - 1) / 2)
    # Windows between landing and leaving.
    stay = 3 * window
    first = frames[0] + window
    last = max(frames[1] - window - stay, first + 1)
    half, pixel = round(LARGEST_IMAGE * context.roi_px), context.pixel_nm
    particles = []
    for frame in np.sort(rng.integers(first, last, count)).tolist():
        x, y = (float(rng.uniform(margin, size - 1 - margin)) for size in field_px[::-1])
        mass = float(rng.choice(good))
        rows, columns = (
            (max(round(centre) - half, 0), min(round(centre) + half + 1, size))
            for centre, size in zip((y, x), field_px, strict=True)
        )
        grid, place = PixelGrid.region(rows, columns, pixel), (x * pixel, y * pixel)
        image = context.wide_at(*place, frame).image(grid, *place, height_nm, mass)
        leave = min(frame + stay, frames[1])
        particles.append(Injected(frame, leave, x, y, mass, (rows[0], columns[0]), image))
    return particles


def _recovery(
    particles: list[Injected],
    found: pd.DataFrame,
    context: AnalysisContext,
    last: int,
    window: int,
    searched: float,
) -> dict[str, Any]:
    """Compare what was found with what was added."""
    separation_px, sign = context.roi_px / 2, reported_steps(context)
    steps = [(p.frame, 1, p) for p in particles]
    steps += [(p.leave, -1, p) for p in particles if p.leave < last]
    frame, x, y, mass, error = (
        found[name].to_numpy(dtype=float)
        for name in ("frame", "x_px", "y_px", "mass_kda", records.FRAME_COLUMN)
    )
    rows: list[tuple[int, bool, int, Any]] = []
    for when, side, p in steps:
        if side * sign < 0:
            continue
        close = np.hypot(x - p.x_px, y - p.y_px)
        near = (close < 2.0) & (mass * side > 0)
        # beside the stated interval of the frame
        near &= np.abs(frame - when) <= error + 4
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
    if rows and np.isfinite(bounds).any():
        sigma, threshold = float(np.nanmedian(bounds)), context.templates.threshold
        powers = [power_searched(p.mass_kda / sigma, threshold) for *_, p in rows]
        result["predicted"] = searched * float(np.mean(powers))
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


class LandingSearch:
    """Searches for particles that land or leave between two windows."""

    def __init__(self, ready: Prepared) -> None:
        whole, self._stretches = ready.over_all_stretches(), ready.stretches.kept
        self._config = config = whole.config
        self.frames = whole.span
        self.longest = max(stop - start for start, stop in self._stretches) // 2
        opening = survey_over(ready.steady, config, ready.camera, self.frames, ready.opening)
        self._reader, noise, self.window = opening.reader, opening.noise, opening.window

        # lengths of window whose models are remembered
        @lru_cache(16)
        def context(window: int) -> AnalysisContext:
            searches = sum(
                sliding.boundaries(stop - start, window) for start, stop in self._stretches
            )
            return make_context(
                config, self._reader.shape, searches=searches, noise=noise.spectrum,
                lines=ready.lines, sliding=True,
            )  # fmt: skip

        self.context = context

    def look(self, frame: int, window: int) -> Look:
        """Compare the windows before and after the boundary at which a frame begins."""
        stride = stride_of(window)
        first, last = min(  # the stretch with or next to the frame in which windows have room
            (span for span in self._stretches if span[1] - span[0] >= 2 * stride),
            key=lambda span: max(span[0] - frame, frame + 1 - span[1], 0),
        )
        frame = min(max(frame, first + stride), last - stride)
        half = STRIDES * stride
        reach = (SPAN if self._config.background.follows_pattern else 1) * STRIDES
        blocks_before = min(reach, (frame - first) // stride)
        span = frame - blocks_before * stride, min(frame + reach * stride, last)
        context = self.context(window)
        with threads(self._config.compute.workers) as pool:
            chunk = self._reader.chunk(span, stride, pool)
            chunk, pattern = corrected(chunk, wanted=reach > STRIDES, mapper=pool.map)
        at = blocks_before - 1  # the boundary between blocks at which `frame` begins
        known = pattern.contrast[at] if pattern else None
        earlier, later = slice(max(at + 1 - STRIDES, 0), at + 1), slice(at + 1, at + 1 + STRIDES)
        usable = chunk.usable.astype(np.float32)
        image = contrast_map(chunk.blocks_e[earlier], chunk.blocks_e[later], usable)
        contrast = np.where(chunk.usable, image.astype(np.float64), np.nan)
        if known is not None:
            contrast = (1 + contrast) / (1 + known) - 1

        @cache
        def map_of() -> tuple[sliding.Filter, sliding.MapArray, FloatArray]:
            matched = sliding.make_filter(
                chunk, context.templates.images[0], context.templates.noise
            )
            count = chunk.edges.size - 2
            empty = np.zeros((count, *chunk.shape), np.float32), np.zeros(count)
            snr, effective = sliding.sliding_maps(
                chunk, matched, STRIDES, explained=None if known is None else lambda *_: known,
                earlier=empty, changed=[at],
            )  # fmt: skip
            return matched, snr[at : at + 1], effective[at : at + 1]

        def search(threshold: float) -> pd.DataFrame:
            matched, snr, effective = map_of()
            peaks = sliding.find_steps(chunk, matched, snr, effective, threshold)
            sieve = SidelobeFilter(chunk.first, stride, window, context.roi_px)
            sign, scale = reported_steps(context), context.model.scale
            return candidate_table(
                (p.x_px, p.y_px, p.snr, float(context.contrasts(np.asarray(p.amplitude))),
                 math.copysign(float(scale.mass(np.asarray(abs(p.amplitude)))), p.amplitude))
                for p in sieve.sift(peaks, (), snr)[0]
                if sign * p.amplitude >= 0
            )  # fmt: skip

        before, after = (max(frame - half, first), frame), (frame, min(frame + half, last))
        return Look(frame, before, after, contrast, context.templates.threshold, search)


class StoredSteps:
    """Draws rows of a landing movie: the windows before and after each step."""

    def __init__(self, ready: Prepared, result: StoredResult) -> None:
        self._ready, self._table, self._config = ready, result.table, ready.config
        self._window = int(result.summary[LANDING.heading]["window_frames"])
        self._stretches = result.summary.get("left_out", {}).get("analysed") or ()
        self._span = fitted_frames(ready.steady, ready.config)
        self._field = make_context(ready.config, ready.shape, lines=ready.lines, sliding=True)
        self._opened = lru_cache(1)(self._open)

    def _open(self, tile: Tile) -> tuple[Reader, AnalysisContext]:
        """Read the pixels of a tile alone."""
        part: records.CountSource = self._ready.steady
        if tile.shape != self._ready.shape:
            part = CutFrames(part, tile.shape, lambda images: images[..., *tile.here])
        camera = self._ready.camera.part(tile.here)
        return reader_of(part, self._config, camera, self._span), self._field.on_tile(tile)

    def __call__(self, row: int) -> records.EventView:
        """Draw a row of the table."""
        table, config, window = self._table, self._config, self._window
        tile = self._tile_around(table.iloc[row])
        reader, context = self._opened(tile)
        frame = int(table["frame"].iloc[row])
        inside = (span for span in self._stretches if span[0] <= frame < span[1])
        begin, end = next(inside, self._span)
        span = max(frame - HALO * window, begin), min(frame + HALO * window, end)
        with threads(config.compute.workers) as pool:
            chunk = reader.chunk(span, stride_of(window), pool)
            wanted = config.background.follows_pattern
            chunk, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
        neighbours = Neighbours(context, chunk, window, pattern)
        near = (table["frame"] - frame).abs() < 3 * window
        known = near & table["mass_kda"].notna() & records.is_event(table)
        known &= tile.holds(table["y_px"].to_numpy(float), table["x_px"].to_numpy(float))
        numbers = [row, *(int(i) for i in np.flatnonzero(known) if i != row)]
        steps = [_step(neighbours, table.iloc[i], tile.corner) for i in numbers]
        tasks = TaskBuilder(neighbours)
        task = tasks.build(0, steps, neighbours.of(steps)[0])
        if task is None:
            name = self._ready.steady.name
            raise DataError(f"{name}: there are no frames around frame {frame} to draw")
        start, z_range = task.displaced(steps[0].start), config.fit.z_range_nm
        fit = fit_particle(task.likelihood, start, context.mode, z_range, level=True)
        event = task.event(fit, task.likelihood, steps[0].sign)
        step = replace(steps[0], at=task.at)
        fitted = StepEvent(event, step, tuple(steps[1:]), np.zeros(0))
        trace = trace_of(fitted, patch_of(fitted, neighbours), tasks)
        number = int(table["event"].iloc[row])
        view = view_of(number, Fitted(task.region, fit, task.likelihood), trace=trace)
        return view_moved(view, tile.corner)

    def _tile_around(self, row: pd.Series[Any]) -> Tile:
        """Tile of the field needed to redraw one event: all of a small field."""
        shape = self._ready.shape
        reach = halo_px(self._config) if math.prod(shape) > LARGEST_PX else max(shape)
        rows, columns = (
            (max(round(place) - reach, 0), min(round(place) + reach + 1, size))
            for place, size in zip((row["y_px"], row["x_px"]), shape, strict=True)
        )
        return Tile(rows, columns, rows, columns, shape)


def _step(neighbours: Neighbours, row: pd.Series[Any], corner: tuple[int, int]) -> Step:
    """Make a `Step` of a row of the table, at its place in the tile at a corner."""
    frames = row["n_before"] * row["n_after"] / (row["n_before"] + row["n_after"])
    at = StepFrame(
        frame=int(row["frame"]), half_width=int(row["frame_ci95"]), height=1.0,
        per_frame_snr=float(row["snr"]) / math.sqrt(max(frames, 1.0)), p_constant=1.0,
    )  # fmt: skip
    mass = float(row["mass_kda"])
    start = records.Candidate(
        float(row["x_px"]) - corner[1], float(row["y_px"]) - corner[0], float(row["z_nm"]),
        abs(mass), float(row["snr"]),
    )  # fmt: skip
    return neighbours.draw(-1 if mass < 0 else 1, at, start)


LANDING = Kind("landing", find_landings, LandingSearch, StoredSteps, inject_and_recover)
