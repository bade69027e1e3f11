"""Detection and fits over a whole field, in turns.

Fitted signals are subtracted from the image before it is searched again, so that side lobes do not
count as particles and faint neighbours are not lost.  A poor fit hides its neighbours; where these
are the cause of the misfit, candidates near it are fitted together.  Each fit includes the signal
of its neighbours, and the laser power is estimated again over a background without particles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from iscat_analysis.camera import refine_power
from iscat_analysis.fitting.context import SPREAD_NM, AnalysisContext, search_both
from iscat_analysis.fitting.events import (
    IN_VAIN,
    Event,
    Fitted,
    PlaceAndMass,
    Region,
    brightest_place,
    fit_flags,
    noise_cumulants,
    photons_scale,
    region_around,
    region_likelihood,
    search_likelihood,
    with_spheres,
)
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.recognition import may_be_large, refitted
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.sized import SeatedModel
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Candidate,
    FloatArray,
    Progress,
    Status,
    Windows,
    silent,
)
from iscat_analysis.search.peaks import EXCEEDS, EXPLAINS, is_hidden
from iscat_analysis.search.templates import LARGEST_IMAGE, ExcessNoise, find_particles

MAX_ROUNDS = 8
"""Rounds of search; each takes the particles found so far off the image."""

_SWEEPS = 2  # fits of everything with everything else in place, after the last round; at least


def fit_field(
    context: AnalysisContext,
    windows: Windows,
    *,
    starts: Sequence[Candidate] = (),
    excess_noise: ExcessNoise | None = None,
    pool: ThreadPoolExecutor,
    progress: Progress = silent,
) -> tuple[tuple[Event, ...], Windows]:
    """Find and fit every particle in a field."""
    events: list[Fitted] = []
    if not starts:
        events, windows = _large_ones(context, windows, pool)
    fresh, doubtful = list(starts), list[Candidate]()
    for number in range(MAX_ROUNDS):
        progress("detect", number, MAX_ROUNDS)
        if number or not fresh:
            fresh, doubtful = search_field(context, windows, events, excess_noise)
        if not fresh and (number or not starts):
            break
        events = _fit_all(context, windows, [*(e.candidate for e in events), *fresh], events, pool)
        windows = _refined(context, windows, events)
    events, windows = _settled(context, windows, events, pool)
    large = with_spheres(context, events, pool, level=False)
    if any(new.sphere and not old.sphere for new, old in zip(large, events, strict=True)):
        events, windows = _settled(context, windows, large, pool)
    trial = None if starts else _with_concealed(context, windows, events, excess_noise, pool)
    if trial is not None:
        events, windows = trial
        fresh, doubtful = search_field(context, windows, events, excess_noise)
        if fresh:  # what was too faint to be told while its neighbours were not described
            events = _fit_all(
                context, windows, [*(e.candidate for e in events), *fresh], events, pool
            )
            events, windows = _settled(context, windows, events, pool)
            _, doubtful = search_field(context, windows, events, excess_noise)
    # of the threshold: a fit whose final SNR is below it is explained by the others
    least = 0.95 * context.templates.threshold
    kept = [e for e in events if e.snr > least and _wanted(context, e)]
    while 0 < len(kept) < len(events):  # a dropped fit no longer belongs to the others' background
        events = _fit_all(context, windows, [e.candidate for e in kept], kept, pool)
        kept = [e for e in events if e.snr > least and _wanted(context, e)]
    lobes: list[Fitted] = []
    if doubtful and not starts:
        lobes = _fit_all(context, windows, doubtful, kept, pool, first=len(kept))
        lobes = [e for e in lobes if e.snr > least and _wanted(context, e)]
    judged = _judged(context, windows, kept, lobes)
    progress("detect", MAX_ROUNDS, MAX_ROUNDS)
    return tuple(sorted(judged, key=lambda e: (e.fit.y_nm, e.fit.x_nm))), windows


def _large_ones(
    context: AnalysisContext, windows: Windows, pool: ThreadPoolExecutor
) -> tuple[list[Fitted], Windows]:
    """Find spheres before anything else, the brightest first.

    The search for dipoles would take the rings of their images for particles.  A place is where the
    light changes most, whatever the shape of the image.
    """
    found: list[Fitted] = []
    dipoles: list[Fitted] = []  # whose rings are no places of their own
    if not context.spheres_of(context.model):
        return found, windows
    nominal = context.model.material.mass_kda
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    seen: list[tuple[float, float]] = []
    vain = 0
    while vain < IN_VAIN:
        known = [*found, *dipoles]
        explained = context.left(total_signal(context, shape, known))
        whole = search_likelihood(context, windows, explained)
        place = brightest_place(whole, explained, seen, context.roi_px / 4)
        if place is None:
            break
        seen.append(place)
        vain += 1
        starts = [Candidate(*place, 0.0, sign * nominal, 0.0) for sign in (1, -1)]
        either = _fit_all(context, windows, starts, known, pool, first=len(known))
        best = max(either, key=lambda one: one.fit.log_likelihood, default=None)
        if best is None:
            continue
        if not may_be_large(best.likelihood, best.fit):
            dipoles.append(best)
            continue
        (large,) = with_spheres(context, [best], pool, level=False)
        if large.sphere:
            vain = 0
        if large.sphere or _chi2_left(large) < EXPLAINS * large.snr**2:
            found, windows = _settled(context, windows, [*found, large], pool)
    return found, windows


def _settled(
    context: AnalysisContext, windows: Windows, events: list[Fitted], pool: ThreadPoolExecutor
) -> tuple[list[Fitted], Windows]:
    """Fit all particles in turns, until fits near each other hardly change."""
    # two fits that share the light of one particle converge slowly
    for sweep in range(16 if events else 0):
        last = _without_doubles(events, context)
        events = _fit_all(context, windows, [e.candidate for e in last], last, pool)
        windows = _refined(context, windows, events)
        if sweep + 1 >= _SWEEPS and _is_settled(last, events, context.roi_px / 2):
            break
    return events, windows


def _with_concealed(
    context: AnalysisContext,
    windows: Windows,
    known: list[Fitted],
    excess_noise: ExcessNoise | None,
    pool: ThreadPoolExecutor,
) -> tuple[list[Fitted], Windows] | None:
    """Add particles near poor fits, where their absence is the cause of the misfit.

    If several particles are missing around a known one, each by itself explains only a part of the
    misfit and cannot be told from it.  Candidates are therefore fitted together, and those are kept
    that explain more than is then left.
    """
    trial, power = known, windows
    for _ in range(MAX_ROUNDS):
        if not any(Status.POOR_FIT in event.fit.flags for event in trial):
            break
        fresh, _ = search_field(
            # Share of the χ² in excess that a particle explains which is tried among others
            context,
            power,
            trial,
            excess_noise,
            explains=0.1,
        )
        if not fresh:
            break
        both = _fit_all(context, power, [*(e.candidate for e in trial), *fresh], trial, pool)
        trial = _fit_all(context, power, [e.candidate for e in both], both, pool)
        power = _refined(context, power, trial)
    while len(trial) > len(known):
        trial, power = _settled(context, power, trial, pool)
        kept = _tenable(context, trial, known)
        if len(kept) == len(trial):
            return (trial, power) if len(trial) > len(known) else None
        trial = kept
    return None


def _tenable(
    context: AnalysisContext, trial: Sequence[Fitted], known: Sequence[Fitted]
) -> list[Fitted]:
    """Drop added particles that explain less than the misfit, the worst of each place first."""
    places, earlier = (
        np.array([(e.candidate.x_px, e.candidate.y_px) for e in events])
        for events in (trial, known)
    )
    apart = np.hypot(*(places[:, None] - places).T)
    near = apart <= _reach_px(context)
    added = np.ones(len(trial), dtype=bool)
    added[np.hypot(*(earlier[:, None] - places).T).argmin(axis=0)] = False
    left = np.array([_chi2_left(event) for event in trial])
    snr2 = np.array([event.snr**2 for event in trial])
    # without this one as much more would be left
    most = np.where(near, left, 0.0).max(axis=1)
    share = np.where(added, snr2 / np.maximum(snr2 + most, 1e-300), 1.0)
    worst = np.where(near, share, 1.0).min(axis=1)
    leave = (share < EXPLAINS) & (share <= worst)
    return [event for event, out in zip(trial, leave, strict=True) if not out]


def total_signal(
    context: AnalysisContext, shape: tuple[int, int], events: Sequence[Fitted]
) -> FloatArray:
    """Sum the signals of all fitted particles over the field.

    Shapes: result (y, x).
    """
    total = np.zeros(shape)
    for event in events:
        whole = Region((0, shape[0]), (0, shape[1]))
        add_signal(context, event.place, whole, total, event.sphere)
    return total


def add_signal(
    context: AnalysisContext,
    place: PlaceAndMass,
    region: Region,
    total: FloatArray,
    sphere: SeatedModel | None = None,
) -> None:
    """Add the signal of a particle, a dipole or a sphere, to the pixels that it reaches.

    Shapes: `total` (y, x).
    """
    x_nm, y_nm, _, _ = place
    spans = []
    for centre, (low, high) in ((y_nm, region.rows), (x_nm, region.columns)):
        first = max(low, math.ceil((centre - SPREAD_NM) / context.pixel_nm))
        spans.append((first, min(high, math.floor((centre + SPREAD_NM) / context.pixel_nm) + 1)))
    rows, columns = spans
    if rows[0] >= rows[1] or columns[0] >= columns[1]:
        return
    grid = PixelGrid.region(rows, columns, context.pixel_nm)
    inside = (
        slice(rows[0] - region.rows[0], rows[1] - region.rows[0]),
        slice(columns[0] - region.columns[0], columns[1] - region.columns[0]),
    )
    model = context.wide_at(x_nm, y_nm)
    if sphere is not None:
        model = sphere.in_place_of(model)
    total[inside] += model.image(grid, *place)


def search_field(
    context: AnalysisContext,
    windows: Windows,
    events: Sequence[Fitted] = (),
    excess_noise: ExcessNoise | None = None,
    *,
    explains: float = EXPLAINS,
) -> tuple[list[Candidate], list[Candidate]]:
    """Find new particles; candidates that may be side lobes of known ones are returned apart."""
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    explained = context.left(total_signal(context, shape, events))
    likelihood = search_likelihood(context, windows, explained)
    found = find_particles(
        likelihood,
        context.templates,
        search_both(context.config.detection),
        roi_px=context.roi_px,
        explained=explained,
        excess_noise=excess_noise,
        known=[(e.candidate.x_px, e.candidate.y_px) for e in events],
        cumulants=noise_cumulants(context, windows, likelihood),
    )
    near = context.config.optics.wavelength_nm / (4 * context.config.optics.na) / context.pixel_nm
    fresh: list[Candidate] = []
    doubtful: list[Candidate] = []
    for candidate in found:
        size = max(
            (_misfit(candidate, event, context, near, explains) for event in events), default=0.0
        )
        size = max(size, EXCEEDS * candidate.beside)
        if abs(candidate.snr) > size:
            fresh.append(candidate)
        elif not is_hidden(candidate.snr, size):
            doubtful.append(candidate)
    return fresh, doubtful


def _misfit(
    candidate: Candidate, event: Fitted, context: AnalysisContext, near_px: float, explains: float
) -> float:
    """Signal-to-noise ratio that a candidate must exceed not to be a residual of a fit."""
    here = event.candidate
    distance = math.hypot(candidate.x_px - here.x_px, candidate.y_px - here.y_px)
    if distance <= near_px:
        return math.inf
    return math.sqrt(explains * _excess(event)) if distance <= _reach_px(context) else 0.0


def _reach_px(context: AnalysisContext) -> float:
    """Distance from a particle within which a poor fit leaves residuals [pixels]."""
    # In dark field a wrong background level leaves residuals beyond the fitted region.
    return (2 if context.additive else 0.75) * context.roi_px


def _excess(event: Fitted) -> float:
    """χ² of a fit beyond its expectation, where the fit is poor."""
    return _chi2_left(event) if Status.POOR_FIT in event.fit.flags else 0.0


def _chi2_left(event: Fitted) -> float:
    """χ² of a fit beyond its expectation, some of which may be noise."""
    return max(0.0, event.fit.chi2_reduced - 1) * event.likelihood.n_pixels


def _fit_all(
    context: AnalysisContext,
    windows: Windows,
    candidates: Sequence[Candidate],
    events: Sequence[Fitted],
    pool: ThreadPoolExecutor,
    *,
    first: int = 0,
) -> list[Fitted]:
    """Fit each candidate with all other `events` in its background.

    Candidate i replaces event ``first + i``, if there is one of that number.
    """
    nominal = context.model.material.mass_kda
    free = FREE_PARAMETERS[context.mode]
    taken: FloatArray | None = None
    if context.lines is not None:
        shape = (windows.after_e.shape[0], windows.after_e.shape[1])
        taken = context.lines.taken(total_signal(context, shape, events))

    starts = [
        replace(
            start,
            mass_kda=start.mass_kda if "mass_kda" in free else nominal,
            z_nm=start.z_nm if "z_nm" in free else context.height_nm(start.mass_kda),
        )
        for start in candidates
    ]
    regions = [region_around(context.roi_px, windows.after_e.shape, start) for start in starts]
    beside = [np.zeros(region.shape) for region in regions]

    def drawn(number: int) -> list[tuple[int, FloatArray]]:
        """Draw an event in the regions that it reaches; its field at its height is made once."""
        images = []
        for index, region in enumerate(regions):
            image = np.zeros(region.shape)
            if number != first + index:
                add_signal(context, events[number].place, region, image, events[number].sphere)
            if image.any():
                images.append((index, image))
        return images

    for images in pool.map(drawn, range(len(events))):
        for index, image in images:
            beside[index] += image

    def one(index: int) -> Fitted | None:
        start, region, others = starts[index], regions[index], beside[index]
        if taken is not None:
            others = (1 + others) / taken[region.slices] - 1
        likelihood = region_likelihood(context, windows, region, others)
        if likelihood.n_pixels < 0.5 * others.size:
            return None
        known = events[first + index] if first + index < len(events) else None
        if known is not None and known.sphere is not None:
            seated, again = refitted(likelihood, known.sphere, known.fit, level=False)
            return Fitted(region, again, seated)
        likelihood = context.with_prior(likelihood, start.mass_kda)
        fit = fit_particle(
            likelihood, start, context.mode, context.config.fit.z_range_nm, level=False
        )
        return Fitted(region, fit, likelihood)

    return [event for event in pool.map(one, range(len(candidates))) if event is not None]


def _refined(context: AnalysisContext, windows: Windows, events: Sequence[Fitted]) -> Windows:
    if not context.config.background.power_normalization:
        return windows
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    signal = context.left(total_signal(context, shape, events))
    if context.additive:
        signal = signal * photons_scale(context, windows)
    return refine_power(windows, signal, additive=context.additive)


def _wanted(context: AnalysisContext, event: Fitted) -> bool:
    """Whether the fitted contrast has the sign that is reported."""
    sign = context.config.detection.sign
    return sign == 0 or context.additive or sign * event.fit.contrast > 0


def _is_settled(before: Sequence[Fitted], after: Sequence[Fitted], near_px: float) -> bool:
    """Whether another turn would hardly change fits that are near each other."""
    if len(before) != len(after) or not after:
        return not after
    places = np.array([(e.candidate.x_px, e.candidate.y_px) for e in after])
    apart = np.hypot(*(places[:, None] - places).T) + 2 * near_px * np.eye(len(places))
    moved = np.array([a.snr - b.snr for a, b in zip(before, after, strict=True)])
    # change of signal-to-noise ratios from one sweep to the next
    return bool(np.all((np.abs(moved) < 0.1) | (apart.min(axis=0) > near_px)))


def _without_doubles(events: Sequence[Fitted], context: AnalysisContext) -> list[Fitted]:
    """Keep the better of two fits that converged to one particle."""
    kept: list[Fitted] = []
    for event in sorted(events, key=lambda e: -e.snr):
        here = event.candidate
        if all(
            math.hypot(here.x_px - k.candidate.x_px, here.y_px - k.candidate.y_px)
            * context.pixel_nm
            # two fits nearer than this describe one particle
            > min(1.5 * context.pixel_nm, 150.0)
            for k in kept
        ):
            kept.append(event)
    return kept


def _judged(
    context: AnalysisContext, windows: Windows, fitted: Sequence[Fitted], lobes: Sequence[Fitted]
) -> list[Event]:
    """Add the flags that depend on the neighbourhood: saturation, crowding, side lobes."""
    judged = []
    limit = context.config.detection.min_separation_nm
    for number, one in enumerate((*fitted, *lobes)):
        x, y = one.fit.x_nm, one.fit.y_nm
        crowded = any(
            other is not one and math.hypot(other.fit.x_nm - x, other.fit.y_nm - y) < limit
            for other in fitted
        )
        near = (
            other.described
            for other in fitted
            if math.hypot(other.fit.x_nm - x, other.fit.y_nm - y)
            < LARGEST_IMAGE * context.roi_px * context.pixel_nm
        )
        lobe = number >= len(fitted) or one.described.is_dwarfed(near)
        own = windows.cut(one.region.slices)
        flags = fit_flags(context, one, own, sidelobe=lobe, too_close=crowded)
        judged.append(
            Event(
                one.region, one.fit, one.likelihood, own, flags,
                windows.frames_after[0], windows.n_before, windows.n_after,
            )
        )  # fmt: skip
    return judged
