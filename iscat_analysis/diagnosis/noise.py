"""The noise before anything is searched: camera, correlation of pixels, window length.

Which number of the camera is wrong, as noise and zero of the light show it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis import camera as cameras
from iscat_analysis.camera import Camera, GainDiagnosis, LightZero, NoiseSpectrum, measure_spectrum
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding, existing
from iscat_analysis.findings import camera as of
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

REPORTED_LAWS = ("other light", "read noise")
"""Laws by which noise is not what the camera's numbers predict, as `law_finding` has it."""

_OTHERS = {
    "offset": "an offset that is too high",
    "read noise": "read noise that is missing",
    "noisy light": "light that is noisy by itself",
    "other light": "light that does not follow the laser",
}


def zero_by_law(law: cameras.Law, level_e: float) -> LightZero | None:
    """Give the zero of the light that follows from the law of the counts."""
    if law.kind == "offset":
        return LightZero(law.value, law.se, law.value * level_e, law.flickers)
    return LightZero(0.0, law.se, 0.0, law.flickers) if law.kind == "linear" else None


def law_finding(known: cameras.LearnedCamera, name: str) -> Finding | None:
    """Find counts that are not proportional to light, and which law they follow."""
    law = known.camera.law
    if law is None:
        return None
    share = {"percent": 100 * law.value, "percent_se": 100 * law.se}
    if law.kind == "read noise" and law.value > cameras.TOLERANCE:
        lacking = math.sqrt(law.value * known.level_e)
        return of.READ_NOISE_LACKING({**share, "lacking_e": lacking}, where=name)
    if not (law.bent or (law.kind == "other light" and law.dilutes)):
        return None
    effect = f"{_effect(1 - law.contrast)} (± {100 * law.contrast_se:.2g} %)"
    if law.kind == "other light":
        camera, light_e = known.config, law.value * known.level_e
        counts = light_e / float(np.mean(known.camera.gain_e_per_adu))
        advice = ""
        if not isinstance(camera.offset_adu, str) and not isinstance(camera.read_noise_e, str):
            read = math.hypot(camera.read_noise_e, math.sqrt(light_e))
            advice = (
                f", or set camera.offset_adu = {camera.offset_adu + counts:.5g} and "
                f"camera.read_noise_e = {read:.4g}, which is its shot noise"
            )
        return of.ROOM_LIGHT({**share, "effect": effect, "advice": advice}, where=name)
    both = "the noise and the answer to the laser's power grow"
    grows = both if law.flickers else "the noise grows"
    words = {
        "gamma": f"gamma {law.value:.3g} ± {law.se:.1g} (counts as light to this power)",
        "saturation": "soft saturation (the pixels are filled to "
        f"{law.value:.3g} ± {law.se:.1g} of the light at which they saturate)",
    }[law.kind]
    if law.certain:
        more = f" besides an offset of {100 * law.offset:.2g} % of the light" if law.offset else ""
        values = {"grows": grows, "law": f"{words}{more}", "effect": effect}
        return of.COUNTS_BENT(values, where=name)
    others = " or ".join(_OTHERS.get(kind, kind) for kind in law.alike)
    values = {"grows": grows, "law": words, "others": others, "effect": effect}
    return of.COUNTS_BENT_OR(values, where=name)


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
    # of the noise that the light has, with that offset
    return left < 1.1 and not (zero.share > 0 and gain.noise_ratio > 1)


def _offset_of(camera: Camera) -> str:
    offset = camera.offset_adu
    if np.ndim(offset):
        return f"the map camera.offset_adu, {np.mean(offset):.4g} on average,"
    return f"camera.offset_adu = {offset:.4g}"


def _effect(share: float) -> str:
    """Describe how the mass changes where a part of the counts is no light."""
    percent = float(f"{100 * abs(share):.2g}")  # in full where it is hundreds
    return f"masses {percent:g} % too {'small' if share > 0 else 'large'}"


def offset_finding(zero: LightZero, camera: Camera) -> Finding:
    """Tell where the light is zero, and what a wrong offset does to masses."""
    gain, offset = (float(np.mean(v)) for v in (camera.gain_e_per_adu, camera.offset_adu))
    counts = zero.electrons / gain
    se, found = zero.se * counts / zero.share, offset + counts
    if np.ndim(camera.offset_adu):
        advice = "record a dark for `iscat calibrate camera --maps`"
    elif found < -cameras.SIGMAS * se:  # no camera has its offset below no counts
        advice = "see whether counts were subtracted from the movie; record raw counts"
    else:
        advice = f"set camera.offset_adu = {max(found, 0.0):.4g}, or the mean of a dark"
    if zero.electrons < 0 and not zero.flickers:
        missing = math.sqrt(-zero.electrons)
        advice += f" (unless {missing:.3g} e of read noise are missing in camera.read_noise_e)"
    how = "pixels follow the laser's power" if zero.flickers else "the noise grows with the light"
    numbers = {"counts": abs(counts), "counts_se": se}
    way = "low" if zero.share > 0 else "high"
    words = {"offset": _offset_of(camera), "way": way, "how": how, "advice": advice}
    words["effect"] = _effect(zero.share)
    return of.OFFSET_WRONG({**numbers, **words})


def offset_or_gain_finding(
    gain: GainDiagnosis, zero: LightZero | None, camera: Camera
) -> Finding | None:
    """Find that either the offset or the gain may be wrong, where the noise fits both.

    An offset that is wrong by a share s of the light leaves 1 − s of the expected noise.
    """
    share = 1 - gain.noise_ratio
    if (
        gain.shakes
        or gain.noise_counts < 1
        or abs(share) < 0.03 + 3 * gain.noise_ratio_se  # of masses, which is not worth a line
        or (zero is not None and not zero.may_be(share))
    ):
        return None
    noisy = "by light that is noisy by itself, " if gain.noise_ratio > 1 else ""
    words = {"offset": _offset_of(camera), "effect": _effect(share), "noisy": noisy}
    ratio, measured = gain.noise_ratio, gain.gain_e_per_adu
    numbers = {"ratio": ratio, "ratio_se": gain.noise_ratio_se, "measured": measured}
    return of.OFFSET_OR_GAIN({**numbers, **words})


def _judge_gain(
    counts: NDArray[Any], camera: Camera, masked: BoolArray | None, spectrum: NoiseSpectrum | None
) -> GainDiagnosis:
    """Measure the gain, allowing for noise that neighbouring pixels share.

    Notes
    -----
    Light is Poisson before charge leaks to neighbours; leaking moves variance into covariances
    (M. Downing et al., Proc. SPIE 6276, 627609, 2006).

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    gain = cameras.diagnose_gain(counts[:_GAIN_FRAMES], camera, masked=masked)
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


@dataclass(frozen=True)
class Noise:
    """The noise of frames without particles, compared with the camera's numbers."""

    findings: tuple[Finding, ...] = ()
    differs: bool = False
    excess: ExcessNoise | None = None
    spectrum: NoiseSpectrum | None = None
    shakes: bool = False

    def findings_of(self, name: str) -> list[Finding]:
        """List what the user should know, that of the spectrum first."""
        found = None if self.spectrum is None else self.spectrum.finding
        spectral = [] if found is None else [replace(found, where=name)]
        return [*spectral, *self.findings]

    def compared_with_fits(self, chi2: FloatArray) -> Noise:
        """Withdraw an excess of noise that the fits of particles do not show.

        Too much noise is in all fits alike.  Where some fits leave less, the excess is the residual
        of a wrong model, or blur of moving particles.

        Shapes: `chi2` (n,).
        """
        known = chi2[np.isfinite(chi2)]
        if self.excess is None or len(known) < 10:  # fits that tell
            return self
        least = float(np.quantile(known, 0.1))  # leave over the noise and no more
        # small pictures leave over as much by chance
        return Noise() if least < 0.75 * self.excess.ratio else self

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
        gain = _judge_gain(counts, camera, masked, spectrum)
    except DataError:  # too dark to tell
        return Noise(spectrum=spectrum)
    if follows and gain.shakes:
        still = cameras.without_pattern_jitter(counts, camera, masked=masked)
        return judge_counts(still, camera, masked=masked, additive=additive, whole=whole)
    shared = cameras.shared_light(counts, camera, masked=masked)
    if shared is not None:  # the spectrum is that of neighbours as well
        return Noise((of.FRAMES_FILTERED({"shared": shared}),), True)
    noisy = gain.off and gain.noise_ratio > 1
    law = camera.law
    if law is not None and (law.bent or law.kind in REPORTED_LAWS):  # already
        return Noise((), gain.off, ExcessNoise(gain.noise_ratio, "") if noisy else None, spectrum)
    zero: LightZero | None = None
    if law is not None:
        zero = zero_by_law(law, float(camera.to_electrons(counts[:1]).mean()))
    elif not additive:
        zero = cameras.find_zero(counts, camera, masked=masked)
    leaks = spectrum is not None and spectrum.correlated
    if zero is not None and leaks and not zero.flickers:
        zero = None  # the variance of a pixel is then of its neighbours' light as well
    wrong = zero if zero is not None and offset_is_wrong(zero, gain) else None
    if wrong is not None:
        finding: Finding | None = offset_finding(wrong, camera)
    else:
        finding = None if additive else offset_or_gain_finding(gain, zero, camera)
        finding = finding or gain.finding
    if finding is not None and gain.shakes and follows is False:
        follow = ", or set background.drift_correction = true, with which it is followed"
        finding = replace(finding, values={**finding.values, "follow": follow})
    message = "" if finding is None else finding.text
    excess = ExcessNoise(gain.noise_ratio, message) if noisy else None
    if wrong is None:
        return Noise(tuple(existing([finding])), gain.off, excess, spectrum, gain.shakes)
    further: Finding | None = None
    offset = camera.offset_adu + wrong.electrons / camera.gain_e_per_adu
    moved = replace(camera, offset_adu=offset, law=None)
    with contextlib.suppress(DataError):  # too dark to tell
        spectrum_there = measure_spectrum(counts, moved, masked=masked)
        rest = _judge_gain(counts, moved, masked, spectrum_there).finding
        further = rest and of.GAIN_BESIDE_OFFSET({"text": rest.text})
    return Noise(tuple(existing([finding, further])), True, excess, spectrum)


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
    # nearer, light changes the variance by some per cent
    away = 1.5 * optics.wavelength_nm / optics.na
    y, x = np.indices(used.shape) * context.pixel_nm
    pixels = np.column_stack([x.ravel(), y.ravel()])
    frame, places_nm = seen
    count = min(_GAIN_FRAMES, span[1] - span[0])
    while count >= 8:  # frames that tell
        near = scipy.spatial.cKDTree(places_nm[(frame >= span[0]) & (frame < span[0] + count)])
        free = used & (near.query(pixels)[0] > away).reshape(used.shape)
        if free.any() and free.sum() >= 0.25 * used.sum():  # of the pixels, without particles
            counts = movie.read(span[0], span[0] + count)
            additive = context.additive
            if not judge_counts(counts, camera, masked=~free, additive=additive).findings:
                return Noise()
            counts = camera.to_counts(without(count))
            return judge_counts(counts, camera, masked=~free, additive=additive)
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
    additive = not config.optics.interferes
    judged, field = reader.sampled, cameras.FieldSample.of(reader.shape)
    sample: dict[str, Any] | None = None
    with one_thread_algebra():
        opening, curve, window = judge_window(judged, config)
        whole = None
        if field is not None:
            sample = field.summary(opening[:_GAIN_FRAMES], judged.camera)
            frames = cameras.whole_frames(reader.shape, SPECTRUM_FRAMES)
            counts = reader.read(reader.first, min(reader.first + frames, reader.last))
            whole = counts[good_frames(counts, reader.camera)], reader.camera
        follows = config.background.follows_pattern
        noise = judge_counts(
            opening, judged.camera, additive=additive, follows=follows, whole=whole
        )
    if noise.excess is None:
        ratio = curve.at(window)
        message = of.WINDOWS_NOISY({"window": window, "ratio": ratio}).text
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
        windows, lower = "sliding windows", ""
        if given:
            windows = f"two windows of background.window_frames = {given}"
            lower = ", or lower background.window_frames"
        raise DataError(
            f"{reader.name}: has {frames} frames, but {windows} before and after each landing take "
            f"{needed}: record longer{lower}; or give the frames before the particles bind as "
            "background.frames = [0, N]"
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
