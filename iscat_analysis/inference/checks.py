"""What every argument must be: real numbers, of the right shape, finite, of a possible size.

Kernels read memory without asking.  Each array is therefore looked at once, where it enters.
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
from iscat_analysis.units import count

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LARGEST = 1e15
"""No mass [kDa], light [e] or number of frames is larger; the square of one is still a number."""


def array_of(name: str, value: ArrayLike) -> NDArray[Any]:
    """Turn an argument into an array of whatever type it is.

    Parameters
    ----------
    name : str
        What messages call it.
    value : array_like
        Anything regular.

    Returns
    -------
    ndarray
        The same.

    Raises
    ------
    DataError
        Its rows have different lengths.
    """
    try:
        return np.asarray(value)
    except ValueError:
        raise DataError(f"{name}: its rows have different lengths; give a regular array") from None


def real_array(name: str, value: ArrayLike) -> FloatArray:
    """Turn an argument into 64-bit floats.

    Parameters
    ----------
    name : str
        What messages call it.
    value : array_like
        Integers or floats of any width; integers are converted before anything is added to them,
        so that nothing wraps.

    Returns
    -------
    ndarray of float64
        Contiguous, of the same shape.

    Raises
    ------
    DataError
        It does not hold real numbers, or not at all of its places.
    """
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
    """Check the shape of parameters.

    Parameters
    ----------
    name : str
        What messages call it.
    value : array_like
        Parameters; NaN and infinities are left for the caller to judge.
    shape : tuple of int
        Needed; −1 where any length will do.

    Returns
    -------
    ndarray of float64
        Contiguous, of that shape.

    Raises
    ------
    DataError
        It has another shape or does not hold real numbers.
    """
    array = real_array(name, value)
    if array.shape == shape:
        return array
    fits = array.ndim == len(shape) and all(
        wanted in (-1, there) for wanted, there in zip(shape, array.shape, strict=True)
    )
    if not fits:
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
    """Check a number for each pixel.

    Parameters
    ----------
    name : str
        What messages call it.
    value : array_like
        One number for each pixel.
    shape : tuple of int
        Of the pixels.
    masked : ndarray of bool, shape `shape`
        Pixels whose value does not matter; it becomes 0 unless it is finite.
    scalar : bool
        Whether one number for all pixels will do.
    least : float, optional
        Smallest value allowed.

    Returns
    -------
    ndarray of float64, shape `shape`
        Finite throughout.

    Raises
    ------
    DataError
        It has another shape, does not hold real numbers, or is not finite where not masked.
    """
    array = real_array(name, value)
    if array.ndim == 0 and scalar:
        array = np.full(shape, float(array))
    if array.shape != shape:
        also = "one number or " if scalar else ""
        raise DataError(f"{name}: has shape {array.shape}; give {also}an array of shape {shape}")
    finite = np.isfinite(array)
    if not finite.all():
        wrong = int(np.count_nonzero(~finite & ~masked))
        if wrong:
            raise DataError(
                f"{name}: is not finite in {count(wrong, 'pixel')}; mask them with masked=…"
            )
        array = np.where(finite, array, 0.0)
    if least is not None and np.any((array < least) & ~masked):
        raise DataError(f"{name} = {float(array.min()):g}: must be at least {least:g}")
    return array


def mask_of(name: str, value: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """Check a mask.

    Parameters
    ----------
    name : str
        What messages call it.
    value : array_like of bool, or None
        True where a pixel must not be used; None masks nothing.
    shape : tuple of int
        Of the pixels.

    Returns
    -------
    ndarray of bool, shape `shape`
        The mask.

    Raises
    ------
    DataError
        It has another shape or is not of truth values.
    """
    if value is None:
        return np.zeros(shape, dtype=np.bool_)
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise DataError(f"{name}: holds {array.dtype}; give True where a pixel must not be used")
    if array.shape != shape:
        raise DataError(f"{name}: has shape {array.shape}; give an array of shape {shape}")
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
    """Check a single number.

    Parameters
    ----------
    name : str
        What messages call it.
    value : Any
        The number.
    least : float, optional
        Smallest that is possible.
    above : float, optional
        In place of `least`: what it must exceed.
    most : float
        Largest that is possible.
    whole : bool
        Whether it counts something.
    what : str
        What it is a number of, for the message; default a number.

    Returns
    -------
    float
        The number.

    Raises
    ------
    ConfigError
        It is not such a number.
    """
    try:
        array = real_array(name, value)
    except DataError:
        array = np.array(math.nan)
    number = math.nan if array.ndim or isinstance(value, (bool, np.bool_)) else float(array)
    low = -most if least is None else least
    if above is not None:
        low = math.nextafter(above, math.inf)
    if low <= number <= most and not (whole and number != round(number)):
        return number
    limit = f" of at least {least:g}" if least is not None else ""
    limit = f" above {above:g}" if above is not None else limit
    limit = f" of at most {most:g}" if number > most else limit
    what = what or ("whole number" if whole else "number")
    raise ConfigError(f"{name} = {shown(value)}: give one {what}{limit}")


def truth_in(name: str, value: Any) -> bool:
    """Check an answer to yes or no.

    Parameters
    ----------
    name : str
        What messages call it.
    value : Any
        The answer.

    Returns
    -------
    bool
        The answer.

    Raises
    ------
    ConfigError
        It is neither True nor False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ConfigError(f"{name} = {shown(value)}: give True or False")
    return bool(value)


def choice_in(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check that a word is one of those that have a meaning.

    Parameters
    ----------
    name : str
        What messages call it.
    value : Any
        The word.
    choices : sequence of str
        Which there are.

    Raises
    ------
    ConfigError
        It is none of them.
    """
    if not isinstance(value, str) or value not in choices:
        raise ConfigError(f"{name} = {shown(value)}: choose one of {', '.join(choices)}")


def path_in(name: str, value: Any) -> Path:
    """Check the path of a file or a folder.

    Parameters
    ----------
    name : str
        What messages call it.
    value : Any
        The path.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ConfigError
        It is neither text nor a path.
    """
    if not isinstance(value, (str, Path)):
        raise ConfigError(f"{name} = {shown(value)}: give a path")
    return Path(value)


def shown(value: Any) -> str:
    """Write a value of any type into a message, in one line and not at length.

    Parameters
    ----------
    value : Any
        What was given.

    Returns
    -------
    str
        Its beginning and its end.
    """
    if isinstance(value, float):
        return f"{value:g}"
    return " ".join(reprlib.repr(value).split())
