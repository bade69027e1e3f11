"""Tiles of a chunk, joined: one chunk of the whole field, with one record for each event.

An event belongs to the tile whose core holds its centre.  On a seam two tiles may each place it in
the other's core, or each in its own: of what one reports beyond its core, that is kept which no
other reports.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.landing.merging import CLIPS, FinishedChunk, SameSteps
from iscat_analysis.landing.searched import Searched
from iscat_analysis.records import EventView
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.sliding import Tile


def joined(tiles: Sequence[Tile], done: Sequence[FinishedChunk]) -> FinishedChunk:
    """Join the tiles of one chunk."""
    homes = [(part, row) for part in done for row in range(len(part.lines))]
    order = _own_rows(tiles, done)
    lines = done[0].lines
    if homes:
        table = pd.concat([part.lines for part in done if len(part.lines)], ignore_index=True)
        lines = table.iloc[order].reset_index(drop=True)
    chosen = [homes[i] for i in order]
    views: list[EventView] = []
    for number, (part, row) in enumerate(chosen):
        if row >= len(part.views):  # it has so many that the others are not shown
            break
        view = part.views[row]
        views.append(view if number < CLIPS else replace(view, clip=None))
    has_ends = done[0].ends_e.size > 0
    middle = next(part for tile, part in zip(tiles, done, strict=True) if tile.is_central)
    return replace(
        done[0],
        lines=lines,
        repeats=np.array([part.repeats[row] for part, row in chosen]),
        evidence=np.array([part.evidence[row] for part, row in chosen]).reshape(
            -1, done[0].evidence.shape[1]
        ),
        views=tuple(views),
        masked=_field(tiles, [part.masked for part in done]),
        saturated=_field(tiles, [part.saturated for part in done]),
        strongest=_field(tiles, [part.strongest for part in done]),
        ends_e=_field(tiles, [part.ends_e for part in done]) if has_ends else done[0].ends_e,
        sampled=sum(part.sampled for part in done),
        stopped=any(part.stopped for part in done),
        trajectory=middle.trajectory,
        cause=next((part.cause for part in done if part.cause), ""),
        empty=EmptySpread.beside([part.empty for part in done]),
        searched=_searched(done),
        untold=np.concatenate([part.untold for part in done]),
    )


def _own_rows(tiles: Sequence[Tile], done: Sequence[FinishedChunk]) -> list[int]:
    """Choose one row for each event, of all rows one after the other, in order of frame."""
    tables = [part.lines for part in done if len(part.lines)]
    if not tables:
        return []
    table = pd.concat(tables, ignore_index=True)
    own = np.concatenate([
        tile.holds(part.lines["y_px"].to_numpy(float), part.lines["x_px"].to_numpy(float))
        for tile, part in zip(tiles, done, strict=True) if len(part.lines)
    ])  # fmt: skip
    same = SameSteps(table)
    chosen = np.flatnonzero(same.with_strangers(own, ~own))
    # two of one particle, each in its own core: the clearer one is kept
    clear = chosen[np.argsort(-table["snr"].to_numpy(float)[chosen], kind="stable")]
    home = np.repeat(np.arange(len(tables)), [len(each) for each in tables])
    taken = np.zeros(len(table), dtype=np.bool_)
    for one in clear.tolist():
        others = same.like(one)
        taken[one] = not (taken[others] & (home[others] != home[one])).any()
    frame, y, x = (table[name].to_numpy(float) for name in ("frame", "y_nm", "x_nm"))
    return sorted(np.flatnonzero(taken).tolist(), key=lambda i: (frame[i], y[i], x[i]))


def _field(tiles: Sequence[Tile], parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Put the cores of tiles in their places.

    Shapes: `parts` (…, y, x), result (…, y, x).
    """
    whole = np.zeros((*parts[0].shape[:-2], *tiles[0].field), dtype=parts[0].dtype)
    for tile, part in zip(tiles, parts, strict=True):
        whole[(..., *tile.core)] = part
    return whole


def _searched(done: Sequence[FinishedChunk]) -> Searched | None:
    """Average the shares of tiles, by their pixels."""
    known = [part for part in done if part.searched is not None]
    if not known:
        return None
    pixels = np.array([np.count_nonzero(~part.masked) for part in known], dtype=np.float64)
    shares = np.stack([part.searched.shares for part in known if part.searched is not None])
    frames = known[0].searched.frames if known[0].searched is not None else np.empty(0, np.int64)
    return Searched(frames, np.average(shares, axis=0, weights=np.maximum(pixels, 1.0)))
