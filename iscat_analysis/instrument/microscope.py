"""Microscopes of changing optics, and whether one describes the brightest particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from iscat_analysis.config import Config, refuse_rod
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import goodness_of_fit
from iscat_analysis.inference.heights import height_prior
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.joint_fit import Neighbours, maximise
from iscat_analysis.instrument.particle_image import (
    ParticleImage,
    average_particle_images,
    with_masses,
)
from iscat_analysis.last_used import memoize
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.parameters import Settings, heights_free, settings_of, with_settings
from iscat_analysis.records import Mapper


def build_microscope(config: Config, reach_nm: float, settings: Settings) -> ForwardModel:
    """Make the forward model of other optics, with the model's own mass scale."""
    changed = with_settings(config, settings).model_copy(update={"calibration": None})
    seated = not heights_free(config) and not config.particle.height_is_open
    highest = config.particle.nominal_height_nm if seated else None
    return forward_model(changed, reach_nm, z_max_nm=highest)


RINGS_NM = 9000.0
"""Farther than this from a particle its rings are left out."""
_SHIFT_NM = 450.0  # how far a particle may lie from the centre of its picture

TESTED = 24
"""Particles on which optics are tested, the brightest."""


def reach_nm(image: ParticleImage) -> float:
    """Distance from a particle, which may move in its picture, to the farthest pixel."""
    return image.grid.diagonal_nm / 2 + _SHIFT_NM


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
    refuse_rod(config, "optics are learned from round particles")
    if config.particle.is_sphere:
        raise ConfigError(
            f'particle.model = "{config.particle.model}": optics are learned from dipoles; record '
            "some, and give the file with their optics as optics.file"
        )


def microscopes(config: Config, reach_nm: float) -> Callable[[Settings], ForwardModel]:
    """Make models of changing optics, and keep the last few."""

    def model(items: tuple[tuple[str, Any], ...]) -> ForwardModel:
        return build_microscope(config, reach_nm, dict(items))

    at_hand = memoize(_MODELS_KEPT, model)
    return lambda settings: at_hand(tuple(settings.items()))


def rings_of(config: Config, image: ParticleImage) -> Callable[[Settings], ForwardModel]:
    """Make models as far as rings of neighbours matter."""
    return microscopes(config, RINGS_NM + image.grid.diagonal_nm)


def goodness(image: ParticleImage, model: ForwardModel) -> tuple[float, float]:
    """Reduced χ² and p-value of a fitted picture."""
    likelihood = Likelihood(model, image.grid, image.noise, image.data)
    return goodness_of_fit(likelihood, image.private, image.free)


def with_sign(config: Config) -> tuple[Config | None, str]:
    """Give learned optics the sign of contrast that the calibration of masses has.

    A line between contrast and mass fixes that sign, and with it the reference phase of two that
    differ by half a turn.
    """
    phase = config.optics.reference_phase_deg
    reason = ""
    for turned in (phase, (phase + 360) % 360 - 180):
        update = {"reference_phase_deg": turned, "calibrate": "never", "file": None}
        learned = config.model_copy(update={"optics": config.optics.model_copy(update=update)})
        try:
            forward_model(learned, 1000.0)
        except ConfigError as error:
            reason = str(error)
        else:
            return learned, ""
    return None, reason


REJECTED_P = 1e-3
"""Half of the brightest particles must fit worse than this before the optics are doubted: a few
that are not alone do not suffice."""

_STARTS_NM = tuple(range(-400, 401, 100))  # along each axis; rings are some 200 nm apart
_FITTED = 3  # of these starts
_CLEAR = 10.0  # standard errors of χ² by which a wrong microscope would be seen in a picture
_DESCRIBED = 0.1  # of that, which a picture that is described has at most
_DESCRIBED_SHARE = 0.25  # of the pictures, that must be described where others are not


def median_p(
    images: list[ParticleImage],
    config: Config,
    others: Sequence[ParticleImage] = (),
    mapper: Mapper = map,
) -> tuple[float, Sequence[ParticleImage]]:
    """Give the median p-value of the brightest particles in the configured microscope.

    The rings of neighbours, where any are known, are put into the pictures that fail without.
    Particles whose heights are open stand at the height that most of them tell.
    """
    settings = settings_of(config)
    build = microscopes(config, max(map(reach_nm, images)) + math.sqrt(2) * _STARTS_NM[-1])
    model = build(settings)
    shown: Sequence[ParticleImage] = images[:TESTED]
    x, y = 0.0, 0.0
    if not heights_free(config):
        averages, shown = average_particle_images(shown)
        x, y = _centre(averages[0], model, build, settings)

    def median(pictures: Sequence[ParticleImage]) -> tuple[float, Sequence[ParticleImage]]:
        fitted = maximise(pictures, build, settings, (), mapper=mapper).images
        return float(np.median([goodness(image, model)[1] for image in fitted])), fitted

    moved = [image.placed(image.x_nm + x, image.y_nm + y) for image in shown]
    shown = with_masses(moved, build, settings)
    if config.particle.height_is_open:
        free = maximise(with_heights(shown, config), build, settings, (), mapper=mapper).images
        middle = float(np.median([image.z_nm for image in free]))
        shown = [replace(image, z_nm=middle) for image in shown]
    found, fitted = median(shown)
    if found >= REJECTED_P or not any(image.neighbours for image in fitted):
        return found, fitted
    elsewhere = [other.placed(other.x_nm + x, other.y_nm + y) for other in others]
    near = Neighbours.fitted(elsewhere, build, rings_of(config, images[0]), settings, mapper)
    return max((found, fitted), median(near.around(fitted, mapper)), key=lambda each: each[0])


def with_heights(images: Sequence[ParticleImage], config: Config) -> Sequence[ParticleImage]:
    """Let each particle have its own height, if heights are to be learned from the movie."""
    prior = height_prior(config, 0.0) if config.particle.height_is_open else None
    heights = None if prior is None else prior.range_nm
    return [replace(image, heights_nm=heights or image.heights_nm) for image in images]


def not_alone(
    images: Sequence[ParticleImage],
    config: Config,
    others: Sequence[ParticleImage] = (),
    mapper: Mapper = map,
) -> tuple[list[int], float]:
    """Find bright places that the configured microscope describes badly, and others well.

    A microscope that is wrong is so for all particles, and is seen the better the brighter they
    are.  Where some as bright are described, the places that are not show two that landed at once.
    From a place that others drew aside a fit ends in another optimum: each begins anew here.
    """
    settings = settings_of(config)
    build = microscopes(config, max(map(reach_nm, images)) + math.sqrt(2) * _STARTS_NM[-1])
    model = build(settings)

    def fitted(image: ParticleImage) -> ParticleImage:
        x, y = _centre(image, model, build, settings)
        (placed,) = with_masses([image.placed(x, y)], build, settings)
        return maximise([placed], build, settings, ()).images[0]

    some = list(mapper(fitted, images[:TESTED]))
    if any(image.neighbours for image in some):
        near = Neighbours.fitted(others, build, rings_of(config, some[0]), settings, mapper)
        pictures = near.around(some, mapper)
        some = list(maximise(pictures, build, settings, (), mapper=mapper).images)
    chi2, p = np.transpose([goodness(image, model) for image in some])
    mass = np.array([image.mass_kda for image in some])
    poor = p < REJECTED_P
    if not poor.any() or poor.all():
        return [], float(np.median(p))
    expected = float(np.median((chi2 - 1)[poor] / mass[poor] ** 2)) * mass**2
    clear = expected > _CLEAR * np.sqrt(2 / math.prod(some[0].grid.shape))
    described = ~poor & clear & (chi2 - 1 < _DESCRIBED * expected)
    if described.sum() < max(2, _DESCRIBED_SHARE * len(some)):
        return [], float(np.median(p))
    return np.flatnonzero(poor).tolist(), float(np.median(p[~poor]))


def _centre(
    image: ParticleImage,
    model: ForwardModel,
    build: Callable[[Settings], ForwardModel],
    settings: Settings,
) -> tuple[float, float]:
    """Find the particle in a picture [nm], whose brightest spot may be of a ring.

    From a place half a ring away a fit ends in another optimum, with the mass of the other sign.
    """
    image = image.placed(image.x_nm, image.y_nm)
    starts = [image.placed(image.x_nm + x, image.y_nm + y) for x in _STARTS_NM for y in _STARTS_NM]

    def misfit(one: ParticleImage) -> float:
        return goodness(one, model)[0]

    likely = sorted(with_masses(starts, build, settings), key=misfit)[:_FITTED]
    fits = [maximise([image], build, settings, ()).images[0] for image in likely]
    best = min(fits, key=misfit)
    return best.x_nm, best.y_nm
