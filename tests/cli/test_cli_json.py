"""What the commands print with --json, and the JSON they write, against the published schemas.

Those of `iscat benchmark` are checked in test_cli_benchmark, where it runs.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
from small_movies import SMALL

from iscat_analysis.bounds.paper import table1
from iscat_analysis.config import config_to_toml, load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import EVENT_COLUMNS, EVENTS, Status
from iscat_analysis.schemas import schema, schema_names
from iscat_cli import main


def _check(value: Any, name: str) -> None:
    jsonschema.Draft202012Validator(schema(name)).validate(value)


@pytest.fixture(scope="module")
def setup(tmp_path_factory, sample_configs) -> Path:
    """Write a small configuration."""
    path = tmp_path_factory.mktemp("json") / "setup.toml"
    path.write_text(config_to_toml(load_config(sample_configs["mass"], SMALL)), encoding="utf-8")
    return path


def _printed(capsys, *arguments: str) -> Any:
    capsys.readouterr()
    assert main([*arguments, "--json", "--quiet"]) == 0
    return json.loads(capsys.readouterr().out, parse_constant=pytest.fail)


def test_schemas_are_schemas() -> None:
    assert set(schema_names()) == {
        "batch", "benchmark", "bounds", "calibration", "camera", "challenge", "comparison", "fit",
        "init", "kd", "optics", "optics_bounds", "simulate", "species", "species_comparison",
        "summary", "template",
    }  # fmt: skip
    for name in schema_names():
        jsonschema.Draft202012Validator.check_schema(schema(name))
    with pytest.raises(ConfigError, match="there are batch, benchmark"):
        schema("fits")


def test_the_schema_of_an_event_is_the_table() -> None:
    event = schema("fit")["$defs"]["Event"]
    assert event["required"] == list(EVENT_COLUMNS)
    assert list(event["properties"]) == [column.name for column in EVENTS]
    assert schema("fit")["$defs"]["Status"]["enum"] == [str(status) for status in Status]
    assert all(column["description"] for column in event["properties"].values())


def test_simulate(setup, capsys, tmp_path) -> None:
    out = str(tmp_path / "movie.tif")
    _check(_printed(capsys, "simulate", "--config", str(setup), "--out", out), "simulate")


def test_simulated_movers(setup, capsys, tmp_path) -> None:
    options = ["--set=simulation.movers=[{count=2, d_um2_s=0.5}]", "--set=camera.frame_rate_hz=150"]
    options += ["--set=simulation.frames=40", "--config", str(setup)]
    written = _printed(capsys, "simulate", "--out", str(tmp_path / "movie.tif"), *options)
    _check(written, "simulate")
    tracks = {row["track"] for row in written["events"]}
    assert None in tracks
    assert len(tracks) >= 3
    assert main(["simulate", "--out", str(tmp_path / "two.tif"), *options]) == 0
    assert f"{len(tracks)} particles in" in capsys.readouterr().out


def test_what_fit_prints_holds_the_summary() -> None:
    printed, summary = schema("fit")["properties"], schema("summary")["properties"]
    assert set(printed) - set(summary) == {"out"}
    assert all(printed[key] == summary[key] for key in summary if key not in ("events", "tracks"))


def test_landing_movies(sample_configs, capsys, tmp_path) -> None:
    movie, config = str(tmp_path / "movie.tif"), str(sample_configs["landing"])
    small = ["simulation.count=4", "simulation.leavings=1", "simulation.shape=[64, 64]"]
    small += ["simulation.frames=400", "fit.spheres=[]"]
    options = ["--config", config, *(f"--set={change}" for change in small)]
    _check(_printed(capsys, "simulate", "--out", movie, *options), "simulate")
    found = _printed(capsys, "fit", movie, *options, "--inject", "2")
    _check(found, "fit")
    _check({**found, "events": len(found["events"])}, "summary")
    assert found["landing"]["landings"] > 0
    assert set(found) <= set(schema("fit")["properties"])


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--mode", "joint"],
        ["--set", "bounds.n_before=0"],
        ["--optimize", "focus", "--for", "mass"],
        ["--target", "mass=5kDa"],
        ["--set", "optics.scheme=cobri"],
    ],
)
def test_bounds(options: list[str], setup, capsys) -> None:
    _check(_printed(capsys, "bounds", "--config", str(setup), *options), "bounds")


def test_comparison(capsys, tmp_path, monkeypatch) -> None:
    """The table alone: test_bounds makes the figures."""
    found = SimpleNamespace(table=table1(), curves=None, images=None, quantum=None)
    monkeypatch.setattr("iscat_analysis.bounds.paper.reproduce", lambda **_: found)
    monkeypatch.setattr("iscat_analysis.report.bounds.write_paper", lambda *_, **__: None)
    printed = _printed(capsys, "bounds", "--preset", "dong2021", "--out", str(tmp_path / "paper"))
    _check(printed, "comparison")
    with pytest.raises(jsonschema.ValidationError):
        _check({"table_1": printed["table_1"][:4]}, "comparison")
