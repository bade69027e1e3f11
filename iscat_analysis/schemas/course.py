"""Parts of documents that say where in a movie something was."""

from __future__ import annotations

from iscat_analysis.schemas.base import Closed, Count, Number, key


class Break(Closed):
    """Frames before and after which are not compared with each other."""

    start: Count = key("First frame that is left out, or the first one after a cut")
    stop: Count = key("One past the last; the same as start where none is left out")
    cause: str = key("What it looks like")


class Text(Closed):
    """A rectangle of pixels into which a text is burnt."""

    rows: tuple[Count, Count] = key("Rows [start, stop)")
    columns: tuple[Count, Count] = key("Columns [start, stop)")


class LeftOut(Closed):
    """Frames and pixels that are no measurement."""

    analysed: list[tuple[Count, Count]] = key("Frames [start, stop) that are analysed together")
    breaks: list[Break] = key("Where landing movies break, and why")
    texts: list[Text] = key("Texts that are burnt in")


class Interval(Closed):
    """Frames of which something is to be said."""

    start: Count = key("First frame")
    stop: Count = key("One past the last; the same as start for a cut")
    what: str = key("What it is")


class EventCounts(Closed):
    """Events in parts of the movie."""

    edges: list[Count] = key("Frames at which the parts begin, and one past the last")
    ok: list[Count] = key("Events whose status is ok")
    flagged: list[Count] = key("Other events, side lobes left out")


class Timeline(Closed):
    """What was where in a movie, on one axis of frames; null where a part says nothing."""

    frames: list[float] = key("Mean frames of the places at which some frames were looked at")
    light_e: list[Number] = key("Mean light of a pixel [photoelectrons]")
    noise_over_expected: list[Number] = key(
        "Variance between neighbouring frames over that of light and read noise"
    )
    focus_nm: list[Number] = key("Focus with which the frames were fitted [nm]")
    drift_x_px: list[Number] = key("Shift of the fixed pattern along x from the first place [px]")
    drift_y_px: list[Number] = key("The same along y [px]")
    intervals: list[Interval] = key("Frames that were left out, or partly hidden")
    events: EventCounts = key("Events per time")
