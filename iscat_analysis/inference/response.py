"""How estimates move when the microscope is not quite the one that is fitted.

The score of a particle's parameters θ at their true values has no mean.  In a microscope whose
parameters p are wrong by δp it has the mean −I_θp δp, I_θp being the cross block of the Fisher
information about (θ, p), and to first order the maximum moves to where the score vanishes again:

    δθ = D δp,    D = −I_θθ⁻¹ I_θp.

All particles of a movie are seen through the same microscope, so that errors of p with covariance
Σ_p give the estimates the *common* covariance D Σ_p Dᵀ, which no averaging over particles lessens.
On an even background the photons cancel from D: it is a property of the picture alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid

FloatArray = NDArray[np.float64]

_POINTS = 40  # of the grid on which the peak is looked for, over λ/NA
_PEAK_REACH = 2.0  # how far from the particle, over λ/NA


def optics_response(
    model: ForwardModel,
    grid: PixelGrid,
    z_nm: float,
    amplitudes: Sequence[float] | FloatArray,
    names: Sequence[str],
    *,
    free: Sequence[bool],
    level: bool = False,
    odds: float = 0.0,
) -> FloatArray:
    """Shift of the estimates per shift of the optics, for a particle at the centre of a region.

    Parameters
    ----------
    model : ForwardModel
        The microscope that is fitted.
    grid : PixelGrid
        The region.
    z_nm : float
        Height [nm].
    amplitudes : sequence of float
        Amplitudes of the particle, none of them 0.
    names : sequence of str
        Parameters of the optics, as `ForwardModel.optics_gradient` takes them.
    free : sequence of bool, length 4
        Which of x, y, z and the amplitude are fitted.
    level : bool
        Whether the level of the light is fitted as well.
    odds : float
        Light after over light before where the background is measured, 0 where it is known: a
        bright pixel weighs 1/((1 + s)(1 + odds (1 + s))).

    Returns
    -------
    ndarray, shape (len(amplitudes), 4, len(names))
        D of (x [nm], y [nm], z [nm], ln a) per unit of each parameter; 0 for what is not fitted.
    """
    x, y = float(np.mean(grid.x_nm)), float(np.mean(grid.y_nm))
    plain = replace(model, scale=MassScale())  # masses that are amplitudes
    moved = [*np.asarray(free, dtype=bool), level]
    out = np.zeros((len(amplitudes), 5, len(names)))
    for index, amplitude in enumerate(map(float, amplitudes)):
        signal, own = plain.amplitude_gradient(grid, x, y, z_nm, amplitude)
        # the logarithm of the amplitude, so that faint particles have the limit of none
        steps = np.stack([*own[:3], amplitude * own[3], 1 + signal]).reshape(5, -1)[moved]
        _, change = plain.optics_gradient(grid, x, y, z_nm, amplitude, names)
        bright = 1 + signal.ravel()
        weighed = steps / (bright * (1 + odds * bright))
        scale = 1 / np.sqrt(np.einsum("ip,ip->i", weighed, steps))
        fisher = np.einsum("ip,jp->ij", weighed, steps) * np.outer(scale, scale)
        cross = weighed @ change.reshape(len(names), -1).T * scale[:, None]
        out[index, moved] = -np.linalg.solve(fisher, cross) * scale[:, None]
    return out[:, :4]


def peak_response(model: ForwardModel, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Change of the peak contrast that a calibration of masses is about.

    The peak is a maximum, so that its place may be held.

    Parameters
    ----------
    model : ForwardModel
        With a reference.
    names : sequence of str
        Parameters of the optics.

    Returns
    -------
    linear, quadratic : ndarray, shape (len(names),)
        Derivatives of L and Q in C = L·a + Q·a² (`MassScale`) at the particle's height.
    """
    plain = replace(model, scale=MassScale())
    unit = model.optics.wavelength_nm / model.optics.na
    weak = 1e-6 / np.sqrt(model.collected_area_nm2(model.height_nm, 1.0))
    half = min(_PEAK_REACH * unit, model.reach_nm / np.sqrt(2) - unit / _POINTS)
    axis = np.arange(-half, half, unit / _POINTS)
    plane = PixelGrid(axis, axis, unit / _POINTS)
    image = model.amplitude_image(plane, 0.0, 0.0, model.height_nm, weak)
    row, column = np.unravel_index(np.argmax(np.abs(image)), image.shape)
    place = PixelGrid(axis[[column]], axis[[row]], 1.0)

    def slope(amplitude: float) -> FloatArray:
        found = plain.optics_gradient(place, 0.0, 0.0, model.height_nm, amplitude, names)[1]
        return np.asarray(found[:, 0, 0] / amplitude)

    strong = 1e5 * weak
    above, below = slope(strong), slope(-strong)
    return (above + below) / 2, (above - below) / (2 * strong)
