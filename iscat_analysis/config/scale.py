"""Sections of the mass scale: contrast against mass, and the inputs that were not measured."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from iscat_analysis.config.covariance import MEASURABLE, OpticsCovariance
from iscat_analysis.config.instrument import Optics
from iscat_analysis.config.values import LARGEST_NM, Finite, NonNegative, Positive, Section, length

CONTRAST_PER_KDA = (1e-7, 0.01)
"""Range of contrast per kDa: a protein has some 1e-5; at the upper limit, the contrast of 100 kDa
would be 1."""


class StandardsCamera(Section):
    """The detector with which the standards of a calibration were recorded."""

    pixel_size_nm: Positive | None = Field(None, description="in the sample plane")
    samples_per_pixel: Literal["auto"] | Annotated[int, Field(ge=1, le=9)] = Field(
        1, description="along each axis, with which the standards were analysed"
    )
    fill_factor: Annotated[float, Field(gt=0, le=1)] = Field(
        1.0, description="share of a pixel's area that detects light"
    )
    gain_e_per_adu: Positive | None = Field(
        None, description="photoelectrons per count, where it is one number"
    )
    offset_adu: Finite | None = Field(
        None, description="counts in the dark, where they are one number"
    )


class Calibration(Section):
    """Contrast against mass; if present, it replaces the absolute scale of the model.

    Signed peak contrast = gradient·mass + sign(mass)·offset, with the optics of the standards; for
    other optics the model converts it.
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
    dof: Annotated[int, Field(ge=0)] | None = Field(
        None, description="degrees of freedom of the line: standards beyond two"
    )
    optics: Optics | None = Field(
        None, description="keys of [optics] with which the standards were analysed"
    )
    covariance: OpticsCovariance | None = Field(
        None, description="of these if they were learned, { names, matrix }"
    )
    height_nm: Annotated[NonNegative, length(0.0, LARGEST_NM)] | None = Field(
        None, description="particle.height_nm with which the standards were analysed"
    )
    camera: StandardsCamera | None = Field(None, description="with which they were recorded")
    optics_assumed: bool = Field(
        False, description="true: the optics are not known; those configured are assumed"
    )

    @model_validator(mode="after")
    def _usable(self) -> Calibration:
        if self.gradient_per_kda == 0:
            raise ValueError("gradient_per_kda = 0 says nothing about mass")
        least, most = CONTRAST_PER_KDA
        if not least <= abs(self.gradient_per_kda) <= most:
            raise ValueError(
                f"gradient_per_kda = {self.gradient_per_kda:g} is not between {least:g} and "
                f"{most:g}: give contrast per kDa, as -3.1e-5, not in per cent or ppm, nor per "
                "Da or MDa"
            )
        return self


def _measurable(errors: dict[str, float]) -> dict[str, float]:
    for name in errors:
        if name not in MEASURABLE:
            raise ValueError(f"{name} cannot be learned: give some of {', '.join(MEASURABLE)}")
    return errors


class Uncertainty(Section):
    """Standard deviations of inputs that were not measured; 0 turns one off.

    If standards were recorded with the same optics, they have the same errors, which cancel.
    """

    wavelength_nm: NonNegative = Field(1.0, description="of optics.wavelength_nm")
    n_sample: NonNegative = Field(0.002, description="of optics.n_sample")
    n_glass: NonNegative = Field(0.002, description="of optics.n_glass")
    index: NonNegative = Field(0.01, description="of particle.index, if particles are spheres")
    height_nm: NonNegative = Field(
        2.0, description="of the mean height of particles, if particle.height_nm is fixed"
    )
    wiggle_nm: NonNegative = Field(
        15.0,
        description="of how far particles wiggle, or have parts that are apart, along each axis "
        "beyond particle.wiggle_nm, before their images are seen",
    )
    magnification: Annotated[NonNegative, Field(lt=0.5)] = Field(
        0.005, description="of camera.pixel_size_nm, as a share of it"
    )
    offset_adu: NonNegative = Field(
        1.0, description="of camera.offset_adu if it is configured, counts"
    )
    optics: Annotated[dict[str, Positive], AfterValidator(_measurable)] = Field(
        default_factory=dict,
        description="of keys of [optics], each aberration by its own name, before particles tell "
        "them, as { focus_nm = 50.0 }; else focus 150, NA 0.01, phase 20, z11 20, others 10",
    )
