"""Sections of the analysis: background, search, fit, tracks, posterior, resources, mass scale."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt

from iscat_analysis.config.instrument import MEASURABLE, Optics, OpticsCovariance
from iscat_analysis.config.kinds import METHODS, MODES, ModeKind, Way
from iscat_analysis.config.values import (
    ALL,
    LARGEST_NM,
    FillFactor,
    Finite,
    FrameRange,
    FramesOrAll,
    Height,
    Method,
    Mode,
    NonNegative,
    Positive,
    Samples,
    Section,
    SphereKind,
    length,
)

# range of diameters of the spheres that mode size may search
FittedDiameter = Annotated[Positive, length(2.0, 2000.0)]


class BackgroundConfig(Section):
    """The image without particles."""

    method: Method | None = None
    """ "fixed": the mean of frames | "median": their median | "sliding": landing movies | "tracks":
    moving particles, together with their tracks | "known": level_e"""
    frames: FramesOrAll | None = None
    """frames before binding [start, stop); absent in landing movies | "all": in mode track, the
    median of all analysed frames with their particles, or with method fixed their mean"""
    window_frames: Annotated[int, Field(ge=4)] | None = None
    """landing movies: frames before and after each step; absent: from the noise"""
    level_e: Positive | None = None
    """known level per pixel and frame, for method known"""
    power_normalization: bool = True
    """divide out the laser power, estimated without the particles, and the flicker of rows or
    columns if they flicker"""
    drift_correction: Literal["auto"] | bool = "auto"
    """landing movies: divide out the motion of the fixed pattern; "auto": if it moves"""

    @property
    def follows_pattern(self) -> bool:
        """Whether the motion of the fixed pattern is divided out; for "auto", a movie decides."""
        return self.drift_correction is True

    @property
    def way(self) -> Way:
        """Which frames are compared with which, see `MethodKind`."""
        return "tracks" if self.frames == ALL else METHODS[str(self.method)].way

    @property
    def slides(self) -> bool:
        """Whether frames just after each frame are compared with those just before it."""
        return self.way == "sliding"

    @property
    def learnt_with_tracks(self) -> bool:
        """Whether the background is fitted together with the tracks over it."""
        return self.method == "tracks"

    @property
    def is_known(self) -> bool:
        """Whether its level is given, and no frame is needed for it."""
        return self.method == "known"

    @property
    def is_counted(self) -> bool:
        """Whether it is a sum of counts, as the conditional likelihood assumes."""
        return METHODS[str(self.method)].is_counted

    @property
    def recorded(self) -> tuple[int, int] | None:
        """Frames that were recorded before the particles; None if there are none."""
        return None if isinstance(self.frames, str) else self.frames

    def _refusals(self) -> Iterator[str]:
        if self.frames == ALL and self.method not in (None, "median", "fixed"):
            yield (
                'frames = "all" is for method = "median" or "fixed", the median or the mean of all '
                f'frames, and method is "{self.method}": set one of these, or leave frames out'
            )
        if self.is_known and self.level_e is None:
            yield 'method = "known" needs level_e, the known background level'
        if self.frames is not None and self.method and not METHODS[self.method].takes_frames:
            does = {
                "sliding": "compares every frame with its neighbours",
                "tracks": "learns the background from the frames in which the particles are",
            }[self.method]
            yield f'method = "{self.method}" {does}: leave frames out, or set method = "fixed"'


class Detection(Section):
    """The search for particles."""

    false_alarms_per_movie: Positive = 0.1
    """expected number of detections in a movie of pure noise"""
    polarity: Literal["both", "dark", "bright"] = "both"
    """ "both" | "dark" | "bright" """
    min_separation_nm: Positive = 500.0
    """closer particles are flagged too_close"""

    @property
    def sign(self) -> int:
        """Sign of the contrast that is reported; 0 if both are."""
        return {"both": 0, "bright": 1, "dark": -1}[self.polarity]


class Fit(Section):
    """The maximum-likelihood fit."""

    mode: Mode = "mass"
    """ "mass" | "localize" | "joint" | "size" (spheres, see particle.model) | "track" """
    frames: FrameRange | None = None
    """[start, stop); absent: all after the background"""
    excluded_frames: tuple[FrameRange, ...] = ()
    """[[start, stop), ...] left out of a landing movie, as if it broke there"""
    roi_nm: Annotated[Positive, length(50.0, LARGEST_NM)] = 2700.0
    """side of the square that is fitted"""
    likelihood: Literal["auto", "poisson", "conditional"] = "auto"
    """ "auto" | "poisson" | "conditional" """
    sigma: Literal["curvature", "measured"] = "curvature"
    """ "curvature" (of the likelihood) | "measured": scaled by the measured spread"""
    pairs: bool = False
    """fit two equal halves to every particle, and give extended ones their mass"""
    index: bool = False
    """mode size: fit the refractive index too, where the picture tells it"""
    z_range_nm: tuple[Height, Height] = (0.0, 1000.0)
    """bounds of z if it is free"""
    diameter_range_nm: tuple[FittedDiameter, FittedDiameter] = (10.0, 400.0)
    """bounds of the diameter in mode size, and of spheres"""
    # Materials of spheres that are tried, at most
    spheres: Annotated[tuple[SphereKind, ...], Field(max_length=32)] = (
        "vesicle",
        "gold",
        "silica",
        "polystyrene",
        "sphere",
    )
    """mode mass: what may stand on the coverslip where no dipole describes a particle: "vesicle" (5
    nm of lipids around water), "gold", "silica", "polystyrene", "sphere" (of an index that is
    fitted), or an index; []: nothing is tried"""

    def _refusals(self) -> Iterator[str]:
        for name in ("z_range_nm", "diameter_range_nm"):
            low, high = getattr(self, name)
            if not low < high:
                yield f"{name} = {[low, high]} is empty"

    @property
    def kind(self) -> ModeKind:
        """What the mode means."""
        return MODES[self.mode]

    @property
    def free(self) -> tuple[str, ...]:
        """Parameters that are fitted, of `PARAMETERS`."""
        return self.kind.free

    @property
    def follows_tracks(self) -> bool:
        """Whether particles move, and are fitted frame by frame."""
        return self.kind.follows_tracks

    @property
    def heights_free(self) -> bool:
        """Whether every particle has a height of its own, which is fitted."""
        return self.kind.heights_free

    @property
    def masses_free(self) -> bool:
        """Whether masses are fitted."""
        return self.kind.masses_free

    def roi_px(self, pixel_nm: float) -> int:
        """Side of the square that is fitted, in pixels of a given side [nm]."""
        return max(5, round(self.roi_nm / pixel_nm))


def _no_pascal_seconds(viscosity: float) -> float:
    if viscosity < 0.1:  # half the viscosity of ether, the thinnest liquid near room temperature
        raise ValueError(
            f"{viscosity:g} mPa·s is less than any liquid has; if {viscosity:g} is in Pa·s, write "
            f"{1e3 * viscosity:g}"
        )
    return viscosity


def _no_kelvins(temperature: float) -> float:
    # temperatures of liquids in a microscope; the upper end is below their values in kelvin
    low, high = -100.0, 250.0
    if not low <= temperature <= high:
        kelvin = f"; if that is in kelvin, write {temperature - 273.15:g}"
        raise ValueError(
            f"{temperature:g} °C is not between {low:g} and {high:g} °C"
            f"{kelvin if temperature > high else ''}"
        )
    return temperature


class TrackConfig(Section):
    """Mode track: particles that move."""

    free: Literal["mass", "joint"] = "joint"
    """fitted per frame: "mass" (x, y, mass: a membrane) | "joint" (x, y, z, mass)"""
    max_step_nm: Annotated[Positive, length(1.0, LARGEST_NM)] = 600.0
    """largest distance of a particle from one frame to the next"""
    memory_frames: Annotated[int, Field(ge=0, le=1000)] = 3
    """frames in which a particle may be missed without ending its track"""
    min_frames: PositiveInt = 10
    """shorter tracks are left out"""
    block_frames: Literal["auto"] | Annotated[int, Field(ge=20)] = "auto"
    """longest block of frames with one background; tracks continue from block to block | "auto": as
    long as memory and drift of the stage allow"""
    viscosity_mpa_s: Annotated[Positive, AfterValidator(_no_pascal_seconds)] = 0.89
    """of the medium, for hydrodynamic diameters; water at 25 °C: 0.89"""
    temperature_c: Annotated[Finite, AfterValidator(_no_kelvins)] = 25.0
    """of the medium, for hydrodynamic diameters"""

    @property
    def heights_free(self) -> bool:
        """Whether the height is fitted in every frame; else particles move in a plane."""
        return MODES[self.free].heights_free


class PosteriorConfig(Section):
    """Sampling of the posterior with emcee."""

    enabled: Literal["auto"] | bool = "auto"
    """true | false | "auto": if there are few events, not in landing movies"""
    walkers: Annotated[int, Field(ge=10, le=10_000, multiple_of=2)] = 32
    """even number"""
    steps: Annotated[int, Field(ge=100, le=1_000_000)] = 2000
    """per walker, burn-in included"""
    prior_mass_kda: tuple[Positive, Positive] | None = None
    """[mean, standard deviation] of a normal prior, for example of a species"""
    prior_z_nm: tuple[NonNegative, Positive] | None = None
    """[mean, standard deviation] of a normal prior, for example of a membrane"""

    @property
    def priors(self) -> dict[str, tuple[float, float]]:
        """Normal priors by parameter, mean and standard deviation [nm, kDa]."""
        both = {"z_nm": self.prior_z_nm, "mass_kda": self.prior_mass_kda}
        return {name: prior for name, prior in both.items() if prior is not None}


class Compute(Section):
    """Resources, and the seed of random numbers in the analysis."""

    workers: Annotated[int, Field(ge=1, le=1024)] = 2
    """threads"""
    memory_limit_mb: Annotated[int, Field(ge=64)] = 1000
    """for the pixel data held at once"""
    seed: NonNegativeInt = 1
    """of random numbers: posteriors, injected particles, resampled species"""


CONTRAST_PER_KDA = (1e-7, 0.01)
"""Range of contrast per kDa: a protein has some 1e-5; at the upper limit, the contrast of 100 kDa
would be 1."""


class StandardsCamera(Section):
    """The detector with which the standards of a calibration were recorded."""

    pixel_size_nm: Positive | None = None
    """in the sample plane"""
    samples_per_pixel: Samples = 1
    """along each axis, with which the standards were analysed"""
    fill_factor: FillFactor = 1.0
    """share of a pixel's area that detects light"""
    gain_e_per_adu: Positive | None = None
    """photoelectrons per count, where it is one number"""
    offset_adu: Finite | None = None
    """counts in the dark, where they are one number"""


class Calibration(Section):
    """Contrast against mass; if present, it replaces the absolute scale of the model.

    Signed peak contrast = gradient·mass + sign(mass)·offset, with the optics of the standards; for
    other optics the model converts it.
    """

    gradient_per_kda: Finite
    """signed peak contrast per kDa"""
    offset: Finite = 0.0
    """peak contrast at zero mass (odd-symmetric)"""
    gradient_se_per_kda: NonNegative = 0.0
    """standard error of gradient_per_kda; 0: not known"""
    offset_se: NonNegative = 0.0
    """standard error of offset"""
    correlation: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """of the errors of gradient_per_kda and offset"""
    dof: NonNegativeInt | None = None
    """degrees of freedom of the line: standards beyond two"""
    optics: Optics | None = None
    """keys of [optics] with which the standards were analysed"""
    covariance: OpticsCovariance | None = None
    """of these if they were learned, { names, matrix }"""
    height_nm: Height | None = None
    """particle.height_nm with which the standards were analysed"""
    camera: StandardsCamera | None = None
    """with which they were recorded"""
    optics_assumed: bool = False
    """true: the optics are not known; those configured are assumed"""

    def _refusals(self) -> Iterator[str]:
        if self.gradient_per_kda == 0:
            yield "gradient_per_kda = 0 says nothing about mass"
        least, most = CONTRAST_PER_KDA
        if not least <= abs(self.gradient_per_kda) <= most:
            yield (
                f"gradient_per_kda = {self.gradient_per_kda:g} is not between {least:g} and "
                f"{most:g}: give contrast per kDa, as -3.1e-5, not in per cent or ppm, nor per "
                "Da or MDa"
            )


def _measurable(errors: dict[str, float]) -> dict[str, float]:
    for name in errors:
        if name not in MEASURABLE:
            raise ValueError(f"{name} cannot be learned: give some of {', '.join(MEASURABLE)}")
    return errors


class Uncertainty(Section):
    """Standard deviations of inputs that were not measured; 0 turns one off.

    If standards were recorded with the same optics, they have the same errors, which cancel.
    """

    wavelength_nm: NonNegative = 1.0
    """of optics.wavelength_nm"""
    n_sample: NonNegative = 0.002
    """of optics.n_sample"""
    n_glass: NonNegative = 0.002
    """of optics.n_glass"""
    index: NonNegative = 0.01
    """of particle.index, if particles are spheres"""
    height_nm: NonNegative = 2.0
    """of the mean height of particles, if particle.height_nm is fixed"""
    wiggle_nm: NonNegative = 15.0
    """of how far particles wiggle, or have parts that are apart, along each axis beyond
    particle.wiggle_nm, before their images are seen"""
    magnification: Annotated[NonNegative, Field(lt=0.5)] = 0.005
    """of camera.pixel_size_nm, as a share of it"""
    offset_adu: NonNegative = 1.0
    """of camera.offset_adu if it is configured, counts"""
    optics: Annotated[dict[str, Positive], AfterValidator(_measurable)] = Field(
        default_factory=dict
    )
    """of keys of [optics], each aberration by its own name, before particles tell them, as {
    focus_nm = 50.0 }; else focus 150, NA 0.01, phase 20, z11 20, others 10"""
