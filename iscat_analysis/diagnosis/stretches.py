"""Where a landing movie breaks: frames that cannot be compared with those beside them.

A recording that was cut together, liquid that was exchanged, a lamp, an aggregate that passes: each
changes much of the field, and windows before and after see all of it as particles.  The movie is
then analysed in stretches, within which windows slide, and what lies between is named and left out.

Of groups of frames the light of square cells is taken, over that of the frame; what a cell changes
by from one group to the next is set against what it usually does.  A particle changes a few cells
once; a break changes most of them, or goes on changing many.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import MOVIE_BREAKS
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.movie import Stack
from iscat_analysis.records import FloatArray
from iscat_analysis.search.noise import SHORTEST_MOVIE

_GROUP, _READ = 16, 4  # frames from one group to the next, and how many of them are looked at
_CELLS, _SMALLEST = 32, 4  # cells along the longer side, and their least side [px]
_FEWEST = 8  # groups that tell what is usual
_STEP_SHARE, _STEP_EVEN = 0.6, 0.15  # of the cells that a break changes, and how evenly (Gauss: ⅓)
_LASTING, _LASTING_SHARE = 3, 0.2  # groups through which many cells go on changing
_SAME, _LIKE, _OTHER = 0.99, 0.9, 0.5  # correlation of patterns: one, alike, and others
_BRIGHTER, _FLATTER = 1.03, 0.985  # light and contrast of a pattern under more light


@dataclass(frozen=True)
class Break:
    """Frames that are left out, none where a cut has none, and why."""

    start: int
    stop: int
    cause: str

    @property
    def description(self) -> str:
        """Describe it in words."""
        if self.start == self.stop:
            return f"{self.cause} at frame {self.start}"
        return f"{self.cause} in frames {self.start}:{self.stop}, which are left out"


@dataclass(frozen=True)
class Stretches:
    """The parts of a movie within which windows slide, and what lies between them."""

    kept: tuple[tuple[int, int], ...]
    breaks: tuple[Break, ...] = ()

    @property
    def main(self) -> tuple[int, int]:
        """The part that tells of camera, light and optics: the first of those that are long."""
        longest = max(stop - start for start, stop in self.kept)
        # tells as much as the longest
        return next(span for span in self.kept if span[1] - span[0] >= 0.75 * longest)

    def with_jumps(self, frames: Sequence[int]) -> Stretches:
        """Break where the focus jumps, too."""
        jumps = [
            Break(frame, frame, "the focus jumps")
            for frame in frames
            if any(start < frame < stop for start, stop in self.kept)
        ]
        if not jumps:
            return self
        every = sorted([*self.breaks, *jumps], key=lambda one: (one.start, one.stop))
        span = min(self.kept[0][0], every[0].start), max(self.kept[-1][1], every[-1].stop)
        return _between(span, every) or self

    def finding(self, name: str) -> Finding | None:
        """Tell where the movie breaks."""
        if not self.breaks:
            return None
        kept = ", ".join(f"{a}:{b}" for a, b in self.kept)
        breaks = "; ".join(one.description for one in self.breaks)
        return MOVIE_BREAKS({"breaks": breaks, "kept": kept}, where=name)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of it."""
        return {
            "analysed": [list(span) for span in self.kept],
            "breaks": [asdict(one) for one in self.breaks],
        }


def find_stretches(
    movie: Stack, span: tuple[int, int], excluded: Sequence[tuple[int, int]] = ()
) -> Stretches:
    """Find where a movie breaks; frames that are excluded are a break too."""
    given: list[Break] = []
    for start, stop in sorted(excluded):
        start, stop = max(start, span[0]), min(stop, span[1])
        if given and start <= given[-1].stop:
            given[-1] = Break(given[-1].start, max(stop, given[-1].stop), _EXCLUDED)
        elif start < stop:
            given.append(Break(start, stop, _EXCLUDED))
    between = _between(span, given)
    if between is None and given:
        raise DataError(
            f"{movie.name}: fit.excluded_frames leaves no {SHORTEST_MOVIE} frames together, which "
            "an analysis needs"
        )
    parts = [_breaks_within(movie, part) for part in (between.kept if between else [span])]
    breaks = sorted(
        (*given, *(one for part in parts for one in part.breaks)), key=lambda b: b.start
    )
    return Stretches(tuple(kept for part in parts for kept in part.kept), tuple(breaks))


def _breaks_within(movie: Stack, span: tuple[int, int]) -> Stretches:
    """Find the breaks that the frames themselves show."""
    whole = Stretches((span,))
    starts = np.arange(span[0], span[1] - _READ + 1, _GROUP)
    if starts.size < _FEWEST:
        return whole
    groups = [_cells(movie, int(start), int(start) + _READ) for start in starts]
    light = np.array([one.mean() for one in groups])
    lit = light > 0.5 * float(np.quantile(light, 0.75))  # of the usual light
    starts, light = starts[lit], light[lit]
    cells = np.array([one / one.mean() for one, used in zip(groups, lit, strict=True) if used])
    if len(cells) < _FEWEST:
        return whole
    runs = _runs(cells)
    if not runs or len(runs) > 12:  # beyond which nothing is usual
        return whole
    found: list[Break] = []
    begun: int | None = None  # since when more light than before
    for run in runs:  # groups between which the light changes
        one, opens = _break_of(movie, starts, cells, light, run)
        if opens:
            begun = one.start if begun is None else begun
            continue
        if opens is False:
            first = span[0] if begun is None else begun
            one, begun = Break(first, max(one.stop, first + 1), _LAMP), None
        found.append(one)
    if begun is not None:
        found.append(Break(begun, span[1], _LAMP))
    return _between(span, found) or whole


_EXCLUDED = "excluded by fit.excluded_frames"
_LAMP = "more light than before, as of a lamp or a door that is open,"
_CUT = "another pattern of light, as where two recordings or fields were joined,"
_JOLT = "the pattern of the light changes from one frame to the next, as by a jolt or new liquid,"
_PASSED = "something large passes through the field, as an aggregate or a bubble,"
_EXCHANGED = "the pattern of the light becomes another one, as where liquid is exchanged,"


def _between(span: tuple[int, int], breaks: Sequence[Break]) -> Stretches | None:
    """Give what is left between breaks, where any of it is long enough."""
    edges = [span[0], *(edge for one in breaks for edge in (one.start, one.stop)), span[1]]
    parts = zip(edges[::2], edges[1::2], strict=True)
    kept = tuple((a, b) for a, b in parts if b - a >= SHORTEST_MOVIE)
    return Stretches(kept, tuple(breaks)) if kept else None


def _cells(movie: Stack, start: int, stop: int, *, each: bool = False) -> FloatArray:
    """Give the mean counts of square cells, of the median of some frames or of each.

    Shapes: result (y, x) or (t, y, x).
    """
    rows, columns = movie.shape[1:]
    side = max(_SMALLEST, math.ceil(max(rows, columns) / _CELLS))
    high, wide = max(rows // side, 1), max(columns // side, 1)
    tall, broad = min(side, rows), min(side, columns)
    every = max(1, tall // 16)  # rows of a cell that are read
    placed = movie.in_place(start, stop)
    counts = movie.read(start, stop) if placed is None else placed.counts
    part = counts[:, : high * tall, : wide * broad].reshape(-1, high, tall, wide * broad)
    part = part[:, :, ::every].astype(np.float64)
    if placed is not None:
        placed.let_go()
    means = part.reshape(len(part), high, -1, wide, broad).mean(axis=(2, 4))
    return np.asarray(means if each else np.median(means, axis=0))


def _runs(cells: FloatArray) -> list[tuple[int, int]]:
    """Find the groups between which a break lies: from the last before it to the first after.

    Shapes: `cells` (groups, y, x).
    """
    seen = cells.reshape(len(cells), -1)
    usable = seen.min(axis=0) > 0
    change = np.diff(np.log(np.where(usable, seen, 1.0)), axis=0)
    change -= np.median(change, axis=0)
    scatter = SIGMA_PER_MAD * np.median(np.abs(change), axis=0)
    usable &= scatter > 0
    if not usable.any():
        return []
    change, scatter = change[:, usable], scatter[usable]
    share = (np.abs(change) > 5.0 * scatter).mean(axis=1)  # standard deviations of a cell
    base = float(np.median(share))
    # of the cells: a change has begun
    begun = share > base + max(0.05, 6 * float(np.median(np.abs(share - base))))
    pattern = seen[:, usable].mean(axis=0)
    contrast = float(np.std(pattern)) or 1.0
    found = []
    edges = np.flatnonzero(np.diff(np.concatenate([[0], begun.astype(np.int8), [0]])))
    for first, last in edges.reshape(-1, 2).tolist():
        part = change[first:last]
        size = np.sqrt(np.mean(part**2, axis=1)) / contrast
        even = np.mean(part**2, axis=1) ** 2 / np.maximum(np.mean(part**4, axis=1), 1e-300)
        # of the pattern's contrast
        sudden = (share[first:last] > _STEP_SHARE) & (even > _STEP_EVEN) & (size > 0.1)
        lasting = (
            last - first >= _LASTING
            and float(share[first:last].max()) > base + _LASTING_SHARE
            # of a few bright particles, one after the other, 0.5
            and float(np.sum(share[first:last] - base)) > 0.8
            # of the pattern's contrast, from one group to the next
            and float(np.median(size)) > 0.05
        )
        if sudden.any() or lasting:
            found.append((first, last))
    return found


def _break_of(
    movie: Stack,
    starts: NDArray[np.int64],
    cells: FloatArray,
    light: FloatArray,
    run: tuple[int, int],
) -> tuple[Break, bool | None]:
    """Date a break and name its cause; the other says whether a lamp went on, or off.

    Shapes: `starts, light` (groups,), `cells` (groups, y, x).
    """
    first, last = run
    start, stop = int(starts[first]), int(starts[last]) + _READ
    before, after = (cells[k] - 1 for k in (first, last))
    slope = float(np.sum(before * after) / np.sum(before**2))
    alike = float(np.corrcoef(before.ravel(), after.ravel())[0, 1])
    brighter = float(light[last] / light[first])
    opens: bool | None = None
    if alike > _LIKE and brighter > _BRIGHTER and slope < _FLATTER:
        opens = True
    elif alike > _LIKE and brighter < 1 / _BRIGHTER and slope > 1 / _FLATTER:
        opens = False
    frame = _sudden(movie, start, stop) if last - first < _LASTING else None
    if frame is not None:
        cause = _CUT if alike < _OTHER else _JOLT
        return Break(frame, frame, cause), opens
    cause = _PASSED if alike > _SAME and opens is None else _EXCHANGED
    return Break(start, stop, cause), opens


def _sudden(movie: Stack, start: int, stop: int) -> int | None:
    """Find the frame at which all of a change is made; None where it takes longer."""
    frames = _cells(movie, start, stop, each=True)
    frames /= frames.mean(axis=(1, 2), keepdims=True)
    # of the four frames on either side none has a part of the change, if it is sudden
    means = sliding_window_view(frames, _READ, axis=0).mean(axis=-1)
    sizes, whole = _squares(means[_READ:] - means[:-_READ]), _squares(means[-1:] - means[:1])
    if not sizes.size or whole[0] <= 0:
        return None
    best = int(np.argmax(_squares(np.diff(frames, axis=0))[_READ - 1 : 1 - _READ]))
    return start + _READ + best if sizes[best] > 0.7 * whole[0] else None


def _squares(changes: FloatArray) -> FloatArray:
    """Sum the squares of each of some images (n, y, x)."""
    return np.asarray(np.sum(np.square(changes), axis=(1, 2)))
