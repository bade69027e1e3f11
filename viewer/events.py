"""One event: its numbers, and data, model and residual."""

from __future__ import annotations

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
        (name, number), *rest = result.facts(row)
        text = "<br>".join([f"<b>{name} {number}</b>", *(f"{what} {said}" for what, said in rest)])
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
