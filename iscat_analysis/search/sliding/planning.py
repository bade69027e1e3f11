"""How a landing movie is cut into parts that fit into memory: chunks of frames, tiles of these."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.search.sliding import stride_of
from iscat_analysis.search.sliding.chunks import Reader, counts_budget
from iscat_analysis.search.sliding.tiles import Tile, cut_field
from iscat_analysis.search.templates import LARGEST_IMAGE
from iscat_analysis.threads import threads

HALO = 2
"""Windows on either side of a chunk's core: a step, its neighbours, and theirs."""

_FIRST_LONGER = 1.24  # than others, of a chunk that is summed before they are begun
_SPAN_BYTES = 6e9  # of the frames of a chunk of a large field: they stay in the system's cache
_CONTROLLED = 16  # tiles of a movie, or some more, tell enough of the noise where nothing lands
_SUM_BYTES, _MAP_BYTES, _HIGHEST_BYTES = 4, 4, 2  # of a pixel of a block
_TILE_SHARE = 0.63  # of what counts may take; the images and regions of its steps have the rest
_TILE_BYTES = 160  # of a pixel of a tile, beside its blocks and maps


@dataclass(frozen=True)
class Part:
    """A chunk of a movie, or one tile of it; in some the noise where nothing lands is measured."""

    core: tuple[int, int]
    span: tuple[int, int]
    tile: Tile | None = None
    controlled: bool = True


def plan_parts(
    reader: Reader,
    config: Config,
    window: int,
    stride: int,
    stretch: tuple[int, int] | None = None,
    *,
    in_place: bool = True,
) -> list[list[Part]]:
    """Divide a movie, or a stretch of it, into chunks, and each chunk of a large field into tiles.

    Block edges fall on the same frames in every chunk.  Maps of a tile take no memory of their own
    where they are made in place.
    """
    first, last = stretch or (reader.first, reader.last)
    plan = plan_chunks(reader, config, window, stride, (first, last))
    if plan:
        return [[Part(core, span)] for core, span in plan]
    parts, core = choose_tiles(reader, config, window, stride, last - first, in_place=in_place)
    tiles = cut_field(reader.shape, parts, halo_px(config))
    count = math.ceil((last - first) / core)
    even = math.ceil((last - first) / count / stride) * stride
    halo = halo_frames(window, stride)
    every = max(1, count * len(tiles) // _CONTROLLED)
    return [
        [
            Part(
                (begin, end),
                (max(begin - halo, first), min(end + halo, last)),
                tile,
                controlled=(number * len(tiles) + place) % every == 0,
            )
            for place, tile in enumerate(tiles)
        ]
        for number, (begin, end) in enumerate(pairwise([*range(first, last, even), last]))
    ]


def halo_px(config: Config) -> int:
    """Width of the halo of a tile: from a fitted square to the centre of its farthest neighbour."""
    return math.ceil((LARGEST_IMAGE + 0.5) * _roi_px(config)) + 2


def _roi_px(config: Config) -> int:
    return config.fit.roi_px(config.camera.pixel_size_nm or math.nan)


def halo_frames(window: int, stride: int) -> int:
    """Length of the halo of a chunk."""
    return math.ceil(HALO * window / stride) * stride


def choose_tiles(
    reader: Reader, config: Config, window: int, stride: int, frames: int, *, in_place: bool
) -> tuple[tuple[int, int], int]:
    """Choose rows and columns of tiles, and the frames of a core, that look at least at halos."""
    side, halo = halo_px(config), halo_frames(window, stride)
    smallest = _roi_px(config)
    per_block = _SUM_BYTES + _moving_bytes(config) + (0 if in_place else _MAP_BYTES)
    budget, per_frame = _TILE_SHARE * counts_budget(config), per_block / stride
    longest = int(_SPAN_BYTES // reader.frame_bytes)
    best: tuple[float, tuple[int, int], int] | None = None
    rows, columns = reader.shape
    for high in range(1, rows // smallest + 1):
        for wide in range(1, columns // smallest + 1):
            pixels = _largest(rows, high, side) * _largest(columns, wide, side)
            room = min(int((budget / pixels - _TILE_BYTES) / per_frame), longest)
            core = frames if room >= frames else (room - 2 * halo) // stride * stride
            if core < stride:
                continue
            looked_at = (rows + 2 * side * (high - 1)) * (columns + 2 * side * (wide - 1))
            work = looked_at * (min(core + 2 * halo, frames) / core)
            if best is None or work < best[0]:
                best = work, (high, wide), core
    if best is None:
        needed = min(2 * halo + stride, frames)
        if needed > longest:
            raise DataError(
                f"{reader.name}: windows of {window} frames need {needed} frames at a time, and "
                f"{_SPAN_BYTES / 1e9:g} GB hold {longest} of {columns} x {rows} pixels: lower "
                "background.window_frames, or cut the field"
            )
        pixels = (smallest + 2 * side) ** 2
        least = (
            config.compute.memory_limit_mb * pixels * (_TILE_BYTES + per_frame * needed) / budget
        )
        raise DataError(
            f"{reader.name}: windows of {window} frames of {columns} x {rows} pixels need "
            f"compute.memory_limit_mb = {math.ceil(least)}; raise it, or lower "
            "background.window_frames"
        )
    return best[1], best[2]


def _largest(size: int, parts: int, halo: int) -> int:
    """Count the rows of the largest of so many tiles; the first and the last have one halo."""
    return min(math.ceil(size / parts) + min(parts - 1, 2) * halo, size)


def _moving_bytes(config: Config) -> int:
    """Bytes of a pixel of a block for the motion of the pattern: its contrast and a spectrum."""
    return 12 if config.background.follows_pattern else 0


def plan_chunks(
    reader: Reader, config: Config, window: int, stride: int, stretch: tuple[int, int] | None = None
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Divide a movie, or a stretch of it, whose field is not divided; empty where it has to be."""
    first, last = stretch or (reader.first, reader.last)
    halo = halo_frames(window, stride)
    budget = counts_budget(config)
    # beside counts and blocks, the field holds some images in doubles
    pixels = math.prod(reader.shape)
    per_block = _SUM_BYTES + _MAP_BYTES + _HIGHEST_BYTES + _moving_bytes(config)
    buffers_bytes = per_block * pixels // stride
    if (last - first) * (reader.frame_bytes + buffers_bytes) <= budget - 40 * pixels:
        return [((first, last), (first, last))]
    room = (budget - 40 * pixels) // (reader.held_bytes + buffers_bytes)
    core = (room - 2 * halo) // stride * stride
    if core < max(halo, stride):  # most of the work would be that of halos
        return []
    count = 2 * math.ceil((last - first) / core / 2)  # which two processes share
    even = (last - first) / count
    # two that are held at once have the room of two
    longer = math.ceil(min(_FIRST_LONGER * even, 2 * core - even) / stride) * stride
    rest = math.ceil((last - first - longer) / (count - 1) / stride) * stride
    edges = [first, *range(first + longer, last, rest), last]
    return [
        ((begin, end), (max(begin - halo, first), min(end + halo, last)))
        for begin, end in pairwise(edges)
    ]


def sum_first_chunk(reader: Reader, config: Config, window: int) -> None:
    """Sum what will be the first chunk, so that whoever asks for it has it at once.

    Frames that have to be read into memory are left for then: whoever looks at them divided by the
    flicker of their light needs as much room again.
    """
    if not reader.in_place:
        return
    stride = stride_of(window)
    first, *_ = plan_parts(reader, config, window, stride)[0]
    if first.tile is None:
        with threads(config.compute.workers) as pool:
            reader.chunk(first.span, stride, pool)
