"""One microscope, many particles: the maximum of their joint likelihood.

Every image of a particle has unknowns of its own (place, mass, background level) and shares those
of the microscope with all others.  The information matrix is an arrow; its private blocks are
eliminated image by image (their Schur complement), so that the cost grows linearly with the
images.  Fisher scoring with Levenberg's damping; a step is taken only if the likelihood rises.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from iscat_analysis.inference.likelihood import LEVEL
from iscat_analysis.instrument.particle_image import (
    PRIVATE,
    ROAM_NM,
    Build,
    Images,
    ParticleImage,
    models_of,
    with_masses,
)
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.local import BASES
from iscat_analysis.optics.parameters import MASK_NA, PARAMETERS, Prior, Settings
from iscat_analysis.records import FloatArray, IntArray, Mapper

_OWN_STEPS = np.array([60.0, 60.0, 20.0, np.inf, 0.5])  # nm, kDa; a fringe is some 200 nm high
_DAMPING = (1e-3, 1e8)  # first, and where the search gives up
_TOGETHER = 5  # images of one task; a millisecond each


@dataclass(frozen=True)
class Estimate:
    """A maximum of the joint posterior: likelihood of the pictures and prior of the optics.

    Shapes: `information`, `scatter` (n, n), of likelihood and prior; `errors` (n,), of the prior.
    """

    names: tuple[str, ...]
    values: Settings
    images: Images
    information: FloatArray
    scatter: FloatArray
    errors: FloatArray
    log_likelihood: float
    log_prior: float
    converged: bool

    @property
    def log_posterior(self) -> float:
        """Logarithm of the density that is largest here."""
        return self.log_likelihood + self.log_prior

    @property
    def log_evidence(self) -> float:
        """Log-likelihood averaged over the prior, by Laplace's approximation."""
        scaled = self.information * np.outer(self.errors, self.errors)
        return self.log_posterior - 0.5 * float(np.linalg.slogdet(scaled)[1])

    @property
    def bound(self) -> FloatArray:
        """Van Trees' bound of the covariance: the inverse information, shape (n, n)."""
        both = np.outer(self.errors, self.errors)
        return np.asarray(np.linalg.inv(self.information * both) * both)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the estimates from the residuals themselves, shape (n, n).

        Notes
        -----
        H. White, Econometrica 50, 1 (1982): right where the noise is not quite that of the model.
        """
        return np.asarray(self.bound @ self.scatter @ self.bound)


def maximise(
    images: Images,
    build: Build,
    start: Settings,
    names: Sequence[str],
    *,
    prior: Prior | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    tolerance: float = 1e-2,
    passes: int = 40,
    mapper: Mapper = map,
) -> Estimate:
    """Maximise the joint posterior over the microscope and all particles.

    The prior is around the start where none is given.
    """
    names, values = tuple(names), dict(start)
    prior = prior or Prior(values)
    joint = JointLikelihood(images, build, names, prior, mapper)
    private = np.clip([image.private for image in images], *joint.walls)
    at = joint.at(values, private)
    damping, used, converged = _DAMPING[0], 1, False
    while used < passes and damping < _DAMPING[1]:
        if at.gain(names) < tolerance:
            converged = True
            break
        shared, own = at.step(names, damping)
        trial_values = dict(values)
        for name, move in zip(names, shared, strict=True):
            ends = (limits or {}).get(name, (-math.inf, math.inf))
            trial_values[name] = float(np.clip(values[name] + move, *ends))
        if "mask_na" in names:
            trial_values["mask_na"] = min(trial_values["mask_na"], trial_values["na"] - MASK_NA)
        moved = np.clip(private + own, *joint.walls)
        trial = joint.at(trial_values, moved)
        used += 1
        if trial.value + trial.log_prior > at.value + at.log_prior:
            values, private, at = trial_values, moved, trial
            damping = max(damping / 8, 1e-9)
        else:
            damping = max(8 * damping, 1e-3)
    return Estimate(
        names=names,
        values=values,
        images=tuple(s.moved(p) for s, p in zip(images, private, strict=True)),
        information=at.reduced(0.0)[0],
        scatter=at.scatter([image.owner for image in images]) + np.diag(at.precision),
        errors=prior.errors(names),
        log_likelihood=at.value,
        log_prior=at.log_prior,
        converged=converged,
    )


@dataclass(frozen=True)
class PictureScores:
    """How the likelihood of each picture changes with its own optics, to second order.

    Shapes: `information` (n, k, k), `score` (n, k), `scatter` (n, k, k).
    """

    images: Images
    names: tuple[str, ...]
    information: FloatArray
    score: FloatArray
    scatter: FloatArray

    @classmethod
    def of(
        cls, images: Images, build: Build, settings: Settings, names: Sequence[str], mapper: Mapper
    ) -> PictureScores:
        """Score what parameters and coefficients of the field change about the optics."""
        bases = tuple(dict.fromkeys(b for name in names for b in BASES.get(name, (name,))))
        private = np.array([image.private for image in images])
        at = JointLikelihood(images, build, bases, mapper=mapper).at(settings, private)
        information, score, _ = at.each(0.0)
        return cls(images, bases, information, score, at.pixel_scatter()[0])

    def slopes(self, names: Sequence[str]) -> FloatArray:
        """Give what parameters change about the optics of every picture, shape (n, m, k)."""
        changes = [[image.slopes(name) for name in names] for image in self.images]
        return np.array(
            [[[each.get(base, 0.0) for base in self.names] for each in of] for of in changes]
        )

    def step(self, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Say how far the pictures ask to change what changes the optics of each by its slopes.

        Shapes: `slopes` (n, m, k), result (m,) and its covariance (m, m).
        """
        score = np.einsum("nik,nk->i", slopes, self.score)
        information, scatter = (
            np.einsum("nik,nkl,njl->ij", slopes, each, slopes, optimize=True)
            for each in (self.information, self.scatter)
        )
        unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information * np.outer(unit, unit)
        # share of the largest eigenvalue below which a direction is not determined
        bound = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) * np.outer(unit, unit)
        return bound @ score, bound @ scatter @ bound


@dataclass(frozen=True)
class JointLikelihood:
    """The likelihood of pictures, in parameters of the optics and what is each picture's own."""

    images: Images
    build: Build
    names: tuple[str, ...]
    prior: Prior | None = None
    mapper: Mapper = map

    @cached_property
    def walls(self) -> FloatArray:
        """Bounds of what is an image's own, shape (2, n, 5): a particle stays in its picture."""
        centres = np.array([(s.grid.x_nm.mean(), s.grid.y_nm.mean()) for s in self.images])
        walls = np.full((2, len(self.images), PRIVATE), np.inf)
        walls[0] = -np.inf
        walls[0, :, :2], walls[1, :, :2] = centres - ROAM_NM, centres + ROAM_NM
        walls[:, :, 2] = np.transpose([s.heights_nm or (s.z_nm, s.z_nm) for s in self.images])
        return walls

    def at(self, values: Settings, private: FloatArray) -> _Point:
        """Evaluate all images; an unknown that its wall stops counts as known.

        Shapes: `private` (n, 5).
        """
        models, names = models_of(self.images, self.build, values), self.names

        def some(first: int) -> list[tuple[float, FloatArray, FloatArray, FloatArray]]:
            these = slice(first, first + _TOGETHER)
            each_of = zip(self.images[these], models[these], private[these], strict=True)
            return [_scores(image, model, names, own) for image, model, own in each_of]

        parts = self.mapper(some, range(0, len(self.images), _TOGETHER))
        found = [each for part in parts for each in part]
        value = math.fsum(each[0] for each in found)
        score, fisher, squares = (np.array([each[part] for each in found]) for part in (1, 2, 3))
        own, (low, high) = score[:, len(names) :], self.walls
        stopped = (private <= low) & (own < 0) | (private >= high) & (own > 0) | (low == high)
        free = np.pad(~stopped, ((0, 0), (len(names), 0)), constant_values=True)
        both = free[:, :, None] & free[:, None, :]
        alone = np.eye(free.shape[1]) * ~free[:, None, :]
        changes, errors = np.zeros(len(names)), np.full(len(names), np.inf)
        if self.prior is not None:
            changes, errors = self.prior.changes(values, names), self.prior.errors(names)
        return _Point(
            value if math.isfinite(value) else -math.inf,
            np.where(free, score, 0.0),
            np.where(both, fisher, alone),
            np.where(both, squares, 0.0),
            -0.5 * float(changes @ changes),
            -changes / errors,
            errors**-2.0,
        )


@dataclass(frozen=True)
class _Point:
    """Likelihood, score and information of all images at one set of parameters."""

    value: float
    score: FloatArray  # (n, k + 5)
    fisher: FloatArray  # (n, k + 5, k + 5)
    squares: FloatArray  # the same, with squared residuals in place of their expectation
    log_prior: float
    pull: FloatArray  # (k,), slope of the logarithm of the prior
    precision: FloatArray  # (k,), its information

    def scatter(self, owners: Sequence[int]) -> FloatArray:
        """Covariance of the reduced score from the residuals, shape (k, k).

        Its shape is what the pixels say.  What the scores of pictures with owners scatter more, or
        those of all pictures of an owner together, is a common factor: there are too few for more.
        """
        by_picture, whole = self.pixel_scatter()
        pixels: FloatArray = by_picture.sum(axis=0)
        known = np.array(owners)
        if not (known >= 0).all():
            return pixels
        groupings = (np.arange(len(known)), known)
        most = max((1.0, *(excess(pixels, whole, each) for each in groupings)))
        return np.asarray(pixels * most)

    def pixel_scatter(self) -> tuple[FloatArray, FloatArray]:
        """Covariance of every picture's reduced score from its residuals, and the score.

        Shapes: result (n, k, k) and (n, k).
        """
        k = self.score.shape[1] - PRIVATE
        gains = np.einsum("eij,ejk->eik", self.fisher[:, :k, k:], self.each(0.0)[2])
        reduce = np.concatenate([np.broadcast_to(np.eye(k), (len(gains), k, k)), -gains], axis=2)
        scatter = np.einsum("eia,eab,ejb->eij", reduce, self.squares, reduce, optimize=True)
        score: FloatArray = np.einsum("eia,ea->ei", reduce, self.score)
        return np.asarray(scatter), score

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Information and score of the shared parameters, and the private blocks inverted."""
        information, score, inverse = self.each(damping)
        whole = information.sum(axis=0) + np.diag(self.precision)
        return whole, score.sum(axis=0) + self.pull, inverse

    def each(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give the same of every picture.

        Shapes: result (n, k, k), (n, k) and (n, 5, 5).
        """
        k = self.score.shape[1] - PRIVATE
        cross, block = self.fisher[:, :k, k:], self.fisher[:, k:, k:]
        ridge = damping * np.einsum("eii->ei", block)
        inverse = np.linalg.inv(block + ridge[:, :, None] * np.eye(PRIVATE))
        gains = np.einsum("eij,ejk->eik", cross, inverse)
        information: FloatArray = self.fisher[:, :k, :k] - gains @ cross.transpose(0, 2, 1)
        score: FloatArray = self.score[:, :k] - np.einsum("eij,ej->ei", gains, self.score[:, k:])
        return information, score, inverse

    def gain(self, names: tuple[str, ...]) -> float:
        """Gain in log-likelihood that the undamped step promises."""
        k = len(names)
        information, score, inverse = self.reduced(0.0)
        own = self.score[:, k:]
        total = 0.5 * float(np.einsum("ei,eij,ej->", own, inverse, own))
        return total + 0.5 * float(score @ _solve(information, score, names, 1e-9))

    def step(self, names: tuple[str, ...], damping: float) -> tuple[FloatArray, FloatArray]:
        """Damped step of the shared parameters and of every private one."""
        k = len(names)
        information, score, inverse = self.reduced(damping)
        shared = _solve(information, score, names, damping)
        largest = np.array([PARAMETERS[name].largest_step for name in names])
        if k:
            shared = shared / max(1.0, float(np.max(np.abs(shared) / largest)))
        rest = self.score[:, k:] - np.einsum("eij,i->ej", self.fisher[:, :k, k:], shared)
        own = np.einsum("eij,ej->ei", inverse, rest)
        return shared, np.clip(own, -_OWN_STEPS, _OWN_STEPS)


def excess(scatter: FloatArray, scores: FloatArray, owners: IntArray) -> float:
    """Say how many times more the scores of owners scatter than expected, over all parameters.

    The scores of all add up to nothing, which takes one of them.
    """
    names, index = np.unique(owners, return_inverse=True)
    k = len(scatter)
    if not k or len(names) < 2:
        return 1.0
    sums = np.zeros((len(names), k))
    np.add.at(sums, index, scores)
    unit = 1 / np.sqrt(np.maximum(np.diag(scatter), np.finfo(float).tiny))
    inverse = np.linalg.pinv(scatter * np.outer(unit, unit), hermitian=True)
    squares = np.einsum("ei,ij,ej->", sums * unit, inverse, sums * unit)
    return float(squares) / (k * (1 - 1 / len(names)))


def _solve(
    information: FloatArray, score: FloatArray, names: tuple[str, ...], damping: float
) -> FloatArray:
    """Solve the damped normal equations in units of the usual errors."""
    scale = np.array([PARAMETERS[name].usual_error for name in names])
    scaled = information * np.outer(scale, scale)
    ridge = np.diag(damping * np.diag(scaled))
    return np.asarray(scale * np.linalg.solve(scaled + ridge, scale * score))


def _scores(
    image: ParticleImage, model: ForwardModel, names: tuple[str, ...], private: FloatArray
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Log-likelihood, score, expected information and its observed squares, shared ones first."""
    x, y, z, mass, level = (float(v) for v in private)
    place = (image.grid, x, y, z, mass)
    k = len(names)
    wanted = tuple(dict.fromkeys(base for name in names for base in image.slopes(name)))
    signal, slopes = model.gradient(*place, wanted)
    rows = np.empty((k + PRIVATE, signal.size))
    for row, name in zip(rows, names, strict=False):
        row[:] = sum(
            weight * slopes[4 + wanted.index(base)].ravel()
            for base, weight in image.slopes(name).items()
        )
    rows[k : k + LEVEL] = slopes[:LEVEL].reshape(LEVEL, -1)
    terms = image.noise.terms(image.data, signal, level)
    rows[-1] = terms.by_level.ravel()
    weighted = rows * terms.information.ravel()
    scored = rows * terms.score.ravel()
    return terms.value + image.baseline, scored.sum(axis=1), weighted @ rows.T, scored @ scored.T


@dataclass(frozen=True)
class Neighbours:
    """Particles with the rings that they make in one microscope."""

    particles: Images
    wide: ForwardModel

    @classmethod
    def fitted(
        cls, others: Images, build: Build, build_wide: Build, settings: Settings, mapper: Mapper
    ) -> Neighbours:
        """Fit them, and once more among each other's rings."""

        def own(images: Images) -> Images:
            return maximise(images, build, settings, (), passes=6, mapper=mapper).images

        first = cls(own(with_masses(others, build, settings)), build_wide(settings))
        return cls(own(first.around(first.particles, mapper)), first.wide)

    def around(self, images: Images, mapper: Mapper = map) -> Images:
        """Put their rings into what is expected of pictures.

        Every particle is drawn into all pictures at once: its field at its height takes longest.
        """
        reached: list[list[tuple[int, float]]] = [[] for _ in self.particles]
        for index, image in enumerate(images):
            for number, share in image.neighbours:
                reached[number].append((index, share))

        def drawn(number: int) -> list[tuple[int, FloatArray]]:
            other = self.particles[number]
            place = (other.x_nm, other.y_nm, other.z_nm, other.mass_kda)
            return [
                (index, share * self.wide.image(images[index].grid, *place))
                for index, share in reached[number]
            ]

        rings = [np.zeros(image.grid.shape) for image in images]
        for drawings in mapper(drawn, range(len(self.particles))):
            for index, drawing in drawings:
                rings[index] += drawing
        return tuple(image.among(ring) for image, ring in zip(images, rings, strict=True))
