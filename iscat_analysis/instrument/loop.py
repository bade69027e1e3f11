"""Which microscope was it?  One loop, whoever the particles are: collect, test, fit, accept, again.

The loop collects pictures of particles, tests whether the optics with which they were found
describe them, fits optics to them, and accepts or refuses the result.  Where pictures depend on the
optics, it collects them again with what was learned, until nothing changes.

Pictures of tracks do.  The light under particles that move is learned with their tracks.  With
wrong optics it takes up a part of what they leave over, and the pictures show only the rest: what
is learned from them is nearer to the truth, but not there, though it may describe the pictures.
Each round leaves a share of the error of the round before.  The share is seen in how much less a
round changes than the one before, and with it what is still to come.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Protocol

import numpy as np

from iscat_analysis.config import MOVES, Config
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import ODD_APERTURE
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.instrument.collect import bright_places, known_places
from iscat_analysis.instrument.joint_fit import Neighbours, maximise
from iscat_analysis.instrument.measure import FOCUS_STEP_NM, TWIN_GAP, Measured, OpticsSearch
from iscat_analysis.instrument.particle_image import (
    Collected,
    Images,
    ParticleImage,
    goodness,
    microscopes,
    reach_nm,
    rings_of,
    with_masses,
    with_sign,
)
from iscat_analysis.instrument.result import OpticsCalibration, make_pictures, make_result
from iscat_analysis.instrument.uneven import FieldOfView, asked_change, in_uneven_field
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.parameters import (
    FIELD,
    FOCUS_STEP,
    FREE,
    Settings,
    change_of,
    free_names,
    optics_limits,
    prior_of,
    settings_of,
    with_settings,
)
from iscat_analysis.records import FloatArray, Mapper, Status, Windows

_OPTICS_PASSES = 8


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
    # of pictures that were not fitted, from which no other is looked for
    if not free or seen.near is not None or (found.accepted and misfit_of(found) < 1.2):
        return found
    begun = _likeliest(start, _search(start, groups, mapper))
    near = replace(seen, images=begun.images, others=begun.others, near=begun.settings)
    other = _fitted(near, groups, origin, mapper)
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


def _search(seen: Collected, groups: Sequence[str], mapper: Mapper) -> OpticsSearch:
    """Set up the measurement of the microscope."""
    config, images = seen.config, seen.images
    configured = settings_of(config)
    limits = optics_limits(config.optics.n_immersion, config.optics.n_glass)
    if seen.focus_step_nm is not None:
        configured[FOCUS_STEP] = seen.focus_step_nm
        # how much smaller or larger than said the steps of a scan may turn out
        low, high = sorted(factor * seen.focus_step_nm for factor in (0.5, 2.0))
        limits[FOCUS_STEP] = (low, high)
    configured |= {name: 0.0 for name in (*MOVES, *FIELD) if name in (seen.near or {})}
    build, wide = microscopes(config, max(map(reach_nm, images))), rings_of(config, images[0])
    prior, focus = prior_of(config, configured), config.optics.focus_nm
    side = int(math.copysign(1, focus)) if focus else 0
    return OpticsSearch(
        configured, build, groups, limits, prior, side, seen.others, wide, seen.near, mapper
    )


def _fitted(
    seen: Collected, groups: Sequence[str], origin: Mapping[str, str], mapper: Mapper
) -> OpticsCalibration:
    """Measure the microscope and put the result together."""
    if not seen.images:
        raise DataError(none_bright(origin["movie"]))
    search = _search(seen, groups, mapper)
    measured = search.run(seen.images)
    if seen.refusal:
        measured = replace(measured, refusals=(*measured.refusals, seen.refusal))
    estimate = measured.estimate
    pictures = make_pictures(estimate.images, search.build, estimate.values)
    notes = _on_the_pixel(search, seen.config, measured)
    return make_result(seen.config, search.configured, measured, pictures, origin, notes)


def _on_the_pixel(search: OpticsSearch, config: Config, measured: Measured) -> tuple[Finding, ...]:
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
    # between the aperture of an objective and what is engraved on it
    if abs(apart) < max(0.02, 5 * math.sqrt(estimate.covariance[k, k])):
        return ()
    most = (values["na"] / engraved) ** 2  # apertures change by half of what pixels do, or more
    reach = max(1.0, most) * max(map(reach_nm, estimate.images))
    wider = replace(search, build=microscopes(config, reach))
    names = [name for name in estimate.names if name != "na"]

    def misfit(factor: float) -> float:
        stretched = [image.stretched(factor) for image in estimate.images]
        fit = wider.fit(stretched, {**values, "na": engraved}, names, _OPTICS_PASSES)
        return estimate.log_likelihood - fit.log_likelihood

    # to which the size of pixels is looked for, over that size
    options = {"xatol": 1e-3}
    ends = sorted((1.0, most))
    found = minimize_scalar(misfit, bounds=ends, method="bounded", options=options)
    if found.fun > TWIN_GAP:
        return ()
    sizes = {"pixel_nm": float(found.x) * pixel, "configured_nm": pixel}
    return (ODD_APERTURE({"difference": apart, **sizes}),)


@dataclass(frozen=True)
class _Begun:
    """A microscope, and all particles at the heights that suit it best."""

    settings: Settings
    images: Images
    others: Images
    misfit: float


def _likeliest(seen: Collected, search: OpticsSearch) -> _Begun:
    """Look for the microscope to begin with around the one that is near.

    The foci and lights that suit the pictures best are followed for some rounds of optics, and of
    heights and rings in them.  Where particles are at one height this is done on the average of
    their pictures.
    """
    known, groups = dict(seen.near or {}), search.free
    build_wide = rings_of(seen.config, seen.images[0])
    lights = ("linear", "circular") if "polarization" in groups else (known["polarization"],)
    steps = (0, -1, 1, -2, 2, -3, 3) if "focus" in groups else (0,)
    # to a standard error of one picture's χ²: a focus and heights that are one fringe off describe
    # the pictures nearly as well
    clear = 1 + math.sqrt(2 / math.prod(seen.images[0].grid.shape))

    def placed(settings: Settings, some: Images, around: Images, moved: float = 0.0) -> _Begun:
        model, wide = search.build(settings), build_wide(settings)
        fringe = model.fringe_nm
        anywhere = [moved + fringe * k for k in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        near = _best_heights(around, anywhere, model, settings, search.mapper)[0]
        for _ in range(2 if near else 0):  # each among all, whose rings other heights change
            among = Neighbours(near, wide).around(near, search.mapper)
            shifts = [-fringe, 0.0, fringe]
            near = _best_heights(among, shifts, model, settings, search.mapper)[0]
        among = Neighbours(near, wide).around(some, search.mapper)
        images, chi2 = _best_heights(among, anywhere, model, settings, search.mapper)
        return _Begun(settings, images, near, float(np.median(chi2)))

    def better(one: _Begun) -> _Begun:
        names = free_names(groups, one.settings, FREE["zernike"])
        fit = search.fit(one.images, one.settings, names, _OPTICS_PASSES)
        return placed(fit.values, fit.images, one.others)

    tried = []
    for light, moved in product(lights, [FOCUS_STEP_NM * step for step in steps]):
        there = {**known, "polarization": light, "focus_nm": known["focus_nm"] + moved}
        tried.append(placed(there, seen.images, seen.others, moved))
    tried.sort(key=lambda begun: begun.misfit)
    first = next(begun for begun in tried if begun.settings["focus_nm"] == known["focus_nm"])
    leaders = [first, *(begun for begun in tried[:2] if begun is not first)]
    for begun in leaders:
        for _ in range(3):
            begun = better(begun)
            tried.append(begun)
            if begun.misfit < clear:
                return begun
    return min(tried, key=lambda begun: begun.misfit)


def _best_heights(
    images: Images, shifts: Sequence[float], model: ForwardModel, settings: Settings, mapper: Mapper
) -> tuple[Images, list[float]]:
    """Fit every image from heights with several shifts [nm]; give the best, and their reduced χ².

    Half a fringe away a particle of the other sign looks much the same, but none leaves here: a fit
    with the sign that the mass had is preferred.
    """
    found: list[list[tuple[bool, float, ParticleImage]]] = [[] for _ in images]
    for shift in shifts if images else ():
        moved = [image.raised(shift) for image in images]
        begun = with_masses(moved, lambda _: model, settings)
        # of a fit from one of several heights
        fits = maximise(begun, lambda _: model, settings, (), passes=12, mapper=mapper).images
        for image, fit, of_it in zip(images, fits, found, strict=True):
            turned = image.mass_kda * fit.mass_kda < 0
            of_it.append((turned, goodness(fit, model)[0], fit))
    best = [min(fits, key=lambda fit: fit[:2]) for fits in found]
    return [fit for *_, fit in best], [chi2 for _, chi2, _ in best]


class PictureSource(Protocol):
    """Where pictures of particles come from: landings, a field before and after, tracks, a scan."""

    def collect(self, rounds: Rounds) -> Collected | None:
        """Give pictures for the next round; None where it would tell nothing more."""

    def describes(self, seen: Collected) -> bool:
        """Tell whether the optics with which pictures were found describe them."""


def learn(
    source: PictureSource,
    config: Config,
    groups: Sequence[str],
    origin: Mapping[str, str],
    mapper: Mapper = map,
) -> Rounds:
    """Learn the optics of a movie from pictures of its particles."""
    rounds = Rounds()
    while (seen := _collected(source, rounds)) is not None:
        described = source.describes(seen)
        found = fit_optics(seen, groups, origin, mapper)
        learned, reason = accepted(found, config)
        ahead = learned or with_sign(with_settings(config, found.measured.settings))[0]
        rounds = Rounds((*rounds.all, Round(seen, described, found, learned, ahead, reason)))
    return rounds


def _collected(source: PictureSource, rounds: Rounds) -> Collected | None:
    """Collect pictures; where that fails with what was learned last, the best so far stays."""
    try:
        return source.collect(rounds)
    except DataError:
        if rounds.best is None:
            raise
        return None


def accepted(found: OpticsCalibration, config: Config) -> tuple[Config | None, str]:
    """Give the configuration with the learned optics, or why there is none."""
    if not found.accepted:
        return None, "; ".join(found.measured.refusals)
    return with_sign(config.changed(optics=found.config.optics))


@dataclass(frozen=True)
class Round:
    """Pictures, and the optics that were learned from them."""

    seen: Collected
    described: bool
    found: OpticsCalibration
    learned: Config | None
    """What may be used."""

    ahead: Config | None
    """What pictures may be found with: what was learned, or is near it; None where particles would
    have the wrong sign."""

    reason: str
    """Why nothing was learned."""

    @property
    def step(self) -> FloatArray:
        """Change of the measured parameters, shape (n,)."""
        return change_of(self.before, self.after, self.found.names)

    @property
    def same_kind(self) -> bool:
        """Whether polarisation, analyser and mask were what they are."""
        return _kind(self.before) == _kind(self.after)

    @property
    def before(self) -> Settings:
        """The optics with which the pictures were found."""
        return settings_of(self.seen.found_with or self.seen.config)

    @property
    def after(self) -> Settings:
        """The optics that were learned, whether or not they may be used."""
        return self.before if self.ahead is None else settings_of(self.ahead)


@dataclass(frozen=True)
class Rounds:
    """One round after the other."""

    all: tuple[Round, ...] = ()

    @property
    def best(self) -> Round | None:
        """The last one whose optics may be used, of pictures that were found with right ones."""
        if self.all and self.all[-1].seen.refusal:
            return None
        return next((one for one in self.all[::-1] if one.learned and one.described), None)

    @property
    def outcome(self) -> OpticsCalibration:
        """What was learned, or else what was found last, with the reasons against it."""
        return (self.best or self.all[-1]).found

    @property
    def _steps(self) -> tuple[Round, ...]:
        """Those that led on."""
        return tuple(one for one in self.all if one.ahead is not None)

    @property
    def share(self) -> float | None:
        """Of an error, what a round leaves; None where the rounds do not tell."""
        if len(self._steps) < 2:
            return None
        then, now = self._steps[-2:]
        if not (then.same_kind and now.same_kind):
            return None
        names = [name for name in now.found.names if name in then.found.names]
        own, old = ([each.found.names.index(name) for name in names] for each in (now, then))
        moved = change_of(then.before, now.before, names)
        changed = now.step[own] - then.step[old]
        weight = np.linalg.pinv(now.found.covariance[np.ix_(own, own)], hermitian=True)
        square = float(moved @ weight @ moved)
        if square == 0:
            return None
        turned = float(moved @ weight @ changed)
        return min(max(1 + turned / square, 0.0), 0.8)

    @property
    def to_come(self) -> FloatArray:
        """Change of the latest parameters that other rounds would make, shape (n,)."""
        # of an error that a round leaves, where one round says nothing of it
        share = 0.5 if self.share is None else self.share
        return self._steps[-1].step * share / (1 - share)

    @property
    def settled(self) -> bool:
        """Whether other rounds would change nothing worth the time."""
        last, rest = self._steps[-1], self.to_come
        weight = np.linalg.pinv(last.found.covariance, hermitian=True)
        # standard errors that are still to come, below which no other round is made
        return last.same_kind and float(rest @ weight @ rest) < 1.0

    @property
    def next(self) -> Config | None:
        """Optics to look with: what was learned, and what is to come where known."""
        last = self.all[-1]
        if self.share is None or last.ahead is None:
            return last.ahead
        values, optics = settings_of(last.ahead), last.ahead.optics
        limits = optics_limits(optics.n_immersion, optics.n_glass)
        # no farther: some directions change back then
        ahead = min(self.share / (1 - self.share), 0.7) * last.step
        for name, change in zip(last.found.names, ahead.tolist(), strict=True):
            ends = limits.get(name, (-np.inf, np.inf))
            values[name] = float(np.clip(values[name] + change, *ends))
        return with_settings(last.ahead, values)

    def error_of(self, taken: Round) -> FloatArray:
        """Give what later rounds changed of a round, and others would, shape (n,)."""
        last, names = self._steps[-1], taken.found.names
        rest = dict(zip(last.found.names, self.to_come.tolist(), strict=True))
        to_come = np.array([rest.get(name, 0.0) for name in names], dtype=float)
        return np.asarray(change_of(taken.after, last.after, names) + to_come)


def _kind(settings: Settings) -> tuple[object, ...]:
    return settings["polarization"], settings["analyzer"], settings["mask_na"] > 0


ROUNDS = 3
"""Of a fit of the field and optics learned from it."""


@dataclass(frozen=True)
class StandingAlone:
    """Particles that stand alone.

    They tell besides whether the optics change over the field or while the movie is recorded.
    """

    seen: Collected
    pool: ThreadPoolExecutor
    view: FieldOfView | None = None
    """Where and when they were seen, if that is asked for."""

    def collect(self, rounds: Rounds) -> Collected | None:
        """Give all pictures, and once more with their places and times where optics change."""
        if not rounds.all:
            return self.seen
        if self.view is None or len(rounds.all) > 1:
            return None
        found, config = rounds.all[0].found.measured, self.seen.config
        settings, mapper = found.settings, self.pool.map
        if not asked_change(found.estimate.images, config, settings, self.view, mapper).matters:
            return None
        return in_uneven_field(self.seen, settings, self.view, mapper)

    def describes(self, seen: Collected) -> bool:
        """Say that no optics took part in finding them."""
        return seen.found_with is None


@dataclass(frozen=True)
class WholeField:
    """All particles of a field, those that are farthest from others, among the rings of all.

    Particles that stand alone are found without any optics.  Where all bound at once and hardly any
    stands alone, the optics are learned roughly from bright places, with what is faint or near
    another not accounted for.  With these optics the field is fitted, and from its particles, now
    all known, the optics are learned again, until they describe pictures that were not fitted.
    Particles that each have a height of their own are learned from in the same way, beginning with
    the field as the configured optics fit it.
    """

    windows: Windows
    config: Config
    pool: ThreadPoolExecutor

    def collect(self, rounds: Rounds) -> Collected | None:
        """Fit the field with what was learned last."""
        free = self.config.heights_free
        if not rounds.all and not free:
            images, others = bright_places(self.windows, self.config, alone_nm=0.0)
            return Collected(self.config, images, others)
        if rounds.all and self._ended(rounds):
            return None
        ahead = rounds.all[-1].ahead if rounds.all else self.config
        if ahead is None:
            raise DataError(rounds.all[-1].reason)
        images, others = seen_in_field(self.windows, ahead, self.pool)
        near = settings_of(ahead) if free and rounds.all else None
        return Collected(self.config, images, others, near, found_with=ahead)

    def describes(self, seen: Collected) -> bool:
        """Tell whether all of the particles are known: bright places alone are seen roughly."""
        return seen.found_with is not None

    def _ended(self, rounds: Rounds) -> bool:
        """Tell whether optics are learned, or another round is hopeless."""
        fitted = [one.found for one in rounds.all if one.described]
        if not fitted:
            return False
        before = misfit_of(fitted[-2]) if len(fitted) > 1 else math.inf
        before = min(before, float(fitted[-1].measured.configured.chi2_reduced.mean()))
        # Reduced χ² above which it must have fallen for another round. Not more than that: with the
        # first optics heights may be those of two fringes, and the field that is fitted with the
        # next ones has a single one.
        hopeless = misfit_of(fitted[-1]) > max(2.0, before)
        return fitted[-1].accepted or hopeless or len(fitted) == ROUNDS


def seen_in_field(
    windows: Windows, config: Config, pool: ThreadPoolExecutor
) -> tuple[Images, Images]:
    """Fit the field, and cut out the particles that are farthest from others."""
    free = config.heights_free
    rows, columns = windows.after_e.shape
    context = make_context(
        config.changed(fit={"mode": "joint" if free else "mass"}), (rows, columns)
    )
    events, _ = fit_field(context, windows, pool=pool)
    # with free heights what wrong optics leave over is beside particles, which would not be alone
    known = [e.fit.theta for e in events if not (free and Status.SIDELOBE in e.flags)]
    return known_places(windows, config, known)
