"""The machine-readable half of the output folder: tables, summary, configuration, posterior."""

from __future__ import annotations

import importlib
import io
import json
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.records import EVENT_COLUMNS, Analysis, EventView
from iscat_analysis.schemas import to_json

CSV_DIGITS = 9
"""Significant digits in ``fits.csv``: 0.1 pm in a field of 100 µm, with no digits of pure noise."""


_Variable = tuple[tuple[str, ...], NDArray[Any], Mapping[str, str]]
"""Axes, values and attributes of a variable in ``posterior.nc``."""


def event_table(analysis: Analysis) -> pd.DataFrame:
    """Put the table of an analysis into the shape it is published in.

    Parameters
    ----------
    analysis : Analysis
        Its `table` may be empty and may hold flags as tuples.

    Returns
    -------
    pandas.DataFrame
        Columns `EVENT_COLUMNS` in that order, then those that only some analyses have; flags
        joined by ``;``, status as text.

    Raises
    ------
    ValueError
        The table lacks one of the columns.
    """
    missing = [name for name in EVENT_COLUMNS if name not in analysis.table.columns]
    if missing and len(analysis.table):
        raise ValueError(f"analysis.table lacks the columns {', '.join(missing)}")
    further = [name for name in analysis.table.columns if name not in EVENT_COLUMNS]
    table = analysis.table.reindex(columns=[*EVENT_COLUMNS, *further]).reset_index(drop=True)
    for name in ("event", "frame", "n_before", "n_after"):
        table[name] = table[name].astype("int64")
    for name in EVENT_COLUMNS[4:-2]:
        table[name] = table[name].astype("float64")
    table["status"] = [_text(value) for value in table["status"]]
    table["flags"] = [_text(value) for value in table["flags"]]
    return table.astype({"status": "object", "flags": "object"})


def _text(value: Any) -> str:
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, str):
        return value
    if isinstance(value, (tuple, list)):
        return ";".join(_text(item) for item in value)
    return ""


def write_tables(analysis: Analysis, folder: Path) -> None:
    """Write ``fits.csv``, ``fits.parquet``, ``summary.json`` and ``config.toml``.

    Parameters
    ----------
    analysis : Analysis
        What to write.
    folder : Path
        An existing folder.
    """
    table = event_table(analysis)
    table.to_csv(
        folder / "fits.csv", index=False, float_format=f"%.{CSV_DIGITS}g", lineterminator="\n"
    )
    with (folder / "fits.parquet").open("wb") as file:  # pyarrow opens no path that is not text
        table.to_parquet(file, index=False)
    summary = to_json("summary", analysis.summary)
    (folder / "summary.json").write_text(summary + "\n", encoding="utf-8")
    (folder / "config.toml").write_text(analysis.config_toml, encoding="utf-8")


def write_posterior(analysis: Analysis, path: Path) -> bool:
    """Write the converged posteriors as one ArviZ InferenceData file.

    The events are a dimension, so that ``az.from_netcdf(path).posterior["mass_kda"].sel(event=7)``
    is one event's chain.  Chains of different length are cut to the last draws that all have.
    Events whose chains did not converge are left out and named in the attributes.

    Parameters
    ----------
    analysis : Analysis
        Its views may carry posteriors.
    path : Path
        The file to write.

    Returns
    -------
    bool
        Whether there was a converged posterior to write.
    """
    sampled = [view for view in analysis.views if view.posterior is not None]
    usable = [view for view in sampled if view.posterior is not None and view.posterior.converged]
    if not usable:
        return False
    posteriors = [view.posterior for view in usable if view.posterior is not None]
    names = posteriors[0].names
    n_chain = min(p.samples.shape[0] for p in posteriors)
    n_draw = min(p.samples.shape[1] for p in posteriors)
    samples = np.stack([p.samples[:n_chain, -n_draw:] for p in posteriors], axis=2)
    log_likelihood = np.stack([p.log_likelihood[:n_chain, -n_draw:] for p in posteriors], axis=2)
    chain, event = ("chain", "draw", "event"), [int(view.event) for view in usable]
    coords = {
        "chain": np.arange(n_chain),
        "draw": np.arange(n_draw),
        "event": np.array(event),
        "parameter": np.array(names, dtype=object),
    }
    diagnostics: dict[str, _Variable] = {
        name: (("event", "parameter"), np.stack([getattr(p, name) for p in posteriors]), {})
        for name in ("tau", "r_hat", "ess_bulk", "ess_tail")
    }
    refused = [v for v in sampled if v.posterior is not None and not v.posterior.converged]
    attributes = {
        "sampling_library": "emcee",
        "input_path": analysis.provenance.input_path,
        "input_sha256": analysis.provenance.input_sha256,
        "events_not_converged": json.dumps([int(view.event) for view in refused]),
        "reasons_not_converged": json.dumps([_reason(view) for view in refused]),
        "draws_before_cutting": json.dumps([int(p.samples.shape[1]) for p in posteriors]),
    }
    statistics: dict[str, _Variable] = {
        "log_likelihood": (chain, log_likelihood, {}),
        "acceptance": (("event",), np.array([p.acceptance for p in posteriors]), {}),
        **diagnostics,
    }
    groups: dict[str, dict[str, _Variable]] = {
        "posterior": {name: (chain, samples[..., i], _unit(name)) for i, name in enumerate(names)},
        "sample_stats": statistics,
    }
    # In memory: where the disk is full, libhdf5 does not fail but crashes.
    buffer = io.BytesIO()
    h5netcdf: Any = importlib.import_module("h5netcdf")  # it has no types
    with h5netcdf.File(buffer, "w") as file:
        for name, variables in groups.items():
            _write_group(file.create_group(name), variables, coords, attributes)
    path.write_bytes(buffer.getbuffer())
    return True


def _write_group(
    group: Any,
    variables: Mapping[str, _Variable],
    coords: Mapping[str, NDArray[Any]],
    attributes: Mapping[str, str],
) -> None:
    """Write one group of an InferenceData file, as xarray lays it out."""
    used = [name for name in coords if any(name in axes for axes, _, _ in variables.values())]
    group.dimensions = {name: len(coords[name]) for name in used}
    labels: dict[str, _Variable] = {name: ((name,), coords[name], {}) for name in used}
    for name, (axes, values, units) in {**labels, **variables}.items():
        kind = h5py.string_dtype() if values.dtype == object else values.dtype
        group.create_variable(name, axes, kind, data=values).attrs.update(units)
    group.attrs.update(attributes)


def _unit(name: str) -> dict[str, str]:
    return {"units": "kDa" if name.endswith("kda") else "nm"}


def _reason(view: EventView) -> str:
    return view.posterior.message if view.posterior is not None else ""
