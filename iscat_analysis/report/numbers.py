"""Numbers, units and names as people read them, and the tables that are made of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

LABELS = {"x_nm": "x", "y_nm": "y", "z_nm": "z", "mass_kda": "mass", "diameter_nm": "diameter"}
"""What the parameters are called in print."""

UNITS = {"x_nm": "nm", "y_nm": "nm", "z_nm": "nm", "mass_kda": "kDa", "diameter_nm": "nm"}
"""Their units."""


@dataclass(frozen=True)
class Fact:
    """A large number of a page, or the values of all species, with its name and unit."""

    label: str
    value: str
    unit: str = ""
    note: str = ""

    @property
    def text(self) -> str:
        """Everything in a line."""
        value = f"{self.label} {self.value} {self.unit}".rstrip()
        return f"{value}, {self.note}" if self.note else value


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, and how its cells are made of a row's record."""

    label: str
    cell: Callable[[Any], Any]
    title: str = ""
    numeric: bool = False


@dataclass(frozen=True)
class Table:
    """A table of a page; cells are text, numbers, or nothing, which is a dash."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    sortable: bool = True
    tall: bool = False


Cell = str | int | Callable[[Any], Any]


def worded(label: str, cell: Cell, title: str = "") -> Column:
    """Make a column of words; `cell` is the key of a record, or a function of it."""
    return Column(label, cell if callable(cell) else itemgetter(cell), title)


def numeric(label: str, cell: Cell, title: str = "") -> Column:
    """Make a column of numbers."""
    return replace(worded(label, cell, title), numeric=True)


def intervals(
    label: str,
    name: str,
    ends: tuple[str, str] | None = None,
    *,
    in_percent: bool = False,
    title: str = "",
) -> tuple[Column, Column]:
    """Make the columns of a number and its interval, whose keys differ in ``_low`` and ``_high``.

    Units at the end of `name` are not in the names of the ends.
    """
    stem = name.removesuffix("_kda").removesuffix("_nm")
    scale, unit = (100, " %") if in_percent else (1, "")

    def cells(record: Any) -> tuple[str, str]:
        found = (record[key] for key in (name, *(ends or (f"{stem}_low", f"{stem}_high"))))
        return with_interval(*(None if v is None else scale * v for v in found), unit=unit)

    return (
        numeric(label, lambda record: cells(record)[0], title),
        numeric("95 %", lambda record: cells(record)[1]),
    )


def tabulate(records: Iterable[Any], columns: Sequence[Column], caption: str = "") -> Table:
    """Make a table with one row for each record."""
    rows = [[column.cell(record) for column in columns] for record in records]
    return Table(columns, rows, caption)


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


def of(key: str, write: Callable[..., Any] = number, *how: Any) -> Callable[[Any], Any]:
    """Make the cell that writes what a record has under a key, nothing if it lacks the key."""
    return lambda record: write(record.get(key), *how)


def decimals_for(errors: Iterable[float | None], digits: int = 2) -> int:
    """Give the decimals with which a column of numbers lines up."""
    known = [abs(e) for e in errors if e is not None and math.isfinite(e) and e != 0]
    return min(8, max(0, digits - 1 - math.floor(math.log10(min(known))))) if known else 2


def fixed(value: float | None, decimals: int) -> str:
    """Write a number with so many decimals."""
    if value is None or not math.isfinite(value):
        return "—"
    return f"{value:z.{decimals}f}".replace("-", "−")


def percent(value: float | None, decimals: int | None = None) -> str:
    """Write a share as a percentage, with two digits or so many decimals; a dash for NaN."""
    if value is None or not math.isfinite(value):
        return "—"
    return f"{number(100 * value, 2) if decimals is None else fixed(100 * value, decimals)} %"


def probability(p: float | None) -> str:
    """Write a p-value."""
    return number(p, 2) if p is None or not p < 1e-6 else "0.000001 or less"


def with_interval(
    value: float | None, low: float | None, high: float | None, *, unit: str = ""
) -> tuple[str, str]:
    """Write a number and its interval, with as many decimals as the interval supports."""
    if value is None or not math.isfinite(value):
        return "—", "—"
    if low is None or high is None or not math.isfinite(low + high):
        return f"{number(value)}{unit}", "—"
    decimals = decimals_for([(high - low) / 2])
    ends = f"{fixed(low, decimals)} to {fixed(high, decimals)}{unit}"
    return f"{fixed(value, decimals)}{unit}", ends


def with_error(value: float, sigma: float | None) -> str:
    """Write a value to the second significant digit of its standard deviation."""
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return number(value)
    decimals = decimals_for([sigma])
    return f"{fixed(value, decimals)} ± {fixed(sigma, decimals)}"


def bracketed(value: float | None, ends: Sequence[float | None]) -> str:
    """Write a number and its interval in one cell."""
    if value is None or not math.isfinite(value):
        return "—"
    return f"{number(value)} [{number(ends[0])}, {number(ends[1])}]"


def parameter(name: str) -> str:
    """Name a parameter with its unit."""
    return f"{LABELS[name]} [{UNITS[name]}]"


def sentence(words: str) -> str:
    """Begin with a capital letter, and end with a full stop."""
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."


def link(page: Any, name: str) -> str:
    """Make a link of a name, if there is a page."""
    if not isinstance(page, str) or not page:
        return name
    return Markup('<a href="{}">{}</a>').format(quote(page), name)


def unbroken(words: Any, longest: int = 28) -> Any:
    """Keep a short text on one line; a dash for none."""
    words = words or "—"
    if not isinstance(words, str) or len(words) > longest:
        return words
    return words.replace(" ", "\N{NO-BREAK SPACE}")


def plain(value: Any) -> Any:
    """Write a dash for an empty value, and a whole number as it is."""
    return "—" if value is None or value != value or value == "" else value
