"""Self-contained HTML pages from the shared templates: a document is made of sections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import jinja2
from markupsafe import Markup

from iscat_analysis.report.numbers import Fact, Table, sentence
from iscat_analysis.report.vega import VegaFigure, libraries, payload
from iscat_analysis.text import in_page

LIBRARIES = "/* libraries */"
"""Where the scripts that draw figures go, on a page that has some."""

OPTICS_FILE = "optics.toml; name it as optics.file in the configuration of the measurement."
"""What is said of an optics.toml on its page."""


@dataclass(frozen=True)
class Chart:
    """A figure on a page: one that the page draws, or a picture that is in it."""

    id: str
    title: str = ""
    svg: Markup | None = None
    caption: str = ""
    wide: bool = False
    figure: VegaFigure | None = None


@dataclass(frozen=True)
class Section:
    """A section of a document; `short` is its name in the bar, if the title is too long."""

    id: str
    title: str
    lead: str = ""
    facts: Sequence[Fact] = ()
    charts: Sequence[Chart] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    code: str = ""
    short: str = ""


def render_document(
    title: str, subtitle: str, sections: Sequence[Section], frame: Mapping[str, Any] | None = None
) -> str:
    """Fill a page of sections; `frame` replaces what the frame of a page says by itself."""
    nav = [(part.id, part.short or part.title) for part in sections]
    charts = {chart.id: chart.figure for part in sections for chart in part.charts}
    figures = {name: figure for name, figure in charts.items() if figure is not None}
    about = {"title": title, "subtitle": subtitle, "sections": sections, "nav": nav}
    held = {"payload": payload(figures)} if figures else {}
    return render_page("document.html", {**about, **held, **(frame or {})})


def configuration(toml: str, lead: str) -> Section:
    """Show what a calibration puts into a configuration."""
    return Section("configuration", "Configuration", lead, code=toml)


def notes_section(name: str, title: str, notes: Sequence[str]) -> list[Section]:
    """Show notes as sentences; no section where there are none."""
    return [Section(name, title, notes=[sentence(note) for note in notes])] if notes else []


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """Fill one of the templates in ``iscat_analysis/report/templates``.

    Everything is escaped, and so are signs that nobody sees; the result needs no network and no
    other file.
    """
    frame = {"kicker": "iscat-analysis", "subtitle": None, "footer": "iscat-analysis", "nav": ()}
    frame["payload"] = None
    page = in_page(templates().get_template(template).render({**frame, **context}))
    return page.replace(LIBRARIES, libraries()) if context.get("payload") else page


@cache
def templates() -> jinja2.Environment:
    """Give the templates, each of which is compiled once in a process."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("iscat_analysis.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=_AskableUndefined,
    )
    environment.filters["cell"] = _cell
    environment.filters["coded"] = _coded
    compact = {"separators": (",", ":"), "ensure_ascii": False, "allow_nan": False}
    environment.policies["json.dumps_kwargs"] = compact
    return environment


class _AskableUndefined(jinja2.StrictUndefined):
    """Undefined names are errors when printed, but `{% if figures.power %}` may ask for them."""

    def __bool__(self) -> bool:  # type: ignore[override]
        return False


def _coded(text: str) -> Markup:
    """Set what stands between backticks as code."""
    parts = text.split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if k % 2 else part for k, part in enumerate(parts)
    )


def _cell(value: Any) -> str:
    """Format a table cell: numbers to four digits unless two say it all, nothing as a dash."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "—"
    if isinstance(value, str):
        return value
    if isinstance(value, float) and not value.is_integer() and float(f"{value:.2g}") != value:
        return f"{value:#.4g}".rstrip(".").replace("-", "−")
    return (f"{value:.4g}" if isinstance(value, float) else str(value)).replace("-", "−")
