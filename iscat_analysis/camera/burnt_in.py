"""Text that was burnt into the frames, as a time that goes on: found, and left out.

Ink is one count, again and again, far from what the light of its pixel is: light scatters, and what
a pixel saturates at is the end of its own scatter.  A time changes in frames that were not looked
at, so that the rectangle around its ink is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, find_objects, label

from iscat_analysis.camera.counts import Camera
from iscat_analysis.movie.selected_frames import ChangedFrames
from iscat_analysis.movie.stack import Stack
from iscat_analysis.records import BoolArray

_FRAMES, _TOGETHER, _COUNTS = 128, 8, 2**24  # that are looked at, in groups all over the movie
_FEWEST = 16
_RANGE = 2.5  # times the range of the counts of most pixels, which ink exceeds
_AGAIN = 0.02  # of the frames that have the same count, at least and at most
_TIMES = 3  # and as many frames
_APART = 5.0  # standard deviations of the light, between which and the ink there is nothing
_LEAST_PIXELS = 8  # of a text
_GAP = 4  # pixels between letters, at most
_MOST = 0.25  # of the field
_MARGIN = 1  # pixel around a text, for letters that are smooth


@dataclass(frozen=True, eq=False)
class PatchedFrames(ChangedFrames):
    """Frames whose text is covered with the rows beside it, which have the light of any."""

    rows: NDArray[np.int64]
    text: BoolArray

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        counts = self.source.read(start, stop)
        y, x = np.nonzero(self.text)
        counts[:, y, x] = counts[:, self.rows[y, x], x]
        return counts


def text_message(text: BoolArray, name: str) -> str:
    """Say where text is burnt in.

    Shapes: `text` (y, x).
    """
    boxes = " and ".join(
        f"rows {a.start}:{a.stop}, columns {b.start}:{b.stop}" for a, b in boxes_of(text)
    )
    return (
        f"{name}: a text is burnt into the frames ({boxes}), whose {int(text.sum())} pixels are "
        "left out; what lies beneath it is lost: switch it off in the program that records"
    )


def text_summary(text: BoolArray) -> list[dict[str, list[int]]]:
    """Give what ``summary.json`` says of a text.

    Shapes: `text` (y, x).
    """
    return [{"rows": [a.start, a.stop], "columns": [b.start, b.stop]} for a, b in boxes_of(text)]


def boxes_of(text: BoolArray) -> list[tuple[slice, slice]]:
    """Give the rectangles of a text.

    Shapes: `text` (y, x).
    """
    return [(box[0], box[1]) for box in find_objects(label(text)[0])]


def patched(movie: Stack, text: BoolArray) -> Stack:
    """Cover a text with the light of the nearest rows that have none.

    Shapes: `text` (y, x).
    """
    free = np.flatnonzero(~text.any(axis=1))
    rows = np.tile(np.arange(text.shape[0])[:, None], (1, text.shape[1]))
    for top, part in ((box[0].start, box) for box in boxes_of(text)):
        high = part[0].stop - top
        starts = [
            s for s in range(text.shape[0] - high + 1) if np.isin(range(s, s + high), free).all()
        ]
        if starts:
            start = min(starts, key=lambda s: abs(s - top))
            rows[part] += start - top
    return movie.seen_as(PatchedFrames(movie, rows.astype(np.int64), text))


def without_text(movie: Stack, text: BoolArray, camera: Camera) -> Stack:
    """Leave the pixels of a text out, as dead ones.

    Shapes: `text` (y, x).
    """
    dark = np.broadcast_to(np.floor(camera.offset_adu), text.shape)[text].astype(movie.dtype)
    return movie.without(text, dark)


def find_text(movie: Stack, span: tuple[int, int]) -> BoolArray | None:
    """Find pixels into which a text is burnt that changes from frame to frame.

    Shapes: result (y, x).
    """
    counts = _sample(movie, span)
    if len(counts) < _FEWEST or not np.issubdtype(counts.dtype, np.integer):
        return None
    lowest, highest = counts.min(axis=0).astype(np.int64), counts.max(axis=0).astype(np.int64)
    width = highest - lowest
    doubtful = width > _RANGE * max(float(np.median(width)), 1.0)
    if not doubtful.sum() >= _LEAST_PIXELS:
        return None
    series = np.sort(counts[:, doubtful].astype(np.int64), axis=0)
    ink, share = _commonest(series)
    light = np.where(series == ink, np.nan, series)
    light[:, share == 1] = 0.0  # nothing but ink, or dead
    scatter = 1.4826 * np.nanmedian(np.abs(light - np.nanmedian(light, axis=0)), axis=0)
    apart = np.nanmin(np.abs(light - ink), axis=0) > _APART * np.maximum(scatter, 1.0)
    inked = apart & (share >= max(_AGAIN, _TIMES / len(counts))) & (share <= 1 - _AGAIN)
    letters = np.zeros(doubtful.shape, dtype=np.bool_)
    letters[doubtful] = inked
    inks = np.unique(ink[inked])
    if letters.sum() < _LEAST_PIXELS or inks.size > letters.sum() / 2:  # of many, none is one
        return None
    # some letters stay, and others change in a few frames
    letters |= (doubtful | (width == 0)) & np.isin(counts, inks).any(axis=0)
    text = np.zeros_like(letters)
    for box in find_objects(label(binary_dilation(letters, iterations=_GAP))[0]):
        y, x = np.nonzero(letters[box])
        if y.size >= _LEAST_PIXELS:
            top, left = box[0].start + int(y.min()), box[1].start + int(x.min())
            bottom, right = box[0].start + int(y.max()), box[1].start + int(x.max())
            text[
                max(top - _MARGIN, 0) : bottom + _MARGIN + 1,
                max(left - _MARGIN, 0) : right + _MARGIN + 1,
            ] = True
    return text if 0 < text.mean() < _MOST else None


def _sample(movie: Stack, span: tuple[int, int]) -> NDArray[Any]:
    """Read groups of frames all over a range.

    Shapes: result (t, y, x).
    """
    frames = span[1] - span[0]
    most = max(_FEWEST, min(_FRAMES, _COUNTS // math.prod(movie.shape[1:])))
    if frames <= most:
        return movie.read(*span)
    groups = max(2, most // _TOGETHER)
    starts = np.linspace(span[0], span[1] - _TOGETHER, groups).astype(int)
    return np.concatenate([movie.read(start, start + _TOGETHER) for start in starts.tolist()])


def _commonest(series: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Give the commonest count of every pixel, and its share of the frames.

    Shapes: `series` (t, n), sorted; `ink, share` (n,).
    """
    frames, pixels = series.shape
    new = np.vstack([np.ones((1, pixels), dtype=np.bool_), np.diff(series, axis=0) != 0])
    begins = np.where(new, np.arange(frames)[:, None], 0)
    length = np.arange(frames)[:, None] - np.maximum.accumulate(begins, axis=0) + 1
    last = length.argmax(axis=0)
    columns = np.arange(pixels)
    return series[last, columns], length[last, columns] / frames
