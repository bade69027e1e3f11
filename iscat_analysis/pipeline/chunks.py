"""Chunks of a landing movie: read once, cut so that they fit into memory, and joined again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.movie.background import find_defects
from iscat_analysis.movie.camera import Camera, check_counts
from iscat_analysis.movie.drift import Trajectory, measure_drift
from iscat_analysis.movie.metadata import diagnose_gain
from iscat_analysis.movie.spectrum import NoiseSpectrum, measure_spectrum
from iscat_analysis.pipeline.diagnosis import EXCESS_NOISE, allow_for_correlation
from iscat_analysis.pipeline.results import table_of
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import (
    BoolArray,
    CountSource,
    EventView,
    FloatArray,
    Mapper,
    Windows,
)
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.sliding import (
    SHORTEST_MOVIE,
    Chunk,
    NoiseCurve,
    choose_window,
    longest_window,
    make_chunk,
    measure_frames,
    measure_noise,
)

HALO = 2
"""Windows on either side of a chunk's core: a step, its neighbours, and theirs."""

VIEWS = 1000
"""Events whose images are kept for the report."""

CLIPS = 250
"""Events of which a clip is kept; the page holds fewer."""

FRAME_COLUMN = "frame_ci95"
"""Column after `EVENT_COLUMNS`: half-width of the 95 % interval of ``frame`` [frames]."""

REPEATS_COLUMN = "repeats"
"""Column of a chunk's table, not of ``fits.csv``: what parts of an event's frames say, flat."""

_MEMORY_SHARE = 0.32  # of compute.memory_limit_mb that the stored counts may take
_PIECE_BYTES = 8 * 2**20
_NOISE_FRAMES = 800  # on which the windows are chosen
_GAIN_FRAMES = 64  # on which the gain is judged
_SEAM_PX = 2.0  # two chunks' estimates of one step are nearer than this


class Reader:
    """Frames in memory, from one chunk to the next without reading any twice.

    Parameters
    ----------
    movie : CountSource
        The movie.
    camera : Camera
        Counts → photoelectrons.
    first, last : int
        Half-open range of frames to analyse.
    room_bytes : int
        Of counts, for the longest chunk; from `counts_budget`.
    """

    def __init__(
        self, movie: CountSource, camera: Camera, first: int, last: int, room_bytes: int
    ) -> None:
        self._movie = movie
        self.camera = camera
        self.first, self.last = first, last
        self.shape = (movie.shape[1], movie.shape[2])
        self.frame_bytes = math.prod(self.shape) * movie.dtype.itemsize
        # made at once, because growing copies; only what is written to takes memory
        room = min(max(last - first, 0), room_bytes // self.frame_bytes)
        self._buffer = np.empty((room, *self.shape), dtype=movie.dtype)
        self._held = (first, first)
        self._light: FloatArray = np.empty(0)
        self._repeats: BoolArray = np.empty(0, dtype=np.bool_)

    @property
    def name(self) -> str:
        """What messages call the movie."""
        return self._movie.name

    def _reserve(self, frames: int) -> None:
        if frames > len(self._buffer):
            kept = self._held[1] - self._held[0]
            larger = np.empty((frames, *self.shape), dtype=self._movie.dtype)
            larger[:kept] = self._buffer[:kept]
            self._buffer = larger

    def counts(
        self, start: int, stop: int, mapper: Mapper = map
    ) -> tuple[NDArray[Any], BoolArray, FloatArray]:
        """Frames [start, stop), which of them are good, and their light [e per pixel]."""
        low, high = self._held
        kept = 0
        if low <= start < high:
            kept = min(high, stop) - start
            if start > low:
                self._buffer[:kept] = self._buffer[start - low : start - low + kept]
            self._light = self._light[start - low : start - low + kept]
            self._repeats = self._repeats[start - low : start - low + kept]
        else:
            self._light, self._repeats = np.empty(0), np.empty(0, dtype=np.bool_)
        self._reserve(stop - start)
        self._held = (start, start + kept)
        self._append(start + kept, stop, mapper)
        good = np.isfinite(self._light) & ~self._repeats
        return self._buffer[: stop - start], good, self._light

    def _append(self, begin: int, end: int, mapper: Mapper) -> None:
        if begin >= end:
            return
        start = self._held[0]
        step = max(1, _PIECE_BYTES // self.frame_bytes)
        pieces = [(a, min(a + step, end)) for a in range(begin, end, step)]

        def read(piece: tuple[int, int]) -> None:
            self._buffer[piece[0] - start : piece[1] - start] = self._movie.read(*piece)

        def check(piece: tuple[int, int]) -> None:
            for run in _runs(lit[piece[0] - begin : piece[1] - begin]):
                low, high = piece[0] + run.start, piece[0] + run.stop
                frames = self._buffer[low - start : high - start]
                check_counts(frames, low, self.name, camera=self.camera)

        for _ in mapper(read, pieces):
            pass
        ahead = 1 if begin > start else 0  # the first new frame is compared with the last old one
        part = self._buffer[begin - ahead - start : end - start]
        light, repeats = measure_frames(part, self.camera, mapper=mapper)
        lit = np.isfinite(light[ahead:])
        for _ in mapper(check, pieces):
            pass
        if not ahead and begin > self.first:  # a chunk that nothing held precedes
            (earlier,) = self._movie.read(begin - 1, begin)
            repeats[0] = np.array_equal(earlier, part[0])
        self._light = np.concatenate([self._light, light[ahead:]])
        self._repeats = np.concatenate([self._repeats, repeats[ahead:]])
        self._held = (start, end)

    def chunk(self, span: tuple[int, int], stride: int, pool: ThreadPoolExecutor) -> Chunk:
        """Frames of a span, summed in blocks."""
        counts, good, light = self.counts(*span, pool.map)
        if not good.any():
            raise DataError(
                f"{self.name}: frames {span[0]}:{span[1]} hold no light that changes; every frame "
                "is zero or repeats the one before it; analyse the others with fit.frames = [A, B]"
            )
        return make_chunk(
            span[0], counts, good, light, self.camera,
            stride=stride, defects=find_defects, mapper=pool.map,
        )  # fmt: skip

    def opening(self, mapper: Mapper = map) -> NDArray[Any]:
        """Good frames among the first, on which the noise is judged."""
        stop = min(self.last, self.first + _NOISE_FRAMES)
        counts, good, _ = self.counts(self.first, stop, mapper)
        used = counts if good.all() else counts[good]
        if len(used) < 2:
            raise DataError(f"{self.name}: has no two frames that differ; export it again")
        return used


def _runs(flags: BoolArray) -> Iterator[slice]:
    """Yield stretches of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))


@dataclass(frozen=True)
class Noise:
    """What the first frames say before anything is searched.

    Attributes
    ----------
    curve : NoiseCurve
        Noise against averaging.
    window : int
        Frames before, and as many after, each step.
    gain_message : str
        One line where the noise does not agree with the configured gain, else empty.
    excess : str
        What is known of noise beyond the expected, else empty.
    spectrum : NoiseSpectrum or None
        Of the noise between neighbouring frames, where it is not white and of the expected size.
    """

    curve: NoiseCurve
    window: int
    gain_message: str
    excess: str
    spectrum: NoiseSpectrum | None


def judge_window(
    reader: Reader, config: Config, mapper: Mapper = map
) -> tuple[NDArray[Any], NoiseCurve, int]:
    """Choose how many frames around a step are summed.

    Parameters
    ----------
    reader : Reader
        The frames.
    config : Config
        ``background.window_frames`` wins where it is given.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    opening : ndarray, shape (t, y, x)
        Good frames among the first.
    curve : NoiseCurve
        Noise against averaging, of these.
    window : int
        Frames before, and as many after, each step.

    Raises
    ------
    DataError
        The movie is shorter than two windows, or holds no two frames that differ.
    """
    frames = reader.last - reader.first
    given = config.background.window_frames
    needed = 2 * given if given else SHORTEST_MOVIE
    if frames < needed:
        windows = (
            f"two windows of background.window_frames = {given}" if given else "sliding windows"
        )
        raise DataError(
            f"{reader.name}: has {frames} frames, but {windows} before and after each landing take "
            f"{needed}: record longer"
            + (", or lower background.window_frames" if given else "")
            + "; or give the frames before the particles bind as background.frames = [0, N]"
        )
    opening = reader.opening(mapper)
    longest = min(given or longest_window(frames), _NOISE_FRAMES // 4)
    curve = measure_noise(opening, reader.camera, longest, mapper=mapper)
    window = given or choose_window(curve, frames)
    return opening, curve, window


def judge_noise(reader: Reader, config: Config, mapper: Mapper = map) -> Noise:
    """Compare the noise with the camera's, and choose how many frames around a step are summed.

    Parameters
    ----------
    reader : Reader
        The frames.
    config : Config
        ``background.window_frames`` wins where it is given.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    Noise
        Window, noise curve, and what is to be said of the gain.

    Raises
    ------
    DataError
        The movie is shorter than two windows, or holds no two frames that differ.
    """
    opening, curve, window = judge_window(reader, config, mapper)
    spectrum = measure_spectrum(opening, reader.camera, mapper=mapper)
    message, ratio = "", 1.0
    try:
        gain = diagnose_gain(opening[:_GAIN_FRAMES], reader.camera)
        gain = allow_for_correlation(gain, spectrum)
        message, ratio = gain.message or "", gain.noise_ratio
    except DataError:  # too dark to tell
        pass
    excess = message if ratio > EXCESS_NOISE else ""
    if not excess and curve.at(window) > EXCESS_NOISE:
        excess = (
            f"between averages of {window} frames the noise variance is {curve.at(window):.2g} "
            "times that of the light; look at the laser, set background.drift_correction = true, "
            "or lower background.window_frames"
        )
    return Noise(curve, window, message, excess, spectrum)


def counts_budget(config: Config) -> int:
    """Bytes that the stored counts of a chunk may take.

    Parameters
    ----------
    config : Config
        ``compute.memory_limit_mb``.

    Returns
    -------
    int
        A share of it.
    """
    return int(_MEMORY_SHARE * config.compute.memory_limit_mb * 1e6)


def plan_chunks(
    reader: Reader, config: Config, window: int, stride: int
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Divide a movie; block edges fall on the same frames in every chunk.

    Parameters
    ----------
    reader : Reader
        The frames.
    config : Config
        ``compute.memory_limit_mb`` bounds a chunk.
    window, stride : int
        Frames in a window, and between two of its positions.

    Returns
    -------
    list of ((int, int), (int, int))
        For each chunk its core, and the span of frames around it that is read.
    """
    first, last = reader.first, reader.last
    halo = math.ceil(HALO * window / stride) * stride
    budget = counts_budget(config)
    # beside its counts, a block holds its sum and its map (where the pattern's motion is divided
    # out, that and a spectrum as well), and the field some images in doubles
    pixels = math.prod(reader.shape)
    per_block = 32 if config.background.drift_correction else 20
    per_frame = reader.frame_bytes + per_block * pixels // stride
    room = (budget - 40 * pixels) // per_frame
    if room >= last - first:
        return [((first, last), (first, last))]
    core = (room - 2 * halo) // stride * stride
    if core < stride:
        least = math.ceil((40 * pixels + per_frame * (2 * halo + stride)) / _MEMORY_SHARE / 1e6)
        raise DataError(
            f"{reader.name}: windows of {window} frames of {reader.shape[1]} x {reader.shape[0]} "
            f"pixels need compute.memory_limit_mb = {least}; raise it, or lower "
            "background.window_frames"
        )
    count = math.ceil((last - first) / core)
    core = math.ceil((last - first) / count / stride) * stride  # of equal length
    return [
        (
            (begin, min(begin + core, last)),
            (max(begin - halo, first), min(begin + core + halo, last)),
        )
        for begin in range(first, last, core)
    ]


@dataclass(frozen=True)
class Done:
    """What is kept of a finished chunk."""

    core: tuple[int, int]
    table: pd.DataFrame
    views: tuple[EventView, ...]
    good: BoolArray  # of the core
    light: FloatArray
    masked: BoolArray
    saturated: BoolArray
    strongest: FloatArray
    ends_e: FloatArray  # mean images of its first and last quarter
    sampled: int = field(default=0)
    stopped: bool = False  # in the middle of its chains
    trajectory: Trajectory | None = None  # of the pattern, in all frames that were read
    cause: str = ""  # what the model probably has wrong
    empty: EmptySpread | None = None  # noise where nothing lands or leaves


class Merged:
    """Finished chunks, in order.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._done: list[Done] = []
        self._strongest = np.zeros((2, *shape))
        self.sampled = 0
        self.cause = ""
        self.empty: EmptySpread | None = None

    def add(self, done: Done) -> None:
        """Take one more."""
        stronger = done.strongest[0] > self._strongest[0]
        self._strongest = np.where(stronger, done.strongest, self._strongest)
        self.sampled += done.sampled
        self.cause = self.cause or done.cause
        if done.empty is not None:
            self.empty = done.empty if self.empty is None else self.empty + done.empty
        # the images are merged; holding them for every chunk would grow with the movie
        small = np.empty((2, 0, 0))
        kept = done.views if sum(len(d.views) for d in self._done) < 2 * VIEWS else ()
        if sum(view.clip is not None for d in self._done for view in d.views) >= 2 * CLIPS:
            kept = tuple(replace(view, clip=None) for view in kept)
        ends = done.ends_e
        if len(self._done) > 1:
            self._done[-1] = replace(self._done[-1], ends_e=small)
        self._done.append(replace(done, strongest=small, views=kept, ends_e=ends))

    @property
    def image(self) -> FloatArray:
        """Amplitude of the strongest step of each pixel."""
        image: FloatArray = self._strongest[1]
        return image

    def result(self, scene: Scene) -> tuple[pd.DataFrame, tuple[EventView, ...]]:
        """Events of all chunks, each once, numbered in order of frame."""
        tables, homes = [], []
        for index, done in enumerate(self._done):
            tables.append(done.table)
            homes += [(index, row) for row in range(len(done.table))]
        if not homes:
            empty = table_of(scene, [])
            empty[FRAME_COLUMN] = np.empty(0, dtype=np.int64)
            empty[REPEATS_COLUMN] = np.empty(0, dtype=object)
            return empty, ()
        table = pd.concat([t for t in tables if len(t)], ignore_index=True)
        cores = np.array([self._done[i].core for i, _ in homes])
        frame = table["frame"].to_numpy()
        own = (frame >= cores[:, 0]) & (frame < cores[:, 1])
        finished = np.zeros(len(table), dtype=np.bool_)
        for done in self._done:
            finished |= (frame >= done.core[0]) & (frame < done.core[1])
        kept = np.flatnonzero(own)
        for stranger in np.flatnonzero(~own & finished):
            if not _same(table, int(stranger), kept):
                kept = np.append(kept, stranger)
        order = sorted(kept, key=lambda i: (frame[i], table["y_nm"].iloc[i], table["x_nm"].iloc[i]))
        result = table.iloc[order].reset_index(drop=True)
        result["event"] = np.arange(len(result), dtype=np.int64)
        views = []
        for number, i in enumerate(order[:VIEWS]):
            index, row = homes[i]
            if row < len(self._done[index].views):
                views.append(replace(self._done[index].views[row], event=number))
        return result, tuple(views)

    def windows(self, shape: tuple[int, int], span: tuple[int, int]) -> tuple[Windows, FloatArray]:
        """Masks and power of the frames that are done."""
        nothing = np.zeros(shape)
        masked = np.zeros(shape, dtype=np.bool_)
        saturated = np.zeros(shape, dtype=np.bool_)
        for done in self._done:
            masked |= done.masked
            saturated |= done.saturated
        light = np.concatenate([np.empty(0), *(d.light for d in self._done)])
        power = light / np.nanmean(light) if np.isfinite(light).any() else light
        windows = Windows(
            before_e=nothing, after_e=nothing, n_before=0, n_after=light.size, power_ratio=1.0,
            read_variance_before_e2=nothing, read_variance_after_e2=nothing,
            masked=masked, saturated=saturated, frames_before=(0, 0),
            frames_after=(span[0], span[0] + light.size), power=power,
        )  # fmt: skip
        return windows, light

    def left_out(self) -> int:
        """Frames that are zero or repeat the one before."""
        return int(sum(np.count_nonzero(~d.good) for d in self._done))

    def repeats(self) -> NDArray[np.int64]:
        """Frames left out, counted from the first of the movie's part that was read."""
        good = np.concatenate([np.empty(0, dtype=np.bool_), *(d.good for d in self._done)])
        return np.flatnonzero(~good.astype(np.bool_))

    def trajectory(self) -> Trajectory | None:
        """Way of the fixed pattern through all chunks that followed it; None where none did."""
        parts: list[Trajectory] = []
        way: Trajectory | None = None  # the chunk before, halo included
        for done in self._done:
            part = done.trajectory
            if part is None:
                continue
            if way is not None:
                common = part.frames <= way.frames[-1]
                common[0] = True
                offset = way.at(part.frames[common]) - part.shift_px[common]
                part = replace(part, shift_px=part.shift_px + offset.mean(axis=0))
            own = (part.frames >= done.core[0]) & (part.frames < done.core[1])
            parts.append(Trajectory(part.frames[own], part.shift_px[own], part.error_px[own]))
            way = part
        if not parts:
            return None
        return Trajectory(
            np.concatenate([p.frames for p in parts]),
            np.concatenate([p.shift_px for p in parts]) - parts[0].shift_px[0],
            np.concatenate([p.error_px for p in parts]),
        )

    def unfollowed(self) -> list[tuple[int, int]]:
        """Frames in which there was no pattern to follow, or nobody asked."""
        return [done.core for done in self._done if done.trajectory is None]

    def drift(self) -> list[float] | None:
        """Shift (y, x) of the fixed pattern from the first frames to the last [px]."""
        if not self._done:
            return None
        way = self.trajectory()
        if way is not None:
            return [float(d) for d in way.shift_px[-1]]
        dy, dx = measure_drift(self._done[0].ends_e[0], self._done[-1].ends_e[1])
        return [dy, dx] if math.isfinite(dy) and math.isfinite(dx) else None

    def masks(self) -> tuple[int, int]:
        """Defective and saturated pixels."""
        if not self._done:
            return 0, 0
        masked = np.any([d.masked for d in self._done], axis=0)
        saturated = np.any([d.saturated for d in self._done], axis=0)
        return int(np.sum(masked & ~saturated)), int(saturated.sum())


def _same(table: pd.DataFrame, one: int, others: NDArray[np.int64]) -> bool:
    """Whether some other row describes the same step."""
    frame, error, x, y, mass = (
        table[name].to_numpy(dtype=float)
        for name in ("frame", FRAME_COLUMN, "x_px", "y_px", "mass_kda")
    )
    near = np.abs(frame[others] - frame[one]) <= np.maximum(2, error[others] + error[one])
    near &= np.hypot(x[others] - x[one], y[others] - y[one]) < _SEAM_PX
    near &= mass[others] * mass[one] > 0
    return bool(near.any())
