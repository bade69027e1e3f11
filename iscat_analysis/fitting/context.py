"""Models, matched filter and threshold that follow from the configuration of a movie."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from iscat_analysis.camera import LightModel, NoiseSpectrum, PartOfLight
from iscat_analysis.config import Config, Detection
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import KNOWN, MEAN, MEDIAN
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.inference.heights import height_prior
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.local import (
    LocalModels,
    refuse_moving_focus,
    refuse_uneven_field,
    terms_of,
)
from iscat_analysis.optics.pixels import margin_nm
from iscat_analysis.optics.sized import SeatedModel, seated_models
from iscat_analysis.records import FREE_PARAMETERS, FloatArray
from iscat_analysis.search.frames import Tile
from iscat_analysis.search.sliding import CORRELATION
from iscat_analysis.search.templates import LARGEST_IMAGE, Templates, make_templates

SPREAD_NM = 10_000.0
"""Farther than this from a particle its rings are left out; they are 1e-4 of its peak."""


_VARIANCE_OF_BACKGROUND = {
    "fixed": MEAN, "sliding": MEAN, "tracks": MEAN, "median": MEDIAN, "known": KNOWN,
}  # fmt: skip
"""Variance of a measured background over that of the mean of its frames."""


@dataclass(frozen=True)
class AnalysisContext:
    """Everything that is the same for all fields of a movie: models, templates, scale."""

    config: Config
    model: ForwardModel
    wide: ForwardModel
    templates: Templates
    mode: str
    searches: int = 1
    lines: LightModel | PartOfLight | None = None
    # of fitted regions, of their surroundings, and of all that is seen far away
    local: tuple[LocalModels, ...] | None = None

    def model_at(self, x_nm: float, y_nm: float, frame: int | None = None) -> ForwardModel:
        """Give the model for fitted regions at a place, in a frame of the movie."""
        return self.model if self.local is None else self.local[0].at(x_nm, y_nm, frame)

    def wide_at(
        self, x_nm: float, y_nm: float, frame: int | None = None, *, reach_px: float = math.inf
    ) -> ForwardModel:
        """Give the model for signals far away of a particle at a place, in a frame of the movie.

        One that reaches no farther than the side of a region takes a fifth of the time to make.
        """
        if self.local is None:
            return self.wide
        return self.local[1 if reach_px <= self.roi_px else 2].at(x_nm, y_nm, frame)

    def on_tile(self, tile: Tile) -> AnalysisContext:
        """Give the same for a tile, whose places count from its own corner."""
        local, lines, noise = self.local, self.lines, self.templates.noise
        if local is not None:
            corner_nm = tile.corner[0] * self.pixel_nm, tile.corner[1] * self.pixel_nm
            local = tuple(models.on_tile(corner_nm) for models in local)
        if isinstance(lines, LightModel):
            lines = PartOfLight(lines, tile.here)
        if noise is not None:
            noise = noise.on(tile.shape)
        templates = replace(self.templates, noise=noise)
        return replace(self, local=local, lines=lines, templates=templates)

    def height_nm(self, mass_kda: float) -> float:
        """Height at which a particle is expected, where its height is not free."""
        return self.config.particle.mean_height_nm(mass_kda)

    def with_prior(self, likelihood: Likelihood, mass_kda: float) -> Likelihood:
        """Add the prior of the height to a likelihood, in mode mass."""
        prior = height_prior(self.config, mass_kda)
        return likelihood if prior is None else replace(likelihood, prior=prior)

    def spheres_of(self, model: ForwardModel) -> tuple[SeatedModel, ...]:
        """Give the spheres that a particle among proteins may be, in a model's microscope."""
        fit, optics = self.config.fit, self.config.optics
        absolute = optics.convention == "exact" and optics.emission == "reciprocal"
        proteins = not fit.heights_free and self.config.particle.kind == "protein"
        if not (proteins and absolute) or model.is_measured or self.additive:
            return ()
        if model is self.model:
            return self._near_spheres
        return seated_models(model, fit.spheres, fit.diameter_range_nm)

    @cached_property
    def _near_spheres(self) -> tuple[SeatedModel, ...]:
        fit = self.config.fit
        return seated_models(self.model, fit.spheres, fit.diameter_range_nm)

    @property
    def pixel_nm(self) -> float:
        """Pixel side [nm]."""
        return _pixel_nm(self.config)

    @property
    def roi_px(self) -> int:
        """Side of the fitted square [pixels]."""
        return self.config.fit.roi_px(self.pixel_nm)

    def left(self, signal: FloatArray) -> FloatArray:
        """Give what is left of a signal after frames are divided by their unsteady light.

        Shapes: `signal` (y, x), result (y, x).
        """
        return signal if self.lines is None else (1 + signal) / self.lines.taken(signal) - 1

    def contrasts(self, amplitude: FloatArray) -> FloatArray:
        """Give the peak contrast of particles at the nominal height."""
        nominal = self.model.material.mass_kda
        peak = self.model.peak_contrast(self.model.height_nm, nominal)
        return amplitude * peak / self.model.scale.amplitude(nominal)

    @property
    def background_variance(self) -> float:
        """Variance of the background over that of the mean of its frames."""
        return variance_of_background(self.config)

    @property
    def additive(self) -> bool:
        """Whether particles add to the background instead of multiplying it."""
        return self.model.rho == 0


def make_context(
    config: Config,
    field_px: tuple[int, int],
    *,
    searches: int = 1,
    noise: NoiseSpectrum | None = None,
    lines: LightModel | None = None,
    sliding: bool = False,
) -> AnalysisContext:
    """Build the models and the matched filter for a field."""
    pixel, roi_px = square_of(config, field_px)
    counted = config.optics.interferes and config.background.is_counted
    if config.fit.likelihood == "conditional" and not counted:
        raise ConfigError(
            'fit.likelihood = "conditional" needs an interferometric scheme and '
            'background.method = "fixed" or "sliding": use "auto"'
        )
    if not sliding or config.optics.psf == "measured":
        refuse_moving_focus(config)
    refuse_uneven_field(config)
    model = square_model(config, pixel, roi_px)
    if sliding:
        reach_nm = math.sqrt(2) * (farthest_px(config, field_px) + 2) * pixel
    else:
        field_nm = math.hypot(field_px[0] + 1, field_px[1] + 1) * pixel
        reach_nm = min(field_nm, math.sqrt(2) * (SPREAD_NM + 2 * pixel))
    mode = config.fit.mode
    free_z = "z_nm" in FREE_PARAMETERS[mode] and not sliding
    wide = forward_model(config, reach_nm)
    local = None
    if terms_of(config.optics):
        beside = forward_model(config, math.sqrt(2) * (roi_px + 2) * pixel)
        local = (
            LocalModels(config, model, field_px),
            LocalModels(config, beside, field_px),
            # models that reach far at hand, of 7 MB each
            LocalModels(config, wide, field_px, kept=12),
        )
    return AnalysisContext(
        config=config,
        model=model,
        wide=wide,
        local=local,
        templates=make_templates(
            model,
            search_both(config.detection, searches=searches),
            pixel_nm=pixel,
            roi_nm=config.fit.roi_nm,
            z_range_nm=config.fit.z_range_nm if free_z else None,
            field_px=field_px,
            noise=noise,
            in_turn=not sliding,
            correlation=CORRELATION if sliding and searches > 1 else 0.0,
        ),
        mode=mode,
        searches=searches,
        lines=lines,
    )


def farthest_px(config: Config, field_px: tuple[int, int]) -> float:
    """Give how far from a particle that lands its rings are drawn at most [pixels].

    Those of a bright sphere are seen in all of a field of usual size.
    """
    pixel = _pixel_nm(config)
    largest = LARGEST_IMAGE * config.fit.roi_px(pixel)
    if not config.particle.is_sphere:
        return largest
    return max(largest, min(max(field_px), 2 * SPREAD_NM / pixel))


def square_of(config: Config, field_px: tuple[int, int]) -> tuple[float, int]:
    """Give the side of a pixel and of the square that is fitted."""
    pixel = _pixel_nm(config)
    roi_px = config.fit.roi_px(pixel)
    if roi_px > min(field_px):
        raise ConfigError(
            f"fit.roi_nm = {config.fit.roi_nm:g} is {roi_px} pixels, more than the field of "
            f"{field_px[0]} x {field_px[1]}: lower fit.roi_nm or check camera.pixel_size_nm"
        )
    return pixel, roi_px


def square_model(config: Config, pixel_nm: float, roi_px: int) -> ForwardModel:
    """Build the forward model of the square that is fitted."""
    margin = pixel_nm + margin_nm(config.optics, pixel_nm)
    return forward_model(
        config, math.sqrt(2) * (roi_px * pixel_nm / 2 + window_nm(pixel_nm) + margin)
    )


def search_both(detection: Detection, *, searches: int = 1) -> Detection:
    """Search both signs: particles of the unwanted sign have side lobes of the wanted one."""
    sides = 1 if detection.polarity == "both" else 2
    alarms = sides * detection.false_alarms_per_movie / searches
    return detection.model_copy(update={"polarity": "both", "false_alarms_per_movie": alarms})


def reported_steps(context: AnalysisContext) -> int:
    """Tell which steps of a landing movie have the sign that is reported."""
    return context.config.detection.sign * int(context.templates.signs[0])


def variance_of_background(config: Config) -> float:
    """Give the variance of the background over that of the mean of its frames."""
    return _VARIANCE_OF_BACKGROUND[str(config.background.method)]


def _pixel_nm(config: Config) -> float:
    if config.camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed: set it, as in camera.pixel_size_nm = 84.4"
        )
    return config.camera.pixel_size_nm
