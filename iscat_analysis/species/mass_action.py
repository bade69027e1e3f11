"""Concentrations at equilibrium, and what of them lands.

Monomers and dimers of c monomers in all, 2 M ⇌ D, K_D = [M]²/[D] (Fineberg, Surrey & Kukura, J.
Mol. Biol. 432, 6168, 2020):

    [M] = 2c / (1 + √(1 + 8c/K_D)),      [D] = [M]²/K_D.

Two partners of a and b in all, A + B ⇌ AB, K_D = [A][B]/[AB]:

    [AB] = 2ab / (s + √(s² − 4ab)),  s = a + b + K_D,      [A] = a − [AB],  [B] = b − [AB].

Of monomers, or of A, a part β may be inactive: it stays as it is.

The number of particles of mass m that land on an absorbing surface below a drop at rest is
2 c √(Dt/π) per area, and D ∝ m^(−1/3): landings are as c·m^p with p = −1/6.  Through a layer of
fixed thickness, as where liquid flows, they are as c·D, p = −1/3; where the surface and not
diffusion decides, and is as sticky for all, p = 0.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from iscat_analysis.records import FloatArray

Model = Literal["dimer", "ab"]

LANDING_POWER = -1 / 6
"""p of landings ∝ concentration · mass^p: diffusion from a drop at rest to an absorbing surface."""

LANDING_POWER_SIGMA = 1 / 6
"""What it may be off by: liquid that flows makes it −1/3, a surface that takes all alike 0."""

COMPOSITION: dict[Model, FloatArray] = {
    "dimer": np.array([[1.0], [2.0]]),
    "ab": np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
}
"""How many of each part a species holds, (species, parts); the last species is the complex."""

_LEAST = 1e-12  # of the total: what is absent has some logarithm


def at_equilibrium(
    model: Model, totals_nm: FloatArray, kd_nm: float, inactive: float = 0.0
) -> FloatArray:
    """Give the concentrations of all species.

    Shapes: `totals_nm` (n, 1) or (n, 2), result (n, 2) or (n, 3).
    """
    active = (1 - inactive) * totals_nm[:, 0]
    idle = inactive * totals_nm[:, 0]
    if model == "dimer":
        monomer = 2 * active / (1 + np.sqrt(1 + 8 * active / kd_nm))
        found = [monomer + idle, monomer**2 / kd_nm]
    else:
        other = totals_nm[:, 1]
        s = active + other + kd_nm
        product = 2 * active * other / (s + np.sqrt(s**2 - 4 * active * other))
        found = [active - product + idle, other - product, product]
    least = _LEAST * totals_nm.sum(axis=1)[:, None]
    return np.asarray(np.maximum(np.array(found).T, least))


def landing_logits(
    model: Model,
    totals_nm: FloatArray,
    kd_nm: float,
    inactive: float,
    masses_kda: FloatArray,
    power: float,
) -> FloatArray:
    """Give the logarithm of how many of each species land, less that of the first.

    Shapes: `totals_nm` (n, 1) or (n, 2), `masses_kda` (k,), result (n, k).
    """
    logits = np.log(at_equilibrium(model, totals_nm, kd_nm, inactive))
    logits = logits + power * np.log(masses_kda)
    return np.asarray(logits - logits[:, :1])
