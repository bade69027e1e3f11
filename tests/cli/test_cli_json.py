"""What the commands print with --json, and the JSON they write, against the published schemas.

Those of `iscat benchmark` are checked in test_cli_benchmark, where it runs.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
import tifffile
from small_movies import SMALL

from iscat_analysis.bounds.paper import table1
from iscat_analysis.config import config_to_toml, load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import EVENT_COLUMNS, EVENTS, Status
from iscat_analysis.schemas import schema, schema_names
from iscat_cli import main

pytestmark = pytest.mark.usefixtures("all_sketched")


def _check(value: Any, name: str) -> None:
    jsonschema.Draft202012Validator(schema(name)).validate(value)


@pytest.fixture(scope="module")
def setup(tmp_path_factory, sample_configs) -> Path:
    """Write a small configuration."""
    path = tmp_path_factory.mktemp("json") / "setup.toml"
    path.write_text(config_to_toml(load_config(sample_configs["mass"], SMALL)), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def movie(setup: Path) -> Path:
    """Simulate what it says."""
    path = setup.with_name("movie.tif")
    assert main(["simulate", "--config", str(setup), "--out", str(path), "--quiet"]) == 0
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


@pytest.mark.parametrize("mode", ["mass", "localize", "joint"])
def test_fit_and_summary(mode: str, movie, setup, capsys, tmp_path) -> None:
    out = tmp_path / "movie.iscat"
    options = ["--config", str(setup), "--mode", mode, "--out", str(out)]
    found = _printed(capsys, "fit", str(movie), *options)
    _check(found, "fit")
    assert len(found["events"]) == 1
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    _check(summary, "summary")
    empty = found | {"events": [], "status": {}}
    _check(empty, "fit")
    if mode == "mass":
        _refuses_what_is_wrong(found)


def _refuses_what_is_wrong(good: dict[str, Any]) -> None:
    """Make sure of the schema: one that accepts everything would pass all of these tests."""
    for change in (
        lambda fit: fit.pop("versions"),
        lambda fit: fit["events"][0].pop("crb_x_nm"),
        lambda fit: fit["events"][0].update(status="good"),
        lambda fit: fit["events"][0].update(p_value=1.5),
        lambda fit: fit["events"][0].update(sigma_x_nm=-1.0),
        lambda fit: fit["events"][0].update(unknown=1),
        lambda fit: fit.update(events=1),
        lambda fit: fit["input"].update(sha256="abc"),
    ):
        bad = copy.deepcopy(good)
        change(bad)
        with pytest.raises(jsonschema.ValidationError):
            _check(bad, "fit")


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
        ["--scan", "focus=-200:200:200"],
        ["--optimize", "focus", "--for", "mass"],
        ["--optimize", "pupil", "--free", "phase"],
        ["--target", "mass=5kDa"],
        ["--set", "optics.scheme=cobri"],
    ],
)
def test_bounds(options: list[str], setup, capsys) -> None:
    _check(_printed(capsys, "bounds", "--config", str(setup), *options), "bounds")


def test_camera(movie, capsys, tmp_path) -> None:
    shade = tmp_path / "dark.tif"
    dark = 100 + 4 * np.random.default_rng(1).standard_normal((60, 64, 64))
    tifffile.imwrite(shade, np.rint(dark).astype("u2"))
    for number, options in enumerate(
        ([str(movie), "--offset", "0"], [str(movie)], ["--dark", str(shade)])
    ):
        out = tmp_path / str(number)
        printed = _printed(capsys, "calibrate", "camera", *options, "--out", str(out))
        _check(printed, "camera")
        written = json.loads((out / "camera.json").read_text(encoding="utf-8"))
        _check(written, "camera")
        assert set(printed) | set(written) == set(schema("camera")["properties"])
        with pytest.raises(jsonschema.ValidationError):
            _check(printed | {"gain_e_per_adu": {"value": 1.0}}, "camera")


def test_comparison(capsys, tmp_path, monkeypatch) -> None:
    """The table alone: test_bounds makes the figures."""
    found = SimpleNamespace(table=table1(), curves=None, images=None, quantum=None)
    monkeypatch.setattr("iscat_analysis.bounds.paper.reproduce", lambda **_: found)
    monkeypatch.setattr("iscat_analysis.report.bounds.write_paper", lambda *_, **__: None)
    printed = _printed(capsys, "bounds", "--preset", "dong2021", "--out", str(tmp_path / "paper"))
    _check(printed, "comparison")
    with pytest.raises(jsonschema.ValidationError):
        _check({"table_1": printed["table_1"][:4]}, "comparison")


def test_calibration(capsys, tmp_path) -> None:
    random = np.random.default_rng(1)
    table = pd.DataFrame(0.0, index=range(180), columns=list(EVENT_COLUMNS))
    mass = random.normal(np.repeat([66.0, 146.0, 480.0], 60), 8.0)
    table = table.assign(mass_kda=mass, sigma_mass_kda=8.0, contrast=-3.1e-5 * mass, status="ok")
    table.to_csv(tmp_path / "fits.csv", index=False)
    out = tmp_path / "line"
    arguments = ["calibrate", "mass", str(tmp_path / "fits.csv"), "--standards", "66,146,480"]
    printed = _printed(capsys, *arguments, "--out", str(out))
    _check(printed, "calibration")
    written = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    _check(written, "calibration")
    assert set(printed) | set(written) == set(schema("calibration")["properties"])
    with pytest.raises(jsonschema.ValidationError):
        _check(printed | {"landing": "grey"}, "calibration")


def test_optics_bounds(capsys, tmp_path, setup) -> None:
    given = ["--config", str(setup), "--for", "optics", "--events", "15", "--free", "focus,na"]
    printed = _printed(capsys, "bounds", *given, "--out", str(tmp_path / "plan"))
    _check(printed, "optics_bounds")
    written = json.loads((tmp_path / "plan" / "optics_bounds.json").read_text(encoding="utf-8"))
    assert written == printed
    with pytest.raises(jsonschema.ValidationError):
        _check(printed | {"events": 0}, "optics_bounds")
