"""Detection and fitting over a whole field, in turns.

What the fits explain is taken off the image before it is searched again, so a side lobe never
counts as a particle and a faint neighbour is not lost.  Every fit sees its neighbours' signal as
part of its background, and the laser power is estimated again with all particles accounted for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.background import refine_power, smooth_background
from iscat_analysis.config import Config, Detection
from iscat_analysis.detect import Templates, find_particles, make_templates
from iscat_analysis.errors import ConfigError
from iscat_analysis.fit import fit_particle, window_nm
from iscat_analysis.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.likelihood import Likelihood, conditional, poisson
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Candidate,
    FitResult,
    FloatArray,
    Progress,
    Status,
    Windows,
    silent,
)

MAX_ROUNDS = 8
"""Rounds of search; each takes the particles found so far off the image."""

SPREAD_NM = 10_000.0
"""Farther than this from a particle its rings are left out; they are 1e-4 of its peak."""

_SWEEPS = 2  # fits of everything with everything else in place, after the last round
_DUPLICATE_PX = 1.5  # two fits nearer than this describe one particle
_SATURATION_NM = 500.0  # saturated pixels nearer than this spoil a fit


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


@dataclass(frozen=True)
class Event:
    """One fitted particle: where it was searched, what was fitted, and the likelihood used."""

    region: Region
    fit: FitResult
    likelihood: Likelihood

    @property
    def candidate(self) -> Candidate:
        """The estimate, as the start of another fit."""
        pixel = self.likelihood.grid.pixel_nm
        return Candidate(
            self.fit.x_nm / pixel, self.fit.y_nm / pixel, self.fit.z_nm, self.fit.mass_kda, self.snr
        )

    @property
    def snr(self) -> float:
        """√(2 Δℓ) against no particle."""
        return math.sqrt(2 * max(self.fit.log_likelihood, 0.0))


@dataclass(frozen=True)
class Scene:
    """What a configuration fixes for every field of a movie: model, templates, scale.

    Attributes
    ----------
    config : Config
        Resolved.
    model : ForwardModel
        For fitted regions.
    wide : ForwardModel
        For signals up to `SPREAD_NM` away.
    templates : Templates
        Matched filter.
    mode : str
        Key of `FREE_PARAMETERS`.
    """

    config: Config
    model: ForwardModel
    wide: ForwardModel
    templates: Templates
    mode: str

    @property
    def pixel_nm(self) -> float:
        """Pixel side [nm]."""
        return _pixel_nm(self.config)

    @property
    def roi_px(self) -> int:
        """Side of the fitted square [pixels]."""
        return max(5, round(self.config.fit.roi_nm / self.pixel_nm))

    @property
    def additive(self) -> bool:
        """Whether particles add to the background instead of multiplying it."""
        return self.model.rho == 0


def make_scene(config: Config, field_px: tuple[int, int], *, searches: int = 1) -> Scene:
    """Build the models and the matched filter for a field.

    Parameters
    ----------
    config : Config
        With a pixel size.
    field_px : (int, int)
        Rows and columns.
    searches : int
        Images that will be searched; they share the expected false alarms.

    Returns
    -------
    Scene
        Ready for `fit_field`.

    Raises
    ------
    ConfigError
        The region is too small or too large, or the likelihood does not suit the scheme.
    """
    pixel = _pixel_nm(config)
    roi_px = max(5, round(config.fit.roi_nm / pixel))
    if roi_px > min(field_px):
        raise ConfigError(
            f"fit.roi_nm = {config.fit.roi_nm:g} is {roi_px} pixels, more than the field of "
            f"{field_px[0]} x {field_px[1]}: lower fit.roi_nm or check camera.pixel_size_nm"
        )
    darkfield = config.optics.scheme == "darkfield"
    if config.fit.likelihood == "conditional" and (darkfield or config.background.method != "mean"):
        raise ConfigError(
            'fit.likelihood = "conditional" needs an interferometric scheme and '
            'background.method = "mean": use "auto"'
        )
    reach = math.sqrt(2) * (roi_px * pixel / 2 + window_nm(pixel) + pixel)
    model = forward_model(config, reach)
    mode = config.fit.mode
    free_z = "z_nm" in FREE_PARAMETERS[mode]
    field_nm = math.hypot(field_px[0] + 1, field_px[1] + 1) * pixel
    return Scene(
        config=config,
        model=model,
        wide=forward_model(config, min(field_nm, math.sqrt(2) * (SPREAD_NM + 2 * pixel))),
        templates=make_templates(
            model,
            _search_both(config.detection, searches),
            pixel_nm=pixel,
            roi_nm=config.fit.roi_nm,
            z_range_nm=config.fit.z_range_nm if free_z else None,
            field_px=field_px,
        ),
        mode=mode,
    )


def fit_field(
    scene: Scene,
    windows: Windows,
    *,
    starts: Sequence[Candidate] = (),
    pool: ThreadPoolExecutor,
    progress: Progress = silent,
) -> tuple[tuple[Event, ...], Windows]:
    """Find and fit every particle in a field.

    Parameters
    ----------
    scene : Scene
        Models and matched filter.
    windows : Windows
        Sums before and after.
    starts : sequence of Candidate
        Particles known beforehand, fitted first.
    pool : ThreadPoolExecutor
        Runs the fits; the result does not depend on its size.
    progress : Progress
        Told the rounds.

    Returns
    -------
    events : tuple of Event
        In order of y, then x.
    windows : Windows
        With the laser power estimated anew.
    """
    events: list[Event] = []
    fresh = list(starts)
    for number in range(MAX_ROUNDS):
        progress("detect", number, MAX_ROUNDS)
        if number or not fresh:
            fresh = _search(scene, windows, events)
        if not fresh and (number or not starts):
            break
        events = _fit_all(scene, windows, [*(e.candidate for e in events), *fresh], events, pool)
        windows = _refined(scene, windows, events)
    for _ in range(_SWEEPS if events else 0):
        events = _without_doubles(events, scene)
        events = _fit_all(scene, windows, [e.candidate for e in events], events, pool)
        windows = _refined(scene, windows, events)
    events = [e for e in events if e.snr > scene.templates.threshold and _wanted(scene, e)]
    events = _judged(scene, windows, events)
    progress("detect", MAX_ROUNDS, MAX_ROUNDS)
    return tuple(sorted(events, key=lambda e: (e.fit.y_nm, e.fit.x_nm))), windows


def field_likelihood(scene: Scene, windows: Windows) -> Likelihood:
    """Likelihood of the whole field.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Sums before and after.

    Returns
    -------
    Likelihood
        For the matched filter.
    """
    rows, columns = windows.after_e.shape
    return region_likelihood(scene, windows, Region((0, rows), (0, columns)), None)


def region_likelihood(
    scene: Scene, windows: Windows, region: Region, others: FloatArray | None
) -> Likelihood:
    """Likelihood of a region, with the signal of other particles as part of its background.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Sums before and after.
    region : Region
        Which pixels.
    others : ndarray, shape (rows, columns), optional
        Signal of the other particles there.

    Returns
    -------
    Likelihood
        Conditional where a measured background is divided out, Poisson otherwise.
    """
    cut = region.slices
    config = scene.config
    grid = PixelGrid.region(region.rows, region.columns, scene.pixel_nm)
    model = scene.model if grid.diagonal_nm <= scene.model.reach_nm else scene.wide
    before, after, masked = windows.before_e[cut], windows.after_e[cut], windows.masked[cut]
    ratio = windows.power_ratio
    signal = np.zeros(grid.shape) if others is None else others
    if uses_conditional(config):
        return conditional(
            model, grid, before, after, ratio * (1 + signal),
            read_variance_before_e2=windows.read_variance_before_e2[cut],
            read_variance_after_e2=windows.read_variance_after_e2[cut],
            masked=masked,
        )  # fmt: skip
    measured = {"mean": 1.0, "median": math.pi / 2, "none": 0.0}[config.background.method]
    read = windows.read_variance_before_e2[cut]
    steady = smooth_background(before, read, masked) if measured else before
    # The expected variance is that of the smooth background; the excess is that over the own one.
    extra = windows.read_variance_after_e2[cut] + ratio**2 * (measured * steady + read)
    extra = extra + ratio * (steady - before)
    background = ratio * before
    if scene.additive:
        scale = photons_scale(scene, windows)
        return poisson(
            model, grid, after, background + scale * signal, scale,
            extra_variance_e2=extra, masked=masked,
        )  # fmt: skip
    level = background * (1 + signal)
    return poisson(model, grid, after, level, level, extra_variance_e2=extra, masked=masked)


def uses_conditional(config: Config) -> bool:
    """Whether the fits condition on the sum of counts before and after.

    Parameters
    ----------
    config : Config
        ``fit.likelihood``, the scheme and ``background.method`` decide.

    Returns
    -------
    bool
        False where they take the background as known.
    """
    if config.fit.likelihood == "auto":
        return config.optics.scheme != "darkfield" and config.background.method == "mean"
    return config.fit.likelihood == "conditional"


def photons_scale(scene: Scene, windows: Windows) -> float:
    """Scale of the signal in dark field.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Frames and laser power.

    Returns
    -------
    float
        Photoelectrons per pixel for unit |E_sca|², summed over the frames after.
    """
    per_frame = scene.model.photons_per_intensity(
        scene.config.simulation.photons_per_pixel, scene.pixel_nm
    )
    return per_frame * windows.power_ratio * max(windows.n_before, 1)


def total_signal(scene: Scene, shape: tuple[int, int], events: Sequence[Event]) -> FloatArray:
    """Signal of all fitted particles over the field.

    Parameters
    ----------
    scene : Scene
        Models.
    shape : (int, int)
        Rows and columns.
    events : sequence of Event
        The particles.

    Returns
    -------
    ndarray, shape (y, x)
        Contrast, or |E_sca|² in dark field.
    """
    total = np.zeros(shape)
    for event in events:
        _add_signal(scene, event, Region((0, shape[0]), (0, shape[1])), total)
    return total


def _pixel_nm(config: Config) -> float:
    if config.camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed: set it, as in --set camera.pixel_size_nm=84.4"
        )
    return config.camera.pixel_size_nm


def _add_signal(scene: Scene, event: Event, region: Region, total: FloatArray) -> None:
    """Add a particle's signal to the pixels of a region that it reaches."""
    fit = event.fit
    spans = []
    for centre, (low, high) in ((fit.y_nm, region.rows), (fit.x_nm, region.columns)):
        first = max(low, math.ceil((centre - SPREAD_NM) / scene.pixel_nm))
        spans.append((first, min(high, math.floor((centre + SPREAD_NM) / scene.pixel_nm) + 1)))
    rows, columns = spans
    if rows[0] >= rows[1] or columns[0] >= columns[1]:
        return
    grid = PixelGrid.region(rows, columns, scene.pixel_nm)
    inside = (
        slice(rows[0] - region.rows[0], rows[1] - region.rows[0]),
        slice(columns[0] - region.columns[0], columns[1] - region.columns[0]),
    )
    total[inside] += scene.wide.image(grid, fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda)


def _search(scene: Scene, windows: Windows, events: Sequence[Event]) -> list[Candidate]:
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    explained = total_signal(scene, shape, events)
    found = find_particles(
        field_likelihood(scene, windows),
        scene.templates,
        _search_both(scene.config.detection, 1),
        roi_px=scene.roi_px,
        explained=explained,
    )
    near = scene.config.optics.wavelength_nm / (4 * scene.config.optics.na) / scene.pixel_nm
    return [c for c in found if all(_is_new(c, event, scene.roi_px, near) for event in events)]


def _is_new(candidate: Candidate, event: Event, roi_px: int, near_px: float) -> bool:
    """Whether a peak is another particle than a fitted one, and not what its fit left over.

    A second particle explains most of the χ² in excess around the first; the residue of a model
    that does not suit the first is spread over many peaks.
    """
    here = event.candidate
    distance = math.hypot(candidate.x_px - here.x_px, candidate.y_px - here.y_px)
    if distance <= near_px:
        return False
    if distance > 2 * roi_px or Status.POOR_FIT not in event.fit.flags:
        return True
    excess = (event.fit.chi2_reduced - 1) * event.likelihood.n_pixels
    return candidate.snr**2 > 0.5 * excess


def _fit_all(
    scene: Scene,
    windows: Windows,
    candidates: Sequence[Candidate],
    events: Sequence[Event],
    pool: ThreadPoolExecutor,
) -> list[Event]:
    """Fit every candidate with the current `events` but itself in its background."""
    height = scene.config.particle.height_nm
    nominal = scene.model.material.mass_kda
    free = FREE_PARAMETERS[scene.mode]

    def one(index: int) -> Event | None:
        start = candidates[index]
        if "mass_kda" not in free:
            start = replace(start, mass_kda=nominal)
        if "z_nm" not in free:
            start = replace(start, z_nm=height)
        region = _region(scene, windows, start)
        others = np.zeros(region.shape)
        for number, event in enumerate(events):
            if number != index:
                _add_signal(scene, event, region, others)
        likelihood = region_likelihood(scene, windows, region, others)
        if likelihood.n_pixels < 0.5 * others.size:
            return None
        fit = fit_particle(likelihood, start, scene.mode, scene.config.fit.z_range_nm)
        return Event(region, fit, likelihood)

    return [event for event in pool.map(one, range(len(candidates))) if event is not None]


def _region(scene: Scene, windows: Windows, start: Candidate) -> Region:
    side = scene.roi_px
    spans = []
    for centre, size in zip((start.y_px, start.x_px), windows.after_e.shape, strict=True):
        first = round(centre - (side - 1) / 2)
        spans.append((max(first, 0), min(first + side, size)))
    return Region(spans[0], spans[1])


def _refined(scene: Scene, windows: Windows, events: Sequence[Event]) -> Windows:
    if not scene.config.background.power_normalization:
        return windows
    shape = (windows.after_e.shape[0], windows.after_e.shape[1])
    signal = total_signal(scene, shape, events)
    if scene.additive:
        signal = signal * photons_scale(scene, windows)
    return refine_power(windows, signal, additive=scene.additive)


def _search_both(detection: Detection, searches: int) -> Detection:
    """Search both polarities, for one that is not wanted has side lobes that are.

    Half of the false alarms have the wanted one, and `searches` images share them.
    """
    sides = 1 if detection.polarity == "both" else 2
    alarms = sides * detection.false_alarms_per_movie / searches
    return detection.model_copy(update={"polarity": "both", "false_alarms_per_movie": alarms})


def _wanted(scene: Scene, event: Event) -> bool:
    """Whether the fitted contrast has the polarity that is reported."""
    sign = {"both": 0, "bright": 1, "dark": -1}[scene.config.detection.polarity]
    return sign == 0 or scene.additive or sign * event.fit.contrast > 0


def _without_doubles(events: Sequence[Event], scene: Scene) -> list[Event]:
    """Keep the better of two fits that fell onto one particle."""
    kept: list[Event] = []
    for event in sorted(events, key=lambda e: -e.snr):
        here = event.candidate
        if all(
            math.hypot(here.x_px - k.candidate.x_px, here.y_px - k.candidate.y_px)
            * scene.pixel_nm > min(_DUPLICATE_PX * scene.pixel_nm, 150.0)
            for k in kept
        ):  # fmt: skip
            kept.append(event)
    return kept


def _judged(scene: Scene, windows: Windows, events: Sequence[Event]) -> list[Event]:
    """Add the verdicts that need the neighbourhood: saturation and crowding."""
    judged = []
    limit = scene.config.detection.min_separation_nm
    for event in events:
        x, y = event.fit.x_nm, event.fit.y_nm
        crowded = any(
            other is not event and math.hypot(other.fit.x_nm - x, other.fit.y_nm - y) < limit
            for other in events
        )
        rows, columns = np.nonzero(windows.saturated[event.region.slices])
        dx = (columns + event.region.columns[0]) * scene.pixel_nm - x
        dy = (rows + event.region.rows[0]) * scene.pixel_nm - y
        burnt = bool(np.any(np.hypot(dx, dy) < _SATURATION_NM))
        flags = [
            *([Status.SATURATED] if burnt else []),
            *(f for f in event.fit.flags if f != Status.POOR_FIT),
            *([Status.TOO_CLOSE] if crowded else []),
            *(f for f in event.fit.flags if f == Status.POOR_FIT),
        ]
        status = Status(flags[0]) if flags else Status.OK
        judged.append(replace(event, fit=replace(event.fit, status=status, flags=tuple(flags))))
    return judged
