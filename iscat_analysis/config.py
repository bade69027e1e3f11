"""The configuration: one frozen, validated model for each section of the TOML file.

Lengths are nm, masses kDa, counts photoelectrons; ranges are half-open ``[start, stop)`` frames;
complex numbers are ``[re, im]``.  Every field carries the text `iscat config` prints beside it.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from iscat_analysis.errors import ConfigError

Mode = Literal["mass", "localize", "joint", "track"]
Scheme = Literal["iscat", "cobri", "darkfield"]


def _ordered(frames: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= frames[0] < frames[1]:
        raise ValueError(f"[start, stop) needs 0 <= start < stop, got {list(frames)}")
    return frames


PIXEL_NM = (1.0, 2000.0)
"""Pixel sizes in the sample plane that a microscope can have [nm]; outside, the unit is wrong."""


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
            "the sample plane (not on the sensor), in nanometres"
        )
    return size_nm


MOST_WAVES = 0.5
"""Largest Zernike term over the wavelength; ten times that of a poor objective."""

ABERRATIONS = tuple(f"z{j}" for j in range(5, 38))
"""Zernike terms on offer, by Noll's index."""


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


Frames = Annotated[tuple[int, int], AfterValidator(_ordered)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Section(BaseModel):
    """A section of the file: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Optics(Section):
    """The microscope (physics.md, section 1)."""

    wavelength_nm: Positive = Field(525.0, description="vacuum wavelength")
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
    focus_nm: Finite = Field(
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
    diameter_nm: Positive | None = Field(None, description="in place of mass_kda")
    height_nm: NonNegative = Field(5.0, description="z where it is fixed; start value elsewhere")

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

    frames: Frames | None = Field(
        None, description="pre-binding frames [start, stop); absent in landing movies"
    )
    window_frames: Annotated[int, Field(ge=4)] | None = Field(
        None,
        description="landing movies: frames before and after each step; absent: from the noise",
    )
    method: Literal["mean", "median", "none"] = Field(
        "mean", description='"mean" | "median" | "none" (then level_e gives the known level)'
    )
    level_e: Positive | None = Field(
        None, description="known level per pixel and frame, for method none"
    )
    power_normalization: bool = Field(
        True, description="divide out the laser power, estimated with the particles excluded"
    )
    drift_correction: bool = Field(
        False, description="landing movies: divide out the motion of the fixed pattern"
    )

    @model_validator(mode="after")
    def _known(self) -> BackgroundConfig:
        if self.method == "none" and self.level_e is None:
            raise ValueError('method = "none" needs level_e, the known background level')
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


class Fit(Section):
    """The maximum-likelihood fit."""

    mode: Mode = Field("mass", description='"mass" | "localize" | "joint" | "track"')
    frames: Frames | None = Field(
        None, description="[start, stop); absent: all after the background"
    )
    roi_nm: Positive = Field(2700.0, description="side of the square that is fitted")
    likelihood: Literal["auto", "poisson", "conditional"] = Field(
        "auto", description='"auto" | "poisson" | "conditional"'
    )
    z_range_nm: tuple[NonNegative, NonNegative] = Field(
        (0.0, 1000.0), description="bounds of z where it is free"
    )

    @model_validator(mode="after")
    def _range(self) -> Fit:
        if not self.z_range_nm[0] < self.z_range_nm[1]:
            raise ValueError(f"z_range_nm = {list(self.z_range_nm)} is empty")
        return self


class PosteriorConfig(Section):
    """Sampling of the posterior with emcee."""

    enabled: bool = Field(True, description="sample it; --posterior and --no-posterior override")
    walkers: Annotated[int, Field(ge=10, multiple_of=2)] = Field(32, description="even number")
    steps: Annotated[int, Field(ge=100)] = Field(2000, description="per walker, burn-in included")


class Calibration(Section):
    """Contrast against mass; present, it replaces the model's absolute scale.

    Signed peak contrast = gradient·mass + sign(mass)·offset.
    """

    gradient_per_kda: Finite = Field(description="signed peak contrast per kDa")
    offset: Finite = Field(0.0, description="peak contrast at zero mass (odd-symmetric)")

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


class Simulation(Section):
    """A synthetic movie with known truth."""

    shape: tuple[Annotated[int, Field(ge=8)], Annotated[int, Field(ge=8)]] = Field(
        (128, 128), description="rows, columns"
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
    count: Annotated[int, Field(ge=1)] | None = Field(
        None, description="landings at random places and times, in place of events"
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


class Compute(Section):
    """Resources."""

    workers: Annotated[int, Field(ge=1)] = Field(2, description="threads")
    memory_limit_mb: Annotated[int, Field(ge=64)] = Field(
        1000, description="for the pixel data held at once"
    )


class Config(Section):
    """A whole configuration; `load_config` reads one."""

    optics: Optics = Field(default_factory=Optics)
    camera: CameraConfig = Field(default_factory=CameraConfig)
    particle: Particle = Field(default_factory=Particle)
    background: BackgroundConfig = Field(default_factory=BackgroundConfig)
    detection: Detection = Field(default_factory=Detection)
    fit: Fit = Field(default_factory=Fit)
    posterior: PosteriorConfig = Field(default_factory=PosteriorConfig)
    calibration: Calibration | None = None
    simulation: Simulation = Field(default_factory=Simulation)
    bounds: BoundsConfig = Field(default_factory=BoundsConfig)
    compute: Compute = Field(default_factory=Compute)


def load_config(path: Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file and apply overrides.

    Parameters
    ----------
    path : Path, optional
        TOML file; without it, the defaults.
    overrides : iterable of str
        ``"section.key=value"``, the value as TOML would write it (quotes may be left out).

    Returns
    -------
    Config
        Validated.  Relative paths in it are relative to the file's folder.

    Raises
    ------
    ConfigError
        The file cannot be read, a key is unknown or a value is impossible.
    """
    values: dict[str, Any] = {}
    if path is not None:
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
        except UnicodeDecodeError:
            raise ConfigError(f"{path}: is not a text file in UTF-8") from None
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{path}: is not valid TOML: {error}") from None
        _anchor_paths(values, path.parent)
    for override in overrides:
        _apply_override(values, override)
    return parse_config(values, where=str(path) if path else "configuration")


def parse_config(values: Mapping[str, Any], *, where: str = "configuration") -> Config:
    """Validate a nested mapping, as `tomllib` returns it.

    Parameters
    ----------
    values : mapping
        Sections of keys.
    where : str
        What error messages call the source.

    Returns
    -------
    Config
        Validated.

    Raises
    ------
    ConfigError
        One line that names each offending key.
    """
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        complaints = "; ".join(dict.fromkeys(_complaint(item) for item in error.errors()))
        raise ConfigError(f"{where}: {complaints}") from None


def config_to_toml(config: Config, *, comments: bool = True) -> str:
    """Write a configuration as TOML that `load_config` reads back to an equal object.

    Parameters
    ----------
    config : Config
        What to write.
    comments : bool
        Put each key's description beside it and show unset keys commented out.

    Returns
    -------
    str
        TOML text.
    """
    blocks = []
    for name, field in type(config).model_fields.items():
        model: Section | type[Section]
        section = getattr(config, name)
        model = section if section is not None else _model_of(field.annotation)
        if section is None and not comments:
            continue
        lines = [f"[{name}]" if section is not None else f"# [{name}]"]
        tables: list[str] = []
        fields = (model if isinstance(model, type) else type(model)).model_fields
        for key, info in fields.items():
            value = getattr(section, key) if section is not None else None
            if key == "events":
                tables = [_event_toml(event) for event in value or ()]
                continue
            if value is None and not comments:
                continue
            line = f"# {key} =" if value is None else f"{key} = {_toml_value(value)}"
            lines.append(f"{line:<36} # {info.description}" if comments else line)
        blocks.append("\n".join([*lines, *tables]))
    return "\n\n".join(blocks) + "\n"


def _model_of(annotation: Any) -> type[Section]:
    model: type[Section] = next(a for a in get_args(annotation) if a is not type(None))
    return model


def _event_toml(event: SimulatedEvent) -> str:
    lines = [f"{k} = {_toml_value(v)}" for k, v in event.model_dump().items() if v is not None]
    return "\n".join(["[[simulation.events]]", *lines])


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    if isinstance(value, dict):
        items = ", ".join(f"{k} = {_toml_value(v)}" for k, v in value.items())
        return f"{{ {items} }}" if items else "{}"
    return repr(value)


_PATH_KEYS = {
    "camera": ("gain_e_per_adu", "offset_adu", "read_noise_e"),
    "simulation": ("background",),
}


def _anchor_paths(values: dict[str, Any], folder: Path) -> None:
    """Make the relative paths of a file relative to the folder it lies in."""
    for section, keys in _PATH_KEYS.items():
        table = values.get(section)
        if not isinstance(table, dict):
            continue
        for key in keys:
            value = table.get(key)
            if isinstance(value, str) and value not in ("flat", "speckle"):
                table[key] = str(folder / value)


def _apply_override(values: dict[str, Any], override: str) -> None:
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise ConfigError(f"--set {override}: write it as section.key=value, as in optics.na=1.42")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    table = values.setdefault(section, {})
    if not isinstance(table, dict):
        raise ConfigError(f"--set {override}: {section} is not a section")
    table[key] = value
    exclusive = {
        "mass_kda": "diameter_nm",
        "diameter_nm": "mass_kda",
        "index": "permittivity",
        "permittivity": "index",
    }
    if section == "particle" and key in exclusive:
        table.pop(exclusive[key], None)


def _complaint(item: Mapping[str, Any]) -> str:
    location = [str(part) for part in item["loc"] if not _is_union_branch(part)]
    key = ".".join(location)
    if item["type"] == "extra_forbidden":
        known = _known_keys(location[:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"; did you mean {near[0]}?" if near else f"; known: {', '.join(known)}"
        kind = "section" if len(location) == 1 else "key"
        return f"unknown {kind} {key}{hint}"
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "missing":
        return f"{key}: is required"
    given = item["input"]
    shown = f" (got {given!r})" if isinstance(given, (str, int, float, list)) else ""
    if isinstance(given, float) and math.isnan(given):
        shown = " (got nan)"
    return f"{key}: {message[:1].lower()}{message[1:]}{shown}"


def _is_union_branch(part: Any) -> bool:
    return isinstance(part, str) and (part in {"str", "float", "int"} or "constrained" in part)


def _known_keys(location: list[str]) -> list[str]:
    model: type[Section] = Config
    for part in location:
        if part.isdigit():
            continue
        if part == "events":
            model = SimulatedEvent
            continue
        annotation = model.model_fields[part].annotation
        model = annotation if isinstance(annotation, type) else _model_of(annotation)
    return list(model.model_fields)
