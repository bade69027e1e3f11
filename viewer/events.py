"""One event: its numbers, and data, model and residual."""

from __future__ import annotations

import math

import pandas as pd
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QGroupBox, QLabel, QVBoxLayout, QWidget

import iscat_analysis as ia

_HEIGHT_PX, _DPI = 200, 72  # the figure is made for a page, and a dock is narrow


class EventPanel(QGroupBox):
    """Shows a row of a result."""

    def __init__(self) -> None:
        super().__init__("Event")
        self.facts = QLabel("click an event of a result")
        self.facts.setWordWrap(True)
        self.facts.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.canvas: QWidget | None = None
        self._inside = QVBoxLayout(self)
        self._inside.addWidget(self.facts)
        self._inside.addStretch(1)

    def show_row(self, result: ia.StoredResult, row: int) -> None:
        """Show a row of a result; where there are no images, say why."""
        if self.canvas is not None:
            self._inside.removeWidget(self.canvas)
            self.canvas.deleteLater()
            self.canvas = None
        text = facts_of(result.table.iloc[row])
        try:
            figure = result.view(row)
        except ia.IscatError as error:
            self.facts.setText(f"{text}<br>{error}")
            return
        self.facts.setText(text)
        figure.set_dpi(_DPI)
        self.canvas = FigureCanvasQTAgg(figure)  # type: ignore[no-untyped-call]
        self.canvas.setMinimumHeight(_HEIGHT_PX)
        self._inside.insertWidget(1, self.canvas, 1)


def facts_of(row: pd.Series) -> str:
    """Write the numbers of an event."""
    kind = "leaves" if row["mass_kda"] < 0 else "frame"
    named = f"event {row['event']}"
    if "track" in row and pd.notna(row["track"]):
        named = f"track {int(row['track'])}"
    lines = [f"<b>{named}</b>, {kind} {row['frame']}"]
    for name, label, unit, digits in (
        ("mass_kda", "mass", "kDa", 1), ("x_nm", "x", "nm", 1), ("y_nm", "y", "nm", 1),
        ("z_nm", "z", "nm", 1),
    ):  # fmt: skip
        sigma = row[f"sigma_{name}"]
        error = f" ± {sigma:.{digits}f}" if math.isfinite(sigma) else ""
        lines.append(f"{label} {row[name]:.{digits}f}{error} {unit}")
    lines.append(f"contrast {100 * row['contrast']:.3f} %, SNR {row['snr']:.1f}")
    status = ia.Status(row["status"])
    lines.append(f"{status.value}: {status.advice}")
    return "<br>".join(lines)
