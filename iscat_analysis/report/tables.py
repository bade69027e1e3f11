"""What programs read of a result: tables, summary, configuration, and chains for ArviZ."""

from __future__ import annotations

import importlib
import io
import json
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from iscat_analysis.records import EVENT_COLUMNS, EVENTS, Analysis, EventView
from iscat_analysis.report.numbers import UNITS
from iscat_analysis.schemas import to_json

if TYPE_CHECKING:
    import xarray

CSV_DIGITS = 9
"""Significant digits in ``fits.csv``: 0.1 pm in a field of 100 µm, with no digits of pure noise."""


def event_table(analysis: Analysis) -> pd.DataFrame:
    """Put the table of an analysis into the shape it is published in."""
    missing = [name for name in EVENT_COLUMNS if name not in analysis.table.columns]
    if missing and len(analysis.table):
        raise ValueError(f"analysis.table lacks the columns {', '.join(missing)}")
    further = [name for name in analysis.table.columns if name not in EVENT_COLUMNS]
    table = analysis.table.reindex(columns=[*EVENT_COLUMNS, *further]).reset_index(drop=True)
    kept = {column.name: column for column in EVENTS if not column.optional}
    for name in kept:
        if kept[name].is_text:
            table[name] = table[name].map(_text)
    return table.astype({name: column.dtype for name, column in kept.items()})


def _text(value: Any) -> str:
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, str):
        return value
    if isinstance(value, (tuple, list)):
        return ";".join(_text(item) for item in value)
    return ""


def write_csv(table: pd.DataFrame, path: Path, digits: int = CSV_DIGITS) -> None:
    """Write a table as CSV, with the same bytes on every system."""
    table.to_csv(path, index=False, float_format=f"%.{digits}g", lineterminator="\n")


def write_json(name: str, values: Any, path: Path) -> None:
    """Write a document through its schema."""
    path.write_text(to_json(name, values) + "\n", encoding="utf-8")


def write_tables(analysis: Analysis, folder: Path) -> None:
    """Write ``fits.csv``, ``tracks.csv`` where there are tracks, both as Parquet, and the rest.

    The rest is ``summary.json``, ``config.toml``, and the response of a camera that is not linear.
    """
    tables = {"fits": event_table(analysis)}
    if analysis.tracks is not None:
        tables["tracks"] = analysis.tracks
    for name, table in tables.items():
        write_csv(table, folder / f"{name}.csv")
        with (folder / f"{name}.parquet").open("wb") as file:  # pyarrow wants paths as text
            table.to_parquet(file, index=False)
    if analysis.response is not None:
        write_csv(analysis.response, folder / "response.csv")
    write_json("summary", analysis.summary, folder / "summary.json")
    (folder / "config.toml").write_text(analysis.config_toml, encoding="utf-8")


def posterior_groups(analysis: Analysis, views: Sequence[EventView]) -> dict[str, xarray.Dataset]:
    """Arrange posteriors as ArviZ does, with the events as one more dimension."""
    import xarray  # takes half a second, and only chains need it

    chains = [view.posterior for view in views if view.posterior is not None]
    names = chains[0].names
    n_chain, n_draw = (min(p.samples.shape[axis] for p in chains) for axis in (0, 1))
    axes = ("chain", "draw", "event")
    samples = np.stack([p.samples[:n_chain, -n_draw:] for p in chains], axis=2)
    values = np.stack([p.log_likelihood[:n_chain, -n_draw:] for p in chains], axis=2)
    events = [view.event for view in views]
    coordinates = {"chain": range(n_chain), "draw": range(n_draw), "event": events}
    refused = {
        int(view.event): view.posterior.message
        for view in analysis.views
        if view.posterior is not None and not view.posterior.converged
    }
    about = {
        "sampling_library": "emcee",
        "input_path": analysis.provenance.input_path,
        "input_sha256": analysis.provenance.input_sha256,
        "events_not_converged": json.dumps(list(refused)),
        "reasons_not_converged": json.dumps(list(refused.values())),
        "draws_before_cutting": json.dumps([int(p.samples.shape[1]) for p in chains]),
    }
    kinds = ["tau", "r_hat", "ess_bulk", "ess_tail"]
    if all(p.van_trees is not None for p in chains):
        kinds.append("van_trees")
    statistics = {
        "log_likelihood": (axes, values),
        "acceptance": (("event",), np.array([p.acceptance for p in chains])),
        **{
            kind: (("event", "parameter"), np.stack([getattr(p, kind) for p in chains]))
            for kind in kinds
        },
    }
    variables = {
        name: (axes, samples[..., k], {"units": UNITS[name]}) for k, name in enumerate(names)
    }
    by_name = {**coordinates, "parameter": list(names)}
    return {
        "posterior": xarray.Dataset(variables, coordinates, about),
        "sample_stats": xarray.Dataset(statistics, by_name, about),
    }


def write_posterior(analysis: Analysis, path: Path) -> bool:
    """Write the converged posteriors as one ArviZ InferenceData file.

    ``arviz.from_netcdf(path).posterior["mass_kda"].sel(event=7)`` is one event's chain.  Events
    whose chains did not converge are left out and named in the attributes.
    """
    usable = [v for v in analysis.views if v.posterior is not None and v.posterior.converged]
    if not usable:
        return False
    from xarray.backends import H5NetCDFStore

    h5netcdf: Any = importlib.import_module("h5netcdf")  # it has no types
    # Made in memory, because libhdf5 crashes instead of failing where the disk is full.
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        for name, group in posterior_groups(analysis, usable).items():
            group.dump_to_store(H5NetCDFStore(file, group=name, mode="a"))
    path.write_bytes(buffer.getbuffer())
    return True
