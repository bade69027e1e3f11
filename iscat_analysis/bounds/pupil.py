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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.bounds.experiment import Experiment, plan
from iscat_analysis.bounds.holevo import Holevo, holevo_bound
from iscat_analysis.bounds.pupil_search import KNOBS, NO_BOUND, OTHER_TERMS, Search, setting, sigmas
from iscat_analysis.bounds.quantum import transmitted_over_collected
from iscat_analysis.bounds.scan import calibrated_scale
from iscat_analysis.config import Config, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import MassScale
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, Progress, silent

FloatArray = NDArray[np.float64]

SEARCHED_NM = 3500.0
"""Side of the field in which valleys are searched; candidates are compared on the whole field."""


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
    quiet, _ = sigmas(
        plan(
            best.model_copy(
                update={
                    "camera": best.camera.model_copy(update={"read_noise_e": 0.0}),
                    "bounds": best.bounds.model_copy(update={"n_before": 0}),
                }
            )
        )
    )
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
    needed = math.ceil((SEARCHED_NM + 2 * max(abs(at.x_nm), abs(at.y_nm))) / pixel)
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
    if optics.scheme == "darkfield":
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
