"""What a configuration makes of a movie: models, matched filter, likelihoods of its pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.config import Config, Detection
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import KNOWN, MEAN, MEDIAN, counts_likelihood
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.movie.background import smooth_background
from iscat_analysis.movie.lines import Lines
from iscat_analysis.movie.spectrum import NoiseSpectrum
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.stamp import margin_nm
from iscat_analysis.records import (
    FREE_PARAMETERS,
    BoolArray,
    FitResult,
    FloatArray,
    Status,
    Windows,
    verdict,
)
from iscat_analysis.search.templates import Templates, make_templates

SPREAD_NM = 10_000.0
"""Farther than this from a particle its rings are left out; they are 1e-4 of its peak."""


SATURATION_NM = 500.0
"""Saturated pixels nearer than this spoil a fit."""

_VARIANCE_OF_BACKGROUND = {
    "fixed": MEAN, "sliding": MEAN, "tracks": MEAN, "median": MEDIAN, "known": KNOWN,
}  # fmt: skip
"""Variance of a measured background over that of the mean of its frames."""


@dataclass(frozen=True)
class Region:
    """Half-open ranges of full-frame pixels."""

    rows: tuple[int, int]
    columns: tuple[int, int]

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the region in a full frame."""
        return slice(*self.rows), slice(*self.columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns it has."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


@dataclass(frozen=True)
class Scene:
    """What a configuration fixes for every field of a movie: model, templates, scale.

    Attributes
    ----------
    config : Config
        Resolved.
    model : ForwardModel
        For fitted regions.
    wide : ForwardModel
        For signals up to `SPREAD_NM` away.
    templates : Templates
        Matched filter.
    mode : str
        Key of `FREE_PARAMETERS`.
    lines : Lines or None
        Rows and columns whose flicker is divided out of the frames.
    """

    config: Config
    model: ForwardModel
    wide: ForwardModel
    templates: Templates
    mode: str
    lines: Lines | None = None

    @property
    def pixel_nm(self) -> float:
        """Pixel side [nm]."""
        return _pixel_nm(self.config)

    @property
    def roi_px(self) -> int:
        """Side of the fitted square [pixels]."""
        return self.config.fit.roi_px(self.pixel_nm)

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what the frames, as they are corrected, show of a signal over the field.

        Parameters
        ----------
        signal : ndarray, shape (y, x)
            Contrast.

        Returns
        -------
        ndarray, shape (y, x)
            The signal itself where no line flickers.
        """
        return signal if self.lines is None else self.lines.left(signal)

    @property
    def background_variance(self) -> float:
        """Variance of the background over that of the mean of its frames."""
        return _VARIANCE_OF_BACKGROUND[self.config.background.method or "fixed"]

    @property
    def additive(self) -> bool:
        """Whether particles add to the background instead of multiplying it."""
        return self.model.rho == 0


def make_scene(
    config: Config,
    field_px: tuple[int, int],
    *,
    searches: int = 1,
    noise: NoiseSpectrum | None = None,
    lines: Lines | None = None,
) -> Scene:
    """Build the models and the matched filter for a field.

    Parameters
    ----------
    config : Config
        With a pixel size.
    field_px : (int, int)
        Rows and columns.
    searches : int
        Images that will be searched; they share the expected false alarms.
    noise : NoiseSpectrum, optional
        Of the movie; without it the noise is white and of the expected size.
    lines : Lines, optional
        What was divided out of the frames.

    Returns
    -------
    Scene
        Ready for `fit_field`.

    Raises
    ------
    ConfigError
        The region is too small or too large, or the likelihood does not suit the scheme.
    """
    pixel, roi_px = square_of(config, field_px)
    darkfield = config.optics.scheme == "darkfield"
    if config.fit.likelihood == "conditional" and (darkfield or not _is_counted(config)):
        raise ConfigError(
            'fit.likelihood = "conditional" needs an interferometric scheme and '
            'background.method = "fixed" or "sliding": use "auto"'
        )
    model = square_model(config, pixel, roi_px)
    mode = config.fit.mode
    free_z = "z_nm" in FREE_PARAMETERS[mode]
    field_nm = math.hypot(field_px[0] + 1, field_px[1] + 1) * pixel
    return Scene(
        config=config,
        model=model,
        wide=forward_model(config, min(field_nm, math.sqrt(2) * (SPREAD_NM + 2 * pixel))),
        templates=make_templates(
            model,
            search_both(config.detection, searches=searches),
            pixel_nm=pixel,
            roi_nm=config.fit.roi_nm,
            z_range_nm=config.fit.z_range_nm if free_z else None,
            field_px=field_px,
            noise=noise,
            in_turn=True,
        ),
        mode=mode,
        lines=lines,
    )


def square_of(config: Config, field_px: tuple[int, int]) -> tuple[float, int]:
    """Give the side of a pixel and of the square that is fitted.

    Parameters
    ----------
    config : Config
        With a pixel size.
    field_px : (int, int)
        Rows and columns of the field.

    Returns
    -------
    pixel_nm : float
        Side of a pixel [nm].
    roi_px : int
        Side of the square [pixels].

    Raises
    ------
    ConfigError
        The pixel size is missing, or the square is larger than the field.
    """
    pixel = _pixel_nm(config)
    roi_px = config.fit.roi_px(pixel)
    if roi_px > min(field_px):
        raise ConfigError(
            f"fit.roi_nm = {config.fit.roi_nm:g} is {roi_px} pixels, more than the field of "
            f"{field_px[0]} x {field_px[1]}: lower fit.roi_nm or check camera.pixel_size_nm"
        )
    return pixel, roi_px


def square_model(config: Config, pixel_nm: float, roi_px: int) -> ForwardModel:
    """Build the forward model of the square that is fitted.

    Parameters
    ----------
    config : Config
        Optics, particle and calibration.
    pixel_nm : float
        Side of a pixel [nm].
    roi_px : int
        Side of the square [pixels].

    Returns
    -------
    ForwardModel
        It reaches over the square from wherever a fit may put the particle.
    """
    margin = pixel_nm + margin_nm(config.optics, pixel_nm)
    return forward_model(
        config, math.sqrt(2) * (roi_px * pixel_nm / 2 + window_nm(pixel_nm) + margin)
    )


def field_likelihood(scene: Scene, windows: Windows) -> Likelihood:
    """Likelihood of the whole field.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Sums before and after.

    Returns
    -------
    Likelihood
        For the matched filter.
    """
    rows, columns = windows.after_e.shape
    return region_likelihood(scene, windows, Region((0, rows), (0, columns)), None)


def search_likelihood(scene: Scene, windows: Windows, explained: FloatArray) -> Likelihood:
    """Likelihood of the whole field with weights that no particle may have made.

    Where the counts are few, weights made of those before alone are large where these are low by
    chance, and there the particles seem to have landed.  Counts before and after together say as
    much of the noise and nothing of the change.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Sums before and after.
    explained : ndarray, shape (y, x)
        Signal of the particles that are known.

    Returns
    -------
    Likelihood
        For the matched filter.
    """
    whole = field_likelihood(scene, windows)
    if not scene.additive or not windows.n_before:
        return whole
    counts, level, scale, extra = whole.data
    ratio = windows.power_ratio
    read = windows.read_variance_after_e2, windows.read_variance_before_e2
    both = windows.before_e + (counts - extra) - scale * explained
    noise = (read[0] + read[1]) / (1 + ratio) ** 2
    steady = smooth_background(both / (1 + ratio), noise, windows.masked)
    factor = scene.background_variance
    variance = steady * ratio * (1 + ratio * factor) + read[0] + ratio**2 * read[1]
    other = np.where(whole.used, variance - level, 0.0)
    return replace(whole, data=np.stack([counts - extra + other, level, scale, other]))


def region_likelihood(
    scene: Scene, windows: Windows, region: Region, others: FloatArray | None
) -> Likelihood:
    """Likelihood of a region, with the signal of other particles as part of its background.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Sums before and after.
    region : Region
        Which pixels.
    others : ndarray, shape (rows, columns), optional
        Signal of the other particles there.

    Returns
    -------
    Likelihood
        Conditional where a measured background is divided out, Poisson otherwise.
    """
    cut = region.slices
    config = scene.config
    grid = PixelGrid.region(region.rows, region.columns, scene.pixel_nm)
    model = scene.model if grid.diagonal_nm <= scene.model.reach_nm else scene.wide
    before, after, masked = windows.before_e[cut], windows.after_e[cut], windows.masked[cut]
    return counts_likelihood(
        model, grid, before, after, windows.power_ratio,
        background=scene.background_variance,
        use_conditional=_uses_conditional(config),
        scale_e=photons_scale(scene, windows) if scene.additive else None,
        others=others,
        read_variance_before_e2=windows.read_variance_before_e2[cut],
        read_variance_after_e2=windows.read_variance_after_e2[cut],
        masked=masked,
    )  # fmt: skip


def noise_cumulants(
    scene: Scene, windows: Windows, likelihood: Likelihood
) -> tuple[FloatArray, FloatArray] | None:
    """Third and fourth cumulants of the counts against their background.

    Parameters
    ----------
    scene : Scene
        Its background says which counts are compared.
    windows : Windows
        Sums before and after.
    likelihood : Likelihood
        From `search_likelihood`, whose noise it is.

    Returns
    -------
    (ndarray, ndarray) or None
        Of each pixel [e³, e⁴]; None in interferometric schemes, where the counts are many.

    Notes
    -----
    Of a Poisson count μ every cumulant is μ; of a − ρ b the k-th is μ_a + (−ρ)ᵏ μ_b.  Read noise
    has none, and a median of frames has hardly any.
    """
    if not scene.additive:
        return None
    _, level, _, extra = likelihood.data
    factor = scene.background_variance
    ratio = windows.power_ratio
    read = windows.read_variance_after_e2 + ratio**2 * windows.read_variance_before_e2
    light = np.maximum(level + extra - read, 0.0) / (1 + ratio * factor)
    counted = ratio if factor == MEAN else 0.0
    return light * (1 - counted**2), light * (1 + counted**3)


def photons_scale(scene: Scene, windows: Windows) -> float:
    """Scale of the signal in dark field.

    Parameters
    ----------
    scene : Scene
        Models.
    windows : Windows
        Frames and laser power.

    Returns
    -------
    float
        Photoelectrons per pixel for unit |E_sca|², summed over the frames after.
    """
    photons = scene.config.particle.photons_per_frame
    if photons is None:
        raise ConfigError(
            "particle.photons_per_frame is needed in dark field, where it is the scale of masses: "
            "give the scattered photons that are collected per frame from a particle of "
            "particle.mass_kda"
        )
    per_frame = scene.model.photons_per_intensity(photons, scene.pixel_nm)
    return per_frame * windows.power_ratio * max(windows.n_before, 1)


def is_saturated(scene: Scene, saturated: BoolArray, region: Region, fit: FitResult) -> bool:
    """Whether pixels that were saturated spoil a fit.

    Parameters
    ----------
    scene : Scene
        Its pixel size.
    saturated : ndarray of bool, shape (rows, columns)
        Those of the region.
    region : Region
        Where it lies in the full frame.
    fit : FitResult
        In the full frame.

    Returns
    -------
    bool
        Whether one lies within `SATURATION_NM` of the particle.
    """
    rows, columns = np.nonzero(saturated)
    dx = (columns + region.columns[0]) * scene.pixel_nm - fit.x_nm
    dy = (rows + region.rows[0]) * scene.pixel_nm - fit.y_nm
    return bool(np.any(np.hypot(dx, dy) < SATURATION_NM))


def judge(
    scene: Scene,
    fit: FitResult,
    region: Region,
    saturated: BoolArray,
    *,
    sidelobe: bool,
    too_close: bool,
    poor_fit: bool = False,
) -> FitResult:
    """Add what the surroundings of a particle say of its fit.

    Parameters
    ----------
    scene : Scene
        Its pixel size.
    fit : FitResult
        With the flags that it raised itself, in the full frame.
    region : Region
        Of the fit, in the full frame.
    saturated : ndarray of bool, shape (rows, columns)
        Pixels of the region that were saturated.
    sidelobe : bool
        Whether the particle may be no more than what the model leaves over of a brighter one.
    too_close : bool
        Whether another one is too near to be kept out of the fit.
    poor_fit : bool
        Whether its light changes otherwise than by one step.

    Returns
    -------
    FitResult
        With the verdict on all of them.
    """
    status, flags = verdict([
        *fit.flags,
        *([Status.SIDELOBE] if sidelobe else []),
        *([Status.SATURATED] if is_saturated(scene, saturated, region, fit) else []),
        *([Status.TOO_CLOSE] if too_close else []),
        *([Status.POOR_FIT] if poor_fit else []),
    ])  # fmt: skip
    return replace(fit, status=status, flags=flags)


def search_both(detection: Detection, *, searches: int = 1) -> Detection:
    """Search both polarities, for one that is not wanted has side lobes that are.

    Parameters
    ----------
    detection : Detection
        As configured.
    searches : int
        Images that share the expected false alarms.

    Returns
    -------
    Detection
        Where one polarity is wanted, twice the false alarms: half of them have the other.
    """
    sides = 1 if detection.polarity == "both" else 2
    alarms = sides * detection.false_alarms_per_movie / searches
    return detection.model_copy(update={"polarity": "both", "false_alarms_per_movie": alarms})


def reported_steps(scene: Scene) -> int:
    """Give which steps of a landing movie have the polarity that is reported.

    Parameters
    ----------
    scene : Scene
        Its template tells what landing does to the light.

    Returns
    -------
    int
        1 landings, −1 leavings, 0 both.
    """
    return scene.config.detection.sign * int(scene.templates.signs[0])


def _uses_conditional(config: Config) -> bool:
    """Whether the fits condition on the sum of counts before and after."""
    if config.fit.likelihood == "auto":
        return config.optics.scheme != "darkfield" and _is_counted(config)
    return config.fit.likelihood == "conditional"


def _is_counted(config: Config) -> bool:
    """Whether the background is a sum of counts, which is what the conditional law is about."""
    return config.background.method in ("fixed", "sliding")


def _pixel_nm(config: Config) -> float:
    if config.camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed: set it, as in camera.pixel_size_nm = 84.4"
        )
    return config.camera.pixel_size_nm
