"""The optics learned from particles that each have a height of their own, which is unknown too.

Their pictures differ, so that nothing can be averaged.  A wrong focus has moved all their heights,
to other fringes too: foci around the configured one are tried, with every particle at the height
that suits it best among the rings of all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.instrument.learner import (
    FREE,
    Neighbours,
    OpticsCalibration,
    ParticleImage,
    Settings,
    free_names,
    maximise,
    optics_limits,
)
from iscat_analysis.instrument.learner.starts import FOCUS_STEP_NM, with_masses
from iscat_analysis.instrument.microscope import (
    calibrate_particle_images,
    goodness,
    microscopes,
    rings_of,
)
from iscat_analysis.instrument.particle_images import reach_nm
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.records import Mapper

_FOCUS_MOVES_NM = tuple(FOCUS_STEP_NM * i for i in (0, -1, 1, -2, 2, -3, 3))
_TURNS = 2  # of heights of neighbours, and of their rings
_PASSES = 12  # of a fit from one of several heights
_OPTICS_PASSES = 8
_LEADERS = 2  # microscopes that are followed beside the configured one,
_FOLLOWED = 3  # for so many rounds,
_CLEAR = 1.0  # unless one describes the pictures to so many standard errors of one picture's χ²
_DESCRIBED_CHI2 = 1.2  # of pictures that were not fitted, from which no other is looked for


def learn_with_heights(
    sights: Sequence[ParticleImage],
    others: Sequence[ParticleImage],
    config: Config,
    groups: Sequence[str],
    source: Mapping[str, str],
    *,
    known: Settings,
    around: bool,
    mapper: Mapper = map,
) -> OpticsCalibration:
    """Learn the optics from particles whose heights are between limits."""
    found = calibrate_particle_images(
        sights, others, config, groups, source, known=known, mapper=mapper
    )
    if not around or (found.accepted and misfit_of(found) < _DESCRIBED_CHI2):
        return found
    begun = _likeliest(sights, others, config, known, groups, mapper)
    other = calibrate_particle_images(
        begun.sights, begun.others, config, groups, source, known=begun.settings, mapper=mapper
    )
    return min(found, other, key=lambda one: (not one.accepted, misfit_of(one)))


def misfit_of(found: OpticsCalibration) -> float:
    """Give the mean reduced χ² of pictures that were not fitted."""
    return float(found.measured.judgement.chi2_reduced.mean())


@dataclass(frozen=True)
class _Begun:
    """A microscope, and all particles at the heights that suit it best."""

    settings: Settings
    sights: list[ParticleImage]
    others: list[ParticleImage]
    misfit: float


def _likeliest(
    sights: Sequence[ParticleImage],
    others: Sequence[ParticleImage],
    config: Config,
    known: Settings,
    groups: Sequence[str],
    mapper: Mapper,
) -> _Begun:
    """Look for the microscope to begin with around the known one.

    The foci and lights that suit the pictures best are followed for some rounds of optics, and of
    heights and rings in them.  Where particles are at one height this is done on the average of
    their pictures.
    """
    optics = config.optics
    limits = optics_limits(optics.n_immersion, optics.n_glass)
    build = microscopes(config, max(map(reach_nm, sights)))
    build_wide = rings_of(config, sights[0])
    lights = ("linear", "circular") if "polarization" in groups else (known["polarization"],)
    focus_moves = _FOCUS_MOVES_NM if "focus" in groups else (0.0,)
    # a focus and heights that are one fringe off describe the pictures nearly as well
    clear = 1 + _CLEAR * math.sqrt(2 / math.prod(sights[0].grid.shape))

    def placed(
        settings: Settings,
        some: Sequence[ParticleImage],
        around: Sequence[ParticleImage],
        moved: float = 0.0,
    ) -> _Begun:
        model, wide = build(settings), build_wide(settings)
        fringe = model.fringe_nm
        anywhere = [moved + fringe * k for k in (-1.0, -0.5, 0.0, 0.5, 1.0)]

        def best(
            few: Sequence[ParticleImage], shifts: Sequence[float]
        ) -> list[tuple[float, ParticleImage]]:
            return _best_heights(few, shifts, model, settings, mapper)

        near = [sight for _, sight in best(around, anywhere)] if around else []
        for _ in range(_TURNS if near else 0):  # each among all, whose rings other heights change
            among = Neighbours(tuple(near), wide).around(near, mapper)
            near = [sight for _, sight in best(among, [-fringe, 0.0, fringe])]
        found = best(Neighbours(tuple(near), wide).around(some, mapper), anywhere)
        misfit = float(np.median([chi2 for chi2, _ in found]))
        return _Begun(settings, [sight for _, sight in found], near, misfit)

    def better(one: _Begun) -> _Begun:
        names = free_names(groups, one.settings, FREE["zernike"])
        fit = maximise(
            one.sights, build, one.settings, names, limits=limits, passes=_OPTICS_PASSES,
            mapper=mapper,
        )  # fmt: skip
        return placed(fit.values, fit.sights, one.others)

    tried = [
        placed(
            {**known, "polarization": light, "focus_nm": known["focus_nm"] + moved},
            sights, others, moved,
        )
        for light in lights for moved in focus_moves
    ]  # fmt: skip
    tried.sort(key=lambda begun: begun.misfit)
    first = next(begun for begun in tried if begun.settings["focus_nm"] == known["focus_nm"])
    leaders = [first, *(begun for begun in tried[:_LEADERS] if begun is not first)]
    followed: list[_Begun] = []
    for begun in leaders:
        for _ in range(_FOLLOWED):
            begun = better(begun)
            followed.append(begun)
            if begun.misfit < clear:
                return begun
    return min([*tried, *followed], key=lambda begun: begun.misfit)


def _best_heights(
    sights: Sequence[ParticleImage],
    shifts_nm: Sequence[float],
    model: ForwardModel,
    settings: Settings,
    mapper: Mapper,
) -> list[tuple[float, ParticleImage]]:
    """Fit every sight from several heights; give the reduced χ² of the best fit, and that.

    Half a fringe away a particle of the other sign looks much the same, but none leaves here: a fit
    with the sign that the mass had is preferred.
    """

    def build(_: Settings) -> ForwardModel:
        return model

    found: list[list[tuple[bool, float, ParticleImage]]] = [[] for _ in sights]
    for shift in shifts_nm:
        moved = [sight.raised(shift) for sight in sights]
        begun = with_masses(moved, build, settings)
        fits = maximise(begun, build, settings, (), passes=_PASSES, mapper=mapper).sights
        for sight, fit, of_it in zip(sights, fits, found, strict=True):
            turned = sight.mass_kda * fit.mass_kda < 0
            of_it.append((turned, goodness(fit, model)[0], fit))
    return [min(fits, key=lambda fit: fit[:2])[1:] for fits in found]
