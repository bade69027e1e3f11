"""The fit of MSPT: a difference of two concentric Gaussians, by least squares.

MSPT tracks proteins on membranes in ratiometric movies (Foley et al. 2021, Heermann et al. 2021).
Its program is in no registry of packages, so its fit is written anew here from what it does.
Candidates are local maxima of the Laplacian of a Gaussian; each is fitted alone, on the 13 × 13
pixels around it, with

    f = A (g(σ) − k g(s σ)) + offset,    g(w) = exp(−r² / 2w²),    k = (1 − T) / s.

The parameters are A, the centre x and y, T, s, the offset and σ, in this order; A (1 − k) is the
contrast.  SciPy's Newton method in a trust region (``trust-ncg``) takes the exact gradient and
Hessian, which Numba compiles, and ends at SciPy's tolerance.

As shipped, images are contrasts, and the gradient of their squares is so small that the fit ends
where it begins, or soon after.  Here they are divided by their noise, with which it converges.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_laplace, maximum_filter
from scipy.optimize import OptimizeResult, minimize

FloatArray = NDArray[np.float64]
Shape = tuple[float, float, float]

HALF = 6
"""Pixels between the middle of a square and its border."""

SHIPPED: Shape = (0.1423, 2.1436, 1.2921)
"""T, s and σ [pixels] where MSPT begins."""

OFFSET = -1e-4
"""Where it begins with the offset, as contrast."""

SEARCH_SIGMA_PX, SEARCH_SIDE_PX, SEARCH_ABOVE = 1.5, 5, 5.0
"""Of the Gaussian; where a candidate is the highest; and how many deviations above the noise."""


def noise(frames: FloatArray) -> float:
    """Give the standard deviation of ratiometric frames where no particles are."""
    return float(1.4826 * np.median(np.abs(frames - np.median(frames))))


def candidates(frame: FloatArray) -> NDArray[np.intp]:
    """Find dark particles whose squares lie in the frame: their rows and columns."""
    filtered = gaussian_laplace(frame, SEARCH_SIGMA_PX)
    highest = maximum_filter(filtered, SEARCH_SIDE_PX) == filtered
    places = np.argwhere(highest & (filtered > SEARCH_ABOVE * noise(filtered)))
    inside = (places >= HALF) & (places < np.array(frame.shape) - HALF)
    return places[inside.all(axis=1)]


def cut(frame: FloatArray, row: int, column: int) -> FloatArray:
    """Give the 13 × 13 pixels around a place."""
    return frame[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]


def start(image: FloatArray, image_noise: float, shape: Shape = SHIPPED) -> FloatArray:
    """Begin at the centre of radial symmetry, with the height of the middle 3 × 3 pixels."""
    T, s, sigma = shape
    middle = image[HALF - 1 : HALF + 2, HALF - 1 : HALF + 2].mean()
    x, y = radial_centre(image)
    return np.array([middle / (1 - (1 - T) / s), x, y, T, s, OFFSET / image_noise, sigma])


def radial_centre(image: FloatArray) -> FloatArray:
    """Find x and y of the place that the lines along all slopes are nearest to.

    Squared distances are weighted by the square of the slope over the distance of its pixel from
    the centroid of all slopes, after Parthasarathy (2012).
    """
    along_y, along_x = (k.ravel() for k in np.gradient(image))
    places = np.indices(image.shape)[::-1].reshape(2, -1) - HALF
    centroid = np.average(places, axis=1, weights=along_x**2 + along_y**2)
    away = np.hypot(*(places - centroid[:, None]))
    across = np.stack([-along_y, along_x]) / np.sqrt(away + 0.5)
    at: FloatArray = np.linalg.solve(across @ across.T, across @ (across * places).sum(axis=0))
    return at


def fit(image: FloatArray, begin: FloatArray) -> OptimizeResult:
    """Fit one square, which is over its noise."""
    return minimize(cost, begin, (image,), "trust-ncg", jac=gradient, hess=hessian)


def contrast(p: FloatArray) -> float:
    """Give what the function has at its centre, over its offset."""
    return float(p[0] * (1 - (1 - p[3]) / p[4]))


@njit
def cost(p: FloatArray, image: FloatArray) -> float:
    """Give half the sum of squares."""
    slopes = np.empty(7)
    total = 0.0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total += 0.5 * (_slopes(p, i, j, slopes) - image[i, j]) ** 2
    return total


@njit
def gradient(p: FloatArray, image: FloatArray) -> FloatArray:
    """Give the slopes of the cost along all parameters."""
    slopes, total = np.empty(7), np.zeros(7)
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            rest = _slopes(p, i, j, slopes) - image[i, j]
            for a in range(7):
                total[a] += rest * slopes[a]
    return total


@njit
def hessian(p: FloatArray, image: FloatArray) -> FloatArray:
    """Give second derivatives of the cost, those of the function included."""
    slopes, bends, total = np.empty(7), np.zeros((7, 7)), np.zeros((7, 7))
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            rest = _slopes(p, i, j, slopes) - image[i, j]
            _bends(p, i, j, bends)
            for a in range(7):
                for b in range(a, 7):
                    total[a, b] += slopes[a] * slopes[b] + rest * bends[a, b]
    for a in range(7):
        for b in range(a):
            total[a, b] = total[b, a]
    return total


@njit
def _bell(p: FloatArray, i: int, j: int, width: float) -> tuple[float, float, float]:
    """Give a Gaussian at a pixel, and how far that is from the centre along x and y, in widths."""
    u, v = (j - HALF - p[1]) / width, (i - HALF - p[2]) / width
    return np.exp(-0.5 * (u * u + v * v)), u, v


@njit
def _slopes(p: FloatArray, i: int, j: int, out: FloatArray) -> float:
    """Give the function at a pixel, and put its slopes along all parameters into `out`."""
    A, T, s, sigma = p[0], p[3], p[4], p[6]
    k, wide = (1 - T) / s, p[4] * p[6]
    g, u, v = _bell(p, i, j, sigma)
    h, q, r = _bell(p, i, j, wide)
    g_w, h_w = g * (u * u + v * v) / sigma, h * (q * q + r * r) / wide
    out[0] = g - k * h
    out[1] = A * (g * u / sigma - k * h * q / wide)
    out[2] = A * (g * v / sigma - k * h * r / wide)
    out[3] = A * h / s
    out[4] = A * k * (h / s - sigma * h_w)
    out[5] = 1.0
    out[6] = A * (g_w - k * s * h_w)
    return float(A * out[0] + p[5])


@njit
def _bends(p: FloatArray, i: int, j: int, out: FloatArray) -> None:
    """Put second derivatives at a pixel into the upper half of `out`; zeros stay as they are."""
    A, T, s, sigma = p[0], p[3], p[4], p[6]
    k, wide = (1 - T) / s, p[4] * p[6]
    g, u, v = _bell(p, i, j, sigma)
    h, q, r = _bell(p, i, j, wide)
    n, m = u * u + v * v, q * q + r * r
    g_w, h_w = g * n / sigma, h * m / wide
    g_ww, h_ww = g * n * (n - 3) / sigma**2, h * m * (m - 3) / wide**2
    g_x, h_x, g_y, h_y = g * u / sigma, h * q / wide, g * v / sigma, h * r / wide
    h_xw, h_yw = h_x * (m - 2) / wide, h_y * (m - 2) / wide
    out[0, 1], out[0, 2] = g_x - k * h_x, g_y - k * h_y
    out[0, 3], out[0, 4], out[0, 6] = h / s, k * (h / s - sigma * h_w), g_w - k * s * h_w
    out[1, 1] = A * (g * (u * u - 1) / sigma**2 - k * h * (q * q - 1) / wide**2)
    out[2, 2] = A * (g * (v * v - 1) / sigma**2 - k * h * (r * r - 1) / wide**2)
    out[1, 2] = A * (g * u * v / sigma**2 - k * h * q * r / wide**2)
    out[1, 3], out[2, 3] = A * h_x / s, A * h_y / s
    out[1, 4], out[2, 4] = A * k * (h_x / s - sigma * h_xw), A * k * (h_y / s - sigma * h_yw)
    out[1, 6] = A * (g_x * (n - 2) / sigma - k * s * h_xw)
    out[2, 6] = A * (g_y * (n - 2) / sigma - k * s * h_yw)
    out[3, 4], out[3, 6] = A * (sigma * h_w / s - h / s**2), A * h_w
    out[4, 4] = A * k * (2 * sigma * h_w / s - 2 * h / s**2 - sigma**2 * h_ww)
    out[4, 6] = -A * k * wide * h_ww
    out[6, 6] = A * (g_ww - k * s**2 * h_ww)
