"""Single events and tracks: their images, traces, films and posteriors, on a page or in files."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image, WebPImagePlugin

from iscat_analysis.config import SCHEMES
from iscat_analysis.records import Analysis, Clip, EventView, FloatArray, PosteriorResult, Trace
from iscat_analysis.report.numbers import number
from iscat_analysis.report.plots import CREDIBLE_LEVELS as CREDIBLE_LEVELS
from iscat_analysis.report.plots import (
    DIVERGING,
    figure_of,
    plot_corner,
    plot_event,
    residual_limit,
    trace_length,
    trace_means,
    trace_range,
)
from iscat_analysis.report.plots import credible_shades as credible_shades
from iscat_analysis.report.style import Sketch, Style, display_range
from iscat_analysis.units import count

CORNER_FIGURES = 20
"""Posteriors that are drawn, at most."""

DETAIL_BYTES, FILM_BYTES = 2_000_000, 3_000_000
"""Images, traces and clips of events inside the page, at most, and films; what comes after that is
left out."""

CLIP_MS = 180
"""Time for which a frame of a clip is shown."""

_GREYS = mpl.colormaps["gray"]
_NOTHING = 255  # of a palette: transparent
_SHADES = 48  # of each scale of images and films: noise hides the steps
_CLIP_SHADES = 24  # of a clip, of which a page holds hundreds


class EventDetail(NamedTuple):
    """What the page shows of one event when its row is opened; may be empty."""

    images: str
    scales: str
    trace: Markup
    words: str
    clip: Markup
    sliding: str


# ---- Images and films inside the page ------------------------------------------------------------


def event_details(analysis: Analysis, table: pd.DataFrame) -> dict[int, EventDetail]:
    """Pack what the page shows of the first events, as many as `DETAIL_BYTES` hold."""
    packed: dict[int, EventDetail] = {}
    spent, nothing = 0, (Markup(), "")
    for row, view in views_of_rows(table, analysis.views):
        scale, trace, clip = _Scale.of(view, analysis.scheme), view.trace, view.clip
        told = nothing if trace is None else (trace_svg(trace), trace_words(trace))
        turn = trace.frame if trace is not None else 0
        film = nothing if clip is None else clip_shown(clip, scale.low, scale.high, turn)
        detail = EventDetail(png_of(scale.strip(view), _PALETTE), scale.text, *told, *film)
        spent += sum(map(len, detail))
        if spent > DETAIL_BYTES:
            break
        packed[row] = detail
    return packed


def films_shown(analysis: Analysis, folder: Path | None = None) -> Iterator[dict[str, Any]]:
    """Make the films of the page, as many as `FILM_BYTES` hold, with what is said of each."""
    spent = 0
    for film in analysis.films:
        scale = _Scale.of(film, analysis.scheme)
        pictures = [Image.fromarray(frame) for frame in _COLOURS[scale.strip(film)]]
        moving = _animated(pictures)
        spent += len(moving)
        if spent > FILM_BYTES:
            break
        if folder is not None:
            (folder / f"track_{film.track:04d}.webp").write_bytes(moving)
        still = io.BytesIO()
        pictures[0].save(still, "PNG")
        wide, tall = pictures[0].size
        scales = f"frames {film.frames[0]} to {film.frames[-1]}; {scale.text}"
        about = {"track": film.track, "why": film.why, "scales": scales}
        shown = {"film": _base64(moving), "still": _base64(still.getvalue())}
        yield {**about, **shown, "width": wide, "height": tall}


@dataclass(frozen=True)
class _Scale:
    """Greys of data and model, and colours of the residual, of one event or film."""

    low: float
    high: float
    limit: float
    unit: str

    @classmethod
    def of(cls, view: Any, scheme: str) -> _Scale:
        """Choose the scales of images, or of films, with their model and residual."""
        low, high = display_range([view.contrast, view.model], scheme)
        return cls(low, high, residual_limit(view.residual), SCHEMES[scheme].image_unit)

    @property
    def text(self) -> str:
        """What the shades mean."""
        greys = f"{self.unit} {number(self.low)} to {number(self.high)}"
        return f"{greys}; residual ±{self.limit:g} σ"

    def strip(self, view: Any) -> NDArray[np.uint8]:
        """Put data, model and residual side by side, as shades of `_PALETTE`."""
        span = self.high - self.low
        greys = ((part - self.low) / span for part in (view.contrast, view.model))
        data, model = (shaded(grey, _SHADES) for grey in greys)
        residual = shaded((view.residual / self.limit + 1) / 2, _SHADES, _SHADES)
        gap = np.full((*data.shape[:-1], 2), _NOTHING, np.uint8)
        return np.concatenate([data, gap, model, gap, residual], axis=-1)


def shaded(values: NDArray[np.floating[Any]], shades: int, first: int = 0) -> NDArray[np.uint8]:
    """Give every pixel of an image the number of its shade, for `png_of`."""
    inside = np.rint(np.clip(np.nan_to_num(values), 0, 1) * (shades - 1)) + first
    return np.where(np.isfinite(values), inside, _NOTHING).astype(np.uint8)


def _ramp(*maps: Any, shades: int) -> NDArray[np.uint8]:
    """Make a palette, shape (n, 3), of so many shades of each colour map."""
    colours = np.concatenate([colours(np.linspace(0, 1, shades)) for colours in maps])
    return np.asarray(np.rint(255 * colours[:, :3]), dtype=np.uint8)


_PALETTE = _ramp(_GREYS, DIVERGING, shades=_SHADES)
_COLOURS = np.full((256, 3), 127, np.uint8)
_COLOURS[: len(_PALETTE)] = _PALETTE


def png_of(shades: NDArray[np.uint8], palette: NDArray[np.uint8]) -> str:
    """Write a small PNG file.

    Shapes: `shades` (y, x), `palette` (n, 3).
    """
    image = Image.fromarray(np.minimum(shades, len(palette)).astype(np.uint8))
    image.putpalette([*palette.ravel().tolist(), 127, 127, 127])
    buffer = io.BytesIO()
    # noise never repeats itself: looking for that takes four times as long, and saves nothing
    image.save(buffer, "PNG", transparency=len(palette), compress_type=Image.HUFFMAN_ONLY)
    return _base64(buffer.getvalue())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def clip_shown(clip: Clip, low: float, high: float, still: int) -> tuple[Markup, str]:
    """Make the film of a clip: its images below each other, of which a page shows one at a time."""
    number, rows, columns = clip.contrast.shape
    grey = shaded((clip.contrast - low) / (high - low), _CLIP_SHADES).reshape(-1, columns)
    image = png_of(grey, _ramp(_GREYS, shades=_CLIP_SHADES))
    at = int(np.argmin(np.abs(np.array(clip.frames) - still)))
    film = Markup(
        f'<div class="clip" style="aspect-ratio:{columns}/{rows}"><img '
        f'style="animation:slide {CLIP_MS * number}ms steps({number}) infinite;'
        f'--still:{-100 * at / number:.4g}%" alt="Ratiometric clip around the step" '
        f'src="data:image/png;base64,{image}"></div>'
    )
    frames = count(clip.window_frames, "frame")
    return film, (
        f"{frames} over the {clip.window_frames} before them, from frame {clip.frames[0]} on to "
        f"{clip.frames[-1]}; grey as in the data"
    )


def _animated(pictures: list[Image.Image]) -> bytes:
    buffer, kind = io.BytesIO(), WebPImagePlugin.WebPImageFile  # else all kinds are loaded for it
    how: Style = {"lossless": True, "quality": 60, "method": 4, "minimize_size": False}
    loop: Style = {"save_all": True, "append_images": pictures[1:], "duration": 120, "loop": 0}
    pictures[0].save(buffer, kind.format, **loop, **how)
    return buffer.getvalue()


def views_of_rows(table: pd.DataFrame, views: Sequence[EventView]) -> list[tuple[int, EventView]]:
    """Assign views to rows: by position where the numbers agree, else by number."""
    numbers = table["event"].tolist()
    if [view.event for view in views] == numbers:
        return list(enumerate(views))
    first = {event: row for row, event in reversed(list(enumerate(numbers)))}
    return [(first[view.event], view) for view in views if view.event in first]


# ---- Figures of the page ------------------------------------------------------------------------


def event_figures(analysis: Analysis, most: int) -> Iterator[Sketch]:
    """Name the images of the first events, and what draws them."""
    for view in analysis.views[:most]:
        yield f"event_{view.event:04d}", partial(_event, view, analysis)


def _event(view: EventView, analysis: Analysis) -> Figure:
    """Draw an event."""
    return figure_of(plot_event(view, analysis.scheme, analysis.pixel_size_nm))


def corner_figures(analysis: Analysis) -> Iterator[Sketch]:
    """Name the first converged posteriors, and what draws them."""
    sampled = [
        (view.event, view.posterior)
        for view in analysis.views
        if view.posterior is not None and view.posterior.converged
    ]
    for event, posterior in sampled[:CORNER_FIGURES]:
        yield f"corner_{event:04d}", partial(_corner, posterior, event)


def _corner(posterior: PosteriorResult, event: int) -> Figure:
    """Draw a posterior."""
    return figure_of(plot_corner(posterior, event))


# ---- Traces --------------------------------------------------------------------------------------


def trace_svg(trace: Trace) -> Markup:
    """Draw a trace for the page; its colours follow the theme."""
    low, high = trace_range(trace)
    frames, fine = len(trace.contrast), 1000  # steps of the curve's scale
    margin, upper, edge = 46, 24, 474  # left and above of the curve, and where it ends
    across, down, bottom = edge - margin, 128, 169

    def left(frame: float) -> float:
        return round(margin + (frame - trace.first) / frames * across, 1)

    def top(value: float) -> float:
        return round(upper + (high - value) / (high - low) * down, 1)

    parts = []
    for value in _ticks(low, high, 4):
        label = f"{1e3 * value:.3g}".replace("-", "−")
        y = top(value)
        parts.append(f'<path class="grid" d="M{margin} {y}H{edge}"/>')
        parts.append(f'<text x="{margin - 6}" y="{y + 4:g}" text-anchor="end">{label}</text>')
    for value in _ticks(trace.first, trace.first + frames, 6):
        x = left(value)
        if value == int(value) and x < edge - 52:
            parts.append(f'<text x="{x}" y="{bottom}" text-anchor="middle">{int(value)}</text>')
    parts.append(f'<text x="{margin}" y="14">contrast [10⁻³]</text>')
    parts.append(f'<text x="{edge}" y="{bottom}" text-anchor="end">frame</text>')
    begin = left(max(trace.frame - trace.half_width, trace.first))
    end = left(min(trace.frame + trace.half_width, trace.first + frames))
    parts.append(
        f'<rect class="when" x="{begin}" y="{upper}" width="{max(end - begin, 1.5):.1f}" '
        f'height="{down}"/>'
    )
    scale = f"matrix({across / frames:.5g} 0 0 {down / fine:.5g} {margin} {upper})"
    levels = np.rint(np.clip((high - trace.contrast) / (high - low), 0, 1) * fine)
    centres, means = trace_means(trace)
    shown = np.rint((high - means) / (high - low) * fine)
    dots = "".join(f"M{x:g} {y:.0f}h0" for x, y in zip(centres - trace.first, shown, strict=True))
    parts.append(
        f'<g transform="{scale}"><path class="frames" d="{_curve(levels)}"/>'
        f'<path class="means" d="{dots}"/></g>'
    )
    begin, turn, end = (left(frame) for frame in (trace.used[0], trace.frame, trace.used[1]))
    before, after = top(trace.before), top(trace.after)
    parts.append(f'<path class="step" d="M{begin} {before}H{turn}V{after}H{end}"/>')
    label = f"Contrast against frame, and the fitted step at frame {trace.frame}"
    return Markup(
        f'<svg class="trace" viewBox="0 0 480 178" role="img" aria-label="{label}">'
        f"{''.join(parts)}</svg>"
    )  # numbers alone come from outside


def trace_words(trace: Trace) -> str:
    """Say what a drawn trace shows."""
    when = f"frame {trace.frame}" + (f" ± {trace.half_width}" if trace.half_width else "")
    return (
        f"Contrast of each frame by the matched filter; dots: means of "
        f"{count(trace_length(trace), 'frame')}. Line: the fitted step, at {when}, over the frames "
        f"that were used. Noise expected of a frame: {number(1e3 * trace.sigma, 2)}×10⁻³."
    )


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Give round values within a range."""
    values = MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(low, high)
    return [float(value) for value in values if low <= value <= high]


def _curve(levels: FloatArray) -> str:
    """Write a path of one step to the right per value; a missing value interrupts it."""
    text = []
    known = np.flatnonzero(np.isfinite(levels))
    for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        values = levels[run].astype(int)
        steps = "".join(f" 1 {step}" for step in np.diff(values).tolist())
        if run.size:
            text.append(f"M{run[0] + 0.5:g} {values[0]}l{steps[1:].replace(' -', '-')}")
    return "".join(text)
