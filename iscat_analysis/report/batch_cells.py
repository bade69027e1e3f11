"""Contents of the cells of a batch's tables."""

from __future__ import annotations

import math
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from iscat_analysis.report.numbers import decimals_for, fixed, number

_SHORT_NAME = 28  # characters


def link(page: Any, name: str) -> str:
    """Make a link of a name, if there is a page."""
    if not isinstance(page, str) or not page:
        return name
    return Markup('<a href="{}">{}</a>').format(quote(page), name)


def with_interval(
    value: float | None, low: float | None, high: float | None, *, unit: str = ""
) -> tuple[str, str]:
    """Write a number and its interval, with as many decimals as the interval supports."""
    if value is None or not math.isfinite(value):
        return "—", "—"
    known = low is not None and high is not None and math.isfinite(low) and math.isfinite(high)
    if not known or low is None or high is None:
        return f"{number(value)}{unit}", "—"
    decimals = decimals_for([(high - low) / 2])
    return (
        f"{fixed(value, decimals)}{unit}",
        f"{fixed(low, decimals)} to {fixed(high, decimals)}{unit}",
    )


def probability(p: float) -> str:
    """Write a p-value."""
    if not math.isfinite(p):
        return "—"
    return number(p, 2) if p >= 1e-6 else "0.000001 or less"


def percent(value: float | None) -> str:
    """Write a share in percent."""
    return "—" if value is None or not math.isfinite(value) else f"{100 * value:.1f} %"


def share(part: float, whole: float) -> str:
    """Write a part of a whole in percent."""
    return percent(part / whole) if whole and math.isfinite(whole) else "—"


def unbroken(text: Any, longest: int = _SHORT_NAME) -> Any:
    """Keep a short text on one line."""
    if not isinstance(text, str) or len(text) > longest:
        return text
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def whole(value: float) -> Any:
    """Round a number to an integer."""
    return int(value) if value is not None and math.isfinite(value) else None


def plain(value: Any) -> Any:
    """Write a dash for an empty value."""
    return "—" if value is None or value != value or value == "" else value
