"""Estimators that are built in: this program's fit, and those that most laboratories use.

All but the first see the contrast image near the start that a detection would give.  Their
amplitudes become masses by one factor (see `estimators`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.signal import fftconvolve

from iscat_analysis.config import Optics
from iscat_analysis.pieces import compile_kernels, config_of, fit_particle, gather, parts_of, psf
from iscat_analysis.records import PARAMETERS, Candidate, FloatArray, Status
from iscat_analysis.study import EstimatorSetup

REACH_PX = 3.0
"""A maximum is sought this far from the start [pixels]."""

DOG_RATIO = 1.6
"""Widths of the two Gaussians whose difference is nearest to a Laplacian (Marr & Hildreth 1980)."""

CENTROID_PASSES = 10

LOST = {Status.NOT_CONVERGED, Status.AT_BOUND, Status.AMBIGUOUS_Z}
"""Fits without an estimate that a user would keep."""

_EVALUATIONS = 200

Table = dict[str, FloatArray]


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
    compile_kernels(counts.model, parts_of(setup.free, posteriors=False))
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
    width = setup.psf_sigma_nm / setup.pixel_size_nm

    def fit(i: int, cut: tuple[slice, slice], start_px: FloatArray) -> FloatArray:
        return fit_gaussian(images[i][cut], cut, start_px, width, setup.polarity)

    return _fitted(images, setup, fit)


def gauss_mle(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Fit the same to the counts with the particle, the background taken for known.

    The squared deviance residuals add up to −2 ln L of Poisson counts.

    Shapes: `before, after` (n, y, x).
    """
    images = setup.image(before, after)
    ratio = setup.n_after / max(setup.n_before, 1)
    width = setup.psf_sigma_nm / setup.pixel_size_nm

    def fit(i: int, cut: tuple[slice, slice], start_px: FloatArray) -> FloatArray:
        expected = np.maximum(ratio * before[i][cut], 1e-9)
        unit = expected if setup.interferes else np.full_like(expected, float(setup.n_after))
        return fit_gaussian(
            images[i][cut], cut, start_px, width, setup.polarity, counts=after[i][cut],
            background=expected, unit=unit,
        )  # fmt: skip

    return _fitted(images, setup, fit)


def gaussian(x: FloatArray, y: FloatArray, p: FloatArray) -> FloatArray:
    """Give a round Gaussian of amplitude, centre, width and level.

    Shapes: `x` (nx,), `y` (ny,), `p` (5,), result (ny, nx).
    """
    return np.asarray(p[0] * _bell(x, y, p)[2] + p[4])


def gaussian_slopes(x: FloatArray, y: FloatArray, p: FloatArray) -> FloatArray:
    """Give its derivatives with respect to the five.

    Shapes: as `gaussian`, result (ny, nx, 5).
    """
    u, v, g = _bell(x, y, p)
    slope = p[0] * g / p[3]
    return np.stack((g, slope * u, slope * v, slope * (u**2 + v**2), np.ones_like(g)), axis=-1)


def _bell(x: FloatArray, y: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    u, v = (x - p[1]) / p[3], ((y - p[2]) / p[3])[:, None]
    return u, v, np.exp(-(u**2 + v**2) / 2)


def fit_gaussian(
    image: FloatArray,
    cut: tuple[slice, slice],
    start_px: FloatArray,
    sigma_px: float,
    polarity: float,
    *,
    counts: FloatArray | None = None,
    background: FloatArray | None = None,
    unit: FloatArray | None = None,
) -> FloatArray:
    """Give amplitude, x and y [px], width [px] and level, and the standard deviation of each.

    Shapes: `image, counts, background, unit` (y, x), `start_px` (2,), result (2, 5).
    """
    y, x = (np.arange(part.start, part.stop, dtype=float) for part in cut)
    scale = float(np.max(np.abs(image))) or 1.0

    def value(p: FloatArray) -> FloatArray:
        return scale * gaussian(x, y, p)

    def slopes(p: FloatArray) -> FloatArray:
        return scale * gaussian_slopes(x, y, p)

    if counts is None or background is None or unit is None:

        def residual(p: FloatArray) -> FloatArray:
            return ((value(p) - image) / scale).ravel()

        def jacobian(p: FloatArray) -> FloatArray:
            return (slopes(p) / scale).reshape(-1, 5)
    else:
        observed = np.maximum(counts, 1e-12)

        def expected(p: FloatArray) -> FloatArray:
            return np.maximum(background + unit * value(p), 1e-9)

        def residual(p: FloatArray) -> FloatArray:
            mean = expected(p)
            deviance = 2 * (mean - counts + counts * np.log(observed / mean))
            return (np.sign(mean - counts) * np.sqrt(np.maximum(deviance, 0.0))).ravel()

        def jacobian(p: FloatArray) -> FloatArray:
            mean, r = expected(p), residual(p).reshape(counts.shape)
            near = np.abs(r) < 1e-6
            steep = np.where(near, 1 / np.sqrt(mean), (1 - counts / mean) / np.where(near, 1, r))
            return (slopes(p) * (steep * unit)[..., None]).reshape(-1, 5)

    begin = np.array([polarity * 0.8, *start_px, sigma_px, 0.0])
    found = least_squares(residual, begin, jacobian, method="lm", max_nfev=_EVALUATIONS)
    if not found.success or not np.all(np.isfinite(found.x)):
        return np.full((2, 5), np.nan)
    information = found.jac.T @ found.jac
    noise = 1.0 if counts is not None else 2 * found.cost / max(image.size - 5, 1)
    sigma = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information)) * noise, 0.0))
    to_image = np.array([scale, 1.0, 1.0, 1.0, scale])
    return np.array([found.x * to_image, sigma * to_image])


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
    template = template.reshape(template.shape[-2:])
    template = template - template.mean()
    turned = template[None, ::-1, ::-1] / np.sum(template**2)
    return _highest(fftconvolve(images, turned, mode="same", axes=(1, 2)), setup, 1)


def dog(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Take the maximum of a difference of Gaussians.

    Shapes: `before, after` (n, y, x).
    """
    width = setup.psf_sigma_nm / setup.pixel_size_nm
    images = setup.image(before, after)
    narrow, wide = (gaussian_filter(images, (0, s, s)) for s in (width, DOG_RATIO * width))
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
        for _ in range(CENTROID_PASSES):
            disc = np.hypot(x - column, y - row) <= reach
            mass = np.maximum(image[disc], 0.0)
            if not mass.sum() > 0:
                break
            column = float(np.average(x[disc], weights=mass))
            row = float(np.average(y[disc], weights=mass))
            out[i] = column * pixel, row * pixel, setup.polarity * image[disc].sum()
    return {"x_nm": out[:, 0], "y_nm": out[:, 1], "amplitude": out[:, 2]}


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
        matrix = np.array(
            [
                [np.sum(w * gy * gy), -np.sum(w * gx * gy)],
                [-np.sum(w * gx * gy), np.sum(w * gx * gx)],
            ]
        )
        aim = gy * x - gx * y
        a, b = np.linalg.lstsq(
            matrix, np.array([np.sum(w * gy * aim), -np.sum(w * gx * aim)]), rcond=None
        )[0]
        if 0 <= a < part.shape[1] and 0 <= b < part.shape[0]:
            out[i] = (a + cut[1].start) * pixel, (b + cut[0].start) * pixel
    return {"x_nm": out[:, 0], "y_nm": out[:, 1]}


def half_width(optics: Optics, pixel_nm: float) -> int:
    """Give half a square of about two widths of the spot [pixels]."""
    return max(2, round(optics.wavelength_nm / optics.na / pixel_nm))


def around(shape: tuple[int, ...], start_px: FloatArray, half: int) -> tuple[slice, slice]:
    """Cut a square around a start, as much of it as lies in the image."""
    rows, columns = shape
    column, row = (round(float(v)) for v in start_px)
    return (
        slice(min(max(row - half, 0), rows - 1), min(max(row + half + 1, 1), rows)),
        slice(min(max(column - half, 0), columns - 1), min(max(column + half + 1, 1), columns)),
    )


def _fitted(
    images: FloatArray,
    setup: EstimatorSetup,
    fit: Callable[[int, tuple[slice, slice], FloatArray], FloatArray],
) -> Table:
    """Fit every region from its start."""
    pixel = setup.pixel_size_nm
    starts, half = setup.start[:, :2] / pixel, half_width(setup.optics, pixel)
    found = np.stack(
        [fit(i, around(images.shape[1:], start, half), start) for i, start in enumerate(starts)]
    )
    return {
        "x_nm": found[:, 0, 1] * pixel,
        "y_nm": found[:, 0, 2] * pixel,
        "amplitude": found[:, 0, 0],
        "sigma_x_nm": found[:, 1, 1] * pixel,
        "sigma_y_nm": found[:, 1, 2] * pixel,
        "sigma_amplitude": found[:, 1, 0],
    }


def _highest(
    images: FloatArray, setup: EstimatorSetup, polarity: int, *, refined: bool = True
) -> Table:
    """Find the maximum near each start."""
    pixel = setup.pixel_size_nm
    out = np.stack(
        [
            highest(image, start, polarity, refined=refined)
            for image, start in zip(images, setup.start[:, :2] / pixel, strict=True)
        ]
    )
    return {"x_nm": out[:, 0] * pixel, "y_nm": out[:, 1] * pixel, "amplitude": out[:, 2]}


def highest(
    image: FloatArray, start_px: FloatArray, polarity: float, *, refined: bool
) -> FloatArray:
    """Give column, row and height of the maximum near a start, between pixels by parabolas.

    Shapes: `image` (ny, nx), `start_px` (2,), result (3,), NaN where no pixel is known.
    """
    turned: FloatArray = polarity * image
    y, x = np.indices(image.shape)
    near = (np.hypot(x - start_px[0], y - start_px[1]) <= REACH_PX) & np.isfinite(turned)
    if not near.any():
        return np.full(3, np.nan)
    candidates = np.where(near, turned, -np.inf)
    down, across = (int(k) for k in np.unravel_index(np.argmax(candidates), image.shape))
    shift, top = [0.0, 0.0], float(turned[down, across])
    lines = (turned[down], across), (turned[:, across], down)
    for k, (line, at) in enumerate(lines if refined else ()):
        if 0 < at < line.size - 1:
            before, middle, behind = line[at - 1 : at + 2]
            bend = before - 2 * middle + behind
            if bend < 0:
                shift[k] = float((before - behind) / (2 * bend))
                top -= float((before - behind) ** 2 / (8 * bend))
    return np.array([across + shift[0], down + shift[1], polarity * top])
