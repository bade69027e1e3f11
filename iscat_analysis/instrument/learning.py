"""The optics of a movie, learned from its brightest particles.

Before a movie is analysed the configured optics are tested on these; where their fits reject them,
the optics are learned, and the analysis goes on with what was learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, logsumexp

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import (
    LIGHT_STEPS,
    SCAN_STEPS,
    SPECTRUM_FRAMES,
    NoiseSurvey,
    calibrated,
    drift_warning,
    examine_background,
    judge_counts,
)
from iscat_analysis.errors import ConfigError, ContrastError, DataError
from iscat_analysis.findings import Finding, printing
from iscat_analysis.findings import optics as of
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.fitting.run import notify_nobody
from iscat_analysis.inference.checks import number_in
from iscat_analysis.instrument.collect import (
    Recording,
    bright_particle_images,
    scan_particle_images,
)
from iscat_analysis.instrument.joint_fit import Neighbours, PictureScores, excess, maximise
from iscat_analysis.instrument.loop import (
    StandingAlone,
    WholeField,
    accepted,
    fit_optics,
    learn,
    misfit_of,
    none_bright,
    seen_in_field,
)
from iscat_analysis.instrument.measure import TWIN_GAP
from iscat_analysis.instrument.particle_image import (
    TESTED,
    Build,
    Collected,
    Images,
    ParticleImage,
    average_particle_images,
    goodness,
    microscopes,
    reach_nm,
    refuse_uncalibratable,
    rings_of,
    with_heights,
    with_masses,
    with_sign,
)
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.instrument.uneven import (
    NO_CHANGE,
    Change,
    FieldOfView,
    asked_change,
    in_uneven_field,
)
from iscat_analysis.movie import Stack
from iscat_analysis.optics.forward import forward_model, signed_peak
from iscat_analysis.optics.local import terms_of
from iscat_analysis.optics.parameters import (
    FIELD,
    FREE,
    LEAST_IMAGES,
    Prior,
    Settings,
    free_groups,
    free_names,
    prior_of,
    settings_of,
)
from iscat_analysis.records import FloatArray, Mapper, Progress, silent
from iscat_analysis.search.frames import measure_frames, well_lit
from iscat_analysis.threads import threads
from iscat_analysis.trust.systematic import REJECTED_SHARE
from iscat_analysis.units import count

REJECTED_P = 1e-3
"""Half of the brightest particles must fit worse than this before the optics are doubted: a few
that are not alone do not suffice."""


_STARTS_NM = tuple(range(-400, 401, 100))  # along each axis; rings are some 200 nm apart


class _AsConfigured(NamedTuple):
    """The configured microscope, in which the brightest particles are fitted."""

    settings: Settings
    build: Build
    build_wide: Build
    mapper: Mapper

    @classmethod
    def of(cls, config: Config, images: Images, mapper: Mapper) -> _AsConfigured:
        """Build it as far as the pictures need."""
        reach = max(map(reach_nm, images)) + math.sqrt(2) * _STARTS_NM[-1]
        build, wide = microscopes(config, reach), rings_of(config, images[0])
        return cls(settings_of(config), build, wide, mapper)

    def placed(self, images: Images) -> Images:
        """Fit the masses where the particles stand."""
        return with_masses(images, self.build, self.settings)

    def fitted(self, images: Images) -> Images:
        """Fit what is an image's own."""
        return maximise(images, self.build, self.settings, (), mapper=self.mapper).images

    def among(self, others: Images, images: Images) -> Images:
        """Fit pictures among the rings of others."""
        near = Neighbours.fitted(others, self.build, self.build_wide, self.settings, self.mapper)
        return self.fitted(near.around(images, self.mapper))

    def goodness(self, images: Images) -> tuple[FloatArray, FloatArray]:
        """Give the reduced χ² and the p-value of every fitted picture."""
        chi2, p = np.transpose([goodness(image, self.build(self.settings)) for image in images])
        return chi2, p

    def centre(self, image: ParticleImage) -> tuple[float, float]:
        """Find the particle in a picture [nm], whose brightest spot may be of a ring.

        From a place half a ring away a fit ends in another optimum, with the mass of the other
        sign.
        """
        image = image.placed(image.x_nm, image.y_nm)
        moves = product(_STARTS_NM, _STARTS_NM)
        starts = self.placed([image.placed(image.x_nm + x, image.y_nm + y) for x, y in moves])
        likely = [starts[k] for k in np.argsort(self.goodness(starts)[0], kind="stable")[:3]]
        alone = self._replace(mapper=map)
        fits = [alone.fitted([one])[0] for one in likely]
        best = fits[int(np.argmin(self.goodness(fits)[0]))]
        return best.x_nm, best.y_nm


def median_p(
    images: Images, config: Config, others: Images = (), mapper: Mapper = map
) -> tuple[float, Images]:
    """Give the median p-value of the brightest particles in the configured microscope.

    The rings of neighbours, where any are known, are put into the pictures that fail without.
    Particles whose heights are open stand at the height that most of them tell.
    """
    as_configured = _AsConfigured.of(config, images, mapper)
    shown: Images = images[:TESTED]
    x, y = 0.0, 0.0
    if not config.heights_free:
        averages, shown = average_particle_images(shown)
        x, y = as_configured.centre(averages[0])
    shown = as_configured.placed([s.placed(s.x_nm + x, s.y_nm + y) for s in shown])
    if config.particle.height_is_open:
        free = as_configured.fitted(with_heights(shown, config))
        middle = float(np.median([image.z_nm for image in free]))
        shown = [replace(image, z_nm=middle) for image in shown]
    fitted = as_configured.fitted(shown)
    found = float(np.median(as_configured.goodness(fitted)[1]))
    if found >= REJECTED_P or not any(image.neighbours for image in fitted):
        return found, fitted
    elsewhere = [other.placed(other.x_nm + x, other.y_nm + y) for other in others]
    among = as_configured.among(elsewhere, fitted)
    better = float(np.median(as_configured.goodness(among)[1]))
    return (found, fitted) if found >= better else (better, among)


def not_alone(
    images: Images, config: Config, others: Images = (), mapper: Mapper = map
) -> tuple[list[int], float]:
    """Find bright places that the configured microscope describes badly, and others well.

    A microscope that is wrong is so for all particles, and is seen the better the brighter they
    are.  Where some as bright are described, the places that are not show two that landed at once.
    From a place that others drew aside a fit ends in another optimum: each begins anew here.
    """
    as_configured = _AsConfigured.of(config, images, mapper)
    alone = as_configured._replace(mapper=map)

    def fitted(image: ParticleImage) -> ParticleImage:
        return alone.fitted(alone.placed([image.placed(*alone.centre(image))]))[0]

    some: Images = list(mapper(fitted, images[:TESTED]))
    if any(image.neighbours for image in some):
        some = as_configured.among(others, some)
    chi2, p = as_configured.goodness(some)
    mass = np.array([image.mass_kda for image in some])
    poor = p < REJECTED_P
    if not poor.any() or poor.all():
        return [], float(np.median(p))
    expected = float(np.median((chi2 - 1)[poor] / mass[poor] ** 2)) * mass**2
    # in standard errors of χ²
    clear = expected > 10.0 * np.sqrt(2 / math.prod(some[0].grid.shape))
    described = ~poor & clear & (chi2 - 1 < 0.1 * expected)
    # of the pictures, that must be described where others are not
    if described.sum() < max(2, 0.25 * len(some)):
        return [], float(np.median(p))
    return np.flatnonzero(poor).tolist(), float(np.median(p[~poor]))


@dataclass(frozen=True)
class ScoreTest:
    """Change of the optics that the sum of scores asks for, and the evidence for it.

    Each image has a score and an information of the optics, with its own parameters (place, mass,
    level) eliminated.  The prior of the change of the optics is normal with covariance P, the
    square of the usual error of each parameter.  For scores that sum to S with information I, the
    change has the posterior mean CS with C = (P⁻¹ + I)⁻¹, and optics that are off are by the factor

        B = exp(½ SᵀCS) / √det(1 + PI)

    likelier than those that are right (R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90, 773
    (1995)). One parameter may be off, or all: B is the mean over these, of which all are as likely
    before. The remaining doubt about the optics is an error of all masses: the width C of what
    prior and images leave, and the change CS, whose square counts with the probability B/(1 + B)
    that there is one.

    Images that show something else, such as two particles at once, disagree with each other.
    Scores and information are divided by the ratio of the scatter of the scores to that expected
    from the information.

    Shapes: `change` (n,), `covariance` (n, n).
    """

    values: Mapping[str, float]
    """As configured."""

    change: FloatArray
    covariance: FloatArray
    log_bayes_factor: float
    """Of optics that are off, over the configured ones."""

    left_over: float
    """Part of the images that the change explains, over the images (root mean square), with the
    probability of a change as a factor of its square."""

    field_px: tuple[float, float, float] | None = None
    """Centre x, y and half the longer side of the field that its terms refer to."""

    @property
    def rejected(self) -> bool:
        """Whether other optics are clearly likelier, and different enough to change masses."""
        return self.log_bayes_factor > TWIN_GAP and self.left_over > REJECTED_SHARE

    @property
    def posterior(self) -> FloatArray:
        """Covariance of errors that the configured optics may have after the test, (n, n)."""
        off = float(expit(self.log_bayes_factor))
        return np.asarray(self.covariance + off * np.outer(self.change, self.change))


def score_test(
    images: Images,
    build: Build,
    settings: Settings,
    prior: Prior,
    terms: Sequence[str] = (),
    mapper: Mapper = map,
) -> ScoreTest:
    """Test the optics by images that were each fitted with the configured optics.

    `terms` are coefficients of the field that are tested beside the optics.
    """
    names = (*free_names(tuple(FREE), settings, FREE["zernike"]), *terms)
    usual = prior.errors(names)
    size, count = len(names), len(images)
    score, information = np.zeros((count, size)), np.zeros((count, size, size))
    if count:
        scores = PictureScores.of(images, build, settings, names, mapper)
        slopes = scores.slopes(names) * usual[:, None]
        score = np.einsum("nik,nk->ni", slopes, scores.score)
        information = np.einsum("nik,nkl,njl->nij", slopes, scores.information, slopes)
    total, asks = information.sum(axis=0), score.sum(axis=0)
    change = np.linalg.solve(np.eye(size) + total, asks)
    # residual scores, which no common change of the optics explains
    disagreement = excess(total, score - information @ change, np.arange(count))
    widened = max(disagreement, 1.0)
    total, asks = total / widened, asks / widened
    spread = np.linalg.inv(np.eye(size) + total)
    change = spread @ asks
    gains, explains = np.transpose(
        [
            _alternative(total[np.ix_(free, free)], asks[free])
            for free in (*np.arange(size)[:, None], np.arange(size))
        ]
    )
    gain = float(logsumexp(gains)) - math.log(len(gains))
    power = math.fsum(image.snr**2 for image in images)
    explained = float(expit(gain)) * explains[np.argmax(gains)]
    left_over = math.sqrt(explained / power) if power else 0.0
    values = {name: float(settings.get(name, 0.0)) for name in names}
    covariance = spread * np.outer(usual, usual)
    return ScoreTest(values, usual * change, covariance, gain, left_over)


def _alternative(information: FloatArray, asks: FloatArray) -> tuple[float, float]:
    """Give log B of other optics, and what their change explains of the images."""
    posterior = np.eye(asks.size) + information
    change = np.linalg.solve(posterior, asks)
    gain = 0.5 * float(asks @ change) - 0.5 * float(np.linalg.slogdet(posterior)[1])
    return gain, max(float(change @ information @ change), 0.0)


_MOST_STEP_NM = 5e3  # farther than the model's pictures reach


NOISE = "its noise is not what the camera's numbers predict"
"""Why optics are not judged where p-values cannot be."""


_NOT_TESTED = "the optics cannot be tested on this movie"


class Learned(NamedTuple):
    """The optics of an analysis, what the summary says of them, and what was found."""

    config: Config
    summary: dict[str, Any]
    findings: tuple[Finding, ...] = ()


def learn_optics(
    movie: Stack,
    config: Config,
    camera: Camera,
    *,
    notify: Callable[[str], None] = notify_nobody,
    opening: NoiseSurvey | None = None,
) -> Learned:
    """Test the configured optics on the brightest particles, and learn them where they fail."""
    optics = config.optics
    reason = why_not(config)
    if reason and optics.calibrate == "always":
        return Learned(config, {}, (of.OPTICS_NOT_LEARNED({"reason": reason}),))
    if (
        reason
        or config.fit.follows_tracks  # where the optics are learned from the tracks
        or optics.calibrate == "never"
        or (optics.calibrate == "auto" and (optics.file is not None or terms_of(optics)))
    ):
        return Learned(config, {})
    tested: Tested | None = None

    def as_configured(reason: str, verdict: str = "") -> Learned:
        summary = tested.summary if tested else {}
        return _as_configured(config, summary, verdict or _verdict(tested), reason)

    with threads(config.compute.workers) as pool:
        recording = Recording(movie, config, camera, pool, opening)
        try:
            tested = tested_optics(recording)
            passed = optics.calibrate == "auto" and not tested.rejected
            if passed and tested.particles and not tested.change.matters:
                return Learned(config, tested.summary | {"calibrated": False})
            if optics.calibrate == "auto" and noise_differs(recording):
                tested = replace(tested, together=_together((), config, pool))
                return as_configured(NOISE, _NOT_TESTED)
            if not tested.particles:
                raise DataError(none_bright(movie.name))
            notify("learning the optics from the particles of the movie, which may take minutes…")
            origin = {"movie": movie.name}
            if passed:
                view = FieldOfView.of(movie, config)
                moved = in_uneven_field(tested.seen, settings_of(config), view, pool.map)
                if moved is None:  # pictures that were not fitted want no change
                    return Learned(config, tested.summary | {"calibrated": False})
                known = StandingAlone(moved, pool)
                found = learn(known, config, tuple(FREE), origin, pool.map).outcome
            else:
                found = learned_from(tested.seen, recording, tuple(FREE), origin)
        except DataError as error:
            changing = tested is not None and tested.change.matters
            why = f"{error}; {tested.change.said}" if tested and changing else str(error)
            return as_configured(why)
    verdict = tested.change.said if passed else _verdict(tested)
    return adopted(found, config, tested.summary, verdict)


@dataclass(frozen=True)
class Tested:
    """The brightest particles of a movie, and how the configured optics describe them."""

    seen: Collected
    """Those that stand alone, from which optics can be learned at once."""

    particles: int
    median_p: float | None
    change: Change = NO_CHANGE
    """Over the field or in time, that they ask for."""

    together: ScoreTest | None = None
    """Test of all together; None where each has a height of its own, which focus imitates."""

    @property
    def rejected(self) -> bool:
        """Whether the configured optics fail to describe them, one by one or together."""
        return _are_rejected(self.median_p, self.together)

    @property
    def summary(self) -> dict[str, Any]:
        """Describe the test in the summary."""
        test: dict[str, Any] = {"tested": self.particles, "median_p": self.median_p}
        if (one := self.together) is None:
            return test
        errors = _with_errors(one.values, one.posterior, one.field_px)
        evidence = {"log_bayes_factor": one.log_bayes_factor, "left_over": one.left_over}
        return test | evidence | errors


def _are_rejected(median: float | None, together: ScoreTest | None) -> bool:
    """Whether images reject the configured optics, one by one or together."""
    poor = median is not None and median < REJECTED_P
    return poor or (together is not None and together.rejected)


def _with_errors(
    values: Mapping[str, float], covariance: FloatArray, field_px: Sequence[float] | None
) -> dict[str, Any]:
    """Describe the optics of an analysis, tested or learned, as parameters with errors."""
    field, errors = None if field_px is None else list(field_px), covariance.tolist()
    names, numbers = list(values), list(values.values())
    return {"names": names, "values": numbers, "covariance": errors, "field_px": field}


def tested_optics(recording: Recording) -> Tested:
    """Collect the brightest particles and test the configured optics on them.

    Where these fail, or the focus moves, more particles are collected, with the rings of others.
    """
    config, pool, way = recording.config, recording.pool, background_mode(recording.config)
    sliding, auto = way == "sliding", config.optics.calibrate == "auto"
    for rings in (False, True) if sliding and auto else (True,):
        images, others = bright_particle_images(recording, rings=rings)
        alone = len(images)
        if alone < 4 and way == "fixed":  # then the field is looked at as a whole
            windows, movie = recording.summed(), recording.movie
            if drift_warning(movie.name, examine_background(movie, recording.camera, windows)):
                raise DataError("the edges of a fixed pattern that moved look like particles")
            images, others = seen_in_field(windows, config, pool)
        if not images:
            return Tested(Collected(config, ()), 0, None, NO_CHANGE, _together((), config, pool))
        median, fitted = median_p(images, config, others, pool.map)
        together = _together(fitted, config, pool)
        if not _are_rejected(median, together):  # else more particles, and whose rings they show
            break
    change = NO_CHANGE
    if not config.heights_free:
        view = FieldOfView.of(recording.movie, config)
        change = asked_change(fitted, config, settings_of(config), view, pool.map)
        over_field = [name for name in change.terms if name in FIELD]
        if over_field:
            together = _together(view.placed(fitted), config, pool, over_field)
            together = together and replace(together, field_px=view.centre_px)
    if sliding and change.matters:  # which the first particles of a long movie tell badly
        images, others = bright_particle_images(recording, whole=True)
        alone = len(images)
    elif auto and median < REJECTED_P and not config.heights_free and not change.matters:
        pairs, median = not_alone(images, config, others, pool.map)
        images = [image for k, image in enumerate(images) if k not in pairs]
        alone -= sum(k < alone for k in pairs)
        single = [image for k, image in enumerate(fitted) if k not in pairs]
        together = _together(single, config, pool)
    seen = Collected(config, images[:alone], others)
    return Tested(seen, len(images), median, change, together)


def _together(
    fitted: Images, config: Config, pool: ThreadPoolExecutor, terms: Sequence[str] = ()
) -> ScoreTest | None:
    """Test all images together against the configured optics."""
    if config.heights_free:
        return None
    build = microscopes(config, max(map(reach_nm, fitted), default=0.0))
    return score_test(fitted, build, settings_of(config), prior_of(config), terms, pool.map)


def why_not(config: Config) -> str:
    """Say of what movies, or with what configuration, no optics are learned."""
    optics, way, tracks = config.optics, background_mode(config), config.fit.follows_tracks
    reasons = {
        "in mode track over a background that is not learned with the tracks": (
            tracks and way != "tracks"
        ),
        "from dark field": not optics.interferes,
        f'with particle.model = "{config.particle.model}"': config.particle.is_sphere,
        f'with optics.convention = "{optics.convention}"': optics.convention != "exact",
        f'with optics.psf = "{optics.psf}"': optics.psf != "model",
        'with background.method = "known"': config.background.is_known,
        f"in mode {config.fit.mode} without background frames": (
            not tracks and config.heights_free and way != "fixed"
        ),
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def _as_configured(
    config: Config, summary: Mapping[str, Any], verdict: str, reason: str
) -> Learned:
    """Go on with the configured optics, and say why."""
    finding = of.OPTICS_AS_CONFIGURED({"verdict": verdict, "reason": reason})
    return Learned(config, {**summary, "calibrated": False, "reason": reason}, (finding,))


def adopted(
    found: OpticsCalibration,
    config: Config,
    tested: Mapping[str, Any],
    verdict: str,
    *,
    picture_of: str = "particle",
) -> Learned:
    """Use what was learned, where it may be used, and say so."""
    learned, why = accepted(found, config)
    if learned is None:
        return _as_configured(config, {**tested, **_told(found)}, verdict, why)
    if learned.optics.reference_phase_deg != found.config.optics.reference_phase_deg:
        line = config.calibration
        expected, other = "brighten", "darken"
        if line is not None and line.gradient_per_kda < 0:
            expected, other = other, expected
        turned = of.TURNED_PHASE({"expected": expected, "found": other})
        found = found.with_phase(learned.optics.reference_phase_deg, turned)
    said = of.OPTICS_LEARNED({"headline": found.headline(picture_of)})
    values = {name: found.value(name) for name in found.names}
    errors = _with_errors(values, found.covariance, learned.optics.field_px)
    summary = {**tested, **_told(found), **errors, "calibrated": True}
    return Learned(learned, summary, (said, *found.notes))


def calibrate_movie(
    movie: Stack,
    config: Config,
    *,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> OpticsCalibration:
    """Measure the optics of an open movie."""
    groups = free_groups(free)
    if focus_step_nm is not None:
        _check_step(focus_step_nm, movie.channel(config.camera.channels).shape[0])
    refuse_uncalibratable(config)
    steps = LIGHT_STEPS if focus_step_nm is None else SCAN_STEPS
    ready = calibrated(movie, config, steps, report=printing(notify))
    config = ready.config
    with threads(config.compute.workers) as pool:
        recording = Recording(ready.steady, config, ready.camera, pool, ready.opening)
        progress("particles", 0, 1)
        if focus_step_nm is not None:
            images = scan_particle_images(recording)
            seen = Collected(config, images, focus_step_nm=focus_step_nm)
            origin = recording.origin("scan of the focus")
        else:
            seen = Collected(config, *bright_particle_images(recording))
            origin = recording.origin()
        progress("particles", 1, 1)
        found = learned_from(seen, recording, groups, origin)
    return replace(found, config=ready.with_frames_asked(found.config))


def _check_step(step_nm: float, frames: int) -> None:
    """Refuse steps that make no scan: another unit is likely."""
    number_in("`focus_step_nm`", step_nm, least=-_MOST_STEP_NM, most=_MOST_STEP_NM)
    travel = abs(step_nm) * (frames - 1)
    if travel < 10.0:  # over all frames; a step in µm stays below it
        raise ConfigError(
            f"`focus_step_nm` = {step_nm:g}: over {count(frames, 'frame')} the focus rises by "
            f"{travel:.3g} nm, which no picture shows; give the step from frame to frame in nm"
        )


def learned_from(
    seen: Collected, recording: Recording, groups: Sequence[str], origin: Mapping[str, str]
) -> OpticsCalibration:
    """Learn the optics from particles that stand alone, or where these do not suffice from all."""
    config, pool, scan = recording.config, recording.pool, seen.focus_step_nm is not None
    crowded = background_mode(config) == "fixed" and not scan
    if not crowded or len(seen.images) >= LEAST_IMAGES:
        asked = not scan and not config.heights_free and set(groups) == set(FREE)
        view = FieldOfView.of(recording.movie, config) if asked else None
        found = learn(StandingAlone(seen, pool, view), config, groups, origin, pool.map).outcome
        if found.accepted or not crowded:
            return found
    field = WholeField(recording.summed(), config, pool)
    return learn(field, config, groups, origin, pool.map).outcome


def noise_differs(recording: Recording) -> bool:
    """Tell whether the first frames repeat each other, or have not the noise of p-values."""
    movie, config, camera = recording.movie, recording.config, recording.camera
    first, last = config.background.recorded or config.fit.frames or (0, movie.shape[0])
    counts = movie.read(first, min(last, first + SPECTRUM_FRAMES, movie.shape[0]))
    light, repeats = measure_frames(counts, camera)
    slides = background_mode(config) == "sliding"
    follows = config.background.follows_pattern if slides else None
    noise = judge_counts(counts[well_lit(light) & ~repeats], camera, follows=follows)
    # sums of frames count a frame that repeats another
    return bool((not slides and repeats.mean() > 0.02) or noise.differs)


def _verdict(tested: Tested | None) -> str:
    """Say what the test found where the optics are not learned."""
    if tested is None or not tested.particles:
        return _NOT_TESTED
    if not tested.rejected:
        return "the optics cannot be learned from this movie"
    why = f"median p-value {tested.median_p:.1g}"
    if not _are_rejected(tested.median_p, None) and tested.together is not None:
        why = f"log Bayes factor {tested.together.log_bayes_factor:.3g} for other optics"
    brightest = count(min(tested.particles, TESTED), "particle")
    return (
        f"the configured optics do not describe the brightest {brightest} ({why}), and they cannot "
        "be learned from them"
    )


def _told(found: OpticsCalibration) -> dict[str, Any]:
    """Give what the summary says of a calibration."""
    told = found.to_dict()
    return {key: told[key] for key in ("accepted", "refusals", "parameters", "twin", "notes")}


@dataclass(frozen=True)
class WrongSign:
    """A configured focus that gives the contrast the other sign.

    The line of a calibration has a sign, and so has the contrast of a particle at a focus.  Between
    the foci of either sign lie those with next to no contrast.  At a focus of the other sign no
    mass belongs to a contrast, and nothing can be fitted: the movie must say where the focus is.
    """

    config: Config
    finding: Finding
    starts: tuple[Config, ...]

    def error(self, why: str) -> ConfigError:
        """Say that nothing can be fitted, and why the movie does not help."""
        return ConfigError(
            f"{self.finding.text}; {why}: correct optics.focus_nm, or "
            "calibration.gradient_per_kda if that has the wrong sign"
        )


def wrong_sign(config: Config) -> WrongSign | None:
    """Tell whether the configured optics give contrast the sign that the calibration has."""
    if config.calibration is None or config.optics.psf != "model":
        return None
    with suppress(ContrastError):
        forward_model(config, 1000.0)
        return None
    line = config.calibration.gradient_per_kda
    foci = sorted({*np.arange(-800.0, 801.0, 50.0).tolist(), config.optics.focus_nm})
    contrast = {
        focus: signed_peak(
            forward_model(config.changed(optics={"focus_nm": focus}, calibration=None), 1000.0)
        )
        for focus in foci
    }
    here = contrast[config.optics.focus_nm]
    most = max(foci, key=lambda focus: abs(contrast[focus]))
    share = abs(here / contrast[most])
    they = "are"
    # contrast over the largest of any focus, below which the focus is one between both signs
    if share < 0.3:
        they = f"have next to no contrast ({share:.0%} of that at {most:g}), and what they have is"
    shown, expected = ("bright", "dark") if here > 0 else ("dark", "bright")
    values = {"focus_nm": config.optics.focus_nm, "gradient_per_kda": line}
    said = {"shown": f"{they} {shown}", "expected": expected}
    finding = of.WRONG_SIGN({**values, **said})
    # of the largest contrast, which a focus to begin with has
    fair = [f for f in foci if contrast[f] * line > 0 and abs(contrast[f] / contrast[most]) > 0.2]
    starts = [focus for focus in fair if focus % 100.0 == 0]  # foci to begin with
    begun = tuple(config.changed(optics={"focus_nm": focus}) for focus in starts)
    return WrongSign(config, finding, begun)


def learn_sign(
    movie: Stack,
    wrong: WrongSign,
    camera: Camera,
    *,
    notify: Callable[[str], None] = notify_nobody,
    opening: NoiseSurvey | None = None,
) -> Learned:
    """Learn the optics of a movie whose configured focus has the wrong sign, or its focus alone."""
    config, optics = wrong.config, wrong.config.optics
    if reason := why_not(config):
        raise wrong.error(f"the optics are not learned {reason}")
    if config.fit.follows_tracks:
        raise wrong.error(
            "no track can be followed with it, from which the optics would be learned"
        )
    by = "file" if optics.calibrate == "auto" and optics.file is not None else "calibrate"
    if by == "file" or optics.calibrate == "never":
        value = getattr(optics, by)
        raise wrong.error(f'by optics.{by} = "{value}" the optics are not learned from the movie')
    notify("learning the optics from the particles of the movie, which may take minutes…")
    with threads(config.compute.workers) as pool:
        recording = Recording(movie, config, camera, pool, opening)
        try:
            if noise_differs(recording):
                raise DataError("the movie does not tell another: " + NOISE)
            if config.heights_free:
                seen = _begun(recording, wrong.starts)
            else:
                seen = Collected(config, *bright_particle_images(recording))
            if not seen.images:
                raise DataError(none_bright(movie.name))
            median, _ = median_p(seen.images, config, seen.others, pool.map)
            if median >= REJECTED_P:
                raise DataError("with it the optics describe the particles of the movie")
            found = _found(recording, seen)
        except DataError as error:
            raise wrong.error(str(error)) from error
    tested = {"tested": len(seen.images), "median_p": median}
    learned = adopted(found, config, tested, wrong.finding.text)
    return learned._replace(findings=(wrong.finding, *learned.findings))


def _begun(recording: Recording, starts: Sequence[Config]) -> Collected:
    """Fit the field with each focus of the right sign, and take what describes most particles."""
    windows, best = recording.summed(), (math.inf, Collected(recording.config, ()))
    for start in starts:
        images, others = seen_in_field(windows, start, recording.pool)
        if images:
            settings = settings_of(start)
            model = microscopes(start, max(map(reach_nm, images)))(settings)
            chi2 = float(np.median([goodness(image, model)[0] for image in images]))
            seen = Collected(recording.config, images, others, settings)
            best = min(best, (chi2, seen), key=lambda each: each[0])
    return best[1]


def _found(recording: Recording, seen: Collected) -> OpticsCalibration:
    """Measure the focus alone, or where that does not describe the particles all of the optics."""
    config, mapper = recording.config, recording.pool.map
    origin = {"movie": recording.movie.name}
    found = fit_optics(seen, ("focus",), origin, mapper)
    focus = found.value("focus_nm")
    if found.accepted:
        learned, _ = with_sign(found.config)
        phase = config.optics.reference_phase_deg
        if learned is None or learned.optics.reference_phase_deg != phase:
            raise DataError(f"by the movie the focus is {focus:.0f} nm, which has that sign too")
        return found
    free = config.heights_free
    if free:
        near = replace(seen, near=found.measured.settings)
        every = fit_optics(near, tuple(FREE), origin, mapper)
    else:
        every = learned_from(seen, recording, tuple(FREE), origin)
    if accepted(every, config)[0] is not None:
        return every
    more = "" if free else ", as where more than the focus is wrong"
    raise DataError(
        f"of the foci tried {focus:.0f} nm describes the brightest particles best, but not well "
        f"(reduced chi2 {misfit_of(found):.3g}){more}"
    )
