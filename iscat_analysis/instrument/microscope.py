"""The microscope of a movie, measured from the pictures of its bright particles."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.learner import (
    FIELD,
    FOCUS_DRIFT,
    FOCUS_STEP,
    LEAST_SIGHTS,
    OpticsCalibration,
    ParticleImage,
    Settings,
    build_microscope,
    make_pictures,
    make_result,
    measure_microscope,
    optics_limits,
    settings_of,
)
from iscat_analysis.instrument.particle_images import RINGS_NM, reach_nm
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.memoize import memoize
from iscat_analysis.records import Mapper
from iscat_analysis.units import count

STEP_FACTORS = (0.5, 2.0)
"""How much smaller or larger than said the steps of a scan may turn out."""

_MODELS_KEPT = 64  # as many as there are pictures with optics of their own


def refuse_uncalibratable(config: Config) -> None:
    """Refuse what has no reference to interfere with, or no derivative."""
    if config.optics.scheme == "darkfield":
        raise ConfigError(
            'optics.scheme = "darkfield" has no reference, and the optics are learned from the '
            "interference with it: calibrate with an interferometric movie of the same microscope"
        )
    if config.optics.convention == "dong2021":
        raise ConfigError('optics.convention = "dong2021" cannot be calibrated: use "exact"')


def calibrate_particle_images(
    sights: Sequence[ParticleImage],
    others: Sequence[ParticleImage],
    config: Config,
    groups: Sequence[str],
    source: Mapping[str, str],
    *,
    focus_step_nm: float | None = None,
    least: int = LEAST_SIGHTS,
    known: Settings | None = None,
    mapper: Mapper = map,
) -> OpticsCalibration:
    """Measure the optics from pictures."""
    if len(sights) < least:
        raise DataError(
            f"{source['movie']}: shows {count(len(sights), 'bright particle')} standing alone, and "
            f"at least {LEAST_SIGHTS} are needed to learn the optics; record more particles, or "
            "brighter ones (20 nm gold, or protein of 400 kDa and more), or more photons per frame"
        )
    configured = settings_of(config)
    limits = optics_limits(config.optics.n_immersion, config.optics.n_glass)
    if focus_step_nm is not None:
        configured[FOCUS_STEP] = focus_step_nm
        low, high = sorted(factor * focus_step_nm for factor in STEP_FACTORS)
        limits[FOCUS_STEP] = (low, high)
    configured |= {name: 0.0 for name in (FOCUS_DRIFT, *FIELD) if known and name in known}
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
        build_wide=rings_of(config, sights[0]),
        known=known,
        mapper=mapper,
    )
    estimate = measured.estimate
    pictures = make_pictures(estimate.sights, build, estimate.values)
    return make_result(config, configured, measured, pictures, source)


def microscopes(config: Config, reach_nm: float) -> Callable[[Settings], ForwardModel]:
    """Make models of changing optics, and keep the last few."""
    latest = threading.local()  # neighbours in a search often share their tables

    def model(items: tuple[tuple[str, Any], ...]) -> ForwardModel:
        like = getattr(latest, "model", None)
        found = build_microscope(config, reach_nm, dict(items), like=like)
        latest.model = found
        return found

    at_hand = memoize(_MODELS_KEPT, model)
    return lambda settings: at_hand(tuple(settings.items()))


def rings_of(config: Config, sight: ParticleImage) -> Callable[[Settings], ForwardModel]:
    """Make models as far as rings of neighbours matter."""
    return microscopes(config, RINGS_NM + sight.grid.diagonal_nm)


def goodness(sight: ParticleImage, model: ForwardModel) -> tuple[float, float]:
    """Reduced χ² and p-value of a fitted picture."""
    likelihood = Likelihood(model, sight.grid, sight.noise, sight.data)
    return goodness_of_fit(likelihood, sight.private, sight.free)


def with_sign(config: Config) -> tuple[Config | None, str]:
    """Give learned optics the sign of contrast that the calibration of masses has.

    A line between contrast and mass fixes that sign, and with it the reference phase of two that
    differ by half a turn.
    """
    phase = config.optics.reference_phase_deg
    reason = ""
    for turned in (phase, (phase + 360) % 360 - 180):
        update = {"reference_phase_deg": turned, "calibrate": "never"}
        learned = config.model_copy(update={"optics": config.optics.model_copy(update=update)})
        try:
            forward_model(learned, 1000.0)
        except ConfigError as error:
            reason = str(error)
        else:
            return learned, ""
    return None, reason
