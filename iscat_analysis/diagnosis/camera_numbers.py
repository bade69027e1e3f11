"""Which number of the camera is wrong, as noise and zero of the light show it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from iscat_analysis.camera.calibration import LightZero
from iscat_analysis.camera.calibration.laws import TOLERANCE, Law
from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.learned import LearnedCamera
from iscat_analysis.camera.metadata import GainDiagnosis
from iscat_analysis.camera.spectrum import NoiseSpectrum

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
