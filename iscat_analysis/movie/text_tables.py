"""Tables of text, as spreadsheets save them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from iscat_analysis.errors import DataError

_SEPARATORS = ",;\t"


def without_remarks(text: str) -> list[str]:
    """Drop empty lines and comments, which begin with ``#``."""
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


def refuse_twice(names: Sequence[object], used: Collection[str], table: object) -> None:
    """Refuse two columns of one name, of which only one can be meant."""
    for name in used:
        if list(names).count(name) > 1:
            raise DataError(
                f"{table}: has two columns of the name {name}, and only one can be meant; rename "
                "the other"
            )


def decimal_mark(between: str) -> str:
    """Find the decimal mark of a table's numbers."""
    return "." if between == "," else ","
