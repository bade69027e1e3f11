"""Contrast of an event against frame, with its fitted step: for the page, and for a figure."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from iscat_analysis.records import FloatArray, Trace
from iscat_analysis.report.numbers import number
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION
from iscat_analysis.units import count

MEANS = 40
"""Means of frames that are shown as dots, about."""

_WIDTH, _HEIGHT = 480, 178
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 6, 24, 26  # around the curve
_WORD = 52  # at the end of the axis of frames, for its name
_FINE = 1000  # steps of the curve's scale
_OUTSIDE = 0.005  # share of frames on either side that the scale may leave out


def trace_svg(trace: Trace) -> Markup:
    """Draw a trace for the page; its colours follow the theme."""
    low, high = _range(trace)
    frames = len(trace.contrast)
    across, down = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def left(frame: float) -> float:
        return round(_LEFT + (frame - trace.first) / frames * across, 1)

    def top(value: float) -> float:
        return round(_TOP + (high - value) / (high - low) * down, 1)

    parts, bottom = [], _HEIGHT - _BOTTOM + 17
    for value in _ticks(low, high, 4):
        label = f"{1e3 * value:.3g}".replace("-", "−")
        y = top(value)
        parts.append(f'<path class="grid" d="M{_LEFT} {y}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:g}" text-anchor="end">{label}</text>')
    for value in _ticks(trace.first, trace.first + frames, 6):
        x = left(value)
        if value == int(value) and x < _WIDTH - _RIGHT - _WORD:
            parts.append(f'<text x="{x}" y="{bottom}" text-anchor="middle">{int(value)}</text>')
    parts.append(f'<text x="{_LEFT}" y="14">contrast [10⁻³]</text>')
    parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{bottom}" text-anchor="end">frame</text>')
    begin = left(max(trace.frame - trace.half_width, trace.first))
    end = left(min(trace.frame + trace.half_width, trace.first + frames))
    parts.append(
        f'<rect class="when" x="{begin}" y="{_TOP}" width="{max(end - begin, 1.5):.1f}" '
        f'height="{down}"/>'
    )
    scale = f"matrix({across / frames:.5g} 0 0 {down / _FINE:.5g} {_LEFT} {_TOP})"
    levels = np.rint(np.clip((high - trace.contrast) / (high - low), 0, 1) * _FINE)
    centres, means = _means(trace)
    shown = np.rint((high - means) / (high - low) * _FINE)
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
        f'<svg class="trace" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">'
        f"{''.join(parts)}</svg>"
    )  # numbers alone come from outside


def trace_words(trace: Trace) -> str:
    """Say what a drawn trace shows."""
    when = f"frame {trace.frame}" + (f" ± {trace.half_width}" if trace.half_width else "")
    return (
        f"Contrast of each frame by the matched filter; dots: means of "
        f"{count(_length(trace), 'frame')}. Line: the fitted step, at {when}, over the frames that "
        f"were used. Noise expected of a frame: {number(1e3 * trace.sigma, 2)}×10⁻³."
    )


def draw_trace(axes: Axes, trace: Trace) -> None:
    """Draw a trace."""
    low, high = _range(trace)
    frames = trace.first + np.arange(len(trace.contrast))
    centres, means = _means(trace)
    axes.axvspan(
        trace.frame - max(trace.half_width, 0.5), trace.frame + max(trace.half_width, 0.5),
        color=BLUE, alpha=0.18, lw=0,
    )  # fmt: skip
    axes.plot(frames + 0.5, 1e3 * trace.contrast, color=GREY, lw=0.6, alpha=0.6)
    axes.plot(centres, 1e3 * means, ".", color=INK, ms=3.5)
    begin, end = trace.used
    axes.plot(
        [begin, trace.frame, trace.frame, end],
        [1e3 * level for level in (trace.before, trace.before, trace.after, trace.after)],
        color=VERMILLION,
        lw=1.6,
    )
    axes.set(
        xlim=(frames[0], frames[-1] + 1),
        ylim=(1e3 * low, 1e3 * high),
        xlabel="frame",
        ylabel="contrast [10⁻³]",
    )


def _range(trace: Trace) -> tuple[float, float]:
    """Give the scale: both levels and nearly all frames, and always a proper interval."""
    known = trace.contrast[np.isfinite(trace.contrast)]
    ends = np.quantile(known, [_OUTSIDE, 1 - _OUTSIDE]) if known.size else np.zeros(2)
    low = min(float(ends[0]), trace.before, trace.after)
    high = max(float(ends[1]), trace.before, trace.after)
    margin = 0.04 * (high - low) or 1e-6
    return low - margin, high + margin


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Give round values within a range."""
    values = MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(low, high)
    return [float(value) for value in values if low <= value <= high]


def _length(trace: Trace) -> int:
    """Frames of a mean."""
    return max(1, round(len(trace.contrast) / MEANS))


def _means(trace: Trace) -> tuple[FloatArray, FloatArray]:
    """Average frames, none across the step; where they lie [frames], and their means."""
    length = _length(trace)
    start = (trace.frame - trace.first) % length
    number = (len(trace.contrast) - start) // length
    parts = trace.contrast[start : start + number * length].reshape(number, length)
    known = np.isfinite(parts)
    some = known.any(axis=1)
    sums = np.where(known, parts, 0.0).sum(axis=1)[some]
    centres = trace.first + start + (np.flatnonzero(some) + 0.5) * length
    means: FloatArray = sums / known.sum(axis=1)[some]
    return np.asarray(centres), means


def _curve(levels: FloatArray) -> str:
    """Write a path of one step to the right per value; a missing value interrupts it."""
    text = []
    known = np.flatnonzero(np.isfinite(levels))
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if known.size else []
    for run in runs:
        values = levels[run].astype(int)
        steps = "".join(f" 1 {step}" for step in np.diff(values).tolist())
        text.append(f"M{run[0] + 0.5:g} {values[0]}l{steps[1:].replace(' -', '-')}")
    return "".join(text)
