"""Posterior samples as the groups of an ArviZ InferenceData, and the file that holds them."""

from __future__ import annotations

import importlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iscat_analysis.records import Analysis, EventView
from iscat_analysis.report.numbers import UNITS

if TYPE_CHECKING:
    import xarray


def posterior_groups(analysis: Analysis, views: Sequence[EventView]) -> dict[str, xarray.Dataset]:
    """Arrange posteriors as ArviZ does, with the events as one more dimension."""
    import xarray  # takes half a second, and only chains need it

    chains = [view.posterior for view in views if view.posterior is not None]
    names = chains[0].names
    n_chain, n_draw = (min(p.samples.shape[axis] for p in chains) for axis in (0, 1))
    axes = ("chain", "draw", "event")
    samples = np.stack([p.samples[:n_chain, -n_draw:] for p in chains], axis=2)
    values = np.stack([p.log_likelihood[:n_chain, -n_draw:] for p in chains], axis=2)
    coordinates = {
        "chain": range(n_chain),
        "draw": range(n_draw),
        "event": [view.event for view in views],
    }
    refused = [
        (view.event, view.posterior.message)
        for view in analysis.views
        if view.posterior is not None and not view.posterior.converged
    ]
    about = {
        "sampling_library": "emcee",
        "input_path": analysis.provenance.input_path,
        "input_sha256": analysis.provenance.input_sha256,
        "events_not_converged": json.dumps([int(event) for event, _ in refused]),
        "reasons_not_converged": json.dumps([message for _, message in refused]),
        "draws_before_cutting": json.dumps([int(p.samples.shape[1]) for p in chains]),
    }
    by_parameter = {
        name: (("event", "parameter"), np.stack([getattr(p, name) for p in chains]))
        for name in ("tau", "r_hat", "ess_bulk", "ess_tail")
    }
    if all(p.van_trees is not None for p in chains):
        by_parameter["van_trees"] = (
            ("event", "parameter"),
            np.stack([np.asarray(p.van_trees) for p in chains]),
        )
    statistics = {
        "log_likelihood": (axes, values),
        "acceptance": (("event",), np.array([p.acceptance for p in chains])),
        **by_parameter,
    }
    variables = {
        name: (axes, samples[..., k], {"units": UNITS[name]}) for k, name in enumerate(names)
    }
    return {
        "posterior": xarray.Dataset(variables, coordinates, about),
        "sample_stats": xarray.Dataset(
            statistics, {**coordinates, "parameter": list(names)}, about
        ),
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
