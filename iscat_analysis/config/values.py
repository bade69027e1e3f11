"""What values the keys of a configuration may have: modes, lengths, ranges of frames; `Section`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
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


ALL = "all"
"""In place of a range of frames: all that are analysed."""

WAVELENGTH_NM = (200.0, 3000.0)
"""Vacuum wavelengths that a light microscope uses [nm]."""

LARGEST_NM = 1e5
"""No height, focus or fitted square is larger [nm]."""

PIXEL_NM = (1.0, 2000.0)
"""Pixel sizes in the sample plane that a microscope can have [nm]; outside, the unit is wrong."""

INDICES = (1.0, 4.5)
"""Refractive indices of air, oils, glasses and transparent semiconductors."""

_UNITS_NM = {"micrometres": 1e3, "millimetres": 1e6, "metres": 1e9, "ångström": 0.1}


def unit_guess(value: float, low_nm: float, high_nm: float) -> str:
    """Say which unit an impossible length was probably written in."""
    for unit, nanometres in _UNITS_NM.items():
        converted = value * nanometres
        if low_nm <= abs(converted) <= high_nm:
            return f"; if {value:g} is in {unit}, write {converted:g}"
    return ""


def plausible_pixel(size_nm: float) -> float:
    """Return a pixel size, unless no microscope has it."""
    low, high = PIXEL_NM
    if not low <= size_nm <= high:
        raise ValueError(
            f"a pixel of {size_nm:g} nm is not between {low:g} and {high:g} nm: give its size in "
            f"the sample plane (not on the sensor), in nanometres{unit_guess(size_nm, low, high)}"
        )
    return size_nm


def length(low_nm: float, high_nm: float) -> AfterValidator:
    """Accept lengths whose magnitude lies in a range, and guess the unit of the others."""

    def check(value: float) -> float:
        if low_nm <= abs(value) <= high_nm:
            return value
        guess = unit_guess(value, max(low_nm, 1e-3 * high_nm), high_nm)
        what = f"{value:g} nm is" if value >= 0 else f"the magnitude of {value:g} nm is"
        raise ValueError(f"{what} not between {low_nm:g} and {high_nm:g} nm{guess}")

    return AfterValidator(check)


def refractive_index(index: float) -> float:
    """Return a refractive index, unless nothing that is transparent has it."""
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


class _Called(ModelMetaclass):
    """What makes a section from keyword arguments: what is wrong is said in the program's words."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().__call__(*args, **kwargs)
        except ValidationError as error:
            from iscat_analysis.config.complaints import complaints, section_name

            name = section_name(self)
            items = ({**item, "loc": (*name, *item["loc"])} for item in error.errors())
            raise ConfigError("; ".join(dict.fromkeys(complaints(items, {})))) from None


class Section(BaseModel, metaclass=_Called):
    """A section of the file: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")
