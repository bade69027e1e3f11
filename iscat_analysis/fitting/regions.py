"""Regions of a field, and the likelihood of their counts before and after."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.camera.background import smooth_background
from iscat_analysis.fitting.context import AnalysisContext, is_counted
from iscat_analysis.inference.counts import MEAN, choose_noise, counts_likelihood
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.collected import photons_per_intensity
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.pieces.setups import darkfield_photons
from iscat_analysis.records import Candidate, FloatArray, Windows


@dataclass(frozen=True)
class Region:
    """Half-open ranges of full-frame pixels."""

    rows: tuple[int, int]
    columns: tuple[int, int]

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the region in a full frame."""
        return slice(*self.rows), slice(*self.columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns it has."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


def region_around(side: int, shape: tuple[int, ...], start: Candidate) -> Region:
    """Place the fitted square around a position."""
    sides = []
    for centre, size in zip((start.y_px, start.x_px), shape, strict=True):
        first = round(centre - (side - 1) / 2)
        sides.append((max(first, 0), min(first + side, size)))
    return Region(sides[0], sides[1])


def field_likelihood(context: AnalysisContext, windows: Windows) -> Likelihood:
    """Likelihood of the whole field."""
    rows, columns = windows.after_e.shape
    return region_likelihood(context, windows, Region((0, rows), (0, columns)), None)


def contrast_image(context: AnalysisContext, windows: Windows) -> FloatArray:
    """Contrast of the frames after over those before.

    Shapes: result (y, x).
    """
    if context.additive:
        return windows.after_e - windows.power_ratio * windows.before_e
    return field_likelihood(context, windows).measured_signal()


def search_likelihood(
    context: AnalysisContext, windows: Windows, explained: FloatArray
) -> Likelihood:
    """Likelihood of the whole field with weights that no particle may have made.

    Where the counts are few, weights made of those before alone are large where these are low by
    chance, and there the particles seem to have landed.  Counts before and after together say as
    much of the noise and nothing of the change.

    Shapes: `explained` (y, x).
    """
    whole = field_likelihood(context, windows)
    if not context.additive or not windows.n_before:
        return whole
    counts, level, scale, extra = whole.data
    ratio = windows.power_ratio
    read = windows.read_variance_after_e2, windows.read_variance_before_e2
    both = windows.before_e + (counts - extra) - scale * explained
    noise = (read[0] + read[1]) / (1 + ratio) ** 2
    steady = smooth_background(both / (1 + ratio), noise, windows.masked)
    factor = context.background_variance
    variance = steady * ratio * (1 + ratio * factor) + read[0] + ratio**2 * read[1]
    other = np.where(whole.used, variance - level, 0.0)
    return replace(whole, data=np.stack([counts - extra + other, level, scale, other]))


def region_likelihood(
    context: AnalysisContext, windows: Windows, region: Region, others: FloatArray | None
) -> Likelihood:
    """Likelihood of a region, with the signal of other particles as part of its background.

    Shapes: `others` (rows, columns).
    """
    cut = region.slices
    config = context.config
    grid = PixelGrid.region(region.rows, region.columns, context.pixel_nm)
    model = context.model if grid.diagonal_nm <= context.model.reach_nm else context.wide
    before, after, masked = windows.before_e[cut], windows.after_e[cut], windows.masked[cut]
    return counts_likelihood(
        model, grid, before, after, windows.power_ratio,
        background=context.background_variance,
        noise=choose_noise(
            config.fit.likelihood,
            interferes=config.optics.scheme != "darkfield",
            counted=is_counted(config),
        ),
        scale_e=photons_scale(context, windows) if context.additive else None,
        others=others,
        read_variance_before_e2=windows.read_variance_before_e2[cut],
        read_variance_after_e2=windows.read_variance_after_e2[cut],
        masked=masked,
    )  # fmt: skip


def noise_cumulants(
    context: AnalysisContext, windows: Windows, likelihood: Likelihood
) -> tuple[FloatArray, FloatArray] | None:
    """Third and fourth cumulants of the counts against their background.

    Notes
    -----
    Of a Poisson count μ every cumulant is μ; of a − ρ b the k-th is μ_a + (−ρ)ᵏ μ_b.  Read noise
    has none, and a median of frames has hardly any.
    """
    if not context.additive:
        return None
    _, level, _, extra = likelihood.data
    factor = context.background_variance
    ratio = windows.power_ratio
    read = windows.read_variance_after_e2 + ratio**2 * windows.read_variance_before_e2
    light = np.maximum(level + extra - read, 0.0) / (1 + ratio * factor)
    counted = ratio if factor == MEAN else 0.0
    return light * (1 - counted**2), light * (1 + counted**3)


def photons_scale(context: AnalysisContext, windows: Windows) -> float:
    """Scale of the signal in dark field."""
    photons = darkfield_photons(context.config.particle)
    per_frame = photons_per_intensity(context.model, photons, context.pixel_nm)
    return per_frame * windows.power_ratio * max(windows.n_before, 1)
