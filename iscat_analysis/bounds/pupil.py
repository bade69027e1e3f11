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
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from iscat_analysis.bounds.classical import bounds_from_matrices
from iscat_analysis.bounds.experiment import Experiment, plan
from iscat_analysis.bounds.holevo import Holevo, holevo_bound
from iscat_analysis.bounds.planning import calibrated_scale, with_keys
from iscat_analysis.bounds.quantum import transmitted_over_collected
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import MassScale
from iscat_analysis.optics.local import terms_of
from iscat_analysis.optics.parameters import Settings, settings_of, with_settings
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


RADII = (0.3, 2e-3)
"""First and last step of a descent; a unit is a radian, 500 nm of focus, λ/20 rms of a Zernike
term, a factor e of attenuation, the whole aperture for the mask."""


NO_BOUND = 50.0
"""ln F of a pupil that does not identify the parameters or saturates the camera."""

Ends = tuple[float, float]


@dataclass(frozen=True)
class _Knob:
    """A variable of the search: its unit, where it is sampled, and how far it may go."""

    encode: Callable[[float], float]
    decode: Callable[[float], float]
    sampled: Ends
    allowed: Ends


def _linear(middle: float, unit: float, sampled: Ends, allowed: Ends) -> _Knob:
    return _Knob(lambda v: (v - middle) / unit, lambda u: middle + unit * u, sampled, allowed)


def knobs_of(config: Config) -> dict[str, _Knob]:
    """Give the variables by their keys."""
    optics, height, turn = config.optics, config.particle.nominal_height_nm, 2 * math.pi
    term = _linear(0.0, optics.wavelength_nm / 20.0, (-2.0, 2.0), (-8.0, 8.0))
    phase = _Knob(
        math.radians,
        lambda u: math.degrees(math.remainder(u, turn)),
        (-turn / 2, turn / 2),
        (-1.5 * turn, 1.5 * turn),
    )
    dimmest = math.log(3e-3), math.log(1e-4)
    return {
        "focus_nm": _linear(height, 500.0, (-4.0, 4.0), (-4.0, 4.0)),
        "reference_phase_deg": phase,
        "attenuation": _Knob(
            math.log, lambda u: math.exp(min(u, 0.0)), (dimmest[0], 0.0), (dimmest[1], 0.0)
        ),
        "mask_na": _linear(0.0, optics.na, (0.1, 0.95), (0.05, 0.99)),
        **dict.fromkeys((*ROUND_TERMS, *OTHER_TERMS), term),
    }


@dataclass
class Search:
    """F of pupils, and the descent into one valley."""

    config: Config
    scale: MassScale | None
    chosen: tuple[str, ...]
    free: tuple[str, ...]
    evaluations: int = 0

    @cached_property
    def knobs(self) -> dict[str, _Knob]:
        """The variables that may change."""
        every = knobs_of(self.config)
        return {key: every[key] for name in KNOBS if name in self.free for key in KNOBS[name]}

    @cached_property
    def start(self) -> Settings:
        """The configured optics."""
        return settings_of(self.config) | terms_of(self.config.optics)

    def config_of(self, settings: Settings) -> Config:
        """Experiment with other optics and the same light on the particle."""
        power = (settings["attenuation"] / self.start["attenuation"]) ** 2
        photons = self.config.bounds.photons_per_pixel * power
        return with_settings(self.config, settings).changed(
            bounds={"photons_per_pixel": photons}, optics={"file": None, "covariance": None}
        )

    def value(self, settings: Settings) -> tuple[float, Settings]:
        """Compute ln F and the optics, dimmed where the well depth requires it."""
        # Share of the well that the brightest pixel may expect
        largest_e = 0.99 * (self.config.camera.well_depth_e or math.inf)
        for _ in range(4):
            self.evaluations += 1
            experiment = plan(self.config_of(settings), scale=self.scale)
            if experiment.peak_e <= largest_e:
                total = total_of(experiment, self.chosen)
                return (math.log(total) if math.isfinite(total) else NO_BOUND), settings
            if "attenuation" not in self.free:
                break
            dimmed = settings["attenuation"] * math.sqrt(0.99 * largest_e / experiment.peak_e)
            settings = {**settings, "attenuation": dimmed}
        return NO_BOUND, settings

    def valleys(self, starts: int, seed: int) -> list[tuple[list[str], FloatArray]]:
        """Choose starts: the configured pupil, and the best of a sample with and without mask."""
        keys = [key for key in self.knobs if key not in OTHER_TERMS]
        bare = [key for key in keys if key != "mask_na"]
        first = keys if self.start["mask_na"] else bare
        chosen = [(first, self.encode(first, self.start))]
        for number, names in enumerate([bare] if bare == keys else [bare, keys]):
            if not names:
                continue
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, number)))
            low, high = np.array([self.knobs[key].sampled for key in names]).T
            # Random pupils for each variable, from which the valleys are chosen
            points = low + (high - low) * rng.random((128 * len(names), len(names)))
            values = [self.value(self.decode(names, point))[0] for point in points]
            distinct: list[FloatArray] = []
            for point in points[np.argsort(values)]:
                # Smallest distance between starts, in these units
                if all(np.linalg.norm(point - other) > 0.5 for other in distinct):
                    distinct.append(point)
            chosen += [(names, point) for point in distinct[:starts]]
        return chosen

    def descend(self, keys: list[str], start: FloatArray) -> tuple[float, Settings]:
        """Find the lowest point near a start: ln F and the optics."""
        if not keys:
            return self.value(self.decode(keys, start))

        def at(point: FloatArray) -> float:
            return self.value(self.decode(keys, point))[0]

        limits = [self.knobs[key].allowed for key in keys]
        first, last = RADII
        options = {"initial_tr_radius": first, "final_tr_radius": last}
        # evaluations that one descent may take for each of its variables
        options["maxfev"] = 70 * len(keys)
        begin = np.clip(start, *np.transpose(limits))
        found = scipy.optimize.minimize(at, begin, bounds=limits, method="COBYQA", options=options)
        return self.value(self.decode(keys, found.x))

    def simplified(self, best: Settings) -> tuple[float, Settings]:
        """Round the settings, and undo those that change nothing."""
        changed = [key for key in self.knobs if key != "mask_na" or best["mask_na"]]
        value, best = self.value({**best, **{key: _rounded(key, best[key]) for key in changed}})
        # Relative change of F below which a knob returns to where it was configured: simpler is
        # better
        worst = value + 1e-4
        for key in reversed(self.knobs):
            if best[key] != self.start[key]:
                simpler = self.value({**best, key: self.start[key]})
                if simpler[0] <= worst and simpler[1]["attenuation"] <= best["attenuation"]:
                    value, best = simpler
        return value, best

    def encode(self, keys: Sequence[str], settings: Settings) -> FloatArray:
        """Optics → point of the search."""
        return np.array([self.knobs[key].encode(settings[key]) for key in keys])

    def decode(self, keys: Sequence[str], point: FloatArray) -> Settings:
        """Point of the search → optics; a mask that is not among the keys is taken out."""
        moved = zip(keys, point.tolist(), strict=True)
        bare = {"mask_na": 0.0} if "mask_na" in self.knobs else {}
        return {**self.start, **bare, **{key: self.knobs[key].decode(u) for key, u in moved}}


def _rounded(key: str, value: float) -> float:
    """Round a setting to the digits that are written."""
    if key == "attenuation":
        return float(f"{value:.3g}")
    return round(value, 3 if key == "mask_na" else 1) + 0.0


def total_of(experiment: Experiment, chosen: Sequence[str]) -> float:
    """F of one pupil: squared joint bounds of the chosen parameters over their quantum bounds."""
    at = [PARAMETERS.index(name) for name in chosen]
    joint, own = sigmas(experiment)
    return float(np.sum((joint[at] / own[at]) ** 2))


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
    sigma: Mapping[str, Mapping[str, float]]
    """Of every chosen parameter: configured, best, holevo, qcrb."""

    sums: Mapping[str, float]
    """F: configured, best, and that of the best pupil with a quiet camera."""

    holevo: float
    transmitted: float
    peak_e: float
    descents: tuple[float, ...]
    evaluations: int

    @property
    def shares(self) -> dict[str, float]:
        """C_H/F: how near each comes to the Holevo bound, at most 1."""
        return {kind: self.holevo / total for kind, total in self.sums.items()}

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
            "sigma": self.sigma,
            "sum": {**{kind: self.sums[kind] for kind in _ENDS}, "holevo": self.holevo},
            "share": self.shares,
            "descents": list(self.descents),
            "near": sum(share > 0.99 * self.descents[0] for share in self.descents),
            "evaluations": self.evaluations,
        }


_ENDS = ("configured", "best")


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
    others = [key for key in OTHER_TERMS if key in search.knobs]
    found: list[tuple[float, Settings]] = []
    valleys = search.valleys(starts, seed)
    for done, (keys, start) in enumerate(valleys):
        found.append(search.descend(keys, start))
        progress("pupils", done + 1, len(valleys) + bool(others))
    found.sort(key=lambda item: item[0])
    if others:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        settings = found[0][1]
        keys = [key for key in search.knobs if key != "mask_na" or settings["mask_na"]]
        start = search.encode(keys, settings)
        start += np.where([key in others for key in keys], rng.normal(0, 0.3, len(keys)), 0.0)
        found.append(search.descend(keys, start))
        progress("pupils", len(valleys) + 1, len(valleys) + 1)
        found.sort(key=lambda item: item[0])
    whole = Search(config, scale, chosen, free)
    _, best = min((whole.value(settings) for _, settings in found[:3]), key=lambda item: item[0])
    value, best = whole.simplified(best)
    if not value < NO_BOUND:
        raise ConfigError(
            "`optimize` = pupil: the parameters are unidentifiable or the camera saturates with "
            "every pupil; lower bounds.photons_per_pixel, or free fewer parameters with fit.mode"
        )
    shares, evaluations = (
        tuple(math.exp(log_holevo - value) for value, _ in found),
        search.evaluations + whole.evaluations,
    )
    return _result(config, whole, best, descents=shares, evaluations=evaluations)


def _result(
    config: Config, whole: Search, found: Settings, *, descents: tuple[float, ...], evaluations: int
) -> PupilOptimum:
    """Bounds of the configured and of the best experiment, the latter as it will be written."""
    chosen, joint = whole.chosen, FREE_PARAMETERS[config.fit.mode]
    best = _uncalibrated(whole.config_of(found), whole.scale)
    quiet = with_keys(best, {"camera": {"read_noise_e": 0.0}, "bounds": {"n_before": 0}})
    here, there = plan(_uncalibrated(config, whole.scale)), plan(best)
    bound, (sigma, own) = _holevo(there, chosen), sigmas(there)
    columns = {"configured": sigmas(here)[0], "best": sigma, "qcrb": own}
    of_holevo = dict(zip(joint, bound.sigma.tolist(), strict=True))
    experiments = {"configured": here, "best": there, "quiet": plan(quiet)}
    return PupilOptimum(
        config=best,
        chosen=chosen,
        settings={key: (float(whole.start[key]), float(found[key])) for key in whole.knobs},
        sigma={
            name: {kind: float(each[PARAMETERS.index(name)]) for kind, each in columns.items()}
            | {"holevo": of_holevo[name]}
            for name in chosen
        },
        sums={kind: total_of(each, chosen) for kind, each in experiments.items()},
        holevo=bound.sum,
        transmitted=transmitted_over_collected(there.model, float(there.theta[2])),
        peak_e=there.peak_e,
        descents=descents,
        evaluations=evaluations,
    )


def _holevo(experiment: Experiment, chosen: tuple[str, ...]) -> Holevo:
    """Holevo bound over the mode's free parameters, of which the chosen ones weigh."""
    free = FREE_PARAMETERS[experiment.config.fit.mode]
    light = experiment.light(free)
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
    known = {"density_kg_m3": density, "mass_kda": matter.mass_kda, "diameter_nm": None}
    return config.changed(calibration=None, particle=known)


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
    return config.changed(bounds={"pixels": needed})


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
