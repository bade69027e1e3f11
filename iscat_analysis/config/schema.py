"""The whole configuration: its sections, and conditions between them.

Lengths are nm, masses kDa, counts photoelectrons; ranges are half-open ``[start, stop)`` frames;
complex numbers are ``[re, im]``.  The description of each field is what `iscat config` prints
beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Self, TypedDict, Unpack

from pydantic import Field, model_validator

from iscat_analysis.config.analysis import (
    BackgroundConfig,
    Calibration,
    Compute,
    Detection,
    Fit,
    PosteriorConfig,
    TrackConfig,
    Uncertainty,
)
from iscat_analysis.config.instrument import AUTO, CameraConfig, Optics, Particle
from iscat_analysis.config.synthetic import BoundsConfig, Simulation
from iscat_analysis.config.values import ALL, LARGEST_NM, Section, unit_guess
from iscat_analysis.errors import ConfigError
from iscat_analysis.units import sphere_diameter_nm

Change = Mapping[str, Any] | Section | None
"""Keys of a section that change, or what takes its place."""


class Sections(TypedDict, total=False):
    """Sections of a configuration that change."""

    optics: Change
    camera: Change
    particle: Change
    background: Change
    fit: Change
    track: Change
    posterior: Change
    calibration: Change
    bounds: Change
    compute: Change


class Config(Section):
    """A whole configuration; `iscat_analysis.config.configure` makes one.

    The method of the background is explicit in it: where `background.method` is not given, it is
    ``"fixed"`` if background frames are given and in dark field (``"median"`` where these are
    ``"all"``), else ``"tracks"`` in mode track and ``"sliding"`` in the others.
    """

    optics: Optics = Field(default_factory=Optics)
    camera: CameraConfig = Field(default_factory=CameraConfig)
    particle: Particle = Field(default_factory=Particle)
    background: BackgroundConfig = Field(default_factory=BackgroundConfig)
    detection: Detection = Field(default_factory=Detection)
    fit: Fit = Field(default_factory=Fit)
    track: TrackConfig = Field(default_factory=TrackConfig)
    posterior: PosteriorConfig = Field(default_factory=PosteriorConfig)
    calibration: Calibration | None = None
    uncertainty: Uncertainty = Field(default_factory=Uncertainty)
    simulation: Simulation = Field(default_factory=Simulation)
    bounds: BoundsConfig = Field(default_factory=BoundsConfig)
    compute: Compute = Field(default_factory=Compute)

    @model_validator(mode="after")
    def _possible(self) -> Self:
        """Choose what is left open, and refuse sections that do not go together.

        The model is frozen for its users; here it is still being made.
        """
        background = self.background
        if background.method is None:
            method = "sliding" if self.optics.interferes else "fixed"
            method = "tracks" if self.fit.follows_tracks else method
            method = "fixed" if background.frames is not None else method
            method = "median" if background.frames == ALL else method
            self.__dict__["background"] = background.model_copy(update={"method": method})
        line, camera = self.calibration, self.camera
        if line is not None and line.camera is not None and camera.samples_per_pixel == AUTO:
            update = {"samples_per_pixel": line.camera.samples_per_pixel}
            self.__dict__["camera"] = camera.model_copy(update=update)
        if self.optics.calibrate == "auto" and self.particle.is_sphere:  # learned from dipoles
            self.__dict__["optics"] = self.optics.model_copy(update={"calibrate": "never"})
        for refusal in self._refusals():
            raise ValueError(refusal)
        return self

    def _refusals(self) -> Iterator[str]:
        for part in (_of_background, _of_particle, _of_fit, _of_template):
            yield from part(self)

    def changed(self, **sections: Unpack[Sections]) -> Config:
        """Replace keys of sections by values that are known to be valid.

        Parameters
        ----------
        **sections : mapping, section or None
            The keys of a section that change, or what takes its place.

        Returns
        -------
        Config
            Its other keys are as they were.
        """
        update = {
            name: getattr(self, name).model_copy(update=new) if isinstance(new, Mapping) else new
            for name, new in sections.items()
        }
        return self.model_copy(update=update)

    @property
    def heights_free(self) -> bool:
        """Whether every particle has a height of its own, which is fitted."""
        return self.track.heights_free if self.fit.follows_tracks else self.fit.heights_free

    @property
    def roi_px(self) -> int:
        """Side of the square that is fitted, in pixels."""
        return self.fit.roi_px(self.camera.pixel_nm)

    @property
    def fits_sizes(self) -> bool:
        """Whether the diameters of spheres are fitted, from which their masses follow."""
        return self.particle.is_sphere and self.fit.masses_free

    @property
    def samples_posterior(self) -> bool:
        """Whether posteriors are sampled: as configured, else if there are few events."""
        if self.fit.follows_tracks:
            return False
        if self.posterior.enabled == "auto":
            return not (self.background.slides or self.fit.kind.fits_sizes)
        return self.posterior.enabled


INVISIBLE = 1e-3
"""Relative difference between the indices of a particle and of the sample below which the particle
is not seen."""


def _of_background(config: Config) -> Iterator[str]:
    background, optics, fit = config.background, config.optics, config.fit
    moving = fit.follows_tracks
    if background.slides and not optics.interferes:
        yield (
            'background.method = "sliding" needs an interferometric scheme: dark field needs '
            "background.frames"
        )
    if background.slides and moving:
        yield (
            'background.method = "sliding" has no tracks: leave it out for fit.mode = "track", '
            "or give background.frames"
        )
    if background.learnt_with_tracks and not moving:
        yield (
            'background.method = "tracks" is made of what fit.mode = "track" finds, and '
            f'fit.mode is "{fit.mode}": use "sliding" for particles that land, or '
            '"fixed" with background.frames'
        )
    if background.frames == ALL and not (moving and optics.interferes):
        yield (
            'background.frames = "all" is for particles that move over an interferometric '
            f'background: with fit.mode = "{fit.mode}" and optics.scheme = "{optics.scheme}" give '
            "the frames before the particles, as in background.frames = [0, 200]"
        )
    if background.method == "median" and background.frames is None and moving:
        yield (
            'background.method = "median": of which frames?  Give those before the particles, '
            'as in background.frames = [0, 200], or background.frames = "all"'
        )


def _of_particle(config: Config) -> Iterator[str]:
    particle, fit = config.particle, config.fit
    if particle.is_sphere:
        yield from _of_sphere(config)
    elif fit.kind.fits_sizes:
        yield (
            f'fit.mode = "size" fits spheres, and particle.model is "{particle.model}": set '
            'particle.model = "mie" or "shell"'
        )
    elif particle.is_rod:
        yield from _of_rod(config)
    for kind in fit.spheres:
        if isinstance(kind, float) and abs(kind / config.optics.n_sample - 1) < INVISIBLE:
            yield (
                f"fit.spheres: {kind:g} is the index of the sample, optics.n_sample = "
                f"{config.optics.n_sample:g}: such a sphere scatters no light"
            )


def _of_fit(config: Config) -> Iterator[str]:
    fit, optics, particle = config.fit, config.optics, config.particle
    if fit.pairs:
        for key in _set(
            (f'fit.mode = "{fit.mode}"', fit.heights_free),
            ('optics.scheme = "darkfield"', not optics.interferes),
            ('optics.psf = "measured"', optics.psf == "measured"),
            ("particle.height_sd_nm", particle.height_prior_sd_nm > 0),
        ):
            yield (
                f"fit.pairs = true does not go together with {key}: pairs are fitted in fit.mode = "
                '"mass", at one height, with the model of interference'
            )
    if fit.index:
        absorbs = particle.permittivity is not None and particle.permittivity[1] != 0
        for key in _set(
            (f'fit.mode = "{fit.mode}": use "size"', not fit.kind.fits_sizes),
            (f'particle.model = "{particle.model}": use "mie"', particle.model != "mie"),
            ("a material that absorbs, which has two numbers", absorbs or particle.kind == "gold"),
        ):
            yield f"fit.index = true does not go together with {key}"
    for fixed in config.posterior.priors.keys() - set(fit.free):
        yield (
            f"posterior.prior_{fixed} is of a parameter that is fixed: use fit.mode = "
            '"joint", or leave the prior out'
        )
    wavelength, pixel = optics.wavelength_nm, config.camera.pixel_size_nm or 0.0
    if pixel > 4 * wavelength:
        yield (
            f"camera.pixel_size_nm = {pixel:g} is more than four wavelengths "
            f"(optics.wavelength_nm = {wavelength:g}): no image is left in such pixels"
        )
    smallest = max(wavelength / 4, pixel)
    if fit.roi_nm < smallest:
        yield (
            f"fit.roi_nm = {fit.roi_nm:g} is smaller than {smallest:g} nm, a pixel or a quarter of "
            "the wavelength: no particle fits into such a square"
            f"{unit_guess(fit.roi_nm, smallest, LARGEST_NM)}"
        )


def _of_template(config: Config) -> Iterator[str]:
    if config.optics.psf != "measured":
        return
    if config.fit.heights_free:
        yield (
            f'fit.mode = "{config.fit.mode}" needs the image at every height, and optics.psf = '
            '"measured" has it at one: use fit.mode = "mass", or optics.psf = "model"'
        )
    if config.particle.height_prior_sd_nm:
        yield (
            'optics.psf = "measured" has the image at one height: with it set '
            "particle.height_sd_nm = 0 and particle.height_nm to a number"
        )
    if config.particle.wiggle_nm:
        yield (
            'optics.psf = "measured" has the wiggle of the particles it shows: set '
            "particle.wiggle_nm = 0"
        )


def _set(*keys: tuple[str, bool]) -> Iterator[str]:
    """Name the keys that are set."""
    return (key for key, is_set in keys if is_set)


def _known_of_dipoles(config: Config) -> Iterator[str]:
    """Name the settings that the models of spheres and rods do not have."""
    particle, optics = config.particle, config.optics
    return _set(
        ('optics.psf = "measured"', optics.psf == "measured"),
        ('optics.convention = "dong2021"', optics.convention == "dong2021"),
        ('optics.emission = "dong2021"', optics.emission == "dong2021"),
        ('optics.calibrate = "always"', optics.calibrate == "always"),
        ("[calibration]", config.calibration is not None),
        ("particle.wiggle_nm", particle.wiggle_nm > 0),
        ("particle.height_sd_nm", particle.height_sd_nm > 0),
        ('particle.height_nm = "auto"', particle.height_nm == "auto"),
        ('particle.height_nm = "contact"', particle.is_rod and particle.height_nm == "contact"),
    )


def _unseen(optics: Optics, *indices: complex | None) -> Iterator[str]:
    """Say that no part of a particle differs from the sample."""
    if all(n is not None and abs(n / optics.n_sample - 1) < INVISIBLE for n in indices):
        yield (
            f"the refractive index of the particle is that of the sample, optics.n_sample = "
            f"{optics.n_sample:g}: such a particle scatters no light"
        )


def _of_rod(config: Config) -> Iterator[str]:
    particle, optics = config.particle, config.optics
    for key in _known_of_dipoles(config):
        yield (
            f'{key} is for round particles, and particle.model is "rod": leave it out, or set '
            'particle.model = "dipole"'
        )
    yield from _unseen(optics, particle.given_index)
    # The light that the two halves of an upright rod of this length scatter back is out of phase,
    # and it scatters 6 % less than its dipole, (k L)²/10
    longest = optics.wavelength_nm / optics.n_sample / 8
    if particle.nominal_length_nm > longest:
        yield (
            f"a rod of particle.aspect_ratio = {particle.aspect_ratio:g} and the volume of a "
            f"sphere of {particle.nominal_diameter_nm:.4g} nm is {particle.nominal_length_nm:.4g} "
            f"nm long, and rods are dipoles, which is true up to {longest:.3g} nm, an eighth of "
            "the wavelength in the sample: give a smaller mass, or a smaller aspect ratio"
        )


def refuse_rod(config: Config, what: str) -> None:
    """Refuse what does not know the direction of a rod as a parameter."""
    if config.particle.is_rod:
        raise ConfigError(
            f'particle.model = "rod": {what}; there are pictures, bounds and fits of '
            "rods (psf, crb, fit_rods, iscat simulate, iscat bounds)"
        )


def refuse_sphere(config: Config, what: str) -> None:
    """Refuse what does not know the diameter of a sphere as a parameter."""
    if config.particle.is_sphere:
        raise ConfigError(
            f'particle.model = "{config.particle.model}": {what}; iscat benchmark studies spheres '
            "without --estimator, and iscat simulate makes movies of them"
        )


def _of_sphere(config: Config) -> Iterator[str]:
    particle, fit = config.particle, config.fit
    model = f'"{particle.model}"'
    if not (fit.kind.fits_sizes or fit.follows_tracks or not fit.masses_free):
        yield (
            f'fit.mode = "{fit.mode}" is for dipoles, whose image has one shape, and '
            f'particle.model is {model}: use fit.mode = "size", "track" for spheres that move, or '
            '"localize" for a known diameter'
        )
    if fit.follows_tracks and not config.track.heights_free:
        yield (
            f'track.free = "{config.track.free}" holds the height, and particle.model is {model}: '
            'the diameter of a sphere needs track.free = "joint"'
        )
    if fit.follows_tracks and config.background.way == "tracks":
        yield (
            f"particle.model = {model} needs a background that is known before its tracks are: "
            "give frames without particles, as in background.frames = [0, 200]; one that is learnt "
            "with the tracks is for dipoles"
        )
    for key in _known_of_dipoles(config):
        yield (
            f"{key} is for dipoles, and particle.model is {model}: leave it out, or set "
            'particle.model = "dipole"'
        )
    diameter, diameters = particle.nominal_diameter_nm, list(fit.diameter_range_nm)
    if max(diameter, diameters[1]) > fit.roi_nm:
        what = f"fit.diameter_range_nm = {diameters}"
        if diameter > fit.roi_nm:
            what = f"particle.diameter_nm = {diameter:.4g}"
        yield (
            f"{what} is larger than the square that is fitted, fit.roi_nm = {fit.roi_nm:g}: give "
            "the diameter in nanometres, or a larger square"
        )
    if particle.shell_nm is not None and diameters[0] < 2 * particle.shell_nm:
        yield (
            f"fit.diameter_range_nm = {diameters} begins below twice particle.shell_nm = "
            f"{particle.shell_nm:g}, where the shell has no core"
        )
    shell = [particle.shell_index] if particle.model == "shell" else []
    yield from _unseen(config.optics, particle.given_index, *shell)
    heights = [("particle.height_nm", particle.nominal_height_nm, diameter)]
    for number, event in enumerate(config.simulation.events):
        if event.z_nm is not None:
            mass = event.mass_kda or particle.nominal_mass_kda
            own = sphere_diameter_nm(mass, particle.density)
            heights.append((f"simulation.events[{number}].z_nm", event.z_nm, own))
    for key, height, size in heights:
        if height < size / 2 * (1 - 1e-9):
            yield (
                f"{key} = {height:g} is less than the radius of a sphere of {size:.4g} nm, which "
                'would reach into the coverslip: give more, or set particle.height_nm = "contact"'
            )
