"""Tables of text, as spreadsheets save them."""

from __future__ import annotations

_SEPARATORS = ",;\t"


def without_remarks(text: str) -> list[str]:
    """Leave out empty lines and those that begin with ``#``."""
    return [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]


def separator(text: str) -> str:
    r"""Find what separates the cells of a table.

    Examples
    --------
    >>> separator("# of Monday\npath;buffer, pH;concentration_nm\na.tif;PBS, 7.4;10\n")
    ';'
    """
    heading = next(iter(without_remarks(text)), "")
    return max(_SEPARATORS, key=heading.count)


def decimal_mark(between: str) -> str:
    """Give what stands before the decimals of a table's numbers."""
    return "." if between == "," else ","
