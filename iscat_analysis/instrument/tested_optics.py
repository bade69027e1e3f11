"""Whether the configured optics describe the brightest particles of a movie."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.instrument.learner import (
    Neighbours,
    ParticleImage,
    Settings,
    heights_free,
    maximise,
    settings_of,
)
from iscat_analysis.instrument.learner.starts import average_particle_images, with_masses
from iscat_analysis.instrument.microscope import goodness, microscopes, rings_of
from iscat_analysis.instrument.particle_images import TESTED, reach_nm
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.records import Mapper

REJECTED_P = 1e-3
"""Half of the brightest particles must fit worse than this before the optics are doubted: a few
that are not alone do not suffice."""

_STARTS_NM = tuple(range(-400, 401, 100))  # along each axis; rings are some 200 nm apart
_FITTED = 3  # of these starts
_CLEAR = 10.0  # standard errors of χ² by which a wrong microscope would be seen in a picture
_DESCRIBED = 0.1  # of that, which a picture that is described has at most
_DESCRIBED_SHARE = 0.25  # of the pictures, that must be described where others are not


def median_p(
    sights: list[ParticleImage],
    config: Config,
    others: Sequence[ParticleImage] = (),
    mapper: Mapper = map,
) -> tuple[float, Sequence[ParticleImage]]:
    """Give the median p-value of the brightest particles in the configured microscope.

    The rings of neighbours, where any are known, are put into the pictures that fail without.
    """
    settings = settings_of(config)
    build = microscopes(config, max(map(reach_nm, sights)) + math.sqrt(2) * _STARTS_NM[-1])
    model = build(settings)
    shown: Sequence[ParticleImage] = sights[:TESTED]
    x, y = 0.0, 0.0
    if not heights_free(config):
        averages, shown = average_particle_images(shown)
        x, y = _centre(averages[0], model, build, settings)

    def median(pictures: Sequence[ParticleImage]) -> tuple[float, Sequence[ParticleImage]]:
        fitted = maximise(pictures, build, settings, (), mapper=mapper).sights
        return float(np.median([goodness(sight, model)[1] for sight in fitted])), fitted

    moved = [sight.placed(sight.x_nm + x, sight.y_nm + y) for sight in shown]
    found, fitted = median(with_masses(moved, build, settings))
    if found >= REJECTED_P or not any(sight.neighbours for sight in fitted):
        return found, fitted
    elsewhere = [other.placed(other.x_nm + x, other.y_nm + y) for other in others]
    near = Neighbours.fitted(elsewhere, build, rings_of(config, sights[0]), settings, mapper)
    return max((found, fitted), median(near.around(fitted, mapper)), key=lambda each: each[0])


def not_alone(
    sights: Sequence[ParticleImage],
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
    build = microscopes(config, max(map(reach_nm, sights)) + math.sqrt(2) * _STARTS_NM[-1])
    model = build(settings)

    def fitted(sight: ParticleImage) -> ParticleImage:
        x, y = _centre(sight, model, build, settings)
        (placed,) = with_masses([sight.placed(x, y)], build, settings)
        return maximise([placed], build, settings, ()).sights[0]

    some = list(mapper(fitted, sights[:TESTED]))
    if any(sight.neighbours for sight in some):
        near = Neighbours.fitted(others, build, rings_of(config, some[0]), settings, mapper)
        pictures = near.around(some, mapper)
        some = list(maximise(pictures, build, settings, (), mapper=mapper).sights)
    chi2, p = np.transpose([goodness(sight, model) for sight in some])
    mass = np.array([sight.mass_kda for sight in some])
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
    sight: ParticleImage,
    model: ForwardModel,
    build: Callable[[Settings], ForwardModel],
    settings: Settings,
) -> tuple[float, float]:
    """Find the particle in a picture [nm], whose brightest spot may be of a ring.

    From a place half a ring away a fit ends in another optimum, with the mass of the other sign.
    """
    sight = sight.placed(sight.x_nm, sight.y_nm)
    starts = [sight.placed(sight.x_nm + x, sight.y_nm + y) for x in _STARTS_NM for y in _STARTS_NM]

    def misfit(one: ParticleImage) -> float:
        return goodness(one, model)[0]

    likely = sorted(with_masses(starts, build, settings), key=misfit)[:_FITTED]
    fits = [maximise([sight], build, settings, ()).sights[0] for sight in likely]
    best = min(fits, key=misfit)
    return best.x_nm, best.y_nm
