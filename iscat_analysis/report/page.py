"""Self-contained HTML pages from the shared templates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup

from iscat_analysis.records import Analysis
from iscat_analysis.report.answer import caution, is_uncalibrated
from iscat_analysis.report.context import report_context
from iscat_analysis.report.distribution import distribution_section, species_figure
from iscat_analysis.report.event_figures import corner_figures, event_figures
from iscat_analysis.report.figures import page_figures
from iscat_analysis.report.size_distribution import sizes_figure, sizes_section
from iscat_analysis.report.style import Sketch, drawn, publish
from iscat_analysis.report.tables import event_table
from iscat_analysis.report.track_context import tracks_context
from iscat_analysis.schemas import jsonable
from iscat_analysis.text import in_page

OPTICS_FILE = "optics.toml; name it as optics.file in the configuration of the measurement."
"""What is said of an optics.toml on its page."""


def render_document(
    title: str, subtitle: str, sections: Sequence[Mapping[str, Any]], toml: str, lead: str
) -> str:
    """Fill the page of a calibration: its sections, and what goes into the configuration."""
    configuration = {"id": "configuration", "title": "Configuration", "lead": lead, "code": toml}
    about = {"title": title, "subtitle": subtitle, "sections": [*sections, configuration]}
    return render_page("document.html", about)


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """Fill one of the templates in ``iscat_analysis/report/templates``.

    Everything is escaped, and so are signs that nobody sees; the result needs no network and no
    other file.
    """
    defaults = {
        "kicker": "iscat-analysis",
        "subtitle": None,
        "footer": "iscat-analysis",
        "nav": [(part["id"], part["title"]) for part in context.get("sections", ())],
    }
    return in_page(templates().get_template(template).render({**defaults, **context}))


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
    return environment


def render_report(analysis: Analysis, *, folder: Path | None = None) -> str:
    """Make the report page of one analysis, and write its figures."""
    table = event_table(analysis)
    about = page_context(analysis, table, folder)
    return page_of(about, publish(drawn(page_sketches(analysis, table)), folder))


def publish_figures(
    analysis: Analysis, folder: Path, most: int, chosen: Callable[[int], bool]
) -> dict[str, Markup]:
    """Write those figures of a folder whose numbers are chosen; images of `most` events at most."""
    sketches = chain(page_sketches(analysis, event_table(analysis)), event_figures(analysis, most))
    some = [sketch for number, sketch in enumerate(sketches) if chosen(number)]
    return publish(drawn(some), folder)


def page_sketches(analysis: Analysis, table: pd.DataFrame) -> Iterator[Sketch]:
    """List the figures of the page, with the functions that draw them."""
    yield from page_figures(analysis, table)
    if (found := _species(analysis, table)) is not None:
        yield "species", partial(species_figure, found)
    if (sizes := _sizes(analysis, table)) is not None:
        yield "sizes", partial(sizes_figure, sizes)
    yield from corner_figures(analysis)


def _species(analysis: Analysis, table: pd.DataFrame) -> dict[str, Any] | None:
    """Give what ``summary.json`` holds of the species, where the page shows them."""
    found = analysis.summary.get("distribution") if caution(table) is None else None
    return jsonable(found) if found else None


def _sizes(analysis: Analysis, table: pd.DataFrame) -> dict[str, Any] | None:
    """Give what ``summary.json`` holds of the diameters, where the page shows them.

    Single frames of a track may be flagged as much as they like.
    """
    fair = analysis.tracks is not None or caution(table) is None
    found = analysis.summary.get("sizes") if fair else None
    return jsonable(found) if found else None


def page_context(
    analysis: Analysis, table: pd.DataFrame, folder: Path | None = None
) -> dict[str, Any]:
    """Collect the text of the page."""
    found = _species(analysis, table)
    species = distribution_section(found) if found else None
    if (sizes := _sizes(analysis, table)) is not None:
        species = sizes_section(sizes)
    elif species is not None and is_uncalibrated(analysis):
        species["lead"] = f"On the model's own scale, which is not a mass. {species['lead']}"
    context = report_context(analysis, table)
    tracked = analysis.tracks is not None
    if tracked:
        context |= tracks_context(analysis, table, folder)
    nav = [
        ("summary", "Summary"),
        ("distributions", "Distributions" if len(table) else "Field"),
        *([("films", "Films")] if tracked and context["films"] else []),
        *([(species["id"], species["title"])] if species else []),
        *([("precision", "Precision")] if len(table) else []),
        *([("budget", "Budget")] if context["budget_rows"] and len(table) else []),
        *([("events", "Tracks" if tracked else "Events")] if context["n_events"] else []),
        *(
            [("posterior", "Posterior")]
            if context["posterior_rows"] or context["refused_rows"]
            else []
        ),
        ("diagnostics", "Diagnostics"),
        ("configuration", "Configuration"),
        ("provenance", "Provenance"),
    ]
    return {"tracked": tracked, **context, "species": species, "nav": nav}


def page_of(about: Mapping[str, Any], figures: Mapping[str, Markup]) -> str:
    """Combine text and figures."""
    shown = {
        "figures": figures,
        "histogram": next((name for name in figures if name.endswith("_histogram")), None),
        "corners": [name for name in figures if name.startswith("corner_")],
    }
    return render_page("report.html", {**about, **shown})


class _AskableUndefined(jinja2.StrictUndefined):
    """Undefined names are errors when printed, but `{% if part.lead %}` may ask for them."""

    def __bool__(self) -> bool:  # type: ignore[override]
        return False


def _cell(value: Any) -> str:
    """Format a table cell: numbers to four digits unless two say it all, nothing as a dash."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "—"
    if isinstance(value, float):
        plain = value.is_integer() or float(f"{value:.2g}") == value
        short = f"{value:.4g}" if plain else f"{value:#.4g}".rstrip(".")
        return short.replace("-", "−")
    if isinstance(value, Markup):
        return value
    return str(value).replace("-", "−") if isinstance(value, int) else str(value)
