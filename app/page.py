"""The page: its parts as tabs, all about the one movie that is chosen."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlencode

import panel as pn

from iscat_app.bounds import Bounds
from iscat_app.calibrate import Calibrate
from iscat_app.chosen import Chosen, Part
from iscat_app.compare import Compare
from iscat_app.export import Export
from iscat_app.files import Files
from iscat_app.film import Film
from iscat_app.form import Form
from iscat_app.results import Results
from iscat_app.run_tab import RunTab
from iscat_app.runs import Queue

STYLE = """
.notice { padding: 6px 10px; border-left: 4px solid #0072B2; }
.notice.error { border-left-color: #D55E00; font-weight: 600; }
table { border-collapse: collapse; }
h2 { margin: 0; font-size: 1.2rem; overflow-wrap: anywhere; }
td, th { padding: 3px 10px 3px 0; text-align: left; vertical-align: top; }
td:last-child { overflow-wrap: anywhere; }
"""
"""Beside what Panel brings."""

_TABS = """
.bk-tab.bk-active { color: inherit; font-weight: 700; }  /* readable on a dark ground */
[style*="visibility: hidden"] { display: none; }  /* or every tab is as high as the highest */
:host > .bk-header, .bk-headers { flex-wrap: wrap; }
"""

_KEYS = """<script>
document.addEventListener("keydown", (event) => {
  const at = event.composedPath()[0];
  if (event.key === "Enter" && at.matches?.(".bk-tab")) at.click();
});
</script>"""
"""Bokeh's tabs can be reached with the keyboard, but answer to clicks alone."""

pn.extension(notifications=False, raw_css=[STYLE], sizing_mode=None, throttled=False)


class _Template(pn.template.VanillaTemplate):
    """Panel's plain page, without the font that it would fetch from another server."""

    _resources: ClassVar[dict[str, Any]] = {}


def page_of(folder: Path, queue: Queue) -> Any:
    """Make the page of one browser tab; each has its own."""
    chosen = Chosen()
    given = _given("movie")
    if given:
        chosen.choose(Path(given))
    start = folder if chosen.movie is None else chosen.movie.parent
    dark = _given("theme") == "dark"
    results, runs, compare = Results(chosen), RunTab(chosen, queue), Compare(chosen, queue)
    parts: list[Part] = [
        Files(chosen, start), Film(chosen), Form(chosen), runs, results, compare,
        Calibrate(chosen, queue), Bounds(chosen), Export(chosen, results, compare),
    ]  # fmt: skip
    # Filled when first opened, for speed, and kept: what the browser says of a list that the server
    # has taken away is lost without a word, as it would be of `dynamic` tabs.
    places = [pn.Column(sizing_mode="stretch_width") for _ in parts]
    tabs = pn.Tabs(
        *[(part.title, place) for part, place in zip(parts, places, strict=True)],
        sizing_mode="stretch_width",
        stylesheets=[_TABS],
    )

    def show(*_: Any) -> None:
        heading.object = f"<h2>{html.escape(_name_of(chosen))}</h2>"
        colours.object = _colours(chosen)
        part, place = parts[tabs.active], places[tabs.active]
        if not len(place):
            place.append(part.body)
        part.refresh()

    def remember(*_: Any) -> None:
        if pn.state.location is not None:
            pn.state.location.update_query(
                movie=None if chosen.movie is None else str(chosen.movie)
            )

    colours = pn.pane.HTML("")
    heading = pn.pane.HTML("", sizing_mode="stretch_width")
    tabs.param.watch(show, "active")
    chosen.param.watch(show, ["movie", "result", "changed"])
    chosen.param.watch(remember, ["movie"])
    template = _Template(
        title="iSCAT analysis", main=[heading, tabs], header=[colours, pn.pane.HTML(_KEYS)],
        header_background="#1B1D21", theme="dark" if dark else "default", busy_indicator=None,
    )  # fmt: skip
    show()
    runs.watch()
    return template


def _given(name: str) -> str:
    """Read a part of the address."""
    values = pn.state.session_args.get(name) or [b""]
    return str(values[0], "utf-8", "replace")


def _colours(chosen: Chosen) -> str:
    """Link to the same page in other colours."""
    same = {} if chosen.movie is None else {"movie": str(chosen.movie)}
    links = []
    for name, theme in (("dark", "dark"), ("light", "default")):
        query = html.escape(urlencode(same | {"theme": theme}))
        links.append(f'<a style="color: white" href="?{query}">{name}</a>')
    return f'<nav aria-label="colours">{" · ".join(links)}</nav>'


def _name_of(chosen: Chosen) -> str:
    named = chosen.movie or chosen.result
    return "Choose a movie" if named is None else named.name
