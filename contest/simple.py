"""Estimators that are built in: this program's fit, and those that most laboratories use.

All but the first see the contrast image near the start that a detection would give.  Their
amplitudes become masses by one factor (see `estimators`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.signal import fftconvolve

from iscat_analysis.config import Optics
from iscat_analysis.pieces import compile_kernels, config_of, fit_particle, gather, psf
from iscat_analysis.records import PARAMETERS, Candidate, FloatArray, Status
from iscat_analysis.study import EstimatorSetup

REACH_PX = 3.0
"""A maximum is sought this far from the start [pixels]."""


LOST = {Status.NOT_CONVERGED, Status.AT_BOUND, Status.AMBIGUOUS_Z}
"""Fits without an estimate that a user would keep."""


Table = dict[str, FloatArray]
Cut = tuple[slice, slice]


def iscat(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> pd.DataFrame:
    """Fit the model by maximum likelihood from the start, as movies are fitted from detections.

    Shapes: `before, after` (n, y, x).
    """
    config = config_of(
        setup.optics, setup.particle, setup.camera, mode=setup.mode, z_range_nm=setup.z_range_nm,
        calibration=setup.calibration,
    )  # fmt: skip
    counts = gather(
        config, before, after, n_before=setup.n_before, n_after=setup.n_after,
        power_ratio=setup.n_after / max(setup.n_before, 1), level=setup.level_fitted,
    )  # fmt: skip
    compile_kernels(counts.model, heights="z_nm" in setup.free)
    pixel = setup.pixel_size_nm
    rows = np.full((len(before), 8), np.nan)
    for i, (x, y, z, mass) in enumerate(setup.start.tolist()):
        begin = Candidate(x / pixel, y / pixel, z, mass, 0.0)
        fit = fit_particle(
            counts.likelihood(i), begin, setup.mode, setup.z_range_nm, level=counts.level
        )
        if not LOST & set(fit.flags):
            rows[i] = fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda, *fit.sigma
    return pd.DataFrame(rows, columns=[*PARAMETERS, *(f"sigma_{name}" for name in PARAMETERS)])


def gauss_ls(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Fit a round Gaussian with a level to the contrast by least squares.

    Shapes: `before, after` (n, y, x).
    """
    images = setup.image(before, after)

    def residual(i: int, cut: Cut, model: FloatArray) -> tuple[FloatArray, Any]:
        return model - images[i][cut], 1.0

    return _fitted(images, setup, residual, is_standard=False)


def gauss_mle(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Fit the same to the counts with the particle, the background taken for known.

    The squared deviance residuals add up to −2 ln L of Poisson counts.

    Shapes: `before, after` (n, y, x).
    """
    background = np.maximum(before * (setup.n_after / max(setup.n_before, 1)), 1e-9)
    unit = background if setup.interferes else np.full_like(background, setup.n_after)

    def residual(i: int, cut: Cut, model: FloatArray) -> tuple[FloatArray, Any]:
        counts = after[i][cut]
        mean = np.maximum(background[i][cut] + unit[i][cut] * model, 1e-9)
        deviance = 2 * (mean - counts + counts * np.log(np.maximum(counts, 1e-12) / mean))
        r = np.sign(mean - counts) * np.sqrt(np.maximum(deviance, 0.0))
        near = np.abs(r) < 1e-6
        steep = np.where(near, 1 / np.sqrt(mean), (1 - counts / mean) / np.where(near, 1, r))
        return r, steep * unit[i][cut]

    return _fitted(setup.image(before, after), setup, residual, is_standard=True)


def _fitted(
    images: FloatArray,
    setup: EstimatorSetup,
    residual: Callable[[int, Cut, FloatArray], tuple[FloatArray, Any]],
    *,
    is_standard: bool,
) -> Table:
    """Fit a Gaussian of amplitude, centre, width and level to every region from its start.

    `residual` gives residuals and their derivatives by the model; they may be in standard errors.
    """
    pixel, starts = setup.pixel_size_nm, setup.start[:, :2] / setup.pixel_size_nm
    half = half_width(setup.optics, pixel)

    def fit(i: int) -> FloatArray:
        cut = around(images.shape[1:], starts[i], half)
        y, x = (np.arange(part.start, part.stop, dtype=float) for part in cut)
        scale = float(np.max(np.abs(images[i][cut]))) or 1.0
        weight = 1.0 if is_standard else 1 / scale

        def bell(p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            u, v = (x - p[1]) / p[3], ((y - p[2]) / p[3])[:, None]
            return u, v, np.exp(-(u**2 + v**2) / 2)

        def of(p: FloatArray) -> tuple[FloatArray, Any]:
            left, steep = residual(i, cut, scale * (p[0] * bell(p)[2] + p[4]))
            return weight * left.ravel(), weight * scale * np.ravel(steep)[:, None]

        def slopes(p: FloatArray) -> FloatArray:
            u, v, g = bell(p)
            by_width = p[0] * g / p[3]
            parts = (g, by_width * u, by_width * v, by_width * (u**2 + v**2), np.ones_like(g))
            return np.asarray(np.stack(parts, axis=-1).reshape(-1, 5) * of(p)[1])

        begin = [0.8 * setup.polarity, *starts[i], setup.psf_sigma_nm / pixel, 0.0]
        how: dict[str, Any] = {"method": "lm", "max_nfev": 200}
        found = least_squares(lambda p: of(p)[0], begin, slopes, **how)
        if not found.success or not np.all(np.isfinite(found.x)):
            return np.full((2, 5), np.nan)
        noise = 1.0 if is_standard else 2 * found.cost / max(found.fun.size - 5, 1)
        variance = np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * noise
        to_image = np.array([scale, pixel, pixel, pixel, scale])
        return np.asarray([found.x, np.sqrt(np.maximum(variance, 0.0))] * to_image)

    found = np.stack([fit(i) for i in range(len(images))])
    names = ("amplitude", "x_nm", "y_nm")
    values = {name: found[:, 0, k] for k, name in enumerate(names)}
    return values | {f"sigma_{name}": found[:, 1, k] for k, name in enumerate(names)}


def matched_filter(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Correlate with the expected image at the height of the start.

    Shapes: `before, after` (n, y, x).
    """
    images = setup.image(before, after)
    side = min(images.shape[1:]) // 2 * 2 - 1
    height = setup.particle.nominal_height_nm
    if "z_nm" not in setup.free:
        height = float(np.median(setup.start[:, 2]))
    template = psf(
        setup.optics, setup.particle, setup.camera, pixels=side, z_nm=height,
        calibration=setup.calibration,
    )  # fmt: skip
    template = template - template.mean()
    turned = template[None, ::-1, ::-1] / np.sum(template**2)
    return _highest(fftconvolve(images, turned, mode="same", axes=(1, 2)), setup, 1)


def dog(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Take the maximum of a difference of Gaussians.

    Shapes: `before, after` (n, y, x).
    """
    width = setup.psf_sigma_nm / setup.pixel_size_nm
    images = setup.image(before, after)
    # widths of the two Gaussians whose difference is nearest to a Laplacian (Marr & Hildreth
    # 1980)
    narrow, wide = (gaussian_filter(images, (0, s, s)) for s in (width, 1.6 * width))
    return _highest(narrow - wide, setup, setup.polarity)


def peak(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Take the highest pixel near the start.

    Shapes: `before, after` (n, y, x).
    """
    return _highest(setup.image(before, after), setup, setup.polarity, refined=False)


def centroid(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Move a disc to the centre of mass of the contrast in it, until it rests.

    Shapes: `before, after` (n, y, x).
    """
    images = setup.polarity * setup.image(before, after)
    images = images - np.median(images, axis=(1, 2), keepdims=True)
    pixel = setup.pixel_size_nm
    rows, columns = images.shape[1:]
    y, x = np.mgrid[:rows, :columns]
    reach = max(2.0, 2.5 * setup.psf_sigma_nm / pixel)
    out = np.full((len(images), 3), np.nan)
    for i, image in enumerate(images):
        column, row = setup.start[i, :2] / pixel
        for _ in range(10):
            disc = np.hypot(x - column, y - row) <= reach
            mass = np.maximum(image[disc], 0.0)
            if not mass.sum() > 0:
                break
            column = float(np.average(x[disc], weights=mass))
            row = float(np.average(y[disc], weights=mass))
            out[i] = column * pixel, row * pixel, setup.polarity * image[disc].sum()
    return _places(out)


def radial_symmetry(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Find the point nearest to all lines along gradients (Parthasarathy, Nat. Methods 2012).

    Shapes: `before, after` (n, y, x).
    """
    images, pixel = setup.image(before, after), setup.pixel_size_nm
    out = np.full((len(images), 2), np.nan)
    for i, image in enumerate(images):
        cut = around(image.shape, setup.start[i, :2] / pixel, half_width(setup.optics, pixel))
        part = image[cut]
        if min(part.shape) < 4:
            continue
        down = part[1:, 1:] - part[:-1, :-1]
        up = part[:-1, 1:] - part[1:, :-1]
        # on the corners between pixels, along the diagonals and turned back to x and y
        gx, gy = gaussian_filter(down + up, 0.5), gaussian_filter(down - up, 0.5)
        y, x = np.indices(gx.shape) + 0.5
        strength = gx**2 + gy**2
        middle = [np.sum(strength * a) / strength.sum() for a in (x, y)]
        far = np.hypot(x - middle[0], y - middle[1])
        w = strength / np.maximum(far, 0.5) / np.maximum(strength, 1e-300)
        # distance of (a, b) from the line: (gy (x − a) − gx (y − b)) / |g|
        lines = np.sqrt(w) * np.array([gy, -gx, gy * x - gx * y])
        a, b = np.linalg.lstsq(lines[:2].reshape(2, -1).T, lines[2].ravel(), rcond=None)[0]
        if 0 <= a < part.shape[1] and 0 <= b < part.shape[0]:
            out[i] = (a + cut[1].start) * pixel, (b + cut[0].start) * pixel
    return _places(out)


def half_width(optics: Optics, pixel_nm: float) -> int:
    """Give half a square of about two widths of the spot [pixels]."""
    return max(2, round(optics.wavelength_nm / optics.na / pixel_nm))


def around(shape: tuple[int, ...], start_px: FloatArray, half: int) -> Cut:
    """Cut a square around a start, as much of it as lies in the image."""
    corner = np.rint(start_px[::-1]).astype(int) - half
    first = np.clip(corner, 0, np.array(shape) - 1)
    last = np.clip(corner + 2 * half + 1, 1, shape)
    return slice(first[0], last[0]), slice(first[1], last[1])


def _highest(
    images: FloatArray, setup: EstimatorSetup, polarity: int, *, refined: bool = True
) -> Table:
    """Find the maximum near each start, between pixels by parabolas; NaN where none is known."""
    pixel = setup.pixel_size_nm
    y, x = np.indices(images.shape[1:])
    out = np.full((len(images), 3), np.nan)
    for i, image in enumerate(polarity * images):
        column, row = setup.start[i, :2] / pixel
        near = (np.hypot(x - column, y - row) <= REACH_PX) & np.isfinite(image)
        if not near.any():
            continue
        place = np.argmax(np.where(near, image, -np.inf))
        down, across = (int(k) for k in np.unravel_index(place, image.shape))
        shift, top = [0.0, 0.0], float(image[down, across])
        lines = (image[down], across), (image[:, across], down)
        for k, (line, at) in enumerate(lines if refined else ()):
            before, middle, behind = line[at - 1 : at + 2] if 0 < at < line.size - 1 else (0, 0, 0)
            bend = before - 2 * middle + behind
            if bend < 0:
                shift[k] = (before - behind) / (2 * bend)
                top -= (before - behind) ** 2 / (8 * bend)
        out[i] = (across + shift[0]) * pixel, (down + shift[1]) * pixel, polarity * top
    return _places(out)


def _places(found: FloatArray) -> Table:
    """Name columns x [nm], y [nm] and, if there is a third, amplitude."""
    return dict(zip(("x_nm", "y_nm", "amplitude"), found.T, strict=False))
