"""The optics of a movie in which particles move, tested on its tracks and learned from them.

The pictures of `iscat_analysis.tracking.blocks` show what the model leaves over of all frames.  A
good model leaves over noise, and less than a hundredth of the particle where there is little of it;
an NA of 1.40 for 1.42, a focus wrong by 20 nm or 15 nm of coma leave over a tenth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings.tracks import TRACKS_HALF_DESCRIBED, TRACKS_NOT_DESCRIBED
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.cause import PIXEL, Cause, likely_cause
from iscat_analysis.inference.fit import goodness_of_fit
from iscat_analysis.instrument.learning import REJECTED_P, adopted
from iscat_analysis.instrument.loop import Rounds, learn
from iscat_analysis.instrument.particle_image import Collected
from iscat_analysis.optics.parameters import FREE, MOST_IMAGES, Settings, settings_of
from iscat_analysis.records import BoolArray
from iscat_analysis.tracking.blocks import Aligned, Block
from iscat_analysis.trust.systematic import MASS_SHARE, REJECTED_SHARE
from iscat_analysis.units import count

REJECTED_CHI2 = 2.0
"""Times the noise of single frames, what it leaves over too: less is seen in good movies whose
particles meet often."""

ROUNDS = 8
"""Of optics learned from tracks, and tracks followed with them, at most.  What is learned from
tracks that were followed with wrong optics is only near the truth, as `instrument.loop` says."""


@dataclass(frozen=True)
class Misfit:
    """What the model does not explain in all pictures of tracks together."""

    share: float
    clear: bool
    tracks: int

    @property
    def rejected(self) -> bool:
        """Whether the optics are not those of the movie."""
        return self.share > REJECTED_SHARE and self.clear

    @property
    def verdict(self) -> str:
        """Say so in one line."""
        if not self.rejected:
            return "the optics cannot be learned from this movie"
        return (
            f"the configured optics do not describe the particles: of the pictures of "
            f"{count(self.tracks, 'track')} they leave over {self.share:.0%}"
        )


@dataclass(frozen=True)
class TrialTracks:
    """The first frames of a movie, tracked with some optics."""

    config: Config
    context: AnalysisContext
    block: Block

    @cached_property
    def left(self) -> Misfit | None:
        """The misfit of all pictures; None where there is none."""
        return _misfit(self.block, self.context)

    @property
    def described(self) -> bool:
        """Whether the optics describe the tracks."""
        return self.left is not None and not self.left.rejected


class TrackFirstFrames(Protocol):
    """Tracks the first frames of a movie with given optics."""

    def __call__(self, config: Config, *, cautious: bool = False) -> TrialTracks:
        """Track them; `cautious` as in `find_rows_and_background`."""
        ...


def learn_from_tracks(
    config: Config, begin: TrackFirstFrames, *, name: str, pool: ThreadPoolExecutor, run: Run
) -> tuple[TrialTracks, dict[str, Any]]:
    """Track the first frames, test the optics on them, and learn better ones where they fail.

    Through very wrong optics the rings of a particle are taken for other particles, until nothing
    can be linked or learned.  Then only isolated particles are tracked, and the optics learned from
    them.
    """
    optics = config.optics
    suited = optics.convention == "exact" and optics.psf == "model"
    begun, trouble = _first(config, begin) if suited else (begin(config), None)
    left = begun.left
    if trouble is not None and (left is None or not left.rejected):
        raise trouble
    if left is None or not suited:
        return begun, {}
    tested = {"tested": left.tracks, "left_over": left.share}
    if not left.rejected and optics.calibrate != "always":
        return begun, tested | {"calibrated": False}
    cause = _cause(begun) if left.rejected else None
    noisy = begun.block.noise_differs and trouble is None
    if noisy and cause is None and optics.calibrate != "always":
        reason = "the noise is not what the camera's numbers predict, and may be what is left over"
        return begun, tested | {"calibrated": False, "reason": reason}

    def as_configured(message: str, reason: str) -> tuple[TrialTracks, dict[str, Any]]:
        if trouble is not None and cause is None:
            raise trouble
        if trouble is not None:
            raise DataError(f"{message}; nothing can be followed with them: {trouble}") from trouble
        run.report(TRACKS_NOT_DESCRIBED({"why": message}))
        return begun, tested | {"calibrated": False, "reason": reason}

    learns = optics.calibrate == "always" or (optics.calibrate == "auto" and optics.file is None)
    if not learns or (cause is not None and cause.name == PIXEL):
        message = _message(left, cause, learns=learns)
        return as_configured(message, message)
    reason = ""
    run.notify("learning the optics from the tracks of the movie, which may take minutes…")
    start = _start(config, cause)
    # with free heights rings are taken for many particles, each with its own: that takes long
    apart = trouble is not None or config.heights_free
    for cautious in (True,) if apart else (False, True):
        try:
            trial = begin(config, cautious=True) if cautious and trouble is None else begun
            tracks = Tracks(start, trial, begin)
            rounds = learn(tracks, config, tuple(FREE), {"movie": name}, pool.map)
            if rounds.best is not None:
                found = rounds.best.found.less_sure(rounds.error_of(rounds.best))
                learned, told, findings = adopted(
                    found, config, tested, left.verdict, picture_of="track picture"
                )
                run.report(*findings)
                return begin(learned), told
            reasons = [one.reason for one in rounds.all if one.reason]
            why = reasons[-1] if reasons else "what was learned does not describe them either"
            last = tracks.begun
            if trouble is not None and last.left is not None and tracks.described:
                run.report(TRACKS_HALF_DESCRIBED({"verdict": left.verdict, "why": why}))
                told = {"calibrated": True, "reason": why, "left_over_then": last.left.share}
                return last, tested | told
        except (DataError, ConfigError) as error:  # or what was learned asks for too much memory
            why = str(error)
        reason = reason or why
    if left.rejected:
        message = f"{_message(left, cause, learns=True)} (other optics were not learned: {reason})"
    else:
        message = f"{left.verdict}: {reason}; the analysis goes on as configured"
    return as_configured(message, reason)


def _first(config: Config, begin: TrackFirstFrames) -> tuple[TrialTracks, DataError | None]:
    """Track the first frames, cautiously where that fails; the error is returned as well."""
    try:
        return begin(config), None
    except DataError as error:
        try:
            return begin(config, cautious=True), error
        except DataError:
            raise error from None


@dataclass
class Tracks:
    """Particles that move, followed with the optics that were learned last."""

    start: Config
    begun: TrialTracks
    """The tracks that were followed last."""

    begin: TrackFirstFrames
    troubled: bool = False
    """Whether with these optics only what stands alone could be followed."""

    def collect(self, rounds: Rounds) -> Collected | None:
        """Follow the first frames with what was learned, and put frames on top of each other."""
        near: Settings | None = None
        if rounds.all:
            last, number = rounds.all[-1], len(rounds.all)
            # optics that describe the tracks at all are found in 4 rounds, or never
            lost = number == 4 and not last.described and rounds.best is None
            done = last.described and rounds.settled
            ahead = rounds.next if last.described else last.ahead
            if number == ROUNDS or lost or done or ahead is None:
                return None
            self.begun, trouble = _first(ahead, self.begin)
            self.troubled = trouble is not None
            if self.troubled and rounds.best is not None:
                return None
            near = settings_of(self.begun.config) if self.described else None
        aligned, context = self.begun.block.aligned, self.begun.context
        images = [aligned.particle_image(context, n) for n in _brightest(aligned, MOST_IMAGES)]
        return Collected(self.start, images, near=near, found_with=self.begun.config)

    def describes(self, seen: Collected) -> bool:
        """Tell whether little is left over of the pictures of the tracks."""
        return self.described and seen.found_with is self.begun.config

    @property
    def described(self) -> bool:
        """Whether the optics describe the tracks that were followed last."""
        return self.begun.described and not self.troubled


def mass_error(summary: Mapping[str, Any]) -> float:
    """Relative error of masses with optics that do not describe the tracks."""
    if "left_over_then" in summary:
        return MASS_SHARE * float(summary["left_over_then"])
    share = float(summary.get("left_over", 0.0))
    rejected = share > REJECTED_SHARE and "reason" in summary and not summary["calibrated"]
    return MASS_SHARE * share if rejected else 0.0


def _misfit(block: Block, context: AnalysisContext) -> Misfit | None:
    """Sum the misfit over all pictures; None where there are none."""
    aligned = block.aligned
    if not len(aligned.track):
        return None
    tracks = len(np.unique(aligned.track))
    if context.config.fit.heights_free:
        return _misfit_of_single_pictures(aligned, context, tracks)
    rest, signal, variance = (np.zeros(aligned.light_e.shape[1:]) for _ in range(3))
    for number, theta in enumerate(aligned.theta):
        likelihood = aligned.likelihood(context, number)
        noise = np.where(likelihood.used, aligned.light_e[number] + aligned.read_e2[number], 0.0)
        rest += theta[3] * np.nan_to_num(likelihood.residuals(theta)) * np.sqrt(noise)
        signal += theta[3] * noise * likelihood.signal(theta)
        variance += theta[3] ** 2 * noise
    used = variance > 0
    usual = max(1.0, float(block.table["chi2_reduced"].median()))
    square = rest[used] ** 2 / variance[used] / usual
    power = float(np.sum(signal[used] ** 2 / variance[used])) / usual
    share = _share(float(np.sum(square - 1)), power)
    return Misfit(share, float(square.mean()) > REJECTED_CHI2, tracks)


def _misfit_of_single_pictures(
    aligned: Aligned, context: AnalysisContext, tracks: int
) -> Misfit | None:
    """Sum the misfit where each picture is a single frame, as of particles at many heights."""
    excess, power, p_values = 0.0, 0.0, []
    for number, theta in enumerate(aligned.theta):
        likelihood = aligned.likelihood(context, number)
        signal = likelihood.signal(theta)
        chi2, p_value = goodness_of_fit(likelihood, theta, _free(context))
        excess += (chi2 - 1) * likelihood.n_pixels
        power += float(np.sum(signal**2 * likelihood.signal_information(signal)))
        p_values.append(p_value)
    return Misfit(_share(excess, power), float(np.median(p_values)) < REJECTED_P, tracks)


def _share(excess: float, power: float) -> float:
    """Root of the ratio of two powers."""
    return math.sqrt(max(excess, 0.0) / power) if power > 0 else 0.0


def _free(context: AnalysisContext) -> BoolArray:
    """Tell which parameters of a picture are fitted, as `Likelihood` has it."""
    return np.array([True, True, context.config.fit.heights_free, True, False])


def _brightest(aligned: Aligned, most: int) -> list[int]:
    """Numbers of the pictures with the most information, the brightest first."""
    energy = aligned.frames * aligned.theta[:, 3] ** 2 * aligned.light_e.mean(axis=(1, 2))
    order: list[int] = np.argsort(-energy, kind="stable")[:most].tolist()
    return order


def _cause(begun: TrialTracks) -> Cause | None:
    """Name the part of the microscope whose change resembles the misfit most."""
    aligned, context = begun.block.aligned, begun.context
    shown = _brightest(aligned, 24)
    fits = [(aligned.likelihood(context, n), aligned.theta[n], _free(context)) for n in shown]
    return likely_cause(context.config, fits)


def _message(left: Misfit, cause: Cause | None, *, learns: bool) -> str:
    """Say what is wrong, and what to do about it."""
    if cause is None:
        return (
            f"the model does not describe the particles: of the pictures of "
            f"{count(left.tracks, 'track')} it leaves over {left.share:.0%}, and no part of the "
            "microscope explains that: see whether the light under them changes slowly "
            "(track.block_frames), or several things are wrong in the optics"
        )
    text = f"{left.verdict}, and masses are wrong too"
    advice = [] if learns else ['optics.calibrate = "auto" learns them from the movie']
    text += f"; it looks most like {cause.likeness}"
    advice = ["correct that", *(advice if cause.name != PIXEL else [])]
    return f"{text}: {', or '.join(advice)}"


def _start(config: Config, cause: Cause | None) -> Config:
    """Choose where the search starts: it does not find the aperture across the critical angle."""
    if cause is None or cause.name != "numerical aperture" or cause.step is None:
        return config
    most = min(config.optics.n_immersion, config.optics.n_glass)
    na = min(config.optics.na + cause.step, 0.5 * (config.optics.na + most))
    return config.changed(optics={"na": na})
