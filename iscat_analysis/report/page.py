"""Self-contained HTML pages from the shared templates: a document is made of sections.

Their figures are made of a few general specifications: `curves` draws what depends on a number,
`intervals` what belongs to a name, `heatmap` what belongs to two, and `pictures` images.  Each is
one figure of one panel or of several, whose title, axes and caption are those of its name in
``specifications/figures.json``.  There `log` names the axes that are logarithmic, `span` the ends
of axes, and `shared` those that all panels share; panels that are `listed` lie below each other,
each with its name at the left.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import jinja2
import numpy as np
from markupsafe import Markup

from iscat_analysis.records import FloatArray
from iscat_analysis.report.numbers import Fact, Table, number, sentence
from iscat_analysis.report.pictures import picture_uri
from iscat_analysis.report.vega import VegaFigure, columns_of, figure, libraries, look_of, payload
from iscat_analysis.text import in_page, in_terminal

BLUE, VERMILLION = "#0072b2", "#d55e00"
GREY, LINE = "#a9afb7", "#7d858f"
PALETTE = (VERMILLION, BLUE, "#009e73", "#cc79a7", "#e69f00", "#56b4e9", LINE)
"""Colours that can be told apart, by night as well."""

NAMED = 12
"""Entries of a legend, at most."""

Row = dict[str, Any]
Kind = Literal["bar", "band", "line", "point", "rule"]

_WIDTHS = {1: 900, 2: 550, 3: 355, 4: 245, 5: 190}  # pixels of a panel, by the panels in a row
_LABELS = "test(/^[125]/, format(datum.value, '.0e')) ? format(datum.value, '~g') : ''"
_FEW_DECADES = {"x": 50.0, "y": 400.0}  # 2 and 5 have a label below this ratio of the ends
_FIELDS = {"x": ("x", "x2"), "y": ("y", "low", "high")}
_WORDS = ("panel", "series", "name", "row", "column", "text")


LIBRARIES = "/* libraries */"
"""Where the scripts that draw figures go, on a page that has some."""

OPTICS_FILE = "optics.toml; name it as optics.file in the configuration of the measurement."
"""What is said of an optics.toml on its page."""


@dataclass(frozen=True)
class Chart:
    """A figure on a page, which draws it; a wide one has a line of its own."""

    id: str
    figure: VegaFigure
    wide: bool = False


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
    figures = {chart.id: chart.figure for part in sections for chart in part.charts}
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


# ---- Rows ----------------------------------------------------------------------------------------


def marks(
    kind: Kind,
    series: str,
    x: Any,
    y: Any = None,
    ends: Any = None,
    *,
    panel: str = "",
    dash: str = "solid",
) -> list[Row]:
    """Make the rows of a line, a band, points with intervals, bars between edges, or rules."""
    across = np.asarray(x, float)
    columns: dict[str, Any] = {"x": across, "y": y, "x2": None, "low": None, "high": None}
    if kind == "bar":
        columns |= {"x": across[:-1], "x2": across[1:]}
    if ends is not None:
        columns |= dict(zip(("low", "high"), np.asarray(ends, float), strict=True))
    nothing = np.full(len(columns["x"]), np.nan)
    numbers = {key: nothing if v is None else np.asarray(v, float) for key, v in columns.items()}
    words = {"kind": kind, "series": series, "panel": panel, "dash": dash}
    return [
        {**words, "order": k, **dict(zip(numbers, row, strict=True))}
        for k, row in enumerate(zip(*numbers.values(), strict=True))
    ]


def interval(
    name: str,
    x: float | None,
    ends: Sequence[float | None] = (None, None),
    *,
    panel: str = "",
    series: str = "",
    lane: str = "",
) -> Row:
    """Make the row of a value with its interval; lanes lie below each other in its line."""
    words = {"panel": panel, "series": series, "lane": lane, "name": name}
    return {**words, "x": x, "low": ends[0], "high": ends[1]}


def around(values: Any, reach: Any) -> FloatArray:
    """Give the ends of intervals of this half length, shape (2, n)."""
    middle, half = np.asarray(values, float), np.asarray(reach, float)
    return np.array([middle - half, middle + half])


# ---- Figures -------------------------------------------------------------------------------------


def curves(
    name: str, parts: Iterable[list[Row]], words: Mapping[str, Any] | None = None, *, of: str = ""
) -> Chart:
    """Draw lines, bands, points, bars and rules against a number."""
    look = {"height": 210, "shared": "x", **look_of(name, words or {})}
    rows = [{**row, "part": k} for k, part in enumerate(parts) for row in part]
    for axis, fields in _FIELDS.items():
        for row in rows if axis in look.get("log", "") else ():
            row.update({key: row[key] if row[key] > 0 else np.nan for key in fields})
    for row in rows:  # an interval whose lower end a logarithmic axis cannot show
        if row["kind"] == "point" and np.isnan(row["low"]) and np.isfinite(row["high"]):
            row["low"] = row["y"]
    kinds = {row["kind"] for row in rows}
    if any(row["kind"] == "point" and np.isfinite(row["low"]) for row in rows):
        kinds.add("interval")
    drawn = figure(
        "curves",
        {"rows": columns_of(_shown(rows))},
        {
            **look,
            **_places(rows, look),
            **_axis("x", look, rows, _FIELDS["x"]),
            **_axis("y", look, rows, _FIELDS["y"], zero="bar" in kinds),
            **({"y_axis": None} if look.get("listed") else {}),
        },
    )
    return _chart(name + of, drawn, rows, look, kinds)


def intervals(
    name: str, rows: list[Row], words: Mapping[str, Any] | None = None, *, of: str = ""
) -> Chart:
    """Draw one or several values with their intervals in the line of each name."""
    look = {"reference": None, "shared": "xy", **look_of(name, words or {})}
    for row in rows if "x" in look.get("log", "") else ():
        row.update({key: row[key] if row[key] and row[key] > 0 else None for key in ("x", "low")})
    kinds = {"point"} | ({"rule"} if look["reference"] is not None else set())
    if any(row["low"] is not None for row in rows):
        kinds.add("interval")
    step = max(20, 8 * len({row["lane"] for row in rows}) + 8)
    look["height"] = step * len({row["name"] for row in rows})
    axis = _axis("x", look, rows, ("x", "low", "high"))
    data = {"rows": columns_of(_shown(rows))}
    drawn = figure("intervals", data, {**look, **_places(rows, look), **axis})
    return _chart(name + of, drawn, rows, look, kinds)


def heatmap(name: str, rows: list[Row], words: Mapping[str, Any] | None = None) -> Chart:
    """Draw a coloured cell for each pair of names: shares from −1 to 1, or which name is there."""
    look = {"shared": "xy", **look_of(name, words or {})}
    signed = not any(isinstance(row["value"], str) for row in rows)
    look |= {
        "type": "quantitative" if signed else "nominal",
        "angle": -45 if signed else 0,
        "opacity": 1 if signed else 0.75,
        "height": 26 * len({row["row"] for row in rows}),
    }
    named = _shown([{**row, "series": "" if signed else row["value"]} for row in rows])
    cells = {**look, **_places(named, look)}
    if signed:
        cells["colours"] = {"domain": [-1, 0, 1], "range": ["#00528c", "#f3f1ec", "#be4600"]}
        cells["legend"] = {"orient": "right"}
    drawn = figure("heatmap", {"rows": columns_of(named)}, cells)
    return _chart(name, drawn, rows, look, set() if signed else {"text"})


def pictures(
    name: str,
    images: Iterable[tuple[str, Any, tuple[float, float]]],
    half: float,
    words: Mapping[str, Any] | None = None,
) -> Chart:
    """Show images of half side `half`, each with its name and the ends of its shades."""
    look = {"shared": "xy", **look_of(name, words or {})}
    rows: list[Row] = [
        {
            "panel": of,
            "series": "",
            "url": picture_uri(np.asarray(one, float), *ends),
            "x": 0,
            "y": 0,
        }
        for of, one, ends in images
    ]
    look |= {"names": ", ".join(row["panel"] for row in rows), "span": [-half, half]}
    drawn = figure("picture", {"rows": columns_of(rows)}, {**look, **_places(rows, look, one=340)})
    return _chart(name, drawn, rows, look, set())


def with_ends(name: str, low: float, high: float) -> str:
    """Name an image with the ends of its shades."""
    ends = f"± {number(high)}" if low == -high else f"{number(low)} to {number(high)}"
    return f"{name}: {ends}"


# ---- Their parts ---------------------------------------------------------------------------------


def _axis(
    axis: str,
    look: Mapping[str, Any],
    rows: list[Row],
    fields: Sequence[str],
    *,
    zero: bool = False,
) -> dict[str, Any]:
    """Say the scale of an axis, and which numbers are written beside it where it is logarithmic."""
    ends = look.get("span", {}).get(axis)
    numbers: dict[str, Any] = {"tickCount": 6}
    scale: dict[str, Any] = {"zero": zero}
    if axis in look.get("log", ""):
        shared = axis in look["shared"] or len(_panels(rows)) < 2
        scale, known = {"type": "log"}, dict[str, list[float]]()
        for row in rows:
            shown = [row[key] for key in fields if row[key] is not None and 0 < row[key] < np.inf]
            known.setdefault("" if shared else row["panel"], []).extend(shown)
        spread = max((max(one) / min(one) for one in known.values() if one), default=1.0)
        few = spread < _FEW_DECADES[axis]
        numbers["labelExpr"] = _LABELS.replace("125", "125" if few else "1")
        if ends is None and shared and any(known.values()):
            ends = _plain_ends(known[""])
    if ends is not None:
        scale |= {"domain": list(ends), "nice": False}
    return {f"{axis}_scale": scale, f"{axis}_axis": numbers}


def _plain_ends(values: list[float]) -> tuple[float, float]:
    """Give the nearest of 1, 2, 5, 10, … outside of all values."""
    steps = [m * 10.0**e for e in range(-12, 13) for m in (1, 2, 5)]
    low, high = min(values), max(values)
    below = max((step for step in steps if step <= low), default=low)
    return below, min((step for step in steps if step >= high and step > below), default=high)


def _colours(rows: list[Row], given: Mapping[str, str], *, wide: bool) -> dict[str, Any]:
    """Give each series its colour, or a step of a scale where there are many."""
    names = list(dict.fromkeys(row["series"] for row in rows))
    bars = {row["series"] for row in rows if row.get("kind") == "bar"}
    if len(bars) == 1 < len(names):
        given = dict.fromkeys(bars, GREY) | {**given}
    free = iter([colour for colour in PALETTE if colour not in given.values()])
    scale: dict[str, Any] = {"domain": names}
    if len(names) > len(PALETTE):
        scale["scheme"] = "viridis"
    else:
        scale["range"] = [given[name] if name in given else next(free, GREY) for name in names]
    room = 120 if wide else 50  # letters beside each other
    columns = max(1, room // (max(map(len, names), default=1) + 4))
    legend = {"columns": columns, "labelLimit": 400}
    return {"colours": scale, "legend": legend if 1 < len(names) <= NAMED else None}


def _shown(rows: list[Row]) -> list[Row]:
    """Make the texts of rows harmless, which may be names of files."""
    for row in rows:
        row.update({key: in_terminal(row[key]) for key in _WORDS if key in row})
    return rows


def _panels(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["panel"] for row in rows))


def _places(rows: list[Row], look: Mapping[str, Any], one: int = 900) -> dict[str, Any]:
    """Say what the panels of a figure share, how wide each is, and the colours of its series."""
    panels, shared = _panels(rows), look["shared"]
    facet: dict[str, Any] = {"field": "panel", "type": "nominal", "sort": panels}
    width = {**_WIDTHS, 1: one}[look.get("columns", min(len(panels), 4) or 1)]
    if look.get("listed"):
        header = {"labelAngle": 0, "labelAlign": "left", "labelOrient": "left", "labelLimit": 260}
        facet, width = {"row": {**facet, "header": header}}, one
    resolve = {axis: "shared" if axis in shared else "independent" for axis in "xy"}
    wide = look.get("wide", len(panels) > 1)
    return {
        "caption": look.get("caption", ""),
        "facet": facet,
        "width": width,
        "resolve": {"scale": resolve},
        **_colours(rows, look.get("colours", {}), wide=wide),
    }


def _chart(
    id: str, drawn: VegaFigure, rows: list[Row], look: Mapping[str, Any], kinds: Iterable[str]
) -> Chart:
    """Leave out what no row asks for; a figure of one panel has its name and its place's width."""
    made, panels = dict(drawn.specification), _panels(rows)
    inner = dict(made["spec"])
    if "layer" in inner:
        kept = {*kinds, "all"}
        inner["layer"] = [one for one in inner["layer"] if one.get("name", "all") in kept]
    if len(panels) > 1:
        columns = (
            {} if look.get("listed") else {"columns": look.get("columns", min(len(panels), 4))}
        )
        made |= {"spec": inner, **columns}
    else:
        heading = {"title": {"text": panels[0], "anchor": "start"}} if any(panels) else {}
        width = inner["width"] if drawn.name == "picture" else "container"
        for key in ("facet", "spec", "resolve", "spacing"):
            made.pop(key, None)
        made |= {**inner, "width": width, **heading}
    return Chart(id, replace(drawn, specification=made), look.get("wide", len(panels) > 1))
