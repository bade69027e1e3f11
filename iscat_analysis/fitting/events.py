"""Regions of a field, the likelihood of their counts, and the record of what was fitted there.

A candidate (`Candidate`, or the `Peak` and `Step` of a landing movie) becomes `Fitted`, and an
`Event` when its neighbours are known too.  An `Event` holds all that its row in ``fits.csv`` and
its images need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import gaussian_filter

from iscat_analysis.camera import smooth_background
from iscat_analysis.findings import Finding
from iscat_analysis.findings.particles import INDEX_UNKNOWN
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.common_size import fit_index
from iscat_analysis.inference.counts import MEAN, choose_noise, counts_likelihood
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.posterior import Prior, sample_posterior
from iscat_analysis.inference.recognition import may_be_large, recognised
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.model import photons_per_intensity
from iscat_analysis.optics.sized import SeatedModel
from iscat_analysis.pieces.counts import darkfield_photons
from iscat_analysis.pieces.regions import saturated_near
from iscat_analysis.records import (
    Candidate,
    FitResult,
    FloatArray,
    PosteriorResult,
    Status,
    Windows,
    verdict,
)
from iscat_analysis.search.peaks import Described
from iscat_analysis.units import count


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
    near = grid.diagonal_nm <= context.model.reach_nm
    middle = (float(np.mean(grid.x_nm)), float(np.mean(grid.y_nm)))
    model = context.model_at(*middle) if near else context.wide
    before, after, masked = windows.before_e[cut], windows.after_e[cut], windows.masked[cut]
    reads = windows.read_variance_before_e2[cut], windows.read_variance_after_e2[cut]
    return counts_likelihood(
        model, grid, before, after, windows.power_ratio,
        background=context.background_variance,
        noise=choose_noise(
            config.fit.likelihood,
            interferes=config.optics.interferes,
            counted=config.background.is_counted,
        ),
        scale_e=photons_scale(context, windows) if context.additive else None,
        others=others,
        read_variances_e2=reads,
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


PlaceAndMass = tuple[float, float, float, float]
"""x, y, z [nm] and mass [kDa]."""


@dataclass(frozen=True)
class Fitted:
    """One fitted particle: where it was searched, what was fitted, and the likelihood used."""

    region: Region
    fit: FitResult
    likelihood: Likelihood

    @property
    def candidate(self) -> Candidate:
        """The estimate, in the form from which another fit starts."""
        pixel = self.likelihood.grid.pixel_nm
        return Candidate(
            self.fit.x_nm / pixel, self.fit.y_nm / pixel, self.fit.z_nm, self.fit.mass_kda, self.snr
        )

    @property
    def place(self) -> PlaceAndMass:
        """Position [nm] and mass [kDa]."""
        return self.fit.x_nm, self.fit.y_nm, self.fit.z_nm, self.fit.mass_kda

    @property
    def sphere(self) -> SeatedModel | None:
        """The model of the sphere that it is; None for a dipole."""
        model = self.likelihood.model
        return model if isinstance(model, SeatedModel) else None

    @property
    def snr(self) -> float:
        """Signal-to-noise ratio √(2 Δℓ), Δℓ against the model without the particle."""
        return self.fit.snr

    @property
    def described(self) -> Described:
        """What the fit explains, and its misfit."""
        return Described.of(self.snr, self.fit.chi2_reduced, self.likelihood.n_pixels)


@dataclass(frozen=True)
class Event(Fitted):
    """One particle, fitted and judged."""

    windows: Windows
    flags: tuple[Status, ...]
    frame: int
    n_before: int
    n_after: int
    sign: int = 1
    half_width: int | None = None
    rise: int = 0


def fit_flags(
    context: AnalysisContext,
    fitted: Fitted,
    windows: Windows,
    *,
    sidelobe: bool,
    too_close: bool,
    changing: bool = False,
) -> tuple[Status, ...]:
    """Join the flags of a fit with those of its neighbourhood."""
    fit, region = fitted.fit, fitted.region
    corner = region.rows[0], region.columns[0]
    saturated = saturated_near(
        windows.saturated, fit.x_nm, fit.y_nm, context.pixel_nm, corner=corner
    )
    possible = (
        (sidelobe, Status.SIDELOBE),
        (saturated, Status.SATURATED),
        (too_close, Status.TOO_CLOSE),
        (changing, Status.CHANGING),
    )
    return verdict([*fit.flags, *(flag for true, flag in possible if true)])[1]


def standing_out(events: Sequence[Event]) -> Sequence[Event]:
    """Select the events without a flag."""
    return [event for event in events if not event.flags] or events


def posterior_of(
    context: AnalysisContext,
    event: Event,
    number: int,
    *,
    stopped: Callable[[], bool] = lambda: False,
) -> PosteriorResult:
    """Sample the posterior of an event."""
    settings = context.config.posterior
    return sample_posterior(
        event.likelihood,
        event.fit,
        walkers=settings.walkers,
        steps=settings.steps,
        seed=context.config.compute.seed + number,
        prior=Prior(settings.priors),
        stopped=stopped,
    )


Told = tuple[float, float]
"""q of d^q (n − n_s), which a picture tells best, and its relative standard error."""


def with_index(context: AnalysisContext, event: Event) -> tuple[Event, Told | None]:
    """Fit the index of a sphere as well, if wanted; give what the picture tells if that is less."""
    config = context.config.fit
    if not config.index:
        return event, None
    own = fit_index(event.likelihood, event.fit, config.z_range_nm)
    flags = verdict([*own.fit.flags, *(set(event.flags) - set(event.fit.flags))])[1]
    told = None if own.is_told else (own.power, own.sigma)
    return replace(event, likelihood=own.likelihood, fit=own.fit, flags=flags), told


def index_finding(
    context: AnalysisContext, untold: Sequence[Told], missing: int, total: int, *, where: str = ""
) -> Finding | None:
    """Tell what images show that do not tell diameter and index apart."""
    if not missing:
        return None
    known = [told for told in untold if math.isfinite(told[1])]
    best = ""
    if known:
        power, sigma = np.median(known, axis=0).tolist()
        n_sample = context.model.optics.n_sample
        best = f": they tell d^{power:.2g} (n − {n_sample:g}) to {100 * sigma:.2g} %"
    spheres = count(total, "sphere")
    return INDEX_UNKNOWN({"number": missing, "spheres": spheres, "best": best}, where=where)


AnyFitted = TypeVar("AnyFitted", bound=Fitted)

IN_VAIN = 8
"""Particles, the brightest first, after which no others are tried if none is a sphere."""

BRIGHT_SNR = 50.0
"""Signal-to-noise ratio below which a sphere differs too little from a dipole to be seen."""


def with_spheres(
    context: AnalysisContext, events: Sequence[AnyFitted], pool: ThreadPoolExecutor, *, level: bool
) -> list[AnyFitted]:
    """Fit spheres where dipoles fail.

    Where the microscope is wrong, all fits are poor and no sphere describes any.
    """

    def tried(event: AnyFitted) -> AnyFitted | None:
        models = context.spheres_of(event.likelihood.model)
        z_range = context.config.fit.z_range_nm
        found = recognised(event.likelihood, event.fit, models, z_range, level=level)
        return None if found is None else replace(event, likelihood=found[0], fit=found[1])

    out = [*events]
    doubtful = [
        index
        for index, event in enumerate(events)
        if not event.sphere
        and may_be_large(event.likelihood, event.fit)
        and context.spheres_of(event.likelihood.model)
    ]
    doubtful.sort(key=lambda index: -events[index].snr)
    for first in range(0, len(doubtful), IN_VAIN):
        batch = doubtful[first : first + IN_VAIN]
        found = list(pool.map(tried, [events[i] for i in batch]))
        for index, event in zip(batch, found, strict=True):
            if event is not None:
                out[index] = event
        if not any(found):
            break
    return out


def brightest_place(
    likelihood: Likelihood,
    explained: FloatArray,
    seen: Sequence[tuple[float, float]],
    apart_px: float,
) -> tuple[float, float] | None:
    """Find where the light of a field changes most, column and row, if a misfit could be seen.

    Energy is averaged over a spot of the size of the diffraction limit, so that a ring counts as
    one place.

    Shapes: `explained` (y, x).
    """
    grid, optics = likelihood.grid, likelihood.model.optics
    left = np.nan_to_num(likelihood.measured_signal() - explained)
    excess = np.where(likelihood.used, left**2 * likelihood.signal_information(explained) - 1, 0.0)
    spot_px = optics.wavelength_nm / optics.na / grid.pixel_nm
    energy = gaussian_filter(excess, spot_px) * (2 * math.pi * spot_px**2)
    rows, columns = np.indices(energy.shape)
    for x, y in seen:
        energy[np.hypot(rows - y, columns - x) < apart_px] = 0.0
    row, column = np.unravel_index(np.argmax(energy), energy.shape)
    if energy[row, column] < BRIGHT_SNR**2:
        return None
    return float(column), float(row)
