"""Sources of pictures of particles that are bound: alone, or many in one field.

Particles that stand alone are found without any optics.  Where all bound at once and hardly any
stands alone, the optics are learned roughly from bright places, with what is faint or near another
not accounted for.  With these optics the field is fitted, and from its particles, now all known,
the optics are learned again, until they describe pictures that were not fitted.  Particles that
each have a height of their own are learned from in the same way, beginning with the field as the
configured optics fit it.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.instrument.collect import bright_places, known_places
from iscat_analysis.instrument.fit_optics import Collected, misfit_of
from iscat_analysis.instrument.loop import Rounds
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.instrument.uneven import FieldOfView, asked_change, in_uneven_field
from iscat_analysis.optics.parameters import LEAST_IMAGES, heights_free, settings_of
from iscat_analysis.records import Status, Windows

ROUNDS = 3
"""Of a fit of the field and optics learned from it."""

HOPELESS_CHI2 = 2.0
"""Reduced χ² of pictures that were not fitted, above which it must have fallen for another round.
Not more than that: with the first optics heights may be those of two fringes, and the field that is
fitted with the next ones has a single one."""


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
    """All particles of a field, those that are farthest from others, among the rings of all."""

    windows: Windows
    config: Config
    pool: ThreadPoolExecutor

    def collect(self, rounds: Rounds) -> Collected | None:
        """Fit the field with what was learned last."""
        free = heights_free(self.config)
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
        hopeless = misfit_of(fitted[-1]) > max(HOPELESS_CHI2, before)
        return fitted[-1].accepted or hopeless or len(fitted) == ROUNDS


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
    return known_places(windows, config, known, LEAST_IMAGES)
