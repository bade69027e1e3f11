"""Movies of particles that move, followed from frame to frame over three kinds of background."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import add_frames
from iscat_analysis.diagnosis import Noise, Prepared, judge_beside
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Region
from iscat_analysis.fitting.field import add_signal
from iscat_analysis.fitting.ranges import checked, fitted_frames
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.pipeline import before_after
from iscat_analysis.pipeline.kinds import Kind, Look, candidate_table, with_threshold
from iscat_analysis.records import EventView, FloatArray, Windows, silent
from iscat_analysis.threads import threads
from iscat_analysis.tracking.blocks import row_view
from iscat_analysis.tracking.field import MovingField
from iscat_analysis.tracking.find import beside_particles, find_moving, track_frames
from iscat_analysis.tracking.frames import (
    LEAST_FRAMES,
    Recording,
    exposure_of,
    load_field,
    restore_particle_light,
    tracking_context,
)
from iscat_analysis.tracking.joint import first_background
from iscat_analysis.tracking.rows import NO_ROWS, BackgroundEstimate, Localizations
from iscat_analysis.tracking.search import search_frames
from iscat_analysis.tracking.stages import blurred_rows

if TYPE_CHECKING:
    from iscat_analysis.pipeline.stored import StoredResult


def track_in_frames(
    ready: Prepared, run: Run, ground: before_after.Background, pool: ThreadPoolExecutor
) -> DetectionResult:
    """Fit each frame by itself over a recorded background, and link the fits."""
    movie, camera, windows = ready.steady, ready.camera, ground.windows
    recording = Recording(movie, camera, checked(movie, camera), pool, run.progress)
    found = track_frames(ground.context, recording, windows, doubt=ground.doubt, report=run.report)
    if not windows.n_before:
        noise = _judge_beside_particles(ready, ground.context, windows, found.fits)
        run.report(*noise.findings)
    return replace(found, summary=ground.summary)


class StoredInDarkField(before_after.StoredEvents):
    """Draws rows over a background that is learnt with the tracks."""

    def made_context(self) -> AnalysisContext:
        """Make the models; see `StoredEvents`."""
        ready, frames = self.ready, self.after[1] - self.after[0]
        return tracking_context(ready.config, ready.shape, frames, ready.lines)

    def sums(self, span: tuple[int, int]) -> Windows:
        """Sum some frames over the light beside the particles; see `StoredEvents`."""
        ready = self.ready
        return add_frames(self._ground, ready.camera, ready.steady.read(*span), span[0])

    @cached_property
    def _ground(self) -> Windows:
        sums = super().sums(self.after)
        return replace(sums, before_e=beside_particles(self.context, sums, self.table))


class MovingSearch:
    """Searches single frames for particles that are not in the median of the frames around."""

    def __init__(self, ready: Prepared) -> None:
        movie, config, camera = ready.steady, ready.config, ready.camera
        check = checked(movie, camera)
        self.frames = first, last = fitted_frames(movie, config)
        self.longest = last - first
        self.window = min(100, self.longest)  # frames that make the background of one
        self._context = tracking_context(config, ready.shape, max(last - first, 1), ready.lines)

        @lru_cache(1)
        def background(span: tuple[int, int]) -> tuple[MovingField, BackgroundEstimate]:
            with threads(config.compute.workers) as pool:
                recording = Recording(movie, camera, check, pool, silent)
                field = load_field(self._context, recording, span)
                return field, first_background(field, config.background)

        self._background = background

    def context(self, window: int) -> AnalysisContext:  # noqa: ARG002
        """Give models and threshold, which are those of every window."""
        return self._context

    def look(self, frame: int, window: int) -> Look:
        """Compare one frame with the median of those around it."""
        first, last = self.frames
        window = max(window, min(LEAST_FRAMES, last - first))
        frame = min(max(frame, first), last - 1)
        start = min(frame - (frame - first) % window, last - window)
        span = start, start + window
        field, ground = self._background(span)
        here, context = frame - start, self._context
        light = ground.level * ground.power[here]
        image = field.residual(ground, NO_ROWS, here, here + 1)[0] / light

        def search(threshold: float) -> pd.DataFrame:
            lowered = with_threshold(context, threshold)
            found = search_frames(lowered, field, ground, NO_ROWS, (here, here + 1))
            (x_nm, y_nm, z_nm, amplitude, _), pixel = found.theta.T, field.pixel_nm
            mass = np.asarray(context.model.scale.mass(amplitude))
            each = zip(x_nm / pixel, y_nm / pixel, found.snr, z_nm, mass, strict=True)
            return candidate_table(
                (x, y, snr, context.model.peak_contrast(float(z), float(m)), m)
                for x, y, snr, z, m in each
            )

        return Look(
            frame, span, (frame, frame + 1), np.where(field.used, image, np.nan),
            context.templates.threshold, search,
        )  # fmt: skip


class StoredTracks:
    """Draws particles in single frames, over the background of their block."""

    def __init__(self, ready: Prepared, result: StoredResult) -> None:
        self.ready, self._table = ready, result.table
        table, tracks = result.table, result.tracks
        blocks = int(result.summary[MOVING.heading]["number"])
        first, last = fitted_frames(ready.steady, ready.config)
        frames = max(last - first, 1)
        self._context = tracking_context(ready.config, ready.shape, frames, ready.lines)
        self._edges = [first + (last - first) * k // blocks for k in range(blocks + 1)]
        self._known = table["mass_kda"].notna() & table["track"].notna()
        found = np.nan_to_num(tracks["d_um2_s"].to_numpy(float))
        self._diffusion = dict(zip(tracks["track"].astype(int), found.tolist(), strict=True))
        self._opened = lru_cache(1)(self._open)

    def _open(
        self, start: int, stop: int
    ) -> tuple[MovingField, BackgroundEstimate, Localizations, NDArray[np.int64]]:
        """Read a block, and fit its background under the particles."""
        ready, context = self.ready, self._context
        movie, config, camera = ready.steady, ready.config, ready.camera
        inside = np.flatnonzero(self._known & self._table["frame"].between(start, stop - 1))
        part = self._table.iloc[inside]
        theta = np.zeros((len(part), 5))
        theta[:, :3] = part[["x_nm", "y_nm", "z_nm"]].to_numpy(float)
        theta[:, 3] = context.model.scale.amplitudes(part["mass_kda"].to_numpy(float))
        numbers, track = np.unique(part["track"].to_numpy(int), return_inverse=True)
        frame = part["frame"].to_numpy(np.int64) - start
        order = np.lexsort((track, frame))
        rows = Localizations.of(frame, track.astype(np.int64), theta)
        speeds = np.array([self._diffusion.get(int(n), 0.0) for n in numbers]).reshape(-1, 1)
        rows, variances = blurred_rows(rows, speeds, exposure_of(config))
        with threads(config.compute.workers) as pool:
            check = checked(movie, camera)
            recording = Recording(movie, camera, check, pool, silent)
            field = load_field(context, recording, (start, stop))
            field.set_blurs(variances)
            ways = config.background
            ground = first_background(field, ways)
            restore_particle_light(context, recording, start, field, ground, rows)
            # of level and power of a background under particles that are known
            for _ in range(3):
                found = field.fit(ground, rows, sweeps=0)[1]
                level = found.level if ways.learnt_with_tracks else ground.level
                power = found.power if ways.power_normalization else ground.power
                ground = BackgroundEstimate(level, power)
        return field, ground, rows, inside[order]

    def __call__(self, row: int) -> EventView:
        """Draw a row of the table."""
        frame = int(self._table["frame"].iloc[row])
        k = int(np.searchsorted(self._edges, frame, side="right")) - 1
        field, ground, rows, where = self._opened(self._edges[k], self._edges[k + 1])
        return row_view(field, ground, rows, int(np.flatnonzero(where == row)[0]))


def _judge_beside_particles(
    ready: Prepared, context: AnalysisContext, windows: Windows, table: pd.DataFrame
) -> Noise:
    """Judge the camera in pixels that no moving particle comes near; the background is known."""
    movie, camera, (first, last) = ready.steady, ready.camera, windows.frames_after
    frame = table["frame"].to_numpy(np.int64)
    particles = table[["x_nm", "y_nm", "z_nm", "mass_kda"]].to_numpy(float)
    rows, columns = ready.shape
    field = Region((0, rows), (0, columns))

    def without(count: int) -> FloatArray:
        electrons = camera.to_electrons(movie.read(first, first + count))
        for number, image in enumerate(electrons if not context.additive else ()):
            signal = np.zeros(field.shape)
            for x, y, z, mass in particles[frame == first + number].tolist():
                add_signal(context, (x, y, z, mass), field, signal)
            image /= 1 + signal
        return electrons

    noise = judge_beside(
        context, movie, camera, (first, last), (frame, particles[:, :2]), ~windows.masked, without
    )
    return noise.compared_with_fits(table["chi2_reduced"].to_numpy(float))


FRAME_BY_FRAME = replace(
    before_after.BEFORE_AFTER, find=partial(before_after.find_before_after, fit=track_in_frames)
)
MOVING_IN_DARK_FIELD = replace(
    before_after.BEFORE_AFTER, find=find_moving, stored=StoredInDarkField, keeps_parts=True
)
MOVING = Kind("blocks", find_moving, MovingSearch, StoredTracks)
