"""Images of a particle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.config import Calibration, CameraConfig, Optics, Particle
from iscat_analysis.inference.checks import number_in
from iscat_analysis.optics.collected import photons_per_intensity
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pieces.setups import LARGEST_REGION, config_of, darkfield_photons, together

FloatArray = NDArray[np.float64]


def psf(
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    *,
    pixels: int = 33,
    x_nm: ArrayLike = 0.0,
    y_nm: ArrayLike = 0.0,
    z_nm: ArrayLike | None = None,
    mass_kda: ArrayLike | None = None,
    calibration: Calibration | None = None,
) -> FloatArray:
    """Draw the image that a camera expects of a particle.

    Parameters
    ----------
    optics : Optics
        The microscope.
    particle : Particle
        Its material; its height sets the focus.
    camera : Camera
        Pixel size and samples per pixel.
    pixels : int
        Side of the square image [pixels].
    x_nm, y_nm : array_like
        Particle, from the centre of the image; x along columns, y down the rows [nm].
    z_nm : array_like, optional
        Height above the coverslip [nm]; default ``particle.height_nm``.
    mass_kda : array_like, optional
        Mass [kDa]; default that of `particle`.
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.

    Returns
    -------
    ndarray, shape (..., pixels, pixels)
        Contrast: light over the light without the particle, minus 1.  In dark field the scattered
        photoelectrons per pixel and frame.  The leading axes are those of the broadcast arguments.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An argument does not hold real numbers.

    Notes
    -----
    Dong et al., J. Phys. D 54, 394002 (2021), section II, or with ``emission = "reciprocal"`` the
    wave that conserves energy.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=-300)
    >>> protein, camera = ia.Particle(mass_kda=480), ia.Camera(pixel_size_nm=84.4)
    >>> ia.psf(optics, protein, camera, z_nm=np.linspace(0, 400, 5)).shape
    (5, 33, 33)
    """
    mode = "size" if isinstance(particle, Particle) and particle.is_sphere else "joint"
    config = config_of(optics, particle, camera, mode=mode, calibration=calibration)
    side = int(number_in("pixels", pixels, least=1, most=LARGEST_REGION, whole=True))
    pixel_nm = float(config.camera.pixel_size_nm or 0.0)
    height = particle.nominal_height_nm if z_nm is None else z_nm
    reference = forward_model(config, pixel_nm)
    mass = reference.material.mass_kda if mass_kda is None else mass_kda
    at = together(
        {"x_nm": x_nm, "y_nm": y_nm, "z_nm": height, "mass_kda": mass}, least={"z_nm": 0.0}
    )
    half = side * pixel_nm / 2
    reach = math.hypot(*(half + np.abs(at[name]).max(initial=0.0) for name in ("x_nm", "y_nm")))
    highest = max(float(at["z_nm"].max(initial=0.0)), particle.nominal_height_nm)
    model = forward_model(config, reach * 1.0001 + pixel_nm, z_max_nm=highest)
    unit = 1.0 if model.rho else photons_per_intensity(model, darkfield_photons(particle), pixel_nm)
    grid = PixelGrid.centred(side, pixel_nm)
    out = np.empty((*at["x_nm"].shape, side, side))
    for place in np.ndindex(at["x_nm"].shape):
        x, y, z, m = (float(at[name][place]) for name in ("x_nm", "y_nm", "z_nm", "mass_kda"))
        out[place] = unit * model.image(grid, x, y, z, m)
    return out
