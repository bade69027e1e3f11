"""Events that somebody rejected by hand: a list beside the result, which anyone can read."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file

COLUMNS = ("event", "frame", "x_px", "y_px", "mass_kda", "rejected_at")
"""Columns of the list: what the event was, so that a new analysis does not reject another."""

_NEAR_PX = 1.0


class Rejections:
    """The rejected events of one result."""

    def __init__(self, result: Path) -> None:
        self.path = result.with_name(f"{result.name}.rejected.csv")
        try:
            self.rows = pd.read_csv(self.path)
        except FileNotFoundError:
            self.rows = pd.DataFrame(columns=list(COLUMNS))
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path}: cannot be read ({error}); move it away") from None
        if not set(COLUMNS) <= set(self.rows.columns):
            raise DataError(f"{self.path}: is no list of rejected events; move it away")

    def events(self, table: pd.DataFrame) -> set[int]:
        """Give the numbers of rejected events that are still those of the table."""
        found = set()
        known = table.set_index("event")
        for row in self.rows.to_dict("records"):
            if row["event"] in known.index:
                now = known.loc[row["event"]]
                near = abs(now["x_px"] - row["x_px"]) + abs(now["y_px"] - row["y_px"]) < _NEAR_PX
                if near and now["frame"] == row["frame"]:
                    found.add(int(row["event"]))
        return found

    def lost(self, table: pd.DataFrame) -> int:
        """Count the rejected events that this table does not have."""
        return len(self.rows) - len(self.events(table))

    def reject(self, rows: pd.DataFrame) -> None:
        """Put events on the list."""
        new = rows[[c for c in COLUMNS if c in rows]].assign(
            rejected_at=datetime.now(UTC).isoformat(timespec="seconds")
        )
        new = new[~new["event"].isin(self.rows["event"])]
        self.rows = new if self.rows.empty else pd.concat([self.rows, new], ignore_index=True)
        self._write()

    def take_back(self, events: set[int]) -> None:
        """Take events off the list."""
        self.rows = self.rows[~self.rows["event"].isin(events)]
        self._write()

    def _write(self) -> None:
        with whole_file(self.path) as partial:
            self.rows.to_csv(partial, index=False)
