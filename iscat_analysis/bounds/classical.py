"""What a camera can learn: Cramér–Rao bounds from the likelihood's own Fisher matrix.

The matrix comes from `Likelihood.score_fisher`, the same code that fits data, so a bound and a fit
cannot disagree about optics, noise or pixels (physics.md, section 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.likelihood import Likelihood, ModelLikelihood
from iscat_analysis.records import PARAMETERS, ComplexArray, FloatArray

LEAST_COMPONENT = 1e-3
"""Component of an unidentifiable direction below which a parameter is not part of it."""


@dataclass(frozen=True)
class Unidentifiable:
    """A direction along which the image does not change."""

    names: tuple[str, ...]
    direction: tuple[float, ...]

    def __str__(self) -> str:
        """Describe it in one line."""
        if len(self.names) == 1:
            return f"{self.names[0]}: the image does not change with it"
        moves = (f"{n} {d:+.3g}" for n, d in zip(self.names, self.direction, strict=True))
        return f"{'–'.join(self.names)}: the image does not change along ({', '.join(moves)})"


@dataclass(frozen=True)
class EventBounds:
    """Bounds for one particle, in the order and the units of `PARAMETERS`; NaN where not free."""

    crb_single: FloatArray
    crb_joint: FloatArray
    qcrb: FloatArray
    fisher: FloatArray
    quantum: FloatArray
    unidentifiable: tuple[Unidentifiable, ...]
    weakest: tuple[float, ...]
    inflation: float


def event_bounds(
    likelihood: ModelLikelihood,
    theta: FloatArray,
    free: tuple[str, ...],
    collected: float = math.nan,
    *,
    quantum: ComplexArray | None = None,
    level: bool = False,
) -> EventBounds:
    """Classical and quantum bounds of one particle, of any model, in the order of its parameters.

    Quantum bounds are NaN where `collected` is, the scattered photons.

    Shapes: `theta` (p,), `quantum` (4, 4).
    """
    parameters = likelihood.model.parameters
    names, count = tuple(each.name for each in parameters), len(parameters)
    unknown = [name for name in free if name not in names]
    if unknown or not free:
        raise ConfigError(f"free = {list(free)}: choose one or more of {', '.join(names)}")
    slopes = [each.slope(float(value)) for each, value in zip(parameters, theta, strict=False)]
    whole = likelihood.score_fisher(theta)[2]
    if level and whole[-1, -1] > 0:  # what is left once the level is fitted: Schur complement
        whole = whole - np.outer(whole[:, -1], whole[-1]) / whole[-1, -1]
    fisher = whole[:count, :count] / np.outer(slopes, slopes)
    light = np.zeros_like(fisher)
    if isinstance(likelihood, Likelihood):
        model = likelihood.model
        if not (model.is_measured or math.isnan(collected)):
            if quantum is None:
                height = max(theta[2], 0.0)  # a nuisance may be below
                quantum = quantum_information(model, height, amplitude=float(theta[3]))
            relative = abs(theta[3] * slopes[3])  # mass for a relative step of 1 [kDa]
            per_kda = np.array([1.0, 1.0, 1.0, 1 / relative if relative else 0.0])
            light = collected * quantum.real * np.outer(per_kda, per_kda)
        light[2, 2] += likelihood.height_prior[1]  # as the Fisher matrix has it
    return bounds_from_matrices(fisher, light, free, names)


def bounds_from_matrices(
    fisher: FloatArray,
    quantum: FloatArray,
    free: tuple[str, ...],
    names: tuple[str, ...] = PARAMETERS,
) -> EventBounds:
    """Turn a Fisher matrix and a quantum one into bounds.

    Shapes: `fisher` (n, n), `quantum` (n, n), n = len(names).
    """
    index = [i for i, name in enumerate(names) if name in free]
    limit, chosen = np.diag(quantum), np.isin(names, free)
    # Share of the light's information below which a parameter is not seen at all
    seen = np.where(chosen & (np.diag(fisher) > 1e-12 * limit), np.diag(fisher), np.nan)
    single, joint, weakest = 1 / np.sqrt(seen), np.full(len(names), np.nan), np.zeros(len(names))
    qcrb = 1 / np.sqrt(np.where(chosen & (limit > 0), limit, np.nan))
    visible = [i for i in index if math.isfinite(seen[i])]
    unidentifiable = [Unidentifiable((names[i],), (1.0,)) for i in index if i not in visible]
    if not visible:
        return EventBounds(
            single, joint, qcrb, fisher, quantum, tuple(unidentifiable), (), math.nan
        )
    scale = single[visible]
    values, vectors = np.linalg.eigh(fisher[np.ix_(visible, visible)] * np.outer(scale, scale))
    # An eigenvalue that counts as zero: the squared angle between the derivatives.  Below it the
    # angle is less than a hundred times the 3e-7 to which the gradient of the image is known, and
    # an inverse would report that error.
    null = values < 1e-9
    for vector in vectors.T[null]:
        step = vector * scale
        parts = [k for k in range(len(visible)) if abs(vector[k]) > LEAST_COMPONENT]
        moves = (step[parts] / step[parts[0]]).tolist()
        unidentifiable.append(Unidentifiable(tuple(names[visible[k]] for k in parts), tuple(moves)))
    involved = np.any(np.abs(vectors[:, null]) > LEAST_COMPONENT, axis=1)
    variance = np.sum(vectors[:, ~null] ** 2 / values[~null], axis=1)
    joint[visible] = np.where(involved, np.nan, scale * np.sqrt(variance))
    weakest[visible] = vectors[:, 0]
    inflation = math.nan if unidentifiable else 1 / math.sqrt(values[0])
    return EventBounds(
        single, joint, qcrb, fisher, quantum, tuple(unidentifiable),
        tuple(float(weakest[i]) for i in index), inflation,
    )  # fmt: skip
