"""The tables of the output folder: events, summary, configuration."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Any

import pandas as pd

from iscat_analysis.records import EVENT_COLUMNS, EVENTS, Analysis
from iscat_analysis.schemas import to_json

CSV_DIGITS = 9
"""Significant digits in ``fits.csv``: 0.1 pm in a field of 100 µm, with no digits of pure noise."""


def event_table(analysis: Analysis) -> pd.DataFrame:
    """Put the table of an analysis into the shape it is published in."""
    missing = [name for name in EVENT_COLUMNS if name not in analysis.table.columns]
    if missing and len(analysis.table):
        raise ValueError(f"analysis.table lacks the columns {', '.join(missing)}")
    further = [name for name in analysis.table.columns if name not in EVENT_COLUMNS]
    table = analysis.table.reindex(columns=[*EVENT_COLUMNS, *further]).reset_index(drop=True)
    kept = [column for column in EVENTS if not column.optional]
    for name in (column.name for column in kept if column.is_text):
        table[name] = [_text(value) for value in table[name]]
    return table.astype({column.name: column.dtype for column in kept})


def _text(value: Any) -> str:
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, str):
        return value
    if isinstance(value, (tuple, list)):
        return ";".join(_text(item) for item in value)
    return ""


def write_tables(analysis: Analysis, folder: Path) -> None:
    """Write ``fits.csv``, ``tracks.csv`` where there are tracks, both as Parquet, and the rest.

    The rest is ``summary.json``, ``config.toml``, and the response of a camera that is not linear.
    """
    tables = {"fits": event_table(analysis)}
    if analysis.tracks is not None:
        tables["tracks"] = analysis.tracks
    for name, table in tables.items():
        table.to_csv(
            folder / f"{name}.csv",
            index=False,
            float_format=f"%.{CSV_DIGITS}g",
            lineterminator="\n",
        )
        with (folder / f"{name}.parquet").open("wb") as file:  # pyarrow wants paths as text
            table.to_parquet(file, index=False)
    if analysis.response is not None:
        analysis.response.to_csv(
            folder / "response.csv",
            index=False,
            float_format=f"%.{CSV_DIGITS}g",
            lineterminator="\n",
        )
    summary = to_json("summary", analysis.summary)
    (folder / "summary.json").write_text(summary + "\n", encoding="utf-8")
    (folder / "config.toml").write_text(analysis.config_toml, encoding="utf-8")
