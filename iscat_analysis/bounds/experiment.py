"""From a configuration to the bounds of the experiment it plans."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iscat_analysis.bounds.classical import EventBounds, bounds_from_matrices, event_bounds
from iscat_analysis.bounds.holevo import natural_bound
from iscat_analysis.bounds.quantum import (
    NAMES,
    incompatible_pairs,
    quantum_bounds,
    quantum_information,
    transmitted_over_collected,
    z_nm_phase_free,
)
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.setup import COARSE_SAMPLING, SATURATED_PLAN
from iscat_analysis.inference.counts import asimov_conditional, asimov_poisson
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.models import TurningRod
from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid, forward_model
from iscat_analysis.optics.model import collected_area_nm2, photons_per_intensity
from iscat_analysis.optics.scatterers import ANGLES, Rod
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, ComplexArray, FloatArray


@dataclass(frozen=True)
class Experiment:
    """One particle, one microscope, a number of frames; build it with `plan`."""

    config: Config
    model: ForwardModel
    grid: PixelGrid
    likelihood: Likelihood
    theta: FloatArray
    mass_kda: float
    on_camera: float
    collected: float
    peak_e: float

    @property
    def quantum(self) -> ComplexArray:
        """Quantum Fisher information of one collected photon, shape (4, 4)."""
        return quantum_information(self.model, self.theta[2])

    @property
    def per_step(self) -> FloatArray:
        """Change of each parameter in a unit step of the quantum matrix, whose mass is relative.

        With a calibration that has an offset, a relative step of the amplitude is not one of the
        mass.  Shapes: result (4,).
        """
        amplitude = float(self.theta[3])
        return np.array([1.0, 1.0, 1.0, abs(amplitude * self.model.scale.slope(amplitude))])

    def light(self, free: tuple[str, ...]) -> ComplexArray:
        """Quantum Fisher information of all collected photons about chosen parameters."""
        index = [PARAMETERS.index(name) for name in free]
        whole = self.collected * self.quantum / np.outer(self.per_step, self.per_step)
        return np.asarray(whole[np.ix_(index, index)])

    def bounds(self, free: tuple[str, ...], *, level: bool = False) -> EventBounds:
        """Bounds over chosen free parameters."""
        return event_bounds(
            self.likelihood, self.theta, free, self.collected, quantum=self.quantum, level=level
        )


def detector(config: Config) -> tuple[float, float]:
    """Give the pixel [nm] and the read noise [e] of the camera, which bounds need as numbers."""
    camera = config.camera.assumed
    if camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is missing: give it, as in camera.pixel_size_nm = 84.4"
        )
    if isinstance(camera.read_noise_e, str):
        raise ConfigError(
            f"camera.read_noise_e = {camera.read_noise_e!r} is a map: bounds need a number, as in "
            "camera.read_noise_e = 1.5"
        )
    return camera.pixel_size_nm, camera.read_noise_e


def light_of(config: Config, model: ForwardModel, pixel_nm: float) -> tuple[float, float]:
    """Give the background of a pixel and frame, and what a signal of 1 adds to it [e]."""
    photons = config.bounds.photons_per_pixel
    if model.rho:
        return photons, photons
    return config.background.level_e or 0.0, photons_per_intensity(model, photons, pixel_nm)


def height_of(config: Config) -> float:
    """Height of the particle of ``[bounds]`` [nm]."""
    z_nm = config.bounds.z_nm
    return config.particle.nominal_height_nm if z_nm is None else z_nm


def reach_of(config: Config) -> float:
    """Distance from the particle to the farthest corner of the field of ``[bounds]`` [nm]."""
    at, half = config.bounds, config.bounds.pixels * detector(config)[0] / 2
    return 1.0001 * math.hypot(half + abs(at.x_nm), half + abs(at.y_nm))


def plan(
    config: Config, *, model: ForwardModel | None = None, scale: MassScale | None = None
) -> Experiment:
    """Set up the experiment of ``[bounds]``."""
    at = config.bounds
    pixel_nm, read_noise_e = detector(config)
    half = at.pixels * pixel_nm / 2
    if max(abs(at.x_nm), abs(at.y_nm)) > half:
        raise ConfigError(
            f"bounds.x_nm = {at.x_nm:g}, bounds.y_nm = {at.y_nm:g} lies outside the field of "
            f"±{half:g} nm: move the particle, or enlarge bounds.pixels"
        )
    grid = PixelGrid.centred(at.pixels, pixel_nm)
    height = height_of(config)
    if model is None:
        optics = config if scale is None else config.model_copy(update={"calibration": None})
        highest = max(height, config.particle.nominal_height_nm)
        model = forward_model(optics, reach_of(config), z_max_nm=highest)
        model = replace(model, z_range_nm=(height, height))  # one height needs no more
        model = model if scale is None else replace(model, scale=scale)
    mass = model.material.mass_kda
    theta = np.array([at.x_nm, at.y_nm, height, model.scale.amplitude(mass), 0.0])
    # with ρ = 0 the signal is the scattered light alone, still in units of the reference
    scattered = replace(model, rho=0.0).image(grid, at.x_nm, at.y_nm, height, mass)
    area = collected_area_nm2(model, height, mass) / pixel_nm**2
    signal = model.image(grid, at.x_nm, at.y_nm, height, mass) if model.rho else scattered
    level, per_frame = light_of(config, model, pixel_nm)
    return Experiment(
        config=config,
        model=model,
        grid=grid,
        likelihood=expected_likelihood(
            model,
            grid,
            theta,
            (level, per_frame),
            (at.n_before, at.n_after),
            read_noise_e=read_noise_e,
        ),
        theta=theta,
        mass_kda=mass,
        on_camera=at.n_after * per_frame * float(scattered.sum()),
        collected=at.n_after * per_frame * area,
        peak_e=level + per_frame * float(signal.max()),
    )


def expected_likelihood(
    model: ForwardModel,
    grid: PixelGrid,
    theta: FloatArray,
    light_e: tuple[float, float],
    frames: tuple[int, int],
    *,
    read_noise_e: float = 0.0,
) -> Likelihood:
    """Likelihood of the expected counts of a planned experiment.

    `light_e` is that of a frame without a particle, and that for unit signal; `frames` are those
    before and after.  Shapes: `theta` (5,).
    """
    (level_e, scale_e), (n_before, n_after), read = light_e, frames, read_noise_e**2
    if model.rho and n_before:
        return asimov_conditional(
            model, grid, theta, level_e, n_before, n_after, read_variance_e2=read
        )
    extra = n_after * read
    if n_before:  # dark field: the measured background adds its own variance
        extra += n_after**2 / n_before * (level_e + read)
    return asimov_poisson(
        model, grid, theta, n_after * level_e, n_after * scale_e, extra_variance_e2=extra
    )


def bounds_report(config: Config) -> dict[str, Any]:
    """Everything `iscat bounds --json` prints."""
    experiment, free = plan(config), FREE_PARAMETERS[config.fit.mode]
    model, mass, z_nm = experiment.model, experiment.mass_kda, float(experiment.theta[2])
    whole = experiment.bounds(PARAMETERS)
    joint = bounds_from_matrices(whole.fisher, whole.quantum, free)
    light = experiment.light(PARAMETERS)
    at_once = natural_bound(experiment.light(free))
    shares = (at_once.sigma / joint.crb_joint[[PARAMETERS.index(name) for name in free]]) ** 2
    camera, collected = math.sqrt(experiment.on_camera), math.sqrt(experiment.collected)
    kinds = {"crb_single": (whole.crb_single, camera), "crb_joint": (joint.crb_joint, camera)}

    def add_light(kind: str, of_one: FloatArray, photons: float = collected) -> None:
        """Add a quantum bound of one photon."""
        kinds[kind] = of_one * experiment.per_step / photons, photons

    single, together = quantum_bounds(experiment.quantum)
    add_light("qcrb", single)
    add_light("qcrb_joint", together)
    paper = quantum_information(model, z_nm, measure="dong2021")
    add_light("qcrb_dong2021", quantum_bounds(paper)[0])
    losses = {}
    if config.optics.analyzer or config.optics.mask_na:
        losses["transmitted_over_collected"] = share = transmitted_over_collected(model, z_nm)
        passed, _ = quantum_bounds(quantum_information(model, z_nm, light="transmitted"))
        add_light("qcrb_transmitted", passed, collected * math.sqrt(share))
    actual = {kind: _named(PARAMETERS, values) for kind, (values, _) in kinds.items()}
    relative = np.array([1.0, 1.0, 1.0, 1 / mass])
    per_photon = {kind: _named(NAMES, v * root * relative) for kind, (v, root) in kinds.items()}
    if not model.rho:
        alone = z_nm_phase_free(model, z_nm)
        per_photon["qcrb"]["z_nm_phase_free"] = alone
        actual["qcrb"]["z_nm_phase_free"] = alone / collected
    optics, at, rod = config.optics, config.bounds, model.aperture.scatterer
    return {
        "at": {
            "scheme": optics.scheme,
            "mode": config.fit.mode,
            "free": list(free),
            **picked(at, "x_nm", "y_nm"),
            "z_nm": z_nm,
            "mass_kda": mass,
            "focus_nm": optics.focus_nm,
            "attenuation": optics.attenuation if model.rho else 0.0,
            "na": optics.na,
            "pixel_size_nm": experiment.grid.pixel_nm,
            **picked(at, "pixels", "photons_per_pixel", "n_before", "n_after"),
        },
        "n_scattered": {"camera": experiment.on_camera, "collected": experiment.collected},
        **losses,
        "per_photon": per_photon,
        "actual": actual,
        "fisher": whole.fisher,
        "qfi": whole.quantum,
        "qfi_imaginary": light.imag,
        "holevo": {"weight": "qfi", "sum": at_once.sum} | _named(free, at_once.sigma),
        "information_fraction": _named(PARAMETERS, information_fraction(whole)),
        "information_fraction_joint": _named(free, shares),
        "incompatible": {
            "–".join(pair): v for pair, v in incompatible_pairs(experiment.quantum).items()
        },
        "unidentifiable": [str(direction) for direction in joint.unidentifiable],
        "crosstalk": {
            "inflation": joint.inflation,
            "direction": dict(zip(free, joint.weakest, strict=False)),
        },
        **picked(optics, "convention", "emission"),
        "warnings": [finding.text for finding in findings_of(experiment)],
        **({"rod": _with_angles(experiment, rod)} if isinstance(rod, Rod) else {}),
    }


def picked(section: Any, *keys: str) -> dict[str, Any]:
    """Take some keys of a section of a configuration."""
    return {key: getattr(section, key) for key in keys}


def _with_angles(experiment: Experiment, rod: Rod) -> dict[str, Any]:
    """Bounds of a rod whose direction is unknown beside the free parameters of the mode."""
    free = (*FREE_PARAMETERS[experiment.config.fit.mode], *ANGLES)
    rods = TurningRod(experiment.model, rod)
    theta = np.insert(experiment.theta, LEVEL, [rod.azimuth_deg, rod.tilt_deg])
    found = event_bounds(experiment.likelihood.under(rods), theta, free)
    index = [i for i, each in enumerate(rods.parameters) if each.name in free]
    return {
        "aspect_ratio": experiment.config.particle.aspect_ratio,
        "azimuth_deg": rod.azimuth_deg,
        "tilt_deg": rod.tilt_deg,
        "crb_single": _named(free, found.crb_single[index]),
        "crb_joint": _named(free, found.crb_joint[index]),
        "unidentifiable": [str(direction) for direction in found.unidentifiable],
    }


def information_fraction(bounds: EventBounds) -> FloatArray:
    """Share of the collected light's information that the microscope uses.

    Shapes: result (4,).
    """
    return (bounds.qcrb / bounds.crb_single) ** 2


def findings_of(experiment: Experiment) -> list[Finding]:
    """Find what makes the bounds unattainable or wrong."""
    found, well_depth_e = [], experiment.config.camera.well_depth_e
    if well_depth_e is not None and experiment.peak_e >= well_depth_e:
        found.append(SATURATED_PLAN({"peak_e": experiment.peak_e, "well_depth_e": well_depth_e}))
    # Excess of the photons on the camera over those collected that betrays coarse sampling
    if experiment.on_camera > (1 + 1e-3) * experiment.collected:
        found.append(COARSE_SAMPLING({"pixel_nm": experiment.grid.pixel_nm}))
    return found


def _named(names: tuple[str, ...], values: FloatArray) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
