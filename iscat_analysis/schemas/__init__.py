"""JSON schemas (draft 2020-12) of what the commands print and write, one file each."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from iscat_analysis.errors import ConfigError


def schema_names() -> tuple[str, ...]:
    """List the schemas there are.

    Returns
    -------
    tuple of str
        Sorted.
    """
    found = (entry.name for entry in files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(".json") for name in found if name.endswith(".json")))


def schema(name: str) -> dict[str, Any]:
    """Give the JSON schema of one kind of output.

    Parameters
    ----------
    name : str
        ``"fit"``, ``"simulate"`` or ``"bounds"`` for what the command prints with ``--json``, and
        ``"comparison"`` for ``iscat bounds --preset``; ``"summary"``, ``"benchmark"``, ``"camera"``
        or ``"calibration"`` for the file of that name and what is printed beside it.

    Returns
    -------
    dict
        A JSON schema, draft 2020-12, with a description and a unit for every number.

    Raises
    ------
    ConfigError
        There is no such schema; the known ones are named.
    """
    names = schema_names()
    if name not in names:
        raise ConfigError(f"schema {name!r} is not known; there are {', '.join(names)}")
    text = files(__name__).joinpath(f"{name}.json").read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found
