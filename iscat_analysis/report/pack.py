"""Images and posteriors small enough to travel inside a page: bytes, shades, histograms."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.records import Analysis, EventView, FloatArray, PosteriorResult

IMAGE_BYTES = 4_000_000
"""Event images embedded in the page, at most; the events after that are table rows only."""

POSTERIOR_BYTES = 1_000_000
"""Posterior densities embedded in the page, at most."""

FIELD_PIXELS = 640
"""Longer side of the embedded image of the field; larger ones are averaged down [px]."""

PAGE_DIGITS = 7
"""Significant digits of table values in the page."""

RESIDUAL_LIMIT = 4.0
"""Residual images span at least ± this many standard deviations."""

CREDIBLE_LEVELS = (0.95, 0.75, 0.5, 0.25)
"""Shades of a posterior's joint densities: the share of the probability inside each."""

POSTERIOR_BINS = 24
"""Bins per axis of an embedded posterior."""


def views_of_rows(table: pd.DataFrame, views: Sequence[EventView]) -> list[tuple[int, EventView]]:
    """Pair each view with its row: by position where the numbers agree, else by number.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    views : sequence of EventView
        In any order; one whose event is not in the table is left out.

    Returns
    -------
    list of (int, EventView)
        Row and view.
    """
    numbers = table["event"].tolist()
    if [view.event for view in views] == numbers:
        return list(enumerate(views))
    first: dict[int, int] = {}
    for row, event in enumerate(numbers):
        first.setdefault(event, row)
    return [(first[view.event], view) for view in views if view.event in first]


def quantise(image: FloatArray, low: float, high: float) -> NDArray[np.uint8]:
    """Squeeze an image into bytes: 0 where it is not finite, else 1 … 255 from `low` to `high`.

    Parameters
    ----------
    image : ndarray, shape (y, x)
        Any unit.
    low, high : float
        Range, in the same unit; values outside are clipped.

    Returns
    -------
    ndarray of uint8, shape (y, x)
        The bytes.
    """
    image = np.asarray(image, float)
    finite = np.isfinite(image)
    scaled = (np.where(finite, image, low) - low) / (high - low)
    levels = 1 + np.round(254 * np.clip(scaled, 0, 1))
    return np.where(finite, levels, 0).astype(np.uint8)


def _base64(image: NDArray[np.uint8]) -> str:
    return base64.b64encode(image.tobytes()).decode("ascii")


def display_range(images: Sequence[FloatArray], scheme: str) -> tuple[float, float]:
    """Choose the grey scale that images share.

    Parameters
    ----------
    images : sequence of ndarray
        Contrast (dark field: photoelectrons).
    scheme : str
        As in `Analysis`.

    Returns
    -------
    float, float
        Symmetric about zero for contrast, from the lowest to the highest in dark field; always a
        proper interval.
    """
    values = np.concatenate([np.ravel(image) for image in images]) if images else np.zeros(1)
    values = values[np.isfinite(values)]
    if not values.size:
        return -1.0, 1.0
    if scheme == "darkfield":
        low, high = (float(v) for v in np.quantile(values, [0.002, 0.999]))
        return (low, high) if high > low else (low, low + 1.0)
    limit = float(np.quantile(np.abs(values), 0.998))
    return (-limit, limit) if limit > 0 else (-1.0, 1.0)


def residual_limit(residual: FloatArray) -> float:
    """Choose the range of a residual image: a few standard deviations, more where it needs more.

    Parameters
    ----------
    residual : ndarray, shape (y, x)
        Residual [standard deviations].

    Returns
    -------
    float
        Half the range, at least `RESIDUAL_LIMIT`.
    """
    values = np.abs(residual[np.isfinite(residual)])
    return max(RESIDUAL_LIMIT, math.ceil(np.quantile(values, 0.995))) if values.size else 4.0


def event_images(views: Sequence[tuple[int, EventView]], scheme: str) -> dict[str, Any]:
    """Pack the images of the first events, as many as `IMAGE_BYTES` hold.

    Parameters
    ----------
    views : sequence of (int, EventView)
        Row of the table and what to show of it.
    scheme : str
        As in `Analysis`.

    Returns
    -------
    dict
        By row: first pixel, shape, ranges, and the bytes of data, model and residual.
    """
    images: dict[str, Any] = {}
    spent = 0
    for row, view in views:
        spent += 3 * math.ceil(view.contrast.size / 3) * 4
        if spent > IMAGE_BYTES:
            break
        low, high = display_range([view.contrast, view.model], scheme)
        limit = residual_limit(view.residual)
        images[str(row)] = {
            "y0": view.row_px,
            "x0": view.column_px,
            "h": view.contrast.shape[0],
            "w": view.contrast.shape[1],
            "lo": significant(low),
            "hi": significant(high),
            "limit": limit,
            "data": _base64(quantise(view.contrast, low, high)),
            "model": _base64(quantise(view.model, low, high)),
            "residual": _base64(quantise(view.residual, -limit, limit)),
        }
    return images


def field_image(analysis: Analysis) -> dict[str, Any] | None:
    """Pack the image of the whole field, averaged down to `FIELD_PIXELS`.

    Parameters
    ----------
    analysis : Analysis
        Its `ratio_image` may hold NaN and may be empty.

    Returns
    -------
    dict or None
        Shape, averaging factor, range and bytes; None without an image.
    """
    image = np.asarray(analysis.ratio_image, float)
    if image.ndim != 2 or not image.size:
        return None
    factor = max(1, math.ceil(max(image.shape) / FIELD_PIXELS))
    h, w = (math.ceil(n / factor) for n in image.shape)
    padded = np.full((h * factor, w * factor), np.nan)
    padded[: image.shape[0], : image.shape[1]] = image
    blocks = padded.reshape(h, factor, w, factor).transpose(0, 2, 1, 3).reshape(h, w, -1)
    known = np.isfinite(blocks)
    count = known.sum(axis=2)
    total = np.where(known, blocks, 0.0).sum(axis=2)
    small = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    low, high = display_range([small], analysis.scheme)
    return {
        "h": h,
        "w": w,
        "rows": image.shape[0],
        "columns": image.shape[1],
        "factor": factor,
        "lo": significant(low),
        "hi": significant(high),
        "data": _base64(quantise(small, low, high)),
    }


def posterior_densities(
    views: Sequence[tuple[int, EventView]], table: pd.DataFrame
) -> tuple[dict[str, Any], list[dict[str, Any]], list[bool]]:
    """Pack the converged posteriors, and say why the others are refused.

    Parameters
    ----------
    views : sequence of (int, EventView)
        Row of the table and what to show of it.
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.

    Returns
    -------
    densities : dict
        By row, for the first that `POSTERIOR_BYTES` hold: histograms, shades, quantiles.
    refused : list of dict
        Row, event and message of each chain that did not converge; never a number of it.
    sampled : list of bool
        Which views carry a chain at all.
    """
    densities: dict[str, Any] = {}
    refused: list[dict[str, Any]] = []
    sampled = [view.posterior is not None for _, view in views]
    spent = 0
    for row, view in views:
        if view.posterior is None:
            continue
        if not view.posterior.converged:
            event = int(table["event"].iloc[row])
            refused.append({"row": row, "event": event, "message": view.posterior.message})
            continue
        n = len(view.posterior.names)
        spent += n * (n - 1) // 2 * POSTERIOR_BINS**2 + n * POSTERIOR_BINS * 5 + 400
        if spent <= POSTERIOR_BYTES:
            densities[str(row)] = _density(view.posterior)
    return densities, refused, sampled


def _density(posterior: PosteriorResult) -> dict[str, Any]:
    flat = posterior.samples.reshape(-1, len(posterior.names))
    edges = []
    for values in flat.T:
        low, high = np.quantile(values, [0.001, 0.999])
        pad = 0.05 * (high - low) or 0.5
        edges.append(np.linspace(low - pad, high + pad, POSTERIOR_BINS + 1))
    pairs = {}
    for i in range(len(edges)):
        for j in range(i):
            counts = np.histogram2d(flat[:, i], flat[:, j], bins=[edges[i], edges[j]])[0]
            pairs[f"{i},{j}"] = "".join(credible_shades(counts).ravel().astype(str))
    quantiles = np.quantile(flat, [0.15865, 0.5, 0.84135], axis=0)
    return {
        "names": list(posterior.names),
        "ranges": [[significant(e[0]), significant(e[-1])] for e in edges],
        "bins": POSTERIOR_BINS,
        "counts": [np.histogram(v, bins=e)[0] for v, e in zip(flat.T, edges, strict=True)],
        "pairs": pairs,
        "low": [significant(v) for v in quantiles[0]],
        "median": [significant(v) for v in quantiles[1]],
        "high": [significant(v) for v in quantiles[2]],
        "r_hat": [significant(v) for v in posterior.r_hat],
        "ess": [significant(v) for v in posterior.ess_bulk],
    }


def credible_shades(counts: FloatArray) -> NDArray[np.int64]:
    """Say of each cell of a histogram which of the `CREDIBLE_LEVELS` contain it.

    Parameters
    ----------
    counts : ndarray, any shape
        Samples in each cell.

    Returns
    -------
    ndarray of int, same shape
        0 outside all regions of highest density, `len(CREDIBLE_LEVELS)` in the innermost.
    """
    flat = counts.ravel()
    order = np.argsort(-flat, kind="stable")
    before = np.cumsum(flat[order]) - flat[order]
    total = max(float(flat.sum()), 1.0)
    shades = np.zeros(flat.size, dtype=np.int64)
    for level in CREDIBLE_LEVELS:
        shades[order] += (before < level * total) & (flat[order] > 0)
    return shades.reshape(counts.shape)


def significant(value: float) -> float | None:
    """Cut a number to the digits a page needs.

    Parameters
    ----------
    value : float
        Any.

    Returns
    -------
    float or None
        `PAGE_DIGITS` significant digits; None where it is not finite.
    """
    value = float(value)
    return float(f"{value:.{PAGE_DIGITS}g}") if math.isfinite(value) else None


def rounded(column: pd.Series) -> list[Any]:
    """Cut a column of numbers to the digits a page needs.

    Parameters
    ----------
    column : pandas.Series
        Integers or floats.

    Returns
    -------
    list
        Integers as they are, floats as `significant` leaves them.
    """
    if column.dtype.kind in "iu":
        return [int(value) for value in column]
    return [significant(value) for value in column]
