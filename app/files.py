"""Open: the movies and results of a folder, and what is known of each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import panel as pn

import iscat_analysis as ia
from iscat_analysis.movie import is_named_as_movie, path_beside
from iscat_analysis.reading import read_json
from iscat_analysis.report.answer import answer_in
from iscat_app.chosen import Chosen, Notice
from iscat_app.widgets import in_line, table_of, wide_pane

Kind = Literal["folder", "movie", "result"]


@dataclass(frozen=True)
class Entry:
    """One line of the list."""

    path: Path
    kind: Kind
    label: str


def listed(folder: Path) -> list[Entry]:
    """List folders, movies and results; nothing is opened."""
    entries = [Entry(folder.parent, "folder", "⬆ ..")] if folder.parent != folder else []
    for path in sorted(folder.iterdir(), key=lambda p: (not p.is_dir(), p.name.lower())):
        if path.name.startswith("."):
            continue
        ending = path.suffix.lower()
        if path.is_dir() and ending == ".iscat":
            continue  # shown with its movie, or below
        if is_named_as_movie(path):
            done = (path_beside(path, ".iscat") / "summary.json").is_file()
            entries.append(Entry(path, "movie", f"{'●' if done else '○'} {path.name}"))
        elif path.is_dir():
            entries.append(Entry(path, "folder", f"▸ {path.name}/"))
    shown = {path_beside(e.path, ".iscat") for e in entries if e.kind == "movie"}
    for path in sorted(folder.glob("*.iscat")):
        if path not in shown and (path / "summary.json").is_file():
            entries.append(Entry(path, "result", f"◆ {path.name}"))
    return entries


def facts_of(movie: Path) -> list[tuple[str, str]]:
    """Say what a movie's file tells, without reading its frames."""
    with ia.open_stack(movie) as stack:
        frames, rows, columns = stack.shape
        told = stack.metadata
        facts = [
            ("frames", f"{frames} of {rows} × {columns} pixels, {stack.dtype}"),
            ("size", f"{frames * rows * columns * stack.dtype.itemsize / 1e6:.4g} MB of pixels"),
        ]
        for name, label, unit in (
            ("pixel_size_nm", "pixel", "nm"),
            ("exposure_ms", "exposure", "ms"),
            ("frame_rate_hz", "frame rate", "Hz"),
            ("wavelength_nm", "wavelength", "nm"),
            ("na", "NA", ""),
        ):
            value = getattr(told, name, None)
            if value is not None:
                facts.append((label, f"{value:.4g} {unit} ({told.source})"))
        if told.pixel_size_nm is None:
            facts.append(("pixel", "not in the file: give it under Set up"))
        facts += [("note", note) for note in stack.notes]
    return facts


def result_facts(result: Path) -> list[tuple[str, str]]:
    """Say what stands in a result."""
    summary: dict[str, Any] = read_json(result / "summary.json")
    state = "interrupted; Run goes on from there" if summary.get("interrupted") else "complete"
    facts = [("result", f"{result.name}, {state}"), ("events", str(summary["events"]))]
    answer = answer_in(result)
    return [*facts, ("answer", answer)] if answer else facts


class Files:
    """The folder browser."""

    title = "Open"

    def __init__(self, chosen: Chosen, folder: Path) -> None:
        self._chosen, self.folder = chosen, folder
        self._entries: dict[str, Entry] = {}
        self._notice = Notice()
        self._where = pn.widgets.TextInput(label="Folder", sizing_mode="stretch_width")
        self._filter = pn.widgets.TextInput(label="Show names with", width=180)
        # Of many, since a list of one sends its first line where nothing is chosen.
        self._list = pn.widgets.MultiSelect(
            label="Movies (● analysed, ○ not yet), ◆ results, ▸ folders",
            size=18,  # lines of the list
            sizing_mode="stretch_width",
        )
        self._facts = wide_pane()
        again = self._notice.button("Look again", 100, self.refresh)
        # Larger files than these are opened where they lie.
        drop = {"label": "Copy a small movie here", "multiple": True, "max_file_size": "200MB"}
        self._drop = pn.widgets.FileDropper(**drop, sizing_mode="stretch_width", height=90)
        self._notice.watch(self.refresh, self._filter)
        self._notice.watch(self._go, self._where)
        self._list.param.watch(self._pick, "value")
        self._drop.param.watch(self._dropped, "value")
        self.body = pn.FlexBox(
            pn.Column(self._where, in_line(self._filter, again), self._list, self._drop, width=640),
            pn.Column(self._notice.pane, self._facts, width=560),
            sizing_mode="stretch_width",
        )

    def refresh(self) -> None:
        """List the folder as it is now."""
        self._where.value = str(self.folder)
        wanted = self._filter.value.strip().lower()
        with self._notice.told():
            entries = [
                e
                for e in listed(self.folder)
                if e.kind == "folder" or wanted in e.path.name.lower()
            ]
            self._entries = {e.label: e for e in entries}
            here = [e.label for e in entries if e.path in (self._chosen.movie, self._chosen.result)]
            self._list.param.update(options=[*self._entries], value=here[:1])
            self._show()

    def _go(self) -> None:
        folder = Path(self._where.value).expanduser()
        if folder != self.folder:
            if not folder.is_dir():
                raise ia.DataError(f"{folder}: is no folder")
            self.folder = folder
            self.refresh()

    def _pick(self, event: Any) -> None:
        entry = self._entries.get(event.new[-1]) if event.new else None
        if entry is None or entry.path in (self._chosen.movie, self._chosen.result):
            return
        self._notice.say("")
        if entry.kind == "folder":
            self.folder = entry.path
            self.refresh()
        elif entry.kind == "movie":
            self._chosen.choose(entry.path)
        else:
            with self._notice.told(), ia.open_result(entry.path) as result:
                try:
                    movie = result.movie_path
                except ia.DataError as error:
                    self._notice.say(str(error))
                    movie = None
                self._chosen.choose(movie, entry.path)
        self._show()

    def _show(self) -> None:
        """Say what is known of what is chosen."""
        movie, result = self._chosen.movie, self._chosen.result
        self._facts.object = ""
        rows: list[tuple[str, str]] = []
        with self._notice.told():
            if movie is not None:
                rows += [("movie", movie.name), *facts_of(movie)]
                found = self._chosen.config
                rows.append(("configuration", found.name if found else "none yet: see Set up"))
            rows += [("result", "none yet: see Run")] if result is None else result_facts(result)
        if movie is not None or result is not None:
            self._facts.object = table_of([(a, b) for a, b in rows])

    def _dropped(self, event: Any) -> None:
        """Save files that were dropped, under names that nothing else has."""
        while event.new:  # it keeps what it has until this is taken out
            name, data = event.new.popitem()
            safe = re.sub(r"[^\w.\- ]", "_", Path(name).name).lstrip(".") or "movie.tif"
            target = self.folder / safe
            with self._notice.told():
                if target.exists():
                    self._notice.say(f"{safe}: is in the folder already", "error")
                    continue
                target.write_bytes(data if isinstance(data, bytes) else str(data).encode())
                self._chosen.choose(target)
        self.refresh()
