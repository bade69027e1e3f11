"""Text from outside, such as names of files and samples, made harmless where it is shown.

A name may hold characters that a terminal, a spreadsheet or XML would act on.  For each
place where text is shown there is one function.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sized
from dataclasses import fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_LONGEST = 60  # characters of a value in `brief`
_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # control characters, but not tabs and ends of lines
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # marks that turn the direction of text
    "\u2028\u2029\ufeff\ufffe\uffff\ud800-\udfff]"  # further ends of lines; what is no character
)
_FORMULA = re.compile("'*[=+\\-@\t\r＝＋－＠]")
_QUOTED = re.compile("'+[=+\\-@\t\r＝＋－＠]")


def printable(text: str) -> str:
    """Escape the bytes of a file name that are not text, which no file in UTF-8 can hold."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def in_terminal(text: str) -> str:
    """Write control characters, marks of direction and bytes that are no text as escapes."""
    return _UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


def in_page(text: str) -> str:
    """Do the same in HTML or XML, whose own signs are escaped where a text is put in."""
    return in_terminal(text)


def in_json(document: str) -> str:
    """Escape in a JSON document what `in_terminal` does; it means the same."""
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", document)


def in_toml(text: str) -> str:
    """Write a text as a string of TOML, quotation marks and all."""
    return in_json(json.dumps(printable(text), ensure_ascii=False))


def in_table(table: pd.DataFrame) -> pd.DataFrame:
    """Put an apostrophe before each text that a spreadsheet would take for a formula.

    Source: OWASP, "CSV injection".  Numbers stay as they are; `from_table` takes it away again.
    """
    return _with_texts(table, _quoted)


def from_table(table: pd.DataFrame) -> pd.DataFrame:
    """Give a table with the texts that `in_table` was given."""
    return _with_texts(table, lambda text: text[1:] if _QUOTED.match(text) else text)


def _with_texts(table: pd.DataFrame, change: Callable[[str], str]) -> pd.DataFrame:
    """Change the texts of a table, and the names of its columns."""

    def changed(cell: Any) -> Any:
        return change(cell) if type(cell) is str else cell

    made = table.rename(columns=changed)
    for place, kind in enumerate(table.dtypes):
        if kind.kind == "O":
            made.isetitem(place, table.iloc[:, place].map(changed).astype(kind))
    return made


def _quoted(text: str) -> str:
    text = printable(text)
    return f"'{text}" if _FORMULA.match(text) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def brief(record: Any) -> str:
    """Write a record for a notebook: arrays and tables by their shape, what is long by its type."""
    parts = []
    for field in fields(record):
        value = getattr(record, field.name)
        text = repr(value) if not hasattr(value, "shape") else ""
        if not text:
            text = f"<{type(value).__name__} {' × '.join(map(str, value.shape))}>"
        elif len(text) > _LONGEST or "\n" in text:
            number = f" of {len(value)}" if isinstance(value, Sized) else ""
            text = f"<{type(value).__name__}{number}>"
        if not field.name.startswith("_"):
            parts.append(f"{field.name}={text}")
    return f"{type(record).__name__}({', '.join(parts)})"
