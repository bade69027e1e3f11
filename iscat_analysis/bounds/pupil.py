"""Which pupil would come nearest to what the light allows.

Reference phase, attenuation, mask, focus and low Zernike terms are searched for the smallest

    F = Σ_j σ_j² K_jj        over the chosen parameters j,

σ_j being the joint Cramér–Rao bound over the mode's free parameters and 1/√K_jj the light's own
bound.  The light on the particle is held and with it the number of collected photons.  None of the
knobs touches the light before the pupil, so that the Holevo bound C_H(W) with W = diag(K_jj) on the
chosen parameters is one number for the whole search: F ≥ C_H, and C_H/F says how near a pupil
comes.

The reference's level on the camera follows the attenuation squared.  Where the brightest pixel
would exceed the well, the attenuation is lowered until it does not.

A random sample of the round pupils finds the valleys, COBYQA (Ragonneau & Zhang 2024; no
derivatives, so that the noise of tables does not matter) descends into the best of them, and then
once more with the Zernike terms that are not round.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from iscat_analysis.bounds.classical import bounds_from_matrices
from iscat_analysis.bounds.experiment import Experiment, plan
from iscat_analysis.bounds.holevo import Holevo, holevo_bound
from iscat_analysis.bounds.planning import calibrated_scale, with_keys
from iscat_analysis.bounds.quantum import transmitted_over_collected
from iscat_analysis.config import Config, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import MassScale
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Progress, silent

ROUND_TERMS, OTHER_TERMS = ("z11",), ("z5", "z6", "z7", "z8", "z9", "z10")
"""Low Zernike terms: spherical aberration, and astigmatism, coma and trefoil."""

KNOBS: Mapping[str, tuple[str, ...]] = {
    "focus": ("focus_nm",),
    "phase": ("reference_phase_deg",),
    "attenuation": ("attenuation",),
    "mask": ("mask_na",),
    "zernike": (*ROUND_TERMS, *OTHER_TERMS),
}
"""What can be searched, and the keys of ``[optics]`` it stands for."""


BUDGET = 70
"""Evaluations that one descent may take for each of its variables."""

RADII = (0.3, 2e-3)
"""First and last step of a descent; a unit is a radian, 500 nm of focus, λ/20 rms of a Zernike
term, a factor e of attenuation, the whole aperture for the mask."""


NO_BOUND = 50.0
"""ln F of a pupil that does not identify the parameters or saturates the camera."""

_DIGITS = {"focus_nm": 1, "reference_phase_deg": 1, "mask_na": 3}  # of what is written; others 1
_UNIT_FOCUS_NM = 500.0


@dataclass
class Search:
    """F of pupils, and the descent into one valley."""

    config: Config
    scale: MassScale | None
    chosen: tuple[str, ...]
    free: tuple[str, ...]
    evaluations: int = 0
    keys: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.keys = tuple(key for name in KNOBS if name in self.free for key in KNOBS[name])

    def config_of(self, optics: Optics) -> Config:
        """Experiment with other optics and the same light on the particle."""
        power = (optics.attenuation / self.config.optics.attenuation) ** 2
        photons = self.config.bounds.photons_per_pixel * power
        return self.config.model_copy(
            update={
                "optics": optics,
                "bounds": self.config.bounds.model_copy(update={"photons_per_pixel": photons}),
            }
        )

    def value(self, optics: Optics) -> tuple[float, Optics]:
        """Compute ln F and the optics, dimmed where the well depth requires it."""
        # Share of the well that the brightest pixel may expect
        largest_e = 0.99 * (self.config.camera.well_depth_e or math.inf)
        for _ in range(4):
            self.evaluations += 1
            experiment = plan(self.config_of(optics), scale=self.scale)
            if experiment.peak_e <= largest_e:
                sigma, own = sigmas(experiment)
                at = [PARAMETERS.index(name) for name in self.chosen]
                total = float(np.sum((sigma[at] / own[at]) ** 2))
                return (math.log(total) if math.isfinite(total) else NO_BOUND), optics
            if "attenuation" not in self.free:
                break
            dimmed = optics.attenuation * math.sqrt(0.99 * largest_e / experiment.peak_e)
            optics = optics.model_copy(update={"attenuation": dimmed})
        return NO_BOUND, optics

    def valleys(self, starts: int, seed: int) -> list[tuple[list[str], FloatArray]]:
        """Choose starts: the configured pupil, and the best of a sample with and without mask."""
        keys = [key for key in self.keys if key not in OTHER_TERMS]
        bare = [key for key in keys if key != "mask_na"]
        here = self.config.optics
        first = keys if here.mask_na else bare
        chosen = [(first, self.encode(first, here))]
        for number, names in enumerate([bare] if bare == keys else [bare, keys]):
            if not names:
                continue
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, number)))
            low, high = np.array([self.range(key)[0] for key in names]).T
            # Random pupils for each variable, with and without mask, from which the valleys are
            # chosen
            points = low + (high - low) * rng.random((128 * len(names), len(names)))
            values = [self.value(self.decode(names, point))[0] for point in points]
            distinct: list[FloatArray] = []
            for point in points[np.argsort(values)]:
                if len(distinct) < starts and all(
                    # Smallest distance between starts, in these units
                    np.linalg.norm(point - p) > 0.5
                    for p in distinct
                ):
                    distinct.append(point)
            chosen += [(names, point) for point in distinct]
        return chosen

    def descend(self, keys: list[str], start: FloatArray) -> tuple[float, Optics]:
        """Find the lowest point near a start: ln F and the optics."""
        if not keys:
            return self.value(self.decode(keys, start))
        low, high = np.array([self.range(key)[1] for key in keys]).T
        found = scipy.optimize.minimize(
            lambda point: self.value(self.decode(keys, point))[0],
            np.clip(start, low, high),
            bounds=list(zip(low, high, strict=True)),
            method="COBYQA",
            options={
                "maxfev": BUDGET * len(keys),
                "initial_tr_radius": RADII[0],
                "final_tr_radius": RADII[1],
            },
        )
        return self.value(self.decode(keys, found.x))

    def simplified(self, best: Optics) -> tuple[float, Optics]:
        """Round the settings, and undo those that change nothing."""
        best = self._with(
            best, {key: _rounded(key, setting(best, key)) for key in self.keys if key != "mask_na"
                   or best.mask_na}
        )  # fmt: skip
        value, best = self.value(best)
        # Relative change of F below which a knob returns to where it was configured: simpler is
        # better
        worst = value + 1e-4
        for key in reversed(self.keys):
            here = setting(self.config.optics, key)
            if setting(best, key) != here:
                simpler = self.value(self._with(best, {key: here}))
                if simpler[0] <= worst and simpler[1].attenuation <= best.attenuation:
                    value, best = simpler
        return value, best

    def range(self, key: str) -> tuple[tuple[float, float], tuple[float, float]]:
        """Where a knob is sampled, and how far it may go."""
        return {
            "focus_nm": ((-4.0, 4.0), (-4.0, 4.0)),
            "reference_phase_deg": ((-math.pi, math.pi), (-3 * math.pi, 3 * math.pi)),
            "attenuation": ((math.log(3e-3), 0.0), (math.log(1e-4), 0.0)),
            "mask_na": ((0.1, 0.95), (0.05, 0.99)),
        }.get(key, ((-2.0, 2.0), (-8.0, 8.0)))

    def encode(self, keys: Sequence[str], optics: Optics) -> FloatArray:
        """Optics → point of the search."""
        return np.array([self._coding(key)[0](setting(optics, key)) for key in keys])

    def decode(self, keys: Sequence[str], point: FloatArray) -> Optics:
        """Point of the search → optics; a mask that is not among the keys is taken out."""
        changes = {key: self._coding(key)[1](float(u)) for key, u in zip(keys, point, strict=True)}
        if "mask_na" in self.keys and "mask_na" not in keys:
            changes["mask_na"] = 0.0
        return self._with(self.config.optics, changes)

    def _coding(self, key: str) -> tuple[Callable[[float], float], Callable[[float], float]]:
        optics, height = self.config.optics, self.config.particle.nominal_height_nm
        # a unit of a Zernike term is a twentieth of the wavelength
        wave = optics.wavelength_nm / 20.0
        if key == "focus_nm":
            return (lambda v: (v - height) / _UNIT_FOCUS_NM, lambda u: height + _UNIT_FOCUS_NM * u)
        if key == "reference_phase_deg":
            return math.radians, lambda u: math.degrees(math.remainder(u, 2 * math.pi))
        if key == "attenuation":
            return math.log, lambda u: math.exp(min(u, 0.0))
        if key == "mask_na":
            return lambda v: v / optics.na, lambda u: u * optics.na
        return lambda v: v / wave, lambda u: u * wave

    def _with(self, optics: Optics, changes: Mapping[str, float]) -> Optics:
        terms = {k: v for k, v in changes.items() if k not in Optics.model_fields}
        update: dict[str, Any] = {k: v for k, v in changes.items() if k not in terms}
        if terms:
            distinct = {k: v for k, v in (optics.aberrations_nm | terms).items() if v}
            update["aberrations_nm"] = distinct
        return optics.model_copy(update=update | {"file": None, "covariance": None})


def setting(optics: Optics, key: str) -> float:
    """Give the value of a key of the optics, or of a Zernike term."""
    if key in Optics.model_fields:
        return float(getattr(optics, key))
    return optics.aberrations_nm.get(key, 0.0)


def _rounded(key: str, value: float) -> float:
    if key == "attenuation":
        return float(f"{value:.3g}")
    return round(value, _DIGITS.get(key, 1)) + 0.0


def sigmas(experiment: Experiment) -> tuple[FloatArray, FloatArray]:
    """Give the joint bounds over the mode's free parameters, and each one's quantum bound.

    Shapes: `joint, quantum` (4,).
    """
    free = FREE_PARAMETERS[experiment.config.fit.mode]
    whole = experiment.bounds(PARAMETERS)
    return bounds_from_matrices(whole.fisher, whole.quantum, free).crb_joint, whole.qcrb


@dataclass(frozen=True)
class PupilOptimum:
    """The best pupil that was found; build it with `optimize_pupil`."""

    config: Config
    chosen: tuple[str, ...]
    settings: Mapping[str, tuple[float, float]]
    sigma: Mapping[str, float]
    sigma_configured: Mapping[str, float]
    sigma_holevo: Mapping[str, float]
    sigma_quantum: Mapping[str, float]
    sum: float
    sum_configured: float
    holevo: float
    share_quiet: float
    transmitted: float
    peak_e: float
    descents: tuple[float, ...]
    evaluations: int

    @property
    def share(self) -> float:
        """C_H/F: how near the best pupil comes to the Holevo bound, at most 1."""
        return self.holevo / self.sum

    @property
    def share_configured(self) -> float:
        """C_H/F as configured."""
        return self.holevo / self.sum_configured

    def to_dict(self) -> dict[str, Any]:
        """Give what ``iscat bounds --json`` has under ``pupil``."""
        return {
            "for": list(self.chosen),
            "settings": {
                key: {"configured": before, "best": best}
                for key, (before, best) in self.settings.items()
            },
            "photons_per_pixel": self.config.bounds.photons_per_pixel,
            "peak_e": self.peak_e,
            "transmitted_over_collected": self.transmitted,
            "sigma": {
                name: {
                    "configured": self.sigma_configured[name],
                    "best": self.sigma[name],
                    "holevo": self.sigma_holevo[name],
                    "qcrb": self.sigma_quantum[name],
                }
                for name in self.chosen
            },
            "sum": {"configured": self.sum_configured, "best": self.sum, "holevo": self.holevo},
            "share": {
                "configured": self.share_configured,
                "best": self.share,
                "quiet": self.share_quiet,
            },
            "descents": list(self.descents),
            "near": sum(share > 0.99 * self.descents[0] for share in self.descents),
            "evaluations": self.evaluations,
        }


def optimize_pupil(
    config: Config,
    chosen: Sequence[str] | None = None,
    *,
    free: Sequence[str] | None = None,
    starts: int = 8,
    seed: int = 0,
    progress: Progress = silent,
) -> PupilOptimum:
    """Search the pupil with the smallest joint bound of the chosen parameters."""
    chosen = _chosen(config, chosen)
    free = _free(config, free)
    scale = calibrated_scale(config)
    light = _holevo(plan(config), chosen)
    search = Search(_cropped(config), scale, chosen, free)
    log_holevo = math.log(light.sum)
    others = [key for key in OTHER_TERMS if key in search.keys]
    found: list[tuple[float, Optics]] = []
    valleys = search.valleys(starts, seed)
    for done, (keys, start) in enumerate(valleys):
        found.append(search.descend(keys, start))
        progress("pupils", done + 1, len(valleys) + bool(others))
    found.sort(key=lambda item: item[0])
    if others:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        optics = found[0][1]
        keys = [key for key in search.keys if key != "mask_na" or optics.mask_na]
        start = search.encode(keys, optics)
        start += np.where([key in others for key in keys], rng.normal(0, 0.3, len(keys)), 0.0)
        found.append(search.descend(keys, start))
        progress("pupils", len(valleys) + 1, len(valleys) + 1)
        found.sort(key=lambda item: item[0])
    whole = Search(config, scale, chosen, free)
    _, best = min((whole.value(optics) for _, optics in found[:3]), key=lambda item: item[0])
    value, best = whole.simplified(best)
    if not value < NO_BOUND:
        raise ConfigError(
            "`optimize` = pupil: the parameters are unidentifiable or the camera saturates with "
            "every pupil; lower bounds.photons_per_pixel, or free fewer parameters with fit.mode"
        )
    return _result(
        config, whole.config_of(best), scale, chosen, search.keys,
        descents=tuple(math.exp(log_holevo - value) for value, _ in found),
        evaluations=search.evaluations + whole.evaluations,
    )  # fmt: skip


def _result(
    config: Config,
    best: Config,
    scale: MassScale | None,
    chosen: tuple[str, ...],
    keys: Sequence[str],
    *,
    descents: tuple[float, ...],
    evaluations: int,
) -> PupilOptimum:
    """Bounds of the configured and of the best experiment, the latter as it will be written."""
    best = _uncalibrated(best, scale)
    here, there = plan(_uncalibrated(config, scale)), plan(best)
    bound = _holevo(there, chosen)
    at = [PARAMETERS.index(name) for name in chosen]
    sigma, own = sigmas(there)
    silent_camera = with_keys(best, {"camera": {"read_noise_e": 0.0}, "bounds": {"n_before": 0}})
    quiet, _ = sigmas(plan(silent_camera))
    before, _ = sigmas(here)
    joint = FREE_PARAMETERS[config.fit.mode]
    holevo_sigma = dict(zip(joint, bound.sigma, strict=True))

    def named(values: FloatArray) -> dict[str, float]:
        return {PARAMETERS[i]: float(values[i]) for i in at}

    return PupilOptimum(
        config=best,
        chosen=chosen,
        settings={key: (setting(config.optics, key), setting(best.optics, key)) for key in keys},
        sigma=named(sigma),
        sigma_configured=named(before),
        sigma_holevo={name: float(holevo_sigma[name]) for name in chosen},
        sigma_quantum=named(own),
        sum=float(np.sum((sigma[at] / own[at]) ** 2)),
        sum_configured=float(np.sum((before[at] / own[at]) ** 2)),
        holevo=bound.sum,
        share_quiet=bound.sum / float(np.sum((quiet[at] / own[at]) ** 2)),
        transmitted=transmitted_over_collected(there.model, float(there.theta[2])),
        peak_e=there.peak_e,
        descents=descents,
        evaluations=evaluations,
    )


def _holevo(experiment: Experiment, chosen: tuple[str, ...]) -> Holevo:
    """Holevo bound over the mode's free parameters, of which the chosen ones weigh."""
    free = FREE_PARAMETERS[experiment.config.fit.mode]
    index = [PARAMETERS.index(name) for name in free]
    theta, scale = experiment.theta, experiment.model.scale
    step = np.array([1.0, 1.0, 1.0, abs(theta[3]) * abs(scale.slope(theta[3]))])
    light = (experiment.collected * experiment.quantum / np.outer(step, step))[np.ix_(index, index)]
    weight = np.diag(light).real * [name in chosen for name in free]
    return holevo_bound(light, np.diag(weight))


def _uncalibrated(config: Config, scale: MassScale | None) -> Config:
    """Let the particle itself scatter as strongly as the calibration says.

    A calibration belongs to the optics it was measured with.  The field of a mass is inversely
    proportional to the density, which does nothing else.
    """
    if config.calibration is None or scale is None:
        return config
    matter = plan(config, scale=scale).model.material
    density = matter.density_kg_m3 * matter.mass_kda / abs(scale.amplitude(matter.mass_kda))
    particle = config.particle.model_copy(
        update={"density_kg_m3": density, "mass_kda": matter.mass_kda, "diameter_nm": None}
    )
    return config.model_copy(update={"calibration": None, "particle": particle})


def _cropped(config: Config) -> Config:
    """Shrink the field to what the search needs."""
    pixel, at = config.camera.pixel_size_nm, config.bounds
    if pixel is None:
        return config  # `plan` says what is missing
    # Side of the field in which valleys are searched; candidates are compared on the whole
    # field
    needed = math.ceil((3500.0 + 2 * max(abs(at.x_nm), abs(at.y_nm))) / pixel)
    needed += (needed - at.pixels) % 2
    if needed >= at.pixels:
        return config
    return config.model_copy(update={"bounds": at.model_copy(update={"pixels": needed})})


def _chosen(config: Config, chosen: Sequence[str] | None) -> tuple[str, ...]:
    free = FREE_PARAMETERS[config.fit.mode]
    for name in chosen or ():
        if name not in free:
            raise ConfigError(
                f"{name} is not free in mode {config.fit.mode}: choose among {', '.join(free)}, or "
                "another fit.mode"
            )
    return tuple(name for name in free if chosen is None or name in chosen)


def _free(config: Config, free: Sequence[str] | None) -> tuple[str, ...]:
    optics = config.optics
    if not optics.interferes:
        raise ConfigError(
            "`optimize` = pupil: dark field has no reference whose phase and strength could be "
            'chosen; choose optics.scheme = "iscat" or "cobri"'
        )
    if optics.psf == "measured":
        raise ConfigError(
            '`optimize` = pupil: optics.psf = "measured" is a picture of one pupil; use "model"'
        )
    for name in free or ():
        if name not in KNOBS:
            raise ConfigError(f"`free` = {name}: choose among {', '.join(KNOBS)}")
    return tuple(name for name in KNOBS if free is None or name in free)
