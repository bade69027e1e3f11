"""What the tabs are made of: fields, figures, pictures with rings, and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from iscat_analysis.records import FloatArray
from iscat_analysis.report.vega import VegaFigure, configuration, records
from iscat_analysis.units import cells

BLUE, RED, GREY, ORANGE, YELLOW = "#0072B2", "#D55E00", "#8A8F96", "#E69F00", "#F0E442"
_GREYS = (0xFF000000 + 0x010101 * np.arange(256)).astype(np.uint32)  # opaque


def number(label: str, value: float | None, width: int, *, start: float | None = None) -> Any:
    """Make a field for a number."""
    return pn.widgets.FloatInput(label=label, value=value, start=start, width=width)


def wide_pane() -> Any:
    """Make an empty place for HTML, as wide as the page."""
    return pn.pane.HTML("", sizing_mode="stretch_width")


def in_line(*parts: Any) -> pn.FlexBox:
    """Put widgets beside each other, on one base line; where the page is narrow, below."""
    return pn.FlexBox(*parts, align_items="end", sizing_mode="stretch_width")


def source(*columns: str) -> ColumnDataSource:
    """Make an empty source of data."""
    return ColumnDataSource({name: [] for name in columns})


def plot(size_px: tuple[int, int], axes: tuple[str, str], tools: str = "") -> Any:
    """Make an empty figure with names of its axes."""
    (width, height), (x, y) = size_px, axes
    made = figure(width=width, height=height, x_axis_label=x, y_axis_label=y, tools=tools)
    made.toolbar.logo = None
    return made


def given(name: str) -> str:
    """Read a part of the page's address."""
    values = pn.state.session_args.get(name) or [b""]
    return str(values[0], "utf-8", "replace")


def clickable(figure: VegaFigure, field: str) -> VegaFigure:
    """Let somebody click the points of a figure, which says the value of their field."""
    pick = {"name": "pick", "select": {"type": "point", "fields": [field], "nearest": True}}
    layers = [
        {**one, "params": [pick]} if one.get("name") == "point" else one
        for one in figure.specification["layer"]
    ]
    return replace(figure, specification={**figure.specification, "layer": layers})


class Drawn(pn.pane.Vega):
    """A figure of one of the specifications, and what somebody drags over it or clicks in it.

    `names` are the selections of its specification.  Panel would ask the browser for them before
    the figure is drawn, cannot clear that of a click, and keeps the rows of the figure before.
    """

    def __init__(self, names: Sequence[str] = (), dragged: Callable[[str, Any], None] = print):
        self._names, self._dragged = names, dragged
        theme = "dark" if given("theme") == "dark" else None
        super().__init__(None, debounce=150, visible=False, theme=theme)

    def draw(self, figure: VegaFigure | None) -> None:
        """Show a figure; nothing where there is none."""
        self.visible = figure is not None
        if figure is None:
            return
        sets = {name: records(columns) for name, columns in figure.data.items()}
        fast = max(map(len, sets.values()), default=0) > 1500
        how = {"embedOptions": {"renderer": "canvas" if fast else "svg"}}
        config = configuration()
        if self.theme:  # which has its own colours of letters and lines
            config = {k: config[k] for k in ("background", "font", "view", "axisX")}
            config["text"] = {"color": "#ccc"}
        whole = {**figure.specification, "config": config, "usermeta": how}
        if whole.get("width") == "container":
            whole["width"] = 580
        self.object = {**whole, "datasets": sets}

    @property
    def _selections(self) -> dict[str, str]:
        return dict.fromkeys(self._names, "interval")

    def _get_sources(self, *_: Any) -> dict[str, Any]:
        return {}

    def _process_event(self, event: Any) -> None:
        self._dragged(event.data["type"], event.data["value"])


class Picture:
    """A picture of the field, and rings around what was found there."""

    def __init__(self, side_px: int, tools: str = "") -> None:
        self._side_px, self.sent = side_px, 0
        nothing = {"image": [np.zeros((2, 2), np.uint32)], "sent": [0], "dw": [1.0], "dh": [1.0]}
        self.data = ColumnDataSource(nothing)
        self._rings = source("x", "y", "colour", "text")
        self._x, self._y = Range1d(0, 1), Range1d(1, 0)
        self.figure = plot((side_px, side_px), ("x [px]", "y [px]"), tools)
        self.figure.update(x_range=self._x, y_range=self._y)
        self.figure.grid.visible = False
        # Coloured here, which is a tenth of the work that it is in the browser.
        self.figure.image_rgba(image="image", x=0, y=0, dw="dw", dh="dh", source=self.data)
        ring = {"fill_color": None, "line_color": "colour", "line_width": 2, "size": 22}
        self.figure.scatter("x", "y", source=self._rings, **ring)
        word = {"text_color": "colour", "text_font_size": "11px", "x_offset": 12, "y_offset": -8}
        self.figure.text("x", "y", text="text", source=self._rings, **word)

    def fit(self, rows: int, columns: int, pixel: float = 1.0) -> None:
        """Make room for pictures of a shape, whose pixels have a width in units of the axes."""
        width, height = columns * pixel, rows * pixel
        self._x.update(start=0, end=width, reset_start=0, reset_end=width)
        self._y.update(start=height, end=0, reset_start=height, reset_end=0)
        side = self._side_px / max(rows, columns)
        self.figure.update(width=round(columns * side) + 80, height=round(rows * side) + 50)

    def show(self, image: FloatArray, low: float, high: float, pixel: float = 1.0) -> None:
        """Send a picture to the browser, black and white at two values."""
        scaled = np.nan_to_num(np.clip((image - low) * (255.0 / (high - low)), 0, 255))
        rows, columns = image.shape
        self.sent += 1
        self.data.data = {
            "image": [_GREYS[scaled.astype(np.uint8)]],
            "sent": [self.sent],
            "dw": [columns * pixel],
            "dh": [rows * pixel],
        }

    def ring(self, rings: Sequence[tuple[float, float, str, str]], pixel: float = 1.0) -> None:
        """Ring places [px] in a colour, with a text beside each."""
        x, y, colours, texts = zip(*rings, strict=True) if rings else ((), (), (), ())
        data = {
            "x": [(place + 0.5) * pixel for place in x],
            "y": [(place + 0.5) * pixel for place in y],
            "colour": list(colours),
            "text": list(texts),
        }
        if data != self._rings.data:
            self._rings.data = data


def table_of(rows: Iterable[tuple[str, ...]], head: tuple[str, ...] = ()) -> str:
    """Write a table as HTML; its cells are text."""

    def line(words: tuple[str, ...], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(word)}</{tag}>" for word in words) + "</tr>"

    top = f"<thead>{line(head, 'th')}</thead>" if head else ""
    body = "".join(line(row, "td") for row in rows)
    return f'<div style="overflow-x: auto"><table>{top}<tbody>{body}</tbody></table></div>'


def listing(records: Iterable[Mapping[str, Any]], heading: str, row: str) -> str:
    """Write records as a table in HTML: headings between bars, and formats as in `cells`."""
    return table_of(cells(records, row), tuple(heading.split(" | ")))


def lines(texts: Iterable[str]) -> str:
    """Write texts below each other in HTML."""
    return table_of((text,) for text in texts)
