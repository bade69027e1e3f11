"""Figures as data and Vega-Lite: one specification in a file, drawn by page, window and notebook.

A specification in ``specifications/`` names its data sets and leaves words and numbers open, as
``"$quantity"``.  `figure` fills it in.  Nothing is drawn in Python: a page draws its figures
itself, JupyterLab knows the format, and the window hands them to its Vega pane.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.errors import DataError

MIME_TYPE = "application/vnd.vegalite.v6+json"
"""What notebooks call a specification."""

DIGITS = 6
"""Significant digits of the numbers of a figure."""

Columns = Mapping[str, Sequence[Any]]
"""A data set: values of each field, all of the same length."""

_DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)


@dataclass(frozen=True)
class VegaFigure:
    """A figure that pages, notebooks and the window draw.

    Attributes
    ----------
    name : str
        Name of its specification.
    specification : mapping
        Vega-Lite, with its data sets by name but without their rows.
    data : mapping of str to mapping
        Rows of each data set, as columns.
    """

    name: str
    specification: Mapping[str, Any]
    data: Mapping[str, Columns] = field(repr=False)

    @property
    def description(self) -> str:
        """What it shows, in a sentence."""
        return str(self.specification.get("description", ""))

    def to_dict(self) -> dict[str, Any]:
        """Give the whole specification, rows included, as a Vega-Lite document."""
        sets = {name: records(columns) for name, columns in self.data.items()}
        return {**self.specification, "config": configuration(), "datasets": sets}

    def save(self, path: str | Path) -> Path:
        """Write the specification with its rows, as JSON that every Vega editor opens.

        Parameters
        ----------
        path : str or Path
            File, as ``"masses.vl.json"``.

        Returns
        -------
        Path
            The file.
        """
        file = Path(path)
        file.write_text(json.dumps(self.to_dict(), ensure_ascii=False), encoding="utf-8")
        return file

    def _repr_mimebundle_(
        self, include: Sequence[str] | None = None, exclude: Sequence[str] | None = None
    ) -> dict[str, Any]:
        """Show itself in a notebook."""
        formats = {MIME_TYPE: self.to_dict(), "text/plain": repr(self)}
        wanted = formats if include is None else include
        return {kind: formats[kind] for kind in wanted if kind not in (exclude or ())}

    def __repr__(self) -> str:
        return f"<VegaFigure {self.name}: {self.description}>"


def figure(
    name: str, data: Mapping[str, Columns], words: Mapping[str, Any] | None = None
) -> VegaFigure:
    """Fill in a specification; every word that it leaves open must be given.

    A layer whose data set has no rows is left out.
    """
    empty = {key for key, columns in data.items() if not any(map(len, columns.values()))}
    whole = filled(_read(name), words or {})
    return VegaFigure(name, _without(whole, empty), {k: data[k] for k in data if k not in empty})


def _without(part: Any, empty: Collection[str]) -> Any:
    """Drop the layers of a specification whose data sets are empty."""
    if isinstance(part, list):
        kept = (
            one
            for one in part
            if not (isinstance(one, Mapping) and (one.get("data") or {}).get("name") in empty)
        )
        return [_without(one, empty) for one in kept]
    if isinstance(part, Mapping):
        return {key: _without(value, empty) for key, value in part.items()}
    return part


def described(drawn: VegaFigure, sentence: str) -> VegaFigure:
    """Say in a sentence with numbers what a figure shows."""
    return replace(drawn, specification={**drawn.specification, "description": sentence})


def filled(part: Any, words: Mapping[str, Any]) -> Any:
    """Replace ``"$name"`` by a value of any kind, and ``$name`` within a text by its text."""
    if isinstance(part, Mapping):
        return {key: filled(value, words) for key, value in part.items()}
    if isinstance(part, list):
        return [filled(value, words) for value in part]
    if isinstance(part, str) and "$" in part:
        return words[part[1:]] if part[1:] in words else Template(part).substitute(words)
    return part


@cache
def _text(name: str) -> str:
    return (files("iscat_analysis.report") / name).read_text(encoding="utf-8")


def _read(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(_text(f"specifications/{name}.vl.json"))
    return found


def look_of(name: str, words: Mapping[str, Any]) -> dict[str, Any]:
    """Give title, axes and looks of a figure that is drawn by a general specification."""
    found: dict[str, Any] = filled(json.loads(_text("specifications/figures.json"))[name], words)
    return found


def configuration() -> dict[str, Any]:
    """Give what all figures share: colours, letters and lines."""
    found: dict[str, Any] = json.loads(_text("specifications/config.json"))
    return found


@cache
def libraries() -> str:
    """Give the scripts that draw, for a page that needs no network."""
    entries = json.loads(_text("vendor/libraries.json"))
    return "\n".join(_text(f"vendor/{entry['file']}") for entry in entries)


# ---- Data sets -----------------------------------------------------------------------------------


def columns_of(rows: Any) -> dict[str, list[Any]]:
    """Turn records, a table, or columns, of which one may be a single value, into columns."""
    table = pd.DataFrame(rows)
    return {str(name): plain_values(table[name].tolist()) for name in table}


def plain_values(values: Iterable[Any]) -> list[Any]:
    """Round numbers to so many digits as a figure needs; null for what is not finite."""
    return [_plain(value) for value in values]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def records(columns: Columns) -> list[dict[str, Any]]:
    """Turn columns into records."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


# ---- On a page -----------------------------------------------------------------------------------


def payload(figures: Mapping[str, VegaFigure]) -> dict[str, Any]:
    """Collect figures for a page, which holds a data set that several share once."""
    sets: dict[str, Columns] = {}
    collected = {}
    for name, drawn in figures.items():
        keys = {}
        for local, columns in drawn.data.items():
            key = local
            while key in sets and sets[key] is not columns:
                key = f"{name}-{key}"
            sets[key], keys[local] = columns, key
        about = {**drawn.specification["usermeta"], "datasets": keys}
        collected[name] = {**drawn.specification, "usermeta": about}
    return {"figures": collected, "datasets": sets, "config": configuration()}


def figures_in(page: Path) -> dict[str, VegaFigure]:
    """Read the figures of a page that was written before.

    Parameters
    ----------
    page : Path
        The page.

    Returns
    -------
    dict of str to VegaFigure
        Figures by name, in the order of the page.

    Raises
    ------
    DataError
        The file cannot be read, or is no page of this version.
    """
    try:
        found = _DATA.search(page.read_text(encoding="utf-8"))
        held = json.loads(found[1]) if found else {}
        return {
            name: VegaFigure(
                specification["usermeta"]["name"],
                specification,
                {
                    local: held["datasets"][key]
                    for local, key in specification["usermeta"]["datasets"].items()
                },
            )
            for name, specification in held["figures"].items()
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{page}: holds no figures of this version ({error!r})") from None
