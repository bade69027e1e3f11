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
from dataclasses import dataclass, replace

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
    field = FieldFit(context, windows, excess_noise, pool)
    events = [] if starts else field.large_ones()
    fresh, doubtful = list(starts), list[Candidate]()
    for number in range(MAX_ROUNDS):
        progress("detect", number, MAX_ROUNDS)
        if number or not fresh:
            fresh, doubtful = field.search(events)
        if not fresh and (number or not starts):
            break
        events = field.fit(events, fresh)
        field.refine_power(events)
    events = field.settled(events)
    large = with_spheres(context, events, pool, level=False)
    if any(new.sphere and not old.sphere for new, old in zip(large, events, strict=True)):
        events = field.settled(large)
    trial = None if starts else field.with_concealed(events)
    if trial is not None:
        events = trial
        fresh, doubtful = field.search(events)
        if fresh:  # what was too faint to be told while its neighbours were not described
            events = field.settled(field.fit(events, fresh))
            _, doubtful = field.search(events)
    kept = field.reported(events)
    while 0 < len(kept) < len(events):  # a dropped fit no longer belongs to the others' background
        events = field.fit(kept)
        kept = field.reported(events)
    lobes: list[Fitted] = []
    if doubtful and not starts:
        lobes = field.reported(field.fit_beside(doubtful, kept))
    judged = field.judged(kept, lobes)
    progress("detect", MAX_ROUNDS, MAX_ROUNDS)
    return tuple(sorted(judged, key=lambda e: (e.fit.y_nm, e.fit.x_nm))), field.windows


@dataclass
class FieldFit:
    """Fits of particles in turns; `windows` are the frames, with the power as it is estimated."""

    context: AnalysisContext
    windows: Windows
    excess_noise: ExcessNoise | None
    pool: ThreadPoolExecutor

    def search(
        self, events: Sequence[Fitted], explains: float = EXPLAINS
    ) -> tuple[list[Candidate], list[Candidate]]:
        """As `search_field`."""
        return search_field(
            self.context, self.windows, events, self.excess_noise, explains=explains
        )

    def signal(self, events: Sequence[Fitted]) -> FloatArray:
        """Give the signal of particles over the field."""
        rows, columns = self.windows.after_e.shape
        return total_signal(self.context, (rows, columns), events)

    def large_ones(self) -> list[Fitted]:
        """Find spheres before anything else, the brightest first.

        The search for dipoles would take the rings of their images for particles.  A place is where
        the light changes most, whatever the shape of the image.
        """
        context = self.context
        found: list[Fitted] = []
        dipoles: list[Fitted] = []  # whose rings are no places of their own
        if not context.spheres_of(context.model):
            return found
        nominal = context.model.material.mass_kda
        seen: list[tuple[float, float]] = []
        vain = 0
        while vain < IN_VAIN:
            known = [*found, *dipoles]
            explained = context.left(self.signal(known))
            whole = search_likelihood(context, self.windows, explained)
            place = brightest_place(whole, explained, seen, context.roi_px / 4)
            if place is None:
                break
            seen.append(place)
            vain += 1
            starts = [Candidate(*place, 0.0, sign * nominal, 0.0) for sign in (1, -1)]
            either = self.fit_beside(starts, known)
            best = max(either, key=lambda one: one.fit.log_likelihood, default=None)
            if best is None:
                continue
            if not may_be_large(best.likelihood, best.fit):
                dipoles.append(best)
                continue
            (large,) = with_spheres(context, [best], self.pool, level=False)
            if large.sphere:
                vain = 0
            if large.sphere or _chi2_left(large) < EXPLAINS * large.snr**2:
                found = self.settled([*found, large])
        return found

    def settled(self, events: list[Fitted]) -> list[Fitted]:
        """Fit all particles in turns, until fits near each other hardly change."""
        # two fits that share the light of one particle converge slowly
        for sweep in range(16 if events else 0):
            last = _without_doubles(events, self.context)
            events = self.fit(last)
            self.refine_power(events)
            # at least two fits of everything with everything else in place
            if sweep + 1 >= 2 and _is_settled(last, events, self.context.roi_px / 2):
                break
        return events

    def with_concealed(self, known: list[Fitted]) -> list[Fitted] | None:
        """Add particles near poor fits, where their absence is the cause of the misfit.

        If several particles are missing around a known one, each by itself explains only a part of
        the misfit and cannot be told from it.  Candidates are therefore fitted together, and those
        are kept that explain more than is then left.
        """
        trial, windows = known, self.windows
        for _ in range(MAX_ROUNDS):
            if not any(Status.POOR_FIT in event.fit.flags for event in trial):
                break
            # Share of the χ² in excess that a particle explains which is tried among others
            fresh, _ = self.search(trial, explains=0.1)
            if not fresh:
                break
            trial = self.fit(self.fit(trial, fresh))
            self.refine_power(trial)
        while len(trial) > len(known):
            trial = self.settled(trial)
            kept = _tenable(self.context, trial, known)
            if len(kept) == len(trial) > len(known):
                return trial
            if len(kept) == len(trial):
                break
            trial = kept
        self.windows = windows
        return None

    def fit(self, events: Sequence[Fitted], fresh: Sequence[Candidate] = ()) -> list[Fitted]:
        """Fit all events again, and new candidates, each with all other events beside it."""
        return self._fit([*(event.candidate for event in events), *fresh], events, 0)

    def fit_beside(self, candidates: Sequence[Candidate], events: Sequence[Fitted]) -> list[Fitted]:
        """Fit candidates with all events beside them."""
        return self._fit(candidates, events, len(events))

    def _fit(
        self, candidates: Sequence[Candidate], events: Sequence[Fitted], first: int
    ) -> list[Fitted]:
        """Fit candidates, of which number i replaces event ``first + i``, if there is one."""
        context, windows = self.context, self.windows
        nominal = context.model.material.mass_kda
        free = FREE_PARAMETERS[context.mode]
        taken: FloatArray | None = None
        if context.lines is not None:
            taken = context.lines.taken(self.signal(events))

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
            """Draw an event in the regions it reaches; its field at its height is made once."""
            images = []
            for index, region in enumerate(regions):
                image = np.zeros(region.shape)
                if number != first + index:
                    add_signal(context, events[number].place, region, image, events[number].sphere)
                if image.any():
                    images.append((index, image))
            return images

        for images in self.pool.map(drawn, range(len(events))):
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
            z_range = context.config.fit.z_range_nm
            fit = fit_particle(likelihood, start, context.mode, z_range, level=False)
            return Fitted(region, fit, likelihood)

        return [event for event in self.pool.map(one, range(len(candidates))) if event is not None]

    def refine_power(self, events: Sequence[Fitted]) -> None:
        """Estimate the power again over a background without the particles."""
        context = self.context
        if not context.config.background.power_normalization:
            return
        signal = context.left(self.signal(events))
        if context.additive:
            signal = signal * photons_scale(context, self.windows)
        self.windows = refine_power(self.windows, signal, additive=context.additive)

    def reported(self, events: Sequence[Fitted]) -> list[Fitted]:
        """Select fits of the sign that is reported which others do not explain."""
        # of the threshold: a fit whose final SNR is below it is explained by the others
        least = 0.95 * self.context.templates.threshold
        any_sign = self.context.additive or not self.context.config.detection.sign
        sign = self.context.config.detection.sign
        return [e for e in events if e.snr > least and (any_sign or sign * e.fit.contrast > 0)]

    def judged(self, fitted: Sequence[Fitted], lobes: Sequence[Fitted]) -> list[Event]:
        """Add the flags that depend on the neighbourhood: saturation, crowding, side lobes."""
        judged, context, windows = [], self.context, self.windows
        limit = context.config.detection.min_separation_nm
        reach = LARGEST_IMAGE * context.roi_px * context.pixel_nm
        for number, one in enumerate((*fitted, *lobes)):
            x, y = one.fit.x_nm, one.fit.y_nm
            away = [(math.hypot(e.fit.x_nm - x, e.fit.y_nm - y), e) for e in fitted]
            crowded = any(other is not one and distance < limit for distance, other in away)
            near = (other.described for distance, other in away if distance < reach)
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
        size = EXCEEDS * candidate.beside
        for event in events:
            here = event.candidate
            distance = math.hypot(candidate.x_px - here.x_px, candidate.y_px - here.y_px)
            if distance <= near:
                size = math.inf
            elif distance <= _reach_px(context) and Status.POOR_FIT in event.fit.flags:
                size = max(size, math.sqrt(explains * _chi2_left(event)))
        if abs(candidate.snr) > size:
            fresh.append(candidate)
        elif not is_hidden(candidate.snr, size):
            doubtful.append(candidate)
    return fresh, doubtful


def _reach_px(context: AnalysisContext) -> float:
    """Distance from a particle within which a poor fit leaves residuals [pixels]."""
    # In dark field a wrong background level leaves residuals beyond the fitted region.
    return (2 if context.additive else 0.75) * context.roi_px


def _chi2_left(event: Fitted) -> float:
    """χ² of a fit beyond its expectation, some of which may be noise."""
    return max(0.0, event.fit.chi2_reduced - 1) * event.likelihood.n_pixels


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
