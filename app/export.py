"""Export: the figure, the table, and the command that does the same without the window."""

from __future__ import annotations

import io
import json
import shlex
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import pandas as pd
import panel as pn

import iscat_analysis as ia
from iscat_analysis.answers.gates import gate_rows
from iscat_analysis.config import config_to_toml
from iscat_analysis.movie import path_beside
from iscat_analysis.report.style import FONTS, PALETTES, Format, figure_bytes, histogram_figure
from iscat_app.chosen import Chosen, Notice
from iscat_app.compare import Compare
from iscat_app.results import Results
from iscat_app.widgets import in_line

_ONE, _SEVERAL = "histogram of the result", "samples of Compare"


class Export:
    """Everything that leaves the window."""

    title = "Export"

    def __init__(self, chosen: Chosen, results: Results, compare: Compare) -> None:
        self._chosen, self._results, self._compare = chosen, results, compare
        self._notice = Notice()
        number, select = pn.widgets.FloatInput, pn.widgets.Select
        self._what = select(label="Figure", options=[_ONE, _SEVERAL], width=200)
        self._width = number(label="Width [cm]", value=12.0, start=3, end=60, width=100)
        self._height = number(label="Height [cm]", value=8.0, start=3, end=60, width=100)
        self._font = number(label="Font [pt]", value=9.0, start=4, end=40, width=100)
        self._family = select(label="Letters", options=[*FONTS], width=120)
        self._palette = select(label="Colours", options=[*PALETTES], width=180)
        self._density = pn.widgets.Checkbox(label="with the kernel density", value=True)
        self._preview = pn.pane.PNG(None, width=560, alt_text="preview of the figure")
        self._command = pn.pane.Str("", sizing_mode="stretch_width")
        size = (self._width, self._height, self._font)
        shape = (self._what, *size, self._family, self._palette, self._density)
        self._notice.watch(self._draw, *shape)
        made: dict[str, tuple[str, Callable[[], bytes]]] = {
            kind: (f"Figure as {kind.upper()}", partial(self._figure, kind))
            for kind in get_args(Format)
        }
        made |= {
            "csv": ("Events as CSV", self._csv),
            "gates.csv": ("Gates as CSV", self._gates),
            "toml": ("Configuration as TOML", self._toml),
            "ipynb": ("Notebook", self._notebook),
        }
        self._buttons = [
            pn.widgets.FileDownload(
                callback=lambda make=make: io.BytesIO(make()),
                filename=f"histogram.{ending}",
                label=name,
                width=240,
            )
            for ending, (name, make) in made.items()
        ]
        self.body = pn.Column(
            self._notice.pane,
            in_line(*shape),
            pn.FlexBox(self._preview, pn.Column(*self._buttons)),
            "### The same without the window",
            self._command,
        )

    def refresh(self) -> None:
        """Show what would be exported."""
        self._results.refresh()
        result = self._results.result
        for button in self._buttons:
            button.disabled = result is None
            if result is not None:
                button.filename = f"{result.folder.stem}.{button.filename.partition('.')[2]}"
        if result is None:
            self._notice.say("There is no result yet: analyse the movie under Run.")
            self._preview.object, self._command.object = None, ""
            return
        self._notice.tried(self._draw)
        with self._notice.told():
            self._command.object = self._commands()

    def _draw(self) -> None:
        self._notice.say("")
        self._preview.object = self._figure("png")

    def _figure(self, kind: Format) -> bytes:
        results = self._results
        if results.histogram is None or results.result is None or results.sample is None:
            raise ia.DataError("there is no histogram yet")
        shape: dict[str, Any] = {"size_cm": (self._width.value, self._height.value)}
        shape |= {"font": (self._family.value, self._font.value), "palette": self._palette.value}
        shape["density"] = self._density.value
        if self._what.value == _SEVERAL:
            if len(self._compare.samples) < 2:
                raise ia.DataError("choose two results or more under Compare")
            return figure_bytes(histogram_figure(self._compare.samples, **shape), kind)
        shape |= {"gates": results.gates, "curve": results.species_curve()}
        alone = [(results.result.folder.stem, results.histogram)]
        figure = histogram_figure(alone, **shape)
        figure.axes[0].set_xlabel(results.sample.quantity.axis)
        return figure_bytes(figure, kind)

    def _csv(self) -> bytes:
        """Write all events; those that were rejected say so."""
        table = self._results.table
        marked = table.assign(rejected_by_hand=table["event"].isin(self._results.rejected))
        return bytes(marked.to_csv(index=False).encode())

    def _gates(self) -> bytes:
        """Write the gates; masses have their unit in the names of their columns."""
        table, sample = pd.DataFrame(gate_rows(self._results.gates)), self._results.sample
        if sample is not None and sample.quantity.unit == "kDa":
            lengths = ("low", "high", "mean", "width")
            table = table.rename(columns={name: f"{name}_kda" for name in lengths})
        return bytes(table.to_csv(index=False).encode())

    def _toml(self) -> bytes:
        result = self._results.result
        return b"" if result is None else config_to_toml(result.config).encode()

    def _commands(self) -> str:
        result = self._results.result
        if result is None:
            return ""
        folder, movie = result.folder, self._chosen.movie
        lines = []
        if movie is not None:
            again = [str(folder / "config.toml"), "--out", f"{folder.stem}-again.iscat"]
            lines.append(shlex.join(["iscat-fit", str(movie), "--config", *again]))
        start, rejected = self._results.start, self._results.rejected
        words = ["iscat", "species", str(folder)]
        if rejected and self._results.rejections is not None:
            words[2] = f"{folder.stem}.csv"
            lines.append(
                f"# {words[2]} is Events as CSV; {len(rejected)} of these were rejected "
                f"by hand: {self._results.rejections.path}"
            )
            limit = self._limit()
            words += ["--limit", ":".join(f"{kda:.9g}" for kda in limit)] if limit else []
        branch = self._results.counted_branch
        words += ["--branch", branch] if branch != "magnitude" else []
        words += [] if start is None else ["--start", ",".join(f"{mass:g}" for mass in start)]
        return "\n".join([*lines, shlex.join(words)])

    def _limit(self) -> tuple[float, float] | None:
        """Give the mass of which half are detected, and its spread [kDa], where that is known."""
        events = self._results.events()
        seen = events.efficiency
        if seen is None or events.edge_kda is not None:
            return None
        return seen.threshold_snr * seen.sigma_kda, seen.sigma_kda

    def _notebook(self) -> bytes:
        result = self._results.result
        if result is None:
            raise ia.DataError("there is no result yet")
        movie = self._chosen.movie or path_beside(result.folder, ".tif")
        limit = self._limit()
        known = "" if limit is None else "limit_kda={:.9g}, limit_sigma_kda={:.9g}, ".format(*limit)
        branch, start = self._results.counted_branch, self._results.start
        code = [
            "import iscat_analysis as ia",
            f"found = ia.fit_movie({str(movie)!r}, config={str(result.folder / 'config.toml')!r})",
            f"rejected = {sorted(self._results.rejected)!r}  # by hand",
            "kept = found.table[found.table['status'] == 'ok']",
            "kept = kept[~kept['event'].isin(rejected)]",
            f"ia.find_species(kept, {known}branch={branch!r}, start_kda={start!r}).species",
        ]
        blank: Any = {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": []}
        cells = [blank | {"id": f"cell-{n}", "source": line} for n, line in enumerate(code)]
        book = {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
        return json.dumps(book, indent=1).encode()
