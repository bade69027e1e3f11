"""Where in the movie?  Light, noise, focus, drift, what was left out, and events, against frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.drift import Pattern, middle_of, pattern_of
from iscat_analysis.camera.field_sample import FieldSample
from iscat_analysis.config import MOVES, Config
from iscat_analysis.diagnosis.prepared import Prepared
from iscat_analysis.diagnosis.stretches import Stretches
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.movie import Stack
from iscat_analysis.optics.field_map import changes_at, terms_of, when
from iscat_analysis.records import FloatArray, Status, is_event
from iscat_analysis.search.sliding import DARK, measure_frames, well_lit

_PLACES, _TOGETHER = 48, 6  # where some frames are looked at, and how many
_FEWEST = 3  # of these that must have light
_BINS = 40  # of time, in which events are counted
_LIT = 0.1  # of the median pixel's light, which one that tells the noise has
_PATTERN_PX = 256  # side of the part of a field whose pattern is followed
_MOST_INTERVALS = 200
_DROPPED = "dark, cut off, or the same as the frame before: left out"
_HIDDEN = "partly hidden by bright or ill-described particles"


@dataclass(frozen=True)
class Seen:
    """What some frames next to each other show; nothing where they have no light.

    Of a large field, the noise is that of a sample of its pixels, and the image that of its middle.
    """

    light_e: float = math.nan
    noise: float = math.nan
    image: FloatArray | None = None


def timeline_of(ready: Prepared, found: DetectionResult, table: pd.DataFrame) -> dict[str, Any]:
    """Say what was where in a movie, on one axis of frames."""
    first, last = _span(found.compared)
    if first == last:  # it was interrupted before any frame was done
        return {}
    together = min(_TOGETHER, last - first)
    starts = np.unique(np.linspace(first, last - together, _PLACES).astype(int)).tolist()
    kept = ready.stretches.kept if ready.stretches.breaks else ((first, last),)
    inside = [next((k for k, s in enumerate(kept) if s[0] <= f < s[1]), None) for f in starts]
    seen = [
        Seen() if held is None else look_at(ready.whole, ready.camera, start, start + together)
        for start, held in zip(starts, inside, strict=True)
    ]
    drift_y, drift_x = _drift(seen, inside, additive=found.context.additive)
    return {
        "frames": [start + (together - 1) / 2 for start in starts],
        "light_e": _numbers([one.light_e for one in seen]),
        "noise_over_expected": _numbers([one.noise for one in seen]),
        "focus_nm": _focus(found.context.config, starts),
        "drift_x_px": drift_x,
        "drift_y_px": drift_y,
        "intervals": list(_intervals(ready.stretches, found)),
        "events": _events(table, first, last),
    }


def _span(compared: Compared) -> tuple[int, int]:
    """Give the first frame that was used, and one past the last."""
    spans = [s for s in (compared.frames_before, compared.frames_after) if s[1] > s[0]] or [(0, 0)]
    return min(s[0] for s in spans), max(s[1] for s in spans)


def look_at(movie: Stack, camera: Camera, start: int, stop: int) -> Seen:
    """Measure light and noise of some frames, and the middle of their mean image."""
    counts = movie.read(start, stop)
    light, repeats = measure_frames(counts, camera)
    good = well_lit(light, DARK) & ~repeats
    if good.sum() < _FEWEST:
        return Seen()
    few, theirs = counts[good], camera
    sample = FieldSample.of((movie.shape[1], movie.shape[2]))
    if sample is not None:
        few, theirs = sample.taken(few), sample.camera(camera)
    electrons = theirs.to_electrons(few)
    power = electrons.mean(axis=(1, 2), keepdims=True)
    if power.min() <= 0:
        return Seen()
    steady = power.mean() / power
    electrons *= steady
    mean = electrons.mean(axis=0)
    used = (mean > _LIT * float(np.median(mean))) & ~theirs.saturated(few.max(axis=0))
    expected = mean + theirs.dark_variance_e2(few)
    noise = math.nan
    if used.any():
        steps = np.mean(np.diff(electrons, axis=0) ** 2, axis=0)
        noise = float(steps[used].sum() / (2 * expected[used].sum()))
    middle = middle_of(movie.shape, _PATTERN_PX)
    image = camera.part(middle).to_electrons(counts[good][..., *middle]) * steady
    return Seen(float(light[good].mean()), noise, image.mean(axis=0))


def _drift(
    seen: Sequence[Seen], inside: Sequence[int | None], *, additive: bool
) -> tuple[list[float | None], list[float | None]]:
    """Follow the fixed pattern within each stretch, from where the one before ended."""
    moved = np.full((len(seen), 2), np.nan)
    reference: Pattern | None = None
    begun: int | None = None
    origin, latest = np.zeros(2), np.zeros(2)
    for number, (one, held) in enumerate(zip(seen, inside, strict=True)):
        if one.image is None or additive:
            continue
        pattern = pattern_of(one.image)
        if held != begun or reference is None:
            reference, begun, origin = pattern, held, latest
        shift = np.array(pattern.shift_from(reference))
        if np.isfinite(shift).all():
            moved[number] = latest = origin + shift
    return _numbers(moved[:, 0]), _numbers(moved[:, 1])


def _focus(config: Config, starts: Sequence[int]) -> list[float | None]:
    """Give the focus with which each part was fitted."""
    optics = config.optics
    moves = {name: size for name, size in terms_of(optics).items() if name in MOVES}
    rises = [changes_at(moves, when(optics, frame)).get("focus_nm", 0.0) for frame in starts]
    return _numbers([optics.focus_nm + rise for rise in rises])


def _intervals(stretches: Stretches, found: DetectionResult) -> Iterator[dict[str, Any]]:
    """Name the frames that are flagged."""
    for one in stretches.breaks:
        yield {"start": one.start, "stop": one.stop, "what": one.cause}
    for start, stop, _ in (found.summary or {}).get("partly_searched", ()):
        yield {"start": int(start), "stop": int(stop), "what": _HIDDEN}
    compared, begin, number = found.compared, 0, 0
    for first, last in (compared.frames_before, compared.frames_after):
        light = compared.power[begin : begin + last - first]
        begin += last - first
        lost = ~np.isfinite(light)
        for one in stretches.breaks:
            lost[max(one.start - first, 0) : max(one.stop - first, 0)] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(np.int8), [0]])))
        for start, stop in edges.reshape(-1, 2).tolist():
            number += 1
            if number <= _MOST_INTERVALS:
                yield {"start": first + start, "stop": first + stop, "what": _DROPPED}


def _events(table: pd.DataFrame, first: int, last: int) -> dict[str, Any]:
    """Count events in equal parts of the movie, those that are ok and others."""
    edges = np.unique(np.linspace(first, last, _BINS + 1).astype(int))
    frame = table["frame"].to_numpy(float)
    ok = (table["status"] == Status.OK.value).to_numpy()
    others = ~ok & is_event(table)
    return {
        "edges": edges.tolist(),
        "ok": np.histogram(frame[ok], edges)[0].tolist(),
        "flagged": np.histogram(frame[others], edges)[0].tolist(),
    }


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> list[float | None]:
    """Give numbers, and nothing where there is none."""
    return [float(value) if math.isfinite(value) else None for value in values]
