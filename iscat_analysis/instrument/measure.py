"""From pictures of particles to the microscope that made them, and a verdict on it.

What is known before is a prior around the configured values, and any number of pictures adds what
it tells.  Two thirds of the pictures are fitted and a third decides: how many aberrations are worth
having, and whether the result describes pictures that it has not seen.  Where there are too few for
that, the evidence decides, the likelihood averaged over the prior, and the fitted pictures judge.
What they do not tell keeps the width of the prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, product
from typing import Any

import numpy as np
from scipy import fft

from iscat_analysis.instrument.joint_fit import Estimate, Neighbours, maximise
from iscat_analysis.instrument.particle_image import (
    FARTHEST_CENTRE_PX,
    UNIT_KDA,
    Build,
    Images,
    ParticleImage,
    average_particle_images,
    best_amplitudes,
    contrast_of,
    goodness,
    with_masses,
)
from iscat_analysis.optics.parameters import (
    FREE,
    HIGHER,
    LEAST_IMAGES,
    PARAMETERS,
    PRIMARY,
    SECONDARY,
    Prior,
    Settings,
    free_names,
    is_term,
)
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.threads import one_thread_algebra
from iscat_analysis.trust.systematic import REJECTED_SHARE

FOCUS_STEP_NM = 80.0
"""Step of the search over focus; a quarter of the depth of field at NA 1.2."""


_TURNS = 24  # of half a circle of phases, for strong particles


@dataclass(frozen=True)
class Start:
    """A microscope that resembles the average picture."""

    values: Mapping[str, Any]
    x_nm: float
    y_nm: float
    mass_kda: float
    explained: float


def _quadratures(model: Any, image: ParticleImage) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contrast per mass at reference phases 0 and 90°, and scattered light per squared mass.

    The particle is in the centre.
    """
    pixels = model.pixels(image.grid)
    along, power = np.zeros(image.grid.shape, complex), np.zeros(image.grid.shape)
    for down, high in zip(pixels.offsets, pixels.weights, strict=True):
        for right, wide in zip(pixels.offsets, pixels.weights, strict=True):
            dx, dy = np.meshgrid(pixels.x + right, pixels.y + down)
            field = model.field(dx, dy, image.z_nm, UNIT_KDA) / UNIT_KDA
            along += wide * high * field[0]
            power += wide * high * np.sum(np.abs(field) ** 2, axis=0)
    return 2 * along.real, 2 * along.imag, power


def search_starts(
    averages: Images,
    build: Build,
    candidates: Sequence[Mapping[str, Any]],
    *,
    most: int,
    prior: Prior | None = None,
) -> tuple[Start, ...]:
    """Rank microscopes by what they explain of the average pictures, and how likely they are."""
    pixel, shape = averages[0].grid.pixel_nm, averages[0].grid.shape
    spectra = []
    for average in averages:
        contrast, variance = contrast_of(average)
        spectra.append((fft.rfft2(contrast), float(np.median(variance))))
    reach = math.ceil(FARTHEST_CENTRE_PX / 2)
    here = np.arange(-reach, reach + 1)
    found = []
    for values in candidates:
        gram, overlaps = np.zeros((3, 3)), np.zeros((3, here.size, here.size))
        for average, (spectrum, noise) in zip(averages, spectra, strict=True):
            model = build({**average.seen_with(values), "reference_phase_deg": 0.0})
            pictures = [picture - picture.mean() for picture in _quadratures(model, average)]
            gram += np.einsum("iyx,jyx->ij", pictures, pictures) / noise
            for k, picture in enumerate(pictures):
                match = fft.irfft2(spectrum * np.conj(fft.rfft2(picture)), s=shape)
                overlaps[k] += match[np.ix_(here, here)] / noise
        amplitude, phase, explained = _best_phase(gram, overlaps)
        row, column = np.unravel_index(int(np.argmax(explained)), explained.shape)
        found.append(
            Start(
                {**values, "reference_phase_deg": math.degrees(phase[row, column])},
                x_nm=float(here[column]) * pixel,
                y_nm=float(here[row]) * pixel,
                mass_kda=float(amplitude[row, column]),
                explained=float(explained[row, column]),
            )
        )

    def likely(start: Start) -> float:
        known = ("focus_nm", "reference_phase_deg")
        return start.explained + 2 * (prior.log_density(start.values, known) if prior else 0)

    found.sort(key=likely, reverse=True)
    kept: list[Start] = []
    for start in found:
        near = any(
            abs(start.values["focus_nm"] - other.values["focus_nm"]) < 1.5 * FOCUS_STEP_NM
            and all(start.values.get(k) == other.values.get(k) for k in ("polarization", "mask_na"))
            for other in kept
        )
        if not near:
            kept.append(start)
        if len(kept) == most:
            break
    return tuple(kept)


def _best_phase(
    gram: FloatArray, overlaps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Amplitude, reference phase and explained χ² at every shift, shape of the last axes.

    `gram` and `overlaps` are of the pictures at phases 0 and 90°, and of the scattered light.
    """
    linear = np.einsum("ij,jyx->iyx", np.linalg.pinv(gram[:2, :2]), overlaps[:2])
    explained = np.einsum("iyx,iyx->yx", linear, overlaps[:2])
    amplitude, phase = np.hypot(*linear), np.arctan2(linear[1], linear[0])
    # the scattered light alone is left out where it explains so little
    if amplitude.max() ** 4 * gram[2, 2] < 1e-3 * explained.max():
        return amplitude, phase, explained
    turns = np.concatenate(
        [np.pi * np.arange(_TURNS)[:, None, None] / _TURNS * np.ones_like(phase), phase[None]]
    )
    way = np.stack([np.cos(turns), np.sin(turns)])
    tried, gained = best_amplitudes(
        np.einsum("itab,iab->tab", way, overlaps[:2]),
        overlaps[2],
        np.einsum("itab,ij,jtab->tab", way, gram[:2, :2], way),
        np.einsum("itab,i->tab", way, gram[:2, 2]),
        gram[2, 2],
    )
    best = np.argmax(gained, axis=0)[None]
    tried, turns, gained = (np.take_along_axis(v, best, 0)[0] for v in (tried, turns, gained))
    return np.abs(tried), turns + np.pi * (tried < 0), gained


def same_state(one: Estimate, other: Estimate) -> bool:
    """Tell whether two microscopes have the same polarisation, and both a mask or none."""
    first, second = one.values, other.values
    masks = first["mask_na"] > 0, second["mask_na"] > 0
    return bool(first["polarization"] == second["polarization"] and masks[0] == masks[1])


HELD_OUT = 3
"""One picture in so many is not fitted."""


TWIN_GAP = math.log(1000.0)
"""Log-likelihood by which a twin must be worse to be ruled out: odds of 1000."""


HELD_OUT_P = 1e-3
"""Below this chance the p-values of pictures that were not fitted are not uniform."""


_TRIAL_PASSES = 12  # of a second microscope on all pictures, and of one with fewer aberrations
_HOPELESS = 0.03  # share of the log-likelihood by which a state lags that is given up
_CLOSE = 0.01  # states whose average is explained this much worse are tried on all pictures


@dataclass(frozen=True)
class Judgement:
    """How pictures agree with the microscope."""

    p_values: FloatArray
    chi2_reduced: FloatArray
    uniform_p: float
    left_over: float
    """What it leaves over of them beyond the noise, over the pictures (root mean square)."""

    fitted: bool = False
    """Whether they were fitted with it, because they are few."""

    @property
    def pictures(self) -> str:
        """Say which pictures."""
        return "the fitted pictures" if self.fitted else "pictures that were not fitted"

    @property
    def told(self) -> dict[str, Any]:
        """What files hold of it."""
        p_values, chi2 = self.p_values.tolist(), self.chi2_reduced.tolist()
        return {"p_values": p_values, "chi2_reduced": chi2, "uniform_p": self.uniform_p}

    @property
    def complaint(self) -> str:
        """Say that they do not agree."""
        return (
            f"the p-values of {self.p_values.size} of {self.pictures} are not uniform (p = "
            f"{self.uniform_p:.1g}, mean reduced chi2 = {float(np.mean(self.chi2_reduced)):.3f})"
        )

    @property
    def good(self) -> bool:
        """Whether they agree, or what is left over is too little to matter."""
        return bool(self.uniform_p >= HELD_OUT_P or self.left_over < REJECTED_SHARE)


@dataclass(frozen=True)
class Twin:
    """A second microscope that makes the same pictures."""

    settings: Settings
    gap: float


@dataclass(frozen=True)
class Measured:
    """What the pictures say about the microscope."""

    settings: Settings
    estimate: Estimate
    dropped: tuple[str, ...]
    undecided: tuple[str, ...]
    judgement: Judgement
    configured: Judgement
    twin: Twin | None
    contaminated: int
    refusals: tuple[str, ...]


def judge(images: Images, build: Build, settings: Settings, mapper: Mapper = map) -> Judgement:
    """Judge fitted pictures one by one and all together."""
    from scipy.stats import kstest  # a second to load, for those who learn optics

    def one(image: ParticleImage) -> tuple[float, float]:
        return goodness(image, build(image.seen_with(settings)))

    found = np.array(list(mapper(one, images))).reshape(-1, 2)
    chi2, p_values = found.T
    pixels = np.array([math.prod(image.grid.shape) for image in images])
    power = math.fsum(image.snr**2 for image in images)
    left_over = math.sqrt(max(float(pixels @ (chi2 - 1)), 0.0) / power) if power else math.inf
    return Judgement(p_values, chi2, float(kstest(p_values, "uniform").pvalue), left_over)


def parted(images: Images) -> tuple[Images, Images]:
    """Give the pictures that are fitted, all where they are few, and those that judge the fit."""
    if len(images) < LEAST_IMAGES:
        return list(images), []
    fitted = [image for i, image in enumerate(images) if i % HELD_OUT != 1]
    return fitted, list(images[1::HELD_OUT])


def without_contaminated(
    fitted: Images, held_out: Images, p_values: FloatArray
) -> tuple[Images, Images]:
    """Leave out the few pictures in which something else happened, if the others are fine.

    Shapes: `p_values` (n,), of the pictures that were fitted and then of those that judge.
    """
    # a single picture with a smaller p-value, where most are fine, shows more than one particle
    fine = p_values > 1e-4
    if np.mean(~fine) > 0.25:  # the model's fault
        return list(fitted), list(held_out)
    number = len(fitted)
    return list(compress(fitted, fine[:number])), list(compress(held_out, fine[number:]))


@dataclass
class OpticsSearch:
    """One measurement of the microscope from pictures of particles; its steps in order of `run`.

    Where no microscope is near, the search begins on the average of all pictures, with every focus.
    The pictures are registered on each other, with the sign of each, and averaged; no model takes
    part in that.  For one focus the contrast of a weak particle is linear in the cosine and the
    sine of the reference phase, so that the phase and the amplitude that fit the average best
    follow from a 2 × 2 system at every shift of the picture.  Of a strong particle one sees the
    scattered light itself as well, with the square of the amplitude: the best amplitude is then the
    root of a cubic equation for every phase.
    """

    configured: Settings
    build: Build
    free: Sequence[str]
    """Groups of parameters."""

    limits: Mapping[str, tuple[float, float]]
    prior: Prior
    side: int = 0
    """Sign of the focus, where the configuration tells it."""

    others: Images = ()
    """Particles whose rings are in the pictures."""

    build_wide: Build | None = None
    """Makes microscopes whose pictures reach as far as rings do."""

    known: Settings | None = None
    """A microscope that is near."""

    mapper: Mapper = map

    @one_thread_algebra()
    def run(self, images: Images) -> Measured:
        """Measure the microscope, the brightest pictures first."""
        images = sorted(images, key=lambda image: -image.snr)
        if self.known is None:
            best, held_out = self._best_state(*average_particle_images(images))
        else:
            best, held_out = self._of_known_kind(images, self.known)
        best, held_out = self._cleared(best, held_out)
        before = len(best.images) + len(held_out)
        best, held_out = self._uncontaminated(best, held_out)
        contaminated = before - len(best.images) - len(held_out)
        best, dropped = self._worthwhile(best, held_out)
        best, undecided = self._analyzer(best)
        best, twin = self._twin(best)
        best, held_out = self._cleared(best, held_out)
        best, held_out = self._signed(best, held_out)
        judged = self.fit(held_out or best.images, best.values, ())
        judgement = judge(judged.images, self.build, best.values, self.mapper)
        judgement = replace(judgement, fitted=not held_out)
        again = with_masses(judged.images, self.build, self.configured)
        nominal = self.fit(again, self.configured, ())
        configured = judge(nominal.images, self.build, self.configured, self.mapper)
        # by less the configured optics may be better: the noise of the fitted parameters costs less
        worse = nominal.log_likelihood - judged.log_likelihood > 20.0
        images = (*best.images, *judged.images) if held_out else best.images
        final = self.fit(images, best.values, best.names)
        refusals = self._refusals(final, judgement, twin, worse=worse)
        # with the errors of what is not worth having, too, and what they add to all others
        whole = self.fit(final.images, final.values, (*final.names, *dropped), passes=1)
        return Measured(
            final.values, replace(whole, converged=final.converged), dropped, undecided,
            judgement, configured, twin, contaminated, refusals,
        )  # fmt: skip

    def fit(
        self, images: Images, start: Settings, names: Sequence[str], passes: int = 40
    ) -> Estimate:
        """Fit named parameters of the optics, and what is each picture's own."""
        return maximise(
            images, self.build, start, names,
            prior=self.prior, limits=self.limits, passes=passes, mapper=self.mapper,
        )  # fmt: skip

    def _states(self, averages: Images) -> list[Estimate]:
        """Refine the most promising microscopes on the average pictures, the likeliest first."""
        found = list(self.mapper(lambda state: self._begin(averages, state, 2), self._settings()))
        begun = [start for starts in found for start in starts]
        refined = self._refine(averages, [s for s in begun if self._promising(s, begun)])
        hidden = self._hidden_masks(averages, refined)
        refined += self._refine(averages, hidden, refined) if hidden else []
        return sorted(refined, key=lambda e: -e.log_posterior)

    def _settings(self) -> list[list[dict[str, Any]]]:
        """Give the settings to start from, those of one state together."""
        now = dict(self.configured)
        lights = ["linear", "circular"] if "polarization" in self.free else [now["polarization"]]
        masks: list[list[dict[str, Any]]] = [[{}]]
        if "mask" in self.free:
            # where no attenuation is configured
            dims = now["attenuation"] if now["attenuation"] < 0.9 else 0.3
            edges = sorted({0.35, 0.65, *([now["mask_na"]] if now["mask_na"] else [])})
            masks = [
                [{"mask_na": 0.0, "attenuation": now["attenuation"]}],
                [{"mask_na": edge, "attenuation": dims} for edge in edges],
            ]
        # how far from the configured focus the search goes
        steps = math.ceil(1000.0 / FOCUS_STEP_NM) if "focus" in self.free else 0
        foci = [now["focus_nm"] + FOCUS_STEP_NM * i for i in range(-steps, steps + 1)]
        return [
            [
                {**now, **mask, "polarization": light, "focus_nm": focus}
                for mask in kind
                for focus in foci
            ]
            for light in lights
            for kind in masks
        ]

    def _begin(
        self, averages: Images, candidates: Sequence[Mapping[str, Any]], most: int
    ) -> list[Start]:
        """Choose starts, their linear light turned to the direction that explains most."""
        out = []
        for start in search_starts(averages, self.build, candidates, most=most, prior=self.prior):
            values = start.values
            if "polarization" in self.free and values["polarization"] == "linear":
                first = values["polarization_deg"]
                turns = [{**values, "polarization_deg": first + t} for t in (45.0, 90.0, 135.0)]
                (best,) = search_starts(averages, self.build, turns, most=1)
                start = max(start, best, key=lambda each: each.explained)
            if "phase" not in self.free:  # the configured one is put back
                phase = self.configured["reference_phase_deg"]
                apart = start.values["reference_phase_deg"] - phase
                mass = math.copysign(start.mass_kda, math.cos(math.radians(apart)))
                values = {**start.values, "reference_phase_deg": phase}
                start = replace(start, values=values, mass_kda=mass)
            out.append(start)
        return out

    def _promising(self, start: Start, begun: Sequence[Start]) -> bool:
        """Whether a mask that is not configured explains more than the same light without one."""
        if not start.values["mask_na"] or self.configured["mask_na"]:
            return True
        light = start.values["polarization"]
        plain = [
            other.explained
            for other in begun
            if other.values["polarization"] == light and not other.values["mask_na"]
        ]
        return start.explained > 1.01 * max(plain)  # times what the same light explains without one

    def _refine(
        self, averages: Images, begun: Sequence[Start], known: Sequence[Estimate] = ()
    ) -> list[Estimate]:
        """Fit the averages from every start, and go on with those that lead after a few passes.

        What is behind a known microscope of the same light is left out.
        """

        def fit(images: Images, values: Settings, passes: int) -> Estimate:
            names = free_names(self.free, values, PRIMARY + SECONDARY)
            # gain in log-likelihood that ends a search
            return maximise(
                images, self.build, values, names,
                prior=self.prior, limits=self.limits, tolerance=1.0, passes=passes,
            )  # fmt: skip

        def first(start: Start) -> Estimate:
            x, y, mass = start.x_nm, start.y_nm, start.mass_kda
            there = [replace(one, x_nm=x, y_nm=y, mass_kda=mass) for one in averages]
            return fit(there, start.values, 6)

        def more(found: Estimate) -> Estimate:
            return found if found.converged else fit(found.images, found.values, 10)

        def is_behind(found: Estimate) -> bool:
            light = found.values["polarization"]
            rivals = [other for other in known if other.values["polarization"] == light]
            return any(found.log_posterior < other.log_posterior for other in rivals)

        fits = sorted(self.mapper(first, begun), key=lambda e: -e.log_posterior)
        fits = [found for found in fits if not is_behind(found)]
        leading = [
            found
            for rank, found in enumerate(fits)
            if rank < 2
            or (
                not any(same_state(found, better) for better in fits[:rank])
                and found.log_posterior > (1 - _HOPELESS) * fits[0].log_posterior
            )
        ]
        return list(self.mapper(more, leading))

    def _hidden_masks(self, averages: Images, refined: Sequence[Estimate]) -> list[Start]:
        """Begin with a mask in every refined pupil that has none."""
        if "mask" not in self.free:
            return []
        least = (1 - _HOPELESS) * max(fit.log_posterior for fit in refined)

        def begun(fit: Estimate) -> list[Start]:
            masked = [
                {**fit.values, "mask_na": edge, "attenuation": dim}
                for edge, dim in product((0.35, 0.5, 0.65, 0.8, 1.0), (0.3, 0.75))
                if edge < fit.values["na"] - 0.1
            ]
            return self._begin(averages, masked, 1)

        plain = [f for f in refined if not f.values["mask_na"] and f.log_posterior > least]
        return [start for starts in self.mapper(begun, plain) for start in starts]

    def _worth(self, fit: Estimate, held_out: Images) -> float:
        """Say how well a microscope does, by pictures that were not fitted or by its evidence."""
        if not held_out:
            return fit.log_evidence
        return self.fit(held_out, fit.values, ()).log_likelihood

    def _cleared(self, best: Estimate, held_out: Images) -> tuple[Estimate, Images]:
        """Put the rings of all neighbours into what is expected of every picture."""
        if not self.others or self.build_wide is None:
            return best, tuple(held_out)
        near = Neighbours.fitted(self.others, self.build, self.build_wide, best.values, self.mapper)
        self.others = near.particles  # where they are is known the next time
        among = near.around((*best.images, *held_out), self.mapper)
        fitted, judged = among[: len(best.images)], among[len(best.images) :]
        return self.fit(fitted, best.values, best.names), self._own(judged, best.values)

    def _own(self, images: Images, values: Settings) -> Images:
        """Fit what is an image's own."""
        return self.fit(images, values, ()).images if images else ()

    def _best_state(self, averages: Images, placed: Images) -> tuple[Estimate, Images]:
        """Try every state on the average picture, the best ones on the pictures to be fitted.

        A mask of which the configuration knows nothing must earn its two parameters.
        The pictures that are not fitted come back with their places and masses.
        """
        refined = self._states(averages)
        top = refined[0].log_posterior
        joint: list[tuple[float, Estimate, Images]] = []
        tried: list[Estimate] = []
        for rough in refined:
            far = top - rough.log_posterior > max(_CLOSE * top, 2 * TWIN_GAP)
            if far or any(same_state(rough, other) for other in tried):
                continue
            tried.append(rough)
            x_nm, y_nm = np.median([(a.x_nm, a.y_nm) for a in rough.images], axis=0).tolist()
            moved = [s.placed(s.x_nm + x_nm, s.y_nm + y_nm) for s in placed]
            fitted, judged = parted(with_masses(moved, self.build, rough.values))
            names = free_names(self.free, rough.values, FREE["zernike"])
            fit = self.fit(fitted, rough.values, names, _TRIAL_PASSES)
            new_mask = fit.values["mask_na"] > 0 and not self.configured["mask_na"]
            earned = self._worth(fit, judged) - (TWIN_GAP if new_mask else 0.0)
            joint.append((earned, fit, self._own(judged, fit.values)))
        _, best, held_out = max(joint, key=lambda each: each[0])
        if not best.converged:
            best = self.fit(best.images, best.values, best.names)
        return best, held_out

    def _of_known_kind(self, images: Images, known: Settings) -> tuple[Estimate, Images]:
        """Go on from a microscope that is near."""
        names = free_names(self.free, known, FREE["zernike"])
        fitted, judged = parted(images)
        best = self.fit(fitted, known, names)
        # focus and phase move all heights, those of pictures that were not fitted to other fringes
        rise = np.median([s.z_nm - was.z_nm for s, was in zip(best.images, fitted, strict=True)])
        return best, self._own([s.raised(float(rise)) for s in judged], best.values)

    def _uncontaminated(self, best: Estimate, held_out: Images) -> tuple[Estimate, Images]:
        """Leave out the few pictures in which something else happened, if the others are fine."""
        judged = judge((*best.images, *held_out), self.build, best.values, self.mapper)
        kept, rest = without_contaminated(best.images, held_out, judged.p_values)
        if len(kept) + len(rest) == judged.p_values.size:
            return best, held_out
        return self.fit(kept, best.values, best.names), rest

    def _worthwhile(self, best: Estimate, held_out: Images) -> tuple[Estimate, tuple[str, ...]]:
        """Keep as many aberrations as improve the pictures that were not fitted."""
        terms = tuple(n for n in best.names if is_term(n))
        ladder = [
            tuple(n for n in terms if n in some)
            for some in ((), PRIMARY, PRIMARY + SECONDARY, PRIMARY + SECONDARY + HIGHER)
        ]
        rungs = list(dict.fromkeys([*ladder, terms]))
        tried: list[tuple[float, Estimate]] = []
        for rung in reversed(rungs):  # the most first; fewer than too few are not tried
            names = tuple(n for n in best.names if not is_term(n) or n in rung)
            start = {**best.values, **{n: 0.0 for n in terms if n not in rung}}
            fit = best if rung == terms else self.fit(best.images, start, names, _TRIAL_PASSES)
            tried.append((self._worth(fit, held_out), fit))
            # log-likelihood that fewer aberrations lose where still fewer cannot be better
            if tried[-1][0] < tried[0][0] - 20.0:
                break
        _, chosen = max(tried, key=lambda pair: pair[0])
        return chosen, tuple(n for n in terms if n not in chosen.names)

    def _analyzer(self, best: Estimate) -> tuple[Estimate, tuple[str, ...]]:
        """Ask whether there is an analyser, which only strong particles tell."""
        if "polarization" not in self.free:
            return best, ()
        was = bool(best.values["analyzer"])
        other = self.fit(best.images, {**best.values, "analyzer": not was}, best.names, passes=8)
        gap = best.log_posterior - other.log_posterior
        if abs(gap) < TWIN_GAP:
            return best, ("analyzer",)
        return (best if gap > 0 else other), ()

    def _twin(self, best: Estimate) -> tuple[Estimate, Twin | None]:
        """Look for the microscope on the other side of focus that makes the same pictures."""
        if not {"focus_nm", "reference_phase_deg"} <= set(best.names):
            return best, None
        z = best.images[0].z_nm
        mirrored = dict(best.values)
        mirrored |= {n: PARAMETERS[n].mirrored * best.values[n] for n in best.names}
        mirrored["focus_nm"] = 2 * z - best.values["focus_nm"]
        turned = [replace(s, mass_kda=-s.mass_kda) for s in best.images]
        # after which a twin is far nearer than _CLOSE
        other = self.fit(turned, mirrored, best.names, 4)
        if best.log_likelihood - other.log_likelihood > _CLOSE * best.log_likelihood:
            return best, None
        other = self.fit(other.images, other.values, best.names, _TRIAL_PASSES)
        other, _ = self._cleared(other, ())  # each among the rings that it makes itself
        gap = best.log_likelihood - other.log_likelihood
        apart = abs(other.values["focus_nm"] - best.values["focus_nm"])
        if abs(gap) >= TWIN_GAP or apart < 1.0:
            return (best if gap > -TWIN_GAP else other), None
        wanted = self.side or (1 if self.configured["focus_nm"] > 0 else -1)
        if (other.values["focus_nm"] > 0) == (wanted > 0) != (best.values["focus_nm"] > 0):
            best, other, gap = other, best, -gap
        return best, Twin(other.values, gap)

    def _signed(self, best: Estimate, held_out: Images) -> tuple[Estimate, Images]:
        """Choose between a phase and its opposite, which a particle that leaves has."""
        if "reference_phase_deg" not in best.names:
            return best, tuple(held_out)
        masses = np.array([s.mass_kda for s in best.images])
        phase = best.values["reference_phase_deg"]
        if abs(np.sign(masses).sum()) > 3 * math.sqrt(masses.size):  # nearly all of them land
            flip = np.sign(masses).sum() < 0
        else:
            flip = math.cos(math.radians(phase - self.configured["reference_phase_deg"])) < 0
        phase = (phase + 180 * flip + 180) % 360 - 180
        # those that were not fitted too: with its height free a strong one does not turn by itself
        turned, judged = (
            tuple(replace(s, mass_kda=-s.mass_kda if flip else s.mass_kda) for s in images)
            for images in (best.images, held_out)
        )
        values = {**best.values, "reference_phase_deg": phase}
        return replace(best, values=values, images=turned), judged

    def _refusals(
        self, final: Estimate, judgement: Judgement, twin: Twin | None, *, worse: bool
    ) -> tuple[str, ...]:
        """Say why the microscope may not be used."""
        checks = (
            (not final.names, "the pictures determine none of the parameters"),
            (not final.converged, "the search did not converge"),
            *(
                (
                    final.values[n] in self.limits.get(n, ()),
                    f"{n} = {final.values[n]:g} lies at its limit",
                )
                for n in final.names
            ),
            (not judgement.good, judgement.complaint),
            (worse, "the configured optics describe pictures that were not fitted better"),
            (
                twin is not None and not self.side,
                "a focus on the other side explains the pictures as well, and optics.focus_nm does "
                "not say which side it is",
            ),
        )
        return tuple(reason for applies, reason in checks if applies)
