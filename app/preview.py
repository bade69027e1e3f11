"""What the search would find with the values of the form, in the frame that Look shows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import panel as pn
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d
from bokeh.palettes import gray
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_app.chosen import Chosen, Notice

_SIDE_PX = 380
_ENDS = (0.005, 0.995)  # quantiles that are black and white


class DetectionPreview:
    """A picture that follows the form."""

    def __init__(self, chosen: Chosen, notice: Notice) -> None:
        self._chosen, self._notice = chosen, notice
        self._config: ia.Config | None = None
        self.asked = pn.widgets.Checkbox(label="Show what the search finds with these values")
        self._image = ColumnDataSource({"image": [], "dw": [], "dh": []})
        self._rings = ColumnDataSource({"x": [], "y": [], "text": []})
        self._grey = LinearColorMapper(palette=gray(256), low=0, high=1)
        self._x, self._y = Range1d(0, 1), Range1d(1, 0)
        self._plot = figure(
            width=_SIDE_PX, height=_SIDE_PX, x_range=self._x, y_range=self._y, tools="",
            toolbar_location=None, x_axis_label="x [px]", y_axis_label="y [px]",
        )  # fmt: skip
        self._plot.grid.visible = False
        self._plot.image(
            image="image", x=0, y=0, dw="dw", dh="dh", source=self._image, color_mapper=self._grey
        )
        self._plot.scatter(
            "x", "y", source=self._rings, size=22, line_color="#F0E442", line_width=2,
            fill_color=None,
        )  # fmt: skip
        self._plot.text(
            "x", "y", text="text", source=self._rings, text_color="#F0E442", x_offset=12,
            y_offset=-8, text_font_size="11px",
        )  # fmt: skip
        self._said = pn.pane.HTML("", width=_SIDE_PX)
        self._shown = pn.Column(pn.pane.Bokeh(self._plot), self._said, visible=False)
        self.asked.param.watch(lambda _: self.follow(self._config), "value")
        self.body = pn.Column(self.asked, self._shown)

    def follow(self, config: ia.Config | None) -> None:
        """Search with a configuration, if somebody wants to see that; without one, wait for it."""
        self._config, movie = config, self._chosen.movie
        self._shown.visible = self.asked.value
        if not self.asked.value or config is None or movie is None:
            return
        frame = self._chosen.view
        self._notice.latest(
            "Searching", lambda: _looked(movie, config, frame), lambda found: self._show(*found)
        )

    def _show(self, look: ia.Look, found: pd.DataFrame) -> None:
        seen = look.image[np.isfinite(look.image)]
        if seen.size:
            low, high = np.quantile(seen, _ENDS)
            self._grey.update(low=float(low), high=float(max(high, np.nextafter(low, math.inf))))
        rows, columns = look.image.shape
        self._x.end, self._y.start = columns, rows
        self._image.data = {"image": [look.image], "dw": [columns], "dh": [rows]}
        self._rings.data = {
            "x": found["x_px"] + 0.5,
            "y": found["y_px"] + 0.5,
            "text": [f"{snr:.1f} σ" for snr in found["snr"]],
        }
        first, stop = look.after
        self._said.object = (
            f"<p>{len(found)} above {look.threshold:.2f} times the noise, in frames {first} to "
            f"{stop - 1}; Look chooses the frame.</p>"
        )


def _looked(movie: Path, config: ia.Config, frame: int | None) -> tuple[ia.Look, pd.DataFrame]:
    """Measure camera and noise and search, as the analysis would."""
    with ia.open_stack(movie) as stack:
        preview = ia.Preview(stack, config)
        look = preview.look(sum(preview.frames) // 2 if frame is None else frame)
        return look, look.found()
