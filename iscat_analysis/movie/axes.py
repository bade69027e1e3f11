"""Which axis of a described stack is time: the one that is longer than 1 beside y and x."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from iscat_analysis.errors import DataError

_TIME_LIKE = "TZQI"
_MOST_CHANNELS = 7  # of an ImageJ composite
_NAMES = {
    "T": "T (time)",
    "Z": "Z (height)",
    "C": "C (channel)",
    "S": "S (sample)",
    "P": "P (position)",
}


def time_axis(sizes: Mapping[str, int], path: Path) -> str | None:
    """Name the axis along which the frames lie.

    T, Z, Q and I may be time: a stack with Z only is what many camera programs write.  So may C
    beyond the seven channels of an ImageJ composite: tifffile calls the frames of ImageJ and OME
    stacks channels when it is not told otherwise.

    Parameters
    ----------
    sizes : mapping of str to int
        Length of each axis besides y and x.
    path : Path
        What messages call the file.

    Returns
    -------
    str or None
        The one axis longer than 1; None where there is none.

    Raises
    ------
    DataError
        There are two such axes, or the only one cannot be time.
    """
    long = {axis: size for axis, size in sizes.items() if size > 1}
    shown = " and ".join(
        f"{_NAMES.get(axis, axis)} of length {size}" for axis, size in long.items()
    )
    if len(long) > 1:
        raise DataError(
            f"{path}: needs one axis besides y and x but has {shown}; "
            "export one of them at a time, each to its own file"
        )
    if not long:
        return None
    (axis,) = long
    if axis not in _TIME_LIKE and not (axis == "C" and long[axis] > _MOST_CHANNELS):
        raise DataError(
            f"{path}: its only axis besides y and x is {shown}, which is not time; "
            "declare it as frames (in Fiji: Image > Properties), or export one channel or position"
        )
    return axis
