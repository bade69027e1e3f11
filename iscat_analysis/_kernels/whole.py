"""Conversion of computed numbers to indices.

Kernels do not check array bounds, and the integer part of a number that is too large, or of NaN, is
undefined.  Only these functions convert numbers that depend on data to indices.
"""

from __future__ import annotations

from iscat_analysis._kernels import kernel


@kernel(_nrt=False)
def within(x: float, low: float, high: float) -> float:
    """Clip a number to a range; NaN becomes `low`."""
    if not x > low:
        return low
    if x > high:
        return high
    return x


@kernel(_nrt=False)
def whole(x: float, low: int, high: int) -> int:
    """Give the integer part of a number, clipped to a range; NaN becomes `low`."""
    return int(within(x, float(low), float(high)))
