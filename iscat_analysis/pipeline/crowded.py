"""The optics of a movie whose particles all bound at once, and hardly any of them stands alone.

From bright places alone the optics are learned roughly, with what is faint or near another not
accounted for.  With these optics the field is fitted, and from its particles, now all known, the
optics are learned again, until they describe pictures that were not fitted.

Particles that each have a height of their own are learned from in the same way, beginning with the
field as the configured optics fit it: their pictures differ, so that nothing can be averaged.  A
wrong focus has moved all their heights, to other fringes too: foci around the configured one are
tried, with every particle at the height that suits it best among the rings of all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.calibration.optics import (
    FREE,
    LEAST_SIGHTS,
    Neighbours,
    OpticsCalibration,
    Settings,
    Sight,
    free_names,
    heights_free,
    maximise,
    optics_limits,
    settings_of,
    with_settings,
)
from iscat_analysis.calibration.optics.starts import FOCUS_STEP_NM, with_masses
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.pipeline.field import fit_field
from iscat_analysis.pipeline.microscope import (
    calibrate_sights,
    goodness,
    microscopes,
    rings_of,
    with_sign,
)
from iscat_analysis.pipeline.scene import make_scene
from iscat_analysis.pipeline.sights import bright_places, known_places, reach_nm
from iscat_analysis.records import Mapper, Status, Windows

LEAST_ROUGH = 6
"""Bright places, whatever is near them, without which the optics are not even learned roughly."""

ROUNDS = 3
"""Of a fit of the field and optics learned from it."""

_FOCUS_MOVES_NM = tuple(FOCUS_STEP_NM * i for i in (0, -1, 1, -2, 2, -3, 3))
_TURNS = 2  # of heights of neighbours, and of their rings
_PASSES = 12  # of a fit from one of several heights
_OPTICS_PASSES = 8
_LEADERS = 2  # microscopes that are followed beside the configured one,
_FOLLOWED = 3  # for so many rounds,
_DESCRIBED_CHI2 = 1.2  # unless one describes the pictures

HOPELESS_CHI2 = 2.0
"""Reduced χ² of pictures that were not fitted, above which it must have fallen for another round.
Not more than that: with the first optics heights may be those of two fringes, and the field that is
fitted with the next ones has a single one."""


def seen_in_field(
    windows: Windows, config: Config, pool: ThreadPoolExecutor
) -> tuple[list[Sight], list[Sight]]:
    """Fit the field, and cut out the particles that are farthest from others.

    Parameters
    ----------
    windows : Windows
        The sums before and after.
    config : Config
        Resolved; with the optics to fit with.
    pool : ThreadPoolExecutor
        Runs the fits.

    Returns
    -------
    sights : list of Sight
        `LEAST_SIGHTS` or more where there are so many, the brightest first.
    others : list of Sight
        Every particle, on small regions.
    """
    free = heights_free(config)
    fit = config.fit.model_copy(update={"mode": "joint" if free else "mass"})
    rows, columns = windows.after_e.shape
    scene = make_scene(config.model_copy(update={"fit": fit}), (rows, columns))
    events, _ = fit_field(scene, windows, pool=pool)
    # with free heights what wrong optics leave over is beside particles, which would not be alone
    known = [e.fit.theta for e in events if not (free and Status.SIDELOBE in e.flags)]
    return known_places(windows, config, known, LEAST_SIGHTS)


def learn_in_field(
    windows: Windows,
    config: Config,
    groups: Sequence[str],
    source: Mapping[str, str],
    pool: ThreadPoolExecutor,
) -> OpticsCalibration:
    """Learn the optics from all particles of a field together.

    Parameters
    ----------
    windows : Windows
        The sums before and after.
    config : Config
        Resolved; with the optics where the search begins.
    groups : sequence of str
        As for `calibrate_sights`.
    source : mapping of str to str
        As for `calibrate_sights`.
    pool : ThreadPoolExecutor
        Runs the fits.

    Returns
    -------
    OpticsCalibration
        Of the first round that is accepted, or of the last.

    Raises
    ------
    DataError
        The field has too few particles.
    """
    guess: Config | None = config
    before, free = math.inf, heights_free(config)
    if not free:
        places, others = bright_places(windows, config, alone_nm=0.0)
        found = calibrate_sights(
            places, others, config, groups, source, least=LEAST_ROUGH, mapper=pool.map
        )
        guess, why = with_sign(with_settings(config, found.measured.settings))
    for number in range(ROUNDS):
        if guess is None:
            raise DataError(why)
        sights, others = seen_in_field(windows, guess, pool)
        known = settings_of(guess) if free else None
        found = calibrate_sights(
            sights, others, config, groups, source, known=known, mapper=pool.map
        )
        if free and not number and not _describes(found):
            begun = _likeliest(sights, others, guess, groups, pool.map)
            other = calibrate_sights(
                begun.sights, begun.others, config, groups, source, known=begun.settings,
                mapper=pool.map,
            )  # fmt: skip
            found = min(found, other, key=lambda one: (not one.accepted, _misfit(one)))
        misfit = _misfit(found)
        before = min(before, float(found.measured.configured.chi2_reduced.mean()))
        if found.accepted or misfit > max(HOPELESS_CHI2, before):
            break
        before = misfit
        guess, why = with_sign(with_settings(config, found.measured.settings))
    return found


def _misfit(found: OpticsCalibration) -> float:
    """Mean reduced χ² of pictures that were not fitted."""
    return float(found.measured.judgement.chi2_reduced.mean())


def _describes(found: OpticsCalibration) -> bool:
    """Whether what was learned describes all pictures, and not only most of them."""
    return found.accepted and _misfit(found) < _DESCRIBED_CHI2


@dataclass(frozen=True)
class _Begun:
    """A microscope, and all particles at the heights that suit it best.

    Attributes
    ----------
    settings : mapping
        Of the microscope.
    sights, others : list of Sight
        As from `seen_in_field`, the first among the rings of the others.
    misfit : float
        Median of the reduced χ² of the sights.
    """

    settings: Settings
    sights: list[Sight]
    others: list[Sight]
    misfit: float


def _likeliest(
    sights: Sequence[Sight],
    others: Sequence[Sight],
    config: Config,
    groups: Sequence[str],
    mapper: Mapper,
) -> _Begun:
    """Look for the microscope to begin with around the configured one.

    The foci and lights that suit the pictures best are followed for some rounds of optics, and of
    heights and rings in them.  Where particles are at one height this is done on the average of
    their pictures.
    """
    configured = settings_of(config)
    optics = config.optics
    limits = optics_limits(optics.n_immersion, optics.n_glass)
    build = microscopes(config, max(map(reach_nm, sights)))
    build_wide = rings_of(config, sights[0])
    lights = ("linear", "circular") if "polarization" in groups else (configured["polarization"],)
    focus_moves = _FOCUS_MOVES_NM if "focus" in groups else (0.0,)

    def placed(
        settings: Settings, some: Sequence[Sight], around: Sequence[Sight], moved: float = 0.0
    ) -> _Begun:
        model, wide = build(settings), build_wide(settings)
        fringe = model.fringe_nm
        anywhere = [moved + fringe * k for k in (-1.0, -0.5, 0.0, 0.5, 1.0)]

        def best(few: Sequence[Sight], shifts: Sequence[float]) -> list[tuple[float, Sight]]:
            return _best_heights(few, shifts, model, settings, mapper)

        near = [sight for _, sight in best(around, anywhere)]
        for _ in range(_TURNS):  # each among the rings of all, which other heights change
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
            {**configured, "polarization": light, "focus_nm": configured["focus_nm"] + moved},
            sights, others, moved,
        )
        for light in lights for moved in focus_moves
    ]  # fmt: skip
    tried.sort(key=lambda begun: begun.misfit)
    focus = configured["focus_nm"]
    first = next(begun for begun in tried if begun.settings["focus_nm"] == focus)
    leaders = [first, *(begun for begun in tried[:_LEADERS] if begun is not first)]
    followed: list[_Begun] = []
    for begun in leaders:
        for _ in range(_FOLLOWED):
            begun = better(begun)
            followed.append(begun)
            if begun.misfit < _DESCRIBED_CHI2:
                return begun
    return min([*tried, *followed], key=lambda begun: begun.misfit)


def _best_heights(
    sights: Sequence[Sight],
    shifts_nm: Sequence[float],
    model: ForwardModel,
    settings: Settings,
    mapper: Mapper,
) -> list[tuple[float, Sight]]:
    """Fit every sight from several heights; give the reduced χ² of the best fit, and that.

    Half a fringe away a particle of the other sign looks much the same, but none leaves here: a fit
    with the sign that the mass had is preferred.
    """

    def build(_: Settings) -> ForwardModel:
        return model

    found: list[list[tuple[bool, float, Sight]]] = [[] for _ in sights]
    for shift in shifts_nm:
        moved = [_raised(sight, shift) for sight in sights]
        begun = with_masses(moved, build, settings)
        fits = maximise(begun, build, settings, (), passes=_PASSES, mapper=mapper).sights
        for sight, fit, of_it in zip(sights, fits, found, strict=True):
            turned = sight.mass_kda * fit.mass_kda < 0
            of_it.append((turned, goodness(fit, model)[0], fit))
    return [min(fits, key=lambda fit: fit[:2])[1:] for fits in found]


def _raised(sight: Sight, shift_nm: float) -> Sight:
    """Begin at another height, within those that are possible."""
    low, high = sight.heights_nm or (sight.z_nm, sight.z_nm)
    return replace(sight, z_nm=min(max(sight.z_nm + shift_nm, low), high))
