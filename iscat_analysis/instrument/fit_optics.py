"""The optics fitted to pictures: at one height, or at heights of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.config import MOVES, Config
from iscat_analysis.errors import DataError
from iscat_analysis.instrument.joint_fit import Neighbours, maximise
from iscat_analysis.instrument.measure import TWIN_GAP, Measured, OpticsSearch
from iscat_analysis.instrument.microscope import goodness, microscopes, reach_nm, rings_of
from iscat_analysis.instrument.particle_image import ParticleImage, with_masses
from iscat_analysis.instrument.result import OpticsCalibration, make_pictures, make_result
from iscat_analysis.instrument.starts import FOCUS_STEP_NM
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.parameters import (
    FIELD,
    FOCUS_STEP,
    FREE,
    Settings,
    free_names,
    optics_limits,
    prior_of,
    settings_of,
)
from iscat_analysis.records import Mapper

STEP_FACTORS = (0.5, 2.0)
"""How much smaller or larger than said the steps of a scan may turn out."""

_FOCUS_MOVES_NM = tuple(FOCUS_STEP_NM * i for i in (0, -1, 1, -2, 2, -3, 3))
_TURNS = 2  # of heights of neighbours, and of their rings
_HEIGHT_PASSES = 12  # of a fit from one of several heights
_OPTICS_PASSES = 8
_LEADERS = 2  # microscopes that are followed beside the configured one,
_FOLLOWED = 3  # for so many rounds,
_CLEAR = 1.0  # unless one describes the pictures to so many standard errors of one picture's χ²
_ODD_NA = 0.02  # between the aperture of an objective and what is engraved on it
_ODD_SIGMAS = 5.0
_PIXEL_ERROR = 1e-3  # to which the size of pixels is looked for, over that size
_DESCRIBED_CHI2 = 1.2  # of pictures that were not fitted, from which no other is looked for


@dataclass(frozen=True)
class Collected:
    """Pictures of particles, and what is known of the microscope that made them."""

    config: Config
    """As configured: where the search begins, and what stays where pictures do not tell it."""

    images: Sequence[ParticleImage]
    others: Sequence[ParticleImage] = ()
    """Particles whose rings are in the pictures."""

    near: Settings | None = None
    """A microscope near theirs, from which the fit goes on; None: one is looked for."""

    found_with: Config | None = None
    """Optics with which they were found; None where no optics took part in that."""

    focus_step_nm: float | None = None
    """Of a scan of the focus."""

    refusal: str = ""
    """Why no optics describe them, however well they fit."""


def fit_optics(
    seen: Collected, groups: Sequence[str], origin: Mapping[str, str], mapper: Mapper = map
) -> OpticsCalibration:
    """Fit the optics to pictures; where each particle has a height of its own, with all heights.

    Such pictures differ, so that nothing can be averaged.  A wrong focus has moved all their
    heights, to other fringes too: foci around the configured one are tried, with every particle at
    the height that suits it best among the rings of all.
    """
    free = any(image.heights_nm is not None for image in seen.images)
    start = replace(seen, near=settings_of(seen.config)) if free and seen.near is None else seen
    found = _fitted(start, groups, origin, mapper)
    if not free or seen.near is not None or (found.accepted and misfit_of(found) < _DESCRIBED_CHI2):
        return found
    begun = _likeliest(start, groups, mapper)
    other = _fitted(
        replace(seen, images=begun.images, others=begun.others, near=begun.settings),
        groups,
        origin,
        mapper,
    )
    return min(found, other, key=lambda one: (not one.accepted, misfit_of(one)))


def none_bright(name: str) -> str:
    """Say that nothing tells the optics, and what would."""
    return (
        f"{name}: shows no bright particle that stands alone, from which the optics would be "
        "learned; record brighter ones (20 nm gold, or protein of 400 kDa and more), or more "
        "photons per frame"
    )


def misfit_of(found: OpticsCalibration) -> float:
    """Give the mean reduced χ² of pictures that were not fitted."""
    return float(found.measured.judgement.chi2_reduced.mean())


def _fitted(
    seen: Collected, groups: Sequence[str], origin: Mapping[str, str], mapper: Mapper
) -> OpticsCalibration:
    """Measure the microscope and put the result together."""
    config, images = seen.config, seen.images
    if not images:
        raise DataError(none_bright(origin["movie"]))
    configured = settings_of(config)
    limits = optics_limits(config.optics.n_immersion, config.optics.n_glass)
    if seen.focus_step_nm is not None:
        configured[FOCUS_STEP] = seen.focus_step_nm
        low, high = sorted(factor * seen.focus_step_nm for factor in STEP_FACTORS)
        limits[FOCUS_STEP] = (low, high)
    near = seen.near or {}
    configured |= {name: 0.0 for name in (*MOVES, *FIELD) if name in near}
    build = microscopes(config, max(map(reach_nm, images)))
    focus = config.optics.focus_nm
    search = OpticsSearch(
        configured,
        build,
        groups,
        limits,
        prior_of(config, configured),
        side=int(math.copysign(1, focus)) if focus else 0,
        others=seen.others,
        build_wide=rings_of(config, images[0]),
        known=seen.near,
        mapper=mapper,
    )
    measured = search.run(images)
    if seen.refusal:
        measured = replace(measured, refusals=(*measured.refusals, seen.refusal))
    estimate = measured.estimate
    pictures = make_pictures(estimate.images, build, estimate.values)
    notes = _on_the_pixel(search, config, measured)
    return make_result(config, configured, measured, pictures, origin, notes)


def _on_the_pixel(search: OpticsSearch, config: Config, measured: Measured) -> tuple[str, ...]:
    """Say that the pixels may be wrong where the aperture is another than the configured one.

    Pictures of a smaller aperture are wider, and so are those whose pixels are said to be too
    large.  Light beyond the critical angle tells both apart, and does not widen as the rest does:
    the size is fitted, with the aperture as configured, and named unless it is ruled out.
    """
    from scipy.optimize import minimize_scalar

    estimate, pixel = measured.estimate, config.camera.pixel_size_nm
    if "na" not in estimate.names or pixel is None:
        return ()
    k = estimate.names.index("na")
    engraved, values = search.configured["na"], estimate.values
    apart = values["na"] - engraved
    if abs(apart) < max(_ODD_NA, _ODD_SIGMAS * math.sqrt(estimate.covariance[k, k])):
        return ()
    most = (values["na"] / engraved) ** 2  # apertures change by half of what pixels do, or more
    build = microscopes(config, max(1.0, most) * max(map(reach_nm, estimate.images)))

    def misfit(factor: float) -> float:
        fit = maximise(
            [image.stretched(factor) for image in estimate.images],
            build,
            {**values, "na": engraved},
            [name for name in estimate.names if name != "na"],
            prior=search.prior, limits=search.limits, passes=_OPTICS_PASSES, mapper=search.mapper,
        )  # fmt: skip
        return estimate.log_likelihood - fit.log_likelihood

    found = minimize_scalar(
        misfit, bounds=sorted((1.0, most)), method="bounded", options={"xatol": _PIXEL_ERROR}
    )
    if found.fun > TWIN_GAP:
        return ()
    return (
        f"the numerical aperture differs by {apart:+.3f} from the configured one; pixels of about "
        f"{found.x * pixel:.1f} nm instead of {pixel:g} nm would explain the pictures as well: "
        "check camera.pixel_size_nm",
    )


@dataclass(frozen=True)
class _Begun:
    """A microscope, and all particles at the heights that suit it best."""

    settings: Settings
    images: list[ParticleImage]
    others: list[ParticleImage]
    misfit: float


def _likeliest(seen: Collected, groups: Sequence[str], mapper: Mapper) -> _Begun:
    """Look for the microscope to begin with around the one that is near.

    The foci and lights that suit the pictures best are followed for some rounds of optics, and of
    heights and rings in them.  Where particles are at one height this is done on the average of
    their pictures.
    """
    config, known = seen.config, dict(seen.near or {})
    images, others = seen.images, seen.others
    optics = config.optics
    limits = optics_limits(optics.n_immersion, optics.n_glass)
    build = microscopes(config, max(map(reach_nm, images)))
    build_wide = rings_of(config, images[0])
    lights = ("linear", "circular") if "polarization" in groups else (known["polarization"],)
    focus_moves = _FOCUS_MOVES_NM if "focus" in groups else (0.0,)
    # a focus and heights that are one fringe off describe the pictures nearly as well
    clear = 1 + _CLEAR * math.sqrt(2 / math.prod(images[0].grid.shape))

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

        near = [image for _, image in best(around, anywhere)] if around else []
        for _ in range(_TURNS if near else 0):  # each among all, whose rings other heights change
            among = Neighbours(tuple(near), wide).around(near, mapper)
            near = [image for _, image in best(among, [-fringe, 0.0, fringe])]
        found = best(Neighbours(tuple(near), wide).around(some, mapper), anywhere)
        misfit = float(np.median([chi2 for chi2, _ in found]))
        return _Begun(settings, [image for _, image in found], near, misfit)

    def better(one: _Begun) -> _Begun:
        names = free_names(groups, one.settings, FREE["zernike"])
        fit = maximise(
            one.images, build, one.settings, names, prior=prior_of(config), limits=limits,
            passes=_OPTICS_PASSES, mapper=mapper,
        )  # fmt: skip
        return placed(fit.values, fit.images, one.others)

    tried = [
        placed(
            {**known, "polarization": light, "focus_nm": known["focus_nm"] + moved},
            images, others, moved,
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
    images: Sequence[ParticleImage],
    shifts_nm: Sequence[float],
    model: ForwardModel,
    settings: Settings,
    mapper: Mapper,
) -> list[tuple[float, ParticleImage]]:
    """Fit every image from several heights; give the reduced χ² of the best fit, and that.

    Half a fringe away a particle of the other sign looks much the same, but none leaves here: a fit
    with the sign that the mass had is preferred.
    """

    def build(_: Settings) -> ForwardModel:
        return model

    found: list[list[tuple[bool, float, ParticleImage]]] = [[] for _ in images]
    for shift in shifts_nm:
        moved = [image.raised(shift) for image in images]
        begun = with_masses(moved, build, settings)
        fits = maximise(begun, build, settings, (), passes=_HEIGHT_PASSES, mapper=mapper).images
        for image, fit, of_it in zip(images, fits, found, strict=True):
            turned = image.mass_kda * fit.mass_kda < 0
            of_it.append((turned, goodness(fit, model)[0], fit))
    return [min(fits, key=lambda fit: fit[:2])[1:] for fits in found]
