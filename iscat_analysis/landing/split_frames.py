"""Estimates from parts of the frames of each event, and from frames in which nothing lands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from iscat_analysis.camera import Camera
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event, photons_scale
from iscat_analysis.fitting.field import total_signal
from iscat_analysis.inference.repeats import (
    PARTS,
    Response,
    Series,
    repeats_of,
    response_of,
    series_of,
)
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.movie import Stack
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Windows
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.frames import EVERYWHERE, Box, Chunk, middle_of_box
from iscat_analysis.trust.null_field import background_field, empty_field, taken_by, taken_places


def nothing_repeated(mode: str) -> FloatArray:
    """Give the record of an event whose frames could not be divided."""
    empty = Series(np.zeros((len(FREE_PARAMETERS[mode]), 0)), *(np.zeros(0) for _ in range(3)))
    return repeats_of((empty,))


# ---- landing movies --------------------------------------------------------------------------


def step_repeats(
    spans: tuple[tuple[int, int], tuple[int, int]],
    event: Event,
    step: Step,
    others: Sequence[Step],
    neighbours: Neighbours,
) -> FloatArray:
    """Compare the estimates from parts of the frames of one landing or leaving.

    `spans` are frames without and with its particle; they contain its windows and may be longer.
    """
    region, windows, chunk = event.region, event.windows, neighbours.chunk
    response = _response(event)
    if response is None:
        return nothing_repeated(neighbours.context.mode)
    moving = neighbours.pattern
    local = None if moving is None else moving.local(region, step.at.frame)
    at = neighbours.shared(step, region)
    whole = chunk.patch(min(spans)[0], max(spans)[1], region.rows, region.columns)
    light = whole.mean_e
    read = np.square(whole.read_noise_e) * np.ones(region.shape)
    own, longer = [], []
    for span, window, weights in zip(
        spans,
        (windows.frames_before, windows.frames_after),
        (response.before, response.after),
        strict=True,
    ):
        part = whole.frames(*span)
        one = series_of(
            part.counts, weights, part.power,
            gain=part.gain, offset=part.offset, mean_e=light, read_variance_e2=read,
        )  # fmt: skip
        known = np.zeros(one.values.shape)
        frames = np.arange(part.first, part.first + len(part.power))[part.power > 0]
        for other in others:
            if not span[0] < other.at.frame < span[1]:
                continue
            shown = neighbours.shown(other, region)
            if shown is None:
                continue
            here, image = shown
            height = np.einsum("iyx,yx->i", weights[(slice(None), *here)], light[here] * image)
            there = (frames >= other.at.turns[:, None]).mean(axis=0)
            known += np.outer(other.sign * height, there)
        if local is not None:  # the pattern moves, and the particle with it
            centres, cuts = zip(*neighbours.in_blocks(frames), strict=True)
            seen = [local.seen(cut) for cut in cuts]
            for centre, cut, block in zip(centres, cuts, seen, strict=True):
                if at is not None and (centre + 0.5 >= step.at.frame) == (step.sign > 0):
                    block[at[0]] += light[at[0]] * neighbours.seen(step, cut, at[1])
            heights = np.einsum("iyx,kyx->ik", weights, seen)
            known += [np.interp(frames, centres, height) for height in heights]
        left = replace(one, values=one.values - known * one.power)
        inside = (frames >= window[0]) & (frames < window[1])
        own.append(replace(left, values=left.values[:, inside], power=left.power[inside]))
        longer.append(left)
    return repeats_of(tuple(own), tuple(longer))


def step_controls(
    events: Sequence[Event], steps: Sequence[Step], neighbours: Neighbours, own: Box = EVERYWHERE
) -> EmptySpread | None:
    """Make the same estimates in windows in which nothing lands or leaves, at its own pixels.

    The middle of a tile is enough: its field has many.
    """
    context, chunk, window = neighbours.context, neighbours.chunk, neighbours.window
    times = sorted({event.frame for event in events})
    times = [t for t in times if chunk.first <= t - window and t + window <= chunk.stop]
    if not times:
        return None
    # Side of the middle of a tile at which its noise is looked at.
    box = EVERYWHERE if own == EVERYWHERE else middle_of_box(own, chunk.shape, 256)
    field = empty_field(
        context, chunk.mean_e[box], chunk.camera.read_variance_e2(chunk.shape)[box],
        chunk.usable[box], [event.fit for event in events], level=True,
    )  # fmt: skip
    most = most_windows(field.places, (chunk.edges.size - 2) / context.searches)
    apart: list[int] = []
    for t in times:
        if not apart or t >= apart[-1] + window:
            apart.append(t)
    chosen = [apart[i] for i in np.unique(np.linspace(0, len(apart) - 1, most).round().astype(int))]
    total: EmptySpread | None = None
    for turn in chosen:
        near = [s for s in steps if abs(s.at.frame - turn) <= window]
        taken = taken_places(
            context, chunk.shape, [(s.start.x_px, s.start.y_px, s.excess == 0) for s in near]
        )
        sides, powers = [], []
        for start, stop in ((turn - window, turn), (turn, turn + window)):
            parts, light = [], []
            for cut in _cuts(chunk, start, stop):
                power = float(chunk.power[cut].sum())
                sum_e = chunk.electrons(cut, box)
                known = np.zeros(chunk.shape)
                for s in near:
                    known[neighbours.box(s)] += neighbours.presence(s, cut) * s.image
                known = context.left(known)[box]
                parts.append(field.errors(sum_e, power, known * chunk.mean_e[box]))
                light.append(power)
            sides.append(parts)
            powers.append(np.array(light))
        if min(len(p) for p in powers) < 2:
            continue
        found = field.spread(sides[0], sides[1], (powers[0], powers[1]), taken[box])
        total = found if total is None else total + found
    return total


def most_windows(places: int, share: float) -> int:
    """Give the number of such windows in a chunk, in proportion to its share of the movie.

    The noise of a chunk is looked at in so many places times windows, and that of a whole movie.
    """
    enough = min(20_000, 100_000 * share) / max(places, 1)
    return int(np.clip(enough, 2, 8))


def _cuts(chunk: Chunk, start: int, stop: int) -> Iterator[slice]:
    """Divide the good frames of a window into contiguous parts."""
    good = np.flatnonzero(chunk.power[chunk.cut(start, stop)] > 0) + (start - chunk.first)
    parts = min(PARTS, good.size)
    edges = np.linspace(0, good.size, parts + 1).round().astype(int)
    for a, b in pairwise(edges):
        if b > a:
            yield slice(int(good[a]), int(good[b - 1]) + 1)


# ---- background frames -----------------------------------------------------------------------


def field_repeats(
    context: AnalysisContext,
    movie: Stack,
    camera: Camera,
    windows: Windows,
    events: Sequence[Event],
) -> tuple[list[FloatArray], EmptySpread | None]:
    """Compare parts of the frames before and after, at the events and where there are none."""
    if not events:
        return [], None
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    read = camera.read_variance_e2(shape)
    responses = [_response(event) for event in events]
    series: list[tuple[list[Series], list[Series]]] = [([], []) for _ in events]
    spans = (windows.frames_before, windows.frames_after)
    n_before = windows.n_before
    power = windows.power
    # of a frame, whose power is then known to 1 %
    if windows.before_e.sum() < 1e4 * max(n_before, 1):
        power = np.ones_like(power)  # too dark to tell one frame's from the next's
    powers = (power[:n_before], power[n_before:])
    # the level of the light is the one that the fits use
    scale = windows.power_ratio * max(powers[0].sum(), 1.0) / powers[1].sum() if n_before else 1.0
    powers = (powers[0], powers[1] * scale)
    fits = [event.fit for event in events]
    field = (
        background_field(context, windows, powers[0].sum(), read, fits) if n_before > 1 else None
    )
    signal = context.left(total_signal(context, shape, events))
    taken = taken_by(context, windows, events, signal)
    parts: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    lights: tuple[list[float], list[float]] = ([], [])
    for side, (span, power) in enumerate(zip(spans, powers, strict=True)):
        count = span[1] - span[0]
        if not count or (side == 0 and not n_before):
            continue
        lit = np.flatnonzero(power > 0)
        inner = np.linspace(0, lit.size, min(PARTS, lit.size) + 1).round().astype(int)[1:-1]
        edges = [0, *lit[inner].tolist(), count]
        sums = windows.after_e if side else windows.before_e
        mean = sums / power.sum()
        known = None
        if side:
            light = windows.before_e / powers[0].sum() if n_before else windows.before_e
            known = signal * (
                photons_scale(context, windows) / power.sum() if context.additive else light
            )
        for a, b in pairwise(edges):
            total = np.zeros(shape)
            for first, counts in movie.chunks(span[0] + a, span[0] + b, memory_mb=4.0):
                start = first - span[0]
                for event, response, own in zip(events, responses, series, strict=True):
                    if response is None:
                        continue
                    here = event.region.slices
                    part, weights = camera.part(here), (response.before, response.after)[side]
                    of_frames = power[start : start + len(counts)]
                    one = series_of(
                        counts[(slice(None), *here)], weights, of_frames,
                        gain=part.gain_e_per_adu, offset=part.offset_adu, mean_e=mean[here],
                        read_variance_e2=read[here],
                    )  # fmt: skip
                    own[side].append(one)
                if field is not None:
                    total += camera.to_electrons(counts).sum(axis=0)
            if field is not None:
                light_sum = float(power[a:b].sum())
                parts[side].append(field.errors(total, light_sum, known))
                lights[side].append(light_sum)
    empty = None
    if field is not None:
        light = np.array(lights[0]), np.array(lights[1])
        left = field.left([(event.candidate.x_px, event.candidate.y_px) for event in events])
        empty = field.spread(parts[0], parts[1], light, taken, left)
    nothing = nothing_repeated(context.mode)
    joined = [[_joined(side) for side in own if side] for own in series]
    return [repeats_of(tuple(own)) if own else nothing for own in joined], empty


def _joined(series: Sequence[Series]) -> Series:
    return Series(
        np.concatenate([s.values for s in series], axis=1),
        np.concatenate([s.power for s in series]),
        series[0].shot,
        series[0].read,
    )


# ---- both ------------------------------------------------------------------------------------


def _response(event: Event) -> Response | None:
    fit, windows, free = event.fit, event.windows, event.fit.box.free
    if event.likelihood.prior is not None:  # of a height of its own no part of the frames tells
        free = free & (np.arange(free.size) != PARAMETERS.index("z_nm"))
    return response_of(event.likelihood, fit.theta, free, windows.before_e, windows.power_ratio)
