"""What an uncertain microscope leaves in every particle: errors that all events share.

The likelihood of one particle has unknowns of its own, θ = (x, y, z, mass, level), and those of the
microscope, p.  If p is off by δp, the estimate of θ moves by D δp with D = −I_θθ⁻¹ I_θp: what the
particle does to imitate the change of the picture.  A covariance Σ of the microscope becomes
D Σ Dᵀ.  The same blocks say what the particle tells of the microscope once its own unknowns are
fitted, I_pp − I_pθ I_θθ⁻¹ I_θp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import PEAK_REACH, ForwardModel
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.records import PARAMETERS, FloatArray

_PEAK_POINTS = 61  # per axis, of the grid on which the peak of a contrast is looked for
_PEAK_NM = 0.1  # to which it is found


def joint_information(
    likelihood: Likelihood,
    theta: FloatArray,
    names: Sequence[str],
    others: Sequence[FloatArray] = (),
) -> FloatArray:
    """Fisher information of one particle about the microscope and about itself.

    `others` are derivatives of the signal with respect to further parameters, which come first;
    n is their number, that of the names, and 5.

    Shapes: `theta` (5,), `others` (ny, nx) each, result (n, n).
    """
    x, y, z, amplitude, level = (float(value) for value in theta)
    model, grid = likelihood.model, likelihood.grid
    signal, own = model.amplitude_gradient(grid, x, y, z, amplitude)
    further = [*others]
    if names:
        place = (grid, x, y, z, float(model.scale.mass(np.array(amplitude))))
        further += [*model.joint_gradient(*place, names)[2]]
    rows = np.empty((len(further) + 5, signal.size))
    for row, derivative in zip(rows, [*further, *own], strict=False):
        row[:] = derivative.ravel()
    _, _, information, by_signal, by_level = likelihood.noise.terms(likelihood.data, signal, level)
    rows[:-1] *= by_signal.ravel()
    rows[-1] = by_level.ravel()
    return np.asarray((rows * information.ravel()) @ rows.T)


def eliminated(information: FloatArray, shared: int) -> FloatArray:
    """Information about the first parameters after all others are fitted: the Schur complement.

    Shapes: `information` (n, n), result (shared, shared).
    """
    cross = information[:shared, shared:]
    return np.asarray(information[:shared, :shared] + cross @ imitation(information, shared))


def imitation(information: FloatArray, shared: int) -> FloatArray:
    """Change of the last parameters per unit error of the first ones.

    Shapes: `information` (n, n), result (n − shared, shared).
    """
    block = information[shared:, shared:]
    scale = 1 / np.sqrt(np.diag(block))
    solved = np.linalg.solve(
        block * np.outer(scale, scale), information[shared:, :shared] * scale[:, None]
    )
    return np.asarray(-solved * scale[:, None])


def displacement(
    likelihood: Likelihood,
    theta: FloatArray,
    names: Sequence[str],
    free: Sequence[str],
    *,
    level: bool = True,
) -> FloatArray:
    """Change of the estimates of a particle with the assumed microscope.

    Shapes: `theta` (5,), result (len(free).
    """
    whole = joint_information(likelihood, theta, names)
    count = len(names)
    own = [PARAMETERS.index(name) for name in free]
    kept = [*range(count), *(count + i for i in own), *([count + 4] if level else [])]
    moves = imitation(whole[np.ix_(kept, kept)], count)[: len(own)]
    if "mass_kda" in free:
        row, model = list(free).index("mass_kda"), likelihood.model
        moves[row] *= model.scale.slope(float(theta[3]))
        moves[row] += mass_drift(model, float(theta[3]), names)
    return moves


def mass_drift(model: ForwardModel, amplitude: float, names: Sequence[str]) -> FloatArray:
    """Change of the mass that a calibration gives an amplitude, with the microscope.

    A line that keeps the optics of its standards gives an amplitude one mass in any microscope.

    Shapes: result (len(names).
    """
    line = model.scale.calibration
    if line is None or line.optics is not None or not names:
        return np.zeros(len(names))
    *_, slopes = peak_gradient(model, model.height_nm, amplitude, names)
    return np.asarray(slopes / line.gradient_per_kda)


def peak_gradient(
    model: ForwardModel, z_nm: float, amplitude: float, names: Sequence[str]
) -> tuple[float, FloatArray, FloatArray]:
    """Peak contrast, and how it changes with the particle and with the microscope.

    Shapes: `own` (4,), `shared` (len(names).
    """
    spot = model.optics.wavelength_nm / model.optics.na
    x, y, half = 0.0, 0.0, min(PEAK_REACH * spot, model.reach_nm - spot) / math.sqrt(2)
    while half > _PEAK_NM:
        axis = np.linspace(-half, half, _PEAK_POINTS)
        grid = PixelGrid(x + axis, y + axis, _PEAK_NM)
        signal = np.abs(model.amplitude_image(grid, 0.0, 0.0, z_nm, amplitude))
        row, column = np.unravel_index(int(np.argmax(signal)), signal.shape)
        x, y = float(grid.x_nm[column]), float(grid.y_nm[row])
        half *= 3 / _PEAK_POINTS
    # where the signal is largest its place does not matter to first order
    there = PixelGrid(np.array([x]), np.array([y]), _PEAK_NM)
    at = (0.0, 0.0, z_nm, amplitude)
    contrast, own, shared = model.amplitude_joint_gradient(there, *at, names)
    return float(contrast[0, 0]), own[:, 0, 0], shared[:, 0, 0]


def shared_sigma(moves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Give the standard deviations that an uncertain microscope puts into all particles alike.

    Shapes: `moves` (k, n), `covariance` (n, n), result (k,).
    """
    variance = np.einsum("ki,ij,kj->k", moves, covariance, moves)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
