"""Estimates at places without a particle, which show the noise.

`landing.split_frames` compares windows of frames there; `FrameNoise` compares single
frames with their background, for tracks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from iscat_analysis.camera import smooth_background
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event, photons_scale
from iscat_analysis.fitting.field import total_signal
from iscat_analysis.inference.likelihood import LEVEL
from iscat_analysis.inference.repeats import LENGTHS
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import (
    FREE_PARAMETERS,
    BoolArray,
    FitResult,
    FloatArray,
    Status,
    Windows,
)
from iscat_analysis.search.empty import CONTRASTS, EmptyField, EmptySpread

_WHOLE = CONTRASTS.index("whole")


def taken_places(
    context: AnalysisContext, shape: tuple[int, int], places: Sequence[tuple[float, float, bool]]
) -> BoolArray:
    """Mark pixels near a particle, in which the estimate would show its fit and not the noise.

    Shapes: result (y, x).
    """
    taken = np.zeros(shape, dtype=np.bool_)
    for x, y, described in places:
        # of the square's side; a poor fit leaves its rings over
        reach = context.roi_px * (1 / 3 if described else 1 / 2)
        top, left = max(math.ceil(y - reach), 0), max(math.ceil(x - reach), 0)
        box = taken[
            top : max(math.floor(y + reach) + 1, 0), left : max(math.floor(x + reach) + 1, 0)
        ]
        i, j = np.indices(box.shape)
        box |= np.hypot(i + top - y, j + left - x) < reach
    return taken


def taken_by(
    context: AnalysisContext, windows: Windows, events: Sequence[Event], signal: FloatArray
) -> BoolArray:
    """Mark pixels near fitted particles.

    Shapes: `signal` (y, x), result (y, x).
    """
    rows, columns = windows.after_e.shape
    taken = taken_places(
        context,
        (rows, columns),
        [(e.candidate.x_px, e.candidate.y_px, Status.POOR_FIT not in e.flags) for e in events],
    )
    if context.additive:
        taken |= photons_scale(context, windows) * signal > 0.1 * windows.after_e.mean()
    return taken


def empty_field(
    context: AnalysisContext,
    mean_e: FloatArray,
    read: FloatArray,
    used: BoolArray,
    fits: Sequence[FitResult],
    *,
    level: bool,
) -> EmptyField:
    """Make the linear estimator for windows, with the typical height and noise of the fits.

    Shapes: `mean_e` (y, x), `read` (y, x), `used` (y, x).
    """
    model, pixel = context.model, context.pixel_nm
    theta = np.median([fit.theta for fit in fits], axis=0)
    grid = PixelGrid.centred(context.roi_px | 1, pixel)
    _, first = model.signal(grid, (0.0, 0.0, theta[2], theta[3]))
    free = fits[0].box.free
    slopes = first[np.flatnonzero(free[:LEVEL])]
    n_free = len(slopes)
    if level:
        slopes = np.concatenate([slopes, np.ones((1, *grid.shape))])
    optics = model.optics
    spacing = max(1, round(optics.wavelength_nm / (2 * optics.na) / pixel))
    return EmptyField(
        mean_e, read, used, slopes, n_free,
        additive=context.additive, spacing_px=spacing, tile_px=max(context.roi_px // 2, 4),
    )  # fmt: skip


def background_field(
    context: AnalysisContext,
    windows: Windows,
    power: float,
    read: FloatArray,
    fits: Sequence[FitResult],
) -> EmptyField:
    """Make the linear estimator for single frames against a background.

    Shapes: `read` (y, x).
    """
    mean = windows.before_e
    if context.additive:  # counts may be few, and weights must not follow their fluctuations
        mean = smooth_background(mean, windows.read_variance_before_e2, windows.masked)
    return empty_field(context, mean / power, read, ~windows.masked, fits, level=False)


class FrameNoise:
    """Estimates in single frames at places without a particle."""

    def __init__(
        self,
        context: AnalysisContext,
        windows: Windows,
        read_e2: FloatArray,
        fits: Sequence[FitResult],
    ) -> None:
        self._context = context
        light = float(max(windows.n_before, 1))
        self._field = background_field(context, windows, light, read_e2, fits)
        self._light = light
        self._level = windows.before_e / light
        self._before = self._field.errors(windows.before_e, light, None)
        # A background noisier than the mean of its frames is worth less light than they hold.
        # variance of a background that is given, over that of one frame
        self._worth = light / max(context.background_variance, 1e-12)
        first, last = windows.frames_after
        known = windows.n_before == 0
        self._middle = first - 1.0 if known else (sum(windows.frames_before) - 1) / 2
        near, far = sorted((abs(first - self._middle), abs(last - 1 - self._middle)))
        # distances between a frame and its background at which the noise is told apart
        self._edges = np.geomspace(near, far, min(6, last - first) + 1)[1:-1]
        bins = self._edges.size + 1
        free = len(FREE_PARAMETERS[context.mode])
        self._squares = np.zeros((2 + bins, free, self._field.tiles))
        self._counts = np.zeros((2 + bins, self._field.tiles))
        self._distances = np.zeros((2, bins))  # sum, and of how many frames
        self._last: tuple[int, float, FloatArray, BoolArray, FloatArray] | None = None

    def look(self, here: Windows, events: Sequence[Event]) -> FloatArray:
        """Add one frame.

        Shapes: result (1 + len(LENGTHS).
        """
        context, field = self._context, self._field
        shape = (here.after_e.shape[0], here.after_e.shape[1])
        power = here.power_ratio * self._light
        signal = context.left(total_signal(context, shape, events))
        taken = taken_by(context, here, events, signal) | here.masked
        known = signal * (photons_scale(context, here) / power if context.additive else self._level)
        errors = field.errors(here.after_e, power, known)
        left = field.left([(e.candidate.x_px, e.candidate.y_px) for e in events])
        apart = field.spread(
            [self._before], [errors], (np.array([self._worth]), np.array([power])), taken, left
        )
        frame = here.frames_after[0]
        distance = abs(frame - self._middle)
        bin_ = int(np.searchsorted(self._edges, distance, side="right"))
        self._distances[:, bin_] += distance, 1
        for k in (0, 2 + bin_):
            self._squares[k] += len(events) * apart.squares[_WHOLE]
            self._counts[k] += len(events) * apart.counts[_WHOLE]
        if self._last is not None and self._last[0] == frame - 1:
            _, before, others, there, share = self._last
            next_ = field.spread(
                [others], [errors], (np.array([before]), np.array([power])), taken | there,
                (left + share) / 2,
            )  # fmt: skip
            self._squares[1] += next_.squares[_WHOLE]
            self._counts[1] += next_.counts[_WHOLE]
        self._last = frame, power, errors, taken, left
        found = np.zeros((1 + len(LENGTHS), len(self._squares[0]) + 1))
        found[0, :-1] = apart.squares[_WHOLE].sum(axis=1)
        found[0, -1] = apart.counts[_WHOLE].sum()
        return found

    @property
    def spread(self) -> EmptySpread:
        """Spread over all frames, each weighted with the number of particles fitted in it."""
        seen = self._counts[2:].any(axis=1)
        kept = np.concatenate([[True, True], seen])
        total, frames = self._distances[:, seen]
        distances = tuple(float(d) for d in total / frames)
        shared = self._field.shared
        return EmptySpread(self._squares[kept], self._counts[kept], shared, distances)
