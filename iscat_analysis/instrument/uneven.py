"""Whether the optics change over the field or during a landing movie, and learned with that.

Pictures of particles at other places, or of other times, tell it: what they ask to change about the
optics is then a known function of place or time (`iscat_analysis.optics.field_map`).  Few pictures
lie at random places at random times, so that a focus that is tilted looks like one that drifts, and
the other way round.  Therefore the kinds of change compete: the one that the pictures ask for most
is tried first, and stays if it describes pictures better that were not fitted; the next is asked
for with it in place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.config import Config
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.instrument.fit_optics import Collected
from iscat_analysis.instrument.joint_fit import Asked, Estimate, asked_changes, maximise
from iscat_analysis.instrument.measure import HELD_OUT
from iscat_analysis.instrument.microscope import microscopes, reach_nm
from iscat_analysis.instrument.particle_image import Build, ParticleImage, with_masses
from iscat_analysis.movie import Stack
from iscat_analysis.optics.field_map import centre_of, changes_at
from iscat_analysis.optics.local import DRIFT_FRAMES
from iscat_analysis.optics.parameters import (
    FOCUS_DRIFT,
    FREE,
    LEAST_SIGHTS,
    Settings,
    free_names,
    prior_range,
)
from iscat_analysis.records import Mapper

KINDS: Mapping[str, tuple[str, ...]] = {
    "the focus moves": (FOCUS_DRIFT,),
    "the focus is tilted": ("focus_tilt_x_nm", "focus_tilt_y_nm"),
    "the focus is curved": ("focus_curvature_nm",),
    "coma grows over the field": ("coma_field_nm",),
    "astigmatism grows over the field": ("astigmatism_field_x_nm", "astigmatism_field_y_nm"),
    "the reference's phase is tilted": ("phase_tilt_x_deg", "phase_tilt_y_deg"),
    "the reference's phase is curved": ("phase_curvature_deg",),
}
"""Coefficients that are asked for, tried and kept together, with what they mean."""

RANDOM_P = 5e-7
"""Chance below which pictures ask for a change: five standard errors of a single coefficient."""

LEAST_CHANGE: Mapping[str, float] = {"focus_nm": 7.5, "reference_phase_deg": 4.0}
"""Changes of a parameter below which pictures and masses hardly change."""

LEAST_TERM_NM = 2.0
"""The same for an aberration."""

LEAST_PICTURES = 6
"""From fewer it is not known how well they tell a change."""

HELD_OUT_GAIN = 4.0
"""Log-likelihood that pictures that were not fitted must gain, to keep a change."""

_SHARED = ("focus_nm", "reference_phase_deg")  # free beside a change before optics are learned
_PERIODS = 20  # parts of the movie with a time of their own, in which pictures are looked at
_PASSES = 10
_NEVER: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class FieldOfView:
    """The part of the sample and the time that a movie shows."""

    centre_px: tuple[float, float, float]
    pixel_nm: float
    frames: tuple[int, int]
    in_time: bool

    @classmethod
    def of(cls, movie: Stack, config: Config, *, in_time: bool) -> FieldOfView:
        """Describe that of a movie."""
        frames = fitted_frames(movie, config, config.background.recorded)
        shape = (movie.shape[1], movie.shape[2])
        pixel = config.camera.pixel_size_nm or math.nan
        return cls(centre_of(config.optics, shape), pixel, frames, in_time)

    @property
    def middle(self) -> int:
        """Frame in the middle."""
        return sum(self.frames) // 2

    def placed(self, sights: Sequence[ParticleImage]) -> list[ParticleImage]:
        """Give pictures their places, and the times of the frames that show their particle."""
        first, last = self.frames
        part = max((last - first) / _PERIODS, 1.0)
        x, y, half = self.centre_px
        out = []
        for sight in sights:
            shown = sight.frames[0] if sight.mass_kda < 0 else sight.frames[1]
            time = round((shown - self.middle) / part) * part / DRIFT_FRAMES
            at_x, at_y = (
                float(np.mean(axis)) / self.pixel_nm for axis in (sight.grid.x_nm, sight.grid.y_nm)
            )
            place = ((at_x - x) / half, (at_y - y) / half)
            out.append(replace(sight, place=place, focus_steps=time if self.in_time else 0.0))
        return out

    def optics(self, config: Config) -> Config:
        """Say in a configuration for what part of the sample and what time its terms hold."""
        update = {"field_px": self.centre_px, "focus_frame": self.middle if self.in_time else 0}
        return config.model_copy(update={"optics": config.optics.model_copy(update=update)})


@dataclass(frozen=True)
class Change:
    """A kind of change that pictures ask for, to first order."""

    kind: str = ""
    terms: Mapping[str, float] = field(default_factory=lambda: _NEVER)
    significance: float = 0.0
    rise_nm: float = 0.0

    @property
    def matters(self) -> bool:
        """Whether there is one."""
        return bool(self.terms)

    @property
    def said(self) -> str:
        """Say so."""
        if FOCUS_DRIFT in self.terms:
            return f"the focus moves by about {self.rise_nm:+.0f} nm over the movie"
        size = math.hypot(*self.terms.values())
        unit = "deg" if next(iter(self.terms), "").endswith("_deg") else "nm"
        return f"{self.kind} by about {size:.0f} {unit} towards the edge of the field"


EVEN = Change()
"""Where nothing is known of a change."""


def asked_change(
    sights: Sequence[ParticleImage],
    config: Config,
    settings: Settings,
    view: FieldOfView,
    mapper: Mapper = map,
) -> Change:
    """Find the kind of change that pictures ask for most, beside another focus and phase."""
    seen = view.placed(sights)
    if len({sight.spot for sight in seen}) < LEAST_PICTURES:
        return EVEN
    build = microscopes(config, max(map(reach_nm, sights)))
    return next(_asked(seen, build, settings, _SHARED, view, mapper), EVEN)


def _asked(
    sights: Sequence[ParticleImage],
    build: Build,
    settings: Settings,
    shared: Sequence[str],
    view: FieldOfView,
    mapper: Mapper,
) -> Iterator[Change]:
    """Give the kinds of change that pictures ask for, the clearest first."""
    kinds = {k: names for k, names in KINDS.items() if not set(names) <= set(shared)}
    if not view.in_time:
        kinds = {k: names for k, names in kinds.items() if FOCUS_DRIFT not in names}
    names = (*shared, *(n for names in kinds.values() for n in names))
    asked = asked_changes(sights, build, settings, names, mapper)
    found = [_change(asked, kind, shared, sights, view) for kind in kinds]
    yield from sorted(filter(None, found), key=lambda each: -each.significance)


def _change(
    asked: Asked,
    kind: str,
    shared: Sequence[str],
    sights: Sequence[ParticleImage],
    view: FieldOfView,
) -> Change | None:
    """Give one kind of change, if it is beyond chance, can be, and matters."""
    names = KINDS[kind]
    step, covariance = asked.step((*shared, *names))
    size, errors = step[len(shared) :], covariance[len(shared) :, len(shared) :]
    if len(sights) < LEAST_PICTURES or not np.all(np.diag(errors) > 0):
        return None
    significance = float(size @ np.linalg.solve(errors, size))
    terms = dict(zip(names, size.tolist(), strict=True))
    if chdtrc(len(names), significance) > RANDOM_P or not is_plausible(terms, view.frames):
        return None
    changes = [changes_at(terms, sight.spot) for sight in sights]
    largest = {base: max(abs(each[base]) for each in changes) for base in changes[0]}
    if all(change < LEAST_CHANGE.get(base, LEAST_TERM_NM) for base, change in largest.items()):
        return None
    rise = terms.get(FOCUS_DRIFT, 0.0) * (view.frames[1] - view.frames[0]) / DRIFT_FRAMES
    return Change(kind, terms, significance, rise)


def is_plausible(terms: Mapping[str, float], frames: tuple[int, int]) -> bool:
    """Whether optics can change so much; pictures that no optics describe ask for anything."""
    over = (frames[1] - frames[0]) / DRIFT_FRAMES
    rise_nm = abs(terms.get(FOCUS_DRIFT, 0.0) * over)
    return rise_nm < prior_range("focus_nm") and all(
        abs(size) < prior_range(name) for name, size in terms.items()
    )


def in_uneven_field(
    seen: Collected, settings: Settings, view: FieldOfView, mapper: Mapper = map
) -> Collected | None:
    """Give pictures their places and times, and a microscope near theirs that changes with these.

    None where pictures that were not fitted want no change.
    """
    images, config = seen.images, seen.config
    if len(images) < LEAST_SIGHTS:
        return seen  # too few for any optics, which is said where they are fitted
    build = microscopes(config, max(map(reach_nm, images)))
    signed = with_masses(images, build, settings)  # what leaves is seen before
    pictures = sorted(view.placed(signed), key=lambda sight: -sight.snr)

    def fitted(some: Sequence[ParticleImage], start: Settings, names: Sequence[str]) -> Estimate:
        return maximise(some, build, start, names, passes=_PASSES, mapper=mapper)

    def tried(start: Settings, names: Sequence[str]) -> tuple[Settings, float]:
        """Fit all parts of the pictures but one, which is judged, in turns."""
        values, total = start, 0.0
        for part in range(HELD_OUT):
            fit = fitted([p for k, p in enumerate(pictures) if k % HELD_OUT != part], start, names)
            total += fitted(pictures[part::HELD_OUT], fit.values, ()).log_likelihood
            values = fit.values
        return values, total

    names: tuple[str, ...] = free_names(tuple(FREE), settings, FREE["zernike"])
    values, before = tried(settings, names)
    kept, refused = list[str](), set[str]()
    while True:
        best = fitted(pictures, values, names)
        wanted = _asked(best.sights, build, best.values, names, view, mapper)
        change = next((each for each in wanted if each.kind not in refused), EVEN)
        if not change.matters:
            break
        refused.add(change.kind)
        start = {**best.values, **dict.fromkeys(change.terms, 0.0)}
        trial, after = tried(start, (*names, *change.terms))
        if after <= before + HELD_OUT_GAIN:
            continue
        values, before, names = trial, after, (*names, *change.terms)
        for kind in kept[:]:  # what was taken for lack of what came later
            others = tuple(name for name in names if name not in KINDS[kind])
            rest = {key: value for key, value in values.items() if key not in KINDS[kind]}
            trial, after = tried(rest, others)
            if after > before - HELD_OUT_GAIN:
                values, before, names = trial, after, others
                kept.remove(kind)
        kept.append(change.kind)
    if not kept:
        return None
    others_placed = view.placed(seen.others)
    return Collected(view.optics(config), best.sights, others_placed, near=best.values)
