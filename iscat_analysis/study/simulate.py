"""Movies with known truth: Poisson counts of the forward model on a static background.

The expected photoelectrons of frame t are P_t·B·|1 + Σ e_i|², with P_t the laser power, B the
static background and e_i the fields of the particles present, which add coherently; in dark field
P_t·(b + s·|Σ E_i|²).  Where the sample drifts, background and particles move together: both are
made on a field larger by the way they go, and its expectation is shifted by the phase of its
Fourier transform, exact for an image that the pixels resolve.  Every frame draws from a generator
of its own, derived from the seed and the frame number, so the bytes do not depend on how the work
is divided.

Particles that move (`movers`) are averaged along their path: each alone, in places that stand for
the exposure, and what two fields make of each other where they meet from their mean places.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import tifffile
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter

from iscat_analysis.camera import camera_from_config, read_map
from iscat_analysis.config import AUTO, Config, Particle
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.files import whole_file
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.local import LocalModels, terms_of
from iscat_analysis.optics.model import photons_per_intensity
from iscat_analysis.optics.scatterers import material
from iscat_analysis.records import FloatArray, Progress, silent
from iscat_analysis.study.movers import MovingParticle, place_movers, track_rows
from iscat_analysis.threads import threads

ComplexArray = NDArray[np.complex128]

TRUTH_COLUMNS = (
    "event", "frame", "leave", "x_px", "y_px", "x_nm", "y_nm", "z_nm", "mass_kda", "contrast",
)  # fmt: skip
"""The columns of ``STACK.truth.csv``."""

TRACK_COLUMNS = ("track", "d_um2_s", "x_middle_nm", "y_middle_nm", "z_middle_nm")
"""Those added where particles move; a row then holds for one frame, with averaged places."""

_STREAMS = {"background": 0, "power": 1, "events": 2, "frames": 3, "movers": 4}
_BATCH = 32  # frames drawn at once
_MARGIN_PX = 8  # around what is ever seen of a sample that drifts
_NO_UUID = "urn:uuid:00000000-0000-0000-0000-000000000000"


@dataclass(frozen=True, eq=False)
class _Still:
    """What does not change until a particle comes or leaves."""

    field: ComplexArray
    expected: FloatArray
    spectrum: ComplexArray | None


def write_stack(
    config: Config,
    path: Path,
    *,
    seed: int | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> pd.DataFrame:
    """Simulate a movie into a TIFF file, with its truth in ``<stem>.truth.csv`` beside it."""
    if config.camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed to simulate: add it, as in camera.pixel_size_nm = 84.4"
        )
    truth_path = path.with_suffix(".truth.csv")
    if not overwrite and (path.exists() or truth_path.exists()):
        found = path if path.exists() else truth_path
        raise DataError(f"{found}: exists already; give another name, or pass `overwrite`")
    movie = Movie(config, config.simulation.seed if seed is None else seed)
    shape = (config.simulation.frames, *config.simulation.shape)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(truth_path) as partial_truth, whole_file(path) as partial:
            tifffile.imwrite(
                partial,
                _counted(movie.frames(config.compute.workers), shape[0], progress),
                shape=shape,
                dtype=np.uint16,
                photometric="minisblack",
                bigtiff=2 * math.prod(shape) > 2**31,
                ome=True,
                metadata=_metadata(config),
            )
            movie.truth.to_csv(partial_truth, index=False, float_format="%.10g")
    except OSError as error:
        reason = error.strerror or f"{error}: is the disk full?"
        raise DataError(f"{path}: cannot be written ({reason})") from None
    return movie.truth


class Movie:
    """A simulated movie, made frame by frame."""

    def __init__(self, config: Config, seed: int) -> None:
        simulation = config.simulation
        self._config = config
        self._seed = seed
        self._pixel_nm = config.camera.pixel_nm
        rate = np.array(simulation.drift_px_per_frame[::-1])
        self.drift_px = np.arange(simulation.frames)[:, None] * rate
        self._margins = self._margins_px()
        rows, columns = (
            (-low, size + high)
            for (low, high), size in zip(self._margins, simulation.shape, strict=True)
        )
        self._grid = PixelGrid.region(rows, columns, self._pixel_nm)
        self.particles = place_particles(config, self._generator("events"))
        self._near_px = config.fit.roi_nm / 2 / self._pixel_nm
        self.movers = place_movers(config, self._near_px, lambda i: self._generator("movers", i))
        heights = [p.z_nm for p in self.particles]
        heights += [float(p.points_nm[..., 2].max()) for p in self.movers]
        reach = self._grid.diagonal_nm + self._pixel_nm
        if not all(p.still for p in self.movers):
            reach += (4 * self._near_px + 8) * self._pixel_nm  # also from beyond a corner
        self._model = forward_model(
            config, reach, z_max_nm=max([config.particle.nominal_height_nm, *heights])
        )
        self._inside = self._model.area.points(self._pixel_nm)
        self._local = None
        if terms_of(config.optics):
            if not all(p.still for p in self.movers):
                raise ConfigError(
                    "optics: particles that move are simulated in a field that is the same "
                    "everywhere: leave out simulation.movers, or the terms of the field"
                )
            self._local = LocalModels(config, self._model, simulation.shape)
        self._camera = camera_from_config(config.camera, simulation.shape, np.uint16)
        self._sample_e = self._background()
        self.background_e = self._sample_e[self._field]
        noise = self._generator("power").standard_normal(simulation.frames)
        self.power = np.maximum(1 + simulation.power_noise * noise, 0.0)
        self._signal_scale = 1.0
        if not self._model.rho:
            light = simulation.photons_per_pixel
            self._signal_scale = photons_per_intensity(self._model, light, self._pixel_nm)
        self._check_range()

    @property
    def truth(self) -> pd.DataFrame:
        """What was put into the movie."""
        peaks = self._peak_contrasts() if self._model.rho else {}
        rows: list[tuple[object, ...]] = [
            (
                i, p.frame, p.leave, p.x_px, p.y_px, p.x_px * self._pixel_nm,
                p.y_px * self._pixel_nm, p.z_nm, p.mass_kda,
                peaks.get((p.z_nm, p.mass_kda)) if self._local is None else self._peak_of(p),
            )
            for i, p in enumerate(self.particles)
        ]  # fmt: skip
        if not self._config.simulation.movers:
            table = pd.DataFrame(rows, columns=list(TRUTH_COLUMNS))
            return table.astype({"leave": "Int64"})
        rows = [(*row, *(None for _ in TRACK_COLUMNS)) for row in rows]
        shape = self._config.simulation.shape
        seen = track_rows(self.movers, shape, self._pixel_nm, self.drift_px, peaks)
        rows += [(i, *row) for i, row in enumerate(seen, len(rows))]
        table = pd.DataFrame(rows, columns=[*TRUTH_COLUMNS, *TRACK_COLUMNS])
        return table.astype({"leave": "Int64", "track": "Int64"})

    def frames(self, workers: int = 1) -> Iterator[NDArray[np.uint16]]:
        """Draw the frames in order; the result does not depend on `workers`."""
        still = self._without_movers()
        with threads(workers) as pool:
            for start in range(0, self.power.size, _BATCH):
                stop = min(start + _BATCH, self.power.size)
                batch = [(t, next(still)) for t in range(start, stop)]
                yield from pool.map(self._draw, batch)

    def expected_frames(self) -> Iterator[FloatArray]:
        """Yield the expected photoelectrons of each frame in order, shape (y, x)."""
        for t, still in enumerate(self._without_movers()):
            yield self._light(t, still)

    def _without_movers(self) -> Iterator[_Still]:
        """Yield what every frame has in common with the one before, until that changes."""
        q = self._inside[1].size
        rows, columns = self._grid.shape
        field = np.zeros((self._components, rows * q, columns * q), dtype=complex)
        present: dict[int, ComplexArray] = {}
        particles = [*self.particles, *(self._standing(p) for p in self.movers if p.still)]
        still, risen = None, 0
        for t in range(self.power.size):
            if self._local is not None and (rise := self._local.rise(t)) != risen:
                present = {i: self._field_of(particles[i], t) for i in present}
                field = sum(present.values(), start=np.zeros_like(field))
                still, risen = None, rise
            for i, particle in enumerate(particles):
                if particle.frame == t:
                    present[i] = self._field_of(particle, t)
                    field = field + present[i]
                    still = None
                if particle.leave == t and i in present:
                    field = field - present.pop(i)
                    still = None
            if still is None:
                current = self._electrons(self._signal(field))
                spectrum = fft.rfft2(current) if self.drift_px.any() else None
                still = _Still(field, current, spectrum)
            yield still

    def _light(self, frame: int, still: _Still) -> FloatArray:
        """Give the photoelectrons expected in a frame, particles that move among them."""
        current, spectrum = still.expected, still.spectrum
        there = ((p, frame - p.first) for p in self.movers if not p.still)
        inside = ((p, i) for p, i in there if 0 <= i < len(p.mean_nm))
        moving = [(p, i) for p, i in inside if self._near(p.mean_nm[i])]
        if moving:
            current = self._electrons(self._signal(still.field) + self._moving(moving, still.field))
            current = np.maximum(current, 0.0)
            spectrum = fft.rfft2(current) if spectrum is not None else None
        if spectrum is None:
            return np.asarray(self.power[frame] * current)
        return np.asarray(self.power[frame] * self._shifted(spectrum, frame))

    def _moving(self, moving: list[tuple[MovingParticle, int]], field: ComplexArray) -> FloatArray:
        """Signal of particles that move, beside that of a field that stands still."""
        rows, columns = self._grid.shape
        signal, meeting = np.zeros((rows, columns)), np.zeros(field.shape[1:])
        together = field
        for particle, i in moving:
            points = particle.points_nm[i]
            for x, y, z in points:
                image = self._model.image(self._grid, x, y, z, particle.mass_kda)
                signal += image / len(points)
            if len(moving) > 1 or field.any():
                x, y, z = particle.mean_nm[i]
                alone = self._field_at(x, y, z, particle.mass_kda)
                meeting += 2 * np.sum(together * alone.conj(), axis=0).real
                together = together + alone
        return signal + self._in_pixels(meeting)

    def _near(self, place_nm: FloatArray) -> bool:
        """Whether a particle is so near the sample's part that is drawn that its light matters."""
        grid, margin = self._grid, (self._near_px + 1) * self._pixel_nm
        x, y = place_nm[:2]
        return bool(
            grid.x_nm[0] - margin <= x <= grid.x_nm[-1] + margin
            and grid.y_nm[0] - margin <= y <= grid.y_nm[-1] + margin
        )

    def _standing(self, particle: MovingParticle) -> SimulatedParticle:
        """Take a particle that does not move for one that lands."""
        x, y, z = particle.mean_nm[0]
        dx, dy = self.drift_px[particle.first, ::-1]
        return SimulatedParticle(
            particle.first, particle.first + len(particle.mean_nm), x / self._pixel_nm + dx,
            y / self._pixel_nm + dy, z, particle.mass_kda,
        )  # fmt: skip

    def _signal(self, field: ComplexArray) -> FloatArray:
        """Intensity with the reference, of a field that is given on the samples inside pixels."""
        reference = np.zeros((self._components, 1, 1))
        reference[0] = self._model.rho
        return self._in_pixels(np.sum(np.abs(reference + field) ** 2, axis=0))

    def _in_pixels(self, intensity: FloatArray) -> FloatArray:
        """Average over the samples inside each pixel."""
        weights = self._inside[1]
        rows, columns = self._grid.shape
        inside = intensity.reshape(rows, weights.size, columns, weights.size)
        return np.asarray(np.einsum("yixj,i,j->yx", inside, weights, weights))

    def _electrons(self, signal: FloatArray) -> FloatArray:
        if self._model.rho:
            return np.asarray(self._sample_e * signal)
        return np.asarray(self._sample_e + self._signal_scale * signal)

    @cached_property
    def _components(self) -> int:
        """Components of the field whose light is added up, two and what incoherent light adds."""
        here = self._model.field(np.zeros(1), np.zeros(1), self._model.height_nm, 1.0)
        return max(2, len(here))

    @property
    def _field(self) -> tuple[slice, slice]:
        """Where the camera's field lies in the sample."""
        (top, _), (left, _) = self._margins
        rows, columns = self._config.simulation.shape
        return slice(top, top + rows), slice(left, left + columns)

    def _margins_px(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pixels of sample before and after the camera's rows and columns."""
        simulation = self._config.simulation
        measured = simulation.background not in ("flat", "speckle")

        def margin(way: FloatArray, size: int) -> tuple[int, int]:
            if not way.any():
                return 0, 0
            low, high = math.ceil(max(way.max(), 0)), math.ceil(max(-way.min(), 0))
            if max(low, high) > size:
                raise ConfigError(
                    f"simulation.drift_px_per_frame moves the sample by {max(low, high)} pixels, "
                    f"out of a field of {size}: lower it, or simulate fewer frames"
                )
            # a measured image is continued by its reflection, of which a whole period closes
            spare = size - low - high if measured else 2 * _MARGIN_PX
            return low + spare // 2, high + spare - spare // 2

        rows, columns = simulation.shape
        return margin(self.drift_px[:, 0], rows), margin(self.drift_px[:, 1], columns)

    def _shifted(self, spectrum: ComplexArray, frame: int) -> FloatArray:
        """Give what the camera sees of the sample in a frame."""
        rows, columns = self._grid.shape
        dy, dx = self.drift_px[frame]
        phase_y = np.exp(-2j * np.pi * dy * fft.fftfreq(rows))
        phase_x = np.exp(-2j * np.pi * dx * fft.rfftfreq(columns))
        moved = fft.irfft2(spectrum * phase_y[:, None] * phase_x, s=(rows, columns))
        return np.asarray(np.maximum(moved[self._field], 0.0))

    def _field_of(self, particle: SimulatedParticle, frame: int) -> ComplexArray:
        return self._field_at(*self._place_nm(particle), particle.z_nm, particle.mass_kda, frame)

    def _place_nm(self, particle: SimulatedParticle) -> tuple[float, float]:
        """Where a particle is in the sample."""
        dy, dx = self.drift_px[particle.frame]
        return (particle.x_px - dx) * self._pixel_nm, (particle.y_px - dy) * self._pixel_nm

    def _field_at(
        self, x_nm: float, y_nm: float, z_nm: float, mass_kda: float, frame: int | None = None
    ) -> ComplexArray:
        """Field of a particle in the sample, on the samples inside each pixel."""
        offsets = self._inside[0]
        x = (self._grid.x_nm[:, None] + offsets).ravel() - x_nm
        y = (self._grid.y_nm[:, None] + offsets).ravel() - y_nm
        dx, dy = np.meshgrid(x, y)
        field = np.zeros((self._components, *dx.shape), dtype=complex)  # an analyser leaves one
        model = self._model if self._local is None else self._local.at(x_nm, y_nm, frame)
        given = model.field(dx, dy, z_nm, mass_kda)
        field[: len(given)] = given
        return field

    def _draw(self, job: tuple[int, _Still]) -> NDArray[np.uint16]:
        frame, still = job
        expected = self._light(frame, still)
        rng = self._generator("frames", frame)
        camera = self._camera
        electrons = rng.poisson(expected).astype(float)
        if camera.well_depth_e is not None:
            electrons = np.minimum(electrons, camera.well_depth_e)
        if np.any(np.asarray(camera.read_noise_e) > 0):
            electrons += camera.read_noise_e * rng.standard_normal(electrons.shape)
        counts = np.rint(electrons / camera.gain_e_per_adu + camera.offset_adu)
        return np.clip(counts, 0, np.iinfo(np.uint16).max).astype(np.uint16)

    def _generator(self, stream: str, index: int = 0) -> np.random.Generator:
        return np.random.default_rng(
            np.random.SeedSequence(self._seed, spawn_key=(_STREAMS[stream], index))
        )

    def _background(self) -> FloatArray:
        simulation = self._config.simulation
        shape = self._grid.shape
        if not self._config.optics.interferes:
            level = self._config.background.level_e or 0.0
        else:
            level = simulation.photons_per_pixel
        if simulation.background == "flat":
            return np.full(shape, level)
        if simulation.background == "speckle":
            optics = self._config.optics
            grain_px = max(0.21 * optics.wavelength_nm / optics.na / self._pixel_nm, 0.5)
            white = self._generator("background").standard_normal(shape)
            noise = gaussian_filter(white, grain_px, mode="wrap")
            if self.drift_px.any():
                noise = self._resolved(noise)
            pattern = 1 + simulation.speckle_contrast * (noise - noise.mean()) / noise.std()
            return np.asarray(level * np.maximum(pattern, 0.05))
        image = read_map(Path(simulation.background), "simulation.background", simulation.shape)
        if not image.mean() > 0 or (image < 0).any():
            raise ConfigError(
                f"{simulation.background}: simulation.background needs a non-negative image"
            )
        around = np.pad(image, self._margins, mode="symmetric")
        return np.asarray(around * (level / image.mean()))

    def _resolved(self, image: FloatArray) -> FloatArray:
        """Take off detail finer than the optics pass, 2 NA/λ: moved, it would not be the same."""
        optics, spectrum = self._config.optics, fft.rfft2(image)
        rows, columns = image.shape
        finest = 2 * optics.na / optics.wavelength_nm * self._pixel_nm
        detail = np.hypot(fft.fftfreq(rows)[:, None], fft.rfftfreq(columns))
        return np.asarray(fft.irfft2(np.where(detail < finest, spectrum, 0.0), s=(rows, columns)))

    def _peak_contrasts(self) -> dict[tuple[float, float], float]:
        """Peak contrast for every height and mass that occurs."""
        kinds = {(p.z_nm, p.mass_kda) for p in self.particles}
        for p in self.movers:
            heights = np.unique(p.mean_nm[:, 2])
            if heights.size > 1:
                # of a particle that moves up and down, to find its highest contrast
                heights = np.linspace(heights[0], heights[-1], 64)
            kinds |= {(float(z), p.mass_kda) for z in heights}
        return {kind: self._model.peak_contrast(*kind) for kind in kinds}

    def _peak_of(self, particle: SimulatedParticle) -> float | None:
        """Peak contrast of a particle where it lands, in a field that is not even."""
        if self._local is None or not self._model.rho:
            return None
        local = self._local.at(*self._place_nm(particle), particle.frame)
        return local.peak_contrast(particle.z_nm, particle.mass_kda)

    def _check_range(self) -> None:
        camera = self._camera
        peak = max((0.0, *self._peak_contrasts().values()))
        level = float(self._sample_e.max())
        top = level * (1 + peak) if self._model.rho else level + self._signal_scale * peak
        top *= float(self.power.max())
        top += 6 * math.sqrt(top)
        most, offset = np.iinfo(np.uint16).max, float(np.max(camera.offset_adu))
        if self._config.camera.gain_e_per_adu == AUTO and offset < most:
            needed = math.ceil(top / (most - offset))  # 1 where counts can be photoelectrons
            self._camera = camera = replace(camera, gain_e_per_adu=float(max(needed, 1)))
        top = top / np.min(camera.gain_e_per_adu) + offset
        if top > most and camera.well_depth_e is None:
            raise ConfigError(
                f"the brightest pixel would hold {top:.0f} counts, more than 16 bits: raise "
                "camera.gain_e_per_adu or lower simulation.photons_per_pixel"
            )


def _counted(
    frames: Iterator[NDArray[np.uint16]], total: int, progress: Progress
) -> Iterator[NDArray[np.uint16]]:
    for done, frame in enumerate(frames, 1):
        yield frame
        progress("simulate", done, total)


def _metadata(config: Config) -> dict[str, object]:
    rate, pixel_um = config.camera.frame_rate_hz, config.camera.pixel_nm / 1000
    metadata: dict[str, object] = {"axes": "TYX", "UUID": _NO_UUID}  # random, files would differ
    for axis in "XY":
        metadata |= {f"PhysicalSize{axis}": pixel_um, f"PhysicalSize{axis}Unit": "µm"}
    return metadata | (
        {} if rate is None else {"TimeIncrement": 1 / rate, "TimeIncrementUnit": "s"}
    )


@dataclass(frozen=True)
class SimulatedParticle:
    """One simulated particle: where, when, how heavy; its place is that in the frame it lands."""

    frame: int
    leave: int | None
    x_px: float
    y_px: float
    z_nm: float
    mass_kda: float


def place_particles(config: Config, rng: np.random.Generator) -> tuple[SimulatedParticle, ...]:
    """Place the particles that stand still: those that are listed, or so many anywhere."""
    simulation, particle = config.simulation, config.particle
    pixel_nm = config.camera.pixel_nm
    nominal = material(particle, config.optics.wavelength_nm).mass_kda
    if simulation.count is None:
        particles = []
        for e in sorted(simulation.events, key=lambda e: e.frame):
            z = _height_nm(particle, e.mass_kda or nominal, rng) if e.z_nm is None else e.z_nm
            mass = nominal if e.mass_kda is None else e.mass_kda
            particles.append(SimulatedParticle(e.frame, e.leave, e.x_px, e.y_px, z, mass))
        return tuple(particles)
    margin = min(config.fit.roi_nm / 2 / pixel_nm, (min(simulation.shape) - 1) / 2)
    (rows, columns), count = simulation.shape, simulation.count
    x = rng.uniform(margin, columns - 1 - margin, count).tolist()
    y = rng.uniform(margin, rows - 1 - margin, count).tolist()
    first = config.background.recorded
    start = first[1] if first is not None else simulation.frames // 20
    ends = start, max(simulation.frames - start // 2, start + 1)
    landing = np.sort(rng.integers(*ends, count)).tolist()
    species = np.array(simulation.species or (nominal,))
    masses = rng.permutation(species[np.arange(count) % species.size]).tolist()
    leavers = set(rng.choice(count, simulation.leavings, replace=False).tolist())
    particles = []
    for i, (frame, mass) in enumerate(zip(landing, masses, strict=True)):
        leaves = i in leavers and frame + 1 < simulation.frames
        leave = int(rng.integers(frame + 1, simulation.frames)) if leaves else None
        z = _height_nm(particle, mass, rng)
        particles.append(SimulatedParticle(frame, leave, x[i], y[i], z, mass))
    return tuple(particles)


def _height_nm(particle: Particle, mass_kda: float, rng: np.random.Generator) -> float:
    """Give a particle's height: as expected, or drawn around that until it is above the glass."""
    mean, sd = particle.mean_height_nm(mass_kda), particle.height_sd_nm
    if not sd:
        return mean
    height = -1.0
    while height < 0:
        height = float(rng.normal(mean, sd))
    return height
