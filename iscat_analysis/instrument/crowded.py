"""The optics of a movie whose particles all bound at once, and hardly any of them stands alone.

From bright places alone the optics are learned roughly, with what is faint or near another not
accounted for.  With these optics the field is fitted, and from its particles, now all known, the
optics are learned again, until they describe pictures that were not fitted.

Particles that each have a height of their own are learned from in the same way, beginning with the
field as the configured optics fit it, see `iscat_analysis.instrument.unknown_heights`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.instrument.collect import bright_places, known_places
from iscat_analysis.instrument.fit_optics import (
    calibrate_particle_images,
    learn_with_heights,
    misfit_of,
)
from iscat_analysis.instrument.measure import LEAST_SIGHTS
from iscat_analysis.instrument.microscope import with_sign
from iscat_analysis.instrument.parameters import heights_free, settings_of, with_settings
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.records import Status, Windows

LEAST_ROUGH = 6
"""Bright places, whatever is near them, without which the optics are not even learned roughly."""

ROUNDS = 3
"""Of a fit of the field and optics learned from it."""

HOPELESS_CHI2 = 2.0
"""Reduced χ² of pictures that were not fitted, above which it must have fallen for another round.
Not more than that: with the first optics heights may be those of two fringes, and the field that is
fitted with the next ones has a single one."""


def seen_in_field(
    windows: Windows, config: Config, pool: ThreadPoolExecutor
) -> tuple[list[ParticleImage], list[ParticleImage]]:
    """Fit the field, and cut out the particles that are farthest from others."""
    free = heights_free(config)
    fit = config.fit.model_copy(update={"mode": "joint" if free else "mass"})
    rows, columns = windows.after_e.shape
    context = make_context(config.model_copy(update={"fit": fit}), (rows, columns))
    events, _ = fit_field(context, windows, pool=pool)
    # with free heights what wrong optics leave over is beside particles, which would not be alone
    known = [e.fit.theta for e in events if not (free and Status.SIDELOBE in e.flags)]
    return known_places(windows, config, known, LEAST_SIGHTS)


def learn_in_field(
    windows: Windows,
    config: Config,
    groups: Sequence[str],
    source: Mapping[str, str],
    pool: ThreadPoolExecutor,
) -> OpticsCalibration:
    """Learn the optics from all particles of a field together."""
    guess: Config | None = config
    before, free = math.inf, heights_free(config)
    if not free:
        places, others = bright_places(windows, config, alone_nm=0.0)
        found = calibrate_particle_images(
            places, others, config, groups, source, least=LEAST_ROUGH, mapper=pool.map
        )
        guess, why = with_sign(with_settings(config, found.measured.settings))
    for number in range(ROUNDS):
        if guess is None:
            raise DataError(why)
        sights, others = seen_in_field(windows, guess, pool)
        if not free:
            found = calibrate_particle_images(
                sights, others, config, groups, source, mapper=pool.map
            )
        else:
            found = learn_with_heights(
                sights, others, config, groups, source,
                known=settings_of(guess), around=not number, mapper=pool.map,
            )  # fmt: skip
        misfit = misfit_of(found)
        before = min(before, float(found.measured.configured.chi2_reduced.mean()))
        if found.accepted or misfit > max(HOPELESS_CHI2, before):
            break
        before = misfit
        guess, why = with_sign(with_settings(config, found.measured.settings))
    return found
