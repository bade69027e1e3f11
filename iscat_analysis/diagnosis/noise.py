"""The noise before anything is searched: camera, correlation of pixels, window length.

Which number of the camera is wrong, as noise and zero of the light show it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis.camera import (
    TOLERANCE,
    Camera,
    FieldSample,
    GainDiagnosis,
    Law,
    LearnedCamera,
    LightZero,
    NoiseSpectrum,
    diagnose_gain,
    find_zero,
    measure_spectrum,
    shared_light,
    whole_frames,
    with_pattern_jitter,
    without_pattern_jitter,
)
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.movie import Stack
from iscat_analysis.records import BoolArray, CountSource, FloatArray, FrameSource, Windows
from iscat_analysis.search.chunks import NOISE_FRAMES, Reader, reader_of
from iscat_analysis.search.frames import good_frames, measure_frames, well_lit
from iscat_analysis.search.noise import (
    SHORTEST_MOVIE,
    NoiseCurve,
    choose_window,
    longest_window,
    measure_noise,
)
from iscat_analysis.search.templates import ExcessNoise
from iscat_analysis.threads import one_thread_algebra

# Of the noise, and of masses if it is the offset, that is not left unsaid
_LEAST_NOISE_ERROR = 0.03
_MOST_LEFT = 1.1  # of the noise that the light has, with an offset that the noise alone tells
REPORTED_LAWS = ("other light", "read noise")
"""Laws by which noise is not what the camera's numbers predict, as `law_messages` has it."""

_OTHERS = {
    "offset": "an offset that is too high",
    "read noise": "read noise that is missing",
    "noisy light": "light that is noisy by itself",
    "other light": "light that does not follow the laser",
}
_SUBTRACTED_SIGMAS = 4.0  # standard errors below no counts, where no camera has its offset


def zero_by_law(law: Law, level_e: float) -> LightZero | None:
    """Give the zero of the light that follows from the law of the counts."""
    if law.kind == "offset":
        return LightZero(law.value, law.se, law.value * level_e, law.flickers)
    return LightZero(0.0, law.se, 0.0, law.flickers) if law.kind == "linear" else None


def law_messages(known: LearnedCamera) -> tuple[str, ...]:
    """Say that counts are not proportional to light, which law they follow, and what to do."""
    law = known.camera.law
    if law is None:
        return ()
    if law.kind == "read noise" and law.value > TOLERANCE:
        return (
            f"without light the noise is {100 * law.value:.2g} ± {100 * law.se:.1g} % of the "
            "light's variance beyond what camera.read_noise_e says: it lacks "
            f"{math.sqrt(law.value * known.level_e):.3g} e, in squares; record a dark",
        )
    if not (law.bent or (law.kind == "other light" and law.dilutes)):
        return ()
    seen = (
        "the noise and the answer to the laser's power grow" if law.flickers else "the noise grows"
    )
    effect = f"{_effect(1 - law.contrast)} (± {100 * law.contrast_se:.2g} %)"
    flagged = "all rows are flagged nonlinear"
    if law.kind == "other light":
        camera, share = known.config, law.value
        counts = share * known.level_e / float(np.mean(known.camera.gain_e_per_adu))
        advice = ""
        if not isinstance(camera.offset_adu, str) and not isinstance(camera.read_noise_e, str):
            read = math.hypot(camera.read_noise_e, math.sqrt(share * known.level_e))
            advice = (
                f", or set camera.offset_adu = {camera.offset_adu + counts:.5g} and "
                f"camera.read_noise_e = {read:.4g}, which is its shot noise"
            )
        return (
            f"{100 * share:.2g} ± {100 * law.se:.1g} % of the light does not follow the laser's "
            "power but has its shot noise, as light of the room, which interferes with nothing; it "
            f"makes {effect}; {flagged}: put it out{advice}",
        )
    named = {
        "gamma": f"gamma {law.value:.3g} ± {law.se:.1g} (counts as light to this power)",
        "saturation": "soft saturation (the pixels are filled to "
        f"{law.value:.3g} ± {law.se:.1g} of the light at which they saturate)",
    }
    if law.certain:
        more = f" besides an offset of {100 * law.offset:.2g} % of the light" if law.offset else ""
        return (
            f"the counts are not in proportion to the light: {seen} with it as by "
            f"{named[law.kind]}{more}, which makes {effect}; {flagged}: switch it off or lower the "
            "exposure, or correct this movie with camera.response = response.csv, which is written "
            "with the result",
        )
    others = " or ".join(_OTHERS.get(kind, kind) for kind in law.alike)
    return (
        f"the counts are not in proportion to the light: {seen} with it as by {named[law.kind]}, "
        f"and the movie does not tell this from {others}; "
        f"the first makes {effect}; {flagged}: switch gamma off and lower the exposure; "
        "`iscat calibrate camera` with a dark tells them apart",
    )


def offset_is_wrong(zero: LightZero, gain: GainDiagnosis) -> bool:
    """Tell whether the offset is wrong, where an excess of noise could be the cause as well.

    Noise of the light itself, or motion, bends the line of variance against mean, which then has
    another zero.  But then there is more noise than the light has, whatever the offset is.
    """
    if not zero.off or gain.shakes:
        return False
    if zero.flickers:
        return True
    left = gain.noise_ratio / (1 - zero.share)
    return left < _MOST_LEFT and not (zero.share > 0 and gain.noise_ratio > 1)


def _offset_of(camera: Camera) -> str:
    offset = camera.offset_adu
    if np.ndim(offset):
        return f"the map camera.offset_adu, {np.mean(offset):.4g} on average,"
    return f"camera.offset_adu = {offset:.4g}"


def _effect(share: float) -> str:
    """Describe how the mass changes where a part of the counts is no light."""
    percent = float(f"{100 * abs(share):.2g}")  # in full where it is hundreds
    return f"masses {percent:g} % too {'small' if share > 0 else 'large'}"


def offset_message(zero: LightZero, camera: Camera) -> str:
    """Say where the light is zero, and what a wrong offset does to masses."""
    per_count = float(np.mean(camera.gain_e_per_adu))
    counts = zero.electrons / per_count
    se = zero.se * counts / zero.share
    found = float(np.mean(camera.offset_adu)) + counts
    how = "pixels follow the laser's power" if zero.flickers else "the noise grows with the light"
    read = zero.electrons < 0 and not zero.flickers
    message = (
        f"{_offset_of(camera)} is too {'low' if zero.share > 0 else 'high'} by {abs(counts):.4g} ± "
        f"{se:.2g} counts, as {how}, and makes {_effect(zero.share)}: "
    )
    if np.ndim(camera.offset_adu):
        message += "record a dark for `iscat calibrate camera --maps`"
    elif found < -_SUBTRACTED_SIGMAS * se:
        message += "see whether counts were subtracted from the movie; record raw counts"
    else:
        message += f"set camera.offset_adu = {max(found, 0.0):.4g}, or the mean of a dark"
    if read:
        missing = math.sqrt(-zero.electrons)
        message += f" (unless {missing:.3g} e of read noise are missing in camera.read_noise_e)"
    return message


def offset_or_gain_message(gain: GainDiagnosis, zero: LightZero | None, camera: Camera) -> str:
    """Say that either the offset or the gain may be wrong, where the noise fits both.

    An offset that is wrong by a share s of the light leaves 1 − s of the expected noise.
    """
    share = 1 - gain.noise_ratio
    if (
        gain.shakes
        or gain.noise_counts < 1
        or abs(share) < _LEAST_NOISE_ERROR + 3 * gain.noise_ratio_se
    ):
        return ""
    if zero is not None and not zero.may_be(share):
        return ""
    noisy = "by light that is noisy by itself, " if gain.noise_ratio > 1 else ""
    return (
        f"the noise variance is {gain.noise_ratio:.3g} ± {gain.noise_ratio_se:.1g} times what the "
        "camera's numbers predict, and this movie does not tell whether by the gain (then set "
        f"camera.gain_e_per_adu = {gain.gain_e_per_adu:.4g}), {noisy}or by {_offset_of(camera)}, "
        f"which would make {_effect(share)}: record a dark, and measure both with "
        "`iscat calibrate camera`"
    )


def allow_for_correlation(gain: GainDiagnosis, spectrum: NoiseSpectrum | None) -> GainDiagnosis:
    """Correct the gain for noise that neighbouring pixels share.

    Notes
    -----
    Light is Poisson before charge leaks to neighbours; leaking moves variance into covariances
    (M. Downing et al., Proc. SPIE 6276, 627609, 2006).
    """
    if spectrum is None or not spectrum.correlated:
        return gain
    ratio, error = spectrum.summed
    return replace(
        gain,
        noise_ratio=ratio,
        noise_ratio_se=error,
        gain_e_per_adu=gain.configured_gain / ratio,
        gain_se=gain.configured_gain / ratio**2 * error,
    )


SPECTRUM_FRAMES = 128
"""Background frames on which the spectrum of the noise is measured."""

_GAIN_FRAMES = 64  # on which the gain is judged
_FEWEST_FRAMES = 8  # on which it is judged beside particles that move
_LEAST_FREE_SHARE = 0.25  # share of the pixels that no particle may come near in the frames judged
# λ/NA from a particle, from where its light changes the variance by some per cent
_LEAST_DISTANCE = 1.5
_ENOUGH_FITS = 10  # of which the best
_BEST_FITS = 0.1  # leave over the noise and no more; this quantile is theirs
_MOST_NOISE_SHARE = 0.75  # of the noise, which small pictures leave over by chance at least


@dataclass(frozen=True)
class Noise:
    """The noise of frames without particles, compared with the camera's numbers."""

    messages: tuple[str, ...] = ()
    differs: bool = False
    excess: ExcessNoise | None = None
    spectrum: NoiseSpectrum | None = None
    shakes: bool = False

    def messages_of(self, name: str) -> Iterator[str]:
        """List the messages for the user."""
        if self.spectrum is not None and self.spectrum.message:
            yield f"{name}: {self.spectrum.message}"
        yield from self.messages

    def compared_with_fits(self, chi2: FloatArray) -> Noise:
        """Withdraw an excess of noise that the fits of particles do not show.

        Too much noise is in all fits alike.  Where some fits leave less, the excess is the residual
        of a wrong model, or blur of moving particles.

        Shapes: `chi2` (n,).
        """
        known = chi2[np.isfinite(chi2)]
        if self.excess is None or len(known) < _ENOUGH_FITS:
            return self
        least = float(np.quantile(known, _BEST_FITS))
        return Noise() if least < _MOST_NOISE_SHARE * self.excess.ratio else self

    @property
    def summary(self) -> dict[str, Any] | None:
        """What ``summary.json`` says of the spectrum."""
        return None if self.spectrum is None else self.spectrum.summary


def judge_counts(
    counts: NDArray[Any],
    camera: Camera,
    *,
    masked: BoolArray | None = None,
    additive: bool = False,
    follows: bool | None = None,
    whole: tuple[NDArray[Any], Camera] | None = None,
) -> Noise:
    """Compare the noise between neighbouring frames with the camera's.

    Where `counts` are those of a sample of the pixels, frames of the `whole` field tell what its
    pixels have in common.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    seen, theirs = whole or (counts, camera)
    spectrum = measure_spectrum(seen, theirs, masked=masked)
    try:
        gain = diagnose_gain(counts[:_GAIN_FRAMES], camera, masked=masked)
    except DataError:  # too dark to tell
        return Noise(spectrum=spectrum)
    gain = allow_for_correlation(gain, spectrum)
    gain = with_pattern_jitter(gain, counts[:_GAIN_FRAMES], camera, masked=masked)
    if follows and gain.shakes:
        still = without_pattern_jitter(counts, camera, masked=masked)
        return judge_counts(still, camera, masked=masked, additive=additive, whole=whole)
    shared = shared_light(counts, camera, masked=masked)
    if shared is not None:
        return Noise((_filtered(shared),), True)  # the spectrum is that of neighbours as well
    law = camera.law
    if law is not None and (law.bent or law.kind in REPORTED_LAWS):  # already
        excess = ExcessNoise(gain.noise_ratio, "") if gain.off and gain.noise_ratio > 1 else None
        return Noise((), gain.off, excess, spectrum)
    if law is not None:
        zero = zero_by_law(law, float(camera.to_electrons(counts[:1]).mean()))
    else:
        zero = None if additive else find_zero(counts, camera, masked=masked)
    leaks = spectrum is not None and spectrum.correlated
    if zero is not None and leaks and not zero.flickers:
        zero = None  # the variance of a pixel is then of its neighbours' light as well
    wrong = zero if zero is not None and offset_is_wrong(zero, gain) else None
    if wrong is not None:
        message = offset_message(wrong, camera)
    else:
        message = "" if additive else offset_or_gain_message(gain, zero, camera)
        message = message or gain.message or ""
    if gain.shakes and follows is False:
        message += ", or set background.drift_correction = true, with which it is followed"
    excess = ExcessNoise(gain.noise_ratio, message) if gain.off and gain.noise_ratio > 1 else None
    if wrong is None:
        return Noise((message,) if message else (), gain.off, excess, spectrum, gain.shakes)
    messages = [message]
    moved = replace(
        camera, offset_adu=camera.offset_adu + wrong.electrons / camera.gain_e_per_adu, law=None
    )
    with contextlib.suppress(DataError):  # too dark to tell
        rest = diagnose_gain(counts[:_GAIN_FRAMES], moved, masked=masked)
        rest = allow_for_correlation(rest, measure_spectrum(counts, moved, masked=masked))
        messages += [f"with that offset, {rest.message}"] if rest.message else []
    return Noise(tuple(messages), True, excess, spectrum)


def _filtered(shared: float) -> str:
    """Say that successive frames are not independent measurements."""
    return (
        f"frames next to each other differ by {shared:.2g} times the variance of those farther "
        "apart: they were averaged, interpolated or filtered in time, so that their noise does not "
        "tell the gain, landings are blurred and σ may be too small: record or export raw frames"
    )


def judge_background(
    movie: Stack, camera: Camera, windows: Windows, *, still: bool, additive: bool
) -> Noise:
    """Judge the noise of the background, or of the fitted frames where the background is known."""
    frames = windows.n_before or (windows.n_after if still else 0)
    if frames < 2 or not is_lit(windows):
        return Noise()
    counts = first_counts(movie, windows, SPECTRUM_FRAMES)
    light, repeats = measure_frames(counts, camera)
    good = ~repeats if additive else ~repeats & well_lit(light)
    return judge_counts(counts[good], camera, masked=windows.masked, additive=additive)


def judge_beside(
    context: AnalysisContext,
    movie: FrameSource,
    camera: Camera,
    span: tuple[int, int],
    seen: tuple[NDArray[np.int64], FloatArray],
    used: BoolArray,
    without: Callable[[int], FloatArray],
) -> Noise:
    """Judge the camera by frames in which particles move, from pixels that none comes near.

    Particles that move add to the variance between frames.  Where they are near, pixels are left
    out; farther away their rings are taken off as they were fitted, and where a fit went astray
    that adds as well: a number is called wrong only where one seems so with the rings and without.

    Shapes: `seen` (n,), `used` (y, x).
    """
    optics = context.config.optics
    away = _LEAST_DISTANCE * optics.wavelength_nm / optics.na
    y, x = np.indices(used.shape) * context.pixel_nm
    pixels = np.column_stack([x.ravel(), y.ravel()])
    frame, places_nm = seen
    count = min(_GAIN_FRAMES, span[1] - span[0])
    while count >= _FEWEST_FRAMES:
        near = scipy.spatial.cKDTree(places_nm[(frame >= span[0]) & (frame < span[0] + count)])
        free = used & (near.query(pixels)[0] > away).reshape(used.shape)
        if free.any() and free.sum() >= _LEAST_FREE_SHARE * used.sum():
            counts = movie.read(span[0], span[0] + count)
            additive = context.additive
            if judge_counts(counts, camera, masked=~free, additive=additive).messages:
                counts = camera.to_counts(without(count))
                return judge_counts(counts, camera, masked=~free, additive=additive)
            return Noise()
        count //= 2
    return Noise()


@dataclass(frozen=True)
class NoiseSurvey:
    """The noise of the first frames of a landing movie, and a reader of all frames.

    `sample` is what ``summary.json`` says of the pixels that were looked at, None of all.
    """

    reader: Reader
    noise: Noise
    curve: NoiseCurve
    window: int
    sample: dict[str, Any] | None = None


def survey_noise(reader: Reader, config: Config) -> NoiseSurvey:
    """Judge the noise of a landing movie, and choose the window."""
    additive = config.optics.scheme == "darkfield"
    judged, field = reader.sampled, FieldSample.of(reader.shape)
    sample: dict[str, Any] | None = None
    with one_thread_algebra():
        opening, curve, window = judge_window(judged, config)
        whole = None
        if field is not None:
            sample = field.summary(*field.scatter(opening[:_GAIN_FRAMES], judged.camera))
            frames = whole_frames(reader.shape, SPECTRUM_FRAMES)
            counts = reader.read(reader.first, min(reader.first + frames, reader.last))
            whole = counts[good_frames(counts, reader.camera)], reader.camera
        noise = judge_counts(
            opening, judged.camera, additive=additive,
            follows=config.background.follows_pattern, whole=whole,
        )  # fmt: skip
    if noise.excess is None:
        ratio = curve.at(window)
        message = (
            f"averages of {window} frames differ by {ratio:.2g} times the variance of the light: "
            "by drift or the laser (set background.drift_correction = true), or by the rings of "
            "many bright particles; lower background.window_frames, which helps against all"
        )
        noise = replace(noise, excess=ExcessNoise(ratio, message))
    return NoiseSurvey(reader, noise, curve, window, sample)


def survey_over(
    frames: CountSource,
    config: Config,
    camera: Camera,
    span: tuple[int, int],
    opening: NoiseSurvey | None = None,
) -> NoiseSurvey:
    """Judge the noise of a landing movie once, and read all of the movie where a part told it."""
    if opening is None:
        return survey_noise(reader_of(frames, config, camera, span), config)
    if (opening.reader.first, opening.reader.last) == span:
        return opening
    return replace(opening, reader=reader_of(frames, config, camera, span))


def judge_window(reader: Reader, config: Config) -> tuple[NDArray[Any], NoiseCurve, int]:
    """Choose how many frames around a step are summed.

    Shapes: `opening` (t, y, x).
    """
    frames = reader.last - reader.first
    given = config.background.window_frames
    needed = 2 * given if given else SHORTEST_MOVIE
    if frames < needed:
        windows = (
            f"two windows of background.window_frames = {given}" if given else "sliding windows"
        )
        raise DataError(
            f"{reader.name}: has {frames} frames, but {windows} before and after each landing take "
            f"{needed}: record longer"
            + (", or lower background.window_frames" if given else "")
            + "; or give the frames before the particles bind as background.frames = [0, N]"
        )
    opening = reader.opening()
    longest = min(given or longest_window(frames), NOISE_FRAMES // 4)
    follows = config.background.follows_pattern
    curve = measure_noise(opening, reader.camera, longest, follows=follows)
    window = given or choose_window(curve, frames)
    return opening, curve, window


def first_counts(movie: Stack, windows: Windows, most: int) -> NDArray[Any]:
    """Read the first background frames, or those after it where it is known.

    Shapes: result (t, y, x).
    """
    start, stop = windows.frames_before if windows.n_before else windows.frames_after
    return movie.read(start, min(stop, start + most))


def is_lit(windows: Windows) -> bool:
    """Tell whether the background has more light than read noise."""
    used = ~windows.masked
    light, read = windows.before_e[used], windows.read_variance_before_e2[used]
    return bool(light.sum() > read.sum())
