"""Settings of the manual; the reference pages are written from the code during the build."""

from __future__ import annotations

import contextlib
import importlib.metadata
import inspect
import io
import itertools
import os
import pkgutil
import re
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from blocks import Interpreter, blocks_of, prepare, run_page  # noqa: E402

import iscat_analysis  # noqa: E402
from iscat_analysis.schemas import schema, schema_names  # noqa: E402

project = "iscat-analysis"
author = "The iscat-analysis developers"
copyright = author
version = release = importlib.metadata.version("iscat-analysis")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
default_role = "code"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
# "ndarray, shape (y, x)" is a description of a type, in which Sphinx looks for classes.
suppress_warnings = ["ref.python"]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
html_theme = "alabaster"
html_static_path = ["static"]
html_css_files = ["manual.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
html_sidebars = {"**": ["about.html", "searchbox.html", "navigation.html"]}
html_theme_options = {
    "description": "Position, mass and their bounds",
    "page_width": "1080px",
    "sidebar_width": "240px",
    "fixed_sidebar": True,
    "show_powered_by": False,
}

GENERATED = HERE / "_build" / "generated"
PROGRAMS = Path(sys.executable).parent


def _write_reference() -> None:
    GENERATED.mkdir(parents=True, exist_ok=True)
    _write_configuration()
    _write_library()
    _write_commands()
    _write_schemas()
    _write_columns()
    _write_findings()


def _said(*arguments: str) -> str:
    from iscat_cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        main(list(arguments))
    return "\n".join(line.rstrip() for line in said.getvalue().splitlines()).strip("\n") + "\n"


def _write_configuration() -> None:
    (GENERATED / "configuration.toml").write_text(_said("config"), encoding="utf-8")


def _write_library() -> None:
    public = [name for name in iscat_analysis.__all__ if callable(getattr(iscat_analysis, name))]
    public.sort(key=lambda name: list(iscat_analysis._HOME).index(name))
    lines = {name: _first_line(getattr(iscat_analysis, name)) for name in public}
    blocks = [
        "The public list\n---------------\n\n.. automodule:: iscat_analysis\n",
        ".. list-table::\n   :widths: 25 75\n\n"
        + "\n".join(f"   * - `{name}`\n     - {line}" for name, line in lines.items()),
    ]
    modules = sorted(
        info.name
        for info in pkgutil.iter_modules(iscat_analysis.__path__, "iscat_analysis.")
        if not info.name.split(".")[-1].startswith("_")
    )
    modules.sort(key=lambda name: name != "iscat_analysis.notebook")
    for name in modules:
        title = f"``{name}``"
        members = "   :members:\n   :show-inheritance:\n"
        if name.endswith(".config"):  # its fields are the configuration page
            members = "   :members: load_config, parse_config, config_to_toml\n"
        blocks.append(f"{title}\n{'-' * len(title)}\n\n.. automodule:: {name}\n{members}")
    (GENERATED / "library.rst").write_text("\n\n".join(blocks), encoding="utf-8")


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0]


def _write_commands() -> None:
    from iscat_cli.app import COMMANDS, GROUPS

    os.environ["TERMINAL_WIDTH"] = os.environ["COLUMNS"] = "84"
    names = [(command.name,) for command in COMMANDS]
    names += [(group, command.name) for group, _, inner in GROUPS for command in inner]
    pages = [
        f"## iscat {' '.join(name)}\n\n```none\n{_said(*name, '--help')}```\n" for name in names
    ]
    (GENERATED / "commands.md").write_text("\n".join(pages), encoding="utf-8")


def _write_schemas() -> None:
    pages = []
    for name in schema_names():
        text = schema(name)
        pages.append(f"## {name}\n\n{text['description']}\n")
        pages.append("| key | type | meaning |\n|---|---|---|")
        for key, about in text["properties"].items():
            kinds = [one.get("type", "object") for one in about.get("anyOf", [about])]
            kind = "one of a list" if "enum" in about else " or ".join(kinds)
            missing = "" if key in text.get("required", ()) else "; may be absent"
            pages.append(f"| `{key}` | {kind}{missing} | {about.get('description', '')} |")
        pages.append("")
    (GENERATED / "schemas.md").write_text("\n".join(pages), encoding="utf-8")


def _write_columns() -> None:
    """Write the tables of columns from their registry, one line for columns that differ in unit."""
    from iscat_analysis.records import EVENTS, TRACKS

    for name, columns in (("fits", EVENTS), ("tracks", TRACKS)):
        lines = ["| column | meaning |", "|---|---|"]
        for meaning, group in itertools.groupby(columns, key=lambda column: column.meaning):
            alike = list(group)
            names = ", ".join(f"`{column.name}`" for column in alike)
            units = ", ".join(dict.fromkeys(column.unit for column in alike))
            absent = "; may be absent" if alike[0].optional else ""
            lines.append(f"| {names} | {meaning.format(units)}{absent} |")
        (GENERATED / f"{name}_columns.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_findings() -> None:
    """Write the table of findings from their registry, the values of a sentence in braces."""
    from iscat_analysis.findings import KINDS

    lines = ["| code | severity | what is printed | what to do |", "|---|---|---|---|"]
    for code, kind in sorted(KINDS.items()):
        page = f" {{doc}}`/{kind.page}`" if kind.page else ""
        lines.append(f"| `{code}` | {kind.severity} | {kind.sentence} | {kind.remedy}{page} |")
    (GENERATED / "findings.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _run_pages() -> None:
    """Run every block of the manual and of README, as many pages at a time as there are cores.

    Pages with many commands come first, so that no core has a long page at the end.
    """
    pages = [
        page
        for page in sorted([HERE.parent / "README.md", *HERE.rglob("*.md")])
        if "_build" not in page.parts and any(block.not_run is None for block in blocks_of(page))
    ]
    pages.sort(key=_commands_of, reverse=True)
    turns = iter(pages)

    def run_in_turn(_: int) -> None:
        with Interpreter(PROGRAMS) as interpreter:
            for page in turns:
                _run_one_page(page, interpreter)

    cores = os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(run_in_turn, range(cores)))


def _commands_of(page: Path) -> int:
    run = [block for block in blocks_of(page) if block.not_run is None]
    return sum(len(block.first) + max(1, len(block.commands)) for block in run)


def _run_one_page(page: Path, interpreter: Interpreter) -> None:
    """Run a page's blocks, and keep their output and figures."""
    target = GENERATED / page.stem
    if target.is_dir() and os.environ.get("DOCS_REUSE"):  # while writing
        return
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(HERE.parent, folder)
        for outcome in run_page(page, folder, interpreter):
            if outcome.failed:
                raise RuntimeError(f"{page}:{outcome.block.line}: {outcome.failed}")
            if outcome.block.keep:
                kept = target / f"{outcome.block.keep}.txt"
                kept.write_text(outcome.out, encoding="utf-8")
        for pattern in ("*.png", "*.iscat/figures/*.png", "scan/**/*.png"):
            for picture in folder.glob(pattern):
                shutil.copy(picture, target / picture.name)


def _mathml(text: str, *, as_block: bool) -> str:
    """Write an equation in MathML, which browsers draw without a script from the network."""
    known = text.replace(r"\dots", r"\ldots")
    return str(tex2mathml(known, as_block=as_block))


def _inline_math(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _display_math(self: Any, node: nodes.math_block) -> None:
    self.body.append(f"<div class='math'>{_mathml(node.astext(), as_block=True)}</div>")
    raise nodes.SkipNode


LITERAL_OR_EMPHASIS = re.compile(
    r"(``.*?``|`.*?`|(?<![\w*])\*{1,2}[^\s*](?:[^*]*[^\s*])?\*{1,2}(?!\w))"
)
MARKUP = re.compile(r"(?<![\\])(?:\||\*(?!\s))")


def _escape(_app: Any, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]) -> None:
    """Keep |E|² and t* from being read as markup; literals and emphasis are left alone."""
    for number, line in enumerate(lines):
        parts = LITERAL_OR_EMPHASIS.split(line)
        parts[::2] = [MARKUP.sub(r"\\\g<0>", part) for part in parts[::2]]
        lines[number] = "".join(parts)


def setup(app: Any) -> None:
    """Write the generated pages and hook into autodoc."""
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
    _write_reference()
    _run_pages()
    # Before napoleon, which adds markup of its own that must stay.
    app.connect("autodoc-process-docstring", _escape, priority=100)
