"""The table of moving particles: one row for each particle and frame."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincc, ndtr

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.fit import OUTWARD, POOR_FIT_P
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import PATH_SPREAD, blurred, collected_area_nm2
from iscat_analysis.pieces.regions import saturated_near
from iscat_analysis.records import PARAMETERS, BoolArray, FloatArray, Status, make_rows, verdict
from iscat_analysis.tracking.joint.common import variances_left
from iscat_analysis.tracking.linking import has_other_mass
from iscat_analysis.tracking.moving import TrackedRows
from iscat_analysis.tracking.paths import path_covariances

LARGEST_LOSS = 0.2
"""Share of the mass that a picture which knew nothing of blur would miss, beyond which the average
over a normal spread no longer describes the path: it is too dark by a fifth of the square of this
share, 1 %."""

_FAINTEST = 1e-3  # of the brightest row: a fit that ended fainter tells nothing of its path
_HEIGHTS = 65  # at which quantum bounds are computed where z is free; linear in between
_TESTS = 2
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
    n, amplitude = len(rows.frame), rows.theta[:, 3]
    slope = np.abs(model.scale.slopes(amplitude))
    units = np.column_stack([np.ones((n, 3)), slope])
    sigma = np.sqrt(variances_left(judged.observed, index)) * units
    crb = np.sqrt(variances_left(judged.fisher, index)) * units
    small = np.all(np.abs(judged.bias * units)[:, index] <= sigma[:, index], axis=1)
    shift = (small & ~field.on_wall(rows)).astype(float)  # else the expansion means nothing
    estimate = rows.theta[:, :4] - judged.bias * shift[:, None]
    mass = model.scale.mass(estimate[:, 3])
    losses = losses_to_blur(context, moving)[rows.group]
    path = _path_errors(context, moving, losses) * units
    sigma, crb = np.hypot(sigma, path), np.hypot(crb, path)
    own = np.sqrt(np.einsum("nii->ni", moving.shared)) * units
    sigma, crb = np.hypot(sigma, own), np.hypot(crb, own)
    freedom = np.maximum(judged.pixels - index.size, 1)
    p_value = _p_values(judged.chi2, freedom, judged.worst, judged.pixels)
    collected = judged.level / pixel**2 * collected_areas(model, estimate[:, 2], estimate[:, 3])
    columns: dict[str, object] = {
        "track": rows.track, "frame": rows.frame + first_frame,
        "n_before": np.full(n, field.frames), "n_after": np.ones(n, dtype=int),
        "x_px": estimate[:, 0] / pixel, "y_px": estimate[:, 1] / pixel,
        "x_nm": estimate[:, 0], "y_nm": estimate[:, 1], "z_nm": estimate[:, 2], "mass_kda": mass,
        "contrast": _contrasts(model, estimate[:, 2], estimate[:, 3]),
        "n_scattered": collected, "snr": np.sqrt(2 * np.maximum(judged.gain, 0.0)),
        "chi2_reduced": judged.chi2 / freedom, "p_value": p_value,
        "flags": _flags(context, moving, sigma, p_value, losses),
    }  # fmt: skip
    quantum = quantum_bounds(model, estimate[:, 2], mass, collected, free)
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
    off = np.zeros(len(table), dtype=np.bool_)
    if parted:
        names = ("track", "mass_kda", "crb_mass_kda")
        off = has_other_mass(*(table[name].to_numpy() for name in names))
    numbers, texts = pd.factorize(table["flags"])
    judged = [_verdict(text, shared) for text in texts for shared in (False, True)]
    status = [str(status) for status, _ in judged]
    flags = [";".join(map(str, flags)) for _, flags in judged]
    status, flags = (np.array(each, dtype=object)[2 * numbers + off] for each in (status, flags))
    return make_rows(table, {"status": status, "flags": flags})


def _verdict(flags: str, shared: bool) -> tuple[Status, tuple[Status, ...]]:
    """Derive status and flags of rows; one flag may be that the mass is shared."""
    own = [Status(flag) for flag in flags.split(";") if flag]
    return verdict([*own, Status.TOO_CLOSE] if shared else own)


def common_masses(context: AnalysisContext, moving: TrackedRows) -> pd.DataFrame:
    """Give the mass of each track that the exact likelihood of all its frames has."""
    common, scale = moving.common, context.model.scale
    known = np.isfinite(common.amplitude)
    amplitude = np.where(known, common.amplitude, 1.0)
    mass = np.where(known, scale.mass(amplitude), np.nan)
    slope = np.abs(scale.slopes(amplitude))
    tracks = np.arange(len(mass))
    group = np.zeros(len(mass), dtype=np.int64)
    group[moving.rows.track] = moving.rows.group
    loss = losses_to_blur(context, moving)[group] if len(mass) else np.zeros(0)
    d, sigma_d = np.nan_to_num(moving.diffusion).T if len(mass) else np.zeros((2, 0))
    rows = moving.rows
    each = _path_errors(context, moving, losses_to_blur(context, moving)[rows.group])[:, 3]
    strength = np.abs(rows.theta[:, 3])
    share = (each / np.maximum(strength, _FAINTEST * strength.max(initial=1e-9))) ** 2
    count = np.maximum(np.bincount(rows.track, minlength=len(mass)), 1)
    path = np.bincount(rows.track, weights=share, minlength=len(mass)) / count
    path /= np.maximum(common.frames, 1.0)
    blur = (loss * np.where(d > 0, sigma_d / np.where(d > 0, d, 1.0), 0.0)) ** 2
    sigma = np.sqrt(common.variance * slope**2 + mass**2 * (path + blur))
    table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": sigma, "crb_mass_kda": sigma})
    table["blur"] = (d > 0).astype(float)
    table["told"] = np.where(known, common.known / common.variance, np.nan)
    return table.set_index(pd.Index(tracks, name="track"))


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
    out = np.zeros((len(losses), 4))
    if moving.field.free[2]:
        return np.asarray(np.sqrt(np.einsum("nii->ni", path_covariances(context, moving))))
    out[:, 3] = PATH_SPREAD * losses * np.abs(moving.rows.theta[:, 3])
    return out


def _p_values(
    chi2: FloatArray, freedom: FloatArray, worst: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Join Pearson's χ², two-sided, and the largest residual by Šidák's rule."""
    above, below = gammaincc(freedom / 2, chi2 / 2), gammainc(freedom / 2, chi2 / 2)
    spread = np.minimum(2 * np.minimum(above, below), 1.0)
    outlier = -np.expm1(pixels * np.log1p(-np.minimum(2 * ndtr(-worst), 1 - 1e-16)))
    least = np.minimum(np.minimum(spread, outlier), 1 - 1e-16)
    return np.asarray(-np.expm1(_TESTS * np.log1p(-least)))


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
) -> NDArray[np.object_]:
    """Join the flags of each row with semicolons."""
    rows, free = moving.rows, np.flatnonzero(moving.field.free[:4])
    lost = ~moving.converged | ~np.isfinite(sigma[:, free]).all(axis=1)
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
        (lost, Status.NOT_CONVERGED), (outside, Status.AT_BOUND),
        (too_bright, Status.SATURATED), (poor, Status.POOR_FIT), (moving.close, Status.TOO_CLOSE),
    )  # fmt: skip
    texts = [""]  # of every set of remarks; in the number of one, each remark has its bit
    for _, mark in marks:
        texts += [f"{text};{mark}".lstrip(";") for text in texts]
    numbers = sum(applies.astype(np.int64) << bit for bit, (applies, _) in enumerate(marks))
    return np.asarray(np.array(texts, dtype=object)[numbers])


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
    return np.array([low]) if low == high else np.linspace(low, high, _HEIGHTS)


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
