"""Images of events of a stored result, made again from the movie.

A result keeps numbers only.  With its movie, the counts of an event are summed again, the other
events of the table are put in their places, and a fit that starts at the stored estimate gives the
images of the report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import (
    LARGEST_PX,
    Camera,
    CutFrames,
    LightModel,
    add_frames,
    refine_power,
)
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import (
    Event,
    Fitted,
    PlaceAndMass,
    Region,
    photons_scale,
    region_around,
    region_likelihood,
)
from iscat_analysis.fitting.field import add_signal
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.ranges import checked, fitted_frames, frame_ranges, measured_windows
from iscat_analysis.fitting.results import view_of
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.landing.chunks import view_moved
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.landing.tasks import StepEvent, TaskBuilder, patch_of, trace_of
from iscat_analysis.movie import Stack
from iscat_analysis.records import (
    Candidate,
    CountSource,
    EventView,
    FloatArray,
    Windows,
    is_event,
    silent,
)
from iscat_analysis.search.chunks import HALO, Reader, halo_px, reader_of
from iscat_analysis.search.dating import StepFrame
from iscat_analysis.search.frames import Tile
from iscat_analysis.search.sliding import stride_of
from iscat_analysis.threads import threads
from iscat_analysis.tracking.block_store import row_view
from iscat_analysis.tracking.dark_field import beside_particles
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations
from iscat_analysis.tracking.moving import blurred_rows
from iscat_analysis.tracking.moving_field import (
    exposure_of,
    initial_background,
    load_field,
    restore_particle_light,
    tracking_context,
)

Redraw = Callable[[int], EventView]
"""Row of the table → its images."""

_BACKGROUND_TURNS = 3  # of level and power of a background under particles that are known


def redraw(
    movie: Stack,
    config: Config,
    table: pd.DataFrame,
    tracks: pd.DataFrame | None,
    summary: Mapping[str, Any],
) -> Redraw:
    """Make the function that draws the rows of a result."""
    ready = calibrated(movie, config).over_all_stretches()
    steady, config, camera, lines = ready.steady, ready.config, ready.camera, ready.lines
    match ready.background_mode:
        case "sliding":
            window = int(summary["landing"]["window_frames"])
            stretches = summary.get("left_out", {}).get("analysed") or ()
            return _landings(steady, config, camera, lines, table, window, stretches)
        case "tracks" if config.optics.scheme != "darkfield":
            blocks = int(summary["blocks"]["number"])
            return _moving(steady, config, camera, lines, table, tracks, blocks)
        case _:
            return _before_after(steady, config, camera, lines, table)


def _landings(
    movie: Stack,
    config: Config,
    camera: Camera,
    lines: LightModel | None,
    table: pd.DataFrame,
    window: int,
    stretches: Sequence[Sequence[int]],
) -> Redraw:
    """Draw rows of a landing movie: the windows before and after each step."""
    first, last = fitted_frames(movie, config)
    shape = (movie.shape[1], movie.shape[2])
    field = make_context(config, shape, lines=lines, sliding=True)
    stride = stride_of(window)

    @lru_cache(1)
    def seen(tile: Tile) -> tuple[Reader, AnalysisContext]:
        """Read the pixels of a tile alone."""
        part: CountSource = movie
        if tile.shape != shape:
            part = CutFrames(movie, tile.shape, lambda images: images[..., *tile.here])
        reader = reader_of(part, config, camera.part(tile.here), (first, last))
        return reader, field.on_tile(tile)

    def draw(row: int) -> EventView:
        tile = _tile_around(table.iloc[row], config, shape)
        reader, context = seen(tile)
        frame = int(table["frame"].iloc[row])
        held = (span for span in stretches if span[0] <= frame < span[1])
        begin, end = next(held, (first, last))
        span = max(frame - HALO * window, begin), min(frame + HALO * window, end)
        with threads(config.compute.workers) as pool:
            chunk = reader.chunk(span, stride, pool)
            wanted = config.background.follows_pattern
            chunk, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
        neighbours = Neighbours(context, chunk, window, pattern)
        near = (table["frame"] - frame).abs() < 3 * window
        known = near & table["mass_kda"].notna() & is_event(table)
        known &= tile.holds(table["y_px"].to_numpy(float), table["x_px"].to_numpy(float))
        numbers = [row, *(int(i) for i in np.flatnonzero(known) if i != row)]
        steps = [_step(neighbours, table.iloc[i], tile.corner) for i in numbers]
        tasks = TaskBuilder(context, chunk, window, neighbours, pattern)
        task = tasks.build(0, steps, neighbours.of(steps)[0])
        if task is None:
            raise DataError(f"{movie.name}: there are no frames around frame {frame} to draw")
        start, (y_px, x_px) = steps[0].start, task.offset_px
        start = Candidate(
            start.x_px + x_px, start.y_px + y_px, start.z_nm, start.mass_kda, start.snr
        )
        fit = fit_particle(task.likelihood, start, context.mode, config.fit.z_range_nm, level=True)
        number = int(table["event"].iloc[row])
        fitted = StepEvent(
            Event(
                task.region, fit, task.likelihood, task.windows, (), task.at.frame, task.n_before,
                task.n_after, steps[0].sign, task.at.half_width, task.at.rise,
            ),
            replace(steps[0], at=task.at), tuple(steps[1:]), np.zeros(0),
        )  # fmt: skip
        trace = trace_of(fitted, patch_of(fitted, chunk, window), chunk, neighbours, tasks)
        view = view_of(number, Fitted(task.region, fit, task.likelihood), trace=trace)
        return view_moved(view, tile.corner)

    return draw


def _tile_around(row: pd.Series[Any], config: Config, shape: tuple[int, int]) -> Tile:
    """Give the pixels that tell of a row: all of a small field, its surroundings in a large one."""
    reach = halo_px(config) if math.prod(shape) > LARGEST_PX else max(shape)
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
    start = Candidate(
        float(row["x_px"]) - corner[1], float(row["y_px"]) - corner[0], float(row["z_nm"]),
        abs(mass), float(row["snr"]),
    )  # fmt: skip
    return neighbours.draw(-1 if mass < 0 else 1, at, start)


def _before_after(
    movie: Stack, config: Config, camera: Camera, lines: LightModel | None, table: pd.DataFrame
) -> Redraw:
    """Draw rows over a background of other frames; in mode ``track`` each in its frame."""
    before, after = frame_ranges(movie, config)
    tracked = config.fit.mode == "track"
    shape = (movie.shape[1], movie.shape[2])
    learnt = config.background.method == "tracks"  # in dark field, beside the particles
    whole = Region((0, shape[0]), (0, shape[1]))
    if learnt:
        context = tracking_context(config, shape, after[1] - after[0], lines)
        sums = measured_windows(movie, config, camera, before, after)
        sums = replace(sums, before_e=beside_particles(context, sums, table))
    else:
        context = make_context(config, shape, lines=lines)

    def drawn(region: Region, rows: Sequence[int]) -> FloatArray:
        """Draw the signal of some rows in a region."""
        total = np.zeros(region.shape)
        for i in rows:
            add_signal(context, _place(table.iloc[i]), region, total)
        return total

    @lru_cache(1)
    def seen(span: tuple[int, int]) -> tuple[Windows, list[int]]:
        """Give the sums, with the light that the particles leave, and the rows in them."""
        if learnt:
            windows = add_frames(sums, camera, movie.read(*span), span[0])
        else:
            windows = measured_windows(movie, config, camera, before, span)
        rows = table.index[table["mass_kda"].notna() & is_event(table)]
        here = [int(i) for i in rows if not tracked or int(table["frame"].iloc[i]) == span[0]]
        if config.background.power_normalization:
            signal = context.left(drawn(whole, here))
            if context.additive:
                signal = signal * photons_scale(context, windows)
            windows = refine_power(windows, signal, additive=context.additive)
        return windows, here

    def draw(row: int) -> EventView:
        frame = int(table["frame"].iloc[row])
        windows, here = seen((frame, frame + 1) if tracked else after)
        x_nm, y_nm, z_nm, mass = _place(table.iloc[row])
        pixel = context.pixel_nm
        start = Candidate(x_nm / pixel, y_nm / pixel, z_nm, mass, float(table["snr"].iloc[row]))
        region = region_around(context.roi_px, shape, start)
        others = drawn(region, [i for i in here if i != row])
        if lines is not None:
            others = (1 + others) / lines.taken(drawn(whole, here))[region.slices] - 1
        likelihood = region_likelihood(context, windows, region, others)
        fit = fit_particle(likelihood, start, context.mode, config.fit.z_range_nm, level=False)
        number = int(table["event"].iloc[row])
        return view_of(number, Fitted(region, fit, likelihood))

    return draw


def _place(row: pd.Series[Any]) -> PlaceAndMass:
    x, y, z, mass = (float(row[name]) for name in ("x_nm", "y_nm", "z_nm", "mass_kda"))
    return x, y, z, mass


def _moving(
    movie: Stack,
    config: Config,
    camera: Camera,
    lines: LightModel | None,
    table: pd.DataFrame,
    tracks: pd.DataFrame | None,
    blocks: int,
) -> Redraw:
    """Draw particles in single frames, over the background of their block."""
    first, last = fitted_frames(movie, config)
    shape = movie.shape[1], movie.shape[2]
    context = tracking_context(config, shape, max(last - first, 1), lines)
    edges = [first + (last - first) * k // blocks for k in range(blocks + 1)]
    known = table["mass_kda"].notna() & table["track"].notna()
    _, exposure_s = exposure_of(config)
    diffusion: dict[int, float] = {}
    if tracks is not None:
        pairs = zip(tracks["track"], np.nan_to_num(tracks["d_um2_s"].to_numpy(float)), strict=True)
        diffusion = {int(track): float(d) for track, d in pairs}

    check = checked(movie, camera)

    @lru_cache(1)
    def block(
        start: int, stop: int
    ) -> tuple[MovingField, BackgroundEstimate, Localizations, NDArray[np.int64]]:
        inside = np.flatnonzero(known & table["frame"].between(start, stop - 1))
        part = table.iloc[inside]
        theta = np.zeros((len(part), 5))
        theta[:, :3] = part[["x_nm", "y_nm", "z_nm"]].to_numpy(float)
        masses = part["mass_kda"].to_numpy(float)
        theta[:, 3] = context.model.scale.amplitudes(masses)
        numbers, track = np.unique(part["track"].to_numpy(int), return_inverse=True)
        frame = part["frame"].to_numpy(np.int64) - start
        order = np.lexsort((track, frame))
        rows = Localizations.of(frame, track.astype(np.int64), theta)
        speeds: FloatArray = np.array([[diffusion.get(int(n), 0.0)] for n in numbers])
        rows, variances = blurred_rows(rows, speeds.reshape(-1, 1), exposure_s)
        with threads(config.compute.workers) as pool:
            field = load_field(context, movie, camera, (start, stop), check, pool, silent)
            field.set_blurs(variances)
            follows = config.background.power_normalization
            ground = initial_background(config, field)
            restore_particle_light(context, field, movie, camera, start, ground, rows)
            for _ in range(_BACKGROUND_TURNS):
                found = field.fit(ground, rows, sweeps=0)[1]
                level = found.level if config.background.method == "tracks" else ground.level
                ground = BackgroundEstimate(level, found.power if follows else ground.power)
        return field, ground, rows, inside[order]

    def draw(row: int) -> EventView:
        frame = int(table["frame"].iloc[row])
        k = int(np.searchsorted(edges, frame, side="right")) - 1
        field, ground, rows, where = block(edges[k], edges[k + 1])
        return row_view(field, ground, rows, int(np.flatnonzero(where == row)[0]))

    return draw
