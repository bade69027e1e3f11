"""The whole configuration: its sections, and conditions between them.

Lengths are nm, masses kDa, counts photoelectrons; ranges are half-open ``[start, stop)`` frames;
complex numbers are ``[re, im]``.  The description of each field is what `iscat config` prints
beside it.
"""

from __future__ import annotations

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
    def _explicit_method(self) -> Config:
        known, moving = self.background.frames is not None, self.fit.follows_tracks
        if self.background.method is None:
            method = "sliding" if self.optics.interferes else "fixed"
            method = "tracks" if moving else method
            method = "fixed" if known else method
            method = "median" if self.background.frames == ALL else method
            # The model is frozen for its users; here it is still being made.
            self.__dict__["background"] = self.background.model_copy(update={"method": method})
        elif self.background.slides and not self.optics.interferes:
            raise ValueError(
                'background.method = "sliding" needs an interferometric scheme: dark field needs '
                "background.frames"
            )
        elif self.background.slides and moving:
            raise ValueError(
                'background.method = "sliding" has no tracks: leave it out for fit.mode = "track", '
                "or give background.frames"
            )
        elif self.background.learnt_with_tracks and not moving:
            raise ValueError(
                'background.method = "tracks" is made of what fit.mode = "track" finds, and '
                f'fit.mode is "{self.fit.mode}": use "sliding" for particles that land, or '
                '"fixed" with background.frames'
            )
        return self

    @model_validator(mode="after")
    def _pixels_of_the_standards(self) -> Config:
        line, camera = self.calibration, self.camera
        if line is not None and line.camera is not None and camera.samples_per_pixel == AUTO:
            update = {"samples_per_pixel": line.camera.samples_per_pixel}
            self.__dict__["camera"] = camera.model_copy(update=update)
        return self

    @model_validator(mode="after")
    def _sphere_with_its_size(self) -> Config:
        if self.particle.is_sphere:
            if self.optics.calibrate == "auto":  # optics are learned from dipoles
                update = {"calibrate": "never"}
                self.__dict__["optics"] = self.optics.model_copy(update=update)
            if refusal := sphere_refusal(self):
                raise ValueError(refusal)
        elif self.fit.kind.fits_sizes:
            raise ValueError(
                'fit.mode = "size" fits spheres, and particle.model is '
                f'"{self.particle.model}": set particle.model = "mie" or "shell"'
            )
        elif self.particle.is_rod and (refusal := rod_refusal(self)):
            raise ValueError(refusal)
        return self

    @model_validator(mode="after")
    def _pairs_suit_mode(self) -> Config:
        if self.fit.pairs:
            for key, is_set in (
                (f'fit.mode = "{self.fit.mode}"', self.fit.heights_free),
                ('optics.scheme = "darkfield"', not self.optics.interferes),
                ('optics.psf = "measured"', self.optics.psf == "measured"),
                ("particle.height_sd_nm", self.particle.height_prior_sd_nm > 0),
            ):
                if is_set:
                    raise ValueError(
                        f"fit.pairs = true does not go together with {key}: pairs are fitted in "
                        'fit.mode = "mass", at one height, with the model of interference'
                    )
        return self

    @model_validator(mode="after")
    def _index_suits_mode(self) -> Config:
        if self.fit.index and (refusal := index_refusal(self)):
            raise ValueError(f"fit.index = true does not go together with {refusal}")
        return self

    @model_validator(mode="after")
    def _spheres_are_seen(self) -> Config:
        for kind in self.fit.spheres:
            if isinstance(kind, float) and abs(kind / self.optics.n_sample - 1) < INVISIBLE:
                raise ValueError(
                    f"fit.spheres: {kind:g} is the index of the sample, optics.n_sample = "
                    f"{self.optics.n_sample:g}: such a sphere scatters no light"
                )
        return self

    @model_validator(mode="after")
    def _median_has_frames(self) -> Config:
        background, moving = self.background, self.fit.follows_tracks
        if background.frames == ALL and not (moving and self.optics.interferes):
            raise ValueError(
                'background.frames = "all" is for particles that move over an interferometric '
                f'background: with fit.mode = "{self.fit.mode}" and optics.scheme = '
                f'"{self.optics.scheme}" give the frames before the particles, as in '
                "background.frames = [0, 200]"
            )
        if background.method == "median" and background.frames is None and moving:
            raise ValueError(
                'background.method = "median": of which frames?  Give those before the particles, '
                'as in background.frames = [0, 200], or background.frames = "all"'
            )
        return self

    @model_validator(mode="after")
    def _template_suits_mode(self) -> Config:
        if self.optics.psf == "measured" and self.fit.heights_free:
            raise ValueError(
                f'fit.mode = "{self.fit.mode}" needs the image at every height, and optics.psf = '
                '"measured" has it at one: use fit.mode = "mass", or optics.psf = "model"'
            )
        spread = self.particle.height_prior_sd_nm
        if self.optics.psf == "measured" and spread:
            raise ValueError(
                'optics.psf = "measured" has the image at one height: with it set '
                "particle.height_sd_nm = 0 and particle.height_nm to a number"
            )
        if self.optics.psf == "measured" and self.particle.wiggle_nm:
            raise ValueError(
                'optics.psf = "measured" has the wiggle of the particles it shows: set '
                "particle.wiggle_nm = 0"
            )
        return self

    @model_validator(mode="after")
    def _priors_are_of_free_parameters(self) -> Config:
        for fixed in self.posterior.priors.keys() - set(self.fit.free):
            raise ValueError(
                f"posterior.prior_{fixed} is of a parameter that is fixed: use fit.mode = "
                '"joint", or leave the prior out'
            )
        return self

    @model_validator(mode="after")
    def _lengths_agree(self) -> Config:
        wavelength, roi = self.optics.wavelength_nm, self.fit.roi_nm
        pixel = self.camera.pixel_size_nm
        if pixel is not None and pixel > 4 * wavelength:
            raise ValueError(
                f"camera.pixel_size_nm = {pixel:g} is more than four wavelengths "
                f"(optics.wavelength_nm = {wavelength:g}): no image is left in such pixels"
            )
        smallest = max(wavelength / 4, pixel or 0.0)
        if roi < smallest:
            guess = unit_guess(roi, smallest, LARGEST_NM)
            raise ValueError(
                f"fit.roi_nm = {roi:g} is smaller than {smallest:g} nm, a pixel or a quarter of "
                f"the wavelength: no particle fits into such a square{guess}"
            )
        return self

    @property
    def heights_free(self) -> bool:
        """Whether every particle has a height of its own, which is fitted."""
        return self.track.heights_free if self.fit.follows_tracks else self.fit.heights_free

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


def _known_of_dipoles(config: Config) -> str:
    """Name a setting that the models of spheres and rods do not have; nothing if none is set."""
    particle, optics = config.particle, config.optics
    for key, is_set in (
        ('optics.psf = "measured"', optics.psf == "measured"),
        ('optics.convention = "dong2021"', optics.convention == "dong2021"),
        ('optics.emission = "dong2021"', optics.emission == "dong2021"),
        ('optics.calibrate = "always"', optics.calibrate == "always"),
        ("[calibration]", config.calibration is not None),
        ("particle.wiggle_nm", particle.wiggle_nm > 0),
        ("particle.height_sd_nm", particle.height_sd_nm > 0),
        ('particle.height_nm = "auto"', particle.height_nm == "auto"),
        ('particle.height_nm = "contact"', particle.is_rod and particle.height_nm == "contact"),
    ):
        if is_set:
            return key
    return ""


def _unseen(optics: Optics, *indices: complex | None) -> str:
    """Say that no part of a particle differs from the sample; nothing if one does."""
    if any(n is None or abs(n / optics.n_sample - 1) >= INVISIBLE for n in indices):
        return ""
    return (
        f"the refractive index of the particle is that of the sample, optics.n_sample = "
        f"{optics.n_sample:g}: such a particle scatters no light"
    )


def rod_refusal(config: Config) -> str:
    """Say why a configuration does not go together with a rod; else nothing."""
    particle, optics = config.particle, config.optics
    if key := _known_of_dipoles(config):
        return (
            f'{key} is for round particles, and particle.model is "rod": leave it out, or set '
            'particle.model = "dipole"'
        )
    if unseen := _unseen(optics, particle.given_index):
        return unseen
    # Longest rod over the wavelength in the sample. The light that the two halves of an upright
    # rod scatter back is out of phase by then, and the rod scatters 6 % less than its dipole, (k
    # L)²/10
    longest = optics.wavelength_nm / optics.n_sample / 8
    if particle.nominal_length_nm > longest:
        return (
            f"a rod of particle.aspect_ratio = {particle.aspect_ratio:g} and the volume of a "
            f"sphere of {particle.nominal_diameter_nm:.4g} nm is {particle.nominal_length_nm:.4g} "
            f"nm long, and rods are dipoles, which is true up to {longest:.3g} nm, an eighth of "
            "the wavelength in the sample: give a smaller mass, or a smaller aspect ratio"
        )
    return ""


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


def index_refusal(config: Config) -> str:
    """Say why the index of a sphere cannot be fitted; else nothing."""
    particle = config.particle
    absorbs = particle.permittivity is not None and particle.permittivity[1] != 0
    for key, is_set in (
        (f'fit.mode = "{config.fit.mode}": use "size"', not config.fit.kind.fits_sizes),
        (f'particle.model = "{particle.model}": use "mie"', particle.model != "mie"),
        ("a material that absorbs, which has two numbers", absorbs or particle.kind == "gold"),
    ):
        if is_set:
            return key
    return ""


def sphere_refusal(config: Config) -> str:
    """Say why a configuration does not go together with a sphere; else nothing."""
    particle, optics, fit = config.particle, config.optics, config.fit
    if not (fit.kind.fits_sizes or fit.follows_tracks or not fit.masses_free):
        return (
            f'fit.mode = "{fit.mode}" is for dipoles, whose image has one shape, and '
            f'particle.model is "{particle.model}": use fit.mode = "size", "track" for spheres '
            'that move, or "localize" for a known diameter'
        )
    if fit.follows_tracks and not config.track.heights_free:
        return (
            f'track.free = "{config.track.free}" holds the height, and particle.model is '
            f'"{particle.model}": the diameter of a sphere needs track.free = "joint"'
        )
    background = config.background
    if fit.follows_tracks and background.way == "tracks":
        return (
            f'particle.model = "{particle.model}" needs a background that is known before its '
            "tracks are: give frames without particles, as in background.frames = [0, 200]; one "
            "that is learnt with the tracks is for dipoles"
        )
    if key := _known_of_dipoles(config):
        return (
            f'{key} is for dipoles, and particle.model is "{particle.model}": leave it out, or '
            'set particle.model = "dipole"'
        )
    diameter = particle.nominal_diameter_nm
    if max(diameter, fit.diameter_range_nm[1]) > fit.roi_nm:
        what = (
            f"particle.diameter_nm = {diameter:.4g}"
            if diameter > fit.roi_nm
            else f"fit.diameter_range_nm = {list(fit.diameter_range_nm)}"
        )
        return (
            f"{what} is larger than the square that is fitted, fit.roi_nm = {fit.roi_nm:g}: give "
            "the diameter in nanometres, or a larger square"
        )
    if particle.shell_nm is not None and fit.diameter_range_nm[0] < 2 * particle.shell_nm:
        return (
            f"fit.diameter_range_nm = {list(fit.diameter_range_nm)} begins below twice "
            f"particle.shell_nm = {particle.shell_nm:g}, where the shell has no core"
        )
    shell = [particle.shell_index] if particle.model == "shell" else []
    if unseen := _unseen(optics, particle.given_index, *shell):
        return unseen
    lowest = particle.nominal_height_nm
    if lowest < diameter / 2 * (1 - 1e-9):
        return (
            f"particle.height_nm = {lowest:g} is less than the radius of a sphere of "
            f'{diameter:.4g} nm, which would reach into the coverslip: set height_nm = "contact"'
        )
    for number, event in enumerate(config.simulation.events):
        radius = (
            sphere_diameter_nm(event.mass_kda or particle.nominal_mass_kda, particle.density) / 2
        )
        if event.z_nm is not None and event.z_nm < radius * (1 - 1e-9):
            return (
                f"simulation.events[{number}].z_nm = {event.z_nm:g} is less than the radius of a "
                f"sphere of {2 * radius:.4g} nm, which would reach into the coverslip"
            )
    return ""
