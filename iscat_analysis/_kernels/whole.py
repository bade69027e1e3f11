"""Numbers that become indices.

Kernels read memory without asking whether it is theirs, and an integer made of a number that is too
large, or of none, is any integer.  Whatever is computed from data becomes an index here alone.
"""

from __future__ import annotations

from iscat_analysis._kernels import kernel


@kernel(_nrt=False)
def within(x: float, low: float, high: float) -> float:
    """Clip a number to a range; `low` in place of one that is not a number."""
    if not x > low:
        return low
    if x > high:
        return high
    return x


@kernel(_nrt=False)
def whole(x: float, low: int, high: int) -> int:
    """Give the integer part of a number, clipped to a range; `low` where it is not a number."""
    return int(within(x, float(low), float(high)))
