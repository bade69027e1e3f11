"""The JSON documents that the commands print and write, as pydantic models.

Each document is dumped through its model (`to_json`), and `schema` gives the JSON schema that
pydantic derives from it, so that the two cannot disagree.  A model states what readers may rely on:
every document may carry further keys, and readers should ignore those they do not know.  NaN and
infinity become null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import Enum
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from iscat_analysis.errors import ConfigError
from iscat_analysis.text import in_json

if TYPE_CHECKING:
    from pydantic import BaseModel

_DOCUMENTS: Mapping[str, str] = {
    "batch": "answers.Batch",
    "benchmark": "limits.Benchmark",
    "bounds": "limits.Bounds",
    "calibration": "fit.MassCalibration",
    "camera": "fit.Camera",
    "challenge": "limits.Challenge",
    "comparison": "limits.Comparison",
    "fit": "fit.Fit",
    "init": "answers.Init",
    "kd": "answers.Kd",
    "optics": "fit.Optics",
    "optics_bounds": "limits.OpticsBounds",
    "simulate": "fit.Simulate",
    "species": "answers.Species",
    "species_comparison": "answers.SpeciesComparison",
    "summary": "fit.Summary",
    "template": "fit.Template",
}
"""Model of each document; a model is imported when it is needed, which saves some milliseconds."""


def _model(name: str) -> type[BaseModel]:
    """Import the model of a document."""
    module, _, model = _DOCUMENTS[name].partition(".")
    found: type[BaseModel] = getattr(import_module(f"{__name__}.{module}"), model)
    return found


def schema_names() -> tuple[str, ...]:
    """List the documents that have a schema."""
    return tuple(_DOCUMENTS)


def schema(name: str) -> dict[str, Any]:
    """Give the JSON schema of one kind of output.

    Parameters
    ----------
    name : str
        ``"fit"``, ``"init"``, ``"batch"``, ``"simulate"`` or ``"bounds"`` for what the command
        prints with ``--json``, ``"comparison"`` and ``"optics_bounds"`` for ``iscat bounds
        --preset`` and ``--for optics``, ``"species_comparison"`` for ``iscat species`` of several
        tables; ``"summary"``, ``"benchmark"``, ``"challenge"``, ``"camera"``, ``"optics"``,
        ``"template"``, ``"calibration"``, ``"species"`` or ``"kd"`` for the file of that name and
        what is printed beside it.

    Returns
    -------
    dict
        A JSON schema, draft 2020-12, derived from the model that is dumped.

    Raises
    ------
    ConfigError
        There is no such schema; the known ones are named.
    """
    if not isinstance(name, str) or name not in _DOCUMENTS:
        raise ConfigError(f"schema {name!r} is not known; there are {', '.join(_DOCUMENTS)}")
    return _model(name).model_json_schema(mode="serialization")


def to_json(name: str, values: Mapping[str, Any]) -> str:
    """Write a document as JSON, through its model."""
    document = _model(name).model_validate(jsonable(values))
    plain = document.model_dump(mode="json", exclude_unset=True, by_alias=True)
    return in_json(json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False))


def jsonable(value: Any) -> Any:
    """Convert a value to strict JSON."""
    if value is None or isinstance(value, (str, bool, int)):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(jsonable(key)): jsonable(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return jsonable(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [jsonable(item) for item in value]
    return None if value != value else str(value)
