"""Sections of the analysis: background, detection, fit, tracks, posterior, resources."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from iscat_analysis.config.kinds import METHODS, MODES, ModeKind, Way
from iscat_analysis.config.values import (
    ALL,
    LARGEST_NM,
    Finite,
    FrameRange,
    FramesOrAll,
    Method,
    Mode,
    NonNegative,
    Positive,
    Section,
    SphereKind,
    length,
)

LOWEST_VISCOSITY_MPA_S = 0.1
"""Half the viscosity of ether, the thinnest liquid near room temperature."""

DIAMETERS_NM = (2.0, 2000.0)
"""Range of diameters of the spheres that mode size may search."""

MOST_SPHERES = 32
"""Materials of spheres that are tried, at most."""

TEMPERATURES_C = (-100.0, 250.0)
"""Temperatures of liquids in a microscope; the upper end is below their values in kelvin."""


class BackgroundConfig(Section):
    """The image without particles."""

    method: Method | None = Field(
        None,
        description='"fixed": the mean of frames | "median": their median | "sliding": landing '
        'movies | "tracks": moving particles, together with their tracks | "known": level_e',
    )
    frames: FramesOrAll | None = Field(
        None,
        description='frames before binding [start, stop); absent in landing movies | "all": in '
        "mode track, the median of all analysed frames with their particles, or with method fixed "
        "their mean",
    )
    window_frames: Annotated[int, Field(ge=4)] | None = Field(
        None,
        description="landing movies: frames before and after each step; absent: from the noise",
    )
    level_e: Positive | None = Field(
        None, description="known level per pixel and frame, for method known"
    )
    power_normalization: bool = Field(
        True,
        description="divide out the laser power, estimated without the particles, and the flicker "
        "of rows or columns if they flicker",
    )
    drift_correction: Literal["auto"] | bool = Field(
        "auto",
        description='landing movies: divide out the motion of the fixed pattern; "auto": if it '
        "moves",
    )

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

    @model_validator(mode="after")
    def _consistent(self) -> BackgroundConfig:
        if self.frames == ALL and self.method not in (None, "median", "fixed"):
            raise ValueError(
                'frames = "all" is for method = "median" or "fixed", the median or the mean of all '
                f'frames, and method is "{self.method}": set one of these, or leave frames out'
            )
        if self.is_known and self.level_e is None:
            raise ValueError('method = "known" needs level_e, the known background level')
        if self.frames is not None and self.method and not METHODS[self.method].takes_frames:
            does = {
                "sliding": "compares every frame with its neighbours",
                "tracks": "learns the background from the frames in which the particles are",
            }[self.method]
            raise ValueError(
                f'method = "{self.method}" {does}: leave frames out, or set method = "fixed"'
            )
        return self


class Detection(Section):
    """The search for particles."""

    false_alarms_per_movie: Positive = Field(
        0.1, description="expected number of detections in a movie of pure noise"
    )
    polarity: Literal["both", "dark", "bright"] = Field(
        "both", description='"both" | "dark" | "bright"'
    )
    min_separation_nm: Positive = Field(500.0, description="closer particles are flagged too_close")

    @property
    def sign(self) -> int:
        """Sign of the contrast that is reported; 0 if both are."""
        return {"both": 0, "bright": 1, "dark": -1}[self.polarity]


class Fit(Section):
    """The maximum-likelihood fit."""

    mode: Mode = Field(
        "mass",
        description='"mass" | "localize" | "joint" | "size" (spheres, see particle.model) '
        '| "track"',
    )
    frames: FrameRange | None = Field(
        None, description="[start, stop); absent: all after the background"
    )
    excluded_frames: tuple[FrameRange, ...] = Field(
        (), description="[[start, stop), ...] left out of a landing movie, as if it broke there"
    )
    roi_nm: Annotated[Positive, length(50.0, LARGEST_NM)] = Field(
        2700.0, description="side of the square that is fitted"
    )
    likelihood: Literal["auto", "poisson", "conditional"] = Field(
        "auto", description='"auto" | "poisson" | "conditional"'
    )
    sigma: Literal["curvature", "measured"] = Field(
        "curvature",
        description='"curvature" (of the likelihood) | "measured": scaled by the measured spread',
    )
    pairs: bool = Field(
        False,
        description="fit two equal halves to every particle, and give extended ones their mass",
    )
    index: bool = Field(
        False, description="mode size: fit the refractive index too, where the picture tells it"
    )
    z_range_nm: tuple[
        Annotated[NonNegative, length(0.0, LARGEST_NM)],
        Annotated[NonNegative, length(0.0, LARGEST_NM)],
    ] = Field((0.0, 1000.0), description="bounds of z if it is free")
    diameter_range_nm: tuple[
        Annotated[Positive, length(*DIAMETERS_NM)], Annotated[Positive, length(*DIAMETERS_NM)]
    ] = Field((10.0, 400.0), description="bounds of the diameter in mode size, and of spheres")
    spheres: Annotated[tuple[SphereKind, ...], Field(max_length=MOST_SPHERES)] = Field(
        ("vesicle", "gold", "silica", "polystyrene", "sphere"),
        description="mode mass: what may stand on the coverslip where no dipole describes a "
        'particle: "vesicle" (5 nm of lipids around water), "gold", "silica", "polystyrene", '
        '"sphere" (of an index that is fitted), or an index; []: nothing is tried',
    )

    @model_validator(mode="after")
    def _range(self) -> Fit:
        if not self.z_range_nm[0] < self.z_range_nm[1]:
            raise ValueError(f"z_range_nm = {list(self.z_range_nm)} is empty")
        if not self.diameter_range_nm[0] < self.diameter_range_nm[1]:
            raise ValueError(f"diameter_range_nm = {list(self.diameter_range_nm)} is empty")
        return self

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
    if viscosity < LOWEST_VISCOSITY_MPA_S:
        raise ValueError(
            f"{viscosity:g} mPa·s is less than any liquid has; if {viscosity:g} is in Pa·s, write "
            f"{1e3 * viscosity:g}"
        )
    return viscosity


def _no_kelvins(temperature: float) -> float:
    low, high = TEMPERATURES_C
    if not low <= temperature <= high:
        kelvin = f"; if that is in kelvin, write {temperature - 273.15:g}"
        raise ValueError(
            f"{temperature:g} °C is not between {low:g} and {high:g} °C"
            f"{kelvin if temperature > high else ''}"
        )
    return temperature


class TrackConfig(Section):
    """Mode track: particles that move."""

    free: Literal["mass", "joint"] = Field(
        "joint",
        description='fitted per frame: "mass" (x, y, mass: a membrane) | "joint" (x, y, z, mass)',
    )
    max_step_nm: Annotated[Positive, length(1.0, LARGEST_NM)] = Field(
        600.0, description="largest distance of a particle from one frame to the next"
    )
    memory_frames: Annotated[int, Field(ge=0, le=1000)] = Field(
        3, description="frames in which a particle may be missed without ending its track"
    )
    min_frames: Annotated[int, Field(ge=1)] = Field(10, description="shorter tracks are left out")
    block_frames: Literal["auto"] | Annotated[int, Field(ge=20)] = Field(
        "auto",
        description="longest block of frames with one background; tracks continue from block to "
        'block | "auto": as long as memory and drift of the stage allow',
    )
    viscosity_mpa_s: Annotated[Positive, AfterValidator(_no_pascal_seconds)] = Field(
        0.89, description="of the medium, for hydrodynamic diameters; water at 25 °C: 0.89"
    )
    temperature_c: Annotated[Finite, AfterValidator(_no_kelvins)] = Field(
        25.0, description="of the medium, for hydrodynamic diameters"
    )

    @property
    def heights_free(self) -> bool:
        """Whether the height is fitted in every frame; else particles move in a plane."""
        return MODES[self.free].heights_free


class PosteriorConfig(Section):
    """Sampling of the posterior with emcee."""

    enabled: Literal["auto"] | bool = Field(
        "auto", description='true | false | "auto": if there are few events, not in landing movies'
    )
    walkers: Annotated[int, Field(ge=10, le=10_000, multiple_of=2)] = Field(
        32, description="even number"
    )
    steps: Annotated[int, Field(ge=100, le=1_000_000)] = Field(
        2000, description="per walker, burn-in included"
    )
    prior_mass_kda: tuple[Positive, Positive] | None = Field(
        None, description="[mean, standard deviation] of a normal prior, for example of a species"
    )
    prior_z_nm: tuple[NonNegative, Positive] | None = Field(
        None, description="[mean, standard deviation] of a normal prior, for example of a membrane"
    )

    @property
    def priors(self) -> dict[str, tuple[float, float]]:
        """Normal priors by parameter, mean and standard deviation [nm, kDa]."""
        both = {"z_nm": self.prior_z_nm, "mass_kda": self.prior_mass_kda}
        return {name: prior for name, prior in both.items() if prior is not None}


class Compute(Section):
    """Resources, and the seed of random numbers in the analysis."""

    workers: Annotated[int, Field(ge=1, le=1024)] = Field(2, description="threads")
    memory_limit_mb: Annotated[int, Field(ge=64)] = Field(
        1000, description="for the pixel data held at once"
    )
    seed: Annotated[int, Field(ge=0)] = Field(
        1, description="of random numbers: posteriors, injected particles, resampled species"
    )
