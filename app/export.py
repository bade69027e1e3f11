"""Export: the figure, the table, and the command that does the same without the window."""

from __future__ import annotations

import io
import json
import shlex
from typing import Any, get_args

import panel as pn

import iscat_analysis as ia
from iscat_analysis.config import config_to_toml
from iscat_analysis.movie import path_beside
from iscat_analysis.report.species import FONTS, PALETTES, Format, figure_bytes, histogram_figure
from iscat_app.chosen import Chosen, Notice, in_line
from iscat_app.compare import Compare
from iscat_app.results import Results

_ONE, _SEVERAL = "histogram of the result", "samples of Compare"


class Export:
    """Everything that leaves the window."""

    title = "Export"

    def __init__(self, chosen: Chosen, results: Results, compare: Compare) -> None:
        self._chosen, self._results, self._compare = chosen, results, compare
        self._notice = Notice()
        self._what = pn.widgets.Select(label="Figure", options=[_ONE, _SEVERAL], width=200)
        self._width = pn.widgets.FloatInput(
            label="Width [cm]", value=12.0, start=3, end=60, width=100
        )
        self._height = pn.widgets.FloatInput(
            label="Height [cm]", value=8.0, start=3, end=60, width=100
        )
        self._font = pn.widgets.FloatInput(label="Font [pt]", value=9.0, start=4, end=40, width=100)
        self._family = pn.widgets.Select(label="Letters", options=[*FONTS], width=120)
        self._palette = pn.widgets.Select(label="Colours", options=[*PALETTES], width=180)
        self._density = pn.widgets.Checkbox(label="with the kernel density", value=True)
        self._preview = pn.pane.PNG(None, width=560, alt_text="preview of the figure")
        self._command = pn.pane.Str("", sizing_mode="stretch_width")
        shape = (self._what, self._width, self._height, self._font, self._family, self._palette,
                 self._density)  # fmt: skip
        for widget in shape:
            widget.param.watch(lambda _: self._draw(), "value")
        buttons = [
            self._download(f"Figure as {kind.upper()}", lambda kind=kind: self._figure(kind), kind)
            for kind in get_args(Format)
        ]
        buttons += [
            self._download("Events as CSV", self._csv, "csv"),
            self._download("Gates as CSV", self._gates, "gates.csv"),
            self._download("Configuration as TOML", self._toml, "toml"),
            self._download("Notebook", self._notebook, "ipynb"),
        ]
        self._buttons = buttons
        self.body = pn.Column(
            self._notice.pane,
            in_line(*shape),
            pn.FlexBox(self._preview, pn.Column(*buttons)),
            "### The same without the window",
            self._command,
        )

    def _download(self, name: str, make: Any, ending: str) -> Any:
        def named() -> Any:
            return make()

        return pn.widgets.FileDownload(
            callback=named, filename=f"histogram.{ending}", label=name, width=240
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
        self._draw()
        with self._notice.told():
            self._command.object = self._commands()

    def _draw(self) -> None:
        self._notice.say("")
        with self._notice.told():
            self._preview.object = self._figure("png").getvalue()

    def _figure(self, kind: Format) -> io.BytesIO:
        results = self._results
        if results.histogram is None or results.result is None:
            raise ia.DataError("there is no histogram yet")
        shape: dict[str, Any] = {
            "size_cm": (self._width.value, self._height.value),
            "font": (self._family.value, self._font.value),
            "palette": self._palette.value, "density": self._density.value,
        }  # fmt: skip
        if self._what.value == _SEVERAL:
            if len(self._compare.samples) < 2:
                raise ia.DataError("choose two results or more under Compare")
            return io.BytesIO(figure_bytes(histogram_figure(self._compare.samples, **shape), kind))
        drawn = histogram_figure(
            [(results.result.folder.stem, results.histogram)],
            gates=results.gates,
            curve=results.species_curve(),
            **shape,
        )
        return io.BytesIO(figure_bytes(drawn, kind))

    def _csv(self) -> io.BytesIO:
        """Write all events; those that were rejected say so."""
        table = self._results.table
        marked = table.assign(rejected_by_hand=table["event"].isin(self._results.rejected))
        return io.BytesIO(marked.to_csv(index=False).encode())

    def _gates(self) -> io.BytesIO:
        import pandas as pd

        from iscat_analysis.answers.gates import gate_rows

        return io.BytesIO(pd.DataFrame(gate_rows(self._results.gates)).to_csv(index=False).encode())

    def _toml(self) -> io.BytesIO:
        result = self._results.result
        text = config_to_toml(result.config) if result is not None else ""
        return io.BytesIO(text.encode())

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

    def _notebook(self) -> io.BytesIO:
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
        cells: list[dict[str, Any]] = [
            {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": [],
             "id": f"cell-{number}", "source": line}
            for number, line in enumerate(code)
        ]  # fmt: skip
        book = {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
        return io.BytesIO(json.dumps(book, indent=1).encode())
