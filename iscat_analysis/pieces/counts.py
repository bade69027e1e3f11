"""Arguments of the functions of arrays, checked once.

Microscope, particle and camera; arrays to broadcast; counts before and after, or contrasts, of
regions, and the likelihood of each.
"""

# Annotations are evaluated: the declarations of keywords are read when the program runs.

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.config import (
    LARGEST_NM,
    Calibration,
    CameraConfig,
    Config,
    Fit,
    Optics,
    Particle,
)
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference import checks
from iscat_analysis.inference.checks import number_in, real_array
from iscat_analysis.inference.counts import KNOWN, MEAN, choose_noise, counts_likelihood, gaussian
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import collected_area_nm2, photons_per_intensity
from iscat_analysis.options import takes
from iscat_analysis.records import FREE_PARAMETERS, BoolArray, FloatArray
from iscat_analysis.units import count

Array = Annotated["ArrayLike | None", "Optional."]
Frames = Annotated[int | None, "Optional."]
Line = Annotated["Calibration | None", "Optional."]
Mode = Annotated[str, "Which parameters are free.", "", "mass"]
Place = Annotated["ArrayLike", "From the centre [nm].", "", 0.0]


class LightOptions(TypedDict, total=False):
    """Light of the frames before and after, and pixels to leave out."""

    n_before: Frames
    n_after: Frames
    power_ratio: Array
    level: Annotated[bool | None, "Optional."]
    masked: Array


class ImageOptions(LightOptions, total=False):
    """Counts or contrast images of many regions."""

    contrast: Array
    sigma: Array
    saturated: Array


class ModelOptions(TypedDict, total=False):
    """Which parameters of a particle are free, and its scale."""

    mode: Mode
    z_range_nm: Annotated[tuple[float, float], "Heights [nm].", "", (0.0, 1000.0)]
    calibration: Line


class LikelihoodOptions(LightOptions, ModelOptions, total=False):
    """The likelihood of one region."""


class FitOptions(ImageOptions, ModelOptions, total=False):
    """Fits of many regions."""

    corners_px: Array
    workers: Annotated[int, "Number of threads.", "", 1]


class ParticleOptions(TypedDict, total=False):
    """A particle, and its scale."""

    z_nm: Array
    mass_kda: Array
    calibration: Line


class SquareOptions(ParticleOptions, total=False):
    """A square image of a particle."""

    pixels: Annotated[int, "Side of the image.", "", 33]
    x_nm: Place
    y_nm: Place


class QuantumOptions(ParticleOptions, total=False):
    """A measurement of a particle."""

    n_after: Annotated["ArrayLike", "Frames with the particle.", "", 1]
    mode: Mode
    focus_nm: Array


class BoundOptions(SquareOptions, QuantumOptions, total=False):
    """A measurement with a camera."""

    n_before: Annotated["ArrayLike", "Frames of background.", "", 0]


LARGEST_REGION = 1500
"""Pixels along a side of a region, whose bounds take half a gigabyte."""


def config_of(
    optics: Optics | None,
    particle: Particle | None,
    camera: CameraConfig | None,
    *,
    mode: str = "joint",
    z_range_nm: tuple[float, float] = (0.0, 1000.0),
    calibration: Calibration | None = None,
) -> Config:
    """Put microscope, particle and camera together."""
    line = "Calibration(gradient_per_kda=-3.1e-5)"
    for name, value, kinds, example in (
        ("optics", optics, Optics, "Optics(na=1.42) returns"),
        ("particle", particle, Particle, "Particle(mass_kda=480) returns"),
        ("camera", camera, CameraConfig, "Camera(pixel_size_nm=84.4) returns"),
        ("calibration", calibration, Calibration | None, f"{line} returns, or None"),
    ):
        if not isinstance(value, kinds):
            raise ConfigError(
                f"{name}: is {type(value).__name__}; give what iscat_analysis.{example}"
            )
    if camera is None or camera.pixel_size_nm is None:
        raise ConfigError("camera.pixel_size_nm is needed: Camera(pixel_size_nm=84.4)")
    if isinstance(camera.assumed.read_noise_e, str):
        raise ConfigError(
            f"camera.read_noise_e = {camera.read_noise_e!r} is a map: give one number [e]"
        )
    checks.choice_in("mode", mode, tuple(FREE_PARAMETERS))
    fit = Fit(mode=mode, z_range_nm=z_range_nm)
    return Config(optics=optics, particle=particle, camera=camera, calibration=calibration, fit=fit)


def together(
    given: Mapping[str, ArrayLike], *, least: Mapping[str, float]
) -> dict[str, FloatArray]:
    """Broadcast arrays against one another."""
    arrays = {name: real_array(name, value) for name, value in given.items()}
    for name, array in arrays.items():
        most = LARGEST_NM if name.endswith("_nm") else checks.LARGEST
        bad = ~(np.abs(array) <= most)
        if name in least:
            bad |= array < least[name]
        if bad.any():
            value = array[bad].flat[0]
            limit = f" of at least {least[name]:g}" if name in least else ""
            if np.isfinite(value) and abs(value) > most:
                limit = f" of at most {most:g}"
            raise ConfigError(f"{name} = {value:g}: give finite numbers{limit}")
    try:
        same = np.broadcast_arrays(*arrays.values())
    except ValueError:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in arrays.items() if a.ndim)
        raise ConfigError(
            f"shapes do not go together: {shapes}; see numpy's broadcasting"
        ) from None
    return dict(zip(arrays, same, strict=True))


def darkfield_photons(particle: Particle) -> float:
    """Give the scale of masses in dark field."""
    if particle.photons_per_frame is None:
        raise ConfigError(
            "particle.photons_per_frame is needed in dark field, where it is the scale of masses: "
            "give the scattered photons that are collected per frame from a particle of "
            "particle.mass_kda, as in photons_per_frame=3000"
        )
    return particle.photons_per_frame


LARGEST_RATIO = 1e9
"""Largest ratio of the light after and before, and of the light before and after."""

_LARGEST_CONTRAST, _SMALLEST_SCATTER = 0.5, 0.1
"""Median below which an image is one of contrasts, and interquartile range below which numbers
about 0 or 1 are no photoelectrons: shot noise makes so few scatter by 1."""


@dataclass(frozen=True)
class Counts:
    """Regions of one size under one microscope; build it with `gather`.

    Where `sigma` is given, `after` has contrasts, and nothing is known of the light.
    """

    config: Config
    model: ForwardModel
    grid: PixelGrid
    before: FloatArray
    after: FloatArray
    ratio: FloatArray
    level: bool
    n_before: int
    n_after: int
    masked: BoolArray
    saturated: BoolArray
    sigma: FloatArray | None = None

    def likelihood(self, index: int) -> Likelihood:
        """Likelihood of one region."""
        if self.sigma is not None:
            contrast, sigma, masked = (a[index] for a in (self.after, self.sigma, self.masked))
            return gaussian(self.model, self.grid, contrast, sigma, masked=masked)
        ratio, read_e = float(self.ratio[index]), float(self.config.camera.assumed.read_noise_e)
        interferes, counted = bool(self.model.rho), self.n_before > 0
        return counts_likelihood(
            self.model,
            self.grid,
            self.before[index],
            self.after[index],
            ratio,
            background=MEAN if counted else KNOWN,
            noise=choose_noise("auto", interferes=interferes, counted=counted),
            scale_e=None if interferes else self._scale_e(ratio),
            read_variances_e2=(self.n_before * read_e**2, self.n_after * read_e**2),
            masked=self.masked[index],
        )

    def collected(self, index: int, z_nm: float, mass_kda: float) -> float:
        """Scattered photons that the pupil collected in the frames after; NaN if not known."""
        if self.sigma is not None:
            return math.nan
        area = collected_area_nm2(self.model, z_nm, mass_kda) / self.grid.pixel_nm**2
        ratio = float(self.ratio[index])
        if not self.model.rho:
            return self._scale_e(ratio) * area
        used = ~self.masked[index]
        return ratio * float(self.before[index][used].mean()) * area

    def _scale_e(self, ratio: float) -> float:
        """Photoelectrons per pixel for unit signal in dark field."""
        photons = darkfield_photons(self.config.particle)
        per_frame = photons_per_intensity(self.model, photons, self.grid.pixel_nm)
        return per_frame * ratio * max(self.n_before, 1)


@takes(ImageOptions)
def gather(
    config: Config,
    before: ArrayLike | None,
    after: ArrayLike | None,
    **options: Unpack[ImageOptions],
) -> Counts:
    """Check the counts, or contrasts, and the arguments that describe them.

    Contrasts of a known light, `before`, are counts too.

    Shapes: `before, after, contrast` (n, y, x).
    """
    contrast, sigma, power_ratio = (options[k] for k in ("contrast", "sigma", "power_ratio"))
    _require({"before": before, "after": after, **options})
    name, given = ("after", after) if contrast is None else ("contrast", contrast)
    events = real_array(name, () if given is None else given)
    if events.ndim != 3 or min(events.shape[1:], default=0) < 5:
        raise DataError(
            f"{name}: has shape {events.shape}; give regions of at least 5 x 5 pixels as (n, y, x)"
        )
    n_before, n_after, spread = options["n_before"], options["n_after"], None
    if sigma is not None:
        spread = _sigma_of(sigma, events.shape)
        before, n_before, n_after = 1.0, 0, 1
    n_before = int(number_in("n_before", n_before, least=0, whole=True))
    n_after = int(number_in("n_after", n_after, least=1, whole=True))
    background = _background_of(before, events.shape, known=not n_before)
    burnt = _mask_of("saturated", options["saturated"], events.shape)
    out = _mask_of("masked", options["masked"], events.shape) | burnt
    for label, array in (("before", background), (name, events)):
        wrong = int(np.count_nonzero(~np.isfinite(array) & ~out))
        if wrong:
            raise DataError(
                f"{label}: is not finite in {count(wrong, 'pixel')}; mask them with masked=…"
            )
    usual = n_after / max(n_before, 1)
    ratio = _ratio_of(usual if power_ratio is None else power_ratio, len(events))
    pixel_nm = config.camera.pixel_nm
    rows, columns = events.shape[1:]
    reach = math.hypot(rows + 2, columns + 2) * pixel_nm + window_nm(pixel_nm)
    model = forward_model(config, reach)
    if model.rho:
        _refuse_other_numbers(name, events, out)
    elif contrast is not None:
        raise ConfigError(
            'contrast: optics.scheme = "darkfield" has no reference that light is compared with: '
            "give photoelectrons as before=… and after=…"
        )
    if contrast is not None and sigma is None:
        events = ratio[:, None, None] * background * (1 + events)
    level = (n_before > 0 or sigma is not None) and power_ratio is None and bool(model.rho)
    if options["level"] is not None:
        level = checks.truth_in("level", options["level"])
    grid = PixelGrid.region((0, rows), (0, columns), pixel_nm)
    return Counts(
        config, model, grid, background, events, ratio, level, n_before, n_after, out, burnt, spread
    )


def _background_of(before: ArrayLike | None, shape: tuple[int, ...], *, known: bool) -> FloatArray:
    """Give the light before every region; one that is known may be an image or a number."""
    background = real_array("before", () if before is None else before)
    if background.shape not in ((shape, shape[1:], ()) if known else (shape,)):
        also = ", an image (y, x) or a number" if known else ""
        raise DataError(f"before: has shape {background.shape}; give {shape} as after has{also}")
    return np.array(np.broadcast_to(background, shape))


def _ratio_of(power_ratio: ArrayLike, regions: int) -> FloatArray:
    """Give the light after over that before of every region."""
    ratio = real_array("power_ratio", power_ratio)
    if ratio.shape not in ((), (regions,)):
        raise DataError(f"power_ratio: has shape {ratio.shape}; give one number or {regions}")
    bad = ~((ratio > 1 / LARGEST_RATIO) & (ratio < LARGEST_RATIO))
    if bad.any():
        raise DataError(
            f"power_ratio = {ratio[bad].flat[0]:g}: give the light after over that before, above 0 "
            f"and below {LARGEST_RATIO:g}"
        )
    return np.array(np.broadcast_to(ratio, regions))


def _require(given: Mapping[str, Any]) -> None:
    """Refuse a choice of arguments that does not describe regions."""
    light: tuple[str, ...] = ("before", "n_before", "n_after")
    wanted = (*light, "after")
    if given["contrast"] is not None:
        wanted = ("contrast", *(light if given["sigma"] is None else ("sigma",)))
    allowed = {*wanted, "level", "masked", "saturated"}
    allowed |= {"power_ratio"} if "before" in wanted else set()
    missing = [name for name in given if name in wanted and given[name] is None]
    needless = [name for name, value in given.items() if value is not None and name not in allowed]
    if missing or needless:
        what = "missing" if missing else "not needed"
        raise ConfigError(
            f"{', '.join(missing or needless)}: {what}; give before, after, n_before and n_after "
            "(photoelectrons), contrast and sigma (contrast images with their noise), or contrast, "
            "before, n_before and n_after (contrast images with their light in photoelectrons)"
        )


def _sigma_of(value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Give the noise of every pixel, from a number, an image or one image for each region."""
    sigma = real_array("sigma", value)
    if sigma.shape not in ((), shape[1:], shape):
        raise DataError(f"sigma: has shape {sigma.shape}; give a number, {shape[1:]} or {shape}")
    wrong = ~((sigma > 0) & np.isfinite(sigma))
    if wrong.any():
        raise DataError(
            f"sigma = {sigma[wrong].flat[0]:g}: give the standard deviation of a pixel of the "
            "contrast images, above 0, and leave pixels out with masked=…"
        )
    return np.array(np.broadcast_to(sigma, shape))


def _refuse_other_numbers(name: str, events: FloatArray, masked: BoolArray) -> None:
    """Refuse ratios and contrasts that are given as counts, and others that are given as contrasts.

    Shapes: `events` (n, y, x).
    """
    used = events[~masked]
    if not used.size:
        return
    low, middle, high = np.quantile(used, (0.25, 0.5, 0.75)).tolist()
    if name == "contrast" and abs(middle) > _LARGEST_CONTRAST:
        raise DataError(
            f"contrast: its median is {middle:.2g}; give the light over that without the particle, "
            "minus 1, which is about 0" + (" (subtract 1)" if middle < 2 else "")
        )
    whole = bool(np.all(used == np.round(used)))
    if name == "after" and abs(middle) < 2 and high - low < _SMALLEST_SCATTER and not whole:
        minus = "" if abs(middle) < _LARGEST_CONTRAST else " minus 1"
        raise DataError(
            f"after: half of its pixels are between {low:.5g} and {high:.5g}; these are no "
            f"photoelectrons but {'ratios' if minus else 'contrasts'}: give them{minus} to "
            "fit_rois as contrast=…, with sigma=… or before=…"
        )


def _mask_of(name: str, value: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """Give a mask for every region, from one for each or one for all."""
    if value is None:
        return np.zeros(shape, dtype=np.bool_)
    array = checks.array_of(name, value)
    if array.dtype != np.bool_:
        raise DataError(f"{name}: holds {array.dtype}; give True where a pixel must not be used")
    if array.shape not in (shape, shape[1:]):
        raise DataError(f"{name}: has shape {array.shape}; give {shape} or {shape[1:]}")
    return np.array(np.broadcast_to(array, shape))
