"""The registry of columns, and the rows that are made from it."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.records import (
    EVENT_COLUMNS,
    EVENTS,
    FRAME_COLUMN,
    PARAMETERS,
    REPEAT_COLUMNS,
    TRACKS,
    make_rows,
)

LINE = {"frame": 7, "n_before": 3, "n_after": 4, "x_px": 1.5, "status": "ok", "flags": ""}


@pytest.mark.parametrize("columns", [EVENTS, TRACKS])
def test_every_column_is_named_once_and_described(columns) -> None:
    names = [column.name for column in columns]
    assert len(set(names)) == len(names)
    for column in columns:
        assert column.description
        assert "{" not in column.description
    assert (
        {f"repeat_{name}" for name in PARAMETERS}
        == set(REPEAT_COLUMNS)
        <= {column.name for column in EVENTS}
    )
    assert FRAME_COLUMN in {column.name for column in EVENTS}


def test_rows_have_the_order_and_the_types_of_the_registry() -> None:
    table = make_rows([{FRAME_COLUMN: 2} | LINE], {"event": range(1), "systematic_z_nm": [0.5]})
    assert list(table) == [*EVENT_COLUMNS, "systematic_z_nm", FRAME_COLUMN]
    types = {column.name: column.dtype for column in EVENTS}
    assert {name: str(kind) for name, kind in table.dtypes.items()} == {
        name: types[name] for name in table
    }
    assert np.isnan(table.loc[0, "mass_kda"])


def test_a_row_has_its_number_once_it_is_given() -> None:
    lines = make_rows([LINE, LINE])
    assert list(lines) == list(EVENT_COLUMNS[1:])
    assert list(make_rows(lines, {"event": [4, 5]})["event"]) == [4, 5]


def test_whole_numbers_that_a_row_lacks_stay_empty() -> None:
    table = make_rows([LINE | {"frame": None}, LINE | {"track": 4}])
    assert [str(table[name].dtype) for name in ("frame", "track", "n_before")] == ["Int64"] * 2 + [
        "int64"
    ]
    assert list(table["track"].isna()) == [True, False]
    assert table.loc[1, "track"] == 4


def test_a_column_that_is_not_registered_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no column of fits\.csv: colour"):
        make_rows([LINE | {"colour": 3.0}])
