"""Pictures of particles, sharp and blurred by their motion, to fit and to draw."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from iscat_analysis._kernels.canvas import Pictures
from iscat_analysis._kernels.lens import RoundLens
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.model import blurred, spreads
from iscat_analysis.optics.stamp import BAND, RINGS, sample_picture, weights_between
from iscat_analysis.optics.waves import axial_table
from iscat_analysis.records import FloatArray


class PictureBook:
    """Makes pictures of particles with any blur."""

    def __init__(
        self,
        near: ForwardModel,
        far: ForwardModel,
        *,
        pixel_nm: float,
        near_px: float,
        far_px: float,
        z_range_nm: tuple[float, float] | None,
    ) -> None:
        self._near, self._far = near, far
        self._pixel_nm, self._z_range = pixel_nm, z_range_nm
        self._near_px, self._far_px = near_px, far_px

    def of(self, variances_nm2: FloatArray) -> tuple[Pictures, Pictures]:
        """Make the pictures of some blurs.

        Shapes: `variances_nm2` (groups,).
        """
        if self._z_range is not None:
            return (
                _along_z(self._near, variances_nm2, self._z_range),
                _along_z(self._far, variances_nm2, self._z_range),
            )
        return (
            _blurred(self._sharp_near, variances_nm2, BAND),
            _blurred(self._sharp_far, variances_nm2, RINGS),
        )

    @cached_property
    def _sharp_near(self) -> Pictures:
        return _at_one_height(self._far, self._pixel_nm, self._near_px, BAND)

    @cached_property
    def _sharp_far(self) -> Pictures:
        return _at_one_height(self._far, self._pixel_nm, self._far_px, RINGS)


def _at_one_height(model: ForwardModel, pixel_nm: float, half_px: float, band: float) -> Pictures:
    """Sharp picture at the model's height."""
    lens, samples = sample_picture(model, pixel_nm, half_px, band)
    return Pictures(
        samples.reshape(1, 1, 1, 2, -1), 0.0, 1.0, 0.0, lens, lens.window[None],
        samples.astype(np.float32),
    )  # fmt: skip


def _blurred(sharp: Pictures, variances_nm2: FloatArray, band: float) -> Pictures:
    """Give a picture at one height the weights of every blur."""
    inverse = sharp.lens.inv_step
    windows = [
        sum(
            share * weights_between(v * inverse**2, band)
            for share, v in spreads(float(q), each_axis=True)
        )
        for q in variances_nm2
    ]
    return sharp._replace(windows=np.stack(windows))


def _along_z(
    model: ForwardModel, variances_nm2: FloatArray, z_range_nm: tuple[float, float]
) -> Pictures:
    """Tables of a model for every blur, along z."""
    tables = [
        axial_table(blurred(model, float(q), upwards=True).wave, z_range_nm) for q in variances_nm2
    ]
    heights = np.stack([table.heights for table in tables])
    one, lens = tables[0], model.lens
    window = np.zeros((1, 0, 0)) if isinstance(lens, RoundLens) else lens.window[None]
    return Pictures(
        heights, one.first_nm, one.step_nm, one.kappa, lens, window, np.zeros((2, 0, 0))
    )
