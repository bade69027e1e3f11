"""What stands in the cells of a batch's tables."""

from __future__ import annotations

import math
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from iscat_analysis.report.numbers import decimals_for, fixed, number

_SHORT_NAME = 28  # characters


def link(page: Any, name: str) -> str:
    """Make a name a link, where there is a page.

    Parameters
    ----------
    page : str or None
        Its address, relative to this one.
    name : str
        What is shown.

    Returns
    -------
    str or Markup
        The name, as a link where there is a page.
    """
    if not isinstance(page, str) or not page:
        return name
    return Markup('<a href="{}">{}</a>').format(quote(page), name)


def with_interval(
    value: float | None, low: float | None, high: float | None, *, unit: str = ""
) -> tuple[str, str]:
    """Write a number, and its interval, with as many decimals as the interval supports.

    Parameters
    ----------
    value, low, high : float or None
        The number and the ends of its interval.
    unit : str
        Written after them.

    Returns
    -------
    (str, str)
        Two cells; a dash for what is not known.
    """
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
    """Write a p-value.

    Parameters
    ----------
    p : float
        May be unknown, as NaN.

    Returns
    -------
    str
        Two digits.
    """
    if not math.isfinite(p):
        return "—"
    return number(p, 2) if p >= 1e-6 else "0.000001 or less"


def percent(value: float | None) -> str:
    """Write a share in percent.

    Parameters
    ----------
    value : float or None
        Of the whole.

    Returns
    -------
    str
        A dash where it is not known.
    """
    return "—" if value is None or not math.isfinite(value) else f"{100 * value:.1f} %"


def share(part: float, whole: float) -> str:
    """Write a part of a whole in percent.

    Parameters
    ----------
    part, whole : float
        Numbers of the same kind.

    Returns
    -------
    str
        A dash where there is no whole.
    """
    return percent(part / whole) if whole and math.isfinite(whole) else "—"


def unbroken(text: Any, longest: int = _SHORT_NAME) -> Any:
    """Keep a short text in one line.

    Parameters
    ----------
    text : object
        Of a cell.
    longest : int
        Characters of a text that is short.

    Returns
    -------
    object
        The text without places to break it; what is long, or no text, as it was.
    """
    if not isinstance(text, str) or len(text) > longest:
        return text
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def whole(value: float) -> Any:
    """Give a number as a whole one.

    Parameters
    ----------
    value : float
        May be unknown, as NaN.

    Returns
    -------
    int or None
        None where it is not known.
    """
    return int(value) if value is not None and math.isfinite(value) else None


def plain(value: Any) -> Any:
    """Put a dash in place of what is empty.

    Parameters
    ----------
    value : object
        Of a cell.

    Returns
    -------
    object
        The same where there is something.
    """
    return "—" if value is None or value != value or value == "" else value
