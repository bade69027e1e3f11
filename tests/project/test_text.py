"""Text from outside is shown by figures, pages, tables and terminals, and never takes effect."""

from __future__ import annotations

import io
import json
import tomllib

import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from iscat_analysis.text import (
    from_table,
    in_json,
    in_page,
    in_table,
    in_terminal,
    in_toml,
    printable,
)

FORMULAE = ["=1+1", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "＝1+1", "-inf"]
EVERY = st.text(st.characters(exclude_categories=()), max_size=12)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202egpj.exe", r"\u202egpj.exe"),
        ("a\udcff", r"a\udcff"),
        ("a\rb\u2028c", r"a\rb\u2028c"),
        ("Ünïcödé – 粒子 🔬\tµm\n", "Ünïcödé – 粒子 🔬\tµm\n"),
    ],
)
def test_what_a_terminal_would_act_on_is_written_as_an_escape(text: str, shown: str) -> None:
    assert in_terminal(text) == in_page(text) == shown


@settings(deadline=None, derandomize=True)
@given(st.lists(EVERY, min_size=1, max_size=4))
@example(FORMULAE)
@example([f"'{text}" for text in FORMULAE])
@example(["-1.5", "+2", "1e5", "", "'", "plain"])
def test_a_table_holds_no_formula_and_reads_back(texts: list[str]) -> None:
    table = pd.DataFrame({"=name": pd.Series(texts, dtype=object), "x": -1.0})
    made = in_table(table)
    for text in [*made.iloc[:, 0], *made.columns]:
        assert not text.startswith(tuple("=+-@\t\r＝＋－＠")) or float(text) == float(text)
        text.encode("utf-8")
    back = from_table(made)
    assert list(back.columns) == ["=name", "x"]
    assert list(back.iloc[:, 0]) == [printable(text) for text in texts]
    assert list(back["x"]) == list(made["x"]) == [-1.0] * len(texts)


def test_a_column_without_a_text_keeps_its_kind() -> None:
    table = pd.DataFrame({"why": pd.Series([None, None], dtype=object), "x": [1, 2]})
    for made in (in_table(table), from_table(table)):
        assert list(made.dtypes) == list(table.dtypes)


def test_numbers_are_written_as_numbers() -> None:
    table = pd.DataFrame({"a": [-1.5, 2.0], "b": ["-1.5", "=2"], "c": [-1, None]})
    file = io.StringIO(in_table(table).to_csv(index=False))
    assert file.getvalue() == "a,b,c\n-1.5,-1.5,-1.0\n2.0,'=2,\n"


@given(EVERY)
@example('\x7f\x9b\u202e"\\\n\t')
def test_json_and_toml_mean_the_same_text(text: str) -> None:
    document = in_json(json.dumps({"name": text}, ensure_ascii=False))
    assert json.loads(document) == {"name": text}
    assert in_terminal(document) == document
    assert tomllib.loads(f"name = {in_toml(text)}") == {"name": printable(text)}
