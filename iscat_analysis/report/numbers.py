"""Numbers, units and names as people read them."""

from __future__ import annotations

import math
from collections.abc import Iterable

LABELS = {"x_nm": "x", "y_nm": "y", "z_nm": "z", "mass_kda": "mass"}
"""What the parameters are called in print."""

UNITS = {"x_nm": "nm", "y_nm": "nm", "z_nm": "nm", "mass_kda": "kDa"}
"""Their units."""


def number(value: float | None, digits: int = 3) -> str:
    """Write a number for people."""
    if value is None or not math.isfinite(value):
        return "—"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa}×10{raised}".replace("-", "−")
    decimals = 0 if value == 0 else max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def decimals_for(errors: Iterable[float | None], digits: int = 2) -> int:
    """Give the decimals with which a column of numbers lines up."""
    known = [abs(e) for e in errors if e is not None and math.isfinite(e) and e != 0]
    return min(8, max(0, digits - 1 - math.floor(math.log10(min(known))))) if known else 2


def fixed(value: float | None, decimals: int) -> str:
    """Write a number with so many decimals."""
    if value is None or not math.isfinite(value):
        return "—"
    return f"{value:z.{decimals}f}".replace("-", "−")


def percent(value: float) -> str:
    """Write a share as a percentage with two digits; a dash for NaN."""
    return "—" if not math.isfinite(value) else f"{number(100 * value, 2)} %"
