"""A template from the bright particles of a movie, and whether it describes those held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from iscat_analysis.camera.learned import with_camera
from iscat_analysis.camera.metadata import resolve_metadata
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.fitting.background_mode import background_mode
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.instrument.learner import LEAST_SIGHTS, Judgement, ParticleImage, judge
from iscat_analysis.instrument.learner.measured_picture import (
    PictureFit,
    fit_own,
    fit_picture,
    place_particle_images,
)
from iscat_analysis.instrument.microscope import goodness, refuse_uncalibratable
from iscat_analysis.instrument.particle_images import bright_particle_images, kind_of, reach_nm
from iscat_analysis.movie.stack import Stack
from iscat_analysis.optics.forward import ForwardModel, forward_model, with_template
from iscat_analysis.optics.measured import Template, lattice_step_nm
from iscat_analysis.records import Mapper, Progress, silent
from iscat_analysis.text import in_toml
from iscat_analysis.threads import threads
from iscat_analysis.units import count

HELD_OUT_P = 1e-3
"""p-value of the held-out pictures' p-values, below which the template does not describe them."""

MARGINS_PX = (10, 6, 2)
"""Pixels by which pictures may be cut larger on every side than the square that is fitted later.

The farther the template reaches, the more is known of the rings of a particle's neighbours; but
the larger a picture, the fewer hold one particle alone.
"""

_PLENTY = 18  # pictures with which a margin is good enough
_HELD_OUT = 3  # every third picture is held out
_CONTAMINATED_P = 1e-4  # something else happened in a picture with a smaller p-value
_CONTAMINATED_SHARE = 0.25  # more than this is the template's fault
_NEW = 0.02  # share of a neighbour's contrast that is new in a picture and disturbs it
_CLEAR_NM = 600.0  # from the edge of a picture to the nearest other particle


@dataclass(frozen=True, eq=False)
class MeasuredPicture:
    """A template, and how it describes pictures that did not make it."""

    config: Config
    fit: PictureFit
    judgement: Judgement
    contaminated: int
    source: Mapping[str, str]
    refusals: tuple[str, ...]

    @property
    def template(self) -> Template:
        """The picture."""
        return self.fit.template

    @property
    def accepted(self) -> bool:
        """Whether it may be used."""
        return not self.refusals

    def headline(self) -> str:
        """Say in one line what was found."""
        judged = self.judgement
        return (
            f"a template from {self.template.sights} particles, {self.fit.effective:.0f} numbers "
            f"determined by them, its peak to {100 * self.template.peak_se:.2g} %; reduced chi2 of "
            f"{judged.p_values.size} that were held out {np.mean(judged.chi2_reduced):.3f} "
            f"(p-values uniform: p = {judged.uniform_p:.2g})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``template.json`` holds."""
        found, judged = self.template, self.judgement
        return {
            "accepted": self.accepted,
            "refusals": list(self.refusals),
            "particles": found.sights,
            "contaminated": self.contaminated,
            "determined": self.fit.effective,
            "peak_se": found.peak_se,
            "pixel_nm": found.pixel_nm,
            "roi_nm": found.roi_nm,
            "held_out": {
                "p_values": judged.p_values.tolist(),
                "chi2_reduced": judged.chi2_reduced.tolist(),
                "uniform_p": judged.uniform_p,
            },
            "source": dict(self.source),
        }

    def to_toml(self, template: str, checksum: str) -> str:
        """Write what ``[optics] file`` reads."""
        lines = [
            "# Template measured by `iscat calibrate optics --measured`",
            "", "[optics]", 'psf = "measured"', f'template = "{template}"',
            "", "[template]", f'sha256 = "{checksum}"',
            f"pixel_nm = {self.template.pixel_nm:.9g}", f"roi_nm = {self.template.roi_nm:.9g}",
            f"peak_se = {self.template.peak_se:.3g}",
            "", "[provenance]", *(f"{key} = {in_toml(text)}" for key, text in self.source.items()),
            f"particles = {self.template.sights}", "",
        ]  # fmt: skip
        return "\n".join(lines)


def measure_template(
    movie: Stack,
    config: Config,
    *,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> MeasuredPicture:
    """Measure the picture of a particle in an open movie."""
    movie = movie.channel(config.camera.channels)
    config, notes = resolve_metadata(config, movie.metadata)
    for note in notes:
        if notify is not None:
            notify(note)
    refuse_uncalibratable(config)
    if config.fit.mode != "mass":
        raise ConfigError(
            f'fit.mode = "{config.fit.mode}" needs the picture at every height, which --measured '
            'does not give: use fit.mode = "mass"'
        )
    pixel = float(config.camera.pixel_size_nm or np.nan)
    roi_nm = config.fit.roi_px(pixel) * pixel
    physics = config.optics.model_copy(update={"psf": "model", "template": None})
    span = config.background.recorded or fitted_frames(movie, config)
    movie, config, known = with_camera(movie, config, span)
    camera = known.camera
    with threads(config.compute.workers) as pool:
        for number, margin in enumerate(MARGINS_PX):
            progress("particles", number, len(MARGINS_PX))
            larger = config.fit.model_copy(update={"roi_nm": roi_nm + 2 * margin * pixel})
            cut = config.model_copy(update={"fit": larger, "optics": physics, "calibration": None})
            alone = _alone(*bright_particle_images(movie, cut, camera, pool))
            if len(alone) >= _PLENTY:
                break
        progress("particles", len(MARGINS_PX), len(MARGINS_PX))
        if len(alone) < LEAST_SIGHTS:
            raise DataError(
                f"{movie.path.name}: shows {count(len(alone), 'bright particle')} without another "
                f"nearby, and at least {LEAST_SIGHTS} are needed to measure a picture; record more "
                "particles, fewer at a time, or brighter ones"
            )
        nominal = forward_model(cut, max(map(reach_nm, alone)) + roi_nm / 10)
        source = {
            "movie": movie.path.name,
            "sha256": movie.sha256(),
            "kind": kind_of(config),
            "version": version("iscat-analysis"),
        }
        step = lattice_step_nm(config.optics.wavelength_nm, config.optics.n_glass)
        settings = {
            "roi_nm": max(roi_nm, config.fit.roi_nm),
            "step_nm": step,
            "level": background_mode(config) == "sliding",
        }
        return _judged(
            place_particle_images(alone, nominal), nominal, config, settings, source, pool.map
        )


def _judged(
    sights: Sequence[ParticleImage],
    nominal: ForwardModel,
    config: Config,
    settings: Mapping[str, float],
    source: Mapping[str, str],
    mapper: Mapper,
) -> MeasuredPicture:
    """Fit with a third held out, leave out what is not a particle alone, then fit them all."""
    level = bool(settings["level"])
    options = {"roi_nm": settings["roi_nm"], "step_nm": settings["step_nm"]}

    def fit(some: Sequence[ParticleImage]) -> PictureFit:
        return fit_picture(some, nominal, level=level, mapper=mapper, **options)

    def fitted_with(some: Sequence[ParticleImage], found: PictureFit) -> list[ParticleImage]:
        model = with_template(nominal, found.template)
        return list(mapper(lambda s: fit_own(s, model, level=level), some))

    def judged(some: Sequence[ParticleImage], found: PictureFit) -> Judgement:
        model = with_template(nominal, found.template)
        return judge(some, {}, lambda sight, _: goodness(sight, model), mapper)

    first = fit([s for i, s in enumerate(sights) if i % _HELD_OUT != 1])
    held = fitted_with(sights[1::_HELD_OUT], first)
    kept = [(some, judged(some, first).p_values > _CONTAMINATED_P) for some in (first.sights, held)]
    bad = sum(int(np.sum(~good)) for _, good in kept)
    contaminated = 0
    if 0 < bad <= _CONTAMINATED_SHARE * len(sights):
        contaminated = bad
        rest = [s for s, ok in zip(*kept[0], strict=True) if ok]
        first = fit(rest)
        held = fitted_with([s for s, ok in zip(*kept[1], strict=True) if ok], first)
    judgement = judged(held, first)
    refusals = []
    if judgement.uniform_p < HELD_OUT_P:
        refusals.append(
            f"of {judgement.p_values.size} pictures that were held out the p-values are not "
            f"uniform (p = {judgement.uniform_p:.1g}, mean reduced chi2 = "
            f"{float(np.mean(judgement.chi2_reduced)):.3f})"
        )
    return MeasuredPicture(
        config, fit([*first.sights, *held]), judgement, contaminated, source, tuple(refusals)
    )


def _alone(sights: Sequence[ParticleImage], others: Sequence[ParticleImage]) -> list[ParticleImage]:
    """Leave out pictures into which another particle reaches."""

    def is_alone(sight: ParticleImage) -> bool:
        room = sight.grid.pixel_nm * max(sight.grid.shape) / 2 + _CLEAR_NM
        x, y = float(np.mean(sight.grid.x_nm)), float(np.mean(sight.grid.y_nm))
        near = (others[number] for number, share in sight.neighbours if abs(share) > _NEW)
        return all(max(abs(o.x_nm - x), abs(o.y_nm - y)) > room for o in near)

    return [sight for sight in sights if is_alone(sight)]
