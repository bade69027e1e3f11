"""Sections of microscope and sample: optics, also over field and time, camera, particle."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, model_validator

from iscat_analysis.config.kinds import SCHEMES, SchemeKind
from iscat_analysis.config.values import (
    LARGEST_NM,
    WAVELENGTH_NM,
    ChannelOf,
    Diameter,
    FillFactor,
    Finite,
    Height,
    NonNegative,
    Positive,
    Samples,
    Scheme,
    Section,
    length,
    plausible_pixel,
    refractive_index,
)
from iscat_analysis.units import sphere_diameter_nm, sphere_mass_kda

Size = Annotated[Finite, Field(ge=-1000.0, le=1000.0)]
Share = Annotated[Finite, Field(ge=-0.5, le=0.5)]

FIELD_TERMS: Mapping[str, tuple[str, int | None]] = {
    "focus_tilt_x_nm": ("focus_tilt_nm", 0),
    "focus_tilt_y_nm": ("focus_tilt_nm", 1),
    "focus_curvature_nm": ("focus_curvature_nm", None),
    "coma_field_nm": ("coma_field_nm", None),
    "astigmatism_field_x_nm": ("astigmatism_field_nm", 0),
    "astigmatism_field_y_nm": ("astigmatism_field_nm", 1),
    "phase_tilt_x_deg": ("phase_tilt_deg", 0),
    "phase_tilt_y_deg": ("phase_tilt_deg", 1),
    "phase_curvature_deg": ("phase_curvature_deg", None),
    "reference_tilt_x": ("reference_tilt", 0),
    "reference_tilt_y": ("reference_tilt", 1),
    "reference_curvature": ("reference_curvature", None),
}
"""Every coefficient by a name of its own: its key in ``[optics]``, and its place in a pair."""


MOVING: Mapping[str, Any] = {
    "focus_drift_nm": 0.0,
    "focus_bend_nm": 0.0,
    "focus_jumps": (),
    "focus_frame": 0,
}
"""Keys of ``[optics]`` that move the focus during a movie, and their values where it rests."""

Jump = tuple[NonNegativeInt, Size]
"""Frame, and rise of the focus there [nm]."""

MOST_JUMPS = 4
"""Jumps of the focus that a movie may have."""

JUMPS = tuple(f"focus_jump_{number}_nm" for number in range(1, MOST_JUMPS + 1))
"""Rises of the focus at the frames of ``focus_jumps`` [nm]."""

MOVES = ("focus_drift_nm", "focus_bend_nm", *JUMPS)
"""What moves the focus during a movie, each coefficient by a name of its own."""


class FieldTerms(Section):
    """Terms of the field by name; each is the change from its centre to its edge."""

    def field_term(self, name: str) -> float:
        """Give a coefficient by its own name.

        Parameters
        ----------
        name : str
            One of `FIELD_TERMS`.

        Returns
        -------
        float
            Its value, in the unit that the name ends with.
        """
        key, index = FIELD_TERMS[name]
        value = getattr(self, key)
        return float(value if index is None else value[index])


def field_keys(terms: Mapping[str, float]) -> dict[str, float | tuple[float, float]]:
    """Give coefficients as keys of ``[optics]``; what of a pair is not named is 0.

    Parameters
    ----------
    terms : Mapping[str, float]
        Coefficients by name, others are left out.

    Returns
    -------
    dict
        By key.
    """
    out: dict[str, float | tuple[float, float]] = {}
    for key, index in dict.fromkeys(FIELD_TERMS[name] for name in FIELD_TERMS if name in terms):
        named = [terms.get(name, 0.0) for name, (k, _) in FIELD_TERMS.items() if k == key]
        out[key] = named[0] if index is None else (named[0], named[1])
    return out


ABERRATIONS = tuple(f"z{j}" for j in range(5, 38))
"""Zernike terms that can be set, by Noll's index."""

MEASURABLE = (
    "focus_nm",
    "na",
    "reference_phase_deg",
    "mask_na",
    "attenuation",
    "polarization_deg",
    *ABERRATIONS,
)
"""Parameters of the optics that can be learned from images, and that have a derivative."""


class OpticsCovariance(Section):
    """Errors of measured optics, section ``[covariance]`` of ``optics.toml``."""

    names: tuple[str, ...]
    """keys of [optics], each aberration by its own name"""
    matrix: tuple[tuple[Finite, ...], ...]
    """covariance, in the order of names"""

    @property
    def of_the_middle(self) -> OpticsCovariance:
        """Errors of the optics in the middle of the field, without those of its terms."""
        return self._without({*FIELD_TERMS, *MOVES})

    @property
    def at_rest(self) -> OpticsCovariance:
        """Errors of the microscope, without those of how its focus moved in a movie."""
        return self._without({*MOVES})

    def _without(self, left_out: set[str]) -> OpticsCovariance:
        kept = [k for k, name in enumerate(self.names) if name not in left_out]
        matrix = tuple(tuple(self.matrix[i][k] for k in kept) for i in kept)
        return OpticsCovariance(names=tuple(self.names[k] for k in kept), matrix=matrix)

    def _refusals(self) -> Iterator[str]:
        size = len(self.names)
        known = (*MEASURABLE, *FIELD_TERMS, *MOVES)
        unknown = [name for name in self.names if name not in known]
        if unknown:
            yield f"names has {unknown[0]}, which is none of {', '.join(known)}"
        if [len(row) for row in self.matrix] != [size] * size:
            yield f"matrix needs {size} rows of {size} numbers, one for each of names"
        for i, j in product(range(size), repeat=2):
            row, other = self.matrix[i], self.matrix[j]
            if abs(row[j] - other[i]) > 1e-6 * math.sqrt(abs(row[i] * other[j])):
                yield f"matrix is not symmetric in {self.names[i]}, {self.names[j]}"
            if row[i] < 0:
                yield f"matrix gives {self.names[i]} a negative variance"


Index = Annotated[Positive, AfterValidator(refractive_index)]

LARGEST_ABERRATION = 0.5
"""Largest Zernike term over the wavelength; ten times that of a poor objective."""

LARGEST_SD_NM = 100.0
"""Largest standard deviation of heights, half a fringe: for more, use mode joint."""

Spread = Annotated[NonNegative, length(0.0, LARGEST_SD_NM)]

LARGEST_ATTENUATION = 3.0
"""Largest attenuation: transmitted amplitude of the reference over that of scattered light."""

DENSITIES_KG_M3 = {"gold": 19300.0, "silica": 2200.0, "polystyrene": 1050.0, "protein": 1350.0}
"""Densities of the kinds of particles; for protein, the usual value in mass photometry."""

USUAL_HEIGHT_NM = 5.0
"""Height of a protein on glass, at which masses are calibrated by default."""


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


class Optics(FieldTerms):
    """The microscope (physics.md, section 1)."""

    file: str | None = None
    """of `iscat calibrate optics`; its values replace those of this section"""
    wavelength_nm: Annotated[Positive, length(*WAVELENGTH_NM)] = 525.0
    """vacuum wavelength"""
    na: Positive = 1.42
    """numerical aperture"""
    n_immersion: Index = 1.515
    """refractive index of the immersion oil"""
    n_glass: Index = 1.515
    """refractive index of the coverslip"""
    n_sample: Index = 1.33
    """refractive index of the sample"""
    scheme: Scheme = "iscat"
    """ "iscat" | "cobri" | "darkfield" """
    attenuation: NonNegative = 1.0
    """amplitude of the reference that passes; ignored in dark field"""
    polarization: Literal["linear", "circular"] = "linear"
    """of the illumination: "linear" | "circular" """
    polarization_deg: Finite = 0.0
    """of linear light, from the image's x axis towards y"""
    analyzer: bool = False
    """only light polarised as the reference reaches the camera"""
    mask_na: NonNegative = 0.0
    """a disc in the pupil attenuates below this NA; 0: the reference alone"""
    reference_phase_deg: Finite = 0.0
    """delay of the reference against the scattered light"""
    aberrations_nm: Annotated[dict[str, Finite], AfterValidator(_noll_names)] = Field(
        default_factory=dict
    )
    """Zernike terms, Noll z5 to z37, rms path over the pupil: { z11 = 8.0 }"""
    focus_nm: Annotated[Finite, length(0.0, LARGEST_NM)] = -300.0
    """focus height z_f; sets the oil thickness for a particle at particle.height_nm"""
    focus_drift_nm: Annotated[Finite, length(0.0, LARGEST_NM)] = 0.0
    """rise of the focus in 1000 frames of a landing movie"""
    focus_bend_nm: Finite = 0.0
    """the same, growing with the square of the frames from focus_frame"""
    focus_jumps: Annotated[tuple[Jump, ...], Field(max_length=MOST_JUMPS)] = ()
    """[[frame, rise], ...]: the focus rises at once, and stays"""
    focus_frame: NonNegativeInt = 0
    """frame at which the focus is focus_nm, but for jumps"""
    convention: Literal["exact", "dong2021"] = "exact"
    """ "exact" | "dong2021" (the paper's numbers, errors included)"""
    axial: Literal["stage", "refocus"] = "stage"
    """fixed in derivatives along z: "stage" | "refocus": the focus follows"""
    emission: Literal["reciprocal", "dong2021"] = "reciprocal"
    """ "reciprocal" (conserves energy) | "dong2021" (as in the paper)"""
    psf: Literal["model", "measured"] = "model"
    """ "model" | "measured" (the image in template; mode mass only)"""
    template: str | None = None
    """file of `iscat calibrate optics --measured`, named in its optics.toml"""
    calibrate: Literal["auto", "always", "never"] = "auto"
    """ "auto" | "always" | "never": learn the optics from the movie"""

    illumination_na: Annotated[Finite, Field(ge=0, le=0.5)] = 0.0
    """aperture of a cone that is evenly filled with light; 0: one plane wave"""
    bandwidth_nm: Annotated[Finite, Field(ge=0, le=100.0)] = 0.0
    """full width at half maximum of the spectrum; 0: one wavelength"""

    focus_tilt_nm: tuple[Size, Size] = (0.0, 0.0)
    """rise of the focus from the centre of the field to its edge, [x, y]"""
    focus_curvature_nm: Size = 0.0
    """the same, growing with the square of the distance from the centre"""
    coma_field_nm: Size = 0.0
    """coma at the edge of the field, along the radius and growing with it"""
    astigmatism_field_nm: tuple[Size, Size] = (0.0, 0.0)
    """astigmatism at the edge, linear in the field, [x, y]"""
    phase_tilt_deg: tuple[Size, Size] = (0.0, 0.0)
    """change of reference_phase_deg from centre to edge, [x, y]"""
    phase_curvature_deg: Size = 0.0
    """the same, growing with the square of the distance"""
    reference_tilt: tuple[Share, Share] = (0.0, 0.0)
    """change of the reference's amplitude from centre to edge, a share"""
    reference_curvature: Share = 0.0
    """the same, growing with the square of the distance"""
    field_px: tuple[Finite, Finite, Annotated[Finite, Field(gt=0)]] | None = None
    """centre x, y of the field and half its longer side [pixels], for which these terms hold; the
    movie's where absent"""

    covariance: OpticsCovariance | None = None
    """of the measured keys, { names, matrix }; taken from the file"""

    @property
    def kind(self) -> SchemeKind:
        """What the scheme means."""
        return SCHEMES[self.scheme]

    @property
    def interferes(self) -> bool:
        """Whether a reference reaches the camera; else, in dark field, particles add light."""
        return self.kind.interferes

    @property
    def resolution_nm(self) -> float:
        """Length λ/NA [nm]."""
        return self.wavelength_nm / self.na

    @property
    def direction(self) -> float:
        """Sign of the incident light's direction along the axis of the collected light."""
        return self.kind.direction

    @property
    def are_learned(self) -> bool:
        """Whether they were learned from the images that are analysed, now or in an earlier run.

        Such optics have errors, come from no file, and are not learned again.  Those of a file or
        of a calibrant of the day were learned from other particles.
        """
        return self.covariance is not None and self.file is None and self.calibrate == "never"

    @model_validator(mode="before")
    @classmethod
    def _emission_of_the_convention(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("convention") == "dong2021":
            return {"emission": "dong2021", **values}
        return values

    def _refusals(self) -> Iterator[str]:
        if self.mask_na >= self.na:
            yield (
                f"mask_na = {self.mask_na} must be below na = {self.na}: a mask that covers the "
                "whole pupil is attenuation without mask_na"
            )
        for name, size in self.aberrations_nm.items():
            if abs(size) > LARGEST_ABERRATION * self.wavelength_nm:
                yield (
                    f"aberrations_nm.{name} = {size:g} exceeds {LARGEST_ABERRATION:g} wavelengths "
                    "rms: give nanometres of path, rms over the pupil"
                )
        if self.na >= self.n_immersion:
            yield (
                f"na = {self.na} must be below n_immersion = {self.n_immersion}: "
                "lower na, or give the index of the oil that was used"
            )
        if self.na >= self.n_glass:
            yield (
                f"na = {self.na} must be below n_glass = {self.n_glass}: such light cannot "
                "cross the coverslip"
            )
        if self.psf == "measured" and self.template is None:
            yield (
                'psf = "measured" needs a template: run `iscat calibrate optics MOVIE --measured` '
                "and give its optics.toml as optics.file"
            )
        if self.psf == "measured" and not self.interferes:
            yield (
                'psf = "measured" needs an interferometric scheme: in dark field the image is the '
                "square of the field, which the template does not have"
            )
        if self.kind.reflected and self.n_glass == self.n_sample:
            yield "n_glass equals n_sample: nothing is reflected, so there is no iSCAT reference"
        if self.attenuation > LARGEST_ATTENUATION:
            yield (
                f"attenuation = {self.attenuation:g} is more than {LARGEST_ATTENUATION:g}: it is "
                "the part of the reference's amplitude that passes, as 0.1 for a tenth"
            )
        if self.interferes and self.attenuation == 0:
            yield 'attenuation = 0 leaves no reference: use scheme = "darkfield"'


AUTO = "auto"
"""Replaces a number of the camera that is measured from the movie."""

ASSUMED: Mapping[str, float] = {"gain_e_per_adu": 1.0, "offset_adu": 0.0, "read_noise_e": 0.0}
"""Values if nothing else is known: counts are photoelectrons, and there are none in the dark."""


class CameraConfig(Section):
    """The detector, in the sample plane."""

    pixel_size_nm: Annotated[Positive, AfterValidator(plausible_pixel)] | None = None
    """in the sample plane; absent: taken from the metadata"""
    gain_e_per_adu: Positive | str = AUTO
    """photoelectrons per count: a number, the path of a TIFF map, or "auto": measured from the
    movie's noise"""
    offset_adu: Finite | str = AUTO
    """counts in the dark: a number, a map, or "auto": from dark frames, or from flicker and
    noise of the pixels"""
    read_noise_e: NonNegative | str = AUTO
    """read noise, standard deviation per frame: a number, a map, or "auto" """
    response: str | None = None
    """CSV file of counts and photoelectrons, for a camera that is not linear"""
    well_depth_e: Positive | None = None
    """full well: counts at or above it are flagged as saturated"""
    channels: ChannelOf | None = None
    """[2, 0]: frames of two channels take turns, and those of the first are a movie of their own,
    with numbers and times of their own"""
    exposure_ms: Positive | None = None
    """absent: taken from the metadata"""
    frame_rate_hz: Positive | None = None
    """absent: taken from the metadata"""
    samples_per_pixel: Samples = "auto"
    """along each axis, to integrate over pixels: 1 to 9 | "auto": as many as are needed, or
    those of the calibration's standards; 1: the light at the centre"""
    fill_factor: FillFactor = 1.0
    """share of a pixel's area that detects light, a square at its centre"""

    @property
    def pixel_nm(self) -> float:
        """Pixel size in the sample plane [nm], NaN where it is not known."""
        return self.pixel_size_nm or math.nan

    @property
    def assumed(self) -> CameraConfig:
        """The camera without a movie: "auto" is replaced by an assumed number."""
        numbers = {key: value for key, value in ASSUMED.items() if getattr(self, key) == AUTO}
        return self.model_copy(update=numbers) if numbers else self


_OF_MODELS = {
    "shell": ("shell_nm", "shell_index", "density_kg_m3"),
    "rod": ("aspect_ratio", "azimuth_deg", "tilt_deg"),
}
"""Model → what it needs, and others do not have; all have a density."""


class Particle(Section):
    """The particle that scatters."""

    kind: Literal["gold", "silica", "polystyrene", "protein", "custom"] = "protein"
    """ "gold" | "silica" | "polystyrene" | "protein" | "custom" """
    model: Literal["dipole", "mie", "shell", "rod"] = "dipole"
    """ "dipole" | "mie": a sphere of any size | "shell": a sphere in a shell | "rod": a spheroid
    that is small"""
    permittivity: tuple[float, float] | None = None
    """relative, [re, im]; replaces that of the kind"""
    index: Positive | None = None
    """refractive index, in place of permittivity"""
    shell_nm: Annotated[Positive, length(0.1, 1e3)] | None = None
    """thickness of the shell, a part of the diameter; for model shell"""
    shell_index: Index | None = None
    """refractive index of the shell"""
    aspect_ratio: Annotated[float, Field(ge=1, le=20)] | None = None
    """length of a rod over its width; for model rod"""
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """direction of a rod in the image, from x towards y; for model rod"""
    tilt_deg: Annotated[float, Field(ge=0, le=180)] | None = None
    """angle between a rod and the optical axis; for model rod"""
    density_kg_m3: Positive | None = None
    """replaces that of the kind; for model shell, of core and shell together"""
    mass_kda: Positive | None = None
    """start value, and the true mass in a simulation"""
    diameter_nm: Diameter | None = None
    """in place of mass_kda"""
    height_nm: Literal["contact", "auto"] | Height = USUAL_HEIGHT_NM
    """z if it is fixed, else its start value | "contact": radius of the particle + linker_nm; a
    sphere that has the default does that too | "auto": 5 nm for optics and mass scale; for the
    particles, mean and spread are learned from the movie"""
    linker_nm: Height = 0.0
    """between coverslip and particle, for height_nm = "contact" """
    height_sd_nm: Spread = 0.0
    """standard deviation of heights; > 0: mode mass fits z with this normal prior"""
    wiggle_nm: Spread = 0.0
    """standard deviation of a particle's position along each axis, if it wiggles as on a tether"""
    learned_height_nm: Height | None = None
    """mean height that height_nm = "auto" learned from a movie; optics and mass scale stay those of
    height_nm"""
    photons_per_frame: Positive | None = None
    """dark field: scattered photons collected per frame from a particle of this mass; it sets the
    mass scale"""

    def _refusals(self) -> Iterator[str]:
        if self.permittivity is not None and self.index is not None:
            yield "give permittivity or index, not both"
        if self.mass_kda is not None and self.diameter_nm is not None:
            yield "give mass_kda or diameter_nm, not both"
        custom = self.kind == "custom"
        if custom and self.given_index is None:
            yield 'kind = "custom" needs permittivity or index'
        if custom and self.density_kg_m3 is None:
            yield 'kind = "custom" needs density_kg_m3'
        for model, names in _OF_MODELS.items():
            for name in names:
                value = getattr(self, name)
                if self.model == model and value is None:
                    yield f'model = "{model}" needs {name}'
                if self.model != model and value is not None and name != "density_kg_m3":
                    yield f'{name} = {value:g} needs model = "{model}"'
        if self.shell_nm is not None and self.shell_nm > self.nominal_diameter_nm / 2:
            yield (
                f"shell_nm = {self.shell_nm:g} is more than the radius of a particle of "
                f"{self.nominal_diameter_nm:g} nm: the shell is a part of the diameter"
            )
        if self.linker_nm and self.height_nm != "contact":
            yield (
                f'linker_nm = {self.linker_nm:g} needs height_nm = "contact", and height_nm is '
                f'{self.height_nm}: set height_nm = "contact", or leave linker_nm out'
            )
        if self.learned_height_nm is not None and self.height_nm != "auto":
            yield (
                f'learned_height_nm = {self.learned_height_nm:g} is what height_nm = "auto" found: '
                "set height_nm to it, or leave it out"
            )

    @property
    def density(self) -> float:
        """Density that is given, or that of the kind [kg/m³]."""
        return self.density_kg_m3 or DENSITIES_KG_M3.get(self.kind, 1000.0)

    @property
    def nominal_mass_kda(self) -> float:
        """Mass that is given, as a mass or a diameter, else a typical one."""
        if self.mass_kda is not None:
            return self.mass_kda
        if self.diameter_nm is None and self.kind == "protein" and not self.is_sphere:
            return 150.0  # mass of a protein if none is given
        # Diameter of a particle if none is given, unless it is a protein
        # Diameter of a sphere that is not small beside the wavelength, if none is given
        typical = 100.0 if self.is_sphere else 30.0
        return sphere_mass_kda(self.diameter_nm or typical, self.density)

    @property
    def nominal_diameter_nm(self) -> float:
        """Diameter of a sphere of the nominal mass [nm]."""
        return sphere_diameter_nm(self.nominal_mass_kda, self.density)

    @property
    def given_index(self) -> complex | None:
        """Refractive index that is given, else None: that of the kind depends on the wavelength."""
        if self.permittivity is not None:
            return cmath.sqrt(complex(*self.permittivity))
        return None if self.index is None else complex(self.index)

    @property
    def is_sphere(self) -> bool:
        """Whether it is a sphere of any size, and no dipole."""
        return self.model in ("mie", "shell")

    @property
    def is_rod(self) -> bool:
        """Whether it is a rod, whose dipole does not point along the light."""
        return self.model == "rod"

    @property
    def nominal_length_nm(self) -> float:
        """Length of a particle of the nominal mass along its longest axis [nm]."""
        return float(self.nominal_diameter_nm * (self.aspect_ratio or 1.0) ** (2 / 3))

    @property
    def nominal_height_nm(self) -> float:
        """Height, of a particle of the nominal mass, at which optics and mass scale are defined."""
        return self._seated_nm(self.nominal_mass_kda)

    def mean_height_nm(self, mass_kda: float) -> float:
        """Height at which a particle is expected: given, of contact, or learned.

        Parameters
        ----------
        mass_kda : float
            Its mass [kDa], which gives its radius for ``height_nm = "contact"``.

        Returns
        -------
        float
            The height [nm].
        """
        learned = self.learned_height_nm
        shift = 0.0 if learned is None else learned - self.nominal_height_nm
        return self._seated_nm(mass_kda) + shift

    def _seated_nm(self, mass_kda: float) -> float:
        stands = self.is_sphere and self.height_nm == USUAL_HEIGHT_NM  # which is of proteins
        if self.height_nm == "contact" or stands:
            return sphere_diameter_nm(abs(mass_kda), self.density) / 2 + self.linker_nm
        return USUAL_HEIGHT_NM if self.height_nm == "auto" else self.height_nm

    def held_at(self, height_nm: float) -> Particle:
        """Give the same particle with a known height.

        Parameters
        ----------
        height_nm : float
            Above the coverslip [nm].

        Returns
        -------
        Particle
            Without a prior of heights.
        """
        known = {"height_nm": height_nm, "learned_height_nm": None}
        return self.model_copy(update={**known, "linker_nm": 0.0, "height_sd_nm": 0.0})

    @property
    def height_is_open(self) -> bool:
        """Whether heights are to be learned from the movie."""
        return self.height_nm == "auto" and self.learned_height_nm is None

    @property
    def height_prior_sd_nm(self) -> float:
        """Standard deviation of the prior of heights; wide before they are learned from a movie."""
        # Standard deviation of heights before they are learned from a movie: a tenth of a fringe
        return self.height_sd_nm or (20.0 if self.height_is_open else 0.0)
