"""The microscope of a movie: its bright particles, what they show, and a folder that says so."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.calibration.optics import (
    FAINTEST,
    FOCUS_STEP,
    LEAST_SIGHTS,
    MOST_SIGHTS,
    OpticsCalibration,
    Settings,
    Sight,
    build_microscope,
    free_groups,
    make_pictures,
    make_result,
    measure_microscope,
    optics_limits,
    settings_of,
)
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.likelihood import Likelihood, conditional, poisson
from iscat_analysis.movie.background import measure_windows
from iscat_analysis.movie.camera import Camera, camera_from_config, check_counts
from iscat_analysis.movie.metadata import resolve_metadata
from iscat_analysis.movie.stack import Stack
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.pipeline.chunks import Reader, counts_budget, judge_window, plan_chunks
from iscat_analysis.pipeline.landing import has_landings
from iscat_analysis.pipeline.ranges import frame_ranges
from iscat_analysis.records import Mapper, Progress, Windows, silent
from iscat_analysis.search.bright import (
    ALONE_NM,
    BrightStep,
    centre_of_energy,
    energy_of,
    find_bright_places,
    find_bright_steps,
)
from iscat_analysis.search.sliding import STRIDES

RINGS_NM = 9000.0
"""Farther than this from a particle its rings are left out."""

STEP_FACTORS = (0.5, 2.0)
"""How much smaller or larger than said the steps of a scan may turn out."""

APART_NM = 2000.0
"""Particles that all bound at once are used if no other is nearer; the rings are accounted for."""

OTHERS_NM = 1700.0
"""Side of the region on which a neighbour is fitted."""

SAME_NM = 800.0
"""Nearer than this, and at the same time, two steps are one."""

_SHIFT_NM = 450.0  # how far a particle may lie from the centre of its picture
_MODELS_KEPT = 24


def calibrate_movie(
    movie: Stack,
    config: Config,
    *,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> OpticsCalibration:
    """Measure the optics of an open movie.

    Parameters
    ----------
    movie : Stack
        A landing movie, one with frames before the particles bound, or a scan of the focus.
    config : Config
        The microscope as far as it is known; `iscat_analysis.pipeline.analyse` reads it likewise.
    free : str or sequence of str, optional
        What may change: some of ``focus, na, phase, mask, zernike, polarization``; default all.
    focus_step_nm : float, optional
        The movie is a scan of immobile particles, and from frame to frame the focus rises by about
        this [nm]; where the focus is free, the step is measured too.
    progress : Progress
        Told how far it is.
    notify : callable
        Told what the user should know, one line at a time.

    Returns
    -------
    OpticsCalibration
        What was found; `OpticsCalibration.accepted` says whether it may be used.

    Raises
    ------
    DataError
        The movie shows too few bright, isolated particles.
    ConfigError
        The configuration cannot be calibrated.
    """
    groups = free_groups(free)
    config, notes = resolve_metadata(config, movie.metadata)
    for note in notes:
        if notify is not None:
            notify(note)
    refuse_uncalibratable(config)
    camera = camera_from_config(config.camera, (movie.shape[1], movie.shape[2]), movie.dtype)
    with ThreadPoolExecutor(config.compute.workers) as pool:
        progress("particles", 0, 1)
        if focus_step_nm is not None:
            others: list[Sight] = []
            sights = scan_sights(movie, config, camera)
        elif has_landings(config):
            sights, others = landing_sights(movie, config, camera, pool)
        else:
            sights, others = bound_sights(movie, config, camera)
        progress("particles", 1, 1)
        source = {
            "movie": movie.path.name,
            "sha256": movie.sha256(),
            "kind": "scan of the focus" if focus_step_nm is not None
            else "landing movie" if has_landings(config) else "frames before and after",
            "version": version("iscat-analysis"),
        }  # fmt: skip
        return calibrate_sights(
            sights, others, config, groups, source,
            focus_step_nm=focus_step_nm, mapper=pool.map,
        )  # fmt: skip


def refuse_uncalibratable(config: Config) -> None:
    """Refuse what has no reference to interfere with, or no derivative.

    Parameters
    ----------
    config : Config
        Resolved.

    Raises
    ------
    ConfigError
        The scheme is dark field, or the convention the paper's.
    """
    if config.optics.scheme == "darkfield":
        raise ConfigError(
            'optics.scheme = "darkfield" has no reference, and the optics are learned from the '
            "interference with it: calibrate with an interferometric movie of the same microscope"
        )
    if config.optics.convention == "dong2021":
        raise ConfigError('optics.convention = "dong2021" cannot be calibrated: use "exact"')


def calibrate_sights(
    sights: Sequence[Sight],
    others: Sequence[Sight],
    config: Config,
    groups: Sequence[str],
    source: Mapping[str, str],
    *,
    focus_step_nm: float | None = None,
    mapper: Mapper = map,
) -> OpticsCalibration:
    """Measure the optics from pictures.

    Parameters
    ----------
    sights : sequence of Sight
        The pictures.
    others : sequence of Sight
        Every particle that `Sight.neighbours` counts.
    config : Config
        Resolved.
    groups : sequence of str
        From `free_groups`.
    source : mapping of str to str
        Where the pictures came from.
    focus_step_nm : float, optional
        Of a scan: rise of the focus from frame to frame, from which the search starts [nm].
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    OpticsCalibration
        What was found.

    Raises
    ------
    DataError
        There are too few pictures.
    """
    if len(sights) < LEAST_SIGHTS:
        raise DataError(
            f"{source['movie']}: shows {len(sights)} bright particles that stand alone, and at "
            f"least {LEAST_SIGHTS} are needed to learn the optics; record more particles, or "
            "brighter ones (20 nm gold, or protein of 400 kDa and more), or more photons per frame"
        )
    configured = settings_of(config)
    limits = optics_limits(config.optics.n_immersion, config.optics.n_glass)
    if focus_step_nm is not None:
        configured[FOCUS_STEP] = focus_step_nm
        low, high = sorted(factor * focus_step_nm for factor in STEP_FACTORS)
        limits[FOCUS_STEP] = (low, high)
    build = microscopes(config, max(reach_nm(sight) for sight in sights))
    optics = config.optics
    measured = measure_microscope(
        sights,
        configured,
        build,
        lambda sight, settings: goodness(sight, build(sight.seen_with(settings))),
        free=groups,
        limits=limits,
        side=int(math.copysign(1, optics.focus_nm)) if optics.focus_nm else 0,
        landing=1,
        others=others,
        build_wide=microscopes(config, RINGS_NM + sights[0].grid.diagonal_nm),
        mapper=mapper,
    )
    estimate = measured.estimate
    pictures = make_pictures(estimate.sights, build, estimate.values)
    return make_result(config, configured, measured, pictures, source)


def microscopes(config: Config, reach_nm: float) -> Callable[[Settings], ForwardModel]:
    """Make models of changing optics, and keep the last few.

    Parameters
    ----------
    config : Config
        What does not change.
    reach_nm : float
        As in `forward_model` [nm].

    Returns
    -------
    callable
        Settings → model.
    """
    latest = threading.local()  # neighbours in a search often share their tables

    @lru_cache(_MODELS_KEPT)
    def model(items: tuple[tuple[str, Any], ...]) -> ForwardModel:
        like = getattr(latest, "model", None)
        found = build_microscope(config, reach_nm, dict(items), like=like)
        latest.model = found
        return found

    return lambda settings: model(tuple(settings.items()))


def goodness(sight: Sight, model: ForwardModel) -> tuple[float, float]:
    """Reduced χ² and p-value of a fitted picture.

    Parameters
    ----------
    sight : Sight
        With its own unknowns fitted.
    model : ForwardModel
        The microscope.

    Returns
    -------
    chi2_reduced, p_value : float
        From `goodness_of_fit`.
    """
    theta = np.array([sight.x_nm, sight.y_nm, sight.z_nm, sight.mass_kda, sight.level])
    likelihood = Likelihood(model, sight.grid, sight.kind, sight.data)
    return goodness_of_fit(likelihood, theta, np.array([True, True, False, True, True]))


def landing_sights(
    movie: Stack, config: Config, camera: Camera, pool: ThreadPoolExecutor
) -> tuple[list[Sight], list[Sight]]:
    """Find bright steps of a landing movie, chunk by chunk until there are enough.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        Resolved.
    camera : Camera
        Counts → photoelectrons.
    pool : ThreadPoolExecutor
        Runs the search.

    Returns
    -------
    sights : list of Sight
        At most `MOST_SIGHTS`, the brightest first.
    others : list of Sight
        Every bright step, on small regions.
    """
    first, last = config.fit.frames or (0, movie.shape[0])
    reader = Reader(movie, camera, first, min(last, movie.shape[0]), counts_budget(config))
    _, _, window = judge_window(reader, config, pool.map)
    stride = max(1, window // STRIDES)
    found: list[BrightStep] = []
    rest: list[BrightStep] = []
    for _, span in plan_chunks(reader, config, window, stride):
        chunk = reader.chunk(span, stride, pool)
        alone, every = find_bright_steps(
            chunk,
            window,
            pixel_nm=_pixel_nm(config),
            resolution_nm=config.optics.wavelength_nm / config.optics.na,
            roi_px=_roi_px(config),
            most=MOST_SIGHTS,
            mapper=pool.map,
        )
        found += alone
        rest += every
        bright = [step for step in found if step.snr > FAINTEST]
        if len(bright) >= MOST_SIGHTS:
            break
    bright.sort(key=lambda step: -step.snr)
    unique = _without_repeats(bright)
    others = _without_repeats(rest)
    sights = [
        [
            replace(_sight_of(step, config), neighbours=_neighbours(step, others, config))
            for step in steps
        ]
        for steps in (unique[:MOST_SIGHTS], others)
    ]
    return sights[0], sights[1]


def _neighbours(
    step: BrightStep, others: Sequence[BrightStep], config: Config
) -> tuple[tuple[int, float], ...]:
    """List the steps whose rings change while a step's frames are summed, and by what share."""
    found = []
    for number, other in enumerate(others):
        apart = math.hypot(step.x_px - other.x_px, step.y_px - other.y_px) * _pixel_nm(config)
        if apart > RINGS_NM or (abs(step.frame - other.frame) < 5 and apart < SAME_NM):
            continue
        shares = [
            (stop - min(max(other.frame, start), stop)) / max(stop - start, 1)
            for start, stop in (step.frames_before, step.frames_after)
        ]
        if shares[1] > shares[0]:
            found.append((number, shares[1] - shares[0]))
    return tuple(found)


def _without_repeats(steps: Iterable[BrightStep]) -> list[BrightStep]:
    """Leave out the second of two that chunks with common frames have both found."""
    kept: list[BrightStep] = []
    for step in steps:
        if not any(
            abs(step.frame - other.frame) < 5
            and math.hypot(step.x_px - other.x_px, step.y_px - other.y_px) < 5
            for other in kept
        ):
            kept.append(step)
    return kept


def bound_sights(movie: Stack, config: Config, camera: Camera) -> tuple[list[Sight], list[Sight]]:
    """Find bright particles that bound between two ranges of frames.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        Resolved, with background frames or a known level.
    camera : Camera
        Counts → photoelectrons.

    Returns
    -------
    sights : list of Sight
        At most `MOST_SIGHTS`, the brightest first.
    others : list of Sight
        Every bright particle, on small regions.
    """
    before, after = frame_ranges(movie, config)
    windows = _windows(movie, config, camera, before, after)
    ratio = windows.power_ratio
    # the noise of a known background is none
    noise_before = windows.before_e + windows.read_variance_before_e2 if windows.n_before else 0.0
    variance = windows.after_e + windows.read_variance_after_e2 + ratio**2 * noise_before
    used = ~windows.masked & (windows.before_e > 0) & (windows.after_e > 0)
    energy = energy_of(windows.after_e - ratio * windows.before_e, variance, used, _spot_px(config))
    model = build_microscope(config, 1000.0, settings_of(config))

    def cut_out(row: int, column: int, side: int) -> Sight:
        region = _region(row, column, side)
        grid = PixelGrid.region(*region, _pixel_nm(config))
        cut = slice(*region[0]), slice(*region[1])
        if windows.n_before:
            likelihood = conditional(
                model, grid, windows.before_e[cut], windows.after_e[cut], ratio,
                read_variance_before_e2=windows.read_variance_before_e2[cut],
                read_variance_after_e2=windows.read_variance_after_e2[cut],
                masked=windows.masked[cut],
            )  # fmt: skip
        else:
            level = ratio * windows.before_e[cut]
            likelihood = poisson(
                model, grid, windows.after_e[cut], level, level,
                extra_variance_e2=windows.read_variance_after_e2[cut], masked=windows.masked[cut],
            )  # fmt: skip
        return _centred(likelihood, config, frame=after[0])

    pixel = _pixel_nm(config)
    sights, others = (
        [
            cut_out(row, column, side)
            for row, column in find_bright_places(
                energy, pixel_nm=pixel, alone_nm=alone_nm, roi_px=side
            )
        ]
        for alone_nm, side in ((APART_NM, _roi_px(config)), (0.0, round(OTHERS_NM / pixel)))
    )

    def with_neighbours(sight: Sight) -> Sight:
        apart = [math.hypot(sight.x_nm - o.x_nm, sight.y_nm - o.y_nm) for o in others]
        near = [(k, 1.0) for k, d in enumerate(apart) if SAME_NM < d < RINGS_NM]
        return replace(sight, neighbours=tuple(near))

    return _bright(map(with_neighbours, sights)), [with_neighbours(o) for o in others]


def scan_sights(movie: Stack, config: Config, camera: Camera) -> list[Sight]:
    """Cut the particles of a scan of the focus out of its frames.

    The particles stay where they are, so that no frame shows the background alone.  It comes from
    ``background.frames`` where the movie has some; otherwise it is taken for even around each
    particle, at a level that is fitted in every picture.

    Parameters
    ----------
    movie : Stack
        The scan.
    config : Config
        Resolved; ``optics.focus_nm`` is that of the first frame that is fitted.
    camera : Camera
        Counts → photoelectrons.

    Returns
    -------
    list of Sight
        At most `MOST_SIGHTS`, spread evenly over the frames.
    """
    known = config.background.frames
    start = known[1] if known else 0
    first, last = config.fit.frames or (start, movie.shape[0])
    counts = movie.read(first, last)
    check_counts(counts, first, movie.name, camera=camera)
    frames = camera.to_electrons(counts)
    read = camera.read_variance_e2((movie.shape[1], movie.shape[2]))
    background, n_before = np.ones(read.shape), 0
    if known:
        n_before = known[1] - known[0]
        background = camera.to_electrons(movie.read(*known)).sum(axis=0)
    ratios = np.array([np.median(frame / background) for frame in frames])
    energies = []
    for frame, ratio in zip(frames, ratios, strict=True):
        noise = ratio**2 * (background + n_before * read) if n_before else 0.0
        energies.append(
            energy_of(frame - ratio * background, frame + read + noise, frame > 0, _spot_px(config))
        )
    energy = np.mean(energies, axis=0) * math.sqrt(len(energies))
    places = find_bright_places(
        energy, pixel_nm=_pixel_nm(config), alone_nm=ALONE_NM, roi_px=_roi_px(config)
    )
    model = build_microscope(config, 1000.0, settings_of(config))
    saturated = np.any(camera.saturated(counts), axis=0)
    sights: list[Sight] = []
    per_place = max(1, MOST_SIGHTS // max(len(places), 1))
    taken = np.unique(np.linspace(0, len(frames) - 1, min(per_place, len(frames))).round())
    for row, column in places[:MOST_SIGHTS]:
        region = _region(row, column, _roi_px(config))
        grid = PixelGrid.region(*region, _pixel_nm(config))
        cut = slice(*region[0]), slice(*region[1])
        masked = np.asarray(saturated)[cut]
        seen: list[Sight] = []
        for index in taken.astype(int):
            frame, ratio = frames[index][cut], float(ratios[index])
            if n_before:
                likelihood = conditional(
                    model, grid, background[cut], frame, ratio,
                    read_variance_before_e2=n_before * read[cut],
                    read_variance_after_e2=read[cut], masked=masked,
                )  # fmt: skip
            else:
                level = np.full(frame.shape, float(np.median(frame)))
                likelihood = poisson(
                    model, grid, frame, level, level, extra_variance_e2=read[cut], masked=masked
                )
            sight = _centred(likelihood, config, frame=first + int(index))
            seen.append(replace(sight, focus_steps=float(index)))
        weights = [sight.snr**2 for sight in seen]
        x_nm, y_nm = (
            float(np.average([getattr(sight, key) for sight in seen], weights=weights))
            for key in ("x_nm", "y_nm")
        )
        sights += [replace(sight, x_nm=x_nm, y_nm=y_nm) for sight in seen]
    return _bright(sights)


def _windows(
    movie: Stack,
    config: Config,
    camera: Camera,
    before: tuple[int, int] | None,
    after: tuple[int, int],
) -> Windows:
    def check(counts: NDArray[Any], first: int) -> None:
        check_counts(counts, first, movie.name, camera=camera)

    return measure_windows(
        movie, camera, before, after, median=config.background.method == "median",
        level_e=config.background.level_e,
        power_normalization=config.background.power_normalization, check=check,
    )  # fmt: skip


def _centred(likelihood: Likelihood, config: Config, *, frame: int) -> Sight:
    """Make a sight of a picture, from the centre of its energy."""
    grid = likelihood.grid
    information = likelihood.signal_information()
    contrast = np.nan_to_num(likelihood.measured_signal())
    used = information > 0
    contrast = np.where(used, contrast - np.average(contrast, weights=information), 0.0)
    variance = 1 / np.where(used, information, 1e-6)
    y, x, snr = centre_of_energy(contrast, variance, grid.pixel_nm)
    return Sight(
        grid=grid, kind=likelihood.kind, data=likelihood.data,
        x_nm=float(grid.x_nm[0] + x * grid.pixel_nm), y_nm=float(grid.y_nm[0] + y * grid.pixel_nm),
        z_nm=config.particle.height_nm, frame=frame, snr=snr,
    )  # fmt: skip


def _bright(sights: Iterable[Sight]) -> list[Sight]:
    """Keep the pictures that are bright enough, the brightest first."""
    return sorted((s for s in sights if s.snr > FAINTEST), key=lambda s: -s.snr)[:MOST_SIGHTS]


def _sight_of(step: BrightStep, config: Config) -> Sight:
    """Make a sight of a step."""
    grid = PixelGrid.region(step.rows, step.columns, _pixel_nm(config))
    model = build_microscope(config, 1000.0, settings_of(config))
    likelihood = conditional(
        model, grid, step.before_e, step.after_e, step.power_ratio,
        read_variance_before_e2=step.n_before * step.read_variance_e2,
        read_variance_after_e2=step.n_after * step.read_variance_e2, masked=~step.usable,
    )  # fmt: skip
    return _centred(likelihood, config, frame=step.frame)


def _pixel_nm(config: Config) -> float:
    return float(config.camera.pixel_size_nm or math.nan)


def _roi_px(config: Config) -> int:
    return config.fit.roi_px(_pixel_nm(config))


def _spot_px(config: Config) -> float:
    return config.optics.wavelength_nm / config.optics.na / _pixel_nm(config)


def _region(row: int, column: int, side: int) -> tuple[tuple[int, int], tuple[int, int]]:
    first, left = row - side // 2, column - side // 2
    return (first, first + side), (left, left + side)


def reach_nm(sight: Sight) -> float:
    """Distance from a particle, which may move in its picture, to the farthest pixel.

    Parameters
    ----------
    sight : Sight
        The picture.

    Returns
    -------
    float
        Distance [nm].
    """
    return sight.grid.diagonal_nm / 2 + _SHIFT_NM
