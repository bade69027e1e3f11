"""The table of moving particles, and what the path within an exposure adds to its errors.

A blurred picture has the spread q = D E/3 that paths have on average.  That of one frame,
S_ab = mean of (r − r̄)_a (r − r̄)_b, differs from it: with the eigenvalues 2 D E/(π² n²) of Brownian
motion about its mean, Var S_aa = 4q²/5 and Var S_ab = 2q²/5, all of them uncorrelated.  To first
order the picture changes by ½ (S − q)_ab ∂a∂b C and, with the third moments M_abc, by
M_abc ∂a∂b∂c C/6, and the estimate by F⁻¹ Σ ∂C·change/(1 + C).  Where z is free the phase of the
interference turns so fast that this limits bright particles, and no frame tells it.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincc, ndtr

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.fit import OUTWARD, POOR_FIT_P
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import PATH_SPREAD, blurred, collected_area_nm2
from iscat_analysis.pieces.regions import saturated_near
from iscat_analysis.records import PARAMETERS, BoolArray, FloatArray, Status, make_rows, verdict
from iscat_analysis.tracking.joint import variances_left
from iscat_analysis.tracking.linking import has_other_mass
from iscat_analysis.tracking.stages import TrackedRows

ALONG = math.sqrt(4 / 5)
"""Standard deviation over its mean of a path's variance along one axis."""

ACROSS = math.sqrt(2 / 5)
"""The same of its covariance along two, over the mean variance of one."""

SKEW, SKEW_ACROSS = math.sqrt(0.90), math.sqrt(0.241)
"""Root mean squares of the third moments M_zzz and M_xzz over q to the power 3/2, of 2·10⁴ paths of
400 steps each."""

_STEP_NM = 2.0  # along z, of differences


def path_shifts(
    model: ForwardModel,
    roi_px: int,
    pixel_nm: float,
    z_nm: FloatArray,
    amplitude: float,
    variance_nm2: float,
    read_share: float = 0.0,
) -> FloatArray:
    """Shift of fits by each standard deviation of the unknown paths of their exposures.

    The first three are of the variances of a path along x, y and z.

    Shapes: `z_nm` (n,), result (n, 4, 9).
    """
    grid, q = PixelGrid.centred(roi_px | 1, pixel_nm), variance_nm2

    def at(z: float) -> FloatArray:
        signal, slopes, second = model.amplitude_hessian(grid, 0.0, 0.0, z, amplitude)
        low, high = (
            model.amplitude_hessian(grid, 0.0, 0.0, z + step, amplitude)[2]
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

    # 8 heights in a fringe, linear in between
    count = max(2, math.ceil(np.ptp(z_nm) / model.fringe_nm * 8) + 1)
    heights = np.linspace(z_nm.min(), max(z_nm.max(), z_nm.min() + _STEP_NM), count)
    table = np.stack([at(z) for z in heights.tolist()])
    return np.asarray(scipy.interpolate.make_interp_spline(heights, table, k=1)(z_nm))


LARGEST_LOSS = 0.2
"""Share of the mass that a picture which knew nothing of blur would miss, beyond which the average
over a normal spread no longer describes the path: it is too dark by a fifth of the square of this
share, 1 %."""

_APART = 0.05  # relative step of a blur


def moving_table(context: AnalysisContext, moving: TrackedRows, first_frame: int) -> pd.DataFrame:
    """Make a line of ``fits.csv`` for every row, without its number and its verdict.

    Notes
    -----
    Errors hold what is not known of the path in a single frame, on a membrane that of the mass,
    `PATH_SPREAD`, in a volume those of the place too, `path_covariances`; and what the background
    takes.
    """
    rows, judged, field = moving.rows, moving.judged, moving.field
    model, pixel, free = context.model, context.pixel_nm, moving.field.free[:4]
    index = np.flatnonzero(free)
    n = len(rows.frame)
    slope = np.abs(model.scale.slopes(rows.theta[:, 3]))
    units = np.column_stack([np.ones((n, 3)), slope])
    sigma = np.sqrt(variances_left(judged.observed, index)) * units
    crb = np.sqrt(variances_left(judged.fisher, index)) * units
    small = np.all(np.abs(judged.bias * units)[:, index] <= sigma[:, index], axis=1)
    shift = (small & ~field.on_wall(rows)).astype(float)  # else the expansion means nothing
    estimate = rows.theta[:, :4] - judged.bias * shift[:, None]
    mass = model.scale.mass(estimate[:, 3])
    losses = losses_to_blur(context, moving)[rows.group]
    own = np.sqrt(np.einsum("nii->ni", moving.shared))
    more = np.hypot(_path_errors(context, moving, losses), own) * units
    sigma, crb = np.hypot(sigma, more), np.hypot(crb, more)
    freedom = np.maximum(judged.pixels - index.size, 1)
    p_value = _p_values(judged.chi2, freedom, judged.worst, judged.pixels)
    place, z, amplitude = estimate[:, :2], estimate[:, 2], estimate[:, 3]
    collected = judged.level / pixel**2 * collected_areas(model, z, amplitude)
    columns: dict[str, object] = {"track": rows.track, "frame": rows.frame + first_frame}
    columns |= {"n_before": np.full(n, field.frames), "n_after": np.ones(n, dtype=int)}
    columns |= dict(zip(("x_px", "y_px"), place.T / pixel, strict=True))
    columns |= dict(zip(PARAMETERS, (*place.T, z, mass), strict=True))
    columns |= {"contrast": _contrasts(model, z, amplitude), "n_scattered": collected}
    columns |= {"snr": np.sqrt(2 * np.maximum(judged.gain, 0.0)), "p_value": p_value}
    columns |= {"chi2_reduced": judged.chi2 / freedom}
    columns["flags"] = _flags(context, moving, sigma, p_value, losses)
    quantum = quantum_bounds(model, z, mass, collected, free)
    for k, name in enumerate(PARAMETERS):
        columns[f"sigma_{name}"], columns[f"crb_{name}"] = sigma[:, k], crb[:, k]
        columns[f"qcrb_{name}"] = quantum[:, k]
    return pd.DataFrame(columns)


def table_of_tracks(
    lines: pd.DataFrame,
    track: NDArray[np.int64],
    inside: BoolArray,
    min_frames: int,
    *,
    parted: bool,
) -> pd.DataFrame:
    """Give the tracks of a movie numbers, drop short ones, and add verdicts to their rows.

    Shapes: `track` (n,), `inside` (n,).
    """
    table = lines.assign(event=track, track=track)[inside]
    seen = table.groupby("track")["frame"].transform("size")
    table = table[seen >= min_frames]
    table = table.sort_values(["track", "frame"], kind="stable").reset_index(drop=True)
    texts = table["flags"]
    if parted:
        names = ("track", "mass_kda", "crb_mass_kda")
        off = has_other_mass(*(table[name].to_numpy() for name in names))
        texts = texts.where(~off, texts + f";{Status.TOO_CLOSE}")
    judged = {text: verdict(map(Status, filter(None, text.split(";")))) for text in texts.unique()}
    status = texts.map({text: str(status) for text, (status, _) in judged.items()})
    flags = texts.map({text: ";".join(map(str, own)) for text, (_, own) in judged.items()})
    return make_rows(table, {"status": status, "flags": flags})


def common_masses(context: AnalysisContext, moving: TrackedRows) -> pd.DataFrame:
    """Give the mass of each track that the exact likelihood of all its frames has."""
    common, scale = moving.common, context.model.scale
    known = np.isfinite(common.amplitude)
    amplitude = np.where(known, common.amplitude, 1.0)
    mass = np.where(known, scale.mass(amplitude), np.nan)
    slope = np.abs(scale.slopes(amplitude))
    rows, losses = moving.rows, losses_to_blur(context, moving)
    group = np.zeros(len(mass), dtype=np.int64)
    group[rows.track] = rows.group
    d, sigma_d = np.nan_to_num(moving.diffusion).T
    strength = np.abs(rows.theta[:, 3])
    # a fit that ended fainter than 1e-3 of the brightest row tells nothing of its path
    strength = np.maximum(strength, 1e-3 * strength.max(initial=1e-9))
    share = (_path_errors(context, moving, losses[rows.group])[:, 3] / strength) ** 2
    total, count = (np.bincount(rows.track, w, minlength=len(mass)) for w in (share, None))
    path = total / np.maximum(count, 1) / np.maximum(common.frames, 1.0)
    blur = (losses[group] * np.where(d > 0, sigma_d / np.where(d > 0, d, 1.0), 0.0)) ** 2
    sigma = np.sqrt(common.variance * slope**2 + mass**2 * (path + blur))
    table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": sigma, "crb_mass_kda": sigma})
    table["blur"] = (d > 0).astype(float)
    table["told"] = np.where(known, common.known / common.variance, np.nan)
    return table.rename_axis("track")


def losses_to_blur(context: AnalysisContext, moving: TrackedRows) -> FloatArray:
    """Share of the mass that the blur of each group takes, to first order: −d ln m / d ln q.

    Shapes: result (groups,).
    """
    upwards = bool(moving.field.free[2])
    each = [loss_to_blur(context, float(q), upwards=upwards) for q in moving.variances_nm2]
    return np.array(each, dtype=np.float64)


def loss_to_blur(context: AnalysisContext, variance_nm2: float, *, upwards: bool) -> float:
    """Share of the mass that a blur takes, to first order."""
    model, grid = context.model, PixelGrid.centred(context.roi_px | 1, context.pixel_nm)
    z, amplitude = model.height_nm, model.scale.amplitude(model.material.mass_kda)
    low, mid, high = (
        blurred(model, variance_nm2 * factor, upwards=upwards).amplitude_image(
            grid, 0.0, 0.0, z, amplitude
        )
        for factor in (1 - _APART, 1.0, 1 + _APART)
    )
    return abs(float(np.sum(mid * (low - high)) / (2 * _APART * np.sum(mid**2))))


def _path_errors(context: AnalysisContext, moving: TrackedRows, losses: FloatArray) -> FloatArray:
    """Errors of (x, y, z, a) of each row that the unknown path of its exposure makes, (n, 4)."""
    rows, out = moving.rows, np.zeros((len(losses), 4))
    if not moving.field.free[2]:
        out[:, 3] = PATH_SPREAD * losses * np.abs(rows.theta[:, 3])
        return out
    level = np.median(np.maximum(moving.judged.level, 1.0)) if len(out) else 1.0
    read_share = float(np.median(moving.field.read_e2) / level)
    for number in np.unique(rows.group[moving.smear_nm > 0]):
        q, mine = float(moving.variances_nm2[number]), rows.group == number
        amplitude, model = (
            float(np.median(rows.theta[mine, 3])),
            blurred(context.model, q, upwards=True),
        )
        where = model, context.roi_px, context.pixel_nm, rows.theta[mine, 2]
        out[mine] = np.linalg.norm(path_shifts(*where, amplitude, q, read_share), axis=2)
    return out


def _p_values(
    chi2: FloatArray, freedom: FloatArray, worst: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Join Pearson's χ², two-sided, and the largest residual by Šidák's rule."""
    above, below = gammaincc(freedom / 2, chi2 / 2), gammainc(freedom / 2, chi2 / 2)
    spread = np.minimum(2 * np.minimum(above, below), 1.0)
    outlier = -np.expm1(pixels * np.log1p(-np.minimum(2 * ndtr(-worst), 1 - 1e-16)))
    least = np.minimum(np.minimum(spread, outlier), 1 - 1e-16)
    return np.asarray(-np.expm1(2 * np.log1p(-least)))


def _off_line(context: AnalysisContext, moving: TrackedRows, sigma_kda: FloatArray) -> BoolArray:
    """Tell which masses the calibration cannot determine, by the mass of the track where known."""
    track, common, scale = moving.rows.track, moving.common, context.model.scale
    own, shared = moving.rows.theta[:, 3], common.amplitude[track]
    known = np.isfinite(shared)
    slope = np.abs(scale.slopes(np.where(known, shared, own)))
    sigma = np.where(known, np.sqrt(common.variance[track]) * slope, sigma_kda)
    return scale.off_line(np.where(known, shared, own), sigma, OUTWARD)


def _flags(
    context: AnalysisContext,
    moving: TrackedRows,
    sigma: FloatArray,
    p_value: FloatArray,
    losses: FloatArray,
) -> pd.Series[str]:
    """Join the flags of each row with semicolons."""
    rows, free = moving.rows, np.flatnonzero(moving.field.free[:4])
    lost = ~moving.done | ~np.isfinite(sigma[:, free]).all(axis=1)
    poor = (p_value < POOR_FIT_P) | (losses > LARGEST_LOSS)
    field = moving.field
    outside = field.on_wall(rows)
    if moving.field.free[3]:
        outside |= _off_line(context, moving, sigma[:, 3])
    too_bright = np.zeros(len(rows.frame), dtype=np.bool_)
    if field.saturated.any():
        too_bright[:] = [
            saturated_near(field.saturated, x, y, field.pixel_nm) for x, y in rows.theta[:, :2]
        ]
    marks = (
        (lost, Status.NOT_CONVERGED),
        (outside, Status.AT_BOUND),
        (too_bright, Status.SATURATED),
        (poor, Status.POOR_FIT),
        (moving.close, Status.TOO_CLOSE),
    )
    flags = pd.Series("", index=range(len(lost)))
    for applies, mark in marks:
        flags[applies] += f";{mark}"
    return flags.str.lstrip(";")


def _contrasts(model: ForwardModel, z_nm: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Peak contrasts; at one height its two parts grow with the amplitude and its square."""
    if len(z_nm) and np.ptp(z_nm) == 0:
        middle = float(np.median(amplitude))
        linear, quadratic = model.wave.peak(float(z_nm[0]), middle, model.rho)
        share = amplitude / middle
        return np.asarray(linear * share + quadratic * share**2)
    pairs = zip(z_nm.tolist(), amplitude.tolist(), strict=True)
    return np.array([model.amplitude_contrast(z, a, "between") for z, a in pairs])


def _heights(z_nm: FloatArray) -> FloatArray:
    """Heights between which smooth functions of z are interpolated; noise may put z below 0."""
    if not len(z_nm):
        return np.zeros(1)
    low, high = np.maximum([z_nm.min(), z_nm.max()], 0.0).tolist()
    # linear between 65 heights
    return np.array([low]) if low == high else np.linspace(low, high, 65)


def collected_areas(model: ForwardModel, z_nm: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Give the collected light as an area of background [nm²]."""
    heights = _heights(z_nm)
    nominal = model.material.mass_kda
    unit = [collected_area_nm2(model, float(z), nominal) for z in heights]
    scale = amplitude / model.scale.amplitude(nominal)
    return np.asarray(np.interp(z_nm, heights, unit) * scale**2)


def quantum_bounds(
    model: ForwardModel, z_nm: FloatArray, mass: FloatArray, collected: FloatArray, free: BoolArray
) -> FloatArray:
    """Quantum bounds, shape (n, 4); NaN where not free."""
    heights = _heights(z_nm)
    kept = np.array([np.diag(quantum_information(model, float(z)).real) for z in heights])
    out = np.full((len(z_nm), 4), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in np.flatnonzero(free):
            out[:, k] = 1 / np.sqrt(collected * np.interp(z_nm, heights, kept[:, k]))
        if free[3]:
            out[:, 3] *= np.abs(mass)  # of a relative step
    return out
