"""Whether the optics change over the field or during a landing movie, and learned with that.

Pictures of particles at other places, or of other times, tell it: what they ask to change about the
optics is then a known function of place or time (`iscat_analysis.optics.local`).  Few pictures
lie at random places at random times, so that a focus that is tilted looks like one that drifts, and
the other way round.  Therefore the kinds of change compete: the one that the pictures ask for most
is tried first, and stays if it describes pictures better that were not fitted; the next is asked
for with it in place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.config import JUMPS, MOVES, Config
from iscat_analysis.fitting.ranges import background_mode, fitted_frames
from iscat_analysis.inference.maximiser import covariance_of
from iscat_analysis.instrument.joint_fit import Estimate, PictureScores, maximise
from iscat_analysis.instrument.measure import HELD_OUT
from iscat_analysis.instrument.particle_image import (
    Collected,
    Images,
    microscopes,
    reach_nm,
    with_heights,
    with_masses,
)
from iscat_analysis.movie import Stack
from iscat_analysis.optics.local import BEND, DRIFT, DRIFT_FRAMES, Spot, centre_of, changes_at
from iscat_analysis.optics.parameters import FREE, Settings, free_names, is_usual, prior_of
from iscat_analysis.records import FloatArray, IntArray, Mapper

KINDS: Mapping[str, tuple[str, ...]] = {
    "the focus moves": (DRIFT,),
    "the focus moves to and fro": (BEND,),
    "the focus is tilted": ("focus_tilt_x_nm", "focus_tilt_y_nm"),
    "the focus is curved": ("focus_curvature_nm",),
    "coma grows over the field": ("coma_field_nm",),
    "astigmatism grows over the field": ("astigmatism_field_x_nm", "astigmatism_field_y_nm"),
    "the reference's phase is tilted": ("phase_tilt_x_deg", "phase_tilt_y_deg"),
    "the reference's phase is curved": ("phase_curvature_deg",),
}
"""Coefficients that are asked for, tried and kept together, with what they mean.

Movies that need each: drift, bend and jumps in `tests/diagnosis/test_focus_drift.py`, the others,
but for a tilted phase, in `tests/instrument/test_uneven_optics.py`; `benchmarks/hazards.py` has a
row for a tilted focus.
"""

_TERMS = tuple(chain.from_iterable(KINDS.values()))

JUMP = "the focus jumps"
"""The same of one more jump, at the frame at which the pictures ask for it most."""

RESTLESS = "the focus moves in a way that is not learned"
"""What is left of a focus that moves, where parts of the movie ask for other ones."""


LEAST_CHANGE: Mapping[str, float] = {"focus_nm": 7.5, "reference_phase_deg": 4.0}
"""Changes of a parameter below which pictures and masses hardly change."""


LEAST_PICTURES = 6
"""From fewer it is not known how well they tell a change."""

HELD_OUT_GAIN = 4.0
"""Log-likelihood that pictures that were not fitted must gain, to keep a change."""

_SIDE = 2  # pictures on either side of a jump


@dataclass(frozen=True)
class FieldOfView:
    """The part of the sample and the time that a movie shows."""

    centre_px: tuple[float, float, float]
    pixel_nm: float
    frames: tuple[int, int]
    in_time: bool
    movie: Stack
    jumps: tuple[int, ...] = ()
    """Frames from which on the focus is another one."""

    @classmethod
    def of(cls, movie: Stack, config: Config) -> FieldOfView:
        """Describe that of a movie; time tells something of landings alone."""
        in_time = background_mode(config) == "sliding"
        frames = fitted_frames(movie, config, config.background.recorded)
        shape = (movie.shape[1], movie.shape[2])
        centre = centre_of(config.optics, shape)
        return cls(centre, config.camera.pixel_nm, frames, in_time, movie)

    @property
    def middle(self) -> int:
        """Frame in the middle."""
        return sum(self.frames) // 2

    def placed(self, images: Images) -> Images:
        """Give pictures their places, and the times of the frames that show their particle."""
        first, last = self.frames
        # parts of the movie with a time of their own, in which pictures are looked at
        part = max((last - first) / 20, 1.0)
        x, y, half = self.centre_px
        out = []
        for image in images:
            time = round((image.shown - self.middle) / part) * part / DRIFT_FRAMES
            after = tuple(image.shown >= frame for frame in self.jumps)
            at_x, at_y = (
                float(np.mean(axis)) / self.pixel_nm for axis in (image.grid.x_nm, image.grid.y_nm)
            )
            place = ((at_x - x) / half, (at_y - y) / half)
            time = time if self.in_time else 0.0
            out.append(replace(image, place=place, focus_steps=time, after=after))
        return out

    def undivided(self, images: Images) -> Images:
        """Leave pictures out whose frames lie on both sides of a jump."""
        return [
            image
            for image in images
            if not any(
                abs(frame - image.step) < 2 * abs(image.shown - image.step) for frame in self.jumps
            )
        ]

    def optics(self, config: Config) -> Config:
        """Say in a configuration for what part of the sample and what time its terms hold."""
        update = {
            "field_px": self.centre_px,
            "focus_frame": self.middle if self.in_time else 0,
            "focus_jumps": tuple((frame, 0.0) for frame in self.jumps),
        }
        return config.changed(optics=update)


@dataclass(frozen=True)
class Change:
    """A kind of change that pictures ask for, to first order."""

    kind: str = ""
    terms: Mapping[str, float] = field(default_factory=dict[str, float])
    significance: float = 0.0
    rise_nm: float = 0.0
    jump: int = 0
    """Pictures before it."""

    @property
    def matters(self) -> bool:
        """Whether there is one."""
        return bool(self.kind)

    @property
    def said(self) -> str:
        """Say so."""
        if DRIFT in self.terms:
            return f"the focus moves by about {self.rise_nm:+.0f} nm over the movie"
        if self.kind == RESTLESS:
            return f"{self.kind}, by about {self.rise_nm:.0f} nm"
        if set(self.terms) & set(MOVES):  # to first order its course is not known
            return f"the focus moves by about {self.rise_nm:.0f} nm within the movie"
        size = math.hypot(*self.terms.values())
        unit = "deg" if next(iter(self.terms), "").endswith("_deg") else "nm"
        return f"{self.kind} by about {size:.0f} {unit} towards the edge of the field"


NO_CHANGE = Change()
"""Where nothing is known of a change."""


def asked_change(
    images: Images, config: Config, settings: Settings, view: FieldOfView, mapper: Mapper = map
) -> Change:
    """Find the kind of change that pictures ask for most, beside another focus and phase."""
    seen = view.placed(with_heights(images, config))
    if len({image.spot for image in seen}) < LEAST_PICTURES:
        return NO_CHANGE
    build = microscopes(config, max(map(reach_nm, images)))
    # free beside a change before optics are learned
    shared = ("focus_nm", "reference_phase_deg")
    scores = PictureScores.of(seen, build, settings, (*shared, *_TERMS), mapper)
    tests = _ScoreTests(scores, shared, view)
    return next(iter([*tests.changes(), *tests.rest()]), NO_CHANGE)


@dataclass(frozen=True)
class _ScoreTests:
    """Score tests of terms of field and time, beside parameters that all pictures share."""

    scores: PictureScores
    shared: Sequence[str]
    view: FieldOfView

    @property
    def images(self) -> Images:
        """The pictures."""
        return self.scores.images

    def changes(self) -> list[Change]:
        """Give the kinds of change, the clearest first."""
        found = [
            self._change(kind, names, self.scores.slopes(names))
            for kind, names in KINDS.items()
            if not set(names) <= set(self.shared)
            and (self.view.in_time or not set(names) & set(MOVES))
        ]
        found += self._jumps()
        return sorted(filter(None, found), key=lambda each: -each.significance)

    def rest(self) -> list[Change]:
        """Say whether parts of the movie ask for a focus of their own."""
        number = min(6, len(self.images) // 4)  # of parts, of four pictures or more
        if not self.view.in_time or number < 2:
            return []
        order = np.argsort([image.shown for image in self.images])
        moved = np.zeros((len(self.images), number - 1))
        for block, pictures in enumerate(np.array_split(order, number)[1:]):
            moved[pictures, block] = 1.0
        rises, significance = self._step(self._of_focus(moved))
        spread = float(np.ptp([0.0, *rises]))
        if not _by_no_chance(significance, number - 1) or spread < LEAST_CHANGE["focus_nm"]:
            return []
        return [Change(RESTLESS, {}, significance, spread)]

    def _jumps(self) -> list[Change | None]:
        """Give the jump of the focus that is asked for most.

        A single picture on its other side may as well show something else, and is no jump.
        """
        known, number = len(self.view.jumps), len(self.images)
        if not self.view.in_time or known == len(JUMPS):
            return []
        order = np.argsort([image.shown for image in self.images])
        taken = {sum(not self.images[k].after[jump] for k in order) for jump in range(known)}
        rank = np.argsort(order)  # of each picture in time
        slopes = {
            before: self._of_focus((rank >= before)[:, None].astype(float))
            for before in sorted({*range(1, number)} - taken)
        }
        before = max(slopes, key=lambda split: self._step(slopes[split])[1], default=0)
        if not _SIDE <= before <= number - _SIDE:
            return []
        found = self._change(JUMP, (JUMPS[known],), slopes[before], trials=number)
        return [found and replace(found, jump=before)]

    def _of_focus(self, moved: FloatArray) -> FloatArray:
        """Give the slopes of what moves the focus alone; shapes: `moved` (n, m), (n, m, k)."""
        return np.asarray(moved[:, :, None] * (np.array(self.scores.names) == "focus_nm"))

    def _step(self, slopes: FloatArray) -> tuple[FloatArray, float]:
        """Give what is asked for beside what is shared, and how clearly in squared errors."""
        both = np.concatenate([self.scores.slopes(self.shared), slopes], axis=1)
        step, covariance = self.scores.step(both)
        size, errors = step[len(self.shared) :], covariance[len(self.shared) :, len(self.shared) :]
        if not np.all(np.diag(errors) > 0):
            return size, 0.0
        # where all pictures have one place errors are singular
        return size, float(size @ covariance_of(errors, np.ones(size.size, dtype=bool)) @ size)

    def _change(
        self, kind: str, names: tuple[str, ...], slopes: FloatArray, trials: int = 1
    ) -> Change | None:
        """Give one kind of change, if it is beyond chance, can be, and matters."""
        size, significance = self._step(slopes)
        terms = dict(zip(names, size.tolist(), strict=True))
        if not (
            len(self.images) >= LEAST_PICTURES
            and _by_no_chance(significance, len(names), trials)
            and is_plausible(terms, self.view.frames)
        ):
            return None
        changes = np.abs(np.einsum("nmk,m->nk", slopes, size)).max(axis=0)
        largest = zip(self.scores.names, changes.tolist(), strict=True)
        # the same for an aberration
        if all(change < LEAST_CHANGE.get(base, 2.0) for base, change in largest):
            return None
        # the likeliest of many is so by chance, too
        clearness = significance - 2 * math.log(trials)
        return Change(kind, terms, clearness, rise_nm(terms, self.view.frames))


def _by_no_chance(significance: float, parameters: int, trials: int = 1) -> bool:
    # chance below which pictures ask for a change: five standard errors of a single coefficient
    return bool(trials * chdtrc(parameters, significance) < 5e-7)


def rise_nm(terms: Mapping[str, float], frames: tuple[int, int]) -> float:
    """Give by how much the focus differs most within a movie, or by a drift alone with its sign."""
    over = (frames[1] - frames[0]) / DRIFT_FRAMES
    if set(terms) == {DRIFT}:
        return terms[DRIFT] * over
    every = (True,) * len(JUMPS)
    spots = [Spot(), *(Spot(t=t, after=every) for t in np.linspace(-over / 2, over / 2, 9))]
    rises = [changes_at(terms, spot).get("focus_nm", 0.0) for spot in spots]
    return max(rises) - min(rises)


def is_plausible(terms: Mapping[str, float], frames: tuple[int, int]) -> bool:
    """Whether optics can change so much; pictures that no optics describe ask for anything."""
    moves = {name: size for name, size in terms.items() if name in MOVES}
    return is_usual("focus_nm", rise_nm(moves, frames)) and all(
        is_usual(name, size) for name, size in terms.items() if name not in moves
    )


_ENDS = 16  # frames at either end, which show the light before and after
_LOOKED_AT = 256  # frames between them


def jump_frame(view: FieldOfView, images: Images, between: tuple[int, int]) -> int:
    """Find the frame of a jump between two pictures: what has landed changes in it, all at once.

    Around each particle every frame is compared with the change from one end to the other, and the
    standard errors of a step are added.  Each has a vote of at most so many until the frames are
    near: what lands beside a few of them outweighs no jump, which all of them see.
    """
    order = sorted(images, key=lambda image: image.shown)
    last, first = (order[k] for k in between)
    low = max(round(last.frames[0]) - _ENDS, view.frames[0])
    high = min(round(2 * first.frames[1] - first.step) + _ENDS, view.frames[1])
    reach = round(350.0 / view.pixel_nm)  # what lands beside a particle changes little of that
    places = []
    for image in (image for image in order if image.step < low):
        y, x = (round(at / view.pixel_nm) for at in (image.y_nm, image.x_nm))
        rows, columns = (slice(max(at - reach, 0), at + reach + 1) for at in (y, x))
        places.append((slice(None), rows, columns))
    found = round((last.shown + first.shown) / 2)
    frames, light = _lit(view.movie, np.r_[low : low + _ENDS, high - _ENDS : high])
    early = frames < low + _ENDS
    if early.all() or not early.any():
        return found
    change = light[~early].mean(axis=0, keepdims=True) - light[early].mean(axis=0, keepdims=True)
    vote = 6.0  # standard errors that each particle counts for at most
    while places:
        number = np.unique(np.linspace(low, high - 1, _LOOKED_AT, dtype=int))
        frames, light = _lit(view.movie, number)
        before = np.arange(1, len(frames))
        after, clear = before[::-1], []
        for place in places:
            own, seen = change[place].ravel(), light[place].reshape(len(light), -1)
            sums = np.cumsum(seen @ own)
            steps = (sums[-1] - sums[:-1]) / after - sums[:-1] / before
            noise = np.std(np.diff(seen, axis=0)) / math.sqrt(2) * np.linalg.norm(own)
            clear.append(np.sqrt(before * after / len(frames)) * np.abs(steps) / noise)
        # where all have their vote, those whose steps are clearest
        votes = np.minimum(clear, vote).sum(axis=0)
        # of votes, which rounding makes
        likely = np.where(votes >= votes.max() - 1e-9, np.sum(clear, axis=0), 0.0)
        found = int(frames[int(np.argmax(likely)) + 1])
        if high - low <= _LOOKED_AT:
            break
        around = max(2 * _ENDS, 2 * (high - low) // _LOOKED_AT)
        low, high, vote = max(found - around, low), min(found + around, high), math.inf
    return found


def _lit(movie: Stack, frames: IntArray) -> tuple[IntArray, FloatArray]:
    """Read frames, and leave out those without light; each over its mean; shape (t, y, x)."""
    light = np.array([movie.read(frame, frame + 1)[0] for frame in frames.tolist()], dtype=float)
    level = light.mean(axis=(1, 2))
    lit = level > 0.5 * level.max()
    return frames[lit], light[lit] / level[lit, None, None]


def in_uneven_field(
    seen: Collected, settings: Settings, view: FieldOfView, mapper: Mapper = map
) -> Collected | None:
    """Give pictures their places and times, and a microscope near theirs that changes with these.

    None where pictures that were not fitted want no change.
    """
    config = seen.config
    images = [image.placed(image.x_nm, image.y_nm) for image in seen.images]
    build = microscopes(config, max(map(reach_nm, images)))
    prior = prior_of(config)
    signed = with_masses(images, build, settings)  # what leaves is seen before
    pictures: Images = sorted(view.placed(signed), key=lambda image: -image.snr)

    def fitted(some: Images, start: Settings, names: Sequence[str]) -> Estimate:
        return maximise(some, build, start, names, prior=prior, passes=10, mapper=mapper)

    def tried(pictures: Images, start: Settings, names: Sequence[str]) -> tuple[Settings, float]:
        """Fit all parts of the pictures but one, which is judged, in turns."""
        values, total = start, 0.0
        for part in range(HELD_OUT):
            fit = fitted([p for k, p in enumerate(pictures) if k % HELD_OUT != part], start, names)
            total += fitted(pictures[part::HELD_OUT], fit.values, ()).log_likelihood
            values = fit.values
        return values, total

    names: tuple[str, ...] = free_names(tuple(FREE), settings, FREE["zernike"])
    values, before = tried(pictures, settings, names)
    kept, refused = list[tuple[str, ...]](), set[str]()
    while True:
        best = fitted(pictures, values, names)
        every = (*names, *_TERMS)
        scores = PictureScores.of(best.images, build, best.values, every, mapper)
        tests = _ScoreTests(scores, names, view)
        change = next((each for each in tests.changes() if each.kind not in refused), NO_CHANGE)
        if not change.matters:
            break
        refused.add(change.kind)
        terms, seen_by, judged, least = tuple(change.terms), view, pictures, before
        if change.kind == JUMP:
            frame = jump_frame(view, best.images, (change.jump - 1, change.jump))
            seen_by = replace(view, jumps=(*view.jumps, frame))
            judged = seen_by.placed(seen_by.undivided(pictures))
            least = tried(judged, values, names)[1]
        start = {**best.values, **dict.fromkeys(terms, 0.0)}
        trial, after = tried(judged, start, (*names, *terms))
        if after <= least + HELD_OUT_GAIN:
            continue
        refused.discard(JUMP)
        view, pictures, values, before, names = seen_by, judged, trial, after, (*names, *terms)
        for kind in kept[:]:  # what was taken for lack of what came later
            others = tuple(name for name in names if name not in kind)
            rest = {key: value for key, value in values.items() if key not in kind}
            trial, after = tried(pictures, rest, others)
            if after > before - HELD_OUT_GAIN:
                values, before, names = trial, after, others
                kept.remove(kind)
        kept.append(terms)
        while view.jumps and JUMPS[len(view.jumps) - 1] not in names:
            view = replace(view, jumps=view.jumps[:-1])
            pictures = view.placed(pictures)
    refusal = "; ".join(change.said for change in tests.rest())
    if not kept and not refusal:
        return None
    return Collected(
        view.optics(config), best.images, view.placed(seen.others),
        near=best.values, refusal=refusal,
    )  # fmt: skip
