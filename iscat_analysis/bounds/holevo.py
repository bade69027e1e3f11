"""What one measurement can reach for several parameters at once: the Holevo bound.

Each quantum Cramér–Rao bound is reached by a measurement of its own.  Where two of those
measurements do not commute, as for height and mass, which are phase and amplitude of nearly the
same wave, no measurement reaches both.  With the information Q = K + iB of `quantum_information`,
any measurement of all parameters has a covariance V with

    Tr W V ≥ C_H(W),        and for coherent states one measurement reaches C_H

(physics.md, section 9; Matsumoto, J. Phys. A 35, 3111 (2002); Albarelli, Friel & Datta, Phys. Rev.
Lett. 123, 200503 (2019)).

What to use when
----------------
`natural_bound` weighs every parameter by its own information, W = K.  In coordinates in which K is
the identity, the commutator becomes a real antisymmetric matrix A with eigenvalues ±iβ, W does not
change when the coordinates turn, and the problem falls apart into planes of one β each, in which
V = 2/(1 + √(1 − β²)).  So V = 2 (1 + √(1 − AᵀA))⁻¹, and C_H = Σ 4/(1 + √(1 − β²)) over the planes
plus 1 for each direction that commutes with all others.

`tradeoff` is the edge of what can be reached for two parameters, for all weights at once.  In the
same coordinates, V₁ = 1/cos²μ and V₂ = 1/cos²ν with μ + ν = arcsin β.

`holevo_bound` takes any weight and any number of parameters, and solves the semidefinite program.

`holevo_over_quantum` tells what the conflict costs one particle's parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.records import PARAMETERS, ComplexArray, FloatArray


@dataclass(frozen=True)
class Holevo:
    """A bound on all parameters at once."""

    sum: float
    covariance: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations that this measurement reaches together, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))


def natural_bound(information: ComplexArray) -> Holevo:
    """Holevo bound with every parameter weighed by its own information, W = K.

    Examples
    --------
    A wave's phase and amplitude cost twice the variance when they are measured together.

    >>> import numpy as np
    >>> from iscat_analysis.bounds import natural_bound
    >>> natural_bound(np.array([[1, 1j], [-1j, 1]])).sigma.round(3)
    array([1.414, 1.414])

    Shapes: `information` (d, d).
    """
    unit, commutator = _orthonormal(information)
    squared, vectors = np.linalg.eigh(commutator.T @ commutator)
    variance = 2 / (1 + np.sqrt(np.clip(1 - squared, 0.0, 1.0)))
    root = unit @ vectors
    return Holevo(float(variance.sum()), (root * variance) @ root.T)


def holevo_over_quantum(
    model: ForwardModel, z_nm: float, free: tuple[str, ...]
) -> dict[str, float]:
    """Cost of estimating parameters together, of which each has a measurement of its own."""
    index = [PARAMETERS.index(name) for name in free]
    information = quantum_information(model, z_nm)[np.ix_(index, index)]
    own = np.sqrt(np.diag(information).real)
    return dict(zip(free, (natural_bound(information).sigma * own).tolist(), strict=True))


def holevo_bound(information: ComplexArray, weight: FloatArray) -> Holevo:
    """Holevo bound for any weight.

    Notes
    -----
    min Tr WV subject to [[V, X†], [X, 1]] ⪰ 0 and 2 Re(X†L) = 1, with L†L = Q/4 (Albarelli et al.
    2019, equation 7, for pure states), in coordinates in which K is the identity and the weight is
    of order one; solved by Clarabel.

    Shapes: `information` (d, d), `weight` (d, d).
    """
    unit, commutator = _orthonormal(information)
    weight = np.asarray(weight, dtype=np.float64)
    size = len(unit)
    if weight.shape != (size, size) or not np.allclose(weight, weight.T):
        raise ConfigError(f"weight: has shape {weight.shape}; give a symmetric ({size}, {size})")
    turned = unit.T @ weight @ unit
    scale = float(np.trace(turned))
    if not scale > 0 or np.linalg.eigvalsh(turned)[0] < -1e-12 * scale:
        raise ConfigError("weight: is not positive semidefinite")
    covariance = _solve(np.eye(size) + 1j * commutator, turned / scale)
    return Holevo(scale * float(np.sum(turned / scale * covariance)), unit @ covariance @ unit.T)


def tradeoff(information: ComplexArray, points: int = 101) -> FloatArray:
    """Edge of what one measurement can reach for two parameters.

    Notes
    -----
    For W' = diag(cos²τ, sin²τ) in the coordinates of `natural_bound` the optimum lies on the curve
    of the module's page; the ellipse of V touches the axes of the given parameters at its σ.

    Shapes: `information` (2, 2), result (points, 2).
    """
    if np.shape(information) != (2, 2):
        raise ConfigError(f"information: has shape {np.shape(information)}; give (2, 2)")
    found = []
    unit, commutator = _orthonormal(information)
    angle = math.asin(min(abs(commutator[0, 1]), 1.0))
    own = 1 / np.sqrt(np.diag(np.asarray(information).real))
    for share in np.linspace(0.0, math.pi / 2, points + 2)[1:-1]:
        # the weight on the given parameters, each in units of its own bound, turned to axes of its
        # own in the orthonormal coordinates
        weight = unit.T @ np.diag([math.cos(share) ** 2, math.sin(share) ** 2] / own**2) @ unit
        sizes, axes = np.linalg.eigh(weight)
        first = _angle(sizes, angle)
        variance = 1 / np.cos([first, angle - first]) ** 2
        root = unit @ axes
        found.append(np.sqrt(np.diag((root * variance) @ root.T)))
    return np.clip(found, None, 5 * own)


def _angle(sizes: FloatArray, angle: float) -> float:
    """Find the μ that minimises w₁/cos²μ + w₂/cos²(φ − μ)."""

    def slope(first: float) -> float:
        return float(
            sizes[0] * math.tan(first) / math.cos(first) ** 2
            - sizes[1] * math.tan(angle - first) / math.cos(angle - first) ** 2
        )

    return float(scipy.optimize.brentq(slope, 0.0, angle, xtol=1e-14)) if angle else 0.0


def _orthonormal(information: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Matrix U with UᵀKU = 1, and the commutator UᵀBU."""
    information = np.asarray(information, dtype=np.complex128)
    if information.ndim != 2 or information.shape[0] != information.shape[1]:
        raise ConfigError(f"information: has shape {information.shape}; give a square matrix")
    if not np.all(np.isfinite(information)):
        raise ConfigError("information: is not finite")
    own = np.diag(information).real
    if not (np.allclose(information, information.conj().T) and np.all(own > 0)):
        raise ConfigError("information: is not Hermitian with a positive diagonal")
    scale = 1 / np.sqrt(own)
    values, vectors = np.linalg.eigh(information.real * np.outer(scale, scale))
    if values[0] < 1e-12:
        raise ConfigError("information: its parameters are not independent of each other")
    unit = scale[:, None] * vectors / np.sqrt(values)
    return unit, unit.T @ information.imag @ unit


def _solve(information: ComplexArray, weight: FloatArray) -> FloatArray:
    """Solve the semidefinite program for Q of order one; the covariance."""
    import clarabel
    from scipy import sparse

    size = len(weight)
    values, vectors = np.linalg.eigh(information / 4)
    light = np.sqrt(np.clip(values, 0.0, None))[:, None] * vectors.conj().T  # L
    # The unknowns are the upper triangle of V, then Re X and Im X.  `v` and `x` are what each of
    # them adds to V and X.
    units = np.eye(size**2).reshape(-1, size, size)
    symmetric = np.maximum(units, units.transpose(0, 2, 1))[
        np.triu(np.ones((size, size))).ravel() > 0
    ]
    v = np.concatenate([symmetric, 0 * units, 0 * units])
    x = np.concatenate([0 * symmetric, units, 1j * units])
    # A Hermitian H = S + iT is positive where [[S, −T], [T, S]] is.  Its upper triangle goes to the
    # solver column by column, off the diagonal times √2: constant − matrix·unknowns.
    hermitian = np.block([[v, x.conj().transpose(0, 2, 1)], [x, 0 * x]])
    real, imaginary = hermitian.real, hermitian.imag
    columns, rows = np.tril_indices(4 * size)
    stretch = np.where(rows == columns, 1.0, math.sqrt(2))
    cone = -np.block([[real, -imaginary], [imaginary, real]])[:, rows, columns] * stretch
    constant = np.diag(np.tile(np.repeat([0.0, 1.0], size), 2))[rows, columns]
    equal = 2 * (x.conj().transpose(0, 2, 1) @ light).real.reshape(len(x), -1)  # 2 Re(X†L) = 1
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix((len(x), len(x))),
        (v * weight).sum(axis=(1, 2)),
        sparse.csc_matrix(np.concatenate([equal, cone], axis=1).T),
        np.concatenate([np.eye(size).ravel(), constant]),
        [clarabel.ZeroConeT(size**2), clarabel.PSDTriangleConeT(4 * size)],
        settings,
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise ConfigError(f"the Holevo bound's solver stopped with {solution.status}")
    return np.tensordot(solution.x, v, axes=1)
