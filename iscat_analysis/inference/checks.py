"""What every array must be before a kernel reads it: real numbers, of the right shape, finite.

Kernels read memory without asking.  Each array is therefore looked at once, where it enters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.units import count

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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
    try:
        array: NDArray[Any] = np.asarray(value)
    except ValueError:
        raise DataError(f"{name}: its rows have different lengths; give a regular array") from None
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
