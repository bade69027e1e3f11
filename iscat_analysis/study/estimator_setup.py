"""What an estimator is told of an experiment; light to import, for each has its own process."""

from __future__ import annotations

from dataclasses import dataclass, replace

from iscat_analysis.config import Calibration, CameraConfig, Optics, Particle
from iscat_analysis.records import FloatArray
from iscat_analysis.text import brief


@dataclass(frozen=True, eq=False)
class EstimatorSetup:
    """What an estimator knows of the experiment, beside the counts.

    Attributes
    ----------
    mode : str
        What is free, as a key of `FREE_PARAMETERS`.
    free : tuple of str
        Names of the free parameters; the others have their values in `start`.
    optics, particle, camera, calibration
        The microscope, the particle's material, the camera, and contrast against mass, or None.
    pixel_size_nm : float
        Side of a pixel in the sample [nm]; pixel (0, 0) of a region has its centre at (0, 0) nm.
    photons_per_pixel : float
        Expected background per pixel and frame [photoelectrons].
    n_before, n_after : int
        Frames in the sums; with `n_before` = 0 `before` is the known background of one frame.
    interferes : bool
        Whether the light has a reference; False in dark field.
    polarity : int
        Sign of the particle's contrast in focus of attention: −1 where it is darker.
    psf_sigma_nm : float
        Standard deviation of the Gaussian nearest to the diffraction-limited spot, 0.21 λ/NA [nm].
    z_range_nm : tuple of float
        Heights that are possible [nm].
    level_fitted : bool
        Whether a common level of the light is unknown.
    start : ndarray, shape (n, 4)
        Where a detection would have put each particle: x, y, z [nm] and mass [kDa].
    """

    mode: str
    free: tuple[str, ...]
    optics: Optics
    particle: Particle
    camera: CameraConfig
    calibration: Calibration | None
    pixel_size_nm: float
    photons_per_pixel: float
    n_before: int
    n_after: int
    interferes: bool
    polarity: int
    psf_sigma_nm: float
    z_range_nm: tuple[float, float]
    level_fitted: bool
    start: FloatArray

    __repr__ = brief

    def image(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Give the contrast; in dark field, the photoelectrons per frame above the background.

        Parameters
        ----------
        before, after : ndarray, shape (n, y, x)
            Counts as an estimator is given them [photoelectrons].

        Returns
        -------
        ndarray, shape (n, y, x)
            Contrast images.
        """
        background = before / max(self.n_before, 1)
        signal = after / self.n_after - background
        return signal / background if self.interferes else signal

    def of(self, first: int, last: int) -> EstimatorSetup:
        """Give the setup of some of the regions.

        Parameters
        ----------
        first, last : int
            Half-open range of regions.

        Returns
        -------
        EstimatorSetup
            The same with fewer starts.
        """
        return replace(self, start=self.start[first:last])
