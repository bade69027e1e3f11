"""The manual's settings; the reference is written from the code when the manual is built."""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import os
import pkgutil
import re
from pathlib import Path
from typing import Any

import iscat_analysis
from iscat_analysis.config import config_to_toml, load_config

project = "iscat-analysis"
author = "The iscat-analysis developers"
copyright = author
version = release = importlib.metadata.version("iscat-analysis")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
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
html_theme_options = {"description": "Position, mass and their bounds", "page_width": "1080px"}

GENERATED = Path(__file__).parent / "_build" / "generated"


def _write_reference() -> None:
    GENERATED.mkdir(parents=True, exist_ok=True)
    (GENERATED / "configuration.toml").write_text(config_to_toml(load_config()), encoding="utf-8")

    modules = sorted(
        info.name
        for info in pkgutil.iter_modules(iscat_analysis.__path__, "iscat_analysis.")
        if not info.name.split(".")[-1].startswith("_")
    )
    blocks = []
    for name in modules:
        title = f"``{name}``"
        members = "   :members:\n   :show-inheritance:\n"
        if name.endswith(".config"):  # its fields are the configuration page
            members = "   :members: load_config, parse_config, config_to_toml\n"
        blocks.append(f"{title}\n{'-' * len(title)}\n\n.. automodule:: {name}\n{members}")
    (GENERATED / "library.rst").write_text("\n\n".join(blocks), encoding="utf-8")

    from iscat_cli import main
    from iscat_cli.app import COMMANDS

    os.environ["TERMINAL_WIDTH"] = os.environ["COLUMNS"] = "96"
    for command, _ in COMMANDS:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            main([command.__name__, "--help"])
        text = "\n".join(line.rstrip() for line in said.getvalue().splitlines()).strip("\n")
        (GENERATED / f"{command.__name__}.txt").write_text(text + "\n", encoding="utf-8")


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
    _write_reference()
    # Before napoleon, which adds markup of its own that must stay.
    app.connect("autodoc-process-docstring", _escape, priority=100)
