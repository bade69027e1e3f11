"""What a notebook shows of anything public is short, however much it holds."""

from __future__ import annotations

import dataclasses
import inspect
import typing
from typing import Any

import numpy as np
import pandas as pd
import pytest
from report_factory import make_analysis, with_traces

import iscat_analysis as ia

LINES, CHARACTERS = 20, 2500


def _returned() -> set[type]:
    """Collect the public classes, and those that public functions and methods return."""
    found: set[type] = set()
    public = [getattr(ia, name) for name in ia.__all__]
    for one in public:
        methods = inspect.getmembers(one, inspect.isfunction) if isinstance(one, type) else ()
        for work in (one, *(work for name, work in methods if not name.startswith("_"))):
            told = getattr(work, "__annotations__", {}).get("return", "")
            module = inspect.getmodule(work)
            kind = vars(module).get(str(told).split(" | ", maxsplit=1)[0]) if module else None
            found |= {each for each in (one, kind) if isinstance(each, type)}
    return {one for one in found if one.__module__.startswith("iscat_")}


def _full(kind: type) -> Any:
    """Make a record whose arrays, tables, texts and tuples are large."""
    made = object.__new__(kind)
    for field in dataclasses.fields(kind):
        told = str(field.type)
        value: Any = 1.25
        if "DataFrame" in told:
            value = pd.DataFrame(np.zeros((300, 12)))
        elif "Array" in told:
            value = np.arange(4e4).reshape(200, 200)
        elif "Mapping" in told or "dict" in told:
            value = {f"key {n}": list(range(50)) for n in range(100)}
        elif "..." in told or "Sequence" in told or "list" in told:
            value = tuple(np.arange(500.0))
        elif told == "str":
            value = "a line\n" * 100
        elif told == "Config":
            value = ia.configure()
        object.__setattr__(made, field.name, value)
    return made


RECORDS = {
    one
    for one in _returned()
    if dataclasses.is_dataclass(one) and one not in (ia.Result, ia.Bounds)
}


@pytest.mark.parametrize("kind", sorted(RECORDS, key=lambda kind: kind.__qualname__))
def test_a_record_is_short(kind: type) -> None:
    text = repr(_full(kind))
    assert kind.__name__ in text
    assert len(text.splitlines()) <= LINES
    assert len(text) <= CHARACTERS


def test_the_walk_meets_what_is_large() -> None:
    """Control: the records that were long are among those that are looked at."""
    names = {kind.__name__ for kind in RECORDS}
    assert {"LogLikelihood", "Analysis", "EventView", "Distribution", "OpticsForecast"} <= names
    assert typing.get_type_hints(ia.log_likelihood)["return"] is ia.LogLikelihood


def test_results_figures_and_settings_are_short() -> None:
    optics, camera = ia.Optics(na=1.42, focus_nm=-300), ia.Camera(pixel_size_nm=84.4)
    many = dataclasses.replace(make_analysis(400), findings=make_analysis(1).findings * 50)
    settings = {"camera.pixel_size_nm": 84.4, "optics.attenuation": 0.1, "bounds.n_after": 200}
    result = ia.Result(many)
    line = ia.Calibration(gradient_per_kda=-3.1e-5)
    shown = (
        result, ia.Result(make_analysis(60, "track")), ia.Result(with_traces(make_analysis(3))),
        result.figure("masses"), result.plot_masses(), result.plot_precision(), result.findings,
        optics, camera, ia.Particle(mass_kda=480), line, ia.configure(),
        ia.instruments, ia.compute_bounds(settings=settings),
    )  # fmt: skip
    for one in shown:
        assert len(repr(one).splitlines()) <= LINES, type(one)
