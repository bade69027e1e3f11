"""What the path of a single exposure, of which only the mean is fitted, does to a fit.

A blurred picture has the spread q = D E/3 that paths have on average.  That of one frame,
S_ab = mean of (r − r̄)_a (r − r̄)_b, differs from it: with the eigenvalues 2 D E/(π² n²) of Brownian
motion about its mean, Var S_aa = 4q²/5 and Var S_ab = 2q²/5, all of them uncorrelated.  To first
order the picture changes by ½ (S − q)_ab ∂a∂b C and, with the third moments M_abc, by
M_abc ∂a∂b∂c C/6, and the estimate by F⁻¹ Σ ∂C·change/(1 + C).  Where z is free the phase of the
interference turns so fast that this limits bright particles, and no frame tells it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import scipy

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import blurred
from iscat_analysis.records import FloatArray
from iscat_analysis.tracking.moving import TrackedRows

ALONG = math.sqrt(4 / 5)
"""Standard deviation over its mean of a path's variance along one axis."""

ACROSS = math.sqrt(2 / 5)
"""The same of its covariance along two, over the mean variance of one."""

SKEW, SKEW_ACROSS = math.sqrt(0.90), math.sqrt(0.241)
"""Root mean squares of the third moments M_zzz and M_xzz over q to the power 3/2, of 2·10⁴ paths of
400 steps each."""

_PER_FRINGE = 8  # heights at which errors are computed; linear in between
_STEP_NM = 2.0  # along z, of differences


def path_covariances(context: AnalysisContext, moving: TrackedRows) -> FloatArray:
    """Give the errors of rows that the unknown paths of their exposures make.

    Shapes: result (n, 4, 4).
    """
    rows = moving.rows
    out = np.zeros((len(rows.frame), 4, 4))
    level = np.maximum(moving.judged.level, 1.0)
    for number in np.unique(rows.group):
        q = float(moving.variances_nm2[number])
        mine = np.flatnonzero(rows.group == number)
        if q == 0 or not mine.size:
            continue
        model = blurred(context.model, q, upwards=True)
        covariance = partial(
            path_covariance, model, context.roi_px, context.pixel_nm,
            amplitude=float(np.median(rows.theta[mine, 3])), variance_nm2=q,
            read_share=float(np.median(moving.field.read_e2) / np.median(level)),
        )  # fmt: skip
        out[mine] = _interpolated(covariance, model, rows.theta[mine, 2])
    return out


def path_shifts_at(
    model: ForwardModel,
    roi_px: int,
    pixel_nm: float,
    z_nm: FloatArray,
    amplitude: float,
    variance_nm2: float,
) -> FloatArray:
    """Give `path_shifts` at many heights.

    Shapes: `z_nm` (n,), result (n, 4, 9).
    """
    shifts = partial(
        path_shifts, model, roi_px, pixel_nm, amplitude=amplitude, variance_nm2=variance_nm2
    )
    return _interpolated(shifts, model, z_nm)


def _interpolated(
    errors: Callable[[float], FloatArray], model: ForwardModel, z_nm: FloatArray
) -> FloatArray:
    """Compute errors at some heights, and interpolate linearly between them.

    Shapes: `z_nm` (n,), result (n, …).
    """
    count = max(2, math.ceil(np.ptp(z_nm) / model.fringe_nm * _PER_FRINGE) + 1)
    heights = np.linspace(z_nm.min(), max(z_nm.max(), z_nm.min() + _STEP_NM), count)
    table = np.stack([errors(height) for height in heights.tolist()])
    return np.asarray(scipy.interpolate.make_interp_spline(heights, table, k=1)(z_nm))


def path_covariance(
    model: ForwardModel,
    roi_px: int,
    pixel_nm: float,
    z_nm: float,
    amplitude: float,
    variance_nm2: float,
    read_share: float = 0.0,
) -> FloatArray:
    """Covariance of one fit that the unknown path of its exposure makes.

    Shapes: result (4, 4).
    """
    moved = path_shifts(model, roi_px, pixel_nm, z_nm, amplitude, variance_nm2, read_share)
    return np.asarray(moved @ moved.T)


def path_shifts(
    model: ForwardModel,
    roi_px: int,
    pixel_nm: float,
    z_nm: float,
    amplitude: float,
    variance_nm2: float,
    read_share: float = 0.0,
) -> FloatArray:
    """Shift of one fit by each standard deviation of the unknown path of its exposure.

    The first three are of its variances along x, y and z.

    Shapes: result (4, 9).
    """
    grid, q = PixelGrid.centred(roi_px | 1, pixel_nm), variance_nm2
    signal, slopes, second = model.amplitude_hessian(grid, 0.0, 0.0, z_nm, amplitude)
    low, high = (
        model.amplitude_hessian(grid, 0.0, 0.0, z_nm + step, amplitude)[2]
        for step in (-_STEP_NM, _STEP_NM)
    )
    third = (high - low) / (2 * _STEP_NM)  # ∂z of ∂a∂b
    skew = q**1.5
    changes = np.stack(
        [
            *(ALONG * q / 2 * second[a, a] for a in range(3)),
            *(ACROSS * q * second[a, b] for a, b in ((0, 1), (0, 2), (1, 2))),
            SKEW * skew / 6 * third[2, 2],
            *(SKEW_ACROSS * skew / 2 * third[a, 2] for a in (0, 1)),
        ]
    )
    weight = 1 / (1 + signal + read_share)
    fisher = np.einsum("ayx,byx,yx->ab", slopes, slopes, weight)
    scale = 1 / np.sqrt(np.diag(fisher))
    pulls = np.einsum("ayx,kyx,yx->ak", slopes, changes, weight) * scale[:, None]
    return np.asarray(np.linalg.solve(fisher * np.outer(scale, scale), pulls) * scale[:, None])
