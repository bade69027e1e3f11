"""Images and films inside a page: data, model and residual of a particle as small files."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image, WebPImagePlugin

from iscat_analysis.config import SCHEMES
from iscat_analysis.records import Analysis, Clip, EventView, FloatArray, Trace
from iscat_analysis.report.numbers import number
from iscat_analysis.report.vega import columns_of
from iscat_analysis.units import count

DETAIL_BYTES, FILM_BYTES = 1_000_000, 800_000
"""Images, traces and clips of particles inside the page, at most, and films; what comes after that
is left out."""
ROW_BYTES = 70
"""What the numbers of a particle take, which leaves so much less for images."""

CLIP_MS, FILM_MS = 180, 120
"""Time for which a frame of a clip is shown, and of a film."""

_NOTHING = 255  # of a palette: transparent
_SHADES = 48  # of each scale of images and films: noise hides the steps
_CLIP_SHADES = 24  # of a clip, of which a page holds hundreds
_GREYS = ((0, 0, 0), (255, 255, 255))
_DIVERGING = ((0, 82, 140), (250, 250, 248), (190, 70, 0))


def display_range(images: Sequence[Any], scheme: str) -> tuple[float, float]:
    """Choose the grey scale that images share."""
    values = np.concatenate([np.ravel(image) for image in images])
    values = values[np.isfinite(values)]
    if not values.size:
        return -1.0, 1.0
    if not SCHEMES[scheme].interferes:
        low, high = (float(v) for v in np.quantile(values, [0.002, 0.999]))
        return (low, high) if high > low else (low, low + 1.0)
    limit = float(np.quantile(np.abs(values), 0.998))
    return (-limit, limit) if limit > 0 else (-1.0, 1.0)


@dataclass(frozen=True)
class Scale:
    """Greys of data and model, and colours of the residual, of one event or film."""

    low: float
    high: float
    limit: float
    unit: str

    @classmethod
    def of(cls, view: Any, scheme: str) -> Scale:
        """Choose the scales of images, or of films, with their model and residual."""
        low, high = display_range([view.contrast, view.model], scheme)
        return cls(low, high, residual_limit(view.residual), SCHEMES[scheme].image_unit)

    @property
    def text(self) -> str:
        """What the shades mean."""
        greys = f"{self.unit} {number(self.low)} to {number(self.high)}"
        return f"{greys}; residual ±{self.limit:g} σ"

    def strip(self, view: Any) -> NDArray[np.uint8]:
        """Put data, model and residual side by side, as shades of the palette."""
        span = self.high - self.low
        greys = ((part - self.low) / span for part in (view.contrast, view.model))
        data, model = (shaded(grey, _SHADES) for grey in greys)
        residual = shaded((view.residual / self.limit + 1) / 2, _SHADES, _SHADES)
        gap = np.full((*data.shape[:-1], 2), _NOTHING, np.uint8)
        return np.concatenate([data, gap, model, gap, residual], axis=-1)


def residual_limit(residual: FloatArray) -> float:
    """Choose the range of a residual image: four standard deviations, more where it needs more.

    Shapes: `residual` (y, x).
    """
    values = np.abs(residual[np.isfinite(residual)])
    return max(4.0, math.ceil(np.quantile(values, 0.995))) if values.size else 4.0


def shaded(values: NDArray[np.floating[Any]], shades: int, first: int = 0) -> NDArray[np.uint8]:
    """Give every pixel of an image the number of its shade, for `png_of`."""
    inside = np.rint(np.clip(np.nan_to_num(values), 0, 1) * (shades - 1)) + first
    return np.where(np.isfinite(values), inside, _NOTHING).astype(np.uint8)


def _ramp(stops: Any, shades: int) -> NDArray[np.uint8]:
    """Make so many shades between colours, shape (shades, 3)."""
    at, ends = np.linspace(0, 1, shades), np.linspace(0, 1, len(stops))
    channels = [np.interp(at, ends, [colour[k] for colour in stops]) for k in range(3)]
    return np.asarray(np.rint(np.stack(channels, axis=1)), dtype=np.uint8)


_PALETTE = np.concatenate([_ramp(_GREYS, _SHADES), _ramp(_DIVERGING, _SHADES)])
_COLOURS = np.full((256, 3), 127, np.uint8)
_COLOURS[: len(_PALETTE)] = _PALETTE


def png_of(shades: NDArray[np.uint8], palette: NDArray[np.uint8]) -> bytes:
    """Write a small PNG file.

    Shapes: `shades` (y, x), `palette` (n, 3).
    """
    image = Image.fromarray(np.minimum(shades, len(palette)).astype(np.uint8))
    image.putpalette([*palette.ravel().tolist(), 127, 127, 127])
    buffer = io.BytesIO()
    # noise never repeats itself: looking for that takes four times as long, and saves nothing
    image.save(buffer, "PNG", transparency=len(palette), compress_type=Image.HUFFMAN_ONLY)
    return buffer.getvalue()


def grey_png(image: FloatArray, longest: int) -> bytes:
    """Write an image between 0 and 1 in greys, its pixels averaged where there are too many."""
    times = -(-max(image.shape) // longest)
    rows, columns = (size // times * times for size in image.shape)
    whole = np.nan_to_num(image[:rows, :columns], nan=0.5)
    parts = whole.reshape(rows // times, times, columns // times, times)
    return png_of(shaded(parts.mean(axis=(1, 3)), 96), _ramp(_GREYS, 96))


def picture_uri(image: FloatArray, low: float, high: float) -> str:
    """Put an image into an address: greys between these ends, or colours on both sides of zero."""
    ramp = _ramp(_DIVERGING if low == -high else _GREYS, 96)
    return data_uri(png_of(shaded((image - low) / (high - low), 96), ramp))


def data_uri(content: bytes, kind: str = "image/png") -> str:
    """Put a file into an address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


# ---- Of an analysis ------------------------------------------------------------------------------


def event_details(analysis: Analysis, table: pd.DataFrame) -> dict[int, dict[str, Any]]:
    """Pack what the page shows of the first particles, as many as `DETAIL_BYTES` hold.

    Keys are rows; a value has `strip`, `scales`, and where they are known `trace` with `told`, and
    `clip` with `frames`, `still` and `sliding`.
    """
    packed: dict[int, dict[str, Any]] = {}
    spent = min(ROW_BYTES * len(table), DETAIL_BYTES * 3 // 4)
    for row, view in views_of_rows(table, analysis.views):
        scale, trace, clip = Scale.of(view, analysis.scheme), view.trace, view.clip
        strip = png_of(scale.strip(view), _PALETTE)
        detail: dict[str, Any] = {"strip": data_uri(strip), "scales": scale.text}
        spent += len(detail["strip"])
        if trace is not None:
            detail |= {"trace": trace_data(trace), "told": trace_words(trace)}
            spent += 14 * len(trace.contrast)  # characters of a frame and its contrast
        if clip is not None:
            turn = trace.frame if trace is not None else 0
            detail["clip"] = clip_shown(clip, scale, turn)
            spent += len(detail["clip"]["image"])
        if spent > DETAIL_BYTES:
            break
        packed[row] = detail
    return packed


def trace_data(trace: Trace) -> dict[str, dict[str, list[Any]]]:
    """Give the contrast of each frame around a step, their means, and the fitted step."""
    length = max(1, round(len(trace.contrast) / 40))  # frames of a mean
    start = (trace.frame - trace.first) % length  # none across the step
    many = (len(trace.contrast) - start) // length
    parts = trace.contrast[start : start + many * length].reshape(many, length)
    some = np.flatnonzero(np.isfinite(parts).any(axis=1))
    frames = trace.first + np.arange(len(trace.contrast))
    middles = trace.first + start + (some + 0.5) * length
    turns = [trace.used[0], trace.frame, trace.frame, trace.used[1]]
    levels = np.array([trace.before, trace.before, trace.after, trace.after])
    data = {
        "frames": {"frame": frames, "contrast": np.round(1e3 * trace.contrast, 3)},
        "means": {"frame": middles, "contrast": np.round(1e3 * np.nanmean(parts[some], axis=1), 3)},
        "step": {"order": range(4), "frame": turns, "contrast": 1e3 * levels},
    }
    return {name: columns_of(columns) for name, columns in data.items()}


def trace_words(trace: Trace) -> str:
    """Say what a drawn trace shows."""
    when = f"frame {trace.frame}" + (f" ± {trace.half_width}" if trace.half_width else "")
    return (
        "Contrast of each frame by the matched filter; dots: means. Line: the fitted step, at "
        f"{when}, over the frames that were used. Noise expected of a frame: "
        f"{number(1e3 * trace.sigma, 2)}×10⁻³."
    )


def clip_shown(clip: Clip, scale: Scale, still: int) -> dict[str, Any]:
    """Make the film of a clip: its images below each other, of which a page shows one at a time."""
    many, rows, columns = clip.contrast.shape
    grey = shaded((clip.contrast - scale.low) / (scale.high - scale.low), _CLIP_SHADES)
    image = png_of(grey.reshape(-1, columns), _ramp(_GREYS, _CLIP_SHADES))
    frames = count(clip.window_frames, "frame")
    return {
        "image": data_uri(image),
        "frames": many,
        "ratio": columns / rows,
        "seconds": CLIP_MS * many / 1e3,
        "still": int(np.argmin(np.abs(np.array(clip.frames) - still))),
        "told": f"{frames} over the {clip.window_frames} before them, from frame "
        f"{clip.frames[0]} on to {clip.frames[-1]}; grey as in the data",
    }


def films_shown(analysis: Analysis) -> Iterator[dict[str, Any]]:
    """Make the films of the page, as many as `FILM_BYTES` hold, with what is said of each."""
    spent = 0
    for film in analysis.films:
        scale = Scale.of(film, analysis.scheme)
        pictures = [Image.fromarray(frame) for frame in _COLOURS[scale.strip(film)]]
        moving = _animated(pictures)
        spent += len(moving)
        if spent > FILM_BYTES:
            break
        still = io.BytesIO()
        pictures[0].save(still, "PNG")
        wide, tall = pictures[0].size
        yield {
            "track": film.track,
            "why": film.why,
            "scales": f"frames {film.frames[0]} to {film.frames[-1]}; {scale.text}",
            "film": data_uri(moving, "image/webp"),
            "still": data_uri(still.getvalue()),
            "width": wide,
            "height": tall,
        }


def _animated(pictures: list[Image.Image]) -> bytes:
    buffer, kind = io.BytesIO(), WebPImagePlugin.WebPImageFile  # else all kinds are loaded for it
    how: dict[str, Any] = {"lossless": True, "quality": 60, "method": 4, "minimize_size": False}
    loop = {"save_all": True, "append_images": pictures[1:], "duration": FILM_MS, "loop": 0}
    pictures[0].save(buffer, kind.format, **loop, **how)
    return buffer.getvalue()


def views_of_rows(table: pd.DataFrame, views: Sequence[EventView]) -> list[tuple[int, EventView]]:
    """Assign views to rows: by position where the numbers agree, else by number."""
    numbers = table["event"].tolist()
    if [view.event for view in views] == numbers:
        return list(enumerate(views))
    first = {event: row for row, event in reversed(list(enumerate(numbers)))}
    return [(first[view.event], view) for view in views if view.event in first]
