"""What the trials of a study share: a microscope, a particle, a noise, and the bounds for them.

Counts are drawn from the expected images of the region that is fitted, as `Windows`, and from there
on everything is the main job's own: `region_likelihood`, `fit_particle`, the bounds of `plan`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iscat_analysis.bounds import EventBounds, Experiment, plan
from iscat_analysis.bounds.experiment import detector, light_of
from iscat_analysis.config import MODES, MOVING, Config, refuse_rod, refuse_sphere
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import Region, region_likelihood
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, Candidate, FloatArray, Windows
from iscat_analysis.study.estimator_setup import EstimatorSetup

START_PX = 1.0
"""How far a start lies from the particle along x and y, at most [pixels]."""


OF_DIPOLES, OF_SPHERES = ("mass", "localize", "joint"), ("size", "localize")
"""Modes that fit dipoles, and those that fit spheres."""


@dataclass(frozen=True)
class Setting:
    """One experiment to be repeated; build it with `make_setting`."""

    config: Config
    context: AnalysisContext
    region: Region
    experiment: Experiment
    truth: FloatArray
    read_variance_e2: float
    level: bool = False

    @property
    def mode(self) -> str:
        """Key of `FREE_PARAMETERS`."""
        return self.context.mode

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return FREE_PARAMETERS[self.mode]

    @property
    def scored(self) -> Mapping[str, int]:
        """Names of what is scored, each with its place among the parameters.

        In mode `size` the mass stands for the diameter, in which it is scored.
        """
        own = "diameter_nm" if MODES[self.mode].fits_sizes else "mass_kda"
        return {own if n == "mass_kda" else n: PARAMETERS.index(n) for n in self.free}

    @property
    def pixels(self) -> int:
        """Side of the fitted square [pixels]."""
        return self.region.rows[1]

    @property
    def bounds(self) -> EventBounds:
        """Bounds over the free parameters, for all frames."""
        return self.experiment.bounds(self.free, level=self.level)

    @property
    def crb(self) -> FloatArray:
        """Joint Cramér–Rao bounds of what is scored, shape (4,)."""
        return self.in_diameters(self.truth, self.bounds.crb_joint)[1]

    @property
    def qcrb(self) -> FloatArray:
        """Quantum bounds of what is scored, shape (4,)."""
        return self.in_diameters(self.truth, self.bounds.qcrb)[1]

    def in_diameters(self, values: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give the diameter in place of the mass, in mode `size`, and its error.

        Shapes: `values, errors` (…, 4).
        """
        if not MODES[self.mode].fits_sizes:
            return values, errors
        values, errors = values.copy(), errors.copy()
        particle, mass = self.config.particle, values[..., 3]
        diameter = particle.nominal_diameter_nm * np.cbrt(mass / particle.nominal_mass_kda)
        errors[..., 3] *= diameter / (3 * mass)
        values[..., 3] = diameter
        return values, errors

    @property
    def experiment_in_region(self) -> Experiment:
        """The experiment with its field where the region is, whose first pixel lies at 0 nm."""
        theta = self.experiment.theta.copy()
        theta[:2] = self.truth[:2]
        return replace(self.experiment, model=self.context.model, grid=self._grid, theta=theta)

    @property
    def _grid(self) -> PixelGrid:
        """Pixels of the region."""
        return PixelGrid.region(self.region.rows, self.region.columns, self.context.pixel_nm)

    def level_e(self) -> float:
        """Return the expected background per pixel and frame [e]."""
        return self._light_e[0]

    def signal_e(self, truth: FloatArray) -> FloatArray:
        """Return the counts that the particle adds to one frame, shape (ny, nx) [e]."""
        return self._light_e[1] * self.context.model.image(self._grid, *(float(v) for v in truth))

    @property
    def _light_e(self) -> tuple[float, float]:
        return light_of(self.config, self.context.model, self.context.pixel_nm)

    def draw(self, truth: FloatArray, random: np.random.Generator | None) -> Windows:
        """Draw the counts of one experiment.

        Shapes: `truth` (4,).
        """
        return self.windows(self.level_e() + self.signal_e(truth), random)

    def windows(
        self, frame_e: FloatArray, random: np.random.Generator | None, *, gain: float = 1.0
    ) -> Windows:
        """Draw counts around any expected frame, for studies of wrong models.

        Shapes: `frame_e` (ny, nx).
        """
        at, shape = self.config.bounds, frame_e.shape
        level, read = np.full(shape, self.level_e()), self.read_variance_e2

        def sums(expected: FloatArray, frames: int) -> FloatArray:
            if random is None:
                return expected
            counts = random.poisson(expected).astype(float)
            return counts + random.normal(0, math.sqrt(frames * read), shape) if read else counts

        after = sums(at.n_after * frame_e, at.n_after)
        before = sums(at.n_before * level, at.n_before) if at.n_before else level
        nothing = np.zeros(shape, dtype=bool)
        first = max(at.n_before, 1)
        return Windows(
            before_e=before * gain,
            after_e=after * gain,
            n_before=first,
            n_after=at.n_after,
            power_ratio=at.n_after / first,
            read_variance_before_e2=np.full(shape, at.n_before * read),
            read_variance_after_e2=np.full(shape, at.n_after * read),
            masked=nothing,
            saturated=nothing,
            frames_before=(0, at.n_before),
            frames_after=(at.n_before, at.n_before + at.n_after),
            power=np.ones(0),
        )

    def likelihood(self, windows: Windows) -> Likelihood:
        """Likelihood of drawn counts, as the main job makes it."""
        return region_likelihood(self.context, windows, self.region, None)

    def start(self, truth: FloatArray, random: np.random.Generator) -> Candidate:
        """Where a fit begins: near the particle, as a detection would be.

        Shapes: `truth` (4,).
        """
        shift = random.uniform(-START_PX, START_PX, 2)
        place = truth[:2] / self.context.pixel_nm + shift
        # factor between a start's mass and the particle's, at most
        factor = 1.5 ** random.uniform(-1, 1)
        low, high = self.config.fit.z_range_nm
        z = random.uniform(low, high)
        return Candidate(
            x_px=float(place[0]),
            y_px=float(place[1]),
            z_nm=float(z if "z_nm" in self.free else truth[2]),
            mass_kda=float(truth[3] * (factor if "mass_kda" in self.free else 1.0)),
            snr=0.0,
        )

    def described(self) -> dict[str, Any]:
        """Say what was simulated, as plain values."""
        at, optics, particle = self.config.bounds, self.config.optics, self.config.particle
        centre = (self.pixels - 1) / 2 * self.context.pixel_nm
        sphere = {"diameter_nm": particle.nominal_diameter_nm} if particle.is_sphere else {}
        collected = {"camera": self.experiment.on_camera, "collected": self.experiment.collected}
        return {
            "scheme": optics.scheme,
            "mode": self.mode,
            **dict(zip(PARAMETERS, (self.truth - [centre, centre, 0, 0]).tolist(), strict=True)),
            **sphere,
            "focus_nm": optics.focus_nm,
            "attenuation": optics.attenuation if self.context.model.rho else 0.0,
            "na": optics.na,
            "pixel_size_nm": self.context.pixel_nm,
            "pixels": self.pixels,
            **{name: getattr(at, name) for name in ("photons_per_pixel", "n_before", "n_after")},
            "read_noise_e": math.sqrt(self.read_variance_e2),
            "level_fitted": self.level,
            "n_scattered": collected,
        }


def setup_of(setting: Setting, start: FloatArray) -> EstimatorSetup:
    """Say what an estimator may know.

    Shapes: `start` (n, 4).
    """
    config, optics = setting.config, setting.config.optics
    signal = setting.signal_e(setting.truth)
    return EstimatorSetup(
        mode=setting.mode,
        free=setting.free,
        optics=optics,
        particle=config.particle,
        camera=config.camera,
        calibration=config.calibration,
        pixel_size_nm=setting.context.pixel_nm,
        photons_per_pixel=setting.level_e(),
        n_before=config.bounds.n_before,
        n_after=config.bounds.n_after,
        interferes=not setting.context.additive,
        polarity=int(np.sign(signal.flat[np.argmax(np.abs(signal))])) or 1,
        psf_sigma_nm=0.21 * optics.wavelength_nm / optics.na,
        z_range_nm=config.fit.z_range_nm,
        level_fitted=setting.level,
        start=start,
    )


def make_setting(
    config: Config,
    mode: str,
    *,
    collected: float | None = None,
    z_nm: float | None = None,
    context: AnalysisContext | None = None,
) -> Setting:
    """Set up one experiment."""
    refuse_rod(config, "these studies are of dipoles and spheres")
    if mode not in OF_SPHERES:
        refuse_sphere(config, "challenges and the estimators of others are of dipoles")
    pixel_nm = config.camera.pixel_size_nm
    side = config.fit.roi_px(pixel_nm) if pixel_nm else config.bounds.pixels
    config = config.changed(  # one picture, in the middle of the movie
        bounds={"pixels": side}, fit={"mode": mode}, optics=MOVING
    )
    if pixel_nm:
        _check_place(config, side * pixel_nm / 2)
    asked = z_nm if z_nm is not None else config.bounds.z_nm
    height = config.particle.nominal_height_nm if asked is None else asked
    counted = config.optics.interferes and config.bounds.n_before > 0
    level = config.background.slides and counted
    config = config.changed(background=_background(config))
    if context is None:
        context = make_context(config, (side, side))
    if asked is not None:
        _check_height(config, context, asked)
    experiment = _experiment(config, context, height, collected)
    if asked is None and "z_nm" in FREE_PARAMETERS[mode]:
        height = _clear_of_ends(config, context, collected, mode, height)
        experiment = _experiment(config, context, height, collected)
    light = experiment.config.bounds.photons_per_pixel
    config = experiment.config.changed(particle={"photons_per_frame": light})
    centre = (side - 1) / 2 * context.pixel_nm
    at = config.bounds
    return Setting(
        config=config,
        context=replace(context, config=config),
        region=Region((0, side), (0, side)),
        experiment=experiment,
        truth=np.array([at.x_nm + centre, at.y_nm + centre, height, experiment.mass_kda]),
        read_variance_e2=detector(config)[1] ** 2,
        level=level,
    )


def _background(config: Config) -> dict[str, Any]:
    """Tell the fits what ``[bounds]`` says of the background: measured beforehand, or known."""
    at = config.bounds
    if at.n_before:
        return {"method": "fixed"}
    dark = not config.optics.interferes
    level = (config.background.level_e or 0.0) if dark else at.photons_per_pixel
    return {"method": "known", "frames": None, "level_e": level}


def _check_place(config: Config, half_nm: float) -> None:
    at = config.bounds
    if max(abs(at.x_nm), abs(at.y_nm)) > half_nm:
        raise ConfigError(
            f"bounds.x_nm = {at.x_nm:g}, bounds.y_nm = {at.y_nm:g} lies outside the fitted region "
            f"of ±{half_nm:g} nm: move the particle, or enlarge fit.roi_nm"
        )


def _check_height(config: Config, context: AnalysisContext, z_nm: float) -> None:
    """Refuse heights at which no fit can find the particle: the model's profiles end there."""
    free = "z_nm" in FREE_PARAMETERS[context.mode]
    low, high = config.fit.z_range_nm if free else context.model.z_range_nm
    if not low <= z_nm <= high:
        raise ConfigError(
            f"bounds.z_nm = {z_nm:g} lies outside the heights that are searched, fit.z_range_nm = "
            f"[{low:g}, {high:g}]: move the particle, or widen the range"
        )


def _experiment(
    config: Config, context: AnalysisContext, z_nm: float, collected: float | None
) -> Experiment:
    experiment = plan(config.changed(bounds={"z_nm": z_nm}), model=context.model)
    if collected is None:
        return experiment
    photons = config.bounds.photons_per_pixel * collected / experiment.collected
    changed = config.changed(bounds={"z_nm": z_nm, "photons_per_pixel": photons})
    return plan(changed, model=context.model)


def _clear_of_ends(
    config: Config, context: AnalysisContext, collected: float | None, mode: str, height: float
) -> float:
    """Find the lowest height from `height` up that the ends of the range do not touch."""
    low, high = config.fit.z_range_nm
    z = PARAMETERS.index("z_nm")
    step = context.model.fringe_nm / 16
    for candidate in np.arange(max(height, low), high, step):
        bounds = _experiment(config, context, candidate, collected).bounds(FREE_PARAMETERS[mode])
        # standard deviations that a height kept by default has to the ends of ``fit.z_range_nm``
        margin = 8.0 * bounds.crb_joint[z]
        if candidate - low > margin and high - candidate > margin:
            return float(candidate)
    return (low + high) / 2
