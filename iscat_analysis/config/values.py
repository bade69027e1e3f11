"""Allowed values of the keys of a configuration: modes, lengths, ranges of frames; `Section`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from iscat_analysis.errors import ConfigError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

Mode = Literal["mass", "localize", "joint", "size", "track"]


def _lower(value: Any) -> Any:
    return value.lower() if isinstance(value, str) else value


Scheme = Annotated[Literal["iscat", "cobri", "darkfield"], BeforeValidator(_lower)]
SphereKind = (
    Literal["vesicle", "gold", "silica", "polystyrene", "sphere"]
    | Annotated[float, AfterValidator(lambda index: refractive_index(index))]
)
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


ALL = "all"
"""Replaces a range of frames: all analysed frames."""

WAVELENGTH_NM = (200.0, 3000.0)
"""Range of vacuum wavelengths of a light microscope [nm]."""

LARGEST_NM = 1e5
"""Largest height, focus or side of a fitted square [nm]."""

PIXEL_NM = (1.0, 2000.0)
"""Range of pixel sizes in the sample plane [nm]; outside, the unit is wrong."""

INDICES = (1.0, 4.5)
"""Range of refractive indices: air, oils, glasses and transparent semiconductors."""

_UNITS_NM = {"micrometres": 1e3, "millimetres": 1e6, "metres": 1e9, "ångström": 0.1}


def unit_guess(value: float, low_nm: float, high_nm: float) -> str:
    """Name the probable unit of a length outside its range."""
    for unit, nanometres in _UNITS_NM.items():
        converted = value * nanometres
        if low_nm <= abs(converted) <= high_nm:
            return f"; if {value:g} is in {unit}, write {converted:g}"
    return ""


def plausible_pixel(size_nm: float) -> float:
    """Return a pixel size; refuse one that no microscope has."""
    low, high = PIXEL_NM
    if not low <= size_nm <= high:
        raise ValueError(
            f"a pixel of {size_nm:g} nm is not between {low:g} and {high:g} nm: give its size in "
            f"the sample plane (not on the sensor), in nanometres{unit_guess(size_nm, low, high)}"
        )
    return size_nm


def length(low_nm: float, high_nm: float) -> AfterValidator:
    """Accept lengths whose magnitude is in a range, and guess the unit of the others."""

    def check(value: float) -> float:
        if low_nm <= abs(value) <= high_nm:
            return value
        guess = unit_guess(value, max(low_nm, 1e-3 * high_nm), high_nm)
        what = f"{value:g} nm is" if value >= 0 else f"the magnitude of {value:g} nm is"
        raise ValueError(f"{what} not between {low_nm:g} and {high_nm:g} nm{guess}")

    return AfterValidator(check)


def refractive_index(index: float) -> float:
    """Return a refractive index; refuse one that no transparent material has."""
    low, high = INDICES
    if not low <= index <= high:
        raise ValueError(
            f"a refractive index of {index:g} is not between {low:g} and {high:g}: write water's, "
            "say, as 1.33"
        )
    return index


def _kind_of_frames(frames: Any) -> str:
    return "literal" if isinstance(frames, str) and frames == ALL else "tuple"


MOST_CHANNELS = 16
"""Channels whose frames take turns, at most."""


def _one_of_them(channel: tuple[int, int]) -> tuple[int, int]:
    channels, which = channel
    if not (2 <= channels <= MOST_CHANNELS and 0 <= which < channels):
        raise ValueError(
            f"[{channels}, {which}] must be how many channels take turns, 2 to {MOST_CHANNELS}, "
            "and which one is analysed, from 0, as in [2, 0]"
        )
    return channel


ChannelOf = Annotated[tuple[int, int], BeforeValidator(_two), AfterValidator(_one_of_them)]
FrameRange = Annotated[tuple[int, int], BeforeValidator(_two), AfterValidator(_ordered)]
FramesOrAll = Annotated[
    Annotated[FrameRange, Tag("tuple")] | Annotated[Literal["all"], Tag("literal")],
    Discriminator(_kind_of_frames),
]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Height = Annotated[NonNegative, length(0.0, LARGEST_NM)]
Diameter = Annotated[Positive, length(0.1, 1e4)]
Samples = Literal["auto"] | Annotated[int, Field(ge=1, le=9)]
""" "auto" or how many along each axis of a pixel"""
FillFactor = Annotated[float, Field(gt=0, le=1)]


class _Called(ModelMetaclass):
    """Make a section from keyword arguments, with the program's own messages for errors."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().__call__(*args, **kwargs)
        except ValidationError as error:
            from iscat_analysis.config.files import complaints, section_name

            name = section_name(self)
            items = ({**item, "loc": (*name, *item["loc"])} for item in error.errors())
            raise ConfigError("; ".join(dict.fromkeys(complaints(items, {})))) from None


class Section(BaseModel, metaclass=_Called):
    """A section of the file: immutable, and an unknown key is an error.

    The docstring below a key is its description, which `iscat config` prints beside it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Write descriptions in one line."""
        for field in cls.model_fields.values():
            field.description = " ".join((field.description or "").split())

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for refusal in self._refusals():
            raise ValueError(refusal)
        return self

    def _refusals(self) -> Iterable[str]:
        """Say why keys do not go together; only the first reason is read."""
        return ()
