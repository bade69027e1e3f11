"""One sphere in many frames: its diameter, and perhaps its refractive index, from all of them.

Every frame f has a place r_f = (x, y, z) of its own, and all frames have c in common: the mass m,
which stands for the diameter, or m and the index n.  With the score and the expected information of
each frame, the places are eliminated,

    I_f = F_cc − F_cr F_rr⁻¹ F_rc,      u_f = s_c − F_cr F_rr⁻¹ s_r,

and a scoring step is Δc = (Σ I_f)⁻¹ Σ u_f, Δr_f = F_rr⁻¹ (s_r − F_rc Δc).  The covariance of c is
(Σ I_f)⁻¹.  Places that are fitted follow the noise of their frame, so that c has a bias which more
frames do not reduce: to first order (D. R. Cox and E. J. Snell, J. R. Stat. Soc. B 30, 248, 1968)

    b = −½ (Σ I_f)⁻¹ Σ_f Σ_pixels w e tr(F_rr⁻¹ ∂²s/∂r²),      e = ∂s/∂c − F_cr F_rr⁻¹ ∂s/∂r,

with the information w of a pixel about its signal s.  Several diameters may have maxima of the
likelihood; frames at different heights exclude all but one sooner than a single frame does.

A faint frame may leave several heights, a fringe apart.  It then has a place r_fb for each, and the
likelihood L_f = Σ_b L_fb.  With the shares p_b = L_fb/L_f, its score is u_f = Σ p_b u_fb, and its
information (T. A. Louis, J. R. Stat. Soc. B 44, 226, 1982)

    I_f = Σ_b p_b I_fb − Σ_b p_b u_fb u_fbᵀ + u_f u_fᵀ.

The likeliest height alone would follow the noise: of 24 vesicles of 200 nm in twelve faint frames,
it gave one the diameter 76 nm, and the others pulls 1.5 wide.

Diameter and refractive index of a sphere from one picture.

A small sphere scatters with d³ (n − n_s), and its picture tells that product and neither factor.  A
larger one changes its picture in another way with d than with n.  What a picture tells is in the
information about ln d and ln (n − n_s), with the place eliminated: the eigenvector (q, 1) of its
larger eigenvalue is the combination d^q (n − n_s).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.hessian import PAIRS
from iscat_analysis._kernels.scoring import LARGEST_GAIN_RATIO
from iscat_analysis.inference.fit import AMPLITUDE, FOLLOWED, fit_particle
from iscat_analysis.inference.laws import PixelTerms
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.maximiser import Optimum, covariance_of, maximise
from iscat_analysis.inference.models import ParticleModel, SphereOfIndex
from iscat_analysis.inference.sizes import (
    AMBIGUITY_ODDS,
    OTHER_SIZE,
    highest_maxima,
    scan_sizes,
    scanned_heights,
    scanned_masses,
)
from iscat_analysis.optics.sized import SizedModel
from iscat_analysis.records import BoolArray, Box, Candidate, FitResult, FloatArray, Status, verdict

IntArray = NDArray[np.int64]

UNDETERMINED = 0.5
"""Error of n − n_s, over its size, from which the index is not told."""


@dataclass(frozen=True)
class CommonSize:
    """One maximum of the likelihood of all frames: of mass, index and every place."""

    mass_kda: float
    index: float
    likely: FloatArray
    """x, y and z of every likely place in a frame [nm], perhaps the level, (n, 3) or (n, 4)."""

    frames: IntArray
    """Number of the frame of each, shape (n,)."""

    places: FloatArray
    """The likeliest in each frame, shape (frames, 3), or (frames, 4) with the level."""

    log_likelihood: float
    log_weight: float
    """Logarithm of the posterior weight: likelihood times volume, flat in the diameter."""

    information: FloatArray
    """Of each frame about (m) or (m, n), shape (frames, k, k)."""

    prior: FloatArray
    """Information of the motion about the same, shape (k, k)."""

    bias: FloatArray
    """Of (m) or (m, n); the estimates still have it."""

    converged: bool

    def covariance(
        self, correlation: FloatArray | None = None, *, excess: float = 1.0
    ) -> FloatArray:
        """Covariance of (m) or (m, n).

        Frames that share a measured background share its noise: `correlation` (frames, frames).
        `excess` is the variance of the estimates from images over that of counting.
        """
        inverse = np.linalg.inv(self.information.sum(axis=0) + self.prior)
        if correlation is None:
            correlation = np.eye(len(self.information))
        sizes, axes = np.linalg.eigh(self.information)
        roots = axes * np.sqrt(np.maximum(sizes, 0.0))[:, None] @ np.swapaxes(axes, 1, 2)
        spread = np.einsum("fac,fg,gbc->ab", roots, correlation, roots)
        return np.asarray(inverse @ (excess * spread + self.prior) @ inverse)


@dataclass(frozen=True)
class SphereFrames:
    """Frames of one sphere, with the model of its images and the heights that it may have."""

    likelihoods: Sequence[Likelihood]
    model: SizedModel
    z_range_nm: tuple[float, float]

    def common_sizes(self, places: FloatArray) -> list[CommonSize]:
        """Fit one diameter to all frames: every maximum that is likely, the best first.

        Shapes: `places` (frames, 3), where each frame was fitted alone.
        """
        masses = scanned_masses(self.model, *self.model.mass_range_kda)
        heights = scanned_heights(self.model, *self.z_range_nm)
        scans = np.array(
            [
                scan_sizes(likelihood, self.model, np.array([*place, 0.0, 0.0]), masses, heights)
                for likelihood, place in zip(self.likelihoods, places, strict=True)
            ]
        )
        found: list[CommonSize] = []
        for (k,) in highest_maxima(scans.max(axis=2).sum(axis=0), 4):
            starts = [
                (f, [*places[f, :2], heights[at]])
                for f, scan in enumerate(scans[:, k])
                for (at,) in highest_maxima(scan, 3)
            ]
            frames, rows = (np.array(each) for each in zip(*starts, strict=True))
            best = max((one.log_likelihood for one in found if one.converged), default=-math.inf)
            mass = float(masses[k])
            one = self.fit(rows, frames=frames, mass_kda=mass, least=best - FOLLOWED)
            if one is not None and not any(
                abs(one.mass_kda / other.mass_kda - 1) < 1e-3 for other in found
            ):
                found.append(one)
        return sorted(found, key=lambda one: -one.log_likelihood)

    def fit(
        self,
        places: FloatArray,
        *,
        mass_kda: float,
        index: float | None = None,
        frames: IntArray | None = None,
        motion: tuple[float, float] | None = None,
        least: float = -math.inf,
    ) -> CommonSize | None:
        """Fit mass and places of all frames, from a start; the index too where one is given.

        None where the start has no likelihood, as where light would be negative.

        `frames` has the number of the frame of each place; without, every frame has one.  `motion`
        is 1/d of the hydrodynamic diameter and its error [1/nm], a prior that is normal in D.  A
        level that is given beside the places is fitted as they are.

        Shapes: `places` (n, 3) or (n, 4), `frames` (n,).
        """
        common = np.array([mass_kda] if index is None else [mass_kda, index])
        rows = places.copy()
        owners = np.arange(len(self.likelihoods)) if frames is None else frames
        rows[:, 2] = np.clip(rows[:, 2], *self.z_range_nm)
        joint = _Joint(self, motion, common.size)
        converged = False
        while True:
            here = joint.gathered(rows, owners, common)
            if not math.isfinite(here.value):
                return None
            # Share of a fringe by which two heights of a frame differ at least
            kept = _still_likely(here, rows, owners, (1 / 8) * self.model.fringe_nm)
            if kept.all() and converged:
                break
            rows, owners = rows[kept], owners[kept]
            found = joint.maximised(rows, owners, common, least)
            rows = found.theta[common.size :].reshape(rows.shape)
            common = found.theta[: common.size]
            converged = found.converged
            if not converged:
                here = joint.gathered(rows, owners, common)
                break
        return CommonSize(
            mass_kda=float(common[0]),
            index=float(common[1]) if index is not None else self.model.sphere.index.real,
            likely=rows,
            frames=owners,
            places=rows[_best_of_each(here.values, owners)],
            log_likelihood=here.value,
            log_weight=_log_weight(here, owners),
            information=here.information,
            prior=here.prior,
            bias=_bias(joint, rows, owners, common, here),
            converged=converged,
        )


class _Frames(NamedTuple):
    """Value, and scores and information of every frame with the places eliminated."""

    value: float
    pull: FloatArray  # of c, of all frames and the prior
    known: FloatArray  # the same of the information that a step takes, Σ p I
    information: FloatArray  # of each frame
    prior: FloatArray  # information of the motion
    values: FloatArray  # of each place, and so are the following
    shares: FloatArray
    place_score: FloatArray
    place_inverse: FloatArray
    mixed: FloatArray  # F_rc
    scale: float  # diameter over 3 m


@dataclass(frozen=True)
class _Joint:
    """The likelihood of all frames, of `count` common parameters."""

    of: SphereFrames
    motion: tuple[float, float] | None
    count: int

    @property
    def particle(self) -> ParticleModel:
        """Sphere of a known index, or of one that is fitted."""
        return self.of.model if self.count == 1 else SphereOfIndex(self.of.model)

    def maximised(
        self, rows: FloatArray, owners: IntArray, common: FloatArray, least: float
    ) -> Optimum:
        """Maximise over c and all places, of which θ consists in this order."""
        k, shape = self.count, rows.shape
        last, shorter = np.zeros(shape), np.ones(len(rows))

        def gathered(theta: FloatArray) -> tuple[float, FloatArray, _Frames]:
            here = self.gathered(theta[k:].reshape(shape), owners, theta[:k])
            places = here.shares[:, None] * here.place_score
            raw = here.pull + np.einsum("bik,bij,bj->k", here.mixed, here.place_inverse, places)
            return here.value, np.concatenate([raw, places.ravel()]), here

        def step_of(
            _score: FloatArray, here: _Frames, _active: BoolArray, damping: float
        ) -> FloatArray | None:
            """Eliminate the places; those that step to and fro take shorter steps."""
            nonlocal last, shorter
            try:
                step = np.linalg.solve(here.known, here.pull)
            except np.linalg.LinAlgError:
                return None
            left = here.place_score - here.mixed @ step
            moves = np.einsum("bij,bj->bi", here.place_inverse, left)
            if not damping:
                # the next step goes back by more than half of the last, where both go too far
                back = -np.sum(moves * last, axis=1) > 0.5 * np.sum(last**2, axis=1)
                last, shorter = moves, np.where(back, shorter / 2, shorter)
            far = np.abs(moves).max(axis=1) / (0.1 * self.of.model.optics.wavelength_nm)
            moves = moves * (shorter / np.maximum(far, 1.0))[:, None]
            whole = np.concatenate([step, moves.ravel()])
            # a damped step is shorter: half of it at first
            return np.asarray(whole / (1 + 1e3 * damping), dtype=np.float64)

        def farthest(theta: FloatArray) -> FloatArray:
            out = np.full(theta.size, math.inf)
            # largest relative change of the mass in a step, and of n − n_s
            out[:k] = 0.2 * np.abs(theta[:k] - [0.0, self.of.model.optics.n_sample][:k])
            return out

        lower, upper = np.full((2, k + rows.size), math.inf) * [[-1], [1]]
        lower[k:].reshape(shape)[:, 2], upper[k:].reshape(shape)[:, 2] = self.of.z_range_nm
        box = Box(np.ones(lower.size, dtype=bool), lower, upper)
        start = np.concatenate([common, rows.ravel()])
        return maximise(gathered, start, box, farthest, least=least, step_of=step_of)

    def gathered(self, rows: FloatArray, owners: IntArray, common: FloatArray) -> _Frames:
        """Compute value, scores and information of all frames."""
        (n, p), k = rows.shape, self.count
        values, scores, pulls = np.full(n, -math.inf), np.zeros((n, p)), np.zeros((n, k))
        known, inverse, mixed = np.zeros((n, k, k)), np.zeros((n, p, p)), np.zeros((n, p, k))
        mass = float(common[0])
        for b, (place, f) in enumerate(zip(rows, owners, strict=True)):
            terms, slopes = self.terms(self.of.likelihoods[f], place, common)
            if not math.isfinite(terms.value):
                continue
            flat = slopes.reshape(p + k, -1)
            score = flat @ terms.score.ravel()
            fisher = (flat * terms.information.ravel()) @ flat.T
            z, down = place[2], score[2] < 0
            free = np.ones(p, dtype=bool)
            free[2] = not (z <= self.of.z_range_nm[0] if down else z >= self.of.z_range_nm[1])
            inside = np.ix_(free, free)
            inverse[b][inside] = np.linalg.inv(fisher[:p, :p][inside])
            values[b], scores[b], mixed[b] = terms.value, score[:p], fisher[:p, p:]
            known[b] = fisher[p:, p:] - mixed[b].T @ inverse[b] @ mixed[b]
            pulls[b] = score[p:] - mixed[b].T @ inverse[b] @ score[:p]
        value, shares = _shared(values, owners, len(self.of.likelihoods))
        pull, prior = shares @ pulls, np.zeros((k, k))
        diameter = self.of.model.sphere.of_mass(mass).diameter_nm
        if self.motion is not None:
            off, slope = 1 / diameter - self.motion[0], -1 / (3 * mass * diameter)
            value -= 0.5 * (off / self.motion[1]) ** 2
            pull[0] -= off * slope / self.motion[1] ** 2
            prior[0, 0] = (slope / self.motion[1]) ** 2
        information = _of_frames(known, pulls, shares, owners, len(self.of.likelihoods))
        expected = np.tensordot(shares, known, axes=1) + prior
        return _Frames(
            value, pull, expected, information, prior, values, shares, scores, inverse, mixed,
            diameter / (3 * mass),
        )  # fmt: skip

    def terms(
        self, likelihood: Likelihood, place: FloatArray, common: FloatArray
    ) -> tuple[PixelTerms, FloatArray]:
        """Terms of the likelihood of a frame, and the slopes of its signal in places and c.

        Shapes: `place` (p,), `common` (k,), slopes (p + k, ny, nx).
        """
        signal, slopes = self.particle.signal(likelihood.grid, [*place[:3], *common])
        level = float(place[3]) if place.size > 3 else 0.0
        terms = likelihood.noise.terms(likelihood.data, signal, level)
        return terms, np.insert(slopes, 3, terms.by_level, axis=0) if place.size > 3 else slopes


def _shared(values: FloatArray, owners: IntArray, frames: int) -> tuple[float, FloatArray]:
    """Sum the likelihoods of the places of each frame; give all frames' logarithm, and the shares.

    Shapes: `values, owners` (n,), shares (n,).
    """
    highest = np.full(frames, -math.inf)
    np.maximum.at(highest, owners, values)
    if not np.isfinite(highest).all():
        return -math.inf, np.zeros(values.size)
    raised = np.exp(values - highest[owners])
    sums = np.bincount(owners, raised, frames)
    return float(np.sum(highest + np.log(sums))), raised / sums[owners]


def _of_frames(
    known: FloatArray, pulls: FloatArray, shares: FloatArray, owners: IntArray, frames: int
) -> FloatArray:
    """Give the information of each frame, by Louis, as far as it is positive.

    Shapes: `known` (n, k, k), `pulls` (n, k), `shares, owners` (n,), result (frames, k, k).
    """
    k = pulls.shape[1]
    expected, spread, mean = (np.zeros((frames, *shape)) for shape in ((k, k), (k, k), (k,)))
    np.add.at(expected, owners, shares[:, None, None] * known)
    if len(owners) == frames:
        return expected
    np.add.at(spread, owners, shares[:, None, None] * pulls[:, :, None] * pulls[:, None, :])
    np.add.at(mean, owners, shares[:, None] * pulls)
    sizes, axes = np.linalg.eigh(expected - spread + mean[:, :, None] * mean[:, None, :])
    positive = axes * np.maximum(sizes, 0.0)[:, None] @ np.swapaxes(axes, 1, 2)
    # a frame of several heights tells a millionth of what one height would, at least
    return np.asarray(positive + 1e-6 * expected)


def _still_likely(
    here: _Frames, places: FloatArray, owners: IntArray, apart_nm: float
) -> NDArray[np.bool_]:
    """Tell which places are likely, or may become so, and not at the height of a better one.

    Shapes: `places` (n, 3), `owners` (n,), result (n,).
    """
    gain = 0.5 * np.einsum("bi,bij,bj->b", here.place_score, here.place_inverse, here.place_score)
    best = here.values[_best_of_each(here.values, owners)][owners]
    kept = here.values + LARGEST_GAIN_RATIO * gain >= best - FOLLOWED
    for b in np.flatnonzero(kept):
        rivals = kept & (owners == owners[b]) & (np.abs(places[:, 2] - places[b, 2]) < apart_nm)
        kept[b] = b == np.flatnonzero(rivals)[np.argmax(here.values[rivals])]
    return np.asarray(kept)


def _best_of_each(values: FloatArray, owners: IntArray) -> IntArray:
    """Give the row of the likeliest place of each frame, shape (frames,)."""
    order = np.lexsort((-values, owners))
    return np.asarray(order[np.unique(owners[order], return_index=True)[1]])


def _log_weight(here: _Frames, owners: IntArray) -> float:
    """Logarithm of likelihood times volume of the posterior, in places and diameter."""
    volumes = [
        0.5 * float(np.linalg.slogdet(2 * math.pi * inverse[np.ix_(free, free)])[1])
        for inverse in here.place_inverse
        for free in [np.diag(inverse) > 0]
    ]
    frames = len(here.information)
    alone, _ = _shared(here.values, owners, frames)
    whole, _ = _shared(here.values + np.array(volumes), owners, frames)
    spread = np.linalg.inv(here.information.sum(axis=0) + here.prior)
    volume = 0.5 * float(np.linalg.slogdet(2 * math.pi * spread)[1])
    return here.value - alone + whole + volume + math.log(here.scale)


def _bias(
    joint: _Joint, rows: FloatArray, owners: IntArray, common: FloatArray, here: _Frames
) -> FloatArray:
    """Bias of c that places which follow the noise of their frame make."""
    total = np.zeros(common.size)
    mass = float(common[0])
    model = joint.of.model
    linear = model if common.size == 1 else model.of_index(float(common[1]))
    for b, (place, f) in enumerate(zip(rows, owners, strict=True)):
        likelihood = joint.of.likelihoods[f]
        terms, slopes = joint.terms(likelihood, place, common)
        bends = linear.at(mass).derivative_rows(likelihood.grid, np.array([*place[:3], mass]))
        inverse, p = here.place_inverse[b], place.size
        traced = sum(
            (1 if i == j else 2) * inverse[i, j] * bends[:, 5 + pair]
            for pair, (i, j) in enumerate(PAIRS)
            if j < 3
        )
        along = slopes[p:] - np.einsum("ic,i...->c...", inverse @ here.mixed[b], slopes[:p])
        total += np.tensordot(along, here.shares[b] * terms.information * traced, axes=2)
    known = here.information.sum(axis=0) + here.prior
    return np.asarray(-0.5 * np.linalg.solve(known, total))


INDEX = 4
"""Where the index stands in θ, before the level."""


class IndexFit(NamedTuple):
    """A sphere whose index was fitted as well, and what its picture tells."""

    likelihood: Likelihood
    fit: FitResult
    power: float
    """q of d^q (n − n_s)."""

    sigma: float
    """Relative standard error of that."""

    @property
    def is_told(self) -> bool:
        """Whether the picture tells diameter and index apart."""
        return math.isfinite(self.fit.sigma_index)


def fit_index(likelihood: Likelihood, fit: FitResult, z_range_nm: tuple[float, float]) -> IndexFit:
    """Fit the index as well, from every likely diameter; the fit stays where that tells nothing."""
    before = _covariance(likelihood, fit)
    if found := _maxima(likelihood, fit, z_range_nm):
        best, *others = found
        index, pixel = best.index - float(best.bias[1]), likelihood.grid.pixel_nm
        own = replace(likelihood, model=_model_of(likelihood).of_index(index))
        x, y, z, *_ = best.places[0].tolist()
        start = Candidate(x / pixel, y / pixel, z, best.mass_kda, fit.snr)
        again = fit_particle(own, start, "size", z_range_nm, level=bool(fit.box.free[LEVEL]))
        again = again.shifted(fit.x_nm - float(fit.estimate[0]), fit.y_nm - float(fit.estimate[1]))
        covariance = _covariance(own, again)
        errors = [math.sqrt(each[INDEX, INDEX]) for each in (before, covariance)]
        if _is_told(likelihood, own, fit, again, errors):
            again = _with_errors(again, covariance, others)
            return IndexFit(own, again, *_combination(own, again, covariance))
    return IndexFit(likelihood, fit, *_combination(likelihood, fit, before))


def _model_of(likelihood: Likelihood) -> SizedModel:
    """Give the model of a sphere's likelihood."""
    if not isinstance(likelihood.model, SizedModel):
        raise TypeError(f"{type(likelihood.model).__name__} has no index")
    return likelihood.model


def _is_told(
    likelihood: Likelihood, own: Likelihood, fit: FitResult, again: FitResult, errors: list[float]
) -> bool:
    """Tell whether the index is known to better than half of its contrast.

    A picture that tells little lets the index go anywhere, to where its error, by the curvature, is
    small.  So its error where the fit began counts as well; and on the way from there the logarithm
    of the likelihood rose by g, so that the error is no less than that way over √(2 g).
    """
    model = _model_of(own)
    index, known = model.sphere.index.real, _model_of(likelihood).sphere.index.real
    gain = again.log_likelihood - fit.log_likelihood
    # a fit may end so much below the one that it began from
    if Status.AT_BOUND in again.flags or gain < -0.5:
        return False
    way = abs(index - known) / math.sqrt(max(2 * gain, 1.0))
    return max(*errors, way) < UNDETERMINED * abs(index - model.optics.n_sample)


def _with_errors(fit: FitResult, covariance: FloatArray, others: Sequence[CommonSize]) -> FitResult:
    """Give a fit the errors with the index free, and a flag for another likely diameter."""
    errors = np.sqrt(np.diag(covariance))
    apart = OTHER_SIZE * errors[AMPLITUDE]
    several = any(abs(one.mass_kda - fit.mass_kda) > apart for one in others)
    status, noticed = verdict([*fit.flags, *([Status.AMBIGUOUS_SIZE] if several else [])])
    return replace(
        fit, sigma=errors[:4], sigma_index=float(errors[INDEX]), status=status, flags=noticed
    )


def _maxima(
    likelihood: Likelihood, fit: FitResult, z_range_nm: tuple[float, float]
) -> list[CommonSize]:
    """Find the maxima of the likelihood in place, diameter and index that are likely, best first.

    They begin at the diameters and heights that are likely at the configured index.
    """
    frame = SphereFrames([likelihood], _model_of(likelihood), z_range_nm)
    x, y, z, mass, level = fit.theta.tolist()
    levels = [level] if fit.box.free[LEVEL] else []
    index = frame.model.sphere.index.real
    starts = [(z, mass), *((other.z_nm, other.mass_kda) for other in fit.alternatives)]
    tried = [
        frame.fit(np.array([[x, y, height, *levels]]), mass_kda=size, index=index)
        for height, size in starts
    ]
    found = [one for one in tried if one is not None and one.converged]
    highest = max((one.log_likelihood for one in found), default=0.0)
    found = [one for one in found if one.log_likelihood > highest - math.log(AMBIGUITY_ODDS)]
    return sorted(found, key=lambda one: -one.log_likelihood)


def _combination(
    likelihood: Likelihood, fit: FitResult, covariance: FloatArray
) -> tuple[float, float]:
    """Give q of the combination d^q (n − n_s) that is told best, and its relative error.

    Shapes: `covariance` (6, 6).
    """
    model = _model_of(likelihood)
    both = np.ix_([AMPLITUDE, INDEX], [AMPLITUDE, INDEX])
    scale = np.array([3 * fit.mass_kda, model.sphere.index.real - model.optics.n_sample])
    relative = covariance[both] / np.outer(scale, scale)
    along = np.linalg.eigh(relative)[1][:, 0]
    told = along / along[1]
    return float(told[0]), math.sqrt(max(float(told @ relative @ told), 0.0))


def _covariance(likelihood: Likelihood, fit: FitResult) -> FloatArray:
    """Give the inverse of the expected information; 0 for a height that is at an end of its range.

    Shapes: result (6, 6), of θ with the index.
    """
    model = _model_of(likelihood)
    theta = np.insert(fit.theta, INDEX, model.sphere.index.real)
    fisher = likelihood.under(SphereOfIndex(model)).score_fisher(theta)[2]
    free = np.insert(fit.box.free, INDEX, True)
    free[2] &= fit.box.lower[2] < fit.theta[2] < fit.box.upper[2]
    return np.nan_to_num(covariance_of(fisher, free))
