"""From pictures of particles to the microscope that made them, and a verdict on it.

What is known before is a prior around the configured values, and any number of pictures adds what
it tells.  Two thirds of the pictures are fitted and a third decides: how many aberrations are worth
having, and whether the result describes pictures that it has not seen.  Where there are too few for
that, the evidence decides, the likelihood averaged over the prior, and the fitted pictures judge.
What they do not tell keeps the width of the prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.instrument.joint_fit import Estimate, Neighbours, maximise
from iscat_analysis.instrument.microscope import goodness
from iscat_analysis.instrument.particle_image import (
    Build,
    ParticleImage,
    average_particle_images,
    with_masses,
)
from iscat_analysis.instrument.starts import StateSearch, same_state
from iscat_analysis.optics.forward import ForwardModel
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

HELD_OUT = 3
"""One picture in so many is not fitted."""

TWIN_GAP = math.log(1000.0)
"""Log-likelihood by which a twin must be worse to be ruled out: odds of 1000."""

WORSE_GAP = 20.0
"""Log-likelihood by which the configured optics may describe pictures that were not fitted better:
the noise of the fitted parameters costs less."""

HELD_OUT_P = 1e-3
"""Below this chance the p-values of pictures that were not fitted are not uniform."""

CONTAMINATED_P = 1e-4
"""A single picture with a smaller p-value, where most are fine, shows more than one particle."""

_PLACE = ("x_nm", "y_nm")
_RUNG_PASSES = 12
_TOO_FEW = 20.0  # log-likelihood that fewer aberrations lose where still fewer cannot be better
_CONTAMINATED_SHARE = 0.25  # more than this is the model's fault
_TRIAL_PASSES = 12  # of a second microscope on all pictures
_TWIN_PASSES = 4  # after which a twin is far nearer than _CLOSE
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
    held_out: tuple[ParticleImage, ...]
    twin: Twin | None
    contaminated: int
    refusals: tuple[str, ...]


def judge(
    images: Sequence[ParticleImage],
    build: Callable[[Settings], ForwardModel],
    settings: Settings,
    mapper: Mapper = map,
) -> Judgement:
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


def _fitted(images: Sequence[ParticleImage]) -> list[ParticleImage]:
    """Give the pictures that are fitted: all where they are few."""
    few = len(images) < LEAST_IMAGES
    return [image for i, image in enumerate(images) if few or i % HELD_OUT != 1]


def _held_out(images: Sequence[ParticleImage]) -> list[ParticleImage]:
    """Give the pictures that are not."""
    return list(images[1::HELD_OUT]) if len(images) >= LEAST_IMAGES else []


@dataclass
class OpticsSearch:
    """One measurement of the microscope from pictures of particles; its steps in order of `run`."""

    configured: Settings
    build: Callable[[Settings], ForwardModel]
    free: Sequence[str]
    """Groups of parameters."""

    limits: Mapping[str, tuple[float, float]]
    prior: Prior
    side: int = 0
    """Sign of the focus, where the configuration tells it."""

    others: Sequence[ParticleImage] = ()
    """Particles whose rings are in the pictures."""

    build_wide: Build | None = None
    """Makes microscopes whose pictures reach as far as rings do."""

    known: Settings | None = None
    """A microscope that is near."""

    mapper: Mapper = map

    @one_thread_algebra()
    def run(self, images: Sequence[ParticleImage]) -> Measured:
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
        judged = self._fit(held_out or best.images, best.values, ())
        judgement = judge(judged.images, self.build, best.values, self.mapper)
        judgement = replace(judgement, fitted=not held_out)
        nominal = self._fit(
            with_masses(judged.images, self.build, self.configured), self.configured, ()
        )
        configured = judge(nominal.images, self.build, self.configured, self.mapper)
        worse = nominal.log_likelihood - judged.log_likelihood > WORSE_GAP
        images = (*best.images, *judged.images) if held_out else best.images
        final = self._fit(images, best.values, best.names)
        refusals = self._refusals(final, judgement, twin, worse=worse)
        return Measured(
            settings=final.values, estimate=self._with_dropped(final, dropped), dropped=dropped,
            undecided=undecided, judgement=judgement, configured=configured,
            held_out=judged.images, twin=twin, contaminated=contaminated, refusals=refusals,
        )  # fmt: skip

    def _with_dropped(self, final: Estimate, dropped: Sequence[str]) -> Estimate:
        """Give the errors of what is not worth having, too, and what they add to all others."""
        names = (*final.names, *dropped)
        whole = self._fit(final.images, final.values, names, passes=1)
        return replace(whole, converged=final.converged)

    def _fit(
        self,
        images: Sequence[ParticleImage],
        start: Settings,
        names: Sequence[str],
        passes: int = 40,
    ) -> Estimate:
        return maximise(
            images, self.build, start, names,
            prior=self.prior, limits=self.limits, passes=passes, mapper=self.mapper,
        )  # fmt: skip

    def _worth(self, fit: Estimate, held_out: Sequence[ParticleImage]) -> float:
        """Say how well a microscope does, by pictures that were not fitted or by its evidence."""
        if not held_out:
            return fit.log_evidence
        return self._fit(held_out, fit.values, ()).log_likelihood

    def _cleared(
        self, best: Estimate, held_out: Sequence[ParticleImage]
    ) -> tuple[Estimate, tuple[ParticleImage, ...]]:
        """Put the rings of all neighbours into what is expected of every picture."""
        if not self.others or self.build_wide is None:
            return best, tuple(held_out)
        near = Neighbours.fitted(self.others, self.build, self.build_wide, best.values, self.mapper)
        self.others = near.particles  # where they are is known the next time
        among = near.around((*best.images, *held_out), self.mapper)
        fitted, judged = among[: len(best.images)], among[len(best.images) :]
        return self._fit(fitted, best.values, best.names), self._own(judged, best.values)

    def _own(
        self, images: Sequence[ParticleImage], settings: Settings
    ) -> tuple[ParticleImage, ...]:
        """Fit what is an image's own."""
        return self._fit(images, settings, ()).images if images else ()

    def _best_state(
        self, averages: Sequence[ParticleImage], placed: Sequence[ParticleImage]
    ) -> tuple[Estimate, tuple[ParticleImage, ...]]:
        """Try every state on the average picture, the best ones on the pictures to be fitted.

        A mask of which the configuration knows nothing must earn its two parameters.
        The pictures that are not fitted come back with their places and masses.
        """
        states = StateSearch(
            self.configured, self.build, tuple(self.free), self.limits, self.prior, self.mapper
        )
        refined = states.run(averages)
        top = refined[0].log_posterior
        joint: list[tuple[float, Estimate, tuple[ParticleImage, ...]]] = []
        tried: list[Estimate] = []
        for rough in refined:
            far = top - rough.log_posterior > max(_CLOSE * top, 2 * TWIN_GAP)
            if far or any(same_state(rough, other) for other in tried):
                continue
            x_nm, y_nm = (np.median([getattr(a, k) for a in rough.images]) for k in _PLACE)
            images = with_masses(
                [s.placed(s.x_nm + float(x_nm), s.y_nm + float(y_nm)) for s in placed],
                self.build,
                rough.values,
            )
            names = free_names(self.free, rough.values, FREE["zernike"])
            tried.append(rough)
            fit = self._fit(_fitted(images), rough.values, names, _TRIAL_PASSES)
            judged = _held_out(images)
            new_mask = fit.values["mask_na"] > 0 and not self.configured["mask_na"]
            earned = self._worth(fit, judged) - (TWIN_GAP if new_mask else 0.0)
            joint.append((earned, fit, self._own(judged, fit.values)))
        _, best, held_out = max(joint, key=lambda each: each[0])
        if not best.converged:
            best = self._fit(best.images, best.values, best.names)
        return best, held_out

    def _of_known_kind(
        self, images: Sequence[ParticleImage], known: Settings
    ) -> tuple[Estimate, tuple[ParticleImage, ...]]:
        """Go on from a microscope that is near."""
        names = free_names(self.free, known, FREE["zernike"])
        fitted = _fitted(images)
        best = self._fit(fitted, known, names)
        # focus and phase move all heights, those of pictures that were not fitted to other fringes
        rise = np.median([s.z_nm - was.z_nm for s, was in zip(best.images, fitted, strict=True)])
        held_out = [s.raised(float(rise)) for s in _held_out(images)]
        return best, self._own(held_out, best.values)

    def _uncontaminated(
        self, best: Estimate, held_out: Sequence[ParticleImage]
    ) -> tuple[Estimate, tuple[ParticleImage, ...]]:
        """Leave out the few pictures in which something else happened, if the others are fine."""
        whole = (*best.images, *held_out)
        fine = judge(whole, self.build, best.values, self.mapper).p_values > CONTAMINATED_P
        good = fine[: len(best.images)], fine[len(best.images) :]
        bad = int(np.sum(~fine))
        if not bad or bad > _CONTAMINATED_SHARE * len(whole):
            return best, tuple(held_out)
        kept = [s for s, ok in zip(best.images, good[0], strict=True) if ok]
        rest = tuple(s for s, ok in zip(held_out, good[1], strict=True) if ok)
        return self._fit(kept, best.values, best.names), rest

    def _worthwhile(
        self, best: Estimate, held_out: Sequence[ParticleImage]
    ) -> tuple[Estimate, tuple[str, ...]]:
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
            fit = best if rung == terms else self._fit(best.images, start, names, _RUNG_PASSES)
            tried.append((self._worth(fit, held_out), fit))
            if tried[-1][0] < tried[0][0] - _TOO_FEW:
                break
        _, chosen = max(tried, key=lambda pair: pair[0])
        return chosen, tuple(n for n in terms if n not in chosen.names)

    def _analyzer(self, best: Estimate) -> tuple[Estimate, tuple[str, ...]]:
        """Ask whether there is an analyser, which only strong particles tell."""
        if "polarization" not in self.free:
            return best, ()
        was = bool(best.values["analyzer"])
        other = self._fit(best.images, {**best.values, "analyzer": not was}, best.names, passes=8)
        gap = best.log_posterior - other.log_posterior
        if abs(gap) < TWIN_GAP:
            return best, ("analyzer",)
        return (best if gap > 0 else other), ()

    def _twin(self, best: Estimate) -> tuple[Estimate, Twin | None]:
        """Look for the microscope on the other side of focus that makes the same pictures."""
        if not {"focus_nm", "reference_phase_deg"} <= set(best.names):
            return best, None
        z = best.images[0].z_nm
        mirrored = {
            **best.values,
            **{n: PARAMETERS[n].mirrored * best.values[n] for n in best.names},
        }
        mirrored["focus_nm"] = 2 * z - best.values["focus_nm"]
        turned = [replace(s, mass_kda=-s.mass_kda) for s in best.images]
        other = self._fit(turned, mirrored, best.names, _TWIN_PASSES)
        if best.log_likelihood - other.log_likelihood > _CLOSE * best.log_likelihood:
            return best, None
        other = self._fit(other.images, other.values, best.names, _TRIAL_PASSES)
        other, _ = self._cleared(other, ())  # each among the rings that it makes itself
        gap = best.log_likelihood - other.log_likelihood
        apart = abs(other.values["focus_nm"] - best.values["focus_nm"])
        if abs(gap) >= TWIN_GAP or apart < 1.0:
            return (best if gap > -TWIN_GAP else other), None
        wanted = self.side or (1 if self.configured["focus_nm"] > 0 else -1)
        if (other.values["focus_nm"] > 0) == (wanted > 0) != (best.values["focus_nm"] > 0):
            best, other, gap = other, best, -gap
        return best, Twin(other.values, gap)

    def _signed(
        self, best: Estimate, held_out: Sequence[ParticleImage]
    ) -> tuple[Estimate, tuple[ParticleImage, ...]]:
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
        reasons = []
        if not final.names:
            reasons.append("the pictures determine none of the parameters")
        if not final.converged:
            reasons.append("the search did not converge")
        for name in final.names:
            low, high = self.limits.get(name, (-math.inf, math.inf))
            if final.values[name] in (low, high):
                reasons.append(f"{name} = {final.values[name]:g} lies at its limit")
        if not judgement.good:
            reasons.append(
                f"the p-values of {judgement.p_values.size} of {judgement.pictures} are not "
                f"uniform (p = {judgement.uniform_p:.1g}, mean reduced chi2 = "
                f"{float(np.mean(judgement.chi2_reduced)):.3f})"
            )
        if worse:
            reasons.append("the configured optics describe pictures that were not fitted better")
        if twin is not None and not self.side:
            reasons.append(
                "a focus on the other side explains the pictures as well, and optics.focus_nm does "
                "not say which side it is"
            )
        return tuple(reasons)
