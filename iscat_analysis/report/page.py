"""Self-contained HTML pages from the shared templates."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import jinja2
from markupsafe import Markup

from iscat_analysis.records import Analysis
from iscat_analysis.report.context import report_context
from iscat_analysis.report.distribution import distribution_section
from iscat_analysis.schemas import jsonable

_UNSAFE_IN_SCRIPT = {
    "<": "\\u003c",
    ">": "\\u003e",
    "&": "\\u0026",
    "\u2028": "\\u2028",
    "\u2029": "\\u2029",
}


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """Fill one of the templates in ``iscat_analysis/report/templates``.

    Everything is escaped; the result needs no network and no other file.

    Parameters
    ----------
    template : str
        ``"document.html"`` for a page of sections (facts, charts, tables, notes, code), whose
        first lines say what each may hold; ``"report.html"`` for the report of an analysis.
    context : mapping
        ``title`` and, for a document, ``sections``.  Optional: ``kicker`` (the name at the left of
        the bar), ``subtitle``, ``footer``, ``nav`` ((id, label) pairs; by default the sections).
        Charts are specifications for ``charts.js``, whose first lines describe them; NaN is
        allowed and is drawn as a gap.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    jinja2.UndefinedError
        The context lacks something that the template needs.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("iscat_analysis.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=_AskableUndefined,
    )
    environment.filters["embed"] = _embed
    environment.filters["cell"] = _cell
    sections = context.get("sections", ())
    defaults = {
        "kicker": "iscat-analysis",
        "subtitle": None,
        "footer": "iscat-analysis",
        "nav": [(part["id"], part["title"]) for part in sections],
    }
    return environment.get_template(template).render({**defaults, **context})


def render_report(analysis: Analysis, *, figures: Mapping[str, int] | None = None) -> str:
    """Make the report page of one analysis.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    figures : mapping, optional
        How many figures of each kind lie beside the page, as `write_figures` returns it.

    Returns
    -------
    str
        HTML.
    """
    context = report_context(analysis, figures or {})
    found = analysis.summary.get("distribution")
    species = distribution_section(jsonable(found)) if found else None
    if species is not None:
        names = [name for name, _ in context["nav"]]
        context["nav"].insert(names.index("distributions") + 1, (species["id"], species["title"]))
    return render_page("report.html", {**context, "species": species})


class _AskableUndefined(jinja2.StrictUndefined):
    """Undefined names are errors when printed, but `{% if part.lead %}` may ask for them."""

    def __bool__(self) -> bool:  # type: ignore[override]
        return False


def _embed(value: Any) -> Markup:
    """JSON that may stand inside a script element."""
    text = json.dumps(jsonable(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    for character, escaped in _UNSAFE_IN_SCRIPT.items():
        text = text.replace(character, escaped)
    return Markup(text)  # every character that could end the element is escaped


def _cell(value: Any) -> str:
    """Format a table cell: numbers to four digits unless two say it all, nothing as a dash."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "—"
    if isinstance(value, float):
        plain = value.is_integer() or float(f"{value:.2g}") == value
        short = f"{value:.4g}" if plain else f"{value:#.4g}".rstrip(".")
        return short.replace("-", "−")
    return str(value).replace("-", "−") if isinstance(value, int) else str(value)
