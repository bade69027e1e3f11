"""Small films, looped: tracks as data, model and residual; landings as ratiometric clips."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image, WebPImagePlugin

from iscat_analysis.records import Analysis, Clip, Film, FloatArray
from iscat_analysis.report.numbers import number
from iscat_analysis.report.scales import (
    DIVERGING,
    GREYS,
    display_range,
    png_of,
    residual_limit,
    shaded,
)
from iscat_analysis.units import count

FILM_BYTES = 3_000_000
"""Films inside the page, at most; those after that are left out."""

FRAME_MS = 120
"""Time for which a frame is shown."""

CLIP_MS = 180
"""The same of a clip."""

_GAP = 2  # pixels between the three pictures
_SHADES = 48  # of each scale: fewer make smaller films, and noise hides the steps
_CLIP_SHADES = 24  # of a clip, of which a page holds hundreds


@dataclass(frozen=True)
class FilmShown:
    """One film as the page shows it."""

    track: int
    why: str
    scales: str
    film: str
    still: str
    width: int
    height: int


def films_shown(analysis: Analysis, folder: Path | None = None) -> Iterator[FilmShown]:
    """Make the films of the page, as many as `FILM_BYTES` hold."""
    spent = 0
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    for film in analysis.films:
        low, high = display_range([film.contrast, film.model], analysis.scheme)
        limit = residual_limit(film.residual)
        pictures = [Image.fromarray(frame) for frame in _frames(film, low, high, limit)]
        moving = _animated(pictures)
        spent += len(moving)
        if spent > FILM_BYTES:
            break
        if folder is not None:
            (folder / f"track_{film.track:04d}.webp").write_bytes(moving)
        still = io.BytesIO()
        pictures[0].save(still, "PNG")
        yield FilmShown(
            film.track,
            film.why,
            f"frames {film.frames[0]} to {film.frames[-1]}; {unit} {number(low)} to "
            f"{number(high)}; residual ±{limit:g} σ",
            base64.b64encode(moving).decode("ascii"),
            base64.b64encode(still.getvalue()).decode("ascii"),
            *pictures[0].size,
        )


def clip_shown(clip: Clip, low: float, high: float, still: int) -> tuple[Markup, str]:
    """Make the film of a clip: its images below each other, of which a page shows one at a time."""
    number, rows, columns = clip.contrast.shape
    grey = shaded((clip.contrast - low) / (high - low), _CLIP_SHADES).reshape(-1, columns)
    image = png_of(grey, GREYS(np.linspace(0, 1, _CLIP_SHADES)))
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


def _frames(film: Film, low: float, high: float, limit: float) -> NDArray[np.uint8]:
    """Colour data, model and residual side by side, shape (t, y, 3 x + gaps, 3)."""
    gap = np.zeros((*film.contrast.shape[:2], _GAP, 4))
    strip = [
        GREYS(_stepped((film.contrast - low) / (high - low))),
        gap,
        GREYS(_stepped((film.model - low) / (high - low))),
        gap,
        DIVERGING(_stepped((film.residual / limit + 1) / 2)),
    ]
    return np.asarray(255 * np.concatenate(strip, axis=2)[..., :3], dtype=np.uint8)


def _stepped(values: FloatArray) -> FloatArray:
    """Round to a few shades; what is masked has the middle one."""
    inside = np.clip(np.nan_to_num(values, nan=0.5), 0.0, 1.0)
    return np.asarray(np.round(inside * (_SHADES - 1)) / (_SHADES - 1))


def _animated(pictures: list[Image.Image]) -> bytes:
    buffer, kind = io.BytesIO(), WebPImagePlugin.WebPImageFile  # else all kinds are loaded for it
    pictures[0].save(
        buffer, kind.format, save_all=True, append_images=pictures[1:], duration=FRAME_MS, loop=0,
        lossless=True, quality=60, method=4, minimize_size=False,
    )  # fmt: skip
    return buffer.getvalue()
