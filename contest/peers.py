"""Adapters of other programs' estimators: counts in their units, their results in ours.

Their programs are imported when they are run.  Picasso is an extra of this package.  PiSCAT asks
for a version of pandas that this package cannot use, and for windows; its fit needs neither, so
that its one file is loaded from a PiSCAT that was installed without its requirements.
"""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.records import FloatArray
from iscat_analysis.study import EstimatorSetup

Table = dict[str, FloatArray]


def _picasso(before: FloatArray, after: FloatArray, setup: EstimatorSetup, *, mle: bool) -> Table:
    """Show Picasso bright spots: what is darker than the background is turned to be brighter."""
    from picasso.fitting import gaussfit, seeds

    background = before * (setup.n_after / max(setup.n_before, 1))
    counts = background + setup.polarity * (after - background)
    spots, corner = _boxes(counts, setup)
    begin = seeds.initial_parameters_gauss(spots, spots.shape[1])
    theta, _, state, _ = gaussfit.fit_spots(gaussfit.ELLIPTIC, spots, begin, mle=mle)
    theta = np.where((np.asarray(state) == 0)[:, None], theta, np.nan).astype(float)
    pixel = setup.pixel_size_nm
    return {
        "x_nm": (theta[:, 1] + corner[:, 1]) * pixel,
        "y_nm": (theta[:, 2] + corner[:, 0]) * pixel,
        "amplitude": setup.polarity * theta[:, 0],
    }


picasso_gausslq, picasso_gaussmle = (partial(_picasso, mle=mle) for mle in (False, True))
"""Fits by `picasso.fitting.gaussfit`: least squares, and maximum likelihood."""


def piscat(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Fit by `piscat.Localization.gaussian_2D_fit`.

    Shapes: `before, after` (n, y, x).
    """
    fit = _piscat_module("Localization/gaussian_2D_fit.py").fit_2D_Gaussian_varAmp
    spots, corner = _boxes(setup.image(before, after), setup)
    pixel = setup.pixel_size_nm
    width = np.sqrt(2) * setup.psf_sigma_nm / pixel  # its width is √2 of a standard deviation
    out = np.full((len(spots), 2, 6), np.nan)
    for i, spot in enumerate(spots.astype(float)):
        _, found, error = fit(spot, width, width)
        if found is not None:
            out[i] = found, error
    return {
        "x_nm": (out[:, 0, 1] + corner[:, 1]) * pixel,
        "y_nm": (out[:, 0, 2] + corner[:, 0]) * pixel,
        "amplitude": out[:, 0, 0],
        "sigma_x_nm": out[:, 1, 1] * pixel,
        "sigma_y_nm": out[:, 1, 2] * pixel,
        "sigma_amplitude": out[:, 1, 0],
    }


def _piscat_module(file: str) -> Any:
    """Load one file of PiSCAT without the rest of it."""
    package = find_spec("piscat")
    folders = package.submodule_search_locations if package is not None else None
    if not folders:
        raise ImportError("piscat is not installed")
    spec = spec_from_file_location(Path(file).stem, Path(folders[0]) / file)
    if spec is None or spec.loader is None:
        raise ImportError(f"piscat has no {file}")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def trackpy(before: FloatArray, after: FloatArray, setup: EstimatorSetup) -> Table:
    """Locate by `trackpy.locate`, and take the feature nearest to the start.

    Shapes: `before, after` (n, y, x).
    """
    import trackpy as tp

    pixel = setup.pixel_size_nm
    images = setup.polarity * setup.image(before, after)
    out = np.full((len(images), 3), np.nan)
    for i, image in enumerate(images):
        scaled = np.maximum(image - np.median(image), 0.0)
        features = tp.locate(
            # diameter of trackpy's mask, odd [pixels]
            np.rint(60000 * scaled / (scaled.max() or 1.0)).astype(np.uint16),
            9,
        )
        if not len(features):
            continue
        x, y = setup.start[i, :2] / pixel
        one = features.iloc[int(np.argmin(np.hypot(features["x"] - x, features["y"] - y)))]
        unit = setup.polarity * scaled.max() / 60000
        out[i] = one["x"] * pixel, one["y"] * pixel, one["mass"] * unit
    return {"x_nm": out[:, 0], "y_nm": out[:, 1], "amplitude": out[:, 2]}


def _boxes(images: FloatArray, setup: EstimatorSetup) -> tuple[FloatArray, FloatArray]:
    """Cut boxes of about two widths of the spot, all of one size, around the starts.

    Shapes: `images` (n, y, x), result (n, box, box) and corners (n, 2).
    """
    half = max(3, round(setup.optics.wavelength_nm / setup.optics.na / setup.pixel_size_nm))
    side = min(2 * half + 1, *images.shape[1:])
    limit = np.array(images.shape[1:]) - side
    centre = np.rint(setup.start[:, 1::-1] / setup.pixel_size_nm).astype(int)
    corner = np.clip(centre - side // 2, 0, limit)
    cut = [image[r : r + side, c : c + side] for image, (r, c) in zip(images, corner, strict=True)]
    return np.ascontiguousarray(np.stack(cut), dtype=np.float32), corner
