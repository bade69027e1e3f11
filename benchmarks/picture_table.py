"""Would one table of images on (z, y, x) do instead of radial profiles?  What it costs, in pairs.

    python benchmarks/picture_table.py [PIXELS…]

Compared are one pass of a fit with a free height (score and information of a region), and what
must be made before the first pass of a model.  The table holds P and Q of the signal a P + a² Q,
averaged over pixels, at 51 heights; a pass blends the eight nearest heights, and their slope along
z, over the nodes that the region needs, and takes the image from them as fits at a fixed height do.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import numba as nb
import numpy as np

import iscat_analysis as ia
from iscat_analysis._kernels.radial import profile_at
from iscat_analysis._kernels.scoring import blank_profile, picture_at, score_pass, span, value_pass
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.pixels import sample_picture

PIXEL_NM, HEIGHTS, TAPS = 84.4, 51, 8


@nb.njit(fastmath=True)
def blend(table, weights, slopes, value, slope):  # type: ignore[no-untyped-def]
    """Interpolate between heights: value and slope along z of every node."""
    for j in range(value.size):
        v = d = 0.0
        for k in range(8):  # TAPS, in a form that the compiler unrolls
            v += table[k, j] * weights[k]
            d += table[k, j] * slopes[k]
        value[j], slope[j] = v, d


def model_of(pixels: int, focus_nm: float) -> ForwardModel:
    """Make a model that nothing has cached."""
    config = ia.configure(
        settings={
            "camera.pixel_size_nm": PIXEL_NM, "fit.mode": "joint", "optics.focus_nm": focus_nm,
        }
    )  # fmt: skip
    return forward_model(config, math.sqrt(2) * (pixels * PIXEL_NM / 2 + 700))


def least_times(ways: list[Callable[[], None]], rounds: int, calls: int) -> list[float]:
    """Least time of each way [s], in turns."""
    least = [math.inf] * len(ways)
    for _ in range(rounds):
        for k, way in enumerate(ways):
            begun = time.perf_counter()
            for _ in range(calls):
                way()
            least[k] = min(least[k], (time.perf_counter() - begun) / calls)
    return least


def passes(pixels: int) -> tuple[float, float]:
    """Time of one pass: by radial profiles, and by the table."""
    model = model_of(pixels, 0.0)
    grid = PixelGrid.region((0, pixels), (0, pixels), PIXEL_NM)
    samples = model.pixels(grid)
    random = np.random.default_rng(0)
    data = random.uniform(900, 1100, (4, pixels, pixels))
    middle = pixels // 2 * PIXEL_NM
    theta = np.array([middle + 25, middle - 17, 200.0, model.nominal_amplitude, 0.0])
    score, fisher = np.empty(5), np.empty((5, 5))
    axial = model.axial_table
    profile = blank_profile(axial, model.lens, 2)
    start, stop = span(model.lens, samples, theta, axial.heights.shape[3])
    lens, fixed = model.picture_table(PIXEL_NM, pixels)
    picture = picture_at(fixed, lens, 200.0, 0, 0, blank_profile(fixed, lens, 2)).copy()
    nodes = 2 * (lens.fine * (pixels + TAPS // lens.fine + 1)) ** 2
    table, weights = random.random((TAPS, nodes)), random.random((2, TAPS))
    value, slope = np.empty((2, nodes))

    def radial() -> None:
        profile_at(axial, theta[2], start, stop, profile)
        score_pass(profile, model.lens, samples, (0, data), theta, (score, fisher))

    def tabulated() -> None:
        blend(table, weights[0], weights[1], value, slope)
        score_pass(picture, lens, samples, (0, data), theta, (score, fisher))
        value_pass(picture, lens, samples, (0, data), theta)  # the image of the slope along z

    radial(), tabulated()
    one, other = least_times([radial, tabulated], 60, 20)
    return one, other


def making(pixels: int) -> tuple[float, float]:
    """Time until the first pass: of a model with its radial profiles, and of the table besides."""
    least = [math.inf, math.inf]
    for focus in range(5):
        begun = time.perf_counter()
        model = model_of(pixels, 1.0 + focus)
        _ = model.axial_table
        made = time.perf_counter()
        sample_picture(model, PIXEL_NM, pixels / 2 + 4)
        least = [min(least[0], made - begun), min(least[1], time.perf_counter() - made)]
    return least[0], HEIGHTS * least[1]


if __name__ == "__main__":
    for pixels in map(int, sys.argv[1:] or ("21", "33")):
        (radial_s, table_s), (model_s, tables_s) = passes(pixels), making(pixels)
        print(
            f"{pixels} px: a pass {1e6 * radial_s:.0f} µs by profiles, {1e6 * table_s:.0f} µs by "
            f"the table ({table_s / radial_s:.2f}); a model {1e3 * model_s:.0f} ms, its table "
            f"{1e3 * tables_s:.0f} ms more ({(model_s + tables_s) / model_s:.0f})"
        )
