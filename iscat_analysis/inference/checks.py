"""Checks of arguments: real, finite numbers of the right shape and a possible size.

Compiled kernels do not check indices, so that every array is checked where it enters.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.units import count

LARGEST = 1e15
"""No mass [kDa], light [e] or number of frames is larger; the square of one is still a number.
Nor is one that must be above 0 smaller than its reciprocal."""


def array_of(name: str, value: ArrayLike) -> NDArray[Any]:
    """Turn an argument into an array of whatever type it is."""
    try:
        return np.asarray(value)
    except ValueError:
        raise DataError(f"{name}: its rows have different lengths; give a regular array") from None


def real_array(name: str, value: ArrayLike) -> FloatArray:
    """Turn an argument into 64-bit floats."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.flags.c_contiguous:
        return value
    array = array_of(name, value)
    if np.ma.is_masked(value):
        raise DataError(f"{name}: has masked elements, whose values mean nothing; leave them out")
    if array.dtype.kind not in "iufb":
        raise DataError(
            f"{name}: holds {array.dtype} where real numbers are needed; convert it with "
            "numpy.asarray(…, dtype=float)"
        )
    return np.asarray(array, dtype=np.float64, order="C")


def vector_of(name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Check the shape of parameters."""
    array = real_array(name, value)
    if array.ndim != len(shape) or any(
        wanted not in (-1, there) for wanted, there in zip(shape, array.shape, strict=True)
    ):
        needed = "(" + ", ".join("n" if n < 0 else str(n) for n in shape) + ")"
        raise DataError(f"{name}: has shape {array.shape} where {needed} is needed")
    return array


def pixels_of(
    name: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    masked: BoolArray,
    *,
    scalar: bool = False,
    least: float | None = None,
) -> FloatArray:
    """Check a number for each pixel."""
    array = real_array(name, value)
    if array.ndim == 0 and scalar:
        array = np.full(shape, float(array))
    if array.shape != shape:
        also = "one number or " if scalar else ""
        raise DataError(f"{name}: has shape {array.shape}; give {also}an array of shape {shape}")
    finite = np.isfinite(array)
    if not finite.all():
        if wrong := int(np.count_nonzero(~finite & ~masked)):
            raise DataError(
                f"{name}: is not finite in {count(wrong, 'pixel')}; mask them with masked=…"
            )
        array = np.where(finite, array, 0.0)
    if least is not None and np.any((array < least) & ~masked):
        raise DataError(f"{name} = {float(array.min()):g}: must be at least {least:g}")
    return array


def mask_of(value: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """Check a mask."""
    if value is None:
        return np.zeros(shape, dtype=np.bool_)
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise DataError(f"masked: holds {array.dtype}; give True where a pixel must not be used")
    if array.shape != shape:
        raise DataError(f"masked: has shape {array.shape}; give an array of shape {shape}")
    return array


def number_in(
    name: str,
    value: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float = LARGEST,
    whole: bool = False,
    what: str = "",
) -> float:
    """Check a single number."""
    try:
        array = real_array(name, value)
    except DataError:
        array = np.array(math.nan)
    number = math.nan if array.ndim or isinstance(value, (bool, np.bool_)) else float(array)
    low = -most if least is None else least
    if above is not None:
        low = max(low, math.nextafter(above, math.inf), above + 1 / LARGEST)
    if low <= number <= most and not (whole and number != round(number)):
        return number
    limit = "" if least is None else f" of at least {least:g}"
    if number > most:
        limit = f" of at most {most:g}"
    elif above is not None:
        limit = f" of at least {low:g}" if above < number < low else f" above {above:g}"
    what = what or ("whole number" if whole else "number")
    raise ConfigError(f"{name} = {shown(value)}: give one {what}{limit}")


def truth_in(name: str, value: Any) -> bool:
    """Check a boolean."""
    if not isinstance(value, (bool, np.bool_)):
        raise ConfigError(f"{name} = {shown(value)}: give True or False")
    return bool(value)


def choice_in(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check that a word is one of the allowed ones."""
    if not isinstance(value, str) or value not in choices:
        raise ConfigError(f"{name} = {shown(value)}: choose one of {', '.join(choices)}")


def path_in(name: str, value: Any) -> Path:
    """Check the path of a file or a folder."""
    if not isinstance(value, (str, Path)):
        raise ConfigError(f"{name} = {shown(value)}: give a path")
    return Path(value)


def shown(value: Any) -> str:
    """Shorten a value of any type to one line of a message."""
    if isinstance(value, float):
        return f"{value:g}"
    return " ".join(reprlib.repr(value).split())
