"""From the fits of particles that move to the table, one row for each particle and frame."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.special import gammainc, gammaincc, ndtr

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.inference.fit import POOR_FIT_P
from iscat_analysis.optics.blur import PATH_SPREAD, blurred
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.pipeline.linking import crowded, shares_mass
from iscat_analysis.pipeline.moving import Moving
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import EVENT_COLUMNS, PARAMETERS, BoolArray, FloatArray, Status, verdict

LARGEST_LOSS = 0.2
"""Share of the mass that a picture which knew nothing of blur would miss, beyond which the average
over a normal spread no longer describes the path: it is too dark by a fifth of the square of this
share, 1 %."""

_HEIGHTS = 65  # at which quantum bounds are computed where z is free; linear in between
_TESTS = 2
_APART = 0.05  # relative step of a blur


def moving_table(scene: Scene, moving: Moving, first_frame: int) -> pd.DataFrame:
    """Make the rows of ``fits.csv``.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving.track_scene`.
    moving : Moving
        From `iscat_analysis.pipeline.moving.follow`.
    first_frame : int
        Number in the movie of the first frame that was analysed.

    Returns
    -------
    pandas.DataFrame
        Columns `EVENT_COLUMNS`, and ``track``; ``event`` is the track too.  Rows whose particle is
        outside the field are left out: they were fitted for the sake of the others.  So are tracks
        with fewer than `track.min_frames` in the field.

    Notes
    -----
    Errors of the mass hold what is not known of the path in a single frame, `PATH_SPREAD`; all
    errors hold what the background takes.
    """
    rows, judged, field = moving.rows, moving.judged, moving.field
    model, pixel, free = scene.model, scene.pixel_nm, moving.field.free[:4]
    index = np.flatnonzero(free)
    n, amplitude = len(rows.frame), rows.theta[:, 3]
    slope = np.array([abs(model.scale.slope(float(a))) for a in amplitude])
    units = np.column_stack([np.ones((n, 3)), slope])
    sigma = np.sqrt(diagonal(judged.observed, index)) * units
    crb = np.sqrt(diagonal(judged.fisher, index)) * units
    small = np.all(np.abs(judged.bias * units)[:, index] <= sigma[:, index], axis=1)
    shift = (small & ~field.on_wall(rows)).astype(float)  # else the expansion means nothing
    estimate = rows.theta[:, :4] - judged.bias * shift[:, None]
    mass = model.scale.mass(estimate[:, 3])
    losses = losses_to_blur(scene, moving)[rows.group]
    path = PATH_SPREAD * losses * np.abs(mass)
    sigma[:, 3], crb[:, 3] = np.hypot(sigma[:, 3], path), np.hypot(crb[:, 3], path)
    own = np.sqrt(np.einsum("nii->ni", moving.shared)) * units
    sigma, crb = np.hypot(sigma, own), np.hypot(crb, own)
    freedom = np.maximum(judged.pixels - index.size, 1)
    p_value = _p_values(judged.chi2, freedom, judged.worst, judged.pixels)
    collected = judged.level / pixel**2 * _areas(model, estimate[:, 2], mass)
    statuses = [verdict(flags) for flags in _flags(scene, moving, sigma, p_value, losses)]
    columns: dict[str, object] = {
        "event": rows.track, "frame": rows.frame + first_frame,
        "n_before": np.full(n, field.frames), "n_after": np.ones(n, dtype=int),
        "x_px": estimate[:, 0] / pixel, "y_px": estimate[:, 1] / pixel,
        "x_nm": estimate[:, 0], "y_nm": estimate[:, 1], "z_nm": estimate[:, 2], "mass_kda": mass,
        "contrast": _contrasts(model, estimate[:, 2], estimate[:, 3]),
        "n_scattered": collected, "snr": np.sqrt(2 * np.maximum(judged.gain, 0.0)),
        "chi2_reduced": judged.chi2 / freedom, "p_value": p_value,
        "status": [str(status) for status, _ in statuses],
        "flags": [";".join(str(flag) for flag in flags) for _, flags in statuses],
    }  # fmt: skip
    quantum = _quantum(model, estimate[:, 2], mass, collected, free)
    for k, name in enumerate(PARAMETERS):
        columns[f"sigma_{name}"], columns[f"crb_{name}"] = sigma[:, k], crb[:, k]
        columns[f"qcrb_{name}"] = quantum[:, k]
    table = pd.DataFrame(columns)[list(EVENT_COLUMNS)].assign(track=rows.track)
    size = np.array([field.used.shape[1], field.used.shape[0]])
    places = rows.theta[:, :2] / pixel
    inside = np.all((places >= -0.5) & (places < size - 0.5), axis=1)
    table = table[inside]
    seen = table.groupby("track")["frame"].transform("size")
    table = table[seen >= scene.config.track.min_frames]
    return table.sort_values(["track", "frame"], kind="stable").reset_index(drop=True)


def common_masses(scene: Scene, moving: Moving) -> pd.DataFrame:
    """Give the mass of each track that the exact likelihood of all its frames has.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving.track_scene`.
    moving : Moving
        From `iscat_analysis.pipeline.moving.follow`.

    Returns
    -------
    pandas.DataFrame
        By track: ``mass_kda``, ``sigma_mass_kda`` and ``crb_mass_kda``.  The errors hold what the
        background takes, the paths of single frames and the error of D, which sets the blur.
    """
    common, scale = moving.common, scene.model.scale
    known = np.isfinite(common.amplitude)
    amplitude = np.where(known, common.amplitude, 1.0)
    mass = np.where(known, scale.mass(amplitude), np.nan)
    slope = np.array([abs(scale.slope(float(a))) for a in amplitude])
    tracks = np.arange(len(mass))
    group = np.zeros(len(mass), dtype=np.int64)
    group[moving.rows.track] = moving.rows.group
    loss = losses_to_blur(scene, moving)[group] if len(mass) else np.zeros(0)
    d, sigma_d = np.nan_to_num(moving.diffusion).T if len(mass) else np.zeros((2, 0))
    path = (PATH_SPREAD * loss) ** 2 / np.maximum(common.frames, 1.0)
    blur = (loss * np.where(d > 0, sigma_d / np.where(d > 0, d, 1.0), 0.0)) ** 2
    sigma = np.sqrt(common.variance * slope**2 + mass**2 * (path + blur))
    table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": sigma, "crb_mass_kda": sigma})
    return table.set_index(pd.Index(tracks, name="track"))


def losses_to_blur(scene: Scene, moving: Moving) -> FloatArray:
    """Share of the mass that the blur of each group takes, to first order: −d ln m / d ln q.

    Parameters
    ----------
    scene : Scene
        Its model is the sharp one.
    moving : Moving
        Knows the blurs.

    Returns
    -------
    ndarray, shape (groups,)
        Where the variance of the path changes by a small share, the fitted mass does by this times
        that.
    """
    model, grid = scene.model, PixelGrid.centred(scene.roi_px | 1, scene.pixel_nm)
    z, amplitude = model.height_nm, model.scale.amplitude(model.material.mass_kda)
    out = []
    for q in moving.variances_nm2:
        upwards = bool(moving.field.free[2])
        low, mid, high = (
            blurred(model, float(q) * factor, upwards=upwards).amplitude_image(
                grid, 0.0, 0.0, z, amplitude
            )
            for factor in (1 - _APART, 1.0, 1 + _APART)
        )
        out.append(float(np.sum(mid * (low - high)) / (2 * _APART * np.sum(mid**2))))
    return np.abs(np.array(out, dtype=np.float64))


def diagonal(information: FloatArray, index: np.ndarray) -> FloatArray:
    """Variances that matrices of information leave, shape (n, 4).

    Parameters
    ----------
    information : ndarray, shape (n, 4, 4)
        In (x, y, z, a).
    index : ndarray of int
        Free parameters.

    Returns
    -------
    ndarray, shape (n, 4)
        NaN where not free, or where a matrix is not positive definite.
    """
    out = np.full(information.shape[:2], np.nan)
    part = information[:, index][:, :, index]
    scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-300))
    scaled = part * scale[:, :, None] * scale[:, None, :]
    good = np.flatnonzero(np.isfinite(scaled).all(axis=(1, 2)))
    if not good.size:
        return out
    values = np.linalg.eigvalsh(scaled[good])
    good = good[values[:, 0] > 1e-9]
    inverse = np.einsum("nii->ni", np.linalg.inv(scaled[good])) * scale[good] ** 2
    out[good[:, None], index[None]] = inverse
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


def _flags(
    scene: Scene, moving: Moving, sigma: FloatArray, p_value: FloatArray, losses: FloatArray
) -> list[list[Status]]:
    """Gather what is to be remarked on each row."""
    rows, free = moving.rows, np.flatnonzero(moving.field.free[:4])
    lost = ~moving.converged | ~np.isfinite(sigma[:, free]).all(axis=1)
    poor = (p_value < POOR_FIT_P) | (losses > LARGEST_LOSS)
    close = crowded(rows, moving.field, scene.config.detection.min_separation_nm)
    close |= shares_mass(rows, moving.judged)
    bound = moving.field.on_wall(rows)
    marks = (
        (lost, Status.NOT_CONVERGED), (bound, Status.AT_BOUND), (poor, Status.POOR_FIT),
        (close, Status.TOO_CLOSE),
    )  # fmt: skip
    return [[mark for told, mark in marks if told[i]] for i in range(len(rows.frame))]


def _contrasts(model: ForwardModel, z_nm: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Peak contrasts; at one height its two parts grow with the amplitude and its square."""
    if len(z_nm) and np.ptp(z_nm) == 0:
        middle = float(np.median(amplitude))
        linear, quadratic = model.wave.peak(float(z_nm[0]), middle, model.rho)
        share = amplitude / middle
        return np.asarray(linear * share + quadratic * share**2)
    pairs = zip(z_nm.tolist(), amplitude.tolist(), strict=True)
    return np.array([model.amplitude_contrast(z, a) for z, a in pairs])


def _heights(z_nm: FloatArray) -> FloatArray:
    """Heights between which smooth functions of z are interpolated."""
    if not len(z_nm):
        return np.zeros(1)
    low, high = float(z_nm.min()), float(z_nm.max())
    return np.array([low]) if low == high else np.linspace(low, high, _HEIGHTS)


def _areas(model: ForwardModel, z_nm: FloatArray, mass_kda: FloatArray) -> FloatArray:
    """Give the collected light as an area of background [nm²]."""
    heights = _heights(z_nm)
    nominal = model.material.mass_kda
    unit = [model.collected_area_nm2(float(z), nominal) for z in heights]
    scale = [model.scale.amplitude(float(m)) / model.scale.amplitude(nominal) for m in mass_kda]
    return np.asarray(np.interp(z_nm, heights, unit) * np.array(scale) ** 2)


def _quantum(
    model: ForwardModel, z_nm: FloatArray, mass: FloatArray, collected: FloatArray, free: BoolArray
) -> FloatArray:
    """Quantum bounds, shape (n, 4); NaN where not free."""
    heights = _heights(z_nm)
    kept = np.array([np.diag(quantum_information(model, float(z)).real) for z in heights])
    out = np.full((len(z_nm), 4), np.nan)
    for k in np.flatnonzero(free):
        light = collected * np.interp(z_nm, heights, kept[:, k])
        with np.errstate(divide="ignore", invalid="ignore"):
            out[:, k] = 1 / np.sqrt(light)
    if free[3]:
        out[:, 3] *= np.abs(mass)  # of a relative step
    return out
