"""The optics of a movie, learned from its brightest particles.

Before a movie is analysed the configured optics are tested on these; where their fits reject them,
the optics are learned, and the analysis goes on with what was learned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

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
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import printing
from iscat_analysis.fitting.ranges import background_mode, frame_ranges, measured_windows
from iscat_analysis.fitting.run import notify_nobody
from iscat_analysis.inference.checks import number_in
from iscat_analysis.instrument.collect import bright_particle_images, kind_of, scan_particle_images
from iscat_analysis.instrument.fit_optics import Collected, none_bright
from iscat_analysis.instrument.loop import accepted, learn
from iscat_analysis.instrument.microscope import (
    REJECTED_P,
    TESTED,
    median_p,
    microscopes,
    not_alone,
    reach_nm,
    refuse_uncalibratable,
)
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.instrument.score_test import ScoreTest, score_test
from iscat_analysis.instrument.sources import StandingAlone, WholeField, seen_in_field
from iscat_analysis.instrument.uneven import (
    EVEN,
    Change,
    FieldOfView,
    asked_change,
    in_uneven_field,
)
from iscat_analysis.movie import Stack
from iscat_analysis.optics.local import terms_of
from iscat_analysis.optics.parameters import (
    FIELD,
    FREE,
    LEAST_IMAGES,
    free_groups,
    heights_free,
    prior_of,
    settings_of,
)
from iscat_analysis.records import FloatArray, Progress, Windows, silent
from iscat_analysis.search.frames import measure_frames, well_lit
from iscat_analysis.threads import threads
from iscat_analysis.units import count

_MANY = 4  # particles alone, with fewer of which a field is looked at as a whole
_MOST_STEP_NM = 5e3  # farther than the model's pictures reach
_LEAST_SCAN_NM = 10.0  # over all frames; a step in µm stays below it
NOISE = "its noise is not what the camera's numbers predict"
"""Why optics are not judged where p-values cannot be."""

_STUCK = 0.02  # share of frames that repeat another, which sums of frames count


def learn_optics(
    movie: Stack,
    config: Config,
    camera: Camera,
    *,
    warn: Callable[[str], None],
    notify: Callable[[str], None] = notify_nobody,
    opening: NoiseSurvey | None = None,
) -> tuple[Config, dict[str, Any]]:
    """Test the configured optics on the brightest particles, and learn them where they fail."""
    optics = config.optics
    reason = why_not(config)
    if reason and optics.calibrate == "always":
        warn(f"the optics are not learned {reason}; the analysis goes on as configured")
    if (
        reason
        or config.fit.mode == "track"  # which learns from its tracks
        or optics.calibrate == "never"
        or (optics.calibrate == "auto" and (optics.file is not None or terms_of(optics)))
    ):
        return config, {}
    tested: Tested | None = None
    with threads(config.compute.workers) as pool:
        try:
            tested = tested_optics(movie, config, camera, pool, opening)
            passed = optics.calibrate == "auto" and not tested.rejected
            if passed and tested.particles and not tested.change.matters:
                return config, tested.summary | {"calibrated": False}
            if optics.calibrate == "auto" and noise_differs(movie, config, camera):
                tested = replace(tested, together=_together((), config, pool))
                reason = f"{NOISE}; the analysis goes on as configured"
                warn(f"the optics cannot be tested on this movie: {reason}")
                return config, tested.summary | {"calibrated": False, "reason": reason}
            if not tested.particles:
                raise DataError(none_bright(movie.name))
            notify("learning the optics from the particles of the movie, which may take minutes…")
            origin = {"movie": movie.name}
            if passed:
                view = FieldOfView.of(movie, config, in_time=background_mode(config) == "sliding")
                moved = in_uneven_field(tested.seen, settings_of(config), view, pool.map)
                if moved is None:  # pictures that were not fitted want no change
                    return config, tested.summary | {"calibrated": False}
                known = StandingAlone(moved, pool)
                found = learn(known, config, tuple(FREE), origin, pool.map).outcome
            else:
                found = learned_from(tested.seen, movie, config, camera, tuple(FREE), origin, pool)
        except DataError as error:
            changing = tested is not None and tested.change.matters
            reason = f"{error}; {tested.change.said}" if tested and changing else str(error)
            warn(f"{_verdict(tested)}: {reason}; the analysis goes on as configured")
            summary = tested.summary if tested else {}
            return config, summary | {"calibrated": False, "reason": reason}
    verdict = tested.change.said if passed else _verdict(tested)
    return adopted(found, config, tested.summary, verdict, warn=warn)


@dataclass(frozen=True)
class Tested:
    """The brightest particles of a movie, and how the configured optics describe them."""

    seen: Collected
    """Those that stand alone, from which optics can be learned at once."""

    particles: int
    median_p: float | None
    change: Change = EVEN
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
        errors = _with_errors(one.names, one.values, one.posterior, one.field_px)
        evidence = {"log_bayes_factor": one.log_bayes_factor, "left_over": one.left_over}
        return test | evidence | errors


def _are_rejected(median: float | None, together: ScoreTest | None) -> bool:
    """Whether images reject the configured optics, one by one or together."""
    poor = median is not None and median < REJECTED_P
    return poor or (together is not None and together.rejected)


def _with_errors(
    names: Sequence[str],
    values: Sequence[float],
    covariance: FloatArray,
    field_px: tuple[float, float, float] | None,
) -> dict[str, Any]:
    """Describe the optics of an analysis, tested or learned, as parameters with errors."""
    return {
        "names": list(names),
        "values": list(values),
        "covariance": covariance.tolist(),
        "field_px": None if field_px is None else list(field_px),
    }


def tested_optics(
    movie: Stack,
    config: Config,
    camera: Camera,
    pool: ThreadPoolExecutor,
    opening: NoiseSurvey | None,
) -> Tested:
    """Collect the brightest particles and test the configured optics on them.

    Where these fail, or the focus moves, more particles are collected, with the rings of others.
    """
    sliding, auto = background_mode(config) == "sliding", config.optics.calibrate == "auto"
    first = sliding and auto
    images, others = bright_particle_images(movie, config, camera, pool, opening, rings=not first)
    alone = len(images)
    if alone < _MANY and background_mode(config) == "fixed":
        windows = _summed(movie, config, camera)
        if drift_warning(movie.name, examine_background(movie, camera, windows)):
            raise DataError("the edges of a fixed pattern that moved look like particles")
        images, others = seen_in_field(windows, config, pool)
    if not images:
        return Tested(Collected(config, ()), 0, None, EVEN, _together((), config, pool))
    median, fitted = median_p(images, config, others, pool.map)
    together = _together(fitted, config, pool)
    if first and _are_rejected(median, together):  # more particles, and whose rings they show
        images, others = bright_particle_images(movie, config, camera, pool, opening)
        alone = len(images)
        median, fitted = median_p(images, config, others, pool.map)
        together = _together(fitted, config, pool)
    change = EVEN
    if not heights_free(config):
        view = FieldOfView.of(movie, config, in_time=sliding)
        change = asked_change(fitted, config, settings_of(config), view, pool.map)
        over_field = [name for name in change.terms if name in FIELD]
        if over_field:
            together = _together(view.placed(fitted), config, pool, over_field)
            together = together and replace(together, field_px=view.centre_px)
    if sliding and change.matters:  # which the first particles of a long movie tell badly
        images, others = bright_particle_images(movie, config, camera, pool, opening, whole=True)
        alone = len(images)
    elif auto and median < REJECTED_P and not heights_free(config) and not change.matters:
        pairs, median = not_alone(images, config, others, pool.map)
        images = [image for k, image in enumerate(images) if k not in pairs]
        alone -= sum(k < alone for k in pairs)
        single = [image for k, image in enumerate(fitted) if k not in pairs]
        together = _together(single, config, pool)
    seen = Collected(config, images[:alone], others)
    return Tested(seen, len(images), median, change, together)


def _together(
    fitted: Sequence[ParticleImage],
    config: Config,
    pool: ThreadPoolExecutor,
    terms: Sequence[str] = (),
) -> ScoreTest | None:
    """Test all images together against the configured optics."""
    if heights_free(config):
        return None
    build = microscopes(config, max(map(reach_nm, fitted), default=0.0))
    return score_test(fitted, build, settings_of(config), prior_of(config), terms, pool.map)


def why_not(config: Config) -> str:
    """Say of what movies, or with what configuration, no optics are learned."""
    optics, mode, way = config.optics, config.fit.mode, background_mode(config)
    tracks = mode == "track"
    reasons = (
        (
            tracks and way != "tracks",
            "in mode track over a background that is not learned with the tracks",
        ),
        (optics.scheme == "darkfield", "from dark field"),
        (config.particle.is_sphere, f'with particle.model = "{config.particle.model}"'),
        (optics.convention != "exact", f'with optics.convention = "{optics.convention}"'),
        (optics.psf != "model", f'with optics.psf = "{optics.psf}"'),
        (config.background.method == "known", 'with background.method = "known"'),
        (
            not tracks and heights_free(config) and way != "fixed",
            f"in mode {mode} without background frames",
        ),
    )
    return next((reason for holds, reason in reasons if holds), "")


def adopted(
    found: OpticsCalibration,
    config: Config,
    tested: Mapping[str, Any],
    verdict: str,
    *,
    picture_of: str = "particle",
    warn: Callable[[str], None],
) -> tuple[Config, dict[str, Any]]:
    """Use what was learned, where it may be used, and say so."""
    learned, why = accepted(found, config)
    if learned is None:
        warn(f"{verdict}: {why}; the analysis goes on as configured")
        return config, {**tested, **_told(found), "calibrated": False, "reason": why}
    if learned.optics.reference_phase_deg != found.config.optics.reference_phase_deg:
        found = found.with_phase(learned.optics.reference_phase_deg, _turned(config))
    headline = found.headline(picture_of)
    warn(f"optics learned from the movie, instead of the configured ones: {headline}")
    for note in found.notes:
        warn(note)
    values = [found.value(name) for name in found.names]
    errors = _with_errors(found.names, values, found.covariance, learned.optics.field_px)
    return learned, {**tested, **_told(found), **errors, "calibrated": True}


def _turned(config: Config) -> str:
    """Say why the phase is not the one that was found, and what that may mean for masses."""
    line = config.calibration
    wanted, found = "brighten", "darken"
    if line is not None and line.gradient_per_kda < 0:
        wanted, found = found, wanted
    return (
        f"the phase is half a turn from the one that was found, with which particles {found} the "
        f"image: by calibration.gradient_per_kda they {wanted} it; if that sign is wrong, so is "
        "that of every mass"
    )


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
    movie, config, camera = ready.steady, ready.config, ready.camera
    with threads(config.compute.workers) as pool:
        progress("particles", 0, 1)
        if focus_step_nm is not None:
            images = scan_particle_images(movie, config, camera)
            seen = Collected(config, images, focus_step_nm=focus_step_nm)
        else:
            images, others = bright_particle_images(movie, config, camera, pool, ready.opening)
            seen = Collected(config, images, others)
        progress("particles", 1, 1)
        origin = {
            "movie": movie.path.name,
            "sha256": movie.sha256(),
            "kind": kind_of(config) if focus_step_nm is None else "scan of the focus",
            "version": version("iscat-analysis"),
        }
        found = learned_from(seen, movie, config, camera, groups, origin, pool)
    return replace(found, config=ready.with_frames_asked(found.config))


def _check_step(step_nm: float, frames: int) -> None:
    """Refuse steps that make no scan: another unit is likely."""
    number_in("`focus_step_nm`", step_nm, least=-_MOST_STEP_NM, most=_MOST_STEP_NM)
    travel = abs(step_nm) * (frames - 1)
    if travel < _LEAST_SCAN_NM:
        raise ConfigError(
            f"`focus_step_nm` = {step_nm:g}: over {count(frames, 'frame')} the focus rises by "
            f"{travel:.3g} nm, which no picture shows; give the step from frame to frame in nm"
        )


def learned_from(
    seen: Collected,
    movie: Stack,
    config: Config,
    camera: Camera,
    groups: Sequence[str],
    origin: Mapping[str, str],
    pool: ThreadPoolExecutor,
) -> OpticsCalibration:
    """Learn the optics from particles that stand alone, or where these do not suffice from all."""
    scan, way = seen.focus_step_nm is not None, background_mode(config)
    crowded = way == "fixed" and not scan
    if not crowded or len(seen.images) >= LEAST_IMAGES:
        asked = not scan and not heights_free(config) and set(groups) == set(FREE)
        view = FieldOfView.of(movie, config, in_time=way == "sliding") if asked else None
        found = learn(StandingAlone(seen, pool, view), config, groups, origin, pool.map).outcome
        if found.accepted or not crowded:
            return found
    field = WholeField(_summed(movie, config, camera), config, pool)
    return learn(field, config, groups, origin, pool.map).outcome


def _summed(movie: Stack, config: Config, camera: Camera) -> Windows:
    """Sum the frames before and after particles bound."""
    return measured_windows(movie, config, camera, *frame_ranges(movie, config))


def noise_differs(movie: Stack, config: Config, camera: Camera) -> bool:
    """Tell whether the first frames repeat each other, or have not the noise of p-values."""
    first, last = config.background.recorded or config.fit.frames or (0, movie.shape[0])
    counts = movie.read(first, min(last, first + SPECTRUM_FRAMES, movie.shape[0]))
    light, repeats = measure_frames(counts, camera)
    stuck = background_mode(config) != "sliding" and repeats.mean() > _STUCK
    follows = config.background.follows_pattern if background_mode(config) == "sliding" else None
    noise = judge_counts(counts[well_lit(light) & ~repeats], camera, follows=follows)
    return bool(stuck or noise.differs)


def _verdict(tested: Tested | None) -> str:
    """Say what the test found where the optics are not learned."""
    if tested is None or not tested.particles:
        return "the optics cannot be tested on this movie"
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
