"""Blocks of frames become one movie again: tracks go on, masses are combined.

Blocks share no frames and no background, so that their rows are independent, and so are the masses
of their parts of a track: each is that of the exact likelihood of its block, with its variance.
The D of each part, which sets its blur, was told from that part alone, and its error is in the
variance of the mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.fitting.results import Followed
from iscat_analysis.records import EventView, FloatArray, Windows
from iscat_analysis.tracking.block_store import Block
from iscat_analysis.tracking.frame_search import link
from iscat_analysis.tracking.joint.localizations import Localizations
from iscat_analysis.tracking.linking import OUTLYING, bridge, numbered, typical, with_mass
from iscat_analysis.tracking.moving_table import table_of_tracks

IntArray = NDArray[np.int64]

_MASS = ["mass_kda", "sigma_mass_kda", "crb_mass_kda", "told"]


@dataclass(frozen=True)
class Joined:
    """The tracks and backgrounds of all blocks of a movie."""

    fits: pd.DataFrame
    views: tuple[EventView, ...]
    followed: Followed


def join_blocks(config: Config, blocks: Sequence[Block], camera: Camera) -> Joined:
    """Make one result of the blocks of a movie."""
    numbers = join_tracks(config, blocks)
    table = table_of_tracks(
        pd.concat([b.table for b in blocks], ignore_index=True),
        np.concatenate([n[b.rows.track] for n, b in zip(numbers, blocks, strict=True)]),
        np.concatenate([b.inside for b in blocks]),
        config.track.min_frames,
        parted=len(blocks) > 1,
    )
    parts = tuple(block.windows(camera) for block in blocks)
    masses = combine_masses([b.masses for b in blocks], numbers, table)
    followed = Followed(_together(blocks, parts), parts if len(parts) > 1 else (), masses)
    return Joined(table, _views(table, blocks, numbers), followed)


def join_tracks(config: Config, blocks: Sequence[Block]) -> list[IntArray]:
    """Say which tracks of blocks are one particle.

    At a border the last rows of the tracks that end there and the first of those that begin are
    linked as two frames are, each with the median mass of its track.  A particle may be missed
    there for as many frames as elsewhere, and one that hardly moves for more.

    Shapes: result (tracks of the block,).
    """
    sizes = [int(b.rows.track.max(initial=-1)) + 1 for b in blocks]
    if len(blocks) == 1:
        return [np.arange(sizes[0])]
    numbers = [np.arange(n) + sum(sizes[:k]) for k, n in enumerate(sizes)]
    for k, (one, two) in enumerate(pairwise(blocks)):
        for before, after in _met(config, one, two):
            numbers[k + 1][after] = numbers[k][before]
    rows = [replace(b.rows, track=n[b.rows.track]) for n, b in zip(numbers, blocks, strict=True)]
    whole = reduce(_both, rows)
    if not len(whole.frame):
        return numbers
    bridged = replace(whole, track=bridge(config, whole))
    last = numbered(replace(bridged, group=whole.track))  # group: the number that it had
    final = np.zeros(int(whole.track.max()) + 1, dtype=np.int64)
    final[last.group] = last.track
    return [final[n] for n in numbers]


def _met(config: Config, one: Block, two: Block) -> list[tuple[int, int]]:
    """Find pairs of tracks of two blocks, where the second continues the first."""
    border, memory = two.span[0], config.track.memory_frames
    ends, begins = _ends(one.rows, -1), _ends(two.rows, 0)
    ends = ends.only(ends.frame >= border - 1 - memory)
    begins = begins.only(begins.frame <= border + memory)
    if not len(ends.frame) or not len(begins.frame):
        return []
    both = _both(ends, begins)
    side = np.repeat([0, 1], [len(ends.frame), len(begins.frame)])
    places = with_mass(config, both, np.hypot(one.error, two.error) / np.sqrt(2))
    track = link(side, places, reach_nm=config.track.max_step_nm, memory=0)
    pairs = []
    for j in np.flatnonzero(side == 1):
        for i in np.flatnonzero((side == 0) & (track == track[j])):
            if both.frame[j] - both.frame[i] - 1 <= memory:
                pairs.append((int(both.track[i]), int(both.track[j])))
    return pairs


def _ends(rows: Localizations, which: int) -> Localizations:
    """First (0) or last (−1) row of every track, with the median mass of the track."""
    order = np.lexsort((rows.frame, rows.track))
    edges = np.flatnonzero(np.diff(rows.track[order], prepend=-1, append=-1))
    chosen = order[edges[:-1] if which == 0 else edges[1:] - 1]
    return typical(rows).only(chosen)


def _both(one: Localizations, two: Localizations) -> Localizations:
    """Join rows, the ones before the others."""
    return one.joined(two.frame, two.track, two.theta, two.group)


def combine_masses(
    masses: Sequence[pd.DataFrame], numbers: Sequence[IntArray], table: pd.DataFrame
) -> pd.DataFrame:
    """Combine the masses of the parts of tracks by their variances."""
    if len(masses) == 1:
        return masses[0][_MASS]
    parts = pd.concat(masses, ignore_index=True)
    parts["track"] = np.concatenate([n[m.index] for n, m in zip(numbers, masses, strict=True)])
    middle = parts["track"].map(table.groupby("track")["mass_kda"].median())
    near = (parts["mass_kda"] - middle).abs() <= OUTLYING * parts["sigma_mass_kda"]
    merit = (parts["blur"] + 2 * near).where(parts["mass_kda"].notna(), -1.0)
    used = parts[(merit >= 0) & (merit >= merit.groupby(parts["track"]).transform("max"))]
    weight = 1 / used["sigma_mass_kda"] ** 2
    total = weight.groupby(used["track"]).sum()
    out = pd.DataFrame(index=pd.Index(np.unique(parts["track"]), name="track"))
    for name in ("mass_kda", "told"):
        out[name] = (weight * used[name]).groupby(used["track"]).sum() / total
    out["sigma_mass_kda"] = out["crb_mass_kda"] = 1 / np.sqrt(total)
    return out


def _views(
    table: pd.DataFrame, blocks: Sequence[Block], numbers: Sequence[IntArray]
) -> tuple[EventView, ...]:
    """Choose the clearest view of each track."""
    if not len(table):
        return ()
    best = table.loc[table.groupby("track")["snr"].idxmax()]
    edges = np.array([b.span[1] for b in blocks])
    found = []
    for row in best.itertuples():
        k = int(np.searchsorted(edges, row.frame, side="right"))
        found += [
            replace(view, event=int(row.track))
            for view in blocks[k].views
            if numbers[k][view.event] == row.track
        ][:1]
    return tuple(found)


def _together(blocks: Sequence[Block], parts: Sequence[Windows]) -> Windows:
    """Sum the backgrounds and the frames of all blocks."""
    if len(parts) == 1:
        return parts[0]
    frames, span = sum(b.frames for b in blocks), (blocks[0].span[0], blocks[-1].span[1])
    light: FloatArray = np.concatenate([b.power * b.level[b.used].mean() for b in blocks])
    power = light / light.mean()
    return replace(
        parts[0],
        before_e=sum((p.before_e for p in parts[1:]), parts[0].before_e),
        after_e=sum((p.after_e for p in parts[1:]), parts[0].after_e),
        n_before=frames,
        n_after=frames,
        read_variance_before_e2=frames / blocks[0].frames * parts[0].read_variance_before_e2,
        read_variance_after_e2=frames / blocks[0].frames * parts[0].read_variance_after_e2,
        masked=np.logical_or.reduce([p.masked for p in parts]),
        saturated=np.logical_or.reduce([p.saturated for p in parts]),
        frames_before=span,
        frames_after=span,
        power=np.concatenate([power, power]),
    )
