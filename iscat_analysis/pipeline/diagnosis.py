"""What the background frames reveal about camera and stage."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.cause import likely_cause
from iscat_analysis.movie import Stack
from iscat_analysis.movie.camera import Camera
from iscat_analysis.movie.drift import follow_pattern
from iscat_analysis.movie.lines import Lines, find_lines
from iscat_analysis.movie.metadata import GainDiagnosis, diagnose_gain
from iscat_analysis.movie.spectrum import NoiseSpectrum, measure_spectrum
from iscat_analysis.pipeline.field import Event
from iscat_analysis.records import Status, Windows
from iscat_analysis.search.sliding import measure_frames, measure_noise

DRIFT_PX = 0.02
"""Shift of the fixed pattern below which it is not worth a line."""

_BRIGHTEST = 8  # isolated particles on which the model is judged
_DISTURBED = frozenset({Status.SATURATED, Status.SIDELOBE, Status.TOO_CLOSE})
_GAIN_FRAMES = 64  # on which the gain is judged
_SPECTRUM_FRAMES = 128  # on which the noise's spectrum is measured
_NOISE_BYTES = 64_000_000  # of counts on which the noise is measured
_LONGEST = 100  # average of the noise curve
_SMALLEST_PX = 32  # side of a field in which a pattern is followed
_SIGNIFICANT = 4.0  # standard errors beyond which a drift is one


EXCESS_NOISE = 1.4
"""Noise variance over the expected from which a thousand candidates are taken for noise."""


def judge_background(
    movie: Stack, camera: Camera, windows: Windows
) -> tuple[GainDiagnosis | None, NoiseSpectrum | None]:
    """Compare the noise of the background frames with the camera's.

    Parameters
    ----------
    movie : Stack
        The movie.
    camera : Camera
        Counts → photoelectrons.
    windows : Windows
        The background.

    Returns
    -------
    gain : GainDiagnosis or None
        None where there is no shot noise to look at.
    spectrum : NoiseSpectrum or None
        None where the noise is white and of the expected size, or there is none to look at.
    """
    if windows.n_before < 2 or not _is_lit(windows):
        return None, None
    counts = _first(movie, windows, _SPECTRUM_FRAMES)
    spectrum = measure_spectrum(counts, camera)
    try:
        gain = diagnose_gain(counts[:_GAIN_FRAMES], camera, masked=windows.masked)
    except DataError:  # too dark to tell
        return None, spectrum
    return allow_for_correlation(gain, spectrum), spectrum


def judge_lines(movie: Stack, config: Config, camera: Camera) -> Lines | None:
    """Look for rows and columns that flicker, where their light may be divided out.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        Its background frames, or the first that are analysed, are looked at; nothing is where
        ``background.power_normalization`` is false, the background is dark or known, or the fixed
        pattern is followed as it moves: it changes the light of the lines far more than flicker, as
        nanoparticles that move in a volume do, which are there in every frame.
    camera : Camera
        Counts → photoelectrons.

    Returns
    -------
    Lines or None
        None where there is nothing to correct.
    """
    background = config.background
    if (
        not background.power_normalization
        or background.method == "known"
        or (background.method == "sliding" and background.drift_correction)
        or config.optics.scheme == "darkfield"
        or (config.fit.mode == "track" and config.track.free == "joint" and not background.frames)
    ):
        return None
    first, last = background.frames or config.fit.frames or (0, movie.shape[0])
    counts = movie.read(first, max(first, min(last, movie.shape[0], first + _SPECTRUM_FRAMES)))
    if not len(counts):
        return None
    light, repeats = measure_frames(counts, camera)
    return find_lines(counts[np.isfinite(light) & ~repeats], camera)


def allow_for_correlation(gain: GainDiagnosis, spectrum: NoiseSpectrum | None) -> GainDiagnosis:
    """Judge the gain by the noise that neighbouring pixels have together.

    Parameters
    ----------
    gain : GainDiagnosis
        From the variance of single pixels.
    spectrum : NoiseSpectrum or None
        Of the same frames.

    Returns
    -------
    GainDiagnosis
        The same where pixels are independent.

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


def pixel_warnings(windows: Windows) -> Iterator[str]:
    """Say which pixels are left out.

    Parameters
    ----------
    windows : Windows
        The background.

    Yields
    ------
    str
        One line each.
    """
    defects = int(np.sum(windows.masked & ~windows.saturated))
    if defects:
        yield f"{defects} dead or hot pixels are left out"
    saturated = int(windows.saturated.sum())
    if saturated:
        yield (
            f"{saturated} pixels are saturated in some frame and left out; "
            "lower the exposure or the laser power"
        )


def examine_background(movie: Stack, camera: Camera, windows: Windows) -> dict[str, Any]:
    """Measure noise against averaging, and how far the fixed pattern moved.

    Parameters
    ----------
    movie : Stack
        The movie.
    camera : Camera
        Counts → photoelectrons.
    windows : Windows
        The background, and the frames with the particles.

    Returns
    -------
    dict
        What ``summary.json`` adds under ``"background"``; drift is from the background to the
        frames after it, None where there is no pattern to follow.
    """
    curve: tuple[tuple[int, ...], tuple[float, ...]] = ((), ())
    limit = drift = error = None
    if windows.n_before >= 2 and _is_lit(windows):
        frame_bytes = math.prod(movie.shape[1:]) * np.dtype(movie.dtype).itemsize
        some = _first(movie, windows, max(2, _NOISE_BYTES // frame_bytes))
        noise = measure_noise(some, camera, min(_LONGEST, len(some) // 2))
        curve, limit = (noise.frames, noise.variance_over_shot), noise.shot_limited
        if min(movie.shape[1:]) >= _SMALLEST_PX:
            way = follow_pattern(
                np.stack([windows.before_e, windows.after_e]),
                np.array([1.0, windows.power_ratio]),
                np.array([np.mean(windows.frames_before), np.mean(windows.frames_after)]),
                ~windows.masked,
                windows.read_variance_before_e2,
            )
            if way is not None and np.isfinite(way.error_px).all():
                drift, error = way.shift_px[1].tolist(), way.error_px[1].tolist()
    return {
        "noise_frames": list(curve[0]),
        "noise_variance_over_shot": list(curve[1]),
        "shot_noise_limited_frames": limit,
        "drift_px": drift,
        "drift_error_px": error,
    }


def drift_warning(name: str, background: dict[str, Any]) -> str | None:
    """Say that the fixed pattern moved, where that can be taken for particles.

    Parameters
    ----------
    name : str
        Of the movie.
    background : dict
        From `examine_background`.

    Returns
    -------
    str or None
        None where it stood still, as far as one can tell.
    """
    if background["drift_px"] is None:
        return None
    (y, x), (y_error, x_error) = background["drift_px"], background["drift_error_px"]
    pull = math.hypot(y / y_error, x / x_error)
    if math.hypot(y, x) <= DRIFT_PX or pull <= _SIGNIFICANT:
        return None
    return (
        f"{name}: the fixed pattern moved by {x:+.2f} pixels in x and {y:+.2f} in y between the "
        "background and the frames after it; its edges look like particles: take background frames "
        "nearer to them (background.frames), or fewer frames (fit.frames)"
    )


def misfit_warning(config: Config, events: Sequence[Event]) -> str:
    """Say what is probably wrong with the model, where it misses the brightest particles.

    Parameters
    ----------
    config : Config
        The microscope as it is configured.
    events : sequence of Event
        Fitted particles.

    Returns
    -------
    str
        One line; empty where most of the brightest are described, or nothing stands out.
    """
    if config.optics.psf == "measured":
        return ""
    alone = [e for e in events if not _DISTURBED.intersection(e.fit.flags)]
    brightest = sorted(alone, key=lambda e: -e.snr)[:_BRIGHTEST]
    missed = [e for e in brightest if Status.POOR_FIT in e.fit.flags]
    if 2 * len(missed) <= len(brightest):
        return ""
    cause = likely_cause(config, [(e.likelihood, e.fit.theta, e.fit.box.free) for e in missed])
    return cause.message if cause else ""


def _first(movie: Stack, windows: Windows, most: int) -> NDArray[Any]:
    """Return the first background frames, shape (t, y, x) [counts]."""
    start, stop = windows.frames_before
    return movie.read(start, min(stop, start + most))


def _is_lit(windows: Windows) -> bool:
    """Whether there is light in the background, beyond the read noise."""
    used = ~windows.masked
    light, read = windows.before_e[used], windows.read_variance_before_e2[used]
    return bool(light.sum() > read.sum())
