"""Optics whose particles are bright where the calibration of masses has them dark, or dark.

The line of a calibration has a sign, and so has the contrast of a particle at a focus.  Between the
foci of either sign lie those with next to no contrast.  At a focus of the other sign no mass
belongs to a contrast, and nothing can be fitted: the movie must say where the focus is.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import NoiseSurvey
from iscat_analysis.errors import ConfigError, ContrastError, DataError
from iscat_analysis.fitting.ranges import frame_ranges, measured_windows
from iscat_analysis.fitting.run import notify_nobody
from iscat_analysis.instrument.collect import bright_particle_images
from iscat_analysis.instrument.fit_optics import Collected, fit_optics, misfit_of, none_bright
from iscat_analysis.instrument.learning import NOISE, adopted, learned_from, noise_differs, why_not
from iscat_analysis.instrument.loop import accepted
from iscat_analysis.instrument.microscope import (
    REJECTED_P,
    goodness,
    median_p,
    microscopes,
    reach_nm,
    with_sign,
)
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.instrument.sources import seen_in_field
from iscat_analysis.movie import Stack
from iscat_analysis.optics.forward import forward_model, signed_peak
from iscat_analysis.optics.parameters import FREE, heights_free, settings_of
from iscat_analysis.threads import threads

NEXT_TO_NONE = 0.3
"""Contrast over the largest of any focus, below which the focus is one between both signs."""

_FOCI_NM = tuple(float(focus) for focus in range(-800, 801, 50))
_FAIR = 0.2  # of the largest contrast, which a focus to begin with has
_APART_NM = 100.0  # foci to begin with


@dataclass(frozen=True)
class WrongSign:
    """A configured focus that gives the contrast the other sign."""

    config: Config
    said: str
    starts: tuple[Config, ...]

    def error(self, why: str) -> ConfigError:
        """Say that nothing can be fitted, and why the movie does not help."""
        return ConfigError(
            f"{self.said}; {why}: correct optics.focus_nm, or calibration.gradient_per_kda if that "
            "has the wrong sign"
        )


def wrong_sign(config: Config) -> WrongSign | None:
    """Tell whether the configured optics give contrast the sign that the calibration has."""
    if config.calibration is None or config.optics.psf != "model":
        return None
    try:
        forward_model(config, 1000.0)
    except ContrastError:
        pass
    else:
        return None
    line = config.calibration.gradient_per_kda
    foci = sorted({*_FOCI_NM, config.optics.focus_nm})
    contrast = {focus: _contrast(_at(config, focus)) for focus in foci}
    here = contrast[config.optics.focus_nm]
    most = max(foci, key=lambda focus: abs(contrast[focus]))
    share = abs(here / contrast[most])
    they = "are"
    if share < NEXT_TO_NONE:
        they = f"have next to no contrast ({share:.0%} of that at {most:g}), and what they have is"
    seen, wanted = ("bright", "dark") if here > 0 else ("dark", "bright")
    said = (
        f"at optics.focus_nm = {config.optics.focus_nm:g} particles {they} {seen}, where "
        f"calibration.gradient_per_kda = {line:g} has them {wanted}"
    )
    fair = [f for f in foci if contrast[f] * line > 0 and abs(contrast[f] / contrast[most]) > _FAIR]
    starts = [focus for focus in fair if focus % _APART_NM == 0]
    return WrongSign(config, said, tuple(_at(config, focus) for focus in starts))


def learn_sign(
    movie: Stack,
    wrong: WrongSign,
    camera: Camera,
    *,
    warn: Callable[[str], None],
    notify: Callable[[str], None] = notify_nobody,
    opening: NoiseSurvey | None = None,
) -> tuple[Config, dict[str, Any]]:
    """Learn the optics of a movie whose configured focus has the wrong sign, or its focus alone."""
    config = wrong.config
    reason = why_not(config)
    if reason:
        raise wrong.error(f"the optics are not learned {reason}")
    if config.fit.mode == "track":
        raise wrong.error(
            "no track can be followed with it, from which the optics would be learned"
        )
    if config.optics.calibrate == "never" or (
        config.optics.calibrate == "auto" and config.optics.file is not None
    ):
        by = "file" if config.optics.calibrate == "auto" else "calibrate"
        value = getattr(config.optics, by)
        raise wrong.error(f'by optics.{by} = "{value}" the optics are not learned from the movie')
    notify("learning the optics from the particles of the movie, which may take minutes…")
    with threads(config.compute.workers) as pool:
        try:
            if noise_differs(movie, config, camera):
                raise DataError("the movie does not tell another: " + NOISE)
            if heights_free(config):
                seen = _begun(movie, wrong, camera, pool)
            else:
                images, others = bright_particle_images(movie, config, camera, pool, opening)
                seen = Collected(config, images, others)
            if not seen.images:
                raise DataError(none_bright(movie.name))
            median, _ = median_p(list(seen.images), config, seen.others, pool.map)
            if median >= REJECTED_P:
                raise DataError("with it the optics describe the particles of the movie")
            found = _found(movie, seen, wrong, camera, pool)
        except DataError as error:
            raise wrong.error(str(error)) from error
    warn(wrong.said)
    tested = {"tested": len(seen.images), "median_p": median}
    return adopted(found, config, tested, wrong.said, warn=warn)


def _begun(movie: Stack, wrong: WrongSign, camera: Camera, pool: ThreadPoolExecutor) -> Collected:
    """Fit the field with each focus of the right sign, and take what describes most particles."""
    config = wrong.config
    windows = measured_windows(movie, config, camera, *frame_ranges(movie, config))
    best: tuple[float, Collected] | None = None
    for start in wrong.starts:
        images, others = seen_in_field(windows, start, pool)
        if not images:
            continue
        model = microscopes(start, max(map(reach_nm, images)))(settings_of(start))
        chi2 = float(np.median([goodness(image, model)[0] for image in images]))
        if best is None or chi2 < best[0]:
            best = chi2, Collected(config, images, others, settings_of(start))
    return best[1] if best is not None else Collected(config, ())


def _found(
    movie: Stack, seen: Collected, wrong: WrongSign, camera: Camera, pool: ThreadPoolExecutor
) -> OpticsCalibration:
    """Measure the focus alone, or where that does not describe the particles all of the optics."""
    config, origin = wrong.config, {"movie": movie.name}
    found = fit_optics(seen, ("focus",), origin, pool.map)
    focus = float(str(found.measured.settings["focus_nm"]))
    if found.accepted:
        learned, _ = with_sign(found.config)
        if learned is None or _phase(learned) != _phase(config):
            raise DataError(f"by the movie the focus is {focus:.0f} nm, which has that sign too")
        return found
    if heights_free(config):
        near = replace(seen, near=found.measured.settings)
        every = fit_optics(near, tuple(FREE), origin, pool.map)
    else:
        every = learned_from(seen, movie, config, camera, tuple(FREE), origin, pool)
    if accepted(every, config)[0] is not None:
        return every
    chi2 = misfit_of(found)
    more = "" if heights_free(config) else ", as where more than the focus is wrong"
    raise DataError(
        f"of the foci tried {focus:.0f} nm describes the brightest particles best, but not well "
        f"(reduced chi2 {chi2:.3g}){more}"
    )


def _phase(config: Config) -> float:
    return config.optics.reference_phase_deg


def _at(config: Config, focus_nm: float) -> Config:
    optics = config.optics.model_copy(update={"focus_nm": focus_nm})
    return config.model_copy(update={"optics": optics})


def _contrast(config: Config) -> float:
    return signed_peak(forward_model(config.model_copy(update={"calibration": None}), 1000.0))
