"""Document of ``iscat init``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from iscat_analysis.schemas.base import Count, Document, Natural, Number, key


class SetupValue(Document):
    """A value of the configuration."""

    value: float | str = key("The value")
    se: Number = key("Its standard error, where it was measured")
    origin: str = Field(
        alias="from",
        description="Where it comes from: read from the file, measured from the movie, your "
        "answer, instrument NAME, assumed, to be given; and whether it will be learned",
    )


class Look(Document):
    """What the search found in some parts of the movie."""

    frames: list[Count] = key("The frames at which it looked")
    window: Natural = key("Frames in each of its windows")
    candidates: list[Count] = key("Number of candidates in each part")
    threshold_snr: Number = key("Signal-to-noise ratio above which something is a candidate")
    strongest_snr: Number = key("That of the strongest candidate")
    noise_contrast: Number = key("Standard deviation of a pixel of the contrast that is searched")
    light_e: Number = key("Photoelectrons in a pixel of a frame")


class Init(Document):
    """What iscat init prints."""

    movie: str = key("Name of the movie")
    shape: Annotated[list[Natural], Field(min_length=3, max_length=3)] = key(
        "Frames, rows, columns"
    )
    values: dict[str, SetupValue] = key("The configuration, by section.key")
    notes: list[str] = key("What the movie gives to say")
    preview: Look = key("What the search saw")
    out: str = key("The configuration that was written")
