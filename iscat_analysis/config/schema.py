"""The sections and keys of a configuration: what each means and which values it may have.

Lengths are nm, masses kDa, counts photoelectrons; ranges are half-open ``[start, stop)`` frames;
complex numbers are ``[re, im]``.  The description of each field is what `iscat config` prints
beside it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from iscat_analysis.errors import ConfigError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

Mode = Literal["mass", "localize", "joint", "track"]


def _lower(value: Any) -> Any:
    return value.lower() if isinstance(value, str) else value


Scheme = Annotated[Literal["iscat", "cobri", "darkfield"], BeforeValidator(_lower)]
Method = Literal["fixed", "sliding", "tracks", "median", "known"]


def _two(frames: Any) -> Any:
    if isinstance(frames, (list, tuple)) and len(frames) == 2:
        return frames
    raise ValueError(
        "[start, stop) takes two numbers, the first frame and the one after the last, as in "
        "[0, 200]"
    )


def _ordered(frames: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= frames[0] < frames[1]:
        raise ValueError(f"[start, stop) needs 0 <= start < stop, got {list(frames)}")
    return frames


WAVELENGTH_NM = (200.0, 3000.0)
"""Vacuum wavelengths that a light microscope uses [nm]."""

LARGEST_NM = 1e5
"""No height, focus or fitted square is larger [nm]."""

PIXEL_NM = (1.0, 2000.0)
"""Pixel sizes in the sample plane that a microscope can have [nm]; outside, the unit is wrong."""

_UNITS_NM = {"micrometres": 1e3, "millimetres": 1e6, "metres": 1e9, "ångström": 0.1}


def unit_guess(value: float, low_nm: float, high_nm: float) -> str:
    """Say which unit an impossible length was probably written in.

    Parameters
    ----------
    value : float
        As it was given.
    low_nm, high_nm : float
        Smallest and largest length that is possible [nm].

    Returns
    -------
    str
        A clause that names the unit and the length in nanometres; empty where no unit fits.
    """
    for unit, nanometres in _UNITS_NM.items():
        converted = value * nanometres
        if low_nm <= abs(converted) <= high_nm:
            return f"; if {value:g} is in {unit}, write {converted:g}"
    return ""


def plausible_pixel(size_nm: float) -> float:
    """Return a pixel size, unless no microscope has it.

    Parameters
    ----------
    size_nm : float
        In the sample plane [nm].

    Returns
    -------
    float
        The same.

    Raises
    ------
    ValueError
        It lies outside `PIXEL_NM`.
    """
    low, high = PIXEL_NM
    if not low <= size_nm <= high:
        raise ValueError(
            f"a pixel of {size_nm:g} nm is not between {low:g} and {high:g} nm: give its size in "
            f"the sample plane (not on the sensor), in nanometres{unit_guess(size_nm, low, high)}"
        )
    return size_nm


MOST_WAVES = 0.5
"""Largest Zernike term over the wavelength; ten times that of a poor objective."""

ABERRATIONS = tuple(f"z{j}" for j in range(5, 38))
"""Zernike terms on offer, by Noll's index."""

MEASURABLE = (
    "focus_nm",
    "na",
    "reference_phase_deg",
    "mask_na",
    "attenuation",
    "polarization_deg",
    *ABERRATIONS,
)
"""Parameters of the optics that pictures can tell, and that have a derivative."""


def _noll_names(terms: dict[str, float]) -> dict[str, float]:
    for name in terms:
        if name not in ABERRATIONS:
            known = {"z1": "piston", "z2": "tilt", "z3": "tilt", "z4": "defocus"}
            reason = f" ({known[name]} is not an aberration here)" if name in known else ""
            raise ValueError(
                f"{name} is not on offer{reason}: name Zernike terms z5 to z37 by Noll's index; "
                "defocus is optics.focus_nm"
            )
    return terms


def _length(low_nm: float, high_nm: float) -> AfterValidator:
    """Accept lengths whose magnitude lies in a range, and guess the unit of the others."""

    def check(value: float) -> float:
        if low_nm <= abs(value) <= high_nm:
            return value
        guess = unit_guess(value, max(low_nm, 1e-3 * high_nm), high_nm)
        raise ValueError(f"{value:g} nm is not between {low_nm:g} and {high_nm:g} nm{guess}")

    return AfterValidator(check)


FrameRange = Annotated[tuple[int, int], BeforeValidator(_two), AfterValidator(_ordered)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Called(ModelMetaclass):
    """What makes a section from keyword arguments: what is wrong is said in the program's words."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().__call__(*args, **kwargs)
        except ValidationError as error:
            from iscat_analysis.config.complaints import complaint, section_name

            name = section_name(self)
            items = ({**item, "loc": (*name, *item["loc"])} for item in error.errors())
            complaints = dict.fromkeys(complaint(item, {}) for item in items)
            raise ConfigError("; ".join(complaints)) from None


class Section(BaseModel, metaclass=_Called):
    """A section of the file: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class OpticsCovariance(Section):
    """Errors of measured optics, as ``[covariance]`` of ``optics.toml`` has them."""

    names: tuple[str, ...] = Field(description="keys of [optics], each aberration by its own name")
    matrix: tuple[tuple[Finite, ...], ...] = Field(description="covariance, in the order of names")

    @model_validator(mode="after")
    def _symmetric(self) -> OpticsCovariance:
        size = len(self.names)
        unknown = [name for name in self.names if name not in MEASURABLE]
        if unknown:
            raise ValueError(f"names has {unknown[0]}, which is none of {', '.join(MEASURABLE)}")
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise ValueError(f"matrix needs {size} rows of {size} numbers, one for each of names")
        for i, row in enumerate(self.matrix):
            for j in range(i):
                room = 1e-6 * math.sqrt(abs(row[i] * self.matrix[j][j]))
                if abs(row[j] - self.matrix[j][i]) > room:
                    raise ValueError(f"matrix is not symmetric in {self.names[i]}, {self.names[j]}")
            if row[i] < 0:
                raise ValueError(f"matrix gives {self.names[i]} a negative variance")
        return self


class Optics(Section):
    """The microscope (physics.md, section 1)."""

    file: str | None = Field(
        None, description="of `iscat calibrate optics`; its values win over this section's"
    )
    wavelength_nm: Annotated[Positive, _length(*WAVELENGTH_NM)] = Field(
        525.0, description="vacuum wavelength"
    )
    na: Positive = Field(1.42, description="numerical aperture")
    n_immersion: Positive = Field(1.515, description="refractive index of the immersion oil")
    n_glass: Positive = Field(1.515, description="refractive index of the coverslip")
    n_sample: Positive = Field(1.33, description="refractive index of the sample")
    scheme: Scheme = Field("iscat", description='"iscat" | "cobri" | "darkfield"')
    attenuation: NonNegative = Field(
        1.0, description="amplitude of the reference that passes; ignored in dark field"
    )
    polarization: Literal["linear", "circular"] = Field(
        "linear", description='of the illumination: "linear" | "circular"'
    )
    polarization_deg: Finite = Field(
        0.0, description="of linear light, from the image's x axis towards y"
    )
    analyzer: bool = Field(
        False, description="only light polarised as the reference reaches the camera"
    )
    mask_na: NonNegative = Field(
        0.0, description="a disc in the pupil attenuates below this NA; 0: the reference alone"
    )
    reference_phase_deg: Finite = Field(
        0.0, description="delay of the reference against the scattered light"
    )
    aberrations_nm: Annotated[dict[str, Finite], AfterValidator(_noll_names)] = Field(
        default_factory=dict,
        description="Zernike terms, Noll z5 to z37, rms path over the pupil: { z11 = 8.0 }",
    )
    focus_nm: Annotated[Finite, _length(0.0, LARGEST_NM)] = Field(
        -300.0,
        description="focus height z_f; sets the oil thickness for a particle at particle.height_nm",
    )
    convention: Literal["exact", "dong2021"] = Field(
        "exact", description='"exact" | "dong2021" (the paper\'s numbers, errors included)'
    )
    axial: Literal["stage", "refocus"] = Field(
        "stage", description='what a moving particle holds fixed: "stage" | "refocus"'
    )
    emission: Literal["reciprocal", "dong2021"] = Field(
        "reciprocal",
        description='"reciprocal" (energy-conserving) | "dong2021" (the paper\'s own)',
    )
    psf: Literal["model", "measured"] = Field(
        "model", description='"model" | "measured" (the picture in template; mode mass only)'
    )
    template: str | None = Field(
        None, description="of `iscat calibrate optics --measured`, whose optics.toml names it"
    )
    calibrate: Literal["auto", "always", "never"] = Field(
        "auto", description='"auto" | "always" | "never": learn the optics from the movie'
    )

    covariance: OpticsCovariance | None = Field(
        None, description="of the measured keys, { names, matrix }; taken from the file"
    )

    @model_validator(mode="before")
    @classmethod
    def _emission_of_the_convention(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("convention") == "dong2021":
            return {"emission": "dong2021", **values}
        return values

    @model_validator(mode="after")
    def _possible(self) -> Optics:
        if self.mask_na >= self.na:
            raise ValueError(
                f"mask_na = {self.mask_na} must be below na = {self.na}: a mask that covers the "
                "whole pupil is attenuation without mask_na"
            )
        for name, size in self.aberrations_nm.items():
            if abs(size) > MOST_WAVES * self.wavelength_nm:
                raise ValueError(
                    f"aberrations_nm.{name} = {size:g} exceeds {MOST_WAVES:g} wavelengths rms: "
                    "give nanometres of path, rms over the pupil"
                )
        if self.na >= self.n_immersion:
            raise ValueError(
                f"na = {self.na} must be below n_immersion = {self.n_immersion}: "
                "lower na, or give the index of the oil that was used"
            )
        if self.na >= self.n_glass:
            raise ValueError(
                f"na = {self.na} must be below n_glass = {self.n_glass}: such light cannot "
                "cross the coverslip"
            )
        if self.psf == "measured" and self.template is None:
            raise ValueError(
                'psf = "measured" needs a template: run `iscat calibrate optics MOVIE --measured` '
                "and give its optics.toml as optics.file"
            )
        if self.psf == "measured" and self.scheme == "darkfield":
            raise ValueError(
                'psf = "measured" needs an interferometric scheme: in dark field the picture is a '
                "square of what the template holds"
            )
        if self.scheme == "iscat" and self.n_glass == self.n_sample:
            raise ValueError(
                "n_glass equals n_sample: nothing is reflected, so there is no iSCAT reference"
            )
        if self.scheme != "darkfield" and self.attenuation == 0:
            raise ValueError('attenuation = 0 leaves no reference: use scheme = "darkfield"')
        return self


class CameraConfig(Section):
    """The detector, in the sample plane."""

    pixel_size_nm: Annotated[Positive, AfterValidator(plausible_pixel)] | None = Field(
        None, description="in the sample plane; taken from the TIFF metadata where absent"
    )
    gain_e_per_adu: Positive | str = Field(
        1.0, description="photoelectrons per count: a number or the path of a TIFF map"
    )
    offset_adu: Finite | str = Field(0.0, description="counts in the dark: a number or a map")
    read_noise_e: NonNegative | str = Field(
        0.0, description="read noise, standard deviation per frame: a number or a map"
    )
    well_depth_e: Positive | None = Field(
        None, description="full well: counts at or above it are flagged as saturated"
    )
    exposure_ms: Positive | None = Field(None, description="taken from the metadata where absent")
    frame_rate_hz: Positive | None = Field(None, description="taken from the metadata where absent")
    samples_per_pixel: Annotated[int, Field(ge=1, le=9)] = Field(
        1, description="per axis, to integrate over pixels; 1 = point sampling at pixel centres"
    )


class Particle(Section):
    """What scatters."""

    kind: Literal["gold", "silica", "polystyrene", "protein", "custom"] = Field(
        "protein", description='"gold" | "silica" | "polystyrene" | "protein" | "custom"'
    )
    permittivity: tuple[float, float] | None = Field(
        None, description="relative, [re, im]; overrides the kind's own"
    )
    index: Positive | None = Field(None, description="refractive index, in place of permittivity")
    density_kg_m3: Positive | None = Field(None, description="overrides the kind's own")
    mass_kda: Positive | None = Field(
        None, description="start value, and the truth of a simulation"
    )
    diameter_nm: Annotated[Positive, _length(0.1, 1e4)] | None = Field(
        None, description="in place of mass_kda"
    )
    height_nm: Annotated[NonNegative, _length(0.0, LARGEST_NM)] = Field(
        5.0, description="z where it is fixed; start value elsewhere"
    )
    photons_per_frame: Positive | None = Field(
        None,
        description="dark field: scattered photons collected per frame from a particle of this "
        "mass, which is the scale of masses there",
    )

    @model_validator(mode="after")
    def _one_of(self) -> Particle:
        if self.permittivity is not None and self.index is not None:
            raise ValueError("give permittivity or index, not both")
        if self.mass_kda is not None and self.diameter_nm is not None:
            raise ValueError("give mass_kda or diameter_nm, not both")
        if self.kind == "custom":
            if self.permittivity is None and self.index is None:
                raise ValueError('kind = "custom" needs permittivity or index')
            if self.density_kg_m3 is None:
                raise ValueError('kind = "custom" needs density_kg_m3')
        return self


class BackgroundConfig(Section):
    """The image without particles."""

    method: Method | None = Field(
        None,
        description='"fixed": the mean of frames | "median": their median, in mode track without '
        'frames that of all | "sliding": landing movies | "tracks": moving particles, together '
        'with their tracks | "known": level_e',
    )
    frames: FrameRange | None = Field(
        None, description="pre-binding frames [start, stop); absent in landing movies"
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
        description="divide out the laser power, estimated with the particles excluded, and its "
        "flicker along rows or columns where they show one",
    )
    drift_correction: bool = Field(
        False, description="landing movies: divide out the motion of the fixed pattern"
    )

    @model_validator(mode="after")
    def _consistent(self) -> BackgroundConfig:
        if self.method == "known" and self.level_e is None:
            raise ValueError('method = "known" needs level_e, the known background level')
        if self.method == "sliding" and self.frames is not None:
            raise ValueError(
                'method = "sliding" takes every frame against its neighbours: leave frames out, '
                'or set method = "fixed"'
            )
        if self.method == "tracks" and self.frames is not None:
            raise ValueError(
                'method = "tracks" learns the background from the frames in which the particles '
                'are: leave frames out, or set method = "fixed"'
            )
        return self


class Detection(Section):
    """What counts as a particle."""

    false_alarms_per_movie: Positive = Field(
        0.1, description="expected number of detections in a movie of pure noise"
    )
    polarity: Literal["both", "dark", "bright"] = Field(
        "both", description='"both" | "dark" | "bright"'
    )
    min_separation_nm: Positive = Field(500.0, description="closer particles are flagged too_close")

    @property
    def sign(self) -> int:
        """Sign of the contrast that is reported; 0 where both are."""
        return {"both": 0, "bright": 1, "dark": -1}[self.polarity]


class Fit(Section):
    """The maximum-likelihood fit."""

    mode: Mode = Field("mass", description='"mass" | "localize" | "joint" | "track"')
    frames: FrameRange | None = Field(
        None, description="[start, stop); absent: all after the background"
    )
    roi_nm: Annotated[Positive, _length(50.0, LARGEST_NM)] = Field(
        2700.0, description="side of the square that is fitted"
    )
    likelihood: Literal["auto", "poisson", "conditional"] = Field(
        "auto", description='"auto" | "poisson" | "conditional"'
    )
    sigma: Literal["curvature", "measured"] = Field(
        "curvature",
        description='"curvature" (of the likelihood) | "measured": scaled by the measured spread',
    )
    z_range_nm: tuple[
        Annotated[NonNegative, _length(0.0, LARGEST_NM)],
        Annotated[NonNegative, _length(0.0, LARGEST_NM)],
    ] = Field((0.0, 1000.0), description="bounds of z where it is free")

    @model_validator(mode="after")
    def _range(self) -> Fit:
        if not self.z_range_nm[0] < self.z_range_nm[1]:
            raise ValueError(f"z_range_nm = {list(self.z_range_nm)} is empty")
        return self

    def roi_px(self, pixel_nm: float) -> int:
        """Side of the square that is fitted, in pixels of a given side [nm]."""
        return max(5, round(self.roi_nm / pixel_nm))


class TrackConfig(Section):
    """Mode track: particles that move."""

    free: Literal["mass", "joint"] = Field(
        "joint",
        description='fitted per frame: "mass" (x, y, mass: a membrane) | "joint" (x, y, z, mass)',
    )
    max_step_nm: Annotated[Positive, _length(1.0, LARGEST_NM)] = Field(
        600.0, description="farthest that a particle goes from one frame to the next"
    )
    memory_frames: Annotated[int, Field(ge=0, le=1000)] = Field(
        3, description="frames in which a particle may be missed without losing its track"
    )
    min_frames: Annotated[int, Field(ge=1)] = Field(10, description="shorter tracks are left out")
    block_frames: Literal["auto"] | Annotated[int, Field(ge=20)] = Field(
        "auto",
        description="frames with a background of their own, at most, tracks going on from block to "
        'block | "auto": as many as fit into the memory and drift of the stage allows',
    )
    viscosity_mpa_s: Positive = Field(
        0.89, description="of the medium, for hydrodynamic diameters; water at 25 °C: 0.89"
    )
    temperature_c: Annotated[float, Field(gt=-273.15, lt=1000.0)] = Field(
        25.0, description="of the medium, for hydrodynamic diameters"
    )


class PosteriorConfig(Section):
    """Sampling of the posterior with emcee."""

    enabled: Literal["auto"] | bool = Field(
        "auto", description='true | false | "auto": where events are few, not in landing movies'
    )
    walkers: Annotated[int, Field(ge=10, le=10_000, multiple_of=2)] = Field(
        32, description="even number"
    )
    steps: Annotated[int, Field(ge=100, le=1_000_000)] = Field(
        2000, description="per walker, burn-in included"
    )
    prior_mass_kda: tuple[Positive, Positive] | None = Field(
        None, description="[mean, standard deviation] of a normal prior, as of a species"
    )
    prior_z_nm: tuple[NonNegative, Positive] | None = Field(
        None, description="[mean, standard deviation] of a normal prior, as above a membrane"
    )

    @property
    def priors(self) -> dict[str, tuple[float, float]]:
        """Normal priors by parameter, mean and standard deviation [nm, kDa]."""
        both = {"z_nm": self.prior_z_nm, "mass_kda": self.prior_mass_kda}
        return {name: prior for name, prior in both.items() if prior is not None}


class Calibration(Section):
    """Contrast against mass; present, it replaces the model's absolute scale.

    Signed peak contrast = gradient·mass + sign(mass)·offset.
    """

    gradient_per_kda: Finite = Field(description="signed peak contrast per kDa")
    offset: Finite = Field(0.0, description="peak contrast at zero mass (odd-symmetric)")
    gradient_se_per_kda: NonNegative = Field(
        0.0, description="standard error of gradient_per_kda; 0: not known"
    )
    offset_se: NonNegative = Field(0.0, description="standard error of offset")
    correlation: Annotated[float, Field(ge=-1, le=1)] = Field(
        0.0, description="of the errors of gradient_per_kda and offset"
    )

    @model_validator(mode="after")
    def _usable(self) -> Calibration:
        if self.gradient_per_kda == 0:
            raise ValueError("gradient_per_kda = 0 says nothing about mass")
        return self


class SimulatedEvent(Section):
    """One particle that appears, and may leave."""

    frame: Annotated[int, Field(ge=0)] = Field(description="first frame with the particle")
    leave: Annotated[int, Field(ge=1)] | None = Field(
        None, description="first frame without it again"
    )
    x_px: Finite = Field(
        description="column; integer = pixel centre; with drift, that of its first frame"
    )
    y_px: Finite = Field(description="row, downwards")
    z_nm: NonNegative | None = Field(None, description="default particle.height_nm")
    mass_kda: Positive | None = Field(None, description="default particle.mass_kda")

    @model_validator(mode="after")
    def _leaves_later(self) -> SimulatedEvent:
        if self.leave is not None and self.leave <= self.frame:
            raise ValueError(f"leave = {self.leave} must come after frame = {self.frame}")
        return self


class SimulatedMover(Section):
    """Particles of one kind that diffuse."""

    count: Annotated[int, Field(ge=1, le=100_000)] = Field(
        1, description="in the field in their first frame; as many enter as leave"
    )
    d_um2_s: NonNegative = Field(description="diffusion coefficient along each axis, µm²/s")
    mass_kda: Positive | None = Field(None, description="default particle.mass_kda")
    diameter_nm: Annotated[Positive, _length(0.1, 1e4)] | None = Field(
        None, description="in place of mass_kda, of the material of [particle]"
    )
    space: Literal["membrane", "volume"] = Field(
        "membrane", description='"membrane": z is fixed | "volume": above z = 0, which reflects'
    )
    z_nm: Annotated[NonNegative, _length(0.0, LARGEST_NM)] | None = Field(
        None, description="at first; default particle.height_nm, below a ceiling anywhere"
    )
    ceiling_nm: Annotated[Positive, _length(0.0, LARGEST_NM)] | None = Field(
        None, description="volume: a height that reflects too"
    )
    drift_um_s: tuple[Finite, Finite] = Field(
        (0.0, 0.0), description="velocity along x and y, µm/s"
    )
    confinement_nm: Annotated[Positive, _length(1.0, LARGEST_NM)] | None = Field(
        None, description="side of a square whose walls reflect, one for each particle"
    )
    frame: Annotated[int, Field(ge=0)] = Field(0, description="first frame with them")
    leave: Annotated[int, Field(ge=1)] | None = Field(
        None, description="first frame without them again"
    )
    x_px: Finite | None = Field(
        None, description="column at first, of a single particle; absent: anywhere"
    )
    y_px: Finite | None = Field(None, description="row at first, downwards")

    @model_validator(mode="after")
    def _possible(self) -> SimulatedMover:
        if self.mass_kda is not None and self.diameter_nm is not None:
            raise ValueError("give mass_kda or diameter_nm, not both")
        if self.leave is not None and self.leave <= self.frame:
            raise ValueError(f"leave = {self.leave} must come after frame = {self.frame}")
        if (self.x_px is None) != (self.y_px is None):
            raise ValueError("give x_px and y_px, or neither")
        if self.x_px is not None and self.count != 1:
            raise ValueError(
                f"count = {self.count} particles cannot all begin at x_px, y_px: leave the place "
                "out, or give each a block of its own"
            )
        if self.ceiling_nm is not None:
            if self.space == "membrane":
                raise ValueError('ceiling_nm needs space = "volume"')
            if self.z_nm is not None and self.z_nm > self.ceiling_nm:
                raise ValueError(
                    f"z_nm = {self.z_nm:g} lies above ceiling_nm = {self.ceiling_nm:g}"
                )
        return self


SIMULATED: dict[str, type[Section]] = {"events": SimulatedEvent, "movers": SimulatedMover}
"""Tables of [simulation] that may be there many times, each describing particles."""


class Simulation(Section):
    """A synthetic movie with known truth."""

    shape: tuple[Annotated[int, Field(ge=8, le=16_384)], Annotated[int, Field(ge=8, le=16_384)]] = (
        Field((128, 128), description="rows, columns")
    )
    frames: Annotated[int, Field(ge=2)] = Field(400, description="frames in the movie")
    photons_per_pixel: Positive = Field(
        1e4,
        description="background photoelectrons per pixel and frame; dark field: scattered photons "
        "collected per frame from a particle of particle.mass_kda",
    )
    background: str = Field("flat", description='"flat" | "speckle" | path of a TIFF')
    speckle_contrast: NonNegative = Field(0.1, description="standard deviation over mean")
    power_noise: NonNegative = Field(0.0, description="relative laser-power noise, frame to frame")
    drift_px_per_frame: tuple[Finite, Finite] = Field(
        (0.0, 0.0), description="of background and particles together, along x and y"
    )
    seed: Annotated[int, Field(ge=0)] = Field(1, description="same seed, same bytes")
    events: tuple[SimulatedEvent, ...] = Field((), description="each particle, placed by hand")
    movers: tuple[SimulatedMover, ...] = Field((), description="particles that diffuse, by kind")
    count: Annotated[int, Field(ge=0, le=1_000_000)] | None = Field(
        None, description="landings at random places and times, in place of events; 0: a blank"
    )
    leavings: Annotated[int, Field(ge=0)] = Field(
        0, description="how many of the count leave before the movie ends"
    )
    species: tuple[Positive, ...] | None = Field(
        None, description="masses [kDa] of the random particles, in equal shares"
    )

    @model_validator(mode="after")
    def _either(self) -> Simulation:
        if self.events and self.count is not None:
            raise ValueError("give events or count, not both")
        if self.leavings and (self.count is None or self.leavings > self.count):
            raise ValueError(f"leavings = {self.leavings} needs a count at least as large")
        for number, event in enumerate(self.events):
            inside = (
                -0.5 <= event.y_px < self.shape[0] - 0.5
                and -0.5 <= event.x_px < self.shape[1] - 0.5
            )
            if not inside:
                raise ValueError(
                    f"events[{number}] at x_px = {event.x_px}, y_px = {event.y_px} lies outside "
                    f"the field of {self.shape[1]} x {self.shape[0]} pixels"
                )
            if event.frame >= self.frames:
                raise ValueError(
                    f"events[{number}] appears at frame {event.frame}, after the "
                    f"{self.frames} frames of the movie"
                )
        for number, mover in enumerate(self.movers):
            if mover.frame >= self.frames:
                raise ValueError(
                    f"movers[{number}] appear at frame {mover.frame}, after the {self.frames} "
                    "frames of the movie"
                )
            x, y = mover.x_px or 0.0, mover.y_px or 0.0
            if not (-0.5 <= y < self.shape[0] - 0.5 and -0.5 <= x < self.shape[1] - 0.5):
                raise ValueError(
                    f"movers[{number}] at x_px = {x}, y_px = {y} begins outside the field of "
                    f"{self.shape[1]} x {self.shape[0]} pixels"
                )
        return self


class BoundsConfig(Section):
    """`iscat bounds`: one particle on a square field of pixel centres (i − (n−1)/2)·pixel size."""

    pixels: Annotated[int, Field(ge=2, le=4096)] = Field(151, description="side of the field")
    x_nm: Finite = Field(0.0, description="particle, from the centre of the field")
    y_nm: Finite = Field(0.0, description="particle, from the centre of the field")
    z_nm: NonNegative | None = Field(None, description="default particle.height_nm")
    photons_per_pixel: Positive = Field(
        1e4, description="background per frame; dark field: as in [simulation]"
    )
    n_before: Annotated[int, Field(ge=0)] = Field(200, description="0: the background is known")
    n_after: Annotated[int, Field(ge=1)] = Field(200, description="frames with the particle")
    false_alarm_probability: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        1e-3, description="of the smallest mass that is detected: that noise is taken for it"
    )
    miss_probability: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.05, description="of the smallest mass that is detected: that it is not found"
    )


class Compute(Section):
    """Resources, and the seed of what the analysis draws."""

    workers: Annotated[int, Field(ge=1, le=1024)] = Field(2, description="threads")
    memory_limit_mb: Annotated[int, Field(ge=64)] = Field(
        1000, description="for the pixel data held at once"
    )
    seed: Annotated[int, Field(ge=0)] = Field(
        1,
        description="of what the analysis draws: posteriors, injected particles, resampled species",
    )


class Config(Section):
    """A whole configuration; `iscat_analysis.config.configure` makes one.

    The method of the background is explicit in it: where `background.method` is not given, it is
    ``"fixed"`` if background frames are given and in dark field, else ``"tracks"`` in mode track
    and ``"sliding"`` in the others.
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
    simulation: Simulation = Field(default_factory=Simulation)
    bounds: BoundsConfig = Field(default_factory=BoundsConfig)
    compute: Compute = Field(default_factory=Compute)

    @model_validator(mode="after")
    def _explicit_method(self) -> Config:
        known = self.background.frames is not None or self.optics.scheme == "darkfield"
        if self.background.method is None:
            method = "tracks" if self.fit.mode == "track" else "sliding"
            method = "fixed" if known else method
            # The model is frozen for its users; here it is still being made.
            self.__dict__["background"] = self.background.model_copy(update={"method": method})
        elif self.background.method == "sliding" and self.optics.scheme == "darkfield":
            raise ValueError(
                'background.method = "sliding" needs an interferometric scheme: dark field needs '
                "background.frames"
            )
        elif self.background.method == "sliding" and self.fit.mode == "track":
            raise ValueError(
                'background.method = "sliding" has no tracks: leave it out for fit.mode = "track", '
                "or give background.frames"
            )
        elif self.background.method == "tracks" and self.fit.mode != "track":
            raise ValueError(
                'background.method = "tracks" is made of what fit.mode = "track" finds, and '
                f'fit.mode is "{self.fit.mode}": use "sliding" for particles that land, or '
                '"fixed" with background.frames'
            )
        elif self.background.method == "tracks" and self.optics.scheme == "darkfield":
            raise ValueError(
                'background.method = "tracks" needs an interferometric scheme: dark field needs '
                "background.frames"
            )
        return self

    @model_validator(mode="after")
    def _template_suits_mode(self) -> Config:
        if self.optics.psf == "measured" and self.fit.mode != "mass":
            raise ValueError(
                f'fit.mode = "{self.fit.mode}" needs the picture at every height, and optics.psf = '
                '"measured" has it at one: use fit.mode = "mass", or optics.psf = "model"'
            )
        return self

    @model_validator(mode="after")
    def _priors_are_of_free_parameters(self) -> Config:
        fixed = {"mass": "z_nm", "localize": "mass_kda"}.get(self.fit.mode)
        if fixed in self.posterior.priors:
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
    def samples_posterior(self) -> bool:
        """Whether posteriors are sampled: as asked, else where events are few."""
        if self.fit.mode == "track":
            return False
        if self.posterior.enabled == "auto":
            return self.background.method != "sliding"
        return self.posterior.enabled
