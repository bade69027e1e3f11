"""Pictures of the bright particles of a movie, from which its microscope is measured.

No microscope takes part in finding them: not where they are, and not what they look like.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np

from iscat_analysis.camera import Camera, check_counts
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import NoiseSurvey, judge_window
from iscat_analysis.fitting.context import variance_of_background
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.ranges import (
    background_mode,
    fitted_frames,
    frame_ranges,
    measured_windows,
)
from iscat_analysis.inference.counts import choose_noise, conditional, counts_likelihood, poisson
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.particle_image import (
    PRIVATE,
    RINGS_NM,
    TESTED,
    Images,
    ParticleImage,
    build_microscope,
    contrast_of,
)
from iscat_analysis.movie import Stack
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.parameters import FAINTEST, LEAST_IMAGES, MOST_IMAGES, settings_of
from iscat_analysis.records import FloatArray, Windows
from iscat_analysis.search.bright import (
    ALONE_NM,
    BrightStep,
    centre_of_energy,
    energy_of,
    find_bright_places,
    find_bright_steps,
)
from iscat_analysis.search.chunks import Reader, plan_parts, reader_of
from iscat_analysis.search.frames import FieldSums, Tile
from iscat_analysis.search.sliding import stride_of

APART_NM = 2000.0
"""Particles that all bound at once are used if no other is nearer; the rings are accounted for."""

OTHERS_NM = 1700.0
"""Side of the region on which a neighbour is fitted."""

SAME_NM = 800.0
"""Nearer than this, and at the same time, two steps are one."""


@dataclass(frozen=True)
class Recording:
    """A movie, and what its pictures are found with."""

    movie: Stack
    config: Config
    camera: Camera
    pool: ThreadPoolExecutor
    opening: NoiseSurvey | None = None

    def summed(self) -> Windows:
        """Sum the frames before and after particles bound."""
        ranges = frame_ranges(self.movie, self.config)
        return measured_windows(self.movie, self.config, self.camera, *ranges)

    def origin(self, kind: str = "") -> dict[str, str]:
        """Say what movie it is and what it shows, for the record of a calibration."""
        sliding = background_mode(self.config) == "sliding"
        return {
            "movie": self.movie.path.name,
            "sha256": self.movie.sha256(),
            "kind": kind or ("landing movie" if sliding else "frames before and after"),
            "version": version("iscat-analysis"),
        }


def bright_particle_images(
    recording: Recording, *, rings: bool = True, whole: bool = False
) -> tuple[Images, Images]:
    """Find the bright particles of a movie, in the way in which it is analysed.

    Particles with heights of their own are known only from fits of the whole field: there are none
    then, where frames before and after are compared.
    """
    movie, config, camera = recording.movie, recording.config, recording.camera
    if background_mode(config) != "sliding":
        if config.heights_free and background_mode(config) == "fixed":
            return [], []
        return bright_places(recording.summed(), config)
    if (opening := recording.opening) is not None:
        reader, window = opening.reader, opening.window
    else:
        reader = reader_of(movie, config, camera, fitted_frames(movie, config))
        window = judge_window(reader.sampled, config)[2]
    return landing_particle_images(reader, window, recording, rings=rings, whole=whole)


def landing_particle_images(
    reader: Reader, window: int, recording: Recording, *, rings: bool, whole: bool
) -> tuple[Images, Images]:
    """Find bright steps of a landing movie, chunk by chunk until there are enough."""
    config, pool = recording.config, recording.pool
    stride = stride_of(window)
    found: list[BrightStep] = []
    rest: list[BrightStep] = []
    parts = [part for chunk in plan_parts(reader, config, window) for part in chunk]
    most = enough = MOST_IMAGES if rings else TESTED
    if whole:
        chosen = np.linspace(0, len(parts) - 1, min(len(parts), 8)).round().astype(int)
        parts = [parts[k] for k in chosen]
        most = math.ceil(MOST_IMAGES / len(parts))
    bright: list[BrightStep] = []
    sums: FieldSums | None = None
    for part in parts:
        if part.tile is None:
            chunk = reader.chunk(part.span, stride, pool)
        else:
            if sums is None or sums.span != part.span:
                sums = reader.field_sums(part.span, pool)
            chunk = reader.tile_chunk(sums.part(part.tile.here), part.tile, stride, pool)
        wanted = config.background.follows_pattern
        chunk, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
        steps = find_bright_steps(chunk, window, config, motion=pattern, mapper=pool.map)
        found += _in_field(steps.alone(most), part.tile)
        rest += _in_field(steps.every() if rings else (), part.tile)
        bright = [step for step in found if step.snr > FAINTEST]
        if len(bright) >= enough and not whole:
            break
    bright.sort(key=lambda step: -step.snr)
    unique = _standards(_without_repeats(bright))
    others = _without_repeats(rest)
    model = build_microscope(config, 1000.0, settings_of(config))
    images, around = (
        [_particle_image_of(step, others, config, model) for step in steps]
        for steps in (unique[:MOST_IMAGES], others)
    )
    return images, around


def _in_field(steps: Iterable[BrightStep], tile: Tile | None) -> list[BrightStep]:
    """Keep the steps of the core of a tile, and count their places from the corner of the field."""
    if tile is None:
        return list(steps)
    y, x = tile.corner
    moved = [
        replace(
            step,
            y_px=step.y_px + y,
            x_px=step.x_px + x,
            rows=(step.rows[0] + y, step.rows[1] + y),
            columns=(step.columns[0] + x, step.columns[1] + x),
        )
        for step in steps
    ]
    return [step for step in moved if tile.holds(np.array(step.y_px), np.array(step.x_px))]


def _standards(bright: Sequence[BrightStep]) -> list[BrightStep]:
    """Leave out what is far brighter than the others: a vesicle or an aggregate is no point.

    A few of these would outweigh all particles, as the square of the brightness.  Of few particles
    each counts.
    """
    if len(bright) < LEAST_IMAGES:
        return list(bright)
    middle = float(np.median([step.snr for step in bright[:LEAST_IMAGES]]))
    # times the median signal-to-noise ratio of the brightest, from which one is no standard
    return [step for step in bright if step.snr <= 5.0 * middle]


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


def bright_places(
    windows: Windows, config: Config, alone_nm: float = APART_NM
) -> tuple[Images, Images]:
    """Find bright particles that bound between two ranges of frames."""
    ratio = windows.power_ratio
    # the noise of a known background is none
    noise_before = windows.before_e + windows.read_variance_before_e2 if windows.n_before else 0.0
    variance = windows.after_e + windows.read_variance_after_e2 + ratio**2 * noise_before
    used = ~windows.masked & (windows.before_e > 0) & (windows.after_e > 0)
    energy = energy_of(windows.after_e - ratio * windows.before_e, variance, used, _spot_px(config))
    pixel, cut_out = config.camera.pixel_nm, _cutter(windows, config)
    images, others = (
        [
            cut_out(row, column, side)
            for row, column in find_bright_places(
                energy, pixel_nm=pixel, alone_nm=apart_nm, roi_px=side
            )
        ]
        for apart_nm, side in ((alone_nm, config.roi_px), (0.0, round(OTHERS_NM / pixel)))
    )
    seen = _bright(_among(image, others, SAME_NM) for image in images)
    return seen, [_among(other, others, SAME_NM) for other in others]


def known_places(
    windows: Windows, config: Config, known: Sequence[FloatArray]
) -> tuple[Images, Images]:
    """Cut out particles that are known, those that are farthest from others.

    Shapes: `known` (5,).
    """
    pixel, cut_out = config.camera.pixel_nm, _cutter(windows, config)
    heights = config.fit.z_range_nm if config.heights_free else None

    def cut(chosen: FloatArray, side: int) -> Images:
        places = np.rint(chosen[:, 1::-1] / pixel).astype(int).tolist()
        return [
            replace(cut_out(row, column, side).moved(theta), heights_nm=heights)
            for (row, column), theta in zip(places, chosen, strict=True)
        ]

    thetas = np.array(known).reshape(-1, PRIVATE)
    places_nm = thetas[:, :2]
    others = cut(thetas, round(OTHERS_NM / pixel))
    room = (config.roi_px // 2 + 1) * pixel
    far = np.array(windows.after_e.shape[::-1]) * pixel - room
    inside = ((places_nm >= room) & (places_nm < far)).all(axis=1)
    apart = np.hypot(*(places_nm[:, None] - places_nm).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1, initial=np.inf)[inside]
    seen = [_among(image, others, 0.0) for image in cut(thetas[inside], config.roi_px)]
    for alone_nm in (APART_NM, 1600.0, 1300.0, 1000.0, 700.0):
        images = _bright(s for s, d in zip(seen, nearest, strict=True) if d >= alone_nm)
        if len(images) >= LEAST_IMAGES:
            break
    return images, [_among(other, others, 0.0) for other in others]


def _cutter(windows: Windows, config: Config) -> Callable[[int, int, int], ParticleImage]:
    """Give what cuts a square out of the field, as far as it goes."""
    model = build_microscope(config, 1000.0, settings_of(config))
    shape, background = windows.after_e.shape, variance_of_background(config)
    noise = choose_noise("auto", interferes=True, counted=config.background.is_counted)

    def cut_out(row: int, column: int, side: int) -> ParticleImage:
        (top, bottom), (left, right) = _region(row, column, side)
        rows = max(top, 0), min(bottom, shape[0])
        columns = max(left, 0), min(right, shape[1])
        grid = PixelGrid.region(rows, columns, config.camera.pixel_nm)
        part = windows.cut((slice(*rows), slice(*columns)))
        counts = model, grid, part.before_e, part.after_e, windows.power_ratio
        reads = part.read_variance_before_e2, part.read_variance_after_e2
        likelihood = counts_likelihood(
            *counts, background=background, noise=noise, read_variances_e2=reads, masked=part.masked
        )
        return _centred(likelihood, config)

    return cut_out


def _among(image: ParticleImage, others: Images, least_nm: float) -> ParticleImage:
    """Tell an image which of the others are near, but not so near that they are the same."""
    apart = [math.hypot(image.x_nm - o.x_nm, image.y_nm - o.y_nm) for o in others]
    near = [(k, 1.0) for k, d in enumerate(apart) if least_nm < d < RINGS_NM]
    return replace(image, neighbours=tuple(near))


def scan_particle_images(recording: Recording) -> Images:
    """Cut the particles of a scan of the focus out of its frames.

    The particles stay where they are, so that no frame shows the background alone.  It comes from
    ``background.frames`` where the movie has some; otherwise it is taken for even around each
    particle, at a level that is fitted in every picture.
    """
    movie, config, camera = recording.movie, recording.config, recording.camera
    known = config.background.recorded
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
    ratios = [float(np.median(frame / background)) for frame in frames]
    noise = background + n_before * read if n_before else np.zeros(read.shape)
    energies = [
        energy_of(f - r * background, f + read + r**2 * noise, f > 0, _spot_px(config))
        for f, r in zip(frames, ratios, strict=True)
    ]
    energy = np.mean(energies, axis=0) * math.sqrt(len(energies))
    places = find_bright_places(
        energy, pixel_nm=config.camera.pixel_nm, alone_nm=ALONE_NM, roi_px=config.roi_px
    )
    model = build_microscope(config, 1000.0, settings_of(config))
    saturated = np.any(camera.saturated(counts), axis=0)
    images: list[ParticleImage] = []
    per_place = max(1, MOST_IMAGES // max(len(places), 1))
    taken = np.unique(np.linspace(0, len(frames) - 1, min(per_place, len(frames))).round())
    for row, column in places[:MOST_IMAGES]:
        region = _region(row, column, config.roi_px)
        grid = PixelGrid.region(*region, config.camera.pixel_nm)
        cut = slice(*region[0]), slice(*region[1])
        masked = np.asarray(saturated)[cut]
        seen: list[ParticleImage] = []
        for index in taken.astype(int):
            frame = frames[index][cut]
            if n_before:
                sums = background[cut], frame, ratios[index]
                reads = n_before * read[cut], read[cut]
                likelihood = conditional(model, grid, *sums, read_variances_e2=reads, masked=masked)
            else:
                level = np.full(frame.shape, float(np.median(frame)))
                likelihood = poisson(
                    model, grid, frame, level, level, extra_variance_e2=read[cut], masked=masked
                )
            seen.append(replace(_centred(likelihood, config), focus_steps=float(index)))
        centres, weights = [(s.x_nm, s.y_nm) for s in seen], [s.snr**2 for s in seen]
        x_nm, y_nm = np.average(centres, axis=0, weights=weights).tolist()
        images += [replace(image, x_nm=x_nm, y_nm=y_nm) for image in seen]
    return _bright(images)


def _centred(likelihood: Likelihood, config: Config) -> ParticleImage:
    """Make an image of a picture, from the centre of its energy."""
    grid, height = likelihood.grid, config.particle.nominal_height_nm
    image = ParticleImage(grid, likelihood.noise, likelihood.data, 0.0, 0.0, height)
    y, x, snr = centre_of_energy(*contrast_of(image), grid.pixel_nm)
    x_nm = float(grid.x_nm[0] + x * grid.pixel_nm)
    y_nm = float(grid.y_nm[0] + y * grid.pixel_nm)
    return replace(image, x_nm=x_nm, y_nm=y_nm, snr=snr)


def _bright(images: Iterable[ParticleImage]) -> Images:
    """Keep the pictures that are bright enough, the brightest first."""
    return sorted((s for s in images if s.snr > FAINTEST), key=lambda s: -s.snr)[:MOST_IMAGES]


def _particle_image_of(
    step: BrightStep, others: Sequence[BrightStep], config: Config, model: ForwardModel
) -> ParticleImage:
    """Make an image of a step among others, whose rings may change while its frames are summed."""
    grid = PixelGrid.region(step.rows, step.columns, config.camera.pixel_nm)
    windows = step.windows
    reads = windows.read_variance_before_e2, windows.read_variance_after_e2
    counts = windows.before_e, windows.after_e, windows.power_ratio * step.motion
    likelihood = conditional(model, grid, *counts, read_variances_e2=reads, masked=windows.masked)
    frames = sum(windows.frames_before) / 2, sum(windows.frames_after) / 2
    near = []
    for number, other in enumerate(others):
        apart = math.hypot(step.x_px - other.x_px, step.y_px - other.y_px) * grid.pixel_nm
        if apart > RINGS_NM or (abs(step.frame - other.frame) < 5 and apart < SAME_NM):
            continue
        before, after = (
            (stop - min(max(other.frame, start), stop)) / max(stop - start, 1)
            for start, stop in (windows.frames_before, windows.frames_after)
        )
        if after > before:
            near.append((number, after - before))
    return replace(_centred(likelihood, config), frames=frames, neighbours=tuple(near))


def _spot_px(config: Config) -> float:
    return config.optics.resolution_nm / config.camera.pixel_nm


def _region(row: int, column: int, side: int) -> tuple[tuple[int, int], tuple[int, int]]:
    first, left = row - side // 2, column - side // 2
    return (first, first + side), (left, left + side)
